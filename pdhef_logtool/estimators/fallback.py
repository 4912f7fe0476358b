"""The fallback estimator: a simpler estimator under the name of one that contradicts the sensors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from pdhef_logtool.estimators.base import Estimator, look_ahead_of, notes_of, predict_track, run_steps
from pdhef_logtool.records.signals import IntArray, Signals
from pdhef_logtool.records.steps import Extrapolation
from pdhef_logtool.records.tracks import StateTrack


@dataclass(frozen=True, slots=True)
class Fallback:
    """An estimator under another name, for a ``reason``. It is selected on the whole log, so it is not causal."""

    algorithm = "stand-in"
    version = 1
    options = ("estimator",)

    estimator: Estimator
    name: str
    reason: str
    causal: bool = False

    @property
    def notes(self) -> tuple[str, ...]:
        """What the report says of it."""
        return (*notes_of(self.estimator), self.reason)

    @property
    def look_ahead_s(self) -> float:
        """What the estimator must see of what follows a window."""
        return look_ahead_of(self.estimator)

    @property
    def calibrated_as(self) -> Estimator:
        """Whose calibrated intervals hold for it."""
        of_estimator: Estimator = getattr(self.estimator, "calibrated_as", self.estimator)
        return of_estimator

    @property
    def intervals_note(self) -> str:
        """What its intervals are made of, where no calibrated ones are to take their place."""
        return getattr(self.estimator, "intervals_note", "")

    def run(self, signals: Signals, state: Any | None, ahead: Signals | None = None) -> tuple[Any, Any]:
        """Process one window (see :class:`~.base.Estimator`)."""
        return run_steps(self.estimator, signals, state, ahead)

    def predict(self, steps: Any, ahead: Extrapolation, stamps_ns: IntArray) -> StateTrack:
        """Extrapolate as the other estimator does."""
        return replace(predict_track(self.estimator, steps, ahead, stamps_ns), name=self.name)
