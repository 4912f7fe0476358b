"""Files that appear only when they are complete, and the error for a place that cannot be written."""

import contextlib
import errno
import hashlib
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Literal

from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.records.processes import NAME, is_alive, process_name

WINDOWS = os.name == "nt"
_PARTIAL = re.compile(rf"\..+\.({NAME})\.partial")
_SCRATCH = re.compile(rf"pdhef-({NAME})-.+")
#: Most bytes of a name, so that temporary names fit the 255 of file systems.
_LONGEST_NAME = 200
#: Folders in which this process has searched for files of killed processes.
_swept: set[Path] = set()

#: Errors that only writing can cause.
OF_WRITING = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)
_OF_THE_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO, errno.ESTALE)
_REMEDIES = {
    errno.ENOSPC: "free some space or choose another place",
    errno.EDQUOT: "free some space within the quota or choose another place",
    errno.EFBIG: "raise the limit on the size of a file (ulimit -f)",
    errno.EROFS: "choose a place that can be written",
    **dict.fromkeys((errno.EACCES, errno.EPERM), "choose a place that you may write to"),
    errno.ENAMETOOLONG: "choose a shorter name",
    **dict.fromkeys(
        (errno.ENOTDIR, errno.EISDIR, errno.EEXIST), "something else has that name: move it or choose another place"
    ),
    errno.EIO: "the disk fails: check it or choose another place",
}


class PendingFile(contextlib.AbstractContextManager["PendingFile"]):
    """A file that is written beside its target and takes the target's name when it is complete.

    The temporary name contains the name of the process, so that two processes never write to the same file, and files
    of killed processes are removed by the next process that writes to the folder.

    Raises
    ------
    OutputError
        When the folder cannot be made or written.
    """

    def __init__(self, target: Path) -> None:
        self.target = target
        name = target.name
        if len(os.fsencode(name)) > _LONGEST_NAME:
            name = hashlib.sha256(os.fsencode(name)).hexdigest()
        self.path = target.with_name(f".{name}.{process_name()}.partial")
        with writing(target):
            target.parent.mkdir(parents=True, exist_ok=True)
            self.path.unlink(missing_ok=True)
        if target.parent not in _swept:
            _swept.add(target.parent)
            sweep_files(target.parent)

    def commit(self) -> None:
        """Flush the file, then give it its final name."""
        try:
            with writing(self.target):
                sync(self.path)
                self.path.replace(self.target)
                sync(self.target.parent)
        except BaseException:
            self.discard()
            raise

    def discard(self) -> None:
        """Remove the temporary file, if there is one."""
        with contextlib.suppress(OSError):
            self.path.unlink(missing_ok=True)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Commit on success, discard on an exception."""
        if kind is None:
            self.commit()
        else:
            self.discard()


def open_new(path: Path, mode: Literal["wb", "ab"] = "wb") -> IO[bytes]:
    """Open a file to write or to append; all our outputs are written by files that this opens."""
    return path.open(mode)


def take_lock(descriptor: int, *, exclusive: bool = True) -> bool:
    """Lock a file until it is closed; False if another process has it. Raises OSError if the system has no locks."""
    try:
        import fcntl
    except ImportError:
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS)) from None
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def write_bytes(target: Path, data: bytes) -> None:
    """Write a whole file through a temporary name; raises OutputError when it cannot be written."""
    with PendingFile(target) as pending, writing(target), open_new(pending.path) as file:
        file.write(data)


@contextlib.contextmanager
def writing(target: Path) -> Iterator[None]:
    """Turn errors of the system for a place that cannot be written into an OutputError."""
    try:
        yield
    except OSError as error:
        raise cannot_write(target, error) from error


def cannot_write(target: Path, error: OSError) -> OutputError:
    """Return the error for a place that cannot be written."""
    made = OutputError(
        expected="a place to write to",
        got=error.strerror or str(error) or type(error).__name__,
        where=target,
        remedy=_REMEDIES.get(error.errno or 0, "choose another place"),
    )
    made.ends_run = error.errno in _OF_THE_DISK
    return made


def sync(path: Path) -> None:
    """Wait until a file's content, or a folder's names, are on the disk."""
    try:
        descriptor = os.open(path, os.O_RDWR if WINDOWS else os.O_RDONLY)
    except PermissionError:
        if WINDOWS:
            return  # it flushes neither folders nor read-only files
        raise
    try:
        os.fsync(descriptor)
    except OSError as error:
        if path.is_dir() and error.errno in (errno.EINVAL, errno.ENOTSUP, errno.EBADF):
            return  # a file system that cannot flush folders
        raise
    finally:
        os.close(descriptor)


def sweep_files(folder: Path, *, held: bool = False) -> None:
    """Remove incomplete files of killed processes from a folder.

    ``held``: no other process of ours writes here, so that files of other hosts are also left over.
    """
    with contextlib.suppress(OSError):
        for path in list(folder.iterdir()):
            if match := _PARTIAL.fullmatch(path.name):
                alive = is_alive(match[1])
                if alive is False or (held and alive is None):
                    with contextlib.suppress(OSError):
                        path.unlink()


def scratch_folder() -> tempfile.TemporaryDirectory[str]:
    """Return a new temporary folder; remove folders of killed processes."""
    root = Path(tempfile.gettempdir())
    if root not in _swept:
        _swept.add(root)
        with contextlib.suppress(OSError):
            for path in list(root.iterdir()):
                match = _SCRATCH.fullmatch(path.name)
                # Where users have ids (not on Windows), they share a temporary folder.
                is_ours = not hasattr(os, "getuid") or path.stat().st_uid == os.getuid()
                if match and is_alive(match[1]) is False and is_ours:
                    shutil.rmtree(path, ignore_errors=True)
    return tempfile.TemporaryDirectory(prefix=f"pdhef-{process_name()}-")
