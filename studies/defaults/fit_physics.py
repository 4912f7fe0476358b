"""Fit ``physics`` of the shipped car: its values and noise, on five minutes of simulated driving.

    python -m studies.defaults.fit_physics [-o FOLDER] [--work out/fit-physics] [--jobs 2]

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

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pdhef_logtool.car.car import FIT_FILE, SHIPPED_CARS, Car
from pdhef_logtool.car.parts import FilterNoise, Fit, FittedPhysics, LearntOn, physics_sha256
from pdhef_logtool.car.toml_files import part_toml
from pdhef_logtool.car.vehicle import AxleTyre, PhysicsParts, Tyres, VehicleParameters
from pdhef_logtool.drive import reading
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import Tell
from pdhef_logtool.estimators.vehicle_ukf import PHYSICS_Q_STD, PosteriorSteps, physics_filter
from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.mapping import Mapping
from pdhef_logtool.mapping.records import SignalSource
from pdhef_logtool.model.descent import descend
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.residual_model.bundle import NO_MODEL
from studies.defaults.axle_forces import (
    PEAK_LOG_STD,
    SHAPE,
    SHAPE_STD,
    STIFFNESS_LOG_STD,
    AxleCurve,
    AxleSamples,
    FitDrive,
    axle_samples,
    fit_axle,
    sampled_errors,
    signals_of,
    usable_seconds,
)
from studies.pages import options

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
#: Biases are states, as those of a drive: a mean over few drives would be no property of the car.
PARTS = PhysicsParts(**dict.fromkeys(PhysicsParts.model_fields, True))
Theta = dict[str, float]
#: Start values of θ. The noise cost has two valleys: clean sensors, and a filter with a low gain on a_y.
STARTS: tuple[Theta, ...] = ({}, {"r a_y": 1.5, "q v_y": 1.4, "q yaw rate": 2.3})


@dataclass(frozen=True, slots=True)
class Prior:
    """Prior of one parameter, normal in its own or, if ``log``, in logarithmic scale; ``low`` bounds the value."""

    name: str
    mean: float
    std: float
    log: bool = False
    low: float | None = None

    def value(self, theta: float) -> float:
        """Return the parameter at a normalised distance from the prior."""
        value = self.mean * math.exp(self.std * theta) if self.log else self.mean + self.std * theta
        return value if self.low is None else max(value, self.low)


def make_priors(start: VehicleParameters, samples: AxleSamples, usable_s: float) -> tuple[Prior, ...]:
    """Return the priors of docs/method.md#identification about a vehicle file."""
    mu, priors = start.assumed_friction, []
    for axle, front, slip, force in (
        ("front", True, samples.front_slip_rad, samples.front_force_n),
        ("rear", False, samples.rear_slip_rad, samples.rear_force_n),
    ):
        seen = float(np.percentile(np.abs(force), 99.5)) if force.size else 0.0
        peak = max(start.magic_formula(front, mu)[2], seen)
        file_curve = AxleCurve(start.cornering_stiffness_n_per_rad(front, mu), peak, SHAPE)
        curve = fit_axle(slip, force, prior=file_curve, mass_kg=start.mass_kg, independent=usable_s / CORRELATION_S)
        stiffness_std, peak_std, shape_std = (AXLE_FIT_SHARE * s for s in (STIFFNESS_LOG_STD, PEAK_LOG_STD, SHAPE_STD))
        priors += [
            Prior(f"{axle} cornering stiffness", curve.stiffness_n_per_rad, stiffness_std, log=True),
            Prior(f"{axle} peak force", curve.peak_n, peak_std, log=True),
            Prior(f"{axle} shape", curve.shape, shape_std, low=1.0),
        ]
    priors += [
        Prior("yaw inertia", start.yaw_inertia_kg_m2, 0.20, log=True),
        Prior("roll gradient", start.roll_gradient_rad_per_m_s2, 0.3, log=True),
        Prior("relaxation length", start.relaxation_length_m or 0.5, 0.4, log=True),
        Prior("load sensitivity", start.load_sensitivity, 0.1, low=0.0),
        Prior("roll frequency", start.roll_frequency_rad_s, 0.3, log=True),
        Prior("roll damping", start.roll_damping, 0.4, log=True),
        Prior("CG over roll axis", 0.7 * start.cg_height_m, 0.2, low=0.0),
    ]
    noises = {
        "q v_y": PHYSICS_Q_STD[1], "q yaw rate": PHYSICS_Q_STD[2], "q a_x bias": 0.03, "q axle force": PHYSICS_Q_STD[4],
        "r a_y": max(0.3, start.sensors.ay_std_m_s2), "r yaw rate": start.sensors.yaw_rate_std_rad_s,
    }  # fmt: skip
    return (*priors, *(Prior(name, mean, NOISE_LOG_STD, log=True) for name, mean in noises.items()))


#: Entries of the vehicle file by parameter.
_ENTRIES = {
    "yaw inertia": "yaw_inertia_kg_m2", "roll gradient": "roll_gradient_rad_per_m_s2",
    "relaxation length": "relaxation_length_m", "load sensitivity": "load_sensitivity", "roll damping": "roll_damping",
    "roll frequency": "roll_frequency_rad_s", "CG over roll axis": "cg_over_roll_axis_m",
}  # fmt: skip


def build_car(
    start: VehicleParameters, priors: Sequence[Prior], theta: FloatArray, *, digits: int = 17
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
    """Sideslip errors of a drive by :func:`~.axle_forces.sampled_errors`; mean normalized innovation squared."""

    error: FloatArray
    counted: int
    seconds: float
    nis: float

    @classmethod
    def of(cls, drive: FitDrive, start: VehicleParameters, steps: PosteriorSteps, nis: float) -> DriveError:
        """Return the errors of a filter's steps on a drive."""
        error, use, each_s = sampled_errors(drive, start, steps, SETTLE_S)
        counted = int(np.count_nonzero(use))
        return cls(error, counted, counted * each_s, nis)

    @property
    def rms(self) -> float:
        """RMS of the counted errors."""
        return float(np.sqrt(np.sum(self.error**2) / max(self.counted, 1)))


def drive_errors(
    drives: Sequence[FitDrive], start: VehicleParameters, vehicle: VehicleParameters, noise: FilterNoise
) -> list[DriveError]:
    """Return the errors of ``physics`` on drives."""
    estimator = physics_filter(vehicle, noise)
    errors = []
    for drive in drives:
        steps, _ = estimator.run(signals_of(drive, start, vehicle), None)
        has_innovation = steps.nis_dof > 0
        nis = float(np.minimum(steps.nis[has_innovation], 50.0).sum() / max(steps.nis_dof[has_innovation].sum(), 1.0))
        errors.append(DriveError.of(drive, start, steps, max(nis, 1e-3)))
    return errors


@dataclass(frozen=True, slots=True, eq=False)
class PhysicsFit:
    """A fitted car: vehicle, noise, priors with θ [K], its posterior 1-sigma in prior units [K], and RMS."""

    vehicle: VehicleParameters
    noise: FilterNoise
    priors: tuple[Prior, ...]
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
    usable_s = sum(usable_seconds(d, start) for d in drives)
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


def _scale(drive: DriveError) -> float:
    return math.sqrt(_robust_square(drive) + FLOOR_RAD**2)


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
        s = _scale(now)
        weight = math.sqrt(now.seconds / CORRELATION_S / max(now.counted, 1))
        parts.append(weight * np.clip(d.error, -ROBUST * s, ROBUST * s) / s)
    return np.concatenate([*parts, [_nis_residual(there)]])


# ------------------------------------------------------------------------------------------------ the shipped car

SEED, DRIVES = 5000, 24
HEAD = "Written by python -m studies.defaults.fit_physics; [filter] by studies.defaults.train_default."


_FRICTION = SignalSource("friction", "/truth/perfect/state", "friction")


def read_drive(path: Path, car: Car) -> reading.WholeDrive:
    """Read a simulated log with its true friction.

    The exact ground truth has the clock of the sensors, so that no latency is estimated: a stuck gyro would bend it.
    """

    def with_true_friction(_log: DriveLog, mapping: Mapping, _tell: Tell) -> Mapping:
        return replace(mapping, signals={**mapping.signals, "friction": _FRICTION})

    with reading.read_drive(path, car, options=ReadOptions(friction=None), adjust=with_true_friction) as drive:
        drive.plan = replace(drive.plan, latency=None)
        return drive.whole()


def main(arguments: list[str] | None = None) -> int:
    """Simulate, fit, write."""
    parser = options("defaults.fit_physics", __doc__)
    parser.add_argument("-o", "--output", type=Path, default=SHIPPED_CARS["saloon"], help="the car's folder")
    parser.add_argument("--work", type=Path, default=Path("out/fit-physics"), help="logs; kept")
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args(arguments)
    simulate = ("simulate", "suite", "--count", str(DRIVES), "--seed", str(SEED), "--jobs", str(given.jobs))
    subprocess.run([sys.executable, "-m", "pdhef_logtool", *simulate, "-o", str(given.work)], check=True)
    car = Car.load(given.output, network=NO_MODEL)
    drawn = json.loads((given.work / "manifest.json").read_text(encoding="utf-8"))["drives"]
    drives, learnt_on = [], []
    for entry in drawn:
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
    return 0


if __name__ == "__main__":
    sys.exit(main())
