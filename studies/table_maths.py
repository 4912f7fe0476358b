"""The maths of the condition table: pooling, percentiles, geometric means, paired bootstrap over drives, intervals.

All functions take one figure a drive. A drive whose figure is NaN (nothing to score) does not count.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.evaluation.metrics import NORMAL_95
from pdhef_logtool.records.signals import FloatArray

#: Resamples of a bootstrap, and the level of its intervals.
RESAMPLES, LEVEL = 2000, 0.95
#: Share of samples that a 95 % interval may miss; weight of a miss in the interval score is 2 / ALPHA.
ALPHA = 0.05


@dataclass(frozen=True, slots=True)
class Bound:
    """A figure with its percentile interval; ``drives`` is how many it was taken over, NaN bounds below two."""

    value: float
    low: float
    high: float
    drives: int


def pooled_rmse(rmse: FloatArray, samples: FloatArray) -> float:
    """Return the RMSE over all samples of all drives from each drive's RMSE [N] and number of samples [N]."""
    return float(np.sqrt(pooled_mean(rmse**2, samples)))


def pooled_mean(mean: FloatArray, samples: FloatArray) -> float:
    """Return the mean over all samples of all drives from each drive's mean [N] and number of samples [N]."""
    known = np.isfinite(mean) & (samples > 0)
    return float(np.sum(samples[known] * mean[known]) / np.sum(samples[known])) if known.any() else float("nan")


def percentiles(values: FloatArray, levels: tuple[float, ...] = (10.0, 50.0, 90.0)) -> tuple[float, ...]:
    """Return percentiles over drives [N] by linear interpolation."""
    known = values[np.isfinite(values)]
    return tuple(np.percentile(known, levels).tolist()) if known.size else (float("nan"),) * len(levels)


def median(values: FloatArray) -> float:
    """Return the median over drives [N]; NaN without any."""
    return percentiles(values, (50.0,))[0]


def geometric_mean(values: FloatArray) -> float:
    """Return exp(mean(log x)) of positive values; NaN if one of them is not."""
    known = np.asarray(values, dtype=np.float64)
    if known.size == 0 or not np.all(known > 0.0):
        return float("nan")
    return float(np.exp(np.mean(np.log(known))))


def median_ratio(rmse: FloatArray, other: FloatArray) -> Bound:
    """Return median(rmse) / median(other) over drives [N], paired, with its bootstrap interval."""
    return _paired(lambda a, b, _a, _b: np.median(a, axis=1) / np.median(b, axis=1), rmse, other, None, None)


def pooled_ratio(rmse: FloatArray, other: FloatArray, samples: FloatArray, other_samples: FloatArray) -> Bound:
    """Return the ratio of pooled RMSE over drives [N], paired, with its bootstrap interval."""

    def ratio(a: FloatArray, b: FloatArray, n_a: FloatArray, n_b: FloatArray) -> FloatArray:
        first = (n_a * a**2).sum(axis=1) / n_a.sum(axis=1)
        return np.asarray(np.sqrt(first / ((n_b * b**2).sum(axis=1) / n_b.sum(axis=1))))

    return _paired(ratio, rmse, other, samples, other_samples)


def _paired(
    statistic: Callable[[FloatArray, FloatArray, FloatArray, FloatArray], FloatArray],
    first: FloatArray,
    second: FloatArray,
    first_samples: FloatArray | None,
    second_samples: FloatArray | None,
) -> Bound:
    """Draw whole drives with replacement, the same for both sides; percentile interval of the statistic."""
    known = np.isfinite(first) & np.isfinite(second)
    columns = [first, second, *(np.ones_like(first) if s is None else s for s in (first_samples, second_samples))]
    a, b, n_a, n_b = (np.asarray(c, dtype=np.float64)[known][None, :] for c in columns)
    drives = a.shape[1]
    nan = float("nan")
    if drives == 0:
        return Bound(nan, nan, nan, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        value = float(statistic(a, b, n_a, n_b)[0])
        if drives < 2:
            return Bound(value, nan, nan, drives)
        draw = np.random.default_rng(0).integers(drives, size=(RESAMPLES, drives))
        resampled = statistic(a[0][draw], b[0][draw], n_a[0][draw], n_b[0][draw])
    low, high = np.nanpercentile(resampled, [50.0 * (1.0 - LEVEL), 50.0 * (1.0 + LEVEL)])
    return Bound(value, float(low), float(high), drives)


def interval_score(error: FloatArray, sigma: FloatArray) -> FloatArray:
    """Return the interval score (Gneiting and Raftery 2007, Eq 43) of central 95 % intervals ± 1.96 σ, [N].

    Width of the interval plus 2/α times the distance by which the error lies outside; smaller is better, and the true
    quantiles minimise its mean. Unit of the error.
    """
    half = NORMAL_95 * sigma
    return np.asarray(2.0 * half + 2.0 / ALPHA * np.maximum(np.abs(error) - half, 0.0))


def verdict(bound: Bound, *, margin: float = 1.05) -> str:
    """Say what the interval of a ratio decides: better, worse (by more than the margin), not worse, or open."""
    if not np.isfinite(bound.low):
        return "–"
    if bound.high < 1.0:
        return "better"
    if bound.low > margin:
        return "worse"
    return "not worse" if bound.high <= margin else "open"
