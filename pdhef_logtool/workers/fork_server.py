"""The fork server, from which workers are forked, and the loop of a worker: the counterpart of ``supervisor.py``.

The server imports the modules of the workers and does no other work: it has one thread and no open query, so that each
fork is a complete process.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import pickle
import pkgutil
import signal
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from pdhef_logtool.records import processes
from pdhef_logtool.records.printable import printable
from pdhef_logtool.workers.confinement import bound_memory

#: Environment of a server, read by libraries when they are loaded: one thread per worker, and no arena of Arrow, which
#: reserves a GiB that would count as memory of the worker.
ENVIRONMENT = {"ARROW_DEFAULT_MEMORY_POOL": "system"} | dict.fromkeys(
    (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
        "NUMBA_NUM_THREADS",
        "POLARS_MAX_THREADS",
        "RAYON_NUM_THREADS",
        "ARROW_IO_THREADS",
    ),
    "1",
)
#: First message to a worker: the function that it calls with its channel.
WORK = f"{__name__}:work_on_items"
#: Requests to the server: fork a worker (with its socket), or return the exit status of a worker.
FORK, STATUS = b"fork", b"stat"
_REQUEST = struct.Struct("<4sq")
_HEAD = struct.Struct("<q")
#: Unchanged progress is reported again after this many seconds at the earliest.
_TELL_EVERY_S = 0.1
_LONGEST = 500


def send(channel: socket.socket, message: Any) -> None:
    """Write a message as its length and a pickle."""
    data = pickle.dumps(message)
    channel.sendall(_HEAD.pack(len(data)) + data)


def receive(channel: socket.socket) -> Any:
    """Wait for a message.

    Raises
    ------
    EOFError : the other side is gone.
    """
    return pickle.loads(exactly(channel, _HEAD.unpack(exactly(channel, _HEAD.size))[0]))  # noqa: S301 (from our own process)


def split(buffer: bytearray) -> Iterator[Any]:
    """Remove and yield the complete messages at the front of a buffer."""
    while len(buffer) >= _HEAD.size:
        end = _HEAD.size + _HEAD.unpack_from(buffer)[0]
        if len(buffer) < end:
            return
        message = pickle.loads(bytes(buffer[_HEAD.size : end]))  # noqa: S301 (from our own process)
        del buffer[:end]
        yield message


def ask(control: socket.socket, what: bytes, number: int, descriptors: Sequence[int] = ()) -> None:
    """Send the server a request: the process id of a worker, or the number of a new one and its socket."""
    socket.send_fds(control, [_REQUEST.pack(what, number)], list(descriptors))


def serve(descriptor: int) -> None:
    """Run the server on the socket of this descriptor until the other side closes; no worker outlives it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    control = socket.socket(fileno=descriptor)
    workers: set[int] = set()
    try:
        send(control, _prepare(receive(control)))
        while True:
            data, descriptors, _, _ = socket.recv_fds(control, _REQUEST.size, 1)
            if not data:
                return
            what, number = _REQUEST.unpack(data)
            if what == FORK:
                workers |= _fork(control, socket.socket(fileno=descriptors[0]), number)
            else:
                _, status = os.waitpid(number, 0)
                workers.discard(number)
                send(control, os.waitstatus_to_exitcode(status))
    except (EOFError, ConnectionError):
        return
    finally:
        for pid in workers:
            os.kill(pid, signal.SIGKILL)  # not yet waited for: no other process can have its number
        for pid in workers:
            os.waitpid(pid, 0)  # so that their processor time counts as the command's


def _prepare(preload: Sequence[str]) -> tuple[str, bool]:
    """Import modules, with ``.*`` all of a package, and call the function after a colon.

    Returns an error message, and whether all is warm: no function has returned False.
    """
    warm = True
    for name in preload:
        module, _, function = name.partition(":")
        try:
            loaded = importlib.import_module(module.removesuffix(".*"))
            if module.endswith(".*"):
                for inner in pkgutil.iter_modules(loaded.__path__, f"{loaded.__name__}."):
                    importlib.import_module(inner.name)
            if function:
                warm &= getattr(loaded, function)() is not False
        except Exception as error:  # noqa: BLE001 (the parent reports any error)
            return f"{name}: {describe_error(error)}", warm
    gc.collect()
    gc.freeze()  # so that garbage collection in a worker copies no shared memory
    return "", warm


def _fork(control: socket.socket, channel: socket.socket, number: int) -> set[int]:
    """Begin a worker on its channel; where the system has no process for it, the parent sees the channel close."""
    with channel:
        try:
            pid = os.fork()
        except OSError:
            return set()
        if pid:
            return {pid}
        try:
            processes.worker_number = number
            control.close()
            pkgutil.resolve_name(receive(channel))(channel)
        finally:
            with contextlib.suppress(OSError, ValueError):
                sys.stdout.flush()
                sys.stderr.flush()
            os._exit(0)


class _Gone(BaseException):
    """The parent is; no handler of errors in the work takes it on its way up."""


def _say(channel: socket.socket, *message: Any) -> None:
    try:
        send(channel, message)
    except OSError:
        raise _Gone from None


def work_on_items(channel: socket.socket) -> None:
    """Run a worker: receive the function and its memory limit, then items; reply to each with its result or error."""
    with contextlib.suppress(OSError):
        # If the machine runs out of memory, the system must end a worker and not its supervisor.
        Path("/proc/self/oom_score_adj").write_text("500")
    with contextlib.suppress(_Gone, EOFError, OSError):
        _say(channel, "ready", os.getpid())
        work, more_bytes = receive(channel)
        if more_bytes is not None:
            bound_memory(more_bytes)
        while True:
            _say(channel, *_answer(channel, work, receive(channel)))


def _answer(channel: socket.socket, work: bytes, item: bytes) -> tuple[str, ...] | tuple[str, bytes]:
    reported: tuple[str, float] = ("", 0.0)

    def tell(text: str, share: float) -> None:
        nonlocal reported
        now = time.monotonic()
        if text != reported[0] or now - reported[1] > _TELL_EVERY_S:
            reported = (text, now)
            _say(channel, "tell", text, share)

    try:
        result = _function(work)(pickle.loads(item), tell)  # noqa: S301 (from our own process)
    except MemoryError:
        return ("memory",)
    except _Gone:
        raise
    except BaseException as error:  # noqa: BLE001 (a worker survives any error of an item)
        return "failed", f"raised {describe_error(error)}"
    try:
        return "done", pickle.dumps(result)
    except Exception as error:  # noqa: BLE001 (any error of a pickler)
        return "failed", f"its result cannot be sent: {describe_error(error)}"


@cache
def _function(packed: bytes) -> Callable[..., Any]:
    return pickle.loads(packed)  # type: ignore[no-any-return]  # noqa: S301 (from our own process)


def describe_error(error: BaseException) -> str:
    """Return an exception as one line."""
    try:
        text = " ".join(str(error).split())
    except Exception:  # noqa: BLE001 (an exception without a text)
        text = ""
    return printable(f"{type(error).__name__}: {text}", _LONGEST) if text else type(error).__name__


def exactly(channel: socket.socket, count: int) -> bytes:
    """Wait for a number of bytes; raises EOFError where the other side is gone."""
    parts = bytearray()
    while len(parts) < count:
        part = channel.recv(min(count - len(parts), 1 << 20))
        if not part:
            raise EOFError
        parts += part
    return bytes(parts)
