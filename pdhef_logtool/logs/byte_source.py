"""Bytes of a recording by offset and size, wherever the file is.

Files are not mapped into memory: if another process truncates a file while it is open, a read raises an error and does
not end this process. Bytes that were read stay valid after the file is closed.
"""

import errno
import os
import stat
from abc import ABC, abstractmethod
from collections.abc import Iterable
from pathlib import Path
from threading import Lock
from typing import BinaryIO

from pdhef_logtool.logs.remote_place import LogPlace
from pdhef_logtool.logs.resource_limits import KIB, MIB
from pdhef_logtool.records.errors import LogError

#: Small reads come from a block read ahead, which grows while reads follow each other and shrinks where they jump.
_LEAST_AHEAD_BYTES = _LARGE_READ_BYTES = 64 * KIB
_MOST_AHEAD_BYTES = 2 * MIB
_KINDS = {stat.S_IFIFO: "a FIFO", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device", stat.S_IFSOCK: "a socket"}


class CutError(Exception):
    """A file is shorter than when it was opened. This package catches it and reports a loss."""


class SourceError(LogError):
    """A log cannot be read at its location (any more). This is no damage of the log, and never one of its losses."""


class ChangedError(SourceError):
    """A log has changed since it was opened."""


#: Errors of a disk or a file server, which may pass: they are no damage of the log.
_OF_THE_SOURCE = (errno.EIO, errno.ESTALE, errno.ENOENT, errno.ENODEV, errno.ENOTCONN, errno.ETIMEDOUT)


def raise_source_error(error: BaseException, where: str = "the log") -> None:
    """Raise a SourceError if the disk or the server of a log has failed."""
    if isinstance(error, SourceError):
        raise error
    if isinstance(error, OSError) and error.errno in _OF_THE_SOURCE:
        got, remedy = error.strerror or str(error), "check the disk or the connection"
        raise SourceError(expected="a readable file", got=got, where=where, remedy=remedy) from error


def unreadable(error: OSError, place: LogPlace) -> LogError:
    """Return the error for a file or folder that the system refuses to read."""
    return LogError(
        expected="a readable log",
        got=error.strerror or str(error),
        where=str(place),
        remedy="check the path and its permissions",
        missing=isinstance(error, FileNotFoundError),
    )


class ByteSource(ABC):
    """Bytes that can be read at any offset.

    Attributes
    ----------
    size : bytes when it was opened. is_remote : whether each read is a request, so that few large reads are faster.
    """

    size: int
    is_remote = False

    def __init__(self, size: int) -> None:
        self.size = size
        self._ahead_bytes = _LEAST_AHEAD_BYTES
        self._block: tuple[int, bytes] = (0, b"")  # offset and bytes of the last block

    @abstractmethod
    def fetch(self, offset: int, size: int) -> bytes:
        """Read up to ``size`` bytes; fewer only at the present end of the file."""

    @abstractmethod
    def close(self) -> None:
        """Close the file or connection."""

    def held_size(self, offset: int, size: int) -> int:
        """Return how many of the ``size`` bytes from an offset can be read at no extra cost."""
        del offset
        return size

    def prefetch(self, extents: Iterable[tuple[int, int]]) -> None:
        """Prepare to read bytes [start, end), in this order."""
        del extents

    def read(self, offset: int, size: int) -> bytes:
        """Return exactly these bytes; raises :class:`CutError` where the file has less."""
        if size <= _LARGE_READ_BYTES:
            block, position = self.ahead(offset, size)
        elif offset + size > self.size:  # a claim must not be allocated
            raise CutError(f"the file has no {size} bytes at byte {offset}")
        else:
            block, position = self.fetch(offset, size), 0
        data = block[position : position + size]
        if len(data) < size:
            raise CutError(f"the file ends at byte {offset + len(data)}, before byte {offset + size}")
        return data

    def ahead(self, offset: int, size: int) -> tuple[bytes, int]:
        """Return a block with ``size`` bytes or more from an offset, fewer at the file's end, and their place in it."""
        start, block = self._block
        position = offset - start
        if position >= 0 and position + size <= len(block):
            return block, position
        follows = 0 <= position <= len(block)
        self._ahead_bytes = min(2 * self._ahead_bytes, _MOST_AHEAD_BYTES) if follows else _LEAST_AHEAD_BYTES
        block = self.fetch(offset, max(size, self.held_size(offset, self._ahead_bytes)))
        self._block = (offset, block)
        return block, 0


class LocalFile(ByteSource):
    """A regular file of this machine.

    Raises
    ------
    LogError : it is a FIFO, a device or a socket. OSError : it cannot be opened.
    """

    def __init__(self, path: Path, shown_path: LogPlace | None = None) -> None:
        require_regular(path, shown_path)
        self._file = path.open("rb", buffering=0)
        self._lock = Lock()
        super().__init__(os.fstat(self._file.fileno()).st_size)

    def fetch(self, offset: int, size: int) -> bytes:
        """Read up to ``size`` bytes at an offset; several threads may read."""
        with self._lock:
            return read_at(self._file, offset, size, self.size)

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def read_at(file: BinaryIO, offset: int, size: int, end: int) -> bytes:
    """Read up to ``size`` bytes at an offset of an unbuffered file with ``end`` bytes; fewer only at its end."""
    file.seek(offset)
    data = file.read(size)
    if not 0 < len(data) < size or offset + len(data) >= end:
        return data
    parts = [data]
    while part := file.read(size - sum(map(len, parts))):  # the system reads at most 2 GiB at a time
        parts.append(part)
    return b"".join(parts)


def require_regular(path: Path, shown_path: LogPlace | None = None) -> None:
    """Reject anything but a regular file, without opening it: opening a FIFO blocks, and some devices react to it.

    Raises
    ------
    LogError : it is no regular file. OSError : it does not exist or cannot be accessed.
    """
    mode = path.stat().st_mode
    if not stat.S_ISREG(mode):
        raise LogError(
            expected="a regular file",
            got=_KINDS.get(stat.S_IFMT(mode), "a folder"),
            where=shown_path or path,
            remedy="record to a file, and give that",
        )
