"""Commands on an hour of a simulated road drive.

Each command runs once, in a new process on one core, with code compiled before, start included.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from benchmarks.measuring import CACHE, ROOT, Row, command_cost
from benchmarks.one_hour_log import HOUR_S, hour_log

_LIGHT = ("--keep", "estimates", "--no-report")
_ALL = ("--estimators", "all", "--annotate", "full")


def drive_hour() -> Path:
    """Return the log of the drive, simulated once."""
    path = CACHE / "drive_hour.mcap"
    if not path.exists():
        CACHE.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, "-m", "pdhef_logtool", "simulate", "road", "--duration", str(HOUR_S), "--seed", "1"]
        subprocess.run([*command, "-o", str(path)], cwd=ROOT, check=True, capture_output=True)
    return path


def run_words(output: Path, *, light: bool) -> tuple[str | Path, ...]:
    """Return the words of a run of the hour."""
    return "run", drive_hour(), "--car", "saloon", "-o", output, *(_LIGHT if light else _ALL)


def rows() -> list[Row]:
    """Measure."""
    output = CACHE / "run-all"
    whole_words = run_words(output, light=False)
    command_cost(*whole_words, "--end", "+30s")  # code that is compiled on its first call
    inspect, light = command_cost("inspect", hour_log()), command_cost(*run_words(CACHE / "run-light", light=True))
    whole, written = command_cost(*whole_words), sum(f.stat().st_size for f in output.rglob("*") if f.is_file())
    run = "pdhef run hour.mcap --car saloon -o out"
    return [
        Row("inspect 1.26 M messages", inspect.seconds, "s", 1.0, command="pdhef inspect hour.mcap"),
        Row("run, light outputs", light.seconds, "s", 10.0, command=f"{run} {' '.join(_LIGHT)}"),
        Row("memory of it", light.peak_bytes / 1e6, "MB"),
        Row("run, everything", whole.seconds, "s", 40.0, command=f"{run} {' '.join(_ALL)}"),
        Row("memory of it", whole.peak_bytes / 1e6, "MB"),
        Row("written bytes", written / 1e6, "MB", 300.0),
        Row("of it: the log's own messages", drive_hour().stat().st_size / 1e6, "MB"),
    ]
