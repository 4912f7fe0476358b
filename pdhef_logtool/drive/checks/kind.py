"""What a check is: a record that one file of this package exports, its words, and the drive that it judges."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import TypeVar

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.drive.delays import LateSensor
from pdhef_logtool.drive.measured import Measured
from pdhef_logtool.drive.truth import LatencyEstimate
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.signals import FloatArray

#: Placeholder in a name for each signal that the check judges.
SIGNAL = "SIGNAL"
_T = TypeVar("_T")
#: A figure of a fit counts from this many standard errors on.
SURE = 4.0


def is_beyond(value: float, error: float, plausible: tuple[float, float]) -> bool:
    """Return whether a figure is so many standard errors outside of what is plausible."""
    low, high = plausible
    return value + SURE * error < low or value - SURE * error > high


@dataclass(frozen=True, slots=True)
class CheckKind:
    """One check, as its file registers it.

    Attributes
    ----------
    name : by which a person waives it, ``SUBJECT.ASPECT``; the subject is :data:`SIGNAL` where it judges several.
    compares, fails : what is compared, and where it fails, for the documentation.
    remedy : what to do where it fails; fields in braces are filled in.
    lacks : what a drive lacks that leaves it undecided.
    function : yields the checks of a drive; none where the drive has nothing that it compares. None: it is called from
        elsewhere, or the function of another kind of its file yields both.
    """

    name: str
    compares: str
    fails: str
    remedy: str = ""
    lacks: str = ""
    function: Callable[[CheckedDrive], Iterable[Check]] | None = None

    def passed(self, evidence: str, signal: str = "") -> Check:
        """Return that it passed; ``signal``: which one, where it judges several."""
        name = self._name(signal)
        return Check(name, name.rpartition(".")[0], "passed", evidence)

    def failed(self, evidence: str, signal: str = "", **fields: object) -> Check:
        """Return that it failed, with its remedy."""
        name = self._name(signal)
        return Check(name, name.rpartition(".")[0], "failed", evidence, self.remedy.format(**fields))

    def undecided(self, evidence: str, signal: str = "", lacks: str = "") -> Check:
        """Return that the drive does not decide it; ``lacks``: other words for what it lacks."""
        name = self._name(signal)
        return Check(name, name.rpartition(".")[0], "undecided", evidence, lacks or self.lacks)

    def judged(self, good: bool, evidence: str, signal: str = "", **fields: object) -> Check:
        """Return that it passed or failed."""
        return self.passed(evidence, signal) if good else self.failed(evidence, signal, **fields)

    def of_figure(
        self, value: float, error: float, plausible: tuple[float, float], evidence: str, **fields: object
    ) -> Check:
        """Judge a figure by its standard error: failed so many errors beyond what is plausible, passed two inside."""
        low, high = plausible
        if is_beyond(value, error, plausible):
            return self.failed(evidence, "", **fields)
        is_inside = low <= value - 2.0 * error and value + 2.0 * error <= high
        return self.passed(evidence) if is_inside else self.undecided(evidence)

    def _name(self, signal: str) -> str:
        return self.name.replace(SIGNAL, signal)


@dataclass(frozen=True, slots=True, eq=False)
class CheckedDrive:
    """What checks judge.

    Attributes
    ----------
    measured : columns [N] on one grid, SI, by signal; those of ground truth begin with ``truth.``.
    vehicle : of the file, or the default one, which is no ``has_file``.
    latency : of ground truth against the gyro, or the gyro's own. late : sensors that are late without ground truth.
    has_truth : whether ground truth at the CG is known.
    related : checks of signals by the relations between them. judged : the checks so far.
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
        """The column used as the speed [N]; None if relations show it to be wrong."""
        name = self.measured.speed_name
        return None if name is None or name in self.wrong else self.measured.columns[name]

    @property
    def wrong(self) -> set[str]:
        """The signals that relations, or their size, show to be wrong."""
        sizes = (c for c in self.judged if c.name.endswith(".magnitude"))
        return {c.subject for c in (*self.related, *sizes) if c.verdict == "failed"}

    def once(self, make: Callable[[CheckedDrive], _T]) -> _T:
        """Return what ``make`` returns for this drive; it is called once."""
        if make not in self._shared:
            self._shared[make] = make(self)
        return self._shared[make]  # type: ignore[return-value]
