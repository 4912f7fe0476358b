"""Kill ``pdhef run`` at random moments and report the remaining files."""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pyarrow.parquet as pq

#: Content with the time of recording, so that two runs never give the same bytes.
TIMED = (".rrd",)
#: Bytes near the end of a complete file.
ENDS = {".mcap": b"\x89MCAP0\r\n", ".rrd": b"RRF2FOOT"}
#: Files of a drive at the least.
WHOLE = ("estimates.parquet", "metrics.parquet", "recording.rrd", "report.json")
#: Longest wait for the end of a command after a signal.
LONGEST_END_S = 120.0


@dataclass(frozen=True)
class Killed:
    """How a command ended: ``after_s`` of the signal, exit code (None if it was done before it), and its stderr."""

    number: int
    after_s: float
    exit_code: int | None
    said: str


def kill_run(
    arguments: Sequence[str], output: Path, *, after_s: float, number: int = signal.SIGKILL, writing: bool = False
) -> Killed:
    """Start ``pdhef run ARGUMENTS -o OUTPUT`` and send it a signal; return when it has ended.

    Parameters
    ----------
    arguments : logs and options. number : of the signal.
    after_s : s from the start, or (``writing``) from when it begins to write a log's outputs.

    Raises
    ------
    subprocess.TimeoutExpired
        It did not end, :data:`LONGEST_END_S` after the signal.
    """
    command = [sys.executable, "-m", "pdhef_logtool", "run", *arguments, "-o", str(output)]
    before = _prepared(output)
    with subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, preexec_fn=_notice_interrupts
    ) as process:
        while writing and process.poll() is None and _prepared(output) <= before:
            time.sleep(0.002)
        try:
            process.wait(after_s)
            done = True
        except subprocess.TimeoutExpired:
            done = False
            process.send_signal(number)
        try:
            said = process.communicate(timeout=LONGEST_END_S)[1]
        except subprocess.TimeoutExpired:
            process.kill()
            raise
    return Killed(number, after_s, None if done else process.returncode, said)


def _notice_interrupts() -> None:
    """Undo the shell's setting for commands in the background: they ignore SIGINT."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def _prepared(output: Path) -> set[int]:
    """Return the inodes of the folders in which logs' outputs are prepared."""
    prepared = set()
    with contextlib.suppress(FileNotFoundError):  # also of the search, while a run removes its folder
        for folder in (output / "logs" / ".pdhef").glob("*/new"):
            prepared.add(folder.stat().st_ino)
    return prepared


def kill_many(
    arguments: Sequence[str],
    output: Path,
    *,
    count: int,
    lasts_s: float,
    writes_s: float,
    seed: int,
    signals: Sequence[int] = (signal.SIGKILL, signal.SIGINT),
) -> Iterator[Killed]:
    """Kill ``count`` runs into one folder one after the other, at times drawn from ``seed``; yield how each ended.

    Every second one is killed within ``writes_s`` of its beginning to write, the others within ``lasts_s`` of their
    start.
    """
    draw = random.Random(seed)
    for i in range(count):
        writing = i % 2 == 0
        after_s = draw.uniform(0.0, writes_s if writing else lasts_s)
        yield kill_run(arguments, output, after_s=after_s, number=draw.choice(signals), writing=writing)


def faults(output: Path, files: Collection[str] = WHOLE) -> list[str]:
    """Return the problems of incomplete files under final names, and of drives without all ``files``."""
    problems = []
    for path in sorted(p for p in output.rglob("*") if p.is_file() and not hidden(p, output)):
        try:
            if path.suffix == ".json":
                json.loads(path.read_text(encoding="utf-8"))
            elif path.suffix == ".parquet":
                pq.ParquetFile(path).read()
            elif any(end not in path.read_bytes()[-64:] for suffix, end in ENDS.items() if suffix == path.suffix):
                problems.append(f"{path.name}: cut")
        except (OSError, ValueError) as error:
            problems.append(f"{path.name}: {error}")
    for folder in (output / "logs").glob("[!.]*"):
        names = {p.name for p in folder.iterdir()}
        if not names.issuperset(files):
            problems.append(f"{folder.name}: only {', '.join(sorted(names))}")
    run = output / "run.json"
    if run.is_file():
        logs = json.loads(run.read_text(encoding="utf-8"))["logs"]
        problems += [f"run.json names {e['log']}" for e in logs if not (output / "logs" / e["log"]).is_dir()]
    return problems


def hidden(path: Path, output: Path) -> bool:
    """Return whether a path lies under a hidden name, where commands prepare their output."""
    return any(part.startswith(".") for part in path.relative_to(output).parts)


def leftovers(output: Path) -> list[str]:
    """Return the files that a run removes at its regular end."""
    return sorted(p.relative_to(output).as_posix() for p in output.rglob("*") if hidden(p, output))


def contents(output: Path) -> dict[str, bytes]:
    """Return the bytes of all files by path, empty for files with the time of recording."""
    files = sorted(p for p in output.rglob("*") if p.is_file())
    return {os.fspath(p.relative_to(output)): b"" if p.suffix in TIMED else p.read_bytes() for p in files}
