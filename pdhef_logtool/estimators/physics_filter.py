"""``physics``: the strongest filter on physics alone, with the parts that a car's driving gives evidence for.

An unscented filter on the model of :mod:`~.physics_model` (docs/method.md#filter). As the axles' forces and the roll
are states, the sensors' readings are linear in the state except for a lever arm's r²: the update uses the Jacobian,
which equals the result of the sigma points for a linear function. Points that differ in the sensors' biases alone move
with their centre.

A residual rate of v̇_y and ṙ enters as in ``phy-ukf``: half before and half after the model's step, and in the
predicted a_y, times the force scale where that is a state. Zeros change no bit.

Inputs, gate, standstill, restart, wheel speed and delay are as in ``phy-ukf``. Where the steering is missing for
longer than it may be held, its error is a state that walks at random, with the place of the steering bias: the rear
axle's tyres, a_y and yaw rate then determine v_y.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pdhef_logtool.car.nominal_model import ModelParameters, dynamic_share, model_parameters
from pdhef_logtool.car.parts import LIMIT_GAIN, PHYSICS, FilterNoise
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters
from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.estimators import filter_base as base
from pdhef_logtool.estimators.filter_base import LINK_WHOLE
from pdhef_logtool.estimators.physics_model import (
    AX_BIAS,
    AY_BIAS,
    BANK,
    BANK_TIME_S,
    CORE,
    FORCE_SCALE,
    FORCE_SCALE_TIME_S,
    FRONT,
    PLACES,
    RATE_BIAS,
    REAR,
    STEER_BIAS,
    VX,
    VY,
    WIDTH,
    YAW_RATE,
    Layout,
    PhysicsParameters,
    advance_block,
    layout_of,
    physics_parameters,
    places_of,
    planar_ay,
    sensed_ay,
    settle_forces,
    spread_layout,
    step_count,
)
from pdhef_logtool.estimators.unscented import partial_root, whiten

if TYPE_CHECKING:
    from pdhef_logtool.car.car import Car

#: Process noise, 1-sigma per square root of second, of [v_x, v_y, r, b_ax, f_f, f_r], for cars without fitted noise and
#: as the start of identification. From the innovation likelihood over simulated drives, as for ``phy-ukf``, with lag,
#: load transfer and biases, and frozen. The present simulator gives 0.078, 0.13, 0.01, 0.062, 0.39.
PHYSICS_Q_STD = (0.085, 0.12, 0.012, 0.086, 0.41, 0.41)
#: 1-sigma of the axles' forces over the mass at the start, and at a standstill, m/s².
_FORCE_STD, _STANDSTILL_FORCE_STD = 0.5, 0.05
#: 1-sigma of roll (rad) and roll rate (rad/s) at the start and at a standstill, and the roll rate's walk per √s.
_ROLL_STD, _STANDSTILL_ROLL_STD, _ROLL_WALK = (0.01, 0.03), (0.005, 0.01), 0.02
#: Spread of the bank, rad: a crowned road has 0.02-0.03, motorway bends to 0.07.
_BANK_STD = 0.02

#: Random walk of the a_y (m/s²), yaw-rate (rad/s) and steering (rad) bias, 1-sigma per square root of second.
BIAS_WALK_STD = (0.004, 0.00008, 0.00002)
#: Spread of the force scale (docs/method.md#adaptation).
FORCE_SCALE_STD = 0.05

#: 1-sigma of an unknown steering angle at the start and at most, rad, and its walk per √s (docs/method.md#physics).
UNKNOWN_STEER_STD, MAX_STEER_STD, UNKNOWN_STEER_WALK = 0.1, 0.2, 0.2

#: Beyond this share of the grip, the largest of about the last ``LIMIT_TIME_S``, tyre models are least certain
#: (docs/method.md#limit). ``limit_lag_m`` of a file that neither ground truth nor calibration has validated, in
#: wheelbases: chosen on simulated cars with right and wrong files. More helps single manoeuvres and harms laps.
LINEAR_SHARE, LIMIT_TIME_S, FILE_LAG = 0.36, 0.5, 1.1

#: The columns of a block of points: each half is one side of the centre, and ends with the centre.
_HALF = WIDTH // 2
_CENTRE = _HALF - 1
#: Rows of a block of points: the entries, and zeros up to a multiple of four.
_ROWS = 16

# No check of divisors, and sums in any order, so that the compiler can take several terms at a time.
_compiled = njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})
# To hand arrays on costs as much as a part of a step computes.
_inlined = njit(forceinline=True, error_model="numpy", fastmath={"contract", "reassoc"})

# In the compiled code every part has its place in the state, whether or not a car has it (``spread_layout``); missing
# parts are 0 and have no variance. x has PLACES entries, P and the factor PLACES rows.


@_inlined
def _draw(x, L, scale, points):  # type: ignore[no-untyped-def]
    """Write a block of sigma points about x to points [_ROWS · WIDTH]; L as of :func:`~.unscented.partial_root`.

    Columns i and _HALF + i differ from the centre along column i of the factor. Points that differ in the sensors'
    biases alone move with their centre and are left out; the rows of these biases contain the differences of the
    other points from their centre.
    """
    root = math.sqrt(scale)
    for j in range(PLACES):
        centre = x[j] if j < AY_BIAS else 0.0
        row = j * WIDTH
        for i in range(_HALF):
            away = root * L[j, i]
            points[row + i] = centre + away
            points[row + _HALF + i] = centre - away
        points[row + _CENTRE] = points[row + _HALF + _CENTRE] = centre


@_inlined
def _four_products(left, right, a, b):  # type: ignore[no-untyped-def]
    """Return the products of row a of one block with rows b to b + 3 of another; four at once become vectors."""
    a, b = a * WIDTH, b * WIDTH
    s0 = s1 = s2 = s3 = 0.0
    for i in range(WIDTH):
        number = left[a + i]
        s0 += number * right[b + i]
        s1 += number * right[b + WIDTH + i]
        s2 += number * right[b + 2 * WIDTH + i]
        s3 += number * right[b + 3 * WIDTH + i]
    return s0, s1, s2, s3


@_inlined
def _moments(points, scale, q, x, P, size):  # type: ignore[no-untyped-def]
    """Write mean and covariance of points that :func:`_draw` drew, with ``q`` [PLACES] added to the variances.

    Only the first ``size`` rows and columns of the covariance are written. The points are replaced by their differences
    from their centre, e. With δ the mean of e, the moments about the mean, the weight of the centre among them, are
    Σ w e eᵀ + δ δᵀ: in the centre's place is δ / √w.
    """
    weight = 0.5 / scale
    per_weight = 1.0 / math.sqrt(weight)
    for j in range(AY_BIAS):
        row = j * WIDTH
        centre, moved = points[row + _CENTRE], 0.0
        for i in range(WIDTH):
            points[row + i] -= centre
            moved += points[row + i]
        points[row + _CENTRE] = per_weight * weight * moved
        x[j] = centre + weight * moved
    bias, biases = P[AY_BIAS, AY_BIAS], P[RATE_BIAS, AY_BIAS]  # no point shows these: they stay
    for a in range(size):
        for b in range(0, min(a + 1, AY_BIAS), 4):
            s0, s1, s2, s3 = _four_products(points, points, a, b)
            P[a, b], P[a, b + 1], P[a, b + 2], P[a, b + 3] = weight * s0, weight * s1, weight * s2, weight * s3
    P[AY_BIAS, AY_BIAS], P[RATE_BIAS, AY_BIAS] = bias, biases
    for a in range(size):
        P[a, a] += q[a]
        for b in range(a):
            P[b, a] = P[a, b]


@_inlined
def _keep_before(points, x, P, places, before, cross):  # type: ignore[no-untyped-def]
    """Write the differences of drawn points from their centre x, and P as the cross covariance [n, n]."""
    for j in range(PLACES):
        centre = x[j] if j < AY_BIAS else 0.0
        for i in range(j * WIDTH, (j + 1) * WIDTH):
            before[i] = points[i] - centre
    _take_matrix(P, places, cross)


@_inlined
def _cross(before, points, scale, places, products, cross):  # type: ignore[no-untyped-def]
    """Write the covariance [n, n] of points before a step, as :func:`_keep_before`, and after it, as :func:`_moments`.

    That of the sensors' biases with each other, which no point that is left shows, stays. ``products`` is work space.
    """
    for a in range(PLACES):
        for b in range(0, PLACES, 4):
            s0, s1, s2, s3 = _four_products(before, points, a, b)
            products[a, b], products[a, b + 1], products[a, b + 2], products[a, b + 3] = s0, s1, s2, s3
    for i in range(places.shape[0]):
        for j in range(places.shape[0]):
            if min(places[i], places[j]) < AY_BIAS:
                cross[i, j] = 0.5 / scale * products[places[i], places[j]]


@_compiled
def _force(x):  # type: ignore[no-untyped-def]
    """Return the factor on forces and residual in state x."""
    return max(0.1, 1.0 + x[FORCE_SCALE])


@_compiled
def _push(points, half):  # type: ignore[no-untyped-def]
    """Add half of the residual's increments of v_y and r to points, times their force scale."""
    half_vy, half_rate = half
    for j in range(WIDTH):
        force = max(0.1, 1.0 + points[FORCE_SCALE * WIDTH + j])
        points[VY * WIDTH + j] += force * half_vy
        points[YAW_RATE * WIDTH + j] += force * half_rate


@_compiled
def _process_noise(q_std, ax_known, dt, layout, q):  # type: ignore[no-untyped-def]
    """Write the variance that ``dt`` s add to each entry, as ``phy-ukf`` does; the bank returns to 0."""
    for i in range(PLACES):
        q[i] = q_std[i] * q_std[i] * dt
    if not ax_known:
        q[VX] = base.NO_AX_Q_STD**2 * dt
    if layout.force_scale >= 0:
        q[FORCE_SCALE] += FORCE_SCALE_STD**2 * (1.0 - math.exp(-2.0 * dt / FORCE_SCALE_TIME_S))
    if layout.bank >= 0:
        q[BANK] += _BANK_STD**2 * (1.0 - math.exp(-2.0 * dt / BANK_TIME_S))


@_compiled
def _yield_to_kinematics(x, friction, dt, limits, p, f, memory):  # type: ignore[no-untyped-def]
    """Return the factor on the process noise of the axle forces, 1 in the linear range, and how they lag beyond it."""
    most = friction * (p.front_D_n + p.rear_D_n) / p.mass_kg
    used = abs(x[FRONT] + x[REAR]) / most
    memory[base.M_GRIP] = max(used, memory[base.M_GRIP] * math.exp(-dt / LIMIT_TIME_S))
    beyond = max(0.0, memory[base.M_GRIP] - LINEAR_SHARE)
    if limits[1] > 0.0:
        f = PhysicsParameters(limits[1] * beyond, *f[1:])
    return 1.0 + limits[0] * beyond * beyond, f


# positional: to hand structures of arrays on at every step would cost as much as the step.
@_inlined
def _predict(x, P, over, rate, dt, noise, layout, p, f, points, size):  # type: ignore[no-untyped-def]
    """Move the state and the first ``size`` rows of its covariance by ``dt`` s with drawn points.

    ``rate`` is the residual of v̇_y and ṙ; it counts where the model is dynamic.
    """
    q_std, q, scale = noise
    n = step_count(x[VX], dt, over.friction, layout, p, f)
    given = rate[0] != 0.0 or rate[1] != 0.0
    share = 0.5 * dynamic_share(x[VX], p) * dt
    half = (share * rate[0], share * rate[1])
    if given:
        _push(points, half)
    advance_block(points, WIDTH, x[VX], over, dt, n, layout, p, f)
    if given:
        _push(points, half)
    _process_noise(q_std, over.ax_known, dt, layout, q)
    _moments(points, scale, q, x, P, size)


# positional: as _predict.
@_inlined
def _measure(x, P, steer, rate_vy, layout, p, f, row, z_hat, S, Pxz):  # type: ignore[no-untyped-def]
    """Write the expected readings [3], their covariance without R [3, 3] and the cross covariance [3, PLACES].

    ``rate_vy`` is the residual of v̇_y, which the accelerometer feels as it does the tyres' forces.
    """
    z_hat[base.Z_AY] = sensed_ay(x, steer, layout, p, f, row)
    if rate_vy != 0.0:
        felt = (1.0 if layout.roll >= 0 else 1.0 + GRAVITY_M_S2 * f.roll_gradient) * dynamic_share(x[VX], p) * rate_vy
        z_hat[base.Z_AY] += _force(x) * felt
        if layout.force_scale >= 0:
            row[FORCE_SCALE] = felt
    z_hat[base.Z_YAW_RATE] = x[YAW_RATE] + x[RATE_BIAS]
    z_hat[base.Z_SPEED] = x[VX]
    for i in range(PLACES):
        Pxz[base.Z_AY, i] = 0.0
        Pxz[base.Z_YAW_RATE, i] = P[YAW_RATE, i] + P[RATE_BIAS, i]
        Pxz[base.Z_SPEED, i] = P[VX, i]
    for b in range(PLACES):
        if row[b] != 0.0:
            for i in range(PLACES):
                Pxz[base.Z_AY, i] += row[b] * P[b, i]
    of_ay, of_rate, of_speed = 0.0, 0.0, 0.0
    for b in range(PLACES):
        if row[b] != 0.0:
            of_ay += row[b] * Pxz[base.Z_AY, b]
            of_rate += row[b] * Pxz[base.Z_YAW_RATE, b]
            of_speed += row[b] * Pxz[base.Z_SPEED, b]
    S[base.Z_AY, base.Z_AY] = of_ay
    S[base.Z_AY, base.Z_YAW_RATE] = S[base.Z_YAW_RATE, base.Z_AY] = of_rate
    S[base.Z_AY, base.Z_SPEED] = S[base.Z_SPEED, base.Z_AY] = of_speed
    for k in (base.Z_YAW_RATE, base.Z_SPEED):
        S[base.Z_YAW_RATE, k] = Pxz[k, YAW_RATE] + Pxz[k, RATE_BIAS]
        S[base.Z_SPEED, k] = Pxz[k, VX]


# positional: as _predict.
@_inlined
def _update(x, P, nu, S, Pxz, use, index, root, w, gain):  # type: ignore[no-untyped-def]
    """Update as :func:`~.unscented.kalman_update` does, without the check of P; ``gain`` [3, PLACES] is work space."""
    nis, used, log_likelihood = whiten(nu, S, use, index, root, w)
    if used == 0:
        return nis, used, log_likelihood
    gain[used:, :] = 0.0
    for i in range(used):
        for a in range(PLACES):
            gain[i, a] = Pxz[index[i], a]
        for j in range(i):
            for a in range(PLACES):
                gain[i, a] -= root[i, j] * gain[j, a]
        for a in range(PLACES):
            gain[i, a] /= root[i, i]
            x[a] += w[i] * gain[i, a]
    for a in range(PLACES):
        g0, g1, g2 = gain[0, a], gain[1, a], gain[2, a]
        for b in range(a + 1):
            left = P[a, b] - (g0 * gain[0, b] + g1 * gain[1, b] + g2 * gain[2, b])
            P[a, b] = P[b, a] = left
    return nis, used, log_likelihood


@_compiled
def _finite(x, P):  # type: ignore[no-untyped-def]
    """Return whether state and variances are numbers; so are all covariances then."""
    total = 0.0
    for i in range(PLACES):
        total += x[i] + P[i, i]
    return math.isfinite(total)


@_compiled
def _in_places(values, places, rest):  # type: ignore[no-untyped-def]
    """Return values [n] where their entries have their places, [PLACES]."""
    out = np.zeros(PLACES)
    out[:] = rest
    for i in range(places.shape[0]):
        out[places[i]] = values[i]
    return out


@_compiled
def _matrix_in_places(P, places, out):  # type: ignore[no-untyped-def]
    """Write P [n, n] where its entries have their places, [PLACES, PLACES]; the rest is left."""
    for i in range(places.shape[0]):
        for j in range(places.shape[0]):
            out[places[i], places[j]] = P[i, j]


@_inlined
def _take(x, places, out):  # type: ignore[no-untyped-def]
    """Write a state [n] from where its entries have their places."""
    for i in range(places.shape[0]):
        out[i] = x[places[i]]


@_inlined
def _take_matrix(P, places, out):  # type: ignore[no-untyped-def]
    """Write a covariance [n, n] from where its entries have their places."""
    for i in range(places.shape[0]):
        for j in range(places.shape[0]):
            out[i, j] = P[places[i], places[j]]


# positional: as _predict.
@_compiled
def _write_prediction(m, x, P, steer, rate_vy, places, p, predicted):  # type: ignore[no-untyped-def]
    """Write state, covariance of the motion and planar a_y to row m, if they are numbers."""
    out_x, out_P, out_ay = predicted
    if not _finite(x, P):
        return
    _take(x, places, out_x[m])
    for i in range(base.MOTION):
        for j in range(base.MOTION):
            out_P[m, i, j] = P[i, j]
    out_ay[m] = planar_ay(x, steer, p)
    if rate_vy != 0.0:
        out_ay[m] += _force(x) * dynamic_share(x[VX], p) * rate_vy


# positional: as _predict.
@_compiled
def _find_steering(x, P, std):  # type: ignore[no-untyped-def]
    """End the estimate of an unknown steering angle: its bias restarts with ``std``."""
    x[STEER_BIAS] = 0.0
    P[STEER_BIAS, :] = 0.0
    P[:, STEER_BIAS] = 0.0
    P[STEER_BIAS, STEER_BIAS] = std * std


# positional: as _predict.
@njit(cache=True)
def _filter(window, tuning, limits, layout, p, f, estimate, out, links):  # type: ignore[no-untyped-def]
    """Run over one window; ``estimate`` is moved in place. ``links`` are of length 0 where nobody asks for them."""
    dt, steer, ax, ay, yaw_rate, speed, friction, residual_rate, extra_r = window
    q_std, r_std, initial_std, standstill_std, _, _, scale, rules = tuning
    state_x, state_P, memory = estimate
    out_x, out_P, out_inputs, out_nis, out_dof, out_likelihood, out_nu, out_valid, out_diverged, out_prior = out
    out_link, out_predicted_P, out_cross = links
    linked = out_link.shape[0] > 0
    places = places_of(layout)
    layout = spread_layout(layout)
    x, there = _in_places(state_x, places, 0.0), _in_places(np.ones(places.shape[0]), places, 0.0) > 0.0
    P, L = np.zeros((PLACES, PLACES)), np.zeros((PLACES, PLACES))
    _matrix_in_places(state_P, places, P)
    q_std, initial_std = _in_places(q_std, places, 0.0), _in_places(initial_std, places, 0.0)
    standstill_std = _in_places(standstill_std, places, math.nan)
    points, before, row = np.zeros(_ROWS * WIDTH), np.zeros(_ROWS * WIDTH), np.zeros(PLACES)
    products = np.empty((PLACES, _ROWS))
    Pxz, gain = np.empty((3, PLACES)), np.empty((3, PLACES))
    _, _, _, z_hat, S, _, nu, at_gate, given, use = base.make_work(base.MEASUREMENTS)
    index, root, w = np.empty(base.MEASUREMENTS, np.int64), np.empty_like(S), np.empty_like(nu)
    noise = (q_std, np.zeros(PLACES), scale)
    front_std, rear_std, steer_std = q_std[FRONT], q_std[REAR], q_std[STEER_BIAS]
    hidden, row_of = layout.steer_bias < 0, memory[base.M_STEER_ROW : base.M_STEER_ROW + PLACES]
    if hidden:
        P[STEER_BIAS, :] = row_of
        P[:, STEER_BIAS] = row_of
    factored = False  # whether L is the factor of P
    for k in range(dt.shape[0]):
        sample = base.Sample(dt[k], steer[k], ax[k], ay[k], yaw_rate[k], speed[k], friction[k])
        guessed = memory[base.M_INITIALISED] > 0.0 and memory[base.M_STEER_AGE] > rules.steer_hold_s
        if guessed:  # the likeliest angle is the input
            memory[base.M_STEER] -= x[STEER_BIAS]
            x[STEER_BIAS] = 0.0
        now = base.begin_step(sample, rules, memory)
        unknown = memory[base.M_STEER_AGE] > rules.steer_hold_s
        if guessed and not unknown:
            _find_steering(x, P, initial_std[STEER_BIAS])
            guessed, factored = False, False
        q_std[STEER_BIAS] = UNKNOWN_STEER_WALK if unknown else steer_std
        if unknown and x[VX] < p.blend_high_m_s and P[STEER_BIAS, STEER_BIAS] > UNKNOWN_STEER_STD**2:
            q_std[STEER_BIAS] = 0.0  # a slow car shows no steering
        there[STEER_BIAS] = guessed or not hidden
        if memory[base.M_INITIALISED] == 0.0:
            factored = False
            out_valid[k] = base.starts(now, p.rear_m, initial_std, x, P, memory)
            if out_valid[k]:
                if unknown:
                    x[STEER_BIAS] = -(p.front_m + p.rear_m) * x[YAW_RATE] / max(x[VX], p.blend_low_m_s)
                    P[STEER_BIAS, STEER_BIAS] = UNKNOWN_STEER_STD**2
                settle_forces(x, now.steer - x[STEER_BIAS], now.ax, now.friction, layout, p, f)
        else:
            over = base.held_over_step(now, memory)
            rate = (memory[base.M_RATE_VY], memory[base.M_RATE_R])
            if not factored:
                partial_root(P, places, there, L)
            factored = False
            if limits[0] > 0.0:
                factor, f = _yield_to_kinematics(x, over.friction, now.dt, limits, p, f, memory)
                q_std[FRONT], q_std[REAR] = factor * front_std, factor * rear_std
            noise = (q_std, noise[1], scale + 1.0 if guessed and hidden else scale)
            _draw(x, L, noise[2], points)
            if linked:
                _keep_before(points, x, P, places, before, out_cross[k])
            _predict(x, P, over, rate, now.dt, noise, layout, p, f, points, PLACES)
            there[STEER_BIAS] = unknown or not hidden
            alive = _finite(x, P)
            if linked:
                _cross(before, points, noise[2], places, products, out_cross[k])
                _take_matrix(P, places, out_predicted_P[k])
            _take(x, places, out_prior[k])
            if alive:
                _measure(x, P, now.steer, rate[0], layout, p, f, row, z_hat, S, Pxz)
                base.innovate(k, now, r_std, extra_r, z_hat, S, nu)
                gated = base.gate(now, memory, nu, S, at_gate, given, use)
                for i in range(base.MEASUREMENTS):
                    if given[i]:
                        out_nu[k, i] = nu[i]
                if gated.outside:  # a sample counts in the likelihood even if rejected, as if it stood at the gate
                    _, _, out_likelihood[k] = whiten(at_gate, S, given, index, root, w)
                if gated.opens:
                    P *= base.GATE_INFLATION
                    if linked:  # to a smoother the inflation is process noise of the step that led here
                        _take_matrix(P, places, out_predicted_P[k])
                    _measure(x, P, now.steer, rate[0], layout, p, f, row, z_hat, S, Pxz)
                    base.innovate(k, now, r_std, extra_r, z_hat, S, nu)
                    base.open_gate(use, memory)
                nis, dof, likelihood = _update(x, P, nu, S, Pxz, use, index, root, w, gain)
                if dof > 0:
                    partial_root(P, places, there, L)
                    factored = True
                    out_nis[k] = nis
                    out_dof[k] = dof
                    if not gated.outside:
                        out_likelihood[k] = likelihood
                base.settle(now, gated, rules, standstill_std, x, P, memory)
                if memory[base.M_STILL] >= rules.still_after_s:
                    factored = False
                alive = _finite(x, P)
            # Without steering, a_y and yaw rate the motion is unknown: the filter ends, and waits for them.
            determined = alive and not (unknown and P[STEER_BIAS, STEER_BIAS] > MAX_STEER_STD**2)
            out_valid[k] = determined
            out_diverged[k] = not alive or base.diverges(rules, x, memory)
            if not determined:
                memory[base.M_INITIALISED] = 0.0
            elif linked and memory[base.M_STILL] < rules.still_after_s:
                out_link[k] = LINK_WHOLE
        base.finish_step(k, now, residual_rate, rules, memory, out_inputs)
        _take(x, places, out_x[k])
        _take_matrix(P, places, out_P[k])
    if hidden:
        memory[base.M_STEER] -= x[STEER_BIAS]
        row_of[:] = P[STEER_BIAS]
    _take(x, places, state_x)
    _take_matrix(P, places, state_P)


@njit(cache=True)
def _predict_outputs(due, held, tuning, layout, p, f, predicted):  # type: ignore[no-untyped-def]
    """Predict the steps that are due with their inputs held; the rows of no step (−1) are left."""
    step, horizon_s = due
    held_x, held_P, inputs, residual_rate = held
    q_std, _, _, _, _, _, scale, _ = tuning
    places = places_of(layout)
    layout = spread_layout(layout)
    x, there = np.zeros(PLACES), _in_places(np.ones(places.shape[0]), places, 0.0) > 0.0
    P, L = np.zeros((PLACES, PLACES)), np.zeros((PLACES, PLACES))
    noise = (_in_places(q_std, places, 0.0), np.zeros(PLACES), scale)
    points = np.zeros(_ROWS * WIDTH)
    for m in range(step.shape[0]):
        k = step[m]
        if k < 0:
            continue
        for i in range(places.shape[0]):
            x[places[i]] = held_x[k, i]
        _matrix_in_places(held_P[k], places, P)
        over, rate = base.held_inputs(inputs, k), (residual_rate[k, 0], residual_rate[k, 1])
        if horizon_s[m] > 0.0:
            partial_root(P, places, there, L)
            _draw(x, L, scale, points)
            _predict(x, P, over, rate, horizon_s[m], noise, layout, p, f, points, base.MOTION)
        _write_prediction(m, x, P, over.steer, rate[0], places, p, predicted)


@dataclass(frozen=True, slots=True)
class PhysicsFilter(base.LinkedFilter):
    """The filter of this file as an estimator.

    Parameters
    ----------
    vehicle : parameters; ``physics`` states which parts it has, ``sensors`` gives R unless ``r_std`` does, and the
        priors of the biases.
    q_std : process 1-sigma per √s of [v_x, v_y, r, b_ax, f_f, f_r], forces over mass in m/s².
    limit_gain : growth of the process noise of the axle forces beyond the linear range; 0: none.
    limit_lag_m : growth of the length over which they return to the tyres' beyond it, none within; 0: the car's lag.
    r_std : 1-sigma of [a_y, r, v_x].
    use_speed : False is the paper's ``esp`` suite: the speed sensor only starts the filter.
    slip_gate : leave out the speed of wheels that spin or lock (:mod:`~.speed_slip`).
    standstill : contain the motion at zero while the car is.
    """

    algorithm = "physics-filter"
    version = 1
    options = ("slip_gate", "standstill", "limit_gain", "limit_lag_m")

    vehicle: VehicleParameters
    q_std: tuple[float, ...] = PHYSICS_Q_STD
    limit_gain: float = 0.0
    limit_lag_m: float = 0.0
    r_std: tuple[float, float, float] | None = None
    use_speed: bool = True
    slip_gate: bool = True
    standstill: bool = True
    name: str = PHYSICS
    causal: bool = True

    @property
    def layout(self) -> Layout:
        """Where the states of the car's parts are."""
        return layout_of(self.vehicle)

    @property
    def parameters(self) -> tuple[Layout, ModelParameters, PhysicsParameters]:
        """Arguments of the compiled model."""
        return self.layout, model_parameters(self.vehicle), physics_parameters(self.vehicle)

    @property
    def _tuning(self) -> base.Tuning:
        layout, s = self.layout, self.vehicle.sensors
        walk, initial = np.zeros(layout.size), np.zeros(layout.size)
        still = np.full(layout.size, math.nan)
        walk[: len(self.q_std)] = self.q_std
        initial[:CORE] = (*base.INITIAL_STD, _FORCE_STD, _FORCE_STD)
        still[: AX_BIAS + 1] = base.STANDSTILL_STD
        still[FRONT : REAR + 1] = _STANDSTILL_FORCE_STD
        if (i := layout.roll) >= 0:
            initial[i : i + 2], still[i : i + 2], walk[i + 1] = _ROLL_STD, _STANDSTILL_ROLL_STD, _ROLL_WALK
        if (i := layout.bank) >= 0:
            initial[i] = _BANK_STD
        if (i := layout.force_scale) >= 0:
            initial[i] = FORCE_SCALE_STD
        if layout.sensor_bias >= 0:
            of_ay, of_rate, of_steer = BIAS_WALK_STD
            initial[layout.steer_bias], walk[layout.steer_bias] = s.steer_bias_std_rad, of_steer
            for bias, std, of in ((0, s.ay_bias_std_m_s2, of_ay), (1, s.yaw_rate_bias_std_rad_s, of_rate)):
                initial[layout.sensor_bias + bias], walk[layout.sensor_bias + bias] = std, of
        return base.make_tuning(
            self.vehicle,
            walk.tolist(),
            self.measurement_std,
            initial.tolist(),
            still.tolist(),
            use_speed=self.use_speed,
            standstill=self.standstill,
            needs_steer=False,
        )

    def _run_kernel(
        self,
        window: base.Window,
        tuning: base.Tuning,
        estimate: base.StateEstimate,
        out: base.Posterior,
        links: base.LinkColumns,
    ) -> None:
        _filter(window, tuning, (self.limit_gain, self.limit_lag_m), *self.parameters, estimate, out, links)

    def _predict_kernel(
        self, pending: base.PendingPredictions, start: base.PredictionStart, predicted: base.Predicted
    ) -> None:
        _predict_outputs(pending, start, self._tuning, *self.parameters, predicted)

    @property
    def _columns(self) -> Mapping[str, int]:
        return self.layout.named


def physics_filter(
    vehicle: VehicleParameters, noise: FilterNoise | None = None, *, use_speed: bool = True
) -> PhysicsFilter:
    """Return the filter with a noise, completed by :data:`PHYSICS_Q_STD` and the sensors' noise."""
    if noise is None:
        return PhysicsFilter(vehicle, use_speed=use_speed)
    return PhysicsFilter(
        vehicle,
        q_std=(*noise.q_std, *PHYSICS_Q_STD[len(noise.q_std) :]),
        limit_gain=noise.limit_gain,
        r_std=noise.measurement_std(vehicle.sensors),
        use_speed=use_speed,
    )


def of_car(car: Car, *, use_speed: bool = True) -> PhysicsFilter:
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
