"""A run whose fork server is killed: before the first drive, while drives are worked on, and again and again."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from pdhef_logtool.records.errors import WorkerError
from pdhef_logtool.runs import fleet
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import run_logs
from pdhef_logtool.runs.working import DriveEnd, DriveTask
from pdhef_logtool.storage.files import PendingFile
from pdhef_logtool.workers.supervisor import Limits, Tell
from tests.runs.stub_drives import stub_drive
from tests.runs.test_fleet_runs import contents, named_logs, run
from tests.workers.planted_work import DEATHS, MOST_DEATHS

RESTARTS = [f"the fork server died (signal 9): restart {n} of 3, no item is lost" for n in (1, 2, 3)]


def mortal_drive(marks: Path, task: DriveTask, tell: Tell) -> DriveEnd:
    """Kill the fork server and then itself in the middle of the drive ``b``, the first time."""
    pending = PendingFile(task.output / "logs" / task.log.stem / "report.json")
    pending.path.write_text("half")
    tell("half", 0.5)
    if task.log.stem == "b" and not (marks / "killed").exists():
        (marks / "killed").touch()
        os.kill(os.getppid(), signal.SIGKILL)
        os.kill(os.getpid(), signal.SIGKILL)
    pending.discard()
    return stub_drive(task, tell)


@pytest.fixture
def dies_at_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file with a letter for each time that the fork server was killed while it loaded."""
    (tmp_path / "deaths").touch()
    monkeypatch.setenv(DEATHS, str(tmp_path / "deaths"))
    monkeypatch.setattr(fleet, "_PRELOAD", ("tests.workers.planted_work:die_at_start", "tests.runs.stub_drives"))
    return tmp_path / "deaths"


def test_a_fork_server_that_is_killed_costs_no_drive(
    tmp_path: Path, dies_at_start: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    logs, out, warned = named_logs(tmp_path / "logs", *"abcd"), tmp_path / "out", list[str]()
    run(logs, tmp_path / "undisturbed")
    monkeypatch.setenv(MOST_DEATHS, "1")
    work = partial(mortal_drive, tmp_path)
    result = run(logs, out, work=work, jobs=2, limits=Limits(60.0), warn=warned.append)
    assert result.exit_code == 0
    assert contents(out) == contents(tmp_path / "undisturbed")
    assert warned == RESTARTS[:2]
    assert not list(out.rglob(".*"))


@pytest.mark.slow
def test_a_fork_server_that_is_always_killed_ends_the_run_with_one_error_and_the_run_goes_on_later(
    tmp_path: Path, dies_at_start: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    logs, out, warned = named_logs(tmp_path / "logs", *"abcd"), tmp_path / "out", list[str]()
    run(logs, tmp_path / "undisturbed")
    monkeypatch.setenv(MOST_DEATHS, "99")
    with pytest.raises(WorkerError, match=r"4 that died.*--resume goes on"):
        run(logs, out, jobs=2, limits=Limits(60.0), warn=warned.append)
    assert warned == RESTARTS
    assert not list(out.rglob(".*"))
    monkeypatch.setenv(MOST_DEATHS, "0")
    assert run(logs, out, jobs=2, limits=Limits(60.0), resume=True).exit_code == 0
    assert contents(out) == contents(tmp_path / "undisturbed")


@pytest.mark.slow
@pytest.mark.parametrize(("kills", "code"), [(1, 0), (99, 1)])
def test_the_command_outlives_its_fork_server_or_says_why_not(
    kills: int, code: int, sample_logs_dir: Path, tmp_path: Path
) -> None:
    logs = [str(sample_logs_dir / f"{name}.mcap") for name in ("dlc", "step")]
    config = RunConfig(car=Path("saloon"), estimators=("zero", "kinematic"), keep="estimates", end="1.5")
    run_logs(logs, tmp_path / "undisturbed", config, report=False)
    options = ["--car", "saloon", "-e", "zero,kinematic", "--keep", "estimates", "--end", "1.5", "--no-report"]
    command = [
        sys.executable,
        "-m",
        "pdhef_logtool",
        "run",
        *logs,
        "-o",
        str(tmp_path / "out"),
        *options,
        "--jobs",
        "2",
    ]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True) as process:
        killed: set[int] = set()
        while process.poll() is None:
            for pid in _children(process.pid):
                if b"forking import serve" in _command_line(pid) and pid not in killed and len(killed) < kills:
                    os.kill(pid, signal.SIGKILL)
                    killed.add(pid)
            time.sleep(0.005)
        _, err = process.communicate()  # until no process has its standard error any more
    assert process.returncode == code, err
    assert len(killed) == min(kills, 4)
    assert all(line in err for line in RESTARTS[: min(kills, 3)])
    assert not list((tmp_path / "out").rglob(".*"))
    if code:
        assert err.splitlines()[-1].startswith("pdhef: worker processes: expected a fork server that keeps running")
    else:
        assert contents(tmp_path / "out") == contents(tmp_path / "undisturbed")


def _children(pid: int) -> list[int]:
    try:
        return [int(x) for x in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []


def _command_line(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""
