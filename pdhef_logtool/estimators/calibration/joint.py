"""Joint fit of tyres, steering and sensors to the driving of logs, without ground truth.

See docs/method.md#self-calibration.

The model of :mod:`~.single_track` is fitted to yaw rate and a_y by output error. In normalised parameters θ (distance
from the prior mean in prior standard deviations) the cost is

    Σ_channels Σ_k (Δt / T) 2 (√(1 + (e_k / σ)²) − 1) + |θ|²

with errors e after a zero-phase low pass, so that T = 1 s of driving is equivalent to one sample. σ is the RMS of the
errors of each channel, at least :data:`ERROR_STD`: with a poor model the prior dominates. Only the product of friction
and peak force is observable: friction keeps the file's value, the peak force is fitted. The prior of the tyres is a
mixture, because a published file describes the driven tyres, or softer ones, and cars on tarmac differ by a factor of
two.

The covariance of θ has three parts: the curvature of the cost; the spread of the cost's gradient between blocks of the
drives (sandwich estimator, White 1982), which includes model error that changes within a drive; and the model error
that is common to a whole drive, estimated on simulated cars (:data:`SHARED_SHARES`). The covariance of a pool refers to
a single drive of it: the variation between drives is added (random effects by moments, DerSimonian and Laird 1986).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from pdhef_logtool.car.assumed_values import stiffness_per_load
from pdhef_logtool.car.descent import descend
from pdhef_logtool.car.model import TaughtParameter
from pdhef_logtool.car.vehicle import (
    GRAVITY_M_S2,
    STIFFNESS_TYRE_SHAPE,
    AxleTyre,
    Tyres,
    VehicleParameters,
    default_vehicle,
)
from pdhef_logtool.estimators.calibration.driving import STEP_S, Driving
from pdhef_logtool.estimators.calibration.single_track import (
    AY,
    BANK_HZ,
    OF_AY,
    OF_RATE,
    SPEED,
    YAW_RATE,
    TrackParameters,
    errors,
    low_pass,
    slow_parts,
)
from pdhef_logtool.records.signals import BoolArray, FloatArray

#: Frequency limit of the comparison of model and sensors.
CUTOFF_HZ = 4.0
#: Smallest standard deviation of the errors of yaw rate (rad/s) and a_y (m/s²); larger errors have a linear cost.
ERROR_STD = (0.02, 0.3)
#: Maximum number of fits with updated standard deviations of the errors; relative change at which they end.
SCALES, SAME_SCALE = 8, 0.05
#: Driving equivalent to one independent sample of each channel; excluded start of each stretch, where the initial state
#: is unknown.
CORRELATION_S, SETTLE_S = 1.0, 1.0
#: Subsampling of the errors, in steps of the grid: 12.5 Hz, three times the cutoff.
KEPT_STEPS = 4
#: Length of the blocks for the spread of gradients: longer than a bend, so that blocks are nearly independent.
BLOCK_S = 3.0
ITERATIONS, DERIVATIVE_STEP, MAX_STEP, LEAST_GAIN = 40, 0.02, 1.0, 1e-3
#: Lower limit of the peak force, as a share of this quantile of a_y, which includes bank and body roll.
REACHED_SHARE, REACHED_QUANTILE = 0.8, 0.98
#: Parts of ``physics`` on a calibrated car: the set with the lowest sideslip error on simulated cars with wrong files.
PARTS = ("lag", "roll", "bank")
#: Cornering coefficient (stiffness over axle load) of the rear axle of driven cars over that of usual files, and front
#: over rear coefficient (below 1 by the steering compliance). Yaw rate and a_y determine the ratio, not the level.
USUAL_LEVEL, USUAL_RATIO = 1.5, 0.68
#: Log standard deviations of level and ratio, of cars and of a file that describes the driven tyres; prior probability
#: of such a file.
USUAL_STDS, FILE_STDS, FILE_SHARE = (0.5, 0.2), (0.1, 0.1), 1.0 / 3.0
#: The ratio of models below this mass varies more; vehicles below the mass of cars have the level of cars.
MODEL_KG, MODEL_STDS, CAR_KG = 50.0, (0.5, 0.5), 400.0
#: Log standard deviation of a file's peak force (wet or icy roads), and of its stiffness without a calibration.
FILE_TYRE_STD = 0.5
#: Ratio of the a_y levels of two drives: below the first, no information is shared; above the second, all of it.
LIKE = (0.3, 0.5)
#: Usual share of gravity in a_y by body roll, rad/(m/s²), for files without one (3 degrees per g), and 1-sigma of the
#: accelerometer's position in wheelbases.
USUAL_ROLL_GRADIENT, IMU_X_REACH = 0.005, 0.4

FRONT_STIFFNESS, REAR_STIFFNESS = "front cornering stiffness", "rear cornering stiffness"
RATIO = "front over rear cornering coefficient"
PEAK, INERTIA, RELAXATION = "peak force over the file's", "yaw inertia", "relaxation length"
STEER_OFFSET, STEER_RATIO, STEER_DELAY = "steering offset", "steering ratio", "steering delay"
AY_GAIN, AY_BIAS, IMU_X, RATE_BIAS = "roll gain", "a_y bias", "lever of a_y", "yaw rate bias"
#: Model error common to a whole drive, as a share of each prior's standard deviation: with it at least 95 % of the
#: parameters of simulated cars are within 1.96 standard deviations. The lag of tyres and body affects the delay.
SHARED_SHARE, SHARED_SHARES = 0.2, {STEER_DELAY: 0.4}


@dataclass(frozen=True, slots=True)
class Parameter:
    """Prior of a fitted parameter: normal with ``mean`` and ``std`` (of the logarithm if ``log``), within a range."""

    name: str
    unit: str
    mean: float
    std: float
    low: float
    high: float
    log: bool = False

    def value(self, theta: float) -> float:
        """Return the parameter for a normalised distance from the prior mean, limited to its range."""
        free = self.mean * math.exp(self.std * theta) if self.log else self.mean + self.std * theta
        return min(max(free, self.low), self.high)

    def theta(self, value: float) -> float:
        """Return the normalised distance of a value from the prior mean, without limits."""
        return (math.log(value / self.mean) if self.log else value - self.mean) / self.std


def _factor(name: str, unit: str, mean: float, std: float, most: float) -> Parameter:
    """Return a parameter with a logarithmic prior, between 1 / ``most`` and ``most`` times its mean."""
    return Parameter(name, unit, mean, std, mean / most, mean * most, log=True)


def _around(name: str, unit: str, mean: float, std: float, most: float) -> Parameter:
    """Return a parameter with a normal prior, at most ``most`` away from its mean."""
    return Parameter(name, unit, mean, std, mean - most, mean + most)


def _tyres(vehicle_file: VehicleParameters, level: float, ratio: float, stds: tuple[float, float]) -> list[Parameter]:
    """Return the prior of both axles about a rear cornering coefficient and a ratio of the coefficients."""
    rear = level * vehicle_file.axle_load_n(False)
    return [_factor(RATIO, "1", ratio, stds[1], 5.0), _factor(REAR_STIFFNESS, "N/rad", rear, stds[0], 5.0)]


def front_stiffness(vehicle: VehicleParameters, ratio: float, rear: float) -> float:
    """Return the cornering stiffness of the front axle from the ratio of the coefficients and that of the rear axle."""
    return ratio * rear * vehicle.axle_load_n(True) / vehicle.axle_load_n(False)


def coefficients(vehicle: VehicleParameters) -> tuple[float, float]:
    """Return the cornering coefficients of front and rear axle, 1/rad."""
    mu = vehicle.assumed_friction
    front, rear = (
        vehicle.cornering_stiffness_n_per_rad(axle, mu) / vehicle.axle_load_n(axle) for axle in (True, False)
    )
    return front, rear


def parameters_of(vehicle_file: VehicleParameters) -> tuple[Parameter, ...]:
    """Return the parameters of a fit, with tyres as cars have; :func:`with_file_tyres` is the alternative.

    The stiffness in published files differs from the driven car's by up to a factor of two, the steering gain by −15 to
    +18 % (compliance, toe, wrong ratios). An accelerometer may be at either axle.
    """
    sensors = vehicle_file.sensors
    gradient = vehicle_file.roll_gradient_rad_per_m_s2 or USUAL_ROLL_GRADIENT
    reach = IMU_X_REACH * vehicle_file.wheelbase_m
    level = USUAL_LEVEL * stiffness_per_load(max(vehicle_file.mass_kg, CAR_KG))
    stds = MODEL_STDS if vehicle_file.mass_kg < MODEL_KG else USUAL_STDS
    return (
        *_tyres(vehicle_file, level, USUAL_RATIO, stds),
        _factor(PEAK, "1", 1.0, FILE_TYRE_STD, 6.0),
        _factor(INERTIA, "kg m^2", vehicle_file.yaw_inertia_kg_m2, 0.2, 2.0),
        _factor(RELAXATION, "m", vehicle_file.relaxation_length_m or 0.5, 0.4, 4.0),
        _around(STEER_OFFSET, "rad", vehicle_file.steer_offset_rad, 0.01, 0.05),
        _factor(STEER_RATIO, "1", vehicle_file.steering_ratio, 0.08, 1.2),
        _around(STEER_DELAY, "s", 0.0, 0.02, 0.1),
        _around(AY_GAIN, "1", 1.0 + GRAVITY_M_S2 * gradient, 0.03, 0.15),
        _around(AY_BIAS, "m/s^2", sensors.ay_bias_m_s2, 0.1, 1.5),
        _around(IMU_X, "m", vehicle_file.imu_position_m[0], reach, 3.0 * reach),
        _around(RATE_BIAS, "rad/s", sensors.yaw_rate_bias_rad_s, 0.005, 0.05),
    )


def with_file_tyres(parameters: Sequence[Parameter], vehicle_file: VehicleParameters) -> tuple[Parameter, ...]:
    """Return the parameters with a prior for a file that describes the driven tyres.

    The default vehicle describes no tyres: its parameters stay.
    """
    if vehicle_file.tyres == default_vehicle().tyres:
        return tuple(parameters)
    front, rear = coefficients(vehicle_file)
    tyres = {p.name: p for p in _tyres(vehicle_file, rear, front / rear, FILE_STDS)}
    return tuple(tyres.get(p.name, p) for p in parameters)


def prior_of(vehicle_file: VehicleParameters, taught: Sequence[TaughtParameter] = ()) -> tuple[Parameter, ...]:
    """Return the prior of a car before any driving: mean and spread of both alternatives, or the taught prior."""
    parameters = parameters_of(vehicle_file)
    if taught:
        return with_taught(parameters, taught)

    def mixed(p: Parameter, of_file: Parameter) -> Parameter:
        away, scale = p.theta(of_file.mean), of_file.std / p.std
        variance = 1.0 - FILE_SHARE + FILE_SHARE * (scale**2 + (1.0 - FILE_SHARE) * away**2)
        return replace(p, mean=p.value(FILE_SHARE * away), std=p.std * math.sqrt(variance))

    return tuple(map(mixed, parameters, with_file_tyres(parameters, vehicle_file)))


def with_taught(
    parameters: Sequence[Parameter], taught: Sequence[TaughtParameter], level_m_s2: float = 0.0
) -> tuple[Parameter, ...]:
    """Return the parameters with the prior from drives with ground truth, for driving at a level of a_y.

    Tyres behave differently at 8 m/s² than in normal driving: the prior of the nearest level is used, and with less
    weight the more the levels differ.
    """

    def likeness(t: TaughtParameter) -> float:
        return min(t.ay_m_s2, level_m_s2) / max(t.ay_m_s2, level_m_s2, 1e-9)

    def moved(p: Parameter) -> Parameter:
        t = max((t for t in taught if t.name == p.name), key=likeness, default=None)
        if t is None:
            return p
        share = float(np.interp(likeness(t), LIKE, (0.0, 1.0))) if likeness(t) > 0.0 else 1.0
        variance = p.std**2 - share**2 * max(p.std**2 - t.std**2, 0.0)
        return replace(p, mean=p.value(share * p.theta(t.value)), std=math.sqrt(variance))

    return tuple(map(moved, parameters))


def like_drives(levels_m_s2: Sequence[float]) -> list[list[int]]:
    """Return groups of drives with similar levels of a_y, which share all information; the lowest level first."""
    groups: list[list[int]] = []
    for k in sorted(range(len(levels_m_s2)), key=lambda k: -levels_m_s2[k]):
        if not groups or levels_m_s2[k] < LIKE[1] * levels_m_s2[groups[-1][0]]:
            groups.append([])
        groups[-1].append(k)
    return [sorted(group) for group in reversed(groups)]


def level_of(drives: Sequence[Driving]) -> float:
    """Return the RMS of a_y, m/s², weighted by its square, so that straight driving hardly contributes."""
    ay2 = driven(drives, AY) ** 2
    return math.sqrt(float(np.nansum(ay2**2)) / max(float(np.nansum(ay2)), 1e-9))


def peak_reached(drives: Sequence[Driving], vehicle_file: VehicleParameters) -> float:
    """Return the share of the file's peak force that the a_y of the driving needs."""
    ay = driven(drives, AY)
    most = sum(vehicle_file.magic_formula(front, vehicle_file.assumed_friction)[2] for front in (True, False))
    reached = np.nanquantile(np.abs(ay), REACHED_QUANTILE) if np.isfinite(ay).any() else 0.0
    return float(reached) * vehicle_file.mass_kg / most


class JointProblem:
    """The fit of one car to the driving of its logs, which were read with ``vehicle_file``."""

    def __init__(self, drives: Sequence[Driving], vehicle_file: VehicleParameters) -> None:
        reached = REACHED_SHARE * peak_reached(drives, vehicle_file)
        self.parameters = tuple(
            replace(p, low=min(max(p.low, reached), p.mean)) if p.name == PEAK else p
            for p in parameters_of(vehicle_file)
        )
        self._drives, self.vehicle_file = drives, vehicle_file
        self._file_tyres = with_file_tyres(self.parameters, vehicle_file)
        self._filter = low_pass(CUTOFF_HZ, STEP_S)
        self._kept = [np.flatnonzero(counted(d))[::KEPT_STEPS] for d in drives]
        self._columns = [np.concatenate([d.columns, np.empty((2, d.columns.shape[1]))]) for d in drives]
        for d, columns in zip(drives, self._columns, strict=True):
            slow_parts(columns, d.stretches, low_pass(BANK_HZ, STEP_S))
        self._out = [np.full((3, d.columns.shape[1]), np.nan) for d in drives]
        self._differences = [np.full((2, d.columns.shape[1]), np.nan) for d in drives]
        blocks = [np.unique(kept * STEP_S // BLOCK_S, return_inverse=True)[1] for kept in self._kept]
        self._first_block = np.cumsum([0, *(int(b.max()) + 1 for b in blocks)])
        self._block = np.concatenate([b + first for b, first in zip(blocks, self._first_block[:-1], strict=True)])
        self._weight = math.sqrt(KEPT_STEPS * STEP_S / CORRELATION_S)
        self._least_std = self._error_std = np.array(ERROR_STD)

    def taught(self, taught: Sequence[TaughtParameter]) -> JointProblem:
        """Return the fit with the prior from drives with ground truth."""
        problem = copy(self)
        problem.parameters = with_taught(self.parameters, taught, level_of(self._drives))
        problem._file_tyres = problem.parameters
        return problem

    def solve(self) -> FloatArray:
        """Return the parameters of the lowest cost, with the standard deviation of their errors.

        A descent from a dry road does not find a minimum with saturated tyres: there are two starts. Both are prior
        values: starting from the fit without the taught prior, the taught fit often stays in the same minimum.
        """
        self._error_std = self._least_std
        slippery = [p.theta(p.low) if p.name == PEAK else 0.0 for p in self.parameters]
        descents = [self._descend(start) for start in (np.zeros(len(slippery)), np.array(slippery))]
        theta = min(descents, key=lambda end: self._cost(self.errors_of(end), end))
        for _ in range(SCALES):
            error_std = np.maximum(self._least_std, self._rms(self.errors_of(theta)))
            self._error_std = error_std
            theta = self._descend(theta)
            if np.allclose(np.maximum(self._least_std, self._rms(self.errors_of(theta))), error_std, rtol=SAME_SCALE):
                break
        return theta

    def _descend(self, theta: FloatArray) -> FloatArray:
        descent, _ = descend(
            self.errors_of,
            self._cost,
            self._residuals,
            theta,
            iterations=ITERATIONS,
            least_gain=lambda _: LEAST_GAIN,
            derivative_step=DERIVATIVE_STEP,
            max_step=MAX_STEP,
        )
        return descent.theta

    def errors_of(self, theta: FloatArray) -> FloatArray:
        """Return errors over ``ERROR_STD`` [2, K]."""
        return self._errors(self.values(theta))

    def rms(self, theta: FloatArray | None) -> tuple[float, float]:
        """Return the RMS error of yaw rate and a_y for θ, or for the vehicle file if θ is None."""
        rms = self._rms(self._errors(_file_values(self.vehicle_file)) if theta is None else self.errors_of(theta))
        return float(rms[OF_RATE]), float(rms[OF_AY])

    def sideslip(self, theta: FloatArray) -> FloatArray:
        """Return the model's v_y / v_x of all used samples [K]."""
        self._errors(self.values(theta))
        parts = zip(self._drives, self._out, self._kept, strict=True)
        return np.concatenate([out[2, k] / d.columns[SPEED, k] for d, out, k in parts])

    def rear_slip(self, theta: FloatArray) -> FloatArray:
        """Return (l_r r − v_y) / v_x of the model with the gyro's r, of all used samples [K]."""
        drives = zip(self._drives, self._kept, strict=True)
        turning = np.concatenate([d.columns[YAW_RATE, k] / d.columns[SPEED, k] for d, k in drives])
        return self.vehicle_file.cg_to_rear_axle_m * turning - self.sideslip(theta)

    def values(self, theta: FloatArray) -> dict[str, float]:
        """Return the parameters by name."""
        return {p.name: p.value(t) for p, t in zip(self.parameters, theta.tolist(), strict=True)}

    def vehicle(self, theta: FloatArray) -> VehicleParameters:
        """Return the vehicle file with the parameters; friction is the file's, the peak force includes its error."""
        return _vehicle_with(self.vehicle_file, self.values(theta))

    def theta_of(self, values: Mapping[str, float]) -> FloatArray:
        """Return the normalised parameters of values by name."""
        return np.array([p.theta(values[p.name]) for p in self.parameters])

    def _errors(self, values: Mapping[str, float]) -> FloatArray:
        p = _track_of(values, self.vehicle_file)
        for d, columns, out, differences in zip(self._drives, self._columns, self._out, self._differences, strict=True):
            errors(columns, d.stretches, STEP_S, p, self._filter, out, differences)
            if not d.has_ay:
                differences[OF_AY] = 0.0
        parts = [e[:, k] for e, k in zip(self._differences, self._kept, strict=True)]
        return np.asarray(np.concatenate(parts, axis=1) / self._error_std[:2, None], dtype=np.float64)

    def _rms(self, scaled: FloatArray) -> FloatArray:
        """Return the RMS of each channel of errors over ``_error_std``."""
        return np.asarray(np.sqrt(np.mean(scaled**2, axis=1)) * self._error_std[: len(scaled)], dtype=np.float64)

    def _cost(self, scaled: FloatArray, theta: FloatArray) -> float:
        robust = 2.0 * (np.sqrt(1.0 + scaled**2) - 1.0)
        return float(self._weight**2 * np.sum(robust) + theta @ theta)

    def _residuals(self, scaled: FloatArray, centre: FloatArray) -> FloatArray:
        """Return residuals [2 K] with the soft L1 weights of the errors ``centre``."""
        return np.asarray(self._weight * scaled / (1.0 + centre**2) ** 0.25, dtype=np.float64).ravel()

    def _curvature(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the inverse curvature of the cost [n, n], and its gradient by block [blocks, n]."""
        centre = self.errors_of(theta)
        residuals = self._residuals(centre, centre)
        jacobian = np.empty((residuals.size, theta.size))
        for i in range(theta.size):
            moved = theta.copy()
            moved[i] += DERIVATIVE_STEP
            jacobian[:, i] = (self._residuals(self.errors_of(moved), centre) - residuals) / DERIVATIVE_STEP
        inverse = np.asarray(np.linalg.inv(jacobian.T @ jacobian + np.eye(theta.size)), dtype=np.float64)
        gradients = np.zeros((int(self._first_block[-1]), theta.size))
        np.add.at(gradients, np.tile(self._block, len(centre)), jacobian * residuals[:, None])
        return inverse, gradients

    def posterior(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean and covariance of the parameters from the lowest cost with tyres as cars have.

        The posterior is a mixture with the tyres of the file. Each part is normal and weighted by its evidence,
        exp(-J / 2) times the root of the determinant of its inverse curvature (Laplace; MacKay 1992).
        """
        evidence, covariance = self._laplace(theta)
        if self._file_tyres == self.parameters:
            return theta, covariance
        other = copy(self)
        other.parameters = self._file_tyres
        other_theta = other._descend(other.theta_of(self.values(theta)))
        other_evidence, other_covariance = other._laplace(other_theta)
        odds = math.exp(min(evidence - other_evidence, 100.0)) * (1.0 - FILE_SHARE) / FILE_SHARE
        share = 1.0 / (1.0 + odds)
        scale = np.array([q.std / p.std for p, q in zip(self.parameters, other.parameters, strict=True)])
        away = self.theta_of(other.values(other_theta)) - theta
        spread = share * (1.0 - share) * np.outer(away, away)
        mixed = (1.0 - share) * covariance + share * other_covariance * np.outer(scale, scale) + spread
        return theta + share * away, mixed

    def _laplace(self, theta: FloatArray) -> tuple[float, FloatArray]:
        """Return log evidence and covariance of the parameters at the lowest cost."""
        inverse, gradients = self._curvature(theta)
        evidence = 0.5 * (float(np.linalg.slogdet(inverse)[1]) - self._cost(self.errors_of(theta), theta))
        of_drives = np.add.reduceat(gradients, self._first_block[:-1])
        spread = _spread(gradients)
        # Add the variation between the drives of a pool beyond block variation: the parameters are for a single drive.
        more, axes = np.linalg.eigh(_spread(of_drives) - spread)
        spread += len(of_drives) * (axes * np.maximum(more, 0.0)) @ axes.T
        shared = np.diag([SHARED_SHARES.get(p.name, SHARED_SHARE) ** 2 for p in self.parameters])
        return evidence, np.asarray(inverse + inverse @ spread @ inverse + shared, dtype=np.float64)


def _spread(gradients: FloatArray) -> FloatArray:
    """Return the covariance [n, n] of a sum of independent gradients [k, n]; 0 of a single one."""
    count = len(gradients)
    return np.asarray(gradients.T @ gradients * (count / (count - 1) if count > 1 else 0.0), dtype=np.float64)


def counted(drive: Driving) -> BoolArray:
    """Return the mask [N] of used samples of a drive: its stretches without their start."""
    inside = np.zeros(drive.columns.shape[1], dtype=np.bool_)
    for first, last in drive.stretches:
        inside[first + round(SETTLE_S / STEP_S) : last] = True
    return inside


def driven(drives: Sequence[Driving], column: int) -> FloatArray:
    """Return a column of all used samples [K]."""
    return np.concatenate([d.columns[column, counted(d)] for d in drives])


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")


def _vehicle_with(vehicle_file: VehicleParameters, values: Mapping[str, float]) -> VehicleParameters:
    values, mu = {name: _rounded(value) for name, value in values.items()}, vehicle_file.assumed_friction

    def tyre(front: bool, stiffness: float) -> AxleTyre:
        peak = values[PEAK] * vehicle_file.magic_formula(front, mu)[2]
        b = _rounded(stiffness / (STIFFNESS_TYRE_SHAPE * peak))
        return AxleTyre(B=b, C=STIFFNESS_TYRE_SHAPE, D_n=_rounded(peak / mu), E=0.0, reference_friction=mu)

    rear = values[REAR_STIFFNESS]
    front = front_stiffness(vehicle_file, values[RATIO], rear)
    biases = {"ay_bias_m_s2": values[AY_BIAS], "yaw_rate_bias_rad_s": values[RATE_BIAS]}
    return vehicle_file.model_copy(
        update={
            "tyres": Tyres(front=tyre(True, front), rear=tyre(False, rear)),
            "yaw_inertia_kg_m2": values[INERTIA],
            "steer_offset_rad": values[STEER_OFFSET],
            "steering_ratio": values[STEER_RATIO],
            "roll_gradient_rad_per_m_s2": _rounded((values[AY_GAIN] - 1.0) / GRAVITY_M_S2),
            "friction": mu,
            "sensors": vehicle_file.sensors.model_copy(update=biases),
            "imu_position_m": (values[IMU_X], *vehicle_file.imu_position_m[1:]),
            "relaxation_length_m": values[RELAXATION],
            "physics": vehicle_file.physics.model_copy(update=dict.fromkeys(PARTS, True)),
        }
    )


def prior_vehicle(vehicle_file: VehicleParameters, taught: Sequence[TaughtParameter] = ()) -> VehicleParameters:
    """Return the vehicle file with every parameter at its prior mean."""
    return _vehicle_with(vehicle_file, {p.name: p.mean for p in prior_of(vehicle_file, taught)})


def prior_variations(
    vehicle: VehicleParameters, priors: Sequence[Parameter] | None = None, share: float = 1.0
) -> tuple[VehicleParameters, ...]:
    """Return vehicles with a prior 1-sigma error in one parameter each, those with the most effect on the sideslip.

    Stiffness of the axles, friction in place of peak force, steering ratio and offset, position of the accelerometer.
    Without ``priors``, ``vehicle`` is a vehicle file. ``share`` : factor on the standard deviations.
    """
    std, (x, y, z) = {p.name: share * p.std for p in priors or parameters_of(vehicle)}, vehicle.imu_position_m
    front, rear = (std[RATIO], std[REAR_STIFFNESS]) if priors else (share * FILE_TYRE_STD, share * FILE_TYRE_STD)
    return (
        vehicle.with_stiffness(math.exp(front), 1.0),
        vehicle.with_stiffness(math.exp(rear) if priors else 1.0, math.exp(rear)),
        vehicle.model_copy(update={"friction": math.exp(-std[PEAK]) * vehicle.assumed_friction}),
        vehicle.model_copy(update={"steering_ratio": math.exp(std[STEER_RATIO]) * vehicle.steering_ratio}),
        vehicle.model_copy(update={"steer_offset_rad": vehicle.steer_offset_rad + std[STEER_OFFSET]}),
        vehicle.model_copy(update={"imu_position_m": (x + std[IMU_X], y, z)}),
    )


def _file_values(file: VehicleParameters) -> dict[str, float]:
    """Return the parameters of a vehicle file by name."""
    front, rear = coefficients(file)
    tyres = {RATIO: front / rear, REAR_STIFFNESS: rear * file.axle_load_n(False)}
    return {p.name: p.mean for p in parameters_of(file)} | tyres


def _track_of(values: Mapping[str, float], file: VehicleParameters) -> TrackParameters:
    """Return the model of parameters for signals that were read with a vehicle file."""
    mu, mass, rear = file.assumed_friction, file.mass_kg, values[REAR_STIFFNESS]
    front_peak, rear_peak = (values[PEAK] * file.magic_formula(front, mu)[2] / mass for front in (True, False))
    gain = file.steering_ratio / values[STEER_RATIO]
    return TrackParameters(
        front_m=file.cg_to_front_axle_m,
        rear_m=file.cg_to_rear_axle_m,
        mass_over_inertia=mass / values[INERTIA],
        front_stiffness=front_stiffness(file, values[RATIO], rear) / mass,
        rear_stiffness=rear / mass,
        front_peak=front_peak,
        rear_peak=rear_peak,
        shape=STIFFNESS_TYRE_SHAPE,
        friction=mu,
        relaxation_m=values[RELAXATION],
        ay_gain=values[AY_GAIN],
        imu_x_m=values[IMU_X],
        ay_bias=values[AY_BIAS] - file.sensors.ay_bias_m_s2,
        rate_bias=values[RATE_BIAS] - file.sensors.yaw_rate_bias_rad_s,
        steer_gain=gain,
        steer_added=gain * file.steer_offset_rad - values[STEER_OFFSET],
        steer_delay=values[STEER_DELAY] / STEP_S,
    )


def varied_parameters(
    theta: FloatArray, root: FloatArray, sideslip: Callable[[FloatArray], FloatArray], most: int
) -> list[FloatArray]:
    """Return parameters 1-sigma away from θ [n] along the posterior directions with most effect on the sideslip.

    ``root`` [n, m]: matrix root of the posterior covariance (root rootᵀ). ``sideslip``: function of parameters that
    returns sideslip, or its errors, [K]. The directions, at most ``most`` and the largest first, are uncorrelated in
    the posterior and in their effect on the sideslip.
    """
    centre = sideslip(theta)
    moved = np.stack([sideslip(theta + step) - centre for step in root.T])
    _, axes = np.linalg.eigh(moved @ moved.T)
    return [theta + step for step in (root @ axes[:, ::-1][:, :most]).T]
