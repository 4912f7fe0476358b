"""``pdhef`` as a process of its own, under limits: how it ended, how long it took, how much memory it had."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from studies.pages import ROOT
from studies.torture.workers import LIMIT_BYTES, Ended

#: Protects the machine from any case; what a case may take is checked against what it took.
_HARD_LIMIT_BYTES = 8 << 30


@dataclass(frozen=True, slots=True)
class Process(Ended):
    """An ended process; ``code`` is negative for a signal, ``late`` if it had to be killed."""

    wall_s: float
    peak_bytes: int
    late: bool = False


def start(
    *arguments: str, prefix: Sequence[str] = (), env: Mapping[str, str] | None = None, **options: object
) -> subprocess.Popen[bytes]:
    """Start ``pdhef`` from this tree in a session of its own; ``prefix`` is put before the interpreter."""
    environment = dict(os.environ) if env is None else dict(env)
    environment |= {"PYTHONPATH": environment.get("PYTHONPATH", str(ROOT)), "OMP_NUM_THREADS": "1"}
    code = "from pdhef_logtool.cli.app import main; main()"
    call = [*prefix, sys.executable, "-c", code, *arguments]
    given: dict[str, object] = {"stdin": subprocess.DEVNULL, "start_new_session": True, "env": environment, **options}
    return subprocess.Popen(call, **given)  # type: ignore[call-overload,no-any-return]


def measured(*arguments: str, limit_s: float = 60.0, **options: object) -> Process:
    """Run ``pdhef`` to its end, or kill it and all its children at the limit."""
    import time

    begin = time.monotonic()
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        process = start(*arguments, stdout=out, stderr=err, preexec_fn=_limit, **options)  # type: ignore[arg-type]
        late = threading.Event()

        def kill() -> None:
            late.set()
            os.killpg(process.pid, signal.SIGKILL)

        timer = threading.Timer(limit_s, kill)
        timer.start()
        _, status, usage = os.wait4(process.pid, 0)
        timer.cancel()
        process.returncode = os.waitstatus_to_exitcode(status)
        texts = []
        for file in (out, err):
            file.seek(0)
            texts.append(file.read().decode("utf-8", errors="replace"))
    wall_s = time.monotonic() - begin
    # A child's peak begins with that of the process which starts it: one above the limit would put it on the child.
    inherited = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10
    peak = usage.ru_maxrss << 10
    is_known = peak > inherited or inherited < LIMIT_BYTES
    return Process(process.returncode, texts[0], texts[1], wall_s, peak if is_known else 0, late.is_set())


def _limit() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (_HARD_LIMIT_BYTES, _HARD_LIMIT_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
