"""Position, gain and delay of the accelerometer and gain and delay of the gyro, by regression on ground truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.drive.checks.kind import SURE, CheckedDrive, CheckKind
from pdhef_logtool.drive.columns import GRID_S, derivative, earlier, fit, moving_at
from pdhef_logtool.drive.relations import CG_VY, GAIN_RANGE
from pdhef_logtool.drive.truth import LatencyEstimate
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.running_mean import running_mean
from pdhef_logtool.records.signals import FloatArray

#: Plausible gain of an accelerometer in lateral acceleration: roll adds 10 %, banked bends subtract 25 %.
AY_GAIN_RANGE = (0.65, 1.3)
#: Crossfall alone moves an accelerometer by half a metre per second squared.
LEAST_LATERAL_M_S2 = 0.7
#: Production gyros have a gain error of 1 %, cheap ones of 3 %; 1-sigma by filters of two (studies/plus_minus.py).
GAIN_ERROR, RESAMPLED_GAIN = 0.05, 0.0015
#: A sensor's filter and a bus take 10 to 20 ms; at 0.5 Hz, 30 ms are 5 degrees of phase.
SENSOR_DELAY_S = 0.03
#: Largest distance between a sensor and its position in the vehicle file, m. Beyond the second value, the sensor is
#: outside of the car: another quantity correlates with the yaw acceleration.
LEVER_M, MOST_LEVER_M = 0.5, 5.0
#: Steps to find the delay of a_y, the largest last step, and the largest delay.
DELAY_STEPS, DELAY_KNOWN_S, MOST_DELAY_S = 4, 0.005, 0.3
#: Lateral acceleration that changes more slowly may be a bank of the road. Delay of body roll after the acceleration;
#: the gain gives the roll angle.
SLOW_S, ROLL_LAG_S = 4.0, 0.08
_TRUTH = {"truth.vx_m_s", "truth.vy_m_s", "truth.yaw_rate_rad_s"}


@dataclass(frozen=True, slots=True)
class SensorErrors:
    """Errors of accelerometer and gyro with their standard errors.

    Attributes
    ----------
    lever_m : position of the accelerometer ahead of the CG. yaw_rate_gain : of the gyro.
    ay_gain, ay_delay_s : of the accelerometer; the gain includes body roll.
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
    """Regress a_y and the gyro on ground truth; NaN for errors that the drive does not excite.

    The regressors of a_y are v̇_y + v_x r (gain, with body roll), the yaw acceleration (lever arm), the derivative of
    v̇_y + v_x r (delay), a constant (bias), and v̇_y + v_x r again where it changes slowly (bank).
    """
    nothing = (math.nan, math.inf)
    lever = gain = ay_gain = delay = nothing
    vx, vy, rate = (columns.get(f"truth.{n}") for n in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s"))
    vy = columns.get(CG_VY, vy)
    gyro, ay = columns.get("yaw_rate_rad_s"), columns.get("ay_m_s2")
    if rate is not None and gyro is not None:
        everywhere = np.ones(rate.shape[0], np.bool_)
        result = fit(gyro, [rate, derivative(rate), np.ones_like(rate)], everywhere)
        gain = nothing if result is None else (result[0][0], math.hypot(result[1][0], RESAMPLED_GAIN))
    if vx is not None and vy is not None and rate is not None and ay is not None:
        lateral = derivative(vy) + vx * rate
        slow = running_mean(lateral, round(0.5 * SLOW_S / GRID_S))
        regressors = [derivative(rate), lateral, derivative(lateral), np.ones_like(rate), slow]
        late_s = 0.0
        for _ in range(DELAY_STEPS):  # iterates, because the lever-arm term is late too
            result = fit(earlier(ay, late_s), regressors, moving_at(vx))
            if result is None or result[0][1] <= 0.0:
                break
            (place, scale, slope, *_), (place_error, scale_error, slope_error, *_), _ = result
            step_s = -slope / scale
            late_s += step_s
            is_converged = abs(step_s) < DELAY_KNOWN_S and late_s < MOST_DELAY_S
            roll = float(np.clip(scale, 1.0, AY_GAIN_RANGE[1])) - 1.0
            delay = (late_s - ROLL_LAG_S * roll, slope_error / scale) if is_converged else nothing
            if lever == nothing or (is_converged and late_s > SURE * delay[1]):
                lever, ay_gain = (place, place_error), (scale, scale_error)
    return SensorErrors(*(float(x) for x in (*lever, *gain, *ay_gain, *delay)))


def errors_of(name: str, drive: CheckedDrive) -> SensorErrors | None:
    """Return the errors of accelerometer or gyro; None if the drive does not excite them or a signal is wrong."""
    if not drive.has_truth or drive.wrong & {name, *_TRUTH}:
        return None
    errors = drive.once(_errors)
    return errors if math.isfinite(errors.lever_m if name == "ay_m_s2" else errors.yaw_rate_gain) else None


def _errors(drive: CheckedDrive) -> SensorErrors:
    return sensor_errors(drive.measured.columns)


def ay_delay(errors: SensorErrors, latency: LatencyEstimate | None) -> tuple[float, float] | None:
    """Return the delay of the accelerometer and its standard error; None if ground truth does not show it.

    If the yaw rate of ground truth is the gyro's channel, its velocities may have another delay.
    """
    low, high = AY_GAIN_RANGE
    if latency is None or not latency.reliable or latency.identical:
        return None
    if not low < errors.ay_gain < high or not math.isfinite(errors.ay_delay_s):
        return None
    return errors.ay_delay_s + latency.latency_s, math.hypot(errors.ay_delay_error_s, latency.std_error_s)


def _with_errors(
    name: str, check: Callable[[CheckedDrive, SensorErrors], Iterable[Check]]
) -> Callable[[CheckedDrive], Iterable[Check]]:
    """Return a check that is made only if the errors of this sensor are known."""
    return lambda drive: () if (errors := errors_of(name, drive)) is None else check(drive, errors)


def _ay_place(drive: CheckedDrive, errors: SensorErrors) -> Iterator[Check]:
    place = drive.vehicle.imu_position_m[0]
    off, error = errors.lever_m - place, errors.lever_error_m
    evidence = (
        f"the accelerometer is {errors.lever_m:.2f} +- {error:.2f} m ahead of the CG, the vehicle file gives {place:g}"
    )
    check = AY_PLACE.of_figure(off, error, (-LEVER_M, LEVER_M), evidence, lever=errors.lever_m)
    if abs(off) > max(MOST_LEVER_M, SURE * error):
        no_car = (
            "no car has its sensor there: lateral velocity or yaw rate of ground truth may be of another point or time"
        )
        check = AY_PLACE.undecided(evidence, lacks=no_car)
    elif check.verdict == "failed" and not drive.has_file:
        check = AY_PLACE.undecided(evidence, lacks="needs a vehicle file that gives imu_position_m")
    yield check


AY_PLACE = CheckKind(
    "ay_m_s2.place",
    compares="the position of the accelerometer, by a_y against ground truth, with the position in the vehicle file",
    fails="they are 0.5 m apart",
    remedy="imu_position_m = [{lever:.2f}, 0.0, 0.0] in the vehicle file",
    lacks="needs quick bends to both sides",
    function=_with_errors("ay_m_s2", _ay_place),
)


def _ay_gain(drive: CheckedDrive, errors: SensorErrors) -> Iterator[Check]:
    gain, error = errors.ay_gain, errors.ay_gain_error
    lateral = drive.measured.columns["truth.vx_m_s"] * drive.measured.columns["truth.yaw_rate_rad_s"]
    if not np.nanstd(lateral) > LEAST_LATERAL_M_S2:
        return
    evidence = f"a_y reads {gain:.2f} +- {error:.2f} of the ground-truth lateral acceleration, with roll and bank"
    low, high = GAIN_RANGE
    if not low < gain < high and any(c.name == "ay_m_s2.unit" and c.verdict == "passed" for c in drive.related):
        lacks = "a_y agrees with yaw rate x speed: the lateral velocity of ground truth may be wrong"
        yield AY_GAIN.undecided(evidence, lacks=lacks)
    else:
        yield AY_GAIN.of_figure(gain, error, AY_GAIN_RANGE, evidence, gain=gain)


AY_GAIN = CheckKind(
    "ay_m_s2.gain",
    compares="a_y with the ground-truth lateral acceleration",
    fails="it reads less than 0.65 or more than 1.3 of it",
    remedy="divide its scale in the mapping by about {gain:.2f}",
    lacks="needs quick bends to both sides",
    function=_with_errors("ay_m_s2", _ay_gain),
)


def _ay_delay(drive: CheckedDrive, errors: SensorErrors) -> Iterator[Check]:
    delay_and_error = ay_delay(errors, drive.latency)
    if delay_and_error is None or delay_and_error[1] > SENSOR_DELAY_S:
        return
    delay, error = delay_and_error
    evidence = f"a_y is {delay * 1e3:.1f} +- {error * 1e3:.1f} ms late against ground truth"
    yield AY_DELAY.of_figure(delay, error, (-math.inf, SENSOR_DELAY_S), evidence, delay=delay)


AY_DELAY = CheckKind(
    "ay_m_s2.delay",
    compares="the stamps of a_y with the stamps of ground truth",
    fails="a_y is 30 ms late",
    remedy="latency_s = {delay:.4f} more in the mapping",
    lacks="needs quick bends to both sides",
    function=_with_errors("ay_m_s2", _ay_delay),
)


def _gyro_gain(drive: CheckedDrive, errors: SensorErrors) -> Iterator[Check]:
    gain, error = errors.yaw_rate_gain / drive.vehicle.sensors.yaw_rate_gain, errors.gain_error
    evidence = f"the gyro reads {gain:.3f} +- {error:.3f} of the ground-truth yaw rate"
    plausible = (1.0 - GAIN_ERROR, 1.0 + GAIN_ERROR)
    yield GYRO_GAIN.of_figure(gain, error, plausible, evidence, gain=errors.yaw_rate_gain)


GYRO_GAIN = CheckKind(
    "yaw_rate_rad_s.gain",
    compares="the gyro with the ground-truth yaw rate",
    fails="its gain is off by 5 %",
    remedy="sensors.yaw_rate_gain = {gain:.3f} in the vehicle file",
    lacks="needs bends to both sides",
    function=_with_errors("yaw_rate_rad_s", _gyro_gain),
)


def _gyro_delay(drive: CheckedDrive) -> Iterator[Check]:
    latency = drive.latency
    if not drive.has_truth or latency is None or not latency.reliable or latency.identical:
        return
    delay = latency.gyro_delay_s
    by = (delay - latency.latency_s) * 1e3
    evidence = f"{by:.1f} +- {latency.std_error_s * 1e3:.1f} ms late against ground truth"
    yield GYRO_DELAY.judged(delay <= SENSOR_DELAY_S, evidence, delay=delay)


GYRO_DELAY = CheckKind(
    "yaw_rate_rad_s.delay",
    compares="the stamps of the gyro with the stamps of ground truth",
    fails="the gyro is 30 ms late",
    remedy="latency_s = {delay:.4f} more in the mapping",
    function=_gyro_delay,
)
CHECKS = (AY_PLACE, AY_GAIN, AY_DELAY, GYRO_GAIN, GYRO_DELAY)
