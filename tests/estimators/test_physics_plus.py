"""``physics-plus``: its model in closed form, its filter against filterpy, and drives of a car whose forces lag."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
from reference_car import (
    FRICTION,
    FRONT_M,
    MASS_KG,
    REAR_M,
    WHEELBASE_M,
    YAW_INERTIA,
    Drive,
    drive,
    magic_tyre,
    make_signals,
    rolling_drive,
    slalom,
    with_noise,
)

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.nominal_model import measured_lateral_acceleration, model_parameters, rk4_step
from pdhef_logtool.car.parts import FilterNoise
from pdhef_logtool.car.vehicle import AxleTyre, Tyres, VehicleParameters, default_vehicle
from pdhef_logtool.estimators.lagged_forces import (
    force_parameters,
    lagged_measured_ay,
    lagged_rk4_step,
    settled_forces,
    steady_forces,
)
from pdhef_logtool.estimators.physics import PhysicsUkf
from pdhef_logtool.estimators.physics_plus import (
    AY_BIAS,
    FRONT_FORCE,
    NAME,
    PHYSICS_PLUS_Q_STD,
    REAR_FORCE,
    STEER_BIAS,
    YAW_RATE_BIAS,
    PhysicsPlusUkf,
    physics_plus,
)
from pdhef_logtool.estimators.table import Options, default_names, make_estimator
from pdhef_logtool.records.signals import Signals

pytestmark = pytest.mark.slow

VEHICLE = default_vehicle()
TRACK_M, CG_HEIGHT_M, G = 1.57, 0.64, 9.80665
ROLL_GAIN = G * 0.0105
IMU_X_M, IMU_Y_M = 0.4, -0.1
Q_STD = (0.05, 0.1, 0.05, 0.05, 1.0, 1.5)
R_STD = (0.12, 0.004, 0.08)
BIAS_STD, BIAS_WALK = (0.0008, 0.08, 0.0015), (0.00002, 0.004, 0.00008)  # steering, a_y, yaw rate


def vehicle(**changes) -> VehicleParameters:
    return VEHICLE.model_copy(update=changes)


# --- the model in plain Python ---------------------------------------------------------------------------------------


def reference_steady(vx, vy, r, steer, ay, mu, sensitivity):
    """Axle forces over the mass; the load transfer relative to steady cornering (Eq 7)."""

    def factor(lateral):
        x = min(1.0, abs(2.0 * CG_HEIGHT_M * lateral / (G * TRACK_M)))
        return 0.5 * ((1 + x) * (1 - sensitivity * x) + (1 - x) * (1 + sensitivity * x))

    alpha_f = steer - math.atan((vy + FRONT_M * r) / vx)
    alpha_r = -math.atan((vy - REAR_M * r) / vx)
    ff, fr = magic_tyre(alpha_f, mu, True) / MASS_KG, magic_tyre(alpha_r, mu, False) / MASS_KG
    own_f, own_r = ff * WHEELBASE_M / REAR_M, fr * WHEELBASE_M / FRONT_M
    return ff * factor(ay) / factor(own_f), fr * factor(ay) / factor(own_r)


def reference_derivative(s, steer, ax, mu, length, sensitivity, imu=(0.0, 0.0)):
    vx, vy, r, ff, fr = s
    ay = ff * math.cos(steer) + fr
    to_f, to_r = reference_steady(vx, vy, r, steer, ay, mu, sensitivity)
    r_dot = MASS_KG * (FRONT_M * ff * math.cos(steer) - REAR_M * fr) / YAW_INERTIA
    vx_dot = ax + vy * r + r_dot * imu[1] + r * r * imu[0]
    return np.array([vx_dot, ay - vx * r, r_dot, (to_f - ff) * vx / length, (to_r - fr) * vx / length])


def reference_step(s, steer, ax, mu, dt, length, sensitivity, imu=(0.0, 0.0), n=1):
    """RK4 with ``steer`` an angle or a function of the time in the step."""
    h = dt / n
    at = steer if callable(steer) else lambda _: steer

    def f(state, t):
        return reference_derivative(state, at(t), ax, mu, length, sensitivity, imu)

    for i in range(n):
        t = i * h
        k1 = f(s, t)
        k2 = f(s + h / 2 * k1, t + h / 2)
        k3 = f(s + h / 2 * k2, t + h / 2)
        k4 = f(s + h * k3, t + h)
        s = s + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return s


def lagging_drive(steer, duration_s=12.0, speed=25.0, length=0.6, sensitivity=0.15, roll_gain=ROLL_GAIN) -> Drive:
    """Drive a car whose forces lag, at 100 Hz, with a body that rolls; steering moves on between the stamps."""
    n, dt = round(duration_s * 100) + 1, 0.01
    s = np.array([speed, 0.0, 0.0, 0.0, 0.0])
    state, ay, ax = np.empty((n, 5)), np.empty(n), np.empty(n)
    for k in range(n):
        t0 = k * dt
        state[k] = s
        ay[k] = s[3] * math.cos(steer(t0)) + s[4]
        ax[k] = -s[1] * s[2]  # the driver holds the speed
        s = reference_step(s, lambda t, t0=t0: steer(t0 + t), ax[k], FRICTION, dt, length, sensitivity, n=4)
    t = np.arange(n) * dt
    signals = make_signals(
        np.full(n - 1, dt),
        steer_rad=np.array([steer(v) for v in t]),
        ax_m_s2=ax,
        ay_m_s2=(1.0 + roll_gain) * ay,
        yaw_rate_rad_s=state[:, 2],
        speed_m_s=np.where(np.arange(n) % 2 == 0, state[:, 0], np.nan),
    )
    return Drive(signals, state[:, 0], state[:, 1], state[:, 2], ay)


# --- relaxation and load transfer ------------------------------------------------------------------------------------


@pytest.mark.parametrize("speed", [8.0, 20.0, 40.0])
@pytest.mark.parametrize("length", [0.3, 0.7])
def test_a_force_builds_up_over_the_relaxation_length(speed, length):
    """At a slip angle that stays (a body too heavy to move): f = f_ss (1 − exp(−v t / σ))."""
    heavy = vehicle(mass_kg=1e12, yaw_inertia_kg_m2=1e12, relaxation_length_m=length)
    p, f = model_parameters(heavy), force_parameters(heavy)
    steer, dt = 0.02, 0.001
    state = (speed, 0.0, 0.0, 0.0, 0.0)
    for k in range(1, 101):
        state = lagged_rk4_step(*state, steer, 0.0, FRICTION, dt, 1, p, f)
        want = magic_tyre(steer, FRICTION, True) / 1e12 * (1.0 - math.exp(-speed * k * dt / length))
        assert state[3] == pytest.approx(want, rel=1e-6)
    assert abs(state[4]) < 1e-6 * state[3]


STATES_OF_MOTION = [(25.0, 0.4, -0.2, 0.03), (12.0, -0.3, 0.4, -0.05), (2.0, 0.1, 0.2, 0.2), (-1.5, 0.02, -0.1, 0.1)]


@pytest.mark.parametrize(("vx", "vy", "r", "steer"), STATES_OF_MOTION)
def test_without_lag_and_load_transfer_it_is_the_nominal_model(vx, vy, r, steer):
    static = vehicle(relaxation_length_m=0.0, load_sensitivity=0.0, imu_position_m=(IMU_X_M, IMU_Y_M, 0.0))
    p, f = model_parameters(static, roll_correction=True), force_parameters(static)
    got = lagged_rk4_step(vx, vy, r, 7.0, -7.0, steer, 0.5, FRICTION, 0.01, 2, p, f)
    np.testing.assert_allclose(got[:3], rk4_step(vx, vy, r, steer, 0.5, FRICTION, 0.01, 2, p), rtol=1e-12)
    ff, fr = settled_forces(vx, vy, r, steer, FRICTION, p, f)
    want = measured_lateral_acceleration(vx, vy, r, steer, FRICTION, p)
    assert lagged_measured_ay(vx, r, ff, fr, steer, p) == pytest.approx(want, rel=1e-12)


def test_a_vanishing_lag_is_no_lag():
    """From one limit to the other without a jump, and stable where the lag is far below the step."""
    results = []
    for length in (0.0, 1e-3, 1e-9):
        v = vehicle(relaxation_length_m=length)
        p, f = model_parameters(v), force_parameters(v)
        state = (25.0, 0.0, 0.0, 0.0, 0.0)
        for k in range(100):
            state = lagged_rk4_step(*state, 0.03 * math.sin(0.06 * k), 0.0, FRICTION, 0.01, 32, p, f)
        results.append(state)
    np.testing.assert_allclose(results[1:], [results[0]] * 2, rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize("steer", [0.02, 0.04, -0.04])
def test_load_transfer_of_steady_cornering_is_in_the_fitted_tyre_already(steer):
    """Where the axles carry what their share of the mass needs, the fitted curve holds as it is."""
    p, f = model_parameters(VEHICLE), force_parameters(VEHICLE)
    state = np.array([22.0, 0.0, 0.0, 0.0, 0.0])
    for _ in range(600):  # the speed is put back, so that the bend stays
        state = np.array(lagged_rk4_step(*state, steer, 0.0, FRICTION, 0.01, 2, p, f))
        state[0] = 22.0
    vx, vy, r, ff, fr = state
    without = force_parameters(vehicle(load_sensitivity=0.0))
    assert abs(ff + fr) > 2.0
    np.testing.assert_allclose((ff, fr), settled_forces(vx, vy, r, steer, FRICTION, p, without), rtol=2e-4)


def test_load_transfer_costs_force_while_the_other_axle_lags_behind():
    """Steering in, the front pushes before the body follows: it has more force than at its own steady a_y."""
    p = model_parameters(VEHICLE)
    f, without = force_parameters(VEHICLE), force_parameters(vehicle(load_sensitivity=0.0))
    plain = steady_forces(25.0, 0.0, 0.0, 0.05, 0.0, FRICTION, p, without)
    early = steady_forces(25.0, 0.0, 0.0, 0.05, 0.0, FRICTION, p, f)
    late = steady_forces(25.0, 0.0, 0.0, 0.05, 8.0, FRICTION, p, f)
    assert early[0] > plain[0] > late[0] > 0.9 * plain[0]


@pytest.mark.parametrize("ay", [0.0, 3.0, -6.0])
def test_a_tyre_known_by_its_stiffness_gets_the_whole_loss_of_two_wheels(ay):
    tyre = AxleTyre(cornering_stiffness_n_per_rad=105_000.0)
    v = vehicle(tyres=Tyres(front=tyre, rear=tyre), load_sensitivity=0.2)
    p = model_parameters(v)
    x = 2.0 * CG_HEIGHT_M * abs(ay) / (G * TRACK_M)
    two_wheels = 0.5 * ((1 + x) * (1 - 0.2 * x) + (1 - x) * (1 + 0.2 * x))
    plain = steady_forces(25.0, 0.3, -0.1, 0.02, ay, FRICTION, p, force_parameters(v.model_copy(update=NO_TRANSFER)))
    got = steady_forces(25.0, 0.3, -0.1, 0.02, ay, FRICTION, p, force_parameters(v))
    np.testing.assert_allclose(got, np.array(plain) * two_wheels, rtol=1e-12)


NO_TRANSFER = {"load_sensitivity": 0.0}


# --- the filter against filterpy -------------------------------------------------------------------------------------


def filterpy_run(signals: Signals, biased: bool, length: float, sensitivity: float):
    """Posterior states, covariances, NIS of every step after the first."""
    n = 9 if biased else 6
    imu = (IMU_X_M, IMU_Y_M)

    def fx(x, dt, u):
        steer, ax, mu = u
        angle = steer - (x[6] if biased else 0.0)
        moved = reference_step(x[[0, 1, 2, 4, 5]], angle, ax - x[3], mu, dt, length, sensitivity, imu, n=2)
        return np.concatenate([moved[:3], x[3:4], moved[3:], x[6:]])

    def hx(x, steer, use):
        angle = steer - (x[6] if biased else 0.0)
        front = x[4] * math.cos(angle)
        r_dot = MASS_KG * (FRONT_M * front - REAR_M * x[5]) / YAW_INERTIA
        ay = (1.0 + ROLL_GAIN) * (front + x[5]) + r_dot * imu[0] - x[2] ** 2 * imu[1]
        extra = x[7:9] if biased else (0.0, 0.0)
        return np.array([ay + extra[0], x[2] + extra[1], x[0]])[use]

    points = MerweScaledSigmaPoints(n, alpha=1.0, beta=2.0, kappa=0.0)
    ukf = UnscentedKalmanFilter(dim_x=n, dim_z=3, dt=0.01, hx=hx, fx=fx, points=points)
    r0, steer, mu = signals.yaw_rate_rad_s[0], signals.steer_rad, signals.friction
    start = [signals.speed_m_s[0], REAR_M * r0, r0]
    forces = (0.0, 0.0)
    for _ in range(20):
        ay = forces[0] * math.cos(steer[0]) + forces[1]
        forces = reference_steady(*start, steer[0], ay, mu[0], sensitivity)
    ukf.x = np.array([*start, 0.0, *forces, *([0.0] * (n - 6))])
    ukf.P = np.diag(np.array([0.5, 0.5, 0.1, 0.3, 0.5, 0.5, *BIAS_STD][:n]) ** 2)
    states, covariances, nis = [ukf.x.copy()], [ukf.P.copy()], []
    for k in range(1, len(signals)):
        dt = (signals.stamps_ns[k] - signals.stamps_ns[k - 1]) * 1e-9
        ukf.Q = np.diag(np.array([*Q_STD, *BIAS_WALK][:n]) ** 2) * dt
        ukf.predict(dt=dt, u=[0.5 * (c[k - 1] + c[k]) for c in (steer, signals.ax_m_s2, mu)])
        z = np.array([signals.ay_m_s2[k], signals.yaw_rate_rad_s[k], signals.speed_m_s[k]])
        use = np.isfinite(z)
        nis.append(np.nan)
        if use.any():
            ukf.update(z[use], R=np.diag(np.array(R_STD)[use] ** 2), steer=steer[k], use=use)
            nis[-1] = ukf.y @ np.linalg.solve(ukf.S, ukf.y)
        states.append(ukf.x.copy())
        covariances.append(ukf.P.copy())
    return np.array(states), np.array(covariances), np.array(nis)


@pytest.mark.parametrize("biased", [False, True])
def test_posteriors_agree_with_filterpy(biased):
    """On irregular stamps, to 0.6 g, with missing samples, a change of friction and an IMU off the centre."""
    rng = np.random.default_rng(7)
    dt = rng.uniform(0.011, 0.019, 300)  # two RK4 steps each, as the reference has them
    s = with_noise(drive(lambda t: 0.045 * np.sin(2.4 * t), speed=40.0 * 0.6, step_s=dt).signals, seed=3)
    s.ay_m_s2[rng.random(len(s)) < 0.1] = np.nan
    s.yaw_rate_rad_s[1:][rng.random(len(s) - 1) < 0.1] = np.nan
    s.friction[:] = np.where(np.arange(len(s)) < 200, 0.85, 0.8)
    length = 0.25
    assert (dt * 22.0 / length).min() > 0.95 and (dt * 26.0 / length).max() < 2.0
    s = replace(s, speed_m_s=np.where(np.arange(len(s)) % 3 == 0, s.speed_m_s, np.nan))
    v = vehicle(relaxation_length_m=length, imu_position_m=(IMU_X_M, IMU_Y_M, 0.0))
    steps, _ = PhysicsPlusUkf(v, q_std=Q_STD, r_std=R_STD, bias_states=biased).filter_steps(s, None)
    two = np.concatenate([[True], dt * steps.x[:-1, 0] / length > 1.0])
    assert two.all(), "every step must be divided by two, as in the reference"
    x, P, nis = filterpy_run(s, biased, length, v.load_sensitivity)
    assert np.nanmax(nis) < 36.0, "the drive must stay inside the gate, which filterpy does not have"
    assert np.ptp(x[:, 1]) > 0.5, "the drive must excite the lateral motion"
    np.testing.assert_allclose(steps.x, x, rtol=1e-7, atol=1e-7)
    scale = np.sqrt(np.einsum("ki,kj->kij", *[np.einsum("kii->ki", P)] * 2))
    assert np.abs((steps.P - P) / scale).max() < 1e-6
    np.testing.assert_allclose(steps.nis[1:], nis, rtol=1e-5, atol=1e-6)


# --- drives ----------------------------------------------------------------------------------------------------------


def sideslip_rmse(estimator, made: Drive, signals: Signals) -> float:
    track, _ = estimator.run(signals, None)
    late = made.time_s > 1.0
    assert track.valid[late].all()
    return float(np.sqrt(np.mean((track.sideslip_rad - made.sideslip)[late] ** 2)))


@pytest.mark.parametrize(("amplitude", "frequency_hz"), [(0.03, 1.0), (0.04, 0.7), (0.02, 1.6)])
def test_it_beats_the_static_filter_on_a_car_whose_forces_lag(amplitude, frequency_hz):
    """Against the plain filter, and against the plain filter that knows of the roll: the lag alone is worth it too."""
    made = lagging_drive(slalom(amplitude, frequency_hz))
    v = vehicle(relaxation_length_m=0.6)
    for seed in (1, 2):
        noisy = with_noise(made.signals, seed)
        plus = sideslip_rmse(physics_plus(v), made, noisy)
        assert plus < 0.5 * sideslip_rmse(PhysicsUkf(v), made, noisy)
        assert plus < 0.8 * sideslip_rmse(PhysicsUkf(v, roll_correction=True), made, noisy)


def test_forces_of_the_axles_are_found():
    """Also a third of them that no tyre model knows of."""
    made = lagging_drive(slalom(0.03, 0.5))
    weak = VEHICLE.tyres.front.model_copy(update={"D_n": 7600.0 / 1.5})
    v = vehicle(tyres=Tyres(front=weak, rear=VEHICLE.tyres.rear), relaxation_length_m=0.6)
    steps, _ = PhysicsPlusUkf(v, q_std=(*PHYSICS_PLUS_Q_STD[:4], 10.0, 10.0)).filter_steps(made.signals, None)
    total = steps.x[:, FRONT_FORCE] * np.cos(made.signals.steer_rad) + steps.x[:, REAR_FORCE]
    error = (total - made.ay)[made.time_s > 1.0]
    assert np.sqrt(np.mean(error**2)) < 0.1 * np.sqrt(np.mean(made.ay**2))


@pytest.mark.parametrize("bias", [{"ay_m_s2": 0.15}, {"steer_rad": 0.0016}])
def test_a_bias_is_found_and_its_removal_helps(bias):
    """Each alone: together, or from the gyro's, they cannot be told apart while nothing stands."""
    made = lagging_drive(slalom(0.03, 0.5), 30.0)
    noisy = with_noise(made.signals, 4)
    biased = replace(noisy, **{c: getattr(noisy, c) + b for c, b in bias.items()})
    v = vehicle(relaxation_length_m=0.6)
    with_states, without = PhysicsPlusUkf(v), PhysicsPlusUkf(v, bias_states=False)
    entry = {"ay_m_s2": AY_BIAS, "steer_rad": STEER_BIAS}[next(iter(bias))]
    found = with_states.filter_steps(biased, None)[0].x[-500:, entry].mean()
    assert 0.3 < found / next(iter(bias.values())) < 1.3
    assert sideslip_rmse(with_states, made, biased) < 0.7 * sideslip_rmse(without, made, biased)


def test_a_standstill_teaches_the_gyro_bias_and_holds_the_rest():
    def speed(t):
        return np.clip(6.0 - 2.0 * np.clip(t - 2.0, 0, None), 0.0, None) + np.clip(1.5 * (t - 15.0), 0.0, 6.0)

    made = rolling_drive(speed, lambda t: np.full_like(t, 0.1), 20.0)
    still = (made.time_s > 5.0) & (made.time_s < 15.0)
    s = with_noise(made.signals, 8)
    wheels = np.where(still & np.isfinite(s.speed_m_s), 0.0, s.speed_m_s)
    s = replace(s, speed_m_s=wheels, yaw_rate_rad_s=s.yaw_rate_rad_s + 0.004)
    steps, _ = physics_plus(VEHICLE).filter_steps(s, None)
    standing = (made.time_s > 5.5) & (made.time_s <= 15.0)
    assert (steps.x[standing][:, [0, 1, 2, FRONT_FORCE, REAR_FORCE]] == 0.0).all()
    assert steps.x[1450, YAW_RATE_BIAS] == pytest.approx(0.004, abs=0.0006)
    going = made.time_s > 15.5
    assert np.abs(steps.x[going, 0] - made.vx[going]).max() < 0.4


def test_without_lag_and_load_transfer_the_filter_is_the_tuned_kind_of_phy_ukf():
    """What is left is ``phy-ukf`` with roll and biases, but for the wider spread of more sigma points."""
    made = lagging_drive(slalom(0.03, 0.7))
    noisy = with_noise(made.signals, 5)
    v = vehicle(relaxation_length_m=0.0, load_sensitivity=0.0)
    q = (0.089, 0.31, 0.062, 0.021)
    for biased in (False, True):
        plus = PhysicsPlusUkf(v, q_std=(*q, 1e-3, 1e-3), bias_states=biased).filter_steps(noisy, None)[0]
        static = PhysicsUkf(v, q, roll_correction=True, bias_states=biased).filter_steps(noisy, None)[0]
        np.testing.assert_allclose(plus.x[50:, :3], static.x[50:, :3], atol=1e-3)
        np.testing.assert_allclose(plus.log_likelihood.sum(), static.log_likelihood.sum(), rtol=1e-3)


# --- the car's noise -------------------------------------------------------------------------------------------------


def test_its_noise_comes_from_the_car_where_it_has_some():
    bare = make_estimator(NAME, Car.of(VEHICLE))
    assert NAME in default_names(Car.of(VEHICLE))
    assert bare.q_std == PHYSICS_PLUS_Q_STD
    assert bare.measurement_std.tolist() == [0.12, 0.004, 0.08]
    noise = FilterNoise(q_std=(0.05, 0.02, 0.02), r_std={"ay_m_s2": 0.8})
    tuned = make_estimator(NAME, Car.of(VEHICLE, noise={NAME: noise}))
    assert tuned.q_std == (0.05, 0.02, 0.02, *PHYSICS_PLUS_Q_STD[3:])
    assert tuned.measurement_std.tolist() == [0.8, 0.004, 0.08]
    assert not make_estimator(NAME, Car.of(VEHICLE), Options(use_speed=False)).use_speed
