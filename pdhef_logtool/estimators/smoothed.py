"""``pd-hef-smoothed``: Rauch-Tung-Striebel smoothing over ``pd-hef`` (docs/method.md#smoothing). Not causal.

The filters of ``pd-hef``, each with its residual, run forward on checked signals (:mod:`~.checked_inputs`). Each filter
is then smoothed backward from its last available step:

    G_k = C_{k,k+1} P_{k+1|k}⁻¹
    x^s_k = x_k + G_k (x^s_{k+1} − x_{k+1|k})
    P^s_k = P_k + G_k (P^s_{k+1} − P_{k+1|k}) G_kᵀ

with C from the sigma points of the step before Q is added and they are redrawn (Särkkä 2008). The network's residual is
a known input of the step: it is contained in x_{k+1|k}. The process noise is identified separately for smoothing
(:func:`for_smoothing`).

- A start (first step, gap, failure) ends the recursion: later steps give no information on earlier ones.
- A standstill sets the motion to zero. This is no measurement and is not propagated backward.
- If the gate opened, the inflated covariance is used as predicted covariance, like process noise of that step.
- The detector is causal: later samples do not make it detect a fault sooner.

The filters are mixed as in :mod:`~.adaptive_physics`, with the evidence of earlier and of later samples, the latter
forgotten with its distance: Λ_k + Λ'_k.

A log is smoothed in blocks of fixed duration, counted from its first step, each with all steps up to the end of the
next block. A step therefore uses one to two blocks of look-ahead, memory is bounded, and the result does not depend on
the windows.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import TypeAlias

import numpy as np

from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.estimators.adaptive_physics import (
    FORGET_S,
    AdaptivePhysics,
    MixtureSteps,
    gather_evidence,
    weigh,
)
from pdhef_logtool.estimators.checked_inputs import CheckedInputs, InputState, r_scale
from pdhef_logtool.estimators.filter_base import (
    AX_BIAS,
    LINK_BIASES,
    LINK_NONE,
    VX,
    FilterState,
    PosteriorSteps,
    StepLinks,
)
from pdhef_logtool.estimators.physics_filter import PhysicsFilter
from pdhef_logtool.estimators.unscented import covariance_root
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray, Signals, join_signals
from pdhef_logtool.records.steps import RESTART_GAP_S, Extrapolation, StepColumns, step_durations_s
from pdhef_logtool.records.tracks import StateTrack

#: Minimum look-ahead of a step; the maximum is twice as much. Sensor biases have time constants of minutes: compared
#: with a look-ahead over a drive of 300 s, v_y changes by less than 5e-5 m/s (60 s: 5e-4 m/s).
BLOCK_S = 120.0
#: Number of steps that are filtered and smoothed at a time. The result does not depend on it.
STEPS_AT_ONCE = 8192
#: Note for the report.
NOT_CAUSAL = "not causal: estimates use later measurements; to be ranked apart from causal estimators"


_compiled = njit(cache=True, error_model="numpy", fastmath={"contract"})


@_compiled
def _gain(cross, predicted_P, first, A, L, gain):  # type: ignore[no-untyped-def]
    """Write (C P⁻¹)ᵀ of a step to ``gain`` [n, n], over the later state's entries from ``first`` on."""
    n = gain.shape[0]
    for i in range(n):
        for j in range(n):
            A[i, j] = predicted_P[i, j] if min(i, j) >= first else 1.0 * (i == j)
            gain[i, j] = cross[j, i] if i >= first else 0.0
    covariance_root(A, L)
    for i in range(first, n):  # forward, then backward substitution with P = L Lᵀ
        for j in range(first, i):
            for k in range(n):
                gain[i, k] -= L[i, j] * gain[j, k]
        for k in range(n):
            gain[i, k] /= L[i, i]
    for i in range(n - 1, first - 1, -1):
        for j in range(i + 1, n):
            for k in range(n):
                gain[i, k] -= L[j, i] * gain[j, k]
        for k in range(n):
            gain[i, k] /= L[i, i]


# positional: arrays of steps with an index; slices would cost as much time as the sums.
@_compiled
def _step_back(forward, k, links, following, xs, Ps, work):  # type: ignore[no-untyped-def]
    """Update the smoothed state [n] and covariance [n, n] from the following step to step k of ``forward``.

    ``links`` has for each step the kind of link, predicted covariance, cross covariance and prior state; ``following``
    is the index of the following step in it.
    """
    x, P, _ = forward
    kind, predicted_P, cross, prior = links
    change, L, gain, half = work
    n = x.shape[1]
    if kind[following] == LINK_NONE:
        xs[:], Ps[:, :] = x[k], P[k]
        return
    _gain(cross[following], predicted_P[following], AX_BIAS if kind[following] == LINK_BIASES else 0, change, L, gain)
    for i in range(n):
        xs[i] -= prior[following, i]
        for j in range(n):
            change[i, j] = Ps[i, j] - predicted_P[following, i, j]
            half[i, j] = 0.0
    for j in range(n):
        for i in range(n):
            for a in range(n):
                half[j, a] += change[i, j] * gain[i, a]
    for a in range(n):
        moved = x[k, a]
        for j in range(n):
            moved += gain[j, a] * xs[j]
        L[0, a] = moved
        for b in range(a + 1):
            s = 0.5 * (P[k, a, b] + P[k, b, a])
            for j in range(n):
                s += 0.5 * (gain[j, a] * half[j, b] + gain[j, b] * half[j, a])
            Ps[a, b] = s
            Ps[b, a] = s
    xs[:] = L[0]
    covariance_root(Ps, L)


@_compiled
def _smooth(forward, links, tie, span, xs, Ps, out_x, out_P):  # type: ignore[no-untyped-def]
    """Smooth steps of a piece from the last of a span to its first; ``xs`` [n] and ``Ps`` [n, n] are updated in place.

    ``forward`` has posterior state, covariance and prior state; ``links`` kind, predicted covariance, cross covariance
    and prior state. ``tie`` is the link of the step after the span, to which xs and Ps belong, or empty without such
    a step. ``span``: the first step, the last step to write and the last step, inclusive.
    """
    x, P, _ = forward
    first, last, end = span
    work = (np.empty_like(Ps), np.empty_like(Ps), np.empty_like(Ps), np.empty_like(Ps))
    for k in range(end, first - 1, -1):
        if k < end:
            _step_back(forward, k, links, k + 1, xs, Ps, work)
        elif tie[0].shape[0] > 0:
            _step_back(forward, k, tie, 0, xs, Ps, work)
        else:
            xs[:], Ps[:, :] = x[k], P[k]
        if k <= last:
            out_x[k], out_P[k] = xs, Ps


#: Smoothed states [K, n] and covariances [K, n, n].
Smoothed: TypeAlias = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, slots=True, eq=False)
class ForwardSteps(StepColumns):
    """Steps of a filter's forward pass: posteriors and the links between them."""

    posterior: PosteriorSteps
    links: StepLinks

    def __len__(self) -> int:
        """Return the number of steps."""
        return len(self.posterior.stamps_ns)


def spans(stamps_ns: IntArray, count: int, origin_ns: int, block_ns: int) -> Iterator[tuple[int, int, int]]:
    """Yield for each block that begins in the first ``count`` steps its first, its last, and its last look-ahead step.

    A step of block b, counted from ``origin_ns``, is smoothed with the available steps of blocks b and b + 1.
    """
    block = (stamps_ns - origin_ns) // block_ns
    for b in np.unique(block[:count]).tolist():
        first, behind = (int(i) for i in np.searchsorted(block, (b, b + 1)))
        yield first, min(behind, count) - 1, int(np.searchsorted(block, b + 2)) - 1


def smooth_blocks(
    pieces: Sequence[ForwardSteps],
    stamps_ns: IntArray,
    count: int,
    origin_ns: int,
    block_ns: int,
    earlier: Smoothed | None = None,
) -> Smoothed:
    """Return smoothed states [M, n] and covariances of the blocks (see `spans`) with the first ``count`` ≤ M steps.

    ``pieces`` are consecutive and contain the steps at ``stamps_ns``. ``earlier`` [D] is the result for the first
    steps, up to the end of a block, which is not computed again.
    """
    n, done = pieces[0].posterior.x.shape[1], 0 if earlier is None else len(earlier[0])
    block = (stamps_ns - origin_ns) // block_ns
    end = max(done, int(np.searchsorted(block, block[count - 1], side="right")) if count else 0)
    x, P = np.empty((end, n)), np.empty((end, n, n))
    if earlier is not None:
        x[:done], P[:done] = earlier
    for span in spans(stamps_ns, end, origin_ns, block_ns):
        if span[0] >= done:
            _smooth_pieces(pieces, span, x, P)
    return x, P


def _smooth_pieces(
    pieces: Sequence[ForwardSteps], span: tuple[int, int, int], out_x: FloatArray, out_P: FloatArray
) -> None:
    """Smooth a span of `spans` from its last piece to its first."""
    first, last, end = span
    n = pieces[0].posterior.x.shape[1]
    tie, xs, Ps = _tie(pieces[0].until(0)), np.empty(n), np.empty((n, n))
    start = sum(map(len, pieces))
    for piece in reversed(pieces):
        start -= len(piece)
        begin, stop = max(first - start, 0), min(end - start, len(piece) - 1)
        if begin > stop:
            continue
        steps = piece.posterior
        forward = (steps.x, steps.P, steps.prior)
        _smooth(forward, _tie(piece), tie, (begin, last - start, stop), xs, Ps, out_x[start:], out_P[start:])
        tie = _tie(piece)


def _tie(piece: ForwardSteps) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Return the link of each step to the previous one: kind, predicted covariance, cross covariance, prior state."""
    return piece.links.kind, piece.links.predicted_P, piece.links.cross, piece.posterior.prior


@njit(cache=True)
def _look_back(dt, likelihood, starts, span, out):  # type: ignore[no-untyped-def]
    """Add to Λ [K, H] of the first steps of a span the likelihood of the following steps."""
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


def for_smoothing(physics: PhysicsFilter, factors: Sequence[float]) -> PhysicsFilter:
    """Return a filter with factors on its process noise of v_y and yaw rate."""
    along, vy, rate, *rest = physics.q_std
    return replace(physics, q_std=(along, vy * factors[0], rate * factors[1], *rest))


@dataclass(frozen=True, slots=True, eq=False)
class SharedSteps(StepColumns):
    """Columns shared by all filters, and their weights.

    Evidence Λ and log-likelihood [K, H], starts of the first filter [K]; from the detector ``extra_r`` [K, 2] and
    ``reason`` [K].
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
class SmoothedState:
    """State of the inputs, of the forward filters [H] and of their evidence after all processed steps; steps ahead.

    The steps ahead are stored in pieces, which are passed on without being joined. ``origin_ns`` is the start of the
    blocks; ``smoothed`` has the smoothed states of the steps ahead so far, by filter.
    """

    inputs: InputState | None
    forward: tuple[FilterState, ...] | None
    evidence: FloatArray | None
    ahead: tuple[Piece, ...]
    shared: SharedSteps | None
    origin_ns: int | None
    smoothed: tuple[Smoothed, ...] | None


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
    version = 1
    options = ("filtered", "block_s")

    filtered: AdaptivePhysics
    block_s: float = BLOCK_S
    name: str = "pd-hef-smoothed"
    causal: bool = False
    notes: tuple[str, ...] = (NOT_CAUSAL,)

    @property
    def look_ahead_s(self) -> float:
        """Look-ahead of :meth:`run` beyond a window."""
        return 2.0 * self.block_s

    def run(
        self,
        signals: Signals,
        state: SmoothedState | None,
        ahead: Signals | None = None,
    ) -> tuple[MixtureSteps, SmoothedState]:
        """Process one window (see :class:`~.base.LookingAhead`).

        Parameters
        ----------
        ahead : samples after the window, at least ``look_ahead_s`` or all that exist; the next window begins with them.
            Without it, the log ends with the window.
        """
        given = signals if ahead is None else join_signals([signals, ahead])
        if state is None:
            origin_ns = int(given.stamps_ns[0]) if len(given) else None
            state = SmoothedState(None, None, None, (), None, origin_ns, None)
        elif state.origin_ns is None and len(given):
            state = replace(state, origin_ns=int(given.stamps_ns[0]))
        parts = []
        for first in range(0, max(len(signals), 1), STEPS_AT_ONCE):
            end = min(first + STEPS_AT_ONCE, len(signals))
            taken = first + (0 if state.shared is None else len(state.shared))
            seen = max(taken, self._seen(given.stamps_ns, end, state.origin_ns))
            checked, after = self.filtered.inputs(given.rows(taken, seen), state.inputs)
            state = self._filtered(checked, replace(state, inputs=after))
            part, done = self._smoothed(end - first, state)
            parts.append(part)
            state = _without(state, end - first, done)
        return reduce(MixtureSteps.joined, parts), state

    def _seen(self, stamps_ns: IntArray, end: int, origin_ns: int | None) -> int:
        """Return the number of steps up to the end of the block after the one that contains step ``end`` − 1."""
        if end == 0 or origin_ns is None:
            return 0
        block_ns = round(self.block_s * 1e9)
        block = (int(stamps_ns[end - 1]) - origin_ns) // block_ns
        return int(np.searchsorted(stamps_ns, origin_ns + (block + 2) * block_ns))

    def _filtered(self, checked: CheckedInputs, state: SmoothedState) -> SmoothedState:
        """Run the forward filters over new steps and append these to the steps ahead."""
        filters = self.filtered.filters
        for begin in range(0, max(len(checked.rate), 1), STEPS_AT_ONCE):
            part = checked.cut(begin, begin + STEPS_AT_ONCE)
            faults, rate = part.faults, self.filtered.trust * part.rate
            before = state.forward or [None] * len(filters)
            runs = [
                f.linked_steps(faults.filtered, b, rate, faults.extra_r) for f, b in zip(filters, before, strict=True)
            ]
            steps = [filter_steps for filter_steps, _, _ in runs]
            gathered, evidence = gather_evidence(steps, state.forward, state.evidence)
            likelihood = np.stack([filter_steps.log_likelihood for filter_steps in steps], axis=1)
            starts: BoolArray = ~np.isfinite(steps[0].prior[:, VX])
            shared = SharedSteps(steps[0].stamps_ns, gathered, likelihood, starts, faults.extra_r, faults.reason)
            state = replace(
                state,
                forward=tuple(after for _, after, _ in runs),
                evidence=evidence,
                ahead=(*state.ahead, tuple(ForwardSteps(filter_steps, links) for filter_steps, _, links in runs)),
                shared=shared if state.shared is None else state.shared.joined(shared),
            )
        return state

    def _smoothed(self, count: int, state: SmoothedState) -> tuple[MixtureSteps, tuple[Smoothed, ...]]:
        """Smooth the first ``count`` of the steps ahead, using all of them.

        Also return, by filter, the smoothed states of later steps as far as available.
        """
        shared = state.shared
        assert shared is not None
        block_ns, origin_ns = round(self.block_s * 1e9), state.origin_ns or 0
        smoothed, following = [], []
        for i in range(len(self.filtered.filters)):
            steps = [piece[i] for piece in state.ahead]
            done = None if state.smoothed is None else state.smoothed[i]
            x, P = smooth_blocks(steps, shared.stamps_ns, count, origin_ns, block_ns, done)
            following.append((x[count:].copy(), P[count:].copy()))
            posterior = _first_of([piece.posterior for piece in steps], count)
            smoothed.append(replace(posterior, x=x[:count], P=P[:count]))
        weights = np.ones((count, 1))
        if len(smoothed) > 1:
            valid = np.stack([track.valid for track in smoothed], axis=1)
            weights = weigh(self._two_sided(shared, count, origin_ns), valid)
        raised = r_scale(shared.extra_r[:count], self.filtered.physics.measurement_std)
        return MixtureSteps(
            tuple(smoothed), weights, raised, shared.reason[:count], np.full(count, self.filtered.trust)
        ), tuple(following)

    def predict(self, steps: MixtureSteps, ahead: Extrapolation, stamps_ns: IntArray) -> StateTrack:
        """Mix the smoothed steps, each at its own stamp (see :class:`~.base.ModelPredictor`)."""
        track, count = self.filtered.predict(steps, ahead, stamps_ns), len(stamps_ns)
        return replace(
            track,
            name=self.name,
            nis=np.full(count, np.nan),  # a smoothed state has no innovation
            nis_dof=np.zeros(count),
            mixture_weight=track.mixture_weight if len(steps.filters) > 1 else np.empty(0),
        )

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


def _without(state: SmoothedState, passed: int, smoothed: tuple[Smoothed, ...]) -> SmoothedState:
    """Return the state without the first steps ahead, with the smoothed states of later steps."""
    assert state.shared is not None
    ahead, rest = list(state.ahead), passed
    while ahead and len(ahead[0][0]) <= rest:
        rest -= len(ahead.pop(0)[0])
    if ahead:
        ahead[0] = tuple(forward.since(rest) for forward in ahead[0])
    return replace(state, ahead=tuple(ahead), shared=state.shared.since(passed), smoothed=smoothed)
