"""``physics``: the strongest filter on physics alone, with the parts that a car's driving gives evidence for.

An unscented filter on the model of :mod:`~.physics_model` (METHOD §6, §16). As the axles' forces and the roll are
states, what the sensors read is linear in the state but for a lever arm's r²: the update takes the derivative, which
for a linear function is what the sigma points give. Points that differ in the sensors' biases alone move with their
centre. With ``jacobian`` the time update takes derivatives too, by differences of the model, and is an extended filter.

A residual rate of v̇_y and ṙ enters as in ``phy-ukf``: half before and half after the model's step, and in the
predicted a_y, times the force scale where that is a state. Zeros change no bit.

Inputs, gate, standstill, restart, wheel speed and delay are those of ``phy-ukf``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pdhef_logtool.car.nominal_model import ModelParameters, dynamic_share, model_parameters
from pdhef_logtool.car.parts import PHYSICS, FilterNoise
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters, corrected_anew
from pdhef_logtool.estimators import filter_shell as shell
from pdhef_logtool.estimators.physics import (
    BIAS_WALK_STD,
    FORCE_SCALE_STD,
    LINK_NONE,
    LINK_WHOLE,
    FilterCarry,
    LinkColumns,
    StepLinks,
    add_process_noise,
)
from pdhef_logtool.estimators.physics_model import (
    AX_BIAS,
    BANK_TIME_S,
    CORE,
    FRONT,
    REAR,
    VX,
    VY,
    YAW_RATE,
    Layout,
    PhysicsParameters,
    advance,
    layout_of,
    physics_parameters,
    planar_ay,
    sensed_ay,
    settle_forces,
    step_count,
)
from pdhef_logtool.estimators.unscented import cholesky_lower, kalman_update, repair_covariance
from pdhef_logtool.records.compiled import njit
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.watches.speed_slip import believable

if TYPE_CHECKING:
    from pdhef_logtool.car.car import Car

#: Process noise, 1-sigma per square root of second, of [v_x, v_y, r, b_ax, f_f, f_r] where the car has none of its own,
#: and where identification looks for it. By innovation likelihood over simulated drives, as that of ``phy-ukf``, with
#: lag, load transfer and biases, and frozen: ``studies.defaults.tune_physics_q`` finds 0.078, 0.13, 0.01, 0.062, 0.39.
PHYSICS_Q_STD = (0.085, 0.12, 0.012, 0.086, 0.41, 0.41)
#: 1-sigma of the axles' forces over the mass at the start, and at a standstill, m/s².
_FORCE_STD, _STANDSTILL_FORCE_STD = 0.5, 0.05
#: 1-sigma of roll (rad) and roll rate (rad/s) at the start and at a standstill, and the roll rate's walk per √s.
_ROLL_STD, _STANDSTILL_ROLL_STD, _ROLL_WALK = (0.01, 0.03), (0.005, 0.01), 0.02
#: Spread of the bank, rad: a crowned road has 0.02-0.03, motorway bends to 0.07.
_BANK_STD = 0.02

# No check of divisors, and sums in any order, so that the compiler can take several terms at a time.
_compiled = njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})


@_compiled
def _draw(x, P, scale, layout, L, points):  # type: ignore[no-untyped-def]
    """Write the sigma points of (x, P) to the columns of points [n, 2n+1] and return how many of them move.

    The first is the centre; those that differ from it in the sensors' biases alone are last. P is repaired if needed.
    """
    n = x.shape[0]
    if not cholesky_lower(P, L):
        repair_covariance(P)
        cholesky_lower(P, L)
    moving = n if layout.sensor_bias < 0 else layout.sensor_bias
    root = math.sqrt(scale)
    for j in range(n):
        points[j, 0] = x[j]
        for i in range(n):
            d = root * L[j, i]
            up = 1 + i if i < moving else 1 + i + moving
            points[j, up] = x[j] + d
            points[j, up + (moving if i < moving else n - moving)] = x[j] - d
    return 1 + 2 * moving


@_compiled
def _moments(points, x, P, deviation):  # type: ignore[no-untyped-def]
    """Write mean [n], covariance [n, n] and deviations of points [n, 2n+1] that :func:`_draw` drew."""
    n, s = points.shape
    weight = 0.5 / n
    for j in range(n):
        total = 0.0
        for i in range(1, s):
            total += points[j, i]
        x[j] = weight * total
        for i in range(s):
            deviation[j, i] = points[j, i] - x[j]
    for a in range(n):
        for b in range(a + 1):
            total = 0.0
            for i in range(1, s):
                total += deviation[a, i] * deviation[b, i]
            P[a, b] = weight * total + 2.0 * deviation[a, 0] * deviation[b, 0]
            P[b, a] = P[a, b]


@_compiled
def _cross(before, deviation, out):  # type: ignore[no-untyped-def]
    """Write the covariance [n, n] of points before a step [n, 2n+1], in pairs about their first, and after it."""
    n, s = before.shape
    weight = 0.5 / n
    for a in range(n):
        for b in range(n):
            total = 0.0
            for i in range(1, s):
                total += (before[a, i] - before[a, 0]) * deviation[b, i]
            out[a, b] = weight * total


@_compiled
def _force(x, layout):  # type: ignore[no-untyped-def]
    """Return the factor on forces and residual in state x [n]."""
    return max(0.1, 1.0 + x[layout.force_scale]) if layout.force_scale >= 0 else 1.0


@_compiled
def _push(points, count, half, layout):  # type: ignore[no-untyped-def]
    """Add half of the residual's increments of v_y and r to points that move, times their force scale."""
    half_vy, half_rate = half
    for j in range(count):
        force = max(0.1, 1.0 + points[layout.force_scale, j]) if layout.force_scale >= 0 else 1.0
        points[VY, j] += force * half_vy
        points[YAW_RATE, j] += force * half_rate


# positional: to hand structures of arrays on at every step would cost as much as the step.
@_compiled
def _predict(x, P, over, rate, dt, noise, layout, p, f, work):  # type: ignore[no-untyped-def]
    """Move state and covariance by ``dt`` s in place; the deviations of the sigma points are left in ``work``.

    ``rate`` is the residual of v̇_y and ṙ; it counts where the model is dynamic.
    """
    q_std, scale = noise
    points, deviation, L = work
    count = _draw(x, P, scale, layout, L, points)
    n = step_count(x[VX], dt, over.friction, layout, p, f)
    given = rate[0] != 0.0 or rate[1] != 0.0
    share = 0.5 * dynamic_share(x[VX], p) * dt
    half = (share * rate[0], share * rate[1])
    if given:
        _push(points, count, half, layout)
    advance(points, count, over, dt, n, layout, p, f)
    if given:
        _push(points, count, half, layout)
    for j in range(x.shape[0]):
        if layout.sensor_bias < 0 or j < layout.sensor_bias:
            for i in range(count, points.shape[1]):
                points[j, i] = points[j, 0]
    _moments(points, x, P, deviation)
    add_process_noise(P, q_std, over.ax_known, dt, layout)
    if layout.bank >= 0:
        P[layout.bank, layout.bank] += _BANK_STD**2 * (1.0 - math.exp(-2.0 * dt / BANK_TIME_S))


# positional: as _predict.
@_compiled
def _measure(x, P, steer, rate_vy, layout, p, f, row, z_hat, S, Pxz):  # type: ignore[no-untyped-def]
    """Write what the sensors should read [3], its covariance without R [3, 3] and the cross covariance [n, 3].

    ``rate_vy`` is the residual of v̇_y, which the accelerometer feels as it does the tyres' forces.
    """
    n = x.shape[0]
    z_hat[shell.Z_AY] = sensed_ay(x, steer, layout, p, f, row)
    if rate_vy != 0.0:
        felt = (1.0 if layout.roll >= 0 else 1.0 + GRAVITY_M_S2 * f.roll_gradient) * dynamic_share(x[VX], p) * rate_vy
        z_hat[shell.Z_AY] += _force(x, layout) * felt
        if layout.force_scale >= 0:
            row[layout.force_scale] = felt
    z_hat[shell.Z_YAW_RATE] = x[YAW_RATE]
    z_hat[shell.Z_SPEED] = x[VX]
    biased = layout.sensor_bias >= 0
    rate_bias = layout.sensor_bias + 1
    if biased:
        z_hat[shell.Z_YAW_RATE] += x[rate_bias]
    for a in range(n):
        total = 0.0
        for b in range(n):
            total += P[a, b] * row[b]
        Pxz[a, shell.Z_AY] = total
        Pxz[a, shell.Z_YAW_RATE] = P[a, YAW_RATE] + (P[a, rate_bias] if biased else 0.0)
        Pxz[a, shell.Z_SPEED] = P[a, VX]
    for k in range(shell.MEASUREMENTS):
        total = 0.0
        for b in range(n):
            total += row[b] * Pxz[b, k]
        S[shell.Z_AY, k] = total
        S[k, shell.Z_AY] = total
        S[shell.Z_YAW_RATE, k] = Pxz[YAW_RATE, k] + (Pxz[rate_bias, k] if biased else 0.0)
        S[shell.Z_SPEED, k] = Pxz[VX, k]


@njit(cache=True)
def _filter(window, tuning, layout, p, f, belief, out, links):  # type: ignore[no-untyped-def]
    """Run over one window; ``belief`` is moved in place. ``links`` are of length 0 where nobody asks for them."""
    dt, steer, ax, ay, yaw_rate, speed, friction, residual_rate, extra_r = window
    q_std, r_std, initial_std, standstill_std, _, _, scale, rules = tuning
    x, P, memory = belief
    out_x, out_P, out_inputs, out_nis, out_dof, out_likelihood, out_nu, out_valid, out_diverged, out_prior = out
    out_link, out_predicted_P, out_cross = links
    linked = out_link.shape[0] > 0
    n = x.shape[0]
    _, L, _, z_hat, S, Pxz, nu, at_gate, given, use = shell.make_work(n)
    points, deviation = np.zeros((n, 2 * n + 1)), np.zeros((n, 2 * n + 1))
    before = np.zeros((n, 2 * n + 1))
    row = np.empty(n)
    noise, work = (q_std, scale), (points, deviation, L)
    for k in range(dt.shape[0]):
        sample = shell.Sample(dt[k], steer[k], ax[k], ay[k], yaw_rate[k], speed[k], friction[k])
        now = shell.begin_step(sample, rules, memory)
        if memory[shell.M_INITIALISED] == 0.0:
            out_valid[k] = shell.starts(now, p.rear_m, initial_std, x, P, memory)
            if out_valid[k]:
                settle_forces(x, now.steer, now.ax, now.friction, layout, p, f)
        else:
            over = shell.meanwhile(now, memory)
            rate = (memory[shell.M_RATE_VY], memory[shell.M_RATE_R])
            if linked:
                _draw(x, P, scale, layout, L, before)
            _predict(x, P, over, rate, now.dt, noise, layout, p, f, work)
            alive = shell.all_finite(x, P)
            if linked:
                _cross(before, deviation, out_cross[k])
                out_predicted_P[k] = P
            out_prior[k] = x
            if alive:
                _measure(x, P, now.steer, rate[0], layout, p, f, row, z_hat, S, Pxz)
                shell.innovate(k, now, r_std, extra_r, z_hat, S, nu)
                verdict = shell.gate(now, memory, nu, S, at_gate, given, use)
                for i in range(shell.MEASUREMENTS):
                    if given[i]:
                        out_nu[k, i] = nu[i]
                if verdict.outside:  # a sample counts in the likelihood even if rejected, as if it stood at the gate
                    _, _, out_likelihood[k] = kalman_update(x.copy(), P.copy(), at_gate, S, Pxz, given)
                if verdict.opens:
                    P *= shell.GATE_INFLATION
                    if linked:  # to a smoother the inflation is process noise of the step that led here
                        out_predicted_P[k] = P
                    _measure(x, P, now.steer, rate[0], layout, p, f, row, z_hat, S, Pxz)
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
            elif linked and memory[shell.M_STILL] < rules.still_after_s:
                out_link[k] = LINK_WHOLE
        shell.finish_step(k, now, residual_rate, rules, memory, out_inputs)
        out_x[k] = x
        out_P[k] = P


@njit(cache=True)
def _predict_outputs(due, held, tuning, layout, p, f, predicted):  # type: ignore[no-untyped-def]
    """Predict the steps that are due with their inputs held; writes state, covariance and planar a_y."""
    step, horizon_s = due
    held_x, held_P, inputs, residual_rate = held
    out_x, out_P, out_ay = predicted
    q_std, _, _, _, _, _, scale, _ = tuning
    n = held_x.shape[1]
    points, deviation, L = np.zeros((n, 2 * n + 1)), np.zeros((n, 2 * n + 1)), np.empty((n, n))
    x, P = np.empty(n), np.empty((n, n))
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
        rate = (residual_rate[k, 0], residual_rate[k, 1])
        if horizon_s[m] > 0.0:
            _predict(x, P, over, rate, horizon_s[m], (q_std, scale), layout, p, f, (points, deviation, L))
            if not shell.all_finite(x, P):
                x[:] = math.nan
                P[:, :] = math.nan
        out_x[m] = x
        out_P[m] = P
        out_ay[m] = planar_ay(x, over.steer, p)
        if rate[0] != 0.0:
            out_ay[m] += _force(x, layout) * dynamic_share(x[VX], p) * rate[0]


@dataclass(frozen=True, slots=True)
class PhysicsFilter:
    """The filter of this file as an estimator.

    Parameters
    ----------
    vehicle : parameters; ``physics`` says which parts it has, ``sensors`` gives R unless ``r_std`` does, and the
        priors of the biases.
    q_std : process 1-sigma per √s of [v_x, v_y, r, b_ax, f_f, f_r], forces over mass in m/s².
    r_std : 1-sigma of [a_y, r, v_x].
    use_speed : False is the paper's ``esp`` suite: the speed sensor only starts the filter.
    slip_gate : leave out the speed of wheels that spin or lock (:mod:`~.speed_slip`).
    standstill : hold the motion at zero while the car stands.
    read_with : the vehicle with which its signals were read and corrected, where that is another; None: its own.
    """

    vehicle: VehicleParameters
    q_std: tuple[float, ...] = PHYSICS_Q_STD
    r_std: tuple[float, float, float] | None = None
    use_speed: bool = True
    slip_gate: bool = True
    standstill: bool = True
    read_with: VehicleParameters | None = None
    name: str = PHYSICS
    causal: bool = True

    @property
    def measurement_std(self) -> FloatArray:
        """1-sigma of [a_y, r, v_x], [3]."""
        return np.array(self.r_std or self.vehicle.sensors.measurement_std)

    @property
    def layout(self) -> Layout:
        """Where the states of the car's parts stand."""
        return layout_of(self.vehicle)

    @property
    def parameters(self) -> tuple[Layout, ModelParameters, PhysicsParameters]:
        """What the compiled model takes."""
        return self.layout, model_parameters(self.vehicle), physics_parameters(self.vehicle)

    @property
    def _tuning(self) -> shell.Tuning:
        layout, s = self.layout, self.vehicle.sensors
        walk, initial = np.zeros(layout.size), np.zeros(layout.size)
        still = np.full(layout.size, math.nan)
        walk[: len(self.q_std)] = self.q_std
        initial[:CORE] = (*shell.INITIAL_STD, _FORCE_STD, _FORCE_STD)
        still[: AX_BIAS + 1] = shell.STANDSTILL_STD
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
            for at, std, of in ((0, s.ay_bias_std_m_s2, of_ay), (1, s.yaw_rate_bias_std_rad_s, of_rate)):
                initial[layout.sensor_bias + at], walk[layout.sensor_bias + at] = std, of
        return shell.make_tuning(
            self.vehicle,
            walk.tolist(),
            self.measurement_std,
            initial.tolist(),
            still.tolist(),
            use_speed=self.use_speed,
            standstill=self.standstill,
        )

    def corrected(self, signals: Signals) -> Signals:
        """Return signals as this filter's vehicle corrects them, where they were read with another one."""
        return signals if self.read_with is None else corrected_anew(signals, self.read_with, self.vehicle)

    def filter_steps(
        self,
        signals: Signals,
        carry: FilterCarry | None,
        residual_rate: FloatArray | None = None,
        extra_r: FloatArray | None = None,
    ) -> tuple[shell.PosteriorSteps, FilterCarry]:
        """Run the filter on measurement time only; the steps and the carry with no pending steps in it.

        ``residual_rate`` [N, 2]: what is added to v̇_y and ṙ from each stamp to the next, m/s² and rad/s².
        ``extra_r`` [N, 2]: variance that a_y (m²/s⁴) and yaw rate (rad²/s²) have beyond R.
        """
        steps, after, _ = self._steps(signals, carry, residual_rate, extra_r, linked=False)
        return steps, after

    def linked_steps(
        self,
        signals: Signals,
        carry: FilterCarry | None,
        residual_rate: FloatArray | None = None,
        extra_r: FloatArray | None = None,
    ) -> tuple[shell.PosteriorSteps, FilterCarry, StepLinks]:
        """Return what :meth:`filter_steps` does, bit for bit, and what ties the steps together."""
        return self._steps(signals, carry, residual_rate, extra_r, linked=True)

    def _steps(
        self,
        signals: Signals,
        carry: FilterCarry | None,
        residual_rate: FloatArray | None,
        extra_r: FloatArray | None,
        *,
        linked: bool,
    ) -> tuple[shell.PosteriorSteps, FilterCarry, StepLinks]:
        signals = self.corrected(signals)
        speed_std_m_s = self.vehicle.sensors.speed_std_m_s
        signals, slip = believable(signals, speed_std_m_s, carry.slip if carry else None, gate=self.slip_gate)
        window, tuning = shell.make_window(signals, carry, residual_rate, extra_r), self._tuning
        count, n = len(signals), self.layout.size
        belief, out = shell.resume(carry, n), shell.no_posterior(count, n)
        tied = count if linked else 0
        links = LinkColumns(np.full(tied, LINK_NONE), np.zeros((tied, n, n)), np.zeros((tied, n, n)))
        _filter(window, tuning, *self.parameters, belief, out, links)
        steps = shell.PosteriorSteps(signals.stamps_ns, signals.ready_ns, *out, window.residual_rate)
        return steps, shell.carry_on(belief, steps, carry, slip), StepLinks(*links)

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
        self, signals: Signals, carry: FilterCarry | None, steps: shell.PosteriorSteps, after: FilterCarry
    ) -> tuple[StateTrack, FilterCarry]:
        """Predict to the window's stamps what :meth:`filter_steps` returned for it; the carry keeps waiting steps."""
        if carry is not None:
            steps = carry.steps.joined(steps)
        held = shell.Held(steps.x, steps.P, steps.inputs, steps.residual_rate)

        def predict(due: shell.Due, predicted: shell.Predicted) -> None:
            _predict_outputs(due, held, self._tuning, *self.parameters, predicted)

        track, released = shell.released_track(self.name, signals.stamps_ns, steps, predict, self.layout.named)
        return track, replace(after, steps=steps.since(released.needed))


def physics_filter(
    vehicle: VehicleParameters, noise: FilterNoise | None = None, *, use_speed: bool = True
) -> PhysicsFilter:
    """Return the filter with a noise; what that leaves out is :data:`PHYSICS_Q_STD` and the sensors' noise."""
    if noise is None:
        return PhysicsFilter(vehicle, use_speed=use_speed)
    return PhysicsFilter(
        vehicle,
        q_std=(*noise.q_std, *PHYSICS_Q_STD[len(noise.q_std) :]),
        r_std=noise.measurement_std(vehicle.sensors),
        use_speed=use_speed,
    )


def of_car(car: Car, *, use_speed: bool = True) -> PhysicsFilter:
    """Return ``physics`` of a car, with what was found through it and its noise where the car has them.

    A car of which nothing was found has no part: a static single track with the sensors' noise. What tuned noise leaves
    out of the process noise is what was found through the filter.
    """
    vehicle, noise = car.physics_vehicle, car.noise.get(PHYSICS)
    if noise is not None and car.fitted_physics is not None:
        fitted = car.fitted_physics.noise.q_std
        noise = noise.model_copy(update={"q_std": (*noise.q_std, *fitted[len(noise.q_std) :])})
    found = physics_filter(vehicle, noise, use_speed=use_speed)
    return found if vehicle == car.vehicle else replace(found, read_with=car.vehicle)
