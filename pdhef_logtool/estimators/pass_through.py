"""``zero`` (β = 0) and ``zero:no-lateral`` (the unchanged sensors): baselines for all estimators."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import Sensors
from pdhef_logtool.estimators.base import Steps, make_steps
from pdhef_logtool.estimators.presets import Options, options_of
from pdhef_logtool.estimators.stepwise import StepState, measured_speed
from pdhef_logtool.records.signals import Signals


@dataclass(frozen=True, slots=True)
class PassThrough:
    """Passes speed sensor, gyro and accelerometer through; ``zero`` adds v_y = 0, ``zero:no-lateral`` no v_y.

    Both have the sensors' delay: the newest available sample is held until the scored stamp.
    """

    algorithm = "pass-through"
    version = 1
    options = ("claims_zero_sideslip", "speed_hold_s")

    name: str
    claims_zero_sideslip: bool
    speed_hold_s: float = Sensors().speed_hold_s
    causal: bool = True

    def run(self, signals: Signals, state: StepState | None) -> tuple[Steps, StepState]:
        """Process one window (see :class:`~.base.Estimator`)."""
        vx, state = measured_speed(signals, self.speed_hold_s, state)
        vy = np.full(len(signals), 0.0 if self.claims_zero_sideslip else np.nan)
        return make_steps(vx, vy, signals.yaw_rate_rad_s, signals.ay_m_s2), state


def build(name: str, car: Car, options: Options) -> PassThrough:
    """Return ``zero`` or its variant ``no-lateral``."""
    del options
    return PassThrough(name, "no-lateral" not in options_of(name), car.vehicle.sensors.speed_hold_s)
