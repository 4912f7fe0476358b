"""``pdhef compile``: what a run uses is compiled now, so that no later one waits."""

from __future__ import annotations

import typer

from pdhef_logtool.cli import console, options

commands = typer.Typer()


@options.command(
    commands,
    "pdhef compile",
    "NUMBA_CACHE_DIR=/opt/pdhef pdhef compile",
    notes="The code is kept where the first run would keep it; a second call finds it and compiles nothing.",
    name="compile",
)
def compile_(as_json: options.JsonFlag = False) -> None:
    """Compile the filters now, so that no run waits. For installations."""
    import time
    from pathlib import Path
    from tempfile import TemporaryDirectory

    from pdhef_logtool.car.car import SHIPPED_CARS
    from pdhef_logtool.runs.config import RunConfig
    from pdhef_logtool.runs.fleet import run_logs
    from truthsim.drive import simulate_drive, write_drive

    began_s = time.perf_counter()
    (car,) = (Path(name) for name in SHIPPED_CARS)
    # Every estimator on a car that has all its parts, and a car of which nothing is known.
    configs = (
        RunConfig(estimators=("all",), car=car, keep="metrics"),
        RunConfig(friction="estimate", keep="metrics"),
    )
    with TemporaryDirectory() as folder, console.progress() as progress:
        log = Path(folder) / "drive.mcap"
        progress("compiling", 0.0)
        write_drive(simulate_drive("banked-road"), log)
        for number, config in enumerate(configs):
            progress("compiling", (1.0 + 2.0 * number) / 4.0)
            run_logs([str(log)], Path(folder) / f"out{number}", config, report=False)
    facts = {"seconds": round(time.perf_counter() - began_s, 1)}
    if as_json:
        console.print_json(facts)
    else:
        console.say(f"everything that a run uses is compiled ({facts['seconds']:.0f} s)")
