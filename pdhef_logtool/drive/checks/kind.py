"""Definition of a check with its texts, and the data of the drive that checks use."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import TypeVar

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.drive.delays import LateSensor
from pdhef_logtool.drive.measured import Measured
from pdhef_logtool.drive.truth import LatencyEstimate
from pdhef_logtool.records.checks import Check, Verdict
from pdhef_logtool.records.signals import FloatArray

#: Placeholder for the signal in the name of a check.
SIGNAL = "SIGNAL"
_T = TypeVar("_T")
#: A fitted value is significant from this many standard errors.
SURE = 4.0


def is_beyond(value: float, error: float, plausible: tuple[float, float]) -> bool:
    """Return whether a value is at least ``SURE`` standard errors outside of the plausible range."""
    low, high = plausible
    return value + SURE * error < low or value - SURE * error > high


@dataclass(frozen=True, slots=True)
class CheckKind:
    """One check, as its file registers it.

    Attributes
    ----------
    name : ``SUBJECT.ASPECT``, also for ``--waive``; the subject is :data:`SIGNAL` for a check of several signals.
    compares, fails : the comparison and the condition of failure, for the documentation.
    remedy : remedy of a failed check; fields in braces are filled in.
    lacks : data that an undecided check needs.
    function : yields the checks of a drive, none without the data to compare. None: another function yields them.
    """

    name: str
    compares: str
    fails: str
    remedy: str = ""
    lacks: str = ""
    function: Callable[[CheckedDrive], Iterable[Check]] | None = None

    def passed(self, evidence: str, signal: str = "") -> Check:
        """Return a passed check; ``signal``: its signal, for a check of several."""
        return self._check("passed", signal, evidence)

    def failed(self, evidence: str, signal: str = "", **fields: object) -> Check:
        """Return a failed check with its remedy."""
        return self._check("failed", signal, evidence, self.remedy.format(**fields))

    def undecided(self, evidence: str, signal: str = "", lacks: str = "") -> Check:
        """Return an undecided check; ``lacks`` replaces the text of missing data."""
        return self._check("undecided", signal, evidence, lacks or self.lacks)

    def judged(self, good: bool, evidence: str, signal: str = "", **fields: object) -> Check:
        """Return a passed or failed check."""
        return self.passed(evidence, signal) if good else self.failed(evidence, signal, **fields)

    def of_figure(
        self, value: float, error: float, plausible: tuple[float, float], evidence: str, **fields: object
    ) -> Check:
        """Return the check of a value: failed ``SURE`` standard errors outside the range, passed two inside."""
        low, high = plausible
        if is_beyond(value, error, plausible):
            return self.failed(evidence, "", **fields)
        is_inside = low <= value - 2.0 * error and value + 2.0 * error <= high
        return self.passed(evidence) if is_inside else self.undecided(evidence)

    def _check(self, verdict: Verdict, signal: str, evidence: str, remedy: str = "") -> Check:
        name = self.name.replace(SIGNAL, signal)
        return Check(name, name.rpartition(".")[0], verdict, evidence, remedy)


@dataclass(frozen=True, slots=True, eq=False)
class CheckedDrive:
    """Data of a drive for the checks.

    Attributes
    ----------
    measured : columns [N] on one grid, SI, by signal; names of ground truth begin with ``truth.``.
    vehicle : from the file, or the default vehicle (``has_file`` False).
    latency : of ground truth against the gyro, or of the gyro. late : late sensors, detected without ground truth.
    has_truth : whether ground truth at the CG is available.
    related : checks of signals by their relations. judged : the checks so far.
    """

    measured: Measured
    vehicle: VehicleParameters
    has_file: bool
    latency: LatencyEstimate | None
    late: tuple[LateSensor, ...]
    has_truth: bool
    related: tuple[Check, ...]
    judged: list[Check] = field(default_factory=list)
    _shared: dict[Callable[[CheckedDrive], object], object] = field(default_factory=dict)

    @property
    def speed(self) -> FloatArray | None:
        """The column used as the speed [N]; None if it is wrong."""
        name = self.measured.speed_name
        return None if name is None or name in self.wrong else self.measured.columns[name]

    @property
    def wrong(self) -> set[str]:
        """Signals with a failed check of a relation."""
        return {c.subject for c in self.related if c.verdict == "failed"}

    def once(self, make: Callable[[CheckedDrive], _T]) -> _T:
        """Return ``make(self)``, computed at the first call."""
        if make not in self._shared:
            self._shared[make] = make(self)
        return self._shared[make]  # type: ignore[return-value]
