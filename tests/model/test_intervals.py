"""Confidence intervals: own standard deviation, uncertainty of the parameters, and contradictions of the sensors."""

from dataclasses import replace

import numpy as np
import pytest
from reference_car import drive, signals_at, slalom, with_noise

from pdhef_logtool.car.assumed_values import DEFAULT_CG_SPREAD, FRONT_WEIGHT_SHARE, FRONT_WEIGHT_SHARE_SPREAD
from pdhef_logtool.car.car import Car
from pdhef_logtool.car.parts import PHYSICS, FilterNoise, FittedPhysics
from pdhef_logtool.car.posterior import FittedParameter, Posterior
from pdhef_logtool.car.toml_files import vehicle_of_entries
from pdhef_logtool.car.vehicle import PhysicsParts, VehicleParameters, corrected_anew, default_vehicle
from pdhef_logtool.estimators.drive_signals import calibrated_signals
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.presets import OPEN_LOOP
from pdhef_logtool.estimators.table import all_names, make_estimator
from pdhef_logtool.estimators.vehicle_ukf import physics_filter
from pdhef_logtool.evaluation.metrics.lateral_consistency import driven_consistency
from pdhef_logtool.evaluation.metrics.metric import CalibratedSignals
from pdhef_logtool.model import intervals
from pdhef_logtool.model.priors import coefficients, prior_variations
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.reasons import STUCK_YAW_RATE
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack, make_track

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
