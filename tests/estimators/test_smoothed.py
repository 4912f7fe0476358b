"""The smoother: against independent smoothers, better than its filter, and the same whatever the windows."""

from __future__ import annotations

import io
import json
import math
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import test_estimators as properties
from filterpy.kalman import KalmanFilter
from made_models import random_network
from pdhef_logtool.estimators.filter_base import AX_BIAS, LINK_BIASES, LINK_NONE, LINK_WHOLE, PosteriorSteps, StepLinks
from pdhef_logtool.estimators.phy_ukf import PhysicsUkf
from pdhef_logtool.estimators.physics_filter import PhysicsFilter
from reference_car import REAR_M, cut, drive, forces, keep, rolling_drive, runge_kutta, slalom, with_noise
from rich.console import Console

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.parts import Trust
from pdhef_logtool.car.vehicle import PhysicsParts, default_vehicle
from pdhef_logtool.cli.run_tables import render_run
from pdhef_logtool.estimators import smoothed
from pdhef_logtool.estimators.adaptive_physics import AdaptivePhysics
from pdhef_logtool.estimators.base import LookingAhead, look_ahead_of
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.estimators.smoothed import ForwardSteps, SmoothedPhysics, smooth_blocks
from pdhef_logtool.estimators.table import SPECS, make_estimator
from pdhef_logtool.records.reasons import (
    BURST_YAW_RATE,
    DEAD_YAW_RATE,
    STUCK_YAW_RATE,
)
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.residual_model.service import NetworkService
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import run_logs

pytestmark = pytest.mark.slow

VEHICLE = default_vehicle()
ALL = 10**6  # seconds: a block that holds every drive
NS = 10**9


BUNDLE = random_network(2)


def smoother(
    block_s: float = ALL, *, trust: float = 1.0, parts: tuple[str, ...] = ("lag", "biases"), **filter_options
) -> SmoothedPhysics:
    vehicle = VEHICLE.model_copy(update={"physics": PhysicsParts(**dict.fromkeys(parts, True))})
    physics = PhysicsFilter(vehicle, **filter_options)
    return SmoothedPhysics(AdaptivePhysics(physics, NetworkService(BUNDLE), trust), block_s=block_s)


def linear_steps(x, P, prior, predicted, cross, kind=None) -> tuple[PosteriorSteps, StepLinks]:
    """Steps of any filter, 10 ms apart."""
    count = len(x)
    nan, no = np.full(count, np.nan), np.zeros(count, dtype=bool)
    stamps = np.arange(count) * 10_000_000
    steps = PosteriorSteps(
        stamps, x, P, np.zeros((count, 4)), nan, nan, nan, np.zeros((count, 3)), ~no, no, prior,
        np.zeros((count, 2)),
    )  # fmt: skip
    if kind is None:
        kind = np.array([LINK_NONE] + [LINK_WHOLE] * (count - 1))
    return steps, StepLinks(kind, predicted, cross)


def smooth_steps(steps, links, count, origin_ns, block_ns):
    """Smooth the first ``count`` steps of one piece."""
    x, P = smooth_blocks([ForwardSteps(steps, links)], steps.stamps_ns, count, origin_ns, block_ns)
    return x[:count], P[:count]


def kalman(z, F, H, Q, R, P0, x0=None):
    """A linear Kalman filter by the book: states, covariances, predictions, their covariances, cross covariances."""
    n = len(F)
    x, P = np.zeros(n) if x0 is None else x0, P0
    rows: list[list[np.ndarray]] = [[], [], [], [], []]
    for k in range(len(z)):
        C = np.zeros((n, n)) if k == 0 else P @ F.T
        if k:
            x, P = F @ x, F @ P @ F.T + Q
        xp, Pp = x, P
        S = H @ P @ H.T + R
        K = P @ H.T @ np.linalg.inv(S)
        x, P = x + K @ (z[k] - H @ x), P - K @ S @ K.T
        for row, value in zip(rows, (x, P, xp, Pp, C), strict=True):
            row.append(value)
    return [np.array(row) for row in rows]


def linear_case(seed: int, n: int = 5, count: int = 60):
    rng = np.random.default_rng(seed)
    F = np.eye(n) + 0.1 * rng.normal(size=(n, n))
    F *= 0.98 / np.abs(np.linalg.eigvals(F)).max()
    A = rng.normal(size=(n, n))
    return rng.normal(size=(count, 2)), F, rng.normal(size=(2, n)), 0.05 * A @ A.T + 0.01 * np.eye(n), np.eye(2) * 0.3


# --- against other smoothers -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_agrees_with_filterpys_smoother_on_a_linear_system(seed):
    z, F, H, Q, R = linear_case(seed)
    x, P, prior, predicted, cross = kalman(z, F, H, Q, R, np.eye(5))
    kf = KalmanFilter(dim_x=5, dim_z=2)
    kf.F, kf.H, kf.Q, kf.R = F, H, Q, R
    theirs_x, theirs_P, _, _ = kf.rts_smoother(x, P)
    ours_x, ours_P = smooth_steps(*linear_steps(x, P, prior, predicted, cross), len(z), 0, ALL * NS)
    assert np.abs(theirs_x - x).max() > 0.1, "smoothing must do something"
    np.testing.assert_allclose(ours_x, theirs_x, atol=1e-10)
    np.testing.assert_allclose(ours_P, theirs_P, atol=1e-10)


def test_time_reversed_it_smooths_to_the_same():
    """A random walk has the same model in both directions, and the prior is uninformative."""
    rng = np.random.default_rng(4)
    n, count = 4, 80
    z = np.cumsum(rng.normal(size=(count, n)), axis=0)
    A = rng.normal(size=(n, n))
    model = (np.eye(n), np.eye(n), A @ A.T + 0.1 * np.eye(n), 2.0 * np.eye(n), 1e7 * np.eye(n))
    forth = smooth_steps(*linear_steps(*kalman(z, *model)), count, 0, ALL * NS)
    back = smooth_steps(*linear_steps(*kalman(z[::-1], *model)), count, 0, ALL * NS)
    np.testing.assert_allclose(forth[0], back[0][::-1], atol=1e-4)
    np.testing.assert_allclose(forth[1], back[1][::-1], atol=1e-4)


def test_what_a_standstill_overwrites_tells_nothing_of_before_but_the_biases_do():
    z, F, H, Q, R = linear_case(7)
    rows = kalman(z, F, H, Q, R, np.eye(5))
    kind = np.array([LINK_NONE] + [LINK_WHOLE] * 59)
    kind[30] = LINK_BIASES
    x, P = smooth_steps(*linear_steps(*rows, kind), 60, 0, ALL * NS)
    fx, fP, prior, predicted, cross = rows
    keep_ = slice(AX_BIAS, None)  # the usual recursion on the marginal of the biases alone
    G = cross[30][:, keep_] @ np.linalg.inv(predicted[30][keep_, keep_])
    np.testing.assert_allclose(x[29], fx[29] + G @ (x[30] - prior[30])[keep_], atol=1e-10)
    want = fP[29] + G @ (P[30] - predicted[30])[keep_, keep_] @ G.T
    np.testing.assert_allclose(P[29], want, atol=1e-10)
    changed = [r.copy() for r in rows]
    changed[0][30:, :AX_BIAS] += 5.0  # only the overwritten states, at and after the standstill
    kind[31] = LINK_NONE
    a, _ = smooth_steps(*linear_steps(*rows, kind), 60, 0, ALL * NS)
    b, _ = smooth_steps(*linear_steps(*changed, kind), 60, 0, ALL * NS)
    np.testing.assert_array_equal(a[:30], b[:30])
    assert not np.allclose(x[:30], fx[:30], atol=1e-3)


Q_STD, R_STD = (0.05, 0.3, 0.15, 0.05), (0.12, 0.004, 0.08)


def unscented_smoother(signals: Signals, rate: np.ndarray):
    """Unscented filter and smoother in plain numpy, the residual as a known input (Särkkä 2008)."""
    n, weight = 4, np.array([0.0] + [1 / 8] * 8)
    weight_c = weight + np.array([2.0] + [0.0] * 8)

    def points(x, P):
        root = np.linalg.cholesky(n * P)
        return np.concatenate([x[None], x + root.T, x - root.T])

    def moments(chi, other=None):
        mean = weight @ chi
        d = chi - mean
        return mean, d.T @ (weight_c[:, None] * d)

    def fx(s, k, dt):
        half = 0.5 * dt * rate[k - 1]
        steer, ax, mu = (0.5 * (c[k - 1] + c[k]) for c in (signals.steer_rad, signals.ax_m_s2, signals.friction))
        push = np.concatenate([[0.0], half])
        out = runge_kutta(s[:3] + push, steer, ax - s[3], mu, dt) + push
        return np.append(out, s[3])

    r0 = signals.yaw_rate_rad_s[0]
    x, P = np.array([signals.speed_m_s[0], REAR_M * r0, r0, 0.0]), np.diag(np.array([0.5, 0.5, 0.1, 0.3]) ** 2)
    xs, Ps, priors, predicted, crosses = [x], [P], [x], [P], [P]
    for k in range(1, len(signals)):
        dt = (signals.stamps_ns[k] - signals.stamps_ns[k - 1]) * 1e-9
        before = points(x, P)
        after = np.array([fx(s, k, dt) for s in before])
        xp, Pp = moments(after)
        cross = (before - x).T @ (weight_c[:, None] * (after - xp))
        Pp = Pp + np.diag(np.array(Q_STD) ** 2) * dt
        chi = points(xp, Pp)
        zeta = np.array(
            [[forces(*s[:3], signals.steer_rad[k], signals.friction[k])[0] + rate[k - 1, 0], s[2], s[0]] for s in chi]
        )
        z = np.array([signals.ay_m_s2[k], signals.yaw_rate_rad_s[k], signals.speed_m_s[k]])
        use = np.isfinite(z)
        x, P = xp, Pp
        if use.any():
            zeta = zeta[:, use]
            z_hat, S = moments(zeta)
            S = S + np.diag(np.array(R_STD)[use] ** 2)
            K = (chi - xp).T @ (weight_c[:, None] * (zeta - z_hat)) @ np.linalg.inv(S)
            x, P = xp + K @ (z[use] - z_hat), Pp - K @ S @ K.T
        for row, value in zip((xs, Ps, priors, predicted, crosses), (x, P, xp, Pp, cross), strict=True):
            row.append(value)
    for k in range(len(signals) - 2, -1, -1):
        G = crosses[k + 1] @ np.linalg.inv(predicted[k + 1])
        xs[k] = xs[k] + G @ (xs[k + 1] - priors[k + 1])
        Ps[k] = Ps[k] + G @ (Ps[k + 1] - predicted[k + 1]) @ G.T
    return np.array(xs), np.array(Ps)


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
    steps, _, links = PhysicsUkf(VEHICLE, q_std=Q_STD, r_std=R_STD).linked_steps(s, None, rate)
    x, P = smooth_steps(steps, links, len(s), int(s.stamps_ns[0]), ALL * NS)
    want_x, want_P = unscented_smoother(s, rate)
    assert np.nanmax(steps.nis) < 36.0, "the drive must stay inside the gate"
    np.testing.assert_allclose(x, want_x, rtol=1e-8, atol=1e-9)
    scale = np.sqrt(np.einsum("ki,kj->kij", *[np.einsum("kii->ki", want_P)] * 2))
    assert np.abs((P - want_P) / scale).max() < 1e-8
    assert not np.allclose(steps.x, want_x, atol=1e-2), "smoothing must do something"


# --- the estimator ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rough() -> Signals:
    """Noise, irregular stamps, missing samples, a gap that restarts the filter, messages late, a gyro that jumps."""
    rng = np.random.default_rng(12)
    s = with_noise(drive(slalom(0.035, 0.5), speed=22.0, step_s=rng.uniform(0.004, 0.022, 700)).signals, seed=6)
    for column in (s.steer_rad, s.ax_m_s2, s.ay_m_s2, s.yaw_rate_rad_s):
        column[rng.random(len(s)) < 0.05] = np.nan
    t = (s.stamps_ns - s.stamps_ns[0]) * 1e-9
    s.yaw_rate_rad_s[(t > 5.0) & (t < 5.6)] += 0.5
    ready = np.maximum.accumulate(s.stamps_ns + rng.integers(0, 45_000_000, len(s)))
    return keep(replace(s, ready_ns=ready), (t < 3.0) | (t > 3.8))


@pytest.fixture(scope="module")
def faulty(rough) -> Signals:
    """The same with a stuck gyro, a burst on both sensors, spikes and missing samples."""
    rng = np.random.default_rng(3)
    t = (rough.stamps_ns - rough.stamps_ns[0]) * 1e-9
    ay, yaw_rate = rough.ay_m_s2.copy(), rough.yaw_rate_rad_s.copy()
    yaw_rate[(t > 1.2) & (t < 2.2)] = 0.06
    burst = (t > 6.2) & (t < 7.2)
    ay[burst] += 2.4 * rng.standard_normal(burst.sum())
    yaw_rate[burst] += 0.08 * rng.standard_normal(burst.sum())
    ay[np.searchsorted(t, (0.7, 2.5, 4.4, 4.6, 4.8))] += 8.0
    ay[(t > 5.0) & (t < 5.2)] = np.nan
    yaw_rate[(t > 5.4) & (t < 5.6)] = np.nan
    return replace(rough, ay_m_s2=ay, yaw_rate_rad_s=yaw_rate)


@pytest.fixture(scope="module")
def stopping() -> Signals:
    """Rolls, stands for three seconds, rolls on."""
    made = rolling_drive(lambda t: 4.0 * np.clip(np.abs(t - 5.5) - 1.5, 0.0, 1.0), lambda t: 0.05 * np.sin(t), 11.0)
    return with_noise(made.signals, seed=2, scale=0.1)


def test_it_sees_one_to_two_blocks_ahead_and_no_further(rough):
    estimator = smoother(0.5)
    j = 150
    ay = rough.ay_m_s2.copy()
    ay[j] = 1.0
    a, _ = run_window(estimator, rough)
    b, _ = run_window(estimator, replace(rough, ay_m_s2=ay), None)
    differs = np.flatnonzero(a.vy_m_s != b.vy_m_s)
    ahead = (rough.stamps_ns[j] - rough.stamps_ns[differs.min()]) * 1e-9
    assert 0.5 <= ahead < 1.0


def test_blocks_of_a_minute_are_as_good_as_the_whole_drive():
    s = with_noise(drive(slalom(0.02, 0.3), 90.0, step_s=0.02).signals, seed=1)
    blocks, whole = smoother(4.0, parts=()), smoother(parts=())
    a, b = run_window(blocks, s)[0], run_window(whole, s)[0]
    assert not np.array_equal(a.vy_m_s, b.vy_m_s)
    np.testing.assert_allclose(a.vy_m_s, b.vy_m_s, atol=1e-5)


def test_left_and_right_are_mirrored(rough):
    estimator = smoother(trust=0.0)  # a network with random weights knows no left and right
    mirrored = replace(rough, **{c: sign * getattr(rough, c) for c, sign in properties.SIGNS.items()})
    a, b = run_window(estimator, rough)[0], run_window(estimator, mirrored)[0]
    for c in properties.MIRRORED:
        np.testing.assert_allclose(getattr(a, c), -getattr(b, c), atol=1e-9, err_msg=c)


@pytest.mark.parametrize("parts", [(), ("lag", "roll", "biases"), tuple(PhysicsParts.model_fields)])
@pytest.mark.parametrize("which", ["rough", "stopping"])
def test_the_covariance_is_never_larger_than_the_filters(which, parts, request):
    s = request.getfixturevalue(which)
    estimator = smoother(parts=parts)
    steps, _, links = estimator.filtered.physics.linked_steps(s, None)
    x, P = smooth_steps(steps, links, len(s), 0, ALL * NS * 100)
    done = steps.valid
    scale = np.sqrt(np.einsum("kii->ki", steps.P))[done]
    unit = scale[:, :, None] * scale[:, None, :]
    assert np.linalg.eigvalsh((steps.P[done] - P[done]) / unit).min() > -1e-9
    assert np.linalg.eigvalsh(P[done] / unit).min() > 0.0
    assert np.median(P[done][:, 1, 1] / steps.P[done][:, 1, 1]) < 0.95
    assert np.isfinite(x[done]).all()
    opened = (links.predicted_P[:, 2, 2] > 5 * np.roll(steps.P[:, 2, 2], 1)) & (links.kind == LINK_WHOLE)
    assert opened[done].any() == (which == "rough"), "the gate opens on the jump"
    assert (links.kind[1:] == LINK_NONE).sum() > 100 or which != "stopping", "a standstill ties nothing"


def test_a_standstill_stands_and_does_not_pull_what_was_before(stopping):
    track, _ = run_window(smoother(), stopping)
    t = (stopping.stamps_ns - stopping.stamps_ns[0]) * 1e-9
    stands = (t > 4.6) & (t < 6.9)
    assert np.abs(track.vx_m_s[stands]).max() < 0.02
    rolls = (t < 3.9) | (t > 7.5)
    v = 4.0 * np.clip(np.abs(t - 5.5) - 1.5, 0.0, 1.0)
    assert np.abs(track.vx_m_s - v)[rolls].max() < 0.15


def test_nothing_behind_a_gap_tells_of_before(rough):
    gap = int(np.argmax(np.diff(rough.stamps_ns))) + 1
    whole, _ = run_window(smoother(), rough)
    before, _ = run_window(smoother(), cut(rough, 0, gap), None)
    properties.same_bits(whole, before, gap)
    stretch = replace(cut(rough, 0, gap), ready_ns=rough.stamps_ns[:gap])
    filtered, _ = run_window(smoother().filtered, stretch)
    assert before.vy_m_s[-1] == filtered.vy_m_s[-1], "at the end of a stretch it is the filter"


@pytest.mark.parametrize("parts", [(), ("biases",)])
def test_it_is_nearer_to_the_truth_than_its_filter(parts):
    errors = []
    for seed in range(6):
        made = drive(slalom(0.03, 0.4 + 0.1 * seed), 10.0, 20.0 + seed, step_s=0.01)
        signals = with_noise(made.signals, seed=seed)
        estimator = flat_smoother(parts)
        filtered, _ = run_window(estimator.filtered, replace(signals, ready_ns=signals.stamps_ns), None)
        track, _ = run_window(estimator, signals)
        both = filtered.valid & track.valid
        errors.append([np.mean((e.sideslip_rad - made.sideslip)[both] ** 2) for e in (track, filtered)])
        inside = np.abs(track.vy_m_s - made.vy) < 1.96 * track.vy_std_m_s
        assert inside.mean() > 0.8
    smoothed_rmse, filtered_rmse = np.sqrt(np.array(errors)).T
    assert (smoothed_rmse < filtered_rmse).sum() >= 5
    assert np.sqrt(np.mean(smoothed_rmse**2)) < 0.93 * np.sqrt(np.mean(filtered_rmse**2))


@pytest.fixture(scope="module")
def slalom_drive():
    return drive(slalom(0.035, 0.5), 12.0, speed=22.0)


def flat_smoother(parts: tuple[str, ...] = (), **filter_options) -> SmoothedPhysics:
    """For the reference car, which does not roll, without network."""
    update = {"roll_gradient_rad_per_m_s2": 0.0, "physics": PhysicsParts(**dict.fromkeys(parts, True))}
    return SmoothedPhysics(AdaptivePhysics(PhysicsFilter(VEHICLE.model_copy(update=update), **filter_options)))


class Unchecked(AdaptivePhysics):
    """Without the detector: signals as they are, no extra noise."""

    def inputs(self, signals, carry):
        return AdaptivePhysics.inputs(replace(self, adaptive=False), signals, carry)


def unchecked(estimator: SmoothedPhysics, signals: Signals) -> StateTrack:
    """The estimate without the detector."""
    filtered = Unchecked(**{f.name: getattr(estimator.filtered, f.name) for f in fields(AdaptivePhysics)})
    return run_window(replace(estimator, filtered=filtered), signals)[0]


def test_without_a_fault_it_is_what_it_is_without_the_detector(slalom_drive):
    estimator = smoother()  # with network
    track, _ = run_window(estimator, slalom_drive.signals)
    assert not track.reason.any()
    assert (track.r_scale == 1.0).all()
    properties.same_bits(track, unchecked(estimator, slalom_drive.signals))
    for seed in range(4):  # false alarms hardly change the estimate
        signals = with_noise(slalom_drive.signals, seed)
        a, _ = run_window(estimator, signals)
        away = np.abs(a.sideslip_rad - unchecked(estimator, signals).sideslip_rad)
        assert np.sqrt(np.mean(away**2)) < np.radians(0.01)


@pytest.mark.parametrize("kind", ["stuck", "dead", "burst"])
def test_a_faulty_gyro_costs_little_and_is_told(slalom_drive, kind):
    t = slalom_drive.time_s
    during = (t > 4.0) & (t < 7.0)
    clean = with_noise(slalom_drive.signals, seed=1)
    rng = np.random.default_rng(2)
    held = clean.yaw_rate_rad_s[np.searchsorted(t, 4.0)]
    bad, bit = {
        "stuck": (np.full(len(t), held), STUCK_YAW_RATE),
        "dead": (0.002 * rng.standard_normal(len(t)), DEAD_YAW_RATE),
        "burst": (clean.yaw_rate_rad_s + 0.08 * rng.standard_normal(len(t)), BURST_YAW_RATE),
    }[kind]
    signals = replace(clean, yaw_rate_rad_s=np.where(during, bad, clean.yaw_rate_rad_s))
    estimator = flat_smoother()
    track, before = run_window(estimator, signals)[0], unchecked(estimator, signals)
    told = track.reason & bit > 0
    assert told[during & (t > 5.5)].mean() > 0.9
    assert not told[(t < 3.9) | (t > 8.0)].any()
    assert (np.median(track.r_scale[told]) > 20.0) == (kind == "burst")
    rmse, without = (np.sqrt(np.mean((x.sideslip_rad - slalom_drive.sideslip) ** 2)) for x in (track, before))
    assert rmse < (1.0 if kind == "burst" else 0.6) * without


def test_it_starts_from_what_the_adaptive_filter_starts_from(faulty):
    """The smoother uses the reasons of pd-hef without delay. Factors on R multiply the R of this filter."""
    estimator = smoother(r_std=(0.5, 0.006, 0.08))
    track, _ = run_window(estimator, faulty)
    adaptive, _ = run_window(estimator.filtered, replace(faulty, ready_ns=faulty.stamps_ns), None)
    np.testing.assert_array_equal(track.reason, adaptive.reason)
    np.testing.assert_array_equal(track.r_scale, adaptive.r_scale)
    assert track.r_scale.max() > 5.0


def test_its_weights_know_what_comes_later():
    """The true grip is 25 % lower than the input. The filter adapts over time, the smoother from the start."""
    made = drive(slalom(0.035, 0.5), 12.0, speed=22.0, mu=0.75 * 0.85)
    signals = with_noise(made.signals, 0)
    signals.friction[:] = 0.85
    estimator = flat_smoother(("force_scale",))
    weights = [run_window(e, signals)[0].mixture_weight for e in (estimator, estimator.filtered)]
    assert weights[1][:10].max() < 0.6
    assert weights[0].min() > 0.99


def test_links_cost_the_filter_no_bit(rough):
    plain, after = PhysicsUkf(VEHICLE).run(rough, None)
    steps, again, links = PhysicsUkf(VEHICLE).linked_steps(rough, None)
    for name in (f.name for f in fields(PosteriorSteps)):
        np.testing.assert_array_equal(getattr(plain, name), getattr(steps, name))
    np.testing.assert_array_equal(after.estimate.P, again.estimate.P)
    starts = ~np.isfinite(steps.prior[:, 0])
    np.testing.assert_array_equal(links.kind == LINK_NONE, starts)
    assert starts.sum() == 2


def test_what_it_says_of_itself(rough):
    trusted = Car.of(VEHICLE, network=BUNDLE, trust=Trust(trust_cap=0.6, evidence="a drive of 300 s"))
    estimator = make_estimator("pd-hef-smoothed", trusted)
    assert estimator.filtered.trust == 0.6
    assert "a drive of 300 s" in estimator.notes[1]
    assert isinstance(estimator, LookingAhead)
    assert (estimator.name, estimator.causal) == ("pd-hef-smoothed", False)
    assert [s.name for s in SPECS if not s.causal] == ["open-loop:calibrated", "pd-hef-smoothed"]
    for spec in SPECS:
        if spec.network in ("residual", "optional"):
            assert make_estimator(spec.name, trusted).causal == spec.causal
    assert "not causal" in estimator.notes[0]
    assert look_ahead_of(estimator) == 240.0
    assert look_ahead_of(make_estimator("phy-ukf", trusted)) == 0.0
    track, _ = run_window(estimator, rough, None)
    assert track.valid[0], "it needs no arrival"
    assert np.isnan(track.nis).all()
    assert not track.nis_dof.any()
    assert set(track.network_trust[track.valid]) == {estimator.filtered.trust}
    assert np.array_equal(track.stamps_ns, rough.stamps_ns)


# --- in a run --------------------------------------------------------------------------------------------------------


def test_a_run_marks_it_as_not_causal(sample_logs_dir: Path, tmp_path: Path):
    BUNDLE.save(tmp_path / "model")
    config = RunConfig(
        car=sample_logs_dir / "vehicle.toml",
        network=tmp_path / "model",
        annotate="none",
        estimators=("pd-hef-smoothed", "zero"),
    )
    out = tmp_path / "out"
    result = run_logs([str(sample_logs_dir / "road.mcap")], out, config)
    report = json.loads((out / "logs/road/report.json").read_text())
    assert {e["name"]: e["causal"] for e in report["estimators"]} == {
        "pd-hef-smoothed": False, "zero": True, "pd-hef": True,
    }  # fmt: skip
    console = Console(file=io.StringIO(), width=200)
    render_run(result, console)
    printed = console.file.getvalue()
    assert printed.rindex("\n zero") < printed.rindex("\n pd-hef-smoothed")
    assert "not causal" in printed


def test_a_covariance_without_an_inverse_is_repaired() -> None:
    A, L, gain = np.empty((2, 2)), np.empty((2, 2)), np.empty((2, 2))
    smoothed._gain(np.eye(2), np.array([[1.0, 1.0 + 1e-9], [1.0 + 1e-9, 1.0]]), 0, A, L, gain)
    assert np.isfinite(gain).all()
    assert gain.any()
