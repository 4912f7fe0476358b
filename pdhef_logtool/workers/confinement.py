"""Confinement of a process that reads a third-party file: no other file, no program, no network, bounded memory.

Linux only. Files and network are refused by Landlock (kernel 5.13 and later, network from 6.7); on older kernels the
limits of memory and time and the empty working folder remain.
"""

import ctypes
import os
import struct
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

#: System calls of Landlock, the same on every architecture, and the option of prctl that they need.
_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF, _NO_NEW_PRIVILEGES = 444, 445, 446, 38
#: Rights over files by version of Landlock, as a number of bits; version 4 adds the network.
_RIGHTS_BY_VERSION = {1: 13, 2: 14, 3: 15, 4: 15, 5: 16}
_READ_FILES_AND_FOLDERS, _TCP, _ALL_SCOPES, _BELOW_A_PATH = 0b1100, 0b11, 0b11, 1


def confine(folder: Path, more_bytes: int) -> None:
    """Confine this process for the rest of its life.

    Parameters
    ----------
    folder : private and empty; becomes the working folder, the folder of temporary files, and takes the standard
        output and error as file ``output``. It is the only place that can be written.
    more_bytes : limit of further memory.
    """
    os.chdir(folder)
    os.environ["TMPDIR"] = tempfile.tempdir = str(folder)
    output = os.open(folder / "output", os.O_WRONLY | os.O_CREAT)
    os.dup2(output, 1)
    os.dup2(output, 2)
    os.close(output)
    bound_memory(more_bytes)
    _refuse_other_files(folder)


def bound_memory(more_bytes: int) -> None:
    """Limit the memory of this process to this much more than it has now (Linux)."""
    with suppress(ImportError, OSError, ValueError, IndexError):
        import resource

        # All that is writable and private, whether touched or not: the sixth number, in pages.
        now = int(Path("/proc/self/statm").read_bytes().split()[5]) * resource.getpagesize()
        _, most = resource.getrlimit(resource.RLIMIT_DATA)
        bound = now + more_bytes if most == resource.RLIM_INFINITY else min(now + more_bytes, most)
        resource.setrlimit(resource.RLIMIT_DATA, (bound, bound))


def allow_processor_time(more_s: float) -> None:
    """End this process (SIGXCPU) when it takes this much more processor time (Linux)."""
    import resource

    bound = int(sum(resource.getrusage(resource.RUSAGE_SELF)[:2]) + more_s) + 1
    _, most = resource.getrlimit(resource.RLIMIT_CPU)
    resource.setrlimit(resource.RLIMIT_CPU, (bound if most == resource.RLIM_INFINITY else min(bound, most), most))


def _refuse_other_files(folder: Path) -> None:
    system = ctypes.CDLL(None, use_errno=True)
    version = system.syscall(_CREATE_RULESET, None, 0, 1)
    if version < 1:  # the kernel has no Landlock
        return
    rights = (1 << _RIGHTS_BY_VERSION.get(version, max(_RIGHTS_BY_VERSION.values()))) - 1
    attributes = struct.pack("QQQ", rights, _TCP, _ALL_SCOPES)[: 8 if version < 4 else 16 if version < 6 else 24]
    rules = system.syscall(_CREATE_RULESET, attributes, len(attributes), 0)
    for path in _code():
        with _opened(path) as place:
            rule = struct.pack("=Qi", _READ_FILES_AND_FOLDERS, place)
            system.syscall(_ADD_RULE, rules, _BELOW_A_PATH, rule, 0)
    with _opened(folder) as place:
        system.syscall(_ADD_RULE, rules, _BELOW_A_PATH, struct.pack("=Qi", rights & ~1, place), 0)  # all but to execute
    system.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0)
    if system.syscall(_RESTRICT_SELF, rules, 0):
        raise OSError(ctypes.get_errno(), "Landlock refuses to confine the reader")
    os.close(rules)


def _code() -> Iterator[Path]:
    """Yield the folders of code that may still be imported, and of time zones."""
    packages = (Path(p) for p in sys.path if Path(p).name in ("site-packages", "dist-packages"))
    system = (Path(p) for p in ("/lib", "/lib64", "/usr/lib", "/usr/share/zoneinfo"))
    library = Path(os.__file__).parent
    yield from (p for p in (library, Path(__file__).parents[1], *packages, *system) if p.is_dir())


@contextmanager
def _opened(path: Path) -> Iterator[int]:
    descriptor = os.open(path, os.O_PATH | os.O_CLOEXEC)
    try:
        yield descriptor
    finally:
        os.close(descriptor)
