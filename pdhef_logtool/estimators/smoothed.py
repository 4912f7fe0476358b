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
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray, Signals, join_signals
from pdhef_logtool.records.tracks import StateTrack, concatenate

#: A step sees at least this much ahead and at most twice as much. Sensor biases remember for minutes: against a
#: smoother that sees all of a drive of 300 s this changed v_y by less than 5e-5 m/s (60 s: 5e-4 m/s).
BLOCK_S = 120.0
#: Steps that are filtered and smoothed at a time, whatever the window. Changes no bit.
STEPS_AT_ONCE = 8192
#: What the report says of it.
NOT_CAUSAL = "not causal: an estimate uses what was measured later; to be ranked apart from causal ones"


# Inner loops run over independent entries, so that the compiler takes several at a time; each sum keeps its order.


@njit(cache=True)
def _smoother_gain(cross, predicted, first, L, gain):  # type: ignore[no-untyped-def]
    """Write (C P⁻¹)ᵀ to gain [n, n] over the entries from ``first`` on of the later state; the rows before are 0."""
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
    for i in range(size):  # forward, then backward substitution with A = L Lᵀ
        for a in range(n):
            gain[first + i, a] = cross[a, first + i]
        for j in range(i):
            for a in range(n):
                gain[first + i, a] -= L[i, j] * gain[first + j, a]
        for a in range(n):
            gain[first + i, a] /= L[i, i]
    for i in range(size - 1, -1, -1):
        for j in range(i + 1, size):
            for a in range(n):
                gain[first + i, a] -= L[j, i] * gain[first + j, a]
        for a in range(n):
            gain[first + i, a] /= L[i, i]


@njit(cache=True)
def _step_back(x, P, link, xs, Ps):  # type: ignore[no-untyped-def]
    """Take the smoothed state [n] and covariance [n, n] from the step behind to the one with the posterior x, P.

    ``link`` is what ties the two: its kind, predicted covariance, cross covariance and prior state.
    """
    kind, predicted_P, cross, prior = link
    n = x.shape[0]
    if kind == LINK_NONE:
        xs[:] = x
        Ps[:, :] = P
        return
    overwritten = AX_BIAS if kind == LINK_BIASES else 0
    work = np.empty((5, n, n))  # to allocate takes longer than to compute
    L, gain, change, half, check = work[0], work[1], work[2], work[3], work[4]
    _smoother_gain(cross, predicted_P, overwritten, L, gain)
    move = check[0]
    for i in range(n):
        move[i] = xs[i] - prior[i]
        for j in range(n):
            change[i, j] = Ps[i, j] - predicted_P[i, j]
    xs[:] = x
    half[:, :] = 0.0
    for i in range(overwritten, n):
        for a in range(n):
            xs[a] += gain[i, a] * move[i]
        for j in range(n):
            for a in range(n):
                half[j, a] += gain[i, a] * change[i, j]
    for a in range(n):
        for b in range(n):
            Ps[a, b] = 0.5 * (P[a, b] + P[b, a])
        for j in range(overwritten, n):
            of_half, of_gain = half[j, a], gain[j, a]
            for b in range(n):
                Ps[a, b] += 0.5 * (of_half * gain[j, b] + half[j, b] * of_gain)
    if not cholesky_lower(Ps, check):
        repair_covariance(Ps)


@njit(cache=True)
def _smooth(forward, links, span, xs, Ps, out_x, out_P):  # type: ignore[no-untyped-def]
    """Smooth steps of a piece from the last of a span, where ``xs`` and ``Ps`` stand, to its first; they are moved.

    ``forward`` are posterior state, covariance and prior state, ``links`` the columns of :class:`~.physics.StepLinks`,
    ``span`` the first step, the last one that is written and the last one, inclusive.
    """
    x, P, prior = forward
    kind, predicted_P, cross = links
    first, last, end = span
    for k in range(end, first - 1, -1):
        if k < end:
            _step_back(x[k], P[k], (kind[k + 1], predicted_P[k + 1], cross[k + 1], prior[k + 1]), xs, Ps)
        if k <= last:
            out_x[k] = xs
            out_P[k] = Ps


#: Smoothed states [K, n] and covariances [K, n, n].
Smoothed: TypeAlias = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, slots=True, eq=False)
class ForwardSteps(StepColumns):
    """Steps of a filter's forward pass: posteriors, and what ties them."""

    posterior: PosteriorSteps
    links: StepLinks

    def __len__(self) -> int:
        """Return the number of steps."""
        return len(self.posterior.stamps_ns)


def spans(stamps_ns: IntArray, count: int, origin_ns: int, block_ns: int) -> Iterator[tuple[int, int, int]]:
    """Yield of each block that begins in the first ``count`` steps its first and last step there, and the last it sees.

    A step of block b, counted from ``origin_ns``, is smoothed with what is given of blocks b and b + 1.
    """
    block = (stamps_ns - origin_ns) // block_ns
    for b in np.unique(block[:count]).tolist():
        first, behind = (int(i) for i in np.searchsorted(block, (b, b + 1)))
        yield first, min(behind, count) - 1, int(np.searchsorted(block, b + 2)) - 1


def smooth_steps(
    steps: PosteriorSteps, links: StepLinks, count: int, origin_ns: int, block_ns: int
) -> tuple[FloatArray, FloatArray]:
    """Return smoothed states [count, n] and covariances [count, n, n] of the first ``count`` steps (see `spans`)."""
    x, P = smooth_blocks([ForwardSteps(steps, links)], steps.stamps_ns, count, origin_ns, block_ns)
    return x[:count], P[:count]


# positional: those of `smooth_steps`, and what is known already.
def smooth_blocks(
    pieces: Sequence[ForwardSteps],
    stamps_ns: IntArray,
    count: int,
    origin_ns: int,
    block_ns: int,
    known: Smoothed | None = None,
) -> Smoothed:
    """Return what `smooth_steps` does of all steps of the blocks that the first ``count`` steps lie in, [M ≥ count].

    ``pieces`` follow each other and hold the steps at ``stamps_ns``. ``known`` [D] is what this has returned of the
    first steps before, up to the end of a block: it is not done again.
    """
    n, done = pieces[0].posterior.x.shape[1], 0 if known is None else len(known[0])
    block = (stamps_ns - origin_ns) // block_ns
    end = max(done, int(np.searchsorted(block, block[count - 1], side="right")) if count else 0)
    x, P = np.empty((end, n)), np.empty((end, n, n))
    if known is not None:
        x[:done], P[:done] = known
    for span in spans(stamps_ns, end, origin_ns, block_ns):
        if span[0] >= done:
            _smooth_pieces(pieces, span, x, P)
    return x, P


def _smooth_pieces(
    pieces: Sequence[ForwardSteps], span: tuple[int, int, int], out_x: FloatArray, out_P: FloatArray
) -> None:
    """Smooth a span of `spans` from its last piece to its first."""
    first, last, end = span
    behind: ForwardSteps | None = None
    start = sum(map(len, pieces))
    for piece in reversed(pieces):
        start -= len(piece)
        begin, stop = max(first - start, 0), min(end - start, len(piece) - 1)
        if begin > stop:
            continue
        steps, links = piece.posterior, piece.links
        if behind is None:
            xs, Ps = steps.x[stop].copy(), steps.P[stop].copy()
        else:
            tie = behind.links
            link = (tie.kind[0], tie.predicted_P[0], tie.cross[0], behind.posterior.prior[0])
            _step_back(steps.x[stop], steps.P[stop], link, xs, Ps)
        behind = piece
        forward, tied = (steps.x, steps.P, steps.prior), (links.kind, links.predicted_P, links.cross)
        _smooth(forward, tied, (begin, last - start, stop), xs, Ps, out_x[start:], out_P[start:])


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
class SharedSteps(StepColumns):
    """What all filters share, and what weighs them.

    Their evidence Λ and log-likelihood [K, H] and where the first of them starts [K]; of the detector ``extra_r``
    [K, 2] and ``reason`` [K].
    """

    stamps_ns: IntArray
    evidence: FloatArray
    log_likelihood: FloatArray
    starts: BoolArray
    extra_r: FloatArray
    reason: IntArray

    def __len__(self) -> int:
        """Return the number of steps."""
        return len(self.reason)


#: The same steps of each filter [H].
Piece: TypeAlias = tuple[ForwardSteps, ...]


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedCarry:
    """State of the inputs, the forward filters [H] and their evidence behind all steps that are taken; those ahead.

    ``inputs`` is None where all inputs are known beforehand. The steps ahead lie in pieces, which are handed on and
    never joined. ``origin_ns`` is where the blocks begin; ``smoothed`` what is done already of the steps ahead, by
    filter.
    """

    inputs: InputCarry | None
    forward: tuple[FilterCarry, ...] | None
    evidence: FloatArray | None
    ahead: tuple[Piece, ...]
    shared: SharedSteps | None
    origin_ns: int | None
    smoothed: tuple[Smoothed, ...] | None


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
        if carry is None:
            origin_ns = int(given.stamps_ns[0]) if len(given) else None
            carry = SmoothedCarry(None, None, None, (), None, origin_ns, None)
        elif carry.origin_ns is None and len(given):
            carry = replace(carry, origin_ns=int(given.stamps_ns[0]))
        parts = []
        for first in range(0, max(len(signals), 1), STEPS_AT_ONCE):
            end = min(first + STEPS_AT_ONCE, len(signals))
            taken = first + (0 if carry.shared is None else len(carry.shared))
            seen = max(taken, self._seen(given.stamps_ns, end, carry.origin_ns))
            if known is None:
                checked, after = self.filtered.inputs(given.rows(taken, seen), carry.inputs)
                carry = replace(carry, inputs=after)
            else:
                checked = known.cut(taken, seen)
            carry = self._filtered(checked, carry)
            part, done = self._smoothed(given.rows(first, end), carry)
            parts.append(part)
            carry = _without(carry, end - first, done)
        return concatenate(parts), carry

    def _seen(self, stamps_ns: IntArray, end: int, origin_ns: int | None) -> int:
        """Return how many steps there are up to the end of the block behind that of the last of the first ``end``."""
        if end == 0 or origin_ns is None:
            return 0
        block_ns = round(self.block_s * 1e9)
        block = (int(stamps_ns[end - 1]) - origin_ns) // block_ns
        return int(np.searchsorted(stamps_ns, origin_ns + (block + 2) * block_ns))

    def _filtered(self, checked: CheckedInputs, carry: SmoothedCarry) -> SmoothedCarry:
        """Run the filters forward over steps that they have not taken yet; they follow those ahead."""
        filters = self.filtered.filters
        for begin in range(0, max(len(checked.rate), 1), STEPS_AT_ONCE):
            part = checked.cut(begin, begin + STEPS_AT_ONCE)
            faults, rate = part.faults, self.filtered.trust * part.rate
            before = carry.forward or [None] * len(filters)
            runs = [
                f.linked_steps(faults.filtered, b, rate, faults.extra_r) for f, b in zip(filters, before, strict=True)
            ]
            steps = [one for one, _, _ in runs]
            gathered, evidence = gather_evidence(steps, carry.forward, carry.evidence)
            likelihood = np.stack([one.log_likelihood for one in steps], axis=1)
            starts: BoolArray = ~np.isfinite(steps[0].prior[:, VX])
            shared = SharedSteps(steps[0].stamps_ns, gathered, likelihood, starts, faults.extra_r, faults.reason)
            carry = replace(
                carry,
                forward=tuple(after for _, after, _ in runs),
                evidence=evidence,
                ahead=(*carry.ahead, tuple(ForwardSteps(one, links) for one, _, links in runs)),
                shared=shared if carry.shared is None else carry.shared.joined(shared),
            )
        return carry

    def _smoothed(self, signals: Signals, carry: SmoothedCarry) -> tuple[StateTrack, tuple[Smoothed, ...]]:
        """Smooth the steps of ``signals``, which are the first of those ahead, with all of them.

        Beside the track it returns by filter what is smoothed now of the steps that follow.
        """
        shared, after = carry.shared, carry.forward
        assert shared is not None
        assert after is not None
        count, block_ns, origin_ns = len(signals), round(self.block_s * 1e9), carry.origin_ns or 0
        physics = self.filtered.physics
        tracks, valid, following = [], [], []
        for i, one in enumerate(self.filtered.filters):
            steps = [piece[i] for piece in carry.ahead]
            done = None if carry.smoothed is None else carry.smoothed[i]
            x, P = smooth_blocks(steps, shared.stamps_ns, count, origin_ns, block_ns, done)
            following.append((x[count:].copy(), P[count:].copy()))
            posterior = _first_of([piece.posterior for piece in steps], count)
            here = replace(posterior, x=x[:count], P=P[:count], ready_ns=signals.stamps_ns)
            # Known at its own stamp, a step is not predicted: what comes back is the step itself.
            track, _ = one.outputs(signals, None, here, after[i])
            tracks.append(track)
            valid.append(here.valid)
        track = tracks[0]
        told: dict[str, Any] = {}
        if len(tracks) > 1:
            weights = weigh(self._two_sided(shared, count, origin_ns), np.stack(valid, axis=1))
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

    def _two_sided(self, shared: SharedSteps, count: int, origin_ns: int) -> FloatArray:
        """Return Λ + Λ' [count, H]."""
        out = shared.evidence[:count].copy()
        dt = step_durations_s(shared.stamps_ns, None)
        for span in spans(shared.stamps_ns, count, origin_ns, round(self.block_s * 1e9)):
            _look_back(dt, shared.log_likelihood, shared.starts, span, out)
        return out


def _first_of(pieces: Sequence[PosteriorSteps], count: int) -> PosteriorSteps:
    """Return the first ``count`` steps of pieces that follow each other."""
    first = pieces[0].until(count)
    for piece in pieces[1:]:
        if (rest := count - len(first.stamps_ns)) > 0:
            first = first.joined(piece.until(rest))
    return first


def _without(carry: SmoothedCarry, passed: int, smoothed: tuple[Smoothed, ...]) -> SmoothedCarry:
    """Return the carry behind the first steps ahead, with what is smoothed of those that follow."""
    assert carry.shared is not None
    ahead, rest = list(carry.ahead), passed
    while ahead and len(ahead[0][0]) <= rest:
        rest -= len(ahead.pop(0)[0])
    if ahead:
        ahead[0] = tuple(one.since(rest) for one in ahead[0])
    return replace(carry, ahead=tuple(ahead), shared=carry.shared.since(passed), smoothed=smoothed)
