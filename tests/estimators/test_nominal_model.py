"""The compiled single-track model against plain Python, linear theory and convergence order."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from reference_car import FRONT_M, FRONT_TYRE, MASS_KG, REAR_M, REAR_TYRE, WHEELBASE_M, derivative, forces, on_axles

from pdhef_logtool.car import nominal_model
from pdhef_logtool.car.nominal_model import model_parameters
from pdhef_logtool.car.vehicle import Tyres, default_vehicle
from pdhef_logtool.compiled.cache import njit

SEDAN = default_vehicle()
P = model_parameters(SEDAN)
BLEND_HIGH = 3.0
STIFFNESS = (105_000.0, 96_000.0)
STIFFNESS_CAR = on_axles(SEDAN, *STIFFNESS)

speeds = st.floats(BLEND_HIGH, 70.0)
lateral = st.floats(-10.0, 10.0)
yaw_rates = st.floats(-3.0, 3.0)
steering = st.floats(-0.6, 0.6)
friction = st.floats(0.05, 1.5)
exact = settings(derandomize=True, deadline=None, max_examples=150)


@exact
@given(speeds, lateral, yaw_rates, steering, st.floats(-10, 10), friction)
def test_derivative_is_the_published_model(vx, vy, r, steer, ax, mu):
    got = nominal_model.state_derivative(vx, vy, r, steer, ax, mu, P)
    want = derivative(np.array([vx, vy, r]), steer, ax, mu)
    np.testing.assert_allclose(got, want, rtol=1e-11, atol=1e-11)
    ay, _ = forces(vx, vy, r, steer, mu)
    assert nominal_model.planar_lateral_acceleration(vx, vy, r, steer, mu, P) == pytest.approx(ay, rel=1e-11, abs=1e-11)


@exact
@given(st.floats(0.0, 60.0), st.floats(1e-4, 0.3), st.floats(0.1, 1.5), st.floats(-0.3, 0.3))
def test_steps_are_divided_until_they_are_stable(vx, dt, mu, steer):
    """From a wild state the lateral motion stays bounded, as RK4 does only inside its region of stability."""
    n = nominal_model.substeps(vx, dt, mu, P)
    assert 1 <= n <= nominal_model.MAX_SUBSTEPS
    state = (vx, 0.5, -0.5)
    for _ in range(20):
        state = nominal_model.rk4_steps(vx, *state[1:], steer, 0.0, mu, dt, n, P)
    assert abs(state[1]) < 50 and abs(state[2]) < 10


@pytest.mark.parametrize("mu", [0.2, 0.85, 1.1])
@pytest.mark.parametrize("front", [True, False])
def test_a_reference_friction_keeps_the_stiffness_and_scales_the_peak(front, mu):
    tyres = Tyres(**{name: tyre.model_copy(update={"reference_friction": 0.85}) for name, tyre in SEDAN.tyres})
    car = SEDAN.model_copy(update={"tyres": tyres})
    assert car.cornering_stiffness_n_per_rad(front, mu) == pytest.approx(
        SEDAN.cornering_stiffness_n_per_rad(front, 0.85)
    )
    b, c, d, _ = FRONT_TYRE if front else REAR_TYRE
    assert SEDAN.cornering_stiffness_n_per_rad(front, mu) == pytest.approx(mu * b * c * d)
    assert car.magic_formula(front, mu)[2] == pytest.approx(mu / 0.85 * SEDAN.magic_formula(front, 0.85)[2])


@njit
def tyre_forces(v, vy, angle, mu, p):
    return nominal_model.magic_formula(v, vy, 0.0, angle, nominal_model.prepare(0.0, mu, p), p)


@exact
@given(st.floats(0.05, 2.0), st.booleans())
def test_tyre_known_by_its_stiffness(mu, front):
    """The slope is the given one at any friction, the force never exceeds friction times the load and gets near it."""
    p = model_parameters(STIFFNESS_CAR)

    def force(slip):
        """The front axle slips by steering, the rear axle by a lateral velocity."""
        angle, vy = (slip, 0.0) if front else (0.0, -np.tan(slip))
        return MASS_KG * tyre_forces(1.0, vy, angle, mu, p)[0 if front else 1]

    stiffness = STIFFNESS[0] if front else STIFFNESS[1]
    load = MASS_KG * 9.80665 * (REAR_M if front else FRONT_M) / WHEELBASE_M
    h = 1e-7
    slope = force(h) / h
    assert slope == pytest.approx(stiffness, rel=1e-6)
    sweep = [force(a) for a in np.linspace(0, 1.5, 400)]
    assert max(sweep) <= mu * load * (1 + 1e-12)
    assert max(sweep) > 0.99 * mu * load or mu > 1.5  # the stiffest road needs more slip than the sweep has
    assert STIFFNESS_CAR.cornering_stiffness_n_per_rad(front, mu) == pytest.approx(stiffness, rel=1e-12)
    gradient = MASS_KG / WHEELBASE_M * (REAR_M / STIFFNESS[0] - FRONT_M / STIFFNESS[1])
    assert STIFFNESS_CAR.understeer_gradient_rad_per_m_s2(mu) == pytest.approx(gradient, rel=1e-12)
