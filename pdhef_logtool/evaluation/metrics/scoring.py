"""Computes the figures of every registered metric, in one pass over the blocks of a drive for those of signals.

e = estimate − ground truth (angles wrapped), over the stamps of a segment at which the estimate and ground truth are
valid and finite; ``n`` is their number. Sideslip counts only where the ground-truth speed exceeds the low-speed blend.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from pdhef_logtool.evaluation.blocks import ErrorSums, HeldRows, SegmentMasks, row_blocks
from pdhef_logtool.evaluation.dead_reckoned import Path, Seconds, pose_known
from pdhef_logtool.evaluation.metrics.independence import marked
from pdhef_logtool.evaluation.metrics.metric import (
    ALL,
    EvaluatedDrive,
    Figure,
    MetricRow,
    OfDrive,
    OfSignal,
    OfTrack,
    Reference,
    SignalBlock,
    SignalFigures,
)
from pdhef_logtool.evaluation.metrics.registry import registered
from pdhef_logtool.evaluation.track_errors import raw_error, total_std
from pdhef_logtool.evaluation.units import SCORED_SIGNALS
from pdhef_logtool.records.signals import BoolArray
from pdhef_logtool.records.tracks import StateTrack


def score_track(
    estimate: StateTrack,
    truth: StateTrack,
    masks: Mapping[str, BoolArray],
    *,
    log: str,
    low_speed_m_s: float,
    not_independent: Mapping[str, str] | None = None,
) -> list[MetricRow]:
    """Score one estimate against ground truth at the same stamps.

    Parameters
    ----------
    estimate, truth : [N] at the same stamps (:func:`pdhef_logtool.drive.truth.truth_at`).
    masks : bool [N] by segment; ``all`` is added when it is absent.
    low_speed_m_s : sideslip is scored above this ground truth speed.
    not_independent : by signal, from :func:`pdhef_logtool.drive.truth.dependent_signals`; other keys are ignored.

    Raises
    ------
    ValueError : The tracks or masks are not at the same stamps.
    """
    return Scorer(truth, masks, log=log, low_speed_m_s=low_speed_m_s, not_independent=not_independent).rows(estimate)


def track_rows(track: StateTrack, truth: StateTrack | None, masks: SegmentMasks, *, log: str) -> Iterator[MetricRow]:
    """Yield the figures of one track as a whole."""
    functions = dict.fromkeys(m.function for m in registered().values() if isinstance(m.function, OfTrack))
    for function in functions:
        yield from function.rows(track, truth, masks, log)


def drive_rows(drive: EvaluatedDrive) -> dict[str, list[MetricRow]]:
    """Return the figures that take the sensors or several tracks, by estimator."""
    functions = dict.fromkeys(m.function for m in registered().values() if isinstance(m.function, OfDrive))
    by_estimator: dict[str, list[MetricRow]] = {}
    for function in functions:
        for row in function.rows(drive):
            by_estimator.setdefault(row.estimator, []).append(row)
    return by_estimator


class Scorer:
    """Scores the estimates of a drive one by one; what they share is computed once.

    Parameters and errors are those of :func:`score_track`.
    """

    def __init__(
        self,
        truth: StateTrack,
        masks: Mapping[str, BoolArray],
        *,
        log: str,
        low_speed_m_s: float,
        not_independent: Mapping[str, str] | None = None,
    ) -> None:
        self._reference = Reference(truth, masks, log=log, low_speed_m_s=low_speed_m_s)
        self._dependent = frozenset(not_independent or ())
        blocks = (HeldRows(truth.rows(a, b)) for a, b in row_blocks(len(truth)))
        self._has_pose = any(pose_known(part).any() for part in blocks)
        self._metrics = {n: m for n, m in registered().items() if isinstance(m.function, OfSignal)}

    def rows(self, estimate: StateTrack) -> list[MetricRow]:
        """Return the figures of an estimate."""
        reference = self._reference
        _check_stamps(estimate, reference.truth)
        functions = dict.fromkeys(m.function for m in self._metrics.values() if isinstance(m.function, OfSignal))
        by_signal = {s: [f.start(reference, estimate, s) for f in functions] for s in SCORED_SIGNALS}
        positions = _Positions(len(reference.truth)) if self._has_pose else None
        for a, b in row_blocks(len(reference.truth)):
            estimated, truth = HeldRows(estimate.rows(a, b)), HeldRows(reference.truth.rows(a, b))
            inside = dict(reference.masks.rows(a, b))
            for signal, figures in by_signal.items():
                block = self._block(estimated, truth, inside, signal, a)
                for part in figures:
                    part.add(block)
            if positions is not None:
                positions.add(estimated, truth)
        rows = [row for signal, figures in by_signal.items() for row in self._rows(estimate.name, signal, figures)]
        for signal, sums in {} if positions is None else positions.sums().items():
            figures_by_metric = {metric: (value, sums.n) for metric, value in sums.figures().items()}
            if signal == "position_m":
                del figures_by_metric["bias"]  # a distance has no sign
            rows += [
                self._row(estimate.name, signal, ALL, metric, figure) for metric, figure in figures_by_metric.items()
            ]
        rows += track_rows(estimate, reference.truth, reference.masks, log=reference.log)
        return marked(rows, self._dependent)

    def _block(
        self, estimate: StateTrack, truth: StateTrack, inside: Mapping[str, BoolArray], signal: str, start: int
    ) -> SignalBlock:
        error = raw_error(estimate, truth, signal)
        scorable = self._reference.scorable.rows(start, start + len(error))[signal]
        scored = estimate.valid & scorable & np.isfinite(error)
        std = total_std(estimate, truth, signal)
        return SignalBlock(signal, start, estimate, truth, error, scorable, scored, std, inside)

    def _rows(self, estimate: str, signal: str, figures: list[SignalFigures]) -> Iterator[MetricRow]:
        for segment in self._reference.masks:
            figures_by_metric: dict[str, Figure] = {}
            for part in figures:
                figures_by_metric |= part.of(segment)
            for metric in self._metrics:
                if metric in figures_by_metric:
                    yield self._row(estimate, signal, segment, metric, figures_by_metric[metric])

    def _row(self, estimate: str, signal: str, segment: str, metric: str, figure: Figure) -> MetricRow:
        unit = self._metrics[metric].unit_of(signal)
        return MetricRow(self._reference.log, estimate, signal, segment, metric, figure[0], unit, figure[1])


class _Positions:
    """Errors of the dead-reckoned position, and of the lateral one after a second, of an estimate of n stamps."""

    def __init__(self, n: int) -> None:
        self._path, self._distances = Path(), ErrorSums(n)
        self._seconds, self._n = Seconds(), n

    def add(self, estimate: StateTrack, truth: StateTrack) -> None:
        distance = self._path.add(estimate, truth)
        self._distances.add(distance[np.isfinite(distance)])
        self._seconds.add(estimate, truth)

    def sums(self) -> dict[str, ErrorSums]:
        """Return the errors by signal, where there is any."""
        laterals = ErrorSums(self._n)
        errors = self._seconds.lateral_errors()
        laterals.add(errors[np.isfinite(errors)])
        return {s: e for s, e in (("position_m", self._distances), ("lateral_1s_m", laterals)) if e.n}


def _check_stamps(estimate: StateTrack, truth: StateTrack) -> None:
    blocks = ((estimate.rows(a, b), truth.rows(a, b)) for a, b in row_blocks(len(truth)))
    if len(estimate) != len(truth) or not all(np.array_equal(e.stamps_ns, t.stamps_ns) for e, t in blocks):
        raise ValueError(f"estimate {estimate.name} and ground truth must be at the same stamps")
