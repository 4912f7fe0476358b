"""Where the friction of a run comes from; every estimator, network and segment is given the same one."""

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

#: What may be asked for beside a number.
CHOICES = ("auto", "file", "estimate")
#: 1-sigma of an estimate by the tyres of the vehicle file: without evidence, when the stiffness may be wrong by a
#: factor of two at each axle, and with it (simulated cars, studies/plus_minus.py, seeds 555 and 99004).
MODEL_STD = {False: 0.5, True: 0.015}


def parse_friction(text: str | float) -> str | float:
    """Return one of :data:`CHOICES` or a number.

    Raises
    ------
    UsageError : The text is neither, or the number is no friction.
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
    """Puts the friction of a run into the signals, and keeps what an estimate was worth.

    Attributes
    ----------
    label : where it comes from, in the words of the report.
    note : what a user must be given before the run; empty: nothing.
    constant : given to all estimators; None leaves the signals' own (and the vehicle file's where they have none).
    bank : estimates it; None where nothing is estimated.
    factor : error made on purpose in the friction of topic or option, for training (docs/method.md#limits).
    model_std : 1-sigma of the estimate's error that comes of the vehicle file (:data:`MODEL_STD`).
    of_truth : it is that of the ground truth, for datasets: no estimator of a run is given it.
    """

    label: str
    note: str = ""
    constant: float | None = None
    bank: FrictionBank | None = None
    factor: float = 1.0
    model_std: float = 0.0
    of_truth: bool = False
    estimate: FrictionEstimate | None = None
    _filled: tuple[Signals, Signals] | None = None

    def fill(self, signals: Signals, truth: StateTrack | None = None) -> Signals:
        """Return the signals of a drive [N] with their friction; ``estimate`` is what came of an estimate."""
        if self.of_truth and truth is not None:
            signals = replace(signals, friction=truth.friction)
        if self.constant is not None:
            return replace(signals, friction=np.full(len(signals), self.constant))
        if self.bank is None:
            return signals if self.factor == 1.0 else replace(signals, friction=signals.friction * self.factor)
        if self._filled is None or self._filled[0] is not signals:
            self.estimate = self.bank.run(signals)
            self._filled = signals, replace(signals, friction=self.estimate.friction)
        return self._filled[1]

    @property
    def from_log(self) -> bool:
        """Whether the log's own friction is used."""
        return self.label.startswith("topic")

    @property
    def std(self) -> FloatArray:
        """1-sigma of the estimate at each stamp; of length 0 where nothing is estimated."""
        return np.empty(0) if self.estimate is None else np.hypot(self.estimate.std, self.model_std)

    @property
    def observable(self) -> BoolArray:
        """Whether the drive shows its friction, at each stamp; of length 0 where nothing is estimated."""
        return np.zeros(0, dtype=np.bool_) if self.estimate is None else self.estimate.observable

    @property
    def observable_share(self) -> float:
        """Share of the stamps at which the drive shows its friction; NaN where nothing is estimated."""
        return float(np.mean(self.observable)) if self.observable.size else math.nan

    @property
    def observable_std(self) -> float:
        """Median 1-sigma of the estimate where it is observable; NaN where it never is."""
        return float(np.median(self.std[self.observable])) if self.observable.any() else math.nan

    @property
    def summary(self) -> str:
        """What came of an estimate, for the report; empty where nothing is estimated."""
        if not self.observable.size:
            return ""
        text = f"observable {100 * self.observable_share:.0f} % of the time"
        if self.observable.any():
            text += f", median 1-sigma {self.observable_std:.2f} there"
        return text + "; elsewhere it goes back to that of a dry road"


def friction_source(
    choice: str | float,
    vehicle: VehicleParameters,
    available: frozenset[str],
    topic: str = "",
    *,
    use_speed: bool = True,
    factor: float = 1.0,
    validated: bool = True,
) -> FrictionSource:
    """Decide where a drive's friction comes from.

    ``auto`` is the log's own where it has one, else the vehicle file's, else an estimate; where the log lacks what an
    estimate needs, 1 is assumed.

    Parameters
    ----------
    choice : of :func:`parse_friction`. available : signals that the log provides. topic : of its friction, ``/a.b``.
    factor : on the friction of topic or option; a vehicle file must contain its wrong friction already.
    validated : whether a drive has shown that the tyres of the vehicle are right.

    Raises
    ------
    UsageError : What was asked for is not there.
    """
    if not isinstance(choice, str):
        return FrictionSource(f"option, {choice:g}", constant=choice * factor)
    if choice == "auto" and "friction" in available:
        return FrictionSource(f"topic {topic}" if topic else "topic", factor=factor)
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
        nothing = "neither log nor vehicle file gives a friction: it is estimated on line" if choice == "auto" else ""
        return FrictionSource("estimate", nothing, bank=bank, model_std=MODEL_STD[validated])
    if choice == "estimate":
        raise UsageError(
            expected="a log with what an estimate of friction needs",
            got=f"no {', '.join(missing)}",
            where="--friction estimate",
            remedy="map the missing signals, or give --friction VALUE",
        )
    assumed = f"assumed, {vehicle.assumed_friction:g}"
    return FrictionSource(assumed, f"friction is {assumed}: no {', '.join(missing)} to estimate it from")
