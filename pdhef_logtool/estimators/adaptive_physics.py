"""``physics`` and ``pd-hef``: the physics filter with residual gain times a network's residual, adaptive.

All gains use the noise of the car's physics: the gain scales the residual only, and ``physics`` has gain 0 and no
network. The mechanism (docs/method.md#adaptation) does not treat model error as noise.

Bottom layer: the drive marks faults of a_y and yaw rate (:mod:`~.checked_inputs`). They apply to every filter here and
to the parallel one, and keep bad samples from the network.

Top layer: a bank of filters, each a hypothesis about the car's model. F1 assumes that the model with its residual is
complete; each other filter adds one state: a scale of all forces, or the bank of the road. With both in one filter, the
same error moves between them, and ``physics`` has 0.35° in place of 0.19° on banked roads. A residual is trained on one
vehicle and level roads: the filter of another vehicle, with a force scale, uses half of it, and the filter of a banked
road none. With Λ the sum of a filter's log-likelihood of its measurements, forgotten within seconds, the weight of
filter i is

    w_i ∝ p_i exp(Λ_i)

which is multiple-model estimation (Magill 1965) for temporary effects; p_i are the odds before any measurement. Where
the residual acts, the process noise of v_y and yaw rate is smaller, as long as the innovations agree. A state has a
filter only if drives of the car have shown its benefit, because an additional state always fits something. A car
without identified parts has F1 alone. The output is the mixture of all, its covariance with their differences.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.estimators.checked_inputs import CheckedInputs, InputState, check_inputs
from pdhef_logtool.estimators.filter_steps import PosteriorSteps
from pdhef_logtool.estimators.prediction import sideslip_std
from pdhef_logtool.estimators.vehicle_model import VX
from pdhef_logtool.estimators.vehicle_ukf import FilterState, VehicleUkf, of_car
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray, Signals
from pdhef_logtool.records.steps import RESTART_GAP_S, Extrapolation, StepColumns
from pdhef_logtool.records.tracks import ESTIMATED_COLUMNS, StateTrack
from pdhef_logtool.residual_model.interface import ResidualModel

if TYPE_CHECKING:
    from pdhef_logtool.car.car import Car
    from pdhef_logtool.estimators.presets import Options


class Cure(NamedTuple):
    """A possible deficiency of the model, as the state of one filter.

    That filter uses a ``share`` of the residual, and has ``odds`` against F1 before any measurement.
    """

    share: float
    odds: float


#: By part of ``physics``; chosen on simulated drives that no table contains. With even odds, tyres near their limit on
#: a level road are taken for a bank.
CURES = {"force_scale": Cure(0.5, 1.0), "bank": Cure(0.0, math.exp(-2.0))}
#: Factor on the 1-sigma of the process noise of v_y and yaw rate at gain 1 of a network that was trained with the
#: filter. Chosen on the same drives: from 0.65 to 0.3 little changes.
RESIDUAL_NOISE = 0.5
#: Time constant with which the likelihood is forgotten, s. Chosen on simulated drives that no table contains; from 1 to
#: 5 s little changes.
FORGET_S = 2.0
#: Columns of the state to mix; the first three have a covariance.
MOTION_COLUMNS = ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "ay_m_s2")
#: Smaller weights are set to 0.
LEAST_WEIGHT = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class MixtureSteps(StepColumns):
    """Steps of all filters [H], their weights [K, H], and faults and residual of the steps."""

    filters: tuple[PosteriorSteps, ...]
    weights: FloatArray
    inputs: CheckedInputs

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
def gather_evidence(kept, likelihood, evidence):  # type: ignore[no-untyped-def]
    """Return Λ [K, H], the decaying sum of log-likelihoods [K, H]; each step keeps the share ``kept`` [K] of the sum.

    ``evidence`` [H] is Λ before the first step and becomes that of the last.
    """
    out = np.empty_like(likelihood)
    for k in range(kept.shape[0]):
        evidence[:] = kept[k] * evidence + likelihood[k]
        out[k] = evidence
    return out


def forgotten(dt_s: FloatArray, likelihood: FloatArray, starts: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return the share of Λ that steps of durations ``dt_s`` [K] keep, and the log-likelihoods [K, H] that count.

    Nothing is kept, and nothing counts, where a filter starts; a step with an unknown likelihood counts for no filter.
    """
    starts = starts | ~(dt_s <= RESTART_GAP_S)
    counts = np.isfinite(likelihood).all(axis=1) & ~starts
    return np.where(starts, 0.0, np.exp(-dt_s / FORGET_S)), np.where(counts[:, None], likelihood, 0.0)


def weigh(evidence: FloatArray, usable: BoolArray, odds: Sequence[float]) -> FloatArray:
    """Return weights [K, H] in proportion to odds [H] · exp(evidence), of sum 1; 0 where not ``usable`` [K, H]."""
    evidence = evidence + np.log(odds)
    best = np.max(evidence, axis=1, keepdims=True, initial=-math.inf, where=usable)
    weights = np.exp(np.where(usable, evidence - best, -math.inf))
    weights[weights < LEAST_WEIGHT * weights.sum(axis=1, keepdims=True)] = 0.0
    return _shares(weights)


def weights_of(
    steps: Sequence[PosteriorSteps], dt_s: FloatArray, evidence: FloatArray, odds: Sequence[float]
) -> FloatArray:
    """Return the weights [K, H] of the steps of all filters [H]; ``evidence`` as in :func:`gather_evidence`."""
    likelihood, starts = np.stack([s.log_likelihood for s in steps], axis=1), ~np.isfinite(steps[0].prior[:, VX])
    gathered = gather_evidence(*forgotten(dt_s, likelihood, starts), evidence)
    return weigh(gathered, np.stack([s.valid for s in steps], axis=1), odds)


def _shares(weights: FloatArray) -> FloatArray:
    """Return weights [K, H] divided by their sums; a row of zeros stays."""
    total = weights.sum(axis=1, keepdims=True)
    shares: FloatArray = np.divide(weights, total, out=np.zeros_like(weights), where=total > 0.0)
    return shares


def _column(track: StateTrack, name: str) -> FloatArray:
    """Return a column of a track [N], zeros without one."""
    column: FloatArray = getattr(track, name)
    return column if len(column) == len(track) else np.zeros(len(track))


def mix(weights: FloatArray, tracks: Sequence[StateTrack]) -> StateTrack:
    """Return tracks [H] with weights [N, H] as one Gaussian: x = Σ w x_i, P = Σ w (P_i + (x_i − x)(x_i − x)ᵀ).

    Invalid states have weight 0; if all weights of valid ones are 0, these have equal weights.
    """
    valid = np.stack([t.valid for t in tracks], axis=1)
    w = np.where(valid, weights, 0.0)
    w = _shares(np.where(w.sum(axis=1, keepdims=True) > 0.0, w, valid))
    # A filter without one of the estimates beside the motion counts as 0.
    names = [*MOTION_COLUMNS, *(n for n in ESTIMATED_COLUMNS if any(len(getattr(t, n)) for t in tracks))]
    used, states = w > 0.0, [np.stack([_column(t, n) for n in names], axis=1) for t in tracks]
    x, P = np.zeros((len(w), len(names))), np.zeros((len(w), 3, 3))
    for share, rows, state in zip(w.T, used.T, states, strict=True):
        x[rows] += share[rows, None] * state[rows]
    for share, rows, state, track in zip(w.T, used.T, states, tracks, strict=True):
        away = (state[rows] - x[rows])[:, :3]
        P[rows] += share[rows, None, None] * (track.covariance[rows] + away[:, :, None] * away[:, None, :])
    any_valid: BoolArray = valid.any(axis=1)  # type: ignore[assignment]
    x[~any_valid], P[~any_valid] = np.nan, np.nan
    likeliest = np.argmax(w, axis=1)
    mixed: dict[str, Any] = {name: x[:, i].copy() for i, name in enumerate(names)}

    for name in ("nis", "nis_dof", "friction", "diverged"):
        mixed[name] = np.choose(likeliest, [getattr(t, name) for t in tracks])
    return replace(
        tracks[0],
        **mixed,
        sideslip_rad=np.arctan2(x[:, 1], x[:, 0]),
        covariance=P,
        sideslip_std_rad=sideslip_std(x[:, 0], x[:, 1], P),
        valid=any_valid,
    )


@dataclass(frozen=True, slots=True)
class AdaptivePhysics:
    """The filter of this file as an estimator.

    Parameters
    ----------
    physics : the car's filter with its parts and noise.
    network : of the model's residual, None without; trust : residual gain of F1, in [0, 1].
    residual_noise : factor on the process noise of v_y and yaw rate at gain 1.
    adaptive : False leaves the mechanism out: no detector, and the car's filter alone, with its cures as states.
    notes : texts for the report, such as the reason for its residual gain.
    """

    algorithm = "adaptive-physics"
    version = 3
    options = ("physics", "trust", "residual_noise", "adaptive")

    physics: VehicleUkf
    network: ResidualModel | None = None
    trust: float = 0.0
    residual_noise: float = 1.0
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
        return 1.0, *(CURES[cure].share for cure in self.cures)

    @property
    def odds(self) -> tuple[float, ...]:
        """Odds of each filter before any measurement."""
        return 1.0, *(CURES[cure].odds for cure in self.cures)

    @property
    def filters(self) -> tuple[VehicleUkf, ...]:
        """F1, and one filter for each cure that the car has."""
        vehicle, cures = self.physics.vehicle, self.cures
        if not cures:
            return (self.physics,)
        parts = [vehicle.physics.model_copy(update={c: c == cure for c in CURES}) for cure in ("", *cures)]
        vehicles = [vehicle.model_copy(update={"physics": p}) for p in parts]
        return tuple(replace(self.physics, vehicle=v) for v in vehicles)

    def inputs(self, signals: Signals, state: InputState | None) -> tuple[CheckedInputs, InputState]:
        """Return faults and the residual at gain 1, and the state."""
        if not self.adaptive:
            signals = replace(signals, extra_variance=np.zeros((len(signals), 2)))
        return check_inputs(self.physics, self.network, signals, state)

    def run(self, signals: Signals, state: AdaptiveState | None) -> tuple[MixtureSteps, AdaptiveState]:
        """Process one window (see :class:`~.base.Estimator`)."""
        checked, inputs = self.inputs(signals, state.inputs if state else None)
        rate, filters = self.trust * checked.rate, self.filters
        before: Sequence[FilterState | None] = state.filters if state else [None] * len(filters)
        members = zip(filters, before, self.residual_shares, strict=True)
        noise = 1.0 - (1.0 - self.residual_noise) * self.trust * checked.gain
        runs = [f.run(signals, b, share * rate, checked.extra_r, noise) for f, b, share in members]
        steps = tuple(filter_steps for filter_steps, _ in runs)
        evidence = state.evidence.copy() if state else np.zeros(len(filters))
        weights = weights_of(steps, signals.steps_s, evidence, self.odds)
        return MixtureSteps(steps, weights, checked), AdaptiveState(inputs, tuple(s for _, s in runs), evidence)

    def predict(self, steps: MixtureSteps, ahead: Extrapolation, stamps_ns: IntArray) -> StateTrack:
        """Extrapolate each filter's steps and mix them (see :class:`~.base.ModelPredictor`)."""
        step, tracks = ahead.step, []
        for h, (physics_filter, of_one) in enumerate(zip(self.filters, steps.filters, strict=True)):
            weighed = of_one.valid[step] & (steps.weights[step, h] > 0.0)
            tracks.append(physics_filter.predict(of_one, replace(ahead, usable=ahead.usable & weighed), stamps_ns))
        track = mix(steps.weights[step], tracks) if len(tracks) > 1 else tracks[0]
        return self.described(track, steps.weights[step], steps.inputs.at(step), ahead.arrived)

    def described(
        self, track: StateTrack, weights: FloatArray, inputs: CheckedInputs, arrived: BoolArray | bool = True
    ) -> StateTrack:
        """Return a track [N] with residual gain, weight of the cures (weights [N, H]), factor on R and reasons."""
        columns: dict[str, Any] = {"network_trust": np.where(track.valid, self.trust * inputs.gain, np.nan)}
        if self.adaptive:
            raised = 1.0 + (inputs.extra_r / self.physics.measurement_std[:2] ** 2).max(axis=1, initial=0.0)
            columns["r_scale"] = np.where(track.valid, raised, 1.0)
            columns["mixture_weight"] = np.where(track.valid, 1.0 - weights[:, 0], np.nan)
            columns["reason"] = np.where(arrived, inputs.reason, 0)
        return replace(track, name=self.name, **columns)


def build(name: str, car: "Car", options: "Options") -> AdaptivePhysics:
    """Return ``physics`` of a car."""
    return AdaptivePhysics(of_car(car, use_speed=options.use_speed), name=name)
