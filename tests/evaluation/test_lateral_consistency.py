"""Lateral kinematic consistency: the residual of v̇_y against the sensors, without ground truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reference_car import signals_at

from pdhef_logtool.car.vehicle import GRAVITY_M_S2, default_vehicle
from pdhef_logtool.evaluation.metrics import EvaluatedDrive, MetricRow, evaluate_drive
from pdhef_logtool.evaluation.metrics.lateral_consistency import driven_consistency
from pdhef_logtool.evaluation.metrics.metric import CalibratedSignals
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack, make_track

T = np.arange(0, 60, 0.01)
STAMPS = 1_700_000_000_000_000_000 + np.round(T * 1e9).astype(np.int64)
SPEED, RATE, VY = 20.0 + 0.0 * T, 0.1 * np.sin(0.5 * T), 0.4 * np.sin(0.8 * T)
VY_RATE, YAW_ACCELERATION = 0.32 * np.cos(0.8 * T), 0.05 * np.cos(0.5 * T)
VEHICLE = default_vehicle().model_copy(update={"roll_gradient_rad_per_m_s2": 0.008, "imu_position_m": (0.7, 0.0, 0.0)})


def signals() -> Signals:
    """Return the readings of the vehicle's sensors for the motion above."""
    felt = VY_RATE + SPEED * RATE
    ay = (1.0 + GRAVITY_M_S2 * 0.008) * felt + 0.7 * YAW_ACCELERATION
    speed = np.where(np.arange(T.size) % 5 == 0, SPEED, np.nan)
    return signals_at(STAMPS, steer_rad=0.0, ax_m_s2=0.0, ay_m_s2=ay, yaw_rate_rad_s=RATE, speed_m_s=speed)


def track(vy: np.ndarray) -> StateTrack:
    return make_track("e", STAMPS, vx_m_s=SPEED, vy_m_s=vy, valid=np.ones(T.size, bool))


def d2(of: Signals, vy: np.ndarray) -> MetricRow:
    read = CalibratedSignals(of, VEHICLE)
    (row,) = evaluate_drive(EvaluatedDrive("drive", {"e": track(vy)}, None, of, {}, 3.0, read), ("d2",))
    return row


def driven(of: Signals, vy: np.ndarray) -> float:
    """Return the part of the consistency residual that correlates with the driving."""
    return driven_consistency(track(vy), CalibratedSignals(of, VEHICLE), 3.0)


def test_what_a_wrong_model_does_goes_with_the_driving_and_a_rough_road_does_not() -> None:
    wrong = VY + 0.02 * SPEED * RATE
    assert driven(signals(), VY) < 2e-3
    assert driven(signals(), wrong) == pytest.approx(d2(signals(), wrong).value, rel=0.02)
    road = replace(signals(), ay_m_s2=signals().ay_m_s2 + 0.3 * np.sin(2.3 * T))
    assert d2(road, VY).value > 0.1
    assert driven(road, VY) < 0.1 * d2(road, VY).value


def test_it_is_not_told_of_too_little_driving() -> None:
    short = CalibratedSignals(signals().rows(0, 900), VEHICLE)
    assert np.isnan(driven_consistency(track(VY).rows(0, 900), short, 3.0))
    assert np.isnan(driven(signals(), np.full(T.size, np.nan)))


def test_the_true_lateral_velocity_contradicts_nothing_once_the_sensors_are_known() -> None:
    row = d2(signals(), VY)
    assert (row.signal, row.metric, row.unit, row.segment) == ("vy_m_s", "d2", "m/s", "all")
    assert row.value < 2e-3
    assert row.n == T.size - 200 - 4  # two seconds before the first, and no speed behind the last sample


def test_it_is_the_change_of_the_error_over_two_seconds() -> None:
    error = 0.3 * np.sin(0.4 * T)
    change = error[200:] - error[:-200]
    found = d2(signals(), VY + error).value
    assert found == pytest.approx(float(np.sqrt(np.mean(change**2))), rel=0.01)
    assert d2(signals(), VY + 5.0).value < 2e-3  # a constant is not seen
