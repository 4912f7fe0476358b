"""``linear-kf``: Kalman filter on the linear single track with steering as input; measures a_y and yaw rate.

Leanza, Reina and Blanco-Claraco, Sensors 21 (2021) 5409, and their program: x = [v_y, r],

    ẋ = A x + B (δ + w),   a_y = v̇_y + v_x r + x_imu ṙ,   z = [a_y, r]

R is the white noise of the sensors, w has 1000 times the white noise of the steering sensor, both per sample at 100 Hz.
``linear-kf:open-loop`` does not measure (Riekert and Schunck 1940). Difference: the vehicle file
gives the noise of the sensors.
"""

import math
from typing import ClassVar

import numpy as np

from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.estimators.gaussian import propagate, update
from pdhef_logtool.estimators.peers.peer import PUBLISHED_HZ, Peer, Samples
from pdhef_logtool.estimators.peers.single_track import (
    LEAST_SPEED_M_S,
    LONGEST_STEP_S,
    discrete,
    matrices,
    single_track,
    solve,
)
from pdhef_logtool.estimators.presets import options_of
from pdhef_logtool.records.readings import POSSIBLE_STATE
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.records.steps import RESTART_GAP_S

#: Steering noise over the noise of the sensor.
STEER_NOISE_FACTOR = 1000.0
_LARGEST_VY = POSSIBLE_STATE["vy_m_s"]


@njit(cache=True, error_model="numpy")
def _predict(x, cov, a, b, before, steer, dt, q):  # type: ignore[no-untyped-def]
    """Predict state and covariance in place over a step with ``before`` and ``steer`` at its start and its end."""
    count = math.ceil(dt / LONGEST_STEP_S)
    columns, g = discrete(a, b, dt / count)
    f = np.array(columns).T
    for part in range(count):
        delta = before + (steer - before) * (part + 0.5) / count
        x[0], x[1] = f[0, 0] * x[0] + f[0, 1] * x[1] + g[0] * delta, f[1, 0] * x[0] + f[1, 1] * x[1] + g[1] * delta
        propagate(cov, f)
        for i in range(2):
            for j in range(2):
                cov[i, j] += b[i] * b[j] * q * dt / count


@njit(cache=True, error_model="numpy")
def _linear_kf(samples, first, p, imu_x, stds, memory):  # type: ignore[no-untyped-def]
    steps_s, vx, steer, ay, yaw_rate, states = samples
    x, cov = memory[:2], memory[2:].reshape(2, 2)
    ay_std, yaw_rate_std, steer_std = stds
    h = np.empty(2)
    for k in range(first, len(vx)):
        if not (vx[k] >= LEAST_SPEED_M_S and math.isfinite(steer[k])):
            x[0] = math.nan
            continue
        a, b = matrices(vx[k], p)
        count = 1.0  # published samples in this one
        if steps_s[k] <= RESTART_GAP_S and abs(x[0]) < _LARGEST_VY:
            count = steps_s[k] * PUBLISHED_HZ
            _predict(x, cov, a, b, steer[k - 1], steer[k], steps_s[k], steer_std**2 / PUBLISHED_HZ)
        else:
            x[0], x[1] = solve(a, -b[0] * steer[k], -b[1] * steer[k])
            cov[0, 0], cov[0, 1], cov[1, 0], cov[1, 1] = 1.0, 0.0, 0.0, 1.0
        if math.isfinite(ay[k]):
            h[0], h[1] = a[0][0] + imu_x * a[1][0], a[0][1] + imu_x * a[1][1] + vx[k]
            update(x, cov, h, ay[k] - (b[0] + imu_x * b[1]) * steer[k], ay_std**2 / count)
        if math.isfinite(yaw_rate[k]):
            h[0], h[1] = 0.0, 1.0
            update(x, cov, h, yaw_rate[k], yaw_rate_std**2 / count)
        states[k, 0], states[k, 1] = x[0], x[1]


class LinearKalman(Peer):
    """The filter of this file as an estimator."""

    algorithm = "linear-kf"
    options: ClassVar[tuple[str, ...]] = ("measures",)
    memory_size = 6

    @property
    def measures(self) -> bool:
        """Whether it measures, False for ``linear-kf:open-loop``."""
        return "open-loop" not in options_of(self.name)

    def estimate(self, samples: Samples, first: int, steps_s: FloatArray, memory: FloatArray) -> None:
        """Run the filter (see :class:`~.peer.Peer`)."""
        sensors = self.vehicle.sensors
        stds = sensors.ay_std_m_s2, sensors.yaw_rate_std_rad_s, STEER_NOISE_FACTOR * sensors.steer_std_rad
        measured = [samples.ay, samples.yaw_rate] if self.measures else np.full((2, len(steps_s)), np.nan)
        columns = (steps_s, samples.vx, samples.held("steer"), *measured, samples.states)
        _linear_kf(columns, first, single_track(self.vehicle), self.vehicle.imu_position_m[0], stds, memory)
