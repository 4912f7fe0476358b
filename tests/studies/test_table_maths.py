"""The condition table's maths against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from studies.table_maths import median_ratio, percentiles, pooled_mean, pooled_rmse, verdict


def test_pooling_equals_the_rmse_of_all_samples_together():
    rng = np.random.default_rng(1)
    drives = [rng.normal(0.0, s, n) for s, n in ((1.0, 50), (3.0, 7), (0.2, 400))]
    rmse = np.array([np.sqrt(np.mean(d**2)) for d in drives] + [np.nan])
    samples = np.array([len(d) for d in drives] + [0.0])
    together = np.concatenate(drives)
    assert pooled_rmse(rmse, samples) == pytest.approx(np.sqrt(np.mean(together**2)), rel=1e-12)
    means = np.array([d.mean() for d in drives] + [np.nan])
    assert pooled_mean(means, samples) == pytest.approx(together.mean(), rel=1e-9)


def test_percentiles_of_eleven_equal_steps_and_of_nothing():
    assert percentiles(np.array([*range(11), np.nan], dtype=float)) == pytest.approx((1.0, 5.0, 9.0))
    assert np.isnan(percentiles(np.array([np.nan]))).all()


def test_a_constant_ratio_has_no_spread_however_much_the_drives_differ():
    # A bootstrap that drew the two sides apart would show the drives' spread here.
    other = np.random.default_rng(2).lognormal(0.0, 2.0, 30)
    bound = median_ratio(0.8 * other, other)
    assert (bound.value, bound.low, bound.high) == pytest.approx((0.8, 0.8, 0.8))
    assert bound.drives == 30
    assert verdict(bound) == "better"


@pytest.mark.parametrize(
    ("ratio", "word"), [(0.9, "better"), (1.02, "not worse"), (1.2, "worse")], ids=["better", "not worse", "worse"]
)
def test_verdicts(ratio, word):
    assert verdict(median_ratio(np.full(5, ratio), np.ones(5))) == word


def test_verdict_is_open_when_the_drives_disagree():
    assert verdict(median_ratio(np.array([0.5, 2.0, 0.4, 2.5, 1.0]), np.ones(5))) == "open"
