"""Axle slip angles and lateral forces from ground truth, and a magic formula through them: where identification starts.

F_yf cos δ + F_yr = m a_y and l_f F_yf cos δ − l_r F_yr = I_z ṙ give both axle forces; the slip angles follow from the
true velocity (Eq 3, 4). The fit is least squares with the priors of docs/method.md#identification.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters, correct_signals
from pdhef_logtool.estimators.vehicle_ukf import PosteriorSteps
from pdhef_logtool.evaluation.smoothing import smooth
from pdhef_logtool.records.geometry import wrap_angle
from pdhef_logtool.records.signals import BoolArray, FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack

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


@dataclass(frozen=True, slots=True, eq=False)
class FitDrive:
    """A drive, or a part of it: signals [N] without any correction of a vehicle file, and ground truth [N]."""

    name: str
    signals: Signals
    truth: StateTrack


@dataclass(frozen=True, slots=True, eq=False)
class AxleSamples:
    """Slip angle [N] in rad and lateral force [N] in N of both axles, from ground truth."""

    front_slip_rad: FloatArray
    front_force_n: FloatArray
    rear_slip_rad: FloatArray
    rear_force_n: FloatArray


@dataclass(frozen=True, slots=True)
class AxleCurve:
    """Magic formula of one axle with E = 0: stiffness N/rad, peak N, shape C."""

    stiffness_n_per_rad: float
    peak_n: float
    shape: float

    def force_n(self, slip_rad: FloatArray) -> FloatArray:
        """Return D sin(C atan(B α)) with B = stiffness/(C D)."""
        b = self.stiffness_n_per_rad / (self.shape * self.peak_n)
        return self.peak_n * np.sin(self.shape * np.arctan(b * slip_rad))


def usable_stamps(signals: Signals, truth: StateTrack, vehicle: VehicleParameters) -> BoolArray:
    """Return where ground truth and signals can be learned from, [N]."""
    is_complete = truth.valid & np.isfinite(truth.vx_m_s + truth.vy_m_s + truth.yaw_rate_rad_s)
    moving = truth.vx_m_s > SPEED_FACTOR * vehicle.low_speed_blend_m_s
    tame = np.abs(truth.sideslip_rad) < MAX_SIDESLIP_RAD
    use: BoolArray = is_complete & moving & tame & np.isfinite(signals.steer_rad)
    return use


def period_s(drive: FitDrive) -> float:
    """Return the usual time from one stamp to the next."""
    stamps = drive.signals.stamps_ns
    return float(np.median(np.diff(stamps))) * 1e-9 if stamps.size > 1 else 0.01


def signals_of(drive: FitDrive, start: VehicleParameters, vehicle: VehicleParameters) -> Signals:
    """Return a drive's signals as a vehicle file reads them; they were loaded with the starting file's ratio."""
    ratio = start.steering_ratio / vehicle.steering_ratio
    return correct_signals(replace(drive.signals, steer_rad=drive.signals.steer_rad * ratio), vehicle)


def usable_seconds(drive: FitDrive, vehicle: VehicleParameters) -> float:
    """Return how long a drive can be used for identification."""
    return float(np.count_nonzero(usable_stamps(drive.signals, drive.truth, vehicle))) * period_s(drive)


def sampled_errors(
    drive: FitDrive, vehicle: VehicleParameters, steps: PosteriorSteps, settle_s: float
) -> tuple[FloatArray, BoolArray, float]:
    """Return sideslip errors of a filter in rad at :data:`FIT_RATE_HZ`, their mask, and the seconds per sample.

    Masked errors are 0. ``settle_s`` : settling time of the filter, excluded from the error.
    """
    every = max(1, round(1.0 / (FIT_RATE_HZ * period_s(drive))))
    pick = slice(None, None, every)
    error = wrap_angle(np.arctan2(steps.x[pick, 1], steps.x[pick, 0]) - drive.truth.sideslip_rad[pick])
    stamps = drive.signals.stamps_ns
    use = usable_stamps(drive.signals, drive.truth, vehicle)[pick] & steps.valid[pick] & np.isfinite(error)
    use &= (stamps[pick] - stamps[0]) * 1e-9 > settle_s
    return np.where(use, error, 0.0), use, every * period_s(drive)


def axle_samples(drives: Sequence[FitDrive], vehicle: VehicleParameters) -> AxleSamples:
    """Return slip angles and forces of all usable stamps of all drives, smoothed to ``SMOOTHING_HZ``.

    At known friction they are those at the vehicle file's, for tyres that keep their stiffness: one curve of force over
    friction by slip over friction.
    """
    columns: list[tuple[FloatArray, ...]] = []
    lf, lr = vehicle.cg_to_front_axle_m, vehicle.cg_to_rear_axle_m
    for drive in drives:
        use = usable_stamps(drive.signals, drive.truth, vehicle)
        stamps = drive.signals.stamps_ns

        def smoothed(values: FloatArray, use: BoolArray = use, stamps: FloatArray = stamps) -> FloatArray:  # type: ignore[assignment]
            return smooth(stamps, np.where(use, values, np.nan), SMOOTHING_HZ)  # type: ignore[arg-type]

        truth = drive.truth
        vx, vy, r = smoothed(truth.vx_m_s), smoothed(truth.vy_m_s), smoothed(truth.yaw_rate_rad_s)
        ay, steer = smoothed(truth.ay_m_s2), smoothed(drive.signals.steer_rad)
        r_dot = vy_dot = np.full(len(stamps), np.nan)
        if len(stamps) > 2:
            r_dot, vy_dot = (np.gradient(x, stamps * 1e-9 - stamps[0] * 1e-9) for x in (r, vy))
        if not np.isfinite(ay).any():  # no specific force is known: a flat road
            ay = vy_dot + vx * r
        total, moment = vehicle.mass_kg * ay, vehicle.yaw_inertia_kg_m2 * r_dot
        front = (lr * total + moment) / (lf + lr) / np.cos(steer)
        rear = (lf * total - moment) / (lf + lr)
        friction = drive.signals.friction
        grip = np.where(np.isfinite(friction), friction / vehicle.assumed_friction, 1.0)
        slips = (steer - np.arctan((vy + lf * r) / vx), -np.arctan((vy - lr * r) / vx))
        columns.append((slips[0] / grip, front / grip, slips[1] / grip, rear / grip))
    joined = [np.concatenate(c) for c in zip(*columns, strict=True)]
    good = np.isfinite(np.sum(joined, axis=0))
    return AxleSamples(*(c[good] for c in joined))


def fit_axle(
    slip_rad: FloatArray, force_n: FloatArray, *, prior: AxleCurve, mass_kg: float, independent: float
) -> AxleCurve:
    """Fit a curve to slip and force, both [N], with priors about ``prior``.

    Parameters
    ----------
    independent : how many independent samples the N neighbouring ones are worth.
    """
    from scipy.optimize import least_squares

    if slip_rad.size < 10:
        return prior
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
