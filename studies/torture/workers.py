"""Cases in monitored processes: what hangs or grows is killed and reported; no case is repeated."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import signal
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from pathlib import Path
from unittest.mock import patch

#: What no case may take.
LIMIT_S = 10.0
LIMIT_BYTES = 1 << 30
BLOCK = 500
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


@dataclass(frozen=True, slots=True)
class Ended:
    """How a command ended."""

    code: int
    out: str
    err: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """How a case ended: a word such as ``exit 3``, what is wrong with it, empty if nothing, and what it cost."""

    end: str
    problem: str = ""
    costs: Mapping[str, float] = field(default_factory=dict)


@dataclass(slots=True)
class Tally:
    """Counts of a block of cases, as one line of the journal."""

    first: int
    ends: Counter[str] = field(default_factory=Counter)
    problems: list[tuple[int, str]] = field(default_factory=list)
    slowest_s: float = 0.0
    peak_bytes: int = 0


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
    except Exception:  # noqa: BLE001 (this is what is looked for)
        return Ended(1, out.getvalue(), f"internal error\n{traceback.format_exc()}")
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    return Ended(code if isinstance(code, int) else 1, out.getvalue(), err.getvalue())


def judge(ended: Ended, allowed: Sequence[int] = (0, 1, 2, 3)) -> Verdict:
    """Return what every end must be: a documented code, one line for an error, nothing that steers a terminal."""
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
) -> list[Tally]:
    """Judge the cases 0 to ``count`` - 1 in blocks, each in a forked process; none that is in the journal already."""
    done = {t.first: t for t in read_journal(journal)}
    left = [range(a, min(a + BLOCK, count)) for a in range(0, count, BLOCK) if a not in done]
    journal.parent.mkdir(parents=True, exist_ok=True)
    running: list[_Block] = []
    with journal.open("a") as file:
        while left or running:
            while left and len(running) < jobs:
                running.append(_Block(judge_case, left.pop(0)))
            wait([b.pipe for b in running], timeout=0.05)
            for block in list(running):
                if not block.watch():
                    continue
                running.remove(block)
                done[block.tally.first] = block.tally
                file.write(json.dumps({f.name: getattr(block.tally, f.name) for f in fields(block.tally)}) + "\n")
                file.flush()
                tell(f"{journal.stem}: {min(len(done) * BLOCK, count)} of {count}")
    return [done[a] for a in sorted(done) if a < count]


def read_journal(journal: Path) -> Iterator[Tally]:
    """Return the blocks that are done; a line that a kill cut is none."""
    if not journal.is_file():
        return
    for line in journal.read_text().splitlines():
        with contextlib.suppress(ValueError):
            raw = json.loads(line)
            raw["ends"], raw["problems"] = Counter(raw["ends"]), [(n, p) for n, p in raw["problems"]]
            yield Tally(**raw)


class _Block:
    """A forked process over some cases; a new one goes on behind a case that had to be killed."""

    def __init__(self, judge_case: Callable[[int], Verdict], cases: range) -> None:
        self.judge_case, self.cases = judge_case, cases
        self.tally = Tally(cases.start)
        self._fork(cases)

    def _fork(self, cases: range) -> None:
        self.pipe, theirs = Pipe(duplex=False)
        sys.stdout.flush()
        self.case, self.since = cases.start, time.monotonic()
        self.pid = os.fork()
        if self.pid == 0:
            os.setsid()
            self.pipe.close()
            with contextlib.suppress(BaseException):
                _work(self.judge_case, cases, theirs)
            os._exit(0)
        theirs.close()

    def watch(self) -> bool:
        """Read the messages of the process; kill it if it takes too much; return whether the block is done."""
        try:
            while self.pipe.poll():
                number, end, problem = self.pipe.recv()
                now = time.monotonic()
                self.tally.slowest_s = max(self.tally.slowest_s, now - self.since)
                self._note(number, end, problem)
                self.case, self.since = number + 1, now
        except EOFError:
            os.waitpid(self.pid, 0)
            if self.case >= self.cases.stop:
                return True
            return self._killed("died", "the process died")
        size = _resident_bytes(self.pid)
        self.tally.peak_bytes = max(self.tally.peak_bytes, size)
        if size > LIMIT_BYTES:
            return self._kill("memory", f"{size >> 20} MiB")
        if time.monotonic() - self.since > LIMIT_S and self.case < self.cases.stop:
            return self._kill("hang", f"longer than {LIMIT_S:.0f} s")
        return False

    def _note(self, number: int, end: str, problem: str) -> None:
        self.tally.ends[end] += 1
        if problem:
            self.tally.problems.append((number, problem))

    def _kill(self, end: str, problem: str) -> bool:
        with contextlib.suppress(OSError):
            os.killpg(self.pid, signal.SIGKILL)
        os.waitpid(self.pid, 0)
        return self._killed(end, problem)

    def _killed(self, end: str, problem: str) -> bool:
        self.pipe.close()
        self._note(self.case, end, problem)
        after = range(self.case + 1, self.cases.stop)
        if not after:
            return True
        self._fork(after)
        return False


def _work(judge_case: Callable[[int], Verdict], cases: range, pipe: Connection) -> None:
    for number in cases:
        try:
            verdict = judge_case(number)
        except BaseException:  # noqa: BLE001 (a case that this harness cannot judge is reported as a problem)
            verdict = Verdict("no verdict", traceback.format_exc()[-3000:])
        pipe.send((number, verdict.end, verdict.problem))


def _resident_bytes(pid: int) -> int:
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except (OSError, IndexError, ValueError):
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")
