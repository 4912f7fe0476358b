"""Residuals of drives with a residual in closed form."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from physics_oracle import Oracle, parts
from reference_car import FRICTION, START_NS, Drive, keep, with_noise
from residual_car import truth_of, weaving

from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.estimators.vehicle_ukf import VehicleUkf, nominal_filter
from pdhef_logtool.learning.network import train_command as training
from pdhef_logtool.learning.network.residuals import ResidualRows, residual_rows
from pdhef_logtool.records.errors import ModelError, UsageError
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.residual_model.features import FEATURES


def state_of(made: Drive) -> np.ndarray:
    return np.stack([made.vx, made.vy, made.r], axis=1)


@pytest.fixture(scope="module")
def made():
    return weaving()


@pytest.fixture(scope="module")
def noisy(made):
    """With noise, a lost stretch of 0.8 s, single lost stamps, and truth and steering that fail for a while."""
    signals, state = with_noise(made.signals, 3, 0.5), state_of(made)
    signals.steer_rad[900:905] = np.nan
    state[700:720] = np.nan
    kept = np.ones(len(signals), dtype=bool)
    kept[300:380] = kept[500] = kept[1203] = False
    return keep(signals, kept), truth_of(signals.stamps_ns[kept], state[kept])


def rows_of(signals: Signals, truth: StateTrack) -> ResidualRows:
    return residual_rows(signals, truth, nominal_filter(default_vehicle()), period_s=0.01)


def rates(rows: ResidualRows) -> np.ndarray:
    return rows.targets / rows.step_s[:, None]


def test_residual_is_taken_at_the_true_state_not_at_the_estimate(made):
    signals, truth = made.signals, truth_of(made.signals.stamps_ns, state_of(made))
    lost = replace(signals, ay_m_s2=signals.ay_m_s2 + 3.0, yaw_rate_rad_s=signals.yaw_rate_rad_s + 0.1)
    good, bad = rows_of(signals, truth), rows_of(lost, truth)
    assert np.abs(bad.features[:, 6] - good.features[:, 6]).max() > 0.3  # the filter is far off
    np.testing.assert_array_equal(bad.targets, good.targets)


def test_no_target_across_gaps_or_without_truth_or_steering(noisy):
    rows = rows_of(*noisy)
    index = np.round((rows.stamps_ns - START_NS) / 1e7).astype(int)
    gone = set(index[np.isnan(rows.targets).any(axis=1)].tolist())
    expected = {299, 499, 1202, *range(699, 720), *range(899, 905), int(index[-1])}
    assert gone == expected
    assert not rows.weight[np.isin(index, list(expected))].any()


def test_features_do_not_see_the_truth(noisy):
    signals, truth = noisy
    state = np.stack([truth.vx_m_s, truth.vy_m_s, truth.yaw_rate_rad_s], axis=1)
    a, b = rows_of(*noisy), rows_of(signals, truth_of(truth.stamps_ns, np.random.default_rng(1).permutation(state)))
    np.testing.assert_array_equal(a.features, b.features)
    np.testing.assert_array_equal(a.segment, b.segment)
    assert not np.array_equal(a.targets, b.targets, equal_nan=True)


# --- missing residual of physics -------------------------------------------------------------------------------------


def oracle_window(made: Drive, **signals: np.ndarray) -> tuple[Signals, StateTrack]:
    whole = replace(made.signals, friction=np.full(len(made.signals), FRICTION), **signals)
    return whole, truth_of(whole.stamps_ns, state_of(made))


@pytest.mark.slow
@pytest.mark.parametrize("names", [("lag",), ("lag", "roll", "load_transfer")], ids="+".join)
def test_physics_of_the_car_lacks_nothing_and_a_force_that_it_does_not_know_comes_out(names):
    """Drive the oracle's car by its equations; with 10 % less grip, the model lacks a force in proportion to a_y."""
    oracle = Oracle(parts(*names))
    made = oracle.drive(lambda t: 0.03 * np.sin(3.0 * t), 6.0)
    physics = VehicleUkf(oracle.as_vehicle())
    signals, truth = oracle_window(made)
    right = rates(residual_rows(signals, truth, physics, period_s=0.01))
    late = slice(100, -1)
    assert np.abs(right[late]).max() < 0.02
    told = replace(signals, friction=np.full(len(signals), 0.9 * FRICTION))
    lacks = rates(residual_rows(told, truth, physics, period_s=0.01))[late, 0]
    slope = float(made.ay[late] @ lacks / (made.ay[late] @ made.ay[late]))
    assert 0.04 < slope < 0.15


@pytest.mark.slow
def test_an_offset_of_the_steering_angle_is_no_residual():
    """The effect of the offset is removed before training; an alternating residual is not."""
    oracle = Oracle(parts("lag"))
    made = oracle.drive(lambda t: 0.02 * np.sin(3.0 * t), 12.0)
    off = made.signals.steer_rad + 0.002
    rows = residual_rows(*oracle_window(made, steer_rad=off), VehicleUkf(oracle.as_vehicle()), period_s=0.01)
    use = rows.weight > 0
    arrays = ResidualRows(**{name: getattr(rows, name)[use] for name in ResidualRows.__slots__})
    mean = (arrays.targets / arrays.step_s[:, None]).mean(axis=0)
    assert np.abs(mean).min() > 0.05
    assert np.abs(mean - training.steering_offset(arrays, oracle.as_vehicle())).max() < 0.2 * np.abs(mean).max()


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
        "chosen": np.ones(count, dtype=np.bool_),
    }
    return ResidualRows(**{**columns, **changes})


def sequence(count: int, value: float = 1.0) -> training.FeatureSequence:
    features = np.zeros((count, len(FEATURES)))
    features[:, 0] = np.arange(count) % 5
    features[:, 1] = value
    return training.FeatureSequence(features, np.tile([value, -2.0 * value], (count, 1)), np.ones(count))


def test_normalisation_is_by_weight_and_keeps_the_targets_zero():
    one = sequence(4, 3.0)
    one.weight[3] = 0.0
    found = training.normalisation_of([one, sequence(1, 1.0)], FEATURES[:2])
    assert found.feature_mean == pytest.approx(((0 + 1 + 2 + 0) / 4, (3 + 3 + 3 + 1) / 4))
    assert found.feature_std == pytest.approx((np.std([0, 1, 2, 0]), np.std([3, 3, 3, 1])))
    assert found.target_std == pytest.approx((math.sqrt(28 / 4), math.sqrt(4 * 28 / 4)))
    flat = training.normalisation_of([sequence(3, 0.0)], FEATURES[1:2])
    assert (flat.feature_std, flat.target_std) == ((1e-6,), (1e-6, 1e-6))
    with pytest.raises(ModelError, match="none"):
        training.normalisation_of([replace(one, weight=np.zeros(4))], FEATURES[:2])


def test_runs_end_at_new_segments_and_short_or_worthless_ones_are_left_out():
    segment = np.repeat([0, 1, 2, 3], [50, 49, 51, 50])
    weight = np.ones(200, dtype=np.float32)
    weight[150:] = 0.0
    drive = arrays(segment=segment, weight=weight)
    assert list(training.gap_free_runs(drive)) == [slice(0, 50), slice(99, 150)]
    drive.features[120, 3] = np.nan
    assert list(training.gap_free_runs(drive)) == [slice(0, 50)]


def test_a_recipe_is_the_papers_or_methods_with_the_callers_seed_and_epochs():
    own, paper = (training.make_recipe(paper=p, seed=5, epochs=None, device="cpu") for p in (False, True))
    assert own == training.Recipe(seed=5) and (paper.hidden, paper.seed, paper.epochs) == (128, 5, 200)
    assert training.make_recipe(paper=False, seed=0, epochs=1, device="cpu").epochs == 1
    with pytest.raises(UsageError, match="epoch"):
        training.make_recipe(paper=False, seed=0, epochs=0, device="cpu")
    if not torch.cuda.is_available():
        with pytest.raises(UsageError, match="--device"):
            training.make_recipe(paper=False, seed=0, epochs=None, device="cuda")


def test_what_is_not_chosen_teaches_nothing_and_only_what_leads_to_the_chosen_is_run():
    chosen = np.zeros(2000, dtype=np.bool_)
    chosen[[700, 740]] = True
    chosen[1500] = True
    weight = np.ones(2000, dtype=np.float32)
    weight[1500] = 0.0  # chosen, but of no use
    rows = arrays(2000, chosen=chosen, weight=weight)
    (run,) = training.gap_free_runs(rows)
    assert run == slice(700 - training.LEAD_STEPS, 741)
    assert rows.training_weight[run].sum() == 2.0
    cut = replace(rows, segment=np.where(np.arange(2000) < 720, 0, 1))
    assert list(training.gap_free_runs(cut)) == [slice(700 - training.LEAD_STEPS, 720)], (
        "what is left behind the cut is too short"
    )
