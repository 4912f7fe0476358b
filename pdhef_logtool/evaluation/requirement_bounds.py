"""Confidence bounds of a requirement's statistic over units: drives, or blocks of time within drives.

The pooled statistic uses the studentised bootstrap (Efron & Tibshirani 1993, chapter 12) of the logarithm, because
errors of drives are skewed and percentile intervals of few drives are too low. Few drives lack a tail: below
``_LOGNORMAL`` drives, the upper bound is at least halfway to the bound for lognormal errors (Zou, Taleban & Huo 2009,
CSDA 53, 3755). The design effect of drives of one day, car or route widens both bounds. Each side uses half of
1 − confidence.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Literal

import numpy as np

from pdhef_logtool.evaluation.dependence import Dependence, Factors, dependence, deviate
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.records.student import student_quantile

#: With fewer drives, blocks within them are drawn. With fewer blocks, there are no bounds.
LEAST_DRIVES, LEAST_BLOCKS = 5, 6
_RESAMPLES, _SEED = 2000, 0
#: More units than this are drawn in groups.
_MOST_UNITS = 1000
#: Largest studentised deviation, in quantiles of Student's t: some resamples of few units have nearly no spread.
_MOST_DEVIATION = 2.0
#: Number of drives from which the coverage of the bootstrap alone is sufficient.
_LOGNORMAL = 300


@dataclass(frozen=True, slots=True)
class Bounded:
    """A statistic with its bounds, NaN with too few units.

    ``units``: number of drives, or of blocks of time of at most ``block_s``; ``effect``: dependence of the drives.
    """

    value: float
    low: float
    high: float
    units: int
    effect: Dependence = field(default_factory=Dependence)
    basis: Literal["drives", "blocks"] = "drives"
    block_s: float | None = None


def pooled(
    weights: FloatArray,
    values: FloatArray,
    others: FloatArray | None,
    *,
    squares: bool,
    positive: bool,
    level: float,
    factors: Factors | None = None,
) -> Bounded:
    """Return the mean of values [N] weighted by stamps [N], or its ratio to the mean of ``others`` [N].

    ``squares``: root mean square. ``positive``: values ≥ 0, for which the bootstrap uses the logarithm.
    ``level``: of the two-sided interval. ``factors``: factors of dependence of drives; None for blocks of time.
    """
    top = weights * (values**2 if squares else values)
    below = weights if others is None else weights * (others**2 if squares else others)
    power = 0.5 if squares else 1.0
    total, base = float(top.sum()), float(below.sum())
    n, nan = len(weights), math.nan
    if not n or base <= 0.0:
        return Bounded(nan, nan, nan, n)
    ratio = total / base
    value = float(ratio**power) if positive else ratio
    if n < 2 or (positive and total <= 0.0):
        return Bounded(value, nan, nan, n) if n < 2 else Bounded(0.0, 0.0, 0.0, n)
    effect = dependence(top - ratio * below, factors or {})
    tail = 0.5 * (1.0 - level)
    below_s, above_s = _studentised(top, below, power, tail, effect, log=positive)
    if not positive:
        return Bounded(value, value - below_s, value + above_s, n, effect)
    if factors is not None and others is None:
        # The mean of both: the bound for lognormal errors alone is too wide if few drives differ much.
        scale = math.sqrt(effect.design_effect)
        above_s += 0.5 * max(scale * _lognormal_excess(values, 1.0 if squares else 0.5, tail) - above_s, 0.0)
    return Bounded(value, value * math.exp(-below_s), value * math.exp(min(above_s, 50.0)), n, effect)


def _studentised(
    top: FloatArray, below: FloatArray, power: float, tail: float, effect: Dependence, *, log: bool
) -> tuple[float, float]:
    """Return the distances from the statistic, or its logarithm, to its lower and upper bound."""
    n = len(top)
    if n > _MOST_UNITS:  # neighbours form groups
        groups = np.arange(n) * _MOST_UNITS // n
        top, below = (np.bincount(groups, weights=c).astype(np.float64) for c in (top, below))
    error = float(_error(top, below, np.ones((1, len(top))), power, log=log)[0])
    if error == 0.0:
        return 0.0, 0.0
    ratio = float(top.sum() / below.sum())
    deviations = _deviations(top, below, power, math.log(ratio) * power if log else ratio, log=log)
    most_deviation = _MOST_DEVIATION * student_quantile(1.0 - tail, len(top) - 1)
    least, most = np.clip(np.quantile(deviations, [tail, 1.0 - tail]), -most_deviation, most_deviation)
    if effect.by:  # the number of days limits the degrees of freedom of the spread
        reach = deviate(1.0 - tail, effect.freedom)
        least, most = min(least, -reach), max(most, reach)
    error *= math.sqrt(effect.design_effect)
    return float(most) * error, -float(least) * error


def _lognormal_excess(values: FloatArray, power: float, tail: float) -> float:
    """Return ln(upper bound / estimate) of exp(μ + ``power`` σ²) of lognormal values [N]; 0 for too few or too many."""
    n = len(values)
    if not LEAST_DRIVES <= n < _LOGNORMAL or not (values > 0.0).all():
        return 0.0
    from scipy.special import chdtri  # its import takes longer than one short log, which never gets here

    variance = float(np.var(np.log(values), ddof=1))
    of_mean = student_quantile(1.0 - tail, n - 1) * math.sqrt(variance / n)
    return math.hypot(of_mean, power * variance * ((n - 1) / float(chdtri(n - 1, 1.0 - tail)) - 1.0))


def _error(top: FloatArray, below: FloatArray, counts: FloatArray, power: float, *, log: bool) -> FloatArray:
    """Return the standard errors [M] of the statistic with ``counts`` [M, N] of the units [N], by the delta method."""
    total, base = counts @ top, counts @ below
    ratio = total / base
    n = len(top)
    # Σ c (t − r b)² without an array [M, N] of residuals.
    squares = counts @ top**2 - 2.0 * ratio * (counts @ (top * below)) + ratio**2 * (counts @ below**2)
    spread = np.sqrt(np.maximum(squares, 0.0) * n / (n - 1))
    result: FloatArray = power * spread / total if log else spread / base
    return result


@lru_cache(maxsize=1)
def _resamples(n: int) -> FloatArray:
    """Return how often each of ``n`` units counts in each resample, [M, N]; all requirements have the same."""
    counts = np.random.default_rng(_SEED).multinomial(n, np.full(n, 1.0 / n), size=_RESAMPLES).astype(np.float64)
    counts.flags.writeable = False
    return counts


def _deviations(top: FloatArray, below: FloatArray, power: float, centre: float, *, log: bool) -> FloatArray:
    """Return (statistic − centre) / its error over resamples of the units."""
    counts = _resamples(len(top))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = (counts @ top) / (counts @ below)
        statistic = power * np.log(ratio) if log else ratio
        deviations = (statistic - centre) / _error(top, below, counts, power, log=log)
    usable = deviations[np.isfinite(deviations)]
    return usable if usable.size else np.zeros(1)


def quantile(values: FloatArray, share: float, level: float, factors: Factors | None = None) -> Bounded:
    """Return a quantile of drives [N] with its bounds by order statistics; infinite if N is too small.

    The bounds are exact for independent drives; otherwise a normal approximation with the design effect is used.
    """
    from scipy.special import bdtr

    n = len(values)
    if not n:
        return Bounded(math.nan, math.nan, math.nan, 0)
    ascending = np.sort(values)
    below = bdtr(np.arange(n + 1), n, share)  # P(at most k drives are below the quantile)
    tail = 0.5 * (1.0 - level)
    upper = next((k for k in range(1, n + 1) if below[k - 1] >= 1.0 - tail), None)
    lower = next((k for k in range(n, 0, -1) if below[k - 1] <= tail), None)
    value = float(np.quantile(ascending, share))
    effect = dependence((values > value).astype(np.float64), factors or {})
    if effect.design_effect > 1.0:
        reach = deviate(1.0 - tail, effect.freedom) * math.sqrt(n * share * (1.0 - share) * effect.design_effect)
        most, least = math.ceil(n * share + reach), math.floor(n * share - reach)
        upper, lower = most if most <= n else None, least if least >= 1 else None
    return Bounded(
        value,
        -math.inf if lower is None else float(ascending[lower - 1]),
        math.inf if upper is None else float(ascending[upper - 1]),
        n,
        effect,
    )


def least_drives(share: float, level: float) -> int:
    """Return the least number of drives N for an upper bound of a quantile: 1 − share^N ≥ (1 + level) / 2."""
    return math.ceil(math.log(0.5 * (1.0 - level)) / math.log(share))
