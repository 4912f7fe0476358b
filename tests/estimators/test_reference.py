"""The sideslip reference: comparison with an independent car and dense matrices, interval coverage, rejected inputs."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from reference_car import FRONT_M, REAR_M, START_NS, Drive, drive, tanh_tyre, with_noise

from pdhef_logtool.estimators import kinematic_filter as kinematics
from pdhef_logtool.estimators.prediction import sideslip_std
from pdhef_logtool.estimators.reference.drive import ReferencePrior, SideslipReference, refer
from pdhef_logtool.records.signals import FloatArray, Signals

PRIOR = ReferencePrior(REAR_M, REAR_M + FRONT_M, ay_gain=1.0)


def error_deg(driven: Drive, found: SideslipReference) -> tuple[FloatArray, FloatArray]:
    """Return error and 1-sigma of sideslip [K] in degrees."""
    error = np.arctan2(found.vy_m_s, found.vx_m_s) - np.interp(
        found.stamps_ns, driven.signals.stamps_ns, driven.sideslip
    )
    return np.degrees(error), np.degrees(std_rad(found))


def std_rad(found: SideslipReference) -> FloatArray:
    return sideslip_std(found.vx_m_s, found.vy_m_s, found.covariance[:, [[0, 1], [1, 2]]])


def driven_by(steer: Callable[[float], float]) -> Drive:
    """Drive for 30 s with tyres that saturate, and sensors with noise, biases and a gain of the speed."""
    made = drive(steer, 30.0, 25.0, tyre=tanh_tyre, speed_every=1)
    noisy = with_noise(made.signals, 1, 0.5)
    spoilt = {"ay_m_s2": noisy.ay_m_s2 + 0.1, "yaw_rate_rad_s": noisy.yaw_rate_rad_s + 0.002}
    spoilt |= {"speed_m_s": noisy.speed_m_s * 1.005, "steer_rad": made.signals.steer_rad}
    return replace(made, signals=replace(noisy, **spoilt))


def heading_rad(driven: Drive) -> FloatArray:
    return np.cumsum(driven.r) * 0.01


def with_gnss(driven: Drive, *, every: int = 10, std: float = 0.03, antenna_m: float = 0.5) -> Signals:
    """Return the signals with the antenna's velocity to the east and north."""
    signals = driven.signals
    n = len(signals)
    vy = driven.vy + antenna_m * signals.yaw_rate_rad_s
    heading = heading_rad(driven) + 0.7
    east = driven.vx * np.cos(heading) - vy * np.sin(heading)
    north = driven.vx * np.sin(heading) + vy * np.cos(heading)
    velocity = np.full((n, 2), np.nan)
    velocity[::every] = np.stack([east, north], axis=1)[::every]
    velocity += std * np.random.default_rng(3).standard_normal((n, 2))
    return replace(signals, gnss_velocity_m_s=velocity, gnss_velocity_std_m_s=np.full(n, np.nan))


def slalom(t: float) -> float:
    """Return a slalom of 0.4 Hz between straights."""
    return 0.02 * float(np.sin(2.0 * np.pi * 0.4 * t)) if 3.0 < t < 25.0 else 0.0


def slide(t: float) -> float:
    """Return a step that the tyres cannot follow, and back."""
    return 0.07 if 8.0 < t < 10.5 else 0.0


def long_slide(t: float) -> float:
    """Return a turn beyond the linear range that lasts."""
    return 0.055 if 5.0 < t < 27.0 else 0.0


SLALOM, SLIDE, LONG = (driven_by(steer) for steer in (slalom, slide, long_slide))


@pytest.mark.parametrize("driven", [SLALOM, SLIDE], ids=["linear", "limit"])
def test_the_reference_finds_sideslip_without_tyre_data_and_its_interval_contains_it(driven):
    found = refer(driven.signals, PRIOR)
    error, std = error_deg(driven, found)
    assert not found.refused
    assert np.sqrt(np.mean(error[found.valid] ** 2)) < 0.2
    assert np.mean(np.abs(error[found.valid]) < 1.96 * std[found.valid]) > 0.9
    assert found.valid.mean() > 0.6


def test_in_a_slide_the_reference_is_given_with_a_larger_standard_deviation():
    found = refer(SLIDE.signals, PRIOR)
    error, std = error_deg(SLIDE, found)
    seconds = (found.stamps_ns - START_NS) * 1e-9
    slides = (seconds > 8.5) & (seconds < 11.0)
    assert found.valid[slides].all()
    assert std[slides].max() > 1.8 * std[seconds < 7.0].mean()
    assert np.mean(np.abs(error[slides]) < 1.96 * std[slides]) > 0.9


def test_long_after_the_last_linear_driving_the_reference_is_not_valid():
    found = refer(LONG.signals, PRIOR)
    seconds = (found.stamps_ns - START_NS) * 1e-9
    trusted = std_rad(found) < np.radians(0.5)
    nearest = np.abs(seconds[:, None] - seconds[trusted]).min(axis=1)
    np.testing.assert_array_equal(found.valid[nearest > 5.1], False)
    assert found.valid[nearest < 4.9].all()
    assert nearest.max() > 5.1


def test_long_driving_at_the_limit_needs_gnss_and_the_interval_shows_it():
    alone = refer(LONG.signals, PRIOR)
    aided = refer(with_gnss(LONG), PRIOR)
    limit = (alone.stamps_ns - START_NS > 12e9) & (alone.stamps_ns - START_NS < 25e9)
    error_alone, std_alone = error_deg(LONG, alone)
    error_aided, std_aided = error_deg(LONG, aided)
    assert std_aided[limit].mean() < 0.6 * std_alone[limit].mean()
    assert np.sqrt(np.mean(error_aided[limit] ** 2)) < 0.3
    assert np.mean(np.abs(error_alone) < 2.5 * std_alone) > 0.95
    assert aided.gnss_share[limit].mean() > 0.5
    assert alone.gnss_share.max() == 0.0


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda s: replace(s, ay_m_s2=1.8 * s.ay_m_s2), "roll gain"),
        (lambda s: replace(s, speed_m_s=1.5 * s.speed_m_s), "implausible"),
    ],
    ids=["scaled a_y", "scaled speed"],
)
def test_a_drive_with_an_implausible_sensor_is_refused_with_the_parameter(change, named):
    found = refer(change(SLALOM.signals), PRIOR)
    assert named in found.refused
    assert " 1 is" not in found.refused  # the unit of a number
    assert not found.valid.any()


@pytest.mark.parametrize("moved_m", [-1.7, -0.5, 1.0])
def test_where_nothing_states_the_accelerometer_the_interval_contains_its_lever(moved_m):
    """The estimate uses the position from the file, because a free position would absorb errors of the axle law."""
    driven = SLALOM
    t = driven.signals.stamps_ns * 1e-9
    turning = np.gradient(driven.r, t - t[0])
    moved = replace(driven.signals, ay_m_s2=driven.signals.ay_m_s2 + moved_m * turning)
    stated, unknown = (refer(moved, replace(PRIOR, imu_x_std_m=0.05, unknown_imu_x_m=u)) for u in (0.0, 1.1))
    np.testing.assert_array_equal(stated.vy_m_s, unknown.vy_m_s)
    error, std = error_deg(driven, unknown)
    assert np.mean(np.abs(error) < 1.96 * std) > 0.95
    assert (std >= error_deg(driven, stated)[1]).all()
    assert unknown.valid.sum() <= stated.valid.sum()


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), east=st.booleans(), length=st.booleans())
def test_jacobians_of_the_measurements_equal_differences(seed, east, length):
    point, row = _drawn(np.random.default_rng(seed))
    row[kinematics.LENGTH] = float(length)
    for measurement, neglected in (
        (lambda q, h: kinematics.rear_axle(q, row, 1.5, h)[0], {kinematics.VX, kinematics.VY}),
        (lambda q, h: kinematics.speed(q, row, h)[0], set()),
        (lambda q, h: kinematics.gnss_velocity(q, row, east, h)[0], _OVER_THE_OFFSET),
        (lambda q, h: kinematics.no_yaw_rate(q, row, h)[0], set()),
    ):
        jacobian, scratch = np.zeros(kinematics.WITH_GNSS), np.zeros(kinematics.WITH_GNSS)
        measurement(point, jacobian)
        for i in set(range(kinematics.WITH_GNSS)) - neglected:
            up, down = _moved(point, i)
            slope = (measurement(down, scratch) - measurement(up, scratch)) / 2e-5
            assert jacobian[i] == pytest.approx(slope, abs=2e-5, rel=1e-5), i


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), tilts=st.booleans())
def test_the_cross_covariance_of_a_step_is_that_of_its_differences(seed, tilts):
    point, row = _drawn(np.random.default_rng(seed))
    row[kinematics.TILT] = float(tilts)
    n = kinematics.WITH_GNSS

    def step(state: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        new, predicted, cross = kinematics.predict(state, np.eye(n), state, 0.05, row, row, np.zeros(3))
        return new, predicted, cross

    _, predicted, cross = step(point)
    np.testing.assert_allclose(predicted, predicted.T, atol=1e-12)
    assert (np.linalg.eigvalsh(predicted - cross.T @ cross) > -1e-12).all()
    for i in set(range(n)) - _SECOND_ORDER:
        up, down = _moved(point, i)
        slope = (step(up)[0] - step(down)[0]) / 2e-5
        np.testing.assert_allclose(cross[i], slope, atol=1e-3, err_msg=str(i))


def _moved(point: FloatArray, i: int) -> tuple[FloatArray, FloatArray]:
    change = 1e-5 * (np.arange(len(point)) == i)
    return point + change, point - change


def _drawn(rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return a state and a row of inputs."""
    point = 0.05 * rng.standard_normal(kinematics.WITH_GNSS)
    point[kinematics.VX] = 15.0
    point[kinematics.HEADING] = rng.uniform(-3.0, 3.0)
    row = rng.standard_normal(kinematics.INPUTS)
    row[kinematics.LAW_STD] = 0.01
    return point, row


#: Errors of the IMU over the hundredths of a second between a knot and a GNSS sample, and on the yaw rate.
_NAMES = "AX_BIAS AY_BIAS ROLL_GAIN AX_GAIN IMU_X IMU_Y IMU_YAW YAW_RATE_BIAS YAW_RATE_GAIN"
_OVER_THE_OFFSET = {getattr(kinematics, name) for name in _NAMES.split()}
#: The transition neglects errors of the gyro in the centripetal term and in the tilt.
_SECOND_ORDER = {kinematics.YAW_RATE_BIAS, kinematics.YAW_RATE_GAIN}
