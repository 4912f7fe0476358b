"""``zero`` (β = 0) and ``gyro`` (the sensors as they are): what any estimator must beat."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pdhef_logtool.estimators.stepwise import StepCarry, advance_speed, run_stepwise
from pdhef_logtool.records.compiled import njit
from pdhef_logtool.records.signals import BoolArray, FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack

if TYPE_CHECKING:
    from pdhef_logtool.car.car import Car
    from pdhef_logtool.estimators.table import Options


@njit(cache=True)
def _pass_through(sensors, vy, state, values, valid):  # type: ignore[no-untyped-def]
    dt, ax, ay, yaw_rate, speed = sensors
    for k in range(dt.shape[0]):
        advance_speed(state, dt[k], ax[k], speed[k])
        values[k, 0] = state[0]
        values[k, 1] = vy
        values[k, 2] = yaw_rate[k]
        values[k, 3] = ay[k]
        valid[k] = math.isfinite(state[0]) and math.isfinite(yaw_rate[k])


@dataclass(frozen=True, slots=True)
class PassThrough:
    """Speed sensor, gyro and accelerometer passed through; ``zero`` adds v_y = 0, ``gyro`` claims no v_y.

    Both carry the sensors' delay, because the newest arrived sample is what stands at the scored stamp.
    """

    algorithm = "pass-through"
    version = 1
    options = ("claims_zero_sideslip",)

    name: str
    claims_zero_sideslip: bool
    causal: bool = True

    def run(self, signals: Signals, carry: StepCarry | None) -> tuple[StateTrack, StepCarry]:
        """Process one window (see :class:`~.base.Estimator`)."""
        vy = 0.0 if self.claims_zero_sideslip else math.nan

        def step(
            dt: FloatArray, s: Signals, state: FloatArray, values: FloatArray, _: FloatArray, valid: BoolArray
        ) -> None:
            _pass_through((dt, s.ax_m_s2, s.ay_m_s2, s.yaw_rate_rad_s, s.speed_m_s), vy, state, values, valid)

        return run_stepwise(self.name, signals, carry, 2, step)


def build(name: str, car: Car, options: Options) -> PassThrough:
    """Return ``zero`` or ``gyro``."""
    del car, options
    return PassThrough(name, claims_zero_sideslip=name == "zero")
