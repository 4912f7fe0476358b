"""The shift between two signals, by the peak of their cross-correlation."""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from pdhef_logtool.drive.columns import student
from pdhef_logtool.records.interpolation import Bracket
from pdhef_logtool.records.running_mean import running_mean
from pdhef_logtool.records.signals import NS_PER_S, S_PER_NS, FloatArray, IntArray

#: A step of more than this many median periods is a gap.
GAP_PERIODS = 3.0
#: Bounds of the common grid's step. Finer steps do not improve the result; coarser ones lose the peak.
MIN_STEP_S, MAX_STEP_S = 0.005, 0.05
#: Least share of a signal's power that is its variance: below that share, it counts as constant.
_LEAST_POWER = 1e-9
#: For the error of a shift: averaging time of both sides, number of blocks, and 1-sigma that stamps and filters of the
#: two sensors cause (studies/plus_minus.py).
_ERROR_MEAN_S, _ERROR_BLOCKS, _RESAMPLING_S = 0.2, 10, 2e-4


@dataclass(frozen=True, slots=True, eq=False)
class CommonGrid:
    """Two signals on one even grid; NaN where one has a gap. ``step_s``; ``a``, ``b`` [N]."""

    step_s: float
    a: FloatArray
    b: FloatArray


@dataclass(frozen=True, slots=True)
class Shift:
    """Delay of ``b`` after ``a``, and the correlation there. ``inside``: the peak is not at an end of the range."""

    shift_s: float
    correlation: float
    inside: bool


def without_trend(values: FloatArray) -> FloatArray:
    """Return a column [N] without its linear trend; NaN stays."""
    finite, n = np.flatnonzero(np.isfinite(values)), values.shape[0]
    if finite.size < 2:
        return values
    time = finite / n
    finite_values, centred = values if finite.size == n else values[finite], time - time.mean()
    slope = float(centred @ finite_values) / float(centred @ centred)
    offset = float(finite_values.mean()) - slope * float(time.mean())
    return np.asarray(values - offset - slope * (np.arange(n) / n), dtype=np.float64)


def on_common_grid(
    stamps_a_ns: IntArray, values_a: FloatArray, stamps_b_ns: IntArray, values_b: FloatArray
) -> CommonGrid:
    """Sample two signals [N], [M] of at least two samples each on one even grid where they overlap, without trends.

    ``stamps_a_ns``, ``stamps_b_ns``: ascending; may be the same array.
    """
    both = [stamps_a_ns] if stamps_a_ns is stamps_b_ns else [stamps_a_ns, stamps_b_ns]
    periods = [float(np.median(np.diff(stamps))) for stamps in both]
    step_ns = round(float(np.clip(min(periods), MIN_STEP_S * NS_PER_S, MAX_STEP_S * NS_PER_S)))
    start, end = max(int(s[0]) for s in both), min(int(s[-1]) for s in both)
    grid = np.arange(start, end + 1, step_ns, dtype=np.int64)
    brackets = [Bracket(s, grid, round(GAP_PERIODS * p)) for s, p in zip(both, periods, strict=True)]
    a, b = (without_trend(k.linear(v)) for k, v in ((brackets[0], values_a), (brackets[-1], values_b)))
    return CommonGrid(step_ns * S_PER_NS, a, b)


def find_shift(grid: CommonGrid, max_shift_s: float) -> Shift:
    """Find the shift within ± ``max_shift_s`` at which b(t + shift) correlates best with a(t).

    At each shift Pearson's coefficient is computed over the points that both have; a parabola through the peak and its
    neighbours refines it below the grid's step. NaN when a signal does not vary.
    """
    reach = round(max_shift_s / grid.step_s)
    every = _correlations(grid, reach)
    if not np.isfinite(every).any():
        return Shift(float("nan"), float("nan"), False)
    best = int(np.nanargmax(every))
    inside = 0 < best < 2 * reach
    refined = parabolic_peak(*every[best - 1 : best + 2].tolist()) if inside else 0.0
    return Shift((best - reach + refined) * grid.step_s, float(every[best]), inside)


def shift_error(grid: CommonGrid, shift_s: float) -> float:
    """Return the standard error of a shift, s, from blocks of equal motion; infinity where the motion does not show it.

    A drifting or nonlinear gain, an offset and a trend can resemble a shift. They are fitted together with the shift,
    and the change of the shift by this fit is part of its error.
    """
    steps, n = round(shift_s / grid.step_s), grid.a.shape[0]
    ahead, behind = max(0, steps), max(0, -steps)
    pair = np.stack([grid.a[behind : n - ahead], grid.b[ahead : n - behind]], axis=1)
    mean = running_mean(pair, max(1, round(0.5 * _ERROR_MEAN_S / grid.step_s)))
    both = np.isfinite(pair).all(axis=1)
    a, b, slope = (c[both] for c in (*mean.T, np.gradient(mean[:, 0], grid.step_s)))
    if a.size < 4 * _ERROR_BLOCKS or not a.any():
        return math.inf
    time = np.linspace(-1.0, 1.0, a.size)
    others = np.stack([np.ones_like(a), time, a, a * time, a * np.abs(a)], axis=1)
    both = np.stack([b, slope], axis=1)
    left, moved = (both - others @ np.linalg.lstsq(others, both, rcond=None)[0]).T
    gain, power = float(np.dot(a, b) / np.dot(a, a)), np.cumsum(moved**2)
    later = -float(np.dot(moved, left) / max(power[-1], 1e-300)) / gain
    noise = float(np.sum(np.gradient(left + later * gain * moved, grid.step_s) ** 2)) / gain**2
    if not power[-1] > 2.0 * noise:
        return math.inf
    edges = np.searchsorted(power, np.linspace(0.0, power[-1], _ERROR_BLOCKS + 1)[1:-1])
    blocks = [
        float(np.dot(m, n) / np.dot(m, m)) / gain
        for m, n in zip(np.split(moved, edges), np.split(left, edges), strict=True)
        if m.any()
    ]
    chance = student(len(blocks)) * float(np.std(blocks, ddof=1)) / math.sqrt(len(blocks))
    return math.hypot(chance, later - (shift_s - steps * grid.step_s), _RESAMPLING_S)


def parabolic_peak(before: float, middle: float, after: float) -> float:
    """Return the position of the vertex of the parabola through values at −1, 0, 1; 0 if it has no maximum."""
    curvature = before - 2.0 * middle + after
    return float(0.5 * (before - after) / curvature) if curvature < 0 else 0.0


def _correlations(grid: CommonGrid, reach: int) -> FloatArray:
    """Return Pearson's coefficient of a(t) and b(t + k) for k in ± ``reach`` [2 reach + 1], over the common samples.

    NaN where a side does not vary. The sums of products at all shifts are cross-correlations, by Fourier transforms;
    where one factor is 1 and no sample is missing, cumulative sums replace them.
    """
    n, shifts = grid.a.shape[0], np.arange(-reach, reach + 1)
    size = min(base << max(-(-(n + reach) // base) - 1, 0).bit_length() for base in (1, 3, 5, 9, 15))
    powers = []  # powers 0, 1 and 2 of each signal, 0 where the signal is NaN
    for values in (_unit_power(grid.a), _unit_power(grid.b)):
        finite = np.isfinite(values)
        values = np.where(finite, values, 0.0)
        powers.append((finite.astype(np.float64), values, values * values))
    whole = reach < n and all(finite.all() for finite, *_ in powers)
    spectrum = cache(lambda side, power: np.fft.rfft(powers[side][power], size))

    def sums(of_a: int, of_b: int) -> FloatArray:
        if whole and 0 in (of_a, of_b):
            values, way = (powers[0][of_a], shifts) if of_b == 0 else (powers[1][of_b], -shifts)
            total = np.concatenate([[0.0], np.cumsum(values)])
            return np.asarray(total[n - np.maximum(way, 0)] - total[np.maximum(-way, 0)], dtype=np.float64)
        every = np.fft.irfft(np.conj(spectrum(0, of_a)) * spectrum(1, of_b), size)
        return np.concatenate([every[size - reach :], every[: reach + 1]])

    count = np.rint(sums(0, 0))
    with np.errstate(divide="ignore", invalid="ignore"):
        sum_a, sum_b = sums(1, 0), sums(0, 1)
        power_a, power_b = sums(2, 0) - sum_a**2 / count, sums(0, 2) - sum_b**2 / count
        shows = (count >= 2) & (np.minimum(power_a, power_b) > _LEAST_POWER * count)
        return np.where(shows, (sums(1, 1) - sum_a * sum_b / count) / np.sqrt(power_a * power_b), np.nan)


def _unit_power(values: FloatArray) -> FloatArray:
    """Return values [N] without their mean, divided by their root mean square."""
    finite = np.isfinite(values)
    if not finite.any():
        return values
    values = values - values[finite].mean()
    size = float(np.sqrt(np.mean(np.square(values[finite]))))
    return values / size if size > 0.0 and math.isfinite(size) else values
