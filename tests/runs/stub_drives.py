"""Work on a drive that takes no time: a report and a figure that follow from the log's name."""

import os
import signal
import time
import zlib
from pathlib import Path

from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.logs.discovery import identity_of
from pdhef_logtool.results.run_report import LogOutcome, write_json
from pdhef_logtool.results.tables import drive_part, write_part
from pdhef_logtool.runs.cars import RunCars, car_record
from pdhef_logtool.runs.drive_outputs import files_of
from pdhef_logtool.runs.journal import digest_of, states_of
from pdhef_logtool.runs.run_drive import car_entry
from pdhef_logtool.runs.working import DriveEnd, DriveTask
from pdhef_logtool.storage.files import PendingFile
from pdhef_logtool.workers.supervisor import Tell


def stub_drive(task: DriveTask, tell: Tell) -> DriveEnd:
    """Write the files of run_drive without reading the log."""
    log = task.log
    tell(log.stem, 0.0)
    car = RunCars.of(task.config, lambda _: None).of_log(log)
    part = f"tables/parts/part-{digest_of(log.stem)}.parquet"
    value = zlib.crc32(log.stem.encode()) / 2**32
    row = MetricRow(log.stem, "physics", "sideslip_rad", "all", "rmse", value, "rad", 100)
    report = task.output / "logs" / log.stem / "report.json"
    write_json(report, {"format": "pdhef.report", "log": {"name": log.stem}})
    (report.parent / "metrics.parquet").write_text(log.stem)
    identity = identity_of(log)
    outcome = LogOutcome(
        log.stem, Path(str(log.path)).name, identity, car=car_entry(car), main="physics", files=files_of(report.parent)
    )
    write_part(task.output / part, drive_part(outcome, {}, [row]))
    outputs = states_of(task.output, [part, *(f"logs/{log.stem}/{p.name}" for p in report.parent.iterdir())])
    return DriveEnd(outcome, identity, car_record(car), part, error_rad=value, outputs=outputs)


def planted_stub(task: DriveTask, tell: Tell) -> DriveEnd:
    """Hang or be killed if the log has that name, else do the work."""
    if task.log.stem == "hangs":
        tell("before it hangs", 0.1)
        time.sleep(3600.0)
    if task.log.stem == "kills":
        os.kill(os.getpid(), signal.SIGKILL)
    return stub_drive(task, tell)


def waiting_drive(folder: Path, task: DriveTask, tell: Tell) -> DriveEnd:
    """Begin to write, wait until a file ``go`` appears in a folder, and only then do the work."""
    (folder / f"{os.getpid()}.begun").touch()
    pending = PendingFile(task.output / "logs" / task.log.stem / "report.json")
    pending.path.write_text("half")
    while not (folder / "go").exists():
        tell("waits", 0.5)
        time.sleep(0.01)
    pending.discard()
    return stub_drive(task, tell)
