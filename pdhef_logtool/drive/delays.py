"""Sensors with late time stamps relative to one another, detected without ground truth.

No sensor shows a motion before it happens. Of two sensors that follow one motion, the later one is late if their shift
is larger than for correct sensors. Only the difference of the rear wheel speeds follows the gyro without a delay. Other
pairs also differ by sideslip, pitch and the vehicle's response; they detect only large delays.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from pdhef_logtool.drive.columns import GRID_S, columns_on_grid, derivative
from pdhef_logtool.drive.correlation import CommonGrid, find_shift, has_peak_within, shift_error, without_trend
from pdhef_logtool.drive.truth import MAX_LATENCY_S
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
    for pair in _pairs(columns_on_grid(signals)):
        grid = CommonGrid(GRID_S, without_trend(pair.first), without_trend(pair.second))
        shift, (low, high) = find_shift(grid, MAX_LATENCY_S), pair.plausible_s
        if not shift.inside or shift.correlation < LEAST_CORRELATION[pair.exact]:
            continue
        error_s = shift_error(grid, shift.shift_s)
        beyond_s = max(low - shift.shift_s, shift.shift_s - high)
        # A sine also correlates with itself a period later.
        if error_s > min(MAX_SHIFT_ERROR_S, beyond_s / SURE) or has_peak_within(
            grid, low, high, AS_HIGH * shift.correlation
        ):
            continue
        name = pair.names[shift.shift_s >= low]
        late_ms, sd_ms, low_ms, high_ms = (1e3 * x for x in (shift.shift_s, error_s, low, high))
        evidence = f"{pair.text} by {late_ms:.0f} +- {sd_ms:.0f} ms where {low_ms:.0f} to {high_ms:.0f} are plausible"
        delay_s = abs(shift.shift_s) if pair.exact else beyond_s
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
    first: FloatArray
    second: FloatArray
    names: tuple[str, str]
    plausible_s: tuple[float, float]
    exact: bool = False


def _pairs(columns: Mapping[str, FloatArray]) -> Iterator[_Pair]:
    """Yield the pairs of columns that follow one motion."""
    gyro, ax, ay = (columns.get(n) for n in ("yaw_rate_rad_s", "ax_m_s2", "ay_m_s2"))
    for unit in ("m_s", "rad_s"):
        names = [f"wheel_speed_r{side}_{unit}" for side in "lr"]
        if gyro is not None and columns.keys() >= {*names}:
            text = "the difference of the rear wheel speeds follows the yaw rate"
            difference = columns[names[1]] - columns[names[0]]
            yield _Pair(text, gyro, difference, ("yaw_rate_rad_s", names[0]), WHEELS_AFTER_GYRO_S, exact=True)
    wheels = [n for u in ("rad_s", "m_s") for w in WHEELS[::-1] if (n := f"wheel_speed_{w}_{u}") in columns]
    pace = next((n for n in ("speed_m_s", *wheels) if n in columns), "")
    if not pace:
        return
    speed = columns[pace]
    if ax is not None:
        yield _Pair(
            f"the derivative of {pace} follows ax_m_s2", ax, derivative(speed), ("ax_m_s2", pace), SPEED_AFTER_A_X_S
        )
    if gyro is not None and ay is not None:
        text = "ay_m_s2 follows yaw_rate_rad_s x speed"
        yield _Pair(text, gyro * speed, ay, ("yaw_rate_rad_s", "ay_m_s2"), A_Y_AFTER_TURNING_S)
    steer = next((n for n in ("steer_rad", "steering_wheel_rad") if n in columns), "")
    if gyro is not None and steer:
        text = f"yaw_rate_rad_s follows {steer} x speed"
        yield _Pair(text, columns[steer] * speed, gyro, (steer, "yaw_rate_rad_s"), YAW_RATE_AFTER_STEERING_S)
