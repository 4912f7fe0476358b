"""The maths of the condition table: percentiles, paired bootstrap over drives.

All functions take one figure a drive. Drives with NaN (without a scored sample) do not count.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
#: Resamples of a bootstrap, and the level of its intervals.
RESAMPLES, LEVEL = 2000, 0.95


@dataclass(frozen=True, slots=True)
class Bound:
    """A figure with its percentile interval; ``drives`` is how many it was taken over, NaN bounds below two."""

    value: float
    low: float
    high: float
    drives: int


def percentiles(values: FloatArray, levels: tuple[float, ...] = (10.0, 50.0, 90.0)) -> tuple[float, ...]:
    """Return percentiles over drives [N] by linear interpolation."""
    finite = values[np.isfinite(values)]
    return tuple(np.percentile(finite, levels).tolist()) if finite.size else (float("nan"),) * len(levels)


def median(values: FloatArray) -> float:
    """Return the median over drives [N]; NaN without any."""
    return percentiles(values, (50.0,))[0]


def median_ratio(rmse: FloatArray, other: FloatArray) -> Bound:
    """Return median(rmse) / median(other) over drives [N], paired, with its bootstrap interval.

    The bootstrap draws whole drives with replacement, the same for both sides.
    """
    finite = np.isfinite(rmse) & np.isfinite(other)
    a, b = rmse[finite], other[finite]
    drives, nan = len(a), float("nan")
    if drives == 0:
        return Bound(nan, nan, nan, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        value = float(np.median(a) / np.median(b))
        if drives < 2:
            return Bound(value, nan, nan, drives)
        draw = np.random.default_rng(0).integers(drives, size=(RESAMPLES, drives))
        resampled = np.median(a[draw], axis=1) / np.median(b[draw], axis=1)
    low, high = np.nanpercentile(resampled, [50.0 * (1.0 - LEVEL), 50.0 * (1.0 + LEVEL)])
    return Bound(value, float(low), float(high), drives)


def verdict(bound: Bound, *, margin: float = 1.05) -> str:
    """Return the verdict from the interval of a ratio: better, worse (by more than the margin), not worse, or open."""
    if not np.isfinite(bound.low):
        return "–"
    if bound.high < 1.0:
        return "better"
    if bound.low > margin:
        return "worse"
    return "not worse" if bound.high <= margin else "open"
