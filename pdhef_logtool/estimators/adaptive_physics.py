"""``physics`` and ``pd-hef``: the physics filter with residual gain times a network's residual, adaptive.

All gains use the noise of the car's physics: the gain scales the residual only, and ``physics`` has gain 0 and no
network. The mechanism (docs/method.md#adaptation) does not treat model error as noise.

Bottom layer: :mod:`~.sensor_faults` checks a_y and yaw rate. Its findings apply to every filter here and to the
parallel one, and keep bad samples from the network.

Top layer: a bank of filters, each a hypothesis about the car's model. F1 assumes that the model with its residual is
complete; each other filter adds one state: a scale of all forces, or the bank of the road. With both at once, the
same error moves between them, and the estimate is worse. A residual is trained on one vehicle and level roads: the
filter of another vehicle, with a force scale, uses half of it, and the filter of a banked road none. With Λ the sum of
a filter's log-likelihood of its measurements, forgotten within seconds, the weight of filter i is

    w_i ∝ exp(Λ_i)

which is multiple-model estimation (Magill 1965) for temporary effects. A state has a filter only if drives of the car
have shown its benefit, because an additional state always fits something. A car without identified parts
has F1 alone. The output is the mixture of all, its covariance with their differences.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.estimators.checked_inputs import CheckedInputs, InputState, check_inputs, r_scale, residual_of
from pdhef_logtool.estimators.sensor_faults import no_faults
from pdhef_logtool.estimators.vehicle_model import VX
from pdhef_logtool.estimators.vehicle_ukf import FilterState, PosteriorSteps, VehicleUkf, of_car, sideslip_std
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray, Signals
from pdhef_logtool.records.steps import RESTART_GAP_S, Extrapolation, StepColumns, step_durations_s
from pdhef_logtool.records.tracks import ESTIMATED_COLUMNS, StateTrack
from pdhef_logtool.residual_model.interface import ResidualModel

if TYPE_CHECKING:
    from pdhef_logtool.car.car import Car
    from pdhef_logtool.estimators.presets import Options

#: Possible deficiencies of a model, as parts of ``physics``; each is the state of one filter, which uses this share of
#: the residual. The shares were chosen on simulated drives that no table contains.
CURES = {"force_scale": 0.5, "bank": 0.0}
#: Time constant with which the likelihood is forgotten, s. Chosen on simulated drives that no table contains; from 1 to
#: 5 s little changes.
FORGET_S = 2.0
#: Smaller weights are set to 0.
LEAST_WEIGHT = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class MixtureSteps(StepColumns):
    """Steps of all filters [H], and by step, [K]: weights [K, H], factor on R, detector's bit mask, residual gain."""

    filters: tuple[PosteriorSteps, ...]
    weights: FloatArray
    r_scale: FloatArray
    reason: IntArray
    gain: FloatArray

    @property
    def valid(self) -> BoolArray:
        """Whether a filter with weight has an estimate, [K]."""
        used = np.stack([steps.valid for steps in self.filters], axis=1) & (self.weights > 0.0)
        return np.asarray(used.any(axis=1), dtype=np.bool_)


@dataclass(frozen=True, slots=True, eq=False)
class AdaptiveState:
    """State of the inputs, the filters [H] and their evidence between windows."""

    inputs: InputState
    filters: tuple[FilterState, ...]
    evidence: FloatArray


@njit(cache=True)
def _gather(dt, likelihood, starts, evidence, out):  # type: ignore[no-untyped-def]
    """Write Λ [K, H] of each step; ``evidence`` [H] belongs to the step before the first, and is updated in place."""
    for k in range(dt.shape[0]):
        forgets = starts[k] or not dt[k] <= RESTART_GAP_S
        kept = 0.0 if forgets else math.exp(-dt[k] / FORGET_S)
        heeds = not forgets
        for h in range(evidence.shape[0]):
            heeds = heeds and math.isfinite(likelihood[k, h])
        for h in range(evidence.shape[0]):
            evidence[h] = kept * evidence[h] + (likelihood[k, h] if heeds else 0.0)
            out[k, h] = evidence[h]


def gather_evidence(dt_s: FloatArray, likelihood: FloatArray, starts: BoolArray, evidence: FloatArray) -> FloatArray:
    """Return Λ [K, H] of steps with durations and starts [K] and log-likelihoods [K, H].

    ``evidence`` [H] is Λ before the first step and becomes that of the last.
    """
    out = np.empty_like(likelihood)
    _gather(dt_s, likelihood, starts, evidence, out)
    return out


def weigh(evidence: FloatArray, usable: BoolArray) -> FloatArray:
    """Return weights [K, H] that go with exp(evidence), 0 where ``usable`` [K, H] is not; a row of zeros for none."""
    weights = np.empty_like(evidence)
    _weigh(evidence, usable, weights)
    return weights


@njit(cache=True)
def _weigh(evidence, usable, out):  # type: ignore[no-untyped-def]
    for k in range(evidence.shape[0]):
        best, total = -math.inf, 0.0
        for h in range(evidence.shape[1]):
            if usable[k, h]:
                best = max(best, evidence[k, h])
        for h in range(evidence.shape[1]):
            out[k, h] = math.exp(evidence[k, h] - best) if usable[k, h] else 0.0
            total += out[k, h]
        for h in range(evidence.shape[1]):
            if out[k, h] < LEAST_WEIGHT * total:
                out[k, h] = 0.0
    _share(out)


@njit(cache=True)
def _share(weights):  # type: ignore[no-untyped-def]
    """Divide weights [K, H] by their sums, in place; a row of zeros stays."""
    for k in range(weights.shape[0]):
        total = 0.0
        for h in range(weights.shape[1]):
            total += weights[k, h]
        for h in range(weights.shape[1]):
            weights[k, h] = weights[k, h] / total if total > 0.0 else 0.0


@njit(cache=True)
def _mix(weights, valid, states, covariances, w, x, P):  # type: ignore[no-untyped-def]
    """Write the mixtures of states [H, N, 4] and covariances [H, N, 3, 3]; the first three states have a covariance.

    ``w`` [N, H] becomes the weights of valid states; if all their weights are 0, they have equal ones.
    """
    for k in range(w.shape[0]):
        total = 0.0
        for h in range(w.shape[1]):
            w[k, h] = weights[k, h] if valid[k, h] else 0.0
            total += w[k, h]
        for h in range(w.shape[1]):
            if not total > 0.0:
                w[k, h] = 1.0 if valid[k, h] else 0.0
    _share(w)
    for k in range(w.shape[0]):
        x[k, :] = 0.0
        P[k, :, :] = 0.0
        for h in range(w.shape[1]):
            if w[k, h] > 0.0:
                for i in range(4):
                    x[k, i] += w[k, h] * states[h, k, i]
                for i in range(3):
                    for j in range(3):
                        P[k, i, j] += w[k, h] * covariances[h, k, i, j]
        for h in range(w.shape[1]):
            if 0.0 < w[k, h] < 1.0:
                for i in range(3):
                    for j in range(i + 1):
                        P[k, i, j] += w[k, h] * (states[h, k, i] - x[k, i]) * (states[h, k, j] - x[k, j])
                        P[k, j, i] = P[k, i, j]


def mix(weights: FloatArray, tracks: Sequence[StateTrack]) -> StateTrack:
    """Return tracks [H] with weights [N, H] as one Gaussian: x = Σ w x_i, P = Σ w (P_i + (x_i − x)(x_i − x)ᵀ).

    Invalid states have weight 0; if all weights of valid ones are 0, these have equal weights.
    """
    valid = np.stack([t.valid for t in tracks], axis=1)
    count = len(valid)
    w, x, P = np.empty(valid.shape), np.empty((count, 4)), np.empty((count, 3, 3))
    states = np.stack([np.stack([t.vx_m_s, t.vy_m_s, t.yaw_rate_rad_s, t.ay_m_s2], axis=1) for t in tracks])
    _mix(weights, valid, states, np.stack([t.covariance for t in tracks]), w, x, P)
    any_valid: BoolArray = valid.any(axis=1)  # type: ignore[assignment]
    x[~any_valid], P[~any_valid] = np.nan, np.nan
    likeliest = np.argmax(w, axis=1)

    def of_likeliest(name: str) -> Any:
        return np.choose(likeliest, [getattr(t, name) for t in tracks])

    return replace(
        tracks[0],
        vx_m_s=x[:, 0].copy(),
        vy_m_s=x[:, 1].copy(),
        yaw_rate_rad_s=x[:, 2].copy(),
        ay_m_s2=x[:, 3].copy(),
        sideslip_rad=np.arctan2(x[:, 1], x[:, 0]),
        covariance=P,
        sideslip_std_rad=sideslip_std(x[:, 0], x[:, 1], P),
        **{name: of_likeliest(name) for name in ("nis", "nis_dof", "friction", "diverged")},
        valid=any_valid,
        **_mixed_columns(w, tracks),
    )


def _mixed_columns(w: FloatArray, tracks: Sequence[StateTrack]) -> dict[str, Any]:
    """Return the mixed estimates beside the motion; a filter without such a state counts as 0."""
    mixed = {}
    for name in ESTIMATED_COLUMNS:
        columns = [getattr(t, name) for t in tracks]
        if any(len(c) == len(w) for c in columns):
            parts = [np.where(w[:, h] > 0.0, w[:, h] * c, 0.0) for h, c in enumerate(columns) if len(c) == len(w)]
            mixed[name] = np.where(w.sum(axis=1) > 0.0, np.sum(parts, axis=0), np.nan)
    return mixed


@dataclass(frozen=True, slots=True)
class AdaptivePhysics:
    """The filter of this file as an estimator.

    Parameters
    ----------
    physics : the car's filter with its parts and noise.
    network : of the model's residual, None without; trust : residual gain of F1, in [0, 1].
    adaptive : False leaves the mechanism out: no detector, and the car's filter alone, with its cures as states.
    notes : texts for the report, such as the reason for its residual gain.
    """

    algorithm = "adaptive-physics"
    version = 1
    options = ("physics", "trust", "adaptive")

    physics: VehicleUkf
    network: ResidualModel | None = None
    trust: float = 0.0
    adaptive: bool = True
    name: str = "pd-hef"
    causal: bool = True
    notes: tuple[str, ...] = ()

    @property
    def cures(self) -> tuple[str, ...]:
        """The cures with a filter."""
        return tuple(cure for cure in CURES if self.adaptive and getattr(self.physics.vehicle.physics, cure))

    @property
    def residual_shares(self) -> tuple[float, ...]:
        """Share of the residual in each filter."""
        return 1.0, *(CURES[cure] for cure in self.cures)

    @property
    def filters(self) -> tuple[VehicleUkf, ...]:
        """F1, and one filter a cure that the car has."""
        vehicle, cures = self.physics.vehicle, self.cures
        if not cures:
            return (self.physics,)
        parts = [vehicle.physics.model_copy(update={c: c == cure for c in CURES}) for cure in ("", *cures)]
        vehicles = [vehicle.model_copy(update={"physics": p}) for p in parts]
        return tuple(replace(self.physics, vehicle=v) for v in vehicles)

    def inputs(self, signals: Signals, state: InputState | None) -> tuple[CheckedInputs, InputState]:
        """Return the inputs of the filters, checked signals with the residual at gain 1, and the state."""
        if self.adaptive:
            return check_inputs(self.physics, self.network, signals, state)
        residual, after = residual_of(self.physics, self.network, signals, state)
        return CheckedInputs(no_faults(signals), residual), after

    def run(self, signals: Signals, state: AdaptiveState | None) -> tuple[MixtureSteps, AdaptiveState]:
        """Process one window (see :class:`~.base.Estimator`)."""
        checked, inputs = self.inputs(signals, state.inputs if state else None)
        faults, rate, filters = checked.faults, self.trust * checked.rate, self.filters
        before: Sequence[FilterState | None] = state.filters if state else [None] * len(filters)
        members = zip(filters, before, self.residual_shares, strict=True)
        runs = [f.run(faults.filtered, b, share * rate, faults.extra_r) for f, b, share in members]
        steps = tuple(filter_steps for filter_steps, _ in runs)
        likelihood, starts = np.stack([s.log_likelihood for s in steps], axis=1), ~np.isfinite(steps[0].prior[:, VX])
        dt_s = step_durations_s(signals.stamps_ns, state.filters[0].last_stamp_ns if state else None)
        evidence = state.evidence.copy() if state else np.zeros(len(filters))
        gathered = gather_evidence(dt_s, likelihood, starts, evidence)
        weights = weigh(gathered, np.stack([filter_steps.valid for filter_steps in steps], axis=1))
        raised = r_scale(faults.extra_r, self.physics.measurement_std)
        after = AdaptiveState(inputs, tuple(state for _, state in runs), evidence)
        return MixtureSteps(steps, weights, raised, faults.reason, self.trust * checked.residual.gain), after

    def predict(self, steps: MixtureSteps, ahead: Extrapolation, stamps_ns: IntArray) -> StateTrack:
        """Extrapolate each filter's steps and mix them (see :class:`~.base.ModelPredictor`)."""
        step, tracks = ahead.step, []
        for h, (physics_filter, of_one) in enumerate(zip(self.filters, steps.filters, strict=True)):
            weighed = of_one.valid[step] & (steps.weights[step, h] > 0.0)
            tracks.append(physics_filter.predict(of_one, replace(ahead, usable=ahead.usable & weighed), stamps_ns))
        track = mix(steps.weights[step], tracks) if len(tracks) > 1 else tracks[0]
        reason = np.where(ahead.arrived, steps.reason[step], 0)
        return self.described(track, steps.weights[step], steps.gain[step], steps.r_scale[step], reason)

    # positional: the columns of a track.
    def described(
        self, track: StateTrack, weights: FloatArray, gain: FloatArray, raised: FloatArray, reason: IntArray
    ) -> StateTrack:
        """Return a track [N] with residual gain, weight of the cures (weights [N, H]), factor on R and reasons [N]."""
        columns: dict[str, Any] = {"network_trust": np.where(track.valid, gain, np.nan)}
        if self.adaptive:
            columns["r_scale"] = np.where(track.valid, raised, 1.0)
            columns["mixture_weight"] = np.where(track.valid, 1.0 - weights[:, 0], np.nan)
            columns["reason"] = reason
        return replace(track, name=self.name, **columns)


def build(name: str, car: Car, options: Options) -> AdaptivePhysics:
    """Return ``physics`` of a car."""
    return AdaptivePhysics(of_car(car, use_speed=options.use_speed), name=name)
