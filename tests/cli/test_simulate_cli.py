"""``pdhef simulate`` in all its forms: drives with faults, suites, condition tables, and the gate on RTK truth."""

import json
import shlex
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from tests.command_line import called, pdhef
from truthsim.manoeuvres import MANOEUVRES

pytestmark = pytest.mark.slow


def test_a_drive_s_command_makes_the_same_file_again(tmp_path):
    made = called(
        *("simulate", "step-steer", "--speed", "90", "--mu", "0.7", "--seed", "4", "--duration", "5"),
        *("--amplitude", "0.8", "--vehicle", "suv~3,mass=1.1", "--fault", "burst20:yaw_rate:2:3"),
        *("--sensor", "jitter_s=0.004", "--rtk-rate", "50", "-o", str(tmp_path / "a.mcap"), "--json"),
    )
    assert made.returncode == 0, made.stderr
    facts = json.loads(made.stdout)
    assert facts["peak_ay_m_s2"] < 0.7 * 9.81 and not facts["spun"]
    again = called(*shlex.split(facts["command"])[1:], "-o", str(tmp_path / "b.mcap"))
    assert again.returncode == 0, again.stderr
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_all_manoeuvres_are_listed_and_the_help_tells_of_faults():
    listed = json.loads(called("simulate", "--list", "--json").stdout)["manoeuvres"]
    assert [row["name"] for row in listed] == list(MANOEUVRES)
    text = called("simulate", "--help").stdout
    assert "KIND:WHAT:START:END" in text and "--keep-spins" in text and "suite" in text


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (("suite", "--mu", "0.5"), 2, ("--mu", "suite")),
        (("suite", "--count", "0"), 2, ("count 0",)),
        (("--seed", "5", "suite", "--count", "0"), 2, ("count 0",)),
        (("--count=0", "suite"), 2, ("count 0",)),
        (("dlc", "--sensor", "jitter_s"), 2, ("NAME=NUMBER",)),
        (("dlc", "--sensor", "gps=1"), 2, ("gps", "jitter_s")),
        (("dlc", "--fault", "nonsense"), 2, ("--fault", "KIND:WHAT:START:END", "nonsense")),
        (("loop-the-loop",), 2, ("loop-the-loop", "--list")),
        (("dlc", "--vehicle", "tank"), 2, ("tank", "sedan")),
        (("dlc", "--without", "gps"), 2, ("gps", "wheels")),
        (("dlc-3888-2", "--speed", "100"), 2, ("70 km/h",)),
        (("dlc-3888-2", "--speed", "70", "--mu", "0.2", "--vehicle", "sedan,cg=0.45"), 1, ("spun", "--keep-spins")),
    ],
)
def test_mistakes_are_one_clear_line(arguments, code, words, tmp_path):
    result = called("simulate", *arguments, "-o", str(tmp_path / "x.mcap"))
    assert result.returncode == code, result.stderr
    assert len(result.stderr.strip().splitlines()) == 1 and all(word in result.stderr for word in words)
    assert not list(tmp_path.iterdir())


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


def _plan(tmp_path: Path, limit: float) -> str:
    path = tmp_path / "plan.toml"
    path.write_text(PLAN.format(limit=limit))
    return str(path)


def test_passed_gate_is_0_and_failed_gate_is_4(sample_logs_dir, tmp_path):
    junit, log = tmp_path / "gate.xml", sample_logs_dir / "dlc.mcap"
    pdhef("run", log, "-o", tmp_path, "-e", "phy-ukf", "--annotate", "full", "--car", sample_logs_dir / "vehicle.toml")
    annotated = tmp_path / "logs/dlc/annotated.mcap"
    passed = called("metrics", annotated, *ESTIMATE, "--plan", _plan(tmp_path, 10.0), "--junit", str(junit))
    assert passed.returncode == 0, passed.stderr
    assert "PASS" in passed.stdout
    assert ET.parse(junit).getroot().attrib["failures"] == "0"
    failed = called("metrics", annotated, *ESTIMATE, "--plan", _plan(tmp_path, 0.01), "--junit", str(junit))
    assert failed.returncode == 4
    assert "FAIL: SR-1 (sideslip p95 ≤ 0.01° (worst drive)): worst of 1 drives" in failed.stderr
    (suite,) = ET.parse(junit).getroot()
    assert (suite.attrib["tests"], suite.attrib["failures"], suite.attrib["skipped"]) == ("2", "1", "1")


def test_failed_gate_wins_over_lost_input_and_both_are_said(sample_logs_dir, tmp_path):
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
