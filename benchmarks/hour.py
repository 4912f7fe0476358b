"""Commands on an hour of a simulated road drive, and the time of the parts of a run.

Each command runs once, in a new process on one core, with code compiled before, start included. The peer is the
straightforward pipeline of `benchmarks/peers.py` on the first 30 s, scaled to the hour by its steps.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from benchmarks.measuring import CACHE, ROOT, Cost, Row, best_seconds, command_cost
from benchmarks.one_hour_log import HOUR_S, hour_log

_SLICE_S = 30
_LEAST_S = 0.05  # what takes less has no row
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


def _run(*options: str) -> tuple[str, ...]:
    name = "light" if "--keep" in options else "all"
    return "run", str(drive_hour()), "--car", "saloon", "-o", str(CACHE / f"run-{name}"), *options


def _written_bytes(folder: Path) -> int:
    return sum(f.stat().st_size for f in folder.rglob("*") if f.is_file())


def _peer_seconds() -> float:
    """Return what the straightforward pipeline takes for the hour, from a slice of it."""
    from benchmarks.peers import run_pipeline
    from pdhef_logtool.logs.open_log import open_log

    log = open_log(drive_hour())
    start_ns = log.start_ns
    log.close()
    out = CACHE / "pipeline.mcap"
    steps = run_pipeline(drive_hour(), out, start_ns + 2 * 10**9)  # what is compiled and imported at first
    seconds = best_seconds({"peer": lambda: run_pipeline(drive_hour(), out, start_ns + _SLICE_S * 10**9)}, rounds=2)
    steps = run_pipeline(drive_hour(), out, start_ns + _SLICE_S * 10**9)
    return seconds["peer"] * HOUR_S * 100 / steps


def _of_a_run(what: str, target_s: float, *options: str) -> tuple[list[Row], Cost]:
    """Run the hour once; returns its row with those of its parts, and what it cost."""
    arguments = _run(*options)
    cost = command_cost(*arguments, module="benchmarks.hour")
    parts: dict[str, float] = json.loads(cost.last_line)
    command = f"pdhef run hour.mcap --car saloon -o out {' '.join(options)}"
    return [
        Row(what, cost.seconds, "s", target_s, command=command),
        *(Row(f"of it: {part}", seconds, "s") for part, seconds in parts.items() if seconds >= _LEAST_S),
        Row("memory of it", cost.peak_bytes / 1e6, "MB"),
    ], cost


def rows() -> list[Row]:
    """Measure."""
    command_cost(*_run(*_ALL, "--end", "+30s"))  # what is compiled at first
    inspect = command_cost("inspect", hour_log())
    light, cost = _of_a_run("run, light outputs", 10.0, *_LIGHT)
    ratio = _peer_seconds() / cost.seconds
    whole, _ = _of_a_run("run, everything", 40.0, *_ALL)
    return [
        Row("inspect 1.26 M messages", inspect.seconds, "s", 1.0, command="pdhef inspect hour.mcap"),
        *light,
        Row("straightforward pipeline / run, light outputs", ratio, "x", 30.0, "at least"),
        *whole,
        Row("written bytes", _written_bytes(CACHE / "run-all") / 1e6, "MB", 300.0),
        Row("of it: the log's own messages", drive_hour().stat().st_size / 1e6, "MB"),
    ]


def _parts_of_a_run() -> None:
    """Run the command line, and end with a line of JSON: processor seconds by part."""
    spent: defaultdict[str, float] = defaultdict(float)
    began = time.process_time()

    def timed(module: Any, name: str, part: str | None, *, lazy: bool = False) -> None:
        """Count what a function takes, or what a generator takes between its values, less what is counted inside."""
        called: Callable[..., Any] = getattr(module, name)

        def of(arguments: tuple[Any, ...]) -> str:
            return part or f"estimator {arguments[0].name}"

        def call(*arguments: Any, **named: Any) -> Any:
            start, inside = time.process_time(), sum(spent.values())
            try:
                return called(*arguments, **named)
            finally:
                spent[of(arguments)] += time.process_time() - start - (sum(spent.values()) - inside)

        def each(*arguments: Any, **named: Any) -> Iterator[Any]:
            values = called(*arguments, **named)
            while True:
                start, inside = time.process_time(), sum(spent.values())
                value = next(values, None)
                spent[of(arguments)] += time.process_time() - start - (sum(spent.values()) - inside)
                if value is None:
                    return
                yield value

        setattr(module, name, each if lazy else call)

    from pdhef_logtool.cli.app import main
    from pdhef_logtool.drive import reading
    from pdhef_logtool.results import mcap_sink as mcap
    from pdhef_logtool.results import parquet_sink as parquet
    from pdhef_logtool.results import rerun_sink as rerun
    from pdhef_logtool.runs import drive_details, estimating, pipeline

    timed(reading, "read_recorded", "reading and aligning")
    timed(estimating, "run_estimator", None)
    timed(pipeline, "_estimate", "monitors, intervals, poses")
    timed(pipeline, "evaluate", "figures")
    timed(drive_details, "drive_details", "details")
    for sink, what in (
        (parquet.EstimatesSink, "estimates.parquet"),
        (mcap.AnnotatedMcapSink, "annotated.mcap"),
        (rerun.RerunSink, "recording.rrd"),
    ):
        for step in ("append", "finish"):
            timed(sink, step, what)
    from pdhef_logtool.reports import pages

    timed(pages, "write_pages", "pages")
    try:
        main()
    except SystemExit:
        pass
    finally:
        total = time.process_time() - began
        spent["start and others"] = total - sum(spent.values())
        print(json.dumps(dict(sorted(spent.items(), key=lambda part: -part[1]))), file=sys.stderr)


if __name__ == "__main__":
    _parts_of_a_run()
