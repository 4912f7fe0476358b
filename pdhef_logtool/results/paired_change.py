"""How much a figure of the same drives changed: the paired log ratio, its bootstrap over drives, and a verdict.

Drives differ far more from one another than two runs over one drive do, so that each drive is its own yardstick. The
median keeps one drive that went wild from speaking for all. Drives of one car or day are no independent witnesses:
they may be drawn together, as a cluster.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.records.signals import FloatArray, IntArray

Verdict: TypeAlias = Literal["equal", "worse", "not worse", "better", "inconclusive"]

RESAMPLES = 2000
_SEED = 0
#: Drives times resamples that are in memory at once.
_AT_ONCE = 1 << 20
#: With fewer drives (clusters) the bootstrap has too little to give bounds: all of four are worse by chance in 6 %.
LEAST_CLUSTERS = 5
#: Normal deviates of a one-sided 95 % bound, and of being found in 80 % of all cases.
_BOUND_95, _FOUND_80 = 1.6448536269514722, 0.8416212335729143


@dataclass(frozen=True, slots=True)
class PairedChange:
    """The median of ln(b / a) over drives; positive where b is larger.

    Attributes
    ----------
    drives, clusters : how many, of those that have the figure on both sides.
    median : NaN without drives. low, high : its 95 % interval; NaN below :data:`LEAST_CLUSTERS`.
    least, most : its one-sided 95 % bounds: 5th and 95th percentile. error : its standard error.
    sign_p : two-sided p-value of "as many drives rise as fall", a vote a cluster; 1 where nothing changed.
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

    def verdict(self, limit: float = 0.0) -> Verdict:
        """Return whether b is worse by more than ``limit`` (a share: 0.05) in a figure whose lower value is better.

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


def log_ratios(a: FloatArray, b: FloatArray, floor: float = 0.0) -> FloatArray:
    """Return ln(b / a) [N] of figures ≥ 0; what is below ``floor`` counts as the floor, 0 against 0 as no change."""
    low, high = np.maximum(a, floor), np.maximum(b, floor)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(low == high, 0.0, np.log(high) - np.log(low))


def paired_change(ratios: FloatArray, clusters: Sequence[object] | None = None) -> PairedChange:
    """Return the median log ratio of drives with its bounds.

    Parameters
    ----------
    ratios : of :func:`log_ratios` [N]; infinite ones take part, by their sign.
    clusters : what each drive is of [N]; None: each is its own.
    """
    n = len(ratios)
    of_drive = np.arange(n) if clusters is None else _numbered(clusters)
    groups = int(of_drive.max()) + 1 if n else 0
    nan = math.nan
    if n == 0:
        return PairedChange(0, 0, nan, nan, nan, nan, nan, nan, 1.0)
    order = np.argsort(ratios, kind="stable")
    ascending = ratios[order]
    median = float(_middle(ascending, np.ones((1, n), dtype=np.int32))[0])
    votes = sign_p(np.array([np.sum(np.sign(ratios[of_drive == g])) for g in range(groups)]) if clusters else ratios)
    if groups < LEAST_CLUSTERS:
        return PairedChange(n, groups, median, nan, nan, nan, nan, nan, votes)
    if ascending[0] == ascending[-1]:  # for any drawing
        return PairedChange(n, groups, median, median, median, median, median, 0.0, votes)
    step = max(1, _AT_ONCE // n)
    parts = (_draws(groups)[i : i + step, of_drive[order]] for i in range(0, RESAMPLES, step))
    medians = np.sort(np.concatenate([_middle(ascending, counts) for counts in parts]))
    low, least, most, high = (float(medians[_rank(share)]) for share in (0.025, 0.05, 0.95, 0.975))
    error = float(np.std(medians)) if np.isfinite(medians).all() else nan
    return PairedChange(n, groups, median, low, high, least, most, error, votes)


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values corrected for being several (Holm 1979), in the given order."""
    corrected = [1.0] * len(p_values)
    largest = 0.0
    for rank, i in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[i]))
        corrected[i] = largest
    return corrected


def _rank(share: float) -> int:
    """Return the place of a percentile among sorted resamples, to the outside: bounds are never too narrow by it."""
    place = share * (RESAMPLES - 1)
    return math.floor(place) if share < 0.5 else math.ceil(place)


@lru_cache(maxsize=2)
def _draws(groups: int) -> NDArray[np.int32]:
    """Return how often each cluster is drawn [RESAMPLES, groups]; always the same for as many."""
    rng = np.random.default_rng(_SEED)
    drawn = np.empty((RESAMPLES, groups), dtype=np.int32)
    for row in drawn:
        row[:] = np.bincount(rng.integers(0, groups, groups), minlength=groups)
    return drawn


def _middle(ascending: FloatArray, counts: NDArray[np.int32]) -> FloatArray:
    """Return the medians [M] of ascending values [N] that count [M, N] times each."""
    reached = np.cumsum(counts, axis=1)
    total = reached[:, -1:]
    lower = np.argmax(reached * 2 >= total, axis=1)
    upper = np.argmax(reached * 2 > total, axis=1)
    low, high = ascending[lower], ascending[upper]
    with np.errstate(invalid="ignore"):
        middle: FloatArray = np.where(low == high, low, 0.5 * (low + high))
    return middle


def _numbered(clusters: Sequence[object]) -> IntArray:
    numbers: dict[object, int] = {}
    return np.array([numbers.setdefault(c, len(numbers)) for c in clusters], dtype=np.int64)


def sign_p(votes: FloatArray) -> float:
    """Return the two-sided p-value of the sign test; those without a sign do not vote."""
    up, down = int(np.count_nonzero(votes > 0)), int(np.count_nonzero(votes < 0))
    n = up + down
    if n == 0:
        return 1.0
    log_half = n * math.log(2.0)
    tail = sum(
        math.exp(math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1) - log_half)
        for k in range(min(up, down) + 1)
    )
    return min(1.0, 2.0 * tail)
