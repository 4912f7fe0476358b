"""Statistics over drives, for validation plans, comparisons of runs and the page of a run.

**Dependence.** Drives that share a day, car or route are correlated. The correlation r of such pairs is estimated from
the scores and widens intervals by the design effect D = 1 + r P / n of n drives with P ordered pairs (Kish 1965,
section 8.2). A pair that shares several factors counts once (Cameron, Gelbach and Miller 2011), so that nested factors
are not counted twice. With G groups, the degrees of freedom are (G - 1) D / (D - 1). The formula of Satterthwaite
(1946), (G - 1) (D / (D - 1))^2, gives too many, because r is limited to r >= 0; docs/calibration.md shows the resulting
rate of false alarms.

**Pooled statistics** have bounds from the studentised bootstrap (Efron & Tibshirani 1993, chapter 12) of the logarithm,
because errors of drives are skewed and percentile intervals of few drives are too low. Few drives lack a tail: below
``_LOGNORMAL`` drives, the upper bound is at least halfway to the bound for lognormal errors (Zou, Taleban & Huo 2009,
CSDA 53, 3755). Each side uses half of 1 - confidence.

**Paired changes** between runs compare each drive with itself, because drives differ more from one another than runs
do. The median of the log ratios limits the influence of single drives. Its bounds are order statistics, as in the sign
test, with a variance multiplied by the design effect.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import combinations
from pathlib import Path
from typing import Any, Literal, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.records.signals import S_PER_NS, FloatArray, IntArray, is_dated
from pdhef_logtool.records.student import student_quantile
from pdhef_logtool.storage.templates import one_line, template

_Key = TypeVar("_Key")
_Value = TypeVar("_Value")
Verdict: TypeAlias = Literal["equal", "worse", "not worse", "better", "inconclusive"]

Outcome: TypeAlias = Literal["PASS", "FAIL", "INCONCLUSIVE"]
#: Values of each drive by factor (day, car, route); None if the log does not contain it.
Factors: TypeAlias = Mapping[str, Sequence[object] | NDArray[np.object_]]

#: Confidence level of intervals, and of one-sided bounds.
LEVEL = 0.95
#: Metadata keys of a route; the first one in the log counts.
ROUTE_KEYS = ("route", "track", "course")
#: Factors unless the user names a cluster.
FACTORS = ("day", "car", "route")
#: Lower limit of an estimated design effect.
_LEAST_EFFECT = 0.2

#: With fewer drives, blocks within them are drawn. With fewer blocks, there are no bounds.
LEAST_DRIVES, LEAST_BLOCKS = 5, 6
_RESAMPLES = 2000
#: More units than this are drawn in groups.
_MOST_UNITS = 1000
#: Largest studentised deviation, in quantiles of Student's t: some resamples of few units have nearly no spread.
_MOST_DEVIATION = 2.0
#: Number of drives from which the coverage of the bootstrap alone is sufficient.
_LOGNORMAL = 300

#: Fewer drives (clusters) have no bounds of a change: all of four are worse by chance in 6 %.
LEAST_CLUSTERS = 5
#: Drives over design effect below which the extremes of the drives are no 95 % bounds.
_LEAST_EFFECTIVE = 4.0
#: Normal deviates of a one-sided 95 % bound, and of being found in 80 % of all cases.
_BOUND_95, _FOUND_80 = 1.6448536269514722, 0.8416212335729143


def decided(low: float, value: float, high: float, bound: float, least: float | None = None) -> Outcome:
    """Return whether a value with its interval is at most ``bound``; INCONCLUSIVE where an end is NaN.

    PASS: the interval is below. FAIL: it is above ``least`` (default: the bound), and the value is above the bound.
    """
    if high <= bound:
        return "PASS"
    return "FAIL" if low > (bound if least is None else least) and value > bound else "INCONCLUSIVE"


@dataclass(frozen=True, slots=True)
class Dependence:
    """Dependence between drives.

    Attributes
    ----------
    design_effect : variance of a mean relative to independent drives, at least 1; it may be lower for a difference.
    freedom : degrees of freedom of the estimate; infinite without dependence.
    by : factors with correlated drives, the strongest first.
    levels : number of different values of each factor that has two or more.
    """

    design_effect: float = 1.0
    freedom: float = math.inf
    by: tuple[str, ...] = ()
    levels: tuple[tuple[str, int], ...] = ()

    def text(self, drives: int) -> str:
        """Return a sentence on the dependence of drives of one day, car or route."""
        sentence = template(Path(__file__).with_name("templates") / "dependence.txt")
        return one_line(sentence.render(d=self, drives=drives))


def deviate(share: float, freedom: float) -> float:
    """Return a quantile of Student's t, or of the normal distribution with infinite degrees of freedom."""
    if math.isinf(freedom) or (freedom < 10_000 and float(freedom).is_integer()):  # one step for each two of them
        return student_quantile(share, freedom)
    from scipy.special import stdtrit

    return float(stdtrit(freedom, share))


def numbered(values: Iterable[object]) -> IntArray:
    """Return an integer for each different value [N]; each None is a separate value."""
    numbers: dict[object, int] = {}
    return np.array(
        [numbers.setdefault(("alone", i) if v is None else v, len(numbers)) for i, v in enumerate(values)],
        dtype=np.int64,
    )


def gathered(pairs: Iterable[tuple[_Key, _Value]]) -> dict[_Key, list[_Value]]:
    """Return the values of each key, such as the names that share a text, both in order of their first appearance."""
    groups: dict[_Key, list[_Value]] = {}
    for key, value in pairs:
        groups.setdefault(key, []).append(value)
    return groups


def dependence(scores: FloatArray, factors: Factors, weights: FloatArray | None = None) -> Dependence:
    """Return the dependence of drives by their scores [N], which need not be centred.

    ``weights`` [N]: weights of a difference of two means, for its design effect. The scores are then deviations from
    both means. The effect is below 1 for drives of the same days, because their influence cancels.
    """
    n = len(scores)
    x = scores - scores.mean() if n else scores
    means = 1 if weights is None else 2
    weights = np.ones(n) if weights is None else weights
    parts: dict[str, IntArray] = {}
    for name, values in factors.items():
        part = numbered(values)
        stated = any(v is not None for v in values)
        if stated and part.max() > 0 and not any(np.array_equal(part, other) for other in parts.values()):
            parts[name] = part
    levels = tuple((name, len({v for v in factors[name] if v is not None})) for name in parts)
    alone = {name: _correlation(x, [part]) for name, part in parts.items()} if np.any(x) else {}
    excesses = {name: r * _shared(weights, [parts[name]]) for name, r in alone.items() if r > 0.0}
    if not excesses:
        return Dependence(levels=levels)
    every = [*parts.values()]
    excess = max(*excesses.values(), max(_correlation(x, every), 0.0) * _shared(weights, every))
    if excess == 0.0:
        return Dependence(levels=levels)
    total = max(1.0 + excess, _LEAST_EFFECT)
    freedom = min(_freedom(parts[name], means) for name in excesses) * max(total / abs(excess), 1.0)
    return Dependence(total, freedom, tuple(sorted(excesses, key=lambda name: (-excesses[name], name))), levels)


def _pairs(values: FloatArray, parts: Sequence[IntArray]) -> float:
    """Return the sum of products over ordered pairs of drives that share any of the partitions."""
    square = float(values @ values)
    products = 0.0
    for size in range(1, len(parts) + 1):  # inclusion and exclusion: a pair with several common factors counts once
        for some in combinations(parts, size):
            sums = np.bincount(np.unique(np.stack(some), axis=1, return_inverse=True)[1].ravel(), values)
            products -= (-1.0) ** size * (float(sums @ sums) - square)
    return products


def _correlation(x: FloatArray, parts: Sequence[IntArray]) -> float:
    """Return the correlation of centred scores of drives that share any of the partitions."""
    n = len(x)
    pairs = _pairs(np.ones(n), parts)
    others = n * (n - 1.0) - pairs
    if pairs <= 0.0 or others <= 0.0:
        return 0.0
    # Centring adds the same amount to the products of all pairs; it cancels in their difference.
    products = _pairs(x, parts) * n / float(x @ x)
    shared, apart = products / pairs, (-n - products) / others
    return (shared - apart) / (1.0 - apart)


def _shared(weights: FloatArray, parts: Sequence[IntArray]) -> float:
    """Return the relative growth of a weighted sum's variance if drives with a common factor correlate fully."""
    return _pairs(weights, parts) / float(weights @ weights)


def _freedom(part: IntArray, means: int) -> float:
    """Return the effective number of a partition's groups minus the number of means."""
    counts = np.bincount(part).astype(np.float64)
    return max(float(np.sum(counts**2) ** 2 / np.sum(counts**4)) - means, 1.0)


def day_and_route(start_ns: int, metadata: Mapping[str, Any]) -> tuple[str | None, str | None]:
    """Return the day (UTC) on which a log with a date starts, and the route from its metadata."""
    from datetime import UTC, datetime

    texts = {str(k).rpartition(".")[2].lower(): str(v) for k, v in metadata.items()}
    day = datetime.fromtimestamp(start_ns * S_PER_NS, UTC).date().isoformat() if is_dated(start_ns) else None
    return day, next((texts[key] for key in ROUTE_KEYS if key in texts), None)


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
    level: float = LEVEL,
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
    """Return the standard errors [M] of the statistic in resamples, ``counts`` [M, N] of the units (delta method)."""
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
    counts = np.random.default_rng(0).multinomial(n, np.full(n, 1.0 / n), size=_RESAMPLES).astype(np.float64)
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


def quantile(values: FloatArray, share: float, level: float = LEVEL, factors: Factors | None = None) -> Bounded:
    """Return a quantile of drives [N] with its bounds by order statistics; infinite if N is too small.

    The bounds are exact for independent drives; otherwise a normal approximation with the design effect is used.
    """
    from scipy.special import bdtr

    n = len(values)
    if not n:
        return Bounded(math.nan, math.nan, math.nan, 0)
    ends = [-math.inf, *np.sort(values).tolist(), math.inf]
    below = bdtr(np.arange(n), n, share)  # P(at most k drives are below the quantile)
    tail = 0.5 * (1.0 - level)
    lower = int(np.searchsorted(below, tail, side="right"))
    upper = int(np.searchsorted(below, 1.0 - tail)) + 1
    value = float(np.quantile(values, share))
    effect = dependence((values > value).astype(np.float64), factors or {})
    if effect.design_effect > 1.0:
        reach = deviate(1.0 - tail, effect.freedom) * math.sqrt(n * share * (1.0 - share) * effect.design_effect)
        lower, upper = max(math.floor(n * share - reach), 0), min(math.ceil(n * share + reach), n + 1)
    return Bounded(value, ends[lower], ends[upper], n, effect)


def least_drives(share: float, level: float) -> int:
    """Return the least number of drives N for an upper bound of a quantile: 1 − share^N ≥ (1 + level) / 2."""
    return math.ceil(math.log(0.5 * (1.0 - level)) / math.log(share))


@dataclass(frozen=True, slots=True)
class PairedChange:
    """The median of ln(b / a) over drives; positive where b is larger.

    Attributes
    ----------
    drives, clusters : number of drives with the figure on both sides, and of clusters, where the user gave some.
    median : NaN without drives. low, high : its interval at the requested level; NaN below :data:`LEAST_CLUSTERS`, or
        where the dependence leaves too little evidence.
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
        if self.most < 0.0:
            return "better"
        beyond = math.log1p(limit)
        outcome = decided(self.least, self.median, self.most, beyond, least=min(beyond, 0.0))
        return {"PASS": "not worse", "FAIL": "worse", "INCONCLUSIVE": "inconclusive"}[outcome]  # type: ignore[return-value]

    def detectable(self, limit: float = 0.0) -> float:
        """Return the smallest worsening (a share) that :meth:`verdict` finds in 80 % of all cases; NaN: unknown."""
        log_change = max((_BOUND_95 + _FOUND_80) * self.error, math.log1p(limit) + _FOUND_80 * self.error)
        return math.expm1(log_change)


def log_ratios(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return ln(b / a) [N] of figures ≥ 0; 0 against 0 is no change."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(a == b, 0.0, np.log(b) - np.log(a))


def paired_change(
    ratios: FloatArray, clusters: Sequence[object] | None = None, factors: Factors | None = None, level: float = LEVEL
) -> PairedChange:
    """Return the median log ratio of drives with its bounds.

    Parameters
    ----------
    ratios : of :func:`log_ratios` [N]; infinite ones take part, by their sign.
    clusters : cluster of each drive [N]; fewer than :data:`LEAST_CLUSTERS` give no bounds.
    factors : possible causes of dependence (day, car, route), used if ``clusters`` is None.
    level : of the two-sided interval.
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
    bounds = (_bounds(ascending, share, effect) for share in (0.5 + 0.5 * level, LEVEL))
    (low, high), (least, most) = bounds if groups >= LEAST_CLUSTERS else ((nan, nan), (nan, nan))
    return PairedChange(n, groups, median, low, high, least, most, (most - least) / (2 * _BOUND_95), votes, effect)


def _bounds(ascending: FloatArray, share: float, effect: Dependence) -> tuple[float, float]:
    """Return the one-sided bounds of the median at a probability: the sign test inverted, NaN where none exists."""
    n = len(ascending)
    if n < _LEAST_EFFECTIVE * effect.design_effect:
        return math.nan, math.nan
    place = 0.5 * (n - 1) - 0.5 * deviate(share, effect.freedom) * math.sqrt(n * effect.design_effect)
    return _at(ascending, max(place, 0.0)), -_at(-ascending[::-1], max(place, 0.0))


def _at(ascending: FloatArray, place: float) -> float:
    """Return the value at a fractional rank, interpolated; beside an infinite value, the value at the lower rank."""
    i = math.floor(place)
    low, high = float(ascending[i]), float(ascending[min(i + 1, len(ascending) - 1)])
    return low if low == high or not (math.isfinite(low) and math.isfinite(high)) else low + (place - i) * (high - low)


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values corrected for multiple tests (Holm 1979), in the given order."""
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
