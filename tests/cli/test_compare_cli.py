"""``pdhef compare`` as it is called and as it is seen."""

import json
import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from typer.testing import CliRunner

from pdhef_logtool.cli.app import app
from pdhef_logtool.records.errors import UsageError
from tests.results.made_run import write_estimates, write_run

TEN = {f"drive_{i}": 0.001 * (1 + i) for i in range(10)}


def _pdhef(*arguments: str) -> tuple[int, str]:
    result = CliRunner(env={"COLUMNS": "80"}).invoke(app, list(arguments), prog_name="pdhef")
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout


@pytest.fixture
def runs(tmp_path):
    a = write_run(tmp_path / "a", TEN)
    worse = {label: value * (1.1 + 0.01 * i) for i, (label, value) in enumerate(TEN.items())}
    b = write_run(tmp_path / "b", worse, config={"friction": 0.3})
    for folder, slip in ((a, np.zeros(50)), (b, np.full(50, 0.01))):
        write_estimates(folder, "drive_9", pd_hef={"sideslip_rad": slip})
    return str(a), str(b)


def test_a_regression_is_told_with_its_drives_and_where_they_part(runs):
    code, text = _pdhef("compare", *runs, "--max-regression", "5%")
    assert code == 4
    assert all(len(line) <= 80 for line in text.splitlines() if not line.startswith("A "))
    assert "configuration: friction auto → 0.3" in text
    assert re.search(r"drive_9 +0\.573 +0\.682 +\+19\.0 %", text)
    first = " ".join(text[: text.index("\nA ")].split())
    assert first.startswith("Result B is worse: sideslip RMSE +14.5 % (+11.4 % to +17.6 %) of 10 drives; gate closed: ")
    assert first.endswith("Next look at drive_9 first: its error increased most")


def test_json_and_junit_say_the_same(runs, tmp_path):
    plan = tmp_path / "plan.toml"
    ratio = 'id = "{}"\nsignal = "sideslip_rad"\nmetric = "{}"\nbaseline = "run"\nmax_ratio = 1.05\n'
    plan.write_text("".join("[[requirement]]\n" + ratio.format(*named) for named in (("A", "rmse"), ("B", "mae"))))
    code, text = _pdhef("compare", *runs, "--plan", str(plan), "--json", "--junit", str(tmp_path / "plan.xml"))
    document = json.loads(text)
    assert code == document["exit_code"] == 4
    assert [r["outcome"] for r in document["plan"]["requirements"]] == ["FAIL", "INCONCLUSIVE"]
    assert document["plan"]["requirements"][0]["value"] == pytest.approx(1.145, abs=0.001)
    root = ET.parse(tmp_path / "plan.xml").getroot()
    assert [s.get("name") for s in root] == ["plan.toml", "compare"]
    assert (root[0].get("tests"), root[0].get("failures"), root[0].get("skipped")) == ("2", "1", "1")
    _, text = _pdhef("compare", *runs, "--plan", str(plan))
    assert text.startswith("Result   B is worse: ")
    assert "; 1 FAIL, 1 INCONCLUSIVE (plan plan.toml)" in " ".join(text.split())
    assert "\nNext     A: look at the worst drive first" in text
    assert _pdhef("compare", runs[0], runs[0], "--plan", str(plan))[0] == 0
    assert _pdhef("compare", runs[0], runs[0], "--plan", str(plan), "--strict")[0] == 4


@pytest.mark.parametrize("width", ["80", "120"])
@pytest.mark.parametrize(
    ("command", "result"),
    [
        (("compare", "A", "B"), "B is worse"),
        (("events", "B", "--where", "sideslip_deg > 0.5"), "1 event in 1 of 1 drives, 0.49 s in all"),
        (("report", "A"), "pages of the run and of 10 logs"),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)
def test_three_lines_come_first(command, result, width, runs, monkeypatch):
    monkeypatch.setenv("COLUMNS", width)
    _, text = _pdhef(*({"A": runs[0], "B": runs[1]}.get(word, word) for word in command))
    head = re.split(r"\n *\n", text)[0]
    assert re.findall(r"^(\w+) +\S", head, re.MULTILINE) == ["Result", "Assumed", "Next"]
    assert result in " ".join(head.split())


def test_a_history_is_a_table_of_runs_in_every_output(runs, tmp_path):
    code, text = _pdhef("compare", *runs, runs[1], "--html", str(tmp_path / "history.html"))
    assert code == 0 and "Result   equal: all figures" in text
    assert re.search(r"unknown +10 .*\+14\.5 %.*worse", text.replace("\n", " "))
    page = (tmp_path / "history.html").read_text()
    assert "<h2>History</h2>" in page and page.count('data-figure="') == 1
    with pytest.raises(UsageError, match="two runs or more, got one"):
        _pdhef("compare", runs[0])


@pytest.mark.parametrize("option", ["--html", "--junit"])
def test_an_output_that_is_an_input_is_refused(runs, option):
    with pytest.raises(UsageError, match="an output that is no input"):
        _pdhef("compare", *runs, option, f"{runs[0]}/run.json")


def test_a_plan_and_a_figure_of_the_command_line_do_not_go_together(runs, tmp_path):
    _pdhef("plan", "init", "-o", str(tmp_path / "plan.toml"))
    with pytest.raises(UsageError, match="--plan or --metric, got both"):
        _pdhef("compare", *runs, "--plan", str(tmp_path / "plan.toml"), "--metric", "mae")
    with pytest.raises(UsageError, match=r"a figure; lower is better, got metric = bias"):
        _pdhef("compare", *runs, "--metric", "bias")
    with pytest.raises(UsageError, match=r"a share such as 5% or 0\.05, got five"):
        _pdhef("compare", *runs, "--max-regression", "five")


def test_events_are_told_in_a_table_with_what_was_not_searched(runs):
    code, text = _pdhef("events", runs[1], "--where", "sideslip_deg > 0.5")
    assert code == 0
    assert re.search(r"drive_9 +0\.00 +0\.49 +0\.49 +0\.573", text)
    assert "1 event in 1 of 1 drives, 0.49 s in all" in text
    assert "not searched, it has no estimates.parquet: drive_0, drive_1" in text
    assert json.loads(_pdhef("events", runs[1], "--where", "valid", "--json")[1])["events"][0]["drive"] == "drive_9"
    for pad in ("five", "-1s", "5 min"):
        with pytest.raises(UsageError, match="a time such as 5s"):
            _pdhef("events", runs[1], "--where", "valid", "--pad", pad)
