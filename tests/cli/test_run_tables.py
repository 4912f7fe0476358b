"""Printed output of a run: result first, within the terminal width, complete names, no repeated line."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pdhef_logtool.cli.run_tables import render_fleet, render_run
from pdhef_logtool.estimators.table import SPECS
from pdhef_logtool.records.signals import Loss
from pdhef_logtool.results.run_report import LogOutcome
from pdhef_logtool.runs.run_result import LogResult, RunResult
from tests.command_line import rendered
from tests.run_report import MAIN, SHA, errors_deg, figures, ran, report, truth

NAMES = [s.name for s in SPECS]
GOOD = [
    *errors_deg(pd_hef=0.1, physics=0.2, zero=1.0),
    *figures(("pd-hef", "sideslip_rad", "coverage95", 0.96), ("pd-hef", "yaw_rate_rad_s", "rmse", 0.01)),
]
ALL_METRICS = [
    row
    for name in NAMES
    for row in figures(
        *((name, "sideslip_rad", metric, 0.01) for metric in ("rmse", "p95_abs", "max_abs", "lag_s", "coverage95")),
        *((name, signal, "rmse", 0.1) for signal in ("vy_m_s", "vx_m_s", "yaw_rate_rad_s", "ay_m_s2", "lateral_1s_m")),
        (name, "state", "nis", 1.0),
        (name, "state", "nis_dof", 2.0),
    )
]
CHECK = {"subject": "steer_rad", "evidence": "its gain is -1.", "remedy": "scale = -1", "waived": False}


def shown(*reports: dict[str, Any], width: int = 80, failed: str = "") -> str:
    results = [
        LogResult(LogOutcome(r["log"]["name"], "a.mcap", SHA, lost=["x"] * len(r["losses"])), None, r) for r in reports
    ]
    if failed:
        results.append(LogResult(LogOutcome("bad", "bad.mcap", None, failed=failed), None, None, ()))
    return rendered(render_run, RunResult(Path("out"), tuple(results)), width)


def named(name: str, **changes: Any) -> dict[str, Any]:
    return report(**{"metrics": GOOD, **changes}, name=name)


def rows(text: str, *names: str) -> list[str]:
    """Return the table rows: lines that begin with one of the names."""
    return [line for line in text.splitlines() if line.strip().startswith(names)]


@pytest.mark.parametrize("width", [80, 120])
def test_every_estimator_fits_and_keeps_its_whole_name(width):
    every = [ran(n, causal=n != "pd-hef-smoothed") for n in NAMES]
    main = replace(MAIN, shown=NAMES, named=True)
    text = shown(report(main, estimators=every, metrics=ALL_METRICS), width=width)
    assert all(len(line) <= width for line in text.splitlines())
    assert "…" not in text
    table = {line.split()[0] for line in text.splitlines() if line.startswith(" ") and line.split()}
    assert set(NAMES) <= table
    assert "pd-hef-smoothed *" in text
    assert "* not causal" in text
    assert ("max °" in text) == (width == 120)  # the least important column is dropped first


def test_the_answer_stands_first_then_three_rows():
    text = shown(named("drive"))
    order = [text.index(word) for word in ("Result", "Assumed", "Next", "drive  mcap", "95 % CI", "estimator")]
    assert order == sorted(order)
    scores = rows(text[text.index("estimator") :], "pd-hef ", "physics ", "zero ")
    assert [line.split()[0] for line in scores] == ["pd-hef", "physics", "zero"]
    assert "In hindsight" not in text  # no other estimator was better


def test_without_truth_there_is_no_column_of_errors():
    metrics = figures(
        ("pd-hef", "vy_m_s", "d2", 0.1),
        ("zero", "vy_m_s", "d2", 1.0),
        ("physics~pd-hef", "sideslip_rad", "disagreement_rms", 0.01),
    )
    text = shown(named("drive", truth=truth(), metrics=metrics))
    assert "Consistency" in text
    assert "RMSE" not in text
    assert "from pd-hef °" in text
    assert rows(text, "physics ")[0].split() == ["physics", "0.573", "-"]


def test_failed_checks_stand_above_the_table_and_undecided_ones_are_named():
    document = report(metrics=GOOD)
    checks = [("steer_rad.sign", "failed"), ("ay_m_s2.unit", "undecided"), ("speed_m_s.unit", "passed")]
    document["checks"] = [{**CHECK, "name": name, "verdict": verdict} for name, verdict in checks]
    text = shown(document)
    assert text.index("FAILED: steer_rad.sign: its gain is -1. Remedy: scale = -1") < text.index("estimator")
    assert "Not observable in this drive: ay_m_s2.unit" in text
    assert "speed_m_s.unit" not in text
    document["checks"][0]["waived"] = True
    assert "waived: steer_rad.sign" in shown(document)


def test_several_logs_have_one_table_and_say_once_what_holds_for_all():
    first, second = named("monday"), named("tuesday", truth=truth(), metrics=[], remarks=["a remark"])
    lost = named("wednesday", losses=[Loss("gap", "0.4 s without samples", "/imu")], remarks=["a remark"])
    text = shown(first, second, lost, failed="no log")
    assert all(len(line) <= 80 for line in text.splitlines())
    assert rows(text, "monday")[0].split() == ["monday", "10", "0.100", "0.200", "1.000", "0.96"]
    assert rows(text, "tuesday")[0].split()[-3:] == ["no", "ground", "truth"]
    assert rows(text, "wednesday")[0].split()[-2:] == ["input", "lost"]
    assert text.count("car golf") == 1 and "a remark" not in text
    assert "lost: 0.4 s without samples (/imu)" in text
    assert text.count("monday") == 1  # no further line about this log
    assert "bad  failed: no log" in text
    assert "4 logs: 3 done, 1 failed, 1 with input lost" in text


def test_estimators_that_were_skipped_are_named_with_the_reason_once():
    drive = named("drive")
    skipped = {"outcome": "skipped", "reason": "needs a gyro"}
    drive["estimators"] += [{**drive["estimators"][0], "name": name, **skipped} for name in ("one", "two")]
    (line,) = (line for line in shown(drive).splitlines() if "skipped" in line)
    assert line.strip() == "one, two skipped: needs a gyro"


def test_a_fleet_is_told_in_a_few_lines_within_80_columns():
    spread = {"drives": 290, "median_rad": 0.001, "p90_rad": 0.003, "max_rad": 0.01}
    errors_rad = {"pd-hef": 0.01, "zero": 0.2}
    worst = [{"log": f"a_day_in_may__drive_{i:05d}", "main": "pd-hef", "errors_rad": errors_rad} for i in range(10)]
    labels = [f"drive_{i}" for i in range(10)]
    summary = {
        "output": "out", "exit_code": 3, "logs": 312, "done": 300, "lost": 8, "scored": 290, "remaining": 4,
        "errors": [{"estimator": "answer", **spread}, {"estimator": "zero", **spread}], "worst": worst,
        "failed": [{"reason": "expected a log, got a FIFO", "count": 12, "labels": labels}],
        "checks_failed": ["drive_7"], "plan": None,
    }  # fmt: skip
    text = rendered(render_fleet, summary)
    assert all(len(line) <= 80 for line in text.splitlines())
    assert rows(text, "answer")[0].split() == ["answer", "290", "0.057", "0.172", "0.573"]
    assert rows(text, "a_day_in_may__drive_00000")[0].split()[1:] == ["pd-hef", "0.573", "11.459"]
    assert "12 failed: expected a log, got a FIFO" in text
    assert "drive_0, drive_1, drive_2, drive_3, drive_4 and 7 more" in text
    assert "1 with failed checks, see report.json:" in text
    assert "312 logs: 300 done, 12 failed, 8 with input lost, 4 not done" in text
    assert len(text.splitlines()) < 30
