"""A log calibrates its car, without truth: tyres, inertia, steering and sensors by output error.

See docs/method.md#self-calibration.

The open-loop model of :mod:`~.single_track` is fitted to yaw rate and a_y. In normalised parameters θ (distance from
the prior in its standard deviations) the cost is

    Σ_logs Σ_channels N log(rms² + floor²) + ((K − 3) / 4)² + |θ|²,

where N counts two seconds of driving as one sample, the rms is of errors cut at three times theirs, and K is the
understeer gradient in 10⁻³ rad/(m/s²). Mass and place of the centre of gravity come from the file.

What is found serves the log, or the pool of logs, that it was found on; a calibration that the driving does not carry
is refused, and the file stays as it stands.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from pdhef_logtool.car.descent import Descent, descend
from pdhef_logtool.car.parts import FilterNoise
from pdhef_logtool.car.prior import Prior
from pdhef_logtool.car.vehicle import (
    GRAVITY_M_S2,
    STIFFNESS_TYRE_SHAPE,
    AxleTyre,
    Tyres,
    VehicleParameters,
)
from pdhef_logtool.estimators.calibration.driving import STEP_S, Driving, smoothed
from pdhef_logtool.estimators.calibration.single_track import (
    AY,
    FRICTION,
    OF_AY,
    OF_RATE,
    SPEED,
    TrackParameters,
    errors,
    low_pass,
)
from pdhef_logtool.records.signals import BoolArray, FloatArray

#: Model and sensors are compared below this frequency.
CUTOFF_HZ = 4.0
#: Driving that is worth one independent sample of each channel.
CORRELATION_S = 2.0
#: What the start of a stretch does not count, for its state is a guess.
SETTLE_S = 2.0
#: Errors are kept every so many steps of the grid: 12.5 Hz, three times the cutoff.
KEPT_STEPS = 4
#: Errors beyond this many times their rms count no more than there.
ROBUST = 3.0
#: No error is believed to be smaller: rad/s and m/s².
FLOORS = (0.0008, 0.03)
#: What the model leaves of yaw rate and a_y, rad/s and m/s² (docs/method.md#self-calibration).
MODEL_STD = (0.02, 0.3)
#: Share of an error's slow part that is forgotten at each step: of a_y over 5 s, for the road's bank wanders so.
FORGOTTEN = np.array([0.0, STEP_S / 5.0])
#: Steps of the search: of each start, then of the best of them.
FIRST_ITERATIONS, ITERATIONS = 8, 20
DERIVATIVE_STEP, MAX_STEP, MIN_GAIN = 0.02, 2.0, 1e-3

#: Priors of docs/method.md#self-calibration, 1 sd: in the logarithm, or in the parameter's unit.
FILE_STIFFNESS_STD, USUAL_STIFFNESS_STD, USUAL_STIFFNESS = 0.5, 0.4, (14.0, 15.0)
USUAL_UNDERSTEER, UNDERSTEER_STD = 3e-3, 4e-3
PEAK_STD, PEAK_OVER_SEEN, INERTIA_STD, RELAXATION_STD = 0.15, 1.05, 0.2, 0.4
OFFSET_STD_RAD, RATIO_STD, GAIN_STD = math.radians(0.5), 0.05, 0.03
AY_BIAS_STD, RATE_BIAS_STD, LEVER_STD_M, DELAY_STD_S = 0.1, 0.002, 1.0, 0.02
#: Share of a bend's lateral acceleration that the road's bank carries; roads have to 0.4, tracks and test grounds 0.
SUPERELEVATION_STD = 0.2

#: Parts and noise of ``physics`` on a calibrated car, chosen on simulated sweeps and roads: the stiffness was found
#: with the lag, and the bank takes up what roads do to a_y; what the model leaves of a_y is no white sensor noise.
PARTS, AY_STD = ("lag", "bank"), 1.0
#: A stiffness that is less well known is not exported to other logs (sd of its logarithm), nor an understeer gradient
#: that no car has, rad/(m/s²): a little oversteer to 7 degrees per g. The log itself uses every
#: calibration; parameters that are not excited stay at their prior and widen the interval.
LEAST_KNOWN_EXPORTED, PLAUSIBLE_UNDERSTEER = 0.15, (-2e-3, 12e-3)
#: Least driving above the lowest speed.
LEAST_S = 4.0
#: Directions of the posterior that a band follows, at most: those in which the drive's own sideslip is known least.
VARIED = 5

#: Where the search starts: θ by name.
STARTS: tuple[dict[str, float], ...] = (
    {},
    {"front cornering stiffness": -1.0, "rear cornering stiffness": -1.0},
    {"front cornering stiffness": 1.0, "rear cornering stiffness": 1.0},
)


@dataclass(frozen=True, slots=True)
class Calibrated:
    """One parameter: value, prior mean, posterior and prior 1-sigma, in its logarithm where ``log``."""

    name: str
    unit: str
    value: float
    prior: float
    sd: float
    prior_sd: float
    log: bool


@dataclass(frozen=True, slots=True)
class Understeer:
    """What the drive says of the understeer gradient, rad/(m/s²), beside the file: δ − L r/v over a_y.

    ``residual_rad`` is what the regression leaves, 1 sigma; beyond :data:`REGRESSION_LIMIT_RAD` it says nothing.
    """

    file: float
    drive: float
    drive_sd: float
    residual_rad: float
    seconds: float

    @property
    def known(self) -> bool:
        """Whether the drive says anything."""
        return self.seconds >= 0.5 * LEAST_S and self.residual_rad < REGRESSION_LIMIT_RAD

    @property
    def contradicts(self) -> bool:
        """Whether file and drive cannot both be right."""
        return self.known and abs(self.drive - self.file) > max(3.0 * self.drive_sd, LEAST_CONTRADICTION)

    @property
    def text(self) -> str:
        """In words, deg/g."""
        if not self.known:
            return "the drive says nothing of the file's understeer"
        unit = math.degrees(GRAVITY_M_S2)
        verdict = "which contradicts it" if self.contradicts else "which agrees"
        return f"understeer {self.file * unit:.1f} deg/g by the file, {self.drive * unit:.1f} by the drive, {verdict}"


#: Regression of the understeer gradient: its range of a_y, smoothing, largest residual, and least difference told.
REGRESSION_AY, REGRESSION_SMOOTH_S, REGRESSION_LIMIT_RAD, LEAST_CONTRADICTION = 4.0, 0.5, math.radians(0.6), 1.5e-3


@dataclass(frozen=True, slots=True, eq=False)
class SelfCalibration:
    """What the driving of a log, or of a pool of logs, says of its car without truth.

    Attributes
    ----------
    own : the file. vehicle : the file with what was found, whether or not it is refused.
    refused : why the file stays as it stands; empty if it does not.
    rms : of yaw rate, rad/s, and a_y, m/s², that the model leaves; of_file : that the file's leaves.
    seconds : of driving that counted. logs : in the pool.
    varied : the vehicle one posterior 1-sigma away in each of the directions that move its sideslip most.
    driven_d2_m_s : d2 of ``physics`` on it as far as it goes with the driving, NaN where no drive told.
    """

    own: VehicleParameters
    vehicle: VehicleParameters
    parameters: tuple[Calibrated, ...]
    understeer: Understeer | None
    refused: str
    rms: tuple[float, float]
    of_file: tuple[float, float]
    seconds: float
    logs: int
    varied: tuple[VehicleParameters, ...] = ()
    driven_d2_m_s: float = math.nan

    @property
    def stiffness_sd(self) -> float:
        """The larger posterior sd of the logarithm of a cornering stiffness; infinite where nothing was fitted."""
        found = [p.sd for p in self.parameters if p.name.endswith("cornering stiffness")]
        return max(found, default=math.inf)

    @property
    def noise(self) -> FilterNoise:
        """The noise of ``physics`` that belongs to it."""
        return FilterNoise(r_std={"ay_m_s2": max(AY_STD, self.own.sensors.ay_std_m_s2)})

    @property
    def text(self) -> str:
        """What a user is told, in one line."""
        told = "" if self.understeer is None else f"; {self.understeer.text}"
        if self.refused:
            return f"not calibrated, the file stays as it stands: {self.refused}{told}"
        by = {p.name: p for p in self.parameters}
        share = [
            f"{axle} stiffness {by[f'{axle} cornering stiffness'].value / self.of_own(axle) - 1.0:+.0%}"
            f" ± {by[f'{axle} cornering stiffness'].sd:.0%}"
            for axle in ("front", "rear")
        ]
        where = "this log" if self.logs == 1 else f"{self.logs} logs"
        return f"calibrated without truth on {self.seconds:.0f} s of {where}: {', '.join(share)}{told}"

    def of_own(self, axle: str) -> float:
        """Return the file's cornering stiffness of an axle in N/rad."""
        return self.own.cornering_stiffness_n_per_rad(axle == "front", self.own.assumed_friction)

    def to_dict(self) -> dict[str, Any]:
        """Return all of it as JSON-able values."""
        u = self.understeer
        return {
            "refused": self.refused or None,
            "text": self.text,
            "seconds": self.seconds,
            "logs": self.logs,
            "parameters": [
                {
                    "name": p.name,
                    "unit": p.unit,
                    "value": p.value,
                    "prior": p.prior,
                    "sd": p.sd,
                    "prior_sd": p.prior_sd,
                    "log": p.log,
                }
                for p in self.parameters
            ],
            "understeer": None
            if u is None
            else {
                "file_rad_per_m_s2": u.file,
                "drive_rad_per_m_s2": u.drive,
                "drive_sd_rad_per_m_s2": u.drive_sd,
                "residual_rad": u.residual_rad,
                "known": u.known,
                "contradicts": u.contradicts,
            },
            "yaw_rate_rms_rad_s": self.rms[OF_RATE],
            "ay_rms_m_s2": self.rms[OF_AY],
            "file_yaw_rate_rms_rad_s": self.of_file[OF_RATE],
            "file_ay_rms_m_s2": self.of_file[OF_AY],
        }


def self_calibrate(
    drives: Sequence[Driving],
    own: VehicleParameters,
    *,
    exported: bool = False,
    progress: Callable[[float], None] = lambda _share: None,
) -> SelfCalibration:
    """Calibrate a car on the driving of its logs, which were read with ``own``.

    Parameters
    ----------
    exported : whether other logs will use it, which takes better known parameters.
    """
    drives = [d for d in drives if len(d.stretches)]
    seconds = sum(d.seconds for d in drives)
    if seconds < LEAST_S:
        why = f"{seconds:.0f} s above {own.low_speed_blend_m_s:g} m/s, {LEAST_S:g} are needed"
        return SelfCalibration(own, own, (), None, why, (math.nan,) * 2, (math.nan,) * 2, seconds, len(drives))
    problem = _Problem(drives, own)
    theta, covariance = problem.solve(progress)
    std = np.sqrt(np.diag(covariance))
    vehicle = problem.vehicle(theta, digits=6)
    parameters = tuple(
        Calibrated(p.name, p.unit, p.value(float(t)), p.mean, float(s) * p.std, p.std, p.log)
        for p, t, s in zip(problem.priors, theta, std, strict=True)
    )
    found = SelfCalibration(
        own,
        vehicle,
        parameters,
        understeer_of(drives, own),
        "",
        problem.rms(theta),
        problem.rms_of_file(),
        seconds,
        len(drives),
        problem.varied(theta, covariance),
    )
    return _with_refusal(found) if exported else found


def _with_refusal(found: SelfCalibration) -> SelfCalibration:
    """Return a calibration, refused if it is too uncertain for other logs."""
    gradient = found.vehicle.understeer_gradient_rad_per_m_s2(found.vehicle.assumed_friction)
    low, high = PLAUSIBLE_UNDERSTEER
    why = ""
    if not low <= gradient <= high:
        why = f"an understeer gradient of {gradient * math.degrees(GRAVITY_M_S2):.1f} deg/g is no car's"
    elif found.stiffness_sd > LEAST_KNOWN_EXPORTED:
        why = (
            f"the driving leaves the cornering stiffness at ± {found.stiffness_sd:.0%}, "
            f"± {LEAST_KNOWN_EXPORTED:.0%} is needed"
        )
    return replace(found, refused=why)


def understeer_of(drives: Sequence[Driving], own: VehicleParameters) -> Understeer | None:
    """Return the regression of δ − L r/v on a_y where |a_y| < 4 m/s², smoothed; None where there is nothing of it."""
    excess, lateral = [], []
    for d in drives:
        steer, speed, rate, ay = (smoothed(c, d.stretches, REGRESSION_SMOOTH_S) for c in d.columns[:4])
        inside = _inside(d, round(SETTLE_S / STEP_S))
        use = inside & (np.abs(ay) < REGRESSION_AY)
        excess.append((steer - own.wheelbase_m * rate / np.where(use, speed, 1.0))[use])
        lateral.append((ay / (1.0 + GRAVITY_M_S2 * own.roll_gradient_rad_per_m_s2))[use])
    y, x = np.concatenate(excess), np.concatenate(lateral)
    if y.size < round(0.5 * LEAST_S / STEP_S) or float(np.std(x)) < 1e-6:
        return None
    use = np.ones(y.size, dtype=np.bool_)
    for _ in range(3):  # without what is far off the line
        slope, offset = np.polyfit(x[use], y[use], 1)
        left = y - slope * x - offset
        spread = float(np.sqrt(np.mean(left[use] ** 2)))
        use = np.abs(left) < ROBUST * spread
    independent = max(np.count_nonzero(use) * STEP_S / CORRELATION_S - 2.0, 1.0)
    sd = spread / (float(np.std(x[use])) * math.sqrt(independent))
    file = own.understeer_gradient_rad_per_m_s2(own.assumed_friction)
    return Understeer(file, float(slope), sd, spread, float(np.count_nonzero(use)) * STEP_S)


def _inside(drive: Driving, settle: int) -> BoolArray:
    """Return where the samples [N] of stretches stand that count, the first ``settle`` of each left out."""
    inside = np.zeros(drive.columns.shape[1], dtype=np.bool_)
    for a, b in drive.stretches:
        inside[a + settle : b] = True
    return inside


def varied_parameters(
    theta: FloatArray, root: FloatArray, sideslip: Callable[[FloatArray], FloatArray]
) -> list[FloatArray]:
    """Return parameters 1-sigma away from θ [n] along the directions of their posterior that move the sideslip most.

    ``root`` [n, m]: its product with its transpose is the posterior's covariance. ``sideslip`` of parameters, or errors
    of it, [K]. The directions, at most :data:`VARIED` and the largest first, are uncorrelated in the posterior and in
    what they do to the sideslip.
    """
    at = sideslip(theta)
    moved = np.stack([sideslip(theta + step) - at for step in root.T])
    _, axes = np.linalg.eigh(moved @ moved.T)
    return [theta + step for step in (root @ axes[:, ::-1][:, :VARIED]).T]


class _Problem:
    """The fit of one pool: its priors, its model, its cost."""

    def __init__(self, drives: Sequence[Driving], own: VehicleParameters) -> None:
        self._drives, self._own = drives, own
        self._filter = low_pass(CUTOFF_HZ, STEP_S)
        settle = round(SETTLE_S / STEP_S)
        self._kept = [np.flatnonzero(_inside(d, settle))[::KEPT_STEPS] for d in drives]
        self._samples = [k.size * KEPT_STEPS * STEP_S / CORRELATION_S for k in self._kept]
        self._out = [np.full((3, d.columns.shape[1]), np.nan) for d in drives]
        self._found = [np.full((2, d.columns.shape[1]), np.nan) for d in drives]
        self.priors = _priors(drives, own)

    def solve(self, progress: Callable[[float], None]) -> tuple[FloatArray, FloatArray]:
        """Return θ [n] and its posterior covariance [n, n]."""
        ends = []
        total = len(STARTS) + 1
        for number, start in enumerate(STARTS):
            first = np.array([start.get(p.name, 0.0) for p in self.priors])
            ends.append(self._descend(first, FIRST_ITERATIONS))
            progress((number + 1) / total)
        theta, normal, _ = self._descend(min(ends, key=lambda end: end.cost).theta, ITERATIONS)
        progress(1.0)
        return theta, np.asarray(np.linalg.inv(normal), dtype=np.float64)

    def varied(self, theta: FloatArray, covariance: FloatArray) -> tuple[VehicleParameters, ...]:
        """Return the vehicle 1-sigma away along the directions that move the open-loop v_y / v_x of the logs most.

        They are uncorrelated in the posterior and in what they do to the sideslip.
        """
        root = np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
        varied = varied_parameters(theta, root, self._sideslip)
        return tuple(self.vehicle(at, digits=6) for at in varied)

    def _sideslip(self, theta: FloatArray) -> FloatArray:
        """Return the open-loop v_y / v_x of all logs, of what a vehicle holds: without delays and superelevation."""
        self._errors(_track_of(self.vehicle(theta), self._own, {}))
        parts = zip(self._drives, self._out, self._kept, strict=True)
        return np.concatenate([out[2, k] / d.columns[SPEED, k] for d, out, k in parts])

    def vehicle(self, theta: FloatArray, *, digits: int = 17) -> VehicleParameters:
        """Return the file with the parameters at θ."""
        v = {p.name: float(f"{p.value(float(t)):.{digits}g}") for p, t in zip(self.priors, theta, strict=True)}
        own, mu = self._own, self._own.assumed_friction

        def tyre(axle: str) -> AxleTyre:
            peak, shape = v[f"{axle} peak force"], STIFFNESS_TYRE_SHAPE
            b = float(f"{v[f'{axle} cornering stiffness'] / (shape * peak):.{digits}g}")
            return AxleTyre(B=b, C=shape, D_n=float(f"{peak / mu:.{digits}g}"), E=0.0, reference_friction=mu)

        biases = {"ay_bias_m_s2": v["a_y bias"], "yaw_rate_bias_rad_s": v["yaw rate bias"]}
        gradient = (v["roll gain"] - 1.0) / GRAVITY_M_S2
        return own.model_copy(
            update={
                "tyres": Tyres(front=tyre("front"), rear=tyre("rear")),
                "yaw_inertia_kg_m2": v["yaw inertia"],
                "steer_offset_rad": v["steering offset"],
                "steering_ratio": v["steering ratio"],
                "roll_gradient_rad_per_m_s2": float(f"{gradient:.{digits}g}"),
                "friction": mu,
                "sensors": own.sensors.model_copy(update=biases),
                "imu_position_m": (v["lever of a_y"], *own.imu_position_m[1:]),
                "relaxation_length_m": v["relaxation length"],
                "physics": own.physics.model_copy(update=dict.fromkeys(PARTS, True)),
            }
        )

    def _track(self, theta: FloatArray) -> TrackParameters:
        v = {p.name: p.value(float(t)) for p, t in zip(self.priors, theta, strict=True)}
        return _track_of(self.vehicle(theta), self._own, v)

    def rms(self, theta: FloatArray) -> tuple[float, float]:
        """Return the rms of what the model leaves of yaw rate and a_y."""
        return self._pooled_rms(self._errors(self._track(theta)))

    def rms_of_file(self) -> tuple[float, float]:
        """Return the same for the file as it stands."""
        return self._pooled_rms(self._errors(_track_of(self._own, self._own, {})))

    @staticmethod
    def _pooled_rms(found: Sequence[FloatArray]) -> tuple[float, float]:
        rate, ay = np.sqrt(np.mean(np.concatenate(found, axis=1) ** 2, axis=1))
        return float(rate), float(ay)

    def _errors(self, p: TrackParameters) -> list[FloatArray]:
        """Return the errors [2, n] of each log."""
        for d, out, found in zip(self._drives, self._out, self._found, strict=True):
            errors(d.columns, d.stretches, STEP_S, p, self._filter, FORGOTTEN, out, found)
        return [f[:, k] for f, k in zip(self._found, self._kept, strict=True)]

    def _cost(self, found: _Tried, theta: FloatArray) -> float:
        fit = sum(
            n * math.log(_robust_square(e[row]) + FLOORS[row] ** 2)
            for e, n in zip(found.of_logs, self._samples, strict=True)
            for row in (OF_RATE, OF_AY)
        )
        return fit + float(theta @ theta) + found.gradient**2

    def _gradient_error(self, theta: FloatArray) -> float:
        vehicle = self.vehicle(theta)
        return (vehicle.understeer_gradient_rad_per_m_s2(vehicle.assumed_friction) - USUAL_UNDERSTEER) / UNDERSTEER_STD

    def _tried(self, theta: FloatArray) -> _Tried:
        return _Tried(self._errors(self._track(theta)), self._gradient_error(theta))

    def _descend(self, theta: FloatArray, iterations: int) -> Descent:
        found, _ = descend(
            self._tried,
            self._cost,
            self._scaled,
            theta,
            iterations=iterations,
            least_gain=lambda _: MIN_GAIN * sum(self._samples),
            derivative_step=DERIVATIVE_STEP,
            max_step=MAX_STEP,
        )
        return found

    def _scaled(self, found: _Tried, at: _Tried) -> FloatArray:
        """Return the residuals of errors, each log's channels in the scales and cut at the limits that ``at`` has."""
        parts = []
        for e, other, n in zip(found.of_logs, at.of_logs, self._samples, strict=True):
            sigma = np.array([math.sqrt(_robust_square(other[row]) + FLOORS[row] ** 2) for row in (OF_RATE, OF_AY)])
            limit, weight = ROBUST * sigma[:, None], np.sqrt(n / max(other.shape[1], 1)) / sigma
            parts.append((weight[:, None] * np.clip(e, -limit, limit)).ravel())
        return np.append(np.concatenate(parts), found.gradient)


class _Tried(NamedTuple):
    """What was found at a θ: the errors [2, n] of each log, and the understeer gradient's distance from its prior."""

    of_logs: list[FloatArray]
    gradient: float


def _robust_square(error: FloatArray) -> float:
    """Return the mean square of errors cut at :data:`ROBUST` times their rms."""
    limit = ROBUST * math.sqrt(float(np.mean(error**2)))
    return float(np.mean(np.minimum(np.abs(error), limit) ** 2))


def _track_of(vehicle: VehicleParameters, own: VehicleParameters, nuisance: Mapping[str, float]) -> TrackParameters:
    """Return the model of a vehicle for signals that were read with ``own``."""
    mu, mass = vehicle.assumed_friction, vehicle.mass_kg
    tyres = [vehicle.magic_formula(front, mu) for front in (True, False)]
    gain = own.steering_ratio / vehicle.steering_ratio
    return TrackParameters(
        front_m=vehicle.cg_to_front_axle_m,
        rear_m=vehicle.cg_to_rear_axle_m,
        mass_over_inertia=mass / vehicle.yaw_inertia_kg_m2,
        front_B=tyres[0][0] * tyres[0][1] / STIFFNESS_TYRE_SHAPE,
        rear_B=tyres[1][0] * tyres[1][1] / STIFFNESS_TYRE_SHAPE,
        front_peak=tyres[0][2] / mass,
        rear_peak=tyres[1][2] / mass,
        shape=STIFFNESS_TYRE_SHAPE,
        friction=mu,
        relaxation_m=max(vehicle.relaxation_length_m, 0.01),
        ay_gain=1.0 + GRAVITY_M_S2 * vehicle.roll_gradient_rad_per_m_s2,
        imu_x_m=vehicle.imu_position_m[0],
        ay_bias=vehicle.sensors.ay_bias_m_s2 - own.sensors.ay_bias_m_s2,
        rate_bias=vehicle.sensors.yaw_rate_bias_rad_s - own.sensors.yaw_rate_bias_rad_s,
        steer_gain=gain,
        steer_added=gain * own.steer_offset_rad - vehicle.steer_offset_rad,
        superelevation=nuisance.get("superelevation", 0.0),
        steer_delay=nuisance.get("steering delay", 0.0) / STEP_S,
        ay_delay=nuisance.get("a_y delay", 0.0) / STEP_S,
        rate_std=max(MODEL_STD[OF_RATE], own.sensors.yaw_rate_std_rad_s),
        ay_std=max(MODEL_STD[OF_AY], own.sensors.ay_std_m_s2),
    )


def _priors(drives: Sequence[Driving], own: VehicleParameters) -> tuple[Prior, ...]:
    """Return the priors; that of a stiffness combines the file's and that of any car.

    See docs/method.md#self-calibration.
    """
    mu = own.assumed_friction
    hard = [np.abs(d.columns[AY][_inside(d, 0)]) * mu / d.columns[FRICTION][_inside(d, 0)] for d in drives]
    gain = 1.0 + GRAVITY_M_S2 * own.roll_gradient_rad_per_m_s2
    seen = float(np.percentile(np.concatenate(hard), 99.5)) / gain
    priors = []
    for axle, front, usual in (("front", True, USUAL_STIFFNESS[0]), ("rear", False, USUAL_STIFFNESS[1])):
        load = own.axle_load_n(front)
        of_file, of_usual = FILE_STIFFNESS_STD**-2, USUAL_STIFFNESS_STD**-2
        middle = of_file * math.log(own.cornering_stiffness_n_per_rad(front, mu)) + of_usual * math.log(usual * load)
        mean, std = math.exp(middle / (of_file + of_usual)), (of_file + of_usual) ** -0.5
        peak = max(own.magic_formula(front, mu)[2] / load, PEAK_OVER_SEEN * seen / GRAVITY_M_S2) * load
        priors.append(Prior(f"{axle} cornering stiffness", "N/rad", mean, std, log=True))
        priors.append(Prior(f"{axle} peak force", "N", peak, PEAK_STD, log=True))
    sensors = own.sensors
    return (
        *priors,
        Prior("yaw inertia", "kg m^2", own.yaw_inertia_kg_m2, INERTIA_STD, log=True),
        Prior("steering offset", "rad", own.steer_offset_rad, OFFSET_STD_RAD),
        Prior("steering ratio", "1", own.steering_ratio, RATIO_STD, log=True),
        Prior("roll gain", "1", gain, GAIN_STD),
        Prior("a_y bias", "m/s^2", sensors.ay_bias_m_s2, AY_BIAS_STD),
        Prior("yaw rate bias", "rad/s", sensors.yaw_rate_bias_rad_s, RATE_BIAS_STD),
        Prior("lever of a_y", "m", own.imu_position_m[0], LEVER_STD_M),
        Prior("superelevation", "1", 0.0, SUPERELEVATION_STD),
        Prior("steering delay", "s", 0.0, DELAY_STD_S),
        Prior("a_y delay", "s", 0.0, DELAY_STD_S),
        Prior("relaxation length", "m", own.relaxation_length_m or 0.5, RELAXATION_STD, log=True),
    )
