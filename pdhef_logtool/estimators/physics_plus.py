"""``physics-plus``: the strongest filter on physics alone, with axle forces as states (METHOD §3, §6, §10).

State [v_x, v_y, r, b_ax, f_f, f_r]: what ``phy-ukf`` has, and the axles' lateral forces over the mass, which follow
their tyres with the lag of the relaxation length and feel the load transfer (:mod:`~.lagged_forces`). With
``bias_states`` the biases of a_y, yaw rate and steering angle stand behind. The accelerometer reads (1 + g K_φ) ΣF/m,
moved to the IMU, so that it measures the forces themselves. Inputs, gate, standstill, restart, wheel speed and delay
are those of ``phy-ukf``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pdhef_logtool.car.nominal_model import ModelParameters, model_parameters
from pdhef_logtool.car.parts import FilterNoise
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.estimators import filter_shell as shell
from pdhef_logtool.estimators.lagged_forces import (
    ForceParameters,
    force_parameters,
    lagged_measured_ay,
    lagged_planar_ay,
    lagged_rk4_step,
    lagged_substeps,
    settled_forces,
)
from pdhef_logtool.estimators.physics import BIAS_WALK_STD, FilterCarry
from pdhef_logtool.estimators.unscented import (
    draw_sigma_points,
    innovation_moments,
    kalman_update,
    mean_and_covariance,
)
from pdhef_logtool.records.compiled import njit
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.watches.speed_slip import believable

if TYPE_CHECKING:
    from pdhef_logtool.car.car import Car
    from pdhef_logtool.estimators.table import Options

NAME = "physics-plus"

#: Forces over the mass, m/s²; the entries before them are those of ``phy-ukf``.
FRONT_FORCE, REAR_FORCE = shell.AX_BIAS + 1, shell.AX_BIAS + 2
STATES = REAR_FORCE + 1
#: Where the biases stand if there are any; those that only the sensors feel are last.
STEER_BIAS, AY_BIAS, YAW_RATE_BIAS = STATES, STATES + 1, STATES + 2
#: Walk of the biases in that order.
_WALK_STD = (BIAS_WALK_STD[2], BIAS_WALK_STD[0], BIAS_WALK_STD[1])

#: Process noise, 1-sigma per square root of second, of [v_x, v_y, r, b_ax, f_f, f_r], used where the vehicle file has
#: no ``[filter.physics-plus]``. By innovation likelihood over simulated drives, as that of ``phy-ukf``
#: (``studies.defaults.tune_physics_q``, its result in ``results/``).
PHYSICS_PLUS_Q_STD = (0.085, 0.12, 0.012, 0.086, 0.41, 0.41)
INITIAL_STD = (*shell.INITIAL_STD, 0.5, 0.5)
#: 1-sigma of an axle's force over the mass at a standstill, m/s².
STANDSTILL_FORCE_STD = 0.05


@njit(cache=True)
def _propagate(chi, over, dt, p, f):  # type: ignore[no-untyped-def]
    """Move sigma points [s, n] by ``dt`` s in place; the biases stay.

    Points that differ from the centre in the sensors' biases alone (the last columns of a lower Cholesky factor) move
    with it.
    """
    n = lagged_substeps(chi[0, shell.VX], dt, over.friction, p, f)
    size = chi.shape[1]
    biased = size > STATES
    for i in range(chi.shape[0]):
        if i > 0 and (i - 1) % size >= AY_BIAS:
            chi[i, :STATES] = chi[0, :STATES]
            continue
        angle = over.steer - chi[i, STEER_BIAS] if biased else over.steer
        vx, vy, r, ff, fr = lagged_rk4_step(
            chi[i, shell.VX], chi[i, shell.VY], chi[i, shell.YAW_RATE], chi[i, FRONT_FORCE], chi[i, REAR_FORCE], angle,
            over.ax - chi[i, shell.AX_BIAS], over.friction, dt, n, p, f,
        )  # fmt: skip
        chi[i, shell.VX] = vx
        chi[i, shell.VY] = vy
        chi[i, shell.YAW_RATE] = r
        chi[i, FRONT_FORCE] = ff
        chi[i, REAR_FORCE] = fr


@njit(cache=True)
def _axle_forces(x, angle, friction, p, f):  # type: ignore[no-untyped-def]
    """Return the axles' forces over the mass in state x [n]: its own, or the tyres' at once where nothing lags."""
    if f.relaxation_length_m > 0.0:
        return x[FRONT_FORCE], x[REAR_FORCE]
    return settled_forces(x[shell.VX], x[shell.VY], x[shell.YAW_RATE], angle, friction, p, f)


@njit(cache=True)
def _measure(chi, steer, friction, p, f, zeta):  # type: ignore[no-untyped-def]
    """Write what the sensors would read at sigma points chi [s, n] to zeta [s, 3]."""
    biased = chi.shape[1] > STATES
    for i in range(chi.shape[0]):
        angle = steer - chi[i, STEER_BIAS] if biased else steer
        front, rear = _axle_forces(chi[i], angle, friction, p, f)
        zeta[i, shell.Z_AY] = lagged_measured_ay(chi[i, shell.VX], chi[i, shell.YAW_RATE], front, rear, angle, p)
        zeta[i, shell.Z_YAW_RATE] = chi[i, shell.YAW_RATE]
        zeta[i, shell.Z_SPEED] = chi[i, shell.VX]
        if biased:
            zeta[i, shell.Z_AY] += chi[i, AY_BIAS]
            zeta[i, shell.Z_YAW_RATE] += chi[i, YAW_RATE_BIAS]


@njit(cache=True)
def _filter(window, tuning, p, f, belief, out):  # type: ignore[no-untyped-def]
    """Run over one window; ``belief`` is moved in place."""
    dt, steer, ax, ay, yaw_rate, speed, friction, residual_rate, extra_r = window
    q_std, r_std, initial_std, standstill_std, wm, wc, scale, rules = tuning
    x, P, memory = belief
    out_x, out_P, out_inputs, out_nis, out_dof, out_likelihood, out_nu, out_valid, out_diverged, out_prior = out
    n = x.shape[0]
    chi, L, zeta, z_hat, S, Pxz, nu, at_gate, given, use = shell.make_work(n)
    for k in range(dt.shape[0]):
        sample = shell.Sample(dt[k], steer[k], ax[k], ay[k], yaw_rate[k], speed[k], friction[k])
        now = shell.begin_step(sample, rules, memory)
        if memory[shell.M_INITIALISED] == 0.0:
            out_valid[k] = shell.starts(now, p.rear_m, initial_std, x, P, memory)
            if out_valid[k]:  # the forces are the tyres' steady ones
                x[FRONT_FORCE], x[REAR_FORCE] = settled_forces(
                    x[shell.VX], x[shell.VY], x[shell.YAW_RATE], now.steer, now.friction, p, f
                )
        else:
            over = shell.meanwhile(now, memory)
            draw_sigma_points(x, P, scale, L, chi)
            _propagate(chi, over, now.dt, p, f)
            mean_and_covariance(chi, wm, wc, x, P)
            shell.add_process_noise(P, q_std, over.ax_known, now.dt)
            alive = shell.all_finite(x, P)
            out_prior[k] = x
            if alive:
                draw_sigma_points(x, P, scale, L, chi)
                _measure(chi, now.steer, now.friction, p, f, zeta)
                innovation_moments(chi, x, zeta, wm, wc, z_hat, S, Pxz)
                shell.innovate(k, now, r_std, extra_r, z_hat, S, nu)
                verdict = shell.gate(now, memory, nu, S, at_gate, given, use)
                for i in range(shell.MEASUREMENTS):
                    if given[i]:
                        out_nu[k, i] = nu[i]
                if verdict.outside:  # a sample counts in the likelihood even if rejected, as if it stood at the gate
                    _, _, out_likelihood[k] = kalman_update(x.copy(), P.copy(), at_gate, S, Pxz, given)
                if verdict.opens:
                    P *= shell.GATE_INFLATION
                    draw_sigma_points(x, P, scale, L, chi)
                    _measure(chi, now.steer, now.friction, p, f, zeta)
                    innovation_moments(chi, x, zeta, wm, wc, z_hat, S, Pxz)
                    shell.innovate(k, now, r_std, extra_r, z_hat, S, nu)
                    shell.open_gate(use, memory)
                nis, dof, likelihood = kalman_update(x, P, nu, S, Pxz, use)
                if dof > 0:
                    out_nis[k] = nis
                    out_dof[k] = dof
                    if not verdict.outside:
                        out_likelihood[k] = likelihood
                shell.settle(now, verdict, rules, standstill_std, x, P, memory)
                alive = shell.all_finite(x, P)
            out_valid[k] = alive and now.steer_ok
            out_diverged[k] = not alive or shell.diverges(rules, x, memory)
            if not alive:
                memory[shell.M_INITIALISED] = 0.0
        shell.finish_step(k, now, residual_rate, rules, memory, out_inputs)
        out_x[k] = x
        out_P[k] = P


@njit(cache=True)
def _predict_outputs(due, held, tuning, p, f, predicted):  # type: ignore[no-untyped-def]
    """Predict the steps that are due with their inputs held; writes state, covariance and planar a_y."""
    step, horizon_s = due
    held_x, held_P, inputs, _ = held
    out_x, out_P, out_ay = predicted
    q_std, _, _, _, wm, wc, scale, _ = tuning
    n = held_x.shape[1]
    chi = np.empty((2 * n + 1, n))
    L = np.empty((n, n))
    x = np.empty(n)
    P = np.empty((n, n))
    for m in range(step.shape[0]):
        k = step[m]
        if k < 0:
            out_x[m, :] = math.nan
            out_P[m, :, :] = math.nan
            out_ay[m] = math.nan
            continue
        x[:] = held_x[k]
        P[:, :] = held_P[k]
        over = shell.held_inputs(inputs, k)
        if horizon_s[m] > 0.0:
            draw_sigma_points(x, P, scale, L, chi)
            _propagate(chi, over, horizon_s[m], p, f)
            mean_and_covariance(chi, wm, wc, x, P)
            shell.add_process_noise(P, q_std, over.ax_known, horizon_s[m])
            if not shell.all_finite(x, P):
                x[:] = math.nan
                P[:, :] = math.nan
        out_x[m] = x
        out_P[m] = P
        angle = over.steer - x[STEER_BIAS] if n > STATES else over.steer
        front, rear = _axle_forces(x, angle, over.friction, p, f)
        out_ay[m] = lagged_planar_ay(x[shell.VX], x[shell.YAW_RATE], front, rear, angle, p)


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
    def measurement_std(self) -> FloatArray:
        """1-sigma of [a_y, r, v_x], [3]."""
        return np.array(self.r_std or self.vehicle.sensors.measurement_std)

    @property
    def _parameters(self) -> tuple[ModelParameters, ForceParameters]:
        return model_parameters(self.vehicle, roll_correction=self.roll_correction), force_parameters(self.vehicle)

    @property
    def _tuning(self) -> shell.Tuning:
        s = self.vehicle.sensors
        biases = (s.steer_bias_std_rad, s.ay_bias_std_m_s2, s.yaw_rate_bias_std_rad_s)
        return shell.make_tuning(
            self.vehicle,
            (*self.q_std, *(_WALK_STD if self.bias_states else ())),
            self.measurement_std,
            (*INITIAL_STD, *(biases if self.bias_states else ())),
            (*shell.STANDSTILL_STD, STANDSTILL_FORCE_STD, STANDSTILL_FORCE_STD),
            use_speed=self.use_speed,
            standstill=self.standstill,
        )

    def filter_steps(self, signals: Signals, carry: FilterCarry | None) -> tuple[shell.PosteriorSteps, FilterCarry]:
        """Run the filter on measurement time only; the steps and the carry with no pending steps in it."""
        speed_std_m_s = self.vehicle.sensors.speed_std_m_s
        signals, slip = believable(signals, speed_std_m_s, carry.slip if carry else None, gate=self.slip_gate)
        window, tuning = shell.make_window(signals, carry), self._tuning
        belief, out = (
            shell.resume(carry, len(tuning.initial_std)),
            shell.no_posterior(len(signals), len(tuning.initial_std)),
        )
        _filter(window, tuning, *self._parameters, belief, out)
        steps = shell.PosteriorSteps(signals.stamps_ns, signals.ready_ns, *out, window.residual_rate)
        return steps, shell.carry_on(belief, steps, carry, slip)

    def run(self, signals: Signals, carry: FilterCarry | None) -> tuple[StateTrack, FilterCarry]:
        """Filter one window and predict the output to its stamps (see :class:`~.base.Estimator`)."""
        steps, after = self.filter_steps(signals, carry)
        if carry is not None:
            steps = carry.steps.joined(steps)
        held = shell.Held(steps.x, steps.P, steps.inputs, steps.residual_rate)

        def predict(due: shell.Due, predicted: shell.Predicted) -> None:
            _predict_outputs(due, held, self._tuning, *self._parameters, predicted)

        track, released = shell.released_track(self.name, signals.stamps_ns, steps, predict)
        return track, replace(after, steps=steps.since(released.needed))


def physics_plus(
    vehicle: VehicleParameters, noise: FilterNoise | None = None, *, use_speed: bool = True
) -> PhysicsPlusUkf:
    """Return the filter with a noise; what that leaves out is :data:`PHYSICS_PLUS_Q_STD` and the sensors' noise."""
    if noise is None:
        return PhysicsPlusUkf(vehicle, use_speed=use_speed)
    return PhysicsPlusUkf(
        vehicle,
        q_std=(*noise.q_std, *PHYSICS_PLUS_Q_STD[len(noise.q_std) :]),
        r_std=noise.measurement_std(vehicle.sensors),
        use_speed=use_speed,
    )


def build(name: str, car: Car, options: Options) -> PhysicsPlusUkf:
    """Return ``physics-plus`` of a car, with its noise where the car has one."""
    return physics_plus(car.vehicle, car.noise.get(name), use_speed=options.use_speed)
