"""``physics``: its model against an ODE in plain Python, its filter against filterpy, and drives that its parts fit."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
from physics_oracle import ALL_PARTS, CG_HEIGHT_M, TRACK_M, G, Oracle, names_of, parts, vehicle
from reference_car import (
    FRICTION,
    FRONT_M,
    MASS_KG,
    REAR_M,
    WHEELBASE_M,
    Drive,
    drive,
    keep,
    magic_tyre,
    rolling_drive,
    slalom,
    with_noise,
)

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.nominal_model import measured_lateral_acceleration, model_parameters, rk4_step
from pdhef_logtool.car.parts import FilterNoise, FittedPhysics, FittedValues, physics_sha256
from pdhef_logtool.car.vehicle import AxleTyre, PhysicsParts, Tyres, VehicleParameters, correct_signals
from pdhef_logtool.estimators.algorithm import resolve
from pdhef_logtool.estimators.drive_signals import calibrated_signals
from pdhef_logtool.estimators.filter_base import LINK_NONE, LINK_WHOLE, HeldInputs
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.estimators.phy_ukf import PhysicsUkf
from pdhef_logtool.estimators.physics_filter import (
    PHYSICS_Q_STD,
    PhysicsFilter,
    _draw,
    _moments,
    of_car,
    physics_filter,
)
from pdhef_logtool.estimators.physics_model import (
    CORE,
    PLACES,
    WIDTH,
    advance,
    grip_under_braking,
    layout_of,
    physics_parameters,
    places_of,
    planar_ay,
    sensed_ay,
    settle_forces,
    step_count,
)
from pdhef_logtool.estimators.table import Options, all_names, make_estimator
from pdhef_logtool.estimators.unscented import partial_root
from pdhef_logtool.records.signals import Signals

pytestmark = pytest.mark.slow

#: Sets of parts that are looked at: none, each alone, some that meet, all.
SETS = ((), *((name,) for name in ALL_PARTS), ("lag", "roll"), ("lag", "load_transfer", "biases"), ALL_PARTS)
every_set = pytest.mark.parametrize("names", SETS, ids="+".join)
IMU = (0.4, -0.2)
ENTRIES = {"vx": 25.0, "vy": 0.2, "r": 0.1, "b_ax": 0.1, "ff": 1.5, "fr": 1.0, "phi": 0.03, "phi_dot": -0.1}
ENTRIES |= {"bank": 0.03, "s": 0.06, "b_delta": 0.002, "b_ay": 0.1, "b_r": 0.003}
R_STD = (0.12, 0.004, 0.08)


def state_of(oracle: Oracle, steer: float, ax: float, mu: float, **changes: float) -> np.ndarray:
    x = np.array([(ENTRIES | changes)[name] for name in names_of(oracle.has)])
    return x if oracle.has.lag else oracle.settled(x, steer, ax, mu)


def moved(v: VehicleParameters, x: np.ndarray, over: HeldInputs, dt: float, n: int = 1) -> np.ndarray:
    """The state after one step of the compiled model, as the second of three points; the third is not used."""
    points = np.repeat(x[:, None], 3, axis=1)
    advance(points, 2, over, dt, n, layout_of(v), model_parameters(v), physics_parameters(v))
    np.testing.assert_array_equal(points[:, 0], points[:, 1])
    np.testing.assert_array_equal(points[:, 2], x)
    return points[:, 1]


def settled(v: VehicleParameters, x: np.ndarray, steer: float, ax: float = 0.0) -> np.ndarray:
    x = np.array(x, dtype=float)
    settle_forces(x, steer, ax, FRICTION, layout_of(v), model_parameters(v), physics_parameters(v))
    return x


# --- the model -------------------------------------------------------------------------------------------------------


def test_the_layout_of_every_combination_of_parts():
    for choice in range(2 ** len(ALL_PARTS)):
        names = [name for i, name in enumerate(ALL_PARTS) if choice >> i & 1]
        layout, entries = layout_of(vehicle(*names)), names_of(parts(*names))
        assert layout.size == len(entries) >= CORE
        found = (layout.roll, layout.bank, layout.force_scale, layout.steer_bias, layout.sensor_bias)
        wanted = [entries.index(e) if e in entries else -1 for e in ("phi", "bank", "s", "b_delta", "b_ay")]
        assert list(found) == wanted
        assert layout.sensor_bias in (-1, layout.size - 2)


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
    in_one = moved(v, x, HeldInputs(steer, ax, True, mu), whole_s, 20)  # as many steps of one call
    assert np.abs(in_one - want).max() < 6e-3


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


@pytest.mark.parametrize(("vx", "vy", "r", "steer"), [(25.0, 0.4, -0.2, 0.03), (12.0, -0.3, 0.4, -0.05)])
def test_without_parts_it_is_the_nominal_model(vx, vy, r, steer):
    """Without lag, the filter uses the tyre forces directly, and its a_y equals the nominal model with roll."""
    v = vehicle(imu_position_m=(*IMU, 0.0))
    p, f, layout = model_parameters(v, roll_correction=True), physics_parameters(v), layout_of(v)
    x = settled(v, [vx, vy, r, 0.0, 7.0, -7.0], steer)
    want = (
        magic_tyre(steer - math.atan((vy + FRONT_M * r) / vx), FRICTION, True) / MASS_KG,
        magic_tyre(-math.atan((vy - REAR_M * r) / vx), FRICTION, False) / MASS_KG,
    )
    np.testing.assert_allclose(x[4:6], want, rtol=1e-6)
    row = np.empty(layout.size)
    want_ay = measured_lateral_acceleration(vx, vy, r, steer, FRICTION, p)
    assert sensed_ay(x, steer, layout, p, f, row) == pytest.approx(want_ay, rel=1e-6)
    errors = []
    for h in (0.01, 0.005):
        end = moved(v, x, HeldInputs(steer, 0.5, True, FRICTION), h)
        errors.append(np.abs(end[:3] - rk4_step(vx, vy, r, steer, 0.5, FRICTION, h, 4, p)).max())
    assert errors[0] < 1e-3
    assert errors[0] / errors[1] > 6.0, "of one step the third order of its length"
    np.testing.assert_allclose(end[4:6], settled(v, end, steer)[4:6], atol=0.01)


def test_a_vanishing_lag_is_no_lag():
    """From one limit to the other without a jump, and stable where the lag is far below the step."""
    ends = []
    for v in (vehicle(), *(vehicle("lag", relaxation_length_m=s) for s in (1e-3, 1e-9))):
        x = np.array([25.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        for k in range(100):
            x = moved(v, x, HeldInputs(0.03 * math.sin(0.06 * k), 0.0, True, FRICTION), 0.01)
        ends.append(x)
    np.testing.assert_allclose(ends[1:], [ends[0]] * 2, rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize("speed", [8.0, 40.0])
@pytest.mark.parametrize("length", [0.3, 0.7])
def test_a_force_builds_up_over_the_relaxation_length(speed, length):
    """At a slip angle that stays (a body too heavy to move): f = f_ss (1 − exp(−v t / σ))."""
    v = vehicle("lag", mass_kg=1e12, yaw_inertia_kg_m2=1e12, relaxation_length_m=length)
    x, steer = np.array([speed, 0.0, 0.0, 0.0, 0.0, 0.0]), 0.02
    for k in range(1, 21):
        x = moved(v, x, HeldInputs(steer, 0.0, True, FRICTION), 0.005)
        want = magic_tyre(steer, FRICTION, True) / 1e12 * (1.0 - math.exp(-speed * k * 0.005 / length))
        assert x[4] == pytest.approx(want, rel=1e-5)


@pytest.mark.parametrize("ay", [0.0, 3.0, -6.0, 30.0])
@pytest.mark.parametrize("sensitivity", [0.0, 0.2])
def test_load_transfer_takes_a_share_of_its_square(ay, sensitivity):
    """Two wheels in closed form. A stiffness takes the full loss; a tyre formula already includes steady cornering."""
    x = min(1.0, 2.0 * CG_HEIGHT_M * abs(ay) / (G * TRACK_M))
    two_wheels = 0.5 * ((1 + x) * (1 - sensitivity * x) + (1 - x) * (1 + sensitivity * x))
    stiff = AxleTyre(cornering_stiffness_n_per_rad=105_000.0)
    lean = {"roll_gradient_rad_per_m_s2": 0.0105, "load_sensitivity": sensitivity}
    plain = np.array([25.0, 0.3, -0.1, 0.0, 0.0, 0.0, 0.0105 * ay, 0.0])

    def asked(v: VehicleParameters) -> np.ndarray:
        """Return the axle forces at the roll angle for ``ay``, after a step too short to change other states."""
        return moved(v, plain, HeldInputs(0.02, 0.0, True, FRICTION), 1e-9)[4:6]

    tyres = Tyres(front=stiff, rear=stiff)
    with_it = asked(vehicle("roll", "load_transfer", tyres=tyres, **lean))
    np.testing.assert_allclose(with_it, two_wheels * asked(vehicle("roll", tyres=tyres, **lean)), rtol=1e-6)
    ff, fr = asked(vehicle("roll", **lean))
    own = [1.0 - sensitivity * (2.0 * CG_HEIGHT_M * a / (G * TRACK_M)) ** 2 for a in (ff * WHEELBASE_M / REAR_M,
           fr * WHEELBASE_M / FRONT_M)]  # fmt: skip
    held = asked(vehicle("roll", "load_transfer", **lean))
    np.testing.assert_allclose(held, np.array([ff, fr]) * two_wheels / own, rtol=1e-6)


@pytest.mark.parametrize(("ax", "mu"), [(1.0, 0.8), (0.0, 0.8), (-3.0, 0.8), (-6.0, 0.7), (-50.0, 0.8)])
def test_braking_moves_load_and_takes_grip(ax, mu):
    f = physics_parameters(vehicle("braking"))
    factors = [grip_under_braking(ax, mu, load) for load in (f.front_load_per_ax, f.rear_load_per_ax)]
    if ax >= 0.0:
        assert factors == [1.0, 1.0]
        return
    left = math.sqrt(max(0.04, 1.0 - (ax / (mu * G)) ** 2))
    moment = -ax * CG_HEIGHT_M * MASS_KG / WHEELBASE_M
    loads = [MASS_KG * G * arm / WHEELBASE_M for arm in (REAR_M, FRONT_M)]
    np.testing.assert_allclose(factors, [left * (1 + moment / loads[0]), left * max(0.2, 1 - moment / loads[1])])
    none = physics_parameters(vehicle())
    assert grip_under_braking(ax, mu, none.front_load_per_ax) == 1.0


@pytest.mark.parametrize("names", [("roll",), ("lag", "roll", "load_transfer")], ids="+".join)
def test_roll_settles_where_the_springs_hold_it(names):
    """In steady state φ = G a_y, and the sensor reads the same as on a car without a roll mode."""
    v = vehicle(*names)
    x = np.zeros(layout_of(v).size)
    x[0] = 20.0
    for _ in range(1000):  # the speed is put back, so that the bend stays
        x = moved(v, x, HeldInputs(0.03, 0.0, True, FRICTION), 0.01)
        x[0] = 20.0
    p, f, layout = model_parameters(v), physics_parameters(v), layout_of(v)
    ay = planar_ay(x, 0.03, p)
    assert abs(ay) > 2.0
    assert x[layout.roll] == pytest.approx(0.0105 * ay, rel=1e-6)
    assert x[layout.roll + 1] == pytest.approx(0.0, abs=1e-9)
    assert ay == pytest.approx(x[0] * x[2], rel=1e-5)
    row = np.empty(layout.size)
    assert sensed_ay(x, 0.03, layout, p, f, row) == pytest.approx((1.0 + G * 0.0105) * ay, rel=1e-6)
    started = settled(v, [*x[:6], 9.0, 0.0], 0.03)
    np.testing.assert_allclose(started[4:7], x[4:7], rtol=1e-4)


def test_a_car_that_does_not_lean_has_the_load_transfer_of_its_acceleration():
    """With a roll gradient of 0, the load transfer follows from a_y, without a division by zero."""
    v = vehicle("roll", "load_transfer", roll_gradient_rad_per_m_s2=0.0)
    flat = vehicle("load_transfer", roll_gradient_rad_per_m_s2=0.0)
    x = np.array([25.0, 0.3, -0.1, 0.0, 3.0, 2.0])
    over = HeldInputs(0.05, 0.0, True, FRICTION)
    np.testing.assert_allclose(moved(v, np.append(x, [0.0, 0.0]), over, 0.01)[:6], moved(flat, x, over, 0.01))


@every_set
def test_left_is_right_in_a_mirror(names):
    oracle = Oracle(parts(*names), imu=(0.4, 0.0))
    x, v = state_of(oracle, 0.04, -2.0, 0.8), oracle.as_vehicle()
    sign = np.where(np.isin(names_of(oracle.has), ["vx", "b_ax", "s"]), 1.0, -1.0)
    one = moved(v, x, HeldInputs(0.04, -2.0, True, 0.8), 0.01)
    other = moved(v, sign * x, HeldInputs(-0.04, -2.0, True, 0.8), 0.01)
    np.testing.assert_allclose(other, sign * one, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("speed", [25.0, 2.2])
@every_set
def test_what_the_accelerometer_reads_and_its_derivative(names, speed):
    oracle, steer = Oracle(parts(*names), imu=IMU), 0.05
    x, v = state_of(oracle, steer, 0.0, FRICTION, vx=speed), oracle.as_vehicle()
    p, f, layout = model_parameters(v), physics_parameters(v), layout_of(v)
    row, unused = np.empty(layout.size), np.empty(layout.size)
    assert sensed_ay(x, steer, layout, p, f, row) == pytest.approx(oracle.sensed_ay(x, steer), rel=1e-12)
    for i in range(layout.size):
        step = np.zeros(layout.size)
        step[i] = 1e-6
        difference = sensed_ay(x + step, steer, layout, p, f, unused) - sensed_ay(x - step, steer, layout, p, f, unused)
        if names_of(oracle.has)[i] != "vx" or speed > 3.0:  # the blend's own slope is left out
            assert row[i] == pytest.approx(difference / 2e-6, rel=1e-6, abs=1e-8)


def test_long_steps_are_divided_for_the_roll_mode():
    v, flat = vehicle("roll", roll_frequency_rad_s=60.0), vehicle("lag")
    for one, most in ((v, 0.5), (flat, 60.0)):
        n = step_count(25.0, 0.1, FRICTION, layout_of(one), model_parameters(one), physics_parameters(one))
        assert 1 <= n <= 32
        assert 0.1 / n * 60.0 <= most
    x = np.zeros(8)
    x[0], x[6] = 25.0, 0.1
    end = moved(v, x, HeldInputs(0.0, 0.0, True, FRICTION), 0.1, 12)
    assert abs(end[6]) < 0.1


# --- sigma points ----------------------------------------------------------------------------------------------------


def spread(layout, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(layout.size, layout.size))
    return rng.normal(size=layout.size), root @ root.T / layout.size + 0.1 * np.eye(layout.size)


def drawn(layout, x: np.ndarray, P: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the sigma points of _draw, [16, WIDTH], and the positions of the state's entries."""
    places, wide = places_of(layout), np.zeros(PLACES)
    P_wide, L, points = np.zeros((PLACES, PLACES)), np.zeros((PLACES, PLACES)), np.zeros((16, WIDTH))
    wide[places], P_wide[np.ix_(places, places)] = x, P
    partial_root(P_wide, places, np.isin(np.arange(PLACES), places), L)
    root = np.zeros((PLACES, PLACES))
    root[np.ix_(places, places)] = np.linalg.cholesky(P)
    np.testing.assert_allclose(L, root, rtol=1e-12, atol=1e-14)
    np.testing.assert_array_equal(L, np.tril(L))
    _draw(wide, L, float(layout.size), points.ravel())
    return points, places


@pytest.mark.parametrize("names", [(), ("roll",), ("bank", "biases"), ALL_PARTS], ids="+".join)
def test_sigma_points_are_those_of_numpy_and_give_their_moments_back(names):
    layout = layout_of(vehicle(*names))
    n = layout.size
    moving = n - 2 if "biases" in names else n
    x, P = spread(layout, 4)
    points, places = drawn(layout, x, P)
    body = places[:moving]
    root = np.linalg.cholesky(n * P)
    centre = points[body, 11]
    np.testing.assert_array_equal(centre, x[:moving])
    mirrored = body + WIDTH // 2
    for i, column in enumerate(body):
        for at, sign in ((column, 1.0), (mirrored[i], -1.0)):
            apart = points[:PLACES, at] - points[:PLACES, 11]
            np.testing.assert_allclose(apart[places], sign * root[:, i], rtol=1e-12, atol=1e-12)
    rest = np.setdiff1d(np.arange(WIDTH), [*body, *mirrored])
    np.testing.assert_array_equal(points[body][:, rest], np.repeat(centre[:, None], len(rest), axis=1))

    # a function that is not linear, so that the centre's weight is seen; the sensors' biases stay as they are
    def bent(v: np.ndarray) -> np.ndarray:
        return np.concatenate([np.sin(v[:moving]) + 0.1 * v[:moving] ** 2, v[moving:]])

    every = bent(np.concatenate([x[:, None], x[:, None] + root, x[:, None] - root], axis=1))
    want = every[:, 1:].mean(axis=1)
    apart = every - want[:, None]
    weights = np.array([2.0, *([0.5 / n] * (2 * n))])
    moved = points.copy()
    moved[:11] = np.sin(points[:11]) + 0.1 * points[:11] ** 2
    mean, covariance = np.zeros(PLACES), np.zeros((PLACES, PLACES))
    mean[places], covariance[np.ix_(places, places)] = x, P
    first_mean, first = mean.copy(), np.zeros((PLACES, PLACES))
    q = np.zeros(PLACES)
    q[places] = np.linspace(0.1, 0.4, n)
    _moments(moved.ravel().copy(), float(n), q, first_mean, first, 3)
    _moments(moved.ravel(), float(n), q, mean, covariance, PLACES)
    np.testing.assert_allclose(mean[places], want, rtol=1e-12)
    want = (weights * apart) @ apart.T + np.diag(q[places])
    np.testing.assert_array_equal(covariance, covariance.T)
    np.testing.assert_allclose(covariance[np.ix_(places, places)], want, rtol=1e-10, atol=1e-12)
    np.testing.assert_array_equal(first_mean, mean)
    np.testing.assert_array_equal(first[:3, :3], covariance[:3, :3])


# --- the filter ------------------------------------------------------------------------------------------------------


def filterpy_run(signals: Signals, estimator: PhysicsFilter, oracle: Oracle):
    """Posterior states, covariances and NIS of every step after the first; the model's step is the compiled one.

    Its points all go by the speed of the first of them, which is filterpy's mean.
    """
    v, layout = estimator.vehicle, estimator.layout
    n = layout.size
    tuning = estimator._tuning
    models = (layout, model_parameters(v), physics_parameters(v))
    centre = {}

    def fx(x, dt, u):
        points = np.stack([centre["x"], x, x], axis=1)
        over = HeldInputs(*u[:2], True, u[2])
        count = step_count(centre["x"][0], dt, u[2], *models)
        advance(points, 2, over, dt, count, *models)
        return points[:, 1]

    def hx(x, steer, use):
        biases = x[-2:] if oracle.has.biases else (0.0, 0.0)
        return np.array([oracle.sensed_ay(x, steer), x[2] + biases[1], x[0]])[use]

    ukf = UnscentedKalmanFilter(n, 3, 0.01, hx, fx, MerweScaledSigmaPoints(n, alpha=1.0, beta=2.0, kappa=0.0))
    r0, steer = signals.yaw_rate_rad_s[0], signals.steer_rad
    start = np.zeros(n)
    start[:3] = signals.speed_m_s[0], REAR_M * r0, r0
    no_roll = replace(oracle, has=oracle.has.model_copy(update={"roll": False}))
    core = np.delete(start, [6, 7]) if oracle.has.roll else start
    start[4:6] = no_roll.settled(core, steer[0], signals.ax_m_s2[0], signals.friction[0])[4:6]
    if oracle.has.roll:
        start[6] = oracle.roll_gradient * oracle.lateral(start, steer[0])
    ukf.x, ukf.P = start, np.diag(tuning.initial_std**2)
    states, covariances, nis = [ukf.x.copy()], [ukf.P.copy()], []
    for k in range(1, len(signals)):
        dt = (signals.stamps_ns[k] - signals.stamps_ns[k - 1]) * 1e-9
        ukf.Q = np.diag(tuning.q_std**2) * dt
        if oracle.has.bank:
            ukf.Q[layout.bank, layout.bank] = 0.02**2 * (1.0 - math.exp(-2.0 * dt / 5.0))
        if oracle.has.force_scale:
            ukf.Q[layout.force_scale, layout.force_scale] = 0.05**2 * (1.0 - math.exp(-2.0 * dt / 2.0))
        centre["x"] = ukf.x.copy()
        ukf.predict(dt=dt, u=[0.5 * (c[k - 1] + c[k]) for c in (steer, signals.ax_m_s2, signals.friction)])
        z = np.array([signals.ay_m_s2[k], signals.yaw_rate_rad_s[k], signals.speed_m_s[k]])
        use = np.isfinite(z)
        nis.append(np.nan)
        if use.any():
            ukf.update(z[use], R=np.diag(np.array(R_STD)[use] ** 2), steer=steer[k], use=use)
            nis[-1] = ukf.y @ np.linalg.solve(ukf.S, ukf.y)
        states.append(ukf.x.copy())
        covariances.append(ukf.P.copy())
    return np.array(states), np.array(covariances), np.array(nis)


@pytest.mark.parametrize("names", [(), ("lag",), ("lag", "roll", "biases"), ALL_PARTS], ids="+".join)
def test_posteriors_agree_with_filterpy(names):
    """On irregular stamps, to 0.6 g, with missing samples and a change of friction."""
    rng = np.random.default_rng(7)
    dt = rng.uniform(0.011, 0.019, 300)
    s = with_noise(drive(lambda t: 0.045 * np.sin(2.4 * t), speed=24.0, step_s=dt).signals, seed=3)
    s.ay_m_s2[rng.random(len(s)) < 0.1] = np.nan
    s.yaw_rate_rad_s[1:][rng.random(len(s) - 1) < 0.1] = np.nan
    s.friction[:] = np.where(np.arange(len(s)) < 200, 0.85, 0.8)
    s = replace(s, speed_m_s=np.where(np.arange(len(s)) % 3 == 0, s.speed_m_s, np.nan))
    oracle = Oracle(parts(*names), imu=(0.4, 0.0))  # without r² the measurement is linear and both updates agree
    estimator = PhysicsFilter(oracle.as_vehicle(), r_std=R_STD)
    steps, _ = estimator.run(s, None)
    x, P, nis = filterpy_run(s, estimator, oracle)
    assert np.nanmax(nis) < 36.0, "the drive must stay inside the gate, which filterpy does not have"
    assert np.ptp(x[:, 1]) > 0.3, "the drive must excite the lateral motion"
    np.testing.assert_allclose(steps.x, x, rtol=1e-6, atol=1e-6)
    scale = np.sqrt(np.einsum("ki,kj->kij", *[np.einsum("kii->ki", P)] * 2))
    assert np.abs((steps.P - P) / scale).max() < 1e-5
    np.testing.assert_allclose(steps.nis[1:], nis, rtol=1e-4, atol=1e-5)


@pytest.fixture(scope="module")
def noisy() -> Signals:
    """With a gap that restarts, a fault that opens the gate, and a delay."""
    made = drive(slalom(0.035, 0.5), 8.0, speed=22.0)
    s = with_noise(made.signals, 3)
    t = made.time_s
    s.yaw_rate_rad_s[(t > 5.0) & (t < 5.6)] += 0.6
    s = keep(s, (t < 2.0) | (t > 2.8))
    return replace(s, ready_ns=s.stamps_ns + 60_000_000)


@every_set
def test_linked_steps_are_the_steps_and_what_ties_them(names, noisy):
    estimator = PhysicsFilter(Oracle(parts(*names), imu=IMU).as_vehicle())
    steps, _ = estimator.run(noisy, None)
    linked, _, links = estimator.linked_steps(noisy, None)
    for column in ("x", "P", "nis", "nis_dof", "log_likelihood", "innovation", "valid", "diverged", "prior"):
        np.testing.assert_array_equal(getattr(linked, column), getattr(steps, column))
    restarted = np.flatnonzero(links.kind == LINK_NONE)
    assert restarted.tolist() == [0, int(np.argmax(np.diff(noisy.stamps_ns))) + 1]
    assert (np.delete(links.kind, restarted) == LINK_WHOLE).all()
    layout, v = estimator.layout, estimator.vehicle
    n = layout.size
    for k in (1, 40, 300, 560):
        assert links.kind[k] == LINK_WHOLE
        x, root = steps.x[k - 1][:, None], np.linalg.cholesky(n * steps.P[k - 1])
        before = np.concatenate([x, x + root, x - root], axis=1)
        after = before.copy()
        over = HeldInputs(
            *(0.5 * (steps.inputs[k - 1, i] + steps.inputs[k, i]) for i in (0, 1)),
            True,
            0.5 * (steps.inputs[k - 1, 2] + steps.inputs[k, 2]),
        )
        dt = (noisy.stamps_ns[k] - noisy.stamps_ns[k - 1]) * 1e-9
        models = (layout, model_parameters(v), physics_parameters(v))
        advance(after, 2 * n + 1, over, dt, step_count(steps.x[k - 1, 0], dt, over.friction, *models), *models)
        mean = after[:, 1:].mean(axis=1)
        np.testing.assert_allclose(steps.prior[k], mean, rtol=1e-9, atol=1e-9)
        cross = (before - before[:, :1])[:, 1:] @ (after[:, 1:] - mean[:, None]).T * (0.5 / n)
        np.testing.assert_allclose(links.cross[k], cross, rtol=1e-6, atol=1e-10)
        apart = after - mean[:, None]
        plain = (np.array([2.0, *([0.5 / n] * (2 * n))]) * apart) @ apart.T
        off = ~np.eye(n, dtype=bool)
        np.testing.assert_allclose(links.predicted_P[k][off], plain[off], rtol=1e-6, atol=1e-10)
        assert (np.diag(links.predicted_P[k]) >= np.diag(plain) - 1e-12).all()


@pytest.mark.parametrize("names", [(), ALL_PARTS], ids="+".join)
def test_a_gap_starts_it_anew_and_a_delay_is_predicted_over(names):
    made = drive(slalom(0.03, 0.5), 10.0)
    mask = (made.time_s < 4.0) | (made.time_s > 4.8)
    estimator = physics_filter(vehicle(*names, roll_gradient_rad_per_m_s2=0.0))
    steps, _ = estimator.run(keep(made.signals, mask), None)
    at = int(np.argmax(np.diff(made.time_s[mask]) > 0.5)) + 1
    assert steps.x[at, 0] == made.vx[mask][at]
    assert steps.x[at, 1] == pytest.approx(REAR_M * made.r[mask][at], abs=1e-12)
    assert (steps.x[at, 4 + 2 :] == 0.0).all()
    assert steps.valid.all()
    late = replace(made.signals, ready_ns=made.signals.stamps_ns + 80_000_000)
    track, _ = run_window(estimator, late)
    whole, _ = estimator.run(made.signals, None)
    use = made.time_s > 1.0
    assert np.abs(track.sideslip_rad - np.arctan2(whole.x[:, 1], whole.x[:, 0]))[use].max() < 0.004
    assert (track.covariance[use, 1, 1] > whole.P[np.flatnonzero(use) - 8, 1, 1]).all()


def test_a_standstill_teaches_the_gyro_bias_and_holds_the_rest():
    def speed(t):
        return np.clip(6.0 - 2.0 * np.clip(t - 2.0, 0, None), 0.0, None) + np.clip(1.5 * (t - 15.0), 0.0, 6.0)

    made = rolling_drive(speed, lambda t: np.full_like(t, 0.1), 20.0)
    still = (made.time_s > 5.0) & (made.time_s < 15.0)
    s = with_noise(made.signals, 8)
    wheels = np.where(still & np.isfinite(s.speed_m_s), 0.0, s.speed_m_s)
    s = replace(s, speed_m_s=wheels, yaw_rate_rad_s=s.yaw_rate_rad_s + 0.004)
    v = vehicle("biases", "roll", "lag")
    steps, _ = physics_filter(v).run(s, None)
    standing = (made.time_s > 5.5) & (made.time_s <= 15.0)
    assert (steps.x[standing][:, [0, 1, 2, 4, 5, 6, 7]] == 0.0).all()
    assert steps.x[1450, layout_of(v).sensor_bias + 1] == pytest.approx(0.004, abs=0.0006)
    going = made.time_s > 15.5
    assert np.abs(steps.x[going, 0] - made.vx[going]).max() < 0.4
    moving, _ = replace(physics_filter(v), standstill=False).run(s, None)
    assert (moving.x[standing, 2] != 0.0).all()


# --- drives ----------------------------------------------------------------------------------------------------------


def sideslip_rmse(estimator, made: Drive, signals: Signals) -> float:
    track, _ = run_window(estimator, signals)
    late = made.time_s > 1.0
    assert track.valid[late].all()
    return float(np.sqrt(np.mean((track.sideslip_rad - made.sideslip)[late] ** 2)))


@pytest.mark.parametrize(
    ("names", "without", "share"),
    [(("lag",), (), 0.8), (("roll",), (), 0.7), (("lag", "roll"), ("lag",), 0.7), (("lag", "roll"), ("roll",), 0.9)],
    ids=str,
)
def test_the_parts_that_a_car_has_are_worth_having(names, without, share):
    oracle = Oracle(parts(*names), relaxation_m=0.7, swing_m=0.45)
    made = oracle.drive(slalom(0.03, 1.0), 8.0)
    for seed in (1, 2):
        noisy = with_noise(made.signals, seed)
        right = sideslip_rmse(physics_filter(oracle.as_vehicle()), made, noisy)
        wrong = sideslip_rmse(physics_filter(oracle.as_vehicle(physics=parts(*without))), made, noisy)
        assert right < share * wrong
        assert right < sideslip_rmse(PhysicsUkf(oracle.as_vehicle()), made, noisy)


def test_beyond_the_linear_range_kinematics_count_more():
    """With half the tyre stiffness in the file, the error at the limit is lower; the linear range does not change."""
    oracle = Oracle(parts("lag"))
    v = oracle.as_vehicle()
    tyres = Tyres(**{name: tyre.model_copy(update={"B": 0.5 * tyre.B}) for name, tyre in v.tyres})
    soft, limit, gentle = v.model_copy(update={"tyres": tyres}), slalom(0.09, 0.5), slalom(0.003, 0.5)
    made = oracle.drive(limit, 8.0)
    noisy = with_noise(made.signals, 1)
    plain, yields = (sideslip_rmse(PhysicsFilter(soft, limit_gain=gain), made, noisy) for gain in (0.0, 6.0))
    assert yields < 0.9 * plain
    linear = with_noise(oracle.drive(gentle, 8.0).signals, 1)
    plain, yields = (run_window(PhysicsFilter(v, limit_gain=gain), linear)[0].vy_m_s for gain in (0.0, 6.0))
    np.testing.assert_array_equal(plain, yields)


def test_a_file_that_nothing_has_validated_yields_at_the_limit():
    """Its tyres are half as stiff as the car's. In the linear range it is the filter of a car without lag."""
    oracle = Oracle(parts("lag", "roll"))
    v = oracle.as_vehicle(physics=PhysicsParts(roll=True))
    tyres = Tyres(**{name: tyre.model_copy(update={"B": 0.5 * tyre.B}) for name, tyre in v.tyres})
    soft = v.model_copy(update={"tyres": tyres})
    made = oracle.drive(slalom(0.09, 0.5), 8.0)
    noisy = with_noise(made.signals, 1)
    bare = of_car(Car.of(soft))
    assert sideslip_rmse(bare, made, noisy) < 0.6 * sideslip_rmse(PhysicsFilter(soft), made, noisy)
    linear = with_noise(oracle.drive(slalom(0.003, 0.5), 8.0).signals, 1)
    plain, yields = (run_window(f, linear)[0].vy_m_s for f in (PhysicsFilter(soft), bare))
    np.testing.assert_array_equal(plain, yields)


def test_forces_of_the_axles_are_found():
    """Also a third of them that no tyre model knows of."""
    oracle = Oracle(parts("lag"))
    made = oracle.drive(slalom(0.03, 0.5), 8.0)
    v = oracle.as_vehicle()
    weak = v.tyres.front.model_copy(update={"D_n": 7600.0 / 1.5})
    v = v.model_copy(update={"tyres": Tyres(front=weak, rear=v.tyres.rear)})
    steps, _ = PhysicsFilter(v, q_std=(*PHYSICS_Q_STD[:4], 10.0, 10.0)).run(made.signals, None)
    total = steps.x[:, 4] * np.cos(made.signals.steer_rad) + steps.x[:, 5]
    error = (total - made.ay)[made.time_s > 1.0]
    assert np.sqrt(np.mean(error**2)) < 0.1 * np.sqrt(np.mean(made.ay**2))


@pytest.mark.parametrize("bias", [{"ay_m_s2": 0.15}, {"steer_rad": 0.0016}])
def test_a_bias_is_found_and_its_removal_helps(bias):
    """Each bias alone. Two biases, or a bias and the gyro's, are not distinguishable while the car moves."""
    oracle = Oracle(parts("lag"))
    made = oracle.drive(slalom(0.03, 0.5), 25.0, n=2)
    noisy = with_noise(made.signals, 4)
    biased = replace(noisy, **{c: getattr(noisy, c) + b for c, b in bias.items()})
    v = oracle.as_vehicle(physics=parts("lag", "biases"))
    layout = layout_of(v)
    entry = {"ay_m_s2": layout.sensor_bias, "steer_rad": layout.steer_bias}[next(iter(bias))]
    found = physics_filter(v).run(biased, None)[0].x[-500:, entry].mean()
    assert 0.3 < found / next(iter(bias.values())) < 1.3
    without = physics_filter(oracle.as_vehicle())
    assert sideslip_rmse(physics_filter(v), made, biased) < 0.75 * sideslip_rmse(without, made, biased)


@pytest.mark.parametrize(("part", "entry", "value"), [("bank", "bank", 0.05), ("force_scale", "s", 0.1)])
def test_what_comes_and_goes_is_found(part, entry, value):
    """It fades as the filter thinks it does, and the estimate is better for it."""
    oracle = Oracle(parts("lag", part))
    made = oracle.drive(slalom(0.035, 0.6), 4.0, **{entry: value})
    noisy = with_noise(made.signals, 5)
    v, without = oracle.as_vehicle(), oracle.as_vehicle(physics=parts("lag"))
    steps, _ = physics_filter(v).run(noisy, None)
    fading = value * np.exp(-made.time_s / {"bank": 5.0, "force_scale": 2.0}[part])
    middle = (made.time_s > 0.5) & (made.time_s < 2.5)
    found = steps.x[:, getattr(layout_of(v), part)]
    assert 0.3 < found[middle].mean() / fading[middle].mean() < 1.3
    assert sideslip_rmse(physics_filter(v), made, noisy) < 0.95 * sideslip_rmse(physics_filter(without), made, noisy)


# --- the car ---------------------------------------------------------------------------------------------------------


def test_its_noise_comes_from_the_car_where_it_has_some():
    v = vehicle()
    bare = physics_filter(v)
    assert "physics" in all_names(Car.of(v))
    assert bare.q_std == PHYSICS_Q_STD
    assert bare.measurement_std.tolist() == [0.12, 0.004, 0.08]
    noise = FilterNoise(q_std=(0.05, 0.02, 0.02), r_std={"ay_m_s2": 0.8})
    car = Car.of(v, noise={"physics": noise})
    assert "physics" in all_names(car)
    tuned = make_estimator("physics", car).physics
    assert tuned.q_std == (0.05, 0.02, 0.02, *PHYSICS_Q_STD[3:])
    assert tuned.measurement_std.tolist() == [0.8, 0.004, 0.08]
    assert not make_estimator("physics", car, Options(use_speed=False)).physics.use_speed


def test_a_fitted_car_runs_on_its_values_and_on_signals_that_were_read_with_others(noisy):
    own = vehicle()
    sensors = {"ay_bias_m_s2": 0.2, "yaw_rate_bias_rad_s": 0.004}
    values = FittedValues(
        steer_offset_rad=0.003,
        steering_ratio=15.0,
        sensors=sensors,
        relaxation_length_m=0.7,
        physics=PhysicsParts(lag=True, roll=True),
    )
    car = replace(
        Car.of(own, noise={"physics": FilterNoise()}), fitted_physics=FittedPhysics(values=values, noise=FilterNoise())
    )
    adaptive = make_estimator("physics", car)
    estimator = adaptive.physics
    fitted = values.applied_to(own)
    assert estimator.vehicle == fitted
    assert resolve(adaptive).physics_sha256 == physics_sha256(fitted) != physics_sha256(own)
    assert resolve(estimator).identity == resolve(physics_filter(fitted, FilterNoise())).identity
    ours, _ = run_window(estimator, calibrated_signals(correct_signals(noisy, own), car))
    raw = replace(noisy, steer_rad=noisy.steer_rad * own.steering_ratio / 15.0)
    want, _ = run_window(physics_filter(fitted, FilterNoise()), correct_signals(raw, fitted), None)
    np.testing.assert_allclose(ours.sideslip_rad, want.sideslip_rad, rtol=1e-9, atol=1e-12)


def test_every_set_of_parts_has_its_own_digest():
    digests = {physics_sha256(vehicle(*c)) for k in range(3) for c in combinations(ALL_PARTS, k)}
    assert len(digests) == 1 + 7 + 21
