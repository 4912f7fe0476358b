"""How much a figure of the same drives changed: the median paired log ratio with its interval, and a verdict.

Each drive is compared with itself, because drives differ more from one another than runs do. The median limits the
influence of single drives. Its bounds are order statistics, as in the sign test, with a variance multiplied by the
design effect of drives of one day, car or route (:mod:`pdhef_logtool.evaluation.dependence`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np

from pdhef_logtool.evaluation.dependence import Dependence, Factors, dependence, deviate, numbered
from pdhef_logtool.records.signals import FloatArray

Verdict: TypeAlias = Literal["equal", "worse", "not worse", "better", "inconclusive"]

#: Fewer drives (clusters) have no bounds: all of four are worse by chance in 6 %.
LEAST_CLUSTERS = 5
#: Drives over design effect below which the extremes of the drives are no 95 % bounds.
_LEAST_EFFECTIVE = 4.0
#: Normal deviates of a one-sided 95 % bound, and of being found in 80 % of all cases.
_BOUND_95, _FOUND_80 = 1.6448536269514722, 0.8416212335729143


@dataclass(frozen=True, slots=True)
class PairedChange:
    """The median of ln(b / a) over drives; positive where b is larger.

    Attributes
    ----------
    drives, clusters : number of drives with the figure on both sides, and of clusters, where the user gave some.
    median : NaN without drives. low, high : its 95 % interval; NaN below :data:`LEAST_CLUSTERS`, or where the
        dependence leaves too little evidence.
    least, most : its one-sided 95 % bounds. error : its standard error, from their distance.
    sign_p : two-sided p-value of "as many drives rise as fall"; 1 if all are equal.
    dependence : design effect and its causes.
    """

    drives: int
    clusters: int
    median: float
    low: float
    high: float
    least: float
    most: float
    error: float
    sign_p: float
    dependence: Dependence = field(default_factory=Dependence)

    def verdict(self, limit: float = 0.0) -> Verdict:
        """Return whether b is worse by more than ``limit`` (a share: 0.05) in a figure for which lower is better.

        ``worse``: the one-sided bound is above 0 and the median above the limit. ``better``: the bound the other way is
        below 0. ``not worse``: a change beyond the limit is excluded. Else the data do not decide.
        """
        beyond = math.log1p(limit)
        if self.least > 0.0 and self.median > beyond:
            return "worse"
        if self.most < 0.0:
            return "better"
        return "not worse" if self.most <= beyond else "inconclusive"

    def detectable(self, limit: float = 0.0) -> float:
        """Return the smallest worsening (a share) that :meth:`verdict` finds in 80 % of all cases; NaN: unknown."""
        log_change = max((_BOUND_95 + _FOUND_80) * self.error, math.log1p(limit) + _FOUND_80 * self.error)
        return math.expm1(log_change)


def log_ratios(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return ln(b / a) [N] of figures ≥ 0; 0 against 0 is no change."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(a == b, 0.0, np.log(b) - np.log(a))


def paired_change(
    ratios: FloatArray, clusters: Sequence[object] | None = None, factors: Factors | None = None
) -> PairedChange:
    """Return the median log ratio of drives with its bounds.

    Parameters
    ----------
    ratios : of :func:`log_ratios` [N]; infinite ones take part, by their sign.
    clusters : cluster of each drive [N]; fewer than :data:`LEAST_CLUSTERS` give no bounds.
    factors : possible causes of dependence (day, car, route), used if ``clusters`` is None.
    """
    n = len(ratios)
    groups = n if clusters is None else len(set(numbered(clusters).tolist()))
    nan = math.nan
    if n == 0:
        return PairedChange(0, 0, nan, nan, nan, nan, nan, nan, 1.0)
    ascending = np.sort(ratios)
    lower, upper = float(ascending[(n - 1) // 2]), float(ascending[n // 2])
    median = 0.0 if lower == -upper else lower if lower == upper else 0.5 * (lower + upper)  # may be infinite
    above = (ratios > median).astype(np.float64) - (ratios < median)
    effect = dependence(above, {"cluster": clusters} if clusters is not None else factors or {})
    votes = sign_p(ratios, effect)
    if groups < LEAST_CLUSTERS:
        return PairedChange(n, groups, median, nan, nan, nan, nan, nan, votes, effect)
    (low, high), (least, most) = (_bounds(ascending, share, effect) for share in (0.975, 0.95))
    return PairedChange(n, groups, median, low, high, least, most, (most - least) / (2 * _BOUND_95), votes, effect)


def _bounds(ascending: FloatArray, share: float, effect: Dependence) -> tuple[float, float]:
    """Return the one-sided bounds of the median at a probability: the sign test inverted, NaN where none exists."""
    n = len(ascending)
    if n < _LEAST_EFFECTIVE * effect.design_effect:
        return math.nan, math.nan
    place = 0.5 * (n - 1) - 0.5 * deviate(share, effect.freedom) * math.sqrt(n * effect.design_effect)
    return _at(ascending, max(place, 0.0)), -_at(-ascending[::-1], max(place, 0.0))


def _at(ascending: FloatArray, place: float) -> float:
    """Return the value at a place between order statistics; between infinite ones the outer one."""
    i = math.floor(place)
    low, high = float(ascending[i]), float(ascending[min(i + 1, len(ascending) - 1)])
    return low if low == high or not (math.isfinite(low) and math.isfinite(high)) else low + (place - i) * (high - low)


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values corrected for being several (Holm 1979), in the given order."""
    corrected = [1.0] * len(p_values)
    largest = 0.0
    for rank, i in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[i]))
        corrected[i] = largest
    return corrected


def sign_p(ratios: FloatArray, effect: Dependence | None = None) -> float:
    """Return the two-sided p-value of the sign test, which ignores ratios of 0; with a design effect by Student's t."""
    up, down = int(np.count_nonzero(ratios > 0)), int(np.count_nonzero(ratios < 0))
    n = up + down
    if n == 0:
        return 1.0
    from scipy.special import bdtr, stdtr

    if effect is not None and effect.design_effect > 1.0:
        excess = max(abs(up - down) - 1.0, 0.0) / math.sqrt(n * effect.design_effect)
        return min(1.0, 2.0 * float(stdtr(effect.freedom, -excess)))
    return min(1.0, 2.0 * float(bdtr(min(up, down), n, 0.5)))
