"""The adaptive filter: no adaptation without a fault, and a correct diagnosis of each fault."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_models import random_network
from pdhef_logtool.estimators.physics_filter import PhysicsFilter
from reference_car import cut, drive, slalom, tanh_tyre, with_noise

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.parts import FilterNoise
from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.estimators.adaptive_physics import CURES, LEAST_WEIGHT, AdaptivePhysics, mix, weigh
from pdhef_logtool.estimators.algorithm import resolve
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.estimators.table import Options, make_estimator
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack, make_track
from pdhef_logtool.residual_model.service import NetworkService

pytestmark = pytest.mark.slow

#: The reference car does not roll.
VEHICLE = default_vehicle().model_copy(update={"roll_gradient_rad_per_m_s2": 0.0})
COMPARED = ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "sideslip_rad", "ay_m_s2", "covariance", "nis", "valid", "r_scale")
ADAPTIVE = (*COMPARED, "mixture_weight", "reason")


NETWORK = NetworkService(random_network())
SILENT = NetworkService(random_network(constant=(0.0, 0.0)))


#: As a car that was identified: a single track with the cures and the noise that it was found with.
PARTS = VEHICLE.physics.model_copy(update={"force_scale": True, "bank": True})
PHYSICS = PhysicsFilter(
    VEHICLE.model_copy(update={"physics": PARTS}),
    q_std=(0.089, 0.06, 0.03, 0.021, 0.4, 0.4),
    r_std=(0.3, 0.003, 0.08),
)
#: The same filter without the additional physics of ``PARTS``.
PLAIN = replace(PHYSICS, vehicle=VEHICLE)


def adaptive(network: NetworkService = SILENT, **options) -> AdaptivePhysics:
    return AdaptivePhysics(**{"physics": PHYSICS, "network": network, "trust": 1.0, **options})


def fixed(network: NetworkService = SILENT, **options) -> AdaptivePhysics:
    given = {"physics": PLAIN, "network": network, "trust": 1.0, **options}
    return AdaptivePhysics(adaptive=False, name="pd-hef:fixed-r", **given)


def times(signals: Signals) -> np.ndarray:
    return (signals.stamps_ns - signals.stamps_ns[0]) * 1e-9


def same(a: StateTrack, b: StateTrack, columns=COMPARED) -> bool:
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


@pytest.fixture(scope="module")
def rough() -> Signals:
    rng = np.random.default_rng(4)
    s = with_noise(drive(slalom(0.04, 0.5), speed=22.0, mu=0.6, step_s=rng.uniform(0.004, 0.022, 700)).signals, seed=5)
    t = times(s)
    s.friction[:] = 0.85
    s.yaw_rate_rad_s[(t > 2) & (t < 3)] = 0.01
    s.ay_m_s2[(t > 4) & (t < 5)] += 2.0 * rng.standard_normal(int(((t > 4) & (t < 5)).sum()))
    s.ay_m_s2[rng.random(len(t)) < 0.05] = np.nan
    return replace(s, ready_ns=np.maximum.accumulate(s.stamps_ns + rng.integers(0, 45_000_000, len(s))))


# --- without faults --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("trust", [0.0, 0.4, 1.0])
def test_without_noise_and_error_it_is_the_fixed_filter_to_the_bit(made, trust):
    signals = replace(made.signals, friction=np.full(len(made.signals), 0.85))
    a, _ = run_window(adaptive(trust=trust, physics=PLAIN), signals)
    b, _ = run_window(fixed(trust=trust), signals)
    assert same(a, b)
    assert set(a.network_trust[a.valid]) == {trust}


def test_with_noise_it_is_the_fixed_filter_but_for_a_few_samples(made):
    """On clean drives, the adaptation hardly changes the estimate."""
    for seed in range(5):
        signals = noisy(made, seed)
        a, _ = run_window(adaptive(), signals)
        b, _ = run_window(fixed(), signals)
        away = np.abs(a.sideslip_rad - b.sideslip_rad)[a.valid]
        assert np.median(away) < np.radians(0.001)
        assert np.sqrt(np.mean(away**2)) < np.radians(0.01)


# --- bottom layer ----------------------------------------------------------------------------------------------------


def test_a_burst_raises_r_for_its_time_and_costs_less(made):
    t = made.time_s
    clean, burst = noisy(made, 1), (t > 4) & (t < 6)
    rng = np.random.default_rng(2)
    bad = replace(
        clean,
        ay_m_s2=clean.ay_m_s2 + burst * 2.4 * rng.standard_normal(len(t)),
        yaw_rate_rad_s=clean.yaw_rate_rad_s + burst * 0.08 * rng.standard_normal(len(t)),
    )
    track, _ = run_window(adaptive(), bad)
    assert np.median(track.r_scale[(t > 4.1) & burst]) > 50
    assert (track.r_scale[t > 6.7] == 1.0).all()
    error = {e.name: np.abs(run_window(e, bad)[0].sideslip_rad - made.sideslip) for e in (adaptive(), fixed())}
    assert error["pd-hef"][burst].mean() < 0.5 * error["pd-hef:fixed-r"][burst].mean()


def test_a_slow_model_error_leaves_r_alone(weak):
    track, _ = run_window(adaptive(), noisy(weak), None)
    assert (track.r_scale == 1.0).mean() > 0.99
    innovation = PLAIN.run(noisy(weak), None)[0].innovation[:, 0]
    assert np.sqrt(np.nanmean(innovation**2)) > 2 * VEHICLE.sensors.ay_std_m_s2, "there was an error to be misread"


@pytest.mark.parametrize("how", ["stuck", "dead"])
def test_a_gyro_that_fails_does_not_take_the_filter_with_it(made, how):
    t, signals = made.time_s, noisy(made, 3)
    bad = (t > 4) & (t < 8)
    held = signals.yaw_rate_rad_s[np.argmax(bad)] if how == "stuck" else 0.0
    faulty = replace(signals, yaw_rate_rad_s=np.where(bad, held, signals.yaw_rate_rad_s))
    error = {
        e.name: np.sqrt(np.nanmean((run_window(e, faulty)[0].sideslip_rad - made.sideslip)[bad] ** 2))
        for e in (adaptive(), fixed())
    }
    assert error["pd-hef"] < np.radians(0.1)
    assert error["pd-hef"] < 0.2 * error["pd-hef:fixed-r"]


# --- top layer -------------------------------------------------------------------------------------------------------


def weights(estimator: AdaptivePhysics, signals: Signals) -> np.ndarray:
    return np.nan_to_num(run_window(estimator, signals)[0].mixture_weight)


def test_forces_that_are_wrong_in_proportion_are_scaled(weak):
    signals = noisy(weak)
    assert weights(adaptive(), signals)[150:].mean() > 0.8
    error = {
        e.name: np.sqrt(np.nanmean((run_window(e, signals)[0].sideslip_rad - weak.sideslip)[150:] ** 2))
        for e in (adaptive(), fixed())
    }
    assert error["pd-hef"] < 0.7 * error["pd-hef:fixed-r"]


def rmse(estimator: AdaptivePhysics, signals: Signals, made) -> float:
    return float(np.sqrt(np.nanmean((run_window(estimator, signals)[0].sideslip_rad - made.sideslip)[100:] ** 2)))


def test_cures_of_nothing_cost_little(made):
    """With a correct model and white noise, the mixture is nearly as accurate as the simplest filter."""
    for seed in range(3):
        signals = noisy(made, seed)
        loud = 0.3 * np.random.default_rng(0).standard_normal(len(signals))
        for given_signals in (signals, replace(signals, ay_m_s2=signals.ay_m_s2 + loud)):
            assert rmse(adaptive(), given_signals, made) < 1.15 * rmse(fixed(), given_signals, made)


def test_each_filter_has_one_cure_and_only_those_that_the_car_has():
    for own in ((), ("force_scale",), ("bank",), CURES):
        parts = VEHICLE.physics.model_copy(update=dict.fromkeys(own, True))
        physics = replace(PHYSICS, vehicle=VEHICLE.model_copy(update={"physics": parts}))
        filters = AdaptivePhysics(physics).filters
        cures = [tuple(c for c in CURES if getattr(f.vehicle.physics, c)) for f in filters]
        assert cures == [(), *((c,) for c in own)]
        assert AdaptivePhysics(physics, adaptive=False).filters == (physics,)


def test_a_banked_road_is_taken_for_one(made):
    """On a banked bend, gravity supplies a part of the lateral force. No accelerometer measures this part."""
    leaning = drive(slalom(0.035, 0.5), 12.0, speed=22.0, side_pull_m_s2=-9.80665 * 0.08)
    signals = noisy(leaning, 7)
    lone, _ = run_window(fixed(), signals)
    track, _ = run_window(adaptive(), signals)
    assert np.nanmean(track.bank_rad[600:]) > 0.03
    errors = [np.sqrt(np.nanmean((x.sideslip_rad - leaning.sideslip)[600:] ** 2)) for x in (track, lone)]
    assert errors[0] < 0.6 * errors[1]
    flat, _ = run_window(adaptive(), noisy(made, 7), None)
    assert abs(np.nanmean(flat.bank_rad)) < 0.01


@given(st.lists(st.tuples(st.floats(-800, 800), st.booleans()), min_size=1, max_size=4))
def test_weights_are_shares_of_what_can_be_used(filters):
    evidence = np.array([[e for e, _ in filters]])
    usable = np.array([[u for _, u in filters]])
    weights = weigh(evidence, usable)
    assert (weights[~usable] == 0.0).all()
    assert weights.sum() == pytest.approx(1.0 if usable.any() else 0.0)
    for i, j in [(i, j) for i in range(len(filters)) for j in range(len(filters)) if weights[0, i] and weights[0, j]]:
        assert np.log(weights[0, i] / weights[0, j]) == pytest.approx(evidence[0, i] - evidence[0, j], abs=1e-6)
    best = np.max(evidence, where=usable, initial=-np.inf)
    lost = usable & (weights == 0.0)
    assert (evidence[lost] < best + np.log(LEAST_WEIGHT) + np.log(len(filters)) + 1e-9).all()


def test_the_mixture_has_the_moments_of_its_samples():
    rng = np.random.default_rng(0)
    means = np.array([[20.0, 0.5, 0.1], [20.4, 0.2, 0.16]])
    roots = 0.1 * rng.standard_normal((2, 3, 3))
    P = roots @ roots.transpose(0, 2, 1)
    tracks = [
        replace(
            make_track("x", np.array([0]), vx_m_s=m[:1], vy_m_s=m[1:2], yaw_rate_rad_s=m[2:], ay_m_s2=np.array([1.0])),
            covariance=p[None],
        )
        for m, p in zip(means, P, strict=True)
    ]
    mixed = mix(np.array([[0.7, 0.3]]), tracks)
    n = 400_000
    drawn = np.concatenate(
        [rng.multivariate_normal(m, p, int(share * n)) for m, p, share in zip(means, P, (0.7, 0.3), strict=True)]
    )
    np.testing.assert_allclose(
        [mixed.vx_m_s[0], mixed.vy_m_s[0], mixed.yaw_rate_rad_s[0]], drawn.mean(axis=0), atol=2e-3
    )
    np.testing.assert_allclose(mixed.covariance[0], np.cov(drawn.T), atol=1e-3)
    assert mixed.sideslip_std_rad[0] == pytest.approx(np.arctan2(drawn[:, 1], drawn[:, 0]).std(), rel=0.02)
    lone = replace(tracks[0], valid=np.array([False]), vy_m_s=np.array([np.nan]))
    for weights in ([[0.7, 0.3]], [[1.0, 0.0]]):
        assert mix(np.array(weights), [lone, tracks[1]]).vy_m_s[0] == tracks[1].vy_m_s[0]
    assert mix(np.array([[0.7, 0.3]]), [tracks[1], lone]).vy_m_s[0] == tracks[1].vy_m_s[0]
    assert not mix(np.array([[0.7, 0.3]]), [lone, lone]).valid[0]


def test_trust_scales_the_network_in_all_filters(made):
    wrong = NetworkService(random_network(constant=(0.5, 0.2)))
    signals = noisy(made)
    a, _ = run_window(adaptive(wrong, trust=0.0), signals)
    b, _ = run_window(adaptive(SILENT, trust=1.0), signals)
    assert same(a, b)
    assert not same(run_window(adaptive(wrong), signals)[0], b)


def test_its_noise_comes_from_the_car():
    tuned = Car.of(VEHICLE, network=SILENT.bundle, noise={"physics": FilterNoise(r_std={"ay_m_s2": 2.0})})
    found = [
        make_estimator(n, tuned, Options(trust=t)) for n, t in (("physics", None), ("pd-hef", 0.0), ("pd-hef", 1.0))
    ]
    for estimator in found:
        assert isinstance(estimator, AdaptivePhysics)
        assert estimator.physics.measurement_std[0] == 2.0
    assert resolve(found[0]) == resolve(found[1]) != resolve(found[2])


# --- windows, causality, symmetry ------------------------------------------------------------------------------------


@settings(derandomize=True, deadline=None, max_examples=15)
@given(j=st.integers(1, 600), seed=st.integers(0, 2**32 - 1))
def test_nothing_that_arrives_later_changes_an_output(rough, j, seed):
    rng = np.random.default_rng(seed)
    later = np.arange(len(rough)) >= j
    columns = {
        c: np.where(later, rng.normal(0, 5, len(rough)), getattr(rough, c))
        for c in ("ay_m_s2", "yaw_rate_rad_s", "steer_rad")
    }
    estimator = adaptive(NETWORK)
    a, b = run_window(estimator, rough)[0], run_window(estimator, replace(rough, **columns), None)[0]
    before = int(np.searchsorted(rough.stamps_ns, rough.ready_ns[j], side="left"))
    for column in ADAPTIVE:
        np.testing.assert_array_equal(getattr(a, column)[:before], getattr(b, column)[:before])


def test_left_and_right_are_mirrored(rough):
    mirrored = replace(rough, **{c: -getattr(rough, c) for c in ("steer_rad", "ay_m_s2", "yaw_rate_rad_s")})
    a, b = run_window(adaptive(), rough)[0], run_window(adaptive(), mirrored)[0]
    np.testing.assert_allclose(b.vy_m_s, -a.vy_m_s, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(b.sideslip_std_rad, a.sideslip_std_rad, rtol=1e-6)


@pytest.mark.filterwarnings("error", "ignore::ResourceWarning")
def test_bad_signals_leave_it_finite_and_its_covariance_definite(rough):
    nothing = {c: np.full(len(rough), np.nan) for c in ("ay_m_s2", "yaw_rate_rad_s", "friction", "ax_m_s2")}
    spiked = {"ay_m_s2": np.where(np.arange(len(rough)) % 50 == 0, 1e6, rough.ay_m_s2)}
    for change in ({}, nothing, spiked):
        track, _ = run_window(adaptive(NETWORK), replace(rough, **change), None)
        assert track.valid[20:].mean() > 0.9
        ok = track.valid
        for column in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "ay_m_s2", "sideslip_std_rad"):
            assert np.isfinite(getattr(track, column)[ok]).all(), column
            assert np.isnan(getattr(track, column)[~ok]).all(), column
        assert (np.linalg.eigvalsh(track.covariance[ok]) > 0).all()
    assert len(run_window(adaptive(), cut(rough, 0, 0), None)[0]) == 0


def test_another_tyre_is_not_noise():
    made = drive(slalom(0.05, 0.4), 12.0, speed=24.0, tyre=tanh_tyre, mu=0.85)
    signals = noisy(made)
    assert rmse(adaptive(), signals, made) < 1.15 * rmse(fixed(), signals, made)
