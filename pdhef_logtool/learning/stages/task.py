"""Input and output of a stage: every stage is one function ``Task -> StageOutput``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.store import Change
from pdhef_logtool.learning.drives import DriveRecord, LearnSettings, tell_drive
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.mapping import Mapping as SignalMapping
from pdhef_logtool.records.reporter import SILENT, Reporter

_Read = TypeVar("_Read")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Task:
    """Input of a stage.

    Attributes
    ----------
    car : car to start from.
    settings : their configuration names this car and the network to start from.
    logs : drives of the stage. set_splits : split of each log in its simulated set, by log name.
    """

    car: Car
    settings: LearnSettings
    logs: tuple[LogInput, ...]
    mapping: SignalMapping | None = None
    set_splits: Mapping[str, str] = field(default_factory=dict)
    reporter: Reporter = SILENT

    def read(
        self, read: Callable[[LogInput], tuple[DriveRecord, _Read | None]], share: float = 1.0
    ) -> tuple[tuple[DriveRecord, ...], list[_Read]]:
        """Read the logs in order; return a record of each, and the contents of usable logs.

        ``share`` : share of the reading in the stage's progress.
        """
        records, drives = [], list[_Read]()
        for number, log in enumerate(self.logs):
            self.reporter.progress(f"reading {log.stem}", share * number / len(self.logs))
            record, drive = read(log)
            records.append(replace(record, split=self.set_splits.get(log.stem)))
            tell_drive(records[-1], self.reporter.warn)
            if drive is not None:
                drives.append(drive)
        return tuple(records), drives


@dataclass(frozen=True, slots=True, eq=False)
class StageOutput:
    """Output of a stage: the change of the car, a record per drive, a summary line and figures as JSON-able values."""

    change: Change
    records: tuple[DriveRecord, ...]
    text: str
    figures: dict[str, Any]
