"""A file that is opened as a log."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pdhef_logtool.logs.remote_place import LogPlace
from pdhef_logtool.logs.resource_limits import Meter
from pdhef_logtool.logs.table_file import NO_SETTINGS, TableSettings


@dataclass(frozen=True, slots=True)
class LogFile:
    """A file to open.

    Attributes
    ----------
    path : on this machine. place : as the user named it; ``path`` may be a decompressed or downloaded copy.
    meter : counts the cost of reading. release : to be called when the log is closed; removes a copy.
    cut : why a copy does not have all of the file; empty where it does. settings : of tables.
    """

    path: Path
    place: LogPlace
    meter: Meter
    release: Callable[[], None] = lambda: None
    cut: str = ""
    settings: TableSettings = NO_SETTINGS
