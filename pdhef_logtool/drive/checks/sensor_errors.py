"""What regression on the truth says of an accelerometer's place and delay, and of gains."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.drive.checks.fitting import SURE, fit
from pdhef_logtool.drive.checks.kind import CheckedDrive
from pdhef_logtool.drive.columns import derivative, earlier, moving_at
from pdhef_logtool.drive.truth import LatencyEstimate
from pdhef_logtool.records.signals import FloatArray

#: What an accelerometer reads of the lateral acceleration: roll adds a tenth, banked bends take a quarter.
AY_GAIN_RANGE = (0.65, 1.3)
#: The delay of a_y is found in so many steps, the last of which is less than this, and is none beyond.
DELAY_STEPS, DELAY_KNOWN_S, MOST_DELAY_S = 4, 0.005, 0.3
_TRUTH = {"truth.vx_m_s", "truth.vy_m_s", "truth.yaw_rate_rad_s"}


@dataclass(frozen=True, slots=True)
class SensorErrors:
    """What regression on truth says of an accelerometer's place and of a gyro's gain, with standard errors.

    Attributes
    ----------
    lever_m : of the accelerometer ahead of the CG. yaw_rate_gain : what the gyro reads of 1.
    ay_gain : what the accelerometer reads of 1, with the roll of the body. ay_delay_s : how late it is.
    """

    lever_m: float
    lever_error_m: float
    yaw_rate_gain: float
    gain_error: float
    ay_gain: float = math.nan
    ay_gain_error: float = math.inf
    ay_delay_s: float = math.nan
    ay_delay_error_s: float = math.inf


def sensor_errors(columns: Mapping[str, FloatArray]) -> SensorErrors:
    """Regress a_y and the gyro on the truth; NaN for what the drive does not tell.

    a_y is the truth's v̇_y + v_x r, as far as roll makes it larger; a lever adds the derivative of the yaw rate, a delay
    takes the derivative of all that off, a bias adds a constant.
    """
    nothing = (math.nan, math.inf)
    lever = gain = ay_gain = delay = nothing
    needed = [columns.get(f"truth.{n}") for n in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s")]
    vx, vy, rate = needed
    gyro, ay = columns.get("yaw_rate_rad_s"), columns.get("ay_m_s2")
    if rate is not None and gyro is not None:
        everywhere = np.ones(rate.shape[0], np.bool_)
        result = fit(gyro, [rate, derivative(rate), np.ones_like(rate)], everywhere)
        gain = nothing if result is None else (result[0][0], result[1][0])
    if vx is not None and vy is not None and rate is not None and ay is not None:
        lateral = derivative(vy) + vx * rate
        regressors = [derivative(rate), lateral, derivative(lateral), np.ones_like(rate)]
        late_s = 0.0
        for _ in range(DELAY_STEPS):  # a lever's part is late too, so that one step is not all of it
            result = fit(earlier(ay, late_s), regressors, moving_at(vx))
            if result is None or result[0][1] <= 0.0:
                break
            (place, scale, slope, _), (place_error, scale_error, slope_error, _), _ = result
            step_s = -slope / scale
            late_s += step_s
            is_converged = abs(step_s) < DELAY_KNOWN_S and late_s < MOST_DELAY_S
            delay = (late_s, slope_error / scale) if is_converged else nothing
            if lever == nothing or (is_converged and late_s > SURE * delay[1]):
                lever, ay_gain = (place, place_error), (scale, scale_error)
    return SensorErrors(*(float(x) for x in (*lever, *gain, *ay_gain, *delay)))


def errors_of_ay(drive: CheckedDrive) -> SensorErrors | None:
    """Return the errors of the accelerometer; None where the drive does not tell, or a signal is wrong."""
    errors = drive.once(_errors) if drive.has_truth else None
    is_usable = errors is not None and math.isfinite(errors.lever_m) and not drive.wrong & {"ay_m_s2", *_TRUTH}
    return errors if is_usable else None


def errors_of_gyro(drive: CheckedDrive) -> SensorErrors | None:
    """Return the errors of the gyro; None where the drive does not tell, or a signal is wrong."""
    errors = drive.once(_errors) if drive.has_truth else None
    is_usable = errors is not None and math.isfinite(errors.yaw_rate_gain)
    return errors if is_usable and not drive.wrong & {"yaw_rate_rad_s", *_TRUTH} else None


def _errors(drive: CheckedDrive) -> SensorErrors:
    return sensor_errors(drive.measured.columns)


def ay_delay(errors: SensorErrors, latency: LatencyEstimate | None) -> tuple[float, float] | None:
    """Return how late the accelerometer is, and its standard error; None where the truth does not tell.

    A truth whose yaw rate is the gyro's own may have velocities of another time, and says nothing of a_y.
    """
    low, high = AY_GAIN_RANGE
    if latency is None or not latency.reliable or latency.identical:
        return None
    if not low < errors.ay_gain < high or not math.isfinite(errors.ay_delay_s):
        return None
    return errors.ay_delay_s + latency.latency_s, math.hypot(errors.ay_delay_error_s, latency.std_error_s)
