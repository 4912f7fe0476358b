"""``pd-hef-smoothed``: Rauch-Tung-Striebel smoothing over ``pd-hef`` (METHOD §12, §14). Not causal.

Forward run the filters of ``pd-hef``, each with its residual, on checked signals (:mod:`~.checked_inputs`);
backward goes each of them, from the last step that is seen,

    G_k = C_{k,k+1} P_{k+1|k}⁻¹
    x^s_k = x_k + G_k (x^s_{k+1} − x_{k+1|k})
    P^s_k = P_k + G_k (P^s_{k+1} − P_{k+1|k}) G_kᵀ

with C from the sigma points of the step before Q is added and they are drawn anew (Särkkä 2008). The network's residual
is a known input of the step, so that it stands in x_{k+1|k} and needs no term of its own.

- A start (first step, gap, failure) ends the recursion: nothing behind it tells of what lies before it.
- A standstill overwrites the motion with zero. That is no measurement, so none of it goes back.
- Where the gate opened, the inflated covariance counts as that of the prediction: process noise of that step.
- The detector is causal: what comes later does not make it find a fault sooner.

They are mixed as in :mod:`~.adaptive_physics`, with the likelihood of what comes later, forgotten with its distance,
beside that of what came before: Λ_k + Λ'_k.

A log is smoothed in blocks of fixed time, counted from its first step: each with all that follows up to the end of the
next block. So a step sees from one to two blocks ahead, memory is bounded, and no window changes a bit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np

from pdhef_logtool.estimators.adaptive_physics import (
    FORGET_S,
    AdaptivePhysics,
    gather_evidence,
    mix,
    weigh,
)
from pdhef_logtool.estimators.checked_inputs import CheckedInputs, InputCarry, r_scale
from pdhef_logtool.estimators.filter_shell import AX_BIAS, VX, PosteriorSteps
from pdhef_logtool.estimators.physics import LINK_BIASES, LINK_NONE, FilterCarry, StepLinks
from pdhef_logtool.estimators.unscented import cholesky_lower, repair_covariance
from pdhef_logtool.records.compiled import njit
from pdhef_logtool.records.release import RESTART_GAP_S, StepColumns, step_durations_s
from pdhef_logtool.records.signals import FloatArray, IntArray, Signals, join_signals
from pdhef_logtool.records.tracks import StateTrack, concatenate

#: A step sees at least this much ahead and at most twice as much. Sensor biases remember for minutes: against a
#: smoother that sees all of a drive of 300 s this changed v_y by less than 5e-5 m/s (60 s: 5e-4 m/s).
BLOCK_S = 120.0
#: Steps that are smoothed at a time, whatever the window, so that 7 states need some 50 MB. Changes no bit.
STEPS_AT_ONCE = 8192
#: What the report says of it.
NOT_CAUSAL = "not causal: an estimate uses what was measured later; to be ranked apart from causal ones"


@njit(cache=True)
def _smoother_gain(cross, predicted, first, L, gain):  # type: ignore[no-untyped-def]
    """Write C P⁻¹ to gain [n, n] over the entries from ``first`` on of the later state; the columns before are 0."""
    n = cross.shape[0]
    size = n - first
    A = np.empty((size, size))
    for i in range(size):
        for j in range(size):
            A[i, j] = predicted[first + i, first + j]
    if not cholesky_lower(A, L[:size, :size]):
        repair_covariance(A)
        cholesky_lower(A, L[:size, :size])
    gain[:, :] = 0.0
    row = np.empty(size)
    for a in range(n):
        for i in range(size):  # forward, then backward substitution with A = L Lᵀ
            s = cross[a, first + i]
            for j in range(i):
                s -= L[i, j] * row[j]
            row[i] = s / L[i, i]
        for i in range(size - 1, -1, -1):
            s = row[i]
            for j in range(i + 1, size):
                s -= L[j, i] * row[j]
            row[i] = s / L[i, i]
        for i in range(size):
            gain[a, first + i] = row[i]


@njit(cache=True)
def _smooth(forward, links, span, smoothed):  # type: ignore[no-untyped-def]
    """Smooth the first steps of a span with all of it; writes state [K, n] and covariance [K, n, n].

    ``forward`` are posterior state, covariance and prior state, ``links`` the columns of :class:`~.physics.StepLinks`,
    ``span`` the first step, the last one that is written and the last one, inclusive.
    """
    x, P, prior = forward
    kind, predicted_P, cross = links
    first, last, end = span
    out_x, out_P = smoothed
    n = x.shape[1]
    xs, Ps = x[end].copy(), P[end].copy()
    L, gain, change = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    half, check = np.empty((n, n)), np.empty((n, n))
    for k in range(end, first - 1, -1):
        if k < end:
            if kind[k + 1] == LINK_NONE:
                xs[:] = x[k]
                Ps[:, :] = P[k]
            else:
                overwritten = AX_BIAS if kind[k + 1] == LINK_BIASES else 0
                _smoother_gain(cross[k + 1], predicted_P[k + 1], overwritten, L, gain)
                move = xs - prior[k + 1]
                for i in range(n):
                    for j in range(n):
                        change[i, j] = Ps[i, j] - predicted_P[k + 1, i, j]
                for a in range(n):
                    xs[a] = x[k, a]
                    for i in range(overwritten, n):
                        xs[a] += gain[a, i] * move[i]
                    for j in range(n):
                        s = 0.0
                        for i in range(overwritten, n):
                            s += gain[a, i] * change[i, j]
                        half[a, j] = s
                for a in range(n):
                    for b in range(a + 1):
                        s = 0.5 * (P[k, a, b] + P[k, b, a])
                        for j in range(overwritten, n):
                            s += 0.5 * (half[a, j] * gain[b, j] + half[b, j] * gain[a, j])
                        Ps[a, b] = s
                        Ps[b, a] = s
                if not cholesky_lower(Ps, check):
                    repair_covariance(Ps)
        if k <= last:
            out_x[k] = xs
            out_P[k] = Ps


#: Smoothed states [K, n] and covariances [K, n, n].
Smoothed: TypeAlias = tuple[FloatArray, FloatArray]


def spans(steps: PosteriorSteps, count: int, origin_ns: int, block_ns: int) -> Iterator[tuple[int, int, int]]:
    """Yield of each block that begins in the first ``count`` steps its first and last step there, and the last it sees.

    A step of block b, counted from ``origin_ns``, is smoothed with what is given of blocks b and b + 1.
    """
    block = (steps.stamps_ns - origin_ns) // block_ns
    for b in np.unique(block[:count]).tolist():
        first, behind = (int(i) for i in np.searchsorted(block, (b, b + 1)))
        yield first, min(behind, count) - 1, int(np.searchsorted(block, b + 2)) - 1


def smooth_steps(
    steps: PosteriorSteps, links: StepLinks, count: int, origin_ns: int, block_ns: int
) -> tuple[FloatArray, FloatArray]:
    """Return smoothed states [count, n] and covariances [count, n, n] of the first ``count`` steps (see `spans`)."""
    x, P = smooth_blocks(steps, links, count, origin_ns, block_ns)
    return x[:count], P[:count]


# positional: those of `smooth_steps`, and what is known already.
def smooth_blocks(
    steps: PosteriorSteps,
    links: StepLinks,
    count: int,
    origin_ns: int,
    block_ns: int,
    known: Smoothed | None = None,
) -> Smoothed:
    """Return what `smooth_steps` does of all steps of the blocks that the first ``count`` steps lie in, [M ≥ count].

    ``known`` [D] is what this has returned of the first steps before, up to the end of a block: it is not done again.
    """
    n, done = steps.x.shape[1], 0 if known is None else len(known[0])
    block = (steps.stamps_ns - origin_ns) // block_ns
    end = max(done, int(np.searchsorted(block, block[count - 1], side="right")) if count else 0)
    x, P = np.empty((end, n)), np.empty((end, n, n))
    if known is not None:
        x[:done], P[:done] = known
    forward, tied = (steps.x, steps.P, steps.prior), (links.kind, links.predicted_P, links.cross)
    for first, last, seen in spans(steps, end, origin_ns, block_ns):
        if first >= done:
            _smooth(forward, tied, (first, last, seen), (x, P))
    return x, P


@njit(cache=True)
def _look_back(dt, likelihood, starts, span, out):  # type: ignore[no-untyped-def]
    """Add to Λ [K, H] of the first steps of a span the likelihood of what follows them in it."""
    first, last, end = span
    later = np.zeros(likelihood.shape[1])
    for k in range(end - 1, first - 1, -1):
        if starts[k + 1] or not dt[k + 1] <= RESTART_GAP_S:
            later[:] = 0.0
        else:
            if np.isfinite(likelihood[k + 1]).all():
                later += likelihood[k + 1]
            later *= math.exp(-dt[k + 1] / FORGET_S)
        if k <= last:
            out[k] += later


@dataclass(frozen=True, slots=True, eq=False)
class ForwardSteps(StepColumns):
    """Steps of a filter's forward pass: posteriors, and what ties them."""

    posterior: PosteriorSteps
    links: StepLinks


@dataclass(frozen=True, slots=True, eq=False)
class SharedSteps(StepColumns):
    """What all filters share: their evidence Λ [K, H], and ``extra_r`` [K, 2] and ``reason`` [K] of the detector."""

    evidence: FloatArray
    extra_r: FloatArray
    reason: IntArray

    def __len__(self) -> int:
        """Return the number of steps."""
        return len(self.reason)


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedCarry:
    """State of the inputs, the forward filters [H] and their evidence behind all steps that are taken; those ahead.

    ``inputs`` is None where all inputs are known beforehand. ``origin_ns`` is where the blocks begin; ``smoothed`` what
    is done already of the steps ahead, by filter.
    """

    inputs: InputCarry | None
    forward: tuple[FilterCarry, ...]
    evidence: FloatArray
    ahead: tuple[ForwardSteps, ...]
    shared: SharedSteps
    origin_ns: int | None
    smoothed: tuple[Smoothed, ...]


@dataclass(frozen=True, slots=True)
class SmoothedPhysics:
    """The car's physics filters with trust times the residual, smoothed.

    Parameters
    ----------
    filtered : what is smoothed: its inputs, and its filters run forward.
    block_s : a step sees at least this much ahead, in s, and at most twice as much.
    notes : what the report says of it.
    """

    filtered: AdaptivePhysics
    block_s: float = BLOCK_S
    name: str = "pd-hef-smoothed"
    causal: bool = False
    notes: tuple[str, ...] = (NOT_CAUSAL,)

    @property
    def look_ahead_s(self) -> float:
        """How much of what follows a window :meth:`run` is to be given."""
        return 2.0 * self.block_s

    def run(
        self,
        signals: Signals,
        carry: SmoothedCarry | None,
        ahead: Signals | None = None,
        known: CheckedInputs | None = None,
    ) -> tuple[StateTrack, SmoothedCarry]:
        """Process one window (see :class:`~.base.LookingAhead`).

        Parameters
        ----------
        ahead : what follows the window, at least ``look_ahead_s`` of it or all that there is; the next window begins
            with it. Without it the log ends here for all that the smoother knows.
        known : what :meth:`~.AdaptivePhysics.inputs` returns for a whole log that is given as one window; it is then
            not called.
        """
        given = signals if ahead is None else join_signals([signals, ahead])
        parts = []
        for first in range(0, max(len(signals), 1), STEPS_AT_ONCE):
            end = min(first + STEPS_AT_ONCE, len(signals))
            seen = len(given)
            if end < len(signals):
                horizon_ns = given.stamps_ns[end - 1] + round(self.look_ahead_s * 1e9)
                seen = int(np.searchsorted(given.stamps_ns, horizon_ns, side="right"))
            taken = first + (0 if carry is None else len(carry.shared))
            fresh = given.rows(taken, seen)
            inputs = None if carry is None else carry.inputs
            if known is None:
                checked, inputs = self.filtered.inputs(fresh, inputs)
            else:
                checked = known.cut(taken, seen)
            steps, shared, forward, evidence = self._filtered(checked, carry)
            if carry is not None:
                steps = tuple(before.joined(now) for before, now in zip(carry.ahead, steps, strict=True))
                shared = carry.shared.joined(shared)
            origin_ns = carry.origin_ns if carry else None
            if origin_ns is None and len(given):
                origin_ns = int(given.stamps_ns[0])
            done = None if carry is None else carry.smoothed
            part, done = self._smoothed(given.rows(first, end), steps, shared, forward, origin_ns or 0, done)
            parts.append(part)
            passed = end - first
            ahead_of = tuple(one.since(passed) for one in steps)
            carry = SmoothedCarry(inputs, forward, evidence, ahead_of, shared.since(passed), origin_ns, done)
        assert carry is not None
        return concatenate(parts), carry

    def _filtered(
        self, checked: CheckedInputs, carry: SmoothedCarry | None
    ) -> tuple[tuple[ForwardSteps, ...], SharedSteps, tuple[FilterCarry, ...], FloatArray]:
        """Run the filters forward over steps that they have not taken yet; the last two are carried on."""
        faults, filters = checked.faults, self.filtered.filters
        rate = self.filtered.trust * checked.rate
        before = carry.forward if carry else [None] * len(filters)
        runs = [f.linked_steps(faults.filtered, b, rate, faults.extra_r) for f, b in zip(filters, before, strict=True)]
        gathered, evidence = gather_evidence(
            [steps for steps, _, _ in runs], carry.forward if carry else None, carry.evidence if carry else None
        )
        shared = SharedSteps(gathered, faults.extra_r, faults.reason)
        forward = tuple(ForwardSteps(steps, links) for steps, _, links in runs)
        return forward, shared, tuple(after for _, after, _ in runs), evidence

    # positional: the steps and what belongs to them.
    def _smoothed(
        self,
        signals: Signals,
        steps: Sequence[ForwardSteps],
        shared: SharedSteps,
        after: Sequence[FilterCarry],
        origin_ns: int,
        done: tuple[Smoothed, ...] | None,
    ) -> tuple[StateTrack, tuple[Smoothed, ...]]:
        """Smooth the steps of ``signals``, which are the first of ``steps``, with all of them.

        ``done`` by filter are the first of them that are smoothed already; beside the track it returns those that are
        smoothed now of the steps that follow.
        """
        count, block_ns = len(signals), round(self.block_s * 1e9)
        physics = self.filtered.physics
        tracks, valid, following = [], [], []
        for i, (one, forward, carry) in enumerate(zip(self.filtered.filters, steps, after, strict=True)):
            before = None if done is None else done[i]
            x, P = smooth_blocks(forward.posterior, forward.links, count, origin_ns, block_ns, before)
            following.append((x[count:].copy(), P[count:].copy()))
            here = replace(forward.posterior.until(count), x=x[:count], P=P[:count], ready_ns=signals.stamps_ns)
            # Known at its own stamp, a step is not predicted: what comes back is the step itself.
            track, _ = one.outputs(signals, None, here, carry)
            tracks.append(track)
            valid.append(here.valid)
        track = tracks[0]
        told: dict[str, Any] = {}
        if len(tracks) > 1:
            evidence = self._two_sided([f.posterior for f in steps], shared.evidence, count, origin_ns)
            weights = weigh(evidence, np.stack(valid, axis=1))
            track = mix(weights, tracks)
            told["mixture_weight"] = np.where(track.valid, 1.0 - weights[:, 0], np.nan)
        whole = replace(
            track,
            name=self.name,
            network_trust=np.where(track.valid, self.filtered.trust, np.nan),
            r_scale=np.where(track.valid, r_scale(shared.extra_r[:count], physics.measurement_std), 1.0),
            nis=np.full(count, np.nan),  # a smoothed state has no innovation
            nis_dof=np.zeros(count),
            reason=shared.reason[:count],
            **told,
        )
        return whole, tuple(following)

    def _two_sided(
        self, steps: Sequence[PosteriorSteps], evidence: FloatArray, count: int, origin_ns: int
    ) -> FloatArray:
        """Return Λ + Λ' [count, H]."""
        out = evidence[:count].copy()
        likelihood = np.stack([s.log_likelihood for s in steps], axis=1)
        dt, starts = step_durations_s(steps[0].stamps_ns, None), ~np.isfinite(steps[0].prior[:, VX])
        for span in spans(steps[0], count, origin_ns, round(self.block_s * 1e9)):
            _look_back(dt, likelihood, starts, span, out)
        return out
