"""Dependence of drives with the same day, car or route, estimated from the scores of these drives.

Drives that share a factor are correlated. The correlation r of such pairs is estimated from the scores and widens
intervals by the design effect D = 1 + r P / n of n drives with P ordered pairs (Kish 1965, section 8.2). A pair that
shares several factors counts once (Cameron, Gelbach and Miller 2011), so that nested factors are not counted twice.
With G groups, the degrees of freedom are (G - 1) D / (D - 1). The formula of Satterthwaite (1946), (G - 1) (D / (D -
1))^2, gives too many, because r is limited to r >= 0; docs/comparing.md shows the resulting rate of false alarms.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from pdhef_logtool.records.signals import FloatArray, IntArray
from pdhef_logtool.records.student import student_quantile

#: Metadata keys of a route; the first one in the log counts.
ROUTE_KEYS = ("route", "track", "course")

#: Factors unless the user names a cluster.
FACTORS = ("day", "car", "route")
#: Lower limit of an estimated design effect.
_LEAST_EFFECT = 0.2
#: Values of each drive by factor (day, car, route); None if the log does not contain it.
Factors = Mapping[str, Sequence[object]]


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
        groups = [f"{count} {name}s" for name, count in self.levels if count > 1]
        if not groups:
            return "Drives are assumed independent: days, cars and routes are the same in all drives, or not recorded."
        among = f"{drives} drives of {', '.join(groups)}"
        if self.design_effect == 1.0:
            return f"Design effect 1: no dependence between {among}."
        return (
            f"Design effect {self.design_effect:.2g} by {' and '.join(self.by)}: {among} have the evidence of "
            f"{drives / self.design_effect:.0f} independent drives."
        )


def deviate(share: float, freedom: float) -> float:
    """Return a quantile of Student's t, or of the normal distribution with infinite degrees of freedom."""
    if math.isinf(freedom) or (freedom < 10_000 and float(freedom).is_integer()):  # one step for each two of them
        return student_quantile(share, freedom)
    from scipy.special import stdtrit

    return float(stdtrit(freedom, share))


def numbered(values: Sequence[object]) -> IntArray:
    """Return an integer for each different value [N]; each None is a separate value."""
    numbers: dict[object, int] = {}
    return np.array(
        [numbers.setdefault(("alone", i) if v is None else v, len(numbers)) for i, v in enumerate(values)],
        dtype=np.int64,
    )


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
    if not np.any(x):
        return Dependence(levels=levels)
    alone = {name: _correlation(x, [part]) for name, part in parts.items()}
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
            sums = _sums(values, some)
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
    """Return the share of pairs with a common factor in the variance of a weighted sum, per unit of correlation."""
    return _pairs(weights, parts) / float(weights @ weights)


def _sums(values: FloatArray, parts: Sequence[IntArray]) -> FloatArray:
    """Return the sum of values of each combination of the partitions' groups."""
    joint = parts[0]
    for part in parts[1:]:
        joint = np.unique(joint * (int(part.max()) + 1) + part, return_inverse=True)[1]
    return np.asarray(np.bincount(joint, values), dtype=np.float64)


def _freedom(part: IntArray, means: int) -> float:
    """Return the effective number of a partition's groups minus the number of means."""
    counts = np.bincount(part).astype(np.float64)
    return max(float(np.sum(counts**2) ** 2 / np.sum(counts**4)) - means, 1.0)


def day_and_route(start_ns: int | None, metadata: Mapping[str, Any]) -> tuple[str | None, str | None]:
    """Return the day (UTC) on which a log starts, and the route from its metadata."""
    from datetime import UTC, datetime

    texts = {str(k).rpartition(".")[2].lower(): str(v) for k, v in metadata.items()}
    day = None if start_ns is None else datetime.fromtimestamp(start_ns * 1e-9, UTC).date().isoformat()
    return day, next((texts[key] for key in ROUTE_KEYS if key in texts), None)
