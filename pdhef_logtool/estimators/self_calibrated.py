"""Estimators on the vehicle that their log has calibrated: they see their signals as that vehicle reads them.

What a whole log says of its car is known only at its end: none of them is causal.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pdhef_logtool.car.car import WithoutTruth
from pdhef_logtool.car.vehicle import VehicleParameters, corrected_anew
from pdhef_logtool.estimators.base import Estimator, look_ahead_of, notes_of, run_window
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack

#: Names that take the calibrated vehicle where there is one; the others run on the file as it stands.
SELF_CALIBRATED = frozenset(
    {
        "physics",
        "pd-hef",
        "pd-hef-fixed-r",
        "pd-hef-smoothed",
        "pd-hef-trust1",
    }
)
#: What runs on the file runs once more on the calibrated vehicle under this name.
OPEN_LOOP = "open-loop-calibrated"


@dataclass(frozen=True, slots=True)
class SelfCalibrated:
    """An estimator on the calibrated vehicle.

    Parameters
    ----------
    estimator : on the calibrated vehicle. calibration : where that comes from.
    read_with : the vehicle that the drive's signals were read with.
    """

    estimator: Estimator
    calibration: WithoutTruth
    read_with: VehicleParameters
    causal: bool = False

    @property
    def name(self) -> str:
        """That of the estimator."""
        return self.estimator.name

    @property
    def notes(self) -> tuple[str, ...]:
        """What the report says of it."""
        return (*notes_of(self.estimator), self.calibration.note)

    @property
    def look_ahead_s(self) -> float:
        """What the estimator must see of what follows a window."""
        return look_ahead_of(self.estimator)

    @property
    def calibrated_as(self) -> Estimator:
        """Whose calibrated intervals hold for it where it has none of its own."""
        of_estimator: Estimator = getattr(self.estimator, "calibrated_as", self.estimator)
        return of_estimator

    def run(self, signals: Signals, carry: Any | None, ahead: Signals | None = None) -> tuple[StateTrack, Any]:
        """Process one window (see :class:`~.base.Estimator`)."""
        return run_window(self.estimator, self._read(signals), carry, None if ahead is None else self._read(ahead))

    def _read(self, signals: Signals) -> Signals:
        signals = corrected_anew(signals, self.read_with, self.calibration.vehicle)
        if self.calibration.told_friction:
            return signals
        return replace(signals, friction=np.full(len(signals), np.nan))
