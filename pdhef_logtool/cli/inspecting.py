"""``pdhef inspect`` and ``map``: the contents of a log and their mapping to signals."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from pdhef_logtool.cli import console, options
from pdhef_logtool.records.errors import UsageError

if TYPE_CHECKING:
    from rich.console import Console

    from pdhef_logtool.logs.drive_log import DriveLog
    from pdhef_logtool.logs.remote_place import LogPlace
    from pdhef_logtool.runs.config import RunConfig
    from pdhef_logtool.runs.inspection.report import Inspection

#: Columns of the kind of a finding.
_HEAD_WIDTH = 9


@options.command()
def inspect(
    log: str,
    topic: str | None = None,
    *,
    config: "RunConfig",
    write_mapping: Path | None = None,
    report: Path | None = None,
    fields: bool = False,
    whole: bool = False,
) -> None:
    """Show topics, rates, gaps and clocks of a log, and how its fields map to signals.

    Of an MCAP file above 32 MB with an intact index, only a part of the chunks is read; the output states how many.
    """
    from pdhef_logtool.runs.inspection.report import write_mapping as write_mapping_file

    if topic is not None and not fields:
        raise UsageError(expected="one log", got=f"{log} and {topic}", where="LOG", remedy="a topic needs --fields")
    if fields and (report or write_mapping) is not None:
        raise UsageError(expected="--fields alone", got="--report or --write-mapping as well", where="--fields")
    if fields:
        from pdhef_logtool.runs.inspection.fields import fields_of_log

        topic_fields = fields_of_log(_place(log, config), topic, config.read_options)
        console.finish(topic_fields, "fields")

    def write_files(inspection: "Inspection", open_log: "DriveLog") -> None:
        if write_mapping is not None:
            write_mapping_file(inspection, write_mapping)
            console.say(f"mapping written to {write_mapping}")
        if report is not None:
            from pdhef_logtool.runs.inspection.page import write_page

            write_page(inspection, open_log, report)
            console.say(f"page written to {report}")

    inspection = _inspect(log, config, whole=whole, then=write_files)
    console.finish(inspection, render_inspection)


def render_inspection(inspection: "Inspection", out: "Console") -> None:
    """Print an inspection: its tables, then its findings."""
    from rich.table import Table
    from rich.text import Text

    from pdhef_logtool.cli.printing import print_template
    from pdhef_logtool.records.signals import SIGNAL_UNITS, TRUTH_UNITS
    from pdhef_logtool.runs.inspection.report import findings_of

    names = list(dict.fromkeys((*SIGNAL_UNITS, *TRUTH_UNITS)))
    print_template("inspection", out, r=inspection, names=names, short=_short)
    for head, style, text in findings_of(inspection):
        line = Table.grid(padding=(0, 1))
        line.add_column(width=_HEAD_WIDTH)
        line.add_column(overflow="fold")
        line.add_row(Text(head, style), Text(text))
        out.print(line)


def _short(field: str) -> str:
    """Write several fields of one struct as ``struct.{w,x,y,z}``."""
    stems, _, leaves = zip(*(path.rpartition(".") for path in field.split(", ")), strict=True)
    return f"{stems[0]}.{{{','.join(leaves)}}}" if len(leaves) > 1 and stems[0] and len(set(stems)) == 1 else field


@options.command()
def map_(log: str, *, config: "RunConfig", output: Path = Path("mapping.toml")) -> None:
    """Build a mapping file interactively.

    Without a terminal, the file contains the recognised signals, and all candidates as comments.
    """
    import sys

    from pdhef_logtool.runs.inspection import asking, report

    inspection = _inspect(log, config)
    if sys.stdin.isatty() and sys.stderr.isatty():
        answers = asking.ask_mapping(inspection, _ask, console.say)
        inspection = replace(inspection, mapping=answers)
    report.write_mapping(inspection, output)
    console.say(f"mapping written to {output}")


def _place(log: str, config: "RunConfig") -> "LogPlace":
    """Return the place of the log of an argument."""
    from pdhef_logtool.logs.discovery import one_place

    return one_place(log, private_redirects=config.allow_private_redirects)


def _inspect(log: str, config: "RunConfig", **given: Any) -> "Inspection":
    """Inspect the log of an argument as configured."""
    from pdhef_logtool.runs.inspection.report import inspect_log

    return inspect_log(_place(log, config), config.mapping, config.read_options, **given)


def _ask(question: str) -> str:
    """Ask on stderr and return the line from stdin."""
    return str(typer.prompt(question, default="", show_default=False, prompt_suffix="", err=True))
