"""The boundary of foreign readers: each file of tables is read by a separate process (Linux).

A library for MDF, MAT or Parquet files is a large parser of third-party bytes. It runs in a process that has the open
file, limits of memory and processor time, an empty folder, and no other file
(:mod:`~pdhef_logtool.workers.confinement`). The process is forked from a server that has imported the library. It
answers with JSON and plain arrays, so that a file that takes over its reader cannot make this process run anything. A
reader that dies costs its file, or the column that it was reading.
"""

from __future__ import annotations

import atexit
import importlib.util
import itertools
import json
import math
import os
import pkgutil
import signal
import socket
import struct
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from numpy.typing import NDArray

from pdhef_logtool.logs.container import SpanDamageError, describe_damage
from pdhef_logtool.logs.log_file import LogFile
from pdhef_logtool.logs.message_schema import FieldInfo
from pdhef_logtool.logs.resource_limits import RAISE_LIMIT, LimitError, ResourceLimits
from pdhef_logtool.logs.table_file import TableFile, Tables
from pdhef_logtool.logs.table_log import Table, TableLog
from pdhef_logtool.records.errors import LogError, PdhefError, UsageError
from pdhef_logtool.records.signals import Loss
from pdhef_logtool.storage.files import scratch_folder
from pdhef_logtool.workers.confinement import allow_processor_time, confine
from pdhef_logtool.workers.fork_server import exactly, receive, send
from pdhef_logtool.workers.supervisor import ForkServer, can_fork

_HEAD = struct.Struct("<q")
_ERRORS: Mapping[str, type[PdhefError]] = {e.__name__: e for e in (LogError, LimitError, UsageError)}
#: Timeout of a request: the allowed processor time by this factor, and a constant part.
_PATIENCE, _PATIENCE_S = 10.0, 60.0
#: Restarts of a reader that died while it loaded a column: the other columns can still be read.
_RESTARTS = 1
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
    with file.meter.running(size):
        if not can_fork():
            stream = file.path.open("rb")
            tables = pkgutil.resolve_name(reader)(TableFile(stream, size, str(file.place), file.meter.limits))
            return TableLog(_closing(file, stream.close), tables.kind, tables.tables, tables.losses)
        session = _Session(file, size, reader, libraries)
        try:
            tables = session.open()
            return TableLog(_closing(file, session.close), tables.kind, tables.tables, tables.losses)
        except BaseException:
            session.close()
            raise


def _closing(file: LogFile, close: Callable[[], None]) -> LogFile:
    def release() -> None:
        close()
        file.release()

    return LogFile(file.path, file.place, file.meter, release, file.cut)


@dataclass(slots=True, eq=False)
class _Process:
    """A reader with the open file."""

    channel: socket.socket
    server: ForkServer
    pid: int
    resources: ExitStack

    def end(self) -> int | None:
        """End it and return its exit code, below zero a signal."""
        self.channel.close()
        with suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)
        code = self.server.status(self.pid)
        self.resources.close()
        return code


class _Session:
    """Requests to the reader of one file."""

    def __init__(self, file: LogFile, size: int, reader: str, libraries: Sequence[str]) -> None:
        self._file, self._size, self._reader, self._libraries = file, size, reader, libraries
        self._where, limits = str(file.place), file.meter.limits
        self._seconds = limits.seconds + limits.seconds_per_mib * size / 2**20
        most = 2 * (limits.table_bytes + limits.table_ratio * size)
        self._bytes = min(most, psutil.virtual_memory().available)
        self._process: _Process | None = None
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
        if self._process is None:
            self._start()
            self._ask("open")
        return self._ask("load", number, path, rows.start, rows.stop)[1][0]

    def close(self) -> None:
        """End the reader."""
        if self._process is not None:
            self._process.end()
            self._process = None

    def _start(self) -> None:
        if not self._starts:
            raise SpanDamageError("its reader died")
        self._starts -= 1
        server = _server(self._reader, *self._libraries)
        ours, theirs = socket.socketpair()
        with ExitStack() as resources, self._file.path.open("rb") as stream:
            folder = resources.enter_context(scratch_folder())
            send(ours, f"{__name__}:serve_tables")
            with theirs:
                server.fork(next(_numbers), theirs)
            socket.send_fds(ours, [b"f"], [stream.fileno()])
            ours.settimeout(_PATIENCE_S + _PATIENCE * self._seconds)
            order = _Order(
                self._reader, self._where, self._size, self._file.meter.limits, folder, self._bytes, self._seconds
            )
            send(ours, order)
            (pid,) = _HEAD.unpack(exactly(ours, _HEAD.size))
            self._process = _Process(ours, server, pid, resources.pop_all())

    def _ask(self, *request: Any) -> tuple[dict[str, Any], list[NDArray[Any]]]:
        process = self._process
        assert process is not None
        try:
            send(process.channel, request)
            head, arrays = _answer(process.channel, self._file.meter.limits.metadata_bytes, self._bytes)
        except (OSError, EOFError, ValueError) as error:
            self._process = None
            raise self._death(process.end(), error) from None
        if "error" not in head:
            return head, arrays
        kind = _ERRORS.get(head["error"])
        raise SpanDamageError(head["text"]) if kind is None else kind(**head["parts"])

    def _death(self, code: int | None, error: Exception) -> LogError:
        if code == -signal.SIGXCPU or isinstance(error, TimeoutError):
            return _over("processor time", f"{self._seconds:.3g} s", self._where)
        how = "an unknown cause" if code is None else f"exit code {code}" if code >= 0 else signal.Signals(-code).name
        got = f"one that ends its reader ({how})"
        return LogError(expected="a readable file", got=got, where=self._where, remedy=_REMEDY)


@dataclass(frozen=True, slots=True)
class _Order:
    """Settings of a reader process."""

    reader: str
    name: str
    size: int
    limits: ResourceLimits
    folder: str
    more_bytes: int
    seconds: float


#: Fork servers, which have imported the libraries of a reader, by process and reader; kept until this process ends.
SERVERS: dict[tuple[int, str], ForkServer] = {}
_numbers = itertools.count(1)


def _server(reader: str, *libraries: str) -> ForkServer:
    key = os.getpid(), reader
    if key not in SERVERS or SERVERS[key].is_dead():
        here = [name for name in libraries if importlib.util.find_spec(name.partition(".")[0])]
        server = ForkServer([reader.partition(":")[0], *here])
        server.start()
        SERVERS[key] = server
    return SERVERS[key]


@atexit.register
def _end_servers() -> None:
    for (pid, _), server in SERVERS.items():
        if pid == os.getpid():
            server.end()
    SERVERS.clear()


def serve_tables(channel: socket.socket) -> None:
    """Run a reader: receive the file and the order, then answer requests until the other side closes."""
    _, descriptors, _, _ = socket.recv_fds(channel, 1, 1)
    order: _Order = receive(channel)
    channel.sendall(_HEAD.pack(os.getpid()))
    confine(Path(order.folder), order.more_bytes)
    stream = os.fdopen(descriptors[0], "rb")
    tables = Tables("", [])
    with suppress(EOFError):
        while True:
            name, *arguments = receive(channel)
            allow_processor_time(order.seconds)
            try:
                if name == "open":
                    file = TableFile(stream, order.size, order.name, order.limits)
                    tables = pkgutil.resolve_name(order.reader)(file)
                    head, arrays = _contents(tables), [t.stamps_ns for t in tables.tables]
                else:
                    number, path, start, stop = arguments
                    head, arrays = {}, [np.asarray(tables.tables[number].load(path, slice(start, stop)))]
            except MemoryError:
                head, arrays = _failure(_over("memory", f"{order.more_bytes / 1e6:.0f} MB", order.name)), []
            except Exception as error:  # noqa: BLE001  any error of a library
                head, arrays = _failure(error), []
            _reply(channel, head, arrays)


def _contents(tables: Tables) -> dict[str, Any]:
    described = [{"name": t.name, "type": t.type_name, "fields": [asdict(f) for f in t.fields]} for t in tables.tables]
    return {"kind": tables.kind, "tables": described, "losses": [asdict(loss) for loss in tables.losses]}


def _failure(error: Exception) -> dict[str, Any]:
    if isinstance(error, PdhefError):
        parts = {name: getattr(error, name) for name in ("expected", "got", "where", "remedy")}
        return {"error": type(error).__name__, "parts": parts, "text": str(error)}
    return {"error": "damage", "text": describe_damage(error)[1]}


def _over(what: str, most: str, where: str) -> LimitError:
    return LimitError(
        expected=f"a file that is read with {most} of {what}", got="more", where=where, remedy=RAISE_LIMIT
    )


def _reply(channel: socket.socket, head: dict[str, Any], arrays: Sequence[NDArray[Any]]) -> None:
    described = [{"dtype": a.dtype.str, "shape": a.shape} for a in arrays]
    data = json.dumps([head, described], default=int).encode()
    channel.sendall(_HEAD.pack(len(data)) + data)
    for array in arrays:
        channel.sendall(np.ascontiguousarray(array).data.cast("B") if array.size else b"")


def _answer(channel: socket.socket, most_head: int, most: int) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    """Receive a reply of at most this size; ValueError for one that no sound reader gives."""
    (length,) = _HEAD.unpack(exactly(channel, _HEAD.size))
    if not 0 <= length <= most_head:
        raise ValueError(length)
    head, described = json.loads(exactly(channel, length))
    arrays = []
    for array in described:
        dtype, shape = np.dtype(array["dtype"]), tuple(map(int, array["shape"]))
        if dtype.kind not in "biuf" or min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize > most:
            raise ValueError(array)
        arrays.append(np.frombuffer(exactly(channel, math.prod(shape) * dtype.itemsize), dtype).reshape(shape))
    return head, arrays
