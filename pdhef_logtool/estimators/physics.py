"""``phy-ukf``: the pure physics unscented Kalman filter on the nominal single-track model (METHOD §1, §2, §6).

State [v_x, v_y, r, b_ax]; b_ax is a slow bias of the longitudinal accelerometer (grade, pitch). Optional states
behind it: the biases of a_y, yaw rate and steering angle, and the force scale s, by which model and residual are taken
to be wrong: (1 + s) times their forces, an Ornstein-Uhlenbeck process (METHOD §12, §15). Measurements [a_y, r, v_x],
each of which may be missing at any step. Without options this is the paper's physics baseline and frozen: R at sensor
level from the vehicle file, Q by innovation likelihood (``studies.defaults.tune_physics_q``).

Over a step the inputs are the mean of those at its two ends: both are known when the step is taken, and the residual
targets are made the same way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit

from pdhef_logtool.car.nominal_model import (
    ModelParameters,
    dynamic_share,
    model_parameters,
    planar_lateral_acceleration,
    substeps,
)
from pdhef_logtool.car.nominal_points import (
    AT_AX,
    AT_AY,
    AT_FORCE,
    AT_STEER,
    AT_VX,
    AT_VY,
    AT_YAW_RATE,
    advance_points,
    measure_points,
    place,
    place_count,
    work_size,
)
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.estimators.unscented import (
    draw_sigma_points,
    innovation_moments,
    kalman_update,
    mean_and_covariance,
    unscented_weights,
)
from pdhef_logtool.records.release import MAX_PREDICTION_S, released_steps
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray, Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.watches.speed_slip import SlipCarry, believable

if TYPE_CHECKING:
    from pdhef_logtool.car.car import Car
    from pdhef_logtool.estimators.table import Options

# State entries and measurement entries, by name.
VX, VY, YAW_RATE, AX_BIAS = 0, 1, 2, 3
STATES = 4
BIAS_STATES = 3
Z_AY, Z_YAW_RATE, Z_SPEED = 0, 1, 2
MEASUREMENTS = 3
# Inputs of a step; a_x is 0 where U_AX_KNOWN is 0. U_SPEED is the last speed sample that was believed, 0 before any.
U_STEER, U_AX, U_FRICTION, U_AX_KNOWN, U_SPEED = 0, 1, 2, 3, 4
INPUTS = 5

#: Process noise, 1-sigma per square root of second, of v_x, v_y, r and the a_x bias. Chosen by innovation likelihood
#: over simulated drives (``studies.defaults.tune_physics_q``, its result in ``results/``) and frozen: the drives were
#: those of the simulator's first, planar vehicle, and a baseline does not follow every change of the simulator.
PHY_UKF_Q_STD = (0.089, 0.31, 0.062, 0.021)
#: Speed process noise where the log has no longitudinal accelerometer: the speed is then a random walk (METHOD §1).
NO_AX_Q_STD = 3.0

INITIAL_STD = (0.5, 0.5, 0.1, 0.3)
#: Random walk of the a_y (m/s²), yaw-rate (rad/s) and steering (rad) bias, 1-sigma per square root of second.
BIAS_WALK_STD = (0.004, 0.00008, 0.00002)
#: Force scale: its spread, and the time constant with which it returns to 0 (METHOD §15).
FORCE_SCALE_STD = 0.05
FORCE_SCALE_TIME_S = 2.0
#: Longer steps are no steps: the filter starts anew behind such a gap.
RESTART_GAP_S = 0.5
#: The last steering angle is kept for this long where the signal is missing.
STEER_HOLD_S = 0.2
#: A sample further from its prediction than this many standard deviations is not used ...
GATE_SIGMA = 6.0
#: ... unless it has been so for this long: then the filter is wrong, not the sensor (METHOD §6, no lock-out).
GATE_OPENS_AFTER_S = 0.2
GATE_INFLATION = 10.0
STANDSTILL_SPEED_M_S = 0.05
STANDSTILL_YAW_RATE_RAD_S = 0.05
STANDSTILL_AFTER_S = 0.3
#: A standstill is not believed for longer than this without a speed sample that says so.
STANDSTILL_SILENCE_S = 1.5
STANDSTILL_STD = (0.02, 0.01, 0.002, 0.0)
#: Divergence: the filter's own normalised squared innovations stay this far above 1, averaged over the time.
DIVERGED_NIS_RATIO = 25.0
#: Samples that the gate rejects count as well, or a gated filter could never notice; each up to this square.
DIVERGED_NIS_CAP = 4.0 * GATE_SIGMA**2
DIVERGED_AVERAGE_S = 1.0
DIVERGED_SIDESLIP_RAD = math.radians(60.0)
#: A car whose speed sensor last read more than this does not roll backwards: a v_x below zero is then no estimate.
FORWARD_M_S = 0.5

# Entries of the filter's scalar memory.
M_INITIALISED, M_STEER, M_AX, M_AX_KNOWN, M_FRICTION, M_STEER_AGE, M_STILL, M_SPEED_AGE, M_NIS = range(9)
M_RATE_VY, M_RATE_R = 9, 10  # residual of the step before
M_REJECTED = 11  # and the two after it, one a measurement: time since the first sample of an unbroken rejection
M_SPEED = 14  # last speed sample
MEMORY = 15
#: What M_REJECTED holds at the first rejected sample itself; 0 is "the last sample was accepted".
JUST_REJECTED_S = 1e-9

#: How a step hangs together with the one before it: not at all (start, failure), through the whole state, or through
#: what a standstill does not overwrite (the entries from AX_BIAS on).
LINK_NONE, LINK_WHOLE, LINK_BIASES = 0, 1, 2


@dataclass(frozen=True, slots=True, eq=False)
class FilterCarry:
    """What the filter takes from window to window, and the steps that no output has used yet."""

    x: FloatArray
    P: FloatArray
    memory: FloatArray
    last_stamp_ns: int
    steps: PosteriorSteps
    slip: SlipCarry | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PosteriorSteps:
    """Filter posteriors on measurement time: [K] each, state [K, 4], covariance [K, 4, 4], inputs [K, 5].

    ``prior`` [K, 4] is the state before the update, NaN where the filter starts. ``residual_rate``
    [K, 2] is what is added to v̇_y and ṙ from the step on; 0 in the pure physics filter.
    """

    stamps_ns: IntArray
    ready_ns: IntArray
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

    def joined(self, other: PosteriorSteps) -> PosteriorSteps:
        """Append the steps of the next window."""
        return PosteriorSteps(*(np.concatenate([getattr(self, n), getattr(other, n)]) for n in self.__slots__))

    def since(self, index: int) -> PosteriorSteps:
        """Keep the steps from ``index`` on."""
        return PosteriorSteps(*(getattr(self, n)[index:] for n in self.__slots__))

    def until(self, index: int) -> PosteriorSteps:
        """Keep the steps before ``index``."""
        return PosteriorSteps(*(getattr(self, n)[:index] for n in self.__slots__))


@dataclass(frozen=True, slots=True, eq=False)
class StepLinks:
    """What a smoother needs beside the posteriors, one row a step, or of length 0 where nobody asked.

    ``kind`` [K] is one of LINK_NONE, LINK_WHOLE, LINK_BIASES; ``predicted_P`` [K, n, n] the covariance before the
    update, with what an opened gate added to it; ``cross`` [K, n, n] the covariance between the state of the step
    before (rows) and the predicted state (columns), from the sigma points before Q is added and they are drawn anew.
    """

    kind: IntArray
    predicted_P: FloatArray
    cross: FloatArray

    def joined(self, other: StepLinks) -> StepLinks:
        """Append the steps of the next window."""
        return StepLinks(*(np.concatenate([getattr(self, n), getattr(other, n)]) for n in self.__slots__))

    def since(self, index: int) -> StepLinks:
        """Keep the steps from ``index`` on."""
        return StepLinks(*(getattr(self, n)[index:] for n in self.__slots__))


def empty_links(count: int, n: int) -> StepLinks:
    """Return links of ``count`` steps of ``n`` states that tie nothing together."""
    return StepLinks(np.full(count, LINK_NONE, dtype=np.int64), np.zeros((count, n, n)), np.zeros((count, n, n)))


class StateLayout(NamedTuple):
    """Where the optional states stand; −1 = not there. The three biases follow each other: a_y, yaw rate, steering."""

    bias: int
    force_scale: int


@njit(cache=True)
def _propagate(chi, steer, ax, friction, rate_vy, rate_r, dt, layout, p, points):  # type: ignore[no-untyped-def]
    """Move sigma points [s, n] by ``dt`` through the nominal model and add the residual (Eq 19), in place.

    Half of the residual's increment goes in before the model's step and half after it: all of it at the end, as Eq 19
    has it, would leave the tyres' answer to it out of the step, 3 % of a residual at 25 m/s and 10 ms. A residual
    counts where the model is dynamic: it knows nothing of the kinematic range. ``points`` [work_size(s)] is work space.
    """
    share = 0.5 * dynamic_share(chi[0, 0], p) * dt
    _set_points(chi, steer, ax, share * rate_vy, share * rate_r, layout, points)
    advance_points(points, friction, dt, substeps(chi[0, 0], dt, friction, p), p)
    keep = math.exp(-dt / FORCE_SCALE_TIME_S) if layout.force_scale >= 0 else 1.0
    for i in range(chi.shape[0]):
        at = place(i)
        half = share * points[at + AT_FORCE]
        chi[i, VX] = points[at + AT_VX]
        chi[i, VY] = points[at + AT_VY] + half * rate_vy
        chi[i, YAW_RATE] = points[at + AT_YAW_RATE] + half * rate_r
        if layout.force_scale >= 0:
            chi[i, layout.force_scale] *= keep


@njit(cache=True)
def _set_points(chi, steer, ax, more_vy, more_r, layout, points):  # type: ignore[no-untyped-def]
    """Write sigma points [s, n] to ``points``, with the increments of v_y and r times their force; the rest is filled.

    What is left of the last block is the first point again: numbers that cannot overflow.
    """
    s = chi.shape[0]
    for column in range(place_count(points)):
        i = column if column < s else 0
        force = 1.0 if layout.force_scale < 0 else max(0.1, 1.0 + chi[i, layout.force_scale])
        at = place(column)
        points[at + AT_VX] = chi[i, VX]
        points[at + AT_VY] = chi[i, VY] + more_vy * force
        points[at + AT_YAW_RATE] = chi[i, YAW_RATE] + more_r * force
        points[at + AT_STEER] = steer if layout.bias < 0 else steer - chi[i, layout.bias + 2]
        points[at + AT_AX] = ax - chi[i, AX_BIAS]
        points[at + AT_FORCE] = force


@njit(cache=True)
def _measure(chi, steer, friction, rate_vy, layout, p, points, zeta):  # type: ignore[no-untyped-def]
    """Write what the sensors would read at sigma points chi [s, n] to zeta [s, 3]; the residual belongs to a_y too."""
    residual = (1.0 + p.ay_roll_gain) * dynamic_share(chi[0, 0], p) * rate_vy
    _set_points(chi, steer, 0.0, 0.0, 0.0, layout, points)
    measure_points(points, friction, p)
    for i in range(chi.shape[0]):
        at = place(i)
        zeta[i, Z_AY] = points[at + AT_AY] + points[at + AT_FORCE] * residual
        zeta[i, Z_YAW_RATE] = chi[i, YAW_RATE]
        zeta[i, Z_SPEED] = chi[i, VX]
        if layout.bias >= 0:
            zeta[i, Z_AY] += chi[i, layout.bias]
            zeta[i, Z_YAW_RATE] += chi[i, layout.bias + 1]


@njit(cache=True)
def _add_process_noise(P, q_std, ax_known, dt, layout):  # type: ignore[no-untyped-def]
    """Add what a step of ``dt`` s makes uncertain; ``q_std`` [4] covers the fixed states, the others have their own."""
    for i in range(STATES):
        q = q_std[i] if i != VX or ax_known else NO_AX_Q_STD
        P[i, i] += q * q * dt
    if layout.bias >= 0:
        for i in range(BIAS_STATES):
            P[layout.bias + i, layout.bias + i] += BIAS_WALK_STD[i] ** 2 * dt
    if layout.force_scale >= 0:
        forgotten = 1.0 - math.exp(-2.0 * dt / FORCE_SCALE_TIME_S)
        P[layout.force_scale, layout.force_scale] += FORCE_SCALE_STD**2 * forgotten


@njit(cache=True)
def _cross_covariance(chi_before, chi, x_after, wc, out):  # type: ignore[no-untyped-def]
    """Write the covariance [n, n] between the sigma points before a step (rows) and after it, whose mean is x_after.

    Those before it lie in pairs about their first, which is their mean.
    """
    s, n = chi.shape
    for a in range(n):
        for b in range(n):
            c = 0.0
            for i in range(s):
                c += wc[i] * (chi_before[i, a] - chi_before[0, a]) * (chi[i, b] - x_after[b])
            out[a, b] = c


@njit(cache=True)
def _all_finite(x, P):  # type: ignore[no-untyped-def]
    for i in range(x.shape[0]):
        if not math.isfinite(x[i]):
            return False
        for j in range(x.shape[0]):
            if not math.isfinite(P[i, j]):
                return False
    return True


@njit(cache=True)
def _filter(  # type: ignore[no-untyped-def]
    dt, steer, ax, ay, yaw_rate, speed, friction, use_speed, still_after_s, default_friction, p, q_std, r_std, wm, wc,
    scale, layout, initial_std, x, P, memory, residual_rate, extra_r, out_x, out_P, out_u, out_nis, out_dof, out_ll,
    out_nu, out_valid, out_diverged, out_prior, out_link, out_predicted_P, out_cross,
):  # fmt: skip
    """Run over one window; x [n], P [n, n] and memory are updated in place. ``dt[k]`` ends at step k, NaN = start.

    The last three outputs are those of :class:`StepLinks`, of length 0 where nobody asks for them.
    """
    n = x.shape[0]
    linked = out_link.shape[0] > 0
    chi = np.empty((2 * n + 1, n))
    chi_before = np.empty((2 * n + 1, n))
    points = np.empty(work_size(2 * n + 1))
    L = np.empty((n, n))
    zeta = np.empty((2 * n + 1, MEASUREMENTS))
    z_hat = np.empty(MEASUREMENTS)
    S = np.empty((MEASUREMENTS, MEASUREMENTS))
    Pxz = np.empty((n, MEASUREMENTS))
    nu = np.empty(MEASUREMENTS)
    z = np.empty(MEASUREMENTS)
    use = np.empty(MEASUREMENTS, dtype=np.bool_)
    given = np.empty(MEASUREMENTS, dtype=np.bool_)
    at_gate = np.empty(MEASUREMENTS)
    for k in range(dt.shape[0]):
        restart = not dt[k] <= RESTART_GAP_S
        if restart:
            memory[:] = 0.0
        if math.isfinite(steer[k]):
            steer_k = steer[k]
            memory[M_STEER_AGE] = 0.0
        else:
            steer_k = memory[M_STEER]
            memory[M_STEER_AGE] += 0.0 if restart else dt[k]
        steer_ok = math.isfinite(steer[k]) or (memory[M_INITIALISED] > 0.0 and memory[M_STEER_AGE] <= STEER_HOLD_S)
        has_ax = math.isfinite(ax[k])
        ax_k = ax[k] if has_ax else 0.0
        if math.isfinite(friction[k]):
            mu_k = friction[k]
        else:
            mu_k = memory[M_FRICTION] if memory[M_FRICTION] > 0.0 else default_friction
        z[Z_AY] = ay[k]
        z[Z_YAW_RATE] = yaw_rate[k]
        z[Z_SPEED] = speed[k] if (use_speed or memory[M_INITIALISED] == 0.0) else math.nan
        if math.isfinite(z[Z_SPEED]):
            memory[M_SPEED] = z[Z_SPEED]
        out_nis[k] = math.nan
        out_dof[k] = 0.0
        out_ll[k] = 0.0
        out_nu[k, :] = math.nan
        out_valid[k] = False
        out_diverged[k] = False
        for i in range(n):
            out_prior[k, i] = math.nan

        if memory[M_INITIALISED] == 0.0:
            if math.isfinite(z[Z_SPEED]) and math.isfinite(steer[k]):
                r0 = z[Z_YAW_RATE] if math.isfinite(z[Z_YAW_RATE]) else 0.0
                x[VX] = z[Z_SPEED]
                x[VY] = p.rear_m * r0  # the rear axle rolls without slip
                x[YAW_RATE] = r0
                x[AX_BIAS:] = 0.0
                P[:, :] = 0.0
                for i in range(n):
                    P[i, i] = initial_std[i] ** 2
                memory[M_INITIALISED] = 1.0
                out_valid[k] = True
        else:
            draw_sigma_points(x, P, scale, L, chi)
            if linked:
                chi_before[:, :] = chi
            # A missing steering angle is held; a missing a_x at one end leaves that of the other.
            ax_step = memory[M_AX] if not has_ax else ax_k if memory[M_AX_KNOWN] == 0.0 else 0.5 * (memory[M_AX] + ax_k)
            ax_known = has_ax or memory[M_AX_KNOWN] > 0.0
            _propagate(
                chi, 0.5 * (memory[M_STEER] + steer_k), ax_step, 0.5 * (memory[M_FRICTION] + mu_k),
                memory[M_RATE_VY], memory[M_RATE_R], dt[k], layout, p, points,
            )  # fmt: skip
            mean_and_covariance(chi, wm, wc, x, P)
            if linked:
                _cross_covariance(chi_before, chi, x, wc, out_cross[k])
            _add_process_noise(P, q_std, ax_known, dt[k], layout)
            alive = _all_finite(x, P)
            if linked:
                out_predicted_P[k] = P
            for i in range(n):
                out_prior[k, i] = x[i]
            if alive:
                draw_sigma_points(x, P, scale, L, chi)
                _measure(chi, steer_k, mu_k, memory[M_RATE_VY], layout, p, points, zeta)
                innovation_moments(chi, x, zeta, wm, wc, z_hat, S, Pxz)
                opens = False
                outside = False
                seen = 0
                squares = 0.0
                for i in range(MEASUREMENTS):
                    S[i, i] += r_std[i] * r_std[i] + (extra_r[k, i] if i < Z_SPEED else 0.0)
                    nu[i] = z[i] - z_hat[i]
                    use[i] = math.isfinite(nu[i]) and (i != Z_AY or steer_ok)
                    given[i] = use[i]
                    at_gate[i] = nu[i]
                    if memory[M_REJECTED + i] > 0.0:
                        memory[M_REJECTED + i] += dt[k]
                    if use[i]:
                        out_nu[k, i] = nu[i]
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
                if outside:  # a sample counts in the likelihood even if rejected, as if it stood at the gate
                    _, _, likelihood_at_gate = kalman_update(x.copy(), P.copy(), at_gate, S, Pxz, given)
                    out_ll[k] = likelihood_at_gate
                if opens:
                    for i in range(n):
                        for j in range(n):
                            P[i, j] *= GATE_INFLATION
                    if linked:  # to a smoother the inflation is process noise of the step that led here
                        out_predicted_P[k] = P
                    draw_sigma_points(x, P, scale, L, chi)
                    _measure(chi, steer_k, mu_k, memory[M_RATE_VY], layout, p, points, zeta)
                    innovation_moments(chi, x, zeta, wm, wc, z_hat, S, Pxz)
                    for i in range(MEASUREMENTS):
                        S[i, i] += r_std[i] * r_std[i] + (extra_r[k, i] if i < Z_SPEED else 0.0)
                        nu[i] = z[i] - z_hat[i]
                        if use[i]:
                            memory[M_REJECTED + i] = 0.0
                nis, dof, log_likelihood = kalman_update(x, P, nu, S, Pxz, use)
                if dof > 0:
                    out_nis[k] = nis
                    out_dof[k] = dof
                    if not outside:
                        out_ll[k] = log_likelihood
                if seen > 0:
                    memory[M_NIS] += min(1.0, dt[k] / DIVERGED_AVERAGE_S) * (squares / seen - memory[M_NIS])
                # Standstill: the speed sensor reads zero and nothing turns, for a while.
                turns = abs(z[Z_YAW_RATE]) > STANDSTILL_YAW_RATE_RAD_S
                if math.isfinite(z[Z_SPEED]):
                    memory[M_SPEED_AGE] = 0.0
                    still = abs(z[Z_SPEED]) < STANDSTILL_SPEED_M_S and not turns
                    memory[M_STILL] = memory[M_STILL] + dt[k] if still else 0.0
                elif memory[M_STILL] > 0.0:
                    memory[M_SPEED_AGE] += dt[k]
                    still = memory[M_SPEED_AGE] <= STANDSTILL_SILENCE_S and not turns
                    memory[M_STILL] = memory[M_STILL] + dt[k] if still else 0.0
                if memory[M_STILL] >= still_after_s:
                    for i in range(AX_BIAS):
                        x[i] = 0.0
                        for j in range(n):
                            P[i, j] = 0.0
                            P[j, i] = 0.0
                        P[i, i] = STANDSTILL_STD[i] ** 2
                alive = _all_finite(x, P)
            if linked and alive:
                out_link[k] = LINK_BIASES if memory[M_STILL] >= still_after_s else LINK_WHOLE
            if alive:
                out_valid[k] = steer_ok
                out_diverged[k] = memory[M_NIS] > DIVERGED_NIS_RATIO or (
                    x[VX] > p.blend_high_m_s and abs(math.atan2(x[VY], x[VX])) > DIVERGED_SIDESLIP_RAD
                )
            else:
                memory[M_INITIALISED] = 0.0
                out_diverged[k] = True
        memory[M_STEER] = steer_k
        memory[M_AX] = ax_k
        memory[M_AX_KNOWN] = 1.0 if has_ax else 0.0
        memory[M_FRICTION] = mu_k
        memory[M_RATE_VY] = residual_rate[k, 0]
        memory[M_RATE_R] = residual_rate[k, 1]
        for i in range(n):
            out_x[k, i] = x[i]
            for j in range(n):
                out_P[k, i, j] = P[i, j]
        out_u[k, U_STEER] = steer_k
        out_u[k, U_AX] = ax_k
        out_u[k, U_FRICTION] = mu_k
        out_u[k, U_AX_KNOWN] = memory[M_AX_KNOWN]
        out_u[k, U_SPEED] = memory[M_SPEED] if use_speed else 0.0


@njit(cache=True)
def _predict_outputs(  # type: ignore[no-untyped-def]
    step, horizon_s, x, P, inputs, residual_rate, layout, p, q_std, wm, wc, scale, out_x, out_P, out_ay
):  # fmt: skip
    """Predict step ``step[m]`` by ``horizon_s[m]`` with its inputs held; writes state, covariance and planar a_y."""
    n = x.shape[1]
    chi = np.empty((2 * n + 1, n))
    points = np.empty(work_size(2 * n + 1))
    L = np.empty((n, n))
    xm = np.empty(n)
    Pm = np.empty((n, n))
    for m in range(step.shape[0]):
        k = step[m]
        if k < 0:
            out_x[m, :] = math.nan
            out_P[m, :, :] = math.nan
            out_ay[m] = math.nan
            continue
        xm[:] = x[k]
        Pm[:, :] = P[k]
        if horizon_s[m] > 0.0:
            draw_sigma_points(xm, Pm, scale, L, chi)
            _propagate(
                chi, inputs[k, U_STEER], inputs[k, U_AX], inputs[k, U_FRICTION], residual_rate[k, 0],
                residual_rate[k, 1], horizon_s[m], layout, p, points,
            )  # fmt: skip
            mean_and_covariance(chi, wm, wc, xm, Pm)
            _add_process_noise(Pm, q_std, inputs[k, U_AX_KNOWN] > 0.0, horizon_s[m], layout)
            if not _all_finite(xm, Pm):
                xm[:] = math.nan
                Pm[:, :] = math.nan
        out_x[m] = xm
        out_P[m] = Pm
        angle = inputs[k, U_STEER] if layout.bias < 0 else inputs[k, U_STEER] - xm[layout.bias + 2]
        force = 1.0 if layout.force_scale < 0 else max(0.1, 1.0 + xm[layout.force_scale])
        ay = planar_lateral_acceleration(xm[VX], xm[VY], xm[YAW_RATE], angle, inputs[k, U_FRICTION], p, force)
        out_ay[m] = ay + force * dynamic_share(xm[VX], p) * residual_rate[k, 0]


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


@dataclass(frozen=True, slots=True)
class PhysicsUkf:
    """The filter of this file as an estimator.

    Parameters
    ----------
    vehicle : parameters; ``sensors`` gives R unless ``r_std`` does.
    q_std : process 1-sigma per √s of [v_x, v_y, r, b_ax].
    use_speed : False is the paper's ``esp`` suite: the speed sensor only starts the filter.
    bias_states : estimate the biases of a_y, yaw rate and steering angle; their priors stand in ``sensors``.
    force_scale : estimate a factor on all lateral forces.
    slip_gate : leave out the speed of wheels that spin or lock (:mod:`~.speed_slip`).
    standstill : hold v_x, v_y and r at zero while the car stands.
    """

    vehicle: VehicleParameters
    q_std: tuple[float, float, float, float] = PHY_UKF_Q_STD
    r_std: tuple[float, float, float] | None = None
    use_speed: bool = True
    roll_correction: bool = False
    bias_states: bool = False
    force_scale: bool = False
    slip_gate: bool = True
    standstill: bool = True
    name: str = "phy-ukf"
    causal: bool = True

    @property
    def needs(self) -> frozenset[str]:
        """Aligned signals without which the filter cannot run; a_x is replaced by a random walk if missing."""
        return frozenset({"steer_rad", "ay_m_s2", "yaw_rate_rad_s", "speed_m_s"})

    @property
    def _parameters(self) -> ModelParameters:
        return model_parameters(self.vehicle, roll_correction=self.roll_correction)

    @property
    def measurement_std(self) -> FloatArray:
        """1-sigma of [a_y, r, v_x], [3]."""
        s = self.vehicle.sensors
        return np.array(self.r_std or (s.ay_std_m_s2, s.yaw_rate_std_rad_s, s.speed_std_m_s))

    @property
    def layout(self) -> StateLayout:
        """Where the optional states stand."""
        after = STATES + (BIAS_STATES if self.bias_states else 0)
        return StateLayout(STATES if self.bias_states else -1, after if self.force_scale else -1)

    @property
    def _initial_std(self) -> FloatArray:
        s = self.vehicle.sensors
        std = [*INITIAL_STD]
        if self.bias_states:
            std += [s.ay_bias_std_m_s2, s.yaw_rate_bias_std_rad_s, s.steer_bias_std_rad]
        if self.force_scale:
            std += [FORCE_SCALE_STD]
        return np.array(std)

    def filter_steps(
        self,
        signals: Signals,
        carry: FilterCarry | None,
        residual_rate: FloatArray | None = None,
        extra_r: FloatArray | None = None,
    ) -> tuple[PosteriorSteps, FilterCarry]:
        """Run the filter on measurement time only; the steps and the carry with no pending steps in it.

        ``residual_rate`` [N, 2]: what is added to v̇_y and ṙ from each stamp to the next, m/s² and rad/s².
        ``extra_r`` [N, 2]: variance that a_y (m²/s⁴) and yaw rate (rad²/s²) have beyond R.
        """
        return self._steps(signals, carry, residual_rate, extra_r, empty_links(0, self._initial_std.shape[0]))

    def linked_steps(
        self,
        signals: Signals,
        carry: FilterCarry | None,
        residual_rate: FloatArray | None = None,
        extra_r: FloatArray | None = None,
    ) -> tuple[PosteriorSteps, FilterCarry, StepLinks]:
        """Return what :meth:`filter_steps` does, bit for bit, and what ties the steps together."""
        links = empty_links(len(signals), self._initial_std.shape[0])
        steps, after = self._steps(signals, carry, residual_rate, extra_r, links)
        return steps, after, links

    def _steps(
        self,
        signals: Signals,
        carry: FilterCarry | None,
        residual_rate: FloatArray | None,
        extra_r: FloatArray | None,
        links: StepLinks,
    ) -> tuple[PosteriorSteps, FilterCarry]:
        """Run the filter; ``links`` are written in place if they have a row a step."""
        signals, slip = believable(
            signals, self.vehicle.sensors.speed_std_m_s, carry.slip if carry else None, gate=self.slip_gate
        )
        count = len(signals)
        initial_std = self._initial_std
        n = initial_std.shape[0]
        if carry is None:
            x, P, memory = np.zeros(n), np.eye(n), np.zeros(MEMORY)
            first_dt = np.nan
        else:
            x, P, memory = carry.x.copy(), carry.P.copy(), carry.memory.copy()
            first_dt = (int(signals.stamps_ns[0]) - carry.last_stamp_ns) * 1e-9 if count else np.nan
        dt = np.empty(count)
        if count:
            dt[0] = first_dt
            dt[1:] = np.diff(signals.stamps_ns) * 1e-9
        steps = PosteriorSteps(
            stamps_ns=signals.stamps_ns,
            ready_ns=signals.ready_ns,
            x=np.empty((count, n)),
            P=np.empty((count, n, n)),
            inputs=np.empty((count, INPUTS)),
            nis=np.empty(count),
            nis_dof=np.empty(count),
            log_likelihood=np.empty(count),
            innovation=np.empty((count, MEASUREMENTS)),
            valid=np.empty(count, dtype=np.bool_),
            diverged=np.empty(count, dtype=np.bool_),
            prior=np.empty((count, n)),
            residual_rate=np.zeros((count, 2)) if residual_rate is None else residual_rate,
        )
        wm, wc, scale = unscented_weights(n)
        _filter(
            dt, signals.steer_rad, signals.ax_m_s2, signals.ay_m_s2, signals.yaw_rate_rad_s, signals.speed_m_s,
            signals.friction, self.use_speed, STANDSTILL_AFTER_S if self.standstill else math.inf,
            self.vehicle.assumed_friction, self._parameters,
            np.array(self.q_std), self.measurement_std, wm, wc, scale[0], self.layout, initial_std, x, P, memory,
            steps.residual_rate, np.zeros((count, 2)) if extra_r is None else extra_r,
            steps.x, steps.P, steps.inputs, steps.nis, steps.nis_dof, steps.log_likelihood, steps.innovation,
            steps.valid, steps.diverged, steps.prior, links.kind, links.predicted_P, links.cross,
        )  # fmt: skip
        last = int(signals.stamps_ns[-1]) if count else (carry.last_stamp_ns if carry else 0)
        return steps, FilterCarry(x=x, P=P, memory=memory, last_stamp_ns=last, steps=steps.since(count), slip=slip)

    def run(
        self,
        signals: Signals,
        carry: FilterCarry | None,
        residual_rate: FloatArray | None = None,
        extra_r: FloatArray | None = None,
    ) -> tuple[StateTrack, FilterCarry]:
        """Filter one window and predict the output to its stamps (see :class:`~.base.Estimator`)."""
        steps, after = self.filter_steps(signals, carry, residual_rate, extra_r)
        return self.outputs(signals, carry, steps, after)

    def outputs(
        self, signals: Signals, carry: FilterCarry | None, steps: PosteriorSteps, after: FilterCarry
    ) -> tuple[StateTrack, FilterCarry]:
        """Predict to the window's stamps what :meth:`filter_steps` returned for it; the carry keeps waiting steps."""
        if carry is not None:
            steps = carry.steps.joined(steps)
        index = released_steps(steps.ready_ns, signals.stamps_ns)
        horizon = np.where(index >= 0, (signals.stamps_ns - steps.stamps_ns[np.maximum(index, 0)]) * 1e-9, np.nan)
        usable = (index >= 0) & (horizon <= MAX_PREDICTION_S)
        usable[usable] &= steps.valid[index[usable]]
        chosen = np.where(usable, index, -1)
        count = len(signals)
        n = steps.x.shape[1]
        x, P, ay = np.empty((count, n)), np.empty((count, n, n)), np.empty(count)
        wm, wc, scale = unscented_weights(n)
        _predict_outputs(
            chosen, horizon, steps.x, steps.P, steps.inputs, steps.residual_rate, self.layout, self._parameters,
            np.array(self.q_std), wm, wc, scale[0], x, P, ay,
        )  # fmt: skip
        usable &= np.isfinite(x[:, VX])
        at = np.maximum(chosen, 0)
        if len(steps.nis):
            usable &= rolls_forward(x[:, VX], steps.inputs[at, U_SPEED])
        nan = np.full(count, np.nan)
        covariance = P[:, :3, :3]
        track = StateTrack(
            name=self.name,
            stamps_ns=signals.stamps_ns,
            vx_m_s=x[:, VX].copy(),
            vy_m_s=x[:, VY].copy(),
            yaw_rate_rad_s=x[:, YAW_RATE].copy(),
            sideslip_rad=np.arctan2(x[:, VY], x[:, VX]),
            ay_m_s2=ay,
            x_m=nan,
            y_m=nan,
            yaw_rad=nan,
            covariance=covariance,
            sideslip_std_rad=sideslip_std(x[:, VX], x[:, VY], covariance),
            network_trust=nan,
            r_scale=np.ones(count),
            nis=np.where(usable, steps.nis[at], np.nan) if len(steps.nis) else nan,
            nis_dof=np.where(usable, steps.nis_dof[at], 0.0) if len(steps.nis) else np.zeros(count),
            friction=np.where(usable, steps.inputs[at, U_FRICTION], np.nan) if len(steps.nis) else nan,
            valid=usable,
            diverged=np.where(usable, steps.diverged[at], False) if len(steps.nis) else usable,
        )
        newest = int(index[-1]) if count else -1
        waiting = steps.since(max(newest, 0))
        return track, FilterCarry(after.x, after.P, after.memory, after.last_stamp_ns, waiting, after.slip)


def innovation_log_likelihood(estimator: PhysicsUkf, signals: Signals) -> tuple[float, int]:
    """Return the Gaussian log-likelihood of all innovations of a drive and how many scalar innovations it sums.

    A sample beyond the gate counts with the likelihood at the gate: a filter gains nothing by rejecting samples, and
    no single outlier decides.
    """
    steps, _ = estimator.filter_steps(signals, None)
    return float(steps.log_likelihood.sum()), int(np.isfinite(steps.innovation).sum())


def build(name: str, car: Car, options: Options) -> PhysicsUkf:
    """Return ``phy-ukf`` of a car, as it is frozen."""
    del name
    return PhysicsUkf(car.vehicle, use_speed=options.use_speed)
