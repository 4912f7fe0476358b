"""Local copies of remote objects, in the user's cache folder: later commands do not fetch the same bytes again.

The folder of a copy is named by the hash of URL, size and version of the object. It contains the fetched parts of the
object at their places in a file, and an index with the extent and CRC of each of them. A damaged part is fetched again.
"""

from __future__ import annotations

import os
import shutil
import weakref
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from threading import Lock
from typing import BinaryIO

from isal.isal_zlib import crc32

from pdhef_logtool.logs.byte_source import read_at
from pdhef_logtool.storage.files import scratch_folder

#: Size of all copies together; least recently used ones are removed.
CACHE_BYTES = 4 << 30
_STEP_BYTES = 1 << 20


class RemoteCopy:
    """Some bytes of one version of an object, in a file that several processes may fill.

    Parameters
    ----------
    name : of the object. identity : of its version; empty, or without a writable cache folder: the copy is temporary.

    Attributes
    ----------
    path : the file.
    """

    def __init__(self, name: str, identity: str) -> None:
        self._lock, stack = Lock(), ExitStack()
        self.close = weakref.finalize(self, stack.close)
        stack.callback(_evict)
        try:
            self._open(stack, _cache_folder() / identity if identity else None, name)
        except (OSError, RuntimeError):  # also a user without a home
            self._open(stack, None, name)

    def _open(self, stack: ExitStack, cached: Path | None, name: str) -> None:
        folder = Path(stack.enter_context(scratch_folder())) if cached is None else cached
        self.path, index = folder / "object" / (name.replace("/", "_")[-80:] or "log"), folder / "index"
        self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        self._index = stack.enter_context(index.open("a+b", buffering=0))
        if not (_lock(self._index, exclusive=False) and index.exists()):
            raise FileNotFoundError  # another process is removing the copy
        os.utime(index)
        self.path.touch(mode=0o600)
        self._file = stack.enter_context(self.path.open("r+b", buffering=0))

    def write(self, offset: int, data: bytes) -> None:
        """Write bytes at an offset; raises OSError without room for them."""
        with self._lock:
            self._file.seek(offset)
            self._file.write(data)

    def read(self, offset: int, size: int) -> bytes:
        """Read bytes that were written."""
        with self._lock:
            return read_at(self._file, offset, size, offset + size)

    def note(self, start: int, end: int, crc: int) -> None:
        """Add bytes [start, end), which were written, to the index."""
        self._index.write(b"%d %d %d\n" % (start, end, crc))

    def extents(self) -> Iterator[tuple[int, int]]:
        """Yield [start, end) of the intact parts of the index."""
        self._index.seek(0)
        for line in self._index.readlines():
            with suppress(ValueError):  # a line that was cut off
                start, end, stated = map(int, line.split())
                crc = 0
                for offset in range(start, end, _STEP_BYTES):
                    crc = crc32(self.read(offset, min(_STEP_BYTES, end - offset)), crc)
                if crc == stated:
                    yield start, end


def _cache_folder() -> Path:
    caches = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(os.environ.get("PDHEF_CACHE_DIR") or Path(caches, "pdhef")) / "remote"


def _lock(file: BinaryIO, *, exclusive: bool) -> bool:
    """Lock a file until it is closed; False if another process has locked it."""
    try:
        import fcntl
    except ImportError:
        return True  # such systems do not remove files that are open
    with suppress(BlockingIOError):
        fcntl.flock(file, (fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH) | fcntl.LOCK_NB)
        return True
    return False


def _evict() -> None:
    """Remove the least recently used copies that are not in use, until the others fit in CACHE_BYTES."""
    total = 0
    with suppress(OSError, RuntimeError):
        for index in sorted(_cache_folder().glob("*/index"), key=lambda path: -path.stat().st_mtime):
            files = [path.stat() for path in (index.parent / "object").iterdir()]
            total += sum(getattr(file, "st_blocks", file.st_size >> 9) << 9 for file in files)
            with index.open("rb") as file:
                if total > CACHE_BYTES and _lock(file, exclusive=True):
                    shutil.rmtree(index.parent, ignore_errors=True)
