"""``pdhef learn``: run one stage on drives and write its part of the car."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.store import check_output, update_car
from pdhef_logtool.learning.drives import (
    CALIBRATE,
    TEACH,
    DriveRecord,
    LearnSettings,
    choose_drives,
    drives_document,
    exit_code,
)
from pdhef_logtool.learning.stages.calibrate import calibrate
from pdhef_logtool.learning.stages.task import StageOutput, Task
from pdhef_logtool.learning.stages.teach import teach
from pdhef_logtool.logs.discovery import Logs
from pdhef_logtool.mapping import mapping_of
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.reporter import SILENT, Reporter
from pdhef_logtool.residual_model.bundle import NO_MODEL
from pdhef_logtool.storage.outputs import check_no_input, local_path

RUN: dict[str, Callable[[Task], StageOutput]] = {TEACH: teach, CALIBRATE: calibrate}


@dataclass(frozen=True, slots=True, eq=False)
class LearnResult:
    """The folder of the car, a record of every drive, the stage with a summary line, and its figures."""

    car: Path
    records: tuple[DriveRecord, ...]
    stage: str
    text: str
    figures: dict[str, Any]

    @property
    def exit_code(self) -> int:
        """0 if all drives were used completely, 3 otherwise."""
        return exit_code(self.records)

    @property
    def drives(self) -> tuple[DriveRecord, ...]:
        """Drives that were used."""
        return tuple(r for r in self.records if not r.left_out)

    @property
    def left_out(self) -> tuple[DriveRecord, ...]:
        """Drives that were excluded."""
        return tuple(r for r in self.records if r.left_out)

    def to_dict(self) -> dict[str, Any]:
        """Return the result as one JSON-able document."""
        shared = {"car": str(self.car), "exit_code": self.exit_code, **drives_document(self.records)}
        return {**shared, "stages": [{"name": self.stage, "text": self.text, "figures": self.figures}]}


def learn(arguments: Logs, output: Path | str, settings: LearnSettings, *, reporter: Reporter = SILENT) -> LearnResult:
    """Run one stage on drives and write the car to the folder ``output``.

    Parameters
    ----------
    arguments : logs, folders, glob patterns.

    Raises
    ------
    UsageError
        An option is wrong, or the set of a drive excludes it from learning.
    PdhefError
        A file or log cannot be read; without it the result would differ.
    EstimatorError
        There is too little driving with ground truth.
    """
    output, config = local_path(output), settings.config
    if output.suffix in (".toml", ".json"):
        raise UsageError(
            expected="a car's folder", got=output.name, where="--output", remedy="a car has more than a file contains"
        )
    car = Car.load(config.car, network=NO_MODEL)
    if config.car is None:
        reporter.warn(f"no --car: mass, geometry and priors come from the default {car.datasheet.name}")
    check_output(car, output)
    inputs, set_splits = choose_drives(arguments, settings)
    read = [*(i.local for i in inputs), *(path for path in config.files if path != config.car)]
    check_no_input(read, [], [output])
    task = Task(
        car=car,
        settings=settings,
        logs=tuple(inputs),
        mapping=mapping_of(config.mapping),
        set_splits=set_splits,
        reporter=reporter,
    )
    stage = RUN[settings.stage](task)
    update_car(car, output, stage.change)
    reporter.progress("done", 1.0)
    return LearnResult(output, stage.records, settings.stage, stage.text, stage.figures)
