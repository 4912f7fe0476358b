"""Sensors whose stamps are late against one another, told without truth.

No sensor shows a motion before it happens: of two that must go together the later one is late, by at least what sound
cars do not have between them. Only what the rear wheels turn apart goes with the gyro at once; sideslip, pitch and the
car's own answer stand between the others, which can be late by much before that shows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pdhef_logtool.drive.correlation import has_peak_within, on_common_grid
from pdhef_logtool.drive.truth import differentiate, estimate_truth_latency
from pdhef_logtool.records.signals import WHEELS, Channel, FloatArray

#: How late the second of two sound signals is after the first, s. On simulated and recorded drives wheels are -10 to
#: 24 ms after the gyro, a_y 0 to 132 after v r, v-dot -121 to 11 after a_x, the yaw rate 16 to 152 after the steering.
WHEELS_AFTER_GYRO_S = (-0.045, 0.06)
A_Y_AFTER_TURNING_S = (-0.3, 0.22)
SPEED_AFTER_A_X_S = (-0.2, 0.12)
YAW_RATE_AFTER_STEERING_S = (-0.02, 0.45)
#: A shift must be known to this, and be beyond the range by so many of its standard errors.
KNOWN_TO_S, SURE = 0.015, 4.0
#: Where the car slides, wheels and gyro go apart; what goes together less than this tells no delay. Of exact ones more.
LEAST_CORRELATION = (0.9, 0.95)
#: Another peak of this share of the highest may as well be the right one.
AS_HIGH = 0.8
#: Both sides are averaged over as long, which shifts neither; no derivative spans more.
SMOOTH_S = 0.1
DERIVATIVE_S = 0.15
#: What is left of both is thinned to this; a parabola finds the peak between.
THIN_S = 0.04
LONGEST_STEP_S = 0.3


@dataclass(frozen=True, slots=True)
class LateSensor:
    """Signals of one sensor whose stamps are late against another's: by ``delay_s``, or more unless it is ``exact``."""

    names: tuple[str, ...]
    delay_s: float
    exact: bool
    evidence: str


def late_sensors(signals: Mapping[str, Channel]) -> tuple[LateSensor, ...]:
    """Return the sensors that are late against others, and nothing that two of them could not tell."""
    found: dict[str, LateSensor] = {}
    for text, first, second, names, (low, high), exact in _pairs(signals):
        if min(len(first), len(second)) < 2:
            continue
        one, other = _averaged(first), _averaged(second)
        shift = estimate_truth_latency(one, other, max_error_s=KNOWN_TO_S)
        margin = SURE * shift.std_error_s
        if not shift.reliable or shift.correlation < LEAST_CORRELATION[exact]:
            continue
        if low - margin <= shift.latency_s <= high + margin:
            continue
        # A sine goes with itself a period later as well.
        grid = on_common_grid(one.stamps_ns, one.values, other.stamps_ns, other.values)
        if has_peak_within(grid, low, high, AS_HIGH * shift.correlation):
            continue
        name = names[0] if shift.latency_s < low else names[1]
        beyond_s = low - shift.latency_s if shift.latency_s < low else shift.latency_s - high
        evidence = (
            f"{text} by {shift.latency_s * 1e3:.0f} +- {shift.std_error_s * 1e3:.0f} ms where {low * 1e3:.0f} to "
            f"{high * 1e3:.0f} are plausible"
        )
        delay_s = abs(shift.latency_s) if exact else beyond_s
        found.setdefault(_sensor(name), LateSensor(_together(name, signals), delay_s, exact, evidence))
    return tuple(found.values())


def _sensor(name: str) -> str:
    return "wheels" if name.startswith("wheel_speed_") else name


def _together(name: str, signals: Mapping[str, Channel]) -> tuple[str, ...]:
    """Return the signal alone, or all wheels where it is one of them."""
    return tuple(n for n in signals if n == name or (n.startswith("wheel_speed_") and _sensor(name) == "wheels"))


_Pair = tuple[str, Channel, Channel, tuple[str, str], tuple[float, float], bool]


def _pairs(signals: Mapping[str, Channel]) -> list[_Pair]:
    """Return what must go together: words, both sides, their signals, how late the second may be, if it is exact."""
    found: list[_Pair] = []
    gyro = signals.get("yaw_rate_rad_s")
    wheels = [signals[n] for u in ("m_s", "rad_s") for w in WHEELS if (n := f"wheel_speed_{w}_{u}") in signals]
    speed = signals.get("speed_m_s") or (wheels[-1] if wheels else None)
    for unit in ("m_s", "rad_s"):
        left, right = (signals.get(f"wheel_speed_r{side}_{unit}") for side in "lr")
        if gyro is None or left is None or right is None or not len(left) or not len(right):
            continue
        apart = replace(left, values=_at(right, left) - left.values)
        text = "what the rear wheels turn apart follows the yaw rate"
        found.append((text, gyro, apart, (gyro.name, left.name), WHEELS_AFTER_GYRO_S, True))
    if speed is None or len(speed) < 2:
        return found
    ax, ay = signals.get("ax_m_s2"), signals.get("ay_m_s2")
    steer = signals.get("steer_rad") or signals.get("steering_wheel_rad")
    if ax is not None:
        text = f"the derivative of {speed.name} follows ax_m_s2"
        found.append((text, ax, _derivative(_averaged(speed)), ("ax_m_s2", speed.name), SPEED_AFTER_A_X_S, False))
    if gyro is not None and len(gyro) and ay is not None:
        turning = replace(gyro, values=gyro.values * _at(speed, gyro))
        text = "ay_m_s2 follows yaw_rate_rad_s x speed"
        found.append((text, turning, ay, (gyro.name, "ay_m_s2"), A_Y_AFTER_TURNING_S, False))
    if gyro is not None and steer is not None and len(steer):
        asked = replace(steer, values=steer.values * _at(speed, steer))
        text = f"yaw_rate_rad_s follows {steer.name} x speed"
        found.append((text, asked, gyro, (steer.name, gyro.name), YAW_RATE_AFTER_STEERING_S, False))
    return found


def _at(channel: Channel, other: Channel) -> FloatArray:
    return np.interp(other.stamps_ns, channel.stamps_ns, channel.values)


def _period_s(channel: Channel) -> float:
    return max(float(np.median(np.diff(channel.stamps_ns))) * 1e-9, 1e-4) if len(channel) > 1 else 1.0


def _derivative(channel: Channel) -> Channel:
    half = max(2, round(DERIVATIVE_S / _period_s(channel)))
    values = differentiate(channel.stamps_ns, channel.values, half, round(LONGEST_STEP_S * 1e9))
    known = np.isfinite(values)
    return replace(channel, values=values).take(known)


def _averaged(channel: Channel) -> Channel:
    half = round(SMOOTH_S / _period_s(channel))
    count = 2 * half + 1
    if half == 0 or len(channel) < 2 * count:
        return channel
    mean = np.convolve(channel.values, np.full(count, 1.0 / count), "valid")
    thin = max(1, int(THIN_S / _period_s(channel)))
    inside = slice(half, len(channel) - half)
    return replace(channel.take(inside), values=mean).take(slice(None, None, thin))
