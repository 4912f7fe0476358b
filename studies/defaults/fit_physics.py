"""Fit ``physics`` of the shipped car: its values and noise, on five minutes of simulated driving.

    python -m studies.defaults.fit_physics [-o FOLDER] [--work out/fit-physics] [--jobs 2]

First come axle slip angles and lateral forces from ground truth, with a magic formula through them: F_yf cos δ + F_yr =
m a_y and l_f F_yf cos δ − l_r F_yr = I_z ṙ give both axle forces; the slip angles follow from the true velocity (Eq 3,
4). The fit is least squares with priors (docs/method.md#identification).

The drives last 12.5 s, like the training drives of networks, with true friction and exact ground truth. The paper's
scenarios, with their different speeds and friction, are excluded. All other values come from the vehicle file. All
parts of the model are on: without one of them, the error on other drives was higher (docs/method.md#identification).

In normalised parameters θ (distance from the prior in its standard deviations) the cost is

    Σ_i N_i log(s_i² + s_0²) + |θ|² + (log(n) / w)²

where s_i is the RMS of the filter's sideslip error on drive i, N_i its length over the correlation time of the errors,
and s_0 the error floor. With a fixed σ in place of the log, the condition σ = RMS of the residual has two fixed points,
and a poor start ends at the worse one (docs/method.md#identification). The last term, of the mean normalized innovation
squared n, fixes the scale of Q and R; the gain depends on their ratio only. It is minimised by Gauss-Newton steps on
errors over their present s_i, derivatives by differences.

The single filter here has force scale and bank as states; in operation they are separate filters
(:mod:`~pdhef_logtool.estimators.adaptive_physics`). With a filter bank, the noise would overfit to few drives.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from pdhef_logtool.car.car import FIT_FILE, SHIPPED_CARS, Car
from pdhef_logtool.car.parts import FilterNoise, Fit, FittedPhysics, LearntOn, physics_sha256
from pdhef_logtool.car.toml_files import part_toml
from pdhef_logtool.car.vehicle import AxleTyre, PhysicsParts, Tyres, VehicleParameters, correct_signals
from pdhef_logtool.drive import reading
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.estimators.vehicle_ukf import PHYSICS_Q_STD, physics_filter
from pdhef_logtool.evaluation.smoothing import smooth
from pdhef_logtool.mapping import load_mapping
from pdhef_logtool.model.descent import descend
from pdhef_logtool.model.priors import Parameter
from pdhef_logtool.records.geometry import wrap_angle
from pdhef_logtool.records.signals import BoolArray, FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.residual_model.bundle import NO_MODEL
from studies.defaults.fit_nominal_tyres import axle_curves, magic_formula
from studies.pages import options
from truthsim.suite import write_suite

#: Error samples that fits use; more only cost time.
FIT_RATE_HZ = 20.0
#: Forces are smoothed without phase; accelerometers on real cars show the road above this.
SMOOTHING_HZ = 2.0
#: 1-sigma of the priors on log stiffness, log peak force, shape (docs/method.md#identification).
STIFFNESS_LOG_STD = 0.25
PEAK_LOG_STD = 0.10
SHAPE_STD = 0.10
SHAPE = 1.35
#: A peak below this multiple of the largest force that was seen is no peak.
PEAK_OVER_SEEN = 1.1
#: Standard deviation of an axle force about the curve, per kg of the car's mass.
FORCE_STD_N_PER_KG = 0.35

#: Usable where the true speed is above this multiple of the low-speed limit, and where the car does not spin or drift.
SPEED_FACTOR, MAX_SIDESLIP_RAD = 2.0, math.radians(8.0)


#: Correlation time of the errors, s; settling time of the filter, excluded from the error, s.
CORRELATION_S, SETTLE_S = 1.0, 2.0
#: An RMS below this is not accepted to be better still.
FLOOR_RAD = math.radians(0.05)
#: Spread of the logarithm of the mean normalized innovation squared about 0.
NIS_LOG_STD = 1.0
#: Errors beyond this many s count linearly: a moment in which the filter is lost must not decide the tyres.
ROBUST = 3.0
DERIVATIVE_STEP = 0.05
MAX_ITERATIONS, MAX_STEP, MIN_GAIN = 40, 1.5, 2e-4
#: Width of the tyres' priors about the axle-force fit, as a share of the widths about a vehicle file.
AXLE_FIT_SHARE = 0.5
NOISE_LOG_STD = 1.2
#: Sideslip error in degrees of fits to one half of the drives on the other half, and in turn: 0.0591, 0.0706; static
#: model 0.1333, 0.1679; without braking 0.0626, 0.0712, force scale 0.0638, 0.0811, bank 0.0701, 0.0730, biases 0.0616,
#: 0.0771, load transfer 0.0590, 0.0758, roll 0.0697, 0.0852, lag 0.0584, 0.0747. Biases are states, as those of a
#: drive: a mean over few drives would be no property of the car.
PARTS = PhysicsParts(**dict.fromkeys(PhysicsParts.model_fields, True))
Theta = dict[str, float]
#: Start values of θ. The noise cost has two valleys: clean sensors, and a filter with a low gain on a_y.
STARTS: tuple[Theta, ...] = ({}, {"r a_y": 1.5, "q v_y": 1.4, "q yaw rate": 2.3})


@dataclass(frozen=True, slots=True, eq=False)
class FitDrive:
    """A drive, or a part of it: signals [N] without any correction of a vehicle file, and ground truth [N]."""

    name: str
    signals: Signals
    truth: StateTrack


@dataclass(frozen=True, slots=True)
class AxleCurve:
    """Magic formula of one axle with E = 0: stiffness N/rad, peak N, shape C."""

    stiffness_n_per_rad: float
    peak_n: float
    shape: float

    def force_n(self, slip_rad: FloatArray) -> FloatArray:
        """Return D sin(C atan(B α)) with B = stiffness/(C D)."""
        b = self.stiffness_n_per_rad / (self.shape * self.peak_n)
        return magic_formula(slip_rad, b, self.shape, self.peak_n, 0.0)


def usable_stamps(signals: Signals, truth: StateTrack, vehicle: VehicleParameters) -> BoolArray:
    """Return where ground truth and signals can be learned from, [N]."""
    is_complete = truth.valid & np.isfinite(truth.vx_m_s + truth.vy_m_s + truth.yaw_rate_rad_s)
    moving = truth.vx_m_s > SPEED_FACTOR * vehicle.low_speed_blend_m_s
    tame = np.abs(truth.sideslip_rad) < MAX_SIDESLIP_RAD
    return np.asarray(is_complete & moving & tame & np.isfinite(signals.steer_rad))


def period_s(drive: FitDrive) -> float:
    """Return the usual time from one stamp to the next."""
    return float(np.median(np.diff(drive.signals.stamps_ns))) * 1e-9


def axle_samples(drives: Sequence[FitDrive], vehicle: VehicleParameters) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return slip angles (rad) and forces (N) [N] of each axle at all usable stamps, smoothed to ``SMOOTHING_HZ``.

    At known friction they are those at the vehicle file's, for tyres that keep their stiffness: one curve of force over
    friction by slip over friction.
    """
    columns: dict[str, list[FloatArray]] = {"front": [], "rear": []}
    for drive in drives:
        signals, truth, stamps = drive.signals, drive.truth, drive.signals.stamps_ns
        use = usable_stamps(signals, truth, vehicle)
        raw = (truth.vx_m_s, truth.vy_m_s, truth.yaw_rate_rad_s, signals.steer_rad, truth.ay_m_s2)
        motion = [smooth(stamps, np.where(use, values, np.nan), SMOOTHING_HZ) for values in raw]
        yaw_acceleration = np.gradient(motion[2], stamps * 1e-9 - stamps[0] * 1e-9)
        grip = np.where(np.isfinite(signals.friction), signals.friction / vehicle.assumed_friction, 1.0)
        curves = np.stack([*axle_curves([*motion, yaw_acceleration], vehicle).values()]) / grip
        good = np.isfinite(curves).all(axis=(0, 1))
        for axle, curve in zip(columns, curves, strict=True):
            columns[axle].append(curve[:, good])
    return {axle: tuple(np.concatenate(parts, axis=1)) for axle, parts in columns.items()}


def fit_axle(
    slip_rad: FloatArray, force_n: FloatArray, *, prior: AxleCurve, mass_kg: float, independent: float
) -> AxleCurve:
    """Fit a curve to slip and force, both [N], with priors about ``prior``.

    Parameters
    ----------
    independent : how many independent samples the N neighbouring ones are worth.
    """
    step = max(1, slip_rad.size // 4000)
    slip, force = slip_rad[::step], force_n[::step]
    weight = np.sqrt(independent / slip.size) / (FORCE_STD_N_PER_KG * mass_kg)
    seen = float(np.percentile(np.abs(force), 99.5))
    peak0 = max(prior.peak_n, PEAK_OVER_SEEN * seen)
    origin = np.array([np.log(prior.stiffness_n_per_rad), np.log(peak0), prior.shape])
    std = np.array([STIFFNESS_LOG_STD, PEAK_LOG_STD, SHAPE_STD])

    def residuals(theta: FloatArray) -> FloatArray:
        curve = AxleCurve(float(np.exp(theta[0])), float(np.exp(theta[1])), float(theta[2]))
        return np.concatenate([weight * (curve.force_n(slip) - force), (theta - origin) / std])

    low = np.array([-np.inf, np.log(PEAK_OVER_SEEN * seen) - 1e-9, 1.0])
    fit = least_squares(residuals, origin, bounds=(low, [np.inf, np.inf, 1.9]), loss="linear")
    return AxleCurve(float(np.exp(fit.x[0])), float(np.exp(fit.x[1])), float(fit.x[2]))


def _prior(name: str, mean: float, std: float, *, log: bool = False, low: float = -math.inf) -> Parameter:
    return Parameter(name, "", mean, std, low, math.inf, log)


def make_priors(
    start: VehicleParameters, samples: Mapping[str, tuple[FloatArray, FloatArray]], usable_s: float
) -> tuple[Parameter, ...]:
    """Return the priors of docs/method.md#identification about a vehicle file."""
    mu, priors = start.assumed_friction, []
    for axle, (slip, force) in samples.items():
        front = axle == "front"
        peak = max(start.magic_formula(front, mu)[2], float(np.percentile(np.abs(force), 99.5)))
        file_curve = AxleCurve(start.cornering_stiffness_n_per_rad(front, mu), peak, SHAPE)
        curve = fit_axle(slip, force, prior=file_curve, mass_kg=start.mass_kg, independent=usable_s / CORRELATION_S)
        stiffness_std, peak_std, shape_std = (AXLE_FIT_SHARE * s for s in (STIFFNESS_LOG_STD, PEAK_LOG_STD, SHAPE_STD))
        priors += [
            _prior(f"{axle} cornering stiffness", curve.stiffness_n_per_rad, stiffness_std, log=True),
            _prior(f"{axle} peak force", curve.peak_n, peak_std, log=True),
            _prior(f"{axle} shape", curve.shape, shape_std, low=1.0),
        ]
    priors += [
        _prior("yaw inertia", start.yaw_inertia_kg_m2, 0.20, log=True),
        _prior("roll gradient", start.roll_gradient_rad_per_m_s2, 0.3, log=True),
        _prior("relaxation length", start.relaxation_length_m or 0.5, 0.4, log=True),
        _prior("load sensitivity", start.load_sensitivity, 0.1, low=0.0),
        _prior("roll frequency", start.roll_frequency_rad_s, 0.3, log=True),
        _prior("roll damping", start.roll_damping, 0.4, log=True),
        _prior("CG over roll axis", 0.7 * start.cg_height_m, 0.2, low=0.0),
    ]
    noises = {
        "q v_y": PHYSICS_Q_STD[1], "q yaw rate": PHYSICS_Q_STD[2], "q a_x bias": 0.03, "q axle force": PHYSICS_Q_STD[4],
        "r a_y": max(0.3, start.sensors.ay_std_m_s2), "r yaw rate": start.sensors.yaw_rate_std_rad_s,
    }  # fmt: skip
    return (*priors, *(_prior(name, mean, NOISE_LOG_STD, log=True) for name, mean in noises.items()))


#: Entries of the vehicle file by parameter.
_ENTRIES = {
    "yaw inertia": "yaw_inertia_kg_m2", "roll gradient": "roll_gradient_rad_per_m_s2",
    "relaxation length": "relaxation_length_m", "load sensitivity": "load_sensitivity", "roll damping": "roll_damping",
    "roll frequency": "roll_frequency_rad_s", "CG over roll axis": "cg_over_roll_axis_m",
}  # fmt: skip


def build_car(
    start: VehicleParameters, priors: Sequence[Parameter], theta: FloatArray, *, digits: int = 17
) -> tuple[VehicleParameters, FilterNoise]:
    """Return the vehicle file with the parameters at ``theta``, and the noise of ``physics`` that belongs to them."""

    def rounded(value: float) -> float:
        return float(f"{value:.{digits}g}")

    v = {p.name: rounded(p.value(float(t))) for p, t in zip(priors, theta, strict=True)}
    mu = start.assumed_friction

    def tyre(axle: str) -> AxleTyre:
        peak, shape = v[f"{axle} peak force"], v[f"{axle} shape"]
        b = rounded(v[f"{axle} cornering stiffness"] / (shape * peak))
        return AxleTyre(B=b, C=shape, D_n=rounded(peak / mu), E=0.0, reference_friction=mu)

    update: dict[str, object] = {entry: v[name] for name, entry in _ENTRIES.items()}
    update |= {"friction": mu, "tyres": Tyres(front=tyre("front"), rear=tyre("rear")), "physics": PARTS}
    noise = FilterNoise(
        q_std=(PHYSICS_Q_STD[0], v["q v_y"], v["q yaw rate"], v["q a_x bias"], v["q axle force"], v["q axle force"]),
        r_std={"ay_m_s2": v["r a_y"], "yaw_rate_rad_s": v["r yaw rate"], "speed_m_s": start.sensors.speed_std_m_s},
    )
    return start.model_copy(update=update), noise


@dataclass(frozen=True, slots=True, eq=False)
class DriveError:
    """Sideslip errors of a drive in rad at :data:`FIT_RATE_HZ`, 0 where they do not count, and the mean NIS."""

    error: FloatArray
    counted: int
    seconds: float
    nis: float

    @property
    def rms(self) -> float:
        """RMS of the counted errors."""
        return float(np.sqrt(np.sum(self.error**2) / max(self.counted, 1)))


def drive_errors(
    drives: Sequence[FitDrive], start: VehicleParameters, vehicle: VehicleParameters, noise: FilterNoise
) -> list[DriveError]:
    """Return the errors of ``physics`` on drives."""
    estimator, errors = physics_filter(vehicle, noise), []
    for drive in drives:
        steps, _ = estimator.run(correct_signals(drive.signals, vehicle), None)
        has_innovation = steps.nis_dof > 0
        nis = float(np.minimum(steps.nis[has_innovation], 50.0).sum() / max(steps.nis_dof[has_innovation].sum(), 1.0))
        every, stamps = max(1, round(1.0 / (FIT_RATE_HZ * period_s(drive)))), drive.signals.stamps_ns
        error = wrap_angle(np.arctan2(steps.x[:, 1], steps.x[:, 0]) - drive.truth.sideslip_rad)
        use = usable_stamps(drive.signals, drive.truth, start) & steps.valid & np.isfinite(error)
        use &= (stamps - stamps[0]) * 1e-9 > SETTLE_S
        counted = int(np.count_nonzero(use[::every]))
        seconds = counted * every * period_s(drive)
        errors.append(DriveError(np.where(use, error, 0.0)[::every], counted, seconds, max(nis, 1e-3)))
    return errors


@dataclass(frozen=True, slots=True, eq=False)
class PhysicsFit:
    """A fitted car: vehicle, noise, priors with θ [K], its posterior 1-sigma in prior units [K], and RMS."""

    vehicle: VehicleParameters
    noise: FilterNoise
    priors: tuple[Parameter, ...]
    theta: FloatArray
    std: FloatArray
    rms_deg: float


def fit_physics(
    drives: Sequence[FitDrive],
    start: VehicleParameters,
    *,
    starts: Sequence[Theta] = STARTS,
    iterations: int = MAX_ITERATIONS,
) -> PhysicsFit:
    """Fit the parameters and noise of ``physics`` to drives with ground truth.

    Parameters
    ----------
    starts : where to start, θ by the parameter's name; the best end counts.
    """
    usable_s = sum(float(np.count_nonzero(usable_stamps(d.signals, d.truth, start))) * period_s(d) for d in drives)
    samples = axle_samples(drives, start)
    priors = make_priors(start, samples, usable_s)

    def errors(theta: FloatArray) -> list[DriveError]:
        return drive_errors(drives, start, *build_car(start, priors, theta))

    limits = {"derivative_step": DERIVATIVE_STEP, "max_step": MAX_STEP}
    firsts = [np.array([first.get(p.name, 0.0) for p in priors]) for first in starts]
    ends = [
        descend(errors, fit_cost, scaled_errors, first, iterations=iterations, least_gain=least_gain, **limits)
        for first in firsts
    ]
    theta, normal, _, errors_of_drives = min(ends, key=lambda end: end.cost)
    std = np.sqrt(np.diag(np.linalg.inv(normal)))
    vehicle, noise = build_car(start, priors, theta, digits=6)
    squares = sum(float(np.sum(d.error**2)) for d in errors_of_drives)
    rms = math.degrees(math.sqrt(squares / max(1, sum(d.counted for d in errors_of_drives))))
    return PhysicsFit(vehicle, noise, priors, theta, std, rms)


def fit_cost(errors: Sequence[DriveError], theta: FloatArray) -> float:
    """Return the cost of the head of this file."""
    fit = sum(d.seconds / CORRELATION_S * math.log(_robust_square(d) + FLOOR_RAD**2) for d in errors)
    return fit + float(theta @ theta) + _nis_residual(errors) ** 2


def _robust_square(drive: DriveError) -> float:
    """Return the mean square of errors cut at :data:`ROBUST` times their RMS."""
    limit = ROBUST * drive.rms
    return float(np.sum(np.minimum(np.abs(drive.error), limit) ** 2) / max(drive.counted, 1))


def _nis_residual(errors: Sequence[DriveError]) -> float:
    total = sum(d.seconds for d in errors)
    return math.log(sum(d.nis * d.seconds for d in errors) / max(total, 1e-9)) / NIS_LOG_STD


def least_gain(errors: Sequence[DriveError]) -> float:
    """Return the smallest decrease of :func:`fit_cost` that continues a fit."""
    return MIN_GAIN * max(1.0, sum(d.seconds for d in errors) / CORRELATION_S)


def scaled_errors(there: Sequence[DriveError], here: Sequence[DriveError]) -> FloatArray:
    """Return the errors and the term of the NIS as residuals, with the scales of the errors ``here`` a place."""
    parts = []
    for d, now in zip(there, here, strict=True):
        s = math.sqrt(_robust_square(now) + FLOOR_RAD**2)
        weight = math.sqrt(now.seconds / CORRELATION_S / max(now.counted, 1))
        parts.append(weight * np.clip(d.error, -ROBUST * s, ROBUST * s) / s)
    return np.concatenate([*parts, [_nis_residual(there)]])


# ------------------------------------------------------------------------------------------------ the shipped car

SEED, DRIVES = 5000, 24
#: Friction is that of the simulator.
MAPPING = Path(__file__).with_name("true_friction.toml")
HEAD = "Written by python -m studies.defaults.fit_physics; [filter] by studies.defaults.train_default."


def read_drive(path: Path, car: Car) -> reading.WholeDrive:
    """Read a simulated log with its true friction.

    The exact ground truth has the clock of the sensors, so that no latency is estimated: a stuck gyro would bend it.
    """
    with reading.read_drive(path, car, load_mapping(MAPPING), ReadOptions(friction=None)) as drive:
        drive.plan = replace(drive.plan, latency=None)
        return drive.whole()


def main(arguments: list[str] | None = None) -> None:
    """Simulate, fit, write."""
    parser = options("defaults.fit_physics", __doc__)
    parser.add_argument("-o", "--output", type=Path, default=SHIPPED_CARS["saloon"], help="the car's folder")
    parser.add_argument("--work", type=Path, default=Path("out/fit-physics"), help="logs; kept")
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args(arguments)
    car = Car.load(given.output, network=NO_MODEL)
    drives, learnt_on = [], []
    for entry in write_suite(given.work, count=DRIVES, seed=SEED, processes=given.jobs)["drives"]:
        read = read_drive(given.work / entry["file"], Car(car.vehicle))
        assert read.truth is not None
        drives.append(FitDrive(read.name, read.signals, read.truth))
        learnt_on.append(LearntOn(name=read.name, sha256=entry["sha256"], end_s=entry["duration_s"]))

    result = fit_physics(drives, car.vehicle)
    # The smoother uses the filter's noise: the network predicts most of the model residual.
    physics = FittedPhysics(values=result.vehicle, noise=result.noise, smoothing=(1.0, 1.0))
    print(f"sideslip RMSE on what it was fitted to: {result.rms_deg:.4f} deg")
    part = Fit(physics_sha256=physics_sha256(car.vehicle), physics=physics, drives=tuple(learnt_on))
    (given.output / FIT_FILE).write_text(part_toml(part, HEAD), encoding="utf-8")


if __name__ == "__main__":
    main()
