"""Processor seconds of a simulated drive of 12.5 s in a fleet, in one process after its first drive.

The default estimators on the shipped car with its network, and on the default sedan, which each log calibrates first:
all of ``pdhef run --keep metrics`` except the files of the whole run. Then the parts, all estimators, and further
outputs: tracks, and with ``full`` the recording, annotated copy and page.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from benchmarks.measuring import CACHE, Row, best_seconds
from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.estimators.table import ALL_ESTIMATORS, make_estimator
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.estimating import estimate_windows
from pdhef_logtool.runs.fleet import run_logs
from pdhef_logtool.runs.selection import default_names
from truthsim.suite import write_suite

#: Drives of a fleet, and of what takes longer.
DRIVES, FEW = 16, 6
#: The drives a second that a core is to do.
TARGET_PER_S = 3.0
_SALOON = RunConfig(car=Path("saloon"), keep="metrics")
_COMMAND = "pdhef run logs/ --keep metrics --car saloon"


def drives() -> list[Path]:
    """Return the drives, simulated when they are first asked for."""
    folder = CACHE / "fleet_drives"
    write_suite(folder, count=DRIVES, seed=5)
    return sorted(folder.glob("*.mcap"))


def run_fleet(logs: Sequence[Path], config: RunConfig) -> None:
    """Run logs as a fleet of one process; pages are written where everything is kept."""
    output = CACHE / "fleet_output"
    shutil.rmtree(output, ignore_errors=True)
    run_logs([str(log) for log in logs], output, config, report=config.kept == "full")


def read(logs: Sequence[Path], car: Car) -> None:
    """Open, map, plan and read logs."""
    for log in logs:
        with read_drive(log, car) as drive:
            for _ in (drive.whole(),):
                pass


def estimate(logs: Sequence[Path], car: Car) -> None:
    """Read logs, and run the default estimators on them."""
    for log in logs:
        with read_drive(log, car) as drive:
            estimators = [make_estimator(name, car) for name in default_names(car, drive.available)]
            for _ in estimate_windows(drive, estimators):
                pass


def rows() -> list[Row]:
    """Measure."""
    logs, car = drives(), Car.load(Path("saloon"))
    few = logs[:FEW]
    everything = replace(_SALOON, estimators=(ALL_ESTIMATORS,))
    of_all: dict[str, Callable[[], object]] = {
        "saloon": lambda: run_fleet(logs, _SALOON),
        "sedan": lambda: run_fleet(logs, RunConfig(keep="metrics")),
        "read": lambda: read(logs, car),
        "estimate": lambda: estimate(logs, car),
    }
    of_few: dict[str, Callable[[], object]] = {
        "all": lambda: run_fleet(few, everything),
        "estimates": lambda: run_fleet(few, replace(_SALOON, keep="estimates")),
        "full": lambda: run_fleet(few, replace(_SALOON, keep="full")),
    }
    for way in (*of_all.values(), *of_few.values()):
        way()  # the first drive of a process loads what has been compiled
    took = {name: s / len(logs) for name, s in best_seconds(of_all).items()}
    took |= {name: s / len(few) for name, s in best_seconds(of_few, rounds=2).items()}
    return [
        Row("drives per second and core", 1.0 / took["saloon"], "1/s", TARGET_PER_S, "at least", command=_COMMAND),
        Row("the same on the default sedan", 1.0 / took["sedan"], "1/s", TARGET_PER_S, "at least"),
        Row("a drive", took["saloon"], "s"),
        Row("of it open, map, plan and read", took["read"], "s"),
        Row("of it the default estimators", took["estimate"] - took["read"], "s"),
        Row("of it figures, report and files", took["saloon"] - took["estimate"], "s"),
        Row("a drive with all estimators", took["all"], "s"),
        Row("a drive, `--keep estimates`", took["estimates"], "s"),
        Row("a drive, `--keep full`, with its pages", took["full"], "s"),
    ]
