"""Which process something belongs to: a name for this one, and whether that of another is still alive."""

from __future__ import annotations

import hashlib
import os
import platform
import time
from functools import cache
from pathlib import Path

#: What :func:`own_name` returns, as a regular expression.
NAME = r"[0-9a-f]{8}-\d+-\d+"
#: Which worker of a command this process is, from 1; 0 in the command itself.
worker_number = 0


def own_name() -> str:
    """Return host, process id and start time of this process as one word: no two processes ever share it."""
    return f"{_host()}-{os.getpid()}-{_start(os.getpid()) or 0}"


def is_alive(name: str) -> bool | None:
    """Tell whether the process of an :func:`own_name` is alive; None for one of another host or container."""
    host, pid, start = name.split("-")
    if host != _host():
        return None
    if _has_ended(int(pid)):
        return False
    # The number may have been given to another process since.
    return _start(int(pid)) in (None, int(start))


@cache
def _host() -> str:
    """Return a short hash of the host and of the space in which process ids count."""
    try:
        space = str(Path("/proc/self/ns/pid").stat().st_ino)
    except OSError:
        space = ""
    return hashlib.sha256(f"{platform.node()}:{space}".encode()).hexdigest()[:8]


def wait_for_end(pid: int, most_s: float = 5.0) -> None:
    """Wait until a process that was killed has ended; unlike ``os.waitpid``, it need not be a child of this one."""
    until = time.monotonic() + most_s
    while not _has_ended(pid) and time.monotonic() < until:
        time.sleep(0.002)


def _has_ended(pid: int) -> bool:
    """Return whether a process is gone, or dead with its exit code not yet collected."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    except (PermissionError, OverflowError):
        return False
    return _stat(pid)[:1] in (["Z"], ["X"])


def _start(pid: int) -> int | None:
    """Return when a process started, in the system's ticks; None where the system does not tell."""
    try:
        return int(_stat(pid)[19])
    except (ValueError, IndexError):
        return None


def _stat(pid: int) -> list[str]:
    """Return the fields of a process from its state on; none where the system does not tell."""
    try:
        # The name of the program, in brackets, may hold anything.
        return Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].decode().split()
    except OSError:
        return []
