"""``pdhef convert``: any log as an MCAP file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from pdhef_logtool.cli import console, options
from pdhef_logtool.records.errors import EXIT_OK, EXIT_PARTIAL

if TYPE_CHECKING:
    from pdhef_logtool.runs.config import RunConfig


@options.command()
def convert(log: str, *, config: RunConfig, output: Path = Path("drive.mcap")) -> None:
    """Convert a log of any format to MCAP."""
    from pdhef_logtool.logs.conversion import convert_log
    from pdhef_logtool.logs.discovery import one_place

    reading = config.read_options
    place = one_place(log, private_redirects=config.allow_private_redirects)
    lost, messages = convert_log(place, output, reading.limits, reading.msgs, reading.tables)
    for loss in lost:
        console.warn(f"{loss.where}: {loss.what}" + ("" if loss.count is None else f" ({loss.count} times)"))
    console.say(f"{messages} messages written to {output}")
    raise typer.Exit(EXIT_PARTIAL if any(loss.severity == "lost" for loss in lost) else EXIT_OK)
