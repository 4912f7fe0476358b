"""The boundary of foreign readers: each file of tables is read by a separate process (Linux).

A library for MDF, MAT or Parquet files is a large parser of third-party bytes. It runs in a process that has the open
file, limits of memory and processor time, an empty folder, and no other file
(:mod:`~pdhef_logtool.workers.confinement`). The process is forked from a server that has imported the library. It
answers with JSON and plain arrays, so that a file that takes over its reader cannot make this process run anything. A
reader that dies costs its file, or the column that it was reading.
"""

import atexit
import json
import os
import pkgutil
import signal
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, replace
from functools import partial
from io import BytesIO
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from numpy.typing import NDArray

from pdhef_logtool.logs.byte_source import SourceError
from pdhef_logtool.logs.container import SpanDamageError, describe_damage
from pdhef_logtool.logs.message_schema import FieldInfo
from pdhef_logtool.logs.resource_limits import MIB, RAISE_LIMIT, LimitError
from pdhef_logtool.logs.table_file import LogFile, TableFile, Tables
from pdhef_logtool.logs.table_log import Table, TableLog
from pdhef_logtool.records.errors import LogError, PdhefError, UsageError, WorkerError
from pdhef_logtool.records.signals import Loss
from pdhef_logtool.storage.files import scratch_folder
from pdhef_logtool.workers.confinement import allow_processor_time, confine
from pdhef_logtool.workers.forking import Child, ForkServer, can_fork

_ERRORS: Mapping[str, type[PdhefError]] = {e.__name__: e for e in (LogError, LimitError, SourceError, UsageError)}
#: Timeout of a request: the allowed processor time by this factor, and a constant part.
_PATIENCE, _PATIENCE_S = 10.0, 60.0
#: Restarts of a reader that died while it loaded a column: the other columns can still be read.
_RESTARTS = 1
_SERVER_STARTS = 2
_REMEDY = "give the recording itself"


def open_tables(file: LogFile, reader: str, libraries: Sequence[str] = ()) -> TableLog:
    """Open a file by a reader of tables.

    Parameters
    ----------
    reader : ``package.module:function``, which receives a :class:`TableFile` and returns :class:`Tables`.
    libraries : modules that it imports when it reads.

    Raises
    ------
    LogError : the reader cannot read the file, dies of it, or exceeds a limit.
    """
    size = file.path.stat().st_size
    opened = TableFile(BytesIO(), size, str(file.place), file.meter.limits, file.settings)
    with file.meter.running(size):
        if not can_fork():
            stream = file.path.open("rb")
            return log_of_tables(file, pkgutil.resolve_name(reader)(replace(opened, stream=stream)), stream.close)
        session = _Session(file.path, opened, reader, libraries)
        try:
            return log_of_tables(file, session.open(), session.close)
        except BaseException:
            session.close()
            raise


def log_of_tables(file: LogFile, tables: Tables, close: Callable[[], object]) -> TableLog:
    """Return the tables of a file, of the group in its settings, as a log; ``close`` is called with the log's."""

    def release() -> None:
        close()
        file.release()

    tables = tables.of_group(file.settings.group, str(file.place)) if file.settings.group else tables
    return TableLog(replace(file, release=release), tables.kind, tables.tables, tables.losses)


class _Session:
    """Requests to the reader of one file."""

    def __init__(self, path: Path, file: TableFile, reader: str, libraries: Sequence[str]) -> None:
        self._path, self._file, self._reader, self._libraries = path, file, reader, libraries
        self._seconds = file.limits.seconds + file.limits.seconds_per_mib * file.size / MIB
        most = 2 * (file.limits.table_bytes + file.limits.table_ratio * file.size)
        self._bytes = min(most, psutil.virtual_memory().available)
        self._child: Child | None = None
        self._resources = ExitStack()
        self._starts = 1 + _RESTARTS

    def open(self) -> Tables:
        """Return the contents of the file; columns are loaded by the reader when they are requested."""
        self._start()
        head, arrays = self._ask("open")
        tables = []
        for number, (table, stamps) in enumerate(zip(head["tables"], arrays, strict=True)):
            fields = tuple(FieldInfo(**described) for described in table["fields"])
            tables.append(Table(table["name"], stamps, fields, partial(self.load, number), table["type"]))
        return Tables(head["kind"], tables, [Loss(**loss) for loss in head["losses"]])

    def load(self, number: int, path: str, rows: slice) -> NDArray[Any]:
        """Return rows of a column of a table, by the table's number."""
        if self._child is None:
            self._start()
            self._ask("open")
        return self._ask("load", number, path, rows.start, rows.stop)[1][0]

    def close(self) -> int | None:
        """End the reader and return its exit code, below zero a signal."""
        child, self._child = self._child, None
        code = None if child is None else child.end()
        self._resources.close()
        return code

    def _start(self) -> None:
        if not self._starts:
            raise SpanDamageError("its reader died")
        self._starts -= 1
        folder = self._resources.enter_context(scratch_folder())
        timeout_s = _PATIENCE_S + _PATIENCE * self._seconds
        with self._path.open("rb") as stream:
            self._child = _fork(self._reader, self._libraries, stream.fileno(), timeout_s)
        with suppress(OSError):  # the next request notices the end of the reader
            self._child.connection.send((self._reader, self._file, folder, self._bytes, self._seconds))

    def _ask(self, *request: Any) -> tuple[dict[str, Any], list[NDArray[Any]]]:
        assert self._child is not None
        try:
            self._child.connection.send(request)
            head, arrays = _answer(self._child.connection, self._file.limits.metadata_bytes, self._bytes)
        except (OSError, EOFError, ValueError, TypeError, KeyError) as error:
            raise self._death(self.close(), error) from None
        if "error" not in head:
            return head, arrays
        kind = _ERRORS.get(head["error"])
        raise SpanDamageError(head["text"]) if kind is None else kind(**head["parts"])

    def _death(self, code: int | None, error: Exception) -> LogError:
        if code == -signal.SIGXCPU or isinstance(error, BlockingIOError):
            return _over("processor time", f"{self._seconds:.3g} s", self._file.name)
        how = "an unknown cause" if code is None else f"exit code {code}" if code >= 0 else signal.Signals(-code).name
        got = f"one that ends its reader ({how})"
        return LogError(expected="a readable file", got=got, where=self._file.name, remedy=_REMEDY)


#: Fork servers, which have imported the libraries of a reader, by process and reader; kept until this process ends.
SERVERS: dict[tuple[int, str], ForkServer] = {}
_lock = threading.Lock()


def _fork(reader: str, libraries: Sequence[str], file: int, timeout_s: float) -> Child:
    """Return a reader process with an open file; a server that died is restarted once."""
    key, preload = (os.getpid(), reader), [reader.partition(":")[0], *libraries]
    with _lock:
        for _ in range(_SERVER_STARTS):
            if key not in SERVERS:
                SERVERS[key] = ForkServer(preload)
            try:
                return SERVERS[key].fork(f"{__name__}:serve_tables", file, timeout_s=timeout_s)
            except EOFError:
                SERVERS.pop(key).end()
    raise WorkerError(expected="a process that reads the file", got="a fork server that died", where=reader)


@atexit.register
def _end_servers() -> None:
    for (pid, _), server in SERVERS.items():
        if pid == os.getpid():
            server.end()
    SERVERS.clear()


def serve_tables(connection: Connection, descriptor: int) -> None:
    """Run a reader of an open file: receive the order, then answer requests until the other side closes."""
    reader, file, folder, more_bytes, seconds = connection.recv()
    confine(Path(folder), more_bytes)
    stream = os.fdopen(descriptor, "rb")
    tables = Tables("", [])
    with suppress(EOFError):
        while True:
            name, *arguments = connection.recv()
            allow_processor_time(seconds)
            try:
                if name == "open":
                    tables = pkgutil.resolve_name(reader)(replace(file, stream=stream))
                    head, arrays = _contents(tables), [t.stamps_ns for t in tables.tables]
                else:
                    number, path, start, stop = arguments
                    head, arrays = {}, [np.asarray(tables.tables[number].load(path, slice(start, stop)))]
            except MemoryError:
                head, arrays = _failure(_over("memory", f"{more_bytes / MIB:.0f} MiB", file.name)), []
            except Exception as error:  # noqa: BLE001  any error of a library
                head, arrays = _failure(error), []
            _reply(connection, head, arrays)


def _contents(tables: Tables) -> dict[str, Any]:
    described = [{"name": t.name, "type": t.type_name, "fields": [asdict(f) for f in t.fields]} for t in tables.tables]
    return {"kind": tables.kind, "tables": described, "losses": [asdict(loss) for loss in tables.losses]}


def _failure(error: Exception) -> dict[str, Any]:
    if isinstance(error, PdhefError):
        parts = {name: getattr(error, name) for name in ("expected", "got", "where", "remedy")}
        return {"error": type(error).__name__, "parts": parts, "text": str(error)}
    try:
        return {"error": "damage", "text": describe_damage(error)[1]}
    except SourceError as source_error:
        return _failure(source_error)


def _over(what: str, most: str, where: str) -> LimitError:
    return LimitError(
        expected=f"a file that is read with {most} of {what}", got="more", where=where, remedy=RAISE_LIMIT
    )


def _reply(connection: Connection, head: dict[str, Any], arrays: Sequence[NDArray[Any]]) -> None:
    described = [{"dtype": a.dtype.str, "shape": a.shape} for a in arrays]
    connection.send_bytes(json.dumps([head, described], default=int).encode())
    for array in arrays:
        connection.send_bytes(np.ascontiguousarray(array).data.cast("B") if array.size else b"")


def _answer(connection: Connection, most_head: int, most: int) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    """Receive a reply of at most this size, which is never unpickled; ValueError for one that no sound reader gives."""
    head, described = json.loads(connection.recv_bytes(most_head))
    arrays = []
    for array in described:
        dtype = np.dtype(array["dtype"])
        if dtype.kind not in "biuf":
            raise ValueError(array)
        arrays.append(np.frombuffer(connection.recv_bytes(most), dtype).reshape(array["shape"]))
    return head, arrays
