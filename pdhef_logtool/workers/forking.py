"""Child processes that are forked from a server with imported modules (Linux).

The server does no other work: it has one thread and no open query, so that each fork is a complete process. Unlike
the fork server of multiprocessing, it does not import ``__main__``, so that scripts can start it at module level, and
creates no file. It works in threads, in daemonic processes and in forks of a process that has a server; a process can
have several. Its children end with it, and their processor time counts as the command's.
"""

import contextlib
import gc
import importlib
import json
import os
import pkgutil
import platform
import signal
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection

from pdhef_logtool.records import processes

#: Environment of a server, read by libraries when they are loaded: one thread per worker, and no arena of Arrow, which
#: reserves a GiB that would count as memory of the worker.
_ENVIRONMENT = {"ARROW_DEFAULT_MEMORY_POOL": "system"} | dict.fromkeys(
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
_START = (
    "import gc, json, os, sys; gc.disable(); sys.path[:] = json.loads(sys.argv[1]); "
    f"from {__name__} import serve; serve(int(sys.argv[2]), json.loads(sys.argv[3])); os._exit(0)"
)
_MOST_BYTES, _MOST_FILES = 1000, 4


def can_fork() -> bool:
    """Return whether children can be forked; macOS has ``fork``, but its frameworks do not work after it."""
    return hasattr(os, "fork") and platform.system() != "Darwin"


@dataclass(slots=True, eq=False)
class Child:
    """A forked process with its connection."""

    connection: Connection
    pid: int
    server: "ForkServer"

    def end(self) -> int | None:
        """End the process and return its exit code, below zero a signal; None if its server is dead."""
        self.connection.close()
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)
        if (code := self.server.ask(b"%d" % self.pid)) is None:
            processes.wait_for_end(self.pid)
        return code


class ForkServer:
    """A process that imports modules and forks children from itself. Its children end with it and with this process.

    Parameters
    ----------
    preload : ``package.module``, ``package.*`` for all modules of a package, or ``package.module:function`` to call
        that too. They must leave no thread behind that is needed, and run no query (polars) or tensor. A module that
        cannot be imported is left to the children.
    """

    def __init__(self, preload: Sequence[str] = ()) -> None:
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._lock = threading.Lock()
        with theirs:
            self._process = subprocess.Popen(  # noqa: S603 (this package)
                [sys.executable, "-c", _START, json.dumps(sys.path), str(theirs.fileno()), json.dumps(list(preload))],
                stdin=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                env={**os.environ, **_ENVIRONMENT, **({processes.QUIET: "1"} if processes.quiet else {})},
            )

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def fork(self, function: str, *files: int, timeout_s: float) -> Child:
        """Start a child that calls ``package.module:function`` with its connection and copies of open files.

        Reading raises BlockingIOError if a message is incomplete for ``timeout_s``.

        Raises
        ------
        EOFError : the server is dead.
        """
        ours, theirs = socket.socketpair()
        with ours, theirs:
            for option in (socket.SO_RCVTIMEO, socket.SO_SNDTIMEO):
                ours.setsockopt(socket.SOL_SOCKET, option, struct.pack("ll", int(timeout_s), 0))
            if (pid := self.ask(function.encode(), theirs.fileno(), *files)) is None:
                raise EOFError
            return Child(Connection(ours.detach()), pid, self)

    def ask(self, request: bytes, *files: int) -> int | None:
        """Request a child of a function, or the exit code of a child that ends; return None if the server is dead."""
        with self._lock, contextlib.suppress(OSError):
            socket.send_fds(self._control, [request], files)
            if answer := self._control.recv(_MOST_BYTES):
                return int(answer)
        return None

    def end(self) -> int:
        """End it and its children; return its exit code, below zero a signal."""
        self._control.close()
        return self._process.wait()


def serve(descriptor: int, preload: Sequence[str]) -> None:
    """Run the server on the socket of this descriptor until the other side closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    control = socket.socket(fileno=descriptor)
    for name in preload:
        with contextlib.suppress(ImportError):
            _load(name)
    gc.collect()
    gc.freeze()  # so that garbage collection in a child copies no shared memory
    gc.enable()
    children: set[int] = set()
    try:
        while True:
            request, files, _, _ = socket.recv_fds(control, _MOST_BYTES, _MOST_FILES)
            if not request:
                return
            if files:
                processes.worker_number += 1
                answer = os.fork()
                if not answer:
                    control.close()
                    _run_child(request.decode(), files)
                children.add(answer)
                for file in files:
                    os.close(file)
            else:
                pid, status = os.waitpid(int(request), 0)
                children.discard(pid)
                answer = os.waitstatus_to_exitcode(status)
            control.send(b"%d" % answer)
    except ConnectionError:
        return
    finally:
        for pid in children:
            os.kill(pid, signal.SIGKILL)  # not yet waited for: no other process can have its number
        for pid in children:
            os.waitpid(pid, 0)  # so that their processor time counts as the command's


def _load(name: str) -> None:
    module, _, function = name.partition(":")
    loaded = importlib.import_module(module.removesuffix(".*"))
    if module.endswith(".*"):
        for inner in pkgutil.iter_modules(loaded.__path__, f"{loaded.__name__}."):
            importlib.import_module(inner.name)
    if function:
        getattr(loaded, function)()


def _run_child(function: str, files: Sequence[int]) -> None:
    """Call a function with the connection and the open files of this process, then exit."""
    try:
        pkgutil.resolve_name(function)(Connection(files[0]), *files[1:])
    finally:
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(0)
