"""Parts of the training on numbers worked out by hand: normalisation, runs of rows, recipes, regression."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from reference_car import START_NS

from pdhef_logtool.learning.network.residuals import ResidualRows
from pdhef_logtool.learning.network.train_command import (
    LEAD_STEPS,
    FeatureSequence,
    Recipe,
    gap_free_runs,
    make_recipe,
    normalisation_of,
    weights_of,
)
from pdhef_logtool.records.errors import ModelError, UsageError
from pdhef_logtool.residual_model.features import FEATURES


def arrays(count: int = 200, **changes: Any) -> ResidualRows:
    """Return the rows of a drive at 100 Hz with random features, all usable."""
    columns: dict[str, Any] = {
        "stamps_ns": START_NS + np.arange(count) * 10_000_000,
        "features": np.random.default_rng(count).normal(size=(count, len(FEATURES))).astype(np.float32),
        "targets": np.full((count, 2), 0.02, dtype=np.float32),
        "step_s": np.full(count, 0.01),
        "weight": np.ones(count, dtype=np.float32),
        "segment": np.zeros(count, dtype=np.int64),
        "truth_velocity": np.tile(np.float32([20.0, 0.1]), (count, 1)),
    }
    return ResidualRows(**{**columns, **changes})


def sequence(count: int, value: float = 1.0) -> FeatureSequence:
    features = np.zeros((count, len(FEATURES)))
    features[:, 0] = np.arange(count) % 5
    features[:, 1] = value
    return FeatureSequence(features, np.tile([value, -2.0 * value], (count, 1)), np.ones(count))


def test_normalisation_is_by_weight_and_keeps_the_targets_zero() -> None:
    one = sequence(4, 3.0)
    one.weight[3] = 0.0
    found = normalisation_of([one, sequence(1, 1.0)], FEATURES[:2])
    assert found.feature_mean == pytest.approx(((0 + 1 + 2 + 0) / 4, (3 + 3 + 3 + 1) / 4))
    assert found.feature_std == pytest.approx((np.std([0, 1, 2, 0]), np.std([3, 3, 3, 1])))
    assert found.target_std == pytest.approx((math.sqrt(28 / 4), math.sqrt(4 * 28 / 4)))
    flat = normalisation_of([sequence(3, 0.0)], FEATURES[1:2])
    assert (flat.feature_std, flat.target_std) == ((1e-6,), (1e-6, 1e-6))
    with pytest.raises(ModelError, match="none"):
        normalisation_of([replace(one, weight=np.zeros(4))], FEATURES[:2])


def test_runs_end_at_new_segments_and_short_or_worthless_ones_are_left_out() -> None:
    segment = np.repeat([0, 1, 2, 3], [50, 49, 51, 50])
    weight = np.ones(200, dtype=np.float32)
    weight[150:] = 0.0
    drive = arrays(segment=segment, weight=weight)
    assert list(gap_free_runs(drive)) == [slice(0, 50), slice(99, 150)]
    drive.features[120, 3] = np.nan
    assert list(gap_free_runs(drive)) == [slice(0, 50)]


def test_a_recipe_is_the_papers_or_methods_with_the_callers_seed_and_epochs() -> None:
    own, paper = (make_recipe(paper=p, seed=5, epochs=None, device="cpu") for p in (False, True))
    assert own == Recipe(seed=5) and (paper.hidden, paper.seed, paper.epochs) == (128, 5, 200)
    assert make_recipe(paper=False, seed=0, epochs=1, device="cpu").epochs == 1
    with pytest.raises(UsageError, match="epoch"):
        make_recipe(paper=False, seed=0, epochs=0, device="cpu")
    if not torch.cuda.is_available():
        with pytest.raises(UsageError, match="--device"):
            make_recipe(paper=False, seed=0, epochs=None, device="cuda")


def test_what_is_not_chosen_teaches_nothing_and_only_what_leads_to_the_chosen_is_run() -> None:
    chosen = np.zeros(2000, dtype=np.bool_)
    chosen[[700, 740]] = True
    chosen[1500] = True
    weight = np.ones(2000, dtype=np.float32)
    weight[1500] = 0.0  # chosen, but of no use
    rows = arrays(2000, chosen=chosen, weight=weight)
    (run,) = gap_free_runs(rows)
    assert run == slice(700 - LEAD_STEPS, 741)
    assert weights_of(rows, run).sum() == 2.0
    cut = replace(rows, segment=np.where(np.arange(2000) < 720, 0, 1))
    assert list(gap_free_runs(cut)) == [slice(700 - LEAD_STEPS, 720)], "what is left behind the cut is too short"
