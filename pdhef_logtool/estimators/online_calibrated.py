"""Estimators on a car that is recalibrated during the log (docs/method.md#self-calibration).

Each stage is the estimator on the vehicle of the latest calibration. A stage begins at its stamp with the state of the
previous stage, and its estimates do not depend on later samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pdhef_logtool.car.car import Car
from pdhef_logtool.estimators.base import StepEstimator, notes_of, predict_track
from pdhef_logtool.estimators.calibrated_band import runs_of, stages_of
from pdhef_logtool.estimators.drive_signals import calibrated_signals
from pdhef_logtool.records.signals import IntArray, Signals
from pdhef_logtool.records.steps import ExtendedSteps, Extrapolation
from pdhef_logtool.records.tracks import StateTrack, concatenate


@dataclass(frozen=True, slots=True, eq=False)
class StagedSteps(ExtendedSteps):
    """Steps of the estimator [K], and the stage of each, [K]."""

    stage: IntArray


@dataclass(frozen=True)
class OnlineCalibrated:
    """An estimator on the vehicle calibrated so far, for signals that were read with the vehicle file.

    ``stages`` in time order, at least two: the estimator on the car of each, ``cars``.
    """

    algorithm = "online-calibrated"
    version = 1
    options = ("estimator",)

    stages: tuple[StepEstimator, ...]
    cars: tuple[Car, ...]
    causal: bool = True

    @property
    def estimator(self) -> StepEstimator:
        """The last stage; all stages have the same algorithm."""
        return self.stages[-1]

    @property
    def name(self) -> str:
        """Name of the estimator."""
        return self.estimator.name

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the report."""
        return notes_of(self.estimator)

    def run(self, signals: Signals, state: Any | None) -> tuple[StagedSteps, Any]:
        """Process one window (see :class:`~.base.Estimator`)."""
        stage = stages_of(signals.stamps_ns, [car.self_calibrated for car in self.cars if car.self_calibrated])
        if not len(signals):
            steps, state = self.stages[0].run(signals, state)
            return StagedSteps(steps, stage), state
        joined: Any = None
        for number, first, last in runs_of(stage):
            part = calibrated_signals(signals.rows(first, last), self.cars[number])
            steps, state = self.stages[number].run(part, state)
            joined = steps if joined is None else joined.joined(steps)
        return StagedSteps(joined, stage), state

    def predict(self, steps: StagedSteps, ahead: Extrapolation, stamps_ns: IntArray) -> StateTrack:
        """Extrapolate each step by the model of its stage."""
        if not len(stamps_ns):
            return predict_track(self.stages[0], steps.steps, ahead, stamps_ns)
        parts = []
        for number, first, last in runs_of(steps.stage[ahead.step]):
            rows = slice(first, last)
            parts.append(predict_track(self.stages[number], steps.steps, ahead.rows(rows, 0), stamps_ns[rows]))
        return concatenate(parts)
