"""Unique names of processes, and detection of dead processes."""

import contextlib
import ctypes
import hashlib
import os
import platform
import time
from functools import cache
from pathlib import Path

#: Result of :func:`process_name`, as a regular expression.
NAME = r"[0-9a-f]{8}-\d+-\d+"
#: Whether only errors and results are printed, and the environment variable that passes it on to workers.
QUIET = "PDHEF_QUIET"
quiet = QUIET in os.environ
#: Number of this worker process, from 1; 0 in the command itself.
worker_number = 0


def process_name() -> str:
    """Return host, process id and start time of this process as one word, which is unique."""
    return f"{_host()}-{os.getpid()}-{_start(os.getpid()) or 0}"


def is_alive(name: str) -> bool | None:
    """Return whether the process of a :func:`process_name` is alive; None for another host or container."""
    host, pid, start = name.split("-")
    if host != _host():
        return None
    if _has_ended(int(pid)):
        return False
    # Another process may have the same id now.
    return _start(int(pid)) in (None, int(start))


@cache
def _host() -> str:
    """Return a short hash of the host and of the process id namespace."""
    try:
        space = str(Path("/proc/self/ns/pid").stat().st_ino)
    except OSError:
        space = ""
    return hashlib.sha256(f"{platform.node()}:{space}".encode()).hexdigest()[:8]


def release_memory(rows: int) -> None:
    """Give memory of freed arrays of many rows back: the C library keeps holes between arrays that are in use."""
    if rows > 1 << 15:  # the arrays of a short drive are small
        _call_c_library("malloc_trim", 0)


def share_memory() -> None:
    """Let all threads allocate from one arena: the C library keeps freed memory for each thread otherwise."""
    _call_c_library("mallopt", -8, 1)  # M_ARENA_MAX


def _call_c_library(name: str, *arguments: int) -> None:
    """Call a function of GNU's C library, which other systems do not have."""
    with contextlib.suppress(OSError, AttributeError, TypeError):
        getattr(ctypes.CDLL(None), name)(*arguments)


def wait_for_end(pid: int, most_s: float = 5.0) -> None:
    """Wait until a killed process has ended, which need not be a child of this process."""
    until = time.monotonic() + most_s
    while not _has_ended(pid) and time.monotonic() < until:
        time.sleep(0.002)


def _has_ended(pid: int) -> bool:
    """Return whether a process has ended, including zombies."""
    import psutil

    try:
        return psutil.Process(pid).status() in (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD)
    except psutil.NoSuchProcess:
        return True
    except psutil.Error:
        return False


def _start(pid: int) -> int | None:
    """Return the start time of a process; None if unknown.

    On Linux in ticks since boot, which a change of the system's clock does not affect; elsewhere in milliseconds since
    1970.
    """
    try:
        # The name of the program, in brackets, can contain any character.
        return int(Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()[19])
    except (OSError, ValueError, IndexError):
        import psutil

        with contextlib.suppress(psutil.Error):
            return int(1000.0 * psutil.Process(pid).create_time())
        return None
