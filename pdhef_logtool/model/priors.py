"""Parameters of a car and its sensors: their priors, with and without earlier drives, and vehicles that have them.

See docs/method.md#self-calibration. Only the product of friction and peak force is observable: friction keeps the
file's value, the peak force is a parameter. The prior of the tyres is a mixture, because a published file describes the
driven tyres, or softer ones, and cars on tarmac differ by a factor of two.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pdhef_logtool.car.assumed_values import stiffness_per_load
from pdhef_logtool.car.model import TaughtParameter
from pdhef_logtool.car.posterior import Posterior
from pdhef_logtool.car.vehicle import (
    GRAVITY_M_S2,
    STIFFNESS_TYRE_SHAPE,
    AxleTyre,
    Tyres,
    VehicleParameters,
    default_vehicle,
)

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
#: Log standard deviation of a file's peak force (wet or icy roads), and of its stiffness without a calibration; of the
#: former before a fit if the file has the friction of the road, which is then accurate to 0.1 (docs/learn.md#friction).
FILE_TYRE_STD, STATED_PEAK_STD = 0.5, 0.15
#: Correlation of a parameter between two drives of a car at the same level of a_y: chosen by the sideslip error of
#: taught cars (docs/method.md#earlier-drives).
CORRELATION = 0.75
#: Usual share of gravity in a_y by body roll, rad/(m/s²), for files without one (3 degrees per g), and 1-sigma of the
#: accelerometer's position in wheelbases.
USUAL_ROLL_GRADIENT, IMU_X_REACH = 0.005, 0.4

REAR_STIFFNESS, RATIO = "rear cornering stiffness", "front over rear cornering coefficient"
PEAK, INERTIA, RELAXATION = "peak force over the file's", "yaw inertia", "relaxation length"
STEER_OFFSET, STEER_RATIO, STEER_DELAY = "steering offset", "steering ratio", "steering delay"
AY_GAIN, AY_BIAS, IMU_X, RATE_BIAS = "roll gain", "a_y bias", "lever of a_y", "yaw rate bias"
#: Parameters that other drives of a car share. With ground truth the tyres alone are taught: biases, gains and delays
#: of sensors belong to one drive and include the effect of the road bank.
TYRES = (RATIO, REAR_STIFFNESS, PEAK, RELAXATION)
CARRIED = (
    RATIO, REAR_STIFFNESS, INERTIA, RELAXATION, STEER_OFFSET, STEER_DELAY, AY_GAIN, AY_BIAS, IMU_X, RATE_BIAS,
)  # fmt: skip


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
    """Return the cornering stiffness of the front axle from the rear axle's and the ratio of the coefficients."""
    return ratio * rear * vehicle.axle_load_n(True) / vehicle.axle_load_n(False)


def coefficients(vehicle: VehicleParameters) -> tuple[float, float]:
    """Return the cornering coefficients of front and rear axle, 1/rad."""
    mu = vehicle.assumed_friction
    front, rear = (
        vehicle.cornering_stiffness_n_per_rad(axle, mu) / vehicle.axle_load_n(axle) for axle in (True, False)
    )
    return front, rear


def parameters_of(vehicle_file: VehicleParameters) -> tuple[Parameter, ...]:
    """Return the parameters of a fit, with tyres as cars have.

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
    """Return the parameters with a prior for a file that describes the driven tyres."""
    front, rear = coefficients(vehicle_file)
    tyres = {p.name: p for p in _tyres(vehicle_file, rear, front / rear, FILE_STDS)}
    return tuple(tyres.get(p.name, p) for p in parameters)


@dataclass(frozen=True, slots=True)
class Prior:
    """Mixture of two priors: tyres as cars have, and, with the probability ``file_share``, tyres of the file."""

    of_cars: tuple[Parameter, ...]
    of_file: tuple[Parameter, ...]
    file_share: float

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Mean and spread of the mixture."""
        share = self.file_share

        def mixed(p: Parameter, of_file: Parameter) -> Parameter:
            away, scale = p.theta(of_file.mean), of_file.std / p.std
            variance = 1.0 - share + share * (scale**2 + (1.0 - share) * away**2)
            return replace(p, mean=p.value(share * away), std=p.std * math.sqrt(variance))

        return tuple(map(mixed, self.of_cars, self.of_file))


def prior_of(
    vehicle_file: VehicleParameters,
    earlier: Sequence[TaughtParameter] = (),
    level_m_s2: float = 0.0,
    *,
    least_peak: float = 0.0,
) -> Prior:
    """Return the prior of a car for a drive at a level of a_y, with the evidence of earlier drives.

    ``least_peak`` : lower limit of the peak force over the file's. The default vehicle describes no tyres.
    """
    before = tuple(
        replace(p, low=min(max(p.low, least_peak), p.mean)) if p.name == PEAK else p
        for p in parameters_of(vehicle_file)
    )
    of_cars = with_earlier(before, earlier, level_m_s2)
    if vehicle_file.tyres == default_vehicle().tyres:
        return Prior(of_cars, of_cars, 0.0)
    odds = FILE_SHARE / (1.0 - FILE_SHARE)
    of_file = with_file_tyres(of_cars, vehicle_file)
    for p, after, file in zip(before, of_cars, of_file, strict=True):
        kept = (after.std / p.std) ** 2
        if file is after or kept > 1.0 - 1e-9:
            continue
        # An observation that moves the prior N(0, 1) to the mean m and variance v: z = m / (1 - v) with v / (1 - v).
        z, noise = p.theta(after.mean) / (1.0 - kept), kept / (1.0 - kept)
        variance = (file.std / p.std) ** 2 + noise
        distances = (z - p.theta(file.mean)) ** 2 / variance - z**2 / (1.0 + noise)
        odds *= math.exp(-0.5 * distances) * math.sqrt((1.0 + noise) / variance)
    return Prior(of_cars, of_file, odds / (1.0 + odds))


def with_earlier(
    parameters: Sequence[Parameter], earlier: Sequence[TaughtParameter], level_m_s2: float = 0.0
) -> tuple[Parameter, ...]:
    """Return the parameters with the posteriors of earlier drives, for driving at a level of a_y.

    Random effects: a parameter has the variance 1 over drives of all cars, and the covariance ρ q between two drives of
    a car, with ρ = :data:`CORRELATION` and the ratio q of the levels of a_y, because tyres behave differently at
    8 m/s² than in normal driving. With posterior means θ and variances v < 1 of the earlier drives, w = 1 - v, the
    covariance K between them, and k with the drive:

        mean = kᵀ (w K + v)⁻¹ θ,   variance = 1 - kᵀ (w K + v)⁻¹ w k
    """

    def moved(p: Parameter) -> Parameter:
        rows = [e for e in earlier if e.name == p.name and e.std < p.std]
        if not rows:
            return p
        levels = np.array([level_m_s2, *(e.ay_m_s2 for e in rows)])
        least, most = np.minimum.outer(levels, levels), np.maximum.outer(levels, levels)
        covariance = CORRELATION * np.where(least > 0.0, least / np.maximum(most, 1e-9), 1.0)
        np.fill_diagonal(covariance, 1.0)
        theta, v = np.array([(p.theta(e.value), (e.std / p.std) ** 2) for e in rows]).T
        k, w = covariance[0, 1:], 1.0 - v
        weights = np.linalg.solve((w[:, None] * covariance[1:, 1:] + np.diag(v)).T, k)
        variance = 1.0 - float(weights @ (w * k))
        return replace(p, mean=p.value(float(weights @ theta)), std=p.std * math.sqrt(variance))

    return tuple(map(moved, parameters))


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")


def vehicle_with(vehicle_file: VehicleParameters, values: Mapping[str, float]) -> VehicleParameters:
    """Return the vehicle file with parameters by name; the peak force includes the error of the file's friction."""
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


def prior_posterior(vehicle_file: VehicleParameters, earlier: Sequence[TaughtParameter] = ()) -> Posterior:
    """Return the car of a drive before any driving: prior means, with the variations that affect sideslip most."""
    parameters = prior_of(vehicle_file, earlier).parameters
    vehicle = vehicle_with(vehicle_file, {p.name: p.mean for p in parameters})
    if vehicle_file.friction is not None:
        parameters = tuple(replace(p, std=STATED_PEAK_STD) if p.name == PEAK else p for p in parameters)
    return Posterior(vehicle, varied=prior_variations(vehicle, parameters), from_earlier=bool(earlier))


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
