"""A file that is opened as a log; argument and result of a reader of tables.

A reader of a table format (CSV, Parquet, MAT, MDF, BLF, ...) is a function ``TableFile -> Tables``. It runs in a
separate process (:mod:`~pdhef_logtool.logs.reader_process`), which has an open file and limits, and no path.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Literal

from pdhef_logtool.logs.remote_place import LogPlace
from pdhef_logtool.logs.resource_limits import Meter, ResourceLimits
from pdhef_logtool.records.errors import LogError
from pdhef_logtool.records.signals import Loss

if TYPE_CHECKING:
    from pdhef_logtool.logs.table_log import Table


@dataclass(frozen=True, slots=True)
class TableSettings:
    """Settings of the user for a log of tables.

    Attributes
    ----------
    rate_hz : rows per second of a table without times, or with times without a unit.
    group : run to read: the beginning or the end of the names of its tables; empty: all tables.
    folder : whether a folder of CSV files is one ``recording`` or several ``drives``; ``auto``: by their contents.
    """

    rate_hz: float | None = None
    group: str = ""
    folder: Literal["auto", "recording", "drives"] = "auto"


NO_SETTINGS = TableSettings()
#: Of a number in a column.
NUMBER_BYTES = 8


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


@dataclass(frozen=True, slots=True, eq=False)
class TableFile:
    """An open file.

    Attributes
    ----------
    stream : read-only, seekable, at its start. size : bytes of the file.
    name : as the user named the file, for messages.
    limits : resource limits of reading. settings : of the user.
    """

    stream: BinaryIO
    size: int
    name: str
    limits: ResourceLimits
    settings: TableSettings = NO_SETTINGS

    def check(self, size: int, where: str = "") -> None:
        """Raise LimitError if the file may not become, or claim to become, tables of ``size`` bytes."""
        self.limits.check_table(size, self.size, where or self.name)


def left_out(what: str, names: Sequence[str], where: str) -> list[Loss]:
    """Return the note on parts of a file without numbers; none without names."""
    text = f"{what} are left out: {', '.join(names)}"
    return [Loss("no-numbers", text, where, count=len(names), severity="note")] if names else []


@dataclass(frozen=True, slots=True, eq=False)
class Tables:
    """Contents of a file: its kind for reports (``csv``, ``mdf-4``, ...), its tables, and its losses."""

    kind: str
    tables: "Sequence[Table]"
    losses: Sequence[Loss] = field(default=())

    def of_group(self, group: str, where: str) -> "Tables":
        """Return the tables of a group; raises LogError without any."""
        names = [table.name for table in self.tables]
        its = [
            t for t in self.tables if t.name == group or t.name.startswith(f"{group}_") or t.name.endswith(f"_{group}")
        ]
        if group == "1":  # of repeated names, the first has no number
            its = its or [t for t in self.tables if not re.search(r"_\d+$", t.name)]
        if not its:
            raise LogError(
                expected=f"tables of the group {group}", got=", ".join(names), where=where, remedy="correct group"
            )
        return Tables(self.kind, its, self.losses)
