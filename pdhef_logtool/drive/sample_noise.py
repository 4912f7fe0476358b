"""Noise variance and spikes of the samples of a sensor, each from samples up to it.

* Noise: squared difference between a sample and the parabola through the three samples before, divided by its gain for
  white noise; with an even clock e = (z_k − 3 z_k−1 + 3 z_k−2 − z_k−3)²/20, and exact for parabolas with an uneven one.
  ŝ² = max(mean of the last 4 e, s₀² + keep · (ŝ² − s₀²)): fast attack, slow decay.
* Spikes: samples beyond 6 sigma of a constant-velocity tracker, if the next sample returns.
"""

import math

import numpy as np

from pdhef_logtool.compiled.cache import njit

#: Time constant of the decay: e^(−1/8) a step of 10 ms.
DECAY_S = 0.08
#: Differences with a larger gain, which an uneven clock can cause, are not used.
MAX_DIFFERENCE_GAIN = 200.0
#: Shortest time in which the learned usual noise, from the median of e, doubles or halves.
LEARNING_S = 10.0
#: Median of the square of a standard normal variable.
MEDIAN_SQUARE = 0.4549
#: Constant-velocity tracker: gains, spike limit.
TRACK_GAIN, TRACK_RATE_GAIN = 0.7, 0.4
SPIKE_SIGMA = 6.0
#: Ratio of the 1-sigma of the tracker's innovation to the sample noise, for the gains above.
TRACK_INNOVATION_RATIO = 1.5
#: Largest number of consecutive spikes; more are a jump or a burst.
MAX_SPIKES = 2


@njit(cache=True)
def _squared_noise(time_s, z, times, values, span_s):  # type: ignore[no-untyped-def]
    """Return the squared deviation of ``z`` from the parabola through the last three samples, over its gain, or NaN."""
    a1, a2, a3 = time_s - times[0], time_s - times[1], time_s - times[2]
    if a3 > span_s or not (0.0 < a1 < a2 < a3):
        return math.nan
    w1 = a2 * a3 / ((a2 - a1) * (a3 - a1))
    w2 = -a1 * a3 / ((a2 - a1) * (a3 - a2))
    w3 = a1 * a2 / ((a3 - a1) * (a3 - a2))
    gain = 1.0 + w1 * w1 + w2 * w2 + w3 * w3
    difference = z - w1 * values[0] - w2 * values[1] - w3 * values[2]
    return difference * difference / gain if gain <= MAX_DIFFERENCE_GAIN else math.nan


@njit(cache=True)
def scan(time_s, z, moves, s0, curvature, span_s):  # type: ignore[no-untyped-def]
    """Return noise variance, usual variance, and the ratio to the spike limit (0 without a spike) of samples [n].

    ``moves`` [n]: the usual noise is learned in motion. The last samples are newest first.
    """
    n = z.shape[0]
    noise, usual, beyond = np.empty(n), np.empty(n), np.zeros(n)
    times, values, e = np.zeros(3), np.zeros(3), np.zeros(4)
    count, spikes, learnt_s, level, variance, before = 0, 0, 0.0, 0.0, 0.0, 0.0
    track, rate, tracked_s = 0.0, 0.0, 0.0
    for k in range(n):
        age = time_s[k] - times[0]
        if count == 0 or age > span_s:
            count, spikes, track, rate, tracked_s = 0, 0, z[k], 0.0, time_s[k]
            e[:] = 0.0
        else:
            dt = time_s[k] - tracked_s
            ahead = track + dt * rate
            miss = z[k] - ahead
            sigma = TRACK_INNOVATION_RATIO * math.sqrt(max(s0 * s0, level, variance))
            limit = SPIKE_SIGMA * sigma + curvature * dt * dt / TRACK_RATE_GAIN
            # The rate needs three samples.
            is_far = count >= 3 and dt <= span_s and abs(miss) > limit
            if is_far and spikes < MAX_SPIKES:
                before = variance if spikes == 0 else before
                spikes += 1
                beyond[k] = abs(miss) / limit
            elif is_far:  # a jump or a burst: the samples are valid
                spikes, track, rate, tracked_s = 0, z[k], 0.0, time_s[k]
            else:
                if spikes > 0:  # a spike and no burst: remove it from the differences and from the noise
                    variance = before
                for i in range(spikes):
                    values[i] = ahead - rate * (time_s[k] - times[i])
                    e[i] = 0.0
                spikes, track, tracked_s = 0, ahead + TRACK_GAIN * miss, time_s[k]
                rate += TRACK_RATE_GAIN * miss / dt
        squared = _squared_noise(time_s[k], z[k], times, values, span_s) if count == 3 else math.nan
        if math.isfinite(squared):
            e[1:] = e[:-1].copy()
            e[0] = squared
            if moves[k] and beyond[k] == 0.0:
                learnt_s += age
                step = math.log(2.0) * age * max(1.0 / LEARNING_S, 1.0 / learnt_s)
                median = MEDIAN_SQUARE * max(level, 0.25 * s0 * s0)
                level = median * math.exp(step if squared > median else -step) / MEDIAN_SQUARE
        usual[k] = max(s0 * s0, level)
        variance = max(e.mean(), usual[k] + math.exp(-age / DECAY_S) * max(variance - usual[k], 0.0))
        noise[k] = variance
        values[1:], times[1:] = values[:-1].copy(), times[:-1].copy()
        values[0], times[0] = z[k], time_s[k]
        count = min(count + 1, 3)
    return noise, usual, beyond
