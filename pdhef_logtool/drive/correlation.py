"""The shift between two signals, by the peak of their cross-correlation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdhef_logtool.drive.interpolation import Bracket
from pdhef_logtool.records.signals import FloatArray, IntArray

#: A step of more than this many median periods is a gap.
GAP_PERIODS = 3.0
#: The common grid's step is kept within these bounds: finer gains nothing, coarser loses the peak.
MIN_STEP_S, MAX_STEP_S = 0.005, 0.05
#: Far above what rounding does to a rough correlation of signals that vary by more than the least share of their power.
_ROUGH_ERROR, _LEAST_POWER = 1e-8, 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class CommonGrid:
    """Two signals on one even grid; NaN where one has a gap. ``step_s``; ``a``, ``b`` [N]."""

    step_s: float
    a: FloatArray
    b: FloatArray

    @property
    def both(self) -> int:
        """Number of grid points where both are known."""
        return int(np.count_nonzero(np.isfinite(self.a) & np.isfinite(self.b)))


@dataclass(frozen=True, slots=True)
class Shift:
    """By how much ``b`` follows ``a``, and the correlation there. ``inside``: the peak is no end of the range."""

    shift_s: float
    correlation: float
    inside: bool


def on_common_grid(
    stamps_a_ns: IntArray, values_a: FloatArray, stamps_b_ns: IntArray, values_b: FloatArray
) -> CommonGrid:
    """Sample two signals of at least two samples each on one even grid where they overlap, linear trends removed."""
    periods = [float(np.median(np.diff(stamps))) for stamps in (stamps_a_ns, stamps_b_ns)]
    step_ns = round(float(np.clip(min(periods), MIN_STEP_S * 1e9, MAX_STEP_S * 1e9)))
    start = max(int(stamps_a_ns[0]), int(stamps_b_ns[0]))
    end = min(int(stamps_a_ns[-1]), int(stamps_b_ns[-1]))
    grid = np.arange(start, end + 1, step_ns, dtype=np.int64)
    a = Bracket(stamps_a_ns, grid, round(GAP_PERIODS * periods[0])).linear(values_a)
    b = Bracket(stamps_b_ns, grid, round(GAP_PERIODS * periods[1])).linear(values_b)
    return CommonGrid(step_s=step_ns * 1e-9, a=_detrend(a), b=_detrend(b))


def find_shift(grid: CommonGrid, max_shift_s: float) -> Shift:
    """Find the shift within ± ``max_shift_s`` at which b(t + shift) correlates best with a(t).

    At each shift Pearson's coefficient is computed over the points that both have; a parabola through the peak and its
    neighbours refines it below the grid's step. NaN when a signal does not vary.
    """
    reach = round(max_shift_s / grid.step_s)
    if grid.both < 2:
        return Shift(float("nan"), float("nan"), False)
    rough = _rough_correlations(grid.a, grid.b, reach)
    # Candidates: all that rounding may have put behind the largest, and what cannot be told without the exact sums.
    near = ~(rough < np.nanmax(rough, initial=-np.inf) - _ROUGH_ERROR)
    exact = {k: _correlation(grid.a, grid.b, k) for k in (np.flatnonzero(near) - reach).tolist()}
    known = [k for k, value in exact.items() if np.isfinite(value)]
    if not known:
        return Shift(float("nan"), float("nan"), False)
    best = max(known, key=lambda k: (exact[k], -k))
    if abs(best) == reach:
        return Shift(best * grid.step_s, exact[best], False)
    refined = parabolic_peak(*(exact[k] if k in exact else _correlation(grid.a, grid.b, k) for k in _around(best)))
    return Shift((best + refined) * grid.step_s, exact[best], True)


def has_peak_within(grid: CommonGrid, low_s: float, high_s: float, least: float) -> bool:
    """Return whether the correlation has a peak of ``least`` or more inside of a range, and not only beyond it."""
    shifts = range(round(low_s / grid.step_s) - 1, round(high_s / grid.step_s) + 2)
    found = np.array([_correlation(grid.a, grid.b, k) for k in shifts])
    inner = found[1:-1]
    return bool(((inner > found[:-2]) & (inner >= found[2:]) & (inner >= least)).any())


def parabolic_peak(before: float, at: float, after: float) -> float:
    """Return the place of the vertex of the parabola through values at −1, 0, 1; 0 when it has no maximum."""
    curvature = before - 2.0 * at + after
    return float(0.5 * (before - after) / curvature) if curvature < 0 else 0.0


def _detrend(values: FloatArray) -> FloatArray:
    known = np.flatnonzero(np.isfinite(values))
    if known.size < 2:
        return values
    slope, offset = np.polyfit(known / values.shape[0], values[known], 1)
    return np.asarray(values - offset - slope * (np.arange(values.shape[0]) / values.shape[0]), dtype=np.float64)


def _around(shift: int) -> tuple[int, int, int]:
    return shift - 1, shift, shift + 1


def _rough_correlations(a: FloatArray, b: FloatArray, reach: int) -> FloatArray:
    """Return :func:`_correlation` at all shifts within ± ``reach``, to :data:`_ROUGH_ERROR`; NaN where it is unsure.

    From sums of products, which a library of linear algebra forms ten times as fast as means are taken off.
    """
    a, b = _unit_power(a), _unit_power(b)
    knows_a, knows_b = (np.isfinite(values).astype(np.float64) for values in (a, b))
    a, b = np.nan_to_num(a, nan=0.0), np.nan_to_num(b, nan=0.0)
    pairs = ((knows_a, knows_b), (a, knows_b), (knows_a, b), (a * a, knows_b), (knows_a, b * b), (a, b))
    found = np.full(2 * reach + 1, np.nan)
    n = a.shape[0]
    for k in range(max(-reach, 1 - n), min(reach, n - 1) + 1):
        x, y = slice(max(0, -k), n - max(0, k)), slice(max(0, k), n - max(0, -k))
        count, sum_a, sum_b, aa, bb, ab = (float(np.dot(u[x], v[y])) for u, v in pairs)
        if count >= 2:
            power_a, power_b = aa - sum_a * sum_a / count, bb - sum_b * sum_b / count
            if min(power_a, power_b) > _LEAST_POWER * count:
                found[reach + k] = (ab - sum_a * sum_b / count) / (power_a * power_b) ** 0.5
    return found


def _unit_power(values: FloatArray) -> FloatArray:
    known = values[np.isfinite(values)]
    with np.errstate(over="ignore"):
        size = float(np.sqrt(np.mean(np.square(known)))) if known.size else 0.0
    return values / size if size > 0 and np.isfinite(size) else values


def _correlation(a: FloatArray, b: FloatArray, shift: int) -> float:
    n = a.shape[0]
    if abs(shift) >= n:
        return float("nan")
    x = a[max(0, -shift) : n - max(0, shift)]
    y = b[max(0, shift) : n - max(0, -shift)]
    both = np.isfinite(x) & np.isfinite(y)
    if np.count_nonzero(both) < 2:
        return float("nan")
    x, y = x[both], y[both]
    x, y = x - x.mean(), y - y.mean()
    power = float((x * x).sum()) * float((y * y).sum())
    # A constant leaves rounding noise after detrending, which must not correlate.
    floor = (1e-20 * x.size) ** 2
    return float((x * y).sum()) / power**0.5 if power > floor else float("nan")
