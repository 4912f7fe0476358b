"""Ranking by the sideslip reference: only beyond its uncertainty."""

from __future__ import annotations

import numpy as np
import pytest

from pdhef_logtool.evaluation.metrics import EvaluatedDrive, evaluate_drive
from pdhef_logtool.records.tracks import make_track

N = 400
STAMPS = np.arange(N, dtype=np.int64) * 10_000_000


def _track(name, sideslip_deg, stamps=STAMPS, **columns):
    vx = np.full(N, 20.0)
    vy = vx * np.tan(np.radians(np.broadcast_to(sideslip_deg, N)))
    return make_track(name, stamps, vx_m_s=vx, vy_m_s=vy, yaw_rate_rad_s=np.zeros(N), **columns)


def _reference(independent, std_deg, stamps):
    columns = {"independent": np.full(N, independent), "sideslip_std_rad": np.full(N, np.radians(std_deg))}
    return _track("reference", 0.0, stamps, **columns)


def _rows(independent, std_deg=0.2, stamps=STAMPS):
    tracks = {name: _track(name, beta, stamps) for name, beta in (("near", 0.1), ("far", 1.0))}
    return _of(tracks | {"reference": _reference(independent, std_deg, stamps)})


def _of(tracks):
    return {(r.estimator, r.metric): r for r in evaluate_drive(EvaluatedDrive("a", tracks, None, None, {}, 3.0))}


def test_the_further_estimate_is_claimed():
    row = _rows(1.0)["near~far", "reference_further"]
    assert np.degrees(row.value) == pytest.approx(-0.9, abs=1e-6)
    assert row.n == N


@pytest.mark.parametrize(("std_deg", "claimed"), [(0.27, True), (0.29, False)])
def test_a_ranking_is_claimed_beyond_the_uncertainty_of_its_difference(std_deg, claimed):
    # 1.0² − 0.1² = 0.99 against 1.96 · 2 · 0.9 · std of one block
    rows = _rows(0.0, std_deg)
    assert (("near~far", "reference_further") in rows) == claimed
    assert rows["far", "reference_independent"].value == 0.0
    assert np.degrees(rows["far", "reference_std"].value) == pytest.approx(std_deg)


def test_errors_of_the_reference_average_out_over_blocks():
    stamps = STAMPS * 20  # eight blocks of 10 s
    assert ("near~far", "reference_further") in _rows(0.0, 0.7, stamps)
    assert ("near~far", "reference_further") not in _rows(0.0, 0.85, stamps)


def test_claims_are_right_as_often_as_they_state():
    rng = np.random.default_rng(5)
    wrong = claimed = 0
    for _ in range(200):
        error = np.repeat(rng.normal(0.0, 0.3, 8), N // 8)  # of the reference, with its standard deviation
        one, two = error + rng.normal(0.0, 0.3), error + rng.normal(0.0, 0.3)
        tracks = {"one": _track("one", one, STAMPS * 20), "two": _track("two", two, STAMPS * 20)}
        row = _of(tracks | {"reference": _reference(0.0, 0.3, STAMPS * 20)}).get(("one~two", "reference_further"))
        if row is not None:
            claimed += 1
            wrong += (abs(one - error)[0] > abs(two - error)[0]) != (row.value > 0.0)
    assert claimed > 50
    assert wrong <= 0.1 * claimed
