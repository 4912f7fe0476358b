"""Calibrated intervals: independent of windows, causal, monotone, and read only from valid files."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from reference_car import signals_at

from pdhef_logtool.car.car import INTERVALS_FILE, Car, load_intervals
from pdhef_logtool.car.parts import Algorithm, Inflation, IntervalEntry, Intervals
from pdhef_logtool.car.toml_files import vehicle_toml
from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.estimators.error_features import FLOOR_RAD, TERMS, error_terms
from pdhef_logtool.estimators.intervals import TrackCalibrator, inflated
from pdhef_logtool.records.errors import PdhefError
from pdhef_logtool.records.reasons import STUCK_AY, STUCK_YAW_RATE
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack, make_track
from tests.estimators.made_inflation import make_inflation

SIDESLIP_FACTORS = (1.0, 1.5, 0.3, 0.8, 0.5, 0.9, 0.2, 0.6, 0.4)
INFLATION = make_inflation(SIDESLIP_FACTORS, (0.5, 1.2, 0.7), 1.1, (1.0, 1.3, 2.0))
ROLL = 0.009
ALGORITHM = Algorithm(
    algorithm="vehicle-ukf",
    options={"roll_correction": True},
    noise={"q_std": [0.1, 0.1, 0.1]},
    physics_sha256="ab" * 32,
    network_sha256="12" * 32,
)


def _intervals(algorithm: Algorithm = ALGORITHM, inflation: Inflation = INFLATION, **changes: Any) -> Intervals:
    values = {
        "car": "car",
        "physics_sha256": "ab" * 32,
        "roll_gradient_rad_per_m_s2": ROLL,
        "entries": (IntervalEntry(estimator="e", algorithm=algorithm, inflation=inflation),),
    }
    return Intervals(**{**values, **changes})


def _calibrator(intervals: Intervals | None, *algorithms: Algorithm, name: str = "e") -> TrackCalibrator:
    return TrackCalibrator(intervals, {name: algorithms})


def _drive(count: int = 900, seed: int = 0) -> tuple[Signals, StateTrack]:
    """A slalom with noise, gaps, missing samples and irregular arrival; the estimate is not quite right."""
    rng = np.random.default_rng(seed)
    stamps = 10**18 + np.cumsum(rng.integers(9_000_000, 11_000_000, count)).astype(np.int64)
    stamps[count // 2 :] += 700_000_000
    t = (stamps - stamps[0]) * 1e-9
    vy, rate, vx = 0.3 * np.sin(3.0 * t), 0.25 * np.sin(3.0 * t + 0.4), np.full(count, 22.0)
    ay = np.gradient(vy, t) + vx * rate + rng.normal(0.0, 0.12, count)
    ay[rng.random(count) < 0.05] = np.nan
    ready = np.maximum.accumulate(stamps + rng.integers(1_000_000, 35_000_000, count))
    columns = {"ay_m_s2": ay, "yaw_rate_rad_s": rate + rng.normal(0.0, 0.004, count), "speed_m_s": vx}
    signals = signals_at(stamps, ready, steer_rad=0.0, ax_m_s2=0.0, friction=0.8, **columns)
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


@pytest.mark.parametrize("at", [100, 460, 700])
def test_what_has_not_arrived_changes_nothing(at: int) -> None:
    signals, track = _drive()
    late = signals.ready_ns > signals.stamps_ns[at]
    changed = replace(
        signals,
        ay_m_s2=np.where(late, 30.0, signals.ay_m_s2),
        yaw_rate_rad_s=np.where(late, 3.0, signals.yaw_rate_rad_s),
    )
    before = error_terms(track, signals, 0.009)
    after = error_terms(track, changed, 0.009)
    assert np.array_equal(before[: at + 1], after[: at + 1])
    assert not np.array_equal(before, after)


def test_the_estimate_stays_and_the_covariance_is_scaled_as_one() -> None:
    signals, track = _drive()
    out = inflated(track, error_terms(track, signals, ROLL), INFLATION)
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


def test_terms_see_a_wrong_sideslip_and_a_wrong_yaw_rate() -> None:
    signals, track = _drive()
    right = replace(track, vy_m_s=track.vy_m_s / 0.8, yaw_rate_rad_s=signals.yaw_rate_rad_s)
    untilted = error_terms(right, signals, 0.0)
    wrong = error_terms(replace(right, vy_m_s=0.5 * right.vy_m_s), signals, 0.0)
    late = slice(200, 440)
    kinematic, rate = TERMS.index("kinematic"), TERMS.index("yaw_rate")
    # Half of a swing of 0.3 m/s at 3 rad/s is lost; the high-pass of 0.3 s passes ωτ / √(1 + ω²τ²) = 0.67 of it.
    expected = 0.15 / np.sqrt(2.0) * 0.67 / 22.0
    assert np.all(untilted[late, kinematic] < 0.3 * expected)
    assert np.median(wrong[late, kinematic]) == pytest.approx(expected, rel=0.25)
    assert np.all(untilted[late, rate] == 0.0)
    off = error_terms(replace(right, yaw_rate_rad_s=right.yaw_rate_rad_s - 0.01), signals, 0.0)
    assert off[400, rate] == pytest.approx(0.01, rel=0.05)
    assert np.all(untilted[:, 0] == FLOOR_RAD)


def test_a_sensor_that_the_estimator_has_found_faulty_widens_nothing() -> None:
    signals, track = _drive()
    stuck = np.arange(900) >= 200
    signals = replace(signals, yaw_rate_rad_s=np.where(stuck, 0.4, signals.yaw_rate_rad_s))
    told = replace(track, reason=np.where(stuck, STUCK_YAW_RATE, 0))
    blind, seeing = (error_terms(t, signals, 0.009)[300:440, 5:7] for t in (track, told))
    assert np.all(seeing < 0.1 * blind)
    # A faulty accelerometer leaves the yaw rate's term alone.
    other = replace(track, reason=np.where(stuck, STUCK_AY, 0))
    assert np.array_equal(error_terms(other, signals, 0.009)[300:440, 6], blind[:, 1])


def test_without_an_entry_a_track_stays_as_it_is() -> None:
    signals, track = _drive(60)
    other = ALGORITHM.model_copy(update={"algorithm": "open-loop"})
    for intervals, ran in ((None, ALGORITHM), (_intervals(entries=()), ALGORITHM), (_intervals(), other)):
        calibrator = _calibrator(intervals, ran)
        assert calibrator.apply(track, signals) is track
        assert calibrator.notes("e")[0] == "intervals not calibrated"
        assert calibrator.notes("e")[1:] == ((calibrator.mismatch("e"),) if ran is other else ())
    assert calibrator.mismatch("e") == (
        "the calibrated intervals of e are not applied: expected vehicle-ukf 1 (roll_correction=True), "
        "got open-loop 1 (roll_correction=True)"
    )
    assert calibrator.warning == calibrator.mismatch("e")
    # Those of the shipped car were never this car's.
    assert TrackCalibrator(_intervals(), {"e": [other]}, of_car=False).mismatch("e") == ""
    assert _calibrator(_intervals(), ALGORITHM).mismatch("e") == ""
    assert _calibrator(None).notes("zero") == ()


def test_the_notes_say_for_what_intervals_were_made() -> None:
    signals, track = _drive(60)

    def notes(intervals: Intervals, ran: Algorithm = ALGORITHM) -> str:
        calibrator = _calibrator(intervals, ran)
        assert calibrator.apply(track, signals) is not track
        return "; ".join(calibrator.notes("e"))

    made = "intervals calibrated on car for friction and vehicle"
    assert notes(_intervals()) == f"{made} as given"
    assert notes(_intervals(spread=0.2)) == f"{made} with a spread of 20 %"
    for changes, said in (
        ({"physics_sha256": "cd" * 32}, "physics"),
        ({"noise": {"q_std": [0.1, 0.1, 0.2]}}, "filter noise"),
        ({"network_sha256": "34" * 32}, "network"),
        ({"use_speed": False}, "sensors (with or without the speed)"),
    ):
        assert notes(_intervals(), ALGORITHM.model_copy(update=changes)).endswith(f"as given, but with other {said}")
    # The current physics of the car do not matter, only the physics of the estimator that ran.
    assert notes(_intervals(physics_sha256="cd" * 32)) == f"{made} as given"


# ---- the file ----


def _document() -> dict[str, Any]:
    return _intervals().model_dump(mode="json")


def test_round_trip(tmp_path: Path) -> None:
    (tmp_path / INTERVALS_FILE).write_text(json.dumps(_document()))
    for path in (tmp_path, tmp_path / INTERVALS_FILE):
        assert load_intervals(path) == _intervals()


def test_which_intervals_a_run_takes(tmp_path: Path) -> None:
    folder = tmp_path / "car"
    folder.mkdir()
    (folder / "vehicle.toml").write_text(vehicle_toml(default_vehicle()))

    def taken(chosen: Path | str | None, car: Path | None = folder, network: str | None = None) -> str | None:
        intervals = Car.load(car, network=network, intervals=chosen).intervals
        return None if intervals is None else intervals.car

    shipped = Car.load("saloon").intervals
    assert shipped is not None
    assert taken(None) is None, "those of the shipped car are another car's"
    (folder / INTERVALS_FILE).write_text(json.dumps(_document() | {"car": "mine"}))
    assert taken(None) == "mine"
    assert taken("none") is None
    assert taken(folder, None) == taken(folder / INTERVALS_FILE, None) == "mine"
    assert taken(None, None) is None
    assert taken(None, Path("saloon")) == shipped.car
    assert taken(None, network="none") == "mine"
    with pytest.raises(PdhefError, match="elsewhere"):
        taken(tmp_path / "elsewhere")
