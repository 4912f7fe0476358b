"""``pdhef learn``: the model of a car (``model.toml``) from its drives, with or without ground truth.

The posterior of each drive informs later drives (:mod:`pdhef_logtool.model.priors`). Drives with ground truth also
give a residual, which is chosen on held-out driving (:mod:`~.teach`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.model import CarModel
from pdhef_logtool.car.names import MODEL_FILE
from pdhef_logtool.car.store import check_output, update_car
from pdhef_logtool.drive.plan import Sensors
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.learning.drives import DriveRecord, DriveSet, LearnSettings, drives_document, exit_code, tell_drive
from pdhef_logtool.learning.teach import LEAST_S, OpenedDrive, figures_of, learn_from, open_drive
from pdhef_logtool.logs.discovery import LogInput, Logs
from pdhef_logtool.model.drive_model import for_later_drives, lacking, model_of, read_driving
from pdhef_logtool.model.driving import Driving
from pdhef_logtool.model.fit import fit_car
from pdhef_logtool.records.errors import EstimatorError, UsageError
from pdhef_logtool.records.reporter import SILENT, Reporter
from pdhef_logtool.residual_model.bundle import NO_MODEL
from pdhef_logtool.storage.outputs import check_no_input, local_path


@dataclass(frozen=True, slots=True, eq=False)
class LearnResult:
    """The folder of the car, a record of every drive, a summary line, and figures as JSON-able values."""

    car: Path
    records: tuple[DriveRecord, ...]
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

    def to_dict(self) -> dict[str, Any]:
        """Return the result as one JSON-able document."""
        shared = {"car": str(self.car), "exit_code": self.exit_code, **drives_document(self.records)}
        return {**shared, "text": self.text, "figures": self.figures}


def learn(arguments: Logs, output: Path | str, settings: LearnSettings, *, reporter: Reporter = SILENT) -> LearnResult:
    """Learn a car from drives and write it to the folder ``output``.

    Drives with ground truth teach; the others are used if there is no such drive.

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
        There is too little driving.
    """
    output, config = local_path(output), settings.config
    if output.suffix in (".toml", ".json"):
        raise UsageError(
            expected="a car's folder", got=output.name, where="--output", remedy="a car has more than a file contains"
        )
    source = Car.load(config.car, network=NO_MODEL)
    if config.car is None:
        reporter.warn(f"no --car: mass, geometry and priors come from the default {source.datasheet.name}")
    check_output(source, output)
    drives = DriveSet.of(arguments, Car.of(source.datasheet), settings, reporter)
    read = [*(i.local for i in drives.logs), *(path for path in config.files if path != config.car)]
    check_no_input(read, [], [output])
    records, model, figures = _learnt(drives)
    for record in records:
        tell_drive(record, reporter.warn)
    learnt_on = tuple(r.learnt_on for r in records if not r.left_out)
    text = model.model_copy(update={"drives": learnt_on}).toml(f"Written by pdhef learn.\n{model.evidence}")
    update_car(source, output, {MODEL_FILE: text.encode()})
    reporter.progress("done", 1.0)
    return LearnResult(output, records, model.evidence, figures)


@dataclass(frozen=True, slots=True, eq=False)
class _Read:
    """Driving and sensors of a drive; ``opened`` : its content for teaching, None without ground truth."""

    driving: Driving | None
    sensors: Sensors
    opened: OpenedDrive | None


def _learnt(drives: DriveSet) -> tuple[tuple[DriveRecord, ...], CarModel, dict[str, Any]]:
    """Return the records of drives, their model, and figures."""
    config, car, progress = drives.settings.config, drives.car, drives.reporter.progress

    def read(log: LogInput) -> tuple[DriveRecord, _Read]:
        with read_drive(log, car, drives.mapping, config.read_options) as drive:
            record, opened = open_drive(drive, config)
            if opened is not None:
                return record, _Read(opened.driving, drive.plan.sensors, opened)
            start_s, end_s = ((t - drive.log.start_ns) * 1e-9 for t in (drive.plan.start_ns, drive.plan.end_ns))
            driving = None if lacking(drive) else read_driving(drive)
            record = replace(record, seconds=end_s - start_s, span_s=(start_s, end_s))
            return record, _Read(driving, drive.plan.sensors, None)

    records, content = drives.read(read, 0.3)
    teachers = [r.opened for r in content if r.opened is not None]
    if not teachers and config.reference != "on":
        return _without_truth(records, content, car)
    _check("" if teachers else "none", "at least one drive with a true sideslip and the signals of a calibration")
    seconds, slow = math.fsum(d.seconds for d in teachers), car.vehicle.low_speed_blend_m_s
    few = "" if seconds >= LEAST_S else f"{seconds:.1f} s"
    _check(few, f"at least {LEAST_S:g} s of driving with ground truth above {slow:g} m/s")
    taught = learn_from(teachers, progress)
    sensors = next(r.sensors for r in content if r.opened is not None)
    stated = {name: getattr(taught, name) for name in ("parameters", "calibrated", "truth", "evidence")}
    return records, model_of(car, sensors, residual=taught.ladder.model, **stated), figures_of(taught)


def _without_truth(
    records: Sequence[DriveRecord], content: Sequence[_Read], car: Car
) -> tuple[tuple[DriveRecord, ...], CarModel, dict[str, Any]]:
    """Return the records of drives without ground truth, their model, and figures."""
    fits = [None if r.driving is None else fit_car(r.driving, car.vehicle) for r in content]
    left_out = [r.left_out if fit is None else fit.refused for r, fit in zip(records, fits, strict=True)]
    records = tuple(replace(r, left_out=reason) for r, reason in zip(records, left_out, strict=True))
    used = [(fit, r.sensors) for fit, r in zip(fits, content, strict=True) if fit is not None and not fit.refused]
    _check(
        "" if used else next(iter(left_out), "no drive"),
        "driving that calibrates the car, such as lane changes and bends",
    )
    seconds = math.fsum(fit.seconds for fit, _ in used)
    evidence = f"calibrated without ground truth on {seconds:.0f} s of driving"
    parameters = tuple(p for fit, _ in used for p in for_later_drives(fit))
    model = model_of(car, used[0][1], parameters=parameters, evidence=evidence)
    return records, model, {"self_calibration": [fit.to_dict() for fit, _ in used]}


def _check(got: str, expected: str) -> None:
    """Raise EstimatorError if ``got`` states a lack of the drives."""
    if got:
        remedy = "give more drives of this car, or map v_y, sideslip, or position and heading as ground truth"
        raise EstimatorError(expected=expected, got=got, where="learn", remedy=remedy)
