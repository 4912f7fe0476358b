"""Commands in this process or another one under limits; cases in supervised processes, killed if they hang or grow."""

import contextlib
import io
import json
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
from functools import partial
from pathlib import Path
from unittest.mock import patch

from pdhef_logtool.estimators.table import FILTERS
from pdhef_logtool.workers.supervisor import Limits, Tell, supervise
from studies.pages import ROOT

#: Limits of a case.
LIMIT_S = 10.0
LIMIT_BYTES = 1 << 30
#: End of a case without a judgement: its process died, hung or grew too large, or the judge failed.
NO_VERDICT = "no verdict"
_TOLD_EVERY = 500
_PRELOAD = ("pdhef_logtool.runs.*", "pdhef_logtool.logs.*", "pdhef_logtool.cli.*", *FILTERS)
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


@dataclass(frozen=True, slots=True)
class Ended:
    """How a command ended."""

    code: int
    out: str
    err: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """How a case ended: a word such as ``exit 3``, the problem (empty if none), and the costs."""

    end: str
    problem: str = ""
    costs: Mapping[str, float] = field(default_factory=dict)


def command(*arguments: str) -> Ended:
    """Run ``pdhef`` in this process; an exception that it calls internal comes with its traceback in ``err``."""
    from pdhef_logtool.cli.app import main

    out, err = io.StringIO(), io.StringIO()
    code: int | str | None = 0
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with (
            patch.dict(os.environ, PDHEF_TRACEBACK="1"),
            patch.object(sys, "argv", ["pdhef", *arguments]),
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
        ):
            main()
    except SystemExit as exit_:
        code = exit_.code
    except Exception:  # noqa: BLE001 (any exception is a finding)
        return Ended(1, out.getvalue(), f"internal error\n{traceback.format_exc()}")
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    return Ended(code if isinstance(code, int) else 1, out.getvalue(), err.getvalue())


def judge(ended: Ended, allowed: Sequence[int] = (0, 1, 2, 3)) -> Verdict:
    """Check the end of a command: a documented code, one line for an error, no terminal control characters."""
    end = f"exit {ended.code}"
    last = ended.err.rstrip("\n").rpartition("\n")[2]
    if "internal error" in ended.err:
        return Verdict("internal error", ended.err[-3000:])
    if ended.code not in allowed:
        return Verdict(end, f"exit code {ended.code}: {ended.err[-500:]}")
    if ended.code in (1, 2) and not last.startswith("pdhef"):
        return Verdict(end, f"no line of an error: {ended.err[-500:]!r}")
    if control := _CONTROL.search(ended.out + ended.err):
        around = (ended.out + ended.err)[max(0, control.start() - 60) : control.end() + 20]
        return Verdict(end, f"a control character in the output: {around!r}")
    return Verdict(end)


def run_cases(
    judge_case: Callable[[int], Verdict],
    count: int,
    journal: Path,
    *,
    jobs: int = 2,
    tell: Callable[[str], None] = print,
    limits: Limits | None = None,
) -> dict[int, Verdict]:
    """Judge the cases 0 to ``count`` - 1 in supervised processes; none that is in the journal already.

    Their costs are seconds and bytes; without others, the peak is that of the process so far.
    """
    done = read_journal(journal)
    left = [n for n in range(count) if n not in done]
    limits = limits or Limits(silence_s=LIMIT_S, memory_bytes=LIMIT_BYTES)
    journal.parent.mkdir(parents=True, exist_ok=True)
    with journal.open("a") as file:
        for ended in supervise(partial(_case, judge_case), left, jobs=jobs, limits=limits, preload=_PRELOAD):
            reason = "" if ended.failure is None else ended.failure.reason
            done[ended.item] = verdict = ended.result or Verdict(NO_VERDICT, reason)
            file.write(json.dumps([ended.item, *astuple(verdict)]) + "\n")
            file.flush()
            if len(done) % _TOLD_EVERY == 0:
                tell(f"{journal.stem}: {len(done)} of {count}")
    return {n: done[n] for n in range(count)}


def _case(judge_case: Callable[[int], Verdict], number: int, tell: Tell) -> Verdict:
    del tell
    begin = time.monotonic()
    verdict = judge_case(number)
    peak_bytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10
    return replace(verdict, costs={"s": time.monotonic() - begin, "bytes": peak_bytes, **verdict.costs})


def read_journal(journal: Path) -> dict[int, Verdict]:
    """Return the completed cases by number; lines cut by a kill are skipped."""
    done: dict[int, Verdict] = {}
    for line in journal.read_text().splitlines() if journal.is_file() else ():
        with contextlib.suppress(ValueError):
            number, *verdict = json.loads(line)
            done[number] = Verdict(*verdict)
    return done


# ------------------------------------------------------------------------------------------------ separate processes

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


def judge_process(process: Process, allowed: Sequence[int], limit_s: float, *more: str) -> Verdict:
    """Judge the end of a command and its costs; ``more`` are further problems, empty if there is none."""
    verdict = judge(process, allowed)
    problems = (
        verdict.problem,
        "a traceback" if "Traceback" in process.err else "",
        f"more than {limit_s:g} s" if process.late or process.wall_s > limit_s else "",
        f"{process.peak_bytes >> 20} MiB" if process.peak_bytes > LIMIT_BYTES else "",
        "left a process" if process.left else "",
        *more,
    )
    return Verdict(verdict.end, "; ".join(filter(None, problems)), {"s": process.wall_s, "bytes": process.peak_bytes})


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
        texts = [os.pread(f.fileno(), os.fstat(f.fileno()).st_size, 0).decode(errors="replace") for f in (out, err)]
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
