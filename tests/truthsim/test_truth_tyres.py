"""Tyres of the truth vehicle: pinned stiffness, saturation, combined slip, load sensitivity, build-up over distance."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from truthsim.tyres import Tyre, cornering_stiffness_n_per_rad, forces_n

TYRE = Tyre()

slips = st.floats(-0.5, 0.5)
loads = st.floats(500.0, 8000.0)
roads = st.floats(0.1, 1.2)


def test_cornering_stiffness_is_that_of_a_mid_size_tyre() -> None:
    # 205/55 R16 at 3.5 kN: 15 to 17 times the load per radian; pinned, so that a wrong gain is seen.
    assert cornering_stiffness_n_per_rad(TYRE, 3530.0, 0.85) == pytest.approx(55_650.0, rel=2e-3)
    assert 14.0 < cornering_stiffness_n_per_rad(TYRE, 3530.0, 0.85) / 3530.0 < 17.0


def test_peak_force_is_friction_times_load_and_lies_at_a_usual_slip_angle() -> None:
    alpha = np.linspace(0.0, 0.4, 4001)
    force = np.array([forces_n(TYRE, 0.0, math.tan(a), 3530.0, 0.85)[1] for a in alpha])
    assert force.max() == pytest.approx(0.85 * 3530.0, rel=1e-4)
    assert 6.0 < np.degrees(alpha[force.argmax()]) < 11.0
    assert 0.8 < force[-1] / force.max() < 1.0


@given(loads, slips, slips, roads)
@settings(derandomize=True, max_examples=200)
def test_resultant_never_exceeds_friction_and_mirrors(load: float, kappa: float, alpha: float, mu: float) -> None:
    fx, fy, _ = forces_n(TYRE, kappa, alpha, load, mu)
    assert math.hypot(fx, fy) <= 1.15 * mu * load
    assert forces_n(TYRE, kappa, -alpha, load, mu)[:2] == pytest.approx((fx, -fy), abs=1e-9)
    assert forces_n(TYRE, -kappa, alpha, load, mu)[:2] == pytest.approx((-fx, fy), abs=1e-9)
    assert fx * kappa >= 0.0 and fy * alpha >= 0.0
