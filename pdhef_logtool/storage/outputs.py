"""Output folders: locked by one command at a time, and changed completely or not at all.

A change is written into a hidden folder beside the folder that it replaces, then both are exchanged: if the command is
killed at any point, the old or the new folder is complete. Remains of a killed command are removed by the next one.
"""

import contextlib
import ctypes
import errno
import os
import re
import shutil
import time
from collections.abc import Container, Iterable, Iterator
from pathlib import Path
from typing import Self

from pdhef_logtool.records.errors import OutputError, UsageError
from pdhef_logtool.records.processes import is_alive, process_name
from pdhef_logtool.storage.files import (
    OF_WRITING,
    WINDOWS,
    cannot_write,
    open_new,
    sweep_files,
    sync,
    take_lock,
    writing,
)

#: The hidden folder beside outputs in which changes are prepared: ``.pdhef/NAME/{new,old}``.
WORK = ".pdhef"
#: Lock file for file systems without the kernel's lock.
LOCK_FILE = ".pdhef.lock"
_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+:)/.")
_NO_LOCK = (errno.EBADF, errno.EINVAL, errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EISDIR)
_POLL_S = 0.05
#: To make a folder that a command beside this one may remove while it is empty.
_TRIES = 100


class FolderTransaction(contextlib.AbstractContextManager["FolderTransaction"]):
    """A folder that is replaced completely, or not at all; files that only the old one has are kept by a hard link.

    Files are written to the paths that :meth:`file` returns. Then either :meth:`commit` makes them the outputs, or
    :meth:`discard` keeps the old ones. As a context it commits at its end and discards on an exception.

    Attributes
    ----------
    target : location of the outputs in messages.

    Parameters
    ----------
    target : the folder, which the process must have locked. keep : whether files that only the old one has are kept.
    stale : names of files that are not kept, as they describe the old content.

    Raises
    ------
    OutputError
        The folder cannot be made.
    """

    def __init__(self, target: Path, *, keep: bool = True, stale: Container[str] = ()) -> None:
        self.target = target
        self._stale = stale
        self._place = Path(os.path.realpath(target))
        self._keep = keep
        self._work = self._place.parent / WORK / self._place.name
        self._new, self._old = self._work / "new", self._work / "old"
        try:
            with writing(target):
                if self._place.exists() and not self._place.is_dir():
                    raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR))
                _repair(self._work, self._place)
                self._make()
        except BaseException:
            self.discard()
            raise

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        """Commit on success, discard on an exception; a full disk is an OutputError wherever it was noticed."""
        if kind is None:
            self.commit()
            return
        self.discard()
        if isinstance(error, OutputError):
            error.where = error.where.replace(str(self._new), str(self.target))
        if isinstance(error, OSError) and error.errno in OF_WRITING:
            raise cannot_write(self.target, error) from error

    def _make(self) -> None:
        for _ in range(_TRIES):
            with contextlib.suppress(FileNotFoundError):  # a command beside this one removed the empty folder of both
                self._new.mkdir(parents=True)
                return

    def file(self, name: str) -> Path:
        """Return where to write the file of a name."""
        return self._new / name

    def commit(self) -> None:
        """Flush all files, link those that are kept, exchange the folders; OutputError leaves all unchanged."""
        try:
            with writing(self.target):
                if self._place.is_dir():
                    shutil.copymode(self._place, self._new)
                    if self._keep:
                        _take_over(self._place, self._new, self._stale)
                for path in self._new.rglob("*"):
                    if not path.is_symlink() and (path.is_file() or path.is_dir()):
                        sync(path)
                sync(self._new)
                _take_place(self._new, self._place, self._old)
                sync(self._place.parent)
        finally:
            self.discard()

    def discard(self) -> None:
        """Remove new files, or replaced ones; harmless after :meth:`commit` and when called twice."""
        with contextlib.suppress(OSError):
            _repair(self._work, self._place)
        with contextlib.suppress(OSError):
            self._work.parent.rmdir()


class FolderLock:
    """Lock of a folder until it is released or this process ends; the folder is created if it is missing.

    The kernel's lock on the folder itself, which no child process inherits. If the file system lacks it, or on Windows,
    a file in the folder names the process; it is void when the process has ended.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder
        self._descriptors: list[int] = []
        self._file: Path | None = None

    def acquire(self, wait_s: float = 0.0) -> None:
        """Lock the folder, after at most ``wait_s``; raises OutputError if another command has locked it."""
        end = time.monotonic() + wait_s
        while True:
            with writing(self.path):
                self.path.mkdir(parents=True, exist_ok=True)
                if self._try():
                    return
            if time.monotonic() >= end:
                raise OutputError(
                    expected="an output folder that no other command is writing to",
                    got="one that another command is writing to",
                    where=self.path,
                    remedy=f"{self._who()}wait for it or choose another folder",
                )
            time.sleep(_POLL_S)

    def hold_next(self, folder: Path) -> None:
        """Also lock a folder of ours that is about to replace the locked one.

        Otherwise a waiting command would lock it before this command has swept it.
        """
        with writing(folder):
            if self._file is not None:
                shutil.copyfile(self._file, folder / LOCK_FILE)
                return
            descriptor = os.open(folder, os.O_RDONLY)
            self._descriptors.append(descriptor)
            take_lock(descriptor)

    def release(self) -> None:
        """Release the lock, if any."""
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.unlink(missing_ok=True)
        for descriptor in self._descriptors:
            os.close(descriptor)
        self._file, self._descriptors = None, []

    def _try(self) -> bool:
        if WINDOWS:  # which opens no folders
            return self._try_file()
        descriptor, is_held = os.open(self.path, os.O_RDONLY), False
        try:
            # A folder that was exchanged since it was opened: the lock is on the old one.
            is_held = take_lock(descriptor) and os.path.samestat(os.fstat(descriptor), self.path.stat())
        except OSError as error:
            if error.errno not in _NO_LOCK:
                raise
            return self._try_file()
        finally:
            if is_held:
                self._descriptors.append(descriptor)
            else:
                os.close(descriptor)
        return is_held

    def _try_file(self) -> bool:
        """Create the complete lock file; remove a dead process's first."""
        file, prepared = self.path / LOCK_FILE, self.path / f"{LOCK_FILE}.{process_name()}.partial"
        if (holder := _holder(file)) is not None and is_alive(holder) is False:
            stale = self.path / f"{LOCK_FILE}.stale.{process_name()}.partial"
            with contextlib.suppress(FileNotFoundError):
                file.rename(stale)
                if _holder(stale) != holder:  # another took it in the meantime: it is theirs
                    stale.rename(file)
                    return False
                stale.unlink()
        try:
            with open_new(prepared) as made:
                made.write(process_name().encode())
            os.link(prepared, file)
        except FileExistsError:
            return False
        finally:
            prepared.unlink(missing_ok=True)
        self._file = file
        return True

    def _who(self) -> str:
        holder = _holder(self.path / LOCK_FILE)
        if holder is None:
            return ""
        if is_alive(holder) is None:
            return f"if no command runs on any machine, remove {LOCK_FILE} in it, else "
        return f"it is process {holder.split('-')[1]}: "


class OutputFolder(FolderLock):
    """A folder that this process locks, so that no other of ours writes to it; created if it is missing.

    Parameters
    ----------
    path : the folder. parts : names of folders in it that are outputs themselves.

    Raises
    ------
    OutputError
        It cannot be created or is locked by another command.
    """

    def __init__(self, path: Path, parts: Iterable[str] = ()) -> None:
        super().__init__(path)
        self._parts = tuple(parts)

    def begin(self, name: str, stale: Container[str] = ()) -> FolderTransaction:
        """Begin to replace a folder, such as ``logs/drive``, without its stale files; raises OutputError."""
        return FolderTransaction(self.path / name, stale=stale)

    def sweep(self) -> None:
        """Remove remains of killed commands, and finish an interrupted exchange."""
        sweep_files(self.path, held=True)
        for part in (self.path / name for name in self._parts):
            with contextlib.suppress(OSError):
                for work in list((part / WORK).iterdir()):
                    _repair(work, part / work.name)
                (part / WORK).rmdir()
            sweep_files(part, held=True)
            with contextlib.suppress(OSError):
                for folder in [p for p in part.iterdir() if p.is_dir() and not p.is_symlink()]:
                    sweep_files(folder, held=True)

    def __enter__(self) -> Self:
        """Lock the folder and sweep it."""
        self.acquire()
        self.sweep()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Release the lock; after an interruption, sweep first."""
        if kind is not None:
            self.sweep()
        self.release()


def local_path(place: Path | str) -> Path:
    """Return an output's place on this machine; raises UsageError for a URL, which as a path has lost a slash."""
    if (match := _URL.match(str(place))) and not Path(match[1]).exists():
        raise UsageError(
            expected="a place on this machine",
            got=re.sub(":/+", "://", str(place), count=1),
            where="--output",
            remedy="pdhef run alone writes to a URL",
        )
    return Path(place)


def check_no_input(inputs: Iterable[Path | None], files: Iterable[Path], folders: Iterable[Path] = ()) -> None:
    """Refuse outputs that would replace an input, before anything is written.

    Parameters
    ----------
    inputs : files and folders that the command reads; those that are not there do not count.
    files : that would be written. folders : that would be replaced, with all that is in them.

    Raises
    ------
    UsageError
        An output is an input, also by another name or link, or an input is in a folder that would be replaced.
    """
    read = {identity: path for given in inputs if given is not None for identity, path in _identities(given)}
    places = {path: Path(os.path.realpath(path)) for path in read.values()}
    within = {i: p for p, real in places.items() for f in (real, *real.parents) if (i := _identity(f)) is not None}
    for output, inputs_by_identity in [*((f, read) for f in files), *((f, within) for f in folders)]:
        identity = _identity(output)
        if identity is not None and identity in inputs_by_identity:
            raise UsageError(
                expected="an output that is no input of the same command",
                got=f"{output}, which would replace the input {inputs_by_identity[identity]}",
                where="output",
                remedy="choose another output folder, or move the input first",
            )


def _identities(path: Path) -> Iterator[tuple[tuple[int, int], Path]]:
    """Yield the identity of a file, or of a folder and the files in it."""
    for member in [path, *(p for p in path.iterdir() if p.is_file())] if path.is_dir() else [path]:
        if (identity := _identity(member)) is not None:
            yield identity, member


def _identity(path: Path) -> tuple[int, int] | None:
    try:
        status = path.stat()
    except (OSError, ValueError):
        return None
    return status.st_dev, status.st_ino


def _holder(file: Path) -> str | None:
    """Return the owner of a lock file; None for another file."""
    try:
        name = file.read_text(encoding="ascii")
        is_alive(name)
    except (OSError, ValueError):
        return None
    return name


def _repair(work: Path, place: Path) -> None:
    """Finish an exchange that was cut off between its two renames, then remove the working folder."""
    old = work / "old"
    if old.is_dir() and not os.path.lexists(place):
        old.rename(place)
    if work.is_dir():
        shutil.rmtree(work, ignore_errors=True)


def _take_over(old: Path, new: Path, stale: Container[str]) -> None:
    """Link everything that only the old folder has, except stale files, into the new one."""
    for path in old.iterdir():
        to = new / path.name
        if path.name in stale or os.path.lexists(to):
            continue
        if path.is_symlink():
            to.symlink_to(path.readlink())
        elif path.is_dir():
            shutil.copytree(path, to, symlinks=True, copy_function=_link)
        else:
            _link(path, to)


def _link(source: str | Path, target: str | Path) -> None:
    try:
        os.link(source, target)
    except OSError:  # a file system without hard links, or a file of another user
        shutil.copy2(source, target)


def _take_place(new: Path, place: Path, old: Path) -> None:
    """Give ``new`` the name of ``place``; the former folder is at ``new`` or ``old`` afterwards."""
    if not os.path.lexists(place):
        new.rename(place)
    elif not _exchanged(new, place):
        # A file system without exchange: for a moment the name does not exist; a kill at that moment is repaired.
        place.rename(old)
        new.rename(place)


def _exchanged(path: Path, other: Path) -> bool:
    """Exchange two names at once where system and file system can (Linux renameat2); False where they cannot."""
    if WINDOWS:
        return False
    at_cwd, exchange = -100, 2
    rename = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if rename is None:
        return False
    if rename(at_cwd, os.fsencode(path), at_cwd, os.fsencode(other), exchange) == 0:
        return True
    if ctypes.get_errno() in (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP):
        return False
    raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()), str(other))
