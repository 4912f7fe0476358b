"""``physics-plus``: the strongest filter on physics alone, with axle forces as states (METHOD §3, §6, §10).

State [v_x, v_y, r, b_ax, f_f, f_r]: what ``phy-ukf`` has, and the axles' lateral forces over the mass, which follow
their tyres with the lag of the relaxation length and feel the load transfer (:mod:`~.lagged_forces`). With
``bias_states`` the biases of a_y, yaw rate and steering angle stand behind. The accelerometer reads (1 + g K_φ) ΣF/m,
moved to the IMU, so that it measures the forces themselves. Inputs, gate, standstill, restart, wheel speed and delay
are those of ``phy-ukf``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from pdhef_logtool.car.nominal_model import ModelParameters, model_parameters
from pdhef_logtool.car.parts import FilterNoise
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.estimators.lagged_forces import (
    ForceParameters,
    force_parameters,
    lagged_measured_ay,
    lagged_planar_ay,
    lagged_rk4_step,
    lagged_substeps,
    settled_forces,
)
from pdhef_logtool.estimators.physics import (
    AX_BIAS,
    BIAS_STATES,
    BIAS_WALK_STD,
    DIVERGED_AVERAGE_S,
    DIVERGED_NIS_CAP,
    DIVERGED_NIS_RATIO,
    DIVERGED_SIDESLIP_RAD,
    GATE_INFLATION,
    GATE_OPENS_AFTER_S,
    GATE_SIGMA,
    INPUTS,
    JUST_REJECTED_S,
    M_AX,
    M_AX_KNOWN,
    M_FRICTION,
    M_INITIALISED,
    M_NIS,
    M_REJECTED,
    M_SPEED,
    M_SPEED_AGE,
    M_STEER,
    M_STEER_AGE,
    M_STILL,
    MEASUREMENTS,
    MEMORY,
    NO_AX_Q_STD,
    RESTART_GAP_S,
    STANDSTILL_AFTER_S,
    STANDSTILL_SILENCE_S,
    STANDSTILL_SPEED_M_S,
    STANDSTILL_STD,
    STANDSTILL_YAW_RATE_RAD_S,
    STEER_HOLD_S,
    U_AX,
    U_AX_KNOWN,
    U_FRICTION,
    U_SPEED,
    U_STEER,
    VX,
    VY,
    YAW_RATE,
    Z_AY,
    Z_SPEED,
    Z_YAW_RATE,
    FilterCarry,
    PosteriorSteps,
    rolls_forward,
    sideslip_std,
)
from pdhef_logtool.estimators.physics import INITIAL_STD as PHYSICS_INITIAL_STD
from pdhef_logtool.estimators.unscented import (
    draw_sigma_points,
    innovation_moments,
    kalman_update,
    mean_and_covariance,
    unscented_weights,
)
from pdhef_logtool.records.release import MAX_PREDICTION_S, released_steps
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.watches.speed_slip import believable

if TYPE_CHECKING:
    from pdhef_logtool.car.car import Car
    from pdhef_logtool.estimators.table import Options

NAME = "physics-plus"

#: Forces over the mass, m/s²; the entries before them are those of ``phy-ukf``.
FRONT_FORCE, REAR_FORCE = AX_BIAS + 1, AX_BIAS + 2
STATES = REAR_FORCE + 1
#: Where the biases stand if there are any; those that only the sensors feel are last.
STEER_BIAS, AY_BIAS, YAW_RATE_BIAS = STATES, STATES + 1, STATES + 2
#: Walk of the biases in that order.
_WALK_STD = (BIAS_WALK_STD[2], BIAS_WALK_STD[0], BIAS_WALK_STD[1])

#: Process noise, 1-sigma per square root of second, of [v_x, v_y, r, b_ax, f_f, f_r], used where the vehicle file has
#: no ``[filter.physics-plus]``. By innovation likelihood over simulated drives, as that of ``phy-ukf``
#: (``studies.defaults.tune_physics_q``, its result in ``results/``).
PHYSICS_PLUS_Q_STD = (0.085, 0.12, 0.012, 0.086, 0.41, 0.41)
INITIAL_STD = (*PHYSICS_INITIAL_STD, 0.5, 0.5)
#: 1-sigma of an axle's force over the mass at a standstill, m/s².
STANDSTILL_FORCE_STD = 0.05


@njit(cache=True)
def _propagate(chi, steer, ax, friction, dt, p, f):  # type: ignore[no-untyped-def]
    """Move sigma points [s, n] by ``dt`` s in place; the biases stay.

    Points that differ from the centre in the sensors' biases alone (the last columns of a lower Cholesky factor) move
    with it.
    """
    n = lagged_substeps(chi[0, VX], dt, friction, p, f)
    size = chi.shape[1]
    biased = size > STATES
    for i in range(chi.shape[0]):
        if i > 0 and (i - 1) % size >= AY_BIAS:
            chi[i, :STATES] = chi[0, :STATES]
            continue
        angle = steer - chi[i, STEER_BIAS] if biased else steer
        vx, vy, r, ff, fr = lagged_rk4_step(
            chi[i, VX], chi[i, VY], chi[i, YAW_RATE], chi[i, FRONT_FORCE], chi[i, REAR_FORCE], angle,
            ax - chi[i, AX_BIAS], friction, dt, n, p, f,
        )  # fmt: skip
        chi[i, VX] = vx
        chi[i, VY] = vy
        chi[i, YAW_RATE] = r
        chi[i, FRONT_FORCE] = ff
        chi[i, REAR_FORCE] = fr


@njit(cache=True)
def _axle_forces(x, angle, friction, p, f):  # type: ignore[no-untyped-def]
    """Return the axles' forces over the mass in state x [n]: its own, or the tyres' at once where nothing lags."""
    if f.relaxation_length_m > 0.0:
        return x[FRONT_FORCE], x[REAR_FORCE]
    return settled_forces(x[VX], x[VY], x[YAW_RATE], angle, friction, p, f)


@njit(cache=True)
def _measure(chi, steer, friction, p, f, zeta):  # type: ignore[no-untyped-def]
    """Write what the sensors would read at sigma points chi [s, n] to zeta [s, 3]."""
    biased = chi.shape[1] > STATES
    for i in range(chi.shape[0]):
        angle = steer - chi[i, STEER_BIAS] if biased else steer
        front, rear = _axle_forces(chi[i], angle, friction, p, f)
        zeta[i, Z_AY] = lagged_measured_ay(chi[i, VX], chi[i, YAW_RATE], front, rear, angle, p)
        zeta[i, Z_YAW_RATE] = chi[i, YAW_RATE]
        zeta[i, Z_SPEED] = chi[i, VX]
        if biased:
            zeta[i, Z_AY] += chi[i, AY_BIAS]
            zeta[i, Z_YAW_RATE] += chi[i, YAW_RATE_BIAS]


@njit(cache=True)
def _add_process_noise(P, q_std, ax_known, dt):  # type: ignore[no-untyped-def]
    for i in range(P.shape[0]):
        q = q_std[i] if i != VX or ax_known else NO_AX_Q_STD
        P[i, i] += q * q * dt


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
def _start(x, P, speed, yaw_rate, steer, friction, initial_std, p, f):  # type: ignore[no-untyped-def]
    """Set x and P at the first sample: the rear axle rolls without slip, the forces are the tyres' steady ones."""
    r = yaw_rate if math.isfinite(yaw_rate) else 0.0
    x[:] = 0.0
    x[VX] = speed
    x[VY] = p.rear_m * r
    x[YAW_RATE] = r
    x[FRONT_FORCE], x[REAR_FORCE] = settled_forces(speed, x[VY], r, steer, friction, p, f)
    P[:, :] = 0.0
    for i in range(x.shape[0]):
        P[i, i] = initial_std[i] ** 2


@njit(cache=True)
def _judge(nu, S, z_ok, dt, memory, at_gate, use):  # type: ignore[no-untyped-def]
    """Decide which samples are used (``use`` [3]); those out of the gate for too long open it (METHOD §6).

    Returns
    -------
    opens, outside : whether the gate opens, whether any sample is beyond it. seen : how many samples there are.
    squares : sum of their normalised squares, each up to the cap.
    """
    opens = False
    outside = False
    seen = 0
    squares = 0.0
    for i in range(MEASUREMENTS):
        use[i] = z_ok[i]
        at_gate[i] = nu[i]
        if memory[M_REJECTED + i] > 0.0:
            memory[M_REJECTED + i] += dt
        if not z_ok[i]:
            continue
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
    return opens, outside, seen, squares


@njit(cache=True)
def _stands(speed, yaw_rate, dt, after_s, memory):  # type: ignore[no-untyped-def]
    """Return whether the vehicle has stood for long enough: the speed sensor reads zero and nothing turns."""
    turns = abs(yaw_rate) > STANDSTILL_YAW_RATE_RAD_S
    if math.isfinite(speed):
        memory[M_SPEED_AGE] = 0.0
        still = abs(speed) < STANDSTILL_SPEED_M_S and not turns
        memory[M_STILL] = memory[M_STILL] + dt if still else 0.0
    elif memory[M_STILL] > 0.0:
        memory[M_SPEED_AGE] += dt
        still = memory[M_SPEED_AGE] <= STANDSTILL_SILENCE_S and not turns
        memory[M_STILL] = memory[M_STILL] + dt if still else 0.0
    return memory[M_STILL] >= after_s


@njit(cache=True)
def _nail_down(x, P):  # type: ignore[no-untyped-def]
    """Set motion and forces of a standing vehicle to zero; the biases keep what they learnt."""
    for i in range(STATES):
        if i == AX_BIAS:
            continue
        x[i] = 0.0
        for j in range(x.shape[0]):
            P[i, j] = 0.0
            P[j, i] = 0.0
        P[i, i] = STANDSTILL_STD[i] ** 2 if i < AX_BIAS else STANDSTILL_FORCE_STD**2


@njit(cache=True)
def _predicted_measurement(  # type: ignore[no-untyped-def]
    chi, x, P, L, steer, friction, wm, wc, scale, r_std, z, p, f, zeta, z_hat, S, Pxz, nu
):  # fmt: skip
    """Write innovation ``nu`` [3], its covariance S [3, 3] with R and the cross covariance, from sigma points anew."""
    draw_sigma_points(x, P, scale, L, chi)
    _measure(chi, steer, friction, p, f, zeta)
    innovation_moments(chi, x, zeta, wm, wc, z_hat, S, Pxz)
    for i in range(MEASUREMENTS):
        S[i, i] += r_std[i] * r_std[i]
        nu[i] = z[i] - z_hat[i]


@njit(cache=True)
def _filter(  # type: ignore[no-untyped-def]
    dt, steer, ax, ay, yaw_rate, speed, friction, use_speed, still_after_s, default_friction, p, f, q_std, r_std,
    initial_std, wm, wc, scale, x, P, memory, out_x, out_P, out_u, out_nis, out_dof, out_ll, out_nu, out_valid,
    out_diverged, out_prior,
):  # fmt: skip
    """Run over one window; x [n], P [n, n] and memory are updated in place. ``dt[k]`` ends at step k, NaN = start."""
    n = x.shape[0]
    chi = np.empty((2 * n + 1, n))
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
    out_nis[:] = math.nan
    out_dof[:] = 0.0
    out_ll[:] = 0.0
    out_nu[:, :] = math.nan
    out_valid[:] = False
    out_diverged[:] = False
    out_prior[:, :] = math.nan
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

        if memory[M_INITIALISED] == 0.0:
            if math.isfinite(z[Z_SPEED]) and math.isfinite(steer[k]):
                _start(x, P, z[Z_SPEED], z[Z_YAW_RATE], steer_k, mu_k, initial_std, p, f)
                memory[M_INITIALISED] = 1.0
                out_valid[k] = True
        else:
            # Inputs of a step: the mean of its two ends; where a_x misses at one end, that of the other.
            ax_step = memory[M_AX] if not has_ax else ax_k if memory[M_AX_KNOWN] == 0.0 else 0.5 * (memory[M_AX] + ax_k)
            ax_known = has_ax or memory[M_AX_KNOWN] > 0.0
            draw_sigma_points(x, P, scale, L, chi)
            _propagate(chi, 0.5 * (memory[M_STEER] + steer_k), ax_step, 0.5 * (memory[M_FRICTION] + mu_k), dt[k], p, f)
            mean_and_covariance(chi, wm, wc, x, P)
            _add_process_noise(P, q_std, ax_known, dt[k])
            alive = _all_finite(x, P)
            out_prior[k] = x
            if alive:
                _predicted_measurement(
                    chi, x, P, L, steer_k, mu_k, wm, wc, scale, r_std, z, p, f, zeta, z_hat, S, Pxz, nu
                )  # fmt: skip
                for i in range(MEASUREMENTS):
                    given[i] = math.isfinite(nu[i]) and (i != Z_AY or steer_ok)
                    if given[i]:
                        out_nu[k, i] = nu[i]
                opens, outside, seen, squares = _judge(nu, S, given, dt[k], memory, at_gate, use)
                if outside:  # a sample counts in the likelihood even if rejected, as if it stood at the gate
                    _, _, likelihood_at_gate = kalman_update(x.copy(), P.copy(), at_gate, S, Pxz, given)
                    out_ll[k] = likelihood_at_gate
                if opens:
                    P *= GATE_INFLATION
                    _predicted_measurement(
                        chi, x, P, L, steer_k, mu_k, wm, wc, scale, r_std, z, p, f, zeta, z_hat, S, Pxz, nu
                    )  # fmt: skip
                    for i in range(MEASUREMENTS):
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
                if _stands(z[Z_SPEED], z[Z_YAW_RATE], dt[k], still_after_s, memory):
                    _nail_down(x, P)
                alive = _all_finite(x, P)
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
        out_x[k] = x
        out_P[k] = P
        out_u[k, U_STEER] = steer_k
        out_u[k, U_AX] = ax_k
        out_u[k, U_FRICTION] = mu_k
        out_u[k, U_AX_KNOWN] = memory[M_AX_KNOWN]
        out_u[k, U_SPEED] = memory[M_SPEED] if use_speed else 0.0


@njit(cache=True)
def _predict_outputs(step, horizon_s, x, P, inputs, p, f, q_std, wm, wc, scale, out_x, out_P, out_ay):  # type: ignore[no-untyped-def]
    """Predict step ``step[m]`` by ``horizon_s[m]`` with its inputs held; writes state, covariance and planar a_y."""
    n = x.shape[1]
    chi = np.empty((2 * n + 1, n))
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
            _propagate(chi, inputs[k, U_STEER], inputs[k, U_AX], inputs[k, U_FRICTION], horizon_s[m], p, f)
            mean_and_covariance(chi, wm, wc, xm, Pm)
            _add_process_noise(Pm, q_std, inputs[k, U_AX_KNOWN] > 0.0, horizon_s[m])
            if not _all_finite(xm, Pm):
                xm[:] = math.nan
                Pm[:, :] = math.nan
        out_x[m] = xm
        out_P[m] = Pm
        angle = inputs[k, U_STEER] - xm[STEER_BIAS] if n > STATES else inputs[k, U_STEER]
        front, rear = _axle_forces(xm, angle, inputs[k, U_FRICTION], p, f)
        out_ay[m] = lagged_planar_ay(xm[VX], xm[YAW_RATE], front, rear, angle, p)


@dataclass(frozen=True, slots=True)
class PhysicsPlusUkf:
    """The filter of this file as an estimator.

    Parameters
    ----------
    vehicle : parameters; ``sensors`` gives R unless ``r_std`` does, and the priors of the biases.
    q_std : process 1-sigma per √s of [v_x, v_y, r, b_ax, f_f, f_r], forces over mass in m/s².
    r_std : 1-sigma of [a_y, r, v_x].
    use_speed : False is the paper's ``esp`` suite: the speed sensor only starts the filter.
    bias_states : estimate the biases of a_y, yaw rate and steering angle, whose priors stand in ``sensors``.
    slip_gate : leave out the speed of wheels that spin or lock (:mod:`~.speed_slip`).
    standstill : hold the motion at zero while the car stands.
    """

    vehicle: VehicleParameters
    q_std: tuple[float, ...] = PHYSICS_PLUS_Q_STD
    r_std: tuple[float, float, float] | None = None
    use_speed: bool = True
    roll_correction: bool = True
    bias_states: bool = True
    slip_gate: bool = True
    standstill: bool = True
    name: str = NAME
    causal: bool = True

    @property
    def needs(self) -> frozenset[str]:
        """Aligned signals without which the filter cannot run; a_x is replaced by a random walk if missing."""
        return frozenset({"steer_rad", "ay_m_s2", "yaw_rate_rad_s", "speed_m_s"})

    @property
    def measurement_std(self) -> FloatArray:
        """1-sigma of [a_y, r, v_x], [3]."""
        s = self.vehicle.sensors
        return np.array(self.r_std or (s.ay_std_m_s2, s.yaw_rate_std_rad_s, s.speed_std_m_s))

    @property
    def _parameters(self) -> tuple[ModelParameters, ForceParameters]:
        return model_parameters(self.vehicle, roll_correction=self.roll_correction), force_parameters(self.vehicle)

    @property
    def _process_std(self) -> FloatArray:
        return np.array([*self.q_std, *(_WALK_STD if self.bias_states else ())])

    @property
    def _initial_std(self) -> FloatArray:
        s = self.vehicle.sensors
        biases = (s.steer_bias_std_rad, s.ay_bias_std_m_s2, s.yaw_rate_bias_std_rad_s)
        return np.array([*INITIAL_STD, *(biases if self.bias_states else ())])

    def filter_steps(self, signals: Signals, carry: FilterCarry | None) -> tuple[PosteriorSteps, FilterCarry]:
        """Run the filter on measurement time only; the steps and the carry with no pending steps in it."""
        signals, slip = believable(
            signals, self.vehicle.sensors.speed_std_m_s, carry.slip if carry else None, gate=self.slip_gate
        )
        count = len(signals)
        n = STATES + (BIAS_STATES if self.bias_states else 0)
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
            residual_rate=np.zeros((count, 2)),
        )
        wm, wc, scale = unscented_weights(n)
        _filter(
            dt, signals.steer_rad, signals.ax_m_s2, signals.ay_m_s2, signals.yaw_rate_rad_s, signals.speed_m_s,
            signals.friction, self.use_speed, STANDSTILL_AFTER_S if self.standstill else math.inf,
            self.vehicle.assumed_friction, *self._parameters, self._process_std,
            self.measurement_std, self._initial_std, wm, wc, scale[0], x, P, memory, steps.x, steps.P, steps.inputs,
            steps.nis, steps.nis_dof, steps.log_likelihood, steps.innovation, steps.valid, steps.diverged, steps.prior,
        )  # fmt: skip
        last = int(signals.stamps_ns[-1]) if count else (carry.last_stamp_ns if carry else 0)
        return steps, FilterCarry(x=x, P=P, memory=memory, last_stamp_ns=last, steps=steps.since(count), slip=slip)

    def run(self, signals: Signals, carry: FilterCarry | None) -> tuple[StateTrack, FilterCarry]:
        """Filter one window and predict the output to its stamps (see :class:`~.base.Estimator`)."""
        steps, after = self.filter_steps(signals, carry)
        if carry is not None:
            steps = carry.steps.joined(steps)
        index = released_steps(steps.ready_ns, signals.stamps_ns)
        horizon = np.where(index >= 0, (signals.stamps_ns - steps.stamps_ns[np.maximum(index, 0)]) * 1e-9, np.nan)
        usable = (index >= 0) & (horizon <= MAX_PREDICTION_S)
        usable[usable] &= steps.valid[index[usable]]
        chosen = np.where(usable, index, -1)
        count, n = len(signals), steps.x.shape[1]
        x, P, ay = np.empty((count, n)), np.empty((count, n, n)), np.empty(count)
        wm, wc, scale = unscented_weights(n)
        _predict_outputs(
            chosen, horizon, steps.x, steps.P, steps.inputs, *self._parameters, self._process_std, wm, wc, scale[0],
            x, P, ay,
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


def physics_plus(
    vehicle: VehicleParameters, noise: FilterNoise | None = None, *, use_speed: bool = True
) -> PhysicsPlusUkf:
    """Return the filter with a noise; what that leaves out is :data:`PHYSICS_PLUS_Q_STD` and the sensors' noise."""
    sensors = vehicle.sensors
    if noise is None:
        return PhysicsPlusUkf(vehicle, use_speed=use_speed)
    return PhysicsPlusUkf(
        vehicle,
        q_std=(*noise.q_std, *PHYSICS_PLUS_Q_STD[len(noise.q_std) :]),
        r_std=(
            noise.r_std.get("ay_m_s2", sensors.ay_std_m_s2),
            noise.r_std.get("yaw_rate_rad_s", sensors.yaw_rate_std_rad_s),
            noise.r_std.get("speed_m_s", sensors.speed_std_m_s),
        ),
        use_speed=use_speed,
    )


def build(name: str, car: Car, options: Options) -> PhysicsPlusUkf:
    """Return ``physics-plus`` of a car, with its noise where the car has one."""
    return physics_plus(car.vehicle, car.noise.get(name), use_speed=options.use_speed)
