"""A pool of worker processes: a worker that dies, hangs or exceeds its memory costs only its own item.

That item is repeated once alone in a new worker, and then reported as failed. Workers live as long as the run and are
forked from a server (``forking.py``). A server that dies is restarted a bounded number of times and costs no item:
those that were under way are repeated alone, since a server mostly dies for lack of memory.

Each worker has its own connection. In a pool with one pipe and lock for all (pebble, concurrent.futures), a worker that
dies in the middle of a message, or with the lock, costs all others.
"""

import contextlib
import os
import pickle
import platform
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Generic, TypeVar

from pdhef_logtool.records.errors import UsageError, WorkerError
from pdhef_logtool.records.printable import printable
from pdhef_logtool.workers.confinement import bound_memory
from pdhef_logtool.workers.forking import Child, ForkServer, can_fork

T = TypeVar("T")
R = TypeVar("R")
#: Progress callback of an item: a text, and a share from 0 to 1.
Tell = Callable[[str, float], None]
#: The same with the number of the item first.
Progress = Callable[[int, str, float], None]

_TICK_S = 0.05
#: Longest silence that one round of the parent counts; a longer round means that the parent was stopped or busy.
_LONGEST_TICK_S = 5.0
#: A worker can exceed its limit by at most this much; allocators reserve more than they need.
_RESERVED_BYTES = 2 << 30
_TRIES = 2
#: Most restarts of the fork server per list of items.
_RESTARTS = 3
#: Timeout for the rest of a message after its first bytes.
_MESSAGE_S = 3.0
#: Unchanged progress is reported again after this many seconds at the earliest.
_TELL_EVERY_S = 0.1
_LONGEST_TEXT = 500


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
    progress: Progress = lambda *_: None,
    warn: Callable[[str], None] = lambda _text: None,
) -> Generator[Ended[T, R], None, None]:
    """Do the work on every item and yield how each ended, in the order of ending.

    Items are requested as workers become free, and an item is released when it has ended. With one job and no
    limits all is done in this process; likewise, with a warning, on systems other than Linux.

    Parameters
    ----------
    work : a function of a module with an item and a progress callback as arguments; its result should be small.
    jobs : processes at once.
    preload : modules of :class:`~.forking.ForkServer`. ``pdhef_logtool.compiled.cache:load_kept`` behind others loads
        their compiled code.
    warn : called with a line for people whenever the fork server is restarted, or if there can be no worker processes.

    Raises
    ------
    UsageError : fewer jobs than one.
    WorkerError : the fork server died more often than it is restarted.
    """
    if jobs < 1:
        raise UsageError(expected="at least one process", got=str(jobs), where="--jobs")
    if jobs == 1 and limits == Limits():
        yield from _in_this_process(work, items, progress)
    elif not can_fork():
        warn("worker processes need Linux: one process does all the work, without limits on memory and time")
        yield from _in_this_process(work, items, progress)
    else:
        with Crew[T, R](work, jobs=jobs, limits=limits, preload=preload, warn=warn) as crew:
            yield from crew.each(items, progress)


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

    def failed(self, reason: str) -> Ended[T, Any]:
        return Ended(self.number, self.item, failure=Failure(printable(reason), printable(self.last), self.tries))


@dataclass(slots=True, eq=False)
class _Worker(Generic[T]):
    child: Child
    attempt: _Attempt[T] | None = None
    silent_s: float = 0.0

    def resident_bytes(self) -> int:
        import psutil

        try:
            return int(psutil.Process(self.child.pid).memory_info().rss)
        except psutil.Error:
            return 0


@dataclass(eq=False)
class Crew(contextlib.AbstractContextManager["Crew[T, R]"], Generic[T, R]):
    """Workers for several lists of items; arguments and errors as for :func:`supervise`."""

    work: Callable[[T, Tell], R]
    jobs: int
    limits: Limits = Limits()
    preload: Sequence[str] = ()
    warn: Callable[[str], None] = lambda _text: None
    _progress: Progress = lambda *_: None
    _server: ForkServer | None = None
    _deaths: int = 0
    _workers: list[_Worker[T]] = field(default_factory=list)
    #: Items that are tried again alone.
    _lost: list[_Attempt[T]] = field(default_factory=list)

    def __post_init__(self) -> None:
        if not can_fork():
            raise UsageError(expected="Linux, for worker processes", got=platform.system(), where="Ray node")

    def __exit__(self, *_: object) -> None:
        """End all processes."""
        self._dismiss(self._workers)
        if self._server is not None:
            self._server.end()

    def each(self, items: Iterable[T], progress: Progress = lambda *_: None) -> Generator[Ended[T, R], None, None]:
        """Do the work on every item, as :func:`supervise` does."""
        self._progress, self._deaths, self._lost = progress, 0, []
        try:
            yield from self._run((_Attempt(n, item) for n, item in enumerate(items)), self.jobs)
            while self._lost:
                self._dismiss(self._workers)
                yield from self._run(iter([self._lost.pop(0)]), 1)
        finally:
            self._dismiss([w for w in self._workers if w.attempt is not None])

    def _dismiss(self, workers: Sequence[_Worker[T]]) -> None:
        for worker in tuple(workers):
            self._workers.remove(worker)
            worker.child.end()

    def _run(self, attempts: Iterator[_Attempt[T]], jobs: int) -> Iterator[Ended[T, R]]:
        """Try items, ``jobs`` at once, and yield the outcome of each that is not tried again."""
        while True:
            self._hand_out(attempts, jobs)
            busy = [w for w in self._workers if w.attempt is not None]
            if not busy:
                return
            since = time.monotonic()
            ready = wait([w.child.connection for w in busy], _TICK_S)
            elapsed_s = min(time.monotonic() - since, _LONGEST_TICK_S)
            for worker in busy:
                worker.silent_s = 0.0 if worker.child.connection in ready else worker.silent_s + elapsed_s
                ended = self._hear(worker) if worker.child.connection in ready else self._watch(worker)
                if ended is not None:
                    yield ended
            del ended, worker, busy

    def _hand_out(self, attempts: Iterator[_Attempt[T]], jobs: int) -> None:
        """Hand items to workers."""
        while sum(w.attempt is not None for w in self._workers) < jobs:
            if (attempt := next(attempts, None)) is None:
                return
            attempt.tries, attempt.last = attempt.tries + 1, ""
            packed = pickle.dumps((self.work, attempt.item))
            worker = next((w for w in self._workers if w.attempt is None), None) or self._start()
            worker.attempt, worker.silent_s = attempt, 0.0
            with contextlib.suppress(OSError):  # the end of a worker is noticed by _hear, its hanging by _watch
                worker.child.connection.send_bytes(packed)
            del attempt, packed

    def _start(self) -> _Worker[T]:
        """Return a new worker; start or restart the fork server if necessary.

        Raises
        ------
        WorkerError : the server died more often than it is restarted.
        """
        while True:
            self._server = self._server or ForkServer(self.preload)
            try:
                worker = _Worker[T](self._server.fork(f"{__name__}:work_on_items", timeout_s=_MESSAGE_S))
            except EOFError:
                self._note_death(self._server)
                continue
            self._workers.append(worker)
            most = self.limits.memory_bytes
            with contextlib.suppress(OSError):
                worker.child.connection.send(None if most is None else most + _RESERVED_BYTES)
            return worker

    def _note_death(self, server: ForkServer) -> None:
        if server is not self._server:
            return  # an earlier one, already noted
        self._server, code = None, server.end()
        self._deaths += 1
        how = f"exit code {code}" if code >= 0 else f"signal {-code}"
        if self._deaths > _RESTARTS:
            raise WorkerError(
                expected="a fork server that keeps running",
                got=f"{self._deaths} that died, the last one by {how}",
                where="worker processes",
                remedy="find the process that kills them, for example the system for lack of memory",
            )
        self.warn(f"the fork server died ({how}): restart {self._deaths} of {_RESTARTS}, no item is lost")

    def _hear(self, worker: _Worker[T]) -> Ended[T, R] | None:
        """Handle a message of a worker, or its end."""
        attempt = worker.attempt
        assert attempt is not None
        try:
            kind, *said = worker.child.connection.recv()
        except BlockingIOError:
            return self._lose(worker, "it stopped in the middle of a message")
        except (EOFError, OSError):
            return self._lose(worker)
        if kind == "tell":
            attempt.last = said[0]
            self._progress(attempt.number, said[0], said[1])
            return None
        if kind == "memory":
            return self._lose(worker, self._too_big())
        worker.attempt = None
        if kind == "failed":
            return attempt.failed(said[0])
        return Ended(attempt.number, attempt.item, pickle.loads(said[0]))  # noqa: S301 (from our own process)

    def _watch(self, worker: _Worker[T]) -> Ended[T, R] | None:
        """End a worker that has been silent for too long or has grown too big."""
        silence_s, memory_bytes = self.limits.silence_s, self.limits.memory_bytes
        if memory_bytes is not None and worker.resident_bytes() > memory_bytes:
            return self._lose(worker, self._too_big())
        if silence_s is not None and worker.silent_s > silence_s:
            return self._lose(worker, f"nothing heard for {silence_s:g} s")
        return None

    def _too_big(self) -> str:
        most = self.limits.memory_bytes
        return "there was no more memory" if most is None else f"took more than {most / 1e6:.0f} MB"

    def _lose(self, worker: _Worker[T], reason: str = "") -> Ended[T, R] | None:
        """End a worker. Its item is repeated once; then return its failure, by ``reason`` or the process's end.

        If the fork server died with the worker, the item is not the cause, and this was no try of it.
        """
        attempt = worker.attempt
        assert attempt is not None
        self._workers.remove(worker)
        code = worker.child.end()
        if code is None:
            self._note_death(worker.child.server)
            attempt.tries -= not reason
        if attempt.tries < _TRIES:
            self._lost.append(attempt)
            return None
        return attempt.failed(reason or _how_it_ended(code or 0))


def _how_it_ended(code: int) -> str:
    return f"the worker was killed (signal {-code})" if code < 0 else f"the worker ended with exit code {code}"


def work_on_items(connection: Connection) -> None:
    """Run a worker: receive its memory limit, then items; reply to each with its result or error."""
    with contextlib.suppress(OSError):
        # If the machine runs out of memory, the system must end a worker and not its supervisor.
        Path("/proc/self/oom_score_adj").write_text("500")
    with contextlib.suppress(EOFError, OSError):
        if (more_bytes := connection.recv()) is not None:
            bound_memory(more_bytes)
        while True:
            connection.send(_answer(connection, connection.recv_bytes()))


def _answer(connection: Connection, packed: bytes) -> tuple[str, *tuple[Any, ...]]:
    reported: tuple[str, float] = ("", 0.0)

    def tell(text: str, share: float) -> None:
        nonlocal reported
        now = time.monotonic()
        if text != reported[0] or now - reported[1] > _TELL_EVERY_S:
            reported = (text, now)
            try:
                connection.send(("tell", text, share))
            except OSError:
                os._exit(1)  # the parent is gone

    try:
        work, item = pickle.loads(packed)  # noqa: S301 (from our own process)
        return "done", pickle.dumps(work(item, tell))
    except MemoryError:
        return ("memory",)
    except BaseException as error:  # noqa: BLE001 (a worker survives any error of an item)
        return "failed", f"raised {describe_error(error)}"


def describe_error(error: BaseException) -> str:
    """Return an exception as one line."""
    text = " ".join(str(error).split())
    return printable(f"{type(error).__name__}: {text}", _LONGEST_TEXT) if text else type(error).__name__
