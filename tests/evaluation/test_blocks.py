"""A drive scored in small blocks against the same in one: figures, masks, intervals; and the memory that it takes."""

from __future__ import annotations

import tracemalloc
from contextlib import contextmanager
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pdhef_logtool.runs.track_store import TrackStore

from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.evaluation import blocks
from pdhef_logtool.evaluation.blocks import ErrorSums, SegmentMasks, median_step_ns, packed
from pdhef_logtool.evaluation.dead_reckoned import Seconds, position_error
from pdhef_logtool.evaluation.metrics import lag, nees, score_track
from pdhef_logtool.evaluation.metrics.disagreement import disagreement_rows
from pdhef_logtool.evaluation.metrics.innovations import state_rows
from pdhef_logtool.evaluation.metrics.sensor_residuals import sensor_rows
from pdhef_logtool.evaluation.metrics.whiteness import whiteness_rows
from pdhef_logtool.evaluation.reasons import summarise_reasons
from pdhef_logtool.evaluation.segments import find_intervals, moving_mask, segment_masks
from pdhef_logtool.records.reasons import REASONS
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import make_track
from pdhef_logtool.runs import track_store
from pdhef_logtool.runs.scoring import segment_events

T0 = 1_700_000_000_000_000_000
VEHICLE = default_vehicle()
#: Figures without sums: the same bits whatever the blocks.
EXACT = {"p95_abs", "max_abs", "availability", "coverage95", "lag_s", "diverged"}


@contextmanager
def blocks_of(rows):
    with patch.object(blocks, "BLOCK_ROWS", rows):
        yield


def some(rng, values, share=0.05):
    """Make stretches of values unknown."""
    values = np.array(values, dtype=float)
    for start in rng.integers(0, len(values), int(rng.integers(0, 6))):
        values[start : start + int(rng.integers(1, max(2, int(share * len(values)))))] = np.nan
    values[: len(values) // 2 if rng.random() < 0.1 else 0] = np.nan
    return values


def drive(seed, seconds=150.0, rate=20.0):
    """A drive at jittering stamps with gaps, slaloms that chain, corners, standstills and stretches without samples."""
    rng = np.random.default_rng(seed)
    n = int(seconds * rate)
    steps = rng.uniform(0.8, 1.2, n) / rate
    sparse = int(rng.integers(0, n))
    steps[sparse : sparse + 60] = 0.4
    steps[rng.random(n) < 0.02] = rng.choice([0.15, 0.3, 0.6, 3.0])
    t = np.cumsum(steps)
    stamps = T0 + np.round(t * 1e9).astype(np.int64)
    ay = rng.normal(0.0, 0.1, n)
    speed = np.full(n, float(rng.uniform(5.0, 20.0)))
    yaw_rate = rng.normal(0.0, 0.01, n)
    for start in np.arange(0.0, t[-1], 8.0):
        here = (t >= start) & (t < start + float(rng.uniform(3.0, 12.0)))
        match rng.integers(0, 4):
            case 0:
                ay = np.where(here, rng.uniform(1.2, 4.0) * np.sin(2 * np.pi * rng.uniform(0.2, 0.6) * t), ay)
            case 1:
                ay = np.where(here, rng.uniform(-5.0, 5.0), ay)
            case 2:
                speed = np.where(here, rng.uniform(0.0, 4.0), speed)
    signals = Signals(
        stamps_ns=stamps,
        ready_ns=stamps,
        steer_rad=np.zeros(n),
        ax_m_s2=some(rng, rng.normal(0.0, 0.2, n) + 3.0 * np.sign(np.sin(0.7 * t)) * (rng.random() < 0.7)),
        ay_m_s2=some(rng, ay),
        yaw_rate_rad_s=some(rng, yaw_rate),
        speed_m_s=np.where(rng.random(n) < 0.6, some(rng, speed), np.nan),
        friction=np.where(rng.random(n) < 0.5, 0.4, np.nan),
        wheel_speed_m_s=np.full((n, 4), np.nan),
    )

    def track(name, noise, covariance):
        vx, vy, rate_ = (some(rng, c + rng.normal(0.0, noise, n)) for c in (speed, 0.1 * ay, yaw_rate))
        pose = {"x_m": np.cumsum(speed * steps), "y_m": rng.normal(0.0, 0.01, n), "yaw_rad": np.zeros(n)}
        if covariance:
            root = rng.normal(0.0, 0.1, (n, 3, 3))
            pose["covariance"] = root @ root.transpose(0, 2, 1) + 1e-3 * np.eye(3)
            pose["sideslip_std_rad"] = np.full(n, 0.05)
        nothing = np.full(n, np.nan)
        return make_track(
            name,
            stamps,
            vx_m_s=nothing if rng.random() < 0.2 else vx,
            vy_m_s=vy,
            yaw_rate_rad_s=nothing if rng.random() < 0.2 else rate_,
            sideslip_rad=np.arctan2(vy, vx),
            ay_m_s2=nothing if rng.random() < 0.3 else some(rng, ay),
            nis=some(rng, rng.chisquare(2, n)),
            nis_dof=rng.integers(0, 3, n).astype(float),
            valid=some(rng, np.ones(n)) == 1.0,
            diverged=rng.random(n) < 0.1,
            reason=np.where(rng.random(n) < 0.2, REASONS[0].bit, 0),
            **{k: some(rng, c) if c.ndim == 1 else c for k, c in pose.items()},
        )

    truth = track("truth", 0.0, rng.random() < 0.5)
    return signals, truth, track("a", 0.3, rng.random() < 0.7), track("b", 0.1, False)


def assert_same_rows(rows, expected):
    def keys(of):
        return [(r.log, r.estimator, r.signal, r.segment, r.metric, r.unit, r.n, r.independent) for r in of]

    assert keys(rows) == keys(expected)
    for row, other in zip(rows, expected, strict=True):
        if row.metric in EXACT:
            assert row.value == other.value or np.isnan([row.value, other.value]).all(), row
        else:
            assert row.value == pytest.approx(other.value, rel=1e-12, abs=1e-11, nan_ok=True), row


SMALL = st.sampled_from([61, 250, 1000])


@pytest.mark.slow
@settings(derandomize=True, max_examples=40, deadline=None)
@given(st.integers(0, 10**6), SMALL, st.booleans())
def test_masks_and_intervals_do_not_know_the_blocks(seed, rows, with_truth):
    signals, truth, _, _ = drive(seed)
    truth = truth if with_truth else None
    whole, moving = segment_masks(signals, truth, VEHICLE), moving_mask(signals, truth, VEHICLE)
    events, spans = segment_events(signals, whole, ()), find_intervals(signals, {"moving": moving})
    with blocks_of(rows):
        parted = segment_masks(signals, truth, VEHICLE)
        np.testing.assert_array_equal(moving_mask(signals, truth, VEHICLE), moving)
        assert segment_events(signals, parted, ()) == events
        assert find_intervals(signals, {"moving": moving}) == spans
    assert tuple(parted) == tuple(whole)
    for name in whole:
        np.testing.assert_array_equal(parted[name], whole[name], err_msg=name)


@pytest.mark.slow
@settings(derandomize=True, max_examples=25, deadline=None)
@given(st.integers(0, 10**6), SMALL)
def test_figures_do_not_know_the_blocks(seed, rows):
    signals, truth, a, b = drive(seed)
    masks = segment_masks(signals, truth, VEHICLE)

    def figures():
        return [
            *score_track(a, truth, masks, log="drive", low_speed_m_s=3.0),
            *score_track(b, truth, masks, log="drive", low_speed_m_s=3.0),
            *state_rows(a, masks, log="drive"),
            *whiteness_rows(a, masks, log="drive"),
            *disagreement_rows([a, b], masks, log="drive", low_speed_m_s=3.0),
            *sensor_rows(signals, masks, log="drive", low_speed_m_s=3.0),
        ]

    expected = figures()

    def lateral_errors():
        seconds = Seconds()
        for first, end in blocks.row_blocks(len(truth)):
            seconds.add(a.rows(first, end), truth.rows(first, end))
        return seconds.lateral_errors()

    paths = position_error(a, truth), lateral_errors()
    reasons, step_ns = summarise_reasons(a), median_step_ns(signals)
    assert step_ns == np.median(np.diff(signals.stamps_ns))
    with blocks_of(rows), patch.object(nees, "NEES_ROWS", 50):
        assert_same_rows(figures(), expected)
        np.testing.assert_array_equal(position_error(a, truth), paths[0])
        np.testing.assert_array_equal(lateral_errors(), paths[1])
        assert summarise_reasons(a) == reasons
        assert median_step_ns(signals) == step_ns


@settings(derandomize=True, max_examples=200, deadline=None)
@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=300), st.integers(1, 300), st.integers(0, 50))
def test_figures_of_errors_are_those_of_numpy(errors, rows, more):
    e = np.array(errors)
    whole, parted = ErrorSums(len(e)), ErrorSums(len(e) + more)
    whole.add(e)
    for start in range(0, len(e), rows):
        parted.add(e[start : start + rows])
    size = np.abs(e)
    assert whole.figures() == {
        "rmse": np.sqrt(np.mean(e**2)),
        "mae": np.mean(size),
        "bias": np.mean(e),
        "p95_abs": np.percentile(size, 95.0),
        "max_abs": np.max(size),
    }
    for name, value in parted.figures().items():
        assert value == pytest.approx(whole.figures()[name], rel=0.0 if name in EXACT else 1e-12, abs=1e-9)
    assert parted.figures()["p95_abs"] == whole.figures()["p95_abs"]


def test_masks_take_a_bit_each_and_refuse_another_shape():
    masks = {f"m{i}": np.arange(7) % (i + 1) == 0 for i in range(10)}
    bits = packed(masks, 7)
    assert isinstance(bits, SegmentMasks)
    assert bits.bits.dtype == np.uint16
    for name, mask in masks.items():
        np.testing.assert_array_equal(bits[name], mask)
        np.testing.assert_array_equal(bits.rows(2, 5)[name], mask[2:5])
    for wrong in (masks, bits):
        with pytest.raises(ValueError, match="expected shape"):
            packed(wrong, 8)
    with pytest.raises(KeyError):
        bits["m10"]


@pytest.mark.slow
def test_scoring_a_stored_track_holds_few_columns(tmp_path, monkeypatch):
    monkeypatch.setattr(track_store, "ROWS_HELD", 0)
    signals, truth, estimate, _ = drive(3, seconds=2400.0)
    with TrackStore(tmp_path / "tracks") as store, patch.object(lag, "LAG_SPAN_NS", 10**10):
        expected = score_track(estimate, truth, {}, log="drive", low_speed_m_s=3.0)
        masks = segment_masks(signals, truth, VEHICLE)
        for track in (truth, estimate):
            store.append(track)
        store.append_signals(signals)
        of_truth, of_estimate = store.read("truth"), store.read("a")
        with blocks_of(300):
            tracemalloc.start()
            try:
                stored = segment_masks(store.signals(), of_truth, VEHICLE)
                found = score_track(of_estimate, of_truth, {}, log="drive", low_speed_m_s=3.0)
                peak = tracemalloc.get_traced_memory()[1]
            finally:
                tracemalloc.stop()
    assert_same_rows(found, expected)
    assert all(np.array_equal(stored[name], masks[name]) for name in masks)
    # What the estimates of a drive share of its truth, what a block takes, and masks of segments.
    assert peak < 4 * truth.vx_m_s.nbytes + 2 * len(truth.vx_m_s)


def test_a_truth_whose_square_is_beyond_floats_is_still_scored():
    stamps = T0 + np.arange(4, dtype=np.int64) * 10_000_000
    truth = make_track("truth", stamps, yaw_rate_rad_s=np.full(4, 1e200))
    estimate = make_track("a", stamps, yaw_rate_rad_s=np.full(4, 1e200))
    with np.errstate(over="ignore"):
        rows = score_track(estimate, truth, {}, log="drive", low_speed_m_s=3.0)
    assert {r.metric: r.value for r in rows if r.signal == "yaw_rate_rad_s"}["rmse_relative"] == 0.0
