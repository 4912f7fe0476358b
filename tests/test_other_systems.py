"""Windows and macOS: commands with one process need no POSIX-only function."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from pdhef_logtool.records.processes import is_alive, process_name
from pdhef_logtool.workers import supervisor
from pdhef_logtool.workers.supervisor import Limits, supervise
from tests.workers.planted_work import planted

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.slow
def test_runs_need_no_posix(tmp_path):
    """The process has no POSIX-only functions, and streams in ASCII; the second run replaces a folder of the first."""
    logs = [f"{ROOT}/sample_logs/{name}" for name in ("step_rosbag2", "dlc.mcap")]
    options = "--car saloon --jobs 2 --end 2 -o out -e"
    commands = f"run {logs[0]} {logs[1]} {options} zero then run {logs[1]} {options} pd-hef --no-report"
    env = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONIOENCODING": "ascii", "PDHEF_TRACEBACK": "1"}
    words = [sys.executable, ROOT / "tests/without_posix.py", *commands.split()]
    ran = subprocess.run(words, cwd=tmp_path, env=env, capture_output=True, encoding="ascii", check=False)
    assert ran.returncode == 0, ran.stderr
    assert ran.stderr.count("worker processes need Linux: one process does all the work") == 2
    names = {path.name for path in (tmp_path / "out/logs/dlc").iterdir()}
    assert {"report.json", "annotated.mcap", "recording.rrd", "estimates.parquet"} <= names
    assert (tmp_path / "out/logs/step_rosbag2/report.html").is_file()
    assert [path.name for path in tmp_path.rglob(".*")] == []


def test_items_end_in_this_process_where_no_workers_can_be_forked(monkeypatch):
    monkeypatch.setattr(supervisor, "can_fork", lambda: False)
    warned: list[str] = []
    items = [("where", ""), ("raise", ""), ("where", "")]
    ended = list(supervise(planted, items, jobs=2, limits=Limits(60.0), warn=warned.append))
    assert [e.failure is None for e in ended] == [True, False, True]
    assert {e.result[0] for e in ended if e.result} == {os.getpid()}
    assert len(warned) == 1


def test_processes_are_known_by_their_start_without_proc(monkeypatch):
    def unreadable(_path: Path) -> bytes:
        raise FileNotFoundError

    monkeypatch.setattr(Path, "read_bytes", unreadable)
    host, pid, start = process_name().split("-")
    assert is_alive(process_name()) is True
    assert is_alive(f"{host}-{pid}-{int(start) + 1}") is False
