"""``pd-hef-paper``: the paper's hybrid filter with its dual-layer adaptive mechanism, to the letter (Eq 19-26).

It is on record for comparison and is not the filter to use: docs/method.md#paper-adaptation gives the reason. Per step
k:

- β_k from the fuzzy rules (Eq 24, 25, Table 2); a_y,nom is the nominal model's at the parallel physics filter's prior,
  without residual. A missing a_y leaves β where it was.
- χ_k = RK4(f_nom; χ_{k−1}, u) + β_k Δx_net(I_{k−1}), the increment whole at the step's end (Eq 19); mean and
  covariance with Q_k = Q_0 (1 + γ β_k) (Eq 20, 21, 26); sigma points again. Eq 19 writes u_{k−1}; u is the mean of
  u_{k−1} and u_k, as in ``phy-ukf`` and in the residual targets, so that half a step of delay is not held against it.
- h_ay = ΣF/m + β_k Δx_net[v_y]/Δt: the residual belongs to the predicted a_y too (docs/method.md#hybrid).
- C_k = θ C_{k−1} + (1 − θ) ν νᵀ and R_k = max(R_0, C_k − P_zz) on the diagonal (Eq 22, 23). C starts at P_zz + R_0.

Details that the paper omits are as in ``phy-ukf``: state [v_x, v_y, r, b_ax], Q_0, wheel speed as a measurement, start
and gaps. It has no gate of innovations, no standstill and no roll correction, as in the paper.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pdhef_logtool.car.nominal_model import (
    ModelParameters,
    dynamic_share,
    measured_lateral_acceleration,
    model_parameters,
    planar_lateral_acceleration,
    substeps,
)
from pdhef_logtool.car.nominal_points import AT_VX, AT_VY, AT_YAW_RATE, advance_points, place, work_size
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters
from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.estimators import filter_base as base
from pdhef_logtool.estimators.filter_base import FilterState
from pdhef_logtool.estimators.fuzzy_trust import NOMINAL_TRUST, fuzzy_trust
from pdhef_logtool.estimators.parallel_physics import parallel_filter, run_features
from pdhef_logtool.estimators.phy_ukf import PHY_UKF_Q_STD, measure_sigma_points, set_points
from pdhef_logtool.estimators.speed_slip import believable
from pdhef_logtool.estimators.unscented import (
    draw_sigma_points,
    innovation_moments,
    kalman_update,
    mean_and_covariance,
)
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray, Signals
from pdhef_logtool.records.steps import Extrapolation
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.residual_model.features import PAPER_FEATURES
from pdhef_logtool.residual_model.service import NetworkCarry, NetworkService

if TYPE_CHECKING:
    from pdhef_logtool.car.car import Car
    from pdhef_logtool.estimators.presets import Options

#: θ of Eq 22 and γ of Eq 26: the paper names no values, docs/method.md#paper-adaptation fixes these.
FORGETTING = 0.95
PROCESS_NOISE_GAIN = 3.0
#: Undisturbed norm of R in the paper's Figure 20; a_y has nearly all of it, so that it is the variance of a_y, m²/s⁴.
PAPER_R_NORM = 0.1

# Behind the entries of the filter base's memory: β, and C of Eq 22 a measurement.
M_TRUST, M_INNOVATION = base.MEMORY, base.MEMORY + 1
MEMORY = M_INNOVATION + base.MEASUREMENTS


@dataclass(frozen=True, slots=True, eq=False)
class PaperSteps(base.PosteriorSteps):
    """Posteriors, and by step, [K]: ``trust`` is β_k, ``r_scale`` R_k / R_0 of a_y.

    ``residual_rate`` is the network's at the step, before β.
    """

    trust: FloatArray
    r_scale: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class PaperState:
    """States of the parallel filter, the network and this filter between windows."""

    physics: FilterState
    network: NetworkCarry
    filter_state: base.FilterState


class Parallel(NamedTuple):
    """Steps of the parallel filter: state [K, 4], state before the update, held inputs, and whether they are right."""

    x: FloatArray
    prior: FloatArray
    inputs: FloatArray
    valid: BoolArray


@njit(cache=True)
def _propagate(chi, over, rate, dt, p, points):  # type: ignore[no-untyped-def]
    """Move sigma points [s, 4] by ``dt`` and add the increment of the residual ``rate`` whole at the end (Eq 19).

    A residual counts in the dynamic range of the model, not in the kinematic one. ``points`` is work space.
    """
    rate_vy, rate_r = rate
    share = dynamic_share(chi[0, base.VX], p) * dt
    set_points(chi, over.steer, over.ax, (0.0, 0.0), points)
    advance_points(points, over.friction, dt, substeps(chi[0, base.VX], dt, over.friction, p), p)
    for i in range(chi.shape[0]):
        place_i = place(i)
        chi[i, base.VX] = points[place_i + AT_VX]
        chi[i, base.VY] = points[place_i + AT_VY] + share * rate_vy
        chi[i, base.YAW_RATE] = points[place_i + AT_YAW_RATE] + share * rate_r


@njit(cache=True)
def adapted_noise(innovation_variance, innovation, predicted_variance, r0):  # type: ignore[no-untyped-def]
    """Return C_k and R_k of one measurement (Eq 22, 23).

    Parameters
    ----------
    innovation_variance : C_{k−1}, NaN before the first sample. innovation : ν.
    predicted_variance : P_zz, without R. r0 : R_0.
    """
    if not math.isfinite(innovation_variance):
        innovation_variance = predicted_variance + r0
    c = FORGETTING * innovation_variance + (1.0 - FORGETTING) * innovation * innovation
    return c, max(r0, c - predicted_variance)


@njit(cache=True)
def _filter(window, tuning, r0, p, parallel, estimate, out, adapted):  # type: ignore[no-untyped-def]
    """Run over one window; ``estimate`` is moved in place.

    Where the prior of the parallel filter is missing it starts, and this filter with it. ``r0`` [3] is R_0, and
    ``adapted`` residual gain and scale of R at each step, [K] each.
    """
    dt, _, _, ay, yaw_rate, speed, _, rate, _ = window
    q_std, _, initial_std, _, wm, wc, scale, rules = tuning
    start_x, prior, inputs, start_ok = parallel
    x, P, memory = estimate
    out_x, out_P, _, out_nis, out_dof, out_likelihood, out_nu, out_valid, out_diverged, out_prior = out
    out_trust, out_r_scale = adapted
    n = base.STATES
    chi, L, zeta, z_hat, S, Pxz, nu, _, _, use = base.make_work(n)
    points = np.empty(work_size(2 * n + 1))
    for k in range(dt.shape[0]):
        steer, friction, has_ax, ok = (
            inputs[k, base.U_STEER],
            inputs[k, base.U_FRICTION],
            inputs[k, base.U_AX_KNOWN] > 0.0,
            start_ok[k],
        )
        z_ay = ay[k] if ok else math.nan  # without steering no a_y can be predicted
        z_speed = speed[k] if rules.use_speed else math.nan
        now = base.StepInputs(dt[k], steer, inputs[k, base.U_AX], has_ax, friction, ok, ok, z_ay, yaw_rate[k], z_speed)
        out_r_scale[k] = 1.0
        if not math.isfinite(prior[k, base.VX]):
            memory[base.M_INITIALISED] = 0.0
        if memory[base.M_INITIALISED] == 0.0:
            if ok:
                memory[base.M_INITIALISED] = 1.0
                memory[M_TRUST] = NOMINAL_TRUST
                P[:, :] = 0.0
                for i in range(n):
                    x[i] = start_x[k, i]
                    P[i, i] = initial_std[i] ** 2
                for i in range(base.MEASUREMENTS):
                    memory[M_INNOVATION + i] = math.nan
                out_valid[k] = True
        else:
            nominal = measured_lateral_acceleration(
                prior[k, base.VX], prior[k, base.VY], prior[k, base.YAW_RATE], steer, friction, p
            )  # fmt: skip
            trust = fuzzy_trust(abs(ay[k] - nominal), abs(ay[k]) / (friction * GRAVITY_M_S2))
            if math.isfinite(trust):
                memory[M_TRUST] = trust
            trust = memory[M_TRUST]
            rate_vy, rate_r = trust * memory[base.M_RATE_VY], trust * memory[base.M_RATE_R]
            draw_sigma_points(x, P, scale, L, chi)
            over = base.held_over_step(now, memory)
            _propagate(chi, over, (rate_vy, rate_r), dt[k], p, points)
            mean_and_covariance(chi, wm, wc, x, P)
            base.add_process_noise(P, q_std, over.ax_known, (1.0 + PROCESS_NOISE_GAIN * trust) * dt[k])  # Eq 26
            alive = base.all_finite(x, P)
            out_prior[k] = x
            if alive:
                draw_sigma_points(x, P, scale, L, chi)
                measure_sigma_points(chi, steer, friction, rate_vy, p, points, zeta)
                innovation_moments(chi, x, zeta, wm, wc, z_hat, S, Pxz)
                nu[base.Z_AY] = now.ay - z_hat[base.Z_AY]
                nu[base.Z_YAW_RATE] = now.yaw_rate - z_hat[base.Z_YAW_RATE]
                nu[base.Z_SPEED] = now.speed - z_hat[base.Z_SPEED]
                for i in range(base.MEASUREMENTS):
                    use[i] = math.isfinite(nu[i])
                    r = r0[i]
                    if use[i]:
                        out_nu[k, i] = nu[i]
                        c, r = adapted_noise(memory[M_INNOVATION + i], nu[i], S[i, i], r0[i])
                        memory[M_INNOVATION + i] = c
                    elif math.isfinite(memory[M_INNOVATION + i]):
                        r = max(r0[i], memory[M_INNOVATION + i] - S[i, i])
                    if i == base.Z_AY:
                        out_r_scale[k] = r / r0[i]
                    S[i, i] += r
                nis, dof, out_likelihood[k] = kalman_update(x, P, nu, S, Pxz, use)
                if dof > 0:
                    out_nis[k] = nis
                    out_dof[k] = dof
                alive = base.all_finite(x, P)
            out_valid[k] = alive and ok
            out_diverged[k] = not alive or base.diverges(rules, x, memory)
            if not alive:
                memory[base.M_INITIALISED] = 0.0
        base.remember(k, now, rate, memory)
        out_trust[k] = memory[M_TRUST]
        out_x[k] = x
        out_P[k] = P


@njit(cache=True)
def _predict_outputs(due, held, trust, tuning, p, predicted):  # type: ignore[no-untyped-def]
    """Predict the steps that are due with inputs, residual and ``trust`` [K] held; planar a_y beside the state."""
    step, horizon_s = due
    held_x, held_P, inputs, rate = held
    out_x, out_P, out_ay = predicted
    q_std, _, _, _, wm, wc, scale, _ = tuning
    n = base.STATES
    chi, points = np.empty((2 * n + 1, n)), np.empty(work_size(2 * n + 1))
    L = np.empty((n, n))
    x = np.empty(n)
    P = np.empty((n, n))
    for m in range(step.shape[0]):
        k = step[m]
        x[:] = math.nan
        P[:, :] = math.nan
        out_ay[m] = math.nan
        if k >= 0:
            x[:] = held_x[k]
            P[:, :] = held_P[k]
            over = base.held_inputs(inputs, k)
            rate_vy, rate_r = trust[k] * rate[k, 0], trust[k] * rate[k, 1]
            if horizon_s[m] > 0.0:
                draw_sigma_points(x, P, scale, L, chi)
                _propagate(chi, over, (rate_vy, rate_r), horizon_s[m], p, points)
                mean_and_covariance(chi, wm, wc, x, P)
                base.add_process_noise(P, q_std, over.ax_known, (1.0 + PROCESS_NOISE_GAIN * trust[k]) * horizon_s[m])
            if base.all_finite(x, P):
                ay = planar_lateral_acceleration(x[base.VX], x[base.VY], x[base.YAW_RATE], over.steer, over.friction, p)
                out_ay[m] = ay + dynamic_share(x[base.VX], p) * rate_vy
            else:
                x[:] = math.nan
                P[:, :] = math.nan
        out_x[m] = x
        out_P[m] = P[:3, :3]


@dataclass(frozen=True, slots=True)
class PaperHybridUkf:
    """The filter of this file as an estimator.

    Parameters
    ----------
    q_std : Q_0 as process 1-sigma per √s of [v_x, v_y, r, b_ax].
    use_speed : False is the paper's ``esp`` suite: the speed sensor only starts the filter.
    slip_gate : as for ``phy-ukf``: leave out the speed of wheels that spin or lock.
    """

    algorithm = "paper-hybrid-ukf"
    version = 1
    options = ("slip_gate",)

    vehicle: VehicleParameters
    network: NetworkService
    q_std: tuple[float, float, float, float] = PHY_UKF_Q_STD
    use_speed: bool = True
    slip_gate: bool = True
    name: str = "pd-hef-paper"
    causal: bool = True

    @property
    def notes(self) -> tuple[str, ...]:
        """State where this is not the paper's filter: its network may have other features than the paper's six."""
        names = self.network.bundle.feature_names
        if names == PAPER_FEATURES:
            return ()
        return (f"the network has {len(names)} features, not the paper's {len(PAPER_FEATURES)}: {', '.join(names)}",)

    @property
    def measurement_variance(self) -> FloatArray:
        """R_0 of [a_y, r, v_x], [3]: the sensors'; a_y has at least the paper's norm."""
        s = self.vehicle.sensors
        std = np.array([s.ay_std_m_s2, s.yaw_rate_std_rad_s, s.speed_std_m_s])
        variance: FloatArray = std**2
        variance[base.Z_AY] = max(variance[base.Z_AY], PAPER_R_NORM)
        return variance

    @property
    def _parameters(self) -> ModelParameters:
        return model_parameters(self.vehicle)

    @property
    def _tuning(self) -> base.Tuning:
        r_std = np.sqrt(self.measurement_variance)
        return base.make_tuning(self.vehicle, self.q_std, r_std, base.INITIAL_STD, use_speed=self.use_speed)

    def run(self, signals: Signals, state: PaperState | None) -> tuple[PaperSteps, PaperState]:
        """Process one window (see :class:`~.base.Estimator`)."""
        features, physics, after = run_features(
            parallel_filter(self.vehicle, use_speed=self.use_speed, slip_gate=self.slip_gate),
            signals,
            state.physics if state else None,
        )
        starts = ~np.isfinite(physics.prior[:, base.VX])
        rate, network = self.network.run(features, starts, state.network if state else None)
        steps, filter_state = self._filter_steps(signals, physics, rate, state.filter_state if state else None)
        return steps, PaperState(after, network, filter_state)

    def predict(self, steps: PaperSteps, ahead: Extrapolation, stamps_ns: IntArray) -> StateTrack:
        """Extrapolate steps with the nominal model and the residual held (see :class:`~.base.ModelPredictor`)."""
        held = base.PredictionStart(steps.x, steps.P, steps.inputs, steps.residual_rate)
        predicted = base.no_prediction(len(stamps_ns), steps.x.shape[1])
        _predict_outputs(base.pending_predictions(ahead), held, steps.trust, self._tuning, self._parameters, predicted)
        track = base.predicted_track(self.name, stamps_ns, steps, ahead, predicted)
        return replace(
            track,
            network_trust=np.where(track.valid, steps.trust[ahead.step], np.nan),
            r_scale=np.where(track.valid, steps.r_scale[ahead.step], np.nan),
        )

    def _filter_steps(
        self,
        signals: Signals,
        physics: base.PosteriorSteps,
        rate: FloatArray,
        state: base.FilterState | None,
    ) -> tuple[PaperSteps, base.FilterState]:
        """Filter one window; return its steps, and the state for the next one."""
        signals, slip = believable(signals, self.vehicle.sensors, state.slip if state else None, gate=self.slip_gate)
        estimate, count = base.resume(state, base.STATES, MEMORY), len(signals)
        parallel = Parallel(physics.x, physics.prior, physics.inputs, physics.valid)
        out, adapted = (
            base.no_posterior(count, base.STATES)._replace(inputs=physics.inputs),
            (np.empty(count), np.empty(count)),
        )
        window, r0 = base.make_window(signals, state, rate), self.measurement_variance
        _filter(window, self._tuning, r0, self._parameters, parallel, estimate, out, adapted)
        steps = PaperSteps(signals.stamps_ns, *out, rate, *adapted)
        return steps, base.next_state(estimate, signals.stamps_ns, state, slip)


def build(name: str, car: Car, options: Options) -> PaperHybridUkf:
    """Return ``pd-hef-paper`` of a car: with the paper's network where there is one beside the car's."""
    del name
    paper = None if car.network is None else car.network.paper_network
    network = options.service(car) if paper is None else NetworkService(paper)
    assert isinstance(network, NetworkService), "the table lets no other residual model in"
    return PaperHybridUkf(car.vehicle, network, use_speed=options.use_speed)
