"""``learned-single-track``: stationary v_y of a linear single track with parameters learned from the yaw rate.

openpilot, ``paramsd`` and ``car_kf`` (2022 to 2025): an extended Kalman filter over stiffness factor, steering ratio i,
slow and fast steering offset, v_x, v_y, r, steering-wheel angle and road roll φ, with

    d/dt [v_y, r] = A(v_x, stiffness) [v_y, r] + B (wheel − offsets) / i − [g φ, 0]

and all other states constant. Noise and validity limits are the published ones; steering wheel and speed are observed
at 100 Hz, the rest at 20 Hz. The estimate is the stationary v_y with the learned parameters. Differences: without a
roll sensor φ is observed as 0 with 10°, as there while the localizer is not valid; the steering ratio starts at 15,
because a log may contain the road-wheel angle.
"""

import math

import numpy as np

from pdhef_logtool.car.vehicle import GRAVITY_M_S2
from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.estimators.gaussian import propagate, update
from pdhef_logtool.estimators.peers.peer import PUBLISHED_HZ, Peer, Samples
from pdhef_logtool.estimators.peers.single_track import LEAST_SPEED_M_S, LONGEST_STEP_S, matrices, single_track, solve
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.records.steps import RESTART_GAP_S

N = 9
STIFFNESS, RATIO, SLOW_OFFSET, FAST_OFFSET, SPEED, VY, RATE, WHEEL, ROLL = range(N)
#: Entries of the memory behind state and covariance: time since observations at 100 and at 20 Hz, activity.
DUE, DUE_SLOW, ACTIVE = range(N + N * N, N + N * N + 3)
START_RATIO, LEAST_PARAMETER = 15.0, 0.1
DEGREE = math.radians(1.0)
UNIT = np.eye(N)
#: Step of the differences.
DIFFERENCE = 1e-6
#: Process noise per √s and initial standard deviation.
STD = np.array([0.0005, 0.01, 0.02 * DEGREE, 0.25 * DEGREE, 0.1, 0.01, 0.1 * DEGREE, 0.1 * DEGREE, DEGREE])
#: Standard deviations of the observations; without a valid yaw rate, 0 is observed with ROLL_STD.
WHEEL_STD, SPEED_STD, ROLL_STD, STIFFNESS_STD, RATIO_STD = 0.05 * DEGREE, 0.1, 10.0 * DEGREE, 0.5, 5.0
#: Limits for learning.
LEAST_ACTIVE_M_S, LARGEST_WHEEL, LARGEST_RATE = 1.0, 45.0 * DEGREE, 1.0


@njit(cache=True, error_model="numpy")
def _drive(x, b, wheel, ratio):  # type: ignore[no-untyped-def]
    """Return the accelerations (2) by steering and road roll."""
    delta = (wheel - x[SLOW_OFFSET] - x[FAST_OFFSET]) / ratio
    return b[0] * delta - GRAVITY_M_S2 * x[ROLL], b[1] * delta


@njit(cache=True, error_model="numpy")
def _rates(x, p):  # type: ignore[no-untyped-def]
    """Return v̇_y and ṙ."""
    a, b = matrices(x[SPEED], p, x[STIFFNESS])
    drive = _drive(x, b, x[WHEEL], x[RATIO])
    return a[0][0] * x[VY] + a[0][1] * x[RATE] + drive[0], a[1][0] * x[VY] + a[1][1] * x[RATE] + drive[1]


@njit(cache=True, error_model="numpy")
def _predict(x, cov, p, dt):  # type: ignore[no-untyped-def]
    """Predict state and covariance in place; the Jacobian is by differences."""
    count = math.ceil(dt / LONGEST_STEP_S)
    h = dt / count
    for _ in range(count):
        rates, f = _rates(x, p), np.eye(N)
        for j in range(N):
            kept = x[j]
            x[j] += DIFFERENCE
            moved = _rates(x, p)
            x[j] = kept
            for i in range(2):
                f[VY + i, j] += h * (moved[i] - rates[i]) / DIFFERENCE
        propagate(cov, f)
        for i in range(N):
            cov[i, i] += h * STD[i] ** 2
        x[VY] += h * rates[0]
        x[RATE] += h * rates[1]


@njit(cache=True, error_model="numpy")
def _observe_slow(x, cov, yaw_rate, yaw_rate_std):  # type: ignore[no-untyped-def]
    """Update in place by the observations at 20 Hz; observed parameters limit their own variance."""
    is_valid = abs(yaw_rate) < LARGEST_RATE
    update(x, cov, UNIT[RATE], yaw_rate if is_valid else 0.0, (yaw_rate_std if is_valid else ROLL_STD) ** 2)
    update(x, cov, UNIT[ROLL], 0.0, ROLL_STD**2)
    update(x, cov, UNIT[FAST_OFFSET], 0.0, ROLL_STD**2)
    update(x, cov, UNIT[STIFFNESS], x[STIFFNESS], STIFFNESS_STD**2)
    update(x, cov, UNIT[RATIO], x[RATIO], RATIO_STD**2)


# positional: numbers and arrays of a compiled function.
@njit(cache=True, error_model="numpy")
def _learn(x, cov, memory, p, dt, vx, wheel, yaw_rate, yaw_rate_std):  # type: ignore[no-untyped-def]
    """Process a sample within the limits for learning, in place."""
    if memory[ACTIVE] and dt <= RESTART_GAP_S:
        _predict(x, cov, p, dt)
        memory[DUE] += dt
        memory[DUE_SLOW] += dt
    else:
        x[SPEED], x[VY], x[RATE], x[WHEEL] = vx, 0.0, 0.0, wheel
    if memory[DUE] >= 0.999 / PUBLISHED_HZ:
        memory[DUE] = 0.0
        update(x, cov, UNIT[WHEEL], wheel, WHEEL_STD**2)
        update(x, cov, UNIT[SPEED], vx, SPEED_STD**2)
    if memory[DUE_SLOW] >= 0.0499:
        memory[DUE_SLOW] = 0.0
        _observe_slow(x, cov, yaw_rate, yaw_rate_std)


@njit(cache=True, error_model="numpy")
def _learned(samples, first, p, yaw_rate_std, memory):  # type: ignore[no-untyped-def]
    steps_s, vx, steer, yaw_rate, states = samples
    x, cov = memory[:N], memory[N:DUE].reshape(N, N)
    for k in range(first, len(vx)):
        if not math.isfinite(memory.sum()):
            memory[:] = 0.0
            x[STIFFNESS], x[RATIO] = 1.0, START_RATIO
            for i in range(N):
                cov[i, i] = STD[i] ** 2
        wheel = steer[k] * START_RATIO
        is_active = vx[k] > LEAST_ACTIVE_M_S and abs(wheel) < LARGEST_WHEEL
        if is_active:
            _learn(x, cov, memory, p, steps_s[k], vx[k], wheel, yaw_rate[k], yaw_rate_std)
        memory[ACTIVE] = is_active
        if vx[k] >= LEAST_SPEED_M_S:
            a, b = matrices(vx[k], p, max(x[STIFFNESS], LEAST_PARAMETER))
            drive = _drive(x, b, wheel, max(x[RATIO], LEAST_PARAMETER))
            states[k, 0], states[k, 1] = solve(a, -drive[0], -drive[1])[0], yaw_rate[k]


class LearnedSingleTrack(Peer):
    """The filter of this file as an estimator."""

    algorithm = "learned-single-track"
    memory_size = ACTIVE + 1

    def estimate(self, samples: Samples, first: int, steps_s: FloatArray, memory: FloatArray) -> None:
        """Run the filter (see :class:`~.peer.Peer`)."""
        columns = (steps_s, samples.vx, samples.held("steer"), samples.held("yaw_rate"), samples.states)
        yaw_rate_std = self.vehicle.sensors.yaw_rate_std_rad_s
        _learned(columns, first, single_track(self.vehicle), yaw_rate_std, memory)
