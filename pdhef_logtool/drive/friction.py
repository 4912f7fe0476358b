"""Source of the friction of a run. All estimators, networks and segments use the same friction."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.readings import POSSIBLE_FRICTION
from pdhef_logtool.records.signals import BoolArray, FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack

if TYPE_CHECKING:
    from pdhef_logtool.estimators.friction_bank import FrictionBank, FrictionEstimate

#: Choices of the option beside a number.
CHOICES = ("auto", "file", "estimate")
#: 1-sigma of the friction estimate due to errors of the vehicle file's tyres: without validation, where the stiffness
#: of each axle may be wrong by a factor of two, and with it (simulated cars, studies/plus_minus.py, seeds 555, 99004).
MODEL_STD = {False: 0.5, True: 0.015}


def parse_friction(text: str | float) -> str | float:
    """Return one of :data:`CHOICES` or a number.

    Raises
    ------
    UsageError : The text is neither, or the number is outside the range of frictions.
    """
    if text in CHOICES:
        return text
    low, high = POSSIBLE_FRICTION
    try:
        value = float(text)
    except (TypeError, ValueError):
        value = math.nan
    if isinstance(text, bool) or not low <= value <= high:
        raise UsageError(
            expected=f"{', '.join(CHOICES)} or a number from {low:g} to {high:g}", got=repr(text), where="--friction"
        )
    return value


@dataclass(slots=True)
class FrictionSource:
    """Fills in the friction of a run, and records the accuracy of an estimated friction.

    Attributes
    ----------
    label : source of the friction, for the report.
    note : warning to the user before the run; empty without one.
    constant : friction for all estimators; None uses the signals' friction, or else the vehicle file's.
    bank : estimates the friction; None if it is not estimated.
    model_std : 1-sigma of the estimate due to errors of the vehicle file (:data:`MODEL_STD`).
    of_truth : uses the friction of the ground truth, for datasets only; estimators of a run never receive it.
    """

    label: str
    note: str = ""
    constant: float | None = None
    bank: FrictionBank | None = None
    model_std: float = 0.0
    of_truth: bool = False
    estimate: FrictionEstimate | None = None
    _filled: tuple[Signals, Signals] | None = None

    def fill(self, signals: Signals, truth: StateTrack | None = None) -> Signals:
        """Return the signals of a drive [N] with their friction; an estimated friction is kept in ``estimate``."""
        if self.of_truth and truth is not None:
            signals = replace(signals, friction=truth.friction)
        if self.constant is not None:
            return replace(signals, friction=np.full(len(signals), self.constant))
        if self.bank is None:
            return signals
        if self._filled is None or self._filled[0] is not signals:
            self.estimate = self.bank.run(signals)
            self._filled = signals, replace(signals, friction=self.estimate.friction)
        return self._filled[1]

    def known(self, signals: Signals) -> Signals:
        """Return the signals of a drive [N] with their friction, which is unknown where it would be estimated."""
        return self.fill(signals) if self.bank is None else replace(signals, friction=np.full(len(signals), np.nan))

    @property
    def from_log(self) -> bool:
        """Whether the log's own friction is used."""
        return self.label.startswith("topic")

    @property
    def std(self) -> FloatArray:
        """1-sigma of the estimate at each stamp [N]; empty without an estimate."""
        return np.empty(0) if self.estimate is None else np.hypot(self.estimate.std, self.model_std)

    @property
    def observable(self) -> BoolArray:
        """Whether the friction is observable at each stamp [N]; empty without an estimate."""
        return np.zeros(0, dtype=np.bool_) if self.estimate is None else self.estimate.observable

    @property
    def observable_share(self) -> float:
        """Share of the stamps with observable friction; NaN without an estimate."""
        return float(np.mean(self.observable)) if self.observable.size else math.nan

    @property
    def observable_std(self) -> float:
        """Median 1-sigma of the estimate where it is observable; NaN if it never is."""
        return float(np.median(self.std[self.observable])) if self.observable.any() else math.nan

    @property
    def summary(self) -> str:
        """Observability and accuracy of the estimate, for the report; empty without an estimate."""
        if not self.observable.size:
            return ""
        text = f"observable {100 * self.observable_share:.0f} % of the time"
        if self.observable.any():
            text += f", median 1-sigma {self.observable_std:.2f} there"
        return text + "; elsewhere it returns to the friction of a dry road"


def friction_source(
    choice: str | float,
    vehicle: VehicleParameters,
    available: frozenset[str],
    topic: str = "",
    *,
    use_speed: bool = True,
    validated: bool = True,
) -> FrictionSource:
    """Choose the source of a drive's friction.

    ``auto`` uses the friction of the log, otherwise of the vehicle file, otherwise an estimate. If signals for the
    estimate are missing, 1 is assumed.

    Parameters
    ----------
    choice : of :func:`parse_friction`. available : signals that the log provides. topic : of its friction, ``/a.b``.
    validated : whether a drive has confirmed the tyres of the vehicle.

    Raises
    ------
    UsageError : The chosen source is not available.
    """
    if not isinstance(choice, str):
        return FrictionSource(f"option, {choice:g}", constant=choice)
    if choice == "auto" and "friction" in available:
        return FrictionSource(f"topic {topic}" if topic else "topic")
    if choice == "file" and vehicle.friction is None:
        raise UsageError(
            expected="a vehicle file with friction",
            got="none in it",
            where="--friction file",
            remedy="write friction = ... into the file, or give --friction estimate or a number",
        )
    if choice == "file" or (choice == "auto" and vehicle.friction is not None):
        constant = vehicle.friction if "friction" in available else None
        return FrictionSource(f"vehicle file, {vehicle.friction:g}", constant=constant)
    from pdhef_logtool.estimators.friction_bank import NEEDS, FrictionBank

    bank = FrictionBank(vehicle, use_speed, validated)
    missing = sorted(NEEDS - available)
    if not missing:
        nothing = "neither log nor vehicle file gives a friction: it is estimated online" if choice == "auto" else ""
        return FrictionSource("estimate", nothing, bank=bank, model_std=MODEL_STD[validated])
    if choice == "estimate":
        raise UsageError(
            expected="a log with the signals that the friction estimate needs",
            got=f"no {', '.join(missing)}",
            where="--friction estimate",
            remedy="map the missing signals, or give --friction VALUE",
        )
    assumed = f"assumed, {vehicle.assumed_friction:g}"
    return FrictionSource(assumed, f"friction is {assumed}: no {', '.join(missing)} to estimate it from")
