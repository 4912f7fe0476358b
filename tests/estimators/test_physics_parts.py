"""``physics`` of cars: drives that the parts of a car fit, and the values and noise that a car brings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from physics_oracle import Oracle, parts, vehicle
from reference_car import Drive, drive, slalom, with_noise

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.parts import FilterNoise, FittedPhysics, physics_sha256
from pdhef_logtool.car.vehicle import PhysicsParts, Tyres, VehicleParameters, correct_signals
from pdhef_logtool.estimators.algorithm import resolve
from pdhef_logtool.estimators.drive_signals import calibrated_signals
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.estimators.vehicle_ukf import VehicleUkf, physics_filter
from pdhef_logtool.records.signals import Signals

pytestmark = pytest.mark.slow


def sideslip_rmse(estimator, made: Drive, signals: Signals) -> float:
    track = run_estimator(estimator, signals)
    late = made.time_s > 1.0
    assert track.valid[late].all()
    return float(np.sqrt(np.mean((track.sideslip_rad - made.sideslip)[late] ** 2)))


def with_soft_tyres(v: VehicleParameters) -> VehicleParameters:
    tyres = Tyres(**{name: tyre.model_copy(update={"B": 0.5 * tyre.B}) for name, tyre in v.tyres})
    return v.model_copy(update={"tyres": tyres})


def test_beyond_the_linear_range_kinematics_count_more():
    """With half the tyre stiffness in the file, the error at the limit is lower; the linear range does not change."""
    oracle = Oracle(parts("lag"))
    v = oracle.as_vehicle()
    soft, made = with_soft_tyres(v), oracle.drive(slalom(0.09, 0.5), 8.0)
    noisy = with_noise(made.signals, 1)
    plain, yields = (sideslip_rmse(VehicleUkf(soft, limit_gain=gain), made, noisy) for gain in (0.0, 6.0))
    assert yields < 0.9 * plain
    linear = with_noise(oracle.drive(slalom(0.003, 0.5), 8.0).signals, 1)
    plain, yields = (run_estimator(VehicleUkf(v, limit_gain=gain), linear).vy_m_s for gain in (0.0, 6.0))
    np.testing.assert_array_equal(plain, yields)


@pytest.mark.parametrize("bias", [{"ay_m_s2": 0.15}, {"steer_rad": 0.0016}])
def test_a_bias_is_found_and_its_removal_helps(bias):
    """Each bias alone. Two biases, or a bias and the gyro's, are not distinguishable while the car moves."""
    oracle = Oracle(parts("lag"))
    made = oracle.drive(slalom(0.03, 0.5), 25.0, n=2)
    noisy = with_noise(made.signals, 4)
    biased = replace(noisy, **{c: getattr(noisy, c) + b for c, b in bias.items()})
    v = oracle.as_vehicle(physics=parts("lag", "biases"))
    estimator, ((column, value),) = physics_filter(v), bias.items()
    entry = {"ay_m_s2": estimator.layout.sensor_bias, "steer_rad": estimator.layout.steer_bias}[column]
    assert 0.3 < estimator.run(biased, None)[0].x[-500:, entry].mean() / value < 1.3
    without = physics_filter(oracle.as_vehicle())
    assert sideslip_rmse(physics_filter(v), made, biased) < 0.75 * sideslip_rmse(without, made, biased)


# --- the car ---------------------------------------------------------------------------------------------------------


def test_a_fitted_car_runs_on_its_values_and_on_signals_that_were_read_with_others():
    own, noisy = vehicle(), with_noise(drive(slalom(0.035, 0.5), 4.0, speed=22.0).signals, 3)
    fitted = own.model_copy(
        update={
            "steer_offset_rad": 0.003,
            "steering_ratio": 15.0,
            "sensors": own.sensors.model_copy(update={"ay_bias_m_s2": 0.2, "yaw_rate_bias_rad_s": 0.004}),
            "relaxation_length_m": 0.7,
            "physics": PhysicsParts(lag=True, roll=True),
        }
    )
    car = replace(
        Car(own, noise={"physics": FilterNoise()}), fitted_physics=FittedPhysics(values=fitted, noise=FilterNoise())
    )
    adaptive = make_estimator("physics", car)
    estimator = adaptive.physics
    assert estimator.vehicle == fitted
    assert resolve(adaptive).physics_sha256 == physics_sha256(fitted) != physics_sha256(own)
    assert resolve(estimator).identity == resolve(physics_filter(fitted, FilterNoise())).identity
    ours = run_estimator(estimator, calibrated_signals(correct_signals(noisy, own), car))
    raw = replace(noisy, steer_rad=noisy.steer_rad * own.steering_ratio / 15.0)
    want = run_estimator(physics_filter(fitted, FilterNoise()), correct_signals(raw, fitted))
    np.testing.assert_allclose(ours.sideslip_rad, want.sideslip_rad, rtol=1e-9, atol=1e-12)
