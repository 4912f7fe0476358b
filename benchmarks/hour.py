"""Commands on an hour of a simulated road drive.

Each command runs once, in a new process, with code compiled before, start included.
"""

from pathlib import Path

from benchmarks.measuring import CACHE, Row, command_cost
from benchmarks.one_hour_log import drive_log

_LIGHT = ("--keep", "estimates", "--no-report")
_ALL = ("--estimators", "all", "--annotate", "full")


def run_words(output: Path, *, light: bool) -> tuple[str | Path, ...]:
    """Return the words of a run of the hour."""
    return "run", drive_log(), "--car", "saloon", "-o", output, *(_LIGHT if light else _ALL)


def rows() -> list[Row]:
    """Measure."""
    output = CACHE / "run-all"
    whole_words = run_words(output, light=False)
    command_cost(*whole_words, "--end", "+30s")  # code that is compiled on its first call
    inspect, light = command_cost("inspect", drive_log()), command_cost(*run_words(CACHE / "run-light", light=True))
    whole, written = command_cost(*whole_words), sum(f.stat().st_size for f in output.rglob("*") if f.is_file())
    run = "pdhef run hour.mcap --car saloon -o out"
    return [
        Row("inspect 1.69 M messages", inspect.seconds, "s", 1.0, command="pdhef inspect hour.mcap"),
        Row("run, light outputs", light.seconds, "s", 10.0, command=f"{run} {' '.join(_LIGHT)}"),
        Row("memory of it", light.peak_bytes / 1e6, "MB"),
        Row("run, everything", whole.seconds, "s", 40.0, command=f"{run} {' '.join(_ALL)}"),
        Row("memory of it", whole.peak_bytes / 1e6, "MB"),
        Row("written bytes", written / 1e6, "MB", 300.0),
        Row("of it: the log's own messages", drive_log().stat().st_size / 1e6, "MB"),
    ]
