"""The yaw rate that tyres cause at a v_y: small for the true one, large for others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool import Car, read_drive
from pdhef_logtool.car.vehicle import VehicleParameters, corrected_anew
from pdhef_logtool.drive.reading import WholeDrive
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.evaluation.metrics import EvaluatedDrive, evaluate_drive
from pdhef_logtool.evaluation.metrics.metric import CalibratedSignals
from pdhef_logtool.records.tracks import StateTrack

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
