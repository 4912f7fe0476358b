"""Inputs of the sideslip reference at its knots: sensor means, values and noise, and the error of the axle law."""

import math
from collections.abc import Callable

import numpy as np

from pdhef_logtool.estimators import kinematic_filter as s
from pdhef_logtool.records.running_mean import running_mean
from pdhef_logtool.records.signals import NS_PER_S, S_PER_NS, BoolArray, FloatArray, IntArray, Signals

#: Knots per second.
RATE_HZ = 20.0
#: Lateral acceleration up to which the rear axle's slip is proportional to its force, at friction 0.85.
LINEAR_AY_M_S2, LINEAR_FRICTION = 3.5, 0.85
#: 1-sigma of the axle law in degrees: constant, per m/s², per m/s³, per (m/s²)² beyond the linear range.
LAW_DEG = (0.15, 0.06, 0.04, 1.5)
#: Gap after which the IMU is considered missing.
LONGEST_IMU_GAP_S = 0.25
#: Minimum white noise of accelerometers, m/s²/√Hz, and of the gyro, rad/s/√Hz.
LEAST_NOISE_M_S2, LEAST_NOISE_RAD_S = 0.02, 0.0007
#: Speed of standstill.
STANDSTILL_M_S = 0.1
#: Upper limits of yaw rate, acceleration (bank and grade) and speed over ground at standstill.
STILL_RAD_S, STILL_M_S2, STILL_GNSS_M_S = 0.03, 2.0, 1.0
#: 1-sigma of GNSS velocity without a reported accuracy; its increase with acceleration (filtering in receivers) and
#: with roll rate (unknown lever arm of the antenna).
GNSS_STD_M_S, GNSS_LAG_S, ROLL_ARM_M = 0.05, 0.01, 0.3
#: Roll per lateral acceleration and pitch per longitudinal acceleration of a usual car.
ROLL_PER_AY_RAD_S2_M, PITCH_PER_AX_RAD_S2_M = 0.0075, 0.004
#: Minimum correlation of roll and pitch rate with a usual car's to determine their signs.
LEAST_SIGN_CORRELATION = 0.3
#: 1-sigma of the lateral position of an antenna, and its factor in a speed over ground: the error is persistent.
ANTENNA_Y_STD_M, LENGTH_FACTOR = 0.5, 4.0
#: Half of the averaging window of accelerations that are multiplied by gains, s.
SLOW_S = 0.25


def sensor_noise(signals: Signals, rows: FloatArray) -> FloatArray:
    """Return the white noise of a_x, a_y in m/s²/√Hz, at least 0.02, and of the gyro in rad/s/√Hz, at least 0.0007.

    The larger of the noise of the samples and of the means between knots, as vibration of the body is not white.
    """
    columns = (
        (signals.ax_m_s2, s.MEAN_AX, LEAST_NOISE_M_S2),
        (signals.ay_m_s2, s.MEAN_AY, LEAST_NOISE_M_S2),
        (signals.yaw_rate_rad_s, s.MEAN_YAW_RATE, LEAST_NOISE_RAD_S),
    )
    stamps_ns = np.rint(np.arange(len(rows)) * (NS_PER_S / RATE_HZ)).astype(np.int64)
    return np.array(
        [
            max(white_noise(signals.stamps_ns, values, least), white_noise(stamps_ns, rows[:, mean], least))
            for values, mean, least in columns
        ]
    )


def white_noise(stamps_ns: IntArray, values: FloatArray, least: float) -> float:
    """Return the white noise of a sensor [N] per √Hz from its third differences.

    Samples that repeat the previous one are excluded, as sensors may repeat values.
    """
    good = np.isfinite(values)
    values, stamps = values[good], stamps_ns[good]
    changed = np.flatnonzero(np.diff(values, prepend=math.inf) != 0.0)
    values, stamps = values[changed], stamps[changed]
    if len(values) < 8:
        return least
    third = np.abs(np.diff(values, 3))
    sample_std = 1.4826 * float(np.median(third)) / math.sqrt(20.0)
    return max(least, sample_std * math.sqrt(float(np.median(np.diff(stamps))) * S_PER_NS))


def knots(
    signals: Signals, friction: float, ay_bias_m_s2: float, *, speed_over_ground: bool = False
) -> tuple[IntArray, FloatArray]:
    """Return the stamps of the knots [K] and the filter's inputs [K, INPUTS] there; a_y without its known bias.

    ``speed_over_ground``: the speed is the length of a velocity.
    """
    t = (signals.stamps_ns - signals.stamps_ns[0]) * S_PER_NS
    h = 1.0 / RATE_HZ
    knot_s = np.arange(0.0, t[-1] + 0.5 * h, h)
    rows = np.full((len(knot_s), s.INPUTS), np.nan)
    gap = np.zeros(len(knot_s), dtype=np.bool_)
    for values, mean, value, derivative, averaged in (
        (signals.ax_m_s2, s.MEAN_AX, s.AX, None, s.SLOW_AX),
        (signals.ay_m_s2 - ay_bias_m_s2, s.MEAN_AY, s.AY, s.AY_RATE, s.SLOW_AY),
        (signals.yaw_rate_rad_s, s.MEAN_YAW_RATE, s.YAW_RATE, s.YAW_ACCELERATION, None),
    ):
        if mean == s.MEAN_AX and np.isfinite(values).sum() < 2:
            values = _from_speed(t, signals.speed_m_s)
        integral, missing = _integral(t, values)
        gap |= missing(knot_s) & (mean != s.MEAN_AX)
        rows[:, mean] = (integral(knot_s) - integral(knot_s - h)) / h
        rows[:, value] = (integral(knot_s + 0.5 * h) - integral(knot_s - 0.5 * h)) / h
        if derivative is not None:
            rows[:, derivative] = (integral(knot_s + h) - 2.0 * integral(knot_s) + integral(knot_s - h)) / h**2
        if averaged is not None:
            rows[:, averaged] = (integral(knot_s + SLOW_S) - integral(knot_s - h - SLOW_S)) / (h + 2.0 * SLOW_S)
    rows[:, s.MEAN_YAW_ACCELERATION] = np.diff(rows[:, s.YAW_RATE], prepend=rows[0, s.YAW_RATE]) / h
    rows[:, s.GAP] = gap
    rows[:, s.SPEED] = _speed(t, signals.speed_m_s, knot_s)
    rows[:, s.SPEED_STD] = 0.15 + 0.01 * np.abs(np.nan_to_num(rows[:, s.SPEED])) + 0.05 * np.abs(rows[:, s.AX])
    rows[:, s.LENGTH] = speed_over_ground
    rows[:, s.UNSIGNED] = not (signals.speed_m_s < -STANDSTILL_M_S).any()
    if rows[0, s.LENGTH]:  # of the antenna
        rows[:, s.SPEED_STD] = np.hypot(rows[:, s.SPEED_STD], LENGTH_FACTOR * ANTENNA_Y_STD_M * rows[:, s.YAW_RATE])
    rows[:, s.LAW_STD] = np.where(gap, 0.0, law_std(rows, friction))
    _add_tilt(rows, signals, t, knot_s)
    _add_gnss(rows, signals, knot_s)
    rows[:, s.STANDSTILL] = standstill(rows)
    return signals.stamps_ns[0] + np.rint(knot_s * NS_PER_S).astype(np.int64), rows


def law_std(rows: FloatArray, friction: float) -> FloatArray:
    """Return the 1-sigma of the axle law [K] in rad."""
    linear = LINEAR_AY_M_S2 * min(1.0, friction / LINEAR_FRICTION)
    ay, ay_rate = np.abs(rows[:, s.AY]), np.abs(rows[:, s.AY_RATE])
    beyond = np.maximum(ay - linear, 0.0) ** 2
    return np.radians(LAW_DEG[0] + LAW_DEG[1] * ay + LAW_DEG[2] * ay_rate + LAW_DEG[3] * beyond)


def standstill(rows: FloatArray) -> BoolArray:
    """Return the mask [K] of standstill: zero speed (also of locked wheels) and no motion in the other sensors."""
    still = rows[:, s.SPEED] < STANDSTILL_M_S
    still &= np.abs(rows[:, s.YAW_RATE]) < STILL_RAD_S
    still &= np.hypot(rows[:, s.SLOW_AX], rows[:, s.SLOW_AY]) < STILL_M_S2
    return still & ~(np.hypot(rows[:, s.GNSS_EAST], rows[:, s.GNSS_NORTH]) > STILL_GNSS_M_S)


def _add_tilt(rows: FloatArray, signals: Signals, t: FloatArray, knot_s: FloatArray) -> None:
    """Add roll and pitch rate to the rows, with signs for a body that leans outwards in turns and dives in braking."""
    h = 1.0 / RATE_HZ
    rows[:, [s.TILT, s.MEAN_ROLL_RATE, s.MEAN_PITCH_RATE]] = 0.0
    rows[:, s.ROLL_RATE] = ROLL_PER_AY_RAD_S2_M * rows[:, s.AY_RATE]
    if not all(np.isfinite(v).sum() > 0.9 * len(t) for v in (signals.roll_rate_rad_s, signals.pitch_rate_rad_s)):
        return
    angles = [_integral(t, values)[0] for values in (signals.roll_rate_rad_s, signals.pitch_rate_rad_s)]
    roll, pitch = ((angle(knot_s) - angle(knot_s - h)) / h for angle in angles)
    roll_at, pitch_at = ((angle(knot_s + 0.5 * h) - angle(knot_s - 0.5 * h)) / h for angle in angles)
    turned = rows[:, s.YAW_RATE] * rows[:, s.SLOW_AY]  # a body that rolls in a turn has a pitch rate
    dives = ROLL_PER_AY_RAD_S2_M * turned - PITCH_PER_AX_RAD_S2_M * np.gradient(rows[:, s.SLOW_AX], h)
    half = round(SLOW_S * RATE_HZ)
    of_pitch = correlation(running_mean(pitch_at, half), running_mean(dives, half))
    signs = [correlation(roll_at, rows[:, s.AY_RATE]), of_pitch]
    if max(np.abs(signs)) < LEAST_SIGN_CORRELATION:
        return
    roll_sign, pitch_sign = (-1.0 if c < -LEAST_SIGN_CORRELATION else 1.0 for c in signs)
    rows[:, s.TILT], rows[:, s.ROLL_RATE] = 1.0, roll_sign * roll_at
    rows[:, s.MEAN_ROLL_RATE], rows[:, s.MEAN_PITCH_RATE] = roll_sign * roll, pitch_sign * pitch


def correlation(rate: FloatArray, change: FloatArray) -> float:
    """Return the correlation of an angular rate [K] with a change of acceleration [K], 0 if one is constant."""
    return 0.0 if rate.std() == 0.0 or change.std() == 0.0 else float(np.corrcoef(rate, change)[0, 1])


def _integral(
    t: FloatArray, values: FloatArray
) -> tuple[Callable[[FloatArray], FloatArray], Callable[[FloatArray], BoolArray]]:
    """Return the integral of a column over time as a function, and a function for intervals without a sample."""
    good = np.isfinite(values)
    if good.sum() < 2:
        return (lambda knot_s: np.zeros_like(knot_s)), (lambda knot_s: np.ones(len(knot_s), dtype=np.bool_))
    times, y = t[good], values[good]
    total = np.concatenate([[0.0], np.cumsum(0.5 * (y[1:] + y[:-1]) * np.diff(times))])

    def integral(knot_s: FloatArray) -> FloatArray:
        inside = np.clip(knot_s, times[0], times[-1])
        i = np.clip(np.searchsorted(times, inside, side="right") - 1, 0, len(times) - 2)
        dt = inside - times[i]
        slope = (y[i + 1] - y[i]) / (times[i + 1] - times[i])
        held = np.where(knot_s < times[0], y[0], y[-1]) * (knot_s - inside)
        return np.asarray(total[i] + dt * (y[i] + 0.5 * slope * dt) + held)

    def missing(knot_s: FloatArray) -> BoolArray:
        i = np.clip(np.searchsorted(times, knot_s), 1, len(times) - 1)
        long = times[i] - times[i - 1] > LONGEST_IMU_GAP_S
        outside = (knot_s < times[0] - LONGEST_IMU_GAP_S) | (knot_s > times[-1] + LONGEST_IMU_GAP_S)
        return np.asarray(long | outside)

    return integral, missing


def _from_speed(t: FloatArray, speed: FloatArray) -> FloatArray:
    """Return a longitudinal acceleration [N] from the speed, for logs without an accelerometer."""
    good = np.isfinite(speed)
    if good.sum() < 3:
        return np.zeros(len(t))
    smooth = np.convolve(np.pad(np.interp(t, t[good], speed[good]), 2, mode="edge"), np.full(5, 0.2), "valid")
    return np.asarray(np.gradient(smooth, t))


def _speed(t: FloatArray, speed: FloatArray, knot_s: FloatArray) -> FloatArray:
    """Return the speed at the knots [K], NaN if no sample is within a knot."""
    good = np.isfinite(speed)
    if not good.any():
        return np.full(len(knot_s), np.nan)
    times = t[good]
    after = np.searchsorted(times, knot_s)
    to_next, to_last = times[np.minimum(after, len(times) - 1)] - knot_s, times[np.maximum(after - 1, 0)] - knot_s
    near = np.minimum(np.abs(to_next), np.abs(to_last))
    return np.where(near < 1.2 / RATE_HZ, np.interp(knot_s, times, speed[good]), np.nan)


def _add_gnss(rows: FloatArray, signals: Signals, knot_s: FloatArray) -> None:
    """Assign each new GNSS velocity to its nearest knot with its time offset; the last one of several."""
    velocity = signals.gnss_velocity_m_s
    good = np.flatnonzero(np.isfinite(velocity).all(axis=1))
    if not good.size:
        return
    new = np.ones(len(good), dtype=np.bool_)
    new[1:] = (velocity[good[1:]] != velocity[good[:-1]]).any(axis=1)
    good = good[new]
    t = (signals.stamps_ns[good] - signals.stamps_ns[0]) * S_PER_NS
    k = np.minimum(np.rint(t * RATE_HZ).astype(np.int64), len(knot_s) - 1)
    rows[k, s.GNSS_EAST], rows[k, s.GNSS_NORTH] = velocity[good].T
    rows[k, s.GNSS_OFFSET] = t - knot_s[k]
    acceleration = np.hypot(rows[k, s.AX], rows[k, s.AY])
    stated = np.nan_to_num(signals.gnss_velocity_std_m_s[good])
    white = np.hypot(np.maximum(stated, GNSS_STD_M_S), GNSS_LAG_S * acceleration)
    rows[k, s.GNSS_STD] = np.hypot(white, ROLL_ARM_M * rows[k, s.ROLL_RATE])
