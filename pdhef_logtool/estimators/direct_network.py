"""``pure-lstm`` and ``linear-regression``: models that output v_y, with the inputs of the hybrid filter's network.

The paper's Pure-LSTM with the same information as PD-HEF: sensors, outputs of the parallel physics filter, friction;
and a baseline with sideslip as a linear function of the low-passed features.
v_x is the parallel filter's, the yaw rate the gyro's. Over the latency, v_x and v_y are extrapolated to the scored
stamp by a_x + v_y r and a_y − v_x r, with a_y corrected for body roll.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters
from pdhef_logtool.estimators.base import QUANTITIES, VX, VY, Steps
from pdhef_logtool.estimators.parallel_physics import run_features
from pdhef_logtool.estimators.presets import Options
from pdhef_logtool.estimators.vehicle_ukf import FilterState, nominal_filter
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.residual_model.bundle import ModelBundle
from pdhef_logtool.residual_model.features import FEATURES
from pdhef_logtool.residual_model.linear_model import LinearModel

_VX, _AX, _AY, _RATE = (FEATURES.index(n) for n in ("vx_m_s", "ax_m_s2", "ay_m_s2", "yaw_rate_rad_s"))


@dataclass(frozen=True, slots=True)
class DirectNetwork:
    """The estimator of this file."""

    algorithm = "direct-network"
    version = 1

    vehicle: VehicleParameters
    network: ModelBundle | LinearModel
    use_speed: bool = True
    name: str = "pure-lstm"
    causal: bool = True

    @property
    def notes(self) -> tuple[str, ...]:
        """Return the model's hash; run.json only contains the residual network's."""
        return (f"{self.algorithm} {self.network.sha256}",)

    def run(self, signals: Signals, state: tuple[FilterState, Any] | None) -> tuple[Steps, tuple[FilterState, Any]]:
        """Process one window (see :class:`~.base.Estimator`); the state is the filter's and the model's."""
        before, carried = state or (None, None)
        physics = nominal_filter(self.vehicle, use_speed=self.use_speed)
        features, dt_s, _, after = run_features(physics, signals, before)
        vy, carried = self.network.lateral_velocity(features, dt_s, carried)
        usable = np.asarray(np.isfinite(features).all(axis=1), dtype=np.bool_)
        values, rates = (np.full((len(features), len(QUANTITIES)), fill) for fill in (np.nan, 0.0))
        vx, yaw_rate, vy = features[usable, _VX], features[usable, _RATE], vy[usable]
        ay = features[usable, _AY] / (1.0 + GRAVITY_M_S2 * self.vehicle.roll_gradient_rad_per_m_s2)
        values[usable] = np.stack([vx, vy, yaw_rate, ay], axis=1)
        rates[usable, VX] = features[usable, _AX] + vy * yaw_rate
        rates[usable, VY] = ay - vx * yaw_rate
        return Steps(values, rates, usable), (after, carried)


class LinearRegression(DirectNetwork):
    """Sideslip by a linear regression on the network's features, through a low pass: v_y = v_x tan β."""

    algorithm = "linear-regression"


def build(name: str, car: Car, options: Options) -> DirectNetwork:
    """Return ``pure-lstm`` or ``linear-regression`` for a car with such a model."""
    kind = {"pure-lstm": DirectNetwork, "linear-regression": LinearRegression}[name]
    return kind(car.vehicle, getattr(car.network, name.replace("-", "_")), use_speed=options.use_speed, name=name)
