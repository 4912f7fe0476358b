"""Work on many items in supervised processes.

A worker lives as long as the run and has one thread. A worker that dies, hangs or takes too much memory costs only the
item in progress, which is repeated once alone in a new process, and then reported as failed. Workers come from a fork
server (``fork_server.py``) with a socket each; they end with their parent. A fork server that dies is restarted a
bounded number of times; its workers finish their items without it.
"""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import platform
import selectors
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Generic, Self, TypeVar

import psutil

from pdhef_logtool.records.errors import UsageError, WorkerError
from pdhef_logtool.records.printable import printable
from pdhef_logtool.records.processes import wait_for_end
from pdhef_logtool.workers.fork_server import ENVIRONMENT, FORK, STATUS, WORK, ask, describe_error, receive, send, split

T = TypeVar("T")
R = TypeVar("R")
#: Progress callback of an item: a text, and a share from 0 to 1.
Tell = Callable[[str, float], None]
#: The same with the number of the item first.
Progress = Callable[[int, str, float], None]

_TICK_S = 0.05
#: Most silence that one poll of the workers counts: more means that the parent itself was stopped or busy.
_LONGEST_TICK_S = 5.0
#: A worker can exceed its limit by at most this much; allocators reserve more than they need.
_RESERVED_BYTES = 2 << 30
_TRIES = 2
#: Most restarts of the fork server per list of items.
_RESTARTS = 3
#: Timeout for handing an item to a worker.
_SEND_S = 60.0


def can_fork() -> bool:
    """Return whether workers can be forked; macOS has ``fork``, but its frameworks do not work after it."""
    return hasattr(os, "fork") and platform.system() != "Darwin"


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of an item; None: unlimited.

    Parameters
    ----------
    silence_s : between two reports of progress.
    memory_bytes : of a worker's resident set.
    """

    silence_s: float | None = None
    memory_bytes: int | None = None


@dataclass(frozen=True, slots=True)
class Failure:
    """Why there is no result: a line for users, the last reported progress, and the number of tries."""

    reason: str
    last: str = ""
    tries: int = 1


@dataclass(frozen=True, slots=True)
class Ended(Generic[T, R]):
    """Outcome of an item, with its number in the order of the items; without ``failure`` it has a result."""

    number: int
    item: T
    result: R | None = None
    failure: Failure | None = None


def supervise(
    work: Callable[[T, Tell], R],
    items: Iterable[T],
    *,
    jobs: int,
    limits: Limits = Limits(),
    preload: Sequence[str] = (),
    progress: Progress = lambda _number, _text, _share: None,
    warn: Callable[[str], None] = lambda _text: None,
) -> Generator[Ended[T, R], None, None]:
    """Do the work on every item and yield how each ended, in the order of ending.

    Items are requested as workers become free, and an item is released when it has ended. With one job and no
    limits all is done in this process; likewise, with a warning, on systems other than Linux.

    Parameters
    ----------
    work : a function of a module with an item and a progress callback as arguments; its result should be small.
    jobs : processes at once.
    preload : modules that the fork server imports: ``package.module``, ``package.*`` for all of a package, or
        ``package.module:function`` to call that too. ``pdhef_logtool.compiled.cache:load_kept`` behind others
        loads their compiled code. They must leave no thread behind that is needed, and run no query (polars) or tensor.
    warn : called with a line for people whenever the fork server is restarted, or if there can be no worker processes.

    Raises
    ------
    UsageError : fewer jobs than one.
    WorkerError : the fork server died more often than it is restarted.
    """
    if jobs < 1:
        raise UsageError(expected="at least one process", got=str(jobs), where="--jobs")
    if jobs == 1 and limits == Limits():
        return _in_this_process(work, items, progress)
    if not can_fork():
        warn("worker processes need Linux: one process does all the work, without limits on memory and time")
        return _in_this_process(work, items, progress)

    def in_workers() -> Generator[Ended[T, R], None, None]:
        with Crew[T, R](work, jobs=jobs, limits=limits, preload=preload, warn=warn) as crew:
            yield from crew.each(items, progress)

    return in_workers()


def _in_this_process(
    work: Callable[[T, Tell], R], items: Iterable[T], progress: Progress
) -> Generator[Ended[T, R], None, None]:
    for number, item in enumerate(items):
        last = ""

        def tell(text: str, share: float, number: int = number) -> None:
            nonlocal last
            last = text
            progress(number, text, share)

        try:
            result = work(item, tell)
        except Exception as error:  # noqa: BLE001 (one item never stops the others)
            yield Ended(number, item, failure=Failure(f"raised {describe_error(error)}", last))
        else:
            yield Ended(number, item, result)
            del result
        del item


@dataclass(slots=True)
class _Attempt(Generic[T]):
    number: int
    item: T
    tries: int = 0
    last: str = ""


@dataclass(slots=True)
class _Worker(Generic[T]):
    """A worker process in the parent; ``pid`` is None until the worker is ready."""

    channel: socket.socket
    server: ForkServer
    attempt: _Attempt[T] | None
    pid: int | None = None
    silent_s: float = 0.0
    buffer: bytearray = field(default_factory=bytearray)

    def resident_bytes(self) -> int:
        try:
            return int(psutil.Process(self.pid).memory_info().rss)
        except psutil.Error:
            return 0

    def end(self) -> str:
        """End the process if it lives, and return how it ended."""
        self.channel.close()
        if self.pid is None:
            return "no process could be started for it"
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)
        code = self.server.status(self.pid)
        if code is None:
            wait_for_end(self.pid)
            return "the worker died"
        return f"the worker was killed (signal {-code})" if code < 0 else f"the worker ended with exit code {code}"


class ForkServer:
    """A process that has imported modules, and forks workers from itself."""

    def __init__(self, preload: Sequence[str]) -> None:
        self._control, theirs = socket.socketpair()
        start = (
            "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
            "from pdhef_logtool.workers.fork_server import serve; serve(int(sys.argv[2]))"
        )
        with theirs:
            self._process = subprocess.Popen(  # noqa: S603 (ourselves)
                [sys.executable, "-c", start, json.dumps(sys.path), str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                env={**os.environ, **ENVIRONMENT},
            )
        self._preload = list(preload)

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def start(self) -> bool | None:
        """Wait until it has loaded its modules; return False if workers have code to compile.

        Returns None if it died.

        Raises
        ------
        RuntimeError : a module cannot be loaded.
        """
        try:
            send(self._control, self._preload)
            problem, warm = receive(self._control)
        except (EOFError, OSError):
            return None
        if problem:
            raise RuntimeError(problem)
        return bool(warm)

    def is_dead(self) -> bool:
        """Return whether its side of the socket is closed, which precedes the end of its workers."""
        try:
            return not self._control.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
        except BlockingIOError:
            return False
        except OSError:
            return True

    def fork(self, number: int, channel: socket.socket) -> bool:
        """Begin a worker on its channel; return False if the server is dead."""
        try:
            ask(self._control, FORK, number, [channel.fileno()])
        except OSError:
            if not self.is_dead():
                raise
            return False
        return True

    def status(self, pid: int) -> int | None:
        """Wait for a worker that ended and return its exit code, below zero a signal; None if the server is dead."""
        try:
            ask(self._control, STATUS, pid)
            return int(receive(self._control))
        except (EOFError, OSError):
            return None

    def end(self) -> int:
        """End it and return its exit code, below zero a signal; with 0 its workers have ended too."""
        self._control.close()
        return self._process.wait()


class Crew(Generic[T, R]):
    """Workers for several lists of items; arguments and errors as for :func:`supervise`."""

    def __init__(
        self,
        work: Callable[[T, Tell], R],
        *,
        jobs: int,
        limits: Limits = Limits(),
        preload: Sequence[str] = (),
        warn: Callable[[str], None] = lambda _text: None,
    ) -> None:
        if not can_fork():
            raise UsageError(expected="Linux, for worker processes", got=platform.system(), where="Ray node")
        most = limits.memory_bytes
        self._orders = (pickle.dumps(work), None if most is None else most + _RESERVED_BYTES)
        self._jobs, self._limits, self._preload = jobs, limits, preload
        self._progress: Progress = lambda _number, _text, _share: None
        self._warn = warn
        self._server: ForkServer | None = None
        self._deaths = 0
        self._returned: list[_Attempt[T]] = []
        self._workers: list[_Worker[T]] = []
        self._started = 0
        self._warm = True
        self._selector = selectors.DefaultSelector()

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        """End all processes."""
        self._selector.close()
        for worker in self._workers:
            worker.channel.close()
        if self._server is not None:
            code = self._server.end()
            for worker in self._workers:
                if code or worker.server is not self._server:  # it is dead and has not ended it
                    worker.end()
        self._workers.clear()

    def each(
        self,
        items: Iterable[T],
        progress: Progress = lambda _number, _text, _share: None,
    ) -> Generator[Ended[T, R], None, None]:
        """Do the work on every item, as :func:`supervise` does."""
        self._progress = progress
        self._deaths = 0
        self._returned.clear()
        lost: list[_Attempt[T]] = []
        attempts = (_Attempt(n, item) for n, item in enumerate(items))
        try:
            for attempt, ended in self._run(attempts, self._jobs):
                if ended is None:
                    lost.append(attempt)
                else:
                    yield ended
                del attempt, ended
            while lost:
                self._dismiss(self._workers)
                for _, ended in self._run(iter([lost.pop(0)]), 1):
                    assert ended is not None
                    yield ended
                    del ended
        finally:
            self._dismiss([w for w in self._workers if w.attempt is not None])

    def _dismiss(self, workers: Sequence[_Worker[T]]) -> None:
        for worker in tuple(workers):
            self._end(worker)

    def _run(self, attempts: Iterator[_Attempt[T]], jobs: int) -> Iterator[tuple[_Attempt[T], Ended[T, R] | None]]:
        """Try items, ``jobs`` at once; yield the outcome of each, None if it was lost and may be tried again."""
        since = time.monotonic()
        coming: _Attempt[T] | None = None
        while True:
            # The first item compiles alone; the others use its code.
            while self._busy() < (jobs if self._warm else 1):
                coming = coming or (self._returned.pop() if self._returned else next(attempts, None))
                if coming is None:
                    break
                attempt, coming = coming, None
                yield from self._give(attempt)
                del attempt
            if not self._busy():
                return
            heard = [key.data for key, _ in self._selector.select(_TICK_S)]
            now = time.monotonic()
            for worker in self._workers:
                worker.silent_s += min(now - since, _LONGEST_TICK_S)
            since = now
            for worker in heard:
                yield from self._hear(worker)
            yield from self._watch()

    def _busy(self) -> int:
        return sum(w.attempt is not None for w in self._workers)

    def _give(self, attempt: _Attempt[T]) -> Iterator[tuple[_Attempt[T], Ended[T, R] | None]]:
        """Hand an item to a worker that is free, or to a new one; an item that cannot be sent ends here."""
        attempt.tries, attempt.last = attempt.tries + 1, ""
        free = next((w for w in self._workers if w.attempt is None), None)
        if free is None:
            self._start(attempt)
        else:
            free.attempt = attempt
            yield from self._send(free)

    def _start(self, attempt: _Attempt[T]) -> None:
        ours, theirs = socket.socketpair()
        self._started += 1
        send(ours, WORK)
        with theirs:
            while not (server := self._live_server()).fork(self._started, theirs):
                pass
        ours.settimeout(_SEND_S)
        worker = _Worker(ours, server, attempt)
        self._workers.append(worker)
        self._selector.register(ours, selectors.EVENT_READ, worker)

    def _live_server(self) -> ForkServer:
        """Return the fork server; start or restart it if necessary.

        Raises
        ------
        WorkerError : it died more often than it is restarted.
        """
        while self._server is None or self._server.is_dead():
            if self._server is not None:
                self._note_death(self._server.end())
            self._server = ForkServer(self._preload)
            if (warm := self._server.start()) is not None:
                self._warm = warm
        return self._server

    def _note_death(self, code: int) -> None:
        self._deaths += 1
        how = f"exit code {code}" if code >= 0 else f"signal {-code}"
        if self._deaths > _RESTARTS:
            raise WorkerError(
                expected="a fork server that keeps running",
                got=f"{self._deaths} that died, the last one by {how}",
                where="worker processes",
                remedy="find the process that kills them, for example the system for lack of memory",
            )
        self._warn(f"the fork server died ({how}): restart {self._deaths} of {_RESTARTS}, no item is lost")

    def _send(self, worker: _Worker[T]) -> Iterator[tuple[_Attempt[T], Ended[T, R] | None]]:
        attempt = worker.attempt
        assert attempt is not None
        try:
            packed = pickle.dumps(attempt.item)
        except Exception as error:  # noqa: BLE001 (any error of a pickler)
            worker.attempt = None
            yield attempt, _failed(attempt, f"it cannot be sent to a worker: {describe_error(error)}")
            return
        worker.silent_s = 0.0
        with contextlib.suppress(OSError):  # dead and hanging workers are handled by _watch
            send(worker.channel, packed)

    def _hear(self, worker: _Worker[T]) -> Iterator[tuple[_Attempt[T], Ended[T, R] | None]]:
        """Handle the messages of a worker."""
        try:
            data = worker.channel.recv(1 << 16)
        except OSError:
            data = b""
        if not data:
            yield from self._lose(worker)
            return
        worker.silent_s = 0.0
        worker.buffer += data
        for kind, *said in split(worker.buffer):
            attempt = worker.attempt
            if kind == "ready":
                worker.pid = said[0]
                with contextlib.suppress(OSError):
                    send(worker.channel, self._orders)
                yield from self._send(worker)
            elif attempt is None:
                continue
            elif kind == "tell":
                attempt.last = said[0]
                self._progress(attempt.number, said[0], said[1])
            elif kind == "memory":
                yield from self._lose(worker, self._too_big())
                return
            else:
                worker.attempt, self._warm = None, True
                yield attempt, _opened(attempt, said[0]) if kind == "done" else _failed(attempt, said[0])

    def _watch(self) -> Iterator[tuple[_Attempt[T], Ended[T, R] | None]]:
        """End the workers that have been silent for too long or have grown too big."""
        for worker in [w for w in self._workers if w.attempt is not None and w.pid is not None]:
            silence_s, memory_bytes = self._limits.silence_s, self._limits.memory_bytes
            if memory_bytes is not None and worker.resident_bytes() > memory_bytes:
                yield from self._lose(worker, self._too_big())
            elif silence_s is not None and worker.silent_s > silence_s:
                yield from self._lose(worker, f"nothing heard for {silence_s:g} s")

    def _too_big(self) -> str:
        most = self._limits.memory_bytes
        return "there was no more memory" if most is None else f"took more than {most / 1e6:.0f} MB"

    def _lose(self, worker: _Worker[T], reason: str = "") -> Iterator[tuple[_Attempt[T], Ended[T, R] | None]]:
        """End a worker; its item, if it has one, is lost for a reason, or for how the process ended.

        An item of a worker that never started because the fork server died has not been tried: it is the next one.
        """
        attempt, self._warm = worker.attempt, True
        untried = worker.pid is None and worker.server.is_dead()
        how = self._end(worker)
        if attempt is not None and untried:
            attempt.tries -= 1
            self._returned.append(attempt)
        elif attempt is not None:
            yield attempt, _failed(attempt, reason or how) if attempt.tries >= _TRIES else None

    def _end(self, worker: _Worker[T]) -> str:
        self._workers.remove(worker)
        self._selector.unregister(worker.channel)
        return worker.end()


def _failed(attempt: _Attempt[T], reason: str) -> Ended[T, R]:
    return Ended(
        attempt.number, attempt.item, failure=Failure(printable(reason), printable(attempt.last), attempt.tries)
    )


def _opened(attempt: _Attempt[T], answer: bytes) -> Ended[T, R]:
    try:
        return Ended(attempt.number, attempt.item, pickle.loads(answer))  # noqa: S301 (from our own process)
    except Exception as error:  # noqa: BLE001 (any error of a pickle)
        return _failed(attempt, f"its result cannot be read: {describe_error(error)}")
