"""``pdhef inspect`` and ``map``: the contents of a log and their mapping to signals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from pdhef_logtool.cli import console, options
from pdhef_logtool.records.errors import EXIT_OK, EXIT_PARTIAL, UsageError

if TYPE_CHECKING:
    from pdhef_logtool.logs.drive_log import DriveLog
    from pdhef_logtool.logs.remote_place import LogPlace
    from pdhef_logtool.runs.config import RunConfig
    from pdhef_logtool.runs.inspection.report import Inspection


@options.command()
def inspect(
    log: str,
    topic: str | None = None,
    *,
    config: RunConfig,
    write_mapping: Path | None = None,
    report: Path | None = None,
    fields: bool = False,
    whole: bool = False,
) -> None:
    """Show topics, rates, gaps and clocks of a log, and how its fields map to signals.

    Of an MCAP file above 32 MB with an intact index, only a part of the chunks is read; the output states how many.
    """
    from pdhef_logtool.runs.inspection import fields_of_log, render_fields, render_inspection
    from pdhef_logtool.runs.inspection import write_mapping as write_mapping_file

    if topic is not None and not fields:
        raise UsageError(expected="one log", got=f"{log} and {topic}", where="LOG", remedy="a topic needs --fields")
    if fields and (report or write_mapping) is not None:
        raise UsageError(expected="--fields alone", got="--report or --write-mapping as well", where="--fields")
    if fields:
        topic_fields = fields_of_log(_place(log, config), topic, config.read_options)
        console.finish(topic_fields, render_fields, exit_code=EXIT_OK)

    def write_files(inspection: Inspection, open_log: DriveLog) -> None:
        if write_mapping is not None:
            write_mapping_file(inspection, write_mapping)
            console.say(f"mapping written to {write_mapping}")
        if report is not None:
            from pdhef_logtool.runs.inspection.page import write_page

            write_page(inspection, open_log, report)
            console.say(f"page written to {report}")

    inspection = _inspect(log, config, whole=whole, then=write_files)
    exit_code = EXIT_PARTIAL if inspection.is_partial else EXIT_OK
    console.finish(inspection, render_inspection, exit_code=exit_code)


@options.command()
def map_(log: str, *, config: RunConfig, output: Path = Path("mapping.toml")) -> None:
    """Build a mapping file interactively.

    Without a terminal, the file contains the recognised signals, and all candidates as comments.
    """
    import sys

    from pdhef_logtool.runs.inspection import ask_mapping, write_mapping

    inspection = _inspect(log, config)
    if sys.stdin.isatty() and sys.stderr.isatty():
        answers = ask_mapping(inspection, _ask, console.say)
        inspection = replace(inspection, mapping=answers)
    write_mapping(inspection, output)
    console.say(f"mapping written to {output}")


def _place(log: str, config: RunConfig) -> LogPlace:
    """Return the place of the log of an argument."""
    from pdhef_logtool.logs.discovery import one_place

    return one_place(log, private_redirects=config.allow_private_redirects)


def _inspect(log: str, config: RunConfig, **given: Any) -> Inspection:
    """Inspect the log of an argument as configured."""
    from pdhef_logtool.runs.inspection import inspect_log

    return inspect_log(_place(log, config), config.mapping, config.read_options, **given)


def _ask(question: str) -> str:
    """Ask on stderr and return the line from stdin."""
    return str(typer.prompt(question, default="", show_default=False, prompt_suffix="", err=True))
