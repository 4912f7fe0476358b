"""``pdhef inspect``, ``map`` and ``estimators``: what there is in a log, what it means, and what can be run on it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from pdhef_logtool.cli import console, options
from pdhef_logtool.records.errors import EXIT_OK, EXIT_PARTIAL, UsageError

if TYPE_CHECKING:
    from pdhef_logtool.runs.config import RunConfig

commands = typer.Typer()


@options.command(
    commands,
    "pdhef inspect drive.mcap",
    "pdhef inspect drive.bag --json | jq .signals",
    "pdhef inspect drive.mcap --write-mapping mapping.toml",
    "pdhef inspect drive.mcap --fields /imu/data",
    "pdhef inspect https://host/drive.mcap --all",
)
def inspect(
    log: options.Log,
    config: RunConfig,
    write_mapping: Annotated[Path | None, Option(help="Write a ready-to-edit mapping.toml (never overwrites).")] = None,
    fields: Annotated[bool, Option("--fields", help="Instead: every number of TOPIC, or of all topics.")] = False,
    topic: Annotated[str | None, Argument(metavar="[TOPIC]", help="Topic of --fields.", show_default=False)] = None,
    whole: Annotated[bool, Option("--all", help="Read all of a large log, and find damage within its chunks.")] = False,
    as_json: options.JsonFlag = False,
) -> None:
    """Show what a log holds and what maps to what. Rates, gaps and jitter are shown too, and what is missing.

    Of a long MCAP above 32 MB whose index is sound a part of the chunks is read, and how many is said.
    """
    from pdhef_logtool.inspection import fields_of_log, inspect_log, render_fields, render_inspection
    from pdhef_logtool.inspection import write_mapping as write_mapping_file
    from pdhef_logtool.logs.discovery import one_place

    reading = config.read_options
    if topic is not None and not fields:
        raise UsageError(expected="one log", got=f"{log} and {topic}", where="LOG", remedy="a topic goes with --fields")
    place = one_place(log, private_redirects=config.allow_private_redirects)
    if fields:
        found = fields_of_log(place, topic, budget=reading.limits, msgs=reading.msgs)
        console.finish(found, render_fields, as_json, exit_code=EXIT_OK)
    inspection = inspect_log(
        place,
        config.mapping,
        prefer_truth=reading.prefer_truth,
        budget=reading.limits,
        msgs=reading.msgs,
        whole=whole,
    )
    if write_mapping is not None:
        write_mapping_file(inspection, write_mapping)
        console.say(f"mapping written to {write_mapping}")
    lost = any(loss.severity == "lost" for loss in inspection.lost)
    console.finish(inspection, render_inspection, as_json, exit_code=EXIT_PARTIAL if lost else EXIT_OK)


@options.command(
    commands, "pdhef map drive.mcap -o mapping.toml", "pdhef run drive.mcap --mapping mapping.toml", name="map"
)
def map_(
    log: options.Log,
    config: RunConfig,
    output: Annotated[Path, Option("--output", "-o", help="File to write (never overwrites).")] = Path("mapping.toml"),
) -> None:
    """Write a log's mapping by question and answer. Without a terminal it holds what was found, and all candidates."""
    import sys

    from pdhef_logtool.inspection import ask_mapping, inspect_log, write_mapping
    from pdhef_logtool.logs.discovery import one_place

    reading = config.read_options
    place = one_place(log, private_redirects=config.allow_private_redirects)
    inspection = inspect_log(
        place,
        config.mapping,
        prefer_truth=reading.prefer_truth,
        budget=reading.limits,
        msgs=reading.msgs,
    )
    if sys.stdin.isatty() and sys.stderr.isatty():
        answers = ask_mapping(inspection, _ask, console.say)
        inspection = replace(inspection, mapping=answers)
    write_mapping(inspection, output)
    console.say(f"mapping written to {output}")


def _ask(question: str) -> str:
    """Ask on stderr and return the line that is typed."""
    return str(typer.prompt(question, default="", show_default=False, prompt_suffix="", err=True))


@options.command(commands)
def estimators(as_json: options.JsonFlag = False) -> None:
    """List the estimators that run can use."""
    from pdhef_logtool.estimators.table import all_specs

    if as_json:
        console.print_json({"estimators": [{"name": s.name, "description": s.text} for s in all_specs()]})
        return
    table = console.table("name", "what it is")
    for spec in all_specs():
        table.add_row(spec.name, spec.text)
    console.stdout().print(table)
