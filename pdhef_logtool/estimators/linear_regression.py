"""``linear-regression``: sideslip as a linear function of the network's low-passed features, a baseline."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.estimators.base import Steps
from pdhef_logtool.estimators.direct_network import direct_steps
from pdhef_logtool.estimators.parallel_physics import run_features
from pdhef_logtool.estimators.vehicle_model import VX
from pdhef_logtool.estimators.vehicle_ukf import FilterState, nominal_filter
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.records.steps import last_stamp_ns, step_durations_s
from pdhef_logtool.residual_model.linear_model import LinearModel
from pdhef_logtool.residual_model.low_pass import low_pass

if TYPE_CHECKING:
    from pdhef_logtool.car.car import Car
    from pdhef_logtool.estimators.presets import Options


@dataclass(frozen=True, slots=True, eq=False)
class RegressionState:
    """State of the parallel filter and the low-pass between windows."""

    physics: FilterState
    sideslip: FloatArray
    last_stamp_ns: int | None


@dataclass(frozen=True, slots=True)
class LinearRegression:
    """The estimator of this file: v_y = v_x tan β, the rest as in ``pure-lstm``."""

    algorithm = "linear-regression"
    version = 1
    options = ("slip_gate",)

    vehicle: VehicleParameters
    model: LinearModel
    use_speed: bool = True
    slip_gate: bool = True
    name: str = "linear-regression"
    causal: bool = True

    @property
    def notes(self) -> tuple[str, ...]:
        """Return the model's hash; run.json only contains the residual network's."""
        return (f"coefficients {self.model.sha256}",)

    def run(self, signals: Signals, state: RegressionState | None) -> tuple[Steps, RegressionState]:
        """Process one window (see :class:`~.base.Estimator`)."""
        features, physics, after = run_features(
            nominal_filter(self.vehicle, use_speed=self.use_speed, slip_gate=self.slip_gate),
            signals,
            state.physics if state else None,
        )
        usable = np.asarray(np.isfinite(features).all(axis=1), dtype=np.bool_)
        starts = ~np.isfinite(physics.prior[:, VX])
        before_ns = state.last_stamp_ns if state else None
        sideslip = np.zeros(1) if state is None else state.sideslip.copy()
        beta = self.model.sideslip_rad(features)[:, None]
        # The low-pass restarts wherever the parallel filter does.
        dt = np.where(starts, np.nan, step_durations_s(signals.stamps_ns, before_ns))
        low_pass(beta, dt, self.model.low_pass_hz, sideslip, beta)
        # Sideslip is the direction of the velocity: beyond 80 degrees the linear model is out of its range.
        vy = features[:, 0] * np.tan(np.clip(beta[:, 0], -1.4, 1.4))
        steps = direct_steps(self.vehicle, features, vy, usable)
        return steps, RegressionState(after, sideslip, last_stamp_ns(signals.stamps_ns, before_ns))


def build(name: str, car: Car, options: Options) -> LinearRegression:
    """Return ``linear-regression`` for a car with such a model."""
    del name
    assert car.network is not None and car.network.linear_regression is not None
    return LinearRegression(car.vehicle, car.network.linear_regression, use_speed=options.use_speed)
