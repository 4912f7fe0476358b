"""Fit of a car to a drive: recovered parameters of a known car, rejected drives, and what earlier drives change."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference_car import FRICTION, Drive, drive, keep, with_noise

from pdhef_logtool.car.model import TaughtParameter
from pdhef_logtool.car.posterior import Posterior
from pdhef_logtool.car.vehicle import AxleTyre, Tyres, VehicleParameters, default_vehicle
from pdhef_logtool.model import fit as rules
from pdhef_logtool.model import priors
from pdhef_logtool.model.driving import STEP_S, Driving, driving_of
from pdhef_logtool.model.fit import fit_car
from pdhef_logtool.model.priors import REAR_STIFFNESS, prior_of
from pdhef_logtool.records.signals import Signals

RIGHT = default_vehicle()
#: A vehicle file: the tyres of the default sedan are no statement about a car.
RIGHT_FILE = RIGHT.with_stiffness(1.001, 1.001)


def wrong(front: float, rear: float, vehicle: VehicleParameters = RIGHT) -> VehicleParameters:
    """Return a vehicle with the axle stiffness multiplied by factors and unchanged peak forces."""

    def of(tyre: AxleTyre, factor: float) -> AxleTyre:
        assert tyre.B is not None
        return tyre.model_copy(update={"B": tyre.B * factor})

    tyres = Tyres(front=of(vehicle.tyres.front, front), rear=of(vehicle.tyres.rear, rear))
    return vehicle.model_copy(update={"tyres": tyres})


def sweep(amplitude: float) -> Callable[[float], float]:
    """Return steering that sweeps from 0.2 to 1.2 Hz in 20 s, again and again."""
    return lambda t: amplitude * math.sin(2.0 * math.pi * (0.2 * (t % 20.0) + 0.025 * (t % 20.0) ** 2))


@cache
def wide() -> Drive:
    return drive(sweep(0.02), 60.0)


def driving(signals: Signals, vehicle: VehicleParameters) -> Driving:
    return driving_of(signals, vehicle)


def found(signals: Signals, vehicle: VehicleParameters) -> Posterior:
    return fit_car(driving(signals, vehicle), vehicle)


def stiffness_errors(posterior: Posterior) -> list[tuple[float, float]]:
    """Return the errors of the logarithm of the rear axle's stiffness and of the ratio of the axles, and their sd."""
    rear, front = (RIGHT.cornering_stiffness_n_per_rad(axle, FRICTION) for axle in (False, True))
    true = {REAR_STIFFNESS: rear, priors.RATIO: front / priors.front_stiffness(RIGHT, 1.0, rear)}
    by = {p.name: p for p in posterior.parameters}
    return [(math.log(by[name].value / value), by[name].sd) for name, value in true.items()]


@pytest.mark.slow
@pytest.mark.parametrize(("front", "rear"), [(1.0, 1.0), (2.0, 0.5), (0.5, 0.7)])
def test_a_sweep_finds_the_stiffness_within_its_own_posterior_whatever_the_file_says(front, rear):
    calibration = found(with_noise(wide().signals, 3), wrong(front, rear))
    assert not calibration.refused
    for error, sd in stiffness_errors(calibration):
        assert abs(error) < min(3.0 * sd, 0.13)
        assert sd < 0.15


def test_biases_offset_and_gain_of_the_sensors_are_found():
    signals = with_noise(wide().signals, 4)
    signals = replace(signals, ay_m_s2=1.05 * signals.ay_m_s2 + 0.1, steer_rad=signals.steer_rad + 0.005)
    file = RIGHT.model_copy(update={"roll_gradient_rad_per_m_s2": 0.0})
    by = {p.name: p for p in found(signals, file).parameters}
    for name, true in (("roll gain", 1.05), ("a_y bias", 0.1), ("steering offset", 0.005)):
        assert abs(by[name].value - true) < 3.0 * by[name].sd, name


@pytest.mark.parametrize("metres", [-1.71, 0.0, 1.0])
def test_the_position_of_the_accelerometer_is_found(metres):
    """The first one is at the rear axle, where v_y is small and a_y alone agrees with no sideslip at all."""
    signals = with_noise(wide().signals, 7)
    turning = np.gradient(wide().r, signals.stamps_ns * 1e-9)
    moved = replace(signals, ay_m_s2=signals.ay_m_s2 + metres * turning)
    by = {p.name: p for p in found(moved, RIGHT).parameters}
    position = by["lever of a_y"]
    assert position.excited
    assert abs(position.value - metres) < 1.96 * position.sd


@pytest.mark.parametrize("share", [0.5, 0.3])
def test_a_slippery_road_is_found_although_the_file_is_of_a_dry_one(share):
    """The file's tyres have the stiffness of the car's and more grip, as a file for asphalt has of a car on ice."""
    dry = Tyres(**{n: t.model_copy(update={"B": share * t.B, "D_n": t.D_n / share}) for n, t in RIGHT.tyres})
    file = RIGHT.model_copy(update={"tyres": dry, "friction": None})
    signals = with_noise(drive(sweep(0.08), 20.0).signals, 12)
    by = {p.name: p for p in found(replace(signals, friction=np.full(len(signals), np.nan)), file).parameters}
    peak = by["peak force over the file's"]
    assert peak.excited
    assert abs(math.log(peak.value / (share * FRICTION))) < min(3.0 * peak.sd, 0.2)


def test_errors_that_no_parameter_explains_leave_the_prior():
    signals = with_noise(wide().signals, 10)
    rng = np.random.default_rng(11)
    rate, ay = (std * rng.standard_normal(len(signals)) for std in (1.0, 15.0))
    unexplained = replace(signals, yaw_rate_rad_s=signals.yaw_rate_rad_s + rate, ay_m_s2=signals.ay_m_s2 + ay)
    for p in found(unexplained, RIGHT).parameters:
        distance = math.log(p.value / p.prior) if p.log else p.value - p.prior
        assert abs(distance) < 2.0 * p.prior_sd, p.name


def test_slow_driving_calibrates_and_very_slow_driving_is_refused():
    file = wrong(0.6, 0.6).model_copy(update={"relaxation_length_m": 0.1})  # the forces of this car do not lag
    slow = found(with_noise(drive(sweep(0.08), 60.0, speed=7.0).signals, 9), file)
    assert not slow.refused
    for error, sd in stiffness_errors(slow):
        assert abs(error) < 1.96 * sd
    walking = found(drive(sweep(0.02), 20.0, speed=RIGHT.low_speed_blend_m_s - 1.0).signals, RIGHT)
    assert "0 s above" in walking.refused
    short = found(drive(sweep(0.02), 4.0).signals, RIGHT)
    assert "are needed" in short.refused
    assert short.vehicle is RIGHT


def test_what_straight_driving_does_not_excite_keeps_its_prior():
    straight = found(with_noise(drive(lambda _t: 0.0, 60.0).signals, 5), RIGHT)
    assert not straight.refused
    for p in straight.parameters:
        if p.name == REAR_STIFFNESS:
            assert not p.excited
            assert p.value == pytest.approx(p.prior, rel=0.1)
    assert "rear cornering stiffness" in straight.text.partition("not excited: ")[2]


def test_a_right_file_decides_what_gentle_driving_cannot_and_a_wrong_one_does_not():
    signals = with_noise(drive(sweep(0.001), 20.0).signals, 3)

    def level_error(file: VehicleParameters) -> float:
        return abs(stiffness_errors(found(signals, file))[0][0])

    right, wrong_level, without_file = (level_error(file) for file in (wrong(1.001, 1.001), wrong(2.0, 0.5), RIGHT))
    assert right < 0.7 * without_file
    assert wrong_level < 0.7 * math.log(2.0)


def test_a_noisy_accelerometer_is_accepted_and_one_of_another_sensor_refused():
    """Vibration of 4 m/s² in samples of 20 Hz exceeds the lateral acceleration, but not its gain of 1."""
    signals, noise = wide().signals, np.random.default_rng(2).normal(0.0, 4.0, len(wide().signals))
    slow = np.repeat(noise[::5], 5)[: len(noise)]
    noisy = found(replace(signals, ay_m_s2=signals.ay_m_s2 + slow), RIGHT)
    assert not noisy.refused
    assert "the lateral acceleration" in found(replace(signals, ay_m_s2=slow), RIGHT).refused


def test_a_car_that_slides_all_the_time_is_refused(monkeypatch):
    monkeypatch.setattr(rules, "SLIDING_RAD", 0.001)
    signals = wide().signals
    slides = found(signals, RIGHT)
    assert "the rear axle slides in" in slides.refused
    assert slides.reached_friction == pytest.approx(np.abs(signals.ay_m_s2).max() / 9.81, rel=0.1)


def test_a_drive_overrules_earlier_drives_that_it_contradicts():
    log, rear = driving(wide().signals, RIGHT), RIGHT.cornering_stiffness_n_per_rad(False, FRICTION)
    absurd = TaughtParameter(name=REAR_STIFFNESS, value=0.06 * rear, std=1e-4)
    posterior = fit_car(log, RIGHT, [absurd] * 9)
    assert not posterior.refused
    assert posterior.vehicle.cornering_stiffness_n_per_rad(False, FRICTION) == pytest.approx(rear, rel=0.2)


def test_earlier_drives_determine_a_parameter_as_random_effects_do():
    """A drive is its car plus a deviation: one has the share ρ of its change in the next drive, many have all of it."""
    before = next(p for p in priors.parameters_of(RIGHT) if p.name == REAR_STIFFNESS)

    def theta(count: int, level: float) -> tuple[float, float]:
        drive = TaughtParameter(name=REAR_STIFFNESS, value=before.value(0.5), std=1e-6, ay_m_s2=4.0)
        (after,) = priors.with_earlier([before], [drive] * count, level)
        return before.theta(after.mean), after.std / before.std

    rho = priors.CORRELATION
    assert theta(1, 4.0) == pytest.approx((0.5 * rho, math.sqrt(1.0 - rho**2)))
    assert theta(1, 8.0) == theta(1, 2.0) == pytest.approx((0.25 * rho, math.sqrt(1.0 - 0.25 * rho**2)))
    assert theta(1, 0.0) == pytest.approx(theta(1, 4.0))  # an unknown level
    assert theta(2000, 4.0) == pytest.approx((0.5, math.sqrt(1.0 - rho)), abs=1e-3)


def test_drives_at_other_lateral_accelerations_inform_less_and_none_leaves_the_prior_of_the_file():
    softer = [TaughtParameter(name=REAR_STIFFNESS, value=4e4, std=0.05, ay_m_s2=8.0)]
    stds = [prior_of(RIGHT_FILE, softer, level).of_cars[1].std for level in (8.0, 4.0, 0.1)]
    assert stds == sorted(stds) and stds[0] < 0.7 * stds[2]
    far, without = prior_of(RIGHT_FILE, softer, 0.01), prior_of(RIGHT_FILE)
    assert far.file_share == pytest.approx(without.file_share, abs=1e-3)
    near = prior_of(RIGHT_FILE, softer, 8.0)  # the earlier drive contradicts the tyres of the file
    assert near.file_share < 0.7 * without.file_share


def test_steering_that_does_not_explain_the_yaw_rate_is_refused():
    signals = wide().signals
    assert "of the yaw rate" in found(replace(signals, steer_rad=-2.0 * signals.steer_rad), RIGHT).refused


def test_a_pause_of_a_day_costs_no_memory():
    signals = wide().signals
    day = np.where(np.arange(len(signals)) < 3000, 0, 86_400 * 10**9)
    paused = driving(replace(signals, stamps_ns=signals.stamps_ns + day, ready_ns=signals.ready_ns + day), RIGHT)
    assert paused.columns.shape[1] < 60 / STEP_S + 200
    assert len(paused.stretches) == 2


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**31), share=st.floats(0.05, 0.98))
def test_any_losses_give_a_grid_whose_stretches_are_whole(seed, share):
    rng = np.random.default_rng(seed)
    signals = keep(wide().signals, rng.uniform(size=len(wide().signals)) < share)
    lost = np.where(rng.uniform(size=len(signals)) < 0.1, np.nan, signals.ay_m_s2)
    d = driving(replace(signals, ay_m_s2=lost), RIGHT)
    for a, b in d.stretches:
        assert np.isfinite(d.columns[:, a:b]).all()
        assert (d.columns[1, a:b] > RIGHT.low_speed_blend_m_s).all()
    assert (np.diff(d.stretches.ravel()) > 0).all()


def test_the_vehicles_of_the_band_spread_as_the_posterior_does():
    """Their joint spread is 70 % to 105 % of the posterior standard deviation of the cornering stiffness."""
    calibration = found(with_noise(wide().signals, 3), wrong(2.0, 0.5))
    assert len(calibration.varied) == 5
    by = {p.name: p for p in calibration.parameters}
    middle = calibration.vehicle
    at = math.log(middle.cornering_stiffness_n_per_rad(False, middle.assumed_friction))
    away = [math.log(v.cornering_stiffness_n_per_rad(False, v.assumed_friction)) - at for v in calibration.varied]
    assert 0.7 * by[REAR_STIFFNESS].sd < math.sqrt(sum(x**2 for x in away)) < 1.05 * by[REAR_STIFFNESS].sd
