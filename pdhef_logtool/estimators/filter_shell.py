"""What the unscented filters do alike at a step, whatever their state and model: one shell about the state.

Reset after a time gap, zero-order hold of missing inputs, start, gate, standstill, divergence and the track of
predicted steps are here. The first
entries of every state are [v_x, v_y, r, b_ax]; any number of others follow, and :class:`Tuning` says of each how it
walks, starts and stands still. A filter's own file says how sigma points move and what sensors read there. Its loop is

    begin_step; start, or: move the points, ``predicted``; measure, ``innovate``, ``gate``; ``update``; ``conclude``;
    ``finish_step``

with the model between the calls: compiled functions are not passed to compiled ones, which could then not be kept.

Over a step the inputs are the mean of those at its two ends: both are known when the step is taken, and the residual
targets are made the same way.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.estimators.unscented import unscented_weights
from pdhef_logtool.records.compiled import njit
from pdhef_logtool.records.release import (
    RESTART_GAP_S,
    Extrapolation,
    StepColumns,
    last_stamp_ns,
    step_durations_s,
)
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray, Signals
from pdhef_logtool.records.tracks import StateTrack, make_track
from pdhef_logtool.watches.speed_slip import SlipCarry

# State entries and measurement entries, by name.
VX, VY, YAW_RATE, AX_BIAS = 0, 1, 2, 3
STATES = 4
Z_AY, Z_YAW_RATE, Z_SPEED = 0, 1, 2
MEASUREMENTS = 3
MOTION = 3  # entries of the state that an output has a covariance of
# Inputs of a step; a_x is 0 where U_AX_KNOWN is 0. U_SPEED is the last speed sample that was believed, 0 before any.
U_STEER, U_AX, U_FRICTION, U_AX_KNOWN, U_SPEED = 0, 1, 2, 3, 4
INPUTS = 5

#: Speed process noise where the log has no longitudinal accelerometer: the speed is then a random walk
#: (docs/method.md#frame).
NO_AX_Q_STD = 3.0
INITIAL_STD = (0.5, 0.5, 0.1, 0.3)
#: The last steering angle is kept for this long where the signal is missing.
STEER_HOLD_S = 0.2
#: A sample further from its prediction than this many standard deviations is not used ...
GATE_SIGMA = 6.0
#: ... unless it has been so for this long: then the filter is wrong, not the sensor (docs/method.md#gate).
GATE_OPENS_AFTER_S = 0.2
GATE_INFLATION = 10.0
STANDSTILL_SPEED_M_S = 0.05
STANDSTILL_YAW_RATE_RAD_S = 0.05
STANDSTILL_AFTER_S = 0.3
#: A standstill is not believed for longer than this without a speed sample that says so.
STANDSTILL_SILENCE_S = 1.5
#: Of the first four entries; NaN is an entry that a standstill leaves as it is.
STANDSTILL_STD = (0.02, 0.01, 0.002, math.nan)
#: Divergence: the filter's own normalised squared innovations stay this far above 1, averaged over the time.
DIVERGED_NIS_RATIO = 25.0
#: Samples that the gate rejects count as well, or a gated filter could never notice; each up to this square.
DIVERGED_NIS_CAP = 4.0 * GATE_SIGMA**2
DIVERGED_AVERAGE_S = 1.0
DIVERGED_SIDESLIP_RAD = math.radians(60.0)
#: A car whose speed sensor last read more than this does not roll backwards: a v_x below zero is then no estimate.
FORWARD_M_S = 0.5

# Entries of the scalar memory of a filter.
M_INITIALISED, M_STEER, M_AX, M_AX_KNOWN, M_FRICTION, M_STEER_AGE, M_STILL, M_SPEED_AGE, M_NIS = range(9)
M_RATE_VY, M_RATE_R = 9, 10  # residual of the step before
M_REJECTED = 11  # and the two after it, one a measurement: time since the first sample of an unbroken rejection
M_SPEED = 14  # last speed sample
MEMORY = 15
#: What M_REJECTED holds at the first rejected sample itself; 0 is "the last sample was accepted".
JUST_REJECTED_S = 1e-9


class Window(NamedTuple):
    """What the sensors say at the steps of a window, [K]; NaN where nothing. ``dt_s`` ends at its step, NaN = start.

    ``residual_rate`` [K, 2] is what is added to v̇_y and ṙ from the step on, m/s² and rad/s²; ``extra_r`` [K, 2] the
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
    """What the shell goes by, beside its constants."""

    use_speed: bool  # False: the speed sensor only starts the filter
    still_after_s: float
    default_friction: float
    dynamic_speed_m_s: float  # above it a sideslip beyond DIVERGED_SIDESLIP_RAD is divergence


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


class Belief(NamedTuple):
    """State [n], covariance [n, n] and scalar memory [MEMORY] of a filter, moved in place."""

    x: FloatArray
    P: FloatArray
    memory: FloatArray


class Posterior(NamedTuple):
    """What a filter writes of each step (see :class:`PosteriorSteps`)."""

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
    """Work space of a step: sigma points and what sensors read there, innovation, and which samples count."""

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
    """What the sensors say at a step, as the columns of :class:`Window`."""

    dt: float
    steer: float
    ax: float
    ay: float
    yaw_rate: float
    speed: float
    friction: float


class Now(NamedTuple):
    """Inputs at a step, held where they miss, and its measurements.

    ``steers`` says that the steering was measured, ``steer_ok`` that it is not held for too long.
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


class Meanwhile(NamedTuple):
    """Inputs over a step: the mean of its two ends."""

    steer: float
    ax: float
    ax_known: bool
    friction: float


class Verdict(NamedTuple):
    """What the gate says of the samples of a step: does it open, is any beyond it, how many, sum of their squares."""

    opens: bool
    outside: bool
    seen: int
    squares: float


class Held(NamedTuple):
    """Steps that predictions start from (see :class:`PosteriorSteps`)."""

    x: FloatArray
    P: FloatArray
    inputs: FloatArray
    residual_rate: FloatArray


class Due(NamedTuple):
    """What is to be predicted, [M]: step (−1 for none) and time ahead of it in s."""

    step: IntArray
    horizon_s: FloatArray


class Predicted(NamedTuple):
    """What becomes of steps: state [M, n], covariance of the motion [M, 3, 3], planar a_y [M]; NaN for none."""

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
    """Restart behind a gap and hold what misses; returns :class:`Now`."""
    restart = not sample.dt <= RESTART_GAP_S
    if restart:
        memory[:] = 0.0
    steers = math.isfinite(sample.steer)
    steer = sample.steer if steers else memory[M_STEER]
    if steers:
        memory[M_STEER_AGE] = 0.0
    else:
        memory[M_STEER_AGE] += 0.0 if restart else sample.dt
    steer_ok = steers or (memory[M_INITIALISED] > 0.0 and memory[M_STEER_AGE] <= STEER_HOLD_S)
    has_ax = math.isfinite(sample.ax)
    friction = sample.friction
    if not math.isfinite(friction):
        friction = memory[M_FRICTION] if memory[M_FRICTION] > 0.0 else rules.default_friction
    speed = sample.speed if rules.use_speed or memory[M_INITIALISED] == 0.0 else math.nan
    if math.isfinite(speed):
        memory[M_SPEED] = speed
    ax = sample.ax if has_ax else 0.0
    return Now(sample.dt, steer, ax, has_ax, friction, steers, steer_ok, sample.ay, sample.yaw_rate, speed)


@njit(cache=True)
def meanwhile(now, memory):  # type: ignore[no-untyped-def]
    """Return the inputs over a step; a missing a_x at one end leaves that of the other."""
    ax = now.ax
    if not now.has_ax:
        ax = memory[M_AX]
    elif memory[M_AX_KNOWN] > 0.0:
        ax = 0.5 * (memory[M_AX] + now.ax)
    return Meanwhile(
        0.5 * (memory[M_STEER] + now.steer),
        ax,
        now.has_ax or memory[M_AX_KNOWN] > 0.0,
        0.5 * (memory[M_FRICTION] + now.friction),
    )


@njit(cache=True)
def held_inputs(inputs, k):  # type: ignore[no-untyped-def]
    """Return the inputs of step k, which a prediction holds."""
    return Meanwhile(inputs[k, U_STEER], inputs[k, U_AX], inputs[k, U_AX_KNOWN] > 0.0, inputs[k, U_FRICTION])


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
    """Add what random walks of ``q_std`` [n] make uncertain in ``dt`` s; without a_x the speed is one too."""
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
    return Verdict(opens, outside, seen, squares)


@njit(cache=True)
def open_gate(use, memory):  # type: ignore[no-untyped-def]
    """Forget that the samples which are used after all were rejected."""
    for i in range(MEASUREMENTS):
        if use[i]:
            memory[M_REJECTED + i] = 0.0


@njit(cache=True)
def settle(now, verdict, rules, standstill_std, x, P, memory):  # type: ignore[no-untyped-def]
    """Average how far innovations are from what the filter expects, and hold a car that stands."""
    if verdict.seen > 0:
        share = min(1.0, now.dt / DIVERGED_AVERAGE_S)
        memory[M_NIS] += share * (verdict.squares / verdict.seen - memory[M_NIS])
    # Standstill: the speed sensor reads zero and nothing turns, for a while.
    turns = abs(now.yaw_rate) > STANDSTILL_YAW_RATE_RAD_S
    if math.isfinite(now.speed):
        memory[M_SPEED_AGE] = 0.0
        still = abs(now.speed) < STANDSTILL_SPEED_M_S and not turns
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
    """Return whether innovations stay far from what the filter expects, or the sideslip is none to drive with."""
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
    """Keep inputs and residual of step k for the next one, and write its row of the inputs [K, 5]."""
    remember(k, now, residual_rate, memory)
    inputs[k, U_STEER] = now.steer
    inputs[k, U_AX] = now.ax
    inputs[k, U_FRICTION] = now.friction
    inputs[k, U_AX_KNOWN] = memory[M_AX_KNOWN]
    inputs[k, U_SPEED] = memory[M_SPEED] if rules.use_speed else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class PosteriorSteps(StepColumns):
    """Filter posteriors on measurement time: [K] each, state [K, n], covariance [K, n, n], inputs [K, 5].

    ``prior`` [K, n] is the state before the update, NaN where the filter starts. ``residual_rate``
    [K, 2] is what is added to v̇_y and ṙ from the step on; 0 in the pure physics filter.
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
class ShellCarry:
    """State that a filter passes from window to window."""

    belief: Belief
    last_stamp_ns: int | None
    slip: SlipCarry | None


def make_window(
    signals: Signals,
    carry: ShellCarry | None,
    residual_rate: FloatArray | None = None,
    extra_r: FloatArray | None = None,
) -> Window:
    """Return the window that a kernel reads; without ``residual_rate`` or ``extra_r`` they are 0."""
    nothing = np.zeros((len(signals), 2))
    return Window(
        step_durations_s(signals.stamps_ns, carry.last_stamp_ns if carry else None),
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
        ),
    )


def resume(carry: ShellCarry | None, n: int, memory_size: int = MEMORY) -> Belief:
    """Return the belief that a window starts with, which the kernel then moves."""
    if carry is None:
        return Belief(np.zeros(n), np.eye(n), np.zeros(memory_size))
    return Belief(*(part.copy() for part in carry.belief))


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
    """Return what predictions of ``n`` states are written to, with none in it."""
    return Predicted(*(np.full((count, *shape), np.nan) for shape in ((n,), (MOTION, MOTION), ())))


def carry_on(belief: Belief, stamps_ns: IntArray, carry: ShellCarry | None, slip: SlipCarry | None) -> ShellCarry:
    """Return the state after a window with these stamps."""
    return ShellCarry(belief, last_stamp_ns(stamps_ns, carry.last_stamp_ns if carry else None), slip)


def due(ahead: Extrapolation) -> Due:
    """Return what a kernel is to predict."""
    return Due(np.where(ahead.usable, ahead.step, -1), ahead.horizon_s)


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
    at, x, covariance = ahead.step, predicted.x, predicted.P
    usable = ahead.usable & np.isfinite(x[:, VX]) & rolls_forward(x[:, VX], steps.inputs[at, U_SPEED])
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
        nis=np.where(usable, steps.nis[at], np.nan),
        nis_dof=np.where(usable, steps.nis_dof[at], 0.0),
        friction=np.where(usable, steps.inputs[at, U_FRICTION], np.nan),
        valid=usable,
        diverged=usable & steps.diverged[at],
        **{column: np.where(usable, x[:, i], np.nan) for column, i in named.items()},
    )


def rolls_forward(vx_m_s: FloatArray, last_speed_m_s: FloatArray) -> BoolArray:
    """Return where v_x [N] does not contradict the last speed sample: the sideslip would stand at 180 degrees there."""
    against: BoolArray = (vx_m_s < 0.0) & (last_speed_m_s > FORWARD_M_S)
    return ~against


def sideslip_std(vx_m_s: FloatArray, vy_m_s: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the 1-sigma of β = atan2(v_y, v_x) in rad, [N], to first order from the covariance [N, ≥2, ≥2]."""
    v2 = np.maximum(vx_m_s**2 + vy_m_s**2, 1e-6)
    gx, gy = -vy_m_s / v2, vx_m_s / v2
    variance = gx**2 * covariance[:, VX, VX] + gy**2 * covariance[:, VY, VY] + 2.0 * gx * gy * covariance[:, VX, VY]
    return np.sqrt(np.maximum(variance, 0.0))
