"""The vehicle filter: one unscented Kalman filter for ``phy-ukf``, ``physics`` and ``pd-hef`` (docs/method.md#filter).

The models f (motion) and h (readings) are in :mod:`~.vehicle_model`; ``phy-ukf`` uses the nominal one, the others that
with axle forces and the parts of the car. A step is

    χ = x ± rows of √(n P);  χ⁻ = f(χ, u) + residual;  x⁻, P⁻ = mean and covariance of χ⁻, + Q
    χ = x⁻ ± rows of √(n P⁻);  ζ = h(χ, u);  ẑ, S, P_xz = moments of ζ and χ, + R;  gate
    x = x⁻ + P_xz S⁻¹ (z − ẑ);  P = P⁻ − P_xz S⁻¹ P_xzᵀ

with the scaled unscented transform at α = 1, β = 2, κ = 0 (Wan and van der Merwe 2000): the centre has the weight 0 in
the mean and 2 in the covariance. The inputs u are the mean of those at both ends of the step, which are known when the
step is computed. A network's residual of v̇_y and ṙ (Eq 19) enters half before and half after the model's step, and in
the predicted a_y; zeros change no bit.

Without steering for longer than it may be held, its error is a state that walks at random: the rear axle's tyres, a_y
and yaw rate then determine v_y. ``phy-ukf`` waits for the steering instead.
"""

import math
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from pdhef_logtool.car.nominal_model import model_parameters
from pdhef_logtool.car.parts import LIMIT_GAIN, PHYSICS, FilterNoise
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.compiled.cache import inline, kernel, njit
from pdhef_logtool.estimators import unscented
from pdhef_logtool.estimators.filter_steps import (
    U_AX,
    U_AX_KNOWN,
    U_FRICTION,
    U_SPEED,
    U_STEER,
    U_STEER_KNOWN,
    LinkedSteps,
    PosteriorSteps,
    no_posterior,
)
from pdhef_logtool.estimators.prediction import predict, predicted_track
from pdhef_logtool.estimators.speed_slip import believable
from pdhef_logtool.estimators.vehicle_model import (
    AX_BIAS,
    BANK_STD,
    CORE,
    FORCE_SCALE_STD,
    FRONT,
    NOMINAL,
    PLACES,
    READINGS,
    REAR,
    VX,
    VY,
    WIDTH,
    YAW_RATE,
    Z_AY,
    Z_SPEED,
    Z_YAW_RATE,
    HeldInputs,
    Layout,
    Model,
    PhysicsParameters,
    layout_of,
    physics_parameters,
    process_noise,
    quadratic_ay,
    read_ay,
    settle_forces,
)
from pdhef_logtool.records.signals import S_PER_NS, FloatArray, IntArray, Signals
from pdhef_logtool.records.steps import RESTART_GAP_S, Extrapolation
from pdhef_logtool.records.tracks import StateTrack

if TYPE_CHECKING:
    from pdhef_logtool.car.car import Car
    from pdhef_logtool.estimators.presets import Options

#: The variant of ``phy-ukf`` with the noise of an identified car.
TUNED = "phy-ukf:tuned"
#: Process noise, 1-sigma per square root of second, of v_x, v_y, r and the a_x bias. Chosen by innovation likelihood
#: over simulated drives and frozen: the drives were those of the simulator's first, planar vehicle, and a baseline does
#: not follow every change of the simulator.
PHY_UKF_Q_STD = (0.089, 0.31, 0.062, 0.021)
#: The same of ``physics``, with the axle forces, for cars without fitted noise and as the start of identification, with
#: lag, load transfer and biases. The present simulator gives 0.078, 0.13, 0.01, 0.062, 0.39.
PHYSICS_Q_STD = (0.085, 0.12, 0.012, 0.086, 0.41, 0.41)
#: 1-sigma at the start and at a standstill of the motion and the a_x bias; NaN: a standstill leaves the entry as it is.
INITIAL_STD, STANDSTILL_STD = (0.5, 0.5, 0.1, 0.3), (0.02, 0.01, 0.002, math.nan)
#: The same of the axles' forces over the mass, m/s², of roll (rad) and roll rate (rad/s); the roll rate's walk per √s.
_FORCE_STD, _STANDSTILL_FORCE_STD = 0.5, 0.05
_ROLL_STD, _STANDSTILL_ROLL_STD, _ROLL_WALK = (0.01, 0.03), (0.005, 0.01), 0.02
#: Random walk of the a_y (m/s²), yaw-rate (rad/s) and steering (rad) bias, 1-sigma per square root of second.
BIAS_WALK_STD = (0.004, 0.00008, 0.00002)
#: 1-sigma of an unknown steering angle at the start and at most, rad, and its walk per √s (docs/method.md#physics).
UNKNOWN_STEER_STD, MAX_STEER_STD, UNKNOWN_STEER_WALK = 0.1, 0.2, 0.2
#: Beyond this share of the grip, the largest of about the last ``LIMIT_TIME_S``, tyre models are least certain
#: (docs/method.md#limit). ``limit_lag_m`` of a file that neither ground truth nor calibration has validated, in
#: wheelbases: chosen on simulated cars with right and wrong files. More helps single manoeuvres and harms laps.
LINEAR_SHARE, LIMIT_TIME_S, FILE_LAG = 0.36, 0.5, 1.1

#: A sample further from its prediction than this many standard deviations is not used ...
GATE_SIGMA = 6.0
#: ... unless it has been so for this long: then the filter is wrong, not the sensor (docs/method.md#gate).
GATE_OPENS_AFTER_S = 0.2
GATE_INFLATION = 10.0
STANDSTILL_AFTER_S = 0.3
#: A standstill is not accepted for longer than this without a speed sample that states so.
STANDSTILL_SILENCE_S = 1.5
#: Mean normalised squared innovation up to which the factor on the noise counts fully, and from which it is 1. Sensors
#: have less noise than R assumes: the usual mean is 0.18; where the network's residual is wrong, it is about 0.5.
QUIET_NIS, LOUD_NIS = 0.2, 0.4
#: Divergence: the filter's own normalised squared innovations stay this far above 1, averaged over the time.
DIVERGED_NIS_RATIO = 25.0
#: Samples that the gate rejects count as well, or a gated filter could never notice; each up to this square.
DIVERGED_NIS_CAP = 4.0 * GATE_SIGMA**2
DIVERGED_AVERAGE_S = 1.0
DIVERGED_SIDESLIP_RAD = math.radians(60.0)
#: Time of a rejection at its first sample, s; 0 is "the last sample was accepted".
_JUST_REJECTED_S = S_PER_NS

#: Memory of a filter of the steps before: whether it runs; last inputs, residual and factor on the noise; ages, s;
#: duration of the standstill, s; mean normalised square of the innovations; last speed sample; largest recent share of
#: the grip that is used, decaying; time since the first sample of an unbroken rejection of a_y, yaw rate and speed, s.
MEMORY_FIELDS: list[tuple[Any, ...]] = [
    *((name, np.float64) for name in ("runs", "steer", "ax", "ax_known", "friction", "rate_vy", "rate_r", "steer_age")),
    *((name, np.float64) for name in ("noise", "speed_age", "still", "nis", "speed", "grip")),
    ("rejected", np.float64, (READINGS,)),
]
MEMORY = np.dtype(MEMORY_FIELDS)
_NOTHING = np.zeros(1, MEMORY)


class Window(NamedTuple):
    """Samples of a window, [K], NaN where missing. ``dt_s`` is the duration before each step, NaN at the start.

    ``residual_rate`` [K, 2] is added to v̇_y and ṙ from the step on, m/s² and rad/s²; ``noise`` [K] is a factor on the
    1-sigma of their process noise, while the innovations agree; ``extra_r`` [K, 2] the variance that a_y (m²/s⁴) and
    yaw rate (rad²/s²) have beyond R.
    """

    dt_s: FloatArray
    steer: FloatArray
    ax: FloatArray
    ay: FloatArray
    yaw_rate: FloatArray
    speed: FloatArray
    friction: FloatArray
    residual_rate: FloatArray
    noise: FloatArray
    extra_r: FloatArray


class Rules(NamedTuple):
    """Settings of the filter, beside its constants."""

    use_speed: bool  # False: the speed sensor only starts the filter
    default_friction: float
    dynamic_speed_m_s: float  # above it a sideslip beyond DIVERGED_SIDESLIP_RAD is divergence
    steer_hold_s: float
    still_speed_m_s: float
    still_yaw_rate_rad_s: float
    limit_gain: float
    limit_lag_m: float


class Tuning(NamedTuple):
    """Noise by entry of the state [n] and of the readings [3], and the rules.

    ``q_std`` is a random walk's 1-sigma per √s; ``standstill_std`` is NaN for entries that a standstill leaves alone.
    """

    q_std: FloatArray
    r_std: FloatArray
    initial_std: FloatArray
    standstill_std: FloatArray
    rules: Rules


class FilterState(NamedTuple):
    """State [n], covariance [n, n] with columns up to whole vectors, memory [1], and memory of the slip detection."""

    x: FloatArray
    P: FloatArray
    memory: np.ndarray[Any, Any]
    slip: FloatArray | None = None


class StepInputs(NamedTuple):
    """Inputs at a step, held if missing, and its measurements.

    ``steers``: the steering is sufficient to start the filter; ``steer_ok``: to continue it.
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


# ------------------------------------------------------------------------------------------------ one step


@inline
def begin_step(k, window, rules, needs_steer, memory):  # type: ignore[no-untyped-def]
    """Reset after a time gap and zero-order-hold missing inputs. Return the inputs of step k."""
    dt, steers = window.dt_s[k], math.isfinite(window.steer[k])
    restart = not dt <= RESTART_GAP_S
    if restart:
        memory[0] = _NOTHING[0]
    m = memory[0]
    steer = window.steer[k] if steers else m.steer
    m.steer_age = 0.0 if steers or restart else m.steer_age + dt
    steer_ok = steers or (m.runs > 0.0 and m.steer_age <= rules.steer_hold_s)
    if not needs_steer:
        lateral = math.isfinite(window.yaw_rate[k]) or math.isfinite(window.ay[k])
        steers = steers or (m.steer_age > rules.steer_hold_s and lateral)
        steer_ok = True
    has_ax = math.isfinite(window.ax[k])
    friction = window.friction[k]
    if not math.isfinite(friction):
        friction = m.friction if m.friction > 0.0 else rules.default_friction
    speed = window.speed[k] if rules.use_speed or m.runs == 0.0 else math.nan
    if math.isfinite(speed):
        m.speed = speed
    ax = window.ax[k] if has_ax else 0.0
    return StepInputs(dt, steer, ax, has_ax, friction, steers, steer_ok, window.ay[k], window.yaw_rate[k], speed)


@inline
def held_over_step(now, m):  # type: ignore[no-untyped-def]
    """Return the mean of the inputs at both ends of a step; if a_x is missing at one end, the other end counts."""
    ax = now.ax
    if not now.has_ax:
        ax = m.ax
    elif m.ax_known > 0.0:
        ax = 0.5 * (m.ax + now.ax)
    return HeldInputs(
        0.5 * (m.steer + now.steer), ax, now.has_ax or m.ax_known > 0.0, 0.5 * (m.friction + now.friction)
    )


@njit(cache=True, no_cpython_wrapper=True, _nrt=True)
def starts(now, unknown_steer, tuning, model, x, P, memory):  # type: ignore[no-untyped-def]
    """Start with the first sample of speed and steering; return whether this is it.

    The rear axle rolls without slip, the tyres' forces have settled, all other entries are 0.
    """
    if not (math.isfinite(now.speed) and now.steers):
        return False
    layout, _, p, f = model
    r = now.yaw_rate if math.isfinite(now.yaw_rate) else 0.0
    x[:] = 0.0
    x[VX], x[VY], x[YAW_RATE] = now.speed, p.rear_m * r, r
    P[:, : x.shape[0]] = np.diag(tuning.initial_std**2)
    if unknown_steer:
        x[layout.steer_bias] = -(p.front_m + p.rear_m) * r / max(now.speed, p.blend_low_m_s)
        P[layout.steer_bias, layout.steer_bias] = UNKNOWN_STEER_STD**2
    if layout.forces >= 0:
        settle_forces(x, now.steer, now.ax, now.friction, layout, p, f)
    memory[0].runs = 1.0
    return True


@inline
def trust_residual(m, q):  # type: ignore[no-untyped-def]
    """Reduce the variance [n] of v_y and yaw rate by the residual's factor, unless the innovations contradict it."""
    agrees = min(1.0, max(0.0, (LOUD_NIS - m.nis) / (LOUD_NIS - QUIET_NIS)))
    factor = 1.0 - (1.0 - m.noise) * agrees
    q[VY] *= factor * factor
    q[YAW_RATE] *= factor * factor


@inline
def yield_to_kinematics(x, friction, dt, rules, p, f, m):  # type: ignore[no-untyped-def]
    """Return the factor on the process noise of the axle forces, 1 in the linear range, and how they lag beyond it."""
    most = friction * (p.front_D_n + p.rear_D_n) / p.mass_kg
    m.grip = max(abs(x[FRONT] + x[REAR]) / most, m.grip * math.exp(-dt / LIMIT_TIME_S))
    beyond = max(0.0, m.grip - LINEAR_SHARE)
    if rules.limit_lag_m > 0.0:
        f = PhysicsParameters(rules.limit_lag_m * beyond, *f[1:])
    return 1.0 + rules.limit_gain * beyond * beyond, f


# positional: to hand structures of arrays on at every step would cost as much as the step.
@inline
def expect(x, P, root, now, rate_vy, r, layout, places, p, f, points, away, reading, nu, S, Pxz):  # type: ignore[no-untyped-def]
    """Write the innovation [3], NaN for missing samples, the lower triangle of its covariance with R, and P_xz [3, n].

    ``r`` [3] are the variances of the sensors. The models of gyro and speed are linear, and so are the sensor biases:
    the sigma points of a_y are sufficient, and where its model is quadratic their moments are known without them.
    """
    m, s, n, first = layout.changing, layout.force_scale, x.shape[0], layout.sensor_bias
    least = 1.0 + x[s] - math.sqrt(n * P[s, s]) if s >= 0 else 1.0
    if layout.forces >= 0 and least > 0.1 and x[VX] - math.sqrt(n * P[VX, VX]) > p.blend_high_m_s:
        ay, S[Z_AY, Z_AY] = quadratic_ay(x, P, now.steer, rate_vy, layout, places, p, f, reading, Pxz)
    else:
        unscented.cholesky(P, root)
        columns = unscented.draw(x, root, places, m, points)
        read_ay(points, columns, now.steer, now.friction, rate_vy, layout, p, f, reading)
        ay, S[Z_AY, Z_AY] = unscented.reading_moments(reading, root, m, away, Pxz, Z_AY)
    nu[Z_AY], nu[Z_YAW_RATE], nu[Z_SPEED] = now.ay - ay, now.yaw_rate - x[YAW_RATE], now.speed - x[VX]
    for i, entry in ((Z_YAW_RATE, YAW_RATE), (Z_SPEED, VX)):
        for a in range(Pxz.shape[1]):
            Pxz[i, a] = P[entry, a]
        for j in range(i + 1):
            S[i, j] = Pxz[j, entry]
    for i in range(READINGS if first >= 0 else 0):  # the biases of a_y and yaw rate
        for j in range(min(i, Z_YAW_RATE) + 1):
            S[i, j] += Pxz[i, first + j]
            if i <= Z_YAW_RATE:
                S[i, j] += Pxz[j, first + i] + P[first + i, first + j]
    for i in range(Z_SPEED if first >= 0 else 0):
        nu[i] -= x[first + i]
        for a in range(Pxz.shape[1]):
            Pxz[i, a] += P[first + i, a]
    for i in range(READINGS):
        S[i, i] += r[i]


@inline
def gate(now, m, nu, S, at_gate, given, use):  # type: ignore[no-untyped-def]
    """Return whether the gate opens and a sample is outside, the number of samples, and the sum of their squares.

    Samples that are out of the gate for too long open it (docs/method.md#gate). Writes which samples there are
    (``given``), which are used, and the innovation with those beyond it at the gate.
    """
    opens, outside, seen, squares = False, False, 0, 0.0
    for i in range(READINGS):
        given[i] = math.isfinite(nu[i]) and (i != Z_AY or now.steer_ok)
        use[i] = given[i]
        at_gate[i] = nu[i]
        if m.rejected[i] > 0.0:
            m.rejected[i] += now.dt
        if given[i]:
            square = nu[i] * nu[i] / S[i, i]
            seen += 1
            squares += min(square, DIVERGED_NIS_CAP)
            if square <= GATE_SIGMA**2:
                m.rejected[i] = 0.0
            else:
                outside = True
                at_gate[i] = math.copysign(GATE_SIGMA * math.sqrt(S[i, i]), nu[i])
                m.rejected[i] = max(m.rejected[i], _JUST_REJECTED_S)
                use[i] = m.rejected[i] > GATE_OPENS_AFTER_S
                opens = opens or use[i]
    return opens, outside, seen, squares


@njit(cache=True, no_cpython_wrapper=True, _nrt=True)
def likelihood_of(x, P, nu, S, Pxz, use):  # type: ignore[no-untyped-def]
    """Return the log-likelihood of an innovation without an update."""
    return unscented.update(x.copy(), P.copy(), nu, S.copy(), Pxz.copy(), use)[2]


@inline
def settle(now, seen, squares, rules, standstill_std, x, P, m):  # type: ignore[no-untyped-def]
    """Average the normalised squared innovations, and contain the motion at rest; return whether the car is at rest."""
    if seen > 0:
        m.nis += min(1.0, now.dt / DIVERGED_AVERAGE_S) * (squares / seen - m.nis)
    # Standstill: for a while the speed sensor reads zero and the car does not turn.
    turns = abs(now.yaw_rate) > rules.still_yaw_rate_rad_s
    if math.isfinite(now.speed):
        m.speed_age = 0.0
        m.still = m.still + now.dt if abs(now.speed) < rules.still_speed_m_s and not turns else 0.0
    elif m.still > 0.0:
        m.speed_age += now.dt
        m.still = m.still + now.dt if m.speed_age <= STANDSTILL_SILENCE_S and not turns else 0.0
    if m.still < STANDSTILL_AFTER_S:
        return False
    for i in range(x.shape[0]):
        if math.isfinite(standstill_std[i]):
            x[i] = 0.0
            P[i, :] = 0.0
            P[:, i] = 0.0
            P[i, i] = standstill_std[i] ** 2
    return True


@inline
def diverges(rules, x, m):  # type: ignore[no-untyped-def]
    """Return whether innovations remain far beyond their covariance, or the motion is impossible.

    Without a speed sensor, only a wrong acceleration makes a car drive backwards that fast.
    """
    reverses = not rules.use_speed and x[VX] < -rules.dynamic_speed_m_s
    slides = x[VX] > rules.dynamic_speed_m_s and abs(math.atan2(x[VY], x[VX])) > DIVERGED_SIDESLIP_RAD
    return m.nis > DIVERGED_NIS_RATIO or slides or reverses


@inline
def remember(k, now, residual_rate, m):  # type: ignore[no-untyped-def]
    """Keep inputs and residual of step k for the next one."""
    m.steer, m.ax, m.ax_known, m.friction = now.steer, now.ax, 1.0 if now.has_ax else 0.0, now.friction
    m.rate_vy, m.rate_r = residual_rate[k, 0], residual_rate[k, 1]


@inline
def finish_step(k, now, window, rules, m, inputs):  # type: ignore[no-untyped-def]
    """Keep inputs and residual of step k for the next one, and write its row of the inputs [K, 6]."""
    remember(k, now, window.residual_rate, m)
    m.noise = window.noise[k]
    inputs[k, U_STEER] = now.steer
    inputs[k, U_AX] = now.ax
    inputs[k, U_FRICTION] = now.friction
    inputs[k, U_AX_KNOWN] = m.ax_known
    inputs[k, U_SPEED] = m.speed if rules.use_speed else 0.0
    inputs[k, U_STEER_KNOWN] = 1.0 if m.steer_age <= rules.steer_hold_s else 0.0


@inline
def keep(P, out, k):  # type: ignore[no-untyped-def]
    """Write a covariance [n, n] to row k of an output."""
    for a in range(P.shape[0]):
        for b in range(P.shape[0]):
            out[k, a, b] = P[a, b]


# ------------------------------------------------------------------------------------------------ a window


@inline
def unknown_steering_as_input(bias, rules, x, m):  # type: ignore[no-untyped-def]
    """Return whether the steering was unknown in the step before; its likeliest angle is then the input."""
    was_unknown = bias >= 0 and m.runs > 0.0 and m.steer_age > rules.steer_hold_s
    if was_unknown:
        m.steer -= x[bias]
        x[bias] = 0.0
    return was_unknown


@inline
def steering_walk(bias, was_unknown, steer_std, tuning, p, x, P, m):  # type: ignore[no-untyped-def]
    """Return whether the steering is unknown, and write the walk of its error; known again, it has its bias only."""
    unknown = bias >= 0 and m.steer_age > tuning.rules.steer_hold_s
    if bias >= 0:
        tuning.q_std[bias] = UNKNOWN_STEER_WALK if unknown else steer_std
        if unknown and x[VX] < p.blend_high_m_s and P[bias, bias] > UNKNOWN_STEER_STD**2:
            tuning.q_std[bias] = 0.0  # a slow car shows no steering
    if was_unknown and not unknown:
        P[bias, :] = 0.0
        P[:, bias] = 0.0
        P[bias, bias] = tuning.initial_std[bias] ** 2
    return unknown


# positional: to hand structures of arrays on at every step would cost as much as the step.
@inline
def correct(k, now, rate_vy, extra_r, tuning, model, x, P, m, scratch, out, predicted_P):  # type: ignore[no-untyped-def]
    """Update state and covariance with the samples of step k that pass the gate; return whether the car is at rest.

    Writes innovations, NIS and likelihood of the step, and P⁻ again where an open gate inflates it.
    """
    root, _, points, away, reading, nu, at_gate, r, S, Pxz, given, use = scratch
    _, _, _, out_nis, out_dof, out_likelihood, out_nu, _, _, _ = out
    layout, places, p, f = model
    for i in range(READINGS):
        r[i] = tuning.r_std[i] * tuning.r_std[i] + (extra_r[k, i] if i < Z_SPEED else 0.0)
    expect(x, P, root, now, rate_vy, r, layout, places, p, f, points, away, reading, nu, S, Pxz)
    opens, outside, seen, squares = gate(now, m, nu, S, at_gate, given, use)
    for i in range(READINGS):
        if given[i]:
            out_nu[k, i] = nu[i]
    if outside:  # a sample counts in the likelihood even if rejected, as if it stood at the gate
        out_likelihood[k] = likelihood_of(x, P, at_gate, S, Pxz, given)
    if opens:
        P *= GATE_INFLATION
        if predicted_P.shape[0] > 0:  # to a smoother the inflation is process noise of the step that led here
            keep(P, predicted_P, k)
        expect(x, P, root, now, rate_vy, r, layout, places, p, f, points, away, reading, nu, S, Pxz)
        for i in range(READINGS):
            if use[i]:
                m.rejected[i] = 0.0
    nis, dof, likelihood = unscented.update(x, P, nu, S, Pxz, use)
    if dof > 0:
        out_nis[k], out_dof[k] = nis, dof
        if not outside:
            out_likelihood[k] = likelihood
    return settle(now, seen, squares, tuning.rules, tuning.standstill_std, x, P, m)


@kernel
def _filter(window, tuning, model, state, scratch, out, links):  # type: ignore[no-untyped-def]
    """Filter one window; ``state`` is updated in place. ``links`` are of length 0 if not requested."""
    q_std, rules, (layout, places, p, car), (x, P, memory) = tuning.q_std, tuning.rules, model, state
    root, q, points, away = scratch[:4]
    out_x, out_P, out_inputs, _, _, _, _, out_valid, out_diverged, out_prior = out
    out_linked, out_predicted_P, out_cross = links
    linked, bias = out_linked.shape[0] > 0, layout.steer_bias
    front_std, rear_std = (q_std[FRONT], q_std[REAR]) if layout.forces >= 0 else (0.0, 0.0)
    steer_std = q_std[bias]
    for k in range(window.dt_s.shape[0]):
        m = memory[0]
        was_unknown = unknown_steering_as_input(bias, rules, x, m)
        now = begin_step(k, window, rules, bias < 0, memory)
        unknown = steering_walk(bias, was_unknown, steer_std, tuning, p, x, P, m)
        if m.runs == 0.0:
            out_valid[k] = starts(now, unknown, tuning, model, x, P, memory)
        else:
            over, rate, f = held_over_step(now, m), (m.rate_vy, m.rate_r), car
            if layout.forces >= 0 and rules.limit_gain > 0.0:
                factor, f = yield_to_kinematics(x, over.friction, now.dt, rules, p, f, m)
                q_std[FRONT], q_std[REAR] = factor * front_std, factor * rear_std
            process_noise(q_std, over.ax_known, now.dt, layout, q)
            trust_residual(m, q)
            predict(x, P, root, over, rate, now.dt, 0.5, q, layout, places, p, f, points, away, x.shape[0])
            if linked:
                unscented.cross_covariance(root, layout.changing, away, out_cross, k)
                keep(P, out_predicted_P, k)
            unscented.keep_state(x, out_prior, k)
            alive, stands = unscented.is_finite(x, P), False
            if alive:
                stands = correct(k, now, rate[0], window.extra_r, tuning, model, x, P, m, scratch, out, out_predicted_P)
                alive = unscented.is_finite(x, P)
            # Without steering, a_y and yaw rate the motion is unknown: the filter ends, and waits for them.
            determined = alive and not (unknown and P[bias, bias] > MAX_STEER_STD**2)
            out_valid[k] = determined and now.steer_ok
            out_diverged[k] = not alive or diverges(rules, x, m)
            if not determined:
                m.runs = 0.0
            elif linked:
                out_linked[k] = not stands
        finish_step(k, now, window, rules, m, out_inputs)
        unscented.keep_state(x, out_x, k)
        keep(P, out_P, k)


def make_window(
    signals: Signals,
    residual_rate: FloatArray | None = None,
    extra_r: FloatArray | None = None,
    noise: FloatArray | None = None,
) -> Window:
    """Return the window that a kernel reads; by default residual and additional variance are 0, ``noise`` is 1."""
    s, nothing, unchanged = signals, np.zeros((len(signals), 2)), np.ones(len(signals))
    columns = [s.steps_s, s.steer_rad, s.ax_m_s2, s.ay_m_s2, s.yaw_rate_rad_s, s.speed_m_s, s.friction]
    given = ((residual_rate, nothing), (noise, unchanged), (extra_r, nothing))
    columns += [default if column is None else column for column, default in given]
    # Numba would compile the kernel again for a read-only column, or one number for all steps.
    return Window._make(np.require(column, requirements=["C", "W"]) for column in columns)


# ------------------------------------------------------------------------------------------------ the estimator


@dataclass(frozen=True)
class VehicleUkf:
    """The filter of this file as an estimator.

    Parameters
    ----------
    vehicle : parameters; ``physics`` states which parts it has, ``sensors`` gives R unless ``r_std`` does, and the
        priors of the biases.
    equations : ``forces`` with axle forces and the car's parts, ``nominal`` without.
    q_std : process 1-sigma per √s of [v_x, v_y, r, b_ax, f_f, f_r], forces over mass in m/s².
    r_std : 1-sigma of [a_y, r, v_x].
    limit_gain : growth of the process noise of the axle forces beyond the linear range; 0: none.
    limit_lag_m : growth of the length over which they return to the tyres' beyond it, none within; 0: the car's lag.
    roll_correction : of a_y in the nominal model.
    use_speed : False is the paper's ``esp`` suite: the speed sensor only starts the filter.
    """

    algorithm = "vehicle-ukf"
    version = 1
    options = ("equations", "limit_gain", "limit_lag_m", "roll_correction")

    vehicle: VehicleParameters
    equations: Literal["forces", "nominal"] = "forces"
    q_std: tuple[float, ...] = PHYSICS_Q_STD
    r_std: tuple[float, float, float] | None = None
    limit_gain: float = 0.0
    limit_lag_m: float = 0.0
    roll_correction: bool = False
    use_speed: bool = True
    name: str = PHYSICS
    causal: bool = True

    @cached_property
    def layout(self) -> Layout:
        """Where the states of the car's parts are."""
        return NOMINAL if self.equations == "nominal" else layout_of(self.vehicle)

    @cached_property
    def parameters(self) -> Model:
        """Arguments of the compiled models."""
        p = model_parameters(self.vehicle, roll_correction=self.roll_correction)
        return Model(self.layout, self.layout.places, p, physics_parameters(self.vehicle))

    @property
    def measurement_std(self) -> FloatArray:
        """1-sigma of [a_y, r, v_x], [3]."""
        return np.array(self.r_std or self.vehicle.sensors.measurement_std)

    @cached_property
    def tuning(self) -> Tuning:
        """Noise of the states and readings, and rules."""
        layout, s = self.layout, self.vehicle.sensors
        walk, initial = np.zeros(layout.size), np.zeros(layout.size)
        still = np.full(layout.size, math.nan)
        walk[: len(self.q_std)] = self.q_std
        initial[: AX_BIAS + 1], still[: AX_BIAS + 1] = INITIAL_STD, STANDSTILL_STD
        if layout.forces >= 0:
            initial[FRONT:CORE], still[FRONT:CORE] = _FORCE_STD, _STANDSTILL_FORCE_STD
        if (i := layout.roll) >= 0:
            initial[i : i + 2], still[i : i + 2], walk[i + 1] = _ROLL_STD, _STANDSTILL_ROLL_STD, _ROLL_WALK
        if layout.bank >= 0:
            initial[layout.bank] = BANK_STD
        if layout.force_scale >= 0:
            initial[layout.force_scale] = FORCE_SCALE_STD
        if (i := layout.sensor_bias) >= 0:
            initial[layout.steer_bias : i + 2] = s.steer_bias_std_rad, s.ay_bias_std_m_s2, s.yaw_rate_bias_std_rad_s
            of_ay, of_rate, of_steer = BIAS_WALK_STD
            walk[layout.steer_bias : i + 2] = of_steer, of_ay, of_rate
        rules = Rules(
            self.use_speed, self.vehicle.assumed_friction, self.vehicle.low_speed_blend_m_s, s.steer_hold_s,
            s.speed_zero_m_s, s.still_yaw_rate_rad_s, self.limit_gain, self.limit_lag_m,
        )  # fmt: skip
        return Tuning(walk, self.measurement_std, initial, still, rules)

    def run(
        self,
        signals: Signals,
        state: FilterState | None,
        residual_rate: FloatArray | None = None,
        extra_r: FloatArray | None = None,
        noise: FloatArray | None = None,
    ) -> tuple[PosteriorSteps, FilterState]:
        """Filter one window (see :class:`~.base.Estimator`).

        ``residual_rate`` [N, 2] is added to v̇_y and ṙ from each stamp to the next, m/s² and rad/s².
        ``extra_r`` [N, 2]: variance that a_y (m²/s⁴) and yaw rate (rad²/s²) have beyond R.
        ``noise`` [N]: factor on the 1-sigma of the process noise of v_y and yaw rate from each stamp to the next.
        """
        steps, after = self.linked_steps(signals, state, residual_rate, extra_r, noise, linked=False)
        return steps.posterior, after

    def linked_steps(
        self,
        signals: Signals,
        state: FilterState | None,
        residual_rate: FloatArray | None = None,
        extra_r: FloatArray | None = None,
        noise: FloatArray | None = None,
        *,
        linked: bool = True,
    ) -> tuple[LinkedSteps, FilterState]:
        """Return the result of :meth:`run`, bit for bit, with the links between the steps if they are ``linked``."""
        count, n = len(signals), self.layout.size
        after = resume(state, n)
        signals, slip = believable(signals, self.vehicle.sensors, after.slip)
        window = make_window(signals, residual_rate, extra_r, noise)
        steps = no_posterior(signals.stamps_ns, n, window.residual_rate)
        rows = count if linked else 0
        links = (np.zeros(rows, dtype=np.bool_), np.zeros((rows, n, n)), np.zeros((rows, n, n)))
        tuning = self.tuning._replace(q_std=self.tuning.q_std.copy())  # it changes with the steering
        _filter(window, tuning, self.parameters, after[:3], make_scratch(n), steps.written, links)
        return LinkedSteps(steps, *links), after._replace(slip=slip)

    def predict(self, steps: PosteriorSteps, ahead: Extrapolation, stamps_ns: IntArray) -> StateTrack:
        """Extrapolate steps with the filter's model (see :class:`~.base.ModelPredictor`)."""
        rate, noise = steps.residual_rate, np.ones(len(steps.x))
        return predicted_track(
            self.name, steps, ahead, stamps_ns, self.tuning.q_std, self.parameters, rate=rate, noise=noise
        )

    def expected_ay(self, x: FloatArray, inputs: FloatArray) -> FloatArray:
        """Return the accelerometer's reading [K] in states [K, n] with inputs [K, 6], without residual."""
        out = np.full(len(x), np.nan)
        _expected_ay(x, inputs, self.parameters, out)
        return out


@njit(cache=True)
def _expected_ay(x, inputs, model, out):  # type: ignore[no-untyped-def]
    layout, places, p, f = model
    points, reading = np.zeros(PLACES * WIDTH), np.zeros(WIDTH)
    for k in range(x.shape[0]):
        if math.isfinite(x[k, VX]):
            for j in range(places.shape[0]):
                points[places[j] * WIDTH] = x[k, j]
            read_ay(points, 1, inputs[k, U_STEER], inputs[k, U_FRICTION], 0.0, layout, p, f, reading)
            out[k] = reading[0] + (x[k, layout.sensor_bias] if layout.sensor_bias >= 0 else 0.0)


def make_scratch(n: int) -> tuple[Any, ...]:
    """Return the arrays of a kernel for ``n`` states that keep nothing between steps, of the readings those from ν."""
    of_readings, chosen = np.zeros((3, READINGS)), np.zeros((2, READINGS), dtype=np.bool_)
    covariances = np.zeros((READINGS, READINGS)), unscented.padded(READINGS, n)
    return (
        unscented.padded(n, n),
        np.zeros(n),
        *unscented.block(n),
        np.zeros(WIDTH),
        *of_readings,
        *covariances,
        *chosen,
    )


def resume(state: FilterState | None, n: int) -> FilterState:
    """Return a copy of the state before a window, which the kernel updates in place."""
    if state is None:
        return FilterState(np.zeros(n), np.eye(n, unscented.padded(n, n).shape[1]), np.zeros(1, MEMORY))
    return deepcopy(state)


# ------------------------------------------------------------------------------------------------ presets


def nominal_filter(vehicle: VehicleParameters, *, use_speed: bool = True, name: str = "phy-ukf") -> VehicleUkf:
    """Return the frozen ``phy-ukf``: the paper's physics baseline, R at sensor level, Q by innovation likelihood."""
    return VehicleUkf(vehicle, "nominal", PHY_UKF_Q_STD, use_speed=use_speed, name=name)


def build_nominal(name: str, car: "Car", options: "Options") -> VehicleUkf:
    """Return the frozen ``phy-ukf`` of a car, or its variant ``tuned`` with the car's noise and the roll correction."""
    nominal = nominal_filter(car.vehicle, use_speed=options.use_speed, name=name)
    if name != TUNED:
        return nominal
    noise = car.noise[name]
    q_std = (*noise.q_std, *PHY_UKF_Q_STD[len(noise.q_std) :])
    return replace(nominal, q_std=q_std, r_std=noise.measurement_std(car.vehicle.sensors), roll_correction=True)


def physics_filter(
    vehicle: VehicleParameters, noise: FilterNoise | None = None, *, use_speed: bool = True
) -> VehicleUkf:
    """Return the filter with a noise, completed by :data:`PHYSICS_Q_STD` and the sensors' noise."""
    if noise is None:
        return VehicleUkf(vehicle, use_speed=use_speed)
    return VehicleUkf(
        vehicle,
        q_std=(*noise.q_std, *PHYSICS_Q_STD[len(noise.q_std) :]),
        limit_gain=noise.limit_gain,
        r_std=noise.measurement_std(vehicle.sensors),
        use_speed=use_speed,
    )


def of_car(car: "Car", *, use_speed: bool = True) -> VehicleUkf:
    """Return ``physics`` of a car, with its identified parts and noise where the car has them.

    A car without identified parts is a static single track with the sensors' noise. If no drive with ground
    truth has validated it, it gets body roll and lagging axle forces, which may depart from the tyre model for longer
    the more grip the car uses. Entries that tuned noise does not contain are those of the fitted filter.
    """
    vehicle, noise = car.physics_vehicle, car.noise.get(PHYSICS)
    if noise is not None and car.fitted_physics is not None:
        fitted = car.fitted_physics.noise.q_std
        noise = noise.model_copy(update={"q_std": (*noise.q_std, *fitted[len(noise.q_std) :])})
    physics = physics_filter(vehicle, noise, use_speed=use_speed)
    if noise is None and not car.has_evidence:
        parts = vehicle.physics.model_copy(update={"lag": True, "roll": True})
        vehicle = vehicle.model_copy(update={"physics": parts})
        physics = replace(physics, vehicle=vehicle, limit_gain=LIMIT_GAIN, limit_lag_m=FILE_LAG * vehicle.wheelbase_m)
    return physics
