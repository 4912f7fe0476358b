"""``pdhef inspect`` and ``pdhef estimators``: what there is in a log, and what can be run on it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Option

from pdhef_logtool.cli import console, options
from pdhef_logtool.records.errors import EXIT_OK, EXIT_PARTIAL

if TYPE_CHECKING:
    from pdhef_logtool.runs.config import RunConfig

commands = typer.Typer()


@options.command(
    commands,
    "pdhef inspect drive.mcap",
    "pdhef inspect drive.bag --json | jq .signals",
    "pdhef inspect drive.mcap --write-mapping mapping.toml",
)
def inspect(
    log: options.Log,
    config: RunConfig,
    write_mapping: Annotated[Path | None, Option(help="Write a ready-to-edit mapping.toml (never overwrites).")] = None,
    as_json: options.JsonFlag = False,
) -> None:
    """Show what a log holds and what maps to what. Rates, gaps and jitter are shown too, and what is missing."""
    from pdhef_logtool.inspection import inspect_log, render_inspection
    from pdhef_logtool.inspection import write_mapping as write_mapping_file
    from pdhef_logtool.mapping import load_mapping

    chosen = None if config.mapping is None else load_mapping(config.mapping)
    reading = config.read_options
    inspection = inspect_log(Path(log), chosen, prefer_truth=reading.prefer_truth, budget=reading.limits)
    if write_mapping is not None:
        write_mapping_file(inspection, write_mapping)
        console.say(f"mapping written to {write_mapping}")
    lost = any(loss.severity == "lost" for loss in inspection.lost)
    console.finish(inspection, render_inspection, as_json, exit_code=EXIT_PARTIAL if lost else EXIT_OK)


@options.command(commands)
def estimators(as_json: options.JsonFlag = False) -> None:
    """List the estimators that run can use."""
    from pdhef_logtool.estimators.table import SPECS

    if as_json:
        console.print_json({"estimators": [{"name": s.name, "description": s.text} for s in SPECS]})
        return
    table = console.table("name", "what it is")
    for spec in SPECS:
        table.add_row(spec.name, spec.text)
    console.stdout().print(table)
