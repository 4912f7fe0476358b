"""Vehicle identification: axle tyres, steering, roll gradient, biases, and the filter noise that belongs to them.

Direct minimisation of the sideslip error of the physics filter itself, with priors (docs/method.md#identification),
started from a fit to axle forces. In normalised parameters θ (distance from the prior in its standard deviations) the
cost is

    Σ_k w (β̂_k(θ) − β_k)² / σ² + |θ|²,

where w makes one second of neighbouring, dependent samples count as one sample and σ is the error that remains, drive
by drive. The intervals contain under the model: they do not contain what a single-track model cannot express. What
the drives do not excite (posterior hardly narrower than the prior) is put back to its prior and stated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.car.parts import FilterNoise, FittedPhysics
from pdhef_logtool.car.prior import Prior
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, AxleTyre, PhysicsParts, Tyres, VehicleParameters
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.estimators.pass_through import PassThrough
from pdhef_logtool.estimators.phy_ukf import PHY_UKF_Q_STD, PhysicsUkf, physics_ukf_tuned
from pdhef_logtool.estimators.physics_filter import physics_filter
from pdhef_logtool.evaluation.metrics import signal_error
from pdhef_logtool.learning.car.axle_forces import (
    PEAK_LOG_STD,
    PEAK_OVER_SEEN,
    SHAPE,
    SHAPE_STD,
    STIFFNESS_LOG_STD,
    AxleCurve,
    AxleSamples,
    axle_samples,
    fit_axle,
    sampled_errors,
    usable_seconds,
)
from pdhef_logtool.learning.car.fit_data import FitDrive, signals_of
from pdhef_logtool.learning.car.physics_fit import PhysicsFit, find_physics
from pdhef_logtool.learning.car.smoothing_fit import fit_smoothing
from pdhef_logtool.records.errors import EstimatorError
from pdhef_logtool.records.signals import BoolArray, FloatArray

#: Neighbouring samples are dependent: this much time is worth one independent sample.
CORRELATION_S = 1.0
#: The filter needs this long from its start before its error counts.
SETTLE_S = 3.0
#: The error that remains is not accepted to be smaller than this.
MIN_SIGMA_RAD = math.radians(0.05)
#: A parameter whose posterior is wider than this share of its prior was not excited.
NOT_EXCITED = 0.8
#: Step of the numerical derivative, in prior standard deviations.
DERIVATIVE_STEP = 0.03
#: Width of the tyres' priors about the axle-force fit, as a share of the widths about a vehicle file.
AXLE_FIT_SHARE = 0.5
#: Errors beyond this many σ count linearly: a moment in which the filter is lost must not decide the tyres.
ROBUST_SIGMA = 3.0
OUTER_PASSES = 2
MAX_ITERATIONS = 15
#: Longest step of one iteration, in prior standard deviations, and the relative gain below which it stops.
MAX_STEP = 2.0
MIN_GAIN = 1e-3
MIN_DRIVE_S = 20.0


@dataclass(frozen=True, slots=True)
class Identified:
    """One parameter: value with its 95 % interval, prior mean, and whether the drives excited it."""

    name: str
    unit: str
    value: float
    low: float
    high: float
    prior: float
    excited: bool
    tuning: bool


@dataclass(frozen=True, slots=True)
class PartScore:
    """Sideslip RMSE in degrees on one part of the drives, by estimator and vehicle file."""

    part: str
    seconds: float
    zero_deg: float
    start_file_deg: float
    identified_deg: float
    physics_deg: float

    def to_dict(self) -> dict[str, float]:
        """Return the figures as they are with the car."""
        figures = {"seconds": self.seconds, "zero_deg": self.zero_deg}
        figures |= {"starting_car_deg": self.start_file_deg, "identified_deg": self.identified_deg}
        figures["physics_deg"] = self.physics_deg
        return {name: round(value, 4) for name, value in figures.items()}


@dataclass(frozen=True, slots=True, eq=False)
class Identification:
    """Everything that identification found: values with the noise of ``phy-ukf:tuned``, and those of ``physics``.

    ``parameters`` are those of the former, ``physics_parameters`` those of the latter.
    """

    vehicle: VehicleParameters
    noise: FilterNoise
    physics: FittedPhysics
    parameters: tuple[Identified, ...]
    physics_parameters: tuple[Identified, ...]
    scores: tuple[PartScore, ...]
    notes: tuple[str, ...]


Progress = Callable[[str, float], None]


def fit_car(
    fit: Sequence[FitDrive],
    held_out: Sequence[FitDrive],
    start: VehicleParameters,
    *,
    steering_wheel: bool = False,
    parts: PhysicsParts | None = None,
    progress: Progress = lambda _text, _share: None,
) -> Identification:
    """Identify a vehicle on ``fit`` and score it, once, on ``held_out``.

    Parameters
    ----------
    fit, held_out : parts of drives that share no stamp.
    start : gives geometry, mass, priors (its tyres, inertia, roll gradient) and sensor noise.
    steering_wheel : the steering signal is a steering-wheel angle, so that the ratio is identified too.
    parts : of ``physics``; None: chosen by what part of the drives states of the other.

    Raises
    ------
    EstimatorError
        There is too little usable driving with ground truth.
    """
    usable_s = sum(usable_seconds(d, start) for d in fit)
    if usable_s < MIN_DRIVE_S:
        raise EstimatorError(
            expected=f"at least {MIN_DRIVE_S:g} s of driving with ground truth, above twice the low-speed limit",
            got=f"{usable_s:.1f} s",
            where="identify",
            remedy="give more drives, a longer slice or a smaller --holdout",
        )
    samples = axle_samples(fit, start)
    priors = make_priors(samples, start, usable_s, steering_wheel=steering_wheel)
    theta = np.maximum(0.0, _low_theta(priors))
    active = np.ones(len(priors), dtype=np.bool_)
    sigma = np.full(len(fit), math.radians(0.4))
    total = OUTER_PASSES + 1
    std = np.ones(len(priors))
    for outer in range(total):
        progress("fitting the filter's sideslip to the ground truth", 0.3 * outer / total)
        theta, std, rmse = _minimise(fit, start, priors, theta, active, sigma)
        sigma = np.maximum(MIN_SIGMA_RAD, rmse)
        if outer == OUTER_PASSES - 1:
            excited = np.array([p.tuning or s < NOT_EXCITED for p, s in zip(priors, std, strict=True)])
            if excited.all():
                break
            active, theta = excited, np.where(excited, theta, np.clip(0.0, _low_theta(priors), None))
    vehicle, noise = build_vehicle(start, priors, theta, digits=6)
    estimate, physics = find_physics(
        fit,
        start,
        steering_wheel=steering_wheel,
        parts=parts,
        progress=lambda text, share: progress(text, 0.3 + 0.6 * share),
    )
    progress("fitting the smoother's sideslip to the ground truth", 0.9)
    physics = physics.model_copy(update={"smoothing": fit_smoothing(fit, start, estimate)})
    progress("scoring", 0.95)
    scores = [_score("fit", fit, start, vehicle, noise, estimate)]
    if held_out:
        scores.append(_score("held out", held_out, start, vehicle, noise, estimate))
    parameters = _identified(priors, theta, std, active)
    of_physics = _identified(estimate.priors, estimate.theta, estimate.std, estimate.std < NOT_EXCITED)
    notes = (*_notes(parameters, fit, usable_s), _told(physics))
    return Identification(vehicle, noise, physics, parameters, of_physics, tuple(scores), notes)


def _identified(
    priors: Sequence[Prior], theta: FloatArray, std: FloatArray, excited: BoolArray
) -> tuple[Identified, ...]:
    return tuple(
        Identified(
            name=p.name,
            unit=p.unit,
            value=p.value(float(t)),
            low=p.value(float(t - 1.96 * s)),
            high=p.value(float(t + 1.96 * s)),
            prior=p.mean,
            excited=bool(a) or p.tuning,
            tuning=p.tuning,
        )
        for p, t, s, a in zip(priors, theta, std, excited, strict=True)
    )


def make_priors(
    samples: AxleSamples, start: VehicleParameters, usable_s: float, *, steering_wheel: bool
) -> tuple[Prior, ...]:
    """Return the priors of docs/method.md#identification; those of the tyres are about the fit to the axle forces.

    That fit has the starting file as its own prior, and its peaks stay above every force that was seen. As it has seen
    the drives already, the filter's error may move the tyres by ``AXLE_FIT_SHARE`` of those widths only: the error
    of the sideslip alone would also accept tyres that contradict the forces.
    """
    friction = start.assumed_friction
    priors = []
    for axle, is_front, slip, force in (
        ("front", True, samples.front_slip_rad, samples.front_force_n),
        ("rear", False, samples.rear_slip_rad, samples.rear_force_n),
    ):
        _, _, peak, _ = start.magic_formula(is_front, friction)
        least = PEAK_OVER_SEEN * float(np.percentile(np.abs(force), 99.5)) if force.size else 0.0
        file_curve = AxleCurve(start.cornering_stiffness_n_per_rad(is_front, friction), max(peak, least), SHAPE)
        curve = fit_axle(slip, force, prior=file_curve, mass_kg=start.mass_kg, independent=usable_s / CORRELATION_S)
        priors += [
            Prior(
                f"{axle} cornering stiffness",
                "N/rad",
                curve.stiffness_n_per_rad,
                AXLE_FIT_SHARE * STIFFNESS_LOG_STD,
                log=True,
            ),
            Prior(f"{axle} peak force", "N", curve.peak_n, AXLE_FIT_SHARE * PEAK_LOG_STD, log=True, low=least or None),
            Prior(f"{axle} shape", "1", curve.shape, AXLE_FIT_SHARE * SHAPE_STD, low=1.0),
        ]
    sensors = start.sensors
    priors += [
        Prior("yaw inertia", "kg m^2", start.yaw_inertia_kg_m2, 0.20, log=True),
        Prior("steering offset", "rad", start.steer_offset_rad, math.radians(0.2)),
        Prior("roll gradient", "rad/(m/s^2)", start.roll_gradient_rad_per_m_s2, 0.004),
        Prior("a_y bias", "m/s^2", sensors.ay_bias_m_s2, 0.10),
        Prior("yaw rate bias", "rad/s", sensors.yaw_rate_bias_rad_s, 0.002),
    ]
    if steering_wheel:
        priors.append(Prior("steering ratio", "1", start.steering_ratio, 0.05, log=True))
    priors += [
        Prior("q v_y", "m/s/sqrt(s)", PHY_UKF_Q_STD[1], 0.5, log=True, tuning=True),
        Prior("q yaw rate", "rad/s/sqrt(s)", PHY_UKF_Q_STD[2], 0.5, log=True, tuning=True),
        Prior("r a_y", "m/s^2", max(1.0, sensors.ay_std_m_s2), 0.5, log=True, tuning=True),
        Prior("r yaw rate", "rad/s", sensors.yaw_rate_std_rad_s, 0.5, log=True, tuning=True),
    ]
    return tuple(priors)


def build_vehicle(
    start: VehicleParameters, priors: Sequence[Prior], theta: FloatArray, *, digits: int = 17
) -> tuple[VehicleParameters, FilterNoise]:
    """Return the starting file with the parameters at ``theta``, and the filter noise that belongs to them.

    ``digits`` : significant digits of every number that is written.
    """

    def rounded(value: float) -> float:
        return float(f"{value:.{digits}g}")

    v = {p.name: rounded(p.value(float(t))) for p, t in zip(priors, theta, strict=True)}
    friction = start.assumed_friction

    def tyre(axle: str) -> AxleTyre:
        peak, shape = v[f"{axle} peak force"], v[f"{axle} shape"]
        return AxleTyre(
            B=rounded(v[f"{axle} cornering stiffness"] / (shape * peak)), C=shape, D_n=rounded(peak / friction), E=0.0
        )

    sensors = start.sensors.model_copy(
        update={"ay_bias_m_s2": v["a_y bias"], "yaw_rate_bias_rad_s": v["yaw rate bias"]}
    )
    noise = FilterNoise(
        q_std=(PHY_UKF_Q_STD[0], v["q v_y"], v["q yaw rate"], PHY_UKF_Q_STD[3]),
        r_std={
            "ay_m_s2": v["r a_y"],
            "yaw_rate_rad_s": v["r yaw rate"],
            "speed_m_s": start.sensors.speed_std_m_s,
        },
    )
    vehicle = start.model_copy(
        update={
            "yaw_inertia_kg_m2": v["yaw inertia"],
            "steer_offset_rad": v["steering offset"],
            "steering_ratio": v.get("steering ratio", start.steering_ratio),
            "roll_gradient_rad_per_m_s2": v["roll gradient"],
            "friction": friction,
            "sensors": sensors,
            "tyres": Tyres(front=tyre("front"), rear=tyre("rear")),
        }
    )
    return vehicle, noise


# ---- the fit ----


def _low_theta(priors: Sequence[Prior]) -> FloatArray:
    return np.array([-6.0 if p.low is None else max(-6.0, p.theta(p.low)) for p in priors])


def _minimise(
    drives: Sequence[FitDrive],
    start: VehicleParameters,
    priors: Sequence[Prior],
    theta0: FloatArray,
    active: BoolArray,
    sigma: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Minimise over the active parameters.

    ``sigma`` [drives] is the error in rad that each drive is accepted to leave: a violent drive, whose error the
    single-track model cannot remove, must not drown the others.

    Returns
    -------
    θ, posterior standard deviations in prior units, and the RMSE of each drive in rad.
    """
    index = np.flatnonzero(active)

    def full(part: FloatArray) -> FloatArray:
        theta = theta0.copy()
        theta[index] = part
        return theta

    def residuals(part: FloatArray) -> FloatArray:
        parts = _sideslip_errors(drives, start, priors, full(part))
        scaled = [weight * _pseudo_huber(error / s) for (error, weight), s in zip(parts, sigma, strict=True)]
        return np.concatenate([*scaled, part])

    def jacobian(part: FloatArray) -> FloatArray:
        here = residuals(part)
        columns = np.empty((here.size, part.size))
        for i in range(part.size):
            moved = part.copy()
            moved[i] += DERIVATIVE_STEP
            columns[:, i] = (residuals(moved) - here) / DERIVATIVE_STEP
        return columns

    part, jac = _projected_levenberg_marquardt(residuals, jacobian, theta0[index], _low_theta(priors)[index])
    theta = full(part)
    covariance = np.linalg.inv(jac.T @ jac)
    std = np.ones(len(priors))
    std[index] = np.sqrt(np.diag(covariance))
    rmse = [
        float(np.sqrt(np.sum(error**2) / max(1, int(np.count_nonzero(weight)))))
        for error, weight in _sideslip_errors(drives, start, priors, theta)
    ]
    return theta, std, np.array(rmse)


def _projected_levenberg_marquardt(
    residuals: Callable[[FloatArray], FloatArray],
    jacobian: Callable[[FloatArray], FloatArray],
    first: FloatArray,
    low: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Minimise |residuals|² above ``low``; returns the parameters and the Jacobian there.

    Steps are projected to the bounds. (An interior-point method, such as scipy's, hardly moves at all from a start at a
    bound, and there is where the axle-force fit often ends.)
    """
    theta = np.maximum(first, low)
    value = residuals(theta)
    jac = jacobian(theta)
    damping = 1e-3
    for _ in range(MAX_ITERATIONS):
        gradient = jac.T @ value
        free = (theta > low) | (gradient < 0.0)
        normal = jac[:, free].T @ jac[:, free]
        improved = False
        for _ in range(6):
            step = np.zeros(theta.size)
            step[free] = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient[free])
            candidate = np.maximum(theta + np.clip(step, -MAX_STEP, MAX_STEP), low)
            there = residuals(candidate)
            if there @ there < value @ value:
                improved = True
                break
            damping *= 8.0
        if not improved:
            break
        gain = 1.0 - (there @ there) / (value @ value)
        moved = float(np.max(np.abs(candidate - theta)))
        theta, value = candidate, there
        jac = jacobian(theta)
        damping = max(damping / 4.0, 1e-6)
        if gain < MIN_GAIN and moved < 10.0 * DERIVATIVE_STEP:
            break
    return theta, jac


def _pseudo_huber(scaled: FloatArray) -> FloatArray:
    """Return residuals whose square grows like the error's own up to ``ROBUST_SIGMA`` and linearly beyond."""
    c = ROBUST_SIGMA
    out: FloatArray = np.sign(scaled) * c * np.sqrt(2.0 * (np.sqrt(1.0 + (scaled / c) ** 2) - 1.0))
    return out


def _sideslip_errors(
    drives: Sequence[FitDrive], start: VehicleParameters, priors: Sequence[Prior], theta: FloatArray
) -> list[tuple[FloatArray, FloatArray]]:
    """Return by drive the filter's sideslip errors in rad at ``FIT_RATE_HZ`` and their weights, 0 = does not count."""
    vehicle, noise = build_vehicle(start, priors, theta)
    estimator = physics_ukf_tuned(vehicle, noise)
    parts = []
    for drive in drives:
        steps, _ = estimator.run(signals_of(drive, start, vehicle), None)
        error, use, each_s = sampled_errors(drive, start, steps, SETTLE_S)
        parts.append((error, np.where(use, math.sqrt(each_s / CORRELATION_S), 0.0)))
    return parts


# ---- the verdict ----


def _score(
    part: str,
    drives: Sequence[FitDrive],
    start: VehicleParameters,
    identified: VehicleParameters,
    noise: FilterNoise,
    physics: PhysicsFit,
) -> PartScore:
    """Score β = 0, the frozen filter with the starting file, the tuned filter with the identified one, and physics."""
    squares = np.zeros(4)
    counts = np.zeros(4)
    slow = start.low_speed_blend_m_s
    for drive in drives:
        before = signals_of(drive, start, start)
        tracks = (
            run_window(PassThrough("zero", claims_zero_sideslip=True), before)[0],
            run_window(PhysicsUkf(start), before)[0],
            run_window(physics_ukf_tuned(identified, noise), signals_of(drive, start, identified))[0],
            run_window(physics_filter(physics.vehicle, physics.noise), signals_of(drive, start, physics.vehicle))[0],
        )
        for i, track in enumerate(tracks):
            error = signal_error(track, drive.truth, "sideslip_rad", slow)
            error = error[np.isfinite(error)]
            squares[i] += float(np.sum(error**2))
            counts[i] += error.size
    rmse = np.degrees(np.sqrt(squares / np.maximum(counts, 1)))
    return PartScore(part, sum(d.duration_s for d in drives), *(float(x) for x in rmse))


def _told(physics: FittedPhysics) -> str:
    parts = ", ".join(name.replace("_", " ") for name in (physics.values.physics or PhysicsParts()).names)
    why = "by driving that its fits had not seen" if physics.tried else "as asked for, or for want of driving"
    return f"physics has {parts or 'none of its parts'}, {why}"


def _notes(parameters: Sequence[Identified], drives: Sequence[FitDrive], usable_s: float) -> tuple[str, ...]:
    notes = [f"{usable_s:.0f} s of usable driving in {len(drives)} drive{'s' if len(drives) != 1 else ''}"]
    kept = [p.name for p in parameters if not p.excited]
    if kept:
        notes.append(f"not excited by these drives beyond what is in the prior, and kept there: {', '.join(kept)}")
    if not any(d.independent_yaw_rate for d in drives):
        notes.append("the ground truth's yaw rate is the gyro itself: its bias is known through the sideslip alone")
    edge = [p.name for p in parameters if p.excited and not p.low <= p.prior <= p.high and not p.tuning]
    if edge:
        notes.append(f"the sideslip asks for another value than the prior in: {', '.join(edge)}")
    return tuple(notes)


def understeer_deg_per_g(vehicle: VehicleParameters) -> float:
    """Return the linear understeer gradient in degrees of road-wheel angle per g."""
    return math.degrees(vehicle.understeer_gradient_rad_per_m_s2(vehicle.assumed_friction)) * GRAVITY_M_S2
