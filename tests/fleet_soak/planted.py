"""Logs that take their worker along, by their name: the work on a drive, with that planted before it."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable

from pdhef_logtool.records.supervisor import Tell
from pdhef_logtool.runs.fleet import DriveEnd, DriveTask, run_drive


def planted_drive(task: DriveTask, tell: Tell, work: Callable[[DriveTask, Tell], DriveEnd] = run_drive) -> DriveEnd:
    """Hang, take 8 GB or be killed where the log's name says so, else do the work."""
    name = task.log.stem
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
