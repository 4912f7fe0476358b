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

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters
from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.estimators import vehicle_ukf as ukf
from pdhef_logtool.estimators.filter_steps import U_AX, U_AX_KNOWN, U_FRICTION, U_STEER, PosteriorSteps, no_posterior
from pdhef_logtool.estimators.fuzzy_trust import NOMINAL_TRUST, fuzzy_trust
from pdhef_logtool.estimators.parallel_physics import run_features
from pdhef_logtool.estimators.prediction import predict, predicted_track
from pdhef_logtool.estimators.presets import Options
from pdhef_logtool.estimators.speed_slip import believable
from pdhef_logtool.estimators.unscented import is_finite, update
from pdhef_logtool.estimators.vehicle_model import NOMINAL, READINGS, VX, Z_AY, process_noise
from pdhef_logtool.records.signals import FloatArray, IntArray, Signals
from pdhef_logtool.records.steps import Extrapolation
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.residual_model.bundle import ModelBundle
from pdhef_logtool.residual_model.features import PAPER_FEATURES

#: Memory of the mechanism: β, and C of Eq 22 for each measurement.
ADAPTED = np.dtype([("trust", np.float64), ("c", np.float64, (READINGS,))])


class Constants(NamedTuple):
    """Constants without a value in the paper, chosen on training drives (``studies/paper/constants.py``).

    Attributes
    ----------
    forgetting : θ (Eq 22). process_noise_gain : γ (Eq 26).
    deviation_tops_m_s2, intensity_tops : tops of the sets small, medium and large of E_ay and I_dyn (Table 2).
    ay_variance : least R_0 of a_y in m²/s⁴ (Eq 23); the undisturbed norm of R in Figure 20 is 0.1.
    """

    forgetting: float
    process_noise_gain: float
    deviation_tops_m_s2: tuple[float, float, float]
    intensity_tops: tuple[float, float, float]
    ay_variance: float


CHOSEN = Constants(1.0, 0.1, (0.03, 0.1, 0.25), (0.03, 0.06, 0.085), 3.0)


@dataclass(frozen=True, slots=True, eq=False)
class PaperSteps(PosteriorSteps):
    """Posteriors, and by step, [K]: ``trust`` is β_k, ``r_scale`` R_k / R_0 of a_y.

    ``residual_rate`` is the network's at the step, before β.
    """

    trust: FloatArray
    r_scale: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class PaperState:
    """States of the parallel filter, the network and this filter between windows; ``adapted`` [1] is β and C."""

    physics: ukf.FilterState
    network: Any
    filtered: ukf.FilterState
    adapted: np.ndarray[Any, Any]


@njit(cache=True)
def adapted_noise(innovation_variance, innovation, predicted_variance, r0, forgetting):  # type: ignore[no-untyped-def]
    """Return C_k and R_k of one measurement (Eq 22, 23).

    Parameters
    ----------
    innovation_variance : C_{k−1}, NaN before the first sample. innovation : ν.
    predicted_variance : P_zz, without R. r0 : R_0. forgetting : θ.
    """
    if not math.isfinite(innovation_variance):
        innovation_variance = predicted_variance + r0
    c = forgetting * innovation_variance + (1.0 - forgetting) * innovation * innovation
    return c, max(r0, c - predicted_variance)


# positional: arrays and records of a compiled function.
@njit(cache=True)
def _filter(window, tuning, r0, constants, model, parallel, state, scratch, out, adapted):  # type: ignore[no-untyped-def]
    """Run over one window; ``state`` is updated in place.

    ``parallel`` has the columns of the parallel filter's steps, and a_y [K] of its prior without residual. Where its
    prior is missing it starts, and this filter with it. ``r0`` [3] is R_0, and ``adapted`` residual gain and scale of R
    at each step, [K] each.
    """
    forgetting, process_noise_gain, deviation_tops, intensity_tops, _ = constants
    layout, places, p, f = model
    (start_x, _, inputs, _, _, _, _, start_ok, _, prior), nominal_ay = parallel
    (x, P, memory), adapted_memory = state
    out_x, out_P, _, out_nis, out_dof, out_likelihood, out_nu, out_valid, out_diverged, out_prior = out
    out_trust, out_r_scale = adapted
    root, q, points, away, reading, nu, _, no_r, S, Pxz, _, use = scratch  # R is added when it is adapted
    for k in range(window.dt_s.shape[0]):
        m, a, ok, dt = memory[0], adapted_memory[0], start_ok[k], window.dt_s[k]
        steer, friction, has_ax = inputs[k, U_STEER], inputs[k, U_FRICTION], inputs[k, U_AX_KNOWN] > 0.0
        ay = window.ay[k] if ok else math.nan  # without steering no a_y can be predicted
        speed = window.speed[k] if tuning.rules.use_speed else math.nan
        now = ukf.StepInputs(dt, steer, inputs[k, U_AX], has_ax, friction, ok, ok, ay, window.yaw_rate[k], speed)
        out_r_scale[k] = 1.0
        if not math.isfinite(prior[k, VX]):
            m.runs = 0.0
        if m.runs == 0.0:
            if ok:
                m.runs, a.trust = 1.0, NOMINAL_TRUST
                a.c[:] = math.nan
                x[:] = start_x[k]
                P[:, :] = np.diag(tuning.initial_std**2)
                out_valid[k] = True
        else:
            intensity = abs(window.ay[k]) / (friction * GRAVITY_M_S2)
            trust = fuzzy_trust(abs(window.ay[k] - nominal_ay[k]), intensity, deviation_tops, intensity_tops)
            if math.isfinite(trust):
                a.trust = trust
            over, rate = ukf.held_over_step(now, m), (a.trust * m.rate_vy, a.trust * m.rate_r)
            noise_dt = (1.0 + process_noise_gain * a.trust) * dt  # Eq 26
            process_noise(tuning.q_std, over.ax_known, noise_dt, layout, q)
            predict(x, P, root, over, rate, dt, 0.0, q, layout, places, p, f, points, away, x.shape[0])  # Eq 19
            alive = is_finite(x, P)
            out_prior[k] = x
            if alive:
                ukf.expect(x, P, root, now, rate[0], no_r, layout, places, p, f, points, away, reading, nu, S, Pxz)
                for i in range(READINGS):
                    use[i] = math.isfinite(nu[i])
                    r = r0[i]
                    if use[i]:
                        out_nu[k, i] = nu[i]
                        a.c[i], r = adapted_noise(a.c[i], nu[i], S[i, i], r0[i], forgetting)
                    elif math.isfinite(a.c[i]):
                        r = max(r0[i], a.c[i] - S[i, i])
                    if i == Z_AY:
                        out_r_scale[k] = r / r0[i]
                    S[i, i] += r
                nis, dof, out_likelihood[k] = update(x, P, nu, S, Pxz, use)
                if dof > 0:
                    out_nis[k], out_dof[k] = nis, dof
                alive = is_finite(x, P)
            out_valid[k] = alive and ok
            out_diverged[k] = not alive or ukf.diverges(tuning.rules, x, m)
            if not alive:
                m.runs = 0.0
        ukf.remember(k, now, window.residual_rate, m)
        out_trust[k] = a.trust
        out_x[k] = x
        out_P[k] = P


@dataclass(frozen=True, slots=True)
class PaperHybridUkf:
    """The filter of this file as an estimator.

    Parameters
    ----------
    q_std : Q_0 as process 1-sigma per √s of [v_x, v_y, r, b_ax].
    use_speed : False is the paper's ``esp`` suite: the speed sensor only starts the filter.
    constants : that the paper leaves open.
    """

    algorithm = "paper-hybrid-ukf"
    version = 2
    options = ("constants",)

    vehicle: VehicleParameters
    network: ModelBundle
    q_std: tuple[float, float, float, float] = ukf.PHY_UKF_Q_STD
    use_speed: bool = True
    name: str = "pd-hef-paper"
    causal: bool = True
    constants: Constants = CHOSEN

    @property
    def notes(self) -> tuple[str, ...]:
        """State where this is not the paper's filter: its network may have other features than the paper's six."""
        names = self.network.feature_names
        if names == PAPER_FEATURES:
            return ()
        return (f"the network has {len(names)} features, not the paper's {len(PAPER_FEATURES)}: {', '.join(names)}",)

    @property
    def measurement_variance(self) -> FloatArray:
        """R_0 of [a_y, r, v_x], [3]: the sensors' variance, for a_y at least ``constants.ay_variance``."""
        variance: FloatArray = np.square(self.vehicle.sensors.measurement_std)
        variance[Z_AY] = max(variance[Z_AY], self.constants.ay_variance)
        return variance

    @property
    def parallel(self) -> ukf.VehicleUkf:
        """The physics filter in parallel, with model, initial covariance and Q_0 of this filter."""
        return ukf.nominal_filter(self.vehicle, use_speed=self.use_speed, name="parallel")

    def run(self, signals: Signals, state: PaperState | None) -> tuple[PaperSteps, PaperState]:
        """Process one window (see :class:`~.base.Estimator`)."""
        features, dt_s, physics, after = run_features(self.parallel, signals, state.physics if state else None)
        rate, network = self.network.run(features, np.isnan(dt_s), state.network if state else None)
        before = (state.filtered, state.adapted) if state else (None, None)
        steps, filtered, adapted = self.filter_steps(signals, physics, rate, *before)
        return steps, PaperState(after, network, filtered, adapted)

    def predict(self, steps: PaperSteps, ahead: Extrapolation, stamps_ns: IntArray) -> StateTrack:
        """Extrapolate steps with the nominal model and the residual held (see :class:`~.base.ModelPredictor`)."""
        rate = steps.trust[:, None] * steps.residual_rate
        noise = 1.0 + self.constants.process_noise_gain * steps.trust
        q_std, model = np.array(self.q_std), self.parallel.parameters
        track = predicted_track(self.name, steps, ahead, stamps_ns, q_std, model, rate=rate, noise=noise, early=0.0)
        return replace(
            track,
            network_trust=np.where(track.valid, steps.trust[ahead.step], np.nan),
            r_scale=np.where(track.valid, steps.r_scale[ahead.step], np.nan),
        )

    def filter_steps(
        self,
        signals: Signals,
        physics: PosteriorSteps,
        rate: FloatArray,
        state: ukf.FilterState | None = None,
        adapted: np.ndarray[Any, Any] | None = None,
    ) -> tuple[PaperSteps, ukf.FilterState, np.ndarray[Any, Any]]:
        """Filter one window with the results of the parallel filter and the residual ``rate`` [K, 2] of the network.

        Return its steps, and the states for the next window.
        """
        count, n, nominal = len(signals), NOMINAL.size, self.parallel
        after, remembered = ukf.resume(state, n), np.zeros(1, ADAPTED) if adapted is None else adapted.copy()
        signals, slip = believable(signals, self.vehicle.sensors, after.slip)
        parallel = physics.written, nominal.expected_ay(physics.prior, physics.inputs)
        steps, columns = no_posterior(signals.stamps_ns, n, rate), (np.empty(count), np.empty(count))
        steps = replace(steps, inputs=physics.inputs)
        window, r0, scratch = ukf.make_window(signals, rate), self.measurement_variance, ukf.make_scratch(n)
        tuning, kept = nominal.tuning._replace(q_std=np.array(self.q_std)), (after[:3], remembered)
        _filter(window, tuning, r0, self.constants, nominal.parameters, parallel, kept, scratch, steps.written, columns)
        paper_steps = PaperSteps(steps.stamps_ns, *[*steps.written, rate, *columns])
        return paper_steps, after._replace(slip=slip), remembered


def build(name: str, car: Car, options: Options) -> PaperHybridUkf:
    """Return ``pd-hef-paper`` of a car: with the paper's network where there is one beside the car's."""
    del name
    network = car.network if car.network is None or car.network.paper_network is None else car.network.paper_network
    assert isinstance(network, ModelBundle), "the table lets no other residual model in"
    return PaperHybridUkf(car.vehicle, network, use_speed=options.use_speed)
