"""``pure-lstm``: a network that outputs v_y directly, with the inputs of the hybrid filter's network.

The paper's Pure-LSTM with the same information as PD-HEF: sensors, outputs of the parallel physics filter, friction.
v_x is the parallel filter's, the yaw rate the gyro's. Over the latency, v_x and v_y are extrapolated to the scored
stamp by a_x + v_y r and a_y − v_x r, with a_y corrected for body roll.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters
from pdhef_logtool.estimators.base import AY, VX, VY, YAW_RATE, Steps
from pdhef_logtool.estimators.parallel_physics import run_features
from pdhef_logtool.estimators.vehicle_ukf import FilterState, nominal_filter
from pdhef_logtool.records.signals import BoolArray, FloatArray, Signals
from pdhef_logtool.residual_model.features import FEATURES
from pdhef_logtool.residual_model.service import NetworkCarry, NetworkService

if TYPE_CHECKING:
    from pdhef_logtool.car.car import Car
    from pdhef_logtool.estimators.presets import Options

_VX, _AX, _AY, _RATE = (FEATURES.index(n) for n in ("vx_m_s", "ax_m_s2", "ay_m_s2", "yaw_rate_rad_s"))


def direct_steps(vehicle: VehicleParameters, features: FloatArray, vy_m_s: FloatArray, usable: BoolArray) -> Steps:
    """Return the steps of an estimator that outputs only v_y; the other quantities come from the features.

    Parameters
    ----------
    vehicle : provides the roll gradient for the planar a_y.
    features : [K, f] of :func:`~.parallel_physics.run_features`. vy_m_s : [K]. usable : [K], both are finite.
    """
    values, rates = np.full((len(features), 4), np.nan), np.zeros((len(features), 4))
    vx, yaw_rate, vy = features[usable, _VX], features[usable, _RATE], vy_m_s[usable]
    ay = features[usable, _AY] / (1.0 + GRAVITY_M_S2 * vehicle.roll_gradient_rad_per_m_s2)
    values[usable, VX], values[usable, VY] = vx, vy
    values[usable, YAW_RATE], values[usable, AY] = yaw_rate, ay
    rates[usable, VX] = features[usable, _AX] + vy * yaw_rate
    rates[usable, VY] = ay - vx * yaw_rate
    return Steps(values, rates, usable)


@dataclass(frozen=True, slots=True, eq=False)
class DirectState:
    """State of the parallel filter and the network between windows."""

    physics: FilterState
    network: NetworkCarry


@dataclass(frozen=True, slots=True)
class DirectNetwork:
    """The estimator of this file; ``network`` must have the lateral velocity as target."""

    algorithm = "direct-network"
    version = 1
    options = ("slip_gate",)

    vehicle: VehicleParameters
    network: NetworkService
    use_speed: bool = True
    slip_gate: bool = True
    name: str = "pure-lstm"
    causal: bool = True

    @property
    def notes(self) -> tuple[str, ...]:
        """Return the network's hash; run.json only contains the residual network's."""
        return (f"network {self.network.bundle.sha256}",)

    def run(self, signals: Signals, state: DirectState | None) -> tuple[Steps, DirectState]:
        """Process one window (see :class:`~.base.Estimator`)."""
        features, physics, after = run_features(
            nominal_filter(self.vehicle, use_speed=self.use_speed, slip_gate=self.slip_gate),
            signals,
            state.physics if state else None,
        )
        starts = ~np.isfinite(physics.prior[:, 0])
        output, network = self.network.run(features, starts, state.network if state else None)
        usable = np.asarray(np.isfinite(features).all(axis=1), dtype=np.bool_)
        return direct_steps(self.vehicle, features, output[:, 0], usable), DirectState(after, network)


def build(name: str, car: Car, options: Options) -> DirectNetwork:
    """Return ``pure-lstm`` for a car with such a network."""
    del name
    assert car.network is not None and car.network.pure_lstm is not None
    return DirectNetwork(car.vehicle, NetworkService(car.network.pure_lstm), use_speed=options.use_speed)
