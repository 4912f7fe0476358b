"""Places and neighbours that do harm: no home, no right to write, a full disk, a second run, a file that shrinks."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO

from studies.pages import ROOT
from studies.torture.killing import hidden
from studies.torture.numerics import write_hours
from studies.torture.outside import measured, start
from studies.torture.workers import Ended, Verdict, judge

_SAMPLE = ROOT / "sample_logs" / "dlc.mcap"
_CAR = ("--car", "saloon")
_NOBODY = ("setpriv", "--reuid=65534", "--regid=65534", "--clear-groups", "--")


def as_nobody(work: Path) -> Verdict:
    """Run from an installation that nobody may write, without a home."""
    if os.geteuid() != 0 or shutil.which("setpriv") is None:
        return Verdict("skipped: another user needs root and setpriv")
    installed = work / "installed"
    for name in ("pdhef_logtool", "truthsim", "schemas"):
        shutil.copytree(ROOT / name, installed / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(_SAMPLE, work / "dlc.mcap")
    subprocess.run(["chmod", "-R", "a+rX,a-w", str(installed)], check=True)
    output = work / "nobodys"
    output.mkdir()
    os.chown(output, 65534, 65534)
    for folder in (output, *output.parents):
        if not folder.stat().st_mode & 0o001:
            return Verdict(f"skipped: nobody may not enter {folder}")
    env = {
        "PATH": os.environ["PATH"],
        "HOME": "/nonexistent",
        "PYTHONPATH": str(installed),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    log = str(work / "dlc.mcap")
    ended = measured("run", log, "-o", str(output), *_CAR, prefix=_NOBODY, env=env, cwd="/", limit_s=400.0)
    return judge(ended, (0,))


def full_disk(work: Path) -> Verdict:
    """Run into a file system of 1 MB, three times as small as the outputs."""
    disk = work / "disk"
    disk.mkdir()
    if (
        os.geteuid() != 0
        or subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "none", str(disk)], check=False).returncode
    ):
        return Verdict("skipped: a small file system needs root and mount")
    try:
        verdict = judge(measured("run", str(_SAMPLE), "-o", str(disk / "out"), *_CAR, limit_s=120.0), (1, 3))
        left = [p for p in disk.rglob("*") if p.suffix in (".parquet", ".mcap", ".rrd") and not hidden(p, disk)]
        return Verdict(verdict.end, verdict.problem or (f"left {left}" if left and verdict.end == "exit 1" else ""))
    finally:
        subprocess.run(["umount", "-l", str(disk)], check=False)


def second_run(work: Path) -> Verdict:
    """Start a run in a folder in which one is going on."""
    road = str(ROOT / "sample_logs" / "road.mcap")
    with start(
        "run", road, "-o", str(work / "out"), *_CAR, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as first:
        until = time.monotonic() + 60.0
        while not (work / "out").is_dir() and time.monotonic() < until:
            time.sleep(0.05)
        time.sleep(1.0)
        second = measured("run", str(_SAMPLE), "-o", str(work / "out"), *_CAR)
        verdict = judge(second, (1, 2))
        if first.wait(300) != 0:
            return Verdict(verdict.end, f"the first run ended with {first.returncode}")
    if any((work / "out").rglob("*dlc*")):
        return Verdict(verdict.end, "the second run wrote something")
    return verdict


def shrinking_file(work: Path) -> Verdict:
    """Cut a log while it is read."""
    log = work / "hour.mcap"
    write_hours(log, 1.0)
    with start("inspect", str(log), stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        files, until = Path(f"/proc/{process.pid}/fd"), time.monotonic() + 60.0
        while str(log) not in _opened(files) and time.monotonic() < until:
            time.sleep(0.01)
        time.sleep(0.3)
        with log.open("r+b") as file:
            file.truncate(log.stat().st_size // 3)
        out, err = process.communicate(timeout=120)
    return judge(Ended(process.returncode, out.decode(), err.decode()), (1, 3))


def _opened(files: Path) -> set[str]:
    """Return what the descriptors below a folder of ``/proc`` refer to."""
    targets = set()
    for file in files.iterdir():
        with contextlib.suppress(OSError):
            targets.add(str(file.readlink()))
    return targets


def output_is_input(work: Path) -> Verdict:
    """Run on an output of ours, into the folder that it came from."""
    measured("run", str(_SAMPLE), "-o", str(work / "out"), *_CAR)
    name = next((work / "out" / "logs").iterdir()).name
    inner = work / "out" / "logs" / "annotated"
    inner.mkdir()
    shutil.copy(work / "out" / "logs" / name / "annotated.mcap", inner / "annotated.mcap")
    before = (inner / "annotated.mcap").read_bytes()
    ended = measured("run", str(inner / "annotated.mcap"), "-o", str(work / "out"), "--annotate", "sidecar", *_CAR)
    verdict = judge(ended, (1, 2))
    same = (inner / "annotated.mcap").is_file() and (inner / "annotated.mcap").read_bytes() == before
    return Verdict(verdict.end, verdict.problem or ("" if same else "the recording changed"))


def full_stdout(work: Path) -> Verdict:
    """Print to a device that is full."""
    del work
    return judge(_inspected(Path("/dev/full").open("wb")), (1,))


def closed_pipe(work: Path) -> Verdict:
    """Print to a reader that went away."""
    del work
    read, write = os.pipe()
    os.close(read)
    ended = _inspected(os.fdopen(write, "wb"))
    verdict = judge(ended, (141,))
    return Verdict(verdict.end, verdict.problem or ended.err)


def _inspected(output: IO[bytes]) -> Ended:
    """Print to a file and close it."""
    with output, start("inspect", str(_SAMPLE), stdout=output, stderr=subprocess.PIPE) as process:
        err = process.communicate(timeout=60)[1].decode()
    return Ended(process.returncode, "", err)


PLACES: dict[str, Callable[[Path], Verdict]] = {
    "as nobody, no home, read-only installation": as_nobody,
    "a full disk": full_disk,
    "a second run in the same folder": second_run,
    "a log that is cut while it is read": shrinking_file,
    "an output that is the input": output_is_input,
    "a full standard output": full_stdout,
    "a reader that closes the pipe": closed_pipe,
}
