"""Consistency without truth: known residuals are found, a healthy drive shows none, and gaps are left out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from reference_car import signals_at

from pdhef_logtool import Car, read_drive
from pdhef_logtool.car.vehicle import VehicleParameters, corrected_anew
from pdhef_logtool.drive.reading import WholeDrive
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.evaluation.metrics import EvaluatedDrive, MetricRow, evaluate_drive
from pdhef_logtool.evaluation.metrics.metric import CalibratedSignals
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack, make_track

T0 = 1_700_000_000_000_000_000
T = np.arange(0, 60, 0.01)
STAMPS = T0 + np.round(T * 1e9).astype(np.int64)


def drive() -> Signals:
    """Speed 20 + 4 sin(0.3 t), yaw rate 0.1 sin(0.5 t), no slip: a_x = v̇, a_y = v r exactly."""
    speed = 20 + 4 * np.sin(0.3 * T)
    rate = 0.1 * np.sin(0.5 * T)
    measured = np.where(np.arange(T.size) % 5 == 0, speed, np.nan)
    columns = {"ax_m_s2": 1.2 * np.cos(0.3 * T), "ay_m_s2": speed * rate, "yaw_rate_rad_s": rate}
    return signals_at(STAMPS, steer_rad=0.0, speed_m_s=measured, **columns)


def rows_of(tracks, signals=None, names=None, masks=None) -> list[MetricRow]:
    signals = drive() if signals is None else signals
    evaluated = EvaluatedDrive("drive", {t.name: t for t in tracks}, None, signals, masks or {}, 3.0)
    return evaluate_drive(evaluated, names)


def test_figures_of_a_segment_are_formulas_over_its_stamps_and_steps() -> None:
    n = T.size
    rng = np.random.default_rng(1)
    nis, dof = rng.chisquare(2, n), rng.choice([0.0, 1.0, 2.0], n)
    track = make_track("e", STAMPS, nis=nis, nis_dof=dof, diverged=rng.random(n) < 0.1)
    mask, has_nis, ratio = rng.random(n) < 0.7, dof > 0, nis / np.where(dof > 0, dof, 1.0)
    pairs = (has_nis & mask)[1:] & (has_nis & mask)[:-1]
    speed, step_s = 20 + 4 * np.sin(0.3 * T), 0.01
    held = speed[np.arange(n) // 5 * 5]
    expected = {
        "nis": (nis[mask & has_nis].mean(), (mask & has_nis).sum()),
        "nis_dof": (dof[mask & has_nis].mean(), (mask & has_nis).sum()),
        "diverged": (track.diverged[mask].mean(), mask.sum()),
        "nis_autocorrelation": (np.corrcoef(ratio[:-1][pairs], ratio[1:][pairs])[0, 1], pairs.sum()),
        "exposure_s": (mask.sum() * step_s, mask.sum()),
        "exposure_m": (held[mask].sum() * step_s, mask.sum()),
    }
    rows = {r.metric: (r.value, r.n) for r in rows_of([track], masks={"turn": mask}) if r.segment == "turn"}
    for metric, (value, count) in expected.items():
        assert rows[metric] == (pytest.approx(value, rel=1e-9), count)


SALOON = Car.load("saloon")
VEHICLE = SALOON.physics_vehicle


@pytest.fixture(scope="module")
def lane_change(sample_logs_dir: Path) -> WholeDrive:
    with read_drive(sample_logs_dir / "dlc.mcap", SALOON) as drive:
        return drive.whole()


def figure(
    tracks: list[StateTrack], drive: WholeDrive, vehicle: VehicleParameters = VEHICLE, delay_s: float = 0.0
) -> list[float]:
    named = {str(i): track for i, track in enumerate(tracks)}
    calibrated = CalibratedSignals(corrected_anew(drive.signals, SALOON.vehicle, vehicle), vehicle, delay_s)
    evaluated = EvaluatedDrive("", named, None, drive.signals, {}, 3.0, calibrated)
    return [row.value for row in evaluate_drive(evaluated, ("yaw_consistency",))]


def test_the_true_sideslip_explains_the_yaw_rate_and_zero_does_not(sample_logs_dir: Path) -> None:
    with read_drive(sample_logs_dir / "road.mcap", SALOON) as drive:
        whole = drive.whole()
    assert whole.truth is not None
    road = replace(whole, signals=whole.signals.rows(0, 6000), truth=whole.truth.rows(0, 6000))
    assert road.truth is not None
    zero = run_estimator(make_estimator("zero", SALOON), road.signals)
    true, none = figure([road.truth, zero], road)
    assert true < 0.1 * float(np.sqrt(np.nanmean(road.signals.yaw_rate_rad_s**2)))
    assert none > 3.0 * true


def test_a_gyro_bias_and_a_steering_delay_that_the_log_calibrated_are_taken_off(lane_change: WholeDrive) -> None:
    assert lane_change.truth is not None
    signals, delay = lane_change.signals, 5
    late = np.concatenate([np.full(delay, signals.steer_rad[0]), signals.steer_rad[:-delay]])
    spoilt = replace(signals, steer_rad=late, yaw_rate_rad_s=signals.yaw_rate_rad_s + 0.02)
    bias = SALOON.vehicle.sensors.yaw_rate_bias_rad_s + 0.02
    sensors = VEHICLE.sensors.model_copy(update={"yaw_rate_bias_rad_s": bias})
    vehicle = VEHICLE.model_copy(update={"sensors": sensors})
    step_s = float(np.median(np.diff(signals.stamps_ns))) * 1e-9
    drive = replace(lane_change, signals=spoilt)
    (clean,), (corrected,) = (
        figure([lane_change.truth], lane_change),
        figure([lane_change.truth], drive, vehicle, -delay * step_s),
    )
    (ignored,) = figure([lane_change.truth], drive)
    assert corrected < 1.3 * clean < ignored


def test_there_is_no_figure_without_steering_or_speed(lane_change: WholeDrive) -> None:
    assert lane_change.truth is not None
    nothing = np.full(len(lane_change.signals), np.nan)
    for name in ("steer_rad", "speed_m_s"):
        blind = replace(lane_change.signals, **{name: nothing})
        assert figure([lane_change.truth], replace(lane_change, signals=blind)) == []
