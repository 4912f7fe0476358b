"""``phy-ukf``: the pure physics unscented Kalman filter on the nominal single-track model (docs/method.md#filter).

State [v_x, v_y, r, b_ax]; b_ax is a slow bias of the longitudinal accelerometer (grade, pitch). Measurements
[a_y, r, v_x]; each may be missing at any step. Without options this is the paper's physics baseline and
frozen: R at sensor level from the vehicle file, Q by innovation likelihood.
Everything that is not the model is in :mod:`~.filter_base`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

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
from pdhef_logtool.car.parts import FilterNoise
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.estimators import filter_base as base
from pdhef_logtool.estimators.unscented import (
    draw_sigma_points,
    innovation_moments,
    kalman_update,
    mean_and_covariance,
)

if TYPE_CHECKING:
    from pdhef_logtool.car.car import Car
    from pdhef_logtool.estimators.presets import Options

#: The variant with the noise of an identified car.
TUNED = "phy-ukf:tuned"
#: Process noise, 1-sigma per square root of second, of v_x, v_y, r and the a_x bias. Chosen by innovation likelihood
#: over simulated drives and frozen: the drives were
#: those of the simulator's first, planar vehicle, and a baseline does not follow every change of the simulator.
PHY_UKF_Q_STD = (0.089, 0.31, 0.062, 0.021)


@njit(cache=True)
def _propagate(chi, over, rate, dt, p, points):  # type: ignore[no-untyped-def]
    """Move sigma points [s, n] by ``dt`` s through the nominal model and add the residual (Eq 19), in place.

    Half of the residual's increment is added before the model's step and half after it: all of it at the end, as Eq 19
    has it, would leave the tyres' answer to it out of the step, 3 % of a residual at 25 m/s and 10 ms. A residual
    counts in the dynamic range of the model, not in the kinematic one. ``over`` are the inputs
    (:class:`~.filter_base.HeldInputs`), ``rate`` the residual of v̇_y and ṙ, ``points`` [work_size(s)] is work space.
    """
    rate_vy, rate_r = rate
    share = 0.5 * dynamic_share(chi[0, 0], p) * dt
    set_points(chi, over.steer, over.ax, (share * rate_vy, share * rate_r), points)
    advance_points(points, over.friction, dt, substeps(chi[0, 0], dt, over.friction, p), p)
    for i in range(chi.shape[0]):
        place_i = place(i)
        chi[i, base.VX] = points[place_i + AT_VX]
        chi[i, base.VY] = points[place_i + AT_VY] + share * rate_vy
        chi[i, base.YAW_RATE] = points[place_i + AT_YAW_RATE] + share * rate_r


@njit(cache=True)
def set_points(chi, steer, ax, more, points):  # type: ignore[no-untyped-def]
    """Write sigma points [s, n] to ``points``, with increments of v_y and r; the rest is filled.

    The rest of the last block repeats the first point: numbers that cannot overflow.
    """
    more_vy, more_r = more
    s = chi.shape[0]
    for column in range(place_count(points)):
        i = column if column < s else 0
        column_place = place(column)
        points[column_place + AT_VX] = chi[i, base.VX]
        points[column_place + AT_VY] = chi[i, base.VY] + more_vy
        points[column_place + AT_YAW_RATE] = chi[i, base.YAW_RATE] + more_r
        points[column_place + AT_STEER] = steer
        points[column_place + AT_AX] = ax - chi[i, base.AX_BIAS]


@njit(cache=True)
def measure_sigma_points(chi, steer, friction, rate_vy, p, points, zeta):  # type: ignore[no-untyped-def]
    """Write the sensor readings at sigma points chi [s, n] to zeta [s, 3]; a_y includes the residual."""
    residual = (1.0 + p.ay_roll_gain) * dynamic_share(chi[0, 0], p) * rate_vy
    set_points(chi, steer, 0.0, (0.0, 0.0), points)
    measure_points(points, friction, p)
    for i in range(chi.shape[0]):
        place_i = place(i)
        zeta[i, base.Z_AY] = points[place_i + AT_AY] + residual
        zeta[i, base.Z_YAW_RATE] = chi[i, base.YAW_RATE]
        zeta[i, base.Z_SPEED] = chi[i, base.VX]


@njit(cache=True)
def _cross_covariance(chi_before, chi, x_after, wc, out):  # type: ignore[no-untyped-def]
    """Write the covariance [n, n] between the sigma points before a step (rows) and after it (mean x_after).

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
def _filter(window, tuning, p, estimate, out, links):  # type: ignore[no-untyped-def]
    """Run over one window; ``estimate`` is moved in place. ``links`` are of length 0 where nobody asks for them."""
    dt, steer, ax, ay, yaw_rate, speed, friction, residual_rate, extra_r = window
    q_std, r_std, initial_std, standstill_std, wm, wc, scale, rules = tuning
    x, P, memory = estimate
    out_x, out_P, out_inputs, out_nis, out_dof, out_likelihood, out_nu, out_valid, out_diverged, out_prior = out
    out_link, out_predicted_P, out_cross = links
    linked = out_link.shape[0] > 0
    n = x.shape[0]
    chi, L, zeta, z_hat, S, Pxz, nu, at_gate, given, use = base.make_work(n)
    chi_before = np.empty((2 * n + 1, n))
    points = np.empty(work_size(2 * n + 1))
    for k in range(dt.shape[0]):
        sample = base.Sample(dt[k], steer[k], ax[k], ay[k], yaw_rate[k], speed[k], friction[k])
        now = base.begin_step(sample, rules, memory)
        if memory[base.M_INITIALISED] == 0.0:
            out_valid[k] = base.starts(now, p.rear_m, initial_std, x, P, memory)
        else:
            rate_vy, rate_r = memory[base.M_RATE_VY], memory[base.M_RATE_R]
            draw_sigma_points(x, P, scale, L, chi)
            if linked:
                chi_before[:, :] = chi
            over = base.held_over_step(now, memory)
            _propagate(chi, over, (rate_vy, rate_r), now.dt, p, points)
            mean_and_covariance(chi, wm, wc, x, P)
            if linked:
                _cross_covariance(chi_before, chi, x, wc, out_cross[k])
            base.add_process_noise(P, q_std, over.ax_known, now.dt)
            alive = base.all_finite(x, P)
            if linked:
                out_predicted_P[k] = P
            for i in range(n):
                out_prior[k, i] = x[i]
            if alive:
                draw_sigma_points(x, P, scale, L, chi)
                measure_sigma_points(chi, now.steer, now.friction, rate_vy, p, points, zeta)
                innovation_moments(chi, x, zeta, wm, wc, z_hat, S, Pxz)
                base.innovate(k, now, r_std, extra_r, z_hat, S, nu)
                gated = base.gate(now, memory, nu, S, at_gate, given, use)
                for i in range(base.MEASUREMENTS):
                    if given[i]:
                        out_nu[k, i] = nu[i]
                if gated.outside:  # a sample counts in the likelihood even if rejected, as if it stood at the gate
                    _, _, out_likelihood[k] = kalman_update(x.copy(), P.copy(), at_gate, S, Pxz, given)
                if gated.opens:
                    for i in range(n):
                        for j in range(n):
                            P[i, j] *= base.GATE_INFLATION
                    if linked:  # to a smoother the inflation is process noise of the step that led here
                        out_predicted_P[k] = P
                    draw_sigma_points(x, P, scale, L, chi)
                    measure_sigma_points(chi, now.steer, now.friction, rate_vy, p, points, zeta)
                    innovation_moments(chi, x, zeta, wm, wc, z_hat, S, Pxz)
                    base.innovate(k, now, r_std, extra_r, z_hat, S, nu)
                    base.open_gate(use, memory)
                nis, dof, likelihood = kalman_update(x, P, nu, S, Pxz, use)
                if dof > 0:
                    out_nis[k] = nis
                    out_dof[k] = dof
                    if not gated.outside:
                        out_likelihood[k] = likelihood
                base.settle(now, gated, rules, standstill_std, x, P, memory)
                alive = base.all_finite(x, P)
            out_valid[k] = alive and now.steer_ok
            out_diverged[k] = not alive or base.diverges(rules, x, memory)
            if not alive:
                memory[base.M_INITIALISED] = 0.0
            elif linked:
                out_link[k] = base.LINK_BIASES if memory[base.M_STILL] >= rules.still_after_s else base.LINK_WHOLE
        base.finish_step(k, now, residual_rate, rules, memory, out_inputs)
        for i in range(n):
            out_x[k, i] = x[i]
            for j in range(n):
                out_P[k, i, j] = P[i, j]


@njit(cache=True)
def _predict_outputs(due, held, tuning, p, predicted):  # type: ignore[no-untyped-def]
    """Predict the steps that are due with their inputs held; writes state, covariance and planar a_y."""
    step, horizon_s = due
    held_x, held_P, inputs, residual_rate = held
    out_x, out_P, out_ay = predicted
    q_std, _, _, _, wm, wc, scale, _ = tuning
    n = held_x.shape[1]
    chi = np.empty((2 * n + 1, n))
    points = np.empty(work_size(2 * n + 1))
    L = np.empty((n, n))
    x = np.empty(n)
    P = np.empty((n, n))
    for m in range(step.shape[0]):
        k = step[m]
        if k < 0:
            continue
        x[:] = held_x[k]
        P[:, :] = held_P[k]
        rate_vy, rate_r = residual_rate[k, 0], residual_rate[k, 1]
        over = base.held_inputs(inputs, k)
        if horizon_s[m] > 0.0:
            draw_sigma_points(x, P, scale, L, chi)
            _propagate(chi, over, (rate_vy, rate_r), horizon_s[m], p, points)
            mean_and_covariance(chi, wm, wc, x, P)
            base.add_process_noise(P, q_std, over.ax_known, horizon_s[m])
            if not base.all_finite(x, P):
                x[:] = math.nan
                P[:, :] = math.nan
        out_x[m] = x
        out_P[m] = P[:3, :3]
        ay = planar_lateral_acceleration(x[base.VX], x[base.VY], x[base.YAW_RATE], over.steer, over.friction, p)
        out_ay[m] = ay + dynamic_share(x[base.VX], p) * rate_vy


@dataclass(frozen=True, slots=True)
class PhysicsUkf(base.LinkedFilter):
    """The filter of this file as an estimator.

    Parameters
    ----------
    vehicle : parameters; ``sensors`` gives R unless ``r_std`` does.
    q_std : process 1-sigma per √s of [v_x, v_y, r, b_ax].
    use_speed : False is the paper's ``esp`` suite: the speed sensor only starts the filter.
    slip_gate : leave out the speed of wheels that spin or lock (:mod:`~.speed_slip`).
    standstill : contain v_x, v_y and r at zero while the car is.
    """

    algorithm = "physics-ukf"
    version = 1
    options = ("roll_correction", "slip_gate", "standstill")

    vehicle: VehicleParameters
    q_std: tuple[float, float, float, float] = PHY_UKF_Q_STD
    r_std: tuple[float, float, float] | None = None
    use_speed: bool = True
    roll_correction: bool = False
    slip_gate: bool = True
    standstill: bool = True
    name: str = "phy-ukf"
    causal: bool = True

    @property
    def _parameters(self) -> ModelParameters:
        return model_parameters(self.vehicle, roll_correction=self.roll_correction)

    @property
    def _tuning(self) -> base.Tuning:
        return base.make_tuning(
            self.vehicle,
            self.q_std,
            self.measurement_std,
            base.INITIAL_STD,
            use_speed=self.use_speed,
            standstill=self.standstill,
        )

    def _run_kernel(
        self,
        window: base.Window,
        tuning: base.Tuning,
        estimate: base.StateEstimate,
        out: base.Posterior,
        links: base.LinkColumns,
    ) -> None:
        _filter(window, tuning, self._parameters, estimate, out, links)

    def _predict_kernel(
        self, pending: base.PendingPredictions, start: base.PredictionStart, predicted: base.Predicted
    ) -> None:
        _predict_outputs(pending, start, self._tuning, self._parameters, predicted)


def physics_ukf_tuned(vehicle: VehicleParameters, noise: FilterNoise, *, use_speed: bool = True) -> PhysicsUkf:
    """Return ``phy-ukf:tuned``: with the car's noise (the rest is ``phy-ukf``'s) and the roll correction."""
    q = (*noise.q_std, *PHY_UKF_Q_STD[len(noise.q_std) :])
    return PhysicsUkf(
        vehicle,
        q_std=(q[0], q[1], q[2], q[3]),
        r_std=noise.measurement_std(vehicle.sensors),
        use_speed=use_speed,
        roll_correction=True,
        name=TUNED,
    )


def build(name: str, car: Car, options: Options) -> PhysicsUkf:
    """Return the frozen ``phy-ukf`` of a car, or its variant ``tuned`` with the car's noise."""
    if name == TUNED:
        return physics_ukf_tuned(car.vehicle, car.noise[name], use_speed=options.use_speed)
    return PhysicsUkf(car.vehicle, use_speed=options.use_speed)
