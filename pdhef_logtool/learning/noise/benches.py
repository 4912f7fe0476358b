"""Drives of the noise search, kept in memory by the processes that score them.

Reading, alignment and ground truth do not depend on a filter's noise and are computed once per drive.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from operator import attrgetter
from types import TracebackType
from typing import Any, Self

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.parts import PHYSICS, FilterNoise
from pdhef_logtool.drive.reading import MAX_BYTES, too_big
from pdhef_logtool.drive.reading import Drive as ReadDrive
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.estimators.table import FILTERS, SPECS, Options, spec_of
from pdhef_logtool.learning.drives import DriveRecord, load_drive
from pdhef_logtool.learning.noise.search import DriveError, drive_error
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.mapping import Mapping as SignalMapping
from pdhef_logtool.records.errors import EstimatorError, PdhefError, UsageError
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.supervisor import Crew, Tell
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.runs.config import RunConfig

#: A drive with fewer scored stamps says nothing of its own.
MIN_SCORED_STAMPS = 100


@dataclass(frozen=True, slots=True, eq=False)
class BenchSetup:
    """What all drives are read and all filters are built with."""

    config: RunConfig
    car: Car
    mapping: SignalMapping | None
    names: tuple[str, ...]


def choose_names(names: Sequence[str] | None, car: Car) -> tuple[str, ...]:
    """Return the estimators to tune, in the order of the tables.

    Parameters
    ----------
    names : None = every one that can be, without ``physics`` where the car has a fit of it: its noise was found
        together with its values.

    Raises
    ------
    UsageError
        A name is unknown or given twice.
    """
    tunable = {s.name: s for s in SPECS if s.tunable}
    if names is None:
        return tuple(n for n in tunable if n != PHYSICS or car.fitted_physics is None)
    wrong = sorted({n for n in names if n not in tunable or names.count(n) > 1})
    if wrong or not names:
        raise UsageError(
            expected=f"estimators out of {', '.join(tunable)}",
            got=", ".join(wrong) or "none",
            where="--estimators",
        )
    return tuple(n for n in tunable if n in names)


@dataclass(frozen=True, slots=True, eq=False)
class _Drive:
    signals: Signals
    truth: StateTrack


class DriveBench:
    """Drives of one process and the scoring on them."""

    def __init__(self, setup: BenchSetup) -> None:
        self._setup = setup
        self._drives: dict[int, _Drive] = {}
        self._options = Options(setup.config.sensors == "full")

    def load(self, index: int, log_input: LogInput, split: str | None, max_bytes: int) -> DriveRecord:
        """Read a drive, run what its filters' noise does not change, and keep it under ``index``.

        Raises
        ------
        PdhefError
            The log cannot be read, or takes more than ``max_bytes``.
        """
        setup = self._setup

        def lacking(drive: ReadDrive) -> str:
            missing = {name: sorted(spec_of(name).needs - drive.available) for name in setup.names}
            return "; ".join(f"{name} needs {', '.join(what)}" for name, what in missing.items() if what)

        record, whole = load_drive(
            log_input,
            setup.car,
            setup.mapping,
            setup.config.read_options,
            split=split,
            refuse=lacking,
            least_scored=MIN_SCORED_STAMPS,
            max_bytes=max_bytes,
        )
        if whole is not None and whole.truth is not None:
            self._drives[index] = _Drive(whole.signals, whole.truth)
        return record

    def score(self, tunings: Mapping[str, FilterNoise]) -> dict[str, dict[int, DriveError]]:
        """Return the errors of each estimator by drive."""
        slow = self._setup.car.vehicle.low_speed_blend_m_s
        errors: dict[str, dict[int, DriveError]] = {}
        for name, noise in tunings.items():
            estimator = spec_of(name).make(self._setup.car.with_noise(name, noise), self._options)
            errors[name] = {
                index: drive_error(run_window(estimator, drive.signals)[0], drive.truth, slow)
                for index, drive in self._drives.items()
            }
        return errors


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """What a bench is to do: ``load`` with the arguments of that, or ``score`` tunings."""

    place: int
    load: tuple[int, LogInput, str | None, int] | None = None
    score: Mapping[str, FilterNoise] = field(default_factory=dict)

    def done_by(self, bench: DriveBench) -> Any:
        return bench.load(*self.load) if self.load else bench.score(self.score)


class Benches:
    """Drives dealt out to processes that live as long as the tuning does; one process is this one itself."""

    def __init__(self, setup: BenchSetup, jobs: int) -> None:
        self._jobs = jobs
        self._local = DriveBench(setup) if jobs == 1 else None
        preload = (__name__, *FILTERS)
        self._crew = None if jobs == 1 else Crew[_Part, Any](partial(_do, setup), jobs=jobs, preload=preload)

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """End the processes."""
        if self._crew is not None:
            self._crew.__exit__(kind, error, at)

    def load(
        self, inputs: Sequence[LogInput], splits: Mapping[str, str], told: Callable[[DriveRecord], None]
    ) -> list[DriveRecord]:
        """Read all drives, whose splits are known by name; ``told`` is called for each in order.

        Raises
        ------
        PdhefError
            A log cannot be read, or all together are too big.
        """
        loaded: list[DriveRecord] = []
        held = 0

        def parts() -> Iterator[_Part]:
            for index, log_input in enumerate(inputs):
                # What is being read counts when it is: there is no more than one a process.
                what = (index, log_input, splits.get(log_input.stem), MAX_BYTES - held)
                yield _Part(index % self._jobs, load=what)

        for record in self._in_order(parts()):
            loaded.append(record)
            held += record.bytes_held
            if held > MAX_BYTES:
                raise too_big(record.name)
            told(record)
        return loaded

    def score(self, tunings: Mapping[str, FilterNoise]) -> dict[str, list[DriveError]]:
        """Return the errors of each estimator in the order of the drives."""
        parts = list(self._in_order(_Part(place, score=dict(tunings)) for place in range(self._jobs)))
        joined: dict[str, dict[int, DriveError]] = {n: {i: e for p in parts for i, e in p[n].items()} for n in tunings}
        return {n: [errors[i] for i in sorted(errors)] for n, errors in joined.items()}

    def _in_order(self, parts: Iterable[_Part]) -> Iterator[Any]:
        """Yield what comes of the parts, in their order; raise what a part raises."""
        if self._local is not None:
            for part in parts:
                yield part.done_by(self._local)
            return
        assert self._crew is not None
        early: dict[int, Any] = {}
        count = 0
        for ended in self._crew.each(parts, place=attrgetter("place")):
            if ended.failure is not None:
                raise _lost(ended.failure.reason)
            early[ended.number] = ended.result
            while count in early:
                result = early.pop(count)
                count += 1
                if isinstance(result, PdhefError):
                    raise result
                yield result


def _lost(reason: str) -> EstimatorError:
    return EstimatorError(expected="a process that works", got=reason, where="--jobs", remedy="fewer --jobs")


#: The bench of a process of :class:`Benches`, by key "bench".
_here: dict[str, DriveBench] = {}


def _do(setup: BenchSetup, part: _Part, _tell: Tell) -> Any:
    """Do a part in a process of its own, where errors are results."""
    if "bench" not in _here:
        if part.load is None or part.load[0] != part.place:  # not its first one: it was held by a process that died
            return _lost("one that died with its drives (out of memory?)")
        _here["bench"] = DriveBench(setup)
    try:
        return part.done_by(_here["bench"])
    except PdhefError as error:
        return error
