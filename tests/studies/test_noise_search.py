"""Search for the noise of the tuned filters of the shipped car."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pdhef_logtool.evaluation.metrics import score_track
from pdhef_logtool.records.tracks import make_track
from studies.defaults.noise import HIGH, LOW, Point, error_rad, objective_deg, search

OPTIMUM = (0.3, 0.05, 1.5, 0.004)


def _bowl(values: Point) -> float:
    """Return an objective that grows with the distance from the optimum in logarithms."""
    return 0.1 + sum(math.log(v / o) ** 2 for v, o in zip(values, OPTIMUM, strict=True))


@pytest.mark.parametrize("seed", range(2))
def test_the_search_finds_the_optimum_inside_its_ranges(seed: int) -> None:
    trials = search(_bowl, 128, seed)
    assert trials == search(_bowl, 128, seed) != search(_bowl, 128, seed + 1)
    best = min(trials, key=lambda t: t.objective_deg)
    assert best.number >= 64, "the refinement improves on the exploration"
    assert np.abs(np.log(np.array(best.values) / OPTIMUM)).max() < math.log(1.4)
    values = np.array([t.values for t in trials])
    assert ((values >= LOW * 0.999) & (values <= HIGH * 1.001)).all()


def test_the_objective_is_the_geometric_mean_over_drives_with_a_floor() -> None:
    errors = np.radians([0.1, 0.4, 3.2])
    expected = math.prod(math.hypot(rmse, 0.05) for rmse in (0.1, 0.4, 3.2)) ** (1 / 3)
    assert objective_deg(errors) == pytest.approx(expected)
    assert objective_deg([1e-9]) == pytest.approx(0.05)


def test_the_error_of_a_drive_is_that_of_a_run_unless_too_much_is_missing() -> None:
    rng, count = np.random.default_rng(1), 400
    stamps = 10**18 + np.arange(count, dtype=np.int64) * 10_000_000
    vx = np.where(np.arange(count) < 100, 1.0, 20.0)
    truth = make_track("truth", stamps, vx_m_s=vx, vy_m_s=rng.normal(0, 5.0, count), valid=rng.random(count) > 0.1)
    near = make_track("e", stamps, vx_m_s=vx, vy_m_s=truth.vy_m_s + 0.1, valid=rng.random(count) > 0.05)
    rows = {(r.signal, r.metric): r for r in score_track(near, truth, {}, log="x", low_speed_m_s=3.0)}
    assert error_rad(near, truth, 3.0) == rows["sideslip_rad", "rmse"].value
    zero = error_rad(replace(truth, sideslip_rad=np.zeros(count)), truth, 3.0)
    for share in (0.8, 0.0):
        missing = replace(near, valid=near.valid & (rng.random(count) < share))
        assert error_rad(missing, truth, 3.0) == pytest.approx(zero)
