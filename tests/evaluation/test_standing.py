"""How an answer stands against physics: the figures of the tables, in blocks."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pdhef_logtool.evaluation.bootstrap import block_bootstrap_difference
from pdhef_logtool.evaluation.metrics import signal_error
from pdhef_logtool.evaluation.requirement_bounds import LEAST_BLOCKS
from pdhef_logtool.evaluation.standing import JUDGED_SIGNALS, Standing, standings
from pdhef_logtool.records.tracks import StateTrack, make_track

SLOW = 3.0


def tracks(seconds: float, **sigma_m_s: float) -> dict[str, StateTrack]:
    n = round(seconds * 20)
    stamps = 1_700_000_000_000_000_000 + np.arange(n, dtype=np.int64) * 50_000_000
    vy = np.sin(np.arange(n) / 40)
    found = {"truth": make_track("truth", stamps, vx_m_s=np.full(n, 20.0), vy_m_s=vy)}
    for seed, (name, sigma) in enumerate(sigma_m_s.items()):
        off = sigma * np.random.default_rng(seed).standard_normal(n)
        off[5:9] = np.nan
        found[name] = make_track(name, stamps, vx_m_s=np.full(n, 20.1), vy_m_s=vy + off)
    return found


def standing(made: dict[str, StateTrack], *rivals: str, signal: str = "sideslip_rad") -> Standing:
    found = standings("own", rivals, made.get, made["truth"], SLOW)
    assert [s.signal for s in found] == list(JUDGED_SIGNALS)
    return next(s for s in found if s.signal == signal)


def test_figures_are_those_of_the_bootstrap_over_the_whole_drive() -> None:
    made = tracks(100.0, own=0.1, physics=0.3, worse=0.5)
    error, other = (signal_error(made[n], made["truth"], "sideslip_rad", SLOW) for n in ("own", "physics"))
    stamps = made["truth"].stamps_ns
    found = standing(made, "worse", "physics")
    assert found.rmse is not None and found.difference is not None
    got, expected = found.difference, block_bootstrap_difference(error, other, stamps)
    assert got.blocks == expected.blocks == found.rmse.blocks
    np.testing.assert_allclose((got.value, got.low, got.high), (expected.value, expected.low, expected.high), rtol=1e-7)
    assert found.rmse.value == pytest.approx(float(np.sqrt(np.nanmean(error**2))))
    assert found.rmse.low < found.rmse.value < found.rmse.high
    assert found.rival == "physics"
    assert found.rival_rmse == pytest.approx(float(np.sqrt(np.nanmean(other**2))))


def test_a_short_drive_has_figures_and_no_interval() -> None:
    found = standing(tracks(10.0 * LEAST_BLOCKS - 11.0, own=0.1, physics=0.3), "physics")
    assert found.rmse is not None and found.difference is not None
    assert found.rmse.value > 0.0 and math.isnan(found.rmse.low) and math.isnan(found.difference.high)


def test_what_nobody_scores_has_no_figure() -> None:
    made = tracks(30.0, own=0.1, physics=0.3)
    assert standing(made, "physics", signal="yaw_rate_rad_s").rmse is None
    assert standing(made).rival is None
