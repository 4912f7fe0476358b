"""One damaged log is the same to every command: the same losses in the same words, and exit code 3."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pdhef_logtool.learning.drives import LearnSettings
from pdhef_logtool.learning.learn import learn
from pdhef_logtool.learning.network.extract_command import ExtractSettings, extract
from pdhef_logtool.records.errors import EXIT_PARTIAL
from pdhef_logtool.records.reporter import Reporter
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import run_logs

pytestmark = pytest.mark.slow


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
