"""Crashes in the middle of a fleet: kills, full disks, changed logs and clocks, damaged outputs, two runs at once.

Each case plants a fault, repeats the command as a user would, and compares every file with an undisturbed output.
"""

import json
import os
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import TypeAlias

import pyarrow.parquet as pq

from studies.pages import ROOT
from studies.torture.workers import Ended, Process, Verdict, judge, measured, start
from truthsim.suite import write_suite

#: A change of a file.
Deed: TypeAlias = Callable[[Path], object]
#: Length of a drive; `learn` needs drives of 20 s.
DRIVE_S, TAUGHT_S = 4.0, 21.0
#: Full disks of each command, and logs of the cases that run more than one fleet.
PLACES, FEW = 10, 4
_RUN = ("--car", "saloon", "--estimators", "zero,phy-ukf", "--keep", "estimates")
_CAR = ("--car", "saloon", "--split")
_LIMIT_S = 900.0
_JOURNAL = "journal.jsonl"
_DAY_S = 86_400
#: Put before the modules of a command, the clock of Python is a day ahead.
_AHEAD = f"""import time
now, now_ns = time.time, time.time_ns
time.time, time.time_ns = lambda: now() + {_DAY_S}, lambda: now_ns() + {_DAY_S} * 10**9
"""
#: Files that are damaged together: one of each kind, of different drives.
_OF_DRIVES = (
    *(f"logs/*/{name}" for name in ("report.json", "metrics.parquet", "estimates.parquet", "model.toml")),
    "tables/parts/*",
)
_OF_RUN = ("run.json", "report.json", "report.html", "metrics.parquet", "tables/[!p]*.parquet")


def _run(logs: Path | str, output: Path, *more: str) -> Process:
    return measured("run", str(logs), *_RUN, "-o", str(output), *more, limit_s=_LIMIT_S)


@dataclass(frozen=True)
class Fleet:
    """A folder of logs, and the output of an undisturbed run of them; ``code`` and ``lasts_s`` are of that run."""

    logs: Path
    calm: Path
    code: int
    lasts_s: float

    @classmethod
    def of(cls, logs: Path, calm: Path) -> "Fleet":
        """Run the logs undisturbed."""
        shutil.rmtree(calm, ignore_errors=True)
        ended = _run(logs, calm)
        return cls(logs, calm, ended.code, ended.wall_s)

    def finish(self, output: Path, codes: Iterable[int], wrong: Iterable[str] = ()) -> Verdict:
        """Finish a run with ``--resume`` and compare it."""
        ended = _run(self.logs, output, "--resume")
        return compared(self.calm, output, [*codes, ended.code], [*wrong, judge(ended, (self.code,)).problem])

    @contextmanager
    def begun(
        self, output: Path, drives: int = 1, env: Mapping[str, str] | None = None
    ) -> Iterator[subprocess.Popen[bytes]]:
        """Start a run; the block begins when it has recorded some drives, and ends with the run."""
        journal = output / _JOURNAL
        words, quiet = ("run", str(self.logs), *_RUN, "-o", str(output)), subprocess.DEVNULL
        with start(*words, env=env, stderr=quiet, stdout=quiet) as process:
            while process.poll() is None and _lines(journal) < drives:
                time.sleep(0.002)
            yield process


def _lines(journal: Path) -> int:
    return journal.read_bytes().count(b'"label"') if journal.is_file() else 0


def _comparable(folder: Path) -> dict[str, bytes]:
    """Return the bytes of all files, and of the journal the last line of each drive that ``run.json`` names."""
    found = contents(folder)
    lines = found.pop(_JOURNAL, b"").splitlines()
    last = {json.loads(line).get("label"): line for line in lines}
    logs = json.loads(found["run.json"])["logs"] if lines and "run.json" in found else ()
    return found | {f"{_JOURNAL}: {log['log']}": last.get(log["log"], b"") for log in logs}


def compared(calm: Path, folder: Path, codes: Iterable[int], wrong: Iterable[str] = ()) -> Verdict:
    """Judge a folder by the output of an undisturbed command; ``wrong`` has further problems."""
    wanted, found = _comparable(calm), _comparable(folder)
    differing = {
        "lost": wanted.keys() - found.keys(),
        "stale": found.keys() - wanted.keys(),
        "unequal": {p for p in wanted.keys() & found.keys() if wanted[p] != found[p]},
    }
    problems = [
        *filter(None, wrong),
        *(f"{how}: {', '.join(sorted(paths))}" for how, paths in differing.items() if paths),
    ]
    end = ", ".join(f"{code} ({n} x)" if (n := len([*same])) > 1 else str(code) for code, same in groupby(codes))
    return Verdict(end, "; ".join(problems), {how: len(paths) for how, paths in differing.items()})


# --------------------------------------------------------------------------------------------------- the cases


def kills(fleet: Fleet, count: int, seed: int, folder: Path) -> Verdict:
    """Kill runs that continue one output at random times, every second one while it writes.

    If a run ends before its kill, the next one starts with an empty folder.
    """
    output, codes, wrong = folder / "out", list[int](), list[str]()
    files = {p.name for p in next((fleet.calm / "logs").iterdir()).iterdir()}
    call, draw = [str(fleet.logs), *_RUN, "--resume"], random.Random(seed)
    for i in range(count):
        writing = i % 2 == 0
        after_s = draw.uniform(0.0, fleet.lasts_s / (4.0 if writing else 2.0))
        number = draw.choice((signal.SIGKILL, signal.SIGINT))
        codes.append(kill_run(call, output, after_s=after_s, number=number, writing=writing).code)
        wrong += faults(output, files)
        if codes[-1] == 0:
            wrong.append(compared(fleet.calm, output, ()).problem)
            shutil.rmtree(output)
    return fleet.finish(output, sorted(codes), wrong)


def full_disk(words: Sequence[str], run: Path | None, folder: Path) -> Verdict:
    """Give a command 5 to 95 % of the space that it needs, then enough, and repeat it; ``run``: copied there before."""

    def prepare(place: Path) -> Path:
        if run is not None:
            shutil.copytree(run, place / "out")
        return place

    def call(place: Path) -> Process:
        return measured(*(word.format(place) for word in words), limit_s=_LIMIT_S)

    if os.geteuid() != 0:
        return Verdict("skipped: to fill a file system (mount -t tmpfs) needs root")
    calm, disk = folder / "calm", folder / "disk"
    calm.mkdir()
    disk.mkdir()
    had = _blocks(prepare(calm))
    wrong, codes, costs = [judge(call(calm), (0,)).problem], list[int](), dict[str, float]()
    needs = _blocks(calm) - had
    for place in range(PLACES):
        room = had + needs * (2 * place + 1) // (2 * PLACES)
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"nr_blocks={max(room, 1)}", "tmpfs", str(disk)], check=True)
        try:
            prepare(disk)
            full = call(disk)
            subprocess.run(["mount", "-o", "remount,nr_blocks=0", str(disk)], check=True)
            again = call(disk)
            verdict = compared(calm, disk, ())
        finally:
            subprocess.run(["umount", "--lazy", str(disk)], check=True)
        codes += full.code, again.code
        wrong += judge(full, (1,)).problem, judge(again, (0,)).problem, verdict.problem
        costs = {how: costs.get(how, 0.0) + n for how, n in verdict.costs.items()}
    return Verdict(compared(calm, calm, sorted(codes)).end, "; ".join(filter(None, wrong)), costs)


def _blocks(folder: Path) -> int:
    page = os.sysconf("SC_PAGE_SIZE")
    return sum(-(-p.stat().st_size // page) for p in folder.rglob("*") if p.is_file())


def two_at_once(fleet: Fleet, folder: Path) -> Verdict:
    """Start a second run into the folder of a running one."""
    output = folder / "out"
    with fleet.begun(output) as first:
        second = _run(fleet.logs, output)
    return compared(fleet.calm, output, [first.returncode, second.code], [judge(second, (1,)).problem])


def clock_set_back(fleet: Fleet, folder: Path) -> Verdict:
    """Kill a run with a clock that is a day ahead, and continue at the right time; its files have times of tomorrow."""
    output, tomorrow = folder / "out", time.time() + _DAY_S
    (folder / "sitecustomize.py").write_text(_AHEAD)
    environment = os.environ | {"PYTHONPATH": f"{folder}{os.pathsep}{ROOT}"}
    with fleet.begun(output, drives=FEW // 2, env=environment) as process, suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    for path in output.rglob("*"):
        os.utime(path, (tomorrow, tomorrow))
    return fleet.finish(output, [process.returncode])


def changed_log(fleet: Fleet, deed: Deed, folder: Path) -> Verdict:
    """Change the last log in the middle of a run: no other drive may suffer; ``--resume`` reads the changed log."""
    mine = Fleet(Path(shutil.copytree(fleet.logs, folder / "logs")), fleet.calm, fleet.code, fleet.lasts_s)
    output, last = folder / "out", max(mine.logs.glob("*.mcap"))
    with mine.begun(output) as process:
        deed(last)
    wanted, found = contents(fleet.calm), contents(output)
    others = [p for p in wanted if p.startswith("logs/") and last.stem not in p]
    wrong = [f"{p} of the first run" for p in others if found.get(p) != wanted[p]]
    wrong += [] if process.returncode in (0, 3) else [f"exit code {process.returncode}"]
    return Fleet.of(mine.logs, folder / "calm").finish(output, [process.returncode], wrong)


def damaged(fleet: Fleet, patterns: Sequence[str], deed: Deed, folder: Path) -> Verdict:
    """Damage one output of each kind before ``--resume``."""
    output = Path(shutil.copytree(fleet.calm, folder / "out"))
    for i, pattern in enumerate(patterns):
        found = sorted(output.glob(pattern))
        deed(found[i % len(found)])
    return fleet.finish(output, ())


def flip(path: Path) -> None:
    """Change a bit in the middle of a file."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def cut(path: Path) -> None:
    """Cut the second half of a file off."""
    os.truncate(path, path.stat().st_size // 2)


def crash_cases(work: Path, drives: int, count: int, seed: int) -> dict[str, Callable[[Path], Verdict]]:
    """Simulate the drives, run them undisturbed, and return the cases by their planted fault."""
    folders = {"fleet": (drives, DRIVE_S), "few": (FEW, DRIVE_S), "taught": (2, TAUGHT_S), "other": (1, DRIVE_S)}
    for i, (name, (number, length_s)) in enumerate(folders.items()):
        write_suite(work / name, count=number, seed=seed + i, duration_s=length_s)
        (work / name / "manifest.json").unlink()
    fleet, few = (Fleet.of(work / name, work / f"calm-{name}") for name in ("fleet", "few"))
    other, bare = next((work / "other").iterdir()), work / "bare"
    _run(few.logs, bare, "--no-report")
    disks: dict[str, tuple[tuple[str, ...], Path | None]] = {
        "run": (("run", str(few.logs), *_RUN, "-o", "{}/out"), None),
        "learn": (("learn", str(work / "taught"), *_CAR, "any", "-o", "{}/car"), None),
        "extract": (("extract", str(few.logs), *_CAR, "train", "-o", "{}/data"), None),
        "report": (("report", "{}/out"), bare),
        "compare": (("compare", str(few.calm), str(bare), "--html", "{}/a.html", "--junit", "{}/a.xml"), None),
    }
    deeds: dict[str, Deed] = {"replaced": partial(shutil.copy, other), "cut": cut, "removed": Path.unlink}
    harm: dict[str, Deed] = {"a flipped bit": flip, "half of it": cut, "nothing left": Path.unlink}
    kinds = {"each file of a drive": _OF_DRIVES, "each file of the run": _OF_RUN, "the journal": (_JOURNAL,)}
    return {
        f"{count} kills in {drives} drives": partial(kills, fleet, count, seed),
        **{f"disk full at {PLACES} places of `{name}`": partial(full_disk, *disk) for name, disk in disks.items()},
        "two runs into one folder": partial(two_at_once, few),
        "clock set back by a day": partial(clock_set_back, few),
        **{f"a log is {name} during the run": partial(changed_log, few, deed) for name, deed in deeds.items()},
        **{
            f"{what}: {how}, before `--resume`": partial(damaged, few, patterns, deed)
            for what, patterns in kinds.items()
            for how, deed in harm.items()
        },
    }


# --------------------------------------------------------------------------------------------------- kills

#: Content with the time of recording, so that two runs never give the same bytes.
TIMED = (".rrd",)
#: Bytes near the end of a complete file.
ENDS = {".mcap": b"\x89MCAP0\r\n", ".rrd": b"RRF2FOOT"}
#: Files of a drive at the least.
WHOLE = ("estimates.parquet", "metrics.parquet", "recording.rrd", "report.json")
#: Longest wait for the end of a command after a signal.
LONGEST_END_S = 120.0


def kill_run(
    arguments: Sequence[str], output: Path, *, after_s: float, number: int = signal.SIGKILL, writing: bool = False
) -> Ended:
    """Start ``pdhef run ARGUMENTS -o OUTPUT``, send it a signal unless it has ended, and return its end.

    Parameters
    ----------
    arguments : logs and options. number : of the signal.
    after_s : s from the start, or (``writing``) from when it begins to write a log's outputs.

    Raises
    ------
    subprocess.TimeoutExpired
        It did not end, :data:`LONGEST_END_S` after the signal.
    """
    before, quiet, told = _prepared(output), subprocess.DEVNULL, subprocess.PIPE
    words = ("run", *arguments, "-o", str(output))
    with start(*words, stdout=quiet, stderr=told, preexec_fn=_notice_interrupts) as process:
        while writing and process.poll() is None and _prepared(output) <= before:
            time.sleep(0.002)
        with suppress(subprocess.TimeoutExpired):
            process.wait(after_s)
        process.send_signal(number)
        try:
            said = process.communicate(timeout=LONGEST_END_S)[1].decode()
        except subprocess.TimeoutExpired:
            process.kill()
            raise
    return Ended(process.returncode, "", said)


def _notice_interrupts() -> None:
    """Undo the shell's setting for commands in the background: they ignore SIGINT."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def _prepared(output: Path) -> set[int]:
    """Return the inodes of the folders in which logs' outputs are prepared."""
    prepared = set()
    with suppress(FileNotFoundError):  # also of the search, while a run removes its folder
        for folder in (output / "logs" / ".pdhef").glob("*/new"):
            prepared.add(folder.stat().st_ino)
    return prepared


def faults(output: Path, files: Collection[str] = WHOLE) -> list[str]:
    """Return the problems of incomplete files under final names, and of drives without all ``files``."""
    problems = []
    for path in sorted(p for p in output.rglob("*") if p.is_file() and not hidden(p, output)):
        try:
            if path.suffix == ".json":
                json.loads(path.read_text(encoding="utf-8"))
            elif path.suffix == ".parquet":
                pq.ParquetFile(path).read()
            elif ENDS.get(path.suffix, b"") not in path.read_bytes()[-64:]:
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
