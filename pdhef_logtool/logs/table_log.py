"""A log of columns without messages, for formats of tables (CSV, MDF, MAT, ...)."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs.container import describe_damage
from pdhef_logtool.logs.drive_log import Columns, DriveLog, Requests, TopicInfo
from pdhef_logtool.logs.message_schema import FieldInfo, nearest
from pdhef_logtool.logs.recording_span import survey_stamps
from pdhef_logtool.logs.table_clocks import unlike_lengths
from pdhef_logtool.logs.table_file import LogFile
from pdhef_logtool.records.errors import LogError
from pdhef_logtool.records.signals import IntArray, Loss

if TYPE_CHECKING:
    from cantools.database.can import Database


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Columns that were recorded together, which become a topic.

    Attributes
    ----------
    name : of the topic. type_name : kind of source, if the file contains it.
    stamps_ns : int64 [N], log time, ascending; derived by the format.
    fields : columns with their kinds and units; elements of an array are ``name[0]``, ``name[1]``, ...
    load : returns rows of a column by its path: numbers [N], for kind ``time`` int64 nanoseconds [N]; for the path of
        an array as a whole [N, k].
    """

    name: str
    stamps_ns: IntArray
    fields: tuple[FieldInfo, ...]
    load: Callable[[str, slice], NDArray[Any]]
    type_name: str = ""

    @classmethod
    def of_arrays(
        cls,
        name: str,
        stamps_ns: IntArray,
        columns: Mapping[str, NDArray[Any]],
        units: Mapping[str, str] | None = None,
        type_name: str = "",
    ) -> "Table":
        """Return a table of numbers [N] that are in memory, with the unit of each column where one is known."""
        fields = tuple(FieldInfo(path, "number", unit=(units or {}).get(path, "")) for path in columns)
        return cls(name, stamps_ns, fields, lambda path, rows: columns[path][rows], type_name)


class TableLog(DriveLog):
    """Tables as a log. It has no messages to copy.

    Parameters
    ----------
    file : that the tables come from; it is released when the log is closed.
    kind : name of the format, for reports.
    tables : one per topic. lost : unreadable parts of the file.

    Raises
    ------
    LogError : stamps of a table step back, or two tables have one name.
    """

    def __init__(self, file: LogFile, kind: str, tables: Sequence[Table], lost: Sequence[Loss] = ()) -> None:
        self.path, self.kind = file.place, kind
        self._file = file
        self._tables = {table.name: table for table in sorted(tables, key=lambda table: table.name)}
        names = Counter(table.name for table in tables)
        wrong = [t.name for t in tables if names[t.name] > 1 or (t.stamps_ns[1:] < t.stamps_ns[:-1]).any()]
        if wrong:
            got = f"others: {', '.join(wrong)}"
            raise LogError(expected="tables of different names with ascending times", got=got, where=str(self.path))
        stamps = {name: table.stamps_ns for name, table in self._tables.items()}
        self.recording_span = survey_stamps(stamps, str(self.path))
        inside = {n: s[slice(*np.searchsorted(s, (self.start_ns, self.end_ns)))] for n, s in stamps.items()}
        cut = [Loss("truncated", file.cut, str(self.path))] if file.cut else []
        self._lost = [*lost, *cut, *unlike_lengths(inside, str(self.path)), *self.recording_span.losses]
        self._unreadable: set[tuple[str, str]] = set()
        self._column_losses: dict[tuple[str, str], list[Loss]] = {}
        files = file.path.rglob("*") if file.path.is_dir() else (file.path,)
        self.size = sum(path.stat().st_size for path in files)

    def decode_frames(self, databases: "Sequence[tuple[str, Database]]") -> None:
        """Add a table for each message of DBC files, given with their names, that raw CAN frames of the log contain."""
        from pdhef_logtool.logs.can_decoding import CAN_TYPE, Decoder, Frames

        for frames in [Frames.of_table(table) for table in self._tables.values() if table.type_name == CAN_TYPE]:
            decoder = Decoder(frames, databases, self._tables, self._lost, self._column_losses)
            for table in decoder.tables():
                self._tables[table.name] = table

    @property
    def tables(self) -> tuple[Table, ...]:
        """The tables by name."""
        return tuple(self._tables.values())

    @property
    def topics(self) -> tuple[TopicInfo, ...]:
        """A topic for each table."""
        return tuple(TopicInfo(t.name, t.type_name, self.kind, len(t.stamps_ns)) for t in self._tables.values())

    @property
    def lost(self) -> tuple[Loss, ...]:
        """Losses so far."""
        return tuple(self._lost)

    def fields(self, topic: str, *, quiet: bool = False) -> tuple[FieldInfo, ...]:
        """Return the columns of a table."""
        del quiet
        return self._tables[topic].fields if topic in self._tables else ()

    def read(
        self, requests: Requests, start_ns: int | None = None, end_ns: int | None = None, *, quiet: bool = False
    ) -> dict[str, Columns]:
        """Read columns; see :class:`~.drive_log.DriveLog`."""
        for topic, paths in requests.items():
            self._check(topic, paths)
        window = (self.start_ns if start_ns is None else start_ns, self.end_ns if end_ns is None else end_ns)
        with self._file.meter.running():
            return {topic: self._columns(self._tables[topic], its, window, quiet) for topic, its in requests.items()}

    def close(self) -> None:
        """Release the file."""
        self._file.release()

    def _check(self, topic: str, paths: Sequence[str]) -> None:
        if topic not in self._tables:
            raise nearest(topic, list(self._tables), "a topic of the log", self.path)
        names = [f.path for f in self._tables[topic].fields]
        for path in paths:
            if path not in names and not any(name.startswith(f"{path}[") for name in names):
                raise nearest(path, names, f"a field of {topic}", self.path)

    def _columns(self, table: Table, paths: Sequence[str], window: tuple[int, int], quiet: bool) -> Columns:
        times = table.stamps_ns
        spans = [(max(low, window[0]), min(high, window[1])) for low, high in self.recording_span.intervals]
        rows = [slice(*np.searchsorted(times, span).tolist()) for span in spans if span[0] < span[1]]
        stamps = np.concatenate([np.empty(0, np.int64), *(times[r] for r in rows)])
        columns = {p: self._column(table, p, rows, len(stamps), quiet) for p in dict.fromkeys(paths)}
        return Columns(table.name, stamps, stamps, columns)

    def _column(self, table: Table, path: str, rows: Sequence[slice], n: int, quiet: bool) -> NDArray[Any]:
        """Load rows of a column. Any error of the format is a loss of the column."""
        is_time = any(f.path == path and f.kind == "time" for f in table.fields)
        kind = np.dtype(np.int64 if is_time else np.float64)
        try:
            parts = [np.asarray(table.load(path, r)).astype(kind) for r in rows]
            values = np.concatenate(parts) if parts else np.empty(0, kind)
            if values.shape[0] != n:
                raise ValueError(f"{values.shape[0]} values for {n} times")
        except Exception as error:  # noqa: BLE001
            if not quiet and (table.name, path) not in self._unreadable:
                self._unreadable.add((table.name, path))
                self._lost.append(Loss("bad-column", f"{path} cannot be read: {describe_damage(error)[1]}", table.name))
            return np.zeros(n, kind) if is_time else np.full(n, np.nan)
        if not quiet:
            self._lost += self._column_losses.pop((table.name, path), ())
        return values
