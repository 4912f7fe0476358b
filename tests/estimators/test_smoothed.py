"""The smoother: against an independent one, better than its filter, and bounded in look-ahead and memory."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import test_estimators as properties
from made_models import random_network
from reference_car import REAR_M, cut, drive, forces, keep, rolling_drive, runge_kutta, slalom, with_noise

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import PhysicsParts, default_vehicle
from pdhef_logtool.estimators.adaptive_physics import AdaptivePhysics
from pdhef_logtool.estimators.base import Smoother
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.smoothed import BLOCK_S, ForwardSteps, SmoothedPhysics, smooth_steps
from pdhef_logtool.estimators.table import SPECS, make_estimator
from pdhef_logtool.estimators.vehicle_ukf import VehicleUkf
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.residual_model.service import NetworkService

pytestmark = pytest.mark.slow

VEHICLE = default_vehicle()
ALL = 10**6  # seconds: a block that holds every drive
BUNDLE = random_network(2)


def smoother(block_s: float = ALL, *, trust: float = 1.0, parts: tuple[str, ...] = ("lag", "biases")):
    vehicle = VEHICLE.model_copy(update={"physics": PhysicsParts(**dict.fromkeys(parts, True))})
    return SmoothedPhysics(AdaptivePhysics(VehicleUkf(vehicle), NetworkService(BUNDLE), trust), block_s=block_s)


def flat_smoother(*parts: str) -> SmoothedPhysics:
    """For the reference car, which does not roll, without network."""
    update = {"roll_gradient_rad_per_m_s2": 0.0, "physics": PhysicsParts(**dict.fromkeys(parts, True))}
    return SmoothedPhysics(AdaptivePhysics(VehicleUkf(VEHICLE.model_copy(update=update))))


def times(signals: Signals) -> FloatArray:
    return (signals.stamps_ns - signals.stamps_ns[0]) * 1e-9


def on_time(signals: Signals) -> Signals:
    """Without latency, for the filter, which then has each step at its own stamp."""
    return replace(signals, ready_ns=signals.stamps_ns)


# --- against another smoother ----------------------------------------------------------------------------------------

Q_STD, R_STD = (0.05, 0.3, 0.15, 0.05), (0.12, 0.004, 0.08)
WEIGHT = np.array([0.0] + [1 / 8] * 8)
WEIGHT_C = WEIGHT + np.array([2.0] + [0.0] * 8)


def _points(x, P):
    root = np.linalg.cholesky(len(x) * P)
    return np.concatenate([x[None], x + root.T, x - root.T])


def _covariance(a, b):
    return (a - WEIGHT @ a).T @ (WEIGHT_C[:, None] * (b - WEIGHT @ b))


def unscented_smoother(signals: Signals, rate: FloatArray):
    """Unscented filter and smoother in plain numpy, the residual as a known input (Särkkä 2008)."""

    def moved(s, k, dt):
        push = np.concatenate([[0.0], 0.5 * dt * rate[k - 1]])
        steer, ax, mu = (0.5 * (c[k - 1] + c[k]) for c in (signals.steer_rad, signals.ax_m_s2, signals.friction))
        return np.append(runge_kutta(s[:3] + push, steer, ax - s[3], mu, dt) + push, s[3])

    def seen(s, k):
        return forces(*s[:3], signals.steer_rad[k], signals.friction[k])[0] + rate[k - 1, 0], s[2], s[0]

    r0 = signals.yaw_rate_rad_s[0]
    x, P = np.array([signals.speed_m_s[0], REAR_M * r0, r0, 0.0]), np.diag(np.array([0.5, 0.5, 0.1, 0.3]) ** 2)
    rows = [(x, P, x, P, P)]
    for k in range(1, len(signals)):
        dt = (signals.stamps_ns[k] - signals.stamps_ns[k - 1]) * 1e-9
        before = _points(x, P)
        after = np.array([moved(s, k, dt) for s in before])
        xp, Pp = WEIGHT @ after, _covariance(after, after) + np.diag(np.array(Q_STD) ** 2) * dt
        chi = _points(xp, Pp)
        z = np.array([signals.ay_m_s2[k], signals.yaw_rate_rad_s[k], signals.speed_m_s[k]])
        use = np.isfinite(z)
        zeta = np.array([seen(s, k) for s in chi])[:, use]
        S = _covariance(zeta, zeta) + np.diag(np.array(R_STD)[use] ** 2)
        K = _covariance(chi, zeta) @ np.linalg.inv(S)
        x, P = xp + K @ (z[use] - WEIGHT @ zeta), Pp - K @ S @ K.T
        rows.append((x, P, xp, Pp, _covariance(before, after)))
    xs, Ps, priors, predicted, crosses = (np.array(column) for column in zip(*rows, strict=True))
    for k in range(len(signals) - 2, -1, -1):
        G = crosses[k + 1] @ np.linalg.inv(predicted[k + 1])
        xs[k] += G @ (xs[k + 1] - priors[k + 1])
        Ps[k] += G @ (Ps[k + 1] - predicted[k + 1]) @ G.T
    return xs, Ps


def smoothed(physics: VehicleUkf, signals: Signals, rate: FloatArray | None = None):
    """Return the forward steps, their links, and the smoothed states and covariances."""
    steps, _, links = physics.linked_steps(signals, None, rate)
    return steps, links, *smooth_steps(ForwardSteps(steps, links))


def test_agrees_with_an_unscented_smoother_in_plain_numpy():
    rng = np.random.default_rng(7)
    made = drive(
        lambda t: 0.045 * math.sin(2.4 * t), speed=24.0, step_s=rng.uniform(0.002, 0.03, 300),
        acceleration=lambda t: math.cos(0.7 * t),
    )  # fmt: skip
    s = with_noise(made.signals, seed=3)
    s.ay_m_s2[rng.random(len(s)) < 0.1] = np.nan
    s.friction[:] = np.where(np.arange(len(s)) < 200, 0.85, 0.78)
    t = made.time_s
    rate = np.stack([0.3 * np.sin(2 * t), 0.1 * np.cos(3 * t)], axis=1)
    steps, _, x, P = smoothed(VehicleUkf(VEHICLE, "nominal", q_std=Q_STD, r_std=R_STD), s, rate)
    want_x, want_P = unscented_smoother(s, rate)
    assert np.nanmax(steps.nis) < 36.0, "the drive must stay inside the gate"
    np.testing.assert_allclose(x, want_x, rtol=1e-8, atol=1e-9)
    scale = np.sqrt(np.einsum("kii->ki", want_P))
    assert np.abs((P - want_P) / (scale[:, :, None] * scale[:, None, :])).max() < 1e-8
    assert not np.allclose(steps.x, want_x, atol=1e-2), "smoothing must do something"


# --- the estimator ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rough() -> Signals:
    """Noise, irregular stamps, missing samples, a gap that restarts the filter, messages late, a gyro that jumps."""
    rng = np.random.default_rng(12)
    s = with_noise(drive(slalom(0.035, 0.5), speed=22.0, step_s=rng.uniform(0.004, 0.022, 700)).signals, seed=6)
    for column in (s.steer_rad, s.ax_m_s2, s.ay_m_s2, s.yaw_rate_rad_s):
        column[rng.random(len(s)) < 0.05] = np.nan
    t = times(s)
    s.yaw_rate_rad_s[(t > 5.0) & (t < 5.6)] += 0.5
    ready = np.maximum.accumulate(s.stamps_ns + rng.integers(0, 45_000_000, len(s)))
    return keep(replace(s, ready_ns=ready), (t < 3.0) | (t > 3.8))


@pytest.fixture(scope="module")
def stopping() -> Signals:
    """Rolls, stands for three seconds, rolls on."""
    made = rolling_drive(lambda t: 4.0 * np.clip(np.abs(t - 5.5) - 1.5, 0.0, 1.0), lambda t: 0.05 * np.sin(t), 11.0)
    return with_noise(made.signals, seed=2, scale=0.1)


def test_it_sees_one_to_two_blocks_ahead_and_no_further(rough):
    estimator, j = smoother(0.5), 150
    ay = rough.ay_m_s2.copy()
    ay[j] = 1.0
    a, b = estimator.smooth(rough), estimator.smooth(replace(rough, ay_m_s2=ay))
    differs = np.flatnonzero(a.vy_m_s != b.vy_m_s)
    assert 0.5 <= (rough.stamps_ns[j] - rough.stamps_ns[differs.min()]) * 1e-9 < 1.0


@pytest.mark.parametrize(("block_s", "parts", "tolerance_m_s"), [(4.0, (), 1e-5), (BLOCK_S, ("lag", "biases"), 5e-3)])
def test_blocks_are_as_good_as_the_whole_drive(block_s, parts, tolerance_m_s):
    """Without sensor biases four seconds are enough. The biases of a drive at 20 Hz take minutes: 0.01° of sideslip."""
    signals = with_noise(drive(slalom(0.02, 0.3), 200.0, step_s=0.05).signals, seed=1)
    a, b = (smoother(s, parts=parts).smooth(signals) for s in (block_s, ALL))
    assert not np.array_equal(a.vy_m_s, b.vy_m_s)
    np.testing.assert_allclose(a.vy_m_s, b.vy_m_s, atol=tolerance_m_s)


def test_an_empty_drive_has_an_empty_track(rough):
    assert len(smoother().smooth(rough.rows(0, 0))) == 0


@pytest.mark.parametrize("parts", [(), tuple(PhysicsParts.model_fields)])
@pytest.mark.parametrize("which", ["rough", "stopping"])
def test_the_covariance_is_never_larger_than_the_filters(which, parts, request):
    steps, links, x, P = smoothed(smoother(parts=parts).filtered.physics, request.getfixturevalue(which))
    done = steps.valid
    scale = np.sqrt(np.einsum("kii->ki", steps.P))[done]
    known = (scale == 0.0).all(axis=0)  # a steering bias that the car does not have
    scale[:, known] = 1.0
    unit = scale[:, :, None] * scale[:, None, :]
    assert not P[done][:, known].any()
    assert np.linalg.eigvalsh((steps.P[done] - P[done]) / unit).min() > -1e-9
    assert np.linalg.eigvalsh((P[done] / unit)[:, ~known][:, :, ~known]).min() > 0.0
    assert np.median(P[done][:, 1, 1] / steps.P[done][:, 1, 1]) < 0.95
    assert np.isfinite(x[done]).all()
    opened = (links.predicted_P[:, 2, 2] > 5 * np.roll(steps.P[:, 2, 2], 1)) & links.linked
    assert opened[done].any() == (which == "rough"), "the gate opens on the jump"
    assert (~links.linked[1:]).sum() > 100 or which != "stopping", "a standstill links nothing"


def test_a_standstill_stands_and_does_not_pull_what_was_before(stopping):
    track, t = smoother().smooth(stopping), times(stopping)
    assert np.abs(track.vx_m_s[(t > 4.6) & (t < 6.9)]).max() < 0.02
    v = 4.0 * np.clip(np.abs(t - 5.5) - 1.5, 0.0, 1.0)
    assert np.abs(track.vx_m_s - v)[(t < 3.9) | (t > 7.5)].max() < 0.15


def test_nothing_behind_a_gap_tells_of_before(rough):
    gap = int(np.argmax(np.diff(rough.stamps_ns))) + 1
    first = cut(rough, 0, gap)
    whole, before = smoother().smooth(rough), smoother().smooth(first)
    properties.same_bits(whole, before, gap)
    filtered = run_estimator(smoother().filtered, on_time(first))
    assert before.vy_m_s[-1] == filtered.vy_m_s[-1], "at the end of a stretch it is the filter"


@pytest.mark.parametrize("parts", [(), ("biases",)])
def test_it_is_nearer_to_the_truth_than_its_filter(parts):
    errors = []
    for seed in range(6):
        made = drive(slalom(0.03, 0.4 + 0.1 * seed), 10.0, 20.0 + seed, step_s=0.01)
        signals = on_time(with_noise(made.signals, seed=seed))
        estimator = flat_smoother(*parts)
        track, filtered = (run_estimator(e, signals) for e in (estimator, estimator.filtered))
        both = filtered.valid & track.valid
        errors.append([np.mean((e.sideslip_rad - made.sideslip)[both] ** 2) for e in (track, filtered)])
        assert (np.abs(track.vy_m_s - made.vy) < 1.96 * track.vy_std_m_s).mean() > 0.8
    ours, theirs = np.array(errors).T
    assert (ours < theirs).sum() >= 5
    assert np.mean(ours) < 0.93**2 * np.mean(theirs)


# --- the detector ----------------------------------------------------------------------------------------------------


def test_what_it_says_of_itself(rough):
    trusted = Car.of(VEHICLE, network=BUNDLE, network_gain=0.6)
    estimator = make_estimator("pd-hef-smoothed", trusted)
    assert isinstance(estimator, SmoothedPhysics) and isinstance(estimator, Smoother)
    assert (estimator.name, estimator.causal, estimator.filtered.trust) == ("pd-hef-smoothed", False, 0.6)
    assert "not causal" in estimator.notes[0]
    assert "residual gain 0.6" in estimator.notes[1]
    assert [s.name for s in SPECS if not s.causal] == ["open-loop:calibrated", "pd-hef-smoothed"]
    track = run_estimator(estimator, rough)
    assert track.valid[0], "it needs no arrival"
    assert np.isnan(track.nis).all()
    assert not track.nis_dof.any()
    assert set(track.network_trust[track.valid]) == {0.6}
    assert np.array_equal(track.stamps_ns, rough.stamps_ns)
