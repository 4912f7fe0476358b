"""Axle slip angles and forces from ground truth, and the curve through them, on numbers worked out by hand."""

import math
from functools import cache

import numpy as np
import pytest
from reference_car import FRONT_TYRE, REAR_TYRE, Drive, drive, keep, on_axles, signals_at, with_noise

from pdhef_logtool.car.vehicle import VehicleParameters, default_vehicle
from pdhef_logtool.records.tracks import make_track
from studies.defaults import fit_physics as study

CAR = on_axles(default_vehicle(), 110_000.0, 95_000.0)


# ---- axle forces ----


def test_axle_forces_follow_from_newton_and_euler():
    """A steady turn-in: v_x and v_y constant, r growing by 0.1 rad/s², a_y constant."""
    n = 400
    stamps = 10**18 + np.arange(n, dtype=np.int64) * 10_000_000
    full = np.full(n, 1.0)
    r = 0.1 * np.arange(n) * 0.01
    truth = make_track("t", stamps, vx_m_s=20 * full, vy_m_s=-0.4 * full, yaw_rate_rad_s=r, ay_m_s2=3.0 * full)
    signals = signals_at(stamps, steer_rad=0.2)
    (front_slip, front_force), (rear_slip, rear_force) = study.axle_samples(
        [study.FitDrive("t", signals, truth)] * 2, CAR
    ).values()
    assert front_force.size == 2 * n
    at = slice(100, 300)  # away from the ends of the smoothing
    lf, lr, m, iz = 1.16, 1.71, 1440.0, 1523.0
    # Newton: F_f cos δ + F_r = m a_y. Euler: l_f F_f cos δ − l_r F_r = I_z ṙ.
    forward, rear = front_force[at] * math.cos(0.2), rear_force[at]
    np.testing.assert_allclose(forward + rear, m * 3.0, rtol=1e-9)
    np.testing.assert_allclose(lf * forward - lr * rear, iz * 0.1, rtol=1e-4)
    np.testing.assert_allclose(front_slip[at], 0.2 - np.arctan((-0.4 + lf * r[at]) / 20), atol=1e-9)
    np.testing.assert_allclose(rear_slip[at], -np.arctan((-0.4 - lr * r[at]) / 20), atol=1e-9)


def test_the_curve_is_the_magic_formula():
    curve = study.AxleCurve(100_000.0, 8000.0, 1.3)
    assert curve.force_n(np.array([1e-6]))[0] == pytest.approx(0.1)
    assert curve.force_n(np.array([0.05]))[0] == pytest.approx(8000 * math.sin(1.3 * math.atan(0.05 * 1e5 / 10_400)))


@pytest.mark.parametrize("count", [300, 9000])
def test_the_fit_minimises_the_cost_of_method_14(count):
    """Its cost is written out here once more: no curve beside the one that is returned has a lower one."""
    slip = np.linspace(-0.06, 0.08, count)
    prior = study.AxleCurve(70_000.0, 6500.0, 1.35)
    force = study.AxleCurve(100_000.0, 5200.0, 1.25).force_n(slip) + 400.0 * np.sin(300 * slip)
    found = study.fit_axle(slip, force, prior=prior, mass_kg=1500.0, independent=40.0)
    used = slice(None, None, max(1, count // 4000))
    least = 1.1 * float(np.percentile(np.abs(force[used]), 99.5))
    centre = np.array([math.log(70_000.0), math.log(max(6500.0, least)), 1.35])

    def cost(theta: np.ndarray) -> float:
        error = study.AxleCurve(math.exp(theta[0]), math.exp(theta[1]), theta[2]).force_n(slip[used]) - force[used]
        return 40.0 * np.mean((error / (0.35 * 1500.0)) ** 2) + np.sum(((theta - centre) / [0.25, 0.10, 0.10]) ** 2)

    at = np.array([math.log(found.stiffness_n_per_rad), math.log(found.peak_n), found.shape])
    assert at[1] > math.log(least) and 1.0 < at[2] < 1.9
    for i, sign in ((i, s) for i in range(3) for s in (-1, 1)):
        aside = at.copy()
        aside[i] += sign * 2e-3
        assert cost(aside) > cost(at)


#: Slope of the true tyres at no slip, N/rad at friction 0.85.
STIFFNESS = tuple(0.85 * b * c * d for b, c, d, _ in (FRONT_TYRE, REAR_TYRE))


def weaving(seed: int):
    rng = np.random.default_rng(seed)
    tones = [(rng.uniform(0.1, 1.0), rng.uniform(0.0, 6.3)) for _ in range(4)]
    return lambda t: 0.017 * sum(math.sin(2.0 * math.pi * f * t + p) for f, p in tones)


def noisy_fit_drive(made: Drive, seed: int) -> study.FitDrive:
    """Drive as identification sees it, at 50 Hz: sensors with noise, truth without."""
    half = np.arange(len(made.signals)) % 2 == 0
    signals = keep(with_noise(made.signals, seed), half)
    columns = {"vx_m_s": made.vx, "vy_m_s": made.vy, "yaw_rate_rad_s": made.r, "ay_m_s2": made.ay}
    truth = make_track("truth", signals.stamps_ns, valid=np.ones(half.sum(), dtype=bool),
                       **{name: column[half] for name, column in columns.items()})  # fmt: skip
    return study.FitDrive(f"made {seed}", signals, truth)


@cache
def static_drive(seed: int, seconds: float = 24.0) -> study.FitDrive:
    return noisy_fit_drive(drive(weaving(seed), seconds, speed=24.0, speed_every=1), seed)


def guess(front: float, rear: float) -> VehicleParameters:
    """The sedan without roll, its tyres known by a stiffness that is wrong by these factors."""
    sedan = on_axles(default_vehicle(), front * STIFFNESS[0], rear * STIFFNESS[1])
    return sedan.model_copy(update={"roll_gradient_rad_per_m_s2": 0.0})


@pytest.fixture(scope="module")
def static():
    return static_drive(1)


# ---- the fit ----


@pytest.mark.slow
def test_stiffness_is_found_within_the_posteriors_interval(static):
    start = guess(0.7, 1.4)
    found = study.fit_physics([static], start, starts=study.STARTS[:1], iterations=12)
    by_name = {p.name: (p.value(t), p.value(t - 2.5 * s), p.value(t + 2.5 * s), s)
               for p, t, s in zip(found.priors, found.theta, found.std, strict=True)}  # fmt: skip
    for axle, true, front in (("front", STIFFNESS[0], True), ("rear", STIFFNESS[1], False)):
        value, low, high, std = by_name[f"{axle} cornering stiffness"]
        assert low < true < high
        assert value == pytest.approx(true, rel=0.15)
        assert std < 0.7, "the drive must say more than the prior"
        assert found.vehicle.cornering_stiffness_n_per_rad(front, 0.85) == pytest.approx(value, rel=1e-4)
    (before,) = study.drive_errors([static], start, *study.build_car(start, found.priors, np.zeros(len(found.priors))))
    assert found.rms_deg < 0.6 * math.degrees(before.rms)
    (after,) = study.drive_errors([static], start, found.vehicle, found.noise)
    assert math.degrees(after.rms) == pytest.approx(found.rms_deg, rel=1e-3)
    (unseen,) = study.drive_errors([static_drive(2)], start, found.vehicle, found.noise)
    assert math.degrees(unseen.rms) < 0.1
    assert 0.3 < after.nis < 3.0
