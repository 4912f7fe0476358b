"""Run ``pdhef`` as on Windows, as far as Linux can imitate it: ``python without_posix.py COMMAND [then COMMAND]``.

Modules and functions that Windows does not have are hidden, folders cannot be opened as files, files open for reading
cannot be flushed, and open files can be neither removed nor renamed. Libraries are imported first: their own builds for
Windows use none of this.
"""

import ctypes
import errno
import fcntl
import importlib
import os
import shutil
import signal
import socket
import stat
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

LIBRARIES = (
    "asyncio", "matplotlib.pyplot", "numba", "polars", "psutil", "pyarrow.parquet", "rerun", "scipy.optimize",
    "subprocess",
)  # fmt: skip
FUNCTIONS = (
    "chown", "fchmod", "fdatasync", "fork", "forkpty", "geteuid", "getgid", "getpgid", "getuid", "killpg", "mkfifo",
    "nice", "openpty", "posix_fadvise", "pread", "preadv", "pwrite", "pwritev", "register_at_fork", "sched_getaffinity",
    "setsid", "statvfs", "sysconf", "uname", "wait", "waitpid",
)  # fmt: skip
MODULES = ("fcntl", "grp", "posix", "pwd", "resource", "termios", "tty")


def imitate() -> None:
    """Hide the functions that Windows lacks, and reject calls that it rejects."""
    for name in LIBRARIES:
        importlib.import_module(name)
    kill, sync, fcntl_ = os.kill, os.fsync, fcntl.fcntl

    def kill_no_probe(pid: int, number: int) -> None:
        if number == 0 and sys._getframe(1).f_globals["__name__"].startswith("pdhef_logtool"):
            raise AssertionError("os.kill(pid, 0) ends the process on Windows")
        kill(pid, number)

    def flush(descriptor: int) -> None:
        if fcntl_(descriptor, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        sync(descriptor)

    def no_folders(function: Callable[..., int]) -> Callable[..., int]:
        def opened(path: Any, flags: int, *arguments: Any, **options: Any) -> int:
            if Path(path).is_dir():
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
            return function(path, flags, *arguments, **options)

        return opened

    def not_in_use(function: Callable[..., None]) -> Callable[..., None]:
        def changed(*paths: Any, **options: Any) -> None:
            for path in paths:
                if options.get("dir_fd") is None and (user := _open_below(os.path.realpath(path))):
                    raise PermissionError(errno.EACCES, f"in use: {user}", str(path))
            function(*paths, **options)

        return changed

    def no_c_library(name: str | None, *arguments: Any, **options: Any) -> Any:
        if name is None:
            raise TypeError("expected the name of a library")
        return library(name, *arguments, **options)

    library = ctypes.CDLL
    shutil._use_fd_functions = False
    tempfile.TemporaryFile = tempfile.NamedTemporaryFile
    for name in ("unlink", "remove", "rename", "replace", "rmdir"):
        setattr(os, name, not_in_use(getattr(os, name)))
    os.kill, os.fsync, os.open, ctypes.CDLL = kill_no_probe, flush, no_folders(os.open), no_c_library
    for name in FUNCTIONS:
        delattr(os, name)
    for owner, name in ((signal, "SIGKILL"), (signal, "SIGALRM"), (socket, "send_fds"), (socket, "MSG_DONTWAIT")):
        delattr(owner, name)
    for name in MODULES:
        sys.modules[name] = None
    exists = Path.exists
    Path.exists = lambda path: str(path) != "/dev/fd" and exists(path)
    from pdhef_logtool.storage import files

    files.WINDOWS = True


def _open_below(path: str) -> str | None:
    """Return a regular file, the path or below it, that Python has open in this process."""
    for link in Path("/proc/self/fd").iterdir():
        try:
            target = link.readlink()
            if target.is_relative_to(path) and stat.S_ISREG(link.stat().st_mode):
                return str(target)
        except OSError:
            continue
    return None


if __name__ == "__main__":
    imitate()
    from pdhef_logtool.cli.app import main

    for command in " ".join(sys.argv[1:]).split(" then "):
        sys.argv[1:] = command.split()
        try:
            main()
        except SystemExit as ended:
            if ended.code:
                raise
