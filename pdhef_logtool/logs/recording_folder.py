"""A folder of CSV files of one recording, as telephones write them: a file for each sensor.

The files are one recording if their times overlap and their columns differ; otherwise each file is a drive.
"""

from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path

from pdhef_logtool.logs.constants import CONSTANTS
from pdhef_logtool.logs.formats import HEAD_BYTES, recognised_format
from pdhef_logtool.logs.reader_process import log_of_tables
from pdhef_logtool.logs.resource_limits import KIB, Meter
from pdhef_logtool.logs.table_columns import field_name, unique
from pdhef_logtool.logs.table_file import LogFile, Tables, TableSettings
from pdhef_logtool.logs.table_log import Table, TableLog
from pdhef_logtool.records.errors import LogError
from pdhef_logtool.records.signals import Loss, is_dated

_FOLDER = CONSTANTS["folder"]


def is_recording(folder: Path, names: Collection[str], settings: TableSettings) -> bool:
    """Return whether the logs of these names in a folder are one recording."""
    file = LogFile(folder, folder, Meter(), settings=settings)
    log = open_recording(file, [folder / name for name in sorted(names)])
    if log is not None:
        log.close()
    return log is not None


def open_recording(file: LogFile, paths: Sequence[Path]) -> TableLog | None:
    """Return the tables of several files as one log; None if the files are drives."""
    is_stated = file.settings.folder == "recording"
    if len(paths) < 2 or file.settings.folder == "drives" or not (is_stated or _may_be_recording(paths)):
        return None
    opened: dict[Path, TableLog] = {}
    what = f"read as one recording; --set folder=drives reads each of {len(paths)} files as a drive"
    lost = [Loss("folder", what, str(file.place), severity="note")]
    with ExitStack() as stack:
        for path in paths:
            try:
                opened[path] = stack.enter_context(closing(_open_file(file, path)))
            except LogError as error:
                lost.append(_unread(path, error))
                continue
            if not (is_stated or _overlap([*opened.values()])):
                return None
        columns = {frozenset(f.path for t in log.tables for f in t.fields) for log in opened.values()}
        if len(columns) < 2 - is_stated:
            return None
        lost += (loss for log in opened.values() for loss in log.lost)
        return log_of_tables(file, Tables("csv", _named_tables(opened), lost), stack.pop_all().close)


def _named_tables(logs: Mapping[Path, TableLog]) -> list[Table]:
    """Return the tables of files, with the names of the files."""
    tables = [(path, log.kind, table) for path, log in logs.items() for table in log.tables]
    names = unique(f"{field_name(path.stem)}{table.name.removeprefix(kind)}" for path, kind, table in tables)
    return [replace(table, name=name) for name, (_, _, table) in zip(names, tables, strict=True)]


def _may_be_recording(paths: Sequence[Path]) -> bool:
    """Return whether files may be one recording by their names and titles."""
    if len(paths) > _FOLDER["most_files"] or not all(path.name.lower().endswith((".csv", ".tsv")) for path in paths):
        return False
    titles = set()
    for path in paths:
        with path.open("rb") as file:
            titles.add(file.readline(64 * KIB).strip())
    return len(titles) > 1


def _open_file(file: LogFile, path: Path) -> TableLog:
    with path.open("rb") as stream:
        log_format = recognised_format(stream.read(HEAD_BYTES), path.name)
    if log_format is None or log_format.libraries is None:
        raise LogError(expected="a file of tables", got="another file", where=str(path))
    opened = log_format.open(LogFile(path, path, file.meter, settings=replace(file.settings, group="")))
    assert isinstance(opened, TableLog)
    return opened


def _unread(path: Path, error: LogError) -> Loss:
    """Return the loss of a file; one without rows, such as a description of the recorder, is a note."""
    with path.open("rb") as file:
        few = sum(1 for _ in zip(file, range(3), strict=False)) < 3
    what = f"expected {error.expected}, got {error.got}"
    return Loss("bad-file", what, str(path), severity="note" if few else "lost")


def _overlap(logs: Sequence[TableLog]) -> bool:
    """Return whether most of the times of logs are common to all; logs of a few rows do not count."""
    long = [log for log in logs if max(len(table.stamps_ns) for table in log.tables) >= _FOLDER["few_rows"]]
    starts, ends = [log.start_ns for log in long], [log.end_ns for log in long]
    dated = {is_dated(start) for start in starts}
    if len(long) < 2 or len(dated) > 1:
        return len(long) < 2
    return bool(min(ends) - max(starts) >= _FOLDER["common"][all(dated)] * (max(ends) - min(starts)))
