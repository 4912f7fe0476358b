"""Effects of conditions on the error: corrected for their number, and not confused with days."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from pdhef_logtool.results.fleet import Breakdown, breakdowns


def found(errors: list[float], days: list[int] | None = None, **keys: list[str]) -> tuple[Breakdown, ...]:
    of_drives = [dict(zip(keys, values, strict=True)) for values in zip(*keys.values(), strict=True)]
    return breakdowns(np.array(errors), of_drives, {"day": days or [None] * len(errors), "car": [None] * len(errors)})


def test_an_effect_is_that_of_welch() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.lognormal(0.0, 0.3, 12), rng.lognormal(0.4, 0.5, 9)
    (only,) = found([*a, *b], k=["a"] * 12 + ["b"] * 9)
    reference = stats.ttest_ind(np.log(b), np.log(a), equal_var=False)
    effect = only.groups[1].effect
    assert effect is not None and effect.p == pytest.approx(reference.pvalue)
    low, high = reference.confidence_interval()
    assert (effect.low, effect.high) == pytest.approx((np.expm1(low), np.expm1(high)))


def test_of_fleets_without_effects_few_show_any() -> None:
    rng = np.random.default_rng(1)
    wrong = naive = 0
    for _ in range(40):
        keys = rng.integers(0, 3, (8, 40))
        errors = rng.lognormal(size=40)
        shown = found([*errors], **{f"k{k}": [*map(str, v)] for k, v in enumerate(keys)})
        effects = [g.effect for b in shown for g in b.groups if g.effect is not None]
        assert all(e.significant == (e.low > 0.0 or e.high < 0.0) for e in effects)
        wrong += any(e.significant for e in effects)
        logs = np.log(errors)
        naive += any(stats.ttest_ind(logs[v == x], logs[v != x]).pvalue < 0.05 for v in keys for x in range(3))
    assert wrong <= 5 and naive >= 16


def test_days_that_differ_are_no_effect_of_the_weather() -> None:
    rng = np.random.default_rng(3)
    wrong = 0
    for _ in range(100):
        day = np.repeat(np.arange(12), 8)
        errors = np.exp(rng.normal(size=12)[day] + 0.3 * rng.normal(size=96))
        (weather,) = found([*errors], day.tolist(), weather=["wet" if d % 2 else "dry" for d in day])
        wrong += weather.p < 0.05
    assert wrong <= 10  # nominal 5
