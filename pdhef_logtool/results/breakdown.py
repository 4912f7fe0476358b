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

import numpy as np

from pdhef_logtool.evaluation.statistics import FACTORS, dependence, deviate, holm, numbered
from pdhef_logtool.records.signals import BoolArray, FloatArray

#: Scored drives on each side of a comparison, at least.
LEAST_DRIVES = 5
#: Family-wise error rate.
SIGNIFICANT = 0.05
#: Values of a key that are listed one by one.
MOST_VALUES = 12
#: Log ratios above are shown as this one.
_LARGEST_LOG = 20.0


@dataclass(frozen=True, slots=True)
class BreakdownDrive:
    """Input of a breakdown, per drive: ``error`` of the selected estimate in rad (NaN: not scored), keys, factors."""

    error: float
    keys: Mapping[str, str]
    factors: Mapping[str, str | None]


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

    def effect(self, p: float, level: float) -> Effect:
        """Return it with a corrected p-value, and the interval at a level (0.05: 95 %)."""
        width = deviate(1.0 - 0.5 * level, self.freedom) * self.error
        low, high = self.difference - width, min(self.difference + width, _LARGEST_LOG)
        return Effect(math.expm1(self.difference), math.expm1(low), math.expm1(high), p)


def breakdowns(drives: Sequence[BreakdownDrive], by: Sequence[str] = ()) -> tuple[Breakdown, ...]:
    """Return the drives by each key that separates them, the strongest evidence first; ``by`` names keys, in order."""
    all_keys = dict.fromkeys(key for d in drives for key in d.keys)
    values = {key: _values(key, drives) for key in by or all_keys}
    if not by:
        counts = {key: len({v for v in of if v is not None}) for key, of in values.items()}
        values = {key: of for key, of in values.items() if 2 <= counts[key] <= min(MOST_VALUES, len(drives) - 1)}
    also: dict[str, tuple[str, ...]] = dict.fromkeys(values, ()) if by else _alike(drives, values)
    tests = {(key, value): test for key in also for value, test in _tests(key, drives, values[key]).items()}
    effects = _corrected(tests)
    rows = [
        Breakdown(key, _groups(drives, values[key], {v: e for (k, v), e in effects.items() if k == key}), others)
        for key, others in also.items()
    ]
    return tuple(rows if by else sorted(rows, key=lambda b: (b.p, b.key)))


def _alike(drives: Sequence[BreakdownDrive], values: Mapping[str, Sequence[str | None]]) -> dict[str, tuple[str, ...]]:
    """Return for the first key of each way to separate the scored drives the other keys that do the same."""
    first: dict[bytes, list[str]] = {}
    scored = [i for i, d in enumerate(drives) if d.error > 0.0]
    for key in sorted(values, key=lambda key: (key not in FACTORS, key)):
        part = numbered([values[key][i] or "" for i in scored])
        first.setdefault(part.tobytes(), []).append(key)
    return {key: tuple(others) for key, *others in first.values()}


def _tests(key: str, drives: Sequence[BreakdownDrive], values: Sequence[str | None]) -> dict[str, _Test | str]:
    """Return the comparison of each value with the other drives, or the reason why it is impossible."""
    scored = [i for i, d in enumerate(drives) if d.error > 0.0 and values[i] is not None]
    logs = np.log([drives[i].error for i in scored])
    names = np.array([values[i] for i in scored], dtype=object)
    factors = {f: [drives[i].factors.get(f) for i in scored] for f in FACTORS}
    part = numbered(list(names))
    factors = {
        f: of
        for f, of in factors.items()
        if key != f and not np.array_equal(numbered(of), part) and len({v for v in of if v}) > 1
    }
    return {value: _test(logs, names == value, factors) for value in dict.fromkeys(v for v in values if v is not None)}


def _test(logs: FloatArray, inside: BoolArray, factors: Mapping[str, Sequence[str | None]]) -> _Test | str:
    scores, weights = np.zeros(len(logs)), np.zeros(len(logs))
    means, variances, freedoms = [], [], []
    for side, sign in ((inside, 1.0), (~inside, -1.0)):
        n = int(np.count_nonzero(side))
        if n < LEAST_DRIVES:
            other = "" if side is inside else " with another value"
            return f"{n} scored drives{other}, at least {LEAST_DRIVES} are needed"
        for name, of in factors.items():
            values = {v for v, use in zip(of, side, strict=True) if use}
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


def _corrected(tests: Mapping[tuple[str, str], _Test | str]) -> dict[tuple[str, str], Effect | str]:
    """Return effects with Holm's p-values, and intervals at the level of the same step."""
    once: dict[tuple[str, frozenset[float]], list[tuple[str, str]]] = {}
    for (key, value), test in tests.items():
        if isinstance(test, _Test):  # the two values of a key are one comparison, with opposite signs
            same = frozenset({round(test.difference, 12), round(-test.difference, 12)})
            once.setdefault((key, same), []).append((key, value))
    first = [tests[places[0]] for places in once.values()]
    raw = [test.p for test in first if isinstance(test, _Test)]
    corrected = holm(raw)
    results: dict[tuple[str, str], Effect | str] = {k: t for k, t in tests.items() if isinstance(t, str)}
    steps = len(raw)
    for p, after, places in sorted(zip(raw, corrected, once.values(), strict=True)):
        for place in places:
            test = tests[place]
            if isinstance(test, _Test):
                results[place] = test.effect(after, SIGNIFICANT / steps)
        steps -= p <= SIGNIFICANT / steps and after < SIGNIFICANT
    return results


def _groups(
    drives: Sequence[BreakdownDrive], values: Sequence[str | None], effects: Mapping[str, Effect | str]
) -> tuple[Group, ...]:
    members: dict[str | None, list[BreakdownDrive]] = {}
    for drive, value in zip(drives, values, strict=True):
        members.setdefault(value, []).append(drive)
    groups = []
    for value, of_group in sorted(members.items(), key=lambda item: _in_order(item[0])):
        errors = np.array([d.error for d in of_group if d.error >= 0.0])
        effect = effects.get(value, "") if value is not None else ""
        mean = float(np.exp(np.mean(np.log(errors)))) if errors.size and errors.min() > 0.0 else math.nan
        groups.append(
            Group(
                "not given" if value is None else value,
                len(of_group),
                len(errors),
                mean,
                float(errors.max()) if errors.size else math.nan,
                effect if isinstance(effect, Effect) else None,
                effect if isinstance(effect, str) else "",
            )
        )
    return tuple(groups)


def _values(key: str, drives: Sequence[BreakdownDrive]) -> list[str | None]:
    """Return the value of each drive: its text, or that it is rare."""
    texts = [d.keys.get(key) for d in drives]
    counts = Counter(t for t in texts if t is not None)
    if len(counts) <= MOST_VALUES:
        return list(texts)
    common = {value for value, _ in counts.most_common(MOST_VALUES)}
    rest = f"{len(counts) - MOST_VALUES} others"
    return [t if t is None or t in common else rest for t in texts]


def _as_number(text: str | None) -> float:
    try:
        return math.nan if text is None else float(text)
    except ValueError:
        return math.nan


def _in_order(value: str | None) -> tuple[bool, bool, float, str]:
    text = value or ""
    number = _as_number(text.partition(" to ")[0])
    return value is None, math.isnan(number), 0.0 if math.isnan(number) else number, text
