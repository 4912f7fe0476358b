"""Which process something belongs to: a name for this one, and whether that of another is still alive."""

from __future__ import annotations

import hashlib
import os
import platform
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
    try:
        os.kill(int(pid), 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        pass
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


def _start(pid: int) -> int | None:
    """Return when a process started, in the system's ticks; None where the system does not tell."""
    try:
        # The name of the program, in brackets, may hold anything.
        return int(Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()[19])
    except (OSError, ValueError, IndexError):
        return None
