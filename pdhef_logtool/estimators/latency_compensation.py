"""Latency compensation of all estimators: which step had arrived by a scored stamp, and its extrapolation to it.

A sample arrives later than it was measured. At a scored stamp t a receiver has the newest step k for which the data
of this and all earlier steps had arrived by t (``Signals.ready_ns``). The estimate at t is that step extrapolated
over the whole latency t - t_k. An estimator returns steps and has no part in this choice.

A smoother (:class:`~.base.Smoother`) reads later samples: it has each estimate at its own stamp.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, fields, replace
from typing import Any, cast

import numpy as np

from pdhef_logtool.estimators.base import Estimator, Smoother, StepEstimator, Steps, predict_track
from pdhef_logtool.estimators.causality_check import CausalityCheck, step_columns
from pdhef_logtool.estimators.plug_ins import contained, package_of, read_only
from pdhef_logtool.records.errors import EstimatorError
from pdhef_logtool.records.signals import IntArray, Signals
from pdhef_logtool.records.steps import StepColumns, extrapolation, release
from pdhef_logtool.records.tracks import StateTrack, concatenate

#: Steps that an estimator makes at a time; an hour of steps with covariances would take 350 MB per filter.
PIECE_STEPS = 8192


@dataclass(frozen=True, slots=True, eq=False)
class PendingSteps(StepColumns):
    """Steps that a coming stamp may still be extrapolated from, with their stamps and availability times, [K]."""

    stamps_ns: IntArray
    ready_ns: IntArray
    steps: Any


@dataclass(frozen=True, slots=True, eq=False)
class WindowState:
    """State between windows: the estimator's, and its pending steps."""

    estimator: Any
    pending: PendingSteps


def run_window(
    estimator: StepEstimator,
    signals: Signals,
    before: WindowState | None = None,
    causality: CausalityCheck | None = None,
) -> tuple[StateTrack, WindowState]:
    """Run an estimator over one window; return its track at the window's stamps, and the state for the next window.

    Parameters
    ----------
    before : state that the previous window returned, None at the start of a log.
    causality : checks the steps of an estimator that declares itself causal.

    Raises
    ------
    EstimatorError
        The estimator did not return one step per sample, or its plug-in failed.
    """
    state = None if before is None else before.estimator
    package = package_of(estimator)
    with contained(estimator.name, package):
        given = read_only(signals) if package else signals
        copied = None if causality is None else causality.state_before(estimator, state)
        returned = estimator.run(given, state)
        if not isinstance(returned, tuple) or len(returned) != 2:
            raise _wrong_steps(estimator, "a pair of steps and state", type(returned).__name__)
        steps, state = returned
        _check_steps(estimator, signals, steps)
        if causality is not None:
            causality.check(estimator, given, copied, steps)
        track, pending = compensate(estimator, signals, steps, None if before is None else before.pending)
    return track, WindowState(state, pending)


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
    columns: dict[str, Any] = {}
    state = None
    for first in range(0, max(len(signals), 1), PIECE_STEPS):
        # Numba compiles a kernel again for read-only arrays: the estimator gets a copy.
        piece = signals.rows(first, first + PIECE_STEPS).copy()
        track, state = run_window(cast("StepEstimator", estimator), piece, state, causality)
        if len(piece) == len(signals):
            return track
        for name in (f.name for f in fields(track) if f.name != "name"):
            part = getattr(track, name)
            if name not in columns:
                columns[name] = np.empty((len(signals) if len(part) else 0, *part.shape[1:]), part.dtype)
            columns[name][first : first + len(part)] = part
    return replace(track, **columns)


def _smoothed(smoother: Smoother, signals: Signals) -> StateTrack:
    """Return the track of a smoother, which has one row per sample."""
    name, package = smoother.name, package_of(smoother)
    with contained(name, package):
        track = smoother.smooth(read_only(signals) if package else signals.copy())
        if not isinstance(track, StateTrack) or len(track) != len(signals):
            got = f"{len(track)} rows" if isinstance(track, StateTrack) else type(track).__name__
            raise EstimatorError(expected=f"a StateTrack, one row per sample ({len(signals)})", got=got, where=name)
    return track


def compensate(
    estimator: Estimator, signals: Signals, steps: Any, before: PendingSteps | None = None
) -> tuple[StateTrack, PendingSteps]:
    """Return the track of an estimator's steps of a window at its stamps, and the steps that stay pending."""
    stamps_ns = signals.stamps_ns
    ready_ns = signals.ready_ns
    window = PendingSteps(stamps_ns, ready_ns, steps)
    if before is None:
        chosen = extrapolation(stamps_ns, ready_ns, steps.valid, stamps_ns)
        track = predict_track(estimator, steps, chosen, stamps_ns)
        return track, deepcopy(window.since(release(ready_ns, stamps_ns).needed))  # a view would keep all steps
    # Few stamps need a step of the window before: to join the steps would copy the covariances of a whole window.
    held = len(before.stamps_ns)
    ready_ns = np.concatenate([before.ready_ns, ready_ns])
    valid = np.concatenate([before.steps.valid, steps.valid])
    chosen = extrapolation(np.concatenate([before.stamps_ns, stamps_ns]), ready_ns, valid, stamps_ns)
    first = int(np.searchsorted(chosen.step, held))
    late, new = chosen.rows(slice(first), 0), chosen.rows(slice(first, None), held)
    tracks = [predict_track(estimator, before.steps, late, stamps_ns[:first])] if first else []
    if first < len(stamps_ns) or not tracks:
        tracks.append(predict_track(estimator, steps, new, stamps_ns[first:]))
    needed = release(ready_ns, stamps_ns).needed
    pending = deepcopy(window.since(needed - held)) if needed >= held else before.since(needed).joined(window)
    return concatenate(tracks) if len(tracks) > 1 else tracks[0], pending


def _check_steps(estimator: Estimator, signals: Signals, steps: Any) -> None:
    expected = f"steps, one per sample ({len(signals)})"
    if not isinstance(steps, StepColumns):
        raise _wrong_steps(estimator, expected, type(steps).__name__)
    for column in step_columns(steps):
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
