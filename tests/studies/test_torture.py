"""The fixed part of the torture: mutants with a fixed seed, the bombs, and the harness itself against known faults."""

import signal
import sqlite3
import subprocess
from contextlib import closing
from pathlib import Path

import pytest

from studies.torture import crashes, workers
from studies.torture.bombs import BOMBS, judge_bomb
from studies.torture.mutants import format_judge
from studies.torture.seeds import SEEDS
from studies.torture.workers import Ended, command, judge

_LAST_NS = 2**63 - 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        f"UPDATE messages SET timestamp = {_LAST_NS} WHERE id > 156",
        f"UPDATE messages SET topic_id = x'3e22', timestamp = {_LAST_NS} WHERE id IN (21, 148)",
        f"UPDATE messages SET timestamp = {2**32 - 2**63} WHERE id = 139",  # in 1677
        "DELETE FROM messages",
        # The orientation of some ground truth lacks a component.
        "UPDATE messages SET data = CAST(substr(data, 1, 84) || x'000000000000f87f' || substr(data, 93) AS BLOB) "
        "WHERE topic_id = 2 AND id % 3 = 0",
        "UPDATE message_definitions SET encoded_message_definition = replace(encoded_message_definition, "
        "'Quaternion' || char(10) || 'float64 x', 'Quaternion' || char(10) || 'float64 h')",
    ],
)
def test_databases_that_did_harm_once(change, tmp_path):
    path = tmp_path / "rosbag2.db3"
    SEEDS[path.name](path)
    with closing(sqlite3.connect(path)) as database, database:
        assert database.execute(change).rowcount > 0
    for words in (["inspect", str(path)], ["run", str(path), "--car", "saloon", "-o", str(tmp_path / "out")]):
        assert judge(command(*words), (0, 1, 3)).problem == ""


# Making and unpacking gigabytes takes seconds; the rest takes as long as a start.
_LARGE = ("GiB", "MB", "channels", "million")


@pytest.mark.slow
@pytest.mark.parametrize("bomb", [b for b in BOMBS if not any(w in b.name for w in _LARGE)][::12], ids=lambda b: b.name)
def test_a_bomb_ends_in_time_with_its_exit_code(bomb, tmp_path, monkeypatch):
    monkeypatch.setattr("studies.torture.bombs.LIMIT_S", 120.0)  # only ends a hang: others may load the machine
    assert judge_bomb(bomb, tmp_path).problem == ""


def test_what_a_command_leaves_or_takes_is_wrong(tmp_path, monkeypatch):
    def harmful(command: str, log: str, *_: str, cwd: Path, env: dict[str, str], limit_s: float) -> workers.Process:
        assert (command, Path(log).name, limit_s) == ("inspect", "drive.csv", 60.0)
        (cwd / "formula_was_run").touch()
        Path(env["TMPDIR"], "copy").touch()
        return workers.Process(0, "Traceback", "Traceback", 61.0, 2 << 30, late=True, left=True)

    monkeypatch.setattr("studies.torture.mutants.measured", harmful)
    problem = format_judge(tmp_path, "csv", 1)(1).problem
    assert problem == "a traceback; more than 60 s; 2048 MiB; left a process; left formula_was_run; left copy"
    assert {path.name for path in tmp_path.iterdir()} == {"seeds", "canary", "canary.h5"}


@pytest.mark.slow
@pytest.mark.parametrize(("script", "late", "left"), [("sleep 600 & exit 3", False, True), ("sleep 600", True, False)])
def test_what_outlives_a_command_or_its_limit_is_ended(script, late, left, monkeypatch):
    def shell(*_: str, **options: object) -> subprocess.Popen[bytes]:
        return subprocess.Popen(["sh", "-c", script], start_new_session=True, **options)

    monkeypatch.setattr(workers, "start", shell)
    monkeypatch.setattr(workers, "END_S", 0.5 if left else 60.0)
    process = workers.measured(limit_s=1.0 if late else 600.0)
    assert (process.late, process.left, process.code) == (late, left, -signal.SIGKILL if late else 3)


def test_what_a_crash_changed_is_lost_stale_or_unequal(tmp_path):
    for folder, files in {"calm": {"a": "1", "b": "2", "c": "3"}, "out": {"b": "4", "c": "3", "d": "5"}}.items():
        (tmp_path / folder).mkdir()
        for name, text in files.items():
            (tmp_path / folder / name).write_text(text)
    found = crashes.compared(tmp_path / "calm", tmp_path / "out", [-9, -9, 0], ["", "late"])
    assert (found.end, found.problem) == ("-9 (2 x), 0", "late; lost: a; stale: d; unequal: b")
    assert found.costs == {"lost": 1, "stale": 1, "unequal": 1}


@pytest.mark.slow
def test_a_full_disk_ends_extract_at_once(sample_logs_dir, tmp_path, monkeypatch):
    monkeypatch.setattr(crashes, "PLACES", 1)
    logs = [str(sample_logs_dir / f"{name}.mcap") for name in ("dlc", "step")]
    verdict = crashes.full_disk(
        ("extract", *logs, "--car", "saloon", "--split", "train", "-o", "{}/data"), None, tmp_path
    )
    if verdict.end.startswith("skipped"):
        pytest.skip(verdict.end)
    assert (verdict.end, verdict.problem) == ("0, 1", "")


@pytest.mark.parametrize(
    ("ended", "wrong"),
    [
        (Ended(0, "fine", ""), False),
        (Ended(1, "", "pdhef: drive.mcap: expected a log, got none\n"), False),
        (Ended(1, "", "Traceback\nValueError: x\n"), True),
        (Ended(1, "", "pdhef: internal error, ValueError: x\n"), True),
        (Ended(9, "", "pdhef: x\n"), True),
        (Ended(0, "topic \x1b[2J", ""), True),
        (Ended(3, "", "warning: \u202ereversed\n"), True),
    ],
)
def test_what_counts_as_wrong(ended, wrong):
    assert bool(judge(ended).problem) is wrong
