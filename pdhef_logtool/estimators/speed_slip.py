"""Wheel slip: speed samples of spinning or locked wheels, rejected by comparison with the accelerometer.

The excess of a sample is the change of the measured speed beyond ∫(a_x + b) dt; b is the learned slow part of the
excess (grade, pitch, bias). Two cumulative sums (Page 1954), one for each sign, add the excess beyond an allowance of
``CONTRADICTION_M_S2`` plus the part of v̇_x = a_x + v_y r that a turn may cause. A sum above a bound that noise does not
reach, at two consecutive samples, is wheel slip; it began at the sum's last zero. From the speed at that time, a_x is
integrated to v̂ (docs/method.md#wheel-slip). While slip lasts,

- the reading nearest to v̂ within a tolerance is accepted: the speed itself, or the mean wheel speed of an axle where
  the log has them (with two spinning driven wheels the median of four is half wrong). v̂ follows it;
- without such a reading the sample is missing. For as long as wrong samples were accepted before the detection, v̂
  replaces them: otherwise the filter would keep their effect.

Slip ends when the speed has agreed with v̂ for a while, or after a timeout without an accepted reading; v̂ is then no
better than the speed, and the check is suspended. Locked wheels on a decelerating car have no timeout. At a standstill
the sensor reads zero, and below some speed there are no pulses: steps into and out of that range are not counted. A
recovery is no slip either: the speed of spinning wheels falls while the car accelerates.
"""

import math
from dataclasses import replace

import numpy as np

from pdhef_logtool.car.vehicle import Sensors
from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.records.readings import without_impossible
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.records.steps import RESTART_GAP_S

#: Allowed difference between the change of speed and the accelerometer; no hill is steeper.
CONTRADICTION_M_S2 = 3.0
#: Largest |v_y| / v_x for the allowance v_y r in v̇_x: of a drifting car it exceeds the limit above.
TURN_SHARE = 1.5
#: Bound of the cumulative sums, in standard deviations of the speed sensor, and its smallest value.
BOUND_SIGMAS, LEAST_BOUND_M_S = 6.0, 0.4
#: Consecutive samples beyond the bound; a single one is an outlier.
ALARM_SAMPLES = 2
#: Time constant and limit of b.
BIAS_S, MAX_BIAS_M_S2 = 3.0, 2.5
#: A reading within the bound of v̂ is accepted; without one the tolerance grows at this rate, and by this share of
#: |r| v_x.
DRIFT_M_S2, TURN_DRIFT_SHARE = 0.3, 1.0
#: Time constant with which v̂ follows accepted readings.
FOLLOW_S = 0.3
#: Duration of agreement after which slip ends.
RELEASE_S = 0.2
#: Timeout without an accepted reading, and the time for which the check is then suspended.
TIMEOUT_S, HEED_AGAIN_S = 5.0, 30.0
#: Wheels lock if the smoothed deceleration exceeds this, and spin otherwise; in the other cases they recover from slip
#: that grew too slowly to be detected.
BRAKING_M_S2, BRAKING_SMOOTHING_S = 0.5, 0.1
#: Locked wheels do not time out above this v̂.
LOCKED_SPEED_M_S = 1.0

# Entries of the memory. Last samples of speed, a_x, yaw rate; since the last speed sample: time, integral of a_x,
# allowance; time since a_x.
(_STARTED, _SPEED, _AX, _HAS_AX, _RATE, _SPAN, _EXPECTED, _ALLOWED, _AX_AGE, _BIAS) = range(10)
# The sums: value, dead-reckoned speed and time since the last zero, b at that time, samples beyond the bound.
_UP, _DOWN = 10, 15
_SUM, _FROM, _SINCE, _LEARNT, _BEYOND = range(5)
# While slip lasts: flag, v̂, tolerance beyond the bound, time of agreement, time alone, time to put v̂ in place.
(_SLIPS, _V, _GROWTH, _AGREED, _ALONE, _REPAIR, _NOT_HEEDED) = range(20, 27)
# a_x, smoothed.
_SLOW_AX = 27
_MEMORY = 28


@njit(cache=True)
def _forget(m):  # type: ignore[no-untyped-def]
    """Reset the sums to the last speed sample."""
    for s in (_UP, _DOWN):
        m[s + _SUM] = 0.0
        m[s + _FROM] = m[_SPEED]
        m[s + _SINCE] = 0.0
        m[s + _LEARNT] = m[_BIAS]
        m[s + _BEYOND] = 0.0


@njit(cache=True)
def _gather(m, s, excess, z, bound):  # type: ignore[no-untyped-def]
    """Add an excess to a sum; return whether it indicates slip."""
    m[s + _SUM] += excess
    if m[s + _SUM] <= 0.0:
        m[s + _SUM] = 0.0
        m[s + _FROM] = z
        m[s + _SINCE] = 0.0
        m[s + _LEARNT] = m[_BIAS]
    m[s + _BEYOND] = m[s + _BEYOND] + 1.0 if m[s + _SUM] > bound else 0.0
    return m[s + _BEYOND] >= ALARM_SAMPLES


@njit(cache=True)
def _onward(v, change):  # type: ignore[no-untyped-def]
    """Return a speed after a change, without a change of sign: wheel slip does not reverse the car."""
    return max(0.0, v + change) if v >= 0.0 else min(0.0, v + change)


@njit(cache=True)
def _axle(wheels, first):  # type: ignore[no-untyped-def]
    return 0.5 * (wheels[first] + wheels[first + 1])


@njit(cache=True)
def _brakes(m):  # type: ignore[no-untyped-def]
    return m[_SLOW_AX] + m[_BIAS] < -BRAKING_M_S2


@njit(cache=True)
def _start(v, wheels, bound, spins):  # type: ignore[no-untyped-def]
    """Return v̂ at an alarm: the dead-reckoned speed, or the speed of the axle with less slip if it shows more slip.

    Slip that grew slowly at first has changed the speed before the sum began to grow.
    """
    front, rear = _axle(wheels, 0), _axle(wheels, 2)
    if spins and min(front, rear) < v - bound:
        return min(front, rear)
    if not spins and max(front, rear) > v + bound:
        return max(front, rear)
    return v


@njit(cache=True)
def _while_slipping(m, z, wheels, bound, zero):  # type: ignore[no-untyped-def]
    """Process a sample during slip; return the accepted speed, NaN for none."""
    v, span = m[_V], m[_SPAN]
    tolerance = bound + m[_GROWTH]
    agrees = abs(z - v) <= tolerance
    m[_AGREED] = m[_AGREED] + span if agrees else 0.0
    believed = z if agrees else math.nan
    distance = abs(z - v) if agrees else tolerance
    for first in (0, 2):
        axle = _axle(wheels, first)
        if abs(axle - v) < distance:
            believed, distance = axle, abs(axle - v)
    if math.isfinite(believed):
        keep = math.exp(-span / FOLLOW_S)
        m[_V] = believed + keep * (v - believed)
        m[_GROWTH] *= keep
        m[_ALONE] = 0.0
    else:
        m[_ALONE] += span
    locked = abs(z) < zero and v > LOCKED_SPEED_M_S and _brakes(m)
    if m[_ALONE] > TIMEOUT_S and not locked:
        m[_SLIPS] = 0.0
        m[_NOT_HEEDED] = HEED_AGAIN_S
        return z
    if m[_AGREED] >= RELEASE_S:
        m[_SLIPS] = 0.0
    return believed


@njit(cache=True)
def _gate(window, sensor, m, believed, reckoned):  # type: ignore[no-untyped-def]
    """Process one window; ``dt[k]`` ends at step k, NaN = start. Returns whether any sample changed.

    ``believed`` [N] is the speed for filters, ``reckoned`` [N] that with v̂ in place of missing samples.
    """
    dt, ax, yaw_rate, speed, wheels = window
    bound, zero, least = sensor
    changed = False
    for k in range(dt.shape[0]):
        if not dt[k] <= RESTART_GAP_S:
            m[:] = 0.0
        step = dt[k] if m[_STARTED] > 0.0 else 0.0
        has_ax = math.isfinite(ax[k])
        if math.isfinite(yaw_rate[k]):
            m[_RATE] = yaw_rate[k]
        # As in the filters: the mean of both ends of the step, or the finite one.
        a = m[_AX] if not has_ax else ax[k] if m[_HAS_AX] == 0.0 else 0.5 * (m[_AX] + ax[k])
        ax_is_known = has_ax or m[_HAS_AX] > 0.0
        m[_HAS_AX] = 1.0 if has_ax else 0.0
        if has_ax:
            m[_AX] = ax[k]
            m[_SLOW_AX] += (1.0 - math.exp(-step / BRAKING_SMOOTHING_S)) * (ax[k] - m[_SLOW_AX])
            m[_AX_AGE] = 0.0
        else:
            m[_AX_AGE] += step
        if step > 0.0:
            m[_NOT_HEEDED] = max(0.0, m[_NOT_HEEDED] - step)
            change = (a + m[_BIAS]) * step
            turning = abs(m[_RATE] * (m[_V] if m[_SLIPS] > 0.0 else m[_SPEED])) * step
            m[_SPAN] += step
            m[_EXPECTED] += change
            m[_ALLOWED] += CONTRADICTION_M_S2 * step + TURN_SHARE * turning
            for s in (_UP, _DOWN):
                m[s + _FROM] = _onward(m[s + _FROM], change)
                m[s + _SINCE] += step
            if m[_SLIPS] > 0.0:
                m[_V] = _onward(m[_V], change)
                m[_GROWTH] += DRIFT_M_S2 * step + TURN_DRIFT_SHARE * turning
                m[_REPAIR] = max(0.0, m[_REPAIR] - step)
            if m[_AX_AGE] > RESTART_GAP_S or m[_SPAN] > RESTART_GAP_S:
                m[_SLIPS] = 0.0
                m[_STARTED] = 0.0
        z = speed[k]
        believed[k] = reckoned[k] = z
        if not math.isfinite(z):
            continue
        if m[_STARTED] == 0.0:
            if ax_is_known:
                m[_STARTED] = 1.0
                m[_SPEED] = z
                m[_NOT_HEEDED] = RELEASE_S  # the first sample may be an outlier
                _forget(m)
        elif m[_SLIPS] > 0.0:
            believed[k] = _while_slipping(m, z, wheels[k], bound, zero)
            reckoned[k] = believed[k]
            if not math.isfinite(believed[k]):
                reckoned[k] = m[_V]
                if m[_REPAIR] > 0.0:
                    believed[k] = m[_V]
            changed = changed or believed[k] != z
            if m[_SLIPS] == 0.0:
                m[_SPEED] = z
                _forget(m)
        else:
            excess = z - m[_SPEED] - m[_EXPECTED]
            quiet = max(m[_UP + _SUM], m[_DOWN + _SUM]) < 0.5 * bound
            if quiet:
                m[_BIAS] = min(MAX_BIAS_M_S2, max(-MAX_BIAS_M_S2, m[_BIAS] + excess / BIAS_S))
            low, high = min(abs(z), abs(m[_SPEED])), max(abs(z), abs(m[_SPEED]))
            m[_SPEED] = z
            if (low < zero and high <= least) or m[_NOT_HEEDED] > 0.0:
                _forget(m)
            else:
                alone = m[_UP + _BEYOND] + m[_DOWN + _BEYOND] == 1.0
                up = _gather(m, _UP, excess - m[_ALLOWED], z, bound)
                down = _gather(m, _DOWN, -excess - m[_ALLOWED], z, bound)
                if (up or down) and up == _brakes(m):  # a recovery
                    _forget(m)
                elif alone and not (up or down):
                    _forget(m)  # a single outlier: its return is no slip
                elif up or down:
                    s = _UP if up else _DOWN
                    m[_SLIPS] = 1.0
                    m[_BIAS] = m[s + _LEARNT]
                    m[_V] = _start(m[s + _FROM], wheels[k], bound, up)
                    m[_REPAIR] = m[s + _SINCE]
                    m[_GROWTH] = m[_AGREED] = m[_ALONE] = 0.0
                    believed[k] = reckoned[k] = m[_V]
                    changed = True
        m[_SPAN] = m[_EXPECTED] = m[_ALLOWED] = 0.0
    return changed


def believable(
    signals: Signals, sensors: Sensors, memory: FloatArray | None, *, reckoned: bool = False
) -> tuple[Signals, FloatArray]:
    """Return the signals without impossible readings and without the speed samples of slipping wheels, and the memory.

    The same object if nothing is removed. Causal: step k depends on samples up to k. Joined windows give the same bits
    as one call over the whole log.

    Parameters
    ----------
    sensors : profile of the speed sensor. memory : after the previous window; None at the start of a log.
    reckoned : replace missing samples by the dead-reckoned speed, for estimators that need one.
    """
    signals = without_impossible(signals)
    memory = np.zeros(_MEMORY) if memory is None else memory.copy()
    believed, with_reckoned = np.empty(len(signals)), np.empty(len(signals))
    window = (signals.steps_s, signals.ax_m_s2, signals.yaw_rate_rad_s, signals.speed_m_s, signals.wheel_speed_m_s)
    bound = max(LEAST_BOUND_M_S, BOUND_SIGMAS * sensors.speed_std_m_s)
    limits = (bound, sensors.speed_zero_m_s, sensors.speed_least_m_s)
    if _gate(window, limits, memory, believed, with_reckoned):
        signals = replace(signals, speed_m_s=with_reckoned if reckoned else believed)
    return signals, memory
