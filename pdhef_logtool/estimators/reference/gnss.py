"""GNSS for the sideslip reference: its plausibility, its delay, its multipath errors, and a first estimate."""

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.estimators import kinematic_filter as s
from pdhef_logtool.estimators.reference.inputs import RATE_HZ
from pdhef_logtool.records.signals import LEAST_DIVISOR, BoolArray, FloatArray, IntArray

ComplexArray: TypeAlias = NDArray[np.complex128]

#: Minimum speed for a course.
LEAST_COURSE_SPEED_M_S = 3.0
#: Interval for changes of GNSS and IMU velocity, and the change below which they may differ.
CHANGE_S, LEAST_CHANGE_M_S = 0.5, 0.5
#: Uncertainty of the axle law up to which the course equals the heading within some degrees.
COURSE_LAW_RAD = math.radians(1.5)
#: Jump of GNSS velocity against the IMU in one interval, m/s, that is rejected if a jump back follows within this time.
JUMP_M_S, JUMP_BACK_S = 0.3, 60.0
#: Candidate delays of GNSS; cost ratio to no delay below which a delay is accepted; time of an unknown heading.
DELAYS_S = tuple(round(0.02 * i, 2) for i in range(-5, 31))
CLEAR_COST, HEADING_WINDOW_S = 0.7, 20.0
#: Smaller delays are left to the smoother. Half of the averaging window of a course.
SMALL_DELAY_S, COURSE_S = 0.06, 10.0
#: Difference from GNSS above which a wheel is locked, spinning or dragged sideways.
WHEEL_ERROR_M_S = 2.0


def _sampled(rows: FloatArray) -> IntArray:
    """Return the knots [M] with a GNSS velocity."""
    return np.flatnonzero(np.isfinite(rows[:, s.GNSS_EAST]))


def _distance(sampled: IntArray, k: IntArray) -> IntArray:
    """Return the distance of knots [K] from the nearest of ``sampled`` [M]."""
    after = np.minimum(np.searchsorted(sampled, k), sampled.size - 1)
    before = np.maximum(after - 1, 0)
    return np.asarray(np.minimum(np.abs(sampled[after] - k), np.abs(sampled[before] - k)), dtype=np.int64)


def with_gnss_speed(rows: FloatArray) -> FloatArray:
    """Return the inputs without speeds that are GNSS speeds, and with a larger uncertainty where GNSS differs.

    The speed of locked, spinning or sideways rolling wheels differs from GNSS.
    """
    aided = rows.copy()
    aided[aided[:, s.LENGTH] > 0.0, s.SPEED] = np.nan
    sampled = _sampled(rows)
    over_ground = np.hypot(rows[sampled, s.GNSS_EAST], rows[sampled, s.GNSS_NORTH])
    k = np.arange(len(rows))
    difference = np.abs(rows[:, s.SPEED]) - np.interp(k, sampled, over_ground)
    apart = np.max(np.abs([np.interp(k + i, k, difference) for i in (-2, 0, 2)]), axis=0)
    near = _distance(sampled, k) < RATE_HZ
    aided[near & (apart > WHEEL_ERROR_M_S), s.SPEED] = np.nan
    aided[:, s.SPEED_STD] = np.where(near, np.hypot(rows[:, s.SPEED_STD], apart), rows[:, s.SPEED_STD])
    return aided


def first_guess(rows: FloatArray, alone: FloatArray) -> FloatArray:
    """Return v_x, v_y and heading [K, 3] by GNSS, gyro and course; without GNSS, the states ``alone``.

    The heading is the integrated gyro, rotated to the course in low-slip intervals. ``alone`` [K, n]: states without
    GNSS.
    """
    k = np.arange(len(rows))
    gyro = np.cumsum(rows[:, s.MEAN_YAW_RATE] - alone[:, s.YAW_RATE_BIAS]) / RATE_HZ
    sampled = _sampled(rows)
    velocity = rows[sampled, s.GNSS_EAST] + 1j * rows[sampled, s.GNSS_NORTH]
    rolls = sampled[rolls_freely(rows)[sampled]]
    rolls = rolls if rolls.size else sampled
    course = np.angle(np.interp(rolls, sampled, velocity)) - gyro[rolls]
    around = np.cumsum(np.concatenate([[0.0], np.exp(1j * course)]))
    n = max(1, round(COURSE_S * RATE_HZ / max(1.0, float(np.median(np.diff(rolls))) if rolls.size > 1 else 1.0)))
    i = np.arange(rolls.size)
    offset = np.unwrap(np.angle(around[np.minimum(i + n, rolls.size)] - around[np.maximum(i - n, 0)]))
    heading = gyro + np.interp(k, rolls, offset)
    body = np.interp(k, sampled, velocity) * np.exp(-1j * heading)
    near = _distance(sampled, k) <= RATE_HZ
    vx, vy = np.where(near, body.real, alone[:, s.VX]), np.where(near, body.imag, alone[:, s.VY])
    return np.stack([vx, vy, heading], axis=1)


def rolls_freely(rows: FloatArray) -> BoolArray:
    """Return the mask [K] of forward motion with little slip, where course and heading differ by a few degrees only.

    Wheel speeds, if available, must agree with GNSS, which excludes sideways motion.
    """
    over_ground = np.hypot(rows[:, s.GNSS_EAST], rows[:, s.GNSS_NORTH])
    rolls = (over_ground > LEAST_COURSE_SPEED_M_S) & (rows[:, s.LAW_STD] > 0.0) & (rows[:, s.LAW_STD] < COURSE_LAW_RAD)
    return rolls & ~(np.abs(rows[:, s.SPEED] - over_ground) > WHEEL_ERROR_M_S)


def gnss_follows_imu(rows: FloatArray) -> bool:
    """Return whether changes of GNSS velocity match the IMU; they do not if axes are exchanged or in the body frame.

    Without significant accelerations the result is True.
    """
    sampled = _sampled(rows)
    sampled = sampled[np.diff(sampled // round(CHANGE_S * RATE_HZ), prepend=-1) > 0]
    if sampled.size < 3:
        return False
    by_gnss, by_imu = increments(rows, sampled, 0.0)
    changes = np.abs(by_imu) >= min(np.median(np.abs(by_imu)), LEAST_CHANGE_M_S)
    typical = max(float(np.median(np.abs(by_imu[changes]))), LEAST_CHANGE_M_S)
    return float(np.median(np.abs(by_gnss - by_imu)[changes])) < 0.5 * typical


def increments(rows: FloatArray, sampled: IntArray, delay_s: float) -> tuple[ComplexArray, ComplexArray]:
    """Return the changes of velocity between GNSS samples [M − 1], east + i north: of GNSS, and of the IMU.

    ``sampled`` [M]: knots with a sample; its velocity is ``delay_s`` old. The unknown heading of the IMU is replaced by
    the slowly varying rotation with the best fit.
    """
    heading = np.cumsum(rows[:, s.MEAN_YAW_RATE]) / RATE_HZ
    turned = np.exp(1j * (heading - 0.5 * rows[:, s.MEAN_YAW_RATE] / RATE_HZ))
    velocity = np.cumsum((rows[:, s.MEAN_AX] + 1j * rows[:, s.MEAN_AY]) * turned) / RATE_HZ
    place = sampled + (rows[sampled, s.GNSS_OFFSET] - delay_s) * RATE_HZ
    by_imu = np.diff(np.interp(place, np.arange(len(rows)), velocity))
    by_gnss = np.diff(rows[sampled, s.GNSS_EAST] + 1j * rows[sampled, s.GNSS_NORTH])
    n = round(HEADING_WINDOW_S * RATE_HZ / max(1.0, float(np.median(np.diff(sampled)))))
    largest = 2.0 * np.median(np.abs(by_gnss)) + 0.1
    products = by_gnss * np.conj(by_imu) * np.minimum(1.0, largest / np.maximum(np.abs(by_gnss), LEAST_DIVISOR)) ** 2
    sums = np.cumsum(np.concatenate([[0.0], products]))
    k = np.arange(len(products))
    around = sums[np.minimum(k + n, len(products))] - sums[np.maximum(k - n, 0)]
    return by_gnss, by_imu * np.exp(1j * np.angle(around))


def scanned_delay(rows: FloatArray) -> float:
    """Return the delay of GNSS velocity in s for which changes of GNSS and IMU velocity match best."""
    sampled = _sampled(rows)
    if sampled.size < 8:
        return 0.0
    costs = []
    for delay_s in DELAYS_S:
        by_gnss, by_imu = increments(rows, sampled, delay_s)
        costs.append(float(np.minimum(np.abs(by_gnss - by_imu) ** 2, JUMP_M_S**2).sum()))
    zero = costs[DELAYS_S.index(0.0)]
    best = int(np.argmin(costs))
    return DELAYS_S[best] if costs[best] < CLEAR_COST * zero and abs(DELAYS_S[best]) > SMALL_DELAY_S else 0.0


def without_jumps(rows: FloatArray) -> FloatArray:
    """Return the inputs without GNSS velocities between a jump against the IMU and a jump back (multipath)."""
    sampled = _sampled(rows)
    if sampled.size < 3:
        return rows
    by_gnss, by_imu = increments(rows, sampled, 0.0)
    jump = by_gnss - by_imu
    limit = JUMP_M_S + 0.02 * np.hypot(rows[sampled[1:], s.AX], rows[sampled[1:], s.AY])
    limit += 0.5 * np.diff(sampled) / RATE_HZ
    limit += np.abs(np.diff(rows[sampled, s.YAW_RATE])) + np.abs(np.diff(rows[sampled, s.ROLL_RATE]))
    candidates = np.flatnonzero(np.abs(jump) > limit)
    rejected = np.zeros(sampled.size, dtype=np.bool_)
    for i, first in enumerate(candidates):
        if rejected[first + 1]:
            continue
        back = [c for c in candidates[i + 1 :] if (sampled[c] - sampled[first]) <= JUMP_BACK_S * RATE_HZ]
        pair = next((c for c in back if abs(jump[c] + jump[first]) < 0.5 * abs(jump[first])), None)
        if pair is not None:
            rejected[first + 1 : pair + 1] = True
    cleaned = rows.copy()
    cleaned[sampled[rejected], s.GNSS_EAST] = np.nan
    return cleaned
