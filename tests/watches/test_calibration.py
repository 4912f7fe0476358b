"""Calibrated intervals: exact over windows, causal, monotone, and only from a file that says what it is."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pdhef_logtool.records.errors import ModelError
from pdhef_logtool.records.reasons import STUCK_AY, STUCK_YAW_RATE
from pdhef_logtool.records.signals import ALIGNED_SIGNALS, Signals
from pdhef_logtool.records.tracks import StateTrack, concatenate, make_track
from pdhef_logtool.watches.error_features import FLOOR_RAD, TERMS, error_terms
from pdhef_logtool.watches.intervals import (
    FILE,
    SIDESLIP_TERMS,
    UNSURE_FILE,
    YAW_RATE_TERMS,
    Calibration,
    Inflation,
    TrackCalibrator,
    calibrated,
    find_calibration,
    inflated,
    inflations_document,
    load_calibration,
)

STEP_NS = 10_000_000
INFLATION = Inflation((1.0, 1.5, 0.3, 0.8, 0.5, 0.9, 0.2), (0.5, 1.2, 0.7), 1.1)
CALIBRATION = Calibration({"e": INFLATION}, "car", "ab" * 32, 0.009)


def _drive(count: int = 900, seed: int = 0) -> tuple[Signals, StateTrack]:
    """A slalom with noise, gaps, missing samples and irregular arrival; the estimate is not quite right."""
    rng = np.random.default_rng(seed)
    stamps = 10**18 + np.cumsum(rng.integers(9_000_000, 11_000_000, count)).astype(np.int64)
    stamps[count // 2 :] += 700_000_000
    t = (stamps - stamps[0]) * 1e-9
    vy, rate, vx = 0.3 * np.sin(3.0 * t), 0.25 * np.sin(3.0 * t + 0.4), np.full(count, 22.0)
    ay = np.gradient(vy, t) + vx * rate + rng.normal(0.0, 0.12, count)
    ay[rng.random(count) < 0.05] = np.nan
    signals = Signals(
        stamps_ns=stamps,
        ready_ns=np.maximum.accumulate(stamps + rng.integers(1_000_000, 35_000_000, count)),
        steer_rad=np.zeros(count),
        ax_m_s2=np.zeros(count),
        ay_m_s2=ay,
        yaw_rate_rad_s=rate + rng.normal(0.0, 0.004, count),
        speed_m_s=vx,
        friction=np.full(count, 0.8),
        wheel_speed_m_s=np.full((count, 4), np.nan),
        available=frozenset(ALIGNED_SIGNALS),
    )
    covariance = np.tile(np.diag([0.01, 0.02, 1e-5]), (count, 1, 1))
    covariance[:, 0, 1] = covariance[:, 1, 0] = 0.004
    covariance[:, 1, 2] = covariance[:, 2, 1] = 1e-4
    std = np.full(count, np.sqrt(0.02) / 22.0)
    std[:3] = np.nan
    track = make_track(
        "e",
        stamps,
        vx_m_s=vx,
        vy_m_s=0.8 * vy,
        yaw_rate_rad_s=rate + 0.002 * np.sin(t),
        ay_m_s2=ay,
        covariance=covariance,
        sideslip_std_rad=std,
    )
    return signals, track


def _cut(record: Any, a: int, b: int) -> Any:
    """Return stamps a to b of signals or of a track."""
    changed = {f.name: getattr(record, f.name) for f in fields(record)}
    return replace(record, **{k: v[a:b] for k, v in changed.items() if isinstance(v, np.ndarray) and len(v)})


@pytest.mark.parametrize("cuts", [(0, 1, 2, 450, 900), (0, 7, 449, 451, 452, 899, 900), (0, 300, 300, 900)])
def test_joined_windows_equal_the_whole(cuts: tuple[int, ...]) -> None:
    signals, track = _drive()
    track = replace(track, reason=np.where(np.arange(900) % 250 < 40, STUCK_AY, 0))
    whole, _ = calibrated(track, signals, CALIBRATION)
    carry, parts = None, []
    for a, b in pairwise(cuts):
        part, carry = calibrated(_cut(track, a, b), _cut(signals, a, b), CALIBRATION, carry)
        if len(part):
            parts.append(part)
    joined = concatenate(parts)
    assert np.array_equal(joined.sideslip_std_rad, whole.sideslip_std_rad, equal_nan=True)
    assert np.array_equal(joined.covariance, whole.covariance)


@pytest.mark.parametrize("at", [100, 460, 700])
def test_what_has_not_arrived_changes_nothing(at: int) -> None:
    signals, track = _drive()
    late = signals.ready_ns > signals.stamps_ns[at]
    changed = replace(
        signals,
        ay_m_s2=np.where(late, 30.0, signals.ay_m_s2),
        yaw_rate_rad_s=np.where(late, 3.0, signals.yaw_rate_rad_s),
    )
    before, _ = error_terms(track, signals, 0.009, None)
    after, _ = error_terms(track, changed, 0.009, None)
    assert np.array_equal(before[: at + 1], after[: at + 1])
    assert not np.array_equal(before, after)


def test_the_estimate_stays_and_the_covariance_is_scaled_as_one() -> None:
    signals, track = _drive()
    out, _ = calibrated(track, signals, CALIBRATION)
    for name in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "sideslip_rad"):
        assert getattr(out, name) is getattr(track, name)
    assert np.array_equal(np.isnan(out.sideslip_std_rad), np.isnan(track.sideslip_std_rad))
    k = out.sideslip_std_rad[3:] / track.sideslip_std_rad[3:]
    np.testing.assert_allclose(out.vy_std_m_s[3:] / track.vy_std_m_s[3:], 1.1 * k)
    np.testing.assert_array_equal(out.vx_std_m_s, track.vx_std_m_s)
    before, after = track.covariance, out.covariance
    for i, j in ((0, 1), (1, 2)):
        correlation = [c[:, i, j] / np.sqrt(c[:, i, i] * c[:, j, j]) for c in (before, after)]
        np.testing.assert_allclose(correlation[0], correlation[1])
    assert np.all(np.linalg.eigvalsh(after) > 0.0)


def test_the_filters_own_term_alone_changes_nothing_but_the_scale() -> None:
    signals, track = _drive()
    terms, _ = error_terms(track, signals, 0.009, None)
    only = Inflation(
        tuple(2.0 * (t == "filter") for t in SIDESLIP_TERMS), tuple(3.0 * (t == "filter") for t in YAW_RATE_TERMS)
    )
    out = inflated(track, terms, only)
    np.testing.assert_allclose(out.sideslip_std_rad, 2.0 * track.sideslip_std_rad)
    np.testing.assert_allclose(out.yaw_rate_std_rad_s, 3.0 * track.yaw_rate_std_rad_s)


def test_the_interval_widens_with_every_term() -> None:
    _, track = _drive(50)
    track = replace(track, sideslip_std_rad=np.full(50, 0.001))
    terms = np.full((50, len(TERMS)), 0.001)
    base = inflated(track, terms, INFLATION).sideslip_std_rad
    np.testing.assert_allclose(base, 0.001 * np.sqrt(np.sum(np.square(INFLATION.sideslip))))
    for i in range(len(TERMS)):
        more = terms.copy()
        more[:, i] = 0.002
        assert np.all(inflated(track, more, INFLATION).sideslip_std_rad > base)


def test_terms_see_a_wrong_sideslip_and_a_wrong_yaw_rate() -> None:
    signals, track = _drive()
    right = replace(track, vy_m_s=track.vy_m_s / 0.8, yaw_rate_rad_s=signals.yaw_rate_rad_s)
    untilted = error_terms(right, signals, 0.0, None)[0]
    wrong = error_terms(replace(right, vy_m_s=0.5 * right.vy_m_s), signals, 0.0, None)[0]
    late = slice(200, 440)
    kinematic, rate = TERMS.index("kinematic"), TERMS.index("yaw_rate")
    # Half of a swing of 0.3 m/s at 3 rad/s is lost; the high-pass of 0.3 s passes ωτ / √(1 + ω²τ²) = 0.67 of it.
    expected = 0.15 / np.sqrt(2.0) * 0.67 / 22.0
    assert np.all(untilted[late, kinematic] < 0.3 * expected)
    assert np.median(wrong[late, kinematic]) == pytest.approx(expected, rel=0.25)
    assert np.all(untilted[late, rate] == 0.0)
    off = error_terms(replace(right, yaw_rate_rad_s=right.yaw_rate_rad_s - 0.01), signals, 0.0, None)[0]
    assert off[400, rate] == pytest.approx(0.01, rel=0.05)
    assert np.all(untilted[:, 0] == FLOOR_RAD)


def test_grip_follows_the_friction_that_is_told() -> None:
    signals, track = _drive()
    grip = TERMS.index("grip")
    high = error_terms(track, signals, 0.0, None)[0][:, grip]
    low = error_terms(track, replace(signals, friction=signals.friction / 2.0), 0.0, None)[0][:, grip]
    np.testing.assert_allclose(low, 2.0 * high)


def test_nothing_is_made_of_missing_samples() -> None:
    signals, track = _drive(60)
    nothing = np.full(60, np.nan)
    blind = replace(signals, ay_m_s2=nothing, yaw_rate_rad_s=nothing, friction=nothing)
    terms, _ = error_terms(track, blind, 0.009, None)
    assert np.all(np.isfinite(terms))
    assert np.all(terms[:, 3:] == 0.0)


def test_a_sensor_that_the_estimator_has_found_faulty_widens_nothing() -> None:
    signals, track = _drive()
    stuck = np.arange(900) >= 200
    signals = replace(signals, yaw_rate_rad_s=np.where(stuck, 0.4, signals.yaw_rate_rad_s))
    told = replace(track, reason=np.where(stuck, STUCK_YAW_RATE, 0))
    blind, seeing = (error_terms(t, signals, 0.009, None)[0][300:440, 5:] for t in (track, told))
    assert np.all(seeing < 0.1 * blind)
    # A faulty accelerometer leaves the yaw rate's term alone.
    other = replace(track, reason=np.where(stuck, STUCK_AY, 0))
    assert np.array_equal(error_terms(other, signals, 0.009, None)[0][300:440, 6], blind[:, 1])


def test_without_an_entry_a_track_stays_as_it_is() -> None:
    signals, track = _drive(60)
    for calibration in (None, replace(CALIBRATION, inflations={})):
        calibrator = TrackCalibrator(calibration, "ab" * 32)
        assert calibrator.add(track, signals) is track
        assert calibrator.notes("e") == ("intervals not calibrated",)
    assert TrackCalibrator(None, "").notes("zero") == ()


def test_the_notes_say_for_what_a_calibration_was_made() -> None:
    signals, track = _drive(60)

    def notes(calibration: Calibration, model: str | None) -> str:
        calibrator = TrackCalibrator(calibration, "ab" * 32, model)
        calibrator.add(track, signals)
        return "; ".join(calibrator.notes("e"))

    made = f"intervals calibrated by {FILE} (12345678) for friction and vehicle"
    assert notes(replace(CALIBRATION, sha256="1234567890"), None) == f"{made} as told"
    assert notes(replace(CALIBRATION, sha256="1234567890", spread=0.2), None) == f"{made} wrong by 0.2"
    assert "another vehicle file (car)" in notes(replace(CALIBRATION, vehicle_sha256="cd" * 32), None)
    assert "another network" in notes(replace(CALIBRATION, model_sha256="1"), "2")
    assert "another" not in notes(replace(CALIBRATION, model_sha256="1"), "1")


# ---- the file ----


def _document() -> dict[str, Any]:
    return {
        "format": "pdhef-calibration",
        "version": 1,
        "vehicle": {"name": "car", "sha256": "ab" * 32, "roll_gradient_rad_per_m_s2": 0.009},
        "model_sha256": None,
        "settings": {"vary": 0.0},
        "estimators": inflations_document({"e": INFLATION}),
    }


def test_round_trip(tmp_path: Path) -> None:
    (tmp_path / FILE).write_text(json.dumps(_document()))
    for path in (tmp_path, tmp_path / FILE):
        loaded = load_calibration(path)
        assert replace(loaded, sha256="") == CALIBRATION
        assert len(loaded.sha256) == 64


@pytest.mark.parametrize(
    "change",
    [
        {"format": "pdhef-tuning"},
        {"version": 2},
        {"vehicle": {}},
        {"estimators": {"e": {"sideslip": {}, "yaw_rate": {}, "vy_factor": 1.0}}},
        {"estimators": inflations_document({"e": replace(INFLATION, vy_factor=-1.0)})},
        {"estimators": inflations_document({"e": replace(INFLATION, yaw_rate=(1.0, float("nan"), 1.0))})},
        {"estimators": []},
        {"settings": {}},
    ],
)
def test_a_wrong_file_is_one_clear_error(tmp_path: Path, change: dict[str, Any]) -> None:
    path = tmp_path / "c.json"
    path.write_text(json.dumps(_document() | change))
    with pytest.raises(ModelError) as caught:
        load_calibration(path)
    assert "c.json" in str(caught.value)
    assert "pdhef calibrate" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [None, "{", "[]"])
def test_no_file_and_no_json(tmp_path: Path, content: str | None) -> None:
    path = tmp_path / "c.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(ModelError):
        load_calibration(path)


def test_which_calibration_a_run_takes(tmp_path: Path) -> None:
    model = tmp_path / "model"
    model.mkdir()
    assert find_calibration(None, model) is None
    (model / FILE).write_text(json.dumps(_document()))
    assert find_calibration(None, model) is not None
    assert find_calibration(Path("none"), model) is None
    assert find_calibration(model / FILE, Path("none")) is not None
    assert find_calibration(None, Path("none")) is None
    with pytest.raises(ModelError, match="unsure"):
        find_calibration(Path("unsure"), model)
    (model / UNSURE_FILE).write_text(json.dumps(_document()))
    assert find_calibration(Path("unsure"), model) is not None
    with pytest.raises(ModelError, match="no model"):
        find_calibration(Path("unsure"), Path("none"))


def test_an_estimator_that_is_another_one_has_its_intervals() -> None:
    signals, track = _drive()
    renamed = replace(track, name="hybrid")
    as_it_is = TrackCalibrator(CALIBRATION, "x").add(renamed, signals)
    as_another = TrackCalibrator(CALIBRATION, "x", stands_for={"hybrid": "e"}).add(renamed, signals)
    np.testing.assert_array_equal(as_it_is.sideslip_std_rad, track.sideslip_std_rad)
    own = TrackCalibrator(CALIBRATION, "x").add(track, signals)
    np.testing.assert_array_equal(as_another.sideslip_std_rad, own.sideslip_std_rad)
    assert as_another.name == "hybrid"
