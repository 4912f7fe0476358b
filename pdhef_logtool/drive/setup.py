"""Frozen set-up: mounting, delays and clocks from another log or from the first seconds of this one.

In a car, these are decided before the drive or from its past. Offline they come from the first ten minutes of the log,
so that estimates of these minutes depend on later samples. With a frozen set-up they do not. Every run writes its
set-up as ``setup.toml``, and a later run can use it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pdhef_logtool.drive.alignment import AlignmentPlan
from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.mapping import ClockModel, Mapping, check_mapping, fit_clocks
from pdhef_logtool.mapping.records import CanSettings, SignalSource
from pdhef_logtool.records.errors import MappingError
from pdhef_logtool.storage.documents import jsonable, read_toml
from pdhef_logtool.storage.toml_text import toml_text

#: The offset of a device clock changes between logs: it is estimated from the messages of this duration.
CLOCK_START_S = 1.0
_REMEDY = "give the setup.toml of a run of the same car and recorder"


@dataclass(frozen=True, slots=True)
class Setup:
    """Decisions that are constant over a drive.

    Attributes
    ----------
    signals, can : the mapping of the sensors, with mounting and units applied.
    clocks : relation of stamps to log time, by topic and stamp of the sensors.
    alignment : source, delay and gaps of every channel.
    decided_s : duration of the log that decided the set-up.
    """

    signals: dict[str, SignalSource]
    clocks: dict[str, ClockModel]
    alignment: AlignmentPlan
    decided_s: float
    can: CanSettings | None = None
    format: Literal["pdhef-setup"] = "pdhef-setup"
    version: Literal[1] = 1

    def applied_to(self, mapping: Mapping) -> Mapping:
        """Return the mapping with the sensors of this set-up; its ground truth is unchanged."""
        return replace(mapping, signals=self.signals, can=self.can, origin="file")


class LogUntil:
    """A log up to a time; later samples are not readable."""

    def __init__(self, log: DriveLog, end_ns: int) -> None:
        self._log, self.end_ns = log, min(end_ns, log.end_ns)

    def __getattr__(self, name: str) -> Any:
        """Return all other attributes of the log."""
        return getattr(self._log, name)

    def read(self, requests: Any, start_ns: int | None = None, end_ns: int | None = None, **options: Any) -> Any:
        """Read the messages up to the end."""
        end_ns = self.end_ns if end_ns is None else min(end_ns, self.end_ns)
        return self._log.read(requests, start_ns, end_ns, **options)


def setup_toml(setup: Setup, head: str) -> str:
    """Return a set-up as TOML, without loss."""
    return toml_text(_plain(setup), head)


def load_setup(path: Path) -> Setup:
    """Read a setup.toml; raises MappingError if it is missing or wrong."""
    from pydantic import TypeAdapter, ValidationError

    raw = read_toml(path, "a set-up", MappingError, _REMEDY)
    try:
        return TypeAdapter(Setup).validate_python(raw)
    except ValidationError as error:
        raise MappingError(
            expected="the entries of a setup.toml",
            got="; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors()[:3]),
            where=str(path),
            remedy=_REMEDY,
        ) from error


def clocks_of(setup: Setup, log: DriveLog, mapping: Mapping, start_ns: int) -> dict[str, ClockModel]:
    """Return the clocks of the sensors. A device clock keeps its drift; its offset is from this log's first messages.

    Parameters
    ----------
    mapping : with the set-up applied.

    Raises
    ------
    MappingError : The log lacks a topic of the set-up.
    """
    sensors = replace(mapping, truth={}, quality=None)
    check_mapping(sensors, log)
    first = fit_clocks(log, sensors, start_ns, start_ns + round(CLOCK_START_S * 1e9))
    return {
        key: replace(clock, reference_stamp_ns=new.reference_stamp_ns, reference_log_ns=new.reference_log_ns)
        if is_device_clock(clock) and is_device_clock(new := first[key])
        else clock
        for key, clock in setup.clocks.items()
    }


def is_device_clock(clock: ClockModel) -> bool:
    """Return whether stamps of the clock are shifted to log time."""
    return (clock.reference_stamp_ns, clock.reference_log_ns, clock.drift) != (0, 0, 0.0)


def _plain(record: Any) -> Any:
    """Return a record as TOML values: without entries that are None, NaN as nan."""
    if hasattr(record, "__dataclass_fields__"):
        entries = {f.name: getattr(record, f.name) for f in fields(record)}
        return {k: _plain(v) for k, v in entries.items() if v is not None}
    if isinstance(record, dict):
        return {k: _plain(v) for k, v in record.items()}
    if isinstance(record, list | tuple):
        return [_plain(v) for v in record]
    if isinstance(record, float | np.floating):
        return float(record) if math.isfinite(record) else float("nan")
    return jsonable(record)
