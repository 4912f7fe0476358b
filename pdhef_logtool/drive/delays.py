"""Delays: of ground truth against the gyro, and of sensors relative to one another without ground truth.

No sensor shows a motion before it happens. Of two sensors that follow one motion, the later one is late if their shift
is larger than for correct sensors. Only the difference of the rear wheel speeds follows the gyro without a delay. Other
pairs also differ by sideslip, pitch and the vehicle's response; they detect only large delays.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from pdhef_logtool.drive.columns import GRID_S, MS_PER_S
from pdhef_logtool.drive.correlation import CommonGrid, find_shift, on_common_grid, shift_error, without_trend
from pdhef_logtool.drive.hypotheses import Relation
from pdhef_logtool.drive.truth import SAME_SHARE, TruthTrack, channel_of, same_share
from pdhef_logtool.records.signals import Channel

#: Search range of the latency.
MAX_LATENCY_S = 0.5
#: Largest standard error of a reliable latency.
MAX_LATENCY_ERROR_S = 0.005
#: Ground truth cannot lead the gyro by more than this: the gyro's stamps are late.
LATE_GYRO_S = 0.005
#: Largest standard error of a shift, and how many standard errors the shift must be outside the plausible range.
MAX_SHIFT_ERROR_S, SURE = 0.015, 4.0
#: Least correlation at the shift: of ground truth; of sensors, which differ where the car slides; of exact pairs.
LEAST_CORRELATION = (0.8, 0.9, 0.95)


@dataclass(frozen=True, slots=True)
class LatencyEstimate:
    """Delay of the ground truth after the sensors.

    ``latency_s`` is 0 unless ``reliable``. ``identical``: the ground-truth yaw rate is the gyro's own channel, so that
    the latency is 0 by construction and gives no information about the other truth channels. ``reason`` is for the
    report. ``gyro_delay_s``: delay of the gyro's stamps; if it is not 0, the ground-truth latency is 0.
    """

    latency_s: float
    correlation: float
    std_error_s: float
    reliable: bool
    identical: bool
    reason: str
    gyro_delay_s: float = 0.0


@dataclass(frozen=True, slots=True)
class LateSensor:
    """Signals of one sensor with late stamps: by ``delay_s``, or by at least ``delay_s`` unless ``exact``."""

    names: tuple[str, ...]
    delay_s: float
    exact: bool
    evidence: str


def lag_of(
    grid: CommonGrid, least_correlation: float = LEAST_CORRELATION[0], max_error_s: float = MAX_LATENCY_ERROR_S
) -> LatencyEstimate:
    """Return the delay of the second signal of a grid after the first, by the peak of their cross-correlation.

    Reliable: a peak inside ± ``MAX_LATENCY_S``, of at least this correlation, with at most this standard error.
    """
    shift = find_shift(grid, MAX_LATENCY_S)
    if not math.isfinite(shift.correlation):
        return LatencyEstimate(0.0, 0.0, math.inf, False, False, "no motion")
    error_s = shift_error(grid, shift.shift_s)
    problems = (
        (not shift.inside, "no peak within the range searched"),
        (shift.correlation < least_correlation, "the two signals correlate too little"),
        (error_s > max_error_s, "too little motion"),
    )
    lacks = next((reason for is_true, reason in problems if is_true), "")
    return LatencyEstimate(0.0 if lacks else shift.shift_s, shift.correlation, error_s, not lacks, False, lacks)


def estimate_truth_latency(sensor_yaw_rate: Channel, truth_yaw_rate: Channel) -> LatencyEstimate:
    """Estimate the ground-truth latency against the gyro by cross-correlation of detrended yaw rates.

    Parameters
    ----------
    sensor_yaw_rate, truth_yaw_rate : on their own clocks. Do not pass an estimator's output: its lag, which the metrics
        show, would be attributed to the ground truth.
    """
    if same_share(sensor_yaw_rate, truth_yaw_rate) >= SAME_SHARE:
        return LatencyEstimate(0.0, 1.0, 0.0, True, True, "the ground-truth yaw rate is the gyro's channel")
    a, b, grid = sensor_yaw_rate, truth_yaw_rate, None
    if min(len(a), len(b)) > 1:
        grid = on_common_grid(a.stamps_ns, a.values, b.stamps_ns, b.values)
    if grid is None or float(np.isfinite(grid.a + grid.b).sum()) * grid.step_s < 4.0 * MAX_LATENCY_S:
        return LatencyEstimate(0.0, 0.0, math.inf, False, False, "less than two seconds in common")
    lag = lag_of(grid)
    return replace(lag, reason="gyro against ground-truth yaw rate") if lag.reliable else lag


def truth_latency(
    signals: Mapping[str, Channel], truths: Mapping[str, Channel], truth: TruthTrack | None
) -> LatencyEstimate | None:
    """Return the latency of ground truth relative to the gyro, or of the gyro; None if one is missing."""
    gyro = signals.get("yaw_rate_rad_s")
    if truth is None or gyro is None or not len(gyro):
        return None
    rate = truths.get("yaw_rate_rad_s") or channel_of(truth, "yaw_rate_rad_s")
    if not len(rate):
        return None
    latency = estimate_truth_latency(gyro, rate)
    speed = signals.get("speed_m_s")
    other = None
    if speed is not None and speed.source.split(".")[0] != gyro.source.split(".")[0]:
        vx = channel_of(truth, "vx_m_s")
        other = estimate_truth_latency(speed, vx) if min(len(speed), len(vx)) >= 2 else None
    return booked_on_the_late(latency, other)


def booked_on_the_late(latency: LatencyEstimate, speed: LatencyEstimate | None) -> LatencyEstimate:
    """Return the latency, with a negative one attributed to the gyro.

    Ground truth cannot show a motion before it happens. If it leads the gyro, the gyro's stamps are late. If a speed
    sensor of another topic is equally late, all sensors agree, and the ground-truth clock is early.

    Parameters
    ----------
    latency : gyro against ground-truth yaw rate. speed : speed sensor of another topic against ground-truth v_x.
    """
    leads = -latency.latency_s
    if not latency.reliable or leads <= max(LATE_GYRO_S, 3.0 * latency.std_error_s):
        return latency
    if (
        speed is not None
        and speed.reliable
        and abs(speed.latency_s - latency.latency_s) <= max(2.0 * LATE_GYRO_S, 3.0 * speed.std_error_s)
    ):
        return replace(latency, reason=f"{latency.reason}; the speed sensor is late by as much")
    reason = f"the gyro is {leads * MS_PER_S:.1f} ms late against ground truth, which leads no motion"
    return replace(latency, latency_s=0.0, gyro_delay_s=leads, reason=reason)


def late_sensors(relations: Iterable[Relation], names: Iterable[str]) -> tuple[LateSensor, ...]:
    """Return the sensors with late stamps, of all signals ``names``; relations that show no delay are ignored."""
    late: dict[str, LateSensor] = {}
    timed = [(r.law, r.law.delay_s, r.sides) for r in relations if r.law.delay_s and r.sides]
    for law, (low, high), sides in sorted(timed, key=lambda x: not x[0].exact):
        grid = CommonGrid(GRID_S, *map(without_trend, sides))
        lag = lag_of(grid, LEAST_CORRELATION[1 + law.exact], MAX_SHIFT_ERROR_S)
        shift_s, error_s = lag.latency_s, lag.std_error_s
        beyond_s = max(low - shift_s, shift_s - high)
        if not lag.reliable or error_s > beyond_s / SURE:
            continue
        name = law.late[shift_s >= low]
        late_ms, sd_ms, low_ms, high_ms = (MS_PER_S * x for x in (shift_s, error_s, low, high))
        evidence = (
            f"{law.text}: delay {late_ms:.0f} +- {sd_ms:.0f} ms where {low_ms:.0f} to {high_ms:.0f} are plausible"
        )
        delay_s = abs(shift_s) if law.exact else beyond_s
        wheels = tuple(n for n in names if n.startswith("wheel_speed_")) if name.startswith("wheel") else ()
        late.setdefault(name, LateSensor(wheels or (name,), delay_s, law.exact, evidence))
    return tuple(late.values())
