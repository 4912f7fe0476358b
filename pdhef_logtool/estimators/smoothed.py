"""``pd-hef-smoothed``: Rauch-Tung-Striebel smoothing over ``pd-hef`` (docs/method.md#smoothing). Not causal.

The filters of ``pd-hef``, each with its residual, run forward on checked signals (:mod:`~.checked_inputs`) and are
smoothed backward (:mod:`~.rts`) with the cross covariances of their sigma points (Särkkä 2008). The network's residual
is a known input of a step: it is contained in its prediction. The process noise is identified separately for smoothing
(:func:`for_smoothing`).

- A start (first step, gap, failure) ends the recursion: later steps give no information on earlier ones. A standstill
  sets the motion to zero, which is no measurement: it ends the recursion, too.
- If the gate opened, the inflated covariance is used as predicted covariance, like process noise of that step.
- The detector is causal: later samples do not make it detect a fault sooner.

The filters are mixed as in :mod:`~.adaptive_physics`, with the evidence of earlier and of later samples, the latter
forgotten with its distance: Λ_k + Λ'_k.

A drive is smoothed in blocks of ``block_s``, each with all steps up to the end of the next one, so that memory is
bounded.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import pairwise

import numpy as np

from pdhef_logtool.estimators.adaptive_physics import AdaptivePhysics, forgotten, gather_evidence, mix, weigh
from pdhef_logtool.estimators.checked_inputs import CheckedInputs
from pdhef_logtool.estimators.filter_steps import LinkedSteps
from pdhef_logtool.estimators.rts import smooth_covariances, smooth_states
from pdhef_logtool.estimators.vehicle_ukf import FilterState, VehicleUkf
from pdhef_logtool.records.signals import NS_PER_S, BoolArray, FloatArray, IntArray, Signals
from pdhef_logtool.records.steps import Extrapolation
from pdhef_logtool.records.tracks import StateTrack, concatenate

#: Minimum look-ahead of a step; the maximum is twice as much. Sensor biases have time constants of minutes: compared
#: with 120 s, v_y of a drive at 20 Hz changes by up to 3.3e-3 m/s.
BLOCK_S = 60.0
#: Note for the report.
NOT_CAUSAL = "not causal: estimates use later measurements; to be ranked apart from causal estimators"


def for_smoothing(physics: VehicleUkf, factors: Sequence[float]) -> VehicleUkf:
    """Return a filter with factors on its process noise of v_y and yaw rate."""
    along, vy, rate, *rest = physics.q_std
    return replace(physics, q_std=(along, vy * factors[0], rate * factors[1], *rest))


@dataclass(frozen=True, slots=True)
class SmoothedPhysics:
    """The car's physics filters with residual gain times the residual, smoothed.

    Parameters
    ----------
    filtered : the estimator to smooth, with its inputs and forward filters.
    block_s : minimum look-ahead of a step, in s; the maximum is twice as much.
    notes : for the report.
    """

    algorithm = "smoothed-physics"
    version = 3
    options = ("filtered", "block_s")

    filtered: AdaptivePhysics
    block_s: float = BLOCK_S
    name: str = "pd-hef-smoothed"
    causal: bool = False
    notes: tuple[str, ...] = (NOT_CAUSAL,)

    def smooth(self, signals: Signals) -> StateTrack:
        """Return the track of a drive (see :class:`~.base.Smoother`)."""
        checked = self._inputs(signals)
        tracks, weights = self._filtered(signals, self.filtered.trust * checked.rate, checked.extra_r)
        track = mix(weights, tracks) if len(tracks) > 1 else tracks[0]
        track = self.filtered.described(track, weights, checked)
        return replace(
            track,
            name=self.name,
            nis=np.full(len(signals), np.nan),  # a smoothed state has no innovation
            nis_dof=np.zeros(len(signals)),
            mixture_weight=track.mixture_weight if len(tracks) > 1 else np.empty(0),
        )

    def _inputs(self, signals: Signals) -> CheckedInputs:
        """Return faults and residual of a drive."""
        state, parts = None, []
        for part in blocks(signals.stamps_ns, self.block_s):
            checked, state = self.filtered.inputs(signals.rows(part.start, part.stop), state)
            parts.append(checked)
        return reduce(CheckedInputs.joined, parts)

    def _filtered(self, signals: Signals, rate: FloatArray, extra_r: FloatArray) -> tuple[list[StateTrack], FloatArray]:
        """Return the smoothed tracks of all filters [H], and their weights [N, H]."""
        members = zip(self.filtered.filters, self.filtered.residual_shares, strict=True)
        drives = [self._smoothed(f, signals, share * rate, extra_r) for f, share in members]
        tracks = [track for track, _, _ in drives]
        if len(drives) == 1:
            return tracks, np.ones((len(signals), 1))
        likelihood, starts = np.stack([of_one for _, of_one, _ in drives], axis=1), drives[0][2]
        kept, counted = forgotten(signals.steps_s, likelihood, starts)
        evidence = gather_evidence(kept, counted, np.zeros(len(drives))) - counted  # both directions contain a step
        backward = np.append(kept[1:], 0.0)[::-1].copy(), counted[::-1].copy()
        evidence += gather_evidence(*backward, np.zeros(len(drives)))[::-1]
        return tracks, weigh(evidence, np.stack([t.valid for t in tracks], axis=1), self.filtered.odds)

    def _smoothed(
        self, physics: VehicleUkf, signals: Signals, rate: FloatArray, extra_r: FloatArray
    ) -> tuple[StateTrack, FloatArray, BoolArray]:
        """Filter a drive and smooth it block by block; return its track, log-likelihood and starts, [N]."""
        likelihood, starts = [], []

        def pieces() -> Iterator[StateTrack]:
            before: FilterState | None = None
            pending: LinkedSteps | None = None
            for part in blocks(signals.stamps_ns, self.block_s):
                given = (signals.rows(part.start, part.stop), before, rate[part], extra_r[part])
                forward, before = physics.linked_steps(*given)
                likelihood.append(forward.posterior.log_likelihood)
                starts.append(~np.isfinite(forward.posterior.prior[:, 0]))
                if pending is not None:
                    yield smoothed_track(physics, pending, forward)
                pending = forward
            if pending is not None:
                yield smoothed_track(physics, pending, None)

        return concatenate(pieces(), len(signals)), np.concatenate(likelihood), np.concatenate(starts)


def smoothed_track(physics: VehicleUkf, steps: LinkedSteps, following: LinkedSteps | None) -> StateTrack:
    """Return the smoothed track of steps, with those that follow them."""
    joined = steps if following is None else steps.joined(following)
    run, linked, count = joined.posterior, joined.linked[:, None], len(steps.posterior.stamps_ns)
    predicted_x = np.where(linked, run.prior, run.x)
    predicted_P = np.where(linked[:, :, None], joined.predicted_P, run.P)
    cross = np.where(linked[:, :, None], joined.cross, 0.0)
    x = smooth_states(run.x, predicted_x, predicted_P, cross)[:count]
    P = smooth_covariances(run.P, predicted_P, cross)[:count]
    smoothed = replace(steps.posterior, x=x, P=P)
    return physics.predict(smoothed, Extrapolation.none(smoothed.valid), smoothed.stamps_ns)


def blocks(stamps_ns: IntArray, block_s: float) -> Iterator[slice]:
    """Yield the steps of each non-empty block of ``block_s``, counted from the first step."""
    if not len(stamps_ns):
        yield slice(0, 0)
        return
    block = (stamps_ns - stamps_ns[0]) // round(block_s * NS_PER_S)
    edges = [0, *(np.flatnonzero(np.diff(block)) + 1).tolist(), len(block)]
    yield from (slice(first, end) for first, end in pairwise(edges))
