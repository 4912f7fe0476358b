"""Faults of accelerometer and gyro detected without the filter: noise, spikes, stuck and dead channels.

No innovation of a filter with a network is used, so that a model error cannot be interpreted as noise
(docs/method.md#faults). For each of a_y and yaw rate:

* noise: squared difference between a sample and the parabola through the three samples before, divided by its gain for
  white noise; with an even clock e = (z_k − 3 z_k−1 + 3 z_k−2 − z_k−3)²/20, and exact for parabolas with an uneven one.
  ŝ² = max(mean of the last 4 e, s₀² + keep · (ŝ² − s₀²)): fast attack, slow decay. Beyond ``BURST_RATIO`` s₀² the
  excess ŝ² − s₀² is added to R in every filter, and the network does not receive the sample.
* spikes: a sample beyond 6 sigma of a constant-velocity tracker, if the next sample returns.
* stuck: at least five identical samples that chance does not explain. Quantized signals repeat, so the share of
  repetitions is learned while the car moves, and a coarse signal is stuck only if the car has turned meanwhile; at a
  standstill no channel is stuck.
* dead, with or without noise: three measures of the yaw rate: r, (a_y − v̇_y)/v_x, and the yaw rate of the open-loop
  nominal model with steering and speed, which also provides v̇_y. If two agree and the third stays near zero, the third
  is dead.

Stuck, dead and spike samples are treated as missing. s₀ is the vehicle file's, or the usual noise of the log if larger:
a rough road is no burst.

Filters apply all of this, which costs little without faults: real noise has long tails, and its outliers get less
weight. A fault is *reported* only if its accumulated evidence (Page's test, in nats) exceeds the level that chance
reaches once in ``HOURS_TO_FALSE_ALARM`` of clean driving:

* burst: samples beyond 3 sigma of the log's usual noise. Healthy noise may be twice the usual noise for any time; a
  burst has five times. The usual noise is here a high quantile of e that decreases more slowly than it increases, so
  that rough roads are remembered and repeated samples (e = 0) do not reduce it.
* spikes: more of them than a long tail contains, or one far beyond it.
* stuck, missing: for ``STUCK_REPORTED_AFTER_S``, ``imu_hold_s``. Dead: within a narrow range for
  ``DEAD_REPORTED_AFTER_S`` of turning.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from pdhef_logtool.car.nominal_model import measured_lateral_acceleration, model_parameters, rk4_step, substeps
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, Sensors, VehicleParameters
from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.records.readings import without_impossible
from pdhef_logtool.records.reasons import BURST_AY, DEAD_AY, MISSING_AY, SPIKE_AY, STUCK_AY
from pdhef_logtool.records.signals import FloatArray, IntArray, Signals
from pdhef_logtool.records.steps import last_stamp_ns, step_durations_s

# The two channels; the bits of the yaw rate are the bits of a_y, shifted left by one.
AY, YAW_RATE = 0, 1
CHANNELS = 2

#: Ratio of noise variance to the usual variance above which it is a burst.
BURST_RATIO = 16.0
#: Time constant of the decay: e^(−1/8) a step of 10 ms.
DECAY_S = 0.08
#: Differences with a larger gain, which an uneven clock can cause, are not used.
MAX_DIFFERENCE_GAIN = 200.0
#: Shortest time in which the learned usual noise, from the median of e, doubles or halves.
LEARNING_S = 10.0
#: Median of the square of a standard normal variable.
MEDIAN_SQUARE = 0.4549
#: Constant-velocity tracker: gains, spike limit, and largest second derivatives of a car (m/s⁴, rad/s³).
TRACK_GAIN, TRACK_RATE_GAIN = 0.7, 0.4
SPIKE_SIGMA = 6.0
#: Ratio of the 1-sigma of the tracker's innovation to the sample noise, for the gains above.
TRACK_INNOVATION_RATIO = 1.5
CURVATURE = (2000.0, 100.0)
#: Largest number of consecutive spikes; more are a jump or a burst.
MAX_SPIKES = 2
#: Probability below which chance is excluded as the reason of repeated samples.
STUCK_CHANCE = 1e-6
#: Time constants with which the share of repetitions increases and decreases, and its initial value.
REPEATS_S = 20.0
REPEATS_FORGOTTEN_S = 60.0
REPEATS_BEFORE = 0.5
#: Share of repetitions above which a channel is coarsely quantized; it is then stuck only if the yaw rate of the
#: open-loop model has changed by this much meanwhile.
COARSE_REPEATS = 0.1
MOVED_RAD_S = 0.05
#: Below this speed repeated samples are a standstill.
STUCK_SPEED_M_S = 1.0
#: Dead: smoothing time of the three measures; smallest value of the two others, in rad/s and in sigmas of the noise;
#: largest share of them, range and duration of the dead channel.
WITNESS_S = 0.04
WITNESS_RAD_S = 0.06
WITNESS_NOISE_SIGMAS = 5.0
DEAD_SHARE = 0.3
DEAD_BAND_RAD_S = 0.008
DEAD_BAND_SIGMAS = 2.0
DEAD_AFTER_S = 0.15
#: A dead channel recovers if it reads this share of both others for a time, or after a longer time without rotation.
ALIVE_SHARE = 0.6
ALIVE_AFTER_S = 0.2
QUIET_RAD_S = 0.03
QUIET_AFTER_S = 1.0
#: The open-loop model is used above this speed.
WITNESS_SPEED_M_S = 6.0

#: Reports: hours of clean driving per false alarm, and number of tests.
HOURS_TO_FALSE_ALARM = 1.0
QUESTIONS = 4.0
#: Noise of a healthy channel and of a burst as multiples of the usual sigma, and the threshold of a sample in sigmas.
HEALTHY_FACTOR, BURST_FACTOR, BEYOND_SIGMA = 2.0, 5.0, 3.0
SHARE_HEALTHY, SHARE_BURST = (math.erfc(BEYOND_SIGMA / f / math.sqrt(2.0)) for f in (HEALTHY_FACTOR, BURST_FACTOR))
NATS_BEYOND = math.log(SHARE_BURST / SHARE_HEALTHY)
NATS_WITHIN = math.log((1.0 - SHARE_BURST) / (1.0 - SHARE_HEALTHY))
#: Number of differences, which share samples, with the information of one independent sample.
DIFFERENCES_PER_SAMPLE = 2.3
#: Share of the evidence for reporting a burst below which the report ends.
BURST_OVER = 0.5
#: The level of e that ``SHARE_HEALTHY`` of the samples exceed is initialized in this time, with this gain and without
#: reports. Afterwards it doubles in ``LEARNING_S`` at most. After the second time twice the evidence is required.
FIRST_GUESS_S, FIRST_GAIN = 1.0, 5.0
HALF_KNOWN_S = 3.0
#: Evidence of a spike at its limit, exponent of its ratio to the limit, and evidence that is forgotten per second. With
#: a tail of the fourth power and a spike in 45 s (Student's t with 4 degrees) the evidence does not accumulate.
SPIKE_AT_LIMIT_NATS, SPIKE_POWER, SPIKE_FORGOTTEN_NATS_PER_S = 2.4, 3.0, 1.0
SPIKE_NATS = math.log(3600.0 * HOURS_TO_FALSE_ALARM * QUESTIONS)
#: Shortest reported duration of a stuck channel.
STUCK_REPORTED_AFTER_S = 0.05
#: Shortest reported duration in which both others turned and a dead channel did not change; for a_y half of it to each
#: side, because bank can compensate a_y on one side.
DEAD_REPORTED_AFTER_S = 0.5

# Memory of a channel.
C_Z, C_AGE, C_E = 0, 3, 6  # three last samples, their ages, four last e
(
    C_COUNT, C_NOISE, C_USUAL, C_LEARNT_S,
    C_TRACK, C_TRACK_RATE, C_TRACK_AGE, C_SPIKES, C_NOISE_BEFORE,
    C_LAST, C_RUN, C_REPEATS, C_MOVED_S,
    C_DEAD, C_DEAD_S, C_ALIVE_S, C_QUIET_S, C_SMOOTH, C_TURN_AT_START, C_TURN_MOST,
    C_ANCHOR, C_STUCK,
    C_LEVEL, C_LEVEL_S, C_BURST, C_BURST_TOLD, C_SPIKE,
    C_RUN_S, C_UNSEEN_S, C_SILENT_LEFT_S, C_SILENT_RIGHT_S,
) = range(C_E + 4, 41)  # fmt: skip
CHANNEL_MEMORY = C_SILENT_RIGHT_S + 1
# Memory of the open-loop model: speed and its age, v_y and r, smoothed r and a_y, time, last inputs.
W_SPEED, W_SPEED_AGE, W_VY, W_R, W_SMOOTH_R, W_SMOOTH_AY, W_SETTLED_S, W_STEER, W_FRICTION = range(9)
WITNESS_MEMORY = W_FRICTION + 1


class Limits(NamedTuple):
    """Limits that follow from the sensor profile; ``burst_nats`` is the evidence for reporting a burst."""

    rate_hz: float
    span_s: float
    hold_s: float
    speed_hold_s: float
    stuck_samples: float
    burst_nats: float

    @classmethod
    def of(cls, s: Sensors) -> Limits:
        """Return the limits of a profile."""
        nats = DIFFERENCES_PER_SAMPLE * math.log(3600.0 * s.imu_rate_hz * HOURS_TO_FALSE_ALARM * QUESTIONS)
        return cls(s.imu_rate_hz, s.imu_span_s, s.imu_hold_s, s.speed_hold_s, float(s.stuck_samples), nats)


@dataclass(frozen=True, slots=True, eq=False)
class FaultState:
    """State between windows: memory of the channels [2, m] and of the open-loop model [w]."""

    channels: FloatArray
    witness: FloatArray
    last_stamp_ns: int | None


@dataclass(frozen=True, slots=True, eq=False)
class SensorFaults:
    """Faults of a_y and yaw rate at each step.

    Attributes
    ----------
    extra_r : [N, 2], variance in excess of the usual one, m²/s⁴ and rad²/s²; 0 without a fault.
    noise_std : [N, 2], present standard deviation ŝ.
    reason : int64 [N], reported faults, bits of :mod:`pdhef_logtool.records.reasons`.
    filtered : signals for filters, without stuck, dead and spike samples.
    network : signals for the network's features, also without samples of a burst.
    """

    extra_r: FloatArray
    noise_std: FloatArray
    reason: IntArray
    filtered: Signals
    network: Signals


@njit(cache=True)
def _difference(c, z, span_s):  # type: ignore[no-untyped-def]
    """Return the difference of ``z`` from the parabola through the last three samples, and its gain for white noise.

    Ages a₁ < a₂ < a₃ of the samples are in ``c``. The gain is NaN where the ages do not allow it.
    """
    a1, a2, a3 = c[C_AGE], c[C_AGE + 1], c[C_AGE + 2]
    if c[C_COUNT] < 3.0 or a3 > span_s or not (0.0 < a1 < a2 < a3):
        return 0.0, math.nan
    w1 = a2 * a3 / ((a2 - a1) * (a3 - a1))
    w2 = -a1 * a3 / ((a2 - a1) * (a3 - a2))
    w3 = a1 * a2 / ((a3 - a1) * (a3 - a2))
    gain = 1.0 + w1 * w1 + w2 * w2 + w3 * w3
    if gain > MAX_DIFFERENCE_GAIN:
        return 0.0, math.nan
    return z - w1 * c[C_Z] - w2 * c[C_Z + 1] - w3 * c[C_Z + 2], gain


@njit(cache=True)
def _forget(c):  # type: ignore[no-untyped-def]
    """Drop the samples but not the learned levels; the next sample starts a new sequence."""
    c[C_COUNT] = 0.0
    c[C_SPIKES] = 0.0
    c[C_E : C_E + 4] = 0.0


@njit(cache=True)
def _decayed(c, usual, dt):  # type: ignore[no-untyped-def]
    """Return the noise variance after ``dt`` s without a sample."""
    return usual + math.exp(-dt / DECAY_S) * max(c[C_NOISE] - usual, 0.0)


@njit(cache=True)
def _asked(c, nats):  # type: ignore[no-untyped-def]
    """Return the required evidence: ``nats`` for a well-determined level, more for an uncertain one."""
    return nats * (1.0 + HALF_KNOWN_S / max(c[C_LEVEL_S], FIRST_GUESS_S))


@njit(cache=True)
def _weigh_burst(c, e, s0, moving, limits):  # type: ignore[no-untyped-def]
    """Add the evidence of a squared difference for a burst, and update the usual level."""
    age = c[C_AGE]
    level_is_known = c[C_LEVEL_S] > FIRST_GUESS_S
    beyond = e > max(BEYOND_SIGMA * BEYOND_SIGMA * s0 * s0, HEALTHY_FACTOR * HEALTHY_FACTOR * c[C_LEVEL])
    nats = NATS_BEYOND if beyond and moving and level_is_known else NATS_WITHIN
    # Faster samples are not independent: road and body motion are slower.
    nats *= min(1.0, age * limits.rate_hz)
    asked = _asked(c, limits.burst_nats)
    c[C_BURST] = min(max(c[C_BURST] + nats, 0.0), asked)
    if c[C_BURST] >= asked:
        c[C_BURST_TOLD] = 1.0
    elif c[C_BURST] < BURST_OVER * limits.burst_nats:
        c[C_BURST_TOLD] = 0.0
    if not moving:
        return
    c[C_LEVEL_S] += age
    rate = math.log(2.0) / (1.0 - SHARE_HEALTHY) * max(1.0 / LEARNING_S, 1.0 / c[C_LEVEL_S])
    if not level_is_known:
        rate = FIRST_GAIN / c[C_LEVEL_S]
    level = max(c[C_LEVEL], 0.01 * s0 * s0)
    c[C_LEVEL] = level * math.exp(rate * age * ((1.0 if e > level else 0.0) - SHARE_HEALTHY))


@njit(cache=True)
def _weigh_spike(c, beyond, dt):  # type: ignore[no-untyped-def]
    """Add the evidence of a sample ``beyond`` times its limit for spikes; return whether to report it."""
    c[C_SPIKE] = max(c[C_SPIKE] - SPIKE_FORGOTTEN_NATS_PER_S * dt, 0.0)
    if beyond <= 1.0 or c[C_LEVEL_S] <= FIRST_GUESS_S:
        return False
    asked = _asked(c, SPIKE_NATS)
    c[C_SPIKE] = min(c[C_SPIKE] + SPIKE_AT_LIMIT_NATS + SPIKE_POWER * math.log(beyond), 2.0 * asked)
    return c[C_SPIKE] >= asked


@njit(cache=True)
def _noise_and_spike(c, z, dt, s0, curvature, learn, limits):  # type: ignore[no-untyped-def]
    """Process a sample of a channel; return whether it is a spike, and its ratio to the limit of reports.

    Updates ŝ² and the usual noise.
    """
    usual = max(s0 * s0, c[C_USUAL])
    if c[C_AGE] > limits.span_s:
        _forget(c)
    if c[C_COUNT] == 0.0:
        c[C_TRACK], c[C_TRACK_RATE] = z, 0.0
        c[C_TRACK_AGE] = 0.0
        c[C_SPIKES] = 0.0
        spike, beyond = False, 0.0
    else:
        age = c[C_TRACK_AGE]
        ahead = c[C_TRACK] + age * c[C_TRACK_RATE]
        miss = z - ahead
        sigma = TRACK_INNOVATION_RATIO * math.sqrt(max(usual, c[C_NOISE]))
        bend = curvature * age * age / TRACK_RATE_GAIN
        # The rate needs three samples.
        spike = c[C_COUNT] >= 3.0 and age <= limits.span_s and abs(miss) > SPIKE_SIGMA * sigma + bend
        beyond = abs(miss) / (SPIKE_SIGMA * sigma + bend)
        if spike and c[C_SPIKES] >= MAX_SPIKES:
            # A jump or a burst: the samples are valid.
            spike = False
            c[C_SPIKES] = 0.0
            c[C_TRACK], c[C_TRACK_RATE], c[C_TRACK_AGE] = z, 0.0, 0.0
        elif spike:
            if c[C_SPIKES] == 0.0:
                c[C_NOISE_BEFORE] = c[C_NOISE]
            c[C_SPIKES] += 1.0
        else:
            if c[C_SPIKES] > 0.0:
                # A spike and no burst: remove it from the differences and from the noise.
                for i in range(int(c[C_SPIKES])):
                    c[C_Z + i] = ahead - c[C_TRACK_RATE] * c[C_AGE + i]
                    c[C_E + i] = 0.0
                c[C_NOISE] = c[C_NOISE_BEFORE]
                c[C_SPIKES] = 0.0
            c[C_TRACK] = ahead + TRACK_GAIN * miss
            c[C_TRACK_RATE] = 0.0 if c[C_COUNT] < 2.0 and age <= 0.0 else c[C_TRACK_RATE] + TRACK_RATE_GAIN * miss / age
            c[C_TRACK_AGE] = 0.0
    difference, gain = _difference(c, z, limits.span_s)
    if math.isfinite(gain):
        e = difference * difference / gain
        _weigh_burst(c, e, s0, learn, limits)
        c[C_E + 3], c[C_E + 2], c[C_E + 1] = c[C_E + 2], c[C_E + 1], c[C_E]
        c[C_E] = e
        if learn and not spike:
            c[C_LEARNT_S] += dt
            step = math.log(2.0) * dt * max(1.0 / LEARNING_S, 1.0 / c[C_LEARNT_S])
            floor = MEDIAN_SQUARE * s0 * s0
            learnt = max(MEDIAN_SQUARE * c[C_USUAL], 0.25 * floor)
            c[C_USUAL] = learnt * math.exp(step if e > learnt else -step) / MEDIAN_SQUARE
    usual = max(s0 * s0, c[C_USUAL])
    recent = 0.25 * (c[C_E] + c[C_E + 1] + c[C_E + 2] + c[C_E + 3])
    c[C_NOISE] = max(recent, _decayed(c, usual, dt))
    for i in (2, 1):
        c[C_Z + i], c[C_AGE + i] = c[C_Z + i - 1], c[C_AGE + i - 1]
    c[C_Z], c[C_AGE] = z, 0.0
    c[C_COUNT] = min(c[C_COUNT] + 1.0, 3.0)
    return spike, beyond


@njit(cache=True)
def _stuck(c, z, dt, moving, turning, stuck_samples):  # type: ignore[no-untyped-def]
    """Return whether the channel repeats a value for longer than its share of repetitions explains.

    ``turning`` is the open-loop model's yaw rate, rad/s.
    """
    same = z == c[C_LAST] and c[C_RUN] > 0.0
    c[C_RUN] = c[C_RUN] + 1.0 if same else 1.0
    c[C_RUN_S] = c[C_RUN_S] + dt if same else 0.0
    c[C_LAST] = z
    if not same:
        c[C_TURN_AT_START] = turning
        c[C_TURN_MOST] = 0.0
    c[C_TURN_MOST] = max(c[C_TURN_MOST], abs(turning - c[C_TURN_AT_START]))
    if not moving:
        c[C_RUN] = 1.0
        return False
    if same and c[C_STUCK] > 0.0:
        return True
    c[C_STUCK] = 0.0
    repeats = max(c[C_REPEATS], REPEATS_BEFORE * math.exp(-c[C_MOVED_S]), 1e-3)
    c[C_MOVED_S] += dt
    gain = min(1.0, dt * max(1.0 / (REPEATS_S if same else REPEATS_FORGOTTEN_S), 1.0 / (c[C_MOVED_S] + 0.5)))
    c[C_REPEATS] += gain * ((1.0 if same else 0.0) - c[C_REPEATS])
    needed = 1.0 + math.log(STUCK_CHANCE) / math.log(min(repeats, 0.9999))
    if c[C_REPEATS] > COARSE_REPEATS and c[C_TURN_MOST] < MOVED_RAD_S:
        return False
    c[C_STUCK] = 1.0 if c[C_RUN] >= max(stuck_samples, needed) else 0.0
    return c[C_STUCK] > 0.0


@njit(cache=True)
def _judge_witness(c, yaw_rate, measured, other, least, band, dt):  # type: ignore[no-untyped-def]
    """Update whether a channel is dead: its ``yaw_rate`` against the two other measures, rad/s.

    A healthy channel may disagree for a while, in a spin or with a wrong model, but then it changes, or reads a large
    value at the limit of grip. A dead one stays within ``band`` and near zero while both others turn.
    """
    if abs(yaw_rate - c[C_ANCHOR]) > band:
        c[C_ANCHOR] = yaw_rate
        c[C_DEAD_S] = 0.0
        c[C_SILENT_LEFT_S] = 0.0
        c[C_SILENT_RIGHT_S] = 0.0
    weakest = min(abs(measured), abs(other))
    agree = measured * other > 0.0 and weakest > least
    reading = yaw_rate if measured > 0.0 else -yaw_rate
    silent = agree and abs(reading) < DEAD_SHARE * weakest
    c[C_DEAD_S] = c[C_DEAD_S] + dt if silent else 0.0
    if silent:
        c[C_SILENT_LEFT_S if measured > 0.0 else C_SILENT_RIGHT_S] += dt
    speaks = agree and reading > ALIVE_SHARE * weakest
    c[C_ALIVE_S] = c[C_ALIVE_S] + dt if speaks else 0.0
    quiet = max(abs(measured), abs(other), abs(yaw_rate)) < QUIET_RAD_S
    c[C_QUIET_S] = c[C_QUIET_S] + dt if quiet else 0.0
    if c[C_DEAD_S] >= DEAD_AFTER_S:
        c[C_DEAD] = 1.0
    elif c[C_ALIVE_S] >= ALIVE_AFTER_S or c[C_QUIET_S] >= QUIET_AFTER_S:
        c[C_DEAD] = 0.0


@njit(cache=True)
def _open_loop(w, steer, friction, dt, p):  # type: ignore[no-untyped-def]
    """Advance the open-loop model by ``dt`` at the speed of ``w``; friction limits its r."""
    v = w[W_SPEED]
    n = substeps(v, dt, friction, p)
    _, vy, r = rk4_step(v, w[W_VY], w[W_R], 0.5 * (w[W_STEER] + steer), -w[W_VY] * w[W_R], friction, dt, n, p)
    limit = 1.2 * friction * GRAVITY_M_S2 / v
    w[W_R] = min(limit, max(-limit, r))
    w[W_VY] = min(0.3 * v, max(-0.3 * v, vy))


@njit(cache=True)
def _detect(window, default_friction, s0, p, channels, w, limits, output):  # type: ignore[no-untyped-def]
    """Process one window; ``dt[k]`` ends at step k, NaN = start of a log. Memories are updated in place."""
    dt, steer, ay, yaw_rate, speed, friction = window
    extra, noise, reason, usable = output
    for k in range(dt.shape[0]):
        step = dt[k] if math.isfinite(dt[k]) else 0.0
        mask, raised = 0, False
        if step > limits.speed_hold_s:
            for i in range(CHANNELS):
                _forget(channels[i])
                channels[i, C_BURST], channels[i, C_BURST_TOLD], channels[i, C_UNSEEN_S] = 0.0, 0.0, -step
            w[W_SETTLED_S] = 0.0
        if math.isfinite(speed[k]):
            w[W_SPEED], w[W_SPEED_AGE] = abs(speed[k]), 0.0
        else:
            w[W_SPEED_AGE] += step
        speed_is_fresh = w[W_SPEED_AGE] <= limits.speed_hold_s
        moving = not speed_is_fresh or w[W_SPEED] > STUCK_SPEED_M_S
        for i in range(CHANNELS):
            z = ay[k] if i == AY else yaw_rate[k]
            c = channels[i]
            c[C_AGE : C_AGE + 3] += step
            c[C_TRACK_AGE] += step
            usable[k, i] = z
            usual = max(s0[i] * s0[i], c[C_USUAL])
            spike, beyond = False, 0.0
            c[C_UNSEEN_S] += step
            if not math.isfinite(z):
                if c[C_UNSEEN_S] >= limits.hold_s:
                    mask |= MISSING_AY << i
                c[C_NOISE] = _decayed(c, usual, step)
            elif _stuck(c, z, step, moving, w[W_SMOOTH_R], limits.stuck_samples):
                if c[C_RUN_S] >= STUCK_REPORTED_AFTER_S:
                    mask |= STUCK_AY << i
                usable[k, i] = math.nan
                c[C_NOISE] = _decayed(c, usual, step)
                _forget(c)
            else:
                spike, beyond = _noise_and_spike(c, z, step, s0[i], CURVATURE[i], moving, limits)
                if spike:
                    usable[k, i] = math.nan
                if c[C_BURST_TOLD] > 0.0:
                    mask |= BURST_AY << i
            if math.isfinite(z):
                c[C_UNSEEN_S] = 0.0
            if _weigh_spike(c, beyond if spike else 0.0, step):
                mask |= SPIKE_AY << i
            usual = max(s0[i] * s0[i], c[C_USUAL])
            extra[k, i] = 0.0
            if c[C_NOISE] > BURST_RATIO * usual:
                raised = True
                extra[k, i] = c[C_NOISE] - s0[i] * s0[i]
            noise[k, i] = math.sqrt(max(c[C_NOISE], usual))

        mu = friction[k] if math.isfinite(friction[k]) else w[W_FRICTION] if w[W_FRICTION] > 0.0 else default_friction
        w[W_FRICTION] = mu
        if speed_is_fresh and w[W_SPEED] > WITNESS_SPEED_M_S and math.isfinite(steer[k]):
            v = w[W_SPEED]
            if w[W_SETTLED_S] == 0.0:
                w[W_VY], w[W_R] = 0.0, 0.0
                w[W_STEER] = steer[k]
            else:
                _open_loop(w, steer[k], mu, step, p)
            w[W_STEER] = steer[k]
            w[W_SETTLED_S] += max(step, 1e-9)
            gain = 1.0 - math.exp(-step / WITNESS_S)
            w[W_SMOOTH_R] += gain * (w[W_R] - w[W_SMOOTH_R])
            modelled = measured_lateral_acceleration(v, w[W_VY], w[W_R], steer[k], mu, p)
            w[W_SMOOTH_AY] += gain * (modelled / v - w[W_SMOOTH_AY])
            for i in range(CHANNELS):
                if math.isfinite(usable[k, i]):
                    rate = usable[k, i] / v if i == AY else usable[k, i]
                    channels[i, C_SMOOTH] += gain * (rate - channels[i, C_SMOOTH])
            clear = math.isfinite(usable[k, AY]) and math.isfinite(usable[k, YAW_RATE])
            if clear and not raised:
                of_ay, of_r = channels[AY, C_SMOOTH], channels[YAW_RATE, C_SMOOTH]
                least = WITNESS_RAD_S + WITNESS_NOISE_SIGMAS * max(s0[AY] / v, s0[YAW_RATE])
                drift = w[W_SMOOTH_AY] - w[W_SMOOTH_R]  # the model's v̇_y over v_x
                band_ay = DEAD_BAND_RAD_S + DEAD_BAND_SIGMAS * s0[AY] / v
                band_r = DEAD_BAND_RAD_S + DEAD_BAND_SIGMAS * s0[YAW_RATE]
                was_dead = channels[AY, C_DEAD] > 0.0
                if channels[YAW_RATE, C_DEAD] == 0.0:
                    _judge_witness(channels[AY], of_ay, of_r + drift, w[W_SMOOTH_AY], least, band_ay, step)
                if not was_dead:
                    _judge_witness(channels[YAW_RATE], of_r, of_ay - drift, w[W_SMOOTH_R], least, band_r, step)
        else:
            w[W_SETTLED_S] = 0.0
            for i in range(CHANNELS):
                channels[i, C_DEAD_S] = 0.0
                channels[i, C_ALIVE_S] = 0.0
                channels[i, C_QUIET_S] = 0.0
        for i in range(CHANNELS):
            if channels[i, C_DEAD] > 0.0:
                left, right = channels[i, C_SILENT_LEFT_S], channels[i, C_SILENT_RIGHT_S]
                silent_s = left + right if i == YAW_RATE else 2.0 * min(left, right)
                if silent_s >= DEAD_REPORTED_AFTER_S:
                    mask |= DEAD_AY << i
                usable[k, i] = math.nan
        reason[k] = mask


def no_faults(signals: Signals) -> SensorFaults:
    """Return the signals unchanged, without faults."""
    nothing = np.zeros((len(signals), CHANNELS))
    return SensorFaults(nothing, nothing, np.zeros(len(signals), dtype=np.int64), signals, signals)


def find_faults(
    signals: Signals, vehicle: VehicleParameters, state: FaultState | None
) -> tuple[SensorFaults, FaultState]:
    """Detect faults of a_y and yaw rate in one window, causally: step k depends on samples up to k.

    Joined windows give the same bits as one call over the whole log.
    """
    signals = without_impossible(signals)
    count = len(signals)
    channels = np.zeros((CHANNELS, CHANNEL_MEMORY)) if state is None else state.channels.copy()
    witness = np.zeros(WITNESS_MEMORY) if state is None else state.witness.copy()
    if state is None:
        witness[W_SPEED_AGE] = np.inf
    before_ns = state.last_stamp_ns if state else None
    window = (
        step_durations_s(signals.stamps_ns, before_ns), signals.steer_rad, signals.ay_m_s2, signals.yaw_rate_rad_s,
        signals.speed_m_s, signals.friction,
    )  # fmt: skip
    extra, noise, usable = (np.empty((count, 2)) for _ in range(3))
    reason = np.empty(count, dtype=np.int64)
    s0 = np.array([vehicle.sensors.ay_std_m_s2, vehicle.sensors.yaw_rate_std_rad_s])
    _detect(
        window,
        vehicle.assumed_friction,
        s0,
        model_parameters(vehicle),
        channels,
        witness,
        Limits.of(vehicle.sensors),
        (extra, noise, reason, usable),
    )
    last = last_stamp_ns(signals.stamps_ns, before_ns)
    filtered: dict[str, Any] = {"ay_m_s2": usable[:, AY].copy(), "yaw_rate_rad_s": usable[:, YAW_RATE].copy()}
    seen: dict[str, Any] = {
        "ay_m_s2": np.where(extra[:, AY] > 0.0, np.nan, usable[:, AY]),
        "yaw_rate_rad_s": np.where(extra[:, YAW_RATE] > 0.0, np.nan, usable[:, YAW_RATE]),
    }
    faults = SensorFaults(extra, noise, reason, replace(signals, **filtered), replace(signals, **seen))
    return faults, FaultState(channels, witness, last)
