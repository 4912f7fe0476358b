"""One damaged log is the same to every command: the same losses in the same words, and exit code 3."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pdhef_logtool.learning.drives import DriveRecord, LearnSettings, exit_code, tell_drive
from pdhef_logtool.learning.learn import learn
from pdhef_logtool.learning.network.extract_command import ExtractSettings, extract
from pdhef_logtool.records.errors import EXIT_PARTIAL
from pdhef_logtool.records.reporter import Reporter
from pdhef_logtool.records.signals import Loss
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import run_logs


def _losses_by_command(log: Path, out: Path, config: RunConfig) -> dict[str, tuple[list[dict[str, Any]], list[str]]]:
    """Run every command on a damaged log; return by command its losses and warnings.

    Every one must end with exit code 3.
    """
    logs, found = [str(log)], {}
    physics = replace(config, network=Path("none"), estimators=("phy-ukf",))
    commands = {
        "extract": lambda tell: extract(logs, out / "2", ExtractSettings(physics), reporter=Reporter(warn=tell)),
        "teach": lambda tell: learn(logs, out / "4", LearnSettings(config=config), reporter=Reporter(warn=tell)),
        "run": lambda tell: run_logs(logs, out / "6", replace(physics, annotate="none"), reporter=Reporter(warn=tell)),
    }
    for name, command in commands.items():
        told: list[str] = []
        result = command(told.append)
        assert result.exit_code == EXIT_PARTIAL, name
        document = json.loads(json.dumps(result.to_dict()))
        if name == "run":
            losses = document["logs"][0]["report"]["losses"]
        else:
            (losses,) = (d["losses"] for d in document["drives"] if d["name"] == log.stem)
        found[name] = losses, [text for text in told if text.startswith(f"{log.stem}: ")]
    return found


@pytest.mark.slow
def test_a_truncated_simulated_log(sample_logs_dir: Path, tmp_path: Path) -> None:
    data = (sample_logs_dir / "road.mcap").read_bytes()
    log = tmp_path / "cut.mcap"
    log.write_bytes(data[: len(data) * 6 // 10])
    config = RunConfig(car=sample_logs_dir / "vehicle.toml", end="34")
    found = _losses_by_command(log, tmp_path / "out", config)
    expected, _ = found["run"]
    lost = [f"cut: {x['what']} ({x['where']})" for x in expected if x["severity"] == "lost"]
    assert lost
    for command, (losses, told) in found.items():
        assert losses == expected, command
        if command != "run":
            assert [text for text in told if text in lost] == lost, command


def record(name: str, **changes: Any) -> DriveRecord:
    return replace(DriveRecord(name, f"{name}.mcap", sha256=name * 64, seconds=6.0, span_s=(1.5, 7.5)), **changes)


def test_what_a_user_must_know_of_a_drive_is_told_in_order_and_decides_the_exit_code() -> None:
    lost = Loss("gap", "2 s are gone", "/imu")
    note = Loss("late", "late", "/imu", severity="note")
    told: list[str] = []
    tell_drive(record("a", notes=("perfect ground truth",), losses=(lost, note), left_out="it is short"), told.append)
    assert told == ["a: perfect ground truth", "a: 2 s are gone (/imu)", "a is left out: it is short"]
    good, bad = record("a", losses=(note,)), record("b", left_out="x")
    assert [exit_code(r) for r in ([good], [good, bad], [good, record("c", losses=(lost,))], [bad])] == [0, 3, 3, 1]
