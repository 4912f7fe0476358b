"""The adaptive filter: no adaptation without a fault, and a correct diagnosis of each fault."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_models import random_network
from reference_car import drive, slalom, with_noise

from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.drive.sensor_faults import without_faults
from pdhef_logtool.estimators.adaptive_physics import AdaptivePhysics, mix, weigh
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.vehicle_ukf import VehicleUkf
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack, make_track
from pdhef_logtool.residual_model.bundle import ModelBundle

pytestmark = pytest.mark.slow

#: The reference car does not roll.
VEHICLE = default_vehicle().model_copy(update={"roll_gradient_rad_per_m_s2": 0.0})
COMPARED = ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "sideslip_rad", "ay_m_s2", "covariance", "nis", "valid", "r_scale")


SILENT = random_network(constant=(0.0, 0.0))


#: As a car that was identified: a single track with the cures and the noise that it was found with.
PARTS = VEHICLE.physics.model_copy(update={"force_scale": True, "bank": True})
PHYSICS = VehicleUkf(
    VEHICLE.model_copy(update={"physics": PARTS}),
    q_std=(0.089, 0.06, 0.03, 0.021, 0.4, 0.4),
    r_std=(0.3, 0.003, 0.08),
)
#: The same filter without the additional physics of ``PARTS``.
PLAIN = replace(PHYSICS, vehicle=VEHICLE)


def adaptive(network: ModelBundle = SILENT, **options) -> AdaptivePhysics:
    return AdaptivePhysics(**{"physics": PHYSICS, "network": network, "trust": 1.0, **options})


def fixed(network: ModelBundle = SILENT, **options) -> AdaptivePhysics:
    given = {"physics": PLAIN, "network": network, "trust": 1.0, **options}
    return AdaptivePhysics(adaptive=False, name="pd-hef:fixed-r", **given)


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
    bad = replace(
        clean,
        ay_m_s2=clean.ay_m_s2 + burst * 2.4 * rng.standard_normal(len(t)),
        yaw_rate_rad_s=clean.yaw_rate_rad_s + burst * 0.08 * rng.standard_normal(len(t)),
    )
    checked = without_faults(bad, VEHICLE)
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
    error = rmse(adaptive(), without_faults(faulty, VEHICLE), made, bad)
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
