"""``open-loop``: the nominal model with steering and measured speed as inputs, without correction by other sensors."""

import math
from dataclasses import dataclass

from pdhef_logtool.car.nominal_model import (
    model_parameters,
    planar_lateral_acceleration,
    rk4_steps,
    state_derivative,
    substeps,
)
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.estimators.base import AY, VX, VY, YAW_RATE, Steps
from pdhef_logtool.estimators.stepwise import StepState, advance_speed, prepared_steps
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.steps import RESTART_GAP_S

#: Time step of the derivative of a_y along the motion.
AY_RATE_STEP_S = 0.001
#: Entries of the state behind v_x, age of the speed sample, v_y and r: steering and friction of the previous step.
STEER, MU = 4, 5


@njit(cache=True)
def _open_loop(inputs, hold_s, default_friction, p, state, values, rates, valid):  # type: ignore[no-untyped-def]
    dt, steer, ax, speed, friction = inputs
    for k in range(dt.shape[0]):
        before = state[0]
        advance_speed(state, dt[k], ax[k], speed[k], hold_s)
        mu = friction[k] if math.isfinite(friction[k]) else default_friction
        ok = math.isfinite(state[0]) and math.isfinite(steer[k])
        if ok and dt[k] <= RESTART_GAP_S and math.isfinite(before + state[2] + state[STEER]):
            n = substeps(before, dt[k], state[MU], p)
            _, state[2], state[3] = rk4_steps(before, state[2], state[3], state[STEER], 0.0, state[MU], dt[k], n, p)
        elif ok:
            state[3] = state[0] * math.tan(steer[k]) / (p.front_m + p.rear_m)
            state[2] = p.rear_m * state[3]
        ok = ok and math.isfinite(state[2]) and math.isfinite(state[3])
        if not ok:
            state[2] = math.nan  # steering missing, or vehicle too light for its tyres: restart
        state[STEER] = steer[k]
        state[MU] = mu
        valid[k] = ok
        if ok:
            _, vy_dot, r_dot = state_derivative(state[0], state[2], state[3], steer[k], 0.0, mu, p)
            ay = planar_lateral_acceleration(state[0], state[2], state[3], steer[k], mu, p)
            h = AY_RATE_STEP_S
            soon = planar_lateral_acceleration(state[0], state[2] + h * vy_dot, state[3] + h * r_dot, steer[k], mu, p)
            values[k, VX] = state[0]
            values[k, VY] = state[2]
            values[k, YAW_RATE] = state[3]
            values[k, AY] = ay
            rates[k, VY] = vy_dot
            rates[k, YAW_RATE] = r_dot
            rates[k, AY] = (soon - ay) / h


@dataclass(frozen=True, slots=True)
class OpenLoop:
    """The model of this file as an estimator."""

    algorithm = "open-loop"
    version = 1

    vehicle: VehicleParameters
    name: str = "open-loop"
    causal: bool = True

    def run(self, signals: Signals, state: StepState | None) -> tuple[Steps, StepState]:
        """Process one window (see :class:`~.base.Estimator`)."""
        p, mu, sensors = model_parameters(self.vehicle), self.vehicle.assumed_friction, self.vehicle.sensors
        s, dt, steps, after = prepared_steps(signals, state, MU + 1, sensors)
        inputs = (dt, s.steer_rad, s.ax_m_s2, s.speed_m_s, s.friction)
        _open_loop(inputs, sensors.speed_hold_s, mu, p, after.state, steps.values, steps.rates, steps.valid)
        return steps, after
