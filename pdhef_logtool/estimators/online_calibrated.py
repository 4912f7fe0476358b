"""Estimators on a car that is recalibrated during the log (docs/method.md#self-calibration).

Each stage is the estimator on the vehicle of the latest calibration. A stage begins at its stamp with the state of the
previous stage, and its estimates do not depend on later samples.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pdhef_logtool.car.car import WithoutTruth
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.estimators.base import predict_track
from pdhef_logtool.estimators.self_calibrated import CalibratedBand, SelfCalibrated
from pdhef_logtool.records.signals import IntArray, Signals
from pdhef_logtool.records.steps import ExtendedSteps, Extrapolation
from pdhef_logtool.records.tracks import StateTrack, concatenate


@dataclass(frozen=True, slots=True, eq=False)
class StagedSteps(ExtendedSteps):
    """Steps of the estimator [K], and the stage of each, [K]."""

    stage: IntArray


def _spans(stage: IntArray) -> Iterator[tuple[int, int, int]]:
    """Yield stage, first and last + 1 of each run of equal stages."""
    edges = np.flatnonzero(np.diff(stage)) + 1
    for first, last in zip([0, *edges], [*edges, len(stage)], strict=True):
        yield int(stage[first]), int(first), int(last)


def _stage_of(stamps_ns: IntArray, stages: Sequence[WithoutTruth]) -> IntArray:
    """Return the stage of each stamp [N]; the first begins with the log."""
    return np.searchsorted([s.since_ns for s in stages[1:]], stamps_ns, side="right").astype(np.int64)


@dataclass(frozen=True)
class OnlineCalibrated:
    """An estimator on the vehicle calibrated so far; ``stages`` in time order, at least two."""

    algorithm = "online-calibrated"
    version = 1
    options = ("estimator",)

    stages: tuple[SelfCalibrated, ...]
    causal: bool = True
    intervals_note: str = "intervals: own and parameters"

    @property
    def estimator(self) -> SelfCalibrated:
        """The last stage; all stages have the same algorithm."""
        return self.stages[-1]

    @property
    def name(self) -> str:
        """Name of the estimator."""
        return self.estimator.name

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the report."""
        return self.estimator.notes

    def run(self, signals: Signals, state: Any | None) -> tuple[StagedSteps, Any]:
        """Process one window (see :class:`~.base.Estimator`)."""
        stage = _stage_of(signals.stamps_ns, [s.calibration for s in self.stages])
        if not len(signals):
            steps, state = self.stages[0].run(signals, state)
            return StagedSteps(steps, stage), state
        joined: Any = None
        for number, first, last in _spans(stage):
            steps, state = self.stages[number].run(signals.rows(first, last), state)
            joined = steps if joined is None else joined.joined(steps)
        return StagedSteps(joined, stage), state

    def predict(self, steps: StagedSteps, ahead: Extrapolation, stamps_ns: IntArray) -> StateTrack:
        """Extrapolate each step by the model of its stage."""
        if not len(stamps_ns):
            return predict_track(self.stages[0], steps.steps, ahead, stamps_ns)
        parts = []
        for number, first, last in _spans(steps.stage[ahead.step]):
            rows = slice(first, last)
            parts.append(predict_track(self.stages[number], steps.steps, ahead.rows(rows, 0), stamps_ns[rows]))
        return concatenate(parts)


@dataclass(slots=True)
class OnlineBand:
    """The interval of :class:`~.self_calibrated.CalibratedBand`, from each stage for its part of the log."""

    stages: Sequence[WithoutTruth]
    read_with: VehicleParameters
    _bands: dict[int, CalibratedBand] = field(default_factory=dict)
    _signals: Signals | None = None
    _parts: list[tuple[int, int, int, Signals]] = field(default_factory=list)

    def widen(self, track: StateTrack, signals: Signals) -> StateTrack:
        """Return a track [N] with wider 1-sigmas of sideslip and v_y."""
        if not len(signals):
            return track
        if signals is not self._signals:  # tracks share the parts, by which the intervals identify them
            self._signals, spans = signals, _spans(_stage_of(signals.stamps_ns, self.stages))
            self._parts = [(number, first, last, signals.rows(first, last)) for number, first, last in spans]
        parts = []
        for number, first, last, part in self._parts:
            band = self._bands.setdefault(number, CalibratedBand(self.stages[number], self.read_with))
            parts.append(band.widen(track.rows(first, last), part))
        return replace(concatenate(parts), name=track.name)
