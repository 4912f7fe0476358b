"""Processor seconds of a simulated drive of 12.5 s in a fleet, in one process after its first drive.

The default estimators on the shipped car with its network, and on the default sedan, which each log calibrates first.
Then all estimators, and further outputs: tracks, and with ``full`` the recording, annotated copy and page.
"""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from benchmarks.measuring import CACHE, Row, best_seconds
from pdhef_logtool.estimators.table import ALL_ESTIMATORS
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import run_logs
from truthsim.suite import write_suite

DRIVES = 12
#: Target of drives per second and core.
TARGET_PER_S = 3.0
_SALOON = RunConfig(car=Path("saloon"), keep="metrics")
_CONFIGS = {
    "saloon": _SALOON,
    "sedan": RunConfig(keep="metrics"),
    "all": replace(_SALOON, estimators=(ALL_ESTIMATORS,)),
    "estimates": replace(_SALOON, keep="estimates"),
    "full": replace(_SALOON, keep="full"),
}


def drives() -> list[Path]:
    """Return the drives, simulated on the first call."""
    folder = CACHE / "fleet_drives"
    write_suite(folder, count=DRIVES, seed=5)
    return sorted(folder.glob("*.mcap"))


def run_fleet(logs: Sequence[Path], config: RunConfig) -> None:
    """Run logs as a fleet in this process; pages are written if everything is kept."""
    output = CACHE / "fleet_output"
    shutil.rmtree(output, ignore_errors=True)
    run_logs([str(log) for log in logs], output, config, report=config.kept == "full")


def rows() -> list[Row]:
    """Measure."""
    logs = drives()
    for config in _CONFIGS.values():
        run_fleet(logs[:1], config)  # the first drive of a process loads the compiled code
    ways = {name: lambda config=config: run_fleet(logs, config) for name, config in _CONFIGS.items()}
    took = {name: s / len(logs) for name, s in best_seconds(ways).items()}
    command = "pdhef run logs/ --keep metrics --car saloon"
    return [
        Row("drives per second and core", 1.0 / took["saloon"], "1/s", TARGET_PER_S, "at least", command=command),
        Row("the same on the default sedan", 1.0 / took["sedan"], "1/s", TARGET_PER_S, "at least"),
        Row("a drive", took["saloon"], "s"),
        Row("a drive with all estimators", took["all"], "s"),
        Row("a drive, `--keep estimates`", took["estimates"], "s"),
        Row("a drive, `--keep full`, with its pages", took["full"], "s"),
    ]
