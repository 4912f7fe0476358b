"""``zero`` (β = 0) and ``zero:no-lateral`` (the unchanged sensors): baselines for all estimators."""

from dataclasses import dataclass

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.estimators.base import Steps, make_steps
from pdhef_logtool.estimators.presets import options_of
from pdhef_logtool.estimators.stepwise import StepState, measured_speed
from pdhef_logtool.records.signals import Signals


@dataclass(frozen=True, slots=True)
class PassThrough:
    """Passes speed sensor, gyro and accelerometer through; ``zero`` adds v_y = 0, ``zero:no-lateral`` no v_y.

    Both have the sensors' delay: the newest available sample is held until the scored stamp.
    """

    algorithm = "pass-through"
    version = 1
    options = ("claims_zero_sideslip",)

    vehicle: VehicleParameters
    name: str
    causal: bool = True

    @property
    def claims_zero_sideslip(self) -> bool:
        """Whether v_y is 0, False for ``zero:no-lateral``."""
        return "no-lateral" not in options_of(self.name)

    def run(self, signals: Signals, state: StepState | None) -> tuple[Steps, StepState]:
        """Process one window (see :class:`~.base.Estimator`)."""
        vx, state = measured_speed(signals, self.vehicle.sensors.speed_hold_s, state)
        vy = np.full(len(signals), 0.0 if self.claims_zero_sideslip else np.nan)
        return make_steps(vx, vy, signals.yaw_rate_rad_s, signals.ay_m_s2), state
