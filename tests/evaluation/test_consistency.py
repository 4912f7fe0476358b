"""Consistency without truth: known residuals are found, a healthy drive shows none, and gaps are left out."""

from dataclasses import replace

import numpy as np
import pytest
from reference_car import signals_at

from pdhef_logtool import Car, read_drive
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters, corrected_anew, default_vehicle
from pdhef_logtool.drive.reading import WholeDrive
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.evaluation.metrics import EvaluatedDrive, MetricRow, evaluate_drive
from pdhef_logtool.evaluation.metrics.lateral_consistency import driven_consistency
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


def test_figures_of_a_segment_are_formulas_over_its_stamps_and_steps():
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
    found = evaluate_drive(EvaluatedDrive("drive", {"e": track}, None, drive(), {"turn": mask}, 3.0))
    rows = {r.metric: (r.value, r.n) for r in found if r.segment == "turn"}
    for metric, (value, count) in expected.items():
        assert rows[metric] == (pytest.approx(value, rel=1e-9), count)


SALOON = Car.load("saloon")
VEHICLE = SALOON.physics_vehicle


@pytest.fixture(scope="module")
def lane_change(sample_logs_dir):
    with read_drive(sample_logs_dir / "dlc.mcap", SALOON) as drive:
        return drive.whole()


def figure(
    tracks: list[StateTrack], drive: WholeDrive, vehicle: VehicleParameters = VEHICLE, delay_s: float = 0.0
) -> list[float]:
    named = {str(i): track for i, track in enumerate(tracks)}
    calibrated = CalibratedSignals(corrected_anew(drive.signals, SALOON.vehicle, vehicle), vehicle, delay_s)
    evaluated = EvaluatedDrive("", named, None, drive.signals, {}, 3.0, calibrated)
    return [row.value for row in evaluate_drive(evaluated, ("yaw_consistency",))]


def test_the_true_sideslip_explains_the_yaw_rate_and_zero_does_not(sample_logs_dir):
    with read_drive(sample_logs_dir / "road.mcap", SALOON) as drive:
        whole = drive.whole()
    road = replace(whole, signals=whole.signals.rows(0, 6000), truth=whole.truth.rows(0, 6000))
    zero = run_estimator(make_estimator("zero", SALOON), road.signals)
    true, none = figure([road.truth, zero], road)
    assert true < 0.1 * float(np.sqrt(np.nanmean(road.signals.yaw_rate_rad_s**2)))
    assert none > 3.0 * true


def test_a_gyro_bias_and_a_steering_delay_that_the_log_calibrated_are_taken_off(lane_change):
    signals, delay = lane_change.signals, 5
    late = np.concatenate([np.full(delay, signals.steer_rad[0]), signals.steer_rad[:-delay]])
    spoilt = replace(signals, steer_rad=late, yaw_rate_rad_s=signals.yaw_rate_rad_s + 0.02)
    bias = SALOON.vehicle.sensors.yaw_rate_bias_rad_s + 0.02
    sensors = VEHICLE.sensors.model_copy(update={"yaw_rate_bias_rad_s": bias})
    vehicle = VEHICLE.model_copy(update={"sensors": sensors})
    step_s = float(np.median(np.diff(signals.stamps_ns))) * 1e-9
    drive = replace(lane_change, signals=spoilt)
    (clean,), (ignored,) = (figure([lane_change.truth], of) for of in (lane_change, drive))
    (corrected,) = figure([lane_change.truth], drive, vehicle, -delay * step_s)
    assert corrected < 1.3 * clean < ignored


def test_there_is_no_figure_without_steering_or_speed(lane_change):
    nothing = np.full(len(lane_change.signals), np.nan)
    for name in ("steer_rad", "speed_m_s"):
        blind = replace(lane_change.signals, **{name: nothing})
        assert figure([lane_change.truth], replace(lane_change, signals=blind)) == []


SPEED, RATE, VY = 20.0 + 0.0 * T, 0.1 * np.sin(0.5 * T), 0.4 * np.sin(0.8 * T)
VY_RATE, YAW_ACCELERATION = 0.32 * np.cos(0.8 * T), 0.05 * np.cos(0.5 * T)
LEANING = default_vehicle().model_copy(update={"roll_gradient_rad_per_m_s2": 0.008, "imu_position_m": (0.7, 0.0, 0.0)})


def signals() -> Signals:
    """Return the readings of the vehicle's sensors for the motion above."""
    felt = VY_RATE + SPEED * RATE
    ay = (1.0 + GRAVITY_M_S2 * 0.008) * felt + 0.7 * YAW_ACCELERATION
    speed = np.where(np.arange(T.size) % 5 == 0, SPEED, np.nan)
    return signals_at(STAMPS, steer_rad=0.0, ax_m_s2=0.0, ay_m_s2=ay, yaw_rate_rad_s=RATE, speed_m_s=speed)


def track(vy: np.ndarray) -> StateTrack:
    return make_track("e", STAMPS, vx_m_s=SPEED, vy_m_s=vy, valid=np.ones(T.size, bool))


def d2(of: Signals, vy: np.ndarray) -> MetricRow:
    read = CalibratedSignals(of, LEANING)
    (row,) = evaluate_drive(EvaluatedDrive("drive", {"e": track(vy)}, None, of, {}, 3.0, read), ("d2",))
    return row


def driven(of: Signals, vy: np.ndarray) -> float:
    """Return the part of the consistency residual that correlates with the driving."""
    return driven_consistency(track(vy), CalibratedSignals(of, LEANING), 3.0)


def test_what_a_wrong_model_does_goes_with_the_driving_and_a_rough_road_does_not():
    wrong = VY + 0.02 * SPEED * RATE
    assert driven(signals(), VY) < 2e-3
    assert driven(signals(), wrong) == pytest.approx(d2(signals(), wrong).value, rel=0.02)
    road = replace(signals(), ay_m_s2=signals().ay_m_s2 + 0.3 * np.sin(2.3 * T))
    assert d2(road, VY).value > 0.1
    assert driven(road, VY) < 0.1 * d2(road, VY).value


def test_it_is_not_told_of_too_little_driving():
    short = CalibratedSignals(signals().rows(0, 900), LEANING)
    assert np.isnan(driven_consistency(track(VY).rows(0, 900), short, 3.0))
    assert np.isnan(driven(signals(), np.full(T.size, np.nan)))


def test_the_true_lateral_velocity_contradicts_nothing_once_the_sensors_are_known():
    row = d2(signals(), VY)
    assert (row.signal, row.metric, row.unit, row.segment) == ("vy_m_s", "d2", "m/s", "all")
    assert row.value < 2e-3
    assert row.n == T.size - 200 - 4  # two seconds before the first, and no speed behind the last sample


def test_it_is_the_change_of_the_error_over_two_seconds():
    error = 0.3 * np.sin(0.4 * T)
    change = error[200:] - error[:-200]
    found = d2(signals(), VY + error).value
    assert found == pytest.approx(float(np.sqrt(np.mean(change**2))), rel=0.01)
    assert d2(signals(), VY + 5.0).value < 2e-3  # a constant is not seen
