"""``pdhef metrics`` and the verdicts of a plan as a user and a CI system meet them."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from tests.command_line import called, pdhef

pytestmark = pytest.mark.slow

ESTIMATE = ("--estimate", "/pdhef/phy_ukf/state")
PLAN = """
[[requirement]]
id = "SR-1"
signal = "sideslip_rad"
metric = "p95_abs"
statistic = "worst drive"
limit_deg = {limit}
[[requirement]]
id = "SR-2"
estimator = "pd-hef"
signal = "sideslip_rad"
limit_deg = 0.1
"""


@pytest.fixture(scope="module")
def annotated(sample_logs_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    out = tmp_path_factory.mktemp("annotated")
    vehicle = str(sample_logs_dir / "vehicle.toml")
    pdhef("run", sample_logs_dir / "dlc.mcap", "-o", out, "-e", "phy-ukf", "--annotate", "full", "--car", vehicle)
    return str(out / "logs/dlc/annotated.mcap")


def _plan(tmp_path: Path, limit: float) -> str:
    path = tmp_path / "plan.toml"
    path.write_text(PLAN.format(limit=limit))
    return str(path)


def test_passed_gate_is_0_and_failed_gate_is_4(annotated: str, tmp_path: Path) -> None:
    junit = tmp_path / "gate.xml"
    passed = called("metrics", annotated, *ESTIMATE, "--plan", _plan(tmp_path, 10.0), "--junit", str(junit))
    assert passed.returncode == 0, passed.stderr
    assert "PASS" in passed.stdout
    assert ET.parse(junit).getroot().attrib["failures"] == "0"
    failed = called("metrics", annotated, *ESTIMATE, "--plan", _plan(tmp_path, 0.01), "--junit", str(junit))
    assert failed.returncode == 4
    assert "FAIL: SR-1 (sideslip p95 ≤ 0.01° (worst drive)): worst of 1 drives" in failed.stderr
    (suite,) = ET.parse(junit).getroot()
    assert (suite.attrib["tests"], suite.attrib["failures"], suite.attrib["skipped"]) == ("2", "1", "1")


def test_failed_gate_wins_over_lost_input_and_both_are_said(sample_logs_dir: Path, tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    whole = (sample_logs_dir / "dlc.mcap").read_bytes()
    (tmp_path / "logs/cut.mcap").write_bytes(whole[: len(whole) * 3 // 4])
    log = str(tmp_path / "logs/cut.mcap")
    options = ("-e", "zero", "--annotate", "none", "--no-report", "-o", str(tmp_path / "out"))
    both = called("run", log, *options, "--plan", _plan(tmp_path, 0.01))
    assert both.returncode == 4
    assert "FAIL: SR-1" in both.stderr
    assert "lost" in both.stderr
    (tmp_path / "logs/bad.mcap").write_bytes(b"no log")
    junit = tmp_path / "gate.xml"
    several = called("run", tmp_path / "logs", *options, "--plan", _plan(tmp_path, 10.0), "--junit", junit)
    assert several.returncode == 3  # a log that could not be read is no drive of the plan
    assert ET.parse(junit).getroot().attrib["failures"] == "0"
