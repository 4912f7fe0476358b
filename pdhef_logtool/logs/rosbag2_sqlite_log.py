"""rosbag2 SQLite databases as a container: opened immutable, pages of rows as spans; no file is written beside it."""

import shutil
import sqlite3
from array import array
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote

import numpy as np

from pdhef_logtool.logs import container
from pdhef_logtool.logs.byte_source import require_regular
from pdhef_logtool.logs.resource_limits import MIB, LimitError
from pdhef_logtool.logs.table_file import LogFile
from pdhef_logtool.storage.files import scratch_folder

_PAGE_ROWS = 8192
_PAGE_BYTES = 4 * MIB
_STEPS_A_CHECK = 100_000  # instructions of SQLite between checks of the time


class SqliteContainer(container.Container):
    """One rosbag2 database, its topics as channels and pages of rows, in order of their ids, as spans.

    A database with a write-ahead log beside it is copied to a temporary folder first, as SQLite would write to it.

    Raises
    ------
    LogError : no SQLite file, or one without rosbag2's tables.
    """

    kind = "rosbag2-sqlite3"
    selective = True  # rows of other topics are not read
    remedy = "is it a rosbag2 recording?"

    def __init__(self, file: LogFile) -> None:
        require_regular(file.path, file.place)
        super().__init__(file, file.path.stat().st_size)
        self._pages: list[tuple[int, int]] = []  # first and last row id
        self._ends: list[int] = []  # bytes of the rows up to the end of each page
        self._late: LimitError | None = None
        self._db = self._connect(file.path)
        self.on_close(self._db.close)
        try:
            self._db.text_factory = lambda stored: stored.decode("utf-8", errors="replace")  # also of a damaged one
            self._db.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(self.meter.limits.chunk_bytes, np.iinfo(np.int32).max))
            self._db.set_progress_handler(self._out_of_time, _STEPS_A_CHECK)
            for pragma in ("trusted_schema = OFF", "mmap_size = 0", "cell_size_check = ON"):
                self._db.execute(f"PRAGMA {pragma}")
            with self.meter.running(self.size):
                self._read_topics()
                self._read_pages()
        except (sqlite3.Error, ValueError, TypeError, OverflowError) as error:
            self.close()
            raise self.no_log("a readable rosbag2 database", str(self._late or error)) from error
        except BaseException:
            self.close()
            raise

    def _out_of_time(self) -> bool:
        """Stop SQLite: a query over a hostile database need not end."""
        try:
            self.meter.check()
        except LimitError as error:
            self._late = error
            return True
        return False

    def _connect(self, path: Path) -> sqlite3.Connection:
        wal = path.with_name(path.name + "-wal")
        if wal.is_file() and wal.stat().st_size > 0:
            folder = scratch_folder()
            self.on_close(folder.cleanup)
            copy = Path(folder.name) / path.name
            shutil.copyfile(path, copy)
            shutil.copyfile(wal, copy.with_name(wal.name))
            return sqlite3.connect(f"file:{quote(str(copy))}", uri=True, check_same_thread=False)
        uri = f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1"
        return sqlite3.connect(uri, uri=True, check_same_thread=False)

    def _columns_of(self, table: str) -> set[str]:
        return {str(row[0]) for row in self._db.execute("SELECT name FROM pragma_table_info(?)", (table,))}

    def _read_topics(self) -> None:
        tables = {str(row[0]) for row in self._db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        needed = {"topics": {"id", "name", "type", "serialization_format"}}
        needed["messages"] = {"id", "topic_id", "timestamp", "data"}
        # Only tables, because a view can be a program that never ends.
        if not needed.keys() <= tables or any(not names <= self._columns_of(table) for table, names in needed.items()):
            raise self.no_log("rosbag2's tables 'topics' and 'messages'", "a database without them")
        topic_columns = self._columns_of("topics")
        if "ros_distro" in self._columns_of("schema"):
            row = self._db.execute("SELECT ros_distro FROM schema").fetchone()
            self.distro = str(row[0]) if row and row[0] else ""
        definitions: dict[str, tuple[str, str]] = {}
        if {"topic_type", "encoding", "encoded_message_definition"} <= self._columns_of("message_definitions"):
            query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            definitions = {str(t): (str(e), str(d)) for t, e, d in self._db.execute(query)}
        extra = [c for c in ("offered_qos_profiles", "type_description_hash") if c in topic_columns]
        query = f"SELECT {', '.join(['id', 'name', 'type', 'serialization_format', *extra])} FROM topics ORDER BY id"  # noqa: S608
        for id_, name, type_name, encoding, *rest in self._db.execute(query):
            self.meter.limits.check("channels", len(self.channels) + 1, f"topic {id_}")
            schema_encoding, text = definitions.get(type_name, ("", ""))
            self.channels[int(id_)] = container.ChannelRecord(
                id=int(id_),
                topic=str(name),
                encoding=str(encoding),
                schema_name=str(type_name),
                schema_encoding=schema_encoding if text else "",
                schema_data=text.encode(),
                metadata={key: str(value) for key, value in zip(extra, rest, strict=True) if value},
            )

    def _read_pages(self) -> None:
        rows = self._db.execute("SELECT id, topic_id, timestamp, length(data), typeof(data) FROM messages ORDER BY id")
        listed = array("q")
        row_count = last = 0
        try:
            for id_, topic, timestamp, length, kind in rows:
                row_count += 1
                if topic in self.channels and isinstance(id_, int) and isinstance(timestamp, int) and kind == "blob":
                    listed.extend((id_, topic, min(timestamp, container.MAX_TIME_NS), length))
                    last = id_
        except sqlite3.Error as error:
            what = f"the rows after id {last} cannot be read: {container.describe_damage(self._late or error)[1]}"
            self.lose("over-budget" if self._late else "truncated", what, listed[-2] + 1 if listed else None)
        ids, topics, times, lengths = np.frombuffer(listed, np.int64).reshape(-1, 4).T
        ends = np.cumsum(lengths)
        page = ends // _PAGE_BYTES + np.arange(len(ids)) // _PAGE_ROWS
        for part in np.split(np.arange(len(ids)), np.flatnonzero(np.diff(page)) + 1) if len(ids) else ():
            stamps = ((id_, times[part][its]) for id_, its in container.rows_by_channel(topics[part]).items())
            self.spans.append(replace(container.Span.of(stamps), index=len(self.spans)))
            self._pages.append((int(ids[part[0]]), int(ids[part[-1]])))
            self._ends.append(int(ends[part[-1]]))
        if unknown := row_count - len(ids):
            what = f"{unknown} messages of topics that the database does not name, or without a time or data"
            self.lose("unknown-channel", what, count=unknown)
        if not self.lost:
            self._check_indexes(row_count)

    def _check_indexes(self, row_count: int) -> None:
        """Compare the rows that were read with the indexes of the table: a damaged page can hide rows."""
        names = [str(row[0]) for row in self._db.execute("SELECT name FROM pragma_index_list('messages')")]
        counts = [0]
        try:
            for name in names:
                quoted = name.replace('"', '""')
                query = f'SELECT COUNT(*) FROM messages INDEXED BY "{quoted}"'  # noqa: S608 (quoted)
                counts.append(int(self._db.execute(query).fetchone()[0]))
        except sqlite3.Error as error:
            if self._late:
                raise
            self.lose("bad-index", f"the index of the messages cannot be read: {error}")
        missing = max(counts) - row_count
        if missing > 0:
            what = f"the index of the messages names {max(counts)} rows, {row_count} of them are there"
            self.lose("missing-messages", what, count=missing)

    def extent(self, span: container.Span) -> tuple[int, int]:
        """Return the bytes of the page's rows, as if the data of all rows lay one behind the other."""
        return (self._ends[span.index - 1] if span.index else 0), self._ends[span.index]

    def load(self, span: container.Span, want: frozenset[int] | None = None) -> container.Block:
        """Read one page; see :class:`~pdhef_logtool.logs.container.Container`."""
        first, last = self._pages[span.index]
        wanted = set(self.channels) if want is None else want & set(self.channels)
        marks = ",".join("?" * len(wanted))
        query = (
            "SELECT topic_id, timestamp, data FROM messages "  # noqa: S608
            f"WHERE id BETWEEN ? AND ? AND topic_id IN ({marks}) ORDER BY id"
        )
        try:
            rows = self._db.execute(query, (first, last, *sorted(wanted))).fetchall()
        except sqlite3.Error as error:
            raise self._late or container.SpanDamageError(str(error)) from error
        sound = (row for row in rows if isinstance(row[1], int) and isinstance(row[2], bytes))
        timed = ((topic, min(timestamp, container.MAX_TIME_NS), data) for topic, timestamp, data in sound)
        return container.block_of(
            container.RawMessage(topic, time_ns, time_ns, 0, data) for topic, time_ns, data in timed
        )
