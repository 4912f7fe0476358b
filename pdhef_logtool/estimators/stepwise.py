"""The simple baselines ``zero``, ``kinematic`` and ``open-loop``, and the measured speed between its samples."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.car import nominal_model
from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import Sensors, VehicleParameters
from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.estimators.base import AY, VX, VY, YAW_RATE, Steps, make_steps
from pdhef_logtool.estimators.presets import Options, options_of
from pdhef_logtool.estimators.speed_slip import believable
from pdhef_logtool.records.readings import without_impossible
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.records.steps import RESTART_GAP_S

#: Time constant of the leak of ``kinematic``, s. A pure integrator drifts by bias · time (0.08 m/s²: 24 m/s in five
#: minutes). Tuned with the ground truth of simulated drives, which is an advantage of this estimator.
LEAK_S = 0.7
#: Fields that ``kinematic`` uses from a sensor profile; the wheel-slip gate has the default noise.
_PROFILE = ("speed_hold_s", "speed_zero_m_s", "speed_least_m_s")
#: Time step of the derivative of a_y along the motion of ``open-loop``.
AY_RATE_STEP_S = 0.001


@dataclass(frozen=True, slots=True, eq=False)
class StepState:
    """State of a baseline between windows, including its state vector."""

    state: FloatArray
    slip: FloatArray | None = None


def prepared_steps(
    signals: Signals, before: StepState | None, state_size: int, slip_sensors: Sensors | None = None
) -> tuple[Signals, FloatArray, Steps, StepState]:
    """Return the usable signals of a window, the time ``dt`` [K] before each step, empty steps, and a state to advance.

    The state vector starts as NaN; ``dt[0]`` is NaN at the start of a log. With ``slip_sensors`` the speed of
    slipping wheels is replaced by the dead-reckoned speed.
    """
    count, slip = len(signals), None
    state = np.full(state_size, np.nan) if before is None else before.state.copy()
    if slip_sensors is None:
        signals = without_impossible(signals)
    else:
        signals, slip = believable(signals, slip_sensors, before.slip if before else None, reckoned=True)
    steps = Steps(np.full((count, 4), np.nan), np.zeros((count, 4)), np.zeros(count, dtype=np.bool_))
    return signals, signals.steps_s, steps, StepState(state, slip)


def measured_speed(signals: Signals, hold_s: float, before: StepState | None) -> tuple[FloatArray, StepState]:
    """Return the measured speed at each stamp, [K], integrated by a_x between samples (:func:`advance_speed`)."""
    signals, dt, steps, after = prepared_steps(signals, before, 2)
    _advance_speeds(dt, signals.ax_m_s2, signals.speed_m_s, hold_s, after.state, steps.values)
    return steps.values[:, VX], after


@njit(cache=True)
def _advance_speeds(dt, ax, speed, hold_s, state, values):  # type: ignore[no-untyped-def]
    for k in range(dt.shape[0]):
        advance_speed(state, dt[k], ax[k], speed[k], hold_s)
        values[k, VX] = state[0]


@njit(cache=True)
def advance_speed(state, dt, ax, speed, hold_s):  # type: ignore[no-untyped-def]
    """Advance [v_x, age of the last speed sample] by one step in place; v_x is NaN without a recent sample.

    Between samples v_x is integrated by a_x (0 if missing), for at most ``hold_s``.
    """
    if math.isfinite(speed):
        state[0] = speed
        state[1] = 0.0
    elif dt <= hold_s and state[1] + dt <= hold_s:
        state[0] += (ax if math.isfinite(ax) else 0.0) * dt
        state[1] += dt
    else:
        state[0] = math.nan
        state[1] = 0.0


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


def build_pass_through(name: str, car: Car, options: Options) -> PassThrough:
    """Return ``zero`` or its variant ``no-lateral``."""
    del options
    return PassThrough(name, "no-lateral" not in options_of(name), car.datasheet.sensors.speed_hold_s)


@njit(cache=True)
def _kinematic(window, leak_s, hold_s, zero, state, values, rates, valid):  # type: ignore[no-untyped-def]
    dt, ax, ay, yaw_rate, speed = window
    # state: v_x, age of the speed sample, v_y, v̇_y of the previous step
    for k in range(dt.shape[0]):
        advance_speed(state, dt[k], ax[k], speed[k], hold_s)
        is_complete = math.isfinite(state[0]) and math.isfinite(yaw_rate[k]) and math.isfinite(ay[k])
        if not dt[k] <= RESTART_GAP_S or not math.isfinite(state[2]) or abs(state[0]) < zero:
            state[2] = 0.0
            state[3] = 0.0
        else:
            state[2] += state[3] * dt[k]
        vy_dot = ay[k] - state[0] * yaw_rate[k] - state[2] / leak_s if is_complete else 0.0
        state[3] = vy_dot
        values[k, VX] = state[0]
        values[k, VY] = state[2]
        values[k, YAW_RATE] = yaw_rate[k]
        values[k, AY] = ay[k]
        rates[k, VY] = vy_dot
        valid[k] = is_complete


@dataclass(frozen=True, slots=True)
class Kinematic:
    """Lateral velocity by integrating v̇_y = a_y − v_x r, with a leak against drift; it needs no vehicle parameters."""

    algorithm = "kinematic"
    version = 1
    options = ("leak_s", *_PROFILE)

    leak_s: float = LEAK_S
    speed_hold_s: float = Sensors().speed_hold_s
    speed_zero_m_s: float = Sensors().speed_zero_m_s
    speed_least_m_s: float = Sensors().speed_least_m_s
    name: str = "kinematic"
    causal: bool = True

    def run(self, signals: Signals, state: StepState | None) -> tuple[Steps, StepState]:
        """Process one window (see :class:`~.base.Estimator`)."""
        profile = Sensors(**{name: getattr(self, name) for name in _PROFILE})
        s, dt, steps, after = prepared_steps(signals, state, 4, profile)
        window = (dt, s.ax_m_s2, s.ay_m_s2, s.yaw_rate_rad_s, s.speed_m_s)
        limits = self.leak_s, self.speed_hold_s, self.speed_zero_m_s
        _kinematic(window, *limits, after.state, steps.values, steps.rates, steps.valid)
        return steps, after


def build_kinematic(name: str, car: Car, options: Options) -> Kinematic:
    """Return ``kinematic`` with the sensors of a car."""
    del name, options
    return Kinematic(**{name: getattr(car.datasheet.sensors, name) for name in _PROFILE})


@njit(cache=True)
def _open_loop(inputs, hold_s, default_friction, p, state, values, rates, valid):  # type: ignore[no-untyped-def]
    dt, steer, ax, speed, friction = inputs
    # state: v_x, age of the speed sample, v_y, r, steering and friction of the previous step
    for k in range(dt.shape[0]):
        before = state[0]
        advance_speed(state, dt[k], ax[k], speed[k], hold_s)
        mu = friction[k] if math.isfinite(friction[k]) else default_friction
        ok = math.isfinite(state[0]) and math.isfinite(steer[k])
        if ok and dt[k] <= RESTART_GAP_S and math.isfinite(before + state[2] + state[4]):
            n = nominal_model.substeps(before, dt[k], state[5], p)
            _, state[2], state[3] = nominal_model.rk4_step(
                before, state[2], state[3], state[4], 0.0, state[5], dt[k], n, p
            )
        elif ok:
            state[3] = state[0] * math.tan(steer[k]) / (p.front_m + p.rear_m)
            state[2] = p.rear_m * state[3]
        ok = ok and math.isfinite(state[2]) and math.isfinite(state[3])
        if not ok:
            state[2] = math.nan  # steering missing, or vehicle too light for its tyres: restart
        state[4] = steer[k]
        state[5] = mu
        valid[k] = ok
        if ok:
            _, vy_dot, r_dot = nominal_model.state_derivative(state[0], state[2], state[3], steer[k], 0.0, mu, p)
            ay = nominal_model.planar_lateral_acceleration(state[0], state[2], state[3], steer[k], mu, p)
            h = AY_RATE_STEP_S
            soon = nominal_model.planar_lateral_acceleration(
                state[0], state[2] + h * vy_dot, state[3] + h * r_dot, steer[k], mu, p
            )
            values[k, VX] = state[0]
            values[k, VY] = state[2]
            values[k, YAW_RATE] = state[3]
            values[k, AY] = ay
            rates[k, VY] = vy_dot
            rates[k, YAW_RATE] = r_dot
            rates[k, AY] = (soon - ay) / h


@dataclass(frozen=True, slots=True)
class OpenLoop:
    """The nominal model with steering and measured speed as inputs, without correction by other sensors."""

    algorithm = "open-loop"
    version = 1

    vehicle: VehicleParameters
    name: str = "open-loop"
    causal: bool = True

    def run(self, signals: Signals, state: StepState | None) -> tuple[Steps, StepState]:
        """Process one window (see :class:`~.base.Estimator`)."""
        p, mu, sensors = (
            nominal_model.model_parameters(self.vehicle),
            self.vehicle.assumed_friction,
            self.vehicle.sensors,
        )
        s, dt, steps, after = prepared_steps(signals, state, 6, sensors)
        inputs = (dt, s.steer_rad, s.ax_m_s2, s.speed_m_s, s.friction)
        _open_loop(inputs, sensors.speed_hold_s, mu, p, after.state, steps.values, steps.rates, steps.valid)
        return steps, after


def build_open_loop(name: str, car: Car, options: Options) -> OpenLoop:
    """Return ``open-loop`` of a car."""
    del options
    return OpenLoop(car.vehicle, name=name)
