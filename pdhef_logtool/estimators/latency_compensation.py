"""Latency compensation of all estimators: which step had arrived by a scored stamp, and its extrapolation to it.

A sample arrives later than it was measured. At a scored stamp t a receiver has the newest step k for which the data
of this and all earlier steps had arrived by t (``Signals.ready_ns``). The estimate at t is that step extrapolated
over the whole latency t - t_k. An estimator returns steps and has no part in this choice.

A smoother (:class:`~.base.Smoother`) reads later samples: it has each estimate at its own stamp.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, cast

import numpy as np

from pdhef_logtool.estimators.base import Estimator, Smoother, StepEstimator, Steps, predict_track
from pdhef_logtool.estimators.causality_check import CausalityCheck
from pdhef_logtool.estimators.plug_ins import contained, package_of
from pdhef_logtool.records.errors import EstimatorError
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.steps import StepColumns, extrapolation, release
from pdhef_logtool.records.tracks import FILED_COLUMNS, StateTrack, concatenate

#: Steps that an estimator makes at a time; an hour of steps with covariances would take 350 MB per filter.
PIECE_STEPS = 4096


def run_estimator(estimator: Estimator, signals: Signals, causality: CausalityCheck | None = None) -> StateTrack:
    """Return the track of an estimator over a drive [N]; it runs piece by piece, so that its steps take little memory.

    Parameters
    ----------
    causality : checks the steps of an estimator that declares itself causal.

    Raises
    ------
    EstimatorError
        The estimator did not return one step per sample, or its plug-in failed.
    """
    if isinstance(estimator, Smoother):
        return _smoothed(estimator, signals)
    pieces = _pieces(cast("StepEstimator", estimator), signals, causality)
    return replace(concatenate(pieces, len(signals), single=FILED_COLUMNS), stamps_ns=signals.stamps_ns)


def _pieces(estimator: StepEstimator, signals: Signals, causality: CausalityCheck | None) -> Iterator[StateTrack]:
    """Yield the track of an estimator piece by piece."""
    arrivals, state = release(signals.ready_ns, signals.stamps_ns), None
    for first in range(0, max(len(signals), 1), PIECE_STEPS):
        # Numba compiles a kernel again for read-only arrays: the estimator gets a copy.
        piece = signals.rows(first, first + PIECE_STEPS).copy()
        due = slice(*np.searchsorted(arrivals.step, (first, first + PIECE_STEPS)).tolist())
        with contained(estimator.name, package_of(estimator)):
            steps, state = _run_piece(estimator, piece, state, causality)
            if due.start == due.stop and len(signals):
                continue
            stamps_ns = signals.stamps_ns[due].copy()
            ahead = extrapolation(piece.stamps_ns, arrivals.rows(due, first), steps.valid, stamps_ns)
            track = predict_track(estimator, steps, ahead, stamps_ns)
        yield track


def _run_piece(
    estimator: StepEstimator, signals: Signals, state: Any, causality: CausalityCheck | None
) -> tuple[Any, Any]:
    """Return the checked steps of an estimator over a piece of a drive, and the state for the next one."""
    given = signals.copy().read_only() if package_of(estimator) else signals
    copied = None if causality is None else causality.state_before(estimator, state)
    returned = estimator.run(given, state)
    if not isinstance(returned, tuple) or len(returned) != 2:
        raise _wrong_steps(estimator, "a pair of steps and state", type(returned).__name__)
    steps, state = returned
    _check_steps(estimator, signals, steps)
    if causality is not None:
        causality.check(estimator, given, copied, steps)
    return steps, state


def _smoothed(smoother: Smoother, signals: Signals) -> StateTrack:
    """Return the track of a smoother, which has one row per sample."""
    name, package = smoother.name, package_of(smoother)
    with contained(name, package):
        track = smoother.smooth(signals.copy().read_only() if package else signals.copy())
        if not isinstance(track, StateTrack) or len(track) != len(signals):
            got = f"{len(track)} rows" if isinstance(track, StateTrack) else type(track).__name__
            raise EstimatorError(expected=f"a StateTrack, one row per sample ({len(signals)})", got=got, where=name)
    return track


def _check_steps(estimator: Estimator, signals: Signals, steps: Any) -> None:
    expected = f"steps, one per sample ({len(signals)})"
    if not isinstance(steps, StepColumns):
        raise _wrong_steps(estimator, expected, type(steps).__name__)
    for column in map(np.asarray, steps.arrays):
        if column.shape[:1] != (len(signals),):
            raise _wrong_steps(estimator, expected, f"{len(column) if column.ndim else 'no'} steps")
        if column.dtype.kind not in "biuf":
            raise _wrong_steps(estimator, "steps of numbers", f"a column of type {column.dtype}")
    if isinstance(steps, Steps) and not steps.values.shape == steps.rates.shape == (len(signals), 4):
        raise _wrong_steps(estimator, f"values and rates of shape ({len(signals)}, 4)", str(steps.values.shape))


def _wrong_steps(estimator: Estimator, expected: str, got: str) -> EstimatorError:
    package = package_of(estimator)
    where = f"{estimator.name} (plug-in {package})" if package else estimator.name
    remedy = "return Steps, or a StepColumns record with a column named valid"
    return EstimatorError(expected=expected, got=got, where=where, remedy=remedy)
