"""``pdhef compile``: what a run uses is compiled now, so that no later one waits."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from pdhef_logtool.cli import console, options, panels

if TYPE_CHECKING:
    from pdhef_logtool.workers.supervisor import Tell

commands = typer.Typer()
#: Parts beside those of the estimators: a simulated drive, and a run of it with a car without data.
_SIMULATION, _UNKNOWN_CAR = "simulation", "unknown car"
_DRIVE = "banked-road"


@options.command(
    commands,
    "pdhef compile",
    "NUMBA_CACHE_DIR=/opt/pdhef pdhef compile",
    panel=panels.TOOLS,
    notes="Uses all processors. A second call compiles nothing.",
    name="compile",
)
def compile_(as_json: options.JsonFlag = False) -> None:
    """Compile the filters in advance, so that the first run starts at once."""
    import time

    from pdhef_logtool.compiled.sources import compiled_digest
    from pdhef_logtool.runs.compiling import all_parts, compile_parts

    began_s = time.perf_counter()
    compile_parts((_SIMULATION, *all_parts(), _UNKNOWN_CAR), _compile_part)
    facts = {"seconds": round(time.perf_counter() - began_s, 1), "compiled": compiled_digest()}
    if as_json:
        console.print_json(facts)
    else:
        console.say(f"everything that a run uses is compiled ({facts['seconds']:.0f} s, {facts['compiled']})")


def _compile_part(part: str, tell: Tell) -> None:
    from pathlib import Path
    from tempfile import TemporaryDirectory

    from pdhef_logtool.runs.compiling import compile_part
    from pdhef_logtool.runs.config import RunConfig
    from pdhef_logtool.runs.fleet import run_logs
    from truthsim.drive import simulate_drive, write_drive

    if part == _SIMULATION:
        simulate_drive(_DRIVE)
    elif part == _UNKNOWN_CAR:
        with TemporaryDirectory() as folder:
            log = Path(folder) / "drive.mcap"
            write_drive(simulate_drive(_DRIVE), log)
            run_logs([str(log)], Path(folder) / "out", RunConfig(friction="estimate", keep="metrics"), report=False)
    else:
        compile_part(part, tell)
