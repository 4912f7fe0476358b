"""The nominal model at many points at once against the same model at one, which is its definition."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numba import njit

from pdhef_logtool.car import nominal_model
from pdhef_logtool.car.nominal_model import model_parameters
from pdhef_logtool.car.nominal_points import (
    AT_AX,
    AT_AY,
    AT_STEER,
    AT_VX,
    AT_VY,
    AT_YAW_RATE,
    WIDTH,
    advance_points,
    arctangent,
    measure_points,
    place,
    place_count,
    sine,
    work_size,
)
from pdhef_logtool.car.vehicle import AxleTyre, Tyres, VehicleParameters, default_vehicle
from pdhef_logtool.estimators import filter_base as base
from pdhef_logtool.estimators import phy_ukf

pytestmark = pytest.mark.slow

FORMULA_CAR = default_vehicle().model_copy(
    update={"imu_position_m": (0.4, -0.3), "roll_gradient_rad_per_m_s2": 0.009, "low_speed_blend_m_s": 4.0}
)
CARS = {
    "magic formula": FORMULA_CAR,
    "cornering stiffness": FORMULA_CAR.model_copy(
        update={
            "tyres": Tyres(
                front=AxleTyre(cornering_stiffness_n_per_rad=105_000.0),
                rear=AxleTyre(cornering_stiffness_n_per_rad=96_000.0),
            )
        }
    ),
    "formula of one friction": FORMULA_CAR.model_copy(
        update={
            "tyres": Tyres(
                front=AxleTyre(B=11.1, C=1.05, D_n=7991.0, E=-0.51, reference_friction=0.85),
                rear=AxleTyre(B=10.6, C=1.65, D_n=5708.0, E=0.34, reference_friction=1.0),
            )
        }
    ),
}
TOLERANCE = 1e-11

cars = pytest.mark.parametrize("car", CARS.values(), ids=CARS)
random_states = settings(derandomize=True, deadline=None, max_examples=60)
seeds = st.integers(0, 2**32 - 1)
frictions = st.floats(0.05, 1.5)
steps_s = st.floats(1e-4, 0.2)


@njit
def _arctangent(y: float, x: float) -> float:
    return arctangent(y, x)  # type: ignore[no-any-return]


@njit
def _sine(x: float) -> float:
    return sine(x)  # type: ignore[no-any-return]


@random_states
@given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e3))
@example(math.tan(math.pi / 8.0), 1.0)
@example(-math.tan(3.0 * math.pi / 8.0), 1.0)
@example(0.0, 1.0)
@example(math.inf, 1.0)
@example(-1e-300, 1.0)
def test_arctangent(y, x):
    assert _arctangent(y, x) == pytest.approx(math.atan2(y, x), rel=2e-15, abs=0.0)


@random_states
@given(st.floats(-100.0, 100.0))
@example(math.pi)
@example(-0.5 * math.pi)
@example(1.5 * math.pi)
@example(1e4)
def test_sine(x):
    assert _sine(x) == pytest.approx(math.sin(x), rel=0.0, abs=4e-16)
    assert _sine(-x) == -_sine(x)


def test_not_a_number_stays_one():
    assert math.isnan(_arctangent(math.nan, 1.0)) and math.isnan(_sine(math.nan)) and math.isnan(_sine(math.inf))


def drawn(seed: int, count: int, size: int) -> np.ndarray:
    """States [count, size] of any speed up to 60 m/s, also around the blend to the kinematic model."""
    rng = np.random.default_rng(seed)
    fast = rng.random() < 0.5
    vx = rng.uniform(0.0, 60.0, count) if fast else rng.uniform(0.0, 6.0, count)
    spread = (2.0, 0.7, 0.5, 0.3, 0.01, 0.05, 0.3)
    return np.column_stack([vx, *(rng.normal(0.0, spread[i], count) for i in range(size - 1))])


@cars
@random_states
@given(seeds, st.integers(1, 2 * WIDTH + 3), frictions, steps_s, st.integers(1, 5))
def test_points_move_as_one_state_does(car, seed, count, mu, dt, n):
    p = model_parameters(car, roll_correction=True)
    rng = np.random.default_rng(seed)
    state = drawn(seed, count, 3)
    steer, ax = rng.uniform(-0.6, 0.6, count), rng.normal(0.0, 4.0, count)
    points = np.ones(work_size(count))
    at = np.array([place.py_func(i) for i in range(count)])
    for row, values in ((AT_VX, state[:, 0]), (AT_VY, state[:, 1]), (AT_YAW_RATE, state[:, 2])):
        points[at + row] = values
    for row, values in ((AT_STEER, steer), (AT_AX, ax)):
        points[at + row] = values
    assert place_count(points) >= count and place_count(points) % WIDTH == 0
    measure_points(points, mu, p)
    read = [nominal_model.measured_lateral_acceleration(*state[i], steer[i], mu, p) for i in range(count)]
    np.testing.assert_allclose(points[at + AT_AY], read, rtol=TOLERANCE, atol=TOLERANCE)
    stable = nominal_model.substeps(float(state[:, 0].min()), dt, mu, p)
    advance_points(points, mu, dt, max(n, stable), p)
    got = np.column_stack([points[at + AT_VX], points[at + AT_VY], points[at + AT_YAW_RATE]])
    want = [nominal_model.rk4_step(*state[i], steer[i], ax[i], mu, dt, max(n, stable), p) for i in range(count)]
    np.testing.assert_allclose(got, want, rtol=TOLERANCE, atol=TOLERANCE)


@cars
@random_states
@given(
    seeds, frictions, steps_s, st.floats(-0.6, 0.6), st.floats(-5.0, 5.0), st.floats(-3.0, 3.0), st.floats(-2.0, 2.0)
)
def test_sigma_points_move_and_measure_as_one_state_does(car, seed, mu, dt, steer, ax, rate_vy, rate_r):
    p = model_parameters(car, roll_correction=True)
    chi = drawn(seed, 2 * base.STATES + 1, base.STATES)
    share = nominal_model.dynamic_share(chi[0, 0], p)
    if nominal_model.substeps(chi[:, 0].min(), dt, mu, p) > nominal_model.substeps(chi[0, 0], dt, mu, p):
        dt = 1e-3  # the first point says how many substeps there are: slow ones beside it would grow without bound
    n = nominal_model.substeps(chi[0, 0], dt, mu, p)
    points = np.full(work_size(len(chi)), np.nan)

    zeta = np.empty((len(chi), base.MEASUREMENTS))
    phy_ukf.measure_sigma_points(chi, steer, mu, rate_vy, p, points, zeta)
    want_zeta, want = np.empty_like(zeta), chi.copy()
    for i, state in enumerate(chi):
        ay = nominal_model.measured_lateral_acceleration(*state[:3], steer, mu, p)
        ay += (1.0 + p.ay_roll_gain) * share * rate_vy
        want_zeta[i] = ay, state[2], state[0]
        half = 0.5 * share * dt * np.array([rate_vy, rate_r])
        moved = nominal_model.rk4_step(state[0], *(state[1:3] + half), steer, ax - state[3], mu, dt, n, p)
        want[i, :3] = moved[0], *(moved[1:] + half)
    np.testing.assert_allclose(zeta, want_zeta, rtol=TOLERANCE, atol=TOLERANCE)

    over = base.HeldInputs(steer, ax, ax_known=True, friction=mu)
    phy_ukf._propagate(chi, over, (rate_vy, rate_r), dt, p, points)
    np.testing.assert_allclose(chi, want, rtol=TOLERANCE, atol=TOLERANCE)


@pytest.mark.parametrize("steer", [-0.5 * math.pi, 0.5 * math.pi])
def test_a_wheel_across_the_car_is_a_number(steer):
    car: VehicleParameters = FORMULA_CAR
    p = model_parameters(car)
    points = np.ones(work_size(1))
    points[AT_VX], points[AT_STEER] = 20.0, steer
    advance_points(points, 1.0, 0.01, 1, p)
    want = nominal_model.rk4_step(20.0, 1.0, 1.0, steer, 1.0, 1.0, 0.01, 1, p)
    np.testing.assert_allclose(points[[AT_VX, AT_VY, AT_YAW_RATE]], want, rtol=TOLERANCE)
