"""The peers, from their published descriptions. They get signals and a vehicle file, and no ground truth.

Constants are published ones; a rule that counts per sample is converted from the published rate to the rate of the log.
``kinematic`` and ``zero`` are the baselines of the tool: a leaky integral of a_y − v_x r with a time constant that was
chosen on simulated drives (``studies.defaults.tune_kinematic_leak``), and sideslip 0.
"""

from __future__ import annotations

import math
from collections import namedtuple
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from pdhef_logtool.car.vehicle import GRAVITY_M_S2, Sensors, VehicleParameters
from pdhef_logtool.estimators.base import VX, VY, YAW_RATE, Estimator, Steps
from pdhef_logtool.estimators.kinematic import Kinematic
from pdhef_logtool.estimators.pass_through import PassThrough
from pdhef_logtool.estimators.stepwise import measured_speed
from pdhef_logtool.records.signals import FloatArray, IntArray, Signals
from pdhef_logtool.records.steps import RESTART_GAP_S, step_durations_s

#: Rate of the published filters in Hz, and the longest integration step in s.
PUBLISHED_HZ, LONGEST_STEP_S = 100.0, 0.005
#: Longest time that a sample is kept.
SPEED_HOLD_S = Sensors().speed_hold_s
#: Slower than this the single track, which divides by the speed, is evaluated at this speed.
LEAST_SPEED_M_S = 0.5
#: Lateral velocity is extrapolated over the latency of the sensors with its change over this time.
RATE_SPAN_S = 0.05
#: Steering noise of the linear Kalman filter over the noise of the sensor.
STEER_NOISE_FACTOR = 1000.0
#: Steering ratio at which the parameter learner starts; its noise is in terms of it.
LEARNER_RATIO = 15.0
#: Car of the unscented filter's published noise: mass in kg, wheelbase in m.
UKF_MASS_KG, UKF_WHEELBASE_M = 800.0, 2.971
#: Low pass of the unscented filter for the IMU at 100 Hz, and the time over which it differentiates the yaw rate.
UKF_LOW_PASS = (0.0772218, 0.2452234, 0.3425609, 0.2452234, 0.0772218)
UKF_YAW_SPAN_S = 1.0

#: Vehicle of the kernels; ``tyres`` [2, 4] are B, C, peak force, E of the axles.
Parameters = namedtuple("Parameters", "mass inertia lf lr cf cr imu_x ay_std yaw_rate_std steer_std tyres speed_scale")
#: Inputs of the kernels, each [N]: steps of time in s, v_x, steering, a_x, a_y, yaw rate, the last three through the
#: low pass of the unscented filter, and the yaw acceleration.
Inputs = namedtuple("Inputs", "steps_s vx steer ax ay yaw_rate smooth_ax smooth_ay smooth_yaw_rate yaw_acceleration")


@dataclass(frozen=True, slots=True)
class Peer:
    """A peer as an estimator, of whole drives: it takes no state from a window before."""

    algorithm = "peer"
    version = 1

    name: str
    kernel: Callable[[Inputs, Parameters], FloatArray]
    vehicle: VehicleParameters
    causal: bool = True

    def run(self, signals: Signals, state: Any | None) -> tuple[Steps, None]:
        """Return the steps of a whole drive (see :class:`~pdhef_logtool.estimators.base.Estimator`)."""
        assert state is None
        times_s = (signals.stamps_ns - signals.stamps_ns[0]) * 1e-9
        inputs = inputs_of(signals, times_s)
        vy = self.kernel(inputs, parameters_of(self.vehicle))
        before = np.searchsorted(times_s, times_s - RATE_SPAN_S)
        values = np.full((len(vy), 4), np.nan)
        values[:, VX], values[:, VY], values[:, YAW_RATE] = inputs.vx, vy, signals.yaw_rate_rad_s
        rates = np.zeros_like(values)
        rates[:, VY] = np.nan_to_num((vy - vy[before]) / np.maximum(times_s - times_s[before], 1e-3))
        return Steps(values, rates, np.isfinite(inputs.vx) & np.isfinite(vy)), None


def peers_of(vehicle: VehicleParameters) -> tuple[Estimator, ...]:
    """Return the peers that use the vehicle file, and those that need none."""
    kernels = {
        "linear-kf": linear_kf,
        "learned-single-track": learned_single_track,
        "open-loop-linear": open_loop,
        "slip-ukf": slip_ukf,
    }
    peers = tuple(Peer(name, kernel, vehicle) for name, kernel in kernels.items())
    return *peers, Kinematic(), PassThrough("zero", claims_zero_sideslip=True)


def stiffness(vehicle: VehicleParameters) -> tuple[float, float]:
    """Return the cornering stiffness of the front and the rear axle at the friction of the file, or at 1."""
    mu = vehicle.assumed_friction
    return vehicle.cornering_stiffness_n_per_rad(True, mu), vehicle.cornering_stiffness_n_per_rad(False, mu)


def parameters_of(vehicle: VehicleParameters) -> Parameters:
    """Return the kernel parameters of a vehicle."""
    lengths = vehicle.cg_to_front_axle_m, vehicle.cg_to_rear_axle_m
    noise = vehicle.sensors.ay_std_m_s2, vehicle.sensors.yaw_rate_std_rad_s, vehicle.sensors.steer_std_rad
    tyres = np.array([vehicle.magic_formula(front, vehicle.assumed_friction) for front in (True, False)])
    scale = math.sqrt(vehicle.wheelbase_m / UKF_WHEELBASE_M)
    body = vehicle.mass_kg, vehicle.yaw_inertia_kg_m2
    return Parameters(*body, *lengths, *stiffness(vehicle), vehicle.imu_position_m[0], *noise, tyres, scale)


def inputs_of(signals: Signals, times_s: FloatArray) -> Inputs:
    """Return the inputs of the kernels at the stamps [N] of a drive."""
    vx, _ = measured_speed(signals, SPEED_HOLD_S, None)
    steer = _held(signals.stamps_ns, signals.steer_rad)
    sensors = signals.ax_m_s2, signals.ay_m_s2, signals.yaw_rate_rad_s
    smooth = [_low_pass(times_s, values) for values in sensors]
    yaw_acceleration = (smooth[2] - np.interp(times_s - UKF_YAW_SPAN_S, times_s, smooth[2])) / UKF_YAW_SPAN_S
    columns = [step_durations_s(signals.stamps_ns, None), vx, steer, *sensors, *smooth, yaw_acceleration]
    return Inputs(*columns)


def _held(stamps_ns: IntArray, values: FloatArray) -> FloatArray:
    """Return a signal [N] with its last finite value held over gaps, as long as the speed is."""
    last = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), 0))
    return np.where((stamps_ns - stamps_ns[last]) * 1e-9 <= SPEED_HOLD_S, values[last], np.nan)


def _low_pass(times_s: FloatArray, values: FloatArray) -> FloatArray:
    """Return a signal [N] through the published filter, or zeros if the log lacks it."""
    finite = np.isfinite(values)
    if not finite.any():
        return np.zeros_like(values)
    total = np.zeros_like(values)
    for i, weight in enumerate(UKF_LOW_PASS):
        total += weight * np.interp(times_s - i / PUBLISHED_HZ, times_s[finite], values[finite])
    return total / sum(UKF_LOW_PASS)


@njit(cache=True)
def _single_track(speed, p, factor=1.0):  # type: ignore[no-untyped-def]
    """Return A [2, 2] and B [2] of the linear single track over [v_y, r] with the road-wheel angle as input.

    ``factor`` is on the stiffness of both axles.
    """
    u, cf, cr = max(speed, LEAST_SPEED_M_S), factor * p.cf, factor * p.cr
    moment = cf * p.lf - cr * p.lr
    a = np.array([[-(cf + cr) / p.mass, -moment / p.mass - u**2],
                  [-moment / p.inertia, -(cf * p.lf**2 + cr * p.lr**2) / p.inertia]])  # fmt: skip
    return a / u, np.array([cf / p.mass, cf * p.lf / p.inertia])


@njit(cache=True)
def _discrete(a, b, h):  # type: ignore[no-untyped-def]
    """Return the transition [2, 2] and the input [2] of a step of the trapezoidal rule."""
    left = np.eye(2) - 0.5 * h * a
    return np.linalg.solve(left, np.eye(2) + 0.5 * h * a), np.linalg.solve(left, h * b)


@njit(cache=True)
def open_loop(inputs, p):  # type: ignore[no-untyped-def]
    """Return v_y of the linear single track (Riekert and Schunck 1940) driven by steering and speed."""
    steps_s, vx, steer = inputs[:3]
    vy = np.full(len(vx), np.nan)
    x = np.full(2, np.nan)
    for k in range(len(vx)):
        if not (math.isfinite(vx[k]) and math.isfinite(steer[k])):
            x[:] = math.nan
            continue
        a, b = _single_track(vx[k], p)
        if not (steps_s[k] <= RESTART_GAP_S and math.isfinite(x[0])):
            x = -np.linalg.solve(a, b * steer[k])
        else:
            count = math.ceil(steps_s[k] / LONGEST_STEP_S)
            f, g = _discrete(a, b, steps_s[k] / count)
            for i in range(count):
                x = f @ x + g * (steer[k - 1] + (steer[k] - steer[k - 1]) * (i + 0.5) / count)
        vy[k] = x[0]
    return vy


@njit(cache=True)
def linear_kf(inputs, p):  # type: ignore[no-untyped-def]
    """Return v_y of a Kalman filter on the linear single track that measures a_y and yaw rate.

    The noise rule follows Leanza, Reina and Blanco-Claraco, Sensors 21 (2021) 5409, and their program: R consists
    of the white noise of the sensors, Q of the input with 1000 times the white noise of the steering sensor, at 100 Hz.
    The vehicle file gives the noise of the sensors.
    """
    steps_s, vx, steer, _, ay, yaw_rate = inputs[:6]
    stds = p.ay_std, p.yaw_rate_std
    q = (STEER_NOISE_FACTOR * p.steer_std) ** 2 / PUBLISHED_HZ
    vy = np.full(len(vx), np.nan)
    x, cov, running = np.zeros(2), np.eye(2), False
    for k in range(len(vx)):
        if not (math.isfinite(vx[k]) and math.isfinite(steer[k])):
            running = False
            continue
        a, b = _single_track(vx[k], p)
        if not (running and steps_s[k] <= RESTART_GAP_S):
            x, cov, running = -np.linalg.solve(a, b * steer[k]), np.eye(2), True
        else:
            count = math.ceil(steps_s[k] / LONGEST_STEP_S)
            f, g = _discrete(a, b, steps_s[k] / count)
            for _ in range(count):
                x = f @ x + g * 0.5 * (steer[k - 1] + steer[k])
                cov = f @ cov @ f.T + np.outer(b, b) * q * steps_s[k] / count
        dt = steps_s[k] if steps_s[k] <= RESTART_GAP_S else 1.0 / PUBLISHED_HZ
        row = a[0] + p.imu_x * a[1]
        row[1] += max(vx[k], LEAST_SPEED_M_S)  # a_y = v̇_y + v_x r
        for i in range(2):
            h = row if i == 0 else np.array([0.0, 1.0])
            z = ay[k] - (b[0] + p.imu_x * b[1]) * steer[k] if i == 0 else yaw_rate[k]
            if math.isfinite(z):
                variance = stds[i] ** 2 / (PUBLISHED_HZ * dt)
                gain = cov @ h / (h @ cov @ h + variance)
                x = x + gain * (z - h @ x)
                keep = np.eye(2) - np.outer(gain, h)
                cov = keep @ cov @ keep.T + np.outer(gain, gain) * variance
        vy[k] = x[0]
    return vy


@njit(cache=True)
def _learner_rates(x, p):  # type: ignore[no-untyped-def]
    a, b = _single_track(x[4], p, x[0])
    rates = a @ x[5:7] + b * (x[7] - x[2] - x[3]) / x[1]
    rates[0] -= GRAVITY_M_S2 * x[8]
    return rates


@njit(cache=True)
def _observe(x, cov, i, z, variance):  # type: ignore[no-untyped-def]
    """Update the state [9] and its covariance [9, 9] in place with an observation of state ``i``."""
    gain = cov[:, i] / (cov[i, i] + variance)
    x += gain * (z - x[i])
    cov -= np.outer(gain, cov[i])


@njit(cache=True)
def learned_single_track(inputs, p):  # type: ignore[no-untyped-def]
    """Return the stationary v_y of a single track with parameters from a Kalman filter on the yaw rate.

    After openpilot's parameter learner (``paramsd`` and ``car_kf``, 2022 to 2025): states are stiffness factor,
    steering ratio, slow and fast steering offset, v_x, v_y, yaw rate, steering-wheel angle and road roll, with the
    published noise and validity limits; steering and speed are observed at 100 Hz, the rest at 20 Hz. There is no roll
    sensor: roll is observed as 0 with 10° as it is there when the localizer is not valid. The estimate is the
    stationary solution of its vehicle model with the learned parameters.
    """
    steps_s, vx, wheel, yaw_rate = inputs.steps_s, inputs.vx, inputs.steer * LEARNER_RATIO, inputs.yaw_rate
    degree = math.pi / 180.0
    q = np.array([0.0005, 0.01, 0.02 * degree, 0.25 * degree, 0.1, 0.01, 0.1 * degree, 0.1 * degree, degree]) ** 2
    x, cov = np.zeros(9), np.diag(q)
    x[0], x[1] = 1.0, LEARNER_RATIO
    vy = np.full(len(vx), np.nan)
    due, due_slow, was_active = 0.0, 0.0, False
    for k in range(len(vx)):
        if not (math.isfinite(vx[k]) and math.isfinite(wheel[k])):
            was_active = False
            continue
        active = vx[k] > 1.0 and abs(wheel[k]) < 45.0 * degree
        if active and not was_active:
            x[4], x[7] = vx[k], wheel[k]
            x[5:7] = 0.0
        if active and was_active and steps_s[k] <= RESTART_GAP_S:
            count = math.ceil(steps_s[k] / LONGEST_STEP_S)
            h = steps_s[k] / count
            for _ in range(count):
                rates = _learner_rates(x, p)
                f = np.eye(9)
                for j in range(9):
                    moved = x.copy()
                    moved[j] += 1e-6
                    f[5:7, j] += h * (_learner_rates(moved, p) - rates) / 1e-6
                x[5:7] += h * rates
                cov = f @ cov @ f.T + h * np.diag(q)
            due += steps_s[k]
            due_slow += steps_s[k]
        if active and due >= 0.999 / PUBLISHED_HZ:
            due = 0.0
            _observe(x, cov, 7, wheel[k], (0.05 * degree) ** 2)
            _observe(x, cov, 4, vx[k], 0.1**2)
        if active and due_slow >= 0.0499:
            due_slow = 0.0
            valid = abs(yaw_rate[k]) < 1.0
            _observe(x, cov, 6, yaw_rate[k] if valid else 0.0, (p.yaw_rate_std if valid else 10.0 * degree) ** 2)
            for i in (8, 3):
                _observe(x, cov, i, 0.0, (10.0 * degree) ** 2)
            _observe(x, cov, 0, x[0], 0.5**2)
            _observe(x, cov, 1, x[1], 5.0**2)
        was_active = active
        a, b = _single_track(vx[k], p, max(x[0], 0.1))
        drive = b * (wheel[k] - x[2] - x[3]) / max(x[1], 0.1)
        drive[0] -= GRAVITY_M_S2 * x[8]
        vy[k] = -np.linalg.solve(a, drive)[0]
    return vy


@njit(cache=True)
def _axle_forces(speed, beta, steer, yaw_rate, p):  # type: ignore[no-untyped-def]
    vx, vy = speed * math.cos(beta), speed * math.sin(beta)
    slips = steer - math.atan2(vy + p.lf * yaw_rate, vx), -math.atan2(vy - p.lr * yaw_rate, vx)
    forces = np.empty(2)
    for i in range(2):
        b, c, d, e = p.tyres[i]
        bent = b * slips[i]
        forces[i] = d * math.sin(c * math.atan(bent - e * (bent - math.atan(bent))))
    return forces


@njit(cache=True)
def slip_ukf(inputs, p):  # type: ignore[no-untyped-def]
    """Return v_y of an unscented Kalman filter over speed and sideslip that measures axle forces.

    After Goblirsch, Weinmann and Betz, arXiv 2408.14885 (2024), and Bechtloff, dissertation, TU Darmstadt (2018): the
    prediction integrates the accelerations; the lateral forces of the axles follow from a_y and the yaw acceleration
    and are compared with the tyre curves of the vehicle file. The published noise of the forces is scaled with the
    mass, the published speed limits with √wheelbase. The logs have neither brake pressures nor drive torque: the two
    longitudinal axle forces are not measured. Where the published filter fixes sideslip at 0 (at its start and at low
    speed), this one fixes it at the sideslip of rolling without slip, and it starts again beyond 86°: otherwise the
    filter finds the falling part of the tyre curve in slow, tight bends and diverges for good.
    """
    steps_s, vx, steer, _, _, _, ax, ay, yaw_rate, yaw_acceleration = inputs
    ay = ay - p.imu_x * yaw_acceleration
    scale, share = p.speed_scale, p.mass / UKF_MASS_KG
    alpha = 0.001
    spread = 2.0 * alpha**2  # n + lambda
    mean_weights = np.full(5, 0.5 / spread)
    mean_weights[0] = 1.0 - 2.0 / spread
    weights = mean_weights.copy()
    weights[0] += 3.0 - alpha**2
    start = np.diag(np.array([0.5**2, 0.0004**2]))
    q = np.diag(np.array([0.2**2, 0.001732**2]))
    # Two wheel speeds became one speed; forces per axle.
    r = np.diag(np.array([0.5, (60.0 * share) ** 2, (120.0 * share) ** 2]))
    x, cov, age_s = np.zeros(2), start, 0.0
    vy = np.full(len(vx), np.nan)
    running = False
    for k in range(len(vx)):
        dt = steps_s[k]
        if not (math.isfinite(vx[k]) and math.isfinite(steer[k])):
            running = False
            continue
        rolling = math.atan(p.lr * yaw_rate[k] / max(vx[k], LEAST_SPEED_M_S))
        if not (running and dt <= RESTART_GAP_S) or vx[k] <= 2.0 * scale or not abs(x[1]) < 1.5:
            x, cov, age_s, running = np.array([vx[k], rolling]), start, 0.0, True
            vy[k] = vx[k] * math.tan(rolling)
            continue
        root = np.linalg.cholesky(spread * cov)
        points = np.empty((5, 2))
        for i in range(5):
            point = x if i == 0 else (x - root[:, i - 1] if i < 3 else x + root[:, i - 3])
            cos, sin, v = math.cos(point[1]), math.sin(point[1]), max(point[0], LEAST_SPEED_M_S)
            points[i, 0] = point[0] + dt * (cos * ax[k] + sin * ay[k])
            points[i, 1] = point[1] + dt * ((cos * ay[k] - sin * ax[k]) / v - yaw_rate[k])
        readings = np.empty((5, 3))
        for i in range(5):
            readings[i, 0] = points[i, 0] * math.cos(points[i, 1])
            readings[i, 1:] = _axle_forces(points[i, 0], points[i, 1], steer[k], yaw_rate[k], p)
        # Means relative to the centre: the weights are of the order of 1e6.
        x = points[0] + mean_weights @ (points - points[0])
        reading = readings[0] + mean_weights @ (readings - readings[0])
        apart, read_apart = points - x, readings - reading
        weighted = np.diag(weights)
        cov = apart.T @ weighted @ apart + q * dt * PUBLISHED_HZ
        across = apart.T @ weighted @ read_apart
        innovation = read_apart.T @ weighted @ read_apart + r / (dt * PUBLISHED_HZ)
        force, moment, length = p.mass * ay[k], p.inertia * yaw_acceleration[k], p.lf + p.lr
        front = (force * p.lr + moment) / length / math.cos(steer[k])
        rear = (force * p.lf - moment) / length
        gain = np.ascontiguousarray(np.linalg.solve(innovation, across.T).T)
        age_s += dt
        if age_s <= 20.0 / PUBLISHED_HZ:
            x = np.array([min(max(x[0], vx[k] - 0.4), vx[k] + 0.4), rolling])
        else:
            x = x + gain @ (np.array([vx[k], front, rear]) - reading)
            cov = cov - gain @ innovation @ gain.T
            cov = 0.5 * (cov + cov.T)
            if vx[k] <= 5.0 * scale:
                x = np.array([min(max(x[0], vx[k] - 0.25), vx[k] + 0.25), rolling])
        vy[k] = vx[k] * math.tan(x[1]) if abs(x[1]) < 1.5 else np.nan
    return vy
