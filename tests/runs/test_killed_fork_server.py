"""A run whose fork server is killed: before the first drive, while drives are worked on, and again and again."""

from __future__ import annotations

import os
import signal
from functools import partial
from pathlib import Path

import pytest

from pdhef_logtool.records.errors import WorkerError
from pdhef_logtool.runs import fleet
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
