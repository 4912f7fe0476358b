"""Logs and outputs on storage that fails during a run."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from pdhef_logtool.logs import byte_source
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.runs import working
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.working import DriveEnd, DriveTask, run_drive
from pdhef_logtool.storage.files import write_bytes
from pdhef_logtool.workers.supervisor import Tell
from tests.failing_writes import failing_writes
from tests.runs.stub_drives import stub_drive
from tests.runs.test_fleet_runs import Counted, contents, named_logs, run

CONFIG = RunConfig(car=Path("saloon"), estimators=("zero",), keep="metrics", end="1.5")


@pytest.fixture
def logs(sample_logs_dir: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "logs"
    folder.mkdir()
    for name in ("dlc", "step"):
        shutil.copy(sample_logs_dir / f"{name}.mcap", folder)
    return folder


@pytest.mark.slow
def test_a_log_that_changes_fails_alone_and_is_run_again(logs: Path, tmp_path: Path) -> None:
    def changing(task: DriveTask, tell: Tell) -> DriveEnd | OutputError:
        def told(text: str, share: float) -> None:
            if task.log.stem == "dlc" and share > 0.5:
                os.utime(task.log.path)
            tell(text, share)

        return run_drive(task, told)

    result = run([str(logs)], tmp_path / "out", CONFIG, work=changing)
    assert result.exit_code == 3
    failed = {r.outcome.log: r.outcome.failed for r in result.results}
    assert failed["step"] is None
    assert "changed while it was read" in str(failed["dlc"])
    assert not (tmp_path / "out/logs/dlc").exists()
    assert run([str(logs)], tmp_path / "out", CONFIG, work=run_drive, resume=True).exit_code == 0


@pytest.mark.slow
@pytest.mark.parametrize("returns", [True, False])
def test_a_log_that_vanishes_is_waited_for_and_is_not_given_up(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, returns: bool
) -> None:
    monkeypatch.setattr(working, "_WAITS_S", (0.0, 0.0))
    away, lines = tmp_path / "away", list[str]()

    def vanishing(task: DriveTask, tell: Tell) -> DriveEnd | OutputError:
        if task.log.stem == "dlc":
            logs.rename(away)

        def told(text: str, share: float) -> None:
            lines.append(text)
            if returns and text == "dlc: waits for the log":
                away.rename(logs)

        end = run_drive(task, told)
        if away.exists():
            away.rename(logs)
        return end

    out = tmp_path / "out"
    assert run([str(logs)], out, CONFIG, work=vanishing).exit_code == (0 if returns else 3)
    assert lines.count("dlc: waits for the log") == (1 if returns else 2)
    assert run([str(logs)], out, CONFIG, work=run_drive, resume=True).exit_code == 0


def test_a_disk_that_fails_is_no_damage_of_the_log() -> None:
    with pytest.raises(byte_source.SourceError, match="Stale file handle"):
        byte_source.raise_source_error(OSError(116, "Stale file handle"))
    byte_source.raise_source_error(ValueError("damage"))


def full_disk(task: DriveTask, tell: Tell) -> DriveEnd | OutputError:
    """Meet a full disk at the drive ``b``."""
    if task.log.stem != "b":
        return stub_drive(task, tell)
    try:
        with failing_writes(1):
            write_bytes(task.output / "x", b"x")
    except OutputError as error:
        assert error.ends_run
        return error
    raise AssertionError


def test_a_full_disk_ends_the_run_at_once_and_quarantines_nothing(tmp_path: Path) -> None:
    folder, out, work = named_logs(tmp_path / "logs", "a", "b", "c", "d"), tmp_path / "out", Counted(full_disk)
    run(folder, tmp_path / "undisturbed")
    with pytest.raises(OutputError, match=r"No space left.*; 1 of 4 logs are done; --resume goes on$") as raised:
        run(folder, out, work=work)
    assert (raised.value.exit_code, work.asked) == (1, ["a", "b"])
    assert run(folder, out, resume=True).exit_code == 0
    assert contents(out) == contents(tmp_path / "undisturbed")
