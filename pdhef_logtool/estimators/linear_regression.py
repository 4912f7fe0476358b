"""``linear-regression``: sideslip linear in the network's features, low-passed; what a network has to beat."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.estimators.direct_network import write_direct_steps
from pdhef_logtool.estimators.filter_shell import VX
from pdhef_logtool.estimators.parallel_physics import parallel_filter, run_features
from pdhef_logtool.estimators.physics import FilterCarry
from pdhef_logtool.estimators.stepwise import StepCarry, run_stepwise
from pdhef_logtool.records.signals import BoolArray, FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.residual_model.linear_model import LinearModel
from pdhef_logtool.residual_model.low_pass import low_pass

if TYPE_CHECKING:
    from pdhef_logtool.car.car import Car
    from pdhef_logtool.estimators.table import Options


@dataclass(frozen=True, slots=True, eq=False)
class RegressionCarry:
    """What the parallel filter, and the low-pass with the release of outputs, take from window to window."""

    physics: FilterCarry
    steps: StepCarry


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
        """Say which file ran: run.json has the residual network's hash alone."""
        return (f"coefficients {self.model.sha256}",)

    def run(self, signals: Signals, carry: RegressionCarry | None) -> tuple[StateTrack, RegressionCarry]:
        """Process one window (see :class:`~.base.Estimator`)."""
        features, physics, after = run_features(
            parallel_filter(self.vehicle, use_speed=self.use_speed, slip_gate=self.slip_gate),
            signals,
            carry.physics if carry else None,
        )
        known = np.asarray(np.isfinite(features).all(axis=1), dtype=np.bool_)
        starts = ~np.isfinite(physics.prior[:, VX])

        def step(
            dt: FloatArray, _s: Signals, state: FloatArray, values: FloatArray, rates: FloatArray, valid: BoolArray
        ) -> None:
            beta = self.model.sideslip_rad(features)[:, None]
            # The memory starts as NaN, and anew wherever the parallel filter does.
            since = np.where(starts, np.nan, dt)
            state[np.isnan(state)] = 0.0
            low_pass(beta, since, self.model.low_pass_hz, state, beta)
            # Sideslip is an angle of the velocity: beyond 80 degrees the line has left its range.
            vy = features[:, 0] * np.tan(np.clip(beta[:, 0], -1.4, 1.4))
            write_direct_steps(self.vehicle, features, vy, known, values, rates, valid)

        track, steps = run_stepwise(self.name, signals, carry.steps if carry else None, 1, step)
        return track, RegressionCarry(after, steps)


def build(name: str, car: Car, options: Options) -> LinearRegression:
    """Return ``linear-regression`` of a car whose network has it."""
    del name
    assert car.network is not None and car.network.linear_regression is not None
    return LinearRegression(car.vehicle, car.network.linear_regression, use_speed=options.use_speed)
