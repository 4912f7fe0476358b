"""Drives that noise is tuned on, kept in memory by the processes that score them.

What does not depend on a filter's noise (reading, alignment, truth, the network's pass) is done once a drive.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from multiprocessing import get_context
from types import TracebackType
from typing import Any, Protocol, Self

import numpy as np

from pdhef_logtool.car.vehicle import FilterTuning, VehicleParameters
from pdhef_logtool.drive.reading import MAX_BYTES, too_big
from pdhef_logtool.drive.reading import Drive as ReadDrive
from pdhef_logtool.estimators.checked_inputs import CheckedInputs, check_inputs
from pdhef_logtool.estimators.hybrid import HybridUkf, hybrid_ukf
from pdhef_logtool.estimators.registry import DESCRIPTIONS, make_estimator
from pdhef_logtool.estimators.smoothed import SmoothedHybrid, smoothed_hybrid
from pdhef_logtool.learning.drives import DriveRecord, load_drive
from pdhef_logtool.learning.noise.search import DriveError, drive_error, tuned_vehicle
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.mapping import Mapping as SignalMapping
from pdhef_logtool.records.errors import EstimatorError, UsageError
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.residual_model.bundle import ModelBundle
from pdhef_logtool.residual_model.service import NetworkService
from pdhef_logtool.run.config import RunConfig

#: A drive with fewer scored stamps says nothing of its own.
MIN_SCORED_STAMPS = 100


@dataclass(frozen=True, slots=True, eq=False)
class TuneSetup:
    """What all drives are read and all filters are built with."""

    config: RunConfig
    vehicle: VehicleParameters
    mapping: SignalMapping | None
    model: ModelBundle | None
    names: tuple[str, ...]

    @property
    def use_speed(self) -> bool:
        """Whether the filters use the speed sensor after their start."""
        return self.config.sensors == "full"


class Tunable(Protocol):
    """An estimator that reads its noise from ``[filter.<name>]`` of the vehicle file."""

    @property
    def needs_model(self) -> bool:
        """Whether it runs a network."""
        ...

    def needs(self, setup: TuneSetup) -> frozenset[str]:
        """Aligned signals without which it cannot run."""
        ...

    def prepare(self, setup: TuneSetup, signals: Signals) -> Any:
        """Return what its noise does not change; it is computed once a drive and given to every run."""
        ...

    def run(self, setup: TuneSetup, tuning: FilterTuning, signals: Signals, prepared: Any) -> StateTrack:
        """Return the estimate of a whole drive, bit-identical to ``pdhef run``'s."""
        ...


@dataclass(frozen=True, slots=True)
class Registered:
    """An estimator of the registry with nothing to prepare."""

    name: str
    needs_model: bool = False

    def _make(self, setup: TuneSetup, tuning: FilterTuning) -> Any:
        return make_estimator(self.name, tuned_vehicle(setup.vehicle, self.name, tuning), use_speed=setup.use_speed)

    def needs(self, setup: TuneSetup) -> frozenset[str]:
        """What the estimator says."""
        needs: frozenset[str] = self._make(setup, FilterTuning()).needs
        return needs

    def prepare(self, setup: TuneSetup, signals: Signals) -> None:
        """Nothing."""
        del setup, signals

    def run(self, setup: TuneSetup, tuning: FilterTuning, signals: Signals, prepared: None) -> StateTrack:
        """Run the estimator as it is."""
        del prepared
        track: StateTrack = self._make(setup, tuning).run(signals, None)[0]
        return track


@dataclass(frozen=True, slots=True)
class Hybrid:
    """The hybrid filter, whose network runs once a drive."""

    name: str
    needs_model: bool = True

    def _make(self, setup: TuneSetup, tuning: FilterTuning) -> HybridUkf:
        assert setup.model is not None
        vehicle = tuned_vehicle(setup.vehicle, self.name, tuning)
        return hybrid_ukf(vehicle, NetworkService(setup.model), use_speed=setup.use_speed)

    def needs(self, setup: TuneSetup) -> frozenset[str]:
        """What the physics filter needs."""
        return self._make(setup, FilterTuning()).needs

    def prepare(self, setup: TuneSetup, signals: Signals) -> np.ndarray[Any, Any]:
        """Return the network's residual rate [N, 2]."""
        return self._make(setup, FilterTuning()).residual_rate(signals, None)[0]

    def run(
        self, setup: TuneSetup, tuning: FilterTuning, signals: Signals, prepared: np.ndarray[Any, Any]
    ) -> StateTrack:
        """Run the filter on a residual rate that is known."""
        hybrid = self._make(setup, tuning)
        return hybrid.filter.run(signals, None, hybrid.trust * prepared)[0]


@dataclass(frozen=True, slots=True)
class Smoothed:
    """The smoother at trust 1 as the filter; its detector and network run once a drive."""

    name: str
    needs_model: bool = True

    def _make(self, setup: TuneSetup, tuning: FilterTuning) -> SmoothedHybrid:
        assert setup.model is not None
        vehicle = tuned_vehicle(setup.vehicle, self.name, tuning)
        return smoothed_hybrid(vehicle, NetworkService(setup.model), use_speed=setup.use_speed)

    def needs(self, setup: TuneSetup) -> frozenset[str]:
        """What the filter needs."""
        return self._make(setup, FilterTuning()).needs

    def prepare(self, setup: TuneSetup, signals: Signals) -> CheckedInputs:
        """Return what the forward filter starts from."""
        return check_inputs(self._make(setup, FilterTuning()).hybrid, signals, None)[0]

    def run(self, setup: TuneSetup, tuning: FilterTuning, signals: Signals, prepared: CheckedInputs) -> StateTrack:
        """Filter and smooth with inputs that are known."""
        return self._make(setup, tuning).run(signals, None, known=prepared)[0]


#: Every estimator that can be tuned, in the order of the tables.
TUNABLE: dict[str, Tunable] = {
    "phy-ukf-tuned": Registered("phy-ukf-tuned"),
    "physics-plus": Registered("physics-plus"),
    "pd-hef": Hybrid("pd-hef"),
    "pd-hef-smoothed": Smoothed("pd-hef-smoothed"),
}
#: Tuned only where they are named: not causal, and a trial takes about twice as long as the filter's.
ON_REQUEST = ("pd-hef-smoothed",)


def choose_names(names: Sequence[str] | None, model: ModelBundle | None) -> tuple[str, ...]:
    """Return the estimators to tune; None = all that the given model suits, but for those of :data:`ON_REQUEST`.

    Raises
    ------
    UsageError
        A name is unknown or given twice, or its network is missing.
    """
    here = [n for n, t in TUNABLE.items() if t.needs_model or n in DESCRIPTIONS]
    if names is None:
        suited = (n for n in here if model is not None or not TUNABLE[n].needs_model)
        return tuple(n for n in suited if n not in ON_REQUEST)
    wrong = sorted({n for n in names if n not in here or names.count(n) > 1})
    if wrong or not names:
        raise UsageError(
            expected=f"estimators out of {', '.join(here)}", got=", ".join(wrong) or "none", where="--estimators"
        )
    without = [n for n in names if TUNABLE[n].needs_model and model is None]
    if without:
        raise UsageError(
            expected="a model bundle", got="none", where=", ".join(without), remedy="give --model DIR of pdhef train"
        )
    return tuple(n for n in here if n in names)


@dataclass(frozen=True, slots=True, eq=False)
class _Drive:
    signals: Signals
    truth: StateTrack
    prepared: Mapping[str, Any]


class DriveBench:
    """Drives of one process and the scoring on them."""

    def __init__(self, setup: TuneSetup) -> None:
        self._setup = setup
        self._drives: dict[int, _Drive] = {}

    def load(self, index: int, log_input: LogInput, split: str | None, max_bytes: int) -> DriveRecord:
        """Read a drive, run what its filters' noise does not change, and keep it under ``index``.

        Raises
        ------
        PdhefError
            The log cannot be read, or takes more than ``max_bytes``.
        """
        setup = self._setup

        def lacking(drive: ReadDrive) -> str:
            missing = {name: sorted(TUNABLE[name].needs(setup) - drive.available) for name in setup.names}
            return "; ".join(f"{name} needs {', '.join(what)}" for name, what in missing.items() if what)

        record, whole = load_drive(
            log_input,
            setup.vehicle,
            setup.mapping,
            setup.config.read_options,
            split=split,
            refuse=lacking,
            least_scored=MIN_SCORED_STAMPS,
            max_bytes=max_bytes,
        )
        if whole is None or whole.truth is None:
            return record
        prepared = {name: TUNABLE[name].prepare(setup, whole.signals) for name in setup.names}
        self._drives[index] = _Drive(whole.signals, whole.truth, prepared)
        more = sum(getattr(value, "nbytes", 0) for value in prepared.values())
        return replace(record, bytes_held=record.bytes_held + more)

    def score(self, tunings: Mapping[str, FilterTuning]) -> dict[str, dict[int, DriveError]]:
        """Return the errors of each estimator by drive."""
        slow = self._setup.vehicle.low_speed_blend_m_s
        return {
            name: {
                index: drive_error(
                    TUNABLE[name].run(self._setup, tuning, drive.signals, drive.prepared[name]), drive.truth, slow
                )
                for index, drive in self._drives.items()
            }
            for name, tuning in tunings.items()
        }


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

    def score(self, tunings: Mapping[str, FilterTuning]) -> dict[str, list[DriveError]]:
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
    _here["bench"] = DriveBench(setup)


def _load(index: int, log_input: LogInput, split: str | None, max_bytes: int) -> DriveRecord:
    return _here["bench"].load(index, log_input, split, max_bytes)


def _score(tunings: dict[str, FilterTuning]) -> dict[str, dict[int, DriveError]]:
    return _here["bench"].score(tunings)
