"""A check is an entry of checks.toml and a function: added that way, it is in every output."""

import json
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator

import numpy as np
import pytest

from pdhef_logtool import RunConfig, inspect_log
from pdhef_logtool.cli.run_tables import render_run
from pdhef_logtool.drive import checks
from pdhef_logtool.drive.check_table import TABLE, judge
from pdhef_logtool.records.checks import Check
from pdhef_logtool.runs.fleet import run_logs
from tests.command_line import rendered

NAME = "speed_m_s.range"
ENTRY = {
    "compares": "the fastest speed with a limit",
    "fails": "it is above 1 m/s",
    "limits": [0.0, 1.0],
    "evidence": "the fastest speed is {value:.1f} m/s",
    "remedy": "check the scale of the speed, which should be in {unit}",
}
PLAN = '[[requirement]]\nid = "a"\nsignal = "sideslip_rad"\nlimit_deg = 90.0\n'


def fastest(drive: checks.CheckedDrive) -> Iterator[Check]:
    if drive.speed is not None:
        yield judge(NAME, float(np.nanmax(drive.speed, initial=0.0)), unit="m/s")


@pytest.fixture
def toy(monkeypatch):
    monkeypatch.setitem(TABLE, NAME, ENTRY)
    monkeypatch.setattr(checks, "FUNCTIONS", (*checks.FUNCTIONS, fastest))
    return NAME


@pytest.mark.slow
@pytest.mark.parametrize("waived", [False, True])
def test_a_check_is_in_report_terminal_page_junit_and_can_be_waived(toy, sample_logs_dir, tmp_path, waived):
    (tmp_path / "plan.toml").write_text(PLAN, encoding="utf-8")
    car, plan, waive = sample_logs_dir / "vehicle.toml", tmp_path / "plan.toml", (toy,) if waived else ()
    config = RunConfig(car=car, estimators=("zero",), annotate="none", plan=plan, waived=waive)
    result = run_logs([str(sample_logs_dir / "dlc.mcap")], tmp_path / "out", config, junit=tmp_path / "junit.xml")
    assert result.exit_code == (0 if waived else 3)
    folder = tmp_path / "out" / "logs" / "dlc"
    (check,) = (c for c in json.loads((folder / "report.json").read_text())["checks"] if c["name"] == toy)
    assert re.fullmatch(r"the fastest speed is \d+\.\d m/s", check["evidence"])
    remedy = "check the scale of the speed, which should be in m/s"
    expected = {"name": toy, "verdict": "failed", "remedy": remedy, "waived": waived}
    assert check == {**expected, "evidence": check["evidence"]}
    word = "waived" if waived else "FAILED"
    assert f"{word}: {toy}: {check['evidence']}. Remedy: {check['remedy']}" in rendered(render_run, result, 200)
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert f'<td class="failed">{toy}{" (waived)" if waived else ""}</td><td>{check["evidence"]}</td>' in page
    (found,) = ET.parse(tmp_path / "junit.xml").getroot().iterfind(f".//property[@name='check {toy}']")
    assert found.attrib["value"] == f"{word.lower()}: {check['evidence']}"


def test_inspect_shows_it(toy, sample_logs_dir):
    found = inspect_log(sample_logs_dir / "dlc.mcap")
    assert [c.verdict for c in found.checks if c.name == toy] == ["failed"]
