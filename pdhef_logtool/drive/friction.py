"""Source of the friction of a run. All estimators, networks and segments use the same friction."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.readings import POSSIBLE_FRICTION
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack

#: Choices of the option beside a number.
CHOICES = ("auto", "file")


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


@dataclass(frozen=True, slots=True)
class FrictionSource:
    """Fills in the friction of a run.

    Attributes
    ----------
    label : source of the friction, for the report.
    note : warning to the user before the run; empty without one.
    constant : friction for all estimators; None uses the signals' friction, or else the vehicle file's.
    assumed : neither option, log nor vehicle file gives a friction.
    of_truth : uses the friction of the ground truth, for datasets only; estimators of a run never receive it.
    """

    label: str
    note: str = ""
    constant: float | None = None
    of_truth: bool = False
    assumed: bool = False

    def fill(self, signals: Signals, truth: StateTrack | None = None) -> Signals:
        """Return the signals of a drive [N] with their friction."""
        if self.of_truth and truth is not None:
            signals = replace(signals, friction=truth.friction)
        if self.constant is not None:
            return replace(signals, friction=np.full(len(signals), self.constant))
        return signals


def friction_source(
    choice: str | float, vehicle: VehicleParameters, available: frozenset[str], topic: str = ""
) -> FrictionSource:
    """Choose the source of a drive's friction.

    ``auto`` uses the friction of the log, otherwise of the vehicle file; without both, 1 is assumed.

    Parameters
    ----------
    choice : of :func:`parse_friction`. available : signals that the log provides. topic : of its friction, ``/a.b``.

    Raises
    ------
    UsageError : The vehicle file has no friction.
    """
    if not isinstance(choice, str):
        return FrictionSource(f"option, {choice:g}", constant=choice)
    if choice == "auto" and "friction" in available:
        return FrictionSource(f"topic {topic}" if topic else "topic")
    if vehicle.friction is not None:
        constant = vehicle.friction if "friction" in available else None
        return FrictionSource(f"vehicle file, {vehicle.friction:g}", constant=constant)
    if choice == "file":
        raise UsageError(
            expected="a vehicle file with friction",
            got="none in it",
            where="--friction file",
            remedy="write friction = ... into the file, or give --friction VALUE",
        )
    assumed = f"assumed, {vehicle.assumed_friction:g}"
    note = f"friction is {assumed}: neither log nor vehicle file has one; give --friction VALUE"
    return FrictionSource(assumed, note, assumed=True)
