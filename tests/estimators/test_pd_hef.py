"""pd-hef is ``physics`` plus exactly the residual, of a network or a taught car; a right residual makes it right."""

import json
import math
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings, strategies as st
from made_models import full_network, linear_residual, random_network
from physics_oracle import G, Oracle, parts, vehicle
from reference_car import FRICTION, Drive, drive, make_signals, slalom, with_noise

from pdhef_logtool import Car, RunConfig
from pdhef_logtool.car.model import CarModel
from pdhef_logtool.car.parts import Algorithm, FilterNoise, FittedPhysics, physics_sha256
from pdhef_logtool.car.posterior import Posterior
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, PhysicsParts, Tyres, correct_signals, default_vehicle
from pdhef_logtool.cli.run_tables import render_run
from pdhef_logtool.drive.sensor_faults import without_faults
from pdhef_logtool.estimators import table
from pdhef_logtool.estimators.adaptive_physics import AdaptivePhysics, mix, weigh
from pdhef_logtool.estimators.algorithm import resolve
from pdhef_logtool.estimators.base import Smoother
from pdhef_logtool.estimators.divergence import watched_track
from pdhef_logtool.estimators.drive_signals import calibrated_signals
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.presets import OPEN_LOOP
from pdhef_logtool.estimators.residual_response import residual_response
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.estimators.vehicle_ukf import VehicleUkf, physics_filter
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.signals import ALIGNED_SIGNALS, Signals
from pdhef_logtool.records.tracks import StateTrack, make_track
from pdhef_logtool.residual_model.bundle import ModelBundle
from pdhef_logtool.residual_model.ladder import LadderModel
from pdhef_logtool.results.run_report import lines_of
from pdhef_logtool.runs.fleet import run_logs
from tests.command_line import rendered
from truthsim.drive import simulate_drive, write_drive

pytestmark = pytest.mark.slow

VEHICLE = default_vehicle()
COMPARED = ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "ay_m_s2", "covariance", "nis", "valid")


@pytest.fixture(scope="module")
def signals():
    made = drive(slalom(0.02, 0.3), 8.0, step_s=np.random.default_rng(0).uniform(0.008, 0.012, 800), speed_every=1)
    noisy = with_noise(made.signals, 0)
    return replace(noisy, ready_ns=noisy.stamps_ns + 10_000_000, available=frozenset(ALIGNED_SIGNALS))


def hybrid(*parts: str, network: ModelBundle | None = None, trust: float = 1.0) -> AdaptivePhysics:
    return AdaptivePhysics(VehicleUkf(vehicle(*parts)), network or random_network(), trust)


@pytest.mark.parametrize("parts", [(), ("lag", "roll", "biases", "bank"), tuple(PhysicsParts.model_fields)])
def test_without_trust_it_is_physics_to_the_bit(parts, signals):
    trusted = hybrid(*parts)
    physics = run_estimator(AdaptivePhysics(trusted.physics, name="physics"), signals)
    for change in ({"trust": 0.0}, {"network": random_network(constant=(0.0, 0.0))}):
        track = run_estimator(replace(trusted, **change), signals)
        for f in fields(StateTrack):
            if f.name not in ("name", "network_trust"):
                np.testing.assert_array_equal(getattr(track, f.name), getattr(physics, f.name), err_msg=f.name)
    assert not same(run_estimator(trusted, signals), physics, COMPARED)


def test_the_filter_of_another_vehicle_has_half_of_the_residual_and_that_of_a_banked_road_none(signals):
    estimator = hybrid("bank", "force_scale", network=random_network(constant=(0.4, 0.1)), trust=0.5)
    steps, _ = estimator.run(signals, None)
    unchanged, other_vehicle, banked = (f.residual_rate for f in steps.filters)
    np.testing.assert_allclose(unchanged[100:], np.tile([0.2, 0.05], (len(unchanged) - 100, 1)))
    np.testing.assert_array_equal(other_vehicle, 0.5 * unchanged)
    assert not banked.any()


#: A model without roll states has the body lean with a force of the residual at once.
@pytest.mark.parametrize(("has", "felt_m_s2"), [((), 0.8 * (1.0 + G * 0.0105)), (("lag", "roll"), 0.8)])
def test_a_residual_in_the_model_is_what_the_car_does_with_it(has, felt_m_s2):
    """The car has a force and a moment that its model lacks. With both as a residual, the filter is correct."""
    oracle = Oracle(parts(*has))

    @dataclass(frozen=True)
    class Pushed(Oracle):
        def derivative(self, x: np.ndarray, steer: float, ax: float, mu: float) -> np.ndarray:
            return super().derivative(x, steer, ax, mu) + np.array([0.0, 0.8, 0.15, *[0.0] * (len(x) - 3)])

    made = Pushed(oracle.has).drive(lambda t: 0.02 * np.sin(2.0 * t), 8.0)
    felt = made.signals.ay_m_s2 + felt_m_s2
    signals = replace(made.signals, ay_m_s2=felt, friction=np.full(len(felt), FRICTION))
    network = random_network(constant=(0.8, 0.15))
    errors = []
    for trust in (0.0, 0.5, 1.0):
        track = run_estimator(AdaptivePhysics(VehicleUkf(oracle.as_vehicle()), network, trust), signals)
        errors.append(np.sqrt(np.mean((track.vy_m_s - made.vy)[200:] ** 2)))
    assert errors[2] < 0.05 * errors[0]
    assert errors[2] < errors[1] < errors[0]
    assert track.ay_m_s2[200:] == pytest.approx(made.ay[200:] + 0.8, abs=0.02)


def sideslip_rmse(estimator, made: Drive, signals: Signals) -> float:
    track = run_estimator(estimator, signals)
    late = made.time_s > 1.0
    assert track.valid[late].all()
    return float(np.sqrt(np.mean((track.sideslip_rad - made.sideslip)[late] ** 2)))


def test_beyond_the_linear_range_kinematics_count_more():
    """With half the tyre stiffness in the file, the error at the limit is lower; the linear range does not change."""
    oracle = Oracle(parts("lag"))
    v = oracle.as_vehicle()
    tyres = Tyres(**{name: tyre.model_copy(update={"B": 0.5 * tyre.B}) for name, tyre in v.tyres})
    soft, made = v.model_copy(update={"tyres": tyres}), oracle.drive(slalom(0.09, 0.5), 8.0)
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
    sensors = own.sensors.model_copy(update={"ay_bias_m_s2": 0.2, "yaw_rate_bias_rad_s": 0.004})
    changes = {"steer_offset_rad": 0.003, "steering_ratio": 15.0, "relaxation_length_m": 0.7, "sensors": sensors}
    fitted = own.model_copy(update=changes | {"physics": PhysicsParts(lag=True, roll=True)})
    physics = FittedPhysics(values=fitted, noise=FilterNoise())
    car = replace(Car(own, noise={"physics": FilterNoise()}), fitted_physics=physics)
    adaptive = make_estimator("physics", car)
    estimator = adaptive.physics
    assert estimator.vehicle == fitted
    assert resolve(adaptive).physics_sha256 == physics_sha256(fitted) != physics_sha256(own)
    assert resolve(estimator).identity == resolve(physics_filter(fitted, FilterNoise())).identity
    ours = run_estimator(estimator, calibrated_signals(correct_signals(noisy, own), car))
    raw = replace(noisy, steer_rad=noisy.steer_rad * own.steering_ratio / 15.0)
    want = run_estimator(physics_filter(fitted, FilterNoise()), correct_signals(raw, fitted))
    np.testing.assert_allclose(ours.sideslip_rad, want.sideslip_rad, rtol=1e-9, atol=1e-12)


#: The reference car does not roll.
FLAT = default_vehicle().model_copy(update={"roll_gradient_rad_per_m_s2": 0.0})
ADAPTED = ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "sideslip_rad", "ay_m_s2", "covariance", "nis", "valid", "r_scale")


SILENT = random_network(constant=(0.0, 0.0))


#: As a car that was identified: a single track with the cures and the noise that it was found with.
PARTS = FLAT.physics.model_copy(update={"force_scale": True, "bank": True})
PHYSICS = VehicleUkf(
    FLAT.model_copy(update={"physics": PARTS}), q_std=(0.089, 0.06, 0.03, 0.021, 0.4, 0.4), r_std=(0.3, 0.003, 0.08)
)
#: The same filter without the additional physics of ``PARTS``.
PLAIN = replace(PHYSICS, vehicle=FLAT)


def adaptive(network: ModelBundle = SILENT, **options) -> AdaptivePhysics:
    return AdaptivePhysics(**{"physics": PHYSICS, "network": network, "trust": 1.0, **options})


def fixed(network: ModelBundle = SILENT, **options) -> AdaptivePhysics:
    given = {"physics": PLAIN, "network": network, "trust": 1.0, **options}
    return AdaptivePhysics(adaptive=False, name="pd-hef:fixed-r", **given)


def same(a: StateTrack, b: StateTrack, columns=ADAPTED) -> bool:
    return all(np.array_equal(getattr(a, c), getattr(b, c), equal_nan=True) for c in columns)


def noisy(made, seed: int = 0) -> Signals:
    s = with_noise(made.signals, seed)
    s.friction[:] = 0.85
    return replace(s, ready_ns=s.stamps_ns + 10_000_000)


@pytest.fixture(scope="module")
def made():
    return drive(slalom(0.035, 0.5), 12.0, speed=22.0)


@pytest.fixture(scope="module")
def weak():
    """Return a drive of a car with 25 % less grip and stiffness than the model, hence 0.75 times its forces."""
    return drive(slalom(0.035, 0.5), 12.0, speed=22.0, mu=0.75 * 0.85)


def rmse(estimator: AdaptivePhysics, signals: Signals, made, used=slice(100, None)) -> float:
    error = run_estimator(estimator, signals).sideslip_rad - made.sideslip
    return float(np.sqrt(np.nanmean(error[used] ** 2)))


# --- without faults --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("trust", [0.0, 0.4, 1.0])
def test_without_noise_and_error_it_is_the_fixed_filter_to_the_bit(made, trust):
    signals = replace(made.signals, friction=np.full(len(made.signals), 0.85))
    a = run_estimator(adaptive(trust=trust, physics=PLAIN), signals)
    b = run_estimator(fixed(trust=trust), signals)
    assert same(a, b)
    assert set(a.network_trust[a.valid]) == {trust}


# --- bottom layer ----------------------------------------------------------------------------------------------------


def test_a_burst_raises_r_for_its_time_and_costs_less(made):
    t = made.time_s
    clean, burst = noisy(made, 1), (t > 4) & (t < 6)
    rng = np.random.default_rng(2)
    ay, rate = (burst * std * rng.standard_normal(len(t)) for std in (2.4, 0.08))
    bad = replace(clean, ay_m_s2=clean.ay_m_s2 + ay, yaw_rate_rad_s=clean.yaw_rate_rad_s + rate)
    checked = without_faults(bad, FLAT)
    track = run_estimator(adaptive(), checked)
    assert np.median(track.r_scale[(t > 4.1) & burst]) > 50
    assert (track.r_scale[t > 6.7] == 1.0).all()
    assert rmse(adaptive(), checked, made, burst) < 0.5 * rmse(fixed(), bad, made, burst)


@pytest.mark.parametrize("how", ["stuck", "dead"])
def test_a_gyro_that_fails_does_not_take_the_filter_with_it(made, how):
    t, signals = made.time_s, noisy(made, 3)
    bad = (t > 4) & (t < 8)
    held = signals.yaw_rate_rad_s[np.argmax(bad)] if how == "stuck" else 0.0
    faulty = replace(signals, yaw_rate_rad_s=np.where(bad, held, signals.yaw_rate_rad_s))
    error = rmse(adaptive(), without_faults(faulty, FLAT), made, bad)
    assert error < min(np.radians(0.1), 0.2 * rmse(fixed(), faulty, made, bad))


# --- top layer -------------------------------------------------------------------------------------------------------


def test_forces_that_are_wrong_in_proportion_are_scaled(weak):
    signals = noisy(weak)
    assert np.nan_to_num(run_estimator(adaptive(), signals).mixture_weight)[150:].mean() > 0.8
    late = slice(150, None)
    assert rmse(adaptive(), signals, weak, late) < 0.7 * rmse(fixed(), signals, weak, late)


def test_a_residual_lowers_the_noise_until_the_innovations_contradict_it(made, weak):
    """On ``made`` the model is right, on ``weak`` its forces are too large; R is larger than the noise, as in use."""
    physics, ratio = replace(PLAIN, r_std=(0.6, 0.006, 0.16)), []
    for of in (made, weak):
        signals = noisy(of)
        quiet, usual = (physics.run(signals, None, None, None, np.full(len(of.vy), f))[0] for f in (0.5, 1.0))
        ratio.append(np.sqrt(quiet.P[200:, 1, 1] / usual.P[200:, 1, 1]))
    assert np.median(ratio[0]) < 0.8
    assert np.median(ratio[1]) > 0.95


def test_without_evidence_the_weights_are_the_odds():
    usable = np.array([[True, True, True], [True, False, True]])
    weights = weigh(np.array([[3.0, 3.0, 3.0], [0.0, 9.0, np.log(2.0)]]), usable, (1.0, 0.5, 0.25))
    np.testing.assert_allclose(weights, [[4 / 7, 2 / 7, 1 / 7], [2 / 3, 0.0, 1 / 3]])


def test_the_mixture_has_the_moments_of_its_samples():
    rng = np.random.default_rng(0)
    means = np.array([[20.0, 0.5, 0.1], [20.4, 0.2, 0.16]])
    roots = 0.1 * rng.standard_normal((2, 3, 3))
    P = roots @ roots.transpose(0, 2, 1)
    names = ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "ay_m_s2")
    motion = [dict(zip(names, np.append(m, 1.0)[:, None], strict=True)) for m in means]
    tracks = [make_track("x", np.array([0]), **m, covariance=p[None]) for m, p in zip(motion, P, strict=True)]
    mixed = mix(np.array([[0.7, 0.3]]), tracks)
    weights = np.array([0.7, 0.3])
    mean = weights @ means
    away = means - mean
    covariance = np.einsum("k,kij->ij", weights, P + away[:, :, None] * away[:, None, :])
    found = [mixed.vx_m_s[0], mixed.vy_m_s[0], mixed.yaw_rate_rad_s[0], mixed.sideslip_rad[0]]
    np.testing.assert_allclose(found, [*mean, np.arctan2(mean[1], mean[0])], rtol=1e-12)
    np.testing.assert_allclose(mixed.covariance[0], covariance, rtol=1e-12)
    slope = np.array([-mean[1], mean[0], 0.0]) / (mean[0] ** 2 + mean[1] ** 2)
    assert mixed.sideslip_std_rad[0] == pytest.approx(np.sqrt(slope @ covariance @ slope))
    lone = replace(tracks[0], valid=np.array([False]), vy_m_s=np.array([np.nan]))
    for weights in ([[0.7, 0.3]], [[1.0, 0.0]]):
        assert mix(np.array(weights), [lone, tracks[1]]).vy_m_s[0] == tracks[1].vy_m_s[0]
    assert mix(np.array([[0.7, 0.3]]), [tracks[1], lone]).vy_m_s[0] == tracks[1].vy_m_s[0]
    assert not mix(np.array([[0.7, 0.3]]), [lone, lone]).valid[0]


SEDAN = default_vehicle()


def taught_car(residual: LadderModel | None, *, calibrated: bool = False) -> Car:
    model = CarModel(physics_sha256=Car(SEDAN).physics_sha256, residual=residual, calibrated=calibrated)
    return replace(Car(SEDAN), model=model)


def acts(estimator: Any) -> bool:
    """Whether an estimator uses the taught residual."""
    return isinstance(estimator.network, LadderModel) and estimator.trust == 1.0


@pytest.fixture(scope="module")
def driven():
    s = with_noise(drive(slalom(0.03, 0.5), 6.0, speed=22.0).signals, seed=3)
    return replace(s, friction=np.full(len(s), 0.85))


def track_of(name: str, car: Car, driven: Signals) -> StateTrack:
    return run_estimator(make_estimator(name, car), driven)


def test_its_response_is_the_one_that_teaching_uses(driven):
    estimator = make_estimator("physics", taught_car(None))
    assert isinstance(estimator, AdaptivePhysics)
    response = residual_response(estimator, driven, np.arange(len(driven)))
    rate = 0.2 * np.sin(np.arange(len(driven)) / 30.0)
    tracks = []
    for share in (0.0, 1.0):
        rates = np.stack([share * rate, np.zeros(len(rate))], axis=1)
        steps, _ = estimator.physics.run(driven, None, rates)
        tracks.append(np.arctan2(steps.x[:, 1], steps.x[:, 0]))
    expected = tracks[1] - tracks[0]
    assert np.nanmax(np.abs(expected)) > 1e-4
    late = slice(50, None)
    assert np.allclose(response(rate[:, None])[late, 0], expected[late], atol=0.1 * np.nanmax(np.abs(expected)))


def test_beyond_the_taught_speed_it_is_physics(driven):
    car = taught_car(linear_residual(fastest_m_s=10.0))
    physics, hybrid = (track_of(name, car, driven) for name in ("physics", "pd-hef"))
    assert np.array_equal(hybrid.sideslip_rad, physics.sideslip_rad, equal_nan=True)
    assert np.nanmax(hybrid.network_trust) == 0.0


def test_a_residual_belongs_to_the_physics_that_it_was_fitted_on(driven):
    calibration = Posterior(SEDAN)
    for calibrated in (False, True):
        car = taught_car(linear_residual(), calibrated=calibrated)
        plain, of_log = (make_estimator("pd-hef", c) for c in (car, replace(car, self_calibrated=calibration)))
        assert acts(plain) is not calibrated
        assert acts(of_log) is calibrated
        without = of_log if not calibrated else plain
        assert any("residual gain 0" in note for note in without.notes)
    car = replace(taught_car(linear_residual(), calibrated=True), self_calibrated=calibration)
    track = track_of("pd-hef", car, driven)
    assert np.nanmax(track.network_trust) == 1.0


def test_a_car_without_a_residual_or_with_a_named_gain_does_not_take_it():
    assert not acts(make_estimator("pd-hef", taught_car(None)))
    assert make_estimator("pd-hef", taught_car(linear_residual())).causal
    with_network = replace(taught_car(linear_residual()), network=random_network())
    assert not acts(make_estimator("pd-hef:gain=1", with_network)) and acts(make_estimator("pd-hef", with_network))


# ---- The table of estimators: every row builds its estimator, and the identity follows from the estimator object ----

NOISE = FilterNoise(q_std=(0.1, 0.2, 0.1), r_std={"ay_m_s2": 0.9})
#: All rows except the estimator on a self-calibrated car (``tests/model/test_car_fit.py``).
LINES = tuple(s for s in table.all_specs() if s.name != OPEN_LOOP)
every_spec = pytest.mark.parametrize("spec", LINES, ids=lambda spec: spec.name)


MODEL = full_network()
#: It has all that any estimator needs.
CAR = Car(SEDAN, network=MODEL, noise={"phy-ukf:tuned": NOISE, "physics": NOISE}, network_gain=1.0)


@pytest.fixture(scope="module")
def slalom_signals():
    s = with_noise(drive(slalom(0.03, 0.5), 4.0, speed=22.0).signals, seed=3)
    return replace(s, friction=np.full(len(s), 0.85), ready_ns=s.stamps_ns + 10_000_000)


def run(name: str, signals: Signals, car: Car = CAR) -> StateTrack:
    return run_estimator(table.make_estimator(name, car), signals)


def same_track(a: StateTrack, b: StateTrack, upto: int | None = None) -> bool:
    columns = [f.name for f in fields(StateTrack) if isinstance(getattr(a, f.name), np.ndarray)]
    return all(np.array_equal(getattr(a, c)[:upto], getattr(b, c)[:upto], equal_nan=True) for c in columns)


# --- the lines -------------------------------------------------------------------------------------------------------


def test_no_two_lines_share_a_name_or_a_colour():
    for attribute in ("name", "colour", "text"):
        assert len({getattr(s, attribute) for s in table.SPECS}) == len(table.SPECS)
    assert all(0 < s.colour <= 0xFFFFFF for s in table.SPECS)


@every_spec
def test_a_line_builds_what_it_says(spec):
    estimator = table.make_estimator(spec.name, CAR)
    assert (estimator.name, estimator.causal) == (spec.name, spec.causal)
    assert isinstance(estimator, Smoother) == (not spec.causal)
    assert table.spec_of(spec.name) is spec
    assert (spec.name in table.all_names(CAR)) == (spec.group == table.ALL_ESTIMATORS)
    assert spec.needs <= frozenset(ALIGNED_SIGNALS)


@every_spec
def test_what_it_needs_is_what_it_needs(spec, slalom_signals):
    """An estimator runs with only its required signals, is skipped if one is missing, and uses every one of them."""
    dt = np.diff(slalom_signals.stamps_ns) * 1e-9
    given = spec.needs | frozenset(sorted(spec.one_of)[-1:])  # with the yaw rate, where any lateral signal will do
    bare = make_signals(dt, **{c: getattr(slalom_signals, c) for c in given})
    estimators, skipped = table.runnable((spec.name,), CAR, bare.available)
    assert ([e.name for e in estimators], skipped) == ([spec.name], [])
    track = run(spec.name, bare)
    assert track.valid[50:].all()
    assert np.isfinite(track.vx_m_s[50:]).all()
    assert np.isfinite(track.yaw_rate_rad_s[50:]).all()
    for lacking in spec.needs:
        estimators, skipped = table.runnable((spec.name,), CAR, frozenset(ALIGNED_SIGNALS) - {lacking})
        assert estimators == []
        assert [s.reason for s in skipped] == [f"the log has no {lacking}"]
        without = replace(bare, **{lacking: np.full(len(bare), np.nan)})
        assert not same_track(run(spec.name, without), track), lacking


@every_spec
def test_a_car_that_lacks_something_skips_it_with_the_remedy(spec):
    everything = frozenset(ALIGNED_SIGNALS)
    estimators, skipped = table.runnable((spec.name,), Car(SEDAN), everything)
    lacks = spec.network not in ("", "optional") or spec.needs_noise
    wanted = ([], [spec.name]) if lacks else ([spec.name], [])
    assert ([e.name for e in estimators], [s.name for s in skipped]) == wanted
    if lacks:
        assert "--network" in skipped[0].reason or "fit.toml" in skipped[0].reason
        with pytest.raises(UsageError, match=spec.name):
            table.make_estimator(spec.name, Car(SEDAN))
    assert (spec.name in table.all_names(Car(SEDAN))) == (spec.group == table.ALL_ESTIMATORS and not lacks)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("physics-plus", r"expected estimators out of all, peers, zero, .* \(0 to 1\), got physics-plus$"),
        *((f"pd-hef:{option}", f"got pd-hef:{option}$") for option in ("trust=1", "gain", "gain=2", "gain=nan", "")),
        ("pd-hef:fixed-r=1", "got pd-hef:fixed-r=1$"),
        ("physics:tuned", "got physics:tuned$"),
        ("zero", "zero"),
    ],
)
def test_an_unknown_name_or_option_is_answered_with_those_that_exist(name, message):
    with pytest.raises(UsageError, match=message):
        table.check_names(("zero", name))


def test_a_group_names_its_estimators_and_each_runs_once():
    everything = frozenset(ALIGNED_SIGNALS)
    peers = [s.name for s in table.SPECS if s.group == table.PEERS]
    assert [e.name for e in table.runnable((table.PEERS,), CAR, everything)[0]] == peers
    table.check_names(("linear-kf", "physics", table.PEERS))
    named, _ = table.runnable(("linear-kf", "physics", table.PEERS), CAR, everything)
    assert [e.name for e in named] == ["linear-kf", "physics", *(n for n in peers if n != "linear-kf")]
    both, _ = table.runnable((table.ALL_ESTIMATORS, table.PEERS), CAR, everything)
    assert [e.name for e in both] == [*table.all_names(CAR), *peers]


def test_a_name_states_the_gain():
    assert ran("pd-hef:gain=0.5").options["trust"] == 0.5
    assert table.make_estimator("pd-hef:gain=0.5", CAR).name == "pd-hef:gain=0.5"
    _, skipped = table.runnable(("pd-hef:gain=0.5",), Car(SEDAN), frozenset(ALIGNED_SIGNALS))
    assert [s.name for s in skipped] == ["pd-hef:gain=0.5"]


# --- algorithm of each name ------------------------------------------------------------------------------------------


def ran(name: str, car: Car = CAR, **options: Any) -> Algorithm:
    return resolve(table.make_estimator(name, car, table.Options(**options)))


# --- pd-hef without residual is physics ------------------------------------------------------------------------------

BARE = replace(CAR, network_gain=None, noise={})


def test_the_gain_decides_what_pd_hef_is():
    trusted, cautious = table.make_estimator("pd-hef", CAR), table.make_estimator("pd-hef", BARE)
    assert trusted.name == cautious.name == "pd-hef"
    assert resolve(trusted).identity != resolve(cautious).identity
    assert resolve(cautious) == ran("physics", BARE)
    without = replace(CAR, network=None)
    assert ran("pd-hef", without) == ran("physics", without)
    papers = replace(CAR, network=MODEL.paper_network)
    assert ran("pd-hef", papers) == ran("physics", papers)


# ---- monitor of divergence: exact kinematics with and without an error of the estimate, and the wrong branch ----

IMU_X_M, IMU_Y_M = 0.8, -0.3
MEASURED_CAR = default_vehicle().model_copy(update={"imu_position_m": (IMU_X_M, IMU_Y_M, 0.0)})
TILT = 1.0 + GRAVITY_M_S2 * MEASURED_CAR.roll_gradient_rad_per_m_s2
SPEED_M_S = 25.0


def motion(
    share: float = 0.9, duration_s: float = 12.0, hz: float = 0.4, seed: int = 0, delay_ns: int = 10_000_000
) -> tuple[Signals, StateTrack]:
    """Return sensor signals and true state of a slalom up to a share of the grip, at irregular 100 Hz."""
    rng = np.random.default_rng(seed)
    dt = rng.uniform(0.008, 0.012, round(duration_s * 100))
    t = np.concatenate([[0.0], np.cumsum(np.round(dt * 1e9) * 1e-9)])
    w = 2.0 * math.pi * hz
    peak = share * FRICTION * GRAVITY_M_S2 / SPEED_M_S
    r, r_dot, r_dot2 = peak * np.sin(w * t), peak * w * np.cos(w * t), -peak * w * w * np.sin(w * t)
    vy, vy_dot = -0.8 * r_dot, -0.8 * r_dot2
    ay = vy_dot + SPEED_M_S * r
    speed, friction = np.full(len(t), SPEED_M_S), np.full(len(t), FRICTION)
    felt = TILT * ay + IMU_X_M * r_dot - IMU_Y_M * r * r
    signals = make_signals(dt, delay_ns, ay_m_s2=felt, yaw_rate_rad_s=r, speed_m_s=speed, friction=friction)
    covariance = np.tile(np.diag([0.01, 0.01, 1e-5]), (len(t), 1, 1))
    state = {"vx_m_s": speed, "vy_m_s": vy, "yaw_rate_rad_s": r, "covariance": covariance}
    track = make_track("f", signals.stamps_ns, **state)
    return signals, track


def off_by(track: StateTrack, degrees: float, from_s: float, to_s: float, rise_s: float = 0.3) -> StateTrack:
    """Return the track with its sideslip off by an angle between two times, up and down within ``rise_s``."""
    t = (track.stamps_ns - track.stamps_ns[0]) * 1e-9
    shape = np.clip((t - from_s) / rise_s, 0.0, 1.0) - np.clip((t - to_s) / rise_s, 0.0, 1.0)
    return replace(track, vy_m_s=track.vy_m_s + SPEED_M_S * math.tan(math.radians(degrees)) * shape)


def seconds(signals: Signals) -> np.ndarray:
    return (signals.stamps_ns - signals.stamps_ns[0]) * 1e-9


def flags(track: StateTrack, signals: Signals) -> np.ndarray:
    return watched_track(track, signals, MEASURED_CAR).diverged


@settings(deadline=None, max_examples=20)
@given(share=st.floats(0.0, 1.0), hz=st.floats(0.1, 1.5), seed=st.integers(0, 99))
def test_the_true_motion_is_never_flagged(share, hz, seed):
    signals, truth = motion(share, hz=hz, seed=seed)
    rng, stds = np.random.default_rng(seed), (MEASURED_CAR.sensors.ay_std_m_s2, MEASURED_CAR.sensors.yaw_rate_std_rad_s)
    ay, rate = (rng.normal(0.0, std, len(signals)) for std in stds)
    noisy = replace(signals, ay_m_s2=signals.ay_m_s2 + ay, yaw_rate_rad_s=signals.yaw_rate_rad_s + rate)
    assert not flags(truth, noisy).any()


@settings(deadline=None, max_examples=20)
@given(degrees=st.floats(8.0, 40.0), rise_s=st.floats(0.02, 1.0), sign=st.sampled_from([-1, 1]))
def test_an_error_is_flagged_while_it_grows_and_taken_back_with_it(degrees, rise_s, sign):
    signals, truth = motion()
    found, t = flags(off_by(truth, sign * degrees, 5.0, 7.0, rise_s), signals), seconds(signals)
    assert not found[t < 5.0].any()
    grown = 5.0 + rise_s
    assert found[(t > grown + 0.1) & (t < grown + 0.5)].all()
    # The leaky integrator forgets up to 1 − e^(−2/3) of the error. This part changes sign when the error ends.
    left = degrees * (1.0 - math.exp(-(2.0 + rise_s) / 3.0))
    assert left > 2.9 or not found[t > 7.0 + rise_s + 0.1].any()


def test_in_the_linear_range_bank_and_bias_are_no_divergence():
    signals, truth = motion(share=0.3)
    banked = replace(signals, ay_m_s2=signals.ay_m_s2 + 1.0)  # 10 % of bank
    assert not flags(truth, banked).any()


def test_bank_and_gain_near_the_limit_are_no_divergence():
    signals, truth = motion(duration_s=25.0, hz=0.02)
    banked = replace(signals, ay_m_s2=1.07 * signals.ay_m_s2 + GRAVITY_M_S2 * 0.04)
    assert not flags(truth, banked).any()


def test_noise_that_the_drive_shows_is_no_divergence():
    signals, truth = motion()
    noisy = replace(signals, ay_m_s2=signals.ay_m_s2 + np.random.default_rng(0).normal(0.0, 40.0, len(signals)))
    shown = FilterNoise(r_std={"ay_m_s2": 40.0})
    assert flags(truth, noisy).any() and not watched_track(truth, noisy, MEASURED_CAR, shown).diverged.any()
    assert watched_track(off_by(truth, 40.0, 5.0, 7.0), noisy, MEASURED_CAR, shown).diverged.any()


def test_what_comes_later_changes_no_flag():
    signals, truth = motion()
    wrong = off_by(truth, 20.0, 5.0, 7.0)
    whole = flags(wrong, signals)
    end = 600
    part = flags(wrong.rows(0, end), signals.rows(0, end))
    assert whole[:end].any()
    np.testing.assert_array_equal(part, whole[:end])


def test_the_watch_adds_to_what_an_estimator_says_itself_and_leaves_those_without_a_covariance():
    signals, truth = motion()
    own = np.zeros(len(signals), dtype=np.bool_)
    own[:10] = True
    wrong = off_by(truth, 20.0, 5.0, 7.0)
    np.testing.assert_array_equal(flags(replace(wrong, diverged=own), signals), own | flags(wrong, signals))
    plain = replace(wrong, covariance=np.empty((0, 3, 3)))
    assert watched_track(plain, signals, MEASURED_CAR) is plain


def test_a_filter_on_the_wrong_branch_is_flagged_at_once_in_every_output(sample_logs_dir, tmp_path):
    """A growing sine on a slippery road: beyond the peak of the tyres, the true sideslip still moderate."""
    drive = simulate_drive(
        "sine-sweep", speed_km_h=100.0, friction=0.3, amplitude=1.08, seed=7302, keep_spins=True, tolerance=0.01
    )
    write_drive(drive, sweep := tmp_path / "sweep.mcap")
    names = ("phy-ukf", "physics", "zero")
    config = RunConfig(car=sample_logs_dir / "vehicle_mu03.toml", estimators=names, keep="estimates")
    result = run_logs([str(sweep)], tmp_path, config, report=False)
    folder = tmp_path / "logs" / "sweep"
    table = pl.read_parquet(folder / "estimates.parquet")
    true = table.filter(pl.col("estimator") == "truth").select("stamp_ns", true="sideslip_rad")
    report = json.loads((folder / "report.json").read_text())
    text = rendered(render_run, result, 160)
    for name in names[:2]:
        of = table.filter(pl.col("estimator") == name).join(true, on="stamp_ns").sort("stamp_ns")
        beta, truth = np.degrees(of["sideslip_rad"].to_numpy()), np.degrees(of["true"].to_numpy())
        t = (of["stamp_ns"].to_numpy() - of["stamp_ns"][0]) * 1e-9
        wrong = abs(beta - truth) > 8.0
        start = float(t[int(np.flatnonzero(wrong)[0])])
        # It is the wrong branch: within two seconds the estimate is far beyond the truth.
        soon = (t >= start) & (t <= start + 2.0)
        assert (abs(beta)[soon] > 2.5 * abs(truth)[soon]).any()
        assert abs(beta)[soon].max() > 25.0
        said = of["diverged"].to_numpy()
        assert not said[t < start - 1.0].any()
        first = float(t[int(np.flatnonzero(said)[0])])
        assert first < start + 0.1
        assert said[wrong].mean() > 0.7
        spans = [s for s in report["segments"] if s["name"] == f"{name} diverged"]
        assert (spans[0]["start_ns"] - int(of["stamp_ns"][0])) * 1e-9 == pytest.approx(first, abs=1e-6)
        (line,) = lines_of("diverged", report, name)
        assert line.startswith("diverged for ") and line in text
    assert not table.filter(pl.col("estimator") == "zero")["diverged"].any()
