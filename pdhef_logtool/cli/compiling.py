"""``pdhef compile``: what a run uses is compiled now, so that no later one waits."""

from __future__ import annotations

import typer

from pdhef_logtool.cli import console, options

commands = typer.Typer()


@options.command(
    commands,
    "pdhef compile",
    "NUMBA_CACHE_DIR=/opt/pdhef pdhef compile",
    notes="Uses all processors. The code is kept where the first run would keep it; a second call compiles nothing.",
    name="compile",
)
def compile_(as_json: options.JsonFlag = False) -> None:
    """Compile the filters now, so that no run waits. For installations."""
    import time

    from pdhef_logtool.records.compiled_sources import compiled_digest
    from pdhef_logtool.runs.compiling import compile_all

    began_s = time.perf_counter()
    compile_all()
    facts = {"seconds": round(time.perf_counter() - began_s, 1), "compiled": compiled_digest()}
    if as_json:
        console.print_json(facts)
    else:
        console.say(f"everything that a run uses is compiled ({facts['seconds']:.0f} s, {facts['compiled']})")
