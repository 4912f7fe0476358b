"""``linear-kf``: Kalman filter on the linear single track with steering as input; measures a_y and yaw rate.

Leanza, Reina and Blanco-Claraco, Sensors 21 (2021) 5409, and their program: x = [v_y, r],

    ẋ = A x + B (δ + w),   a_y = v̇_y + v_x r + x_imu ṙ,   z = [a_y, r]

R is the white noise of the sensors, w has 1000 times the white noise of the steering sensor, both per sample at 100 Hz.
``linear-kf:open-loop`` does not measure (Riekert and Schunck 1940). Difference: the noise of the sensors is that of the
vehicle file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.estimators.peers.gaussian import propagate, update
from pdhef_logtool.estimators.peers.peer import PUBLISHED_HZ, Peer, Samples
from pdhef_logtool.estimators.peers.single_track import (
    LEAST_SPEED_M_S,
    discrete,
    matrices,
    parts_of,
    single_track,
    stationary,
)
from pdhef_logtool.estimators.presets import options_of
from pdhef_logtool.records.readings import POSSIBLE_STATE
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.records.steps import RESTART_GAP_S

if TYPE_CHECKING:
    from pdhef_logtool.car.car import Car
    from pdhef_logtool.estimators.presets import Options

#: Steering noise over the noise of the sensor.
STEER_NOISE_FACTOR = 1000.0
_LARGEST_VY = POSSIBLE_STATE["vy_m_s"]


@njit(cache=True, error_model="numpy")
def _start(x, cov, a, b, vx, steer, p):  # type: ignore[no-untyped-def]
    """Set the state to stationary driving, or to rolling without slip."""
    x[0], x[1] = stationary(a, b[0] * steer, b[1] * steer)
    if vx < LEAST_SPEED_M_S:
        x[1] = vx * math.tan(steer) / (p.front_m + p.rear_m)
        x[0] = p.rear_m * x[1]
    cov[:] = 0.0
    cov[0, 0] = cov[1, 1] = 1.0


@njit(cache=True, error_model="numpy")
def _predict(x, cov, a, b, before, steer, dt, q):  # type: ignore[no-untyped-def]
    """Predict state and covariance in place over a step with ``before`` and ``steer`` at its start and its end."""
    count = parts_of(dt)
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
        if not math.isfinite(vx[k] * steer[k]):
            x[0] = math.nan
            continue
        a, b = matrices(vx[k], p)
        runs = steps_s[k] <= RESTART_GAP_S and abs(x[0]) < _LARGEST_VY and vx[k] >= LEAST_SPEED_M_S
        if runs:
            _predict(x, cov, a, b, steer[k - 1], steer[k], steps_s[k], steer_std**2 / PUBLISHED_HZ)
        else:
            _start(x, cov, a, b, vx[k], steer[k], p)
        count = PUBLISHED_HZ * steps_s[k] if runs else 1.0  # published samples in this one
        if math.isfinite(ay[k]):
            h[0], h[1] = a[0][0] + imu_x * a[1][0], a[0][1] + imu_x * a[1][1] + max(vx[k], LEAST_SPEED_M_S)
            update(x, cov, h, ay[k] - (b[0] + imu_x * b[1]) * steer[k], ay_std**2 / count)
        if math.isfinite(yaw_rate[k]):
            h[0], h[1] = 0.0, 1.0
            update(x, cov, h, yaw_rate[k], yaw_rate_std**2 / count)
        states[k, 0], states[k, 1] = x[0], x[1]


@dataclass(frozen=True, slots=True)
class LinearKalman(Peer):
    """The filter of this file as an estimator."""

    algorithm = "linear-kf"
    options: ClassVar[tuple[str, ...]] = ("measures",)
    memory_size = 6

    measures: bool = True

    def estimate(self, samples: Samples, first: int, steps_s: FloatArray, memory: FloatArray) -> None:
        """Run the filter (see :class:`~.peer.Peer`)."""
        sensors = self.vehicle.sensors
        stds = sensors.ay_std_m_s2, sensors.yaw_rate_std_rad_s, STEER_NOISE_FACTOR * sensors.steer_std_rad
        measured = [samples.ay, samples.yaw_rate] if self.measures else np.full((2, len(steps_s)), np.nan)
        columns = (steps_s, samples.vx, samples.held("steer"), *measured, samples.states)
        _linear_kf(columns, first, single_track(self.vehicle), self.vehicle.imu_position_m[0], stds, memory)

    @classmethod
    def build(cls, name: str, car: Car, options: Options) -> LinearKalman:
        """Return ``linear-kf`` or its variant ``open-loop``."""
        del options
        return cls(car.vehicle, name, measures="open-loop" not in options_of(name))
