"""Faulty samples of accelerometer and gyro, dropped once before all estimators: noise, spikes, stuck and dead channels.

A sample is judged from samples up to it, so that causal estimators stay causal; no innovation of a filter is used, so
that a model error cannot be interpreted as noise (docs/method.md#faults). For each of a_y and yaw rate:

* noise beyond ``BURST_RATIO`` of the usual one, and spikes (:mod:`~.sample_noise`). The excess of the variance is added
  to R in every filter, and the network does not receive the sample. The usual noise is the vehicle file's, or that of
  the log if larger: a rough road is no burst.
* stuck: at least five identical samples, twice as many as ever before, that chance does not explain. A coarse signal
  is stuck only if the car has turned meanwhile.
* dead, with or without noise: three measures of the yaw rate: r, a_y/v_x, and steering times speed. If two agree and
  the third stays near zero, the third is dead.

Real noise has long tails, so that more samples are weighted down or dropped than are *reported*: a time in which most
samples are noisy, spikes beyond a long tail, and silence that lasts.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from pdhef_logtool.car.vehicle import GRAVITY_M_S2, Sensors, VehicleParameters
from pdhef_logtool.drive.sample_noise import scan
from pdhef_logtool.drive.sensor_changes import CELL_S, Cells, cells_of, long_runs
from pdhef_logtool.records.reasons import BURST_AY, DEAD_AY, MISSING_AY, SPIKE_AY, STUCK_AY
from pdhef_logtool.records.signals import NS_PER_S, S_PER_NS, BoolArray, FloatArray, IntArray, Signals

#: The two channels; the bits of the yaw rate are the bits of a_y, shifted left by one.
COLUMNS = ("ay_m_s2", "yaw_rate_rad_s")

#: Ratio of noise variance to the usual variance above which it is a burst.
BURST_RATIO = 16.0
#: Largest second derivatives of a_y and yaw rate of a car, m/s⁴ and rad/s³.
CURVATURE = (2000.0, 100.0)
#: Below this speed repeated samples are a standstill.
STUCK_SPEED_M_S = 1.0
#: Share of repetitions above which a channel is coarsely quantized; it is then stuck only if the yaw rate of the
#: steering has changed by this much meanwhile.
COARSE_REPEATS = 0.1
MOVED_RAD_S = 0.05
#: Dead: smallest value of the two others, in rad/s and in sigmas of the noise; largest value and duration of the dead
#: channel. The steering is used above a speed.
WITNESS_RAD_S, WITNESS_NOISE_SIGMAS = 0.06, 5.0
DEAD_BAND_RAD_S, DEAD_BAND_SIGMAS = 0.008, 2.0
DEAD_AFTER_S = 0.4
WITNESS_SPEED_M_S = 6.0
#: A dead channel recovers if it reads this share of both others for a time, or after a longer time without rotation.
ALIVE_SHARE, ALIVE_AFTER_S = 0.6, 0.2
QUIET_RAD_S, QUIET_AFTER_S = 0.03, 1.0

#: Reports. Number of independent samples of a burst, and share of them with this ratio to the drive's median variance.
BURST_SAMPLES, BURST_SHARE, LOUD_RATIO = 75.0, 0.8, 6.0
#: Evidence of a spike at its limit, exponent of its ratio to the limit, and evidence that is forgotten per second, in
#: nats, against one false alarm in an hour. With a tail of the fourth power and a spike in 45 s (Student's t with 4
#: degrees) the evidence does not accumulate.
SPIKE_AT_LIMIT_NATS, SPIKE_POWER, SPIKE_FORGOTTEN_NATS_PER_S = 2.4, 3.0, 1.0
SPIKE_NATS = math.log(4.0 * 3600.0)
#: Shortest durations of a stuck channel and of the turning that a dead channel misses; for a_y half of it to each side,
#: because bank can compensate a_y on one side.
STUCK_REPORTED_AFTER_S, DEAD_REPORTED_AFTER_S = 0.05, 0.5


def without_faults(signals: Signals, vehicle: VehicleParameters) -> Signals:
    """Return signals [N] without faulty samples; ``extra_variance`` and ``faults`` describe the faults."""
    extra, faults = np.zeros((len(signals), 2)), np.zeros(len(signals), np.int64)
    if not len(signals):
        return replace(signals, extra_variance=extra, faults=faults.astype(np.float64))
    cells = cells_of(signals)
    turning = _turning(cells, vehicle)
    sound: dict[str, Any] = {}
    for i, name in enumerate(COLUMNS):
        sound[name] = getattr(signals, name).copy()
        faults |= _without_stuck(sound[name], signals, cells, turning, vehicle.sensors) << i
        extra[:, i], bits = _without_spikes(sound[name], i, signals, cells, vehicle.sensors)
        faults |= bits << i
    calm: dict[str, Any] = {name: np.where(extra.any(axis=1), np.nan, column) for name, column in sound.items()}
    dead, reported = _dead(cells_of(replace(signals, **calm)), turning, vehicle)
    for i, name in enumerate(COLUMNS):
        sound[name][dead[cells.of_stamp, i]] = np.nan
        faults[reported[cells.of_stamp, i]] |= DEAD_AY << i
    stated = faults.astype(np.float64) if faults.any() else np.broadcast_to(0.0, len(faults))
    return replace(signals, **sound, extra_variance=extra, faults=stated)


def _without_stuck(
    column: FloatArray, signals: Signals, cells: Cells, turning: FloatArray, sensors: Sensors
) -> IntArray:
    """Remove the stuck samples of a column [N] in place; return its stuck and missing samples as faults of a_y."""
    steps_s, finite = signals.steps_s, np.isfinite(column)
    clock = np.cumsum(np.where(steps_s <= sensors.speed_hold_s, steps_s, 0.0))
    unseen_s = clock - np.maximum.accumulate(np.where(finite, clock, 0.0))
    faults = np.where(~finite & (unseen_s >= sensors.imu_hold_s), MISSING_AY, 0)
    # The mean of a cell is known behind it.
    speed, turning = (np.append(np.nan, c[:-1]) for c in (cells.speed, turning))
    for run in long_runs(column, cells, ~(speed <= STUCK_SPEED_M_S), least=sensors.stuck_samples):
        first = run.sure
        if run.repeats > COARSE_REPEATS:
            turned = turning[cells.of_stamp[run.start : run.end]] - turning[cells.of_stamp[run.start]]
            first = max(first, run.start + int(np.argmax(np.append(np.abs(turned) > MOVED_RAD_S, True))))
        if signals.stamps_ns[run.end - 1] - signals.stamps_ns[run.start] >= STUCK_REPORTED_AFTER_S * NS_PER_S:
            faults[first : run.end] |= STUCK_AY
        column[first : run.end] = np.nan
    return faults


def _without_spikes(
    column: FloatArray, channel: int, signals: Signals, cells: Cells, sensors: Sensors
) -> tuple[FloatArray, IntArray]:
    """Remove the spikes of a column [N] in place; return its extra variance, and its reported faults of a_y."""
    extra, faults, rows = np.zeros(len(column)), np.zeros(len(column), np.int64), np.flatnonzero(np.isfinite(column))
    time_s = (signals.stamps_ns[rows] - signals.stamps_ns[0]) * S_PER_NS
    moves = ~(np.append(np.nan, cells.speed)[cells.of_stamp[rows]] <= STUCK_SPEED_M_S)
    s0 = (sensors.ay_std_m_s2, sensors.yaw_rate_std_rad_s)[channel]
    noise, usual, beyond = scan(time_s, column[rows], moves, s0, CURVATURE[channel], sensors.imu_span_s)
    extra[rows] = np.where(noise > BURST_RATIO * usual, noise - s0 * s0, 0.0)
    column[rows[beyond > 1.0]] = np.nan
    # A rough car is no burst: its noise is usual.
    is_loud = noise > LOUD_RATIO * (np.median(noise) if len(rows) else 0.0)
    faults[rows[_is_burst(time_s, is_loud, BURST_SAMPLES / sensors.imu_rate_hz)]] |= BURST_AY
    faults[rows[_reported_spikes(time_s, beyond)]] |= SPIKE_AY
    return extra, faults


def _turning(cells: Cells, vehicle: VehicleParameters) -> FloatArray:
    """Return the steady yaw rate of the steering [n], rad/s; NaN at low speed."""
    v, friction = np.where(cells.speed > WITNESS_SPEED_M_S, cells.speed, np.nan), vehicle.assumed_friction
    gradient = max(vehicle.understeer_gradient_rad_per_m_s2(friction), 0.0)
    limit = 1.2 * friction * GRAVITY_M_S2 / v
    return np.clip(v * cells.steer / (vehicle.wheelbase_m + gradient * v**2), -limit, limit)


def _is_burst(time_s: FloatArray, is_noisy: BoolArray, window_s: float) -> BoolArray:
    """Return the samples [n] at the end of a window that is noisy for most of its samples."""
    first = np.searchsorted(time_s, time_s - window_s, side="right")
    noisy = np.concatenate([[0], np.cumsum(is_noisy)])
    end = np.arange(len(time_s)) + 1
    return np.asarray((noisy[end] - noisy[first] > BURST_SHARE * (end - first)) & (time_s >= window_s))


def _reported_spikes(time_s: FloatArray, beyond: FloatArray) -> list[int]:
    """Return the spikes among samples [n] with more accumulated evidence than long-tailed noise gives."""
    reported, nats, before_s = [], 0.0, 0.0
    for k in map(int, np.flatnonzero(beyond)):
        nats = max(nats - SPIKE_FORGOTTEN_NATS_PER_S * (time_s[k] - before_s), 0.0)
        nats = min(nats + SPIKE_AT_LIMIT_NATS + SPIKE_POWER * math.log(beyond[k]), 2.0 * SPIKE_NATS)
        before_s = time_s[k]
        if nats >= SPIKE_NATS:
            reported.append(k)
    return reported


def _dead(cells: Cells, turning: FloatArray, vehicle: VehicleParameters) -> tuple[BoolArray, BoolArray]:
    """Return in which cells a_y and yaw rate are dead, [n, 2] from the cells before, and in which it is reported.

    A healthy channel may disagree for a while, in a spin or with a wrong model, but then it changes, or reads a large
    value at the limit of grip. A dead one stays near zero while both others turn.
    """
    sensors = vehicle.sensors
    v = np.where(cells.speed > WITNESS_SPEED_M_S, cells.speed, np.nan)
    by_ay = cells.ay / v
    noise = np.stack([sensors.ay_std_m_s2 / v, np.full(len(by_ay), sensors.yaw_rate_std_rad_s)])
    least = WITNESS_RAD_S + WITNESS_NOISE_SIGMAS * noise.max(axis=0)
    measures = (by_ay, cells.yaw_rate)
    dead, reported = np.zeros((len(by_ay), 2), np.bool_), np.zeros((len(by_ay), 2), np.bool_)
    for i, (reading, other) in enumerate((measures, measures[::-1])):
        weakest = np.minimum(np.abs(other), np.abs(turning))
        agree = (other * turning > 0.0) & (weakest > least)
        silent = agree & (np.abs(reading) < DEAD_BAND_RAD_S + DEAD_BAND_SIGMAS * noise[i])
        speaks = agree & (reading * np.sign(turning) > ALIVE_SHARE * weakest)
        quiet = np.max(np.abs([reading, other, turning]), axis=0) < QUIET_RAD_S
        begins = _lasts(silent, DEAD_AFTER_S)
        ends = _lasts(speaks, ALIVE_AFTER_S) | _lasts(quiet, QUIET_AFTER_S)
        count = np.arange(len(begins))
        last = [np.maximum.accumulate(np.where(event, count, -1)) for event in (begins, ends)]
        dead[1:, i] = (last[0] > last[1])[:-1]
        stretch = np.cumsum(np.diff(dead[:, i], prepend=False))
        left, right = (np.bincount(stretch, silent & (turning * side > 0.0)) for side in (1.0, -1.0))
        silent_s = CELL_S * (2.0 * np.minimum(left, right) if i == 0 else left + right)
        reported[:, i] = dead[:, i] & (silent_s[stretch] >= DEAD_REPORTED_AFTER_S)
    return dead, reported


def _lasts(mask: BoolArray, time_s: float) -> BoolArray:
    """Return the cells [n] up to which a condition [n] has been true for ``time_s`` without a break."""
    count = np.arange(len(mask))
    return np.asarray((count - np.maximum.accumulate(np.where(mask, -1, count))) * CELL_S >= time_s)
