"""Axle slip angles and forces from ground truth, and the curve through them, on numbers worked out by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from reference_car import drive, slalom

from pdhef_logtool.car.vehicle import AxleTyre, Tyres, default_vehicle
from pdhef_logtool.records.tracks import make_track
from studies.defaults.axle_forces import AxleCurve, FitDrive, axle_samples, fit_axle

CAR = default_vehicle().model_copy(
    update={
        "tyres": Tyres(
            front=AxleTyre(cornering_stiffness_n_per_rad=110_000.0),
            rear=AxleTyre(cornering_stiffness_n_per_rad=95_000.0),
        )
    }
)


def fit_drive(seconds: float = 6.0, period_s: float = 0.01, **changes: Any) -> FitDrive:
    made = drive(slalom(), seconds, step_s=period_s)
    stamps = made.signals.stamps_ns
    truth = make_track(
        "truth", stamps, vx_m_s=made.vx, vy_m_s=made.vy, yaw_rate_rad_s=made.r, ay_m_s2=made.ay, valid=made.vx > 0
    )
    return replace(FitDrive("made", made.signals, truth), **changes)


# ---- axle forces ----


def test_axle_forces_follow_from_newton_and_euler() -> None:
    """A steady turn-in: v_x and v_y constant, r growing by 0.1 rad/s², a_y constant."""
    n = 400
    stamps = 10**18 + np.arange(n, dtype=np.int64) * 10_000_000
    full = np.full(n, 1.0)
    r = 0.1 * np.arange(n) * 0.01
    truth = make_track("t", stamps, vx_m_s=20 * full, vy_m_s=-0.4 * full, yaw_rate_rad_s=r, ay_m_s2=3.0 * full)
    signals = replace(fit_drive(3.99).signals, stamps_ns=stamps, steer_rad=0.2 * full)
    samples = axle_samples([FitDrive("t", signals, truth)] * 2, CAR)
    assert samples.front_force_n.size == 2 * n
    at = slice(100, 300)  # away from the ends of the smoothing
    lf, lr, m, iz = 1.16, 1.71, 1440.0, 1523.0
    # Newton: F_f cos δ + F_r = m a_y. Euler: l_f F_f cos δ − l_r F_r = I_z ṙ.
    forward, rear = samples.front_force_n[at] * math.cos(0.2), samples.rear_force_n[at]
    np.testing.assert_allclose(forward + rear, m * 3.0, rtol=1e-9)
    np.testing.assert_allclose(lf * forward - lr * rear, iz * 0.1, rtol=1e-4)
    np.testing.assert_allclose(samples.front_slip_rad[at], 0.2 - np.arctan((-0.4 + lf * r[at]) / 20), atol=1e-9)
    np.testing.assert_allclose(samples.rear_slip_rad[at], -np.arctan((-0.4 - lr * r[at]) / 20), atol=1e-9)
    two = replace(signals, **{k: getattr(signals, k)[:2] for k in ("stamps_ns", "steer_rad", "friction")})
    short = make_track("t", stamps[:2], **{k: getattr(truth, k)[:2] for k in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s")})
    assert axle_samples([FitDrive("t", two, short)], CAR).front_force_n.size == 0


def test_the_curve_is_the_magic_formula() -> None:
    curve = AxleCurve(100_000.0, 8000.0, 1.3)
    assert curve.force_n(np.array([1e-6]))[0] == pytest.approx(0.1)
    assert curve.force_n(np.array([0.05]))[0] == pytest.approx(8000 * math.sin(1.3 * math.atan(0.05 * 1e5 / 10_400)))


@pytest.mark.parametrize("count", [300, 9000])
def test_the_fit_minimises_the_cost_of_method_14(count: int) -> None:
    """Its cost is written out here once more: no curve beside the one that is returned has a lower one."""
    slip = np.linspace(-0.06, 0.08, count)
    prior = AxleCurve(70_000.0, 6500.0, 1.35)
    force = AxleCurve(100_000.0, 5200.0, 1.25).force_n(slip) + 400.0 * np.sin(300 * slip)
    found = fit_axle(slip, force, prior=prior, mass_kg=1500.0, independent=40.0)
    used = slice(None, None, max(1, count // 4000))
    least = 1.1 * float(np.percentile(np.abs(force[used]), 99.5))
    centre = np.array([math.log(70_000.0), math.log(max(6500.0, least)), 1.35])

    def cost(theta: np.ndarray) -> float:
        error = AxleCurve(math.exp(theta[0]), math.exp(theta[1]), theta[2]).force_n(slip[used]) - force[used]
        return 40.0 * np.mean((error / (0.35 * 1500.0)) ** 2) + np.sum(((theta - centre) / [0.25, 0.10, 0.10]) ** 2)

    at = np.array([math.log(found.stiffness_n_per_rad), math.log(found.peak_n), found.shape])
    assert at[1] > math.log(least) and 1.0 < at[2] < 1.9
    for i, sign in ((i, s) for i in range(3) for s in (-1, 1)):
        aside = at.copy()
        aside[i] += sign * 2e-3
        assert cost(aside) > cost(at)
