"""The models of the vehicle filter against an ODE in plain Python, the nominal model and closed forms."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from physics_oracle import ALL_PARTS, Oracle, names_of, parts, vehicle
from reference_car import FRICTION, on_axles

from pdhef_logtool.car import nominal_model
from pdhef_logtool.car.nominal_model import model_parameters
from pdhef_logtool.car.vehicle import AxleTyre, Tyres, VehicleParameters, default_vehicle
from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.estimators import vehicle_model as model
from pdhef_logtool.estimators.vehicle_model import HeldInputs

pytestmark = pytest.mark.slow

#: Sets of parts under test: none, each alone, some that interact, all.
SETS = ((), *((name,) for name in ALL_PARTS), ("lag", "roll"), ("lag", "load_transfer", "biases"), ALL_PARTS)
every_set = pytest.mark.parametrize("names", SETS, ids="+".join)
IMU = (0.4, -0.2)
TOLERANCE = 1e-12
ENTRIES = {"vx": 25.0, "vy": 0.2, "r": 0.1, "b_ax": 0.1, "ff": 1.5, "fr": 1.0, "phi": 0.03, "phi_dot": -0.1}
ENTRIES |= {"bank": 0.03, "s": 0.06, "b_delta": 0.002, "b_ay": 0.1, "b_r": 0.003}


@njit
def accelerations(vx, vy, r, steer, mu, p):
    return nominal_model.accelerations(vx, vy, r, steer, nominal_model.prepare(steer, mu, p), p)


def state_of(oracle: Oracle, steer: float, ax: float, mu: float, **changes: float) -> np.ndarray:
    x = np.array([(ENTRIES | changes)[name] for name in names_of(oracle.has)])
    return x if oracle.has.lag else oracle.settled(x, steer, ax, mu)


def models(v: VehicleParameters) -> tuple[model.Layout, Any, Any]:
    return model.layout_of(v), model_parameters(v), model.physics_parameters(v)


def block_of(layout: model.Layout, states: np.ndarray) -> np.ndarray:
    """Return a block [PLACES, WIDTH] with states [k, n] in its first columns, and the first state in the rest."""
    block = np.zeros((model.PLACES, model.WIDTH))
    block[layout.places] = states[0][:, None]
    block[layout.places, : len(states)] = states.T
    return block


def moved(v: VehicleParameters, x: np.ndarray, over: HeldInputs, dt: float) -> np.ndarray:
    """Return the state after one call of the compiled model, which leaves the columns behind the first LANES alone."""
    layout, p, f = models(v)
    x = np.append(x, np.zeros(layout.size - len(x)))
    block = block_of(layout, x[None])
    model.advance(block.ravel(), model.LANES, over, dt, layout, p, f)
    states = block[layout.places]
    np.testing.assert_array_equal(states[:, : model.LANES], np.tile(states[:, :1], model.LANES))
    np.testing.assert_array_equal(states[:, model.LANES], x)
    return states[:, 0]


def ay_of(v: VehicleParameters, x: np.ndarray, steer: float) -> float:
    layout, p, f = models(v)
    reading = np.zeros(model.WIDTH)
    model.read_ay(block_of(layout, x[None]).ravel(), 1, steer, FRICTION, 0.0, layout, p, f, reading)
    return float(reading[0])


# --- without axle forces: the nominal model --------------------------------------------------------------------------

SEDAN = default_vehicle().model_copy(
    update={"imu_position_m": (0.4, -0.3, 0.0), "roll_gradient_rad_per_m_s2": 0.009, "low_speed_blend_m_s": 4.0}
)
ONE_FRICTION = (
    AxleTyre(B=11.1, C=1.05, D_n=7991.0, E=-0.51, reference_friction=0.85),
    AxleTyre(B=10.6, C=1.65, D_n=5708.0, E=0.34, reference_friction=1.0),
)
OTHER = SEDAN.model_copy(update={"tyres": Tyres(front=ONE_FRICTION[0], rear=ONE_FRICTION[1])})
STEER_RAD = st.floats(-0.6, 0.6) | st.sampled_from([-0.5 * math.pi, 0.5 * math.pi])
CARS = [SEDAN, on_axles(SEDAN, 105_000.0, 96_000.0), OTHER]


@pytest.mark.parametrize("car", CARS, ids=["magic formula", "cornering stiffness", "formula of one friction"])
@settings(derandomize=True, deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1), st.floats(0.05, 1.5), st.floats(1e-4, 0.2), STEER_RAD, st.booleans())
def test_states_of_a_block_move_and_are_read_as_one_state_of_the_nominal_model(car, seed, mu, dt, steer, fast):
    """Also with a residual, at any speed and with wheels across the car."""
    p, f, rng = model_parameters(car, roll_correction=True), model.physics_parameters(car), np.random.default_rng(seed)
    vx = rng.uniform(0.0, 60.0 if fast else 6.0, model.LANES)
    states = np.column_stack([vx, *(rng.normal(0.0, s, model.LANES) for s in (2.0, 0.7, 0.3))])
    ax, rate = rng.normal(0.0, 4.0), (rng.normal(), rng.normal())
    if nominal_model.substeps(vx.min(), dt, mu, p) > nominal_model.substeps(vx[0], dt, mu, p):
        dt = 1e-3  # the first state determines the substeps: slow states beside it would grow without bound
    n, share = nominal_model.substeps(vx[0], dt, mu, p), nominal_model.dynamic_share(vx[0], p)
    block, reading = block_of(model.NOMINAL, states), np.zeros(model.WIDTH)
    model.read_ay(block.ravel(), model.LANES, steer, mu, rate[0], model.NOMINAL, p, f, reading)
    model.push(block.ravel(), model.LANES, vx[0], rate, 0.5 * dt, p)
    model.advance(block.ravel(), model.LANES, HeldInputs(steer, ax, True, mu), dt, model.NOMINAL, p, f)
    model.push(block.ravel(), model.LANES, vx[0], rate, 0.5 * dt, p)
    want, want_reading = states.copy(), np.zeros(model.LANES)
    for i, state in enumerate(states):
        half = 0.5 * share * dt * np.array(rate)
        end = nominal_model.rk4_steps(state[0], *(state[1:3] + half), steer, ax - state[model.AX_BIAS], mu, dt, n, p)
        want[i, :3] = end[0], *(end[1:] + half)
        w = nominal_model.dynamic_share(state[0], p)
        ay = nominal_model.planar_lateral_acceleration(*state[:3], steer, mu, p) + w * rate[0]
        _, yaw = accelerations(*state[:3], steer, mu, p)
        want_reading[i] = (1.0 + p.ay_roll_gain) * ay + w * yaw * p.imu_x_m - state[2] ** 2 * p.imu_y_m
    np.testing.assert_allclose(reading[: model.LANES], want_reading, rtol=TOLERANCE, atol=TOLERANCE)
    found = block[[model.VX, model.VY, model.YAW_RATE, model.AX_BIAS], : model.LANES].T
    np.testing.assert_allclose(found, want, rtol=TOLERANCE, atol=TOLERANCE)


# --- with axle forces and parts --------------------------------------------------------------------------------------


@pytest.mark.parametrize("ax", [0.1, -4.0])
@every_set
def test_a_step_is_that_of_the_equations_to_the_second_order(names, ax):
    """For steps of 20 ms to 5 ms. First-order terms (bank, force scale, load transfer) only matter below 5 ms."""
    oracle, steer, mu, whole_s = Oracle(parts(*names), imu=IMU), 0.03, 0.8, 0.2
    x, v = state_of(oracle, steer, ax, mu), oracle.as_vehicle()
    want = oracle.after(x, steer, ax, mu, whole_s)
    errors = []
    for count in (10, 20, 40):
        end = x
        for _ in range(count):
            end = moved(v, end, HeldInputs(steer, ax, True, mu), whole_s / count)
        errors.append(np.abs(end - want))
    late = np.array(errors)
    assert (late[1] < 2.5e-3).all()
    assert (np.max(late[:-1], axis=1) / np.max(late[1:], axis=1) > 3.4).all()
    end, count = x, model.step_count(x[model.VX], whole_s, mu, *models(v))
    for _ in range(count):
        end = moved(v, end, HeldInputs(steer, ax, True, mu), whole_s / count)
    np.testing.assert_allclose(moved(v, x, HeldInputs(steer, ax, True, mu), whole_s), end, atol=5e-3)


@pytest.mark.parametrize("speed", [2.2, 1.0])
@pytest.mark.parametrize("names", [(), ("lag", "roll"), ALL_PARTS], ids="+".join)
def test_at_low_speed_it_rolls_without_slip(names, speed):
    """Blended to the kinematic model, in steps that its time constant asks for."""
    oracle, steer = Oracle(parts(*names), imu=IMU), 0.2
    x, v = state_of(oracle, steer, 0.0, FRICTION, vx=speed, ff=0.3, fr=0.2), oracle.as_vehicle()
    want, end = oracle.after(x, steer, 0.0, FRICTION, 0.2), x
    for _ in range(80):
        end = moved(v, end, HeldInputs(steer, 0.0, True, FRICTION), 0.0025)
    np.testing.assert_allclose(end[[0, 1, 2]], want[[0, 1, 2]], atol=2e-3)


@pytest.mark.parametrize("speed", [25.0, 2.2])
@every_set
def test_the_accelerometer_reads_what_the_equations_say(names, speed):
    oracle, steer = Oracle(parts(*names), imu=IMU), 0.05
    x, v = state_of(oracle, steer, 0.0, FRICTION, vx=speed), oracle.as_vehicle()
    bias = ENTRIES["b_ay"] if "biases" in names else 0.0
    assert ay_of(v, x, steer) + bias == pytest.approx(oracle.sensed_ay(x, steer), rel=1e-12)


def test_a_vanishing_lag_is_no_lag():
    """From one limit to the other without a jump, and stable where the lag is far below the step."""
    ends = []
    for v in (vehicle(), *(vehicle("lag", relaxation_length_m=s) for s in (1e-3, 1e-9))):
        x = np.array([25.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        for k in range(100):
            x = moved(v, x, HeldInputs(0.03 * math.sin(0.06 * k), 0.0, True, FRICTION), 0.01)
        ends.append(x)
    np.testing.assert_allclose(ends[1:], [ends[0]] * 2, rtol=2e-3, atol=2e-3)
