"""``slip-ukf``: unscented Kalman filter over speed and sideslip that measures the lateral forces of the axles.

Goblirsch, Weinmann and Betz, arXiv 2408.14885 (2024), after Bechtloff, dissertation, TU Darmstadt (2018):

    v̇ = a_x cos β + a_y sin β,   β̇ = (a_y cos β − a_x sin β) / v − r
    z = [v_x, F_f, F_r],   F_f = (m a_y l_r + I_z ṙ) / (l cos δ),   F_r = (m a_y l_f − I_z ṙ) / l

with F = D sin(C atan(B α − E (B α − atan B α))) of the vehicle file. Published noise of the forces is scaled with the
mass, published speed limits with √wheelbase. Differences: a log has neither brake pressures nor drive torque, so that
the longitudinal axle forces are not measured; two wheel speeds became one. Where the published filter fixes sideslip at
0 (at its start and at low speed), this one fixes it at the angle of rolling without slip. It starts again beyond
86°: otherwise it finds the falling part of the tyre curve in slow, tight bends and diverges for good.
"""

import math
from typing import NamedTuple

import numpy as np

from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.estimators.gaussian import update
from pdhef_logtool.estimators.peers.peer import PUBLISHED_HZ, Peer, Samples
from pdhef_logtool.estimators.peers.single_track import LEAST_SPEED_M_S, SingleTrack, single_track
from pdhef_logtool.records.signals import S_PER_NS, FloatArray, IntArray
from pdhef_logtool.records.steps import RESTART_GAP_S

#: Car of the published noise.
MASS_KG, WHEELBASE_M = 800.0, 2.971
#: Low pass of the IMU at 100 Hz, and the time over which the yaw rate is differentiated.
LOW_PASS, YAW_SPAN_S = (0.0772218, 0.2452234, 0.3425609, 0.2452234, 0.0772218), 1.0
#: Initial and process standard deviation of speed and sideslip; variance of z, of a car of MASS_KG.
START_STD, STD = np.array([0.5, 0.0004]), np.array([0.2, 0.001732])
FRONT_STD_N, REAR_STD_N, SPEED_VARIANCE = 60.0, 120.0, 0.5
#: Speed and sideslip, measurements v_x, F_f and F_r; entry of the memory behind state and covariance.
N, AGE = 5, 6
UNIT = np.eye(N)
#: Sigma points of n = 2 with α = 0.001, β = 2, κ = 0.
ALPHA = 0.001
SPREAD = 2.0 * ALPHA**2
#: At the start sideslip is fixed for this time, and the speed within a limit; below the second speed within another.
START_S, START_LIMIT_M_S, SLOW_LIMIT_M_S = 0.2, 0.4, 0.25
LEAST_START_M_S, SLOW_M_S, LARGEST_SLIP = 2.0, 5.0, 1.5


class SlipCar(NamedTuple):
    """Car of the filter; tyres are B, C, D and E of the axles; factors on published speeds and forces."""

    body: SingleTrack
    front: tuple[float, float, float, float]
    rear: tuple[float, float, float, float]
    speed_scale: float
    force_scale: float


def _low_passed(stamps_ns: IntArray, values: FloatArray) -> FloatArray:
    """Return a column [K] through the low pass."""
    times_s, total = stamps_ns * S_PER_NS, np.zeros_like(values)
    for i, weight in enumerate(LOW_PASS):
        total += weight / sum(LOW_PASS) * np.interp(times_s - i / PUBLISHED_HZ, times_s, values)
    return total


@njit(cache=True, error_model="numpy")
def _axle_force(tyre, slip):  # type: ignore[no-untyped-def]
    b, c, d, e = tyre
    bent = b * slip
    return d * math.sin(c * math.atan(bent - e * (bent - math.atan(bent))))


@njit(cache=True, error_model="numpy")
def _sigma_point(point, v, beta, sample, car):  # type: ignore[no-untyped-def]
    """Write a sigma point after a step, with its measurements: v, β, v_x, F_f, F_r."""
    dt, steer, ax, ay, yaw_rate, _ = sample
    cos, sin = math.cos(beta), math.sin(beta)
    beta += dt * ((cos * ay - sin * ax) / max(v, LEAST_SPEED_M_S) - yaw_rate)
    v += dt * (cos * ax + sin * ay)
    vx, vy = v * math.cos(beta), v * math.sin(beta)
    point[0], point[1], point[2] = v, beta, vx
    point[3] = _axle_force(car.front, steer - math.atan2(vy + car.body.front_m * yaw_rate, vx))
    point[4] = _axle_force(car.rear, -math.atan2(vy - car.body.rear_m * yaw_rate, vx))


@njit(cache=True, error_model="numpy")
def _predict(x, cov, sample, car, mean, joint):  # type: ignore[no-untyped-def]
    """Write mean [5] and covariance [5, 5] of state and measurements after a step, with process noise."""
    width = math.sqrt(SPREAD * cov[0, 0])  # Cholesky factor
    slope = SPREAD * cov[1, 0] / width
    depth = math.sqrt(SPREAD * cov[1, 1] - slope**2)
    points = np.empty((N, N))
    for i, (dv, dbeta) in enumerate(((0.0, 0.0), (width, slope), (-width, -slope), (0.0, depth), (0.0, -depth))):
        _sigma_point(points[i], x[0] + dv, x[1] + dbeta, sample, car)
    for a in range(N):  # relative to the centre: the weights are of the order of 1e6
        mean[a] = points[0, a]
        for i in range(1, N):
            mean[a] += (points[i, a] - points[0, a]) * 0.5 / SPREAD
    for a in range(N):
        for b in range(N):
            joint[a, b] = 0.0
            for i in range(N):
                weight = 0.5 / SPREAD if i else 1.0 - 2.0 / SPREAD + 3.0 - ALPHA**2
                joint[a, b] += weight * (points[i, a] - mean[a]) * (points[i, b] - mean[b])
    for a in range(2):
        joint[a, a] += STD[a] ** 2 * sample[0] * PUBLISHED_HZ


@njit(cache=True, error_model="numpy")
def _measure(mean, joint, vx, sample, car):  # type: ignore[no-untyped-def]
    """Update mean and covariance in place by speed and axle forces."""
    dt, steer, _, ay, _, yaw_acceleration = sample
    body, count = car.body, dt * PUBLISHED_HZ  # published samples in this one
    force, moment, length = body.mass * ay, body.inertia * yaw_acceleration, body.front_m + body.rear_m
    front = (force * body.rear_m + moment) / length / math.cos(steer)
    rear = (force * body.front_m - moment) / length
    update(mean, joint, UNIT[2], vx, SPEED_VARIANCE / count)
    update(mean, joint, UNIT[3], front, (FRONT_STD_N * car.force_scale) ** 2 / count)
    update(mean, joint, UNIT[4], rear, (REAR_STD_N * car.force_scale) ** 2 / count)


# positional: numbers and arrays of a compiled function.
@njit(cache=True, error_model="numpy")
def _step(x, cov, vx, rolling, age_s, sample, car, mean, joint):  # type: ignore[no-untyped-def]
    """Process a sample in place, ``age_s`` after the start."""
    _predict(x, cov, sample, car, mean, joint)
    is_starting = age_s <= START_S
    if not is_starting:
        _measure(mean, joint, vx, sample, car)
    for i in range(2):
        x[i] = mean[i]
        for j in range(2):
            cov[i, j] = 0.5 * (joint[i, j] + joint[j, i])
    if is_starting or vx <= SLOW_M_S * car.speed_scale:
        limit = START_LIMIT_M_S if is_starting else SLOW_LIMIT_M_S
        x[0], x[1] = min(max(x[0], vx - limit), vx + limit), rolling


@njit(cache=True, error_model="numpy")
def _slip_ukf(samples, first, car, memory):  # type: ignore[no-untyped-def]
    steps_s, vx, steer, ax, ay, yaw_rate, yaw_acceleration, states = samples
    x, cov = memory[:2], memory[2:AGE].reshape(2, 2)
    mean, joint = np.empty(N), np.empty((N, N))
    for k in range(first, len(vx)):
        if not (vx[k] >= LEAST_SPEED_M_S and math.isfinite(steer[k])):
            x[1] = math.nan
            continue
        rolling = math.atan(car.body.rear_m * yaw_rate[k] / vx[k])
        if steps_s[k] <= RESTART_GAP_S and abs(x[1]) < LARGEST_SLIP and vx[k] > LEAST_START_M_S * car.speed_scale:
            memory[AGE] += steps_s[k]
            sample = (steps_s[k], steer[k], ax[k], ay[k], yaw_rate[k], yaw_acceleration[k])
            _step(x, cov, vx[k], rolling, memory[AGE], sample, car, mean, joint)
        else:
            x[0], x[1], memory[AGE] = vx[k], rolling, 0.0
            cov[0, 0], cov[0, 1], cov[1, 0], cov[1, 1] = START_STD[0] ** 2, 0.0, 0.0, START_STD[1] ** 2
        states[k, 0] = vx[k] * math.tan(x[1]) if abs(x[1]) < LARGEST_SLIP else math.nan
        states[k, 1] = yaw_rate[k]


class SlipUkf(Peer):
    """The filter of this file as an estimator."""

    algorithm = "slip-ukf"
    memory_size = AGE + 1

    def estimate(self, samples: Samples, first: int, steps_s: FloatArray, memory: FloatArray) -> None:
        """Run the filter (see :class:`~.peer.Peer`)."""
        vehicle, times_s = self.vehicle, samples.stamps_ns * S_PER_NS
        ax = _low_passed(samples.stamps_ns, np.nan_to_num(samples.held("ax")))
        ay, yaw_rate = (_low_passed(samples.stamps_ns, samples.held(name)) for name in ("ay", "yaw_rate"))
        yaw_acceleration = (yaw_rate - np.interp(times_s - YAW_SPAN_S, times_s, yaw_rate)) / YAW_SPAN_S
        ay -= vehicle.imu_position_m[0] * yaw_acceleration
        front, rear = (vehicle.magic_formula(axle, vehicle.assumed_friction) for axle in (True, False))
        scales = math.sqrt(vehicle.wheelbase_m / WHEELBASE_M), vehicle.mass_kg / MASS_KG
        columns = (steps_s, samples.vx, samples.held("steer"), ax, ay, yaw_rate, yaw_acceleration, samples.states)
        _slip_ukf(columns, first, SlipCar(single_track(vehicle), front, rear, *scales), memory)
