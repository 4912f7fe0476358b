"""``physics`` of cars: drives that the parts of a car fit, and the values and noise that a car brings."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from physics_oracle import ALL_PARTS, Oracle, parts, vehicle
from reference_car import Drive, drive, slalom, with_noise

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.parts import FilterNoise, FittedPhysics, FittedValues, physics_sha256
from pdhef_logtool.car.vehicle import PhysicsParts, Tyres, VehicleParameters, correct_signals
from pdhef_logtool.estimators.algorithm import resolve
from pdhef_logtool.estimators.drive_signals import calibrated_signals
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.estimators.table import Options, all_names, make_estimator
from pdhef_logtool.estimators.vehicle_ukf import PHYSICS_Q_STD, VehicleUkf, nominal_filter, of_car, physics_filter
from pdhef_logtool.records.signals import Signals

pytestmark = pytest.mark.slow


def sideslip_rmse(estimator, made: Drive, signals: Signals) -> float:
    track, _ = run_window(estimator, signals)
    late = made.time_s > 1.0
    assert track.valid[late].all()
    return float(np.sqrt(np.mean((track.sideslip_rad - made.sideslip)[late] ** 2)))


@pytest.mark.parametrize(
    ("names", "without", "share"),
    [(("lag",), (), 0.8), (("roll",), (), 0.7), (("lag", "roll"), ("lag",), 0.7), (("lag", "roll"), ("roll",), 0.9)],
    ids=str,
)
def test_the_parts_that_a_car_has_are_worth_having(names, without, share):
    oracle = Oracle(parts(*names), relaxation_m=0.7, swing_m=0.45)
    made = oracle.drive(slalom(0.03, 1.0), 8.0)
    for seed in (1, 2):
        noisy = with_noise(made.signals, seed)
        right = sideslip_rmse(physics_filter(oracle.as_vehicle()), made, noisy)
        wrong = sideslip_rmse(physics_filter(oracle.as_vehicle(physics=parts(*without))), made, noisy)
        assert right < share * wrong
        assert right < sideslip_rmse(nominal_filter(oracle.as_vehicle()), made, noisy)


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
    plain, yields = (run_window(VehicleUkf(v, limit_gain=gain), linear)[0].vy_m_s for gain in (0.0, 6.0))
    np.testing.assert_array_equal(plain, yields)


def test_a_file_that_nothing_has_validated_yields_at_the_limit():
    """Its tyres are half as stiff as the car's. In the linear range it is the filter of a car without lag."""
    oracle = Oracle(parts("lag", "roll"))
    soft = with_soft_tyres(oracle.as_vehicle(physics=PhysicsParts(roll=True)))
    made = oracle.drive(slalom(0.09, 0.5), 8.0)
    noisy = with_noise(made.signals, 1)
    bare = of_car(Car.of(soft))
    assert sideslip_rmse(bare, made, noisy) < 0.6 * sideslip_rmse(VehicleUkf(soft), made, noisy)
    linear = with_noise(oracle.drive(slalom(0.003, 0.5), 8.0).signals, 1)
    plain, yields = (run_window(f, linear)[0].vy_m_s for f in (VehicleUkf(soft), bare))
    np.testing.assert_array_equal(plain, yields)


def test_forces_of_the_axles_are_found():
    """Also a third of them that no tyre model knows of."""
    oracle = Oracle(parts("lag"))
    made = oracle.drive(slalom(0.03, 0.5), 8.0)
    v = oracle.as_vehicle()
    weak = v.tyres.front.model_copy(update={"D_n": 7600.0 / 1.5})
    v = v.model_copy(update={"tyres": Tyres(front=weak, rear=v.tyres.rear)})
    steps, _ = VehicleUkf(v, q_std=(*PHYSICS_Q_STD[:4], 10.0, 10.0)).run(made.signals, None)
    total = steps.x[:, 4] * np.cos(made.signals.steer_rad) + steps.x[:, 5]
    error = (total - made.ay)[made.time_s > 1.0]
    assert np.sqrt(np.mean(error**2)) < 0.1 * np.sqrt(np.mean(made.ay**2))


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


@pytest.mark.parametrize(("part", "entry", "value"), [("bank", "bank", 0.05), ("force_scale", "s", 0.1)])
def test_what_comes_and_goes_is_found(part, entry, value):
    """It fades as the filter thinks it does, and the estimate is better for it."""
    oracle = Oracle(parts("lag", part))
    made = oracle.drive(slalom(0.035, 0.6), 4.0, **{entry: value})
    noisy = with_noise(made.signals, 5)
    v, without = oracle.as_vehicle(), oracle.as_vehicle(physics=parts("lag"))
    steps, _ = physics_filter(v).run(noisy, None)
    fading = value * np.exp(-made.time_s / {"bank": 5.0, "force_scale": 2.0}[part])
    middle = (made.time_s > 0.5) & (made.time_s < 2.5)
    found = steps.x[:, getattr(physics_filter(v).layout, part)]
    assert 0.3 < found[middle].mean() / fading[middle].mean() < 1.3
    assert sideslip_rmse(physics_filter(v), made, noisy) < 0.95 * sideslip_rmse(physics_filter(without), made, noisy)


# --- the car ---------------------------------------------------------------------------------------------------------


def test_its_noise_comes_from_the_car_where_it_has_some():
    v = vehicle()
    bare = physics_filter(v)
    assert "physics" in all_names(Car.of(v))
    assert bare.q_std == PHYSICS_Q_STD
    assert bare.measurement_std.tolist() == [0.12, 0.004, 0.08]
    noise = FilterNoise(q_std=(0.05, 0.02, 0.02), r_std={"ay_m_s2": 0.8})
    car = Car.of(v, noise={"physics": noise})
    assert "physics" in all_names(car)
    tuned = make_estimator("physics", car).physics
    assert tuned.q_std == (0.05, 0.02, 0.02, *PHYSICS_Q_STD[3:])
    assert tuned.measurement_std.tolist() == [0.8, 0.004, 0.08]
    assert not make_estimator("physics", car, Options(use_speed=False)).physics.use_speed


def test_a_fitted_car_runs_on_its_values_and_on_signals_that_were_read_with_others():
    own, noisy = vehicle(), with_noise(drive(slalom(0.035, 0.5), 4.0, speed=22.0).signals, 3)
    sensors = {"ay_bias_m_s2": 0.2, "yaw_rate_bias_rad_s": 0.004}
    values = FittedValues(
        steer_offset_rad=0.003,
        steering_ratio=15.0,
        sensors=sensors,
        relaxation_length_m=0.7,
        physics=PhysicsParts(lag=True, roll=True),
    )
    car = replace(
        Car.of(own, noise={"physics": FilterNoise()}), fitted_physics=FittedPhysics(values=values, noise=FilterNoise())
    )
    adaptive = make_estimator("physics", car)
    estimator = adaptive.physics
    fitted = values.applied_to(own)
    assert estimator.vehicle == fitted
    assert resolve(adaptive).physics_sha256 == physics_sha256(fitted) != physics_sha256(own)
    assert resolve(estimator).identity == resolve(physics_filter(fitted, FilterNoise())).identity
    ours, _ = run_window(estimator, calibrated_signals(correct_signals(noisy, own), car))
    raw = replace(noisy, steer_rad=noisy.steer_rad * own.steering_ratio / 15.0)
    want, _ = run_window(physics_filter(fitted, FilterNoise()), correct_signals(raw, fitted), None)
    np.testing.assert_allclose(ours.sideslip_rad, want.sideslip_rad, rtol=1e-9, atol=1e-12)


def test_every_set_of_parts_has_its_own_digest():
    digests = {physics_sha256(vehicle(*c)) for k in range(3) for c in combinations(ALL_PARTS, k)}
    assert len(digests) == 1 + 7 + 21
