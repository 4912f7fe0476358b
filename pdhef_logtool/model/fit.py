"""Fit of tyres, steering and sensors to a drive, without ground truth.

See docs/method.md#self-calibration.

The model of :mod:`~.equations` is fitted to yaw rate and a_y by output error. In normalised parameters θ (distance
from the prior mean in prior standard deviations) the cost is

    Σ_channels Σ_k (Δt / T) 2 (√(1 + (e_k / σ)²) − 1) + |θ|²

with errors e after a zero-phase low pass, so that T = 1 s of driving is equivalent to one sample. σ is the RMS of the
errors of each channel, at least :data:`ERROR_STD`: with a poor model the prior dominates. A drive for teaching has the
sideslip of its ground truth as a third channel, without its mean over a few seconds: offsets of the ground truth are
0.2 to 0.3 degrees and differ between days, and the road bank would be attributed to the tyres.

The covariance of θ has three parts: the curvature of the cost; the spread of the cost's gradient between blocks of the
drive (sandwich estimator, White 1982), which includes model error that changes within a drive; and the model error
that is common to a whole drive, estimated on simulated cars (:data:`SHARED_SHARES`).

Mass and position of the centre of gravity come from the file. Parameters that are not observable in the driving keep
their prior and widen the interval.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from typing import Any

import numpy as np

from pdhef_logtool.car.model import TaughtParameter
from pdhef_logtool.car.posterior import FittedParameter, Posterior
from pdhef_logtool.car.vehicle import STIFFNESS_TYRE_SHAPE, VehicleParameters
from pdhef_logtool.model import equations, priors
from pdhef_logtool.model.descent import descend, linearised
from pdhef_logtool.model.driving import STEP_S, Driving
from pdhef_logtool.records.running_mean import running_mean
from pdhef_logtool.records.signals import LEAST_DIVISOR, FloatArray

#: Frequency limit of the comparison of model and sensors.
CUTOFF_HZ = 4.0
#: Smallest standard deviation of the errors of yaw rate (rad/s), a_y (m/s²) and sideslip (rad); larger errors have a
#: linear cost.
ERROR_STD = (0.02, 0.3, math.radians(0.3))
#: Window of the mean of the sideslip error to remove, in s. If only a constant is removed, the bank of simulated roads
#: doubles the sideslip error on other drives.
SLOW_S = 4.0
#: Maximum number of fits with updated standard deviations of the errors; relative change at which they end.
SCALES, SAME_SCALE = 8, 0.05
#: Driving equivalent to one independent sample of each channel.
CORRELATION_S = 1.0
#: Subsampling of the errors, in steps of the grid: 12.5 Hz, three times the cutoff.
KEPT_STEPS = 4
#: Length of the blocks for the spread of gradients: longer than a bend, so that blocks are nearly independent.
BLOCK_S = 3.0
#: Limits of a descent.
DESCENT: dict[str, Any] = {"iterations": 40, "least_gain": lambda _: 1e-3, "derivative_step": 0.02, "max_step": 1.0}
#: Lower limit of the peak force, as a share of this quantile of a_y, which includes bank and body roll.
REACHED_SHARE, REACHED_QUANTILE = 0.8, 0.98
#: Model error common to a whole drive, as a share of each prior's standard deviation: with it at least 95 % of the
#: parameters of simulated cars are within 1.96 standard deviations. The lag of tyres and body affects the delay.
SHARED_SHARE, SHARED_SHARES = 0.2, {priors.STEER_DELAY: 0.4}
#: Minimum driving above the low-speed limit.
LEAST_S = 5.0
#: A fit is rejected if its error exceeds this share of the RMS of yaw rate or of a_y, and ``ERROR_STD``: sign or topic
#: of a signal may be wrong, or the car spins. A noisy sensor is accepted: its gain against the model is about 1.
LARGEST_SHARE, LARGEST_GAIN = 0.5, 1.25
#: A fit is rejected if the rear axle slides for this time and this share of the driving: beyond this slip angle the
#: lateral force depends on longitudinal slip, which the model lacks.
SLIDING_RAD, SLIDING_S, SLIDING_SHARE = math.radians(8.0), 10.0, 0.2
#: Smallest probability of the tyres of the file that is considered.
LEAST_FILE_SHARE = 1e-3
#: Maximum number of posterior directions in an interval.
VARIED = 5


def fit_car(driving: Driving, vehicle_file: VehicleParameters, earlier: Sequence[TaughtParameter] = ()) -> Posterior:
    """Fit a car to a drive that was read with ``vehicle_file``.

    ``earlier`` : posteriors of earlier drives; omitted if the fit is rejected with them.
    """
    driving = driving.informative()
    if driving.seconds < LEAST_S:
        why = f"{driving.seconds:.0f} s above {vehicle_file.low_speed_blend_m_s:g} m/s, {LEAST_S:g} are needed"
        return Posterior(vehicle_file, refused=why, seconds=driving.seconds)
    fit = CarFit(driving, vehicle_file, earlier)
    best = fit.solve()
    refused, slides = fit.refusal(best)
    if refused and earlier:
        return fit_car(driving, vehicle_file)
    theta, covariance = fit.posterior(best)
    vehicle, reached = fit.vehicle(theta), None
    if refused:
        reached = peak_reached(driving, vehicle_file) * vehicle_file.assumed_friction if slides else None
        vehicle = vehicle_file if reached is None else vehicle_file.model_copy(update={"friction": reached})
    root = np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
    varied = () if refused else varied_parameters(theta, root, fit.sideslip, VARIED)
    return Posterior(
        vehicle,
        fit.fitted(theta, covariance),
        refused,
        tuple(fit.vehicle(to) for to in varied),
        # A good fit is no proof of a better model.
        error_scale=max(1.0, float(np.sqrt(np.mean((fit.rms(theta) / ERROR_STD[:2]) ** 2)))),
        reached_friction=reached,
        seconds=driving.seconds,
        level_m_s2=level_of(driving),
    )


def level_of(driving: Driving) -> float:
    """Return the RMS of a_y, m/s², weighted by its square, so that straight driving hardly contributes."""
    ay2 = driving.columns[equations.AY, driving.settled] ** 2
    return math.sqrt(float(np.nansum(ay2**2)) / max(float(np.nansum(ay2)), LEAST_DIVISOR))


def peak_reached(driving: Driving, vehicle_file: VehicleParameters) -> float:
    """Return the share of the file's peak force that the a_y of the driving needs."""
    ay = driving.columns[equations.AY, driving.settled]
    return float(np.quantile(np.abs(ay), REACHED_QUANTILE)) / vehicle_file.most_ay_m_s2(vehicle_file.assumed_friction)


class CarFit:
    """The fit of a car to a drive, which was read with ``vehicle_file``."""

    def __init__(
        self, driving: Driving, vehicle_file: VehicleParameters, earlier: Sequence[TaughtParameter] = ()
    ) -> None:
        least_peak = REACHED_SHARE * peak_reached(driving, vehicle_file)
        self.prior: priors.Prior = priors.prior_of(vehicle_file, earlier, level_of(driving), least_peak=least_peak)
        self.parameters = self.prior.of_cars
        self._driving, self.vehicle_file = driving, vehicle_file
        self._filter = equations.low_pass(CUTOFF_HZ, STEP_S)
        self._kept = np.flatnonzero(driving.settled)[::KEPT_STEPS]
        grid = driving.columns.shape[1]
        self._columns = np.concatenate([driving.columns, np.empty((2, grid))])
        equations.slow_parts(self._columns, driving.stretches, equations.low_pass(equations.BANK_HZ, STEP_S))
        self._out, self._differences = np.full((3, grid), np.nan), np.full((2, grid), np.nan)
        self._block = np.unique(self._kept * STEP_S // BLOCK_S, return_inverse=True)[1]
        self._weight = math.sqrt(KEPT_STEPS * STEP_S / CORRELATION_S)
        self._least_std = self._error_std = np.array(ERROR_STD[: 2 if driving.slopes is None else 3])

    def solve(self) -> FloatArray:
        """Return the parameters θ [n] of the lowest cost; the scale of each channel's errors is estimated with them.

        A descent from a dry road does not find a minimum with saturated tyres: there are two starts. Both are prior
        values: starting from the fit without the taught prior, the taught fit often stays in the same minimum.
        """
        self._error_std = self._least_std
        slippery = [p.theta(p.low) if p.name == priors.PEAK else 0.0 for p in self.parameters]
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
        return descend(self.errors_of, self._cost, self._residuals, theta, **DESCENT).theta

    def rms(self, theta: FloatArray) -> FloatArray:
        """Return the RMS error of yaw rate and a_y, [2]."""
        return self._rms(self.errors_of(theta))[:2]

    def sideslip(self, theta: FloatArray) -> FloatArray:
        """Return the model's v_y / v_x of all used samples [K]."""
        self.errors_of(theta)
        return np.asarray(self._out[2, self._kept] / self._columns[equations.SPEED, self._kept], dtype=np.float64)

    def values(self, theta: FloatArray) -> dict[str, float]:
        """Return the parameters by name."""
        return {p.name: p.value(t) for p, t in zip(self.parameters, theta.tolist(), strict=True)}

    def vehicle(self, theta: FloatArray) -> VehicleParameters:
        """Return the vehicle file with the parameters."""
        return priors.vehicle_with(self.vehicle_file, self.values(theta))

    def fitted(self, theta: FloatArray, covariance: FloatArray) -> tuple[FittedParameter, ...]:
        """Return the parameters of a posterior, with mean and standard deviation of their prior."""
        rows = zip(self.parameters, self.prior.parameters, theta, np.sqrt(np.diag(covariance)), strict=True)
        return tuple(
            FittedParameter(p.name, p.unit, p.value(float(t)), prior.mean, float(sd) * p.std, prior.std, p.log)
            for p, prior, t, sd in rows
        )

    def refusal(self, theta: FloatArray) -> tuple[str, bool]:
        """Return why a fit is rejected, its error is too large or the car slides, and whether it slides."""
        rms = self.rms(theta)
        measured, modelled = (of[:, self._kept] for of in (self._columns[equations.YAW_RATE :], self._out))
        for row, name in ((equations.OF_RATE, "yaw rate"), (equations.OF_AY, "lateral acceleration")):
            share = rms[row] / max(float(np.sqrt(np.mean(measured[row] ** 2))), LEAST_DIVISOR)
            gain = float(modelled[row] @ measured[row]) / max(float(modelled[row] @ modelled[row]), LEAST_DIVISOR)
            is_noise = 1.0 / LARGEST_GAIN < gain < LARGEST_GAIN
            if share > LARGEST_SHARE and rms[row] > ERROR_STD[row] and not is_noise:
                return f"the model leaves {share:.0%} of the {name}, at most {LARGEST_SHARE:.0%} is plausible", False
        turning = self._columns[equations.YAW_RATE, self._kept] / self._columns[equations.SPEED, self._kept]
        rear_slip = self.vehicle_file.cg_to_rear_axle_m * turning - self.sideslip(theta)
        sliding = float(np.mean(np.abs(rear_slip) > SLIDING_RAD))
        if sliding > SLIDING_SHARE and sliding * self._driving.seconds > SLIDING_S:
            return f"the rear axle slides in {sliding:.0%} of the driving", True
        return "", False

    def errors_of(self, theta: FloatArray) -> FloatArray:
        """Return errors over their standard deviations: yaw rate, a_y, and sideslip if it is known, [2 or 3, K]."""
        driving, kept = self._driving, self._kept
        track = _track_of(self.values(theta), self.vehicle_file)
        equations.errors(self._columns, driving.stretches, STEP_S, track, self._filter, self._out, self._differences)
        if not driving.has_ay:
            self._differences[equations.OF_AY] = 0.0
        rows = self._differences[:, kept]
        if driving.slopes is not None:
            weights = driving.weights[kept]
            error = self._out[2, kept] / self._columns[equations.SPEED, kept] - driving.slopes[kept]
            fast = error - running_mean(error, round(0.5 * SLOW_S / (KEPT_STEPS * STEP_S)), weights)
            rows = np.vstack([rows, np.nan_to_num(np.sqrt(weights) * fast)])
        return np.asarray(rows / self._error_std[:, None], dtype=np.float64)

    def _rms(self, scaled: FloatArray) -> FloatArray:
        """Return the RMS of each channel of errors over ``_error_std``."""
        return np.asarray(np.sqrt(np.mean(scaled**2, axis=1)) * self._error_std, dtype=np.float64)

    def _cost(self, scaled: FloatArray, theta: FloatArray) -> float:
        robust = 2.0 * (np.sqrt(1.0 + scaled**2) - 1.0)
        return float(self._weight**2 * np.sum(robust) + theta @ theta)

    def _residuals(self, scaled: FloatArray, centre: FloatArray) -> FloatArray:
        """Return residuals [2 K] with the soft L1 weights of the errors ``centre``."""
        return np.asarray(self._weight * scaled / (1.0 + centre**2) ** 0.25, dtype=np.float64).ravel()

    def posterior(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean and covariance of the parameters from the lowest cost with tyres as cars have.

        The posterior is a mixture with the tyres of the file. Each part is normal and weighted by its evidence,
        exp(-J / 2) times the root of the determinant of its inverse curvature (Laplace; MacKay 1992).
        """
        evidence, covariance = self._laplace(theta)
        if self.prior.file_share < LEAST_FILE_SHARE:
            return theta, covariance
        other = copy(self)
        other.parameters = self.prior.of_file
        start = np.array(
            [p.theta(value) for p, value in zip(other.parameters, self.values(theta).values(), strict=True)]
        )
        other_theta = other._descend(start)
        other_evidence, other_covariance = other._laplace(other_theta)
        odds = math.exp(min(evidence - other_evidence, 100.0)) * (1.0 - self.prior.file_share) / self.prior.file_share
        share = 1.0 / (1.0 + odds)
        scale = np.array([q.std / p.std for p, q in zip(self.parameters, other.parameters, strict=True)])
        values = other.values(other_theta).values()
        away = np.array([p.theta(value) for p, value in zip(self.parameters, values, strict=True)]) - theta
        spread = share * (1.0 - share) * np.outer(away, away)
        mixed = (1.0 - share) * covariance + share * other_covariance * np.outer(scale, scale) + spread
        return theta + share * away, mixed

    def _laplace(self, theta: FloatArray) -> tuple[float, FloatArray]:
        """Return log evidence and covariance of the parameters at the lowest cost."""
        centre, count = self.errors_of(theta), int(self._block.max()) + 1
        residuals, jacobian = linearised(self.errors_of, self._residuals, theta, centre, DESCENT["derivative_step"])
        inverse = np.linalg.inv(jacobian.T @ jacobian + np.eye(theta.size))
        evidence = 0.5 * (float(np.linalg.slogdet(inverse)[1]) - self._cost(centre, theta))
        gradients = np.zeros((count, theta.size))  # of the cost, by block
        np.add.at(gradients, np.tile(self._block, len(centre)), jacobian * residuals[:, None])
        spread = gradients.T @ gradients * (count / (count - 1) if count > 1 else 0.0)
        shared = np.diag([SHARED_SHARES.get(p.name, SHARED_SHARE) ** 2 for p in self.parameters])
        return evidence, np.asarray(inverse + inverse @ spread @ inverse + shared, dtype=np.float64)


def _track_of(values: Mapping[str, float], file: VehicleParameters) -> equations.TrackParameters:
    """Return the model of parameters for signals that were read with a vehicle file."""
    mu, mass, rear = file.assumed_friction, file.mass_kg, values[priors.REAR_STIFFNESS]
    front_peak, rear_peak = (values[priors.PEAK] * file.magic_formula(front, mu)[2] / mass for front in (True, False))
    gain = file.steering_ratio / values[priors.STEER_RATIO]
    return equations.TrackParameters(
        front_m=file.cg_to_front_axle_m,
        rear_m=file.cg_to_rear_axle_m,
        mass_over_inertia=mass / values[priors.INERTIA],
        front_stiffness=priors.front_stiffness(file, values[priors.RATIO], rear) / mass,
        rear_stiffness=rear / mass,
        front_peak=front_peak,
        rear_peak=rear_peak,
        shape=STIFFNESS_TYRE_SHAPE,
        friction=mu,
        relaxation_m=values[priors.RELAXATION],
        ay_gain=values[priors.AY_GAIN],
        imu_x_m=values[priors.IMU_X],
        ay_bias=values[priors.AY_BIAS] - file.sensors.ay_bias_m_s2,
        rate_bias=values[priors.RATE_BIAS] - file.sensors.yaw_rate_bias_rad_s,
        steer_gain=gain,
        steer_added=gain * file.steer_offset_rad - values[priors.STEER_OFFSET],
        steer_delay=values[priors.STEER_DELAY] / STEP_S,
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
