"""Source of the friction of a run. All estimators, networks and segments use the same friction."""

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np

from pdhef_logtool.car.vehicle import DEFAULT_VEHICLE_NAME, VehicleParameters
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


class FrictionFrom(StrEnum):
    """Where a friction comes from. The ground truth's is for datasets only; estimators of a run never receive it."""

    OPTION = "option"
    TOPIC = "topic"
    FILE = "vehicle file"
    SEDAN = "default sedan"
    ASSUMED = "no value given"
    REACHED = "largest lateral acceleration"
    TRUTH = "ground truth"
    NONE = "none"


@dataclass(frozen=True, slots=True)
class FrictionSource:
    """Fills in the friction of a run.

    Attributes
    ----------
    source : where it comes from. value : of the whole drive; None if it varies. topic : of the log, ``/a.b``.
    constant : friction for all estimators; None uses the signals' friction, or else the vehicle file's.
    """

    source: FrictionFrom
    value: float | None = None
    topic: str = ""
    constant: float | None = None

    @property
    def is_given(self) -> bool:
        """Whether option, log or vehicle file gives it."""
        return self.source in (FrictionFrom.OPTION, FrictionFrom.TOPIC, FrictionFrom.FILE, FrictionFrom.TRUTH)

    @property
    def note(self) -> str:
        """A warning to the user before the run; empty without one."""
        if self.source is not FrictionFrom.ASSUMED:
            return ""
        return f"friction is assumed, {self.value:g}: neither log nor vehicle file has one; give --friction VALUE"

    @property
    def label(self) -> str:
        """Source with value or topic."""
        value = "" if self.value is None else f", {self.value:.3g}"
        return f"{self.source} {self.topic}".rstrip() + value

    def to_dict(self) -> dict[str, Any]:
        """Return the entry ``friction`` of report.json."""
        return {"source": self.source, "value": self.value, "topic": self.topic or None, "given": self.is_given}

    def fill(self, signals: Signals, truth: StateTrack | None = None) -> Signals:
        """Return the signals of a drive [N] with their friction."""
        if self.source is FrictionFrom.TRUTH and truth is not None:
            signals = replace(signals, friction=truth.friction)
        if self.constant is not None:
            return replace(signals, friction=np.broadcast_to(self.constant, len(signals)))
        return signals


def friction_source(
    choice: str | float | None, vehicle: VehicleParameters, available: frozenset[str], topic: str = ""
) -> FrictionSource:
    """Choose the source of a drive's friction.

    ``auto`` uses the friction of the log, otherwise of the vehicle file or the default sedan; without, 1 is assumed.

    Parameters
    ----------
    choice : of :func:`parse_friction`, or None for the friction of the log, if any.
    available : signals that the log provides. topic : of its friction, ``/a.b``.

    Raises
    ------
    UsageError : The vehicle file has no friction.
    """
    if choice is None and not topic:
        return FrictionSource(FrictionFrom.NONE)
    if choice is None or (choice == "auto" and "friction" in available):
        return FrictionSource(FrictionFrom.TOPIC, topic=topic)
    if not isinstance(choice, str):
        return FrictionSource(FrictionFrom.OPTION, choice, constant=choice)
    if vehicle.friction is not None:
        source = FrictionFrom.SEDAN if vehicle.name == DEFAULT_VEHICLE_NAME else FrictionFrom.FILE
        constant = vehicle.friction if "friction" in available else None
        return FrictionSource(source, vehicle.friction, constant=constant)
    if choice == "file":
        raise UsageError(
            expected="a vehicle file with friction",
            got="none in it",
            where="--friction file",
            remedy="write friction = ... into the file, or give --friction VALUE",
        )
    return FrictionSource(FrictionFrom.ASSUMED, vehicle.assumed_friction)
