"""Effects of properties of a drive (car, road, weather, month) on the error, with intervals.

An effect is the ratio of geometric mean errors: drives with one value against the other drives. Its interval is from
Welch's t-test of log errors, widened by the dependence of drives of one day, car and route; levels and p-values are
corrected for the number of comparisons (Holm 1979).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.evaluation.statistics import FACTORS, Factors, dependence, deviate, holm, numbered
from pdhef_logtool.records.signals import BoolArray, FloatArray

#: Values of drives [N], None where unknown.
_Texts: TypeAlias = NDArray[np.object_]

#: Scored drives on each side of a comparison, at least.
LEAST_DRIVES = 5
#: Family-wise error rate.
SIGNIFICANT = 0.05
#: Values of a key that are listed one by one.
MOST_VALUES = 12
#: Log ratios above are shown as this one.
_LARGEST_LOG = 20.0


@dataclass(frozen=True, slots=True)
class Effect:
    """Ratio of the errors of a group and of the other drives, less 1, with its interval and corrected p-value."""

    share: float
    low: float
    high: float
    p: float

    @property
    def significant(self) -> bool:
        """Whether the interval excludes 0."""
        return self.p < SIGNIFICANT


@dataclass(frozen=True, slots=True)
class Group:
    """Drives with one value of a key; ``effect`` None with the reason in ``why_not``."""

    value: str
    drives: int
    scored: int
    mean_rad: float
    worst_rad: float
    effect: Effect | None
    why_not: str = ""


@dataclass(frozen=True, slots=True)
class Breakdown:
    """The drives by a key; ``also``: other keys that separate the scored drives in the same way."""

    key: str
    groups: tuple[Group, ...]
    also: tuple[str, ...] = ()

    @property
    def p(self) -> float:
        """The smallest corrected p-value; infinite without a comparison."""
        return min((g.effect.p for g in self.groups if g.effect is not None), default=math.inf)

    @property
    def comparisons(self) -> int:
        """Number of independent comparisons: two groups are compared once."""
        count = sum(g.effect is not None for g in self.groups)
        return 1 if count == 2 and len(self.groups) == 2 else count


@dataclass(frozen=True, slots=True)
class _Test:
    """A comparison before correction: difference of mean logs, its standard error, and degrees of freedom."""

    difference: float
    error: float
    freedom: float

    @property
    def p(self) -> float:
        from scipy.special import ndtr, stdtr

        if self.error == 0.0:
            return 1.0 if self.difference == 0.0 else 0.0
        t = -abs(self.difference) / self.error
        return 2.0 * float(ndtr(t) if math.isinf(self.freedom) else stdtr(self.freedom, t))

    def effect(self, p: float, level: float, sign: float = 1.0) -> Effect:
        """Return it with a corrected p-value, and the interval at a level (0.05: 95 %); ``sign`` -1: other group."""
        width, difference = deviate(1.0 - 0.5 * level, self.freedom) * self.error, sign * self.difference
        low, high = difference - width, min(difference + width, _LARGEST_LOG)
        return Effect(math.expm1(difference), math.expm1(low), math.expm1(high), p)


def breakdowns(
    errors: FloatArray, keys: Sequence[Mapping[str, str]], factors: Factors, by: Sequence[str] = ()
) -> tuple[Breakdown, ...]:
    """Return drives by each key that separates them, the strongest evidence first.

    Parameters
    ----------
    errors : of the selected estimate [N] in rad, NaN: not scored. keys, factors : of the drives [N].
    by : names of keys, in order; none: all that separate drives.
    """
    columns = {key: _values([of.get(key) for of in keys]) for key in by or dict.fromkeys(k for of in keys for k in of)}
    also: dict[str, tuple[str, ...]] = dict.fromkeys(columns, ())
    if not by:
        most = min(MOST_VALUES, len(keys) - 1)
        also = _alike(errors, {key: of for key, of in columns.items() if 2 <= len({*of} - {None}) <= most})
    drives = {name: np.array(of, dtype=object) for name, of in factors.items()}
    tests = {key: _tests(key, errors, columns[key], drives) for key in also}
    effects = _corrected(tests)
    rows = [Breakdown(key, _groups(errors, columns[key], effects[key]), others) for key, others in also.items()]
    return tuple(rows if by else sorted(rows, key=lambda b: (b.p, b.key)))


def _alike(errors: FloatArray, columns: Mapping[str, _Texts]) -> dict[str, tuple[str, ...]]:
    """Return for the first key of each way to separate the scored drives the other keys that do the same."""
    first: dict[bytes, list[str]] = {}
    for key in sorted(columns, key=lambda key: (key not in FACTORS, key)):
        part = numbered([value or "" for value in columns[key][errors > 0.0]])
        first.setdefault(part.tobytes(), []).append(key)
    return {key: tuple(others) for key, *others in first.values()}


def _tests(key: str, errors: FloatArray, values: _Texts, drives: Mapping[str, _Texts]) -> dict[str, _Test | str]:
    """Return the comparison of each value with the other drives, or the reason why it is impossible."""
    use = (errors > 0.0) & np.array([v is not None for v in values], dtype=np.bool_)
    logs, names = np.log(errors[use]), values[use]
    part = numbered(names)
    factors = {
        name: of[use]
        for name, of in drives.items()
        if key != name and not np.array_equal(numbered(of[use]), part) and len({*filter(None, of[use])}) > 1
    }
    return {value: _test(logs, names == value, factors) for value in dict.fromkeys(values) if value is not None}


def _test(logs: FloatArray, inside: BoolArray, factors: Mapping[str, _Texts]) -> _Test | str:
    scores, weights = np.zeros(len(logs)), np.zeros(len(logs))
    means, variances, freedoms = [], [], []
    for side, sign in ((inside, 1.0), (~inside, -1.0)):
        n = int(np.count_nonzero(side))
        if n < LEAST_DRIVES:
            other = "" if side is inside else " with another value"
            return f"{n} scored drives{other}, at least {LEAST_DRIVES} are needed"
        for name, of in factors.items():
            values = {*of[side]}
            if len(values) == 1 and None not in values:
                where = "its drives" if side is inside else "the other drives"
                return f"{where} are all of one {name}: the two cannot be separated"
        spread = float(logs[side].std(ddof=1))
        means.append(float(logs[side].mean()))
        scores[side] = (logs[side] - means[-1]) / (spread or 1.0)
        weights[side] = sign * spread / n
        variances.append(spread**2 / n)
        freedoms.append(n - 1.0)
    variance = sum(variances)
    if variance == 0.0:
        return _Test(means[0] - means[1], 0.0, math.inf)
    drives = dependence(scores, factors, weights)
    uncertain = sum(v**2 / f for v, f in zip(variances, freedoms, strict=True)) / variance**2
    freedom = 1.0 / (uncertain + (0.0 if math.isinf(drives.freedom) else 1.0 / drives.freedom))
    return _Test(means[0] - means[1], math.sqrt(variance * drives.design_effect), freedom)


def _corrected(tests: Mapping[str, Mapping[str, _Test | str]]) -> dict[str, dict[str, Effect | str]]:
    """Return effects with Holm's p-values, and intervals at the level of the same step, by key and value."""
    results: dict[str, dict[str, Effect | str]] = {key: {} for key in tests}
    once: list[tuple[_Test, str, list[str]]] = []
    for key, of_key in tests.items():
        results[key] |= {value: test for value, test in of_key.items() if isinstance(test, str)}
        made = {value: test for value, test in of_key.items() if isinstance(test, _Test)}
        if len(made) == len(of_key) == 2:  # the two values of a key are one comparison, with opposite signs
            once.append((next(iter(made.values())), key, [*made]))
        else:
            once += [(test, key, [value]) for value, test in made.items()]
    raw = [test.p for test, _, _ in once]
    steps = len(raw)
    for p, corrected, (test, key, values) in sorted(zip(raw, holm(raw), once, strict=True), key=lambda row: row[0]):
        for value, sign in zip(values, (1.0, -1.0), strict=False):
            results[key][value] = test.effect(corrected, SIGNIFICANT / steps, sign)
        steps -= p <= SIGNIFICANT / steps and corrected < SIGNIFICANT
    return results


def _groups(errors: FloatArray, values: _Texts, effects: Mapping[str, Effect | str]) -> tuple[Group, ...]:
    groups = []
    for value in sorted({*values}, key=_in_order):
        inside = np.equal(values, value)
        scored = errors[inside & (errors >= 0.0)]
        effect = effects.get(value, "")
        mean = float(np.exp(np.mean(np.log(scored)))) if scored.size and scored.min() > 0.0 else math.nan
        worst = float(scored.max()) if scored.size else math.nan
        shown, why_not = (effect, "") if isinstance(effect, Effect) else (None, effect)
        name, drives = "not given" if value is None else value, int(np.count_nonzero(inside))
        groups.append(Group(name, drives, len(scored), mean, worst, shown, why_not))
    return tuple(groups)


def _values(texts: Sequence[str | None]) -> _Texts:
    """Return the value of each drive [N]: its text, or that it is rare; None without one."""
    counts = Counter(t for t in texts if t is not None)
    rare = {value for value, _ in counts.most_common()[MOST_VALUES:]}
    return np.array([f"{len(rare)} others" if t in rare else t for t in texts], dtype=object)


def _in_order(value: str | None) -> tuple[bool, bool, float, str]:
    """Return the place of a value: numbers in order, then texts, then None."""
    text = value or ""
    try:
        number = float(text.partition(" to ")[0])
    except ValueError:
        number = math.nan
    return value is None, math.isnan(number), 0.0 if math.isnan(number) else number, text
