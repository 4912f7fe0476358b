"""Stage ``calibrate``: calibrate a car on several logs by the sensors alone (``model.toml``).

See docs/method.md#self-calibration. The sensors are those of the first log.
"""

from __future__ import annotations

from dataclasses import replace

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.store import Change
from pdhef_logtool.drive.model_file import ModelFile, Sensors
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.estimators.calibration.calibration import as_prior, self_calibrate
from pdhef_logtool.estimators.calibration.driving import Driving
from pdhef_logtool.learning.drives import CALIBRATE, DriveRecord, record_of
from pdhef_logtool.learning.stages.task import StageOutput, Task
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.model.drive_model import lacking, read_driving
from pdhef_logtool.records.errors import EstimatorError
from pdhef_logtool.results.opened_run import MODEL_FILE


def calibrate(task: Task) -> StageOutput:
    """Calibrate a car on its logs without ground truth.

    Raises
    ------
    EstimatorError
        Too little driving, a stiffness that remains uncertain, or a car that drifts.
    """
    start = task.car.datasheet
    car = Car.of(start)

    def read(log: LogInput) -> tuple[DriveRecord, tuple[Driving, Sensors] | None]:
        with read_drive(log, car, task.mapping, task.settings.config.read_options) as drive:
            if missing := lacking(drive):
                return record_of(drive, left_out=f"the log has no {', '.join(missing)}"), None
            driving = read_driving(drive)
            usable = len(driving.stretches) > 0
            record = record_of(drive, left_out="" if usable else "no driving that a calibration can use")
            start_s, end_s = ((t - drive.log.start_ns) * 1e-9 for t in (drive.plan.start_ns, drive.plan.end_ns))
            record = replace(record, seconds=end_s - start_s, span_s=(start_s, end_s))
            return record, (driving, drive.plan.sensors) if usable else None

    records, drives = task.read(read, 0.8)
    calibration = self_calibrate(
        [driving for driving, _ in drives],
        start,
        exported=True,
        progress=lambda share: task.reporter.progress("fitting to the sensors", 0.8 + 0.2 * share),
    )
    if calibration.refused:
        raise EstimatorError(
            expected="logs with bends and lane changes that calibrate the car",
            got=calibration.refused,
            where="learn --stages calibrate",
            remedy="give more logs of this car, or one with ground truth without this option",
        )
    learnt_on = [r.learnt_on for r in records if not r.left_out]
    head = f"Written by pdhef learn --stages calibrate: no ground truth was used.\n{calibration.text}."
    files = {MODEL_FILE: ModelFile.of(drives[0][1], car, as_prior(calibration.parameters)).toml(head).encode()}
    change = Change(f"learn --stages {CALIBRATE}", MODEL_FILE, files, task.settings.to_dict(), learnt_on)
    return StageOutput(change, records, calibration.text, {"self_calibration": calibration.to_dict()})
