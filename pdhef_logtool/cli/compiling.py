"""``pdhef compile``: compile the code of runs in advance."""

from __future__ import annotations

import typer

from pdhef_logtool.cli import console, options

commands = typer.Typer()


@options.command(commands, name="compile")
def compile_() -> None:
    """Compile the filters in advance, so that the first run starts at once."""
    import time
    from pathlib import Path
    from tempfile import TemporaryDirectory

    from pdhef_logtool.compiled.sources import compiled_digest
    from pdhef_logtool.estimators.table import ALL_ESTIMATORS
    from pdhef_logtool.runs.config import RunConfig
    from pdhef_logtool.runs.fleet import run_logs
    from truthsim.drive import simulate_drive, write_drive

    began_s = time.perf_counter()
    saloon = RunConfig(car=Path("saloon"), estimators=(ALL_ESTIMATORS,), keep="metrics", reference="on")
    sedan = RunConfig(keep="metrics")
    with TemporaryDirectory() as folder:
        log = Path(folder) / "drive.mcap"
        write_drive(simulate_drive("banked-road"), log)
        for config in (saloon, sedan):
            run_logs([str(log)], Path(folder) / "out", config, report=False)
    seconds = time.perf_counter() - began_s
    console.say(f"all code of runs is compiled ({seconds:.0f} s, {compiled_digest()})")
