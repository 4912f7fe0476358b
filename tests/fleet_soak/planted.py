"""The work on a drive, preceded by a fault that the name of the log selects."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

from pdhef_logtool.runs.working import DriveEnd, DriveTask, run_drive
from pdhef_logtool.workers.supervisor import Tell
from tests.runs.stub_drives import stub_drive

#: Environment variable with the file in which workers write the memory after each drive.
MEASURES = "PDHEF_SOAK_MEASURES"


def planted_drive(task: DriveTask, tell: Tell, work: Callable[[DriveTask, Tell], DriveEnd] = run_drive) -> DriveEnd:
    """Hang, take 8 GB or be killed if the log has that name, else do the work."""
    name = task.log.path.name.partition(".")[0]
    if name == "hangs":
        tell("before it hangs", 0.1)
        time.sleep(3600.0)
    if name == "takes_8_gb":
        tell("before it takes", 0.1)
        held = []
        for _ in range(128):
            held.append(bytearray(b"x" * (64 << 20)))
            time.sleep(0.02)
    if name == "kills":
        tell("before it is killed", 0.1)
        os.kill(os.getpid(), signal.SIGKILL)
    return work(task, tell)


def planted_stub(task: DriveTask, tell: Tell) -> DriveEnd:
    """Do the same with a stub's work."""
    return planted_drive(task, tell, stub_drive)


def rss_bytes() -> int:
    """Return the memory that this process has now."""
    return int(Path("/proc/self/statm").read_bytes().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def measured_drive(task: DriveTask, tell: Tell) -> DriveEnd:
    """Work on a drive and note the memory of the process."""
    return _measured(planted_drive(task, tell), task)


def measured_stub(task: DriveTask, tell: Tell) -> DriveEnd:
    """Do the same with a stub's work."""
    return _measured(stub_drive(task, tell), task)


def _measured(end: DriveEnd, task: DriveTask) -> DriveEnd:
    line = json.dumps([rss_bytes(), task.log.path.name])
    with Path(os.environ[MEASURES]).open("a") as file:
        file.write(line + "\n")
    return end
