"""Bytes of an object on a server: each is fetched once, into a local file from which all reads are served.

Wanted bytes are joined to ranges of at most 8 MB across gaps of at most 64 kB, and several ranges are fetched in
parallel. Only blocks in transfer are in memory. An interrupted range continues where it was cut.
"""

from __future__ import annotations

import asyncio
import errno
import hashlib
import os
import shutil
import sys
from bisect import bisect_right
from collections.abc import Coroutine, Iterable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import BinaryIO, TypeAlias

from pdhef_logtool.logs.byte_source import ByteSource, ChangedError, SourceError, read_at
from pdhef_logtool.logs.remote_objects import (
    EMPTY,
    Answer,
    ObjectState,
    RemoteObject,
    TryAgainError,
    remote_object,
    try_in_turn,
)
from pdhef_logtool.logs.remote_place import RemotePlace
from pdhef_logtool.storage.files import scratch_folder

Extent: TypeAlias = tuple[int, int]

#: Fetching this many unwanted bytes is cheaper than another request.
JOINED_GAP_BYTES = 64 << 10
MOST_RANGE_BYTES = 8 << 20
AT_ONCE = 4
#: Enough to recognise the format of an object.
HEAD_BYTES = 4 << 10
#: Free disk space that a scratch file leaves.
_DISK_RESERVE_BYTES = 256 << 20
#: Objects that were closed stay for the next opening, so that no pass over the same log fetches it again.
_KEPT_BYTES = 4 << 30
_KEPT_OBJECTS = 1000


_AT_END = sys.maxsize


def join_ranges(extents: Iterable[Extent], held: Sequence[Extent] = ()) -> list[Extent]:
    """Return the ranges to ask for, ascending, to have all of ``extents``; bytes of ``held`` are in none of them."""
    joined: list[Extent] = []
    for start, end in without(extents, held):
        last = joined[-1] if joined else (0, 0)
        between = any(low < start and high > last[1] for low, high in held)
        if joined and start - last[1] <= JOINED_GAP_BYTES and not between:
            joined[-1] = (last[0], end)
        else:
            joined.append((start, end))
    step = MOST_RANGE_BYTES
    return [(first, min(first + step, end)) for start, end in joined for first in range(start, end, step)]


def without(extents: Iterable[Extent], held: Sequence[Extent]) -> list[Extent]:
    """Return the parts of some extents that are in none of others, ascending, neighbours joined."""
    missing: list[Extent] = []
    taken = sorted(held)
    for start, end in sorted(extents):
        position = max(start, missing[-1][1]) if missing else start
        for low, high in (*taken, (end, end)):
            stop = min(low, end)
            if stop > position:
                joined = missing and missing[-1][1] == position
                missing.append((missing.pop()[0] if joined else position, stop))
            position = max(position, high)
    return missing


class RemoteSource(ByteSource):
    """An object on a server, read through a scratch file.

    Parameters
    ----------
    head_bytes : that are fetched at once.
    place : its URL. Its state (size, ETag, time of modification) is recorded now; any later read fails if it has
        changed.

    Raises
    ------
    SourceError : It does not exist, may not be read, or the server does not respond.
    UsageError : A required package is not installed.
    """

    is_remote = True

    def __init__(self, place: RemotePlace, head_bytes: int = HEAD_BYTES) -> None:
        self._spool = _acquire(place, head_bytes)
        self._closed = False
        self.place = place
        super().__init__(self._spool.state.size)
        self.prefetch([(0, head_bytes)])

    @property
    def state(self) -> ObjectState:
        """State of the object when it was opened."""
        return self._spool.state

    @property
    def identity(self) -> str:
        """Hash of the URL without what gives access to it, of the size, and of ETag or time of modification."""
        parts = (self.place.identity, str(self.size), self.state.etag or self.state.modified)
        return hashlib.sha256("\0".join(parts).encode()).hexdigest()

    @property
    def path(self) -> Path:
        """The scratch file: fetched ranges are valid, all of it after :meth:`fetch_whole`."""
        return self._spool.path

    def fetch(self, offset: int, size: int) -> bytes:
        """See :class:`ByteSource`."""
        return self._spool.read(offset, min(offset + size, self.size))

    def held_size(self, offset: int, size: int) -> int:
        """See :class:`ByteSource`."""
        return self._spool.held_to(offset, offset + size) - offset

    def prefetch(self, extents: Iterable[Extent]) -> None:
        """See :class:`ByteSource`."""
        self._spool.order([(max(start, 0), min(end, self.size)) for start, end in extents])

    def fetch_whole(self) -> None:
        """Fetch the whole object into the scratch file."""
        self.prefetch([(0, self.size)])
        self._spool.wait(0, self.size)

    def close(self) -> None:
        """Release the scratch file, which is kept for some time in case the same object is opened again."""
        if not self._closed:
            self._closed = True
            _release(self._spool)


@dataclass(eq=False)
class _Spool:
    """A scratch file with what was fetched of one object.

    Attributes
    ----------
    held : extents in the file, ascending, apart. coming : ranges under way. users : sources that read it.
    """

    place: RemotePlace
    remote: RemoteObject
    state: ObjectState = EMPTY
    held: list[Extent] = field(default_factory=list)
    coming: list[tuple[Extent, Future[None]]] = field(default_factory=list)
    users: int = 0
    failure: SourceError | None = None

    def __post_init__(self) -> None:
        self._folder = scratch_folder()
        self.path = Path(self._folder.name) / (self.place.name.replace("/", "_")[-80:] or "log")
        self._file: BinaryIO | None = None
        self._lock = Lock()
        self._entering = Lock()
        self._at_once = asyncio.Semaphore(AT_ONCE)
        self._room = 0

    def enter(self, head_bytes: int) -> None:
        """Open the scratch file; the first user records the state of the object, later ones compare it.

        Raises
        ------
        ChangedError : The object has changed. SourceError : It cannot be requested.
        """
        with self._entering:
            if self._file is not None:
                return
            self._file = self.path.open("r+b" if self.path.exists() else "x+b", buffering=0)
            try:
                if self.state is EMPTY:
                    self._run(try_in_turn(lambda: self._first(head_bytes), self.remote)).result()
                elif self.state.size:
                    self._run(try_in_turn(self._ask_again, self.remote)).result()
            except BaseException:
                self.leave()
                raise

    def leave(self) -> None:
        """Close the scratch file, after its last use."""
        for _, future in self.coming:
            future.cancel()
        self.coming.clear()
        with self._lock:  # nothing that is still under way writes to what gets this number next
            file, self._file = self._file, None
        if file is not None:
            file.close()

    async def _first(self, head_bytes: int) -> None:
        async with self.remote.ask(0, head_bytes, None) as answer:
            written = await self._write(answer, answer.state.size)
        size = written if answer.state.size < 0 else answer.state.size
        if written < min(size, head_bytes):
            raise TryAgainError("an answer that is cut")
        self.held = [(0, written)] if written else []
        self.state = ObjectState(size, answer.state.etag, answer.state.modified)

    async def _ask_again(self) -> None:
        async with self.remote.ask(0, 1, self.state):
            pass

    def order(self, extents: Iterable[Extent]) -> None:
        """Start to fetch what is neither held nor coming."""
        with self._lock:
            if self.failure:
                return
            there = [*self.held, *(extent for extent, _ in self.coming)]
            for extent in join_ranges(extents, there):
                self.coming.append((extent, self._run(self._get(*extent))))

    def wait(self, start: int, end: int) -> None:
        """Return when bytes [start, end) are held; raises SourceError where they cannot be had."""
        self.order([(start, end)])
        for (low, high), future in list(self.coming):
            if (low < end and high > start) or future.done():
                self._take((low, high), future)
        if self.failure:
            raise self.failure

    def _take(self, extent: Extent, future: Future[None]) -> None:
        try:
            future.result()
        except SourceError as error:
            self.failure = self.failure or error
            for _, other in self.coming:
                other.cancel()
            raise self.failure from None
        with self._lock:
            if (extent, future) in self.coming:
                self.coming.remove((extent, future))
                self.held = without([*self.held, extent], ())

    def read(self, start: int, end: int) -> bytes:
        """Return bytes [start, end)."""
        if end <= start:
            return b""
        if self.held_to(start, end) < end:
            self.wait(start, end)
        with self._lock:
            assert self._file is not None
            return read_at(self._file, start, end - start, end)

    def held_to(self, start: int, end: int) -> int:
        """Return up to where, at most to ``end``, bytes from ``start`` on are held; ``start``: none is."""
        index = bisect_right(self.held, (start, _AT_END)) - 1
        return min(self.held[index][1], end) if index >= 0 and self.held[index][1] > start else start

    async def _get(self, start: int, end: int) -> None:
        async with self._at_once:
            position = start

            async def rest() -> None:
                nonlocal position
                async with self.remote.ask(position, end, self.state) as answer:
                    if answer.start != position:
                        raise self.remote.error("all of it instead of a part", "the server stopped to give ranges")
                    written = 0
                    try:
                        async for block in answer.blocks:
                            written += self._put(block[: end - position - written], position + written)
                            if position + written >= end:
                                break
                    finally:
                        position += written
                if position < end:
                    raise TryAgainError("an answer that is cut")

            await try_in_turn(rest, self.remote, lambda: position)

    async def _write(self, answer: Answer, size: int) -> int:
        """Write the blocks of a first answer, which may be all of the object; returns how many bytes came."""
        position = 0
        async for block in answer.blocks:
            position += self._put(block, position)
        if answer.start == 0 and size >= 0 and position > size:
            raise self.remote.error("more bytes than its declared size", "read a copy")
        return position

    def _put(self, block: bytes, offset: int) -> int:
        """Write a block, leaving some of the disk to others."""
        self._room -= len(block)
        if self._room < 0:
            self._room = shutil.disk_usage(self.path.parent).free - _DISK_RESERVE_BYTES - len(block)
            self._room = min(self._room, _DISK_RESERVE_BYTES)
        try:
            if self._room < 0:
                raise OSError("the disk is full")
            with self._lock:
                if self._file is None:
                    raise OSError(errno.EBADF, os.strerror(errno.EBADF))
                self._file.seek(offset)
                return self._file.write(block)
        except OSError:
            raise self.remote.error("no room for its bytes on this disk", "set TMPDIR to another") from None

    def _run(self, work: Coroutine[None, None, None]) -> Future[None]:
        return asyncio.run_coroutine_threadsafe(work, self.remote.loop)

    @property
    def size(self) -> int:
        """Bytes of the scratch file that take room."""
        return sum(high - low for low, high in self.held)

    def drop(self) -> None:
        """Remove the scratch file."""
        self.leave()
        self._folder.cleanup()


#: By place, in order of their last use.
_spools: dict[RemotePlace, _Spool] = {}
_registry = Lock()


def _acquire(place: RemotePlace, head_bytes: int) -> _Spool:
    with _registry:
        spool = _spools.pop(place, None) or _Spool(place, remote_object(place))
        _spools[place] = spool
        spool.users += 1
    try:
        spool.enter(head_bytes)
    except BaseException as error:
        with _registry:
            spool.users -= 1
            if not spool.users:
                _forget(spool)
        if isinstance(error, ChangedError) and spool.state is not EMPTY:
            return _acquire(place, head_bytes)  # another one since it was closed: opening pins what it is now
        raise
    return spool


def _release(spool: _Spool) -> None:
    with _registry:
        spool.users -= 1
        if spool.users:
            return
        spool.leave()
        if spool.failure is not None:
            _forget(spool)
        idle = [s for s in _spools.values() if not s.users]
        size = sum(s.size for s in idle)
        while idle and (size > _KEPT_BYTES or len(idle) > _KEPT_OBJECTS):
            size -= idle[0].size
            _forget(idle.pop(0))


def _forget(spool: _Spool) -> None:
    if _spools.get(spool.place) is spool:
        del _spools[spool.place]
    spool.drop()
