"""Fit of a car to a drive: recovered parameters of a known car, rejected drives, and what earlier drives change."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from reference_car import FRICTION, Drive, drive, keep, signals_at, slalom, with_noise

from pdhef_logtool import Car, estimate, load_mapping, read_drive
from pdhef_logtool.car.assumed_values import DEFAULT_CG_SPREAD, FRONT_WEIGHT_SHARE, FRONT_WEIGHT_SHARE_SPREAD
from pdhef_logtool.car.model import CarModel, TaughtParameter, read_model
from pdhef_logtool.car.parts import PHYSICS, FilterNoise, FittedPhysics
from pdhef_logtool.car.posterior import FittedParameter, Posterior
from pdhef_logtool.car.toml_files import vehicle_of_entries
from pdhef_logtool.car.vehicle import AxleTyre, PhysicsParts, Tyres, VehicleParameters, corrected_anew, default_vehicle
from pdhef_logtool.drive import reading
from pdhef_logtool.drive.options import OFF, ReadOptions
from pdhef_logtool.drive.plan import with_earlier_drive
from pdhef_logtool.estimators.drive_signals import calibrated_signals
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.presets import OPEN_LOOP
from pdhef_logtool.estimators.table import all_names, make_estimator, spec_of
from pdhef_logtool.estimators.vehicle_ukf import of_car, physics_filter
from pdhef_logtool.evaluation.metrics.lateral_consistency import driven_consistency
from pdhef_logtool.evaluation.metrics.metric import CalibratedSignals
from pdhef_logtool.model import fit as rules, intervals, priors
from pdhef_logtool.model.drive_model import DriveModel
from pdhef_logtool.model.driving import STEP_S, Driving, driving_of
from pdhef_logtool.model.fit import fit_car
from pdhef_logtool.model.measured_noise import measured_noise
from pdhef_logtool.model.priors import REAR_STIFFNESS, coefficients, prior_of, prior_variations
from pdhef_logtool.records.errors import MappingError, UsageError, VehicleError
from pdhef_logtool.records.reasons import STUCK_YAW_RATE
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack, make_track
from truthsim.drive import simulate_drive, write_drive
from truthsim.sensors import SensorNoise

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
    files = wrong(1.001, 1.001), wrong(2.0, 0.5), RIGHT
    right, wrong_level, without_file = (abs(stiffness_errors(found(signals, file))[0][0]) for file in files)
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


# ---- intervals: own standard deviation, uncertainty of the parameters, contradictions of the sensors ----

OWN = default_vehicle().model_copy(update={"name": "mine"})
BIASES = {"sensors": OWN.sensors.model_copy(update={"ay_bias_m_s2": 0.1, "yaw_rate_bias_rad_s": 0.001})}
VALUES = {"yaw_inertia_kg_m2": 1700.0, "steer_offset_rad": 0.003, "steering_ratio": 16.5}
FOUND = OWN.model_copy(update=BIASES | VALUES)
VARIED = (FOUND.model_copy(update={"steer_offset_rad": 0.008}), FOUND.with_stiffness(1.0, 0.9))
NOISE = FilterNoise(r_std={"ay_m_s2": 1.0})
#: A parameter of a fit: an interval on a fitted vehicle is not causal.
FITTED = FittedParameter("yaw inertia", "kg m^2", 1700.0, 1500.0, 0.1, 0.2, log=True)


def calibrated(varied: tuple[VehicleParameters, ...] = (), scale: float = 1.0, *, causal: bool = False) -> Car:
    found = Posterior(FOUND, () if causal else (FITTED,), varied=varied, error_scale=scale)
    return replace(Car(OWN), self_calibrated=found)


def identified() -> Car:
    parts = PhysicsParts(lag=True, force_scale=True)
    values = OWN.model_copy(update={"yaw_inertia_kg_m2": 1700.0, "physics": parts})
    found = FittedPhysics(values=values, noise=NOISE)
    return Car(OWN, fitted_physics=found).with_noise(PHYSICS, NOISE)


@pytest.fixture(scope="module")
def signals():
    s = with_noise(drive(slalom(0.03, 0.5), 12.0, speed=22.0).signals, seed=3)
    return replace(s, friction=np.full(len(s), 0.85))


def tracks_of(name: str, car: Car, signals: Signals) -> tuple[StateTrack, StateTrack]:
    """Return the track of an estimator, and the same with its interval."""
    estimator = make_estimator(name, car)
    track = run_estimator(estimator, calibrated_signals(signals, car))
    return track, intervals.drive_intervals(car, [estimator]).apply(track, signals)


def spread(vehicles: tuple[VehicleParameters, ...], noise: FilterNoise, signals: Signals) -> np.ndarray:
    """Return the sum of squares of the differences of v_y to that on the first vehicle."""
    read = [(physics_filter(v, noise), corrected_anew(signals, OWN, v)) for v in vehicles]
    middle, *others = (run_estimator(f, s).vy_m_s for f, s in read)
    return np.asarray(sum((vy - middle) ** 2 for vy in others))


def assert_alike(got: np.ndarray, expected: np.ndarray) -> None:
    """The filters of the variations run on means of samples: 5 % in the median, 15 % of the median anywhere."""
    median = np.median(expected)
    assert np.median(got) == pytest.approx(median, rel=0.05)
    np.testing.assert_allclose(got, expected, atol=0.15 * median)


def test_an_interval_changes_no_estimate(signals):
    plain, wide = tracks_of("physics", calibrated(VARIED), signals)
    for column in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "sideslip_rad", "nis", "yaw_rate_std_rad_s"):
        np.testing.assert_array_equal(getattr(wide, column), getattr(plain, column))
    assert (np.linalg.eigvalsh(wide.covariance[10:]) > 0.0).all()


@pytest.mark.parametrize("varied", [(), VARIED])
def test_on_a_car_that_was_fitted_to_the_drive_it_is_the_sum_of_its_parts(signals, varied):
    plain, wide = tracks_of("physics", calibrated(varied, 2.0), signals)
    read = CalibratedSignals(corrected_anew(signals, OWN, FOUND), FOUND)
    consistency = intervals.DRIVE_SHARE * driven_consistency(plain, read, FOUND.low_speed_blend_m_s)
    assert consistency > 0.0
    fast, own = plain.vx_m_s > OWN.low_speed_blend_m_s, plain.sideslip_std_rad**2
    square = np.mean((plain.sideslip_rad**2 + own)[fast & plain.valid])
    share = 1.0 + 3.0 * square / (3.0 * own + square)
    expected = share * plain.vy_std_m_s**2 + 4.0 * (intervals.CAR_STD_RAD * plain.vx_m_s) ** 2 + consistency**2
    if varied:
        expected = expected + spread((FOUND, *varied), Posterior(FOUND).noise, signals)
        assert_alike(wide.vy_std_m_s[fast], np.sqrt(expected[fast]))
    else:
        np.testing.assert_allclose(wide.vy_std_m_s[fast] ** 2, expected[fast], rtol=1e-9)


def test_a_model_that_explains_nothing_widens_it_by_no_more_than_the_sideslip_itself(signals):
    plain, wide = tracks_of("physics", calibrated(scale=300.0), signals)
    fast, own = plain.vx_m_s > OWN.low_speed_blend_m_s, plain.sideslip_std_rad**2
    read = CalibratedSignals(corrected_anew(signals, OWN, FOUND), FOUND)
    consistency = intervals.DRIVE_SHARE * driven_consistency(plain, read, FOUND.low_speed_blend_m_s)
    others = (300.0 * intervals.CAR_STD_RAD) ** 2 + (consistency / plain.vx_m_s) ** 2
    most = own + np.mean((plain.sideslip_rad**2 + own)[fast & plain.valid]) + others
    assert (wide.sideslip_std_rad**2 < most)[fast].all()


def test_on_an_identified_car_it_is_the_sum_of_its_parts(signals):
    """The filter runs on varied vehicles, without the states that would compensate the variation."""
    car = identified()
    plain, wide = tracks_of("physics", car, signals)
    parts = {"physics": PhysicsParts(lag=True)}
    vehicles = (car.physics_vehicle, *prior_variations(car.physics_vehicle, share=intervals.IDENTIFIED_SHARE))
    vehicles = tuple(v.model_copy(update=parts) for v in vehicles)
    unknown = replace(signals, friction=np.full(len(signals), np.nan))  # each has its own
    running = intervals.running_consistency(plain, signals, car.physics_vehicle.roll_gradient_rad_per_m_s2)
    road_m_s = intervals.CROSSFALL_STD_RAD / coefficients(car.physics_vehicle)[1] * plain.vx_m_s
    own = intervals.OWN_SHARE * plain.vy_std_m_s
    expected = own**2 + running**2 + road_m_s**2 + spread(vehicles, NOISE, unknown)
    fast = plain.vx_m_s > OWN.low_speed_blend_m_s
    assert_alike(wide.vy_std_m_s[fast], np.sqrt(expected[fast]))


def test_a_file_that_no_drive_has_shown_to_be_right_has_the_interval_of_its_prior():
    """Errors of a file with a wrong rear axle are inside; the interval of an identified car is narrower."""
    true = with_noise(drive(slalom(0.03, 0.5), 6.0, speed=22.0).signals, seed=3)
    signals = replace(true, friction=np.full(len(true), 0.85))
    right, wrong = Car(OWN), Car(OWN.with_stiffness(1.0, 0.6))
    (truth, _), (plain, wide) = (tracks_of("physics", car, signals) for car in (right, wrong))
    error = np.abs(plain.sideslip_rad - truth.sideslip_rad)[50:]
    assert np.mean(error <= 1.96 * plain.sideslip_std_rad[50:]) < 0.5
    assert np.mean(error <= 1.96 * wide.sideslip_std_rad[50:]) > 0.95
    assert np.mean(1.96 * wide.sideslip_std_rad[50:]) < 0.04
    nominal, nominal_wide = tracks_of("phy-ukf", wrong, signals)
    assert np.median(nominal_wide.sideslip_std_rad / nominal.sideslip_std_rad) > 2.0
    _, of_identified = tracks_of("physics", identified(), signals)
    assert np.median(of_identified.sideslip_std_rad / wide.sideslip_std_rad) < 0.5
    assert len({vehicle.model_dump_json() for vehicle in (OWN, *prior_variations(OWN))}) == 7


def test_the_interval_contains_where_the_centre_of_gravity_is_only_assumed(signals):
    """At a yaw rate r the rear axle determines v_y up to the error of its distance times r."""
    car = calibrated(VARIED)
    guessed = replace(car, vehicle=OWN.model_copy(update={"name": default_vehicle().name}))
    (_, narrow), (_, wide) = (tracks_of("physics", c, signals) for c in (car, guessed))
    assert guessed.cg_std_m > 0.05 > car.cg_std_m == 0.0
    added = wide.sideslip_std_rad**2 - narrow.sideslip_std_rad**2
    expected = (guessed.cg_std_m * wide.yaw_rate_rad_s / wide.vx_m_s) ** 2
    fast = wide.valid & (wide.vx_m_s > OWN.low_speed_blend_m_s)
    np.testing.assert_allclose(added[fast], expected[fast], rtol=1e-6, atol=1e-12)


# ---- running consistency ----


def _motion(count: int = 900) -> tuple[Signals, StateTrack]:
    """A slalom with a gap, and its true motion."""
    stamps = 10**18 + np.cumsum(np.full(count, 10_000_000)).astype(np.int64)
    stamps[count // 2 :] += 700_000_000
    t = (stamps - stamps[0]) * 1e-9
    vy, rate, vx = 0.3 * np.sin(3.0 * t), 0.25 * np.sin(3.0 * t + 0.4), np.full(count, 22.0)
    columns = {"ay_m_s2": 0.9 * np.cos(3.0 * t) + vx * rate, "yaw_rate_rad_s": rate, "speed_m_s": vx}
    signals = signals_at(stamps, stamps + 30_000_000, steer_rad=0.0, ax_m_s2=0.0, friction=0.8, **columns)
    return signals, make_track("e", stamps, vx_m_s=vx, vy_m_s=vy, yaw_rate_rad_s=rate)


@pytest.mark.parametrize("at", [100, 460, 700])
def test_samples_that_have_not_arrived_change_nothing(at):
    signals, track = _motion()
    late = signals.ready_ns > signals.stamps_ns[at]
    changed = replace(signals, ay_m_s2=np.where(late, 30.0, signals.ay_m_s2))
    before, after = (intervals.running_consistency(track, s, 0.009) for s in (signals, changed))
    np.testing.assert_array_equal(before[: at + 1], after[: at + 1])
    assert not np.array_equal(before, after)


def test_a_wrong_sideslip_contradicts_the_sensors():
    signals, track = _motion()
    right = intervals.running_consistency(track, signals, 0.0)[200:440]
    wrong = intervals.running_consistency(replace(track, vy_m_s=0.5 * track.vy_m_s), signals, 0.0)[200:440]
    # Half of a swing of 0.3 m/s at 3 rad/s is lost; the high-pass of 0.3 s passes ωτ / √(1 + ω²τ²) = 0.67 of it.
    expected = 0.15 / np.sqrt(2.0) * 0.67
    assert np.all(right < 0.1 * expected)
    assert np.median(wrong) == pytest.approx(expected, rel=0.25)


def test_a_sensor_that_the_estimator_reports_as_faulty_widens_nothing():
    signals, track = _motion()
    stuck = np.arange(900) >= 200
    signals = replace(signals, yaw_rate_rad_s=np.where(stuck, 0.4, signals.yaw_rate_rad_s))
    told = replace(track, reason=np.where(stuck, STUCK_YAW_RATE, 0))
    blind, seeing = (intervals.running_consistency(t, signals, 0.009)[300:440] for t in (track, told))
    assert np.all(seeing < 0.1 * blind)


# ---- estimators on a car that its log has calibrated ----


def test_the_open_loop_model_runs_once_more_only_on_a_calibrated_car():
    assert OPEN_LOOP in all_names(calibrated())
    assert OPEN_LOOP not in all_names(Car(OWN))
    with pytest.raises(UsageError, match="has not calibrated"):
        make_estimator(OPEN_LOOP, Car(OWN))


def test_the_centre_of_gravity_is_assumed_without_a_file_or_weight_split():
    assert Car(default_vehicle()).cg_std_m == pytest.approx(DEFAULT_CG_SPREAD * 1.71)
    assert Car(OWN.model_copy(update={"name": "mine"})).cg_std_m == 0.0
    given = vehicle_of_entries({"name": "mine", "mass_kg": 1500.0, "wheelbase_m": 2.7}, where="test")
    car = Car(given.vehicle, assumed=given.assumed)
    assert car.cg_std_m == pytest.approx(FRONT_WEIGHT_SHARE_SPREAD * 2.7 * FRONT_WEIGHT_SHARE)


@pytest.mark.parametrize(("friction", "std"), [(0.85, priors.STATED_PEAK_STD), (None, priors.FILE_TYRE_STD)])
def test_before_a_fit_the_peak_force_is_known_as_well_as_the_friction_of_the_file(friction, std):
    prior = priors.prior_posterior(OWN.model_copy(update={"friction": friction}))
    least = min(v.assumed_friction for v in prior.varied)
    assert least == pytest.approx(np.exp(-std) * prior.vehicle.assumed_friction)


# ---- A model file determines sensors and car before the drive: later data do not change them ----

CHANGE_S = 30.0


#: Fields that change their sign when the IMU is turned by half a turn about the vertical.
TURNED = tuple(f"{vector}.{axis}" for vector in ("linear_acceleration", "angular_velocity") for axis in "xy")


class ChangedLater:
    """A log with a change: from a given time on, its IMU is rotated by 180° and its messages arrive 70 ms later."""

    def __init__(self, log: Any, change_ns: int) -> None:
        self._log, self._change_ns = log, change_ns

    def __getattr__(self, name: str) -> Any:
        return getattr(self._log, name)

    def read(self, requests: Any, start_ns: Any = None, end_ns: Any = None, **options: Any) -> dict[str, Any]:
        columns = dict(self._log.read(requests, start_ns, end_ns, **options))
        for topic, read in columns.items():
            later = read.log_time_ns >= self._change_ns
            changed = {
                path: np.where(later, -values, values) if path in TURNED else values
                for path, values in read.fields.items()
            }
            columns[topic] = replace(read, fields=changed, log_time_ns=read.log_time_ns + later * 70_000_000)
        return columns


def read_signals_of(log: Path, options: ReadOptions) -> tuple[Signals, CarModel]:
    with read_drive(log, Car.load("saloon"), options=options) as drive:
        return drive.whole().signals, DriveModel.of(drive).file


@pytest.fixture
def file(road, tmp_path):
    """Return the model of the drive before the change."""
    _, model = read_signals_of(road, ReadOptions(end=str(CHANGE_S - 5.0)))
    path = tmp_path / "model.toml"
    path.write_text(model.toml("Of a test.\nTwo lines."))
    return path


@pytest.fixture(scope="module")
def road(sample_logs_dir):
    return sample_logs_dir / "road.mcap"


@pytest.mark.slow
def test_no_causal_estimate_depends_on_the_future(road, file, monkeypatch):
    """Of every estimator, with a model file."""
    options = ReadOptions(model=file, end="60")

    def estimates() -> dict[str, Any]:
        with read_drive(road, Car.load("saloon"), options=options) as drive:
            tracks = estimate(drive, ["all"]).tracks
        return {name: track for name, track in tracks.items() if name != "truth"}

    as_recorded = estimates()
    really_open = reading.open_log

    def opened(*args: Any, **more: Any) -> Any:
        log = really_open(*args, **more)
        return ChangedLater(log, log.start_ns + round(CHANGE_S * 1e9))

    monkeypatch.setattr(reading, "open_log", opened)
    changed = estimates()
    assert len(changed) > 8
    for name, track in as_recorded.items():
        rows = track.stamps_ns < track.stamps_ns[0] + (CHANGE_S - 3.0) * 1e9
        same = np.array_equal(track.sideslip_rad[rows], changed[name].sideslip_rad[rows], equal_nan=True)
        assert same == spec_of(name).causal, name


def test_a_model_is_read_back_as_it_was_written_and_gives_the_same_signals(road, tmp_path):
    whole, model = read_signals_of(road, ReadOptions())
    model = model.model_copy(update={"parameters": (TaughtParameter(name="yaw inertia", value=1510.0, std=0.02),)})
    path = tmp_path / "model.toml"
    path.write_text(model.toml("Of a test.\nTwo lines."))
    assert path.read_text().startswith("# Of a test.\n# Two lines.\n")
    read, written = (json.dumps(m.model_dump(), sort_keys=True) for m in (read_model(path), model))
    assert read == written
    saloon = Car.load("saloon")
    car, _ = with_earlier_drive(saloon, path)
    assert car.taught_prior == model.parameters
    own = CarModel(physics_sha256=saloon.physics_sha256, truth="ground truth", parameters=model.parameters[:0])
    car, _ = with_earlier_drive(replace(saloon, model=own), path)
    assert car.model is not None and (car.model.truth, car.taught_prior) == ("ground truth", model.parameters)
    again, _ = read_signals_of(road, ReadOptions(model=path))
    np.testing.assert_array_equal(whole.ay_m_s2, again.ay_m_s2)
    np.testing.assert_array_equal(whole.ready_ns, again.ready_ns)
    with pytest.raises(VehicleError, match=r"expected a model of the car .*, got one of the vehicle file"):
        with_earlier_drive(Car.load(), path)


def test_a_model_that_does_not_fit_is_refused_in_one_line(road, file):
    text = file.read_text().replace("/imu/data", "/imu/other")
    file.write_text(text)
    with pytest.raises(MappingError, match="/imu/other"):
        read_signals_of(road, ReadOptions(model=file))
    file.write_text(text.replace("decided_s", "decided"))
    with pytest.raises(VehicleError, match="decided_s"):
        read_signals_of(road, ReadOptions(model=file))
    with pytest.raises(VehicleError, match=r"auto, off or a model\.toml"):
        read_signals_of(road, ReadOptions(model="of"))


def test_sensors_show_a_model_car_without_a_vehicle_file_and_its_model_belongs_to_later_drives(tmp_path):
    time = np.arange(0.0, 40.0, 0.01)
    speed, angle = 2.0 + 0.5 * np.sin(0.3 * time), 0.15 * np.sin(1.5 * time) + 0.05 * np.sin(0.4 * time)
    rate = speed * np.tan(angle) / 0.4
    log, mapping = tmp_path / "small.csv", tmp_path / "mapping.toml"
    columns = {"speed_m_s": speed, "steer_rad": angle, "yaw_rate_rad_s": rate, "ay_m_s2": speed * rate}
    rows = np.column_stack([time, *columns.values()])
    np.savetxt(log, rows, delimiter=",", header=",".join(["time", *columns]), comments="")
    table = '[signals.{0}]\ntopic = "csv"\nfield = "{0}"\nstamp = "log_time"\n'
    mapping.write_text("".join(map(table.format, columns)))
    with read_drive(log, Car.load(), load_mapping(mapping)) as drive:
        assert drive.car.vehicle.wheelbase_m == pytest.approx(0.4, abs=0.01)
        assert drive.car.vehicle.name == "model car of 0.4 m"
        assert any("the default car is scaled" in note for note in drive.notes)
        model = DriveModel.of(drive).file
    with read_drive(log, Car.load(), load_mapping(mapping), ReadOptions(model=OFF)) as drive:
        assert drive.car.vehicle == Car.load().vehicle
    path = tmp_path / "model.toml"
    taught = TaughtParameter(name="yaw inertia", value=0.3, std=0.02)
    path.write_text(model.model_copy(update={"parameters": (taught,)}).toml("Of a test."))
    later, _ = with_earlier_drive(Car.load(), path)
    assert later.vehicle.wheelbase_m == model.wheelbase_m and later.taught_prior == (taught,)


NOISY = SensorNoise(acceleration_m_s2=1.0, yaw_rate_rad_s=0.05, wheel_speed_m_s=0.5)


def slalom_log(folder: Path, noise: SensorNoise) -> Path:
    log = folder / "drive.mcap"
    write_drive(simulate_drive("slalom", seed=3, noise=noise), log)
    return log


@pytest.mark.parametrize("noise", [NOISY, SensorNoise()], ids=["noisy", "sound"])
def test_noisy_sensors_are_taken_as_noisy_and_sound_ones_keep_their_noise(tmp_path, noise):
    with read_drive(slalom_log(tmp_path, noise), Car.load(None), None, ReadOptions()) as drive:
        posterior = DriveModel.fit(drive).posterior
    if noise is NOISY:
        assert posterior.r_std["yaw_rate_rad_s"] == pytest.approx(NOISY.yaw_rate_rad_s, rel=0.4)
        assert "yaw_rate_rad_s 0.0" in posterior.text
    else:
        assert (posterior.r_std, "noise" in posterior.text) == ({}, False)


def test_a_model_that_explains_the_yaw_rate_worse_with_more_noise_keeps_its_noise(tmp_path, monkeypatch):
    with read_drive(slalom_log(tmp_path, SensorNoise()), Car.load(None), None, ReadOptions()) as drive:
        model = DriveModel.fit(drive)
        calibrated = model.calibrated(drive.whole().signals)
    vehicle = model.car.calibrated_car.physics_vehicle
    # A car that is far too quick to turn: the innovations are large, the sensors are sound.
    wrong = vehicle.model_copy(update={"cg_to_front_axle_m": 0.3})
    physics = replace(of_car(model.car.calibrated_car), vehicle=wrong, r_std=(0.02, 0.0003, 0.02))
    assert measured_noise(calibrated, physics) == {}
    monkeypatch.setattr("pdhef_logtool.model.measured_noise.EXPLAINED", 2.0)
    assert measured_noise(calibrated, physics)["yaw_rate_rad_s"] > 0.0003
