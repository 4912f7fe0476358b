"""``pdhef`` in a separate process under limits: exit code, duration, memory."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from studies.pages import ROOT
from studies.torture.workers import Ended

#: Protects the machine; the limits of a case are checked when it has ended.
_HARD_LIMIT_BYTES = 8 << 30
_SAMPLE_S = 0.01
#: Time in which the children of an ended command must end.
END_S = 10.0


@dataclass(frozen=True, slots=True)
class Process(Ended):
    """An ended process and its children.

    ``code`` is negative for a signal, ``late`` if it had to be killed, ``left`` if a child outlived it. ``peak_bytes``
    is the highest sum of the peaks of the processes that ran at the same time.
    """

    wall_s: float
    peak_bytes: int
    late: bool = False
    left: bool = False


def start(
    *arguments: str, prefix: Sequence[str] = (), env: Mapping[str, str] | None = None, **options: object
) -> subprocess.Popen[bytes]:
    """Start ``pdhef`` from this tree in a new session; ``prefix`` is put before the interpreter."""
    environment = dict(os.environ) if env is None else dict(env)
    environment |= {"PYTHONPATH": environment.get("PYTHONPATH", str(ROOT)), "OMP_NUM_THREADS": "1"}
    code = "from pdhef_logtool.cli.app import main; main()"
    call = [*prefix, sys.executable, "-c", code, *arguments]
    given: dict[str, object] = {"stdin": subprocess.DEVNULL, "start_new_session": True, "env": environment, **options}
    return subprocess.Popen(call, **given)  # type: ignore[call-overload,no-any-return]


def measured(*arguments: str, limit_s: float = 60.0, **options: object) -> Process:
    """Run ``pdhef`` to its end, or kill it and all its children at the limit."""
    begin, peak, late = time.monotonic(), 0, False
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        process = start(*arguments, stdout=out, stderr=err, preexec_fn=_limit, **options)  # type: ignore[arg-type]
        while process.poll() is None:
            peak = max(peak, sum(map(_peak_bytes, _family(process.pid))))
            if not late and time.monotonic() - begin > limit_s:
                late = True
                os.killpg(process.pid, signal.SIGKILL)
            time.sleep(_SAMPLE_S)
        wall_s = time.monotonic() - begin
        left = _outlived(process.pid)
        texts = []
        for file in (out, err):
            file.seek(0)
            texts.append(file.read().decode("utf-8", errors="replace"))
    return Process(process.returncode, texts[0], texts[1], wall_s, peak, late, left)


def _family(pid: int) -> Iterator[int]:
    """Yield a process and all that descend from it."""
    yield pid
    with contextlib.suppress(OSError):
        for children in list(Path(f"/proc/{pid}/task").glob("*/children")):
            for child in children.read_text().split():
                yield from _family(int(child))


def _peak_bytes(pid: int) -> int:
    """Return the peak memory of a process since its program was loaded, excluding the peak of its parent."""
    with contextlib.suppress(OSError, IndexError, ValueError):
        return int(Path(f"/proc/{pid}/status").read_text().split("VmHWM:")[1].split()[0]) << 10
    return 0


def _outlived(group: int) -> bool:
    """Return whether a process of the group still runs after :data:`END_S`, and end it."""
    with contextlib.suppress(ProcessLookupError):
        for _ in range(round(END_S / _SAMPLE_S)):
            os.killpg(group, 0)
            time.sleep(_SAMPLE_S)
        os.killpg(group, signal.SIGKILL)
        return True
    return False


def _limit() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (_HARD_LIMIT_BYTES, _HARD_LIMIT_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
