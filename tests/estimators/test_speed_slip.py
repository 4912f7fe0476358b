"""Speed gating: the filters receive no speed from spinning or locked wheels, but every other speed."""

from dataclasses import replace

import numpy as np
import pytest
from reference_car import drive, rolling_drive, slalom, with_noise

from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.estimators import stepwise, vehicle_ukf
from pdhef_logtool.estimators.filter_steps import U_SPEED
from pdhef_logtool.estimators.kinematic import Kinematic
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.open_loop import OpenLoop
from pdhef_logtool.estimators.speed_slip import TIMEOUT_S, believable
from pdhef_logtool.estimators.vehicle_ukf import VehicleUkf, nominal_filter
from pdhef_logtool.records.readings import without_impossible
from pdhef_logtool.records.signals import Signals

VEHICLE = default_vehicle()
SENSORS = VEHICLE.sensors
FILTERS = (nominal_filter(VEHICLE), VehicleUkf(VEHICLE))
ESTIMATORS = (Kinematic(VEHICLE), OpenLoop(VEHICLE), *FILTERS)


def start_and_stop(t: np.ndarray) -> np.ndarray:
    """Stand for 1 s, start with 1.5 m/s² up to 9 m/s, brake with 2 m/s² to a standstill."""
    return np.clip(np.minimum(1.5 * (t - 1.0), 9.0 - 2.0 * (t - 10.0)), 0.0, 9.0)


def spin(t: np.ndarray, at: float = 2.0, length: float = 2.5, size: float = 10.0) -> np.ndarray:
    """Return the excess speed of spinning wheels, m/s: one half sine."""
    return size * np.sin(np.pi * np.clip((t - at) / length, 0.0, 1.0)) ** 2


@pytest.fixture(scope="module")
def good():
    made = rolling_drive(start_and_stop, lambda t: 0.004 * np.sin(t), 20.0)
    return replace(made, signals=with_noise(made.signals, 3))


def believed(signals: Signals, **options) -> np.ndarray:
    return believable(signals, SENSORS, None, **options)[0].speed_m_s


def test_a_drive_without_slip_is_left_alone(good):
    assert believable(good.signals, SENSORS, None)[0] is good.signals
    made = drive(slalom(0.06, 0.7), 12.0, acceleration=lambda t: -6.0 if 4.0 < t < 6.0 else 0.0)
    noisy = with_noise(made.signals, 5)
    assert believable(noisy, SENSORS, None)[0] is noisy


@pytest.mark.parametrize("size", [10.0, 20.0])
def test_spinning_wheels_are_not_believed(good, size):
    slipping = replace(good.signals, speed_m_s=good.signals.speed_m_s + spin(good.time_s, size=size))
    out = believed(slipping)
    error = np.abs(out - good.vx)
    assert np.nanmax(error) < 2.0  # the bound plus the growth of the tolerance
    lasts = (good.time_s > 2.8) & (good.time_s < 3.8)
    assert np.isnan(out[lasts & np.isfinite(slipping.speed_m_s)]).all()
    away = (good.time_s < 2.0) | (good.time_s > 5.5)
    np.testing.assert_array_equal(out[away], slipping.speed_m_s[away])
    dead_reckoned = believed(slipping, reckoned=True)
    np.testing.assert_array_equal(np.isfinite(dead_reckoned), np.isfinite(slipping.speed_m_s))
    assert np.nanmax(np.abs(dead_reckoned - good.vx)) < 2.0


@pytest.mark.parametrize("estimator", ESTIMATORS, ids=lambda e: e.name)
@pytest.mark.slow
def test_all_estimators_heed_it(good, estimator, monkeypatch):
    slipping = replace(good.signals, speed_m_s=good.signals.speed_m_s + spin(good.time_s))
    gated, undisturbed = (run_estimator(estimator, s) for s in (slipping, good.signals))
    for module in (stepwise, vehicle_ukf):
        monkeypatch.setattr(module, "believable", lambda signals, _sensors, memory, **_: (signals, memory))
    plain, same = (run_estimator(estimator, s) for s in (slipping, good.signals))

    def worst(track):
        return np.nanmax(np.abs(track.vx_m_s - good.vx)[good.time_s > 0.5])

    assert worst(gated) < 1.5
    assert worst(plain) > 5.0
    assert gated.valid.sum() >= plain.valid.sum()
    np.testing.assert_array_equal(undisturbed.vy_m_s, same.vy_m_s)


def test_locked_wheels_are_not_believed_however_long_it_takes():
    """All wheels stand while the car slides from 20 m/s at 2 m/s²; then it stands, and that is believed."""
    made = rolling_drive(lambda t: np.clip(20.0 - 2.0 * np.clip(t - 2.0, 0, None), 0.0, None), np.zeros_like, 16.0)
    signals = with_noise(made.signals, 7)
    lock = np.clip((made.time_s - 2.0) / 0.3, 0.0, 1.0)
    locked = replace(signals, speed_m_s=np.maximum(signals.speed_m_s * (1.0 - lock), 0.0))
    out = believed(locked)
    sliding = (made.time_s > 2.5) & (made.vx > 4.0)
    assert made.time_s[sliding][-1] - 2.0 > TIMEOUT_S + 2.0
    assert np.isnan(out[sliding & np.isfinite(locked.speed_m_s)]).all()
    stands = made.time_s > 14.0
    np.testing.assert_array_equal(out[stands], locked.speed_m_s[stands])
    track = run_estimator(FILTERS[0], locked)
    assert np.abs(track.vx_m_s - made.vx)[sliding].max() < 1.0
    assert np.abs(track.vx_m_s[-100:]).max() < 0.02


def test_a_standstill_and_the_floor_of_the_pulses_are_no_slip(good):
    """No pulses below 0.8 m/s, with a start of 5 m/s²: the speed jumps, and stops dead."""
    made = rolling_drive(
        lambda t: np.clip(np.minimum(5.0 * (t - 1.0), 5.0 * (8.0 - t)), 0.0, 10.0), np.zeros_like, 12.0
    )
    signals = with_noise(made.signals, 8)
    read = np.where(signals.speed_m_s < 0.8, np.where(np.isfinite(signals.speed_m_s), 0.0, np.nan), signals.speed_m_s)
    floor = replace(signals, speed_m_s=read)
    assert believable(floor, SENSORS, None)[0] is floor


def test_a_speed_that_lasts_is_believed_in_the_end(good):
    jumped = replace(good.signals, speed_m_s=good.signals.speed_m_s + np.where(good.time_s > 4.0, 6.0, 0.0))
    out = believed(jumped)
    assert np.isnan(out[(good.time_s > 5.0) & (good.time_s < 8.0) & np.isfinite(jumped.speed_m_s)]).all()
    late = good.time_s > 4.0 + TIMEOUT_S + 0.5
    np.testing.assert_array_equal(out[late], jumped.speed_m_s[late])


def test_without_an_accelerometer_nothing_is_gated(good):
    blind = replace(good.signals, ax_m_s2=np.full(len(good.signals), np.nan))
    blind = replace(blind, speed_m_s=blind.speed_m_s + spin(good.time_s))
    assert believable(blind, SENSORS, None)[0] is blind


@pytest.mark.parametrize("estimator", FILTERS, ids=lambda e: e.name)
@pytest.mark.slow
def test_an_estimate_that_runs_backwards_against_the_speed_is_not_valid(estimator, good):
    """The accelerometer says braking, the speed sensor falls silent: v_x runs below zero."""
    silent = good.time_s > 9.0
    signals = without_impossible(good.signals)
    speed, ax = np.where(silent, np.nan, signals.speed_m_s), np.where(silent, -4.0, signals.ax_m_s2)
    signals = replace(signals, speed_m_s=speed, ax_m_s2=ax)
    steps, _ = estimator.run(signals, None)
    back = steps.x[:, 0] < 0.0
    assert back[-500:].all()
    assert (steps.inputs[back & silent, U_SPEED] > 0.5).all()
    track = run_estimator(estimator, signals)
    assert not track.valid[back & silent].any()
    assert track.valid[~back & (good.time_s > 0.5)].all()


@pytest.mark.parametrize("slope", [-2.0, 2.0])
def test_a_steep_hill_is_no_slip(good, slope):
    hill = replace(good.signals, ax_m_s2=good.signals.ax_m_s2 + slope)
    assert believable(hill, SENSORS, None)[0] is hill
