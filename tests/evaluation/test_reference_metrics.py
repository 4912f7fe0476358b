"""Ranking by the sideslip reference: only where it is independent, and only beyond its uncertainty."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pdhef_logtool.evaluation.metrics.metric import EvaluatedDrive
from pdhef_logtool.evaluation.metrics.reference import METRICS
from pdhef_logtool.records.tracks import make_track

N = 400
STAMPS = np.arange(N, dtype=np.int64) * 10_000_000


def _track(name, sideslip_deg, **columns):
    vx = np.full(N, 20.0)
    vy = vx * np.tan(np.radians(np.broadcast_to(sideslip_deg, N)))
    return make_track(name, STAMPS, vx_m_s=vx, vy_m_s=vy, yaw_rate_rad_s=np.zeros(N), **columns)


def _rows(independent, std_deg=0.2):
    shares = {"independent": np.broadcast_to(np.asarray(independent, dtype=np.float64), N).copy()}
    reference = _track("reference", 0.0, sideslip_std_rad=np.full(N, np.radians(std_deg)), **shares)
    tracks = {"near": _track("near", 0.1), "far": _track("far", 1.0), "reference": reference}
    return _of(tracks)


def _of(tracks):
    masks = {"all": np.ones(N, dtype=np.bool_)}
    none: Any = None
    drive = EvaluatedDrive("a", tracks, None, none, masks, 3.0, none)
    (function,) = {m.function for m in METRICS}
    return {(r.estimator, r.metric): r for r in function.rows(drive)}


def test_the_further_estimate_is_claimed():
    row = _rows(1.0)["near~far", "reference_further"]
    assert np.degrees(row.value) == pytest.approx(-0.9, abs=1e-6)
    assert row.n == N


@pytest.mark.parametrize(("independent", "std_deg"), [(0.0, 0.31), (1.0, 1.0)], ids=["not independent", "uncertain"])
def test_nothing_is_claimed_by_the_same_imu_or_within_the_uncertainty(independent, std_deg):
    rows = _rows(independent, std_deg)
    assert ("near~far", "reference_further") not in rows
    assert rows["far", "reference_independent"].value == independent
    assert np.degrees(rows["far", "reference_std"].value) == pytest.approx(std_deg)


def test_only_independent_stamps_count_unless_the_difference_exceeds_three_standard_deviations():
    assert _rows(np.arange(N) < 100, 0.31)["near~far", "reference_further"].n == 100
    assert _rows(np.arange(N) < 100, 0.29)["near~far", "reference_further"].n == N
