"""A folder of CSV files of one recording, as telephones write them: a file for each sensor.

The files are one recording if their times overlap and their columns differ; otherwise each file is a drive.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path

from pdhef_logtool.logs.constants import CONSTANTS
from pdhef_logtool.logs.formats import HEAD_BYTES, recognised_format
from pdhef_logtool.logs.log_file import LogFile
from pdhef_logtool.logs.reader_process import log_of_tables
from pdhef_logtool.logs.resource_limits import Meter
from pdhef_logtool.logs.table_columns import field_name, unique
from pdhef_logtool.logs.table_file import Tables, TableSettings
from pdhef_logtool.logs.table_log import TableLog
from pdhef_logtool.records.errors import LogError
from pdhef_logtool.records.signals import Loss

_SUFFIXES = (".csv", ".tsv")
_MOST_FILES = 64
#: Share of the common times in all times: of dates, and of times since a start, which overlap by chance.
_COMMON_OF_DATES, _COMMON_SINCE_START = 0.5, 0.9
#: Files with fewer rows show no overlap.
_FEW_ROWS = 10


def may_be_recording(folder: Path, names: Collection[str], settings: TableSettings) -> bool:
    """Return whether the logs of these names in a folder may be one recording, by their names and titles."""
    if settings.folder == "drives" or len(names) < 2:
        return False
    if settings.folder == "recording":
        return True
    paths = [folder / name for name in sorted(names)]
    are_tables = len(paths) <= _MOST_FILES and all(name.lower().endswith(_SUFFIXES) for name in names)
    return are_tables and len(set(map(_first_line, paths))) > 1


def is_recording(folder: Path, names: Collection[str], settings: TableSettings) -> bool:
    """Return whether the logs of these names in a folder are one recording; their times are read."""
    if not may_be_recording(folder, names, settings) or settings.folder == "recording":
        return settings.folder == "recording" and len(names) > 1
    file = LogFile(folder, folder, Meter(), settings=settings)
    opened = open_recording(file, [folder / name for name in sorted(names)])
    if opened is not None:
        opened.close()
    return opened is not None


def open_recording(file: LogFile, paths: Sequence[Path]) -> TableLog | None:
    """Return the tables of several files as one log; None if the files are drives.

    Raises
    ------
    LogError : a setting states that the files are a recording, and none of them can be read as a table.
    """
    opened: dict[Path, TableLog] = {}
    lost: list[Loss] = []
    with ExitStack() as stack:
        for path in paths:
            try:
                opened[path] = stack.enter_context(closing(_open_file(file, path)))
            except LogError as error:
                lost.append(_unread(path, error))
                continue
            if file.settings.folder == "auto" and not _overlap([*opened.values()]):
                return None
        if not opened:
            raise LogError(expected="files of tables", got=lost[0].what, where=str(file.place))
        columns = {frozenset(f.path for t in log.tables for f in t.fields) for log in opened.values()}
        if file.settings.folder == "auto" and len(columns) < 2:
            return None
        what = f"{len(opened)} files are read as one recording; --set folder=drives reads each as a drive"
        lost += [
            Loss("folder", what, str(file.place), severity="note"),
            *(x for log in opened.values() for x in log.lost),
        ]
        names = unique(_name(path, log, table.name) for path, log in opened.items() for table in log.tables)
        tables = [table for log in opened.values() for table in log.tables]
        named = [replace(table, name=name) for name, table in zip(names, tables, strict=True)]
        return log_of_tables(file, Tables("csv", named, lost), stack.pop_all().close)


def _first_line(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.readline(1 << 16).strip()


def _open_file(file: LogFile, path: Path) -> TableLog:
    with path.open("rb") as stream:
        log_format = recognised_format(stream.read(HEAD_BYTES), path.name)
    settings = replace(file.settings, group="")
    log = None if log_format is None else log_format.open(LogFile(path, path, file.meter, settings=settings))
    if not isinstance(log, TableLog):
        if log is not None:
            log.close()
        raise LogError(expected="a file of tables", got="a file of messages", where=str(path))
    return log


def _unread(path: Path, error: LogError) -> Loss:
    """Return the loss of a file; one without rows, such as a description of the recorder, is a note."""
    with path.open("rb") as file:
        few = sum(1 for _ in zip(file, range(3), strict=False)) < 3
    what = f"expected {error.expected}, got {error.got}"
    return Loss("bad-file", what, str(path), severity="note" if few else "lost")


def _name(path: Path, log: TableLog, table: str) -> str:
    return f"{field_name(path.name.partition('.')[0])}{table.removeprefix(log.kind)}"


def _overlap(logs: Sequence[TableLog]) -> bool:
    """Return whether most of the times of logs are common to all."""
    long = [log for log in logs if max(len(table.stamps_ns) for table in log.tables) >= _FEW_ROWS]
    if len(long) < 2:
        return True
    starts, ends = [log.start_ns for log in long], [log.end_ns for log in long]
    dated = {start >= CONSTANTS["clocks"]["first_date_ns"] for start in starts}
    least = _COMMON_OF_DATES if dated == {True} else _COMMON_SINCE_START
    return len(dated) == 1 and min(ends) - max(starts) >= least * (max(ends) - min(starts))
