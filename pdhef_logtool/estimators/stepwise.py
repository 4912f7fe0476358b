"""Inputs and outputs shared by the simple baselines, and the measured speed between its samples."""

import math
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.car.vehicle import Sensors
from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.estimators.base import QUANTITIES, VX, Steps
from pdhef_logtool.estimators.speed_slip import believable
from pdhef_logtool.records.readings import without_impossible
from pdhef_logtool.records.signals import FloatArray, Signals


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
    shape = count, len(QUANTITIES)
    steps = Steps(np.full(shape, np.nan), np.zeros(shape), np.zeros(count, dtype=np.bool_))
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
