"""Base of the unscented filters: everything at a step that does not depend on state and model.

These functions reset after a time gap, keep missing inputs, start the filter, gate samples, stop it at rest, detect
divergence and make the track of predicted steps. The first entries of every state are [v_x, v_y, r, b_ax]; a filter may
append others, and :class:`Tuning` has noise, initial and standstill 1-sigma of each. A filter's own file moves sigma
points and predicts measurements. The loop of its kernel is

    begin_step; starts, or: move the points; predict measurements, ``innovate``, ``gate``; update; ``settle``;
    ``finish_step``

with the model between the calls, because functions that are passed to compiled functions cannot be cached.

The inputs over a step are the mean of those at its two ends, which are both known when the step is computed. The
residual targets use the same rule.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.estimators.speed_slip import SlipState, believable
from pdhef_logtool.estimators.unscented import unscented_weights
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray, Signals
from pdhef_logtool.records.steps import (
    RESTART_GAP_S,
    Extrapolation,
    StepColumns,
    last_stamp_ns,
    step_durations_s,
)
from pdhef_logtool.records.tracks import StateTrack, make_track

# State entries and measurement entries, by name.
VX, VY, YAW_RATE, AX_BIAS = 0, 1, 2, 3
STATES = 4
Z_AY, Z_YAW_RATE, Z_SPEED = 0, 1, 2
MEASUREMENTS = 3
MOTION = 3  # entries of the state that an output has a covariance of
# Inputs of a step; a_x is 0 where U_AX_KNOWN is 0. U_SPEED is the last speed sample that was accepted, 0 before any.
U_STEER, U_AX, U_FRICTION, U_AX_KNOWN, U_SPEED, U_STEER_KNOWN = range(6)
INPUTS = 6

#: Speed process noise where the log has no longitudinal accelerometer: the speed is then a random walk
#: (docs/method.md#frame).
NO_AX_Q_STD = 3.0
INITIAL_STD = (0.5, 0.5, 0.1, 0.3)
#: A sample further from its prediction than this many standard deviations is not used ...
GATE_SIGMA = 6.0
#: ... unless it has been so for this long: then the filter is wrong, not the sensor (docs/method.md#gate).
GATE_OPENS_AFTER_S = 0.2
GATE_INFLATION = 10.0
STANDSTILL_AFTER_S = 0.3
#: A standstill is not accepted for longer than this without a speed sample that states so.
STANDSTILL_SILENCE_S = 1.5
#: Of the first four entries; NaN is an entry that a standstill leaves as it is.
STANDSTILL_STD = (0.02, 0.01, 0.002, math.nan)
#: Divergence: the filter's own normalised squared innovations stay this far above 1, averaged over the time.
DIVERGED_NIS_RATIO = 25.0
#: Samples that the gate rejects count as well, or a gated filter could never notice; each up to this square.
DIVERGED_NIS_CAP = 4.0 * GATE_SIGMA**2
DIVERGED_AVERAGE_S = 1.0
DIVERGED_SIDESLIP_RAD = math.radians(60.0)
#: If the speed sensor last read more than this, the car does not roll backwards: a v_x below zero is divergence.
FORWARD_M_S = 0.5

# Entries of the scalar memory of a filter.
M_INITIALISED, M_STEER, M_AX, M_AX_KNOWN, M_FRICTION, M_STEER_AGE, M_STILL, M_SPEED_AGE, M_NIS = range(9)
M_RATE_VY, M_RATE_R = 9, 10  # residual of the step before
M_REJECTED = 11  # and the two after it, one a measurement: time since the first sample of an unbroken rejection
M_SPEED = 14  # last speed sample
M_GRIP = 15  # largest recent share of the grip that is used, decaying (``physics`` only)
M_STEER_ROW = 16  # and those behind it: covariance of an unknown steering angle with the state (``physics`` only)
MEMORY = 32
#: Value of M_REJECTED at the first rejected sample; 0 is "the last sample was accepted".
JUST_REJECTED_S = 1e-9


class Window(NamedTuple):
    """Samples of a window, [K], NaN where missing. ``dt_s`` is the duration before each step, NaN at the start.

    ``residual_rate`` [K, 2] is added to v̇_y and ṙ from the step on, m/s² and rad/s²; ``extra_r`` [K, 2] the
    variance that a_y (m²/s⁴) and yaw rate (rad²/s²) have beyond R.
    """

    dt_s: FloatArray
    steer: FloatArray
    ax: FloatArray
    ay: FloatArray
    yaw_rate: FloatArray
    speed: FloatArray
    friction: FloatArray
    residual_rate: FloatArray
    extra_r: FloatArray


class Rules(NamedTuple):
    """Settings of the filter base, beside its constants."""

    use_speed: bool  # False: the speed sensor only starts the filter
    still_after_s: float
    default_friction: float
    dynamic_speed_m_s: float  # above it a sideslip beyond DIVERGED_SIDESLIP_RAD is divergence
    steer_hold_s: float
    needs_steer: bool  # False: without steering for ``steer_hold_s`` the filter estimates it
    still_speed_m_s: float
    still_yaw_rate_rad_s: float


class Tuning(NamedTuple):
    """Noise by entry of the state [n] and of the measurement [3], weights of the sigma points, and the rules.

    ``q_std`` is a random walk's 1-sigma per √s; ``standstill_std`` is NaN for entries that a standstill leaves alone.
    """

    q_std: FloatArray
    r_std: FloatArray
    initial_std: FloatArray
    standstill_std: FloatArray
    wm: FloatArray
    wc: FloatArray
    scale: float
    rules: Rules


class StateEstimate(NamedTuple):
    """State [n], covariance [n, n] and scalar memory [MEMORY] of a filter, moved in place."""

    x: FloatArray
    P: FloatArray
    memory: FloatArray


class Posterior(NamedTuple):
    """Output arrays of a kernel, one row per step (see :class:`PosteriorSteps`)."""

    x: FloatArray
    P: FloatArray
    inputs: FloatArray
    nis: FloatArray
    nis_dof: FloatArray
    log_likelihood: FloatArray
    innovation: FloatArray
    valid: BoolArray
    diverged: BoolArray
    prior: FloatArray


class Work(NamedTuple):
    """Work space of a step: sigma points, their measurements, innovation, and which samples are used."""

    chi: FloatArray
    L: FloatArray
    zeta: FloatArray
    z_hat: FloatArray
    S: FloatArray
    Pxz: FloatArray
    nu: FloatArray
    at_gate: FloatArray
    given: BoolArray
    use: BoolArray


class Sample(NamedTuple):
    """Samples of one step, as the columns of :class:`Window`."""

    dt: float
    steer: float
    ax: float
    ay: float
    yaw_rate: float
    speed: float
    friction: float


class StepInputs(NamedTuple):
    """Inputs at step k, held if missing, and its measurements.

    ``steers`` states that the filter may start with the steering, ``steer_ok`` that it may go on with it.
    """

    dt: float
    steer: float
    ax: float
    has_ax: bool
    friction: float
    steers: bool
    steer_ok: bool
    ay: float
    yaw_rate: float
    speed: float


class HeldInputs(NamedTuple):
    """Held inputs over a step: the mean of its two ends."""

    steer: float
    ax: float
    ax_known: bool
    friction: float


class GateResult(NamedTuple):
    """Result of the gate: whether it opens, whether a sample is outside, number of samples, sum of squares."""

    opens: bool
    outside: bool
    seen: int
    squares: float


class PredictionStart(NamedTuple):
    """Steps from which predictions start (see :class:`PosteriorSteps`)."""

    x: FloatArray
    P: FloatArray
    inputs: FloatArray
    residual_rate: FloatArray


class PendingPredictions(NamedTuple):
    """Pending predictions, [M]: step (−1 for none) and horizon in s."""

    step: IntArray
    horizon_s: FloatArray


class Predicted(NamedTuple):
    """Predictions: state [M, n], covariance of the motion [M, 3, 3], planar a_y [M]; NaN for none."""

    x: FloatArray
    P: FloatArray
    ay: FloatArray


# A kernel unpacks structures of arrays before its loop: to hand them on at every step would cost as much as the step.


@njit(cache=True)
def make_work(n):  # type: ignore[no-untyped-def]
    """Return the work space of a filter of ``n`` states."""
    return Work(
        np.empty((2 * n + 1, n)),
        np.empty((n, n)),
        np.empty((2 * n + 1, MEASUREMENTS)),
        np.empty(MEASUREMENTS),
        np.empty((MEASUREMENTS, MEASUREMENTS)),
        np.empty((n, MEASUREMENTS)),
        np.empty(MEASUREMENTS),
        np.empty(MEASUREMENTS),
        np.empty(MEASUREMENTS, dtype=np.bool_),
        np.empty(MEASUREMENTS, dtype=np.bool_),
    )


@njit(cache=True)
def all_finite(x, P):  # type: ignore[no-untyped-def]
    """Return whether state [n] and covariance [n, n] are numbers."""
    for i in range(x.shape[0]):
        if not math.isfinite(x[i]):
            return False
        for j in range(x.shape[0]):
            if not math.isfinite(P[i, j]):
                return False
    return True


@njit(cache=True)
def begin_step(sample, rules, memory):  # type: ignore[no-untyped-def]
    """Reset after a time gap and zero-order-hold missing inputs. Return the inputs of this step."""
    restart = not sample.dt <= RESTART_GAP_S
    if restart:
        memory[:] = 0.0
    steers = math.isfinite(sample.steer)
    steer = sample.steer if steers else memory[M_STEER]
    if steers:
        memory[M_STEER_AGE] = 0.0
    else:
        memory[M_STEER_AGE] += 0.0 if restart else sample.dt
    steer_ok = steers or (memory[M_INITIALISED] > 0.0 and memory[M_STEER_AGE] <= rules.steer_hold_s)
    if not rules.needs_steer:
        lateral = math.isfinite(sample.yaw_rate) or math.isfinite(sample.ay)
        steers = steers or (memory[M_STEER_AGE] > rules.steer_hold_s and lateral)
        steer_ok = True
    has_ax = math.isfinite(sample.ax)
    friction = sample.friction
    if not math.isfinite(friction):
        friction = memory[M_FRICTION] if memory[M_FRICTION] > 0.0 else rules.default_friction
    speed = sample.speed if rules.use_speed or memory[M_INITIALISED] == 0.0 else math.nan
    if math.isfinite(speed):
        memory[M_SPEED] = speed
    ax = sample.ax if has_ax else 0.0
    return StepInputs(sample.dt, steer, ax, has_ax, friction, steers, steer_ok, sample.ay, sample.yaw_rate, speed)


@njit(cache=True)
def held_over_step(now, memory):  # type: ignore[no-untyped-def]
    """Return the mean of the inputs at both ends of a step; if a_x is missing at one end, the other end counts."""
    ax = now.ax
    if not now.has_ax:
        ax = memory[M_AX]
    elif memory[M_AX_KNOWN] > 0.0:
        ax = 0.5 * (memory[M_AX] + now.ax)
    return HeldInputs(
        0.5 * (memory[M_STEER] + now.steer),
        ax,
        now.has_ax or memory[M_AX_KNOWN] > 0.0,
        0.5 * (memory[M_FRICTION] + now.friction),
    )


@njit(cache=True)
def held_inputs(inputs, k):  # type: ignore[no-untyped-def]
    """Return the inputs of step k, held during a prediction."""
    return HeldInputs(inputs[k, U_STEER], inputs[k, U_AX], inputs[k, U_AX_KNOWN] > 0.0, inputs[k, U_FRICTION])


@njit(cache=True)
def starts(now, rear_m, initial_std, x, P, memory):  # type: ignore[no-untyped-def]
    """Start with the first sample of speed and steering; return whether this is it.

    The rear axle rolls without slip, all other entries are 0.
    """
    if not (math.isfinite(now.speed) and now.steers):
        return False
    r = now.yaw_rate if math.isfinite(now.yaw_rate) else 0.0
    x[:] = 0.0
    x[VX] = now.speed
    x[VY] = rear_m * r
    x[YAW_RATE] = r
    P[:, :] = 0.0
    for i in range(x.shape[0]):
        P[i, i] = initial_std[i] ** 2
    memory[M_INITIALISED] = 1.0
    return True


@njit(cache=True)
def add_process_noise(P, q_std, ax_known, dt):  # type: ignore[no-untyped-def]
    """Add the variance of random walks of ``q_std`` [n] over ``dt`` s; without a_x the speed is a random walk too."""
    for i in range(P.shape[0]):
        q = q_std[i] if i != VX or ax_known else NO_AX_Q_STD
        P[i, i] += q * q * dt


@njit(cache=True)
def innovate(k, now, r_std, extra_r, z_hat, S, nu):  # type: ignore[no-untyped-def]
    """Add R, with ``extra_r`` [K, 2] of a_y and yaw rate, to S [3, 3], and write the innovation [3]."""
    for i in range(MEASUREMENTS):
        S[i, i] += r_std[i] * r_std[i] + (extra_r[k, i] if i < Z_SPEED else 0.0)
    nu[Z_AY] = now.ay - z_hat[Z_AY]
    nu[Z_YAW_RATE] = now.yaw_rate - z_hat[Z_YAW_RATE]
    nu[Z_SPEED] = now.speed - z_hat[Z_SPEED]


@njit(cache=True)
def gate(now, memory, nu, S, at_gate, given, use):  # type: ignore[no-untyped-def]
    """Decide which samples are used; those that are out of the gate for too long open it (docs/method.md#gate).

    Writes which samples there are (``given``), which are used, and the innovation with those beyond it at the gate.
    """
    opens = False
    outside = False
    seen = 0
    squares = 0.0
    for i in range(MEASUREMENTS):
        given[i] = math.isfinite(nu[i]) and (i != Z_AY or now.steer_ok)
        use[i] = given[i]
        at_gate[i] = nu[i]
        if memory[M_REJECTED + i] > 0.0:
            memory[M_REJECTED + i] += now.dt
        if given[i]:
            square = nu[i] * nu[i] / S[i, i]
            seen += 1
            squares += min(square, DIVERGED_NIS_CAP)
            if square <= GATE_SIGMA**2:
                memory[M_REJECTED + i] = 0.0
            else:
                outside = True
                at_gate[i] = math.copysign(GATE_SIGMA * math.sqrt(S[i, i]), nu[i])
                memory[M_REJECTED + i] = max(memory[M_REJECTED + i], JUST_REJECTED_S)
                use[i] = memory[M_REJECTED + i] > GATE_OPENS_AFTER_S
                opens = opens or use[i]
    return GateResult(opens, outside, seen, squares)


@njit(cache=True)
def open_gate(use, memory):  # type: ignore[no-untyped-def]
    """Forget that the samples which are used after all were rejected."""
    for i in range(MEASUREMENTS):
        if use[i]:
            memory[M_REJECTED + i] = 0.0


@njit(cache=True)
def settle(now, gated, rules, standstill_std, x, P, memory):  # type: ignore[no-untyped-def]
    """Average the normalised squared innovations, and contain the motion at a standstill."""
    if gated.seen > 0:
        share = min(1.0, now.dt / DIVERGED_AVERAGE_S)
        memory[M_NIS] += share * (gated.squares / gated.seen - memory[M_NIS])
    # Standstill: for a while the speed sensor reads zero and the car does not turn.
    turns = abs(now.yaw_rate) > rules.still_yaw_rate_rad_s
    if math.isfinite(now.speed):
        memory[M_SPEED_AGE] = 0.0
        still = abs(now.speed) < rules.still_speed_m_s and not turns
        memory[M_STILL] = memory[M_STILL] + now.dt if still else 0.0
    elif memory[M_STILL] > 0.0:
        memory[M_SPEED_AGE] += now.dt
        still = memory[M_SPEED_AGE] <= STANDSTILL_SILENCE_S and not turns
        memory[M_STILL] = memory[M_STILL] + now.dt if still else 0.0
    if memory[M_STILL] < rules.still_after_s:
        return
    for i in range(x.shape[0]):
        if math.isfinite(standstill_std[i]):
            x[i] = 0.0
            for j in range(x.shape[0]):
                P[i, j] = 0.0
                P[j, i] = 0.0
            P[i, i] = standstill_std[i] ** 2


@njit(cache=True)
def diverges(rules, x, memory):  # type: ignore[no-untyped-def]
    """Return whether innovations stay far beyond their covariance, or the sideslip is impossible."""
    return memory[M_NIS] > DIVERGED_NIS_RATIO or (
        x[VX] > rules.dynamic_speed_m_s and abs(math.atan2(x[VY], x[VX])) > DIVERGED_SIDESLIP_RAD
    )


@njit(cache=True)
def remember(k, now, residual_rate, memory):  # type: ignore[no-untyped-def]
    """Keep inputs and residual of step k for the next one."""
    memory[M_STEER] = now.steer
    memory[M_AX] = now.ax
    memory[M_AX_KNOWN] = 1.0 if now.has_ax else 0.0
    memory[M_FRICTION] = now.friction
    memory[M_RATE_VY] = residual_rate[k, 0]
    memory[M_RATE_R] = residual_rate[k, 1]


@njit(cache=True)
def finish_step(k, now, residual_rate, rules, memory, inputs):  # type: ignore[no-untyped-def]
    """Keep inputs and residual of step k for the next one, and write its row of the inputs [K, 6]."""
    remember(k, now, residual_rate, memory)
    inputs[k, U_STEER] = now.steer
    inputs[k, U_AX] = now.ax
    inputs[k, U_FRICTION] = now.friction
    inputs[k, U_AX_KNOWN] = memory[M_AX_KNOWN]
    inputs[k, U_SPEED] = memory[M_SPEED] if rules.use_speed else 0.0
    inputs[k, U_STEER_KNOWN] = 1.0 if memory[M_STEER_AGE] <= rules.steer_hold_s else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class PosteriorSteps(StepColumns):
    """Filter posteriors on measurement time: [K] each, state [K, n], covariance [K, n, n], inputs [K, 6].

    ``prior`` [K, n] is the state before the update, NaN where the filter starts. ``residual_rate``
    [K, 2] is added to v̇_y and ṙ from the step on; 0 in the pure physics filter.
    """

    stamps_ns: IntArray
    x: FloatArray
    P: FloatArray
    inputs: FloatArray
    nis: FloatArray
    nis_dof: FloatArray
    log_likelihood: FloatArray
    innovation: FloatArray
    valid: BoolArray
    diverged: BoolArray
    prior: FloatArray
    residual_rate: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class FilterState:
    """Filter state between windows."""

    estimate: StateEstimate
    last_stamp_ns: int | None
    slip: SlipState | None


#: How a step hangs together with the one before it: not at all (start, failure), through the whole state, or through
#: entries that a standstill does not overwrite (from AX_BIAS on).
LINK_NONE, LINK_WHOLE, LINK_BIASES = 0, 1, 2


@dataclass(frozen=True, slots=True, eq=False)
class StepLinks(StepColumns):
    """Further inputs of a smoother, one row per step; length 0 if not requested.

    ``kind`` [K] is one of LINK_NONE, LINK_WHOLE, LINK_BIASES; ``predicted_P`` [K, n, n] the covariance before the
    update, with the inflation by an opened gate; ``cross`` [K, n, n] the covariance between the state of the step
    before (rows) and the predicted state (columns), from the sigma points before Q is added and they are drawn again.
    """

    kind: IntArray
    predicted_P: FloatArray
    cross: FloatArray


class LinkColumns(NamedTuple):
    """The columns of :class:`StepLinks`, for the kernel to write."""

    kind: IntArray
    predicted_P: FloatArray
    cross: FloatArray


def make_window(
    signals: Signals,
    state: FilterState | None,
    residual_rate: FloatArray | None = None,
    extra_r: FloatArray | None = None,
) -> Window:
    """Return the window that a kernel reads; without ``residual_rate`` or ``extra_r`` they are 0."""
    nothing = np.zeros((len(signals), 2))
    return Window(
        step_durations_s(signals.stamps_ns, state.last_stamp_ns if state else None),
        signals.steer_rad,
        signals.ax_m_s2,
        signals.ay_m_s2,
        signals.yaw_rate_rad_s,
        signals.speed_m_s,
        signals.friction,
        nothing if residual_rate is None else residual_rate,
        nothing if extra_r is None else extra_r,
    )


def make_tuning(
    vehicle: VehicleParameters,
    q_std: Sequence[float],
    r_std: FloatArray,
    initial_std: Sequence[float],
    standstill_std: Sequence[float] = STANDSTILL_STD,
    *,
    use_speed: bool,
    standstill: bool = True,
    needs_steer: bool = True,
) -> Tuning:
    """Return the tuning of a filter of as many states as ``initial_std`` has entries; the rest of ``q_std`` is 0."""
    n = len(initial_std)
    wm, wc, scale = unscented_weights(n)
    return Tuning(
        np.array([*q_std, *[0.0] * (n - len(q_std))]),
        r_std,
        np.array(initial_std),
        np.array([*standstill_std, *[math.nan] * (n - len(standstill_std))]),
        wm,
        wc,
        float(scale[0]),
        Rules(
            use_speed,
            STANDSTILL_AFTER_S if standstill else math.inf,
            vehicle.assumed_friction,
            vehicle.low_speed_blend_m_s,
            vehicle.sensors.steer_hold_s,
            needs_steer,
            vehicle.sensors.speed_zero_m_s,
            vehicle.sensors.still_yaw_rate_rad_s,
        ),
    )


def resume(state: FilterState | None, n: int, memory_size: int = MEMORY) -> StateEstimate:
    """Return a copy of the state before a window, which the kernel updates in place."""
    if state is None:
        return StateEstimate(np.zeros(n), np.eye(n), np.zeros(memory_size))
    return StateEstimate(*(part.copy() for part in state.estimate))


def no_posterior(count: int, n: int) -> Posterior:
    """Return the arrays that a kernel writes ``count`` steps of ``n`` states to, with no estimate in them."""
    return Posterior(
        x=np.empty((count, n)),
        P=np.empty((count, n, n)),
        inputs=np.empty((count, INPUTS)),
        nis=np.full(count, np.nan),
        nis_dof=np.zeros(count),
        log_likelihood=np.zeros(count),
        innovation=np.full((count, MEASUREMENTS), np.nan),
        valid=np.zeros(count, dtype=np.bool_),
        diverged=np.zeros(count, dtype=np.bool_),
        prior=np.full((count, n), np.nan),
    )


def no_prediction(count: int, n: int) -> Predicted:
    """Return empty arrays for predictions of ``n`` states."""
    return Predicted(*(np.full((count, *shape), np.nan) for shape in ((n,), (MOTION, MOTION), ())))


def next_state(
    estimate: StateEstimate, stamps_ns: IntArray, state: FilterState | None, slip: SlipState | None
) -> FilterState:
    """Return the state after a window with these stamps."""
    return FilterState(estimate, last_stamp_ns(stamps_ns, state.last_stamp_ns if state else None), slip)


def pending_predictions(ahead: Extrapolation) -> PendingPredictions:
    """Return the pending predictions as a kernel reads them."""
    return PendingPredictions(np.where(ahead.usable, ahead.step, -1), ahead.horizon_s)


def predicted_track(
    name: str,
    stamps_ns: IntArray,
    steps: PosteriorSteps,
    ahead: Extrapolation,
    predicted: Predicted,
    named: Mapping[str, int] = MappingProxyType({}),
) -> StateTrack:
    """Return the track of predicted states at the scored stamps [M].

    ``named`` gives the entries of the state that have a column in the track.
    """
    step, x, covariance = ahead.step, predicted.x, predicted.P
    usable = ahead.usable & np.isfinite(x[:, VX]) & rolls_forward(x[:, VX], steps.inputs[step, U_SPEED])
    return make_track(
        name,
        stamps_ns,
        vx_m_s=x[:, VX].copy(),
        vy_m_s=x[:, VY].copy(),
        yaw_rate_rad_s=x[:, YAW_RATE].copy(),
        ay_m_s2=predicted.ay,
        covariance=covariance,
        sideslip_std_rad=sideslip_std(x[:, VX], x[:, VY], covariance),
        r_scale=np.ones(len(stamps_ns)),
        nis=np.where(usable, steps.nis[step], np.nan),
        nis_dof=np.where(usable, steps.nis_dof[step], 0.0),
        friction=np.where(usable, steps.inputs[step, U_FRICTION], np.nan),
        valid=usable,
        diverged=usable & steps.diverged[step],
        **{column: np.where(usable, x[:, i], np.nan) for column, i in named.items()},
    )


def rolls_forward(vx_m_s: FloatArray, last_speed_m_s: FloatArray) -> BoolArray:
    """Return where v_x [N] does not contradict the last speed sample: the sideslip would be at 180 degrees there."""
    against: BoolArray = (vx_m_s < 0.0) & (last_speed_m_s > FORWARD_M_S)
    return ~against


def sideslip_std(vx_m_s: FloatArray, vy_m_s: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the 1-sigma of β = atan2(v_y, v_x) in rad, [N], to first order from the covariance [N, ≥2, ≥2]."""
    v2 = np.maximum(vx_m_s**2 + vy_m_s**2, 1e-6)
    gx, gy = -vy_m_s / v2, vx_m_s / v2
    variance = gx**2 * covariance[:, VX, VX] + gy**2 * covariance[:, VY, VY] + 2.0 * gx * gy * covariance[:, VX, VY]
    return np.sqrt(np.maximum(variance, 0.0))


class LinkedFilter:
    """Interface of a filter with kernels that read :class:`Window` and write :class:`Posterior` and :class:`StepLinks`.

    A filter is a dataclass with the fields below. It adds its noise and its two kernels.
    """

    __slots__ = ()

    name: str
    vehicle: VehicleParameters
    r_std: tuple[float, float, float] | None
    slip_gate: bool

    @property
    def measurement_std(self) -> FloatArray:
        """1-sigma of [a_y, r, v_x], [3]."""
        return np.array(self.r_std or self.vehicle.sensors.measurement_std)

    @property
    def _tuning(self) -> Tuning:
        raise NotImplementedError

    @property
    def _columns(self) -> Mapping[str, int]:
        """Entries of the state that have a column in the track, beside the motion."""
        return {}

    def _run_kernel(
        self, window: Window, tuning: Tuning, estimate: StateEstimate, out: Posterior, links: LinkColumns
    ) -> None:
        raise NotImplementedError

    def _predict_kernel(self, pending: PendingPredictions, start: PredictionStart, predicted: Predicted) -> None:
        raise NotImplementedError

    def corrected(self, signals: Signals) -> Signals:
        """Return signals as the filter's vehicle corrects them."""
        return signals

    def run(
        self,
        signals: Signals,
        state: FilterState | None,
        residual_rate: FloatArray | None = None,
        extra_r: FloatArray | None = None,
    ) -> tuple[PosteriorSteps, FilterState]:
        """Filter one window (see :class:`~.base.Estimator`).

        ``residual_rate`` [N, 2] is added to v̇_y and ṙ from each stamp to the next, m/s² and rad/s².
        ``extra_r`` [N, 2]: variance that a_y (m²/s⁴) and yaw rate (rad²/s²) have beyond R.
        """
        steps, after, _ = self._steps(signals, state, residual_rate, extra_r, linked=False)
        return steps, after

    def linked_steps(
        self,
        signals: Signals,
        state: FilterState | None,
        residual_rate: FloatArray | None = None,
        extra_r: FloatArray | None = None,
    ) -> tuple[PosteriorSteps, FilterState, StepLinks]:
        """Return the result of :meth:`run`, bit for bit, and the links between the steps."""
        return self._steps(signals, state, residual_rate, extra_r, linked=True)

    def predict(self, steps: PosteriorSteps, ahead: Extrapolation, stamps_ns: IntArray) -> StateTrack:
        """Extrapolate steps with the filter's model (see :class:`~.base.ModelPredictor`)."""
        start = PredictionStart(steps.x, steps.P, steps.inputs, steps.residual_rate)
        predicted = no_prediction(len(stamps_ns), steps.x.shape[1])
        self._predict_kernel(pending_predictions(ahead), start, predicted)
        return predicted_track(self.name, stamps_ns, steps, ahead, predicted, self._columns)

    def _steps(
        self,
        signals: Signals,
        state: FilterState | None,
        residual_rate: FloatArray | None,
        extra_r: FloatArray | None,
        *,
        linked: bool,
    ) -> tuple[PosteriorSteps, FilterState, StepLinks]:
        signals, slip = believable(
            self.corrected(signals),
            self.vehicle.sensors,
            state.slip if state else None,
            gate=self.slip_gate,
        )
        window, tuning = make_window(signals, state, residual_rate, extra_r), self._tuning
        count, n = len(signals), len(tuning.initial_std)
        estimate, out = resume(state, n), no_posterior(count, n)
        rows = count if linked else 0
        links = LinkColumns(np.full(rows, LINK_NONE), np.zeros((rows, n, n)), np.zeros((rows, n, n)))
        self._run_kernel(window, tuning, estimate, out, links)
        steps = PosteriorSteps(signals.stamps_ns, *out, window.residual_rate)
        return steps, next_state(estimate, signals.stamps_ns, state, slip), StepLinks(*links)
