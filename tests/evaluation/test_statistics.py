"""Statistics over drives: dependence, bounds of quantiles, the paired change of a figure and its verdict."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st
from scipy import stats

from pdhef_logtool.evaluation.statistics import decided, dependence, deviate, holm, paired_change, quantile
from studies.comparing import ratios_of_days, shares_of_days


def test_bounds_are_those_of_resampled_medians():
    ratios = np.random.default_rng(4).normal(0.0, 0.2, 31)
    found = paired_change(ratios)
    reference = stats.bootstrap((ratios,), np.median, n_resamples=9999, method="percentile", rng=1).confidence_interval
    assert found.median == np.median(ratios)
    assert (found.low, found.high) == pytest.approx(tuple(reference), abs=0.02)
    assert found.low <= found.least <= found.median <= found.most <= found.high


def test_the_sign_test_is_that_of_scipy_and_holm_corrects_for_being_several():
    ratios = np.array([0.1] * 9 + [-0.1] * 3 + [0.0] * 5)  # the unchanged do not vote
    assert paired_change(ratios).sign_p == pytest.approx(stats.binomtest(3, 12).pvalue)
    assert paired_change(np.zeros(8)).sign_p == 1.0
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([]) == []


def test_the_bounds_of_a_quantile_are_exact():
    rng = np.random.default_rng(0)
    found = [quantile(rng.uniform(size=60), 0.9, 0.95) for _ in range(400)]
    assert np.mean([f.low <= 0.9 for f in found]) >= 0.95
    assert np.mean([f.high >= 0.9 for f in found]) >= 0.95


@pytest.mark.parametrize(
    ("interval", "bound", "least", "outcome"),
    [
        ((0.9, 1.0, 1.1), 1.1, None, "PASS"),
        ((0.9, 1.0, 1.1), 1.0, None, "INCONCLUSIVE"),
        ((1.1, 1.2, 1.3), 1.05, None, "FAIL"),
        ((1.01, 1.1, 1.2), 1.05, None, "INCONCLUSIVE"),
        ((1.01, 1.1, 1.2), 1.05, 1.0, "FAIL"),  # a significant regression, and more than accepted
        ((1.01, 1.04, 1.2), 1.05, 1.0, "INCONCLUSIVE"),
        ((math.nan, 2.0, math.nan), 1.0, None, "INCONCLUSIVE"),
    ],
)
def test_an_interval_decides(interval, bound, least, outcome):
    assert decided(*interval, bound, least) == outcome


@pytest.mark.parametrize(("shared", "each"), [(0.1, 20), (0.9, 10)])
def test_equal_runs_with_drives_of_six_days_are_seldom_called_worse(shared, each):
    alone, together = shares_of_days(shared, 2000, 11, each)
    assert together <= 0.07  # nominal 0.05
    assert alone >= 0.10  # the result of treating the drives as independent


def test_the_design_effect_is_that_of_the_simulated_correlation():
    rng = np.random.default_rng(12)
    effects = [dependence(*ratios_of_days(rng, 20, 10, 0.3)).design_effect for _ in range(200)]
    assert np.mean(effects) == pytest.approx(1.0 + 0.3 * 9, abs=0.25)
    assert deviate(0.975, 1e15) == pytest.approx(deviate(0.975, math.inf))  # in no time


def test_factors_that_are_nested_or_equal_count_once_and_crossed_ones_add():
    rng = np.random.default_rng(13)
    day = np.repeat(np.arange(12), 10)
    scores = rng.normal(size=12)[day] + 0.5 * rng.normal(size=120)
    one = dependence(scores, {"day": day.tolist()})
    assert dependence(scores, {"day": day.tolist(), "car": [f"c{d}" for d in day]}) == one
    car = np.tile(np.arange(10), 12)
    crossed = dependence(scores + rng.normal(size=10)[car], {"day": day.tolist(), "car": car.tolist()})
    assert set(crossed.by) == {"day", "car"}
    nested = dependence(scores, {"day": day.tolist(), "road": (day // 2).tolist()})
    assert nested.design_effect < 1.6 * one.design_effect


@settings(max_examples=50, deadline=None)
@given(
    ratios=st.lists(st.floats(-3.0, 3.0) | st.sampled_from([math.inf, -math.inf, 0.0]), min_size=1, max_size=40),
    groups=st.integers(1, 8),
)
@example(ratios=[math.inf] * 3 + [-math.inf] * 3, groups=1)
def test_bounds_enclose_the_median_and_follow_the_sign(ratios, groups):
    values = np.array(ratios)
    factors = {"day": [i % groups for i in range(len(values))], "car": [None] * len(values)}
    one, other = paired_change(values, None, factors), paired_change(-values, None, factors)
    assert one.dependence.design_effect >= 1.0 and 0.0 <= one.sign_p <= 1.0
    if not math.isnan(one.low):
        assert one.low <= one.least <= one.median <= one.most <= one.high
        assert (one.low, one.most) == (-other.high, -other.least)
    else:
        assert one.verdict() == "inconclusive"
