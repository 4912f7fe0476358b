"""Drives that noise is tuned on, kept in memory by the processes that score them.

What does not depend on a filter's noise (reading, alignment, truth) is done once a drive.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from types import TracebackType
from typing import Any, Self

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.parts import PHYSICS, FilterNoise
from pdhef_logtool.drive.reading import MAX_BYTES, too_big
from pdhef_logtool.drive.reading import Drive as ReadDrive
from pdhef_logtool.estimators.table import SPECS, Options, former, spec_of
from pdhef_logtool.learning.drives import DriveRecord, load_drive
from pdhef_logtool.learning.noise.search import DriveError, drive_error
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.mapping import Mapping as SignalMapping
from pdhef_logtool.records.errors import EstimatorError, UsageError
from pdhef_logtool.records.processes import follow_parent
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.runs.config import RunConfig

#: A drive with fewer scored stamps says nothing of its own.
MIN_SCORED_STAMPS = 100


@dataclass(frozen=True, slots=True, eq=False)
class TuneSetup:
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
            remedy=former(wrong),
        )
    return tuple(n for n in tunable if n in names)


@dataclass(frozen=True, slots=True, eq=False)
class _Drive:
    signals: Signals
    truth: StateTrack


class DriveBench:
    """Drives of one process and the scoring on them."""

    def __init__(self, setup: TuneSetup) -> None:
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
                index: drive_error(estimator.run(drive.signals, None)[0], drive.truth, slow)
                for index, drive in self._drives.items()
            }
        return errors


class Benches:
    """Drives dealt out to processes that live as long as the tuning does; one process is this one itself."""

    def __init__(self, setup: TuneSetup, jobs: int) -> None:
        self._local = DriveBench(setup) if jobs == 1 else None
        self._pools = [
            ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=_open_bench, initargs=(setup,))
            for _ in range(0 if jobs == 1 else jobs)
        ]

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        """End the processes."""
        for pool in self._pools:
            pool.shutdown(wait=error is None, cancel_futures=True)

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
        under_way: deque[Future[DriveRecord]] = deque()
        for index, log_input in enumerate(inputs):
            what = (index, log_input, splits.get(log_input.stem), MAX_BYTES - held)
            if self._local is not None:
                under_way.append(_done(self._local.load(*what)))
            else:
                # No more than one a process ahead, so that the bound on the memory is kept.
                under_way.append(self._pools[index % len(self._pools)].submit(_load, *what))
            while len(under_way) > (len(self._pools) if index + 1 < len(inputs) else 0):
                record = _result(under_way.popleft())
                loaded.append(record)
                held += record.bytes_held
                if held > MAX_BYTES:
                    raise too_big(record.name)
                told(record)
        return loaded

    def score(self, tunings: Mapping[str, FilterNoise]) -> dict[str, list[DriveError]]:
        """Return the errors of each estimator in the order of the drives."""
        if self._local is not None:
            parts = [self._local.score(tunings)]
        else:
            parts = [_result(f) for f in [pool.submit(_score, dict(tunings)) for pool in self._pools]]
        joined: dict[str, dict[int, DriveError]] = {n: {i: e for p in parts for i, e in p[n].items()} for n in tunings}
        return {n: [errors[i] for i in sorted(errors)] for n, errors in joined.items()}


def _result(future: Future[Any]) -> Any:
    try:
        return future.result()
    except BrokenProcessPool:
        raise EstimatorError(
            expected="processes that live", got="one that died (out of memory?)", where="--jobs", remedy="fewer --jobs"
        ) from None


def _done(record: DriveRecord) -> Future[DriveRecord]:
    future: Future[DriveRecord] = Future()
    future.set_result(record)
    return future


#: The bench of a process of :class:`Benches`, by key "bench".
_here: dict[str, DriveBench] = {}


def _open_bench(setup: TuneSetup) -> None:
    follow_parent()
    _here["bench"] = DriveBench(setup)


def _load(index: int, log_input: LogInput, split: str | None, max_bytes: int) -> DriveRecord:
    return _here["bench"].load(index, log_input, split, max_bytes)


def _score(tunings: dict[str, FilterNoise]) -> dict[str, dict[int, DriveError]]:
    return _here["bench"].score(tunings)
