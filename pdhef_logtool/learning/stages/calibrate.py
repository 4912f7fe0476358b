"""Stage ``calibrate``: calibrate a car on several logs by the sensors alone (``fit.toml``).

See docs/method.md#self-calibration. The calibration of a single log may be wrong on other logs, so that only a
calibration on several logs is written.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from pdhef_logtool.car.car import FIT_FILE, Car
from pdhef_logtool.car.parts import Fit, FittedPhysics, FittedValues, LearntOn, physics_sha256
from pdhef_logtool.car.store import Change
from pdhef_logtool.car.toml_files import part_toml
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.estimators.calibration.calibration import SelfCalibration, self_calibrate
from pdhef_logtool.estimators.calibration.driving import Driving
from pdhef_logtool.learning.drives import CALIBRATE, DriveRecord, record_of
from pdhef_logtool.learning.stages.task import StageOutput, Task
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.records.errors import EstimatorError
from pdhef_logtool.runs.self_calibrating import lacking, read_driving

#: Minimum number of logs.
LEAST_LOGS = 2


def calibrate(task: Task) -> StageOutput:
    """Calibrate a car on its logs without ground truth.

    Raises
    ------
    EstimatorError
        Too few logs, too little driving, a stiffness that remains uncertain, or a car that drifts.
    """
    start = task.car.datasheet
    car = Car.of(start)

    def read(log: LogInput) -> tuple[DriveRecord, Driving | None]:
        with read_drive(log, car, task.mapping, task.settings.config.read_options) as drive:
            if missing := lacking(drive):
                return record_of(drive, left_out=f"the log has no {', '.join(missing)}"), None
            driving = read_driving(drive)
            usable = len(driving.stretches) > 0
            record = record_of(drive, left_out="" if usable else "no driving that a calibration can use")
            start_s, end_s = ((t - drive.log.start_ns) * 1e-9 for t in (drive.plan.start_ns, drive.plan.end_ns))
            return replace(record, seconds=end_s - start_s, span_s=(start_s, end_s)), driving if usable else None

    records, drives = task.read(read, 0.8)
    if len(drives) < LEAST_LOGS:
        raise _refused(f"{len(drives)} of them", "logs of one car, for the result of one log need not apply to another")
    calibration = self_calibrate(
        drives,
        start,
        exported=True,
        progress=lambda share: task.reporter.progress("fitting to the sensors", 0.8 + 0.2 * share),
    )
    if calibration.refused:
        raise _refused(calibration.refused, "logs with bends and lane changes that calibrate the car")
    part = fit_part(calibration, [r.learnt_on for r in records if not r.left_out])
    head = f"Written by pdhef learn --stages calibrate: no ground truth was used.\n{calibration.text}."
    files = {FIT_FILE: part_toml(part, head).encode()}
    settings = task.settings.to_dict()
    change = Change(f"learn --stages {CALIBRATE}", FIT_FILE, files, settings=settings, drives=part.drives)
    return StageOutput(change, records, calibration.text, {"self_calibration": calibration.to_dict()})


def fit_part(calibration: SelfCalibration, drives: Sequence[LearntOn]) -> Fit:
    """Return the calibration as a part of a car; ``physics`` has the same values, and its own noise."""
    datasheet, vehicle = calibration.vehicle_file, calibration.vehicle
    return Fit(
        physics_sha256=physics_sha256(datasheet),
        values=FittedValues.between(datasheet, vehicle),
        physics=FittedPhysics(
            values=FittedValues.of(vehicle),
            noise=calibration.noise,
            varied=tuple(FittedValues.between(vehicle, v) for v in calibration.varied),
        ),
        without_truth=True,
        drives=tuple(drives),
        notes=(calibration.text, "no ground truth was used: a drive with ground truth gives better values"),
    )


def _refused(got: str, expected: str) -> EstimatorError:
    return EstimatorError(
        expected=expected,
        got=got,
        where="learn --stages calibrate",
        remedy="give more logs of this car, or one with ground truth without this option",
    )
