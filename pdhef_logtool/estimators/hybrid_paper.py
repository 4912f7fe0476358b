"""``pd-hef-paper``: the paper's hybrid filter with its dual-layer adaptive mechanism, to the letter (Eq 19-26).

It is on record for comparison and is not the filter to use: METHOD §7 says what the mechanism costs. Per step k:

- β_k from the fuzzy rules (Eq 24, 25, Table 2); a_y,nom is the nominal model's at the parallel physics filter's prior,
  without residual. A missing a_y leaves β where it was.
- χ_k = RK4(f_nom; χ_{k−1}, u) + β_k Δx_net(I_{k−1}), the increment whole at the step's end (Eq 19); mean and
  covariance with Q_k = Q_0 (1 + γ β_k) (Eq 20, 21, 26); sigma points anew. Eq 19 writes u_{k−1}; u is the mean of
  u_{k−1} and u_k, as in ``phy-ukf`` and in the residual targets, so that half a step of delay is not held against it.
- h_ay = ΣF/m + β_k Δx_net[v_y]/Δt: the residual belongs to the predicted a_y too (METHOD §6).
- C_k = θ C_{k−1} + (1 − θ) ν νᵀ and R_k = max(R_0, C_k − P_zz) on the diagonal (Eq 22, 23). C starts at P_zz + R_0.

What the paper does not say is as in ``phy-ukf``: state [v_x, v_y, r, b_ax], Q_0, wheel speed as a measurement, start
and gaps. It has no gate of innovations, no standstill and no roll correction: the paper has none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from pdhef_logtool.car.nominal_model import (
    ModelParameters,
    dynamic_share,
    measured_lateral_acceleration,
    model_parameters,
    planar_lateral_acceleration,
    rk4_step,
    substeps,
)
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters
from pdhef_logtool.estimators.fuzzy_trust import NOMINAL_TRUST, fuzzy_trust
from pdhef_logtool.estimators.parallel_physics import parallel_filter, run_features
from pdhef_logtool.estimators.physics import (
    AX_BIAS,
    DIVERGED_SIDESLIP_RAD,
    INITIAL_STD,
    MEASUREMENTS,
    NO_AX_Q_STD,
    PHY_UKF_Q_STD,
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
from pdhef_logtool.residual_model.features import PAPER_FEATURES
from pdhef_logtool.residual_model.service import NetworkCarry, NetworkService
from pdhef_logtool.watches.speed_slip import SlipCarry, believable

if TYPE_CHECKING:
    from pdhef_logtool.car.car import Car
    from pdhef_logtool.estimators.table import Options

STATES = 4
#: θ of Eq 22 and γ of Eq 26: the paper names no values, METHOD §7 fixes these.
FORGETTING = 0.95
PROCESS_NOISE_GAIN = 3.0
#: Undisturbed norm of R in the paper's Figure 20; a_y has nearly all of it, so that it is the variance of a_y, m²/s⁴.
PAPER_R_NORM = 0.1

# Entries of the filter's scalar memory: running, β, inputs and residual of the step before, C of Eq 22 a measurement.
M_RUNNING, M_TRUST, M_STEER, M_AX, M_FRICTION, M_AX_KNOWN, M_RATE_VY, M_RATE_R, M_INNOVATION = range(9)
MEMORY = M_INNOVATION + MEASUREMENTS


@dataclass(frozen=True, slots=True, eq=False)
class PaperSteps:
    """Posteriors on measurement time, [K] each; state [K, 4], covariance [K, 4, 4], inputs [K, 5].

    ``residual_rate`` [K, 2] is the network's at the step, before β; ``trust`` is β_k, ``r_scale`` R_k / R_0 of a_y.
    """

    stamps_ns: IntArray
    ready_ns: IntArray
    x: FloatArray
    P: FloatArray
    inputs: FloatArray
    residual_rate: FloatArray
    trust: FloatArray
    r_scale: FloatArray
    nis: FloatArray
    nis_dof: FloatArray
    valid: BoolArray
    diverged: BoolArray

    def joined(self, other: PaperSteps) -> PaperSteps:
        """Append the steps of the next window."""
        return PaperSteps(*(np.concatenate([getattr(self, n), getattr(other, n)]) for n in self.__slots__))

    def since(self, index: int) -> PaperSteps:
        """Keep the steps from ``index`` on."""
        return PaperSteps(*(getattr(self, n)[index:] for n in self.__slots__))


@dataclass(frozen=True, slots=True, eq=False)
class PaperCarry:
    """What the parallel filter, the network and this filter take from window to window."""

    physics: FilterCarry
    network: NetworkCarry
    x: FloatArray
    P: FloatArray
    memory: FloatArray
    last_stamp_ns: int
    steps: PaperSteps
    slip: SlipCarry | None = None


@njit(cache=True)
def _propagate(chi, steer, ax, friction, rate_vy, rate_r, dt, p):  # type: ignore[no-untyped-def]
    """Move sigma points [s, 4] by ``dt`` and add the residual's increment whole at the end (Eq 19), in place.

    A residual counts where the model is dynamic: it knows nothing of the kinematic range.
    """
    share = dynamic_share(chi[0, VX], p) * dt
    n = substeps(chi[0, VX], dt, friction, p)
    for i in range(chi.shape[0]):
        vx, vy, r = rk4_step(
            chi[i, VX], chi[i, VY], chi[i, YAW_RATE], steer, ax - chi[i, AX_BIAS], friction, dt, n, p
        )  # fmt: skip
        chi[i, VX] = vx
        chi[i, VY] = vy + share * rate_vy
        chi[i, YAW_RATE] = r + share * rate_r


@njit(cache=True)
def _measure(chi, steer, friction, rate_vy, p, zeta):  # type: ignore[no-untyped-def]
    """Write what the sensors would read at sigma points chi [s, 4] to zeta [s, 3]."""
    residual = (1.0 + p.ay_roll_gain) * dynamic_share(chi[0, VX], p) * rate_vy
    for i in range(chi.shape[0]):
        ay = measured_lateral_acceleration(chi[i, VX], chi[i, VY], chi[i, YAW_RATE], steer, friction, p)
        zeta[i, Z_AY] = ay + residual
        zeta[i, Z_YAW_RATE] = chi[i, YAW_RATE]
        zeta[i, Z_SPEED] = chi[i, VX]


@njit(cache=True)
def _add_process_noise(P, q_std, trust, ax_known, dt):  # type: ignore[no-untyped-def]
    """Add Q_k = Q_0 (1 + γ β_k) of a step (Eq 26) to P in place."""
    scale = (1.0 + PROCESS_NOISE_GAIN * trust) * dt
    for i in range(P.shape[0]):
        q = q_std[i] if i != VX or ax_known else NO_AX_Q_STD
        P[i, i] += q * q * scale


@njit(cache=True)
def _is_alive(x, P):  # type: ignore[no-untyped-def]
    return bool(np.isfinite(x).all() and np.isfinite(P).all())


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
def _filter(  # type: ignore[no-untyped-def]
    dt, inputs, ay, yaw_rate, speed, use_speed, start_x, start_ok, prior, rate, p, q_std, r0, wm, wc, scale,
    x, P, memory, out_x, out_P, out_trust, out_r_scale, out_nis, out_dof, out_valid, out_diverged,
):  # fmt: skip
    """Run over one window; x [4], P [4, 4] and memory are updated in place.

    ``inputs`` [K, 5], ``start_x`` [K, ≥4], ``start_ok`` [K] and ``prior`` [K, ≥3] are the parallel filter's: where its
    prior is missing it starts, and this filter with it.
    """
    n = STATES
    chi = np.empty((2 * n + 1, n))
    L = np.empty((n, n))
    zeta = np.empty((2 * n + 1, MEASUREMENTS))
    z_hat = np.empty(MEASUREMENTS)
    S = np.empty((MEASUREMENTS, MEASUREMENTS))
    Pxz = np.empty((n, MEASUREMENTS))
    nu = np.empty(MEASUREMENTS)
    z = np.empty(MEASUREMENTS)
    use = np.empty(MEASUREMENTS, dtype=np.bool_)
    for k in range(dt.shape[0]):
        steer, friction = inputs[k, U_STEER], inputs[k, U_FRICTION]
        out_nis[k] = math.nan
        out_dof[k] = 0.0
        out_r_scale[k] = 1.0
        out_valid[k] = False
        out_diverged[k] = False
        if not math.isfinite(prior[k, VX]):
            memory[M_RUNNING] = 0.0
        if memory[M_RUNNING] == 0.0:
            if start_ok[k]:
                memory[M_RUNNING] = 1.0
                memory[M_TRUST] = NOMINAL_TRUST
                P[:, :] = 0.0
                for i in range(n):
                    x[i] = start_x[k, i]
                    P[i, i] = INITIAL_STD[i] ** 2
                for i in range(MEASUREMENTS):
                    memory[M_INNOVATION + i] = math.nan
                out_valid[k] = True
        else:
            nominal = measured_lateral_acceleration(
                prior[k, VX], prior[k, VY], prior[k, YAW_RATE], steer, friction, p
            )  # fmt: skip
            trust = fuzzy_trust(abs(ay[k] - nominal), abs(ay[k]) / (friction * GRAVITY_M_S2))
            if math.isfinite(trust):
                memory[M_TRUST] = trust
            trust = memory[M_TRUST]
            rate_vy, rate_r = trust * memory[M_RATE_VY], trust * memory[M_RATE_R]
            draw_sigma_points(x, P, scale, L, chi)
            # A missing a_x at one end of the step leaves that of the other.
            ax = memory[M_AX]
            if inputs[k, U_AX_KNOWN] > 0.0:
                ax = 0.5 * (ax + inputs[k, U_AX]) if memory[M_AX_KNOWN] > 0.0 else inputs[k, U_AX]
            ax_known = inputs[k, U_AX_KNOWN] > 0.0 or memory[M_AX_KNOWN] > 0.0
            _propagate(
                chi, 0.5 * (memory[M_STEER] + steer), ax, 0.5 * (memory[M_FRICTION] + friction), rate_vy, rate_r,
                dt[k], p,
            )  # fmt: skip
            mean_and_covariance(chi, wm, wc, x, P)
            _add_process_noise(P, q_std, trust, ax_known, dt[k])
            alive = _is_alive(x, P)
            if alive:
                draw_sigma_points(x, P, scale, L, chi)
                _measure(chi, steer, friction, rate_vy, p, zeta)
                innovation_moments(chi, x, zeta, wm, wc, z_hat, S, Pxz)
                z[Z_AY] = ay[k] if start_ok[k] else math.nan  # without steering no a_y can be predicted
                z[Z_YAW_RATE] = yaw_rate[k]
                z[Z_SPEED] = speed[k] if use_speed else math.nan
                for i in range(MEASUREMENTS):
                    nu[i] = z[i] - z_hat[i]
                    use[i] = math.isfinite(nu[i])
                    r = r0[i]
                    if use[i]:
                        c, r = adapted_noise(memory[M_INNOVATION + i], nu[i], S[i, i], r0[i])
                        memory[M_INNOVATION + i] = c
                    elif math.isfinite(memory[M_INNOVATION + i]):
                        r = max(r0[i], memory[M_INNOVATION + i] - S[i, i])
                    if i == Z_AY:
                        out_r_scale[k] = r / r0[i]
                    S[i, i] += r
                nis, dof, _ = kalman_update(x, P, nu, S, Pxz, use)
                if dof > 0:
                    out_nis[k] = nis
                    out_dof[k] = dof
                alive = _is_alive(x, P)
            if alive:
                out_valid[k] = start_ok[k]
                out_diverged[k] = x[VX] > p.blend_high_m_s and abs(math.atan2(x[VY], x[VX])) > DIVERGED_SIDESLIP_RAD
            else:
                memory[M_RUNNING] = 0.0
                out_diverged[k] = True
        memory[M_STEER] = steer
        memory[M_AX] = inputs[k, U_AX]
        memory[M_FRICTION] = friction
        memory[M_AX_KNOWN] = inputs[k, U_AX_KNOWN]
        memory[M_RATE_VY] = rate[k, 0]
        memory[M_RATE_R] = rate[k, 1]
        out_trust[k] = memory[M_TRUST]
        out_x[k] = x
        out_P[k] = P


@njit(cache=True)
def _predict_outputs(step, horizon_s, x, P, inputs, rate, trust, p, q_std, wm, wc, scale, out_x, out_P, out_ay):  # type: ignore[no-untyped-def]
    """Predict step ``step[m]`` by ``horizon_s[m]``, inputs and residual held; state, covariance and planar a_y."""
    n = STATES
    chi = np.empty((2 * n + 1, n))
    L = np.empty((n, n))
    xm = np.empty(n)
    Pm = np.empty((n, n))
    for m in range(step.shape[0]):
        k = step[m]
        xm[:] = math.nan
        Pm[:, :] = math.nan
        out_ay[m] = math.nan
        if k >= 0:
            xm[:] = x[k]
            Pm[:, :] = P[k]
            steer, friction = inputs[k, U_STEER], inputs[k, U_FRICTION]
            rate_vy, rate_r = trust[k] * rate[k, 0], trust[k] * rate[k, 1]
            if horizon_s[m] > 0.0:
                draw_sigma_points(xm, Pm, scale, L, chi)
                _propagate(chi, steer, inputs[k, U_AX], friction, rate_vy, rate_r, horizon_s[m], p)
                mean_and_covariance(chi, wm, wc, xm, Pm)
                _add_process_noise(Pm, q_std, trust[k], inputs[k, U_AX_KNOWN] > 0.0, horizon_s[m])
            if _is_alive(xm, Pm):
                ay = planar_lateral_acceleration(xm[VX], xm[VY], xm[YAW_RATE], steer, friction, p)
                out_ay[m] = ay + dynamic_share(xm[VX], p) * rate_vy
            else:
                xm[:] = math.nan
                Pm[:, :] = math.nan
        out_x[m] = xm
        out_P[m] = Pm


@dataclass(frozen=True, slots=True)
class PaperHybridUkf:
    """The filter of this file as an estimator.

    Parameters
    ----------
    q_std : Q_0 as process 1-sigma per √s of [v_x, v_y, r, b_ax].
    use_speed : False is the paper's ``esp`` suite: the speed sensor only starts the filter.
    slip_gate : as for ``phy-ukf``: leave out the speed of wheels that spin or lock.
    """

    vehicle: VehicleParameters
    network: NetworkService
    q_std: tuple[float, float, float, float] = PHY_UKF_Q_STD
    use_speed: bool = True
    slip_gate: bool = True
    name: str = "pd-hef-paper"
    causal: bool = True

    @property
    def needs(self) -> frozenset[str]:
        """What the physics filter needs."""
        return parallel_filter(self.vehicle, use_speed=self.use_speed).needs

    @property
    def notes(self) -> tuple[str, ...]:
        """Say where this is not the paper's filter: its network may have other features than the paper's six."""
        names = self.network.bundle.feature_names
        if names == PAPER_FEATURES:
            return ()
        return (f"the network has {len(names)} features, not the paper's {len(PAPER_FEATURES)}: {', '.join(names)}",)

    @property
    def measurement_variance(self) -> FloatArray:
        """R_0 of [a_y, r, v_x], [3]: the sensors', that of a_y at least the paper's norm."""
        s = self.vehicle.sensors
        std = np.array([s.ay_std_m_s2, s.yaw_rate_std_rad_s, s.speed_std_m_s])
        variance: FloatArray = std**2
        variance[Z_AY] = max(variance[Z_AY], PAPER_R_NORM)
        return variance

    @property
    def _parameters(self) -> ModelParameters:
        return model_parameters(self.vehicle)

    def run(self, signals: Signals, carry: PaperCarry | None) -> tuple[StateTrack, PaperCarry]:
        """Process one window (see :class:`~.base.Estimator`)."""
        features, physics, after = run_features(
            parallel_filter(self.vehicle, use_speed=self.use_speed, slip_gate=self.slip_gate),
            signals,
            carry.physics if carry else None,
        )
        starts = ~np.isfinite(physics.prior[:, VX])
        rate, network = self.network.run(features, starts, carry.network if carry else None)
        usable, slip = believable(
            signals, self.vehicle.sensors.speed_std_m_s, carry.slip if carry else None, gate=self.slip_gate
        )
        steps, x, P, memory = self._filter_steps(usable, physics, rate, carry)
        last = int(signals.stamps_ns[-1]) if len(signals) else (carry.last_stamp_ns if carry else 0)
        if carry is not None:
            steps = carry.steps.joined(steps)
        track, newest = self._outputs(signals.stamps_ns, steps)
        return track, PaperCarry(after, network, x, P, memory, last, steps.since(max(newest, 0)), slip)

    def _filter_steps(
        self, signals: Signals, physics: PosteriorSteps, rate: FloatArray, carry: PaperCarry | None
    ) -> tuple[PaperSteps, FloatArray, FloatArray, FloatArray]:
        """Filter believable signals on measurement time; the steps, then x, P and memory after them."""
        count = len(signals)
        if carry is None:
            x, P, memory = np.zeros(STATES), np.eye(STATES), np.zeros(MEMORY)
        else:
            x, P, memory = carry.x.copy(), carry.P.copy(), carry.memory.copy()
        before = [carry.last_stamp_ns] if carry is not None else signals.stamps_ns[:1]
        dt = np.diff(signals.stamps_ns, prepend=before) * 1e-9
        steps = PaperSteps(
            stamps_ns=signals.stamps_ns,
            ready_ns=signals.ready_ns,
            x=np.empty((count, STATES)),
            P=np.empty((count, STATES, STATES)),
            inputs=physics.inputs,
            residual_rate=rate,
            trust=np.empty(count),
            r_scale=np.empty(count),
            nis=np.empty(count),
            nis_dof=np.empty(count),
            valid=np.empty(count, dtype=np.bool_),
            diverged=np.empty(count, dtype=np.bool_),
        )
        wm, wc, scale = unscented_weights(STATES)
        _filter(
            dt, physics.inputs, signals.ay_m_s2, signals.yaw_rate_rad_s, signals.speed_m_s, self.use_speed, physics.x,
            physics.valid, physics.prior, rate, self._parameters, np.array(self.q_std), self.measurement_variance,
            wm, wc, scale[0], x, P, memory, steps.x, steps.P, steps.trust, steps.r_scale, steps.nis, steps.nis_dof,
            steps.valid, steps.diverged,
        )  # fmt: skip
        return steps, x, P, memory

    def _outputs(self, stamps_ns: IntArray, steps: PaperSteps) -> tuple[StateTrack, int]:
        """Predict the newest arrived step to each stamp; the track and the last step that was used."""
        count = stamps_ns.shape[0]
        index = released_steps(steps.ready_ns, stamps_ns)
        at = np.maximum(index, 0)
        horizon = np.full(count, np.nan)
        horizon[index >= 0] = (stamps_ns - steps.stamps_ns[at])[index >= 0] * 1e-9 if count else 0.0
        usable = (index >= 0) & (horizon <= MAX_PREDICTION_S)
        usable[usable] &= steps.valid[index[usable]]
        x, P, ay = np.empty((count, STATES)), np.empty((count, STATES, STATES)), np.empty(count)
        wm, wc, scale = unscented_weights(STATES)
        _predict_outputs(
            np.where(usable, index, -1), horizon, steps.x, steps.P, steps.inputs, steps.residual_rate, steps.trust,
            self._parameters, np.array(self.q_std), wm, wc, scale[0], x, P, ay,
        )  # fmt: skip
        usable &= np.isfinite(x[:, VX])
        if len(steps.stamps_ns):
            usable &= rolls_forward(x[:, VX], steps.inputs[at, U_SPEED])

        def where_usable(column: FloatArray | BoolArray, otherwise: float) -> FloatArray:
            out = np.full(count, otherwise)
            out[usable] = column[index[usable]]
            return out

        nan = np.full(count, np.nan)
        covariance = P[:, :3, :3]
        track = StateTrack(
            name=self.name,
            stamps_ns=stamps_ns,
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
            network_trust=where_usable(steps.trust, np.nan),
            r_scale=where_usable(steps.r_scale, np.nan),
            nis=where_usable(steps.nis, np.nan),
            nis_dof=where_usable(steps.nis_dof, 0.0),
            friction=where_usable(steps.inputs[:, U_FRICTION], np.nan),
            valid=usable,
            diverged=where_usable(steps.diverged, 0.0).astype(np.bool_),
        )
        return track, int(index[-1]) if count else -1


def build(name: str, car: Car, options: Options) -> PaperHybridUkf:
    """Return ``pd-hef-paper`` of a car: with the paper's network where there is one beside the car's."""
    del name
    paper = None if car.network is None else car.network.paper_network
    network = options.service(car) if paper is None else NetworkService(paper)
    return PaperHybridUkf(car.vehicle, network, use_speed=options.use_speed)
