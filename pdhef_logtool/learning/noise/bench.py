"""Drives of the noise search in memory: what does not depend on a filter's noise is computed once per drive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.parts import PHYSICS, FilterNoise
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import MAX_BYTES, Drive, WholeDrive, too_big
from pdhef_logtool.estimators.base import Estimator
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.estimators.table import FEATURES, SPECS, Options, spec_of
from pdhef_logtool.learning.drives import DriveRecord, load_drive
from pdhef_logtool.learning.noise.search import DriveError, drive_error
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.mapping import Mapping as SignalMapping
from pdhef_logtool.records.errors import UsageError

#: A drive with fewer scored stamps does not count.
MIN_SCORED_STAMPS = 100


def choose_names(names: Sequence[str] | None, car: Car) -> tuple[str, ...]:
    """Return the estimators to tune, in the order of the tables.

    Parameters
    ----------
    names : None = every one that can be, without ``physics`` where the car has a fit of it: its noise was identified
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


class Bench:
    """Drives in memory, and the errors of estimators on them.

    Parameters
    ----------
    names : estimators whose signals a drive must have.
    """

    def __init__(self, car: Car, mapping: SignalMapping | None, options: ReadOptions, names: Sequence[str]) -> None:
        self._car, self._mapping, self._options, self._names = car, mapping, options, names
        self._drives: list[WholeDrive] = []
        self._bytes = 0

    def load(self, log: LogInput) -> tuple[DriveRecord, WholeDrive | None]:
        """Read a drive and keep it, None with the reason in the record if it cannot be used.

        Raises
        ------
        PdhefError
            The log cannot be read, or all drives together are too big.
        """

        def lacking(drive: Drive) -> str:
            missing = {name: sorted(FEATURES - drive.available) for name in self._names}
            return "; ".join(f"{name} needs {', '.join(what)}" for name, what in missing.items() if what)

        record, drive = load_drive(
            log,
            self._car,
            self._mapping,
            self._options,
            refuse=lacking,
            least_scored=MIN_SCORED_STAMPS,
            max_bytes=MAX_BYTES - self._bytes,
        )
        self._bytes += record.bytes_held
        if self._bytes > MAX_BYTES:
            raise too_big(record.name)
        if drive is not None:
            self._drives.append(drive)
        return record, drive

    def score(self, tunings: Mapping[str, FilterNoise]) -> dict[str, list[DriveError]]:
        """Return the errors of each estimator in the order of the drives."""
        errors: dict[str, list[DriveError]] = {}
        for name, noise in tunings.items():
            car = self._car.with_noise(name, noise)
            estimator = spec_of(name).make(car, Options(self._options.use_speed))
            errors[name] = [self._error(estimator, drive) for drive in self._drives]
        return errors

    def _error(self, estimator: Estimator, drive: WholeDrive) -> DriveError:
        assert drive.truth is not None
        slow = self._car.vehicle.low_speed_blend_m_s
        return drive_error(run_window(estimator, drive.signals)[0], drive.truth, slow)
