"""Sensors with late time stamps relative to one another, detected without ground truth.

No sensor shows a motion before it happens. Of two sensors that follow one motion, the later one is late if their shift
is larger than for correct sensors. Only the difference of the rear wheel speeds follows the gyro without a delay. Other
pairs also differ by sideslip, pitch and the vehicle's response; they detect only large delays.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pdhef_logtool.drive.correlation import has_peak_within, on_common_grid
from pdhef_logtool.drive.truth import differentiate, estimate_truth_latency
from pdhef_logtool.records.signals import WHEELS, Channel, FloatArray

#: Plausible delay of the second of two correct signals relative to the first, s. On simulated and recorded drives the
#: delay of the wheels after the gyro is -10 to 24 ms, of a_y after v r 0 to 132 ms, of v-dot after a_x -121 to 11 ms,
#: of the yaw rate after the steering 16 to 152 ms.
WHEELS_AFTER_GYRO_S = (-0.045, 0.06)
A_Y_AFTER_TURNING_S = (-0.3, 0.22)
SPEED_AFTER_A_X_S = (-0.2, 0.12)
YAW_RATE_AFTER_STEERING_S = (-0.02, 0.45)
#: Largest standard error of a shift, and how many standard errors the shift must be outside the plausible range.
MAX_SHIFT_ERROR_S, SURE = 0.015, 4.0
#: Least correlation at the shift: wheels and gyro differ where the car slides. The second value is for exact pairs.
LEAST_CORRELATION = (0.9, 0.95)
#: A peak in the plausible range with this share of the highest correlation may be the right one.
AS_HIGH = 0.8
#: Both sides are averaged over this time, which shifts neither, and differentiated over this half window.
SMOOTH_S = 0.1
DERIVATIVE_S = 0.15
#: The averages are thinned to this step; a parabola refines the peak.
THIN_S = 0.04
LONGEST_STEP_S = 0.3


@dataclass(frozen=True, slots=True)
class LateSensor:
    """Signals of one sensor with late stamps: by ``delay_s``, or by at least ``delay_s`` unless ``exact``."""

    names: tuple[str, ...]
    delay_s: float
    exact: bool
    evidence: str


def late_sensors(signals: Mapping[str, Channel]) -> tuple[LateSensor, ...]:
    """Return the sensors with late stamps; pairs that do not show a delay are ignored."""
    late: dict[str, LateSensor] = {}
    for pair in _pairs(signals):
        first, second = _averaged(pair.first), _averaged(pair.second)
        shift = estimate_truth_latency(first, second, max_error_s=MAX_SHIFT_ERROR_S)
        low, high = pair.plausible_s
        margin = SURE * shift.std_error_s
        is_plausible = low - margin <= shift.latency_s <= high + margin
        if is_plausible or not shift.reliable or shift.correlation < LEAST_CORRELATION[pair.exact]:
            continue
        # A sine also correlates with itself a period later.
        grid = on_common_grid(first.stamps_ns, first.values, second.stamps_ns, second.values)
        if has_peak_within(grid, low, high, AS_HIGH * shift.correlation):
            continue
        name = pair.names[shift.latency_s >= low]
        beyond_s = max(low - shift.latency_s, shift.latency_s - high)
        late_ms, sd_ms, low_ms, high_ms = (1e3 * x for x in (shift.latency_s, shift.std_error_s, low, high))
        evidence = f"{pair.text} by {late_ms:.0f} +- {sd_ms:.0f} ms where {low_ms:.0f} to {high_ms:.0f} are plausible"
        delay_s = abs(shift.latency_s) if pair.exact else beyond_s
        wheels = tuple(n for n in signals if n.startswith("wheel_speed_")) if name.startswith("wheel_speed_") else ()
        sensor = LateSensor(wheels or (name,), delay_s, pair.exact, evidence)
        late.setdefault(sensor.names[0], sensor)
    return tuple(late.values())


class _Pair(NamedTuple):
    """Two signals that follow one motion.

    Attributes
    ----------
    names : name to report if the first or the second signal is late. plausible_s : range of the second's delay, s.
    exact : the vehicle adds no delay between the two.
    """

    text: str
    first: Channel
    second: Channel
    names: tuple[str, str]
    plausible_s: tuple[float, float]
    exact: bool = False


def _pairs(signals: Mapping[str, Channel]) -> Iterator[_Pair]:
    """Yield the pairs of signals that follow one motion."""
    channels = {n: c for n, c in signals.items() if len(c) > 1}
    gyro, ax, ay = (channels.get(n) for n in ("yaw_rate_rad_s", "ax_m_s2", "ay_m_s2"))
    wheels = [c for u in ("m_s", "rad_s") for w in WHEELS if (c := channels.get(f"wheel_speed_{w}_{u}"))]
    for unit in ("m_s", "rad_s"):
        left, right = (channels.get(f"wheel_speed_r{side}_{unit}") for side in "lr")
        if gyro and left and right:
            difference = replace(left, values=_sampled(right, left) - left.values)
            text = "the difference of the rear wheel speeds follows the yaw rate"
            yield _Pair(text, gyro, difference, (gyro.name, left.name), WHEELS_AFTER_GYRO_S, exact=True)
    speed = channels.get("speed_m_s") or (wheels[-1] if wheels else None)
    if speed is None:
        return
    if ax:
        text = f"the derivative of {speed.name} follows ax_m_s2"
        yield _Pair(text, ax, _derivative(_averaged(speed)), ("ax_m_s2", speed.name), SPEED_AFTER_A_X_S)
    if gyro and ay:
        text = "ay_m_s2 follows yaw_rate_rad_s x speed"
        yield _Pair(text, _times(gyro, speed), ay, (gyro.name, "ay_m_s2"), A_Y_AFTER_TURNING_S)
    steer = channels.get("steer_rad") or channels.get("steering_wheel_rad")
    if gyro and steer:
        text = f"yaw_rate_rad_s follows {steer.name} x speed"
        yield _Pair(text, _times(steer, speed), gyro, (steer.name, gyro.name), YAW_RATE_AFTER_STEERING_S)


def _times(channel: Channel, speed: Channel) -> Channel:
    return replace(channel, values=channel.values * _sampled(speed, channel))


def _sampled(channel: Channel, other: Channel) -> FloatArray:
    return np.interp(other.stamps_ns, channel.stamps_ns, channel.values)


def _period_s(channel: Channel) -> float:
    return max(float(np.median(np.diff(channel.stamps_ns))) * 1e-9, 1e-4) if len(channel) > 1 else 1.0


def _derivative(channel: Channel) -> Channel:
    half = max(2, round(DERIVATIVE_S / _period_s(channel)))
    values = differentiate(channel.stamps_ns, channel.values, half, round(LONGEST_STEP_S * 1e9))
    return replace(channel, values=values).take(np.isfinite(values))


def _averaged(channel: Channel) -> Channel:
    half = round(SMOOTH_S / _period_s(channel))
    count = 2 * half + 1
    if half == 0 or len(channel) < 2 * count:
        return channel
    mean = np.convolve(channel.values, np.full(count, 1.0 / count), "valid")
    thin = max(1, int(THIN_S / _period_s(channel)))
    inside = slice(half, len(channel) - half)
    return replace(channel.take(inside), values=mean).take(slice(None, None, thin))
