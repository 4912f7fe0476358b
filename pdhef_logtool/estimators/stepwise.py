"""Shared by the simple baselines: measured speed between its samples, and release of steps at the scored stamps."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.records.compiled import njit
from pdhef_logtool.records.release import StepColumns, last_stamp_ns, predictable, step_durations_s
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray, Signals
from pdhef_logtool.records.tracks import StateTrack, make_track
from pdhef_logtool.watches.speed_slip import ASSUMED_STD_M_S, SlipCarry, believable

#: A speed sample is carried on by a_x for this long.
SPEED_HOLD_S = 0.5

# Entries of a step's values and of their time derivatives.
VX, VY, YAW_RATE, AY = 0, 1, 2, 3


@dataclass(frozen=True, slots=True, eq=False)
class Steps(StepColumns):
    """Estimates on measurement time: values and rates [K, 4] over [v_x, v_y, r, a_y]; NaN is allowed."""

    stamps_ns: IntArray
    ready_ns: IntArray
    values: FloatArray
    rates: FloatArray
    valid: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class StepCarry:
    """Memory of a baseline between windows: its own state vector and the steps that outputs still need."""

    state: FloatArray
    last_stamp_ns: int | None
    steps: Steps
    slip: SlipCarry | None = None


#: (dt [K], signals, state, values [K, 4], rates [K, 4], valid [K]) -> None; writes the last four in place.
StepFunction = Callable[[FloatArray, Signals, FloatArray, FloatArray, FloatArray, BoolArray], None]


def run_stepwise(
    name: str,
    signals: Signals,
    carry: StepCarry | None,
    state_size: int,
    step: StepFunction,
    *,
    slip_gate: bool = False,
    speed_std_m_s: float = ASSUMED_STD_M_S,
) -> tuple[StateTrack, StepCarry]:
    """Run ``step`` over a window and extrapolate the newest arrived step to each scored stamp, to first order.

    ``state`` starts as NaN; ``dt[0]`` is NaN at the start of a log. With ``slip_gate`` the dead-reckoned speed stands
    in place of that of slipping wheels.
    """
    signals, slip = believable(signals, speed_std_m_s, carry.slip if carry else None, gate=slip_gate, reckoned=True)
    count = len(signals)
    state = np.full(state_size, np.nan) if carry is None else carry.state.copy()
    before_ns = carry.last_stamp_ns if carry else None
    dt = step_durations_s(signals.stamps_ns, before_ns)
    values = np.full((count, 4), np.nan)
    rates = np.zeros((count, 4))
    valid = np.zeros(count, dtype=np.bool_)
    step(dt, signals, state, values, rates, valid)
    steps = Steps(signals.stamps_ns, signals.ready_ns, values, rates, valid)
    if carry is not None:
        steps = carry.steps.joined(steps)
    released, horizon_s, usable = predictable(steps.stamps_ns, steps.ready_ns, steps.valid, signals.stamps_ns)
    out = steps.values[released.at] + steps.rates[released.at] * horizon_s[:, None]
    out[~usable] = np.nan
    track = make_track(
        name,
        signals.stamps_ns,
        vx_m_s=out[:, VX].copy(),
        vy_m_s=out[:, VY].copy(),
        yaw_rate_rad_s=out[:, YAW_RATE].copy(),
        ay_m_s2=out[:, AY].copy(),
        valid=usable,
    )
    last = last_stamp_ns(signals.stamps_ns, before_ns)
    return track, StepCarry(state, last, steps.since(released.needed), slip)


@njit(cache=True)
def advance_speed(state, dt, ax, speed):  # type: ignore[no-untyped-def]
    """Advance [v_x, age of the last speed sample] by one step in place; v_x is NaN where no sample is near.

    Between samples v_x follows a_x (0 where it is missing), at most ``SPEED_HOLD_S``.
    """
    if math.isfinite(speed):
        state[0] = speed
        state[1] = 0.0
    elif dt <= SPEED_HOLD_S and state[1] + dt <= SPEED_HOLD_S:
        state[0] += (ax if math.isfinite(ax) else 0.0) * dt
        state[1] += dt
    else:
        state[0] = math.nan
        state[1] = 0.0
