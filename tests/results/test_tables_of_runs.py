"""The tables of a run, and questions about them: contents, order, documentation, and every statement of the docs."""

import json
import re
from pathlib import Path
from typing import Any

import polars as pl
import pytest

import pdhef_logtool as pdhef
from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.records.errors import OutputError, UsageError
from pdhef_logtool.results.opened_run import TABLES, open_run, table_file
from pdhef_logtool.results.parquet_sink import load_schema
from pdhef_logtool.results.querying import query
from pdhef_logtool.results.run_report import LogOutcome
from pdhef_logtool.results.tables import add_verdicts, drive_part, read_part, write_part, write_tables
from pdhef_logtool.storage.documents import file_sha256, seal
from studies.documentation_tables import with_tables
from tests.command_line import called
from tests.results.made_run import entry
from tests.run_report import report

ROOT = Path(__file__).parents[2]
SECOND_NS = 1_000_000_000
REQUIREMENT = {
    "id": "R1", "title": "error", "signal": "sideslip_rad", "metric": "rmse", "segment": "all", "estimator": None,
    "outcome": "FAIL", "value": 0.02, "low": 0.01, "high": 0.03, "bound": 0.01, "unit": "rad", "reason": "too large",
}  # fmt: skip
CONTENT: dict[str, Any] = {
    "checks": [
        {"name": "ay.sign", "subject": "ay_m_s2", "verdict": "failed", "waived": False, "evidence": "", "remedy": "x"},
        {"name": "vx.gain", "subject": "vx_m_s", "verdict": "passed", "waived": False, "evidence": "1", "remedy": ""},
    ],
    "segments": [{"name": "slalom", "start_ns": SECOND_NS, "end_ns": 3 * SECOND_NS, "text": ""}],
    "faults": [
        {"sensor": "ay_m_s2", "kind": "stuck", "count": 2, "seconds": 1.5,
         "intervals": [{"start_ns": 5, "end_ns": 6}, {"start_ns": 7, "end_ns": 9}]}
    ],
    "losses": [
        {"kind": "gap", "what": "a hole", "where": "/imu", "start_ns": 0, "end_ns": SECOND_NS, "count": 1,
         "severity": "lost"}
    ],
    "operating_space": {
        "speed_edges_m_s": [0.0, 15.0], "ay_edges_m_s2": [0.0, 4.0],
        "cells": [{"speed": 1, "ay": 1, "seconds": 9.0, "scored": 0, "sideslip_mse_rad2": None}],
    },
    "metadata": {"road": "wet"},
}  # fmt: skip


def rows(log: str) -> list[MetricRow]:
    return [
        MetricRow(log, name, "sideslip_rad", segment, "rmse", value, "rad", 9)
        for segment in ("all", "nonlinear", "slalom")
        for name, value in (("pd-hef", 0.02), ("zero", 0.01))
    ]


def of_log(log: str) -> LogOutcome:
    car = {"name": "golf", "sha256": "a", "network_sha256": None}
    texts = {"lost": ["a hole (/imu)"], "car": car, "main": "pd-hef", "day": "2026-01-31"}
    return LogOutcome(log, f"{log}.mcap", "b", signals_sha256="c", **texts)


def write(folder: Path, *logs: str) -> Path:
    """Write a run of logs with everything in it and one that failed."""
    parts = []
    for log in logs:
        part = drive_part(of_log(log), report(name=log, **CONTENT), rows(log), {"requirements": [REQUIREMENT]})
        write_part(folder / f"{log}.parquet", part)
        parts.append(read_part(folder / f"{log}.parquet"))
    parts.append(drive_part(LogOutcome("bad", "bad.mcap", None, failed="no log"), None))
    write_tables(folder / "tables", parts, [*(f"of/{log}" for log in logs), ""])
    add_verdicts(folder / "tables", {"requirements": [REQUIREMENT]})
    files = {table_file(name): file_sha256(folder / table_file(name)) for name in TABLES}
    entries = [entry(log) for log in logs] + [entry("bad", outcome="failed: no log", main=None)]
    document = {"format": "pdhef.run", "version": 1, "logs": entries, "files": files}
    (folder / "run.json").write_text(json.dumps(seal(document)))
    return folder


def statements() -> list[str]:
    text = (ROOT / "docs/questions.sql").read_text()
    lines = (line for line in text.splitlines() if not line.startswith("--"))
    return [one.strip() for one in "\n".join(lines).split(";") if one.strip()]


def test_every_table_has_the_rows_of_all_logs_in_their_order(tmp_path):
    folder = write(tmp_path, "b", "a")
    found = {name: pl.read_parquet(folder / table_file(name)) for name in TABLES}
    drives = found["drives"]
    assert drives["log"].to_list() == ["b", "a", "bad"]
    assert drives["outcome"].to_list() == ["lost", "lost", "failed"]
    assert drives["reason"].to_list() == ["a hole (/imu)", "a hole (/imu)", "no log"]
    assert drives["folder"].to_list() == ["of/b", "of/a", ""]
    assert drives["sideslip_rmse_rad"].to_list() == [0.02, 0.02, None]
    assert drives["failed_checks"].to_list() == [1, 1, 0]
    assert drives["causal"].to_list() == [True, True, None]
    assert found["metrics"].height == 12 and found["checks"].height == 4
    assert found["events"].select("event", "seconds").rows() == [("slalom", 2.0)] * 2
    faults = found["faults"].filter(log="a").select("origin", "place", "kind", "text", "seconds", "start_ns", "end_ns")
    assert faults.rows() == [
        ("sensor", "ay_m_s2", "stuck", None, 1.5, 5, 9),
        ("log", "/imu", "gap", "a hole", 1.0, 0, SECOND_NS),
    ]
    assert found["exposure"].select("speed_m_s", "ay_m_s2", "sideslip_mse_rad2").rows() == [(15.0, 4.0, None)] * 2
    assert found["metadata"].rows() == [("b", "road", "wet"), ("a", "road", "wet")]
    assert found["verdicts"].select("log", "requirement", "outcome").rows() == [
        (log, "R1", "FAIL") for log in ("b", "a", None)
    ]


@pytest.mark.parametrize("page", sorted((ROOT / "docs").glob("*.md")), ids=lambda page: page.name)
def test_pages_have_the_tables_of_the_code(page):
    text = page.read_text(encoding="utf-8")
    assert with_tables(text) == text, "run python -m studies.documentation_tables"


@pytest.mark.parametrize("name", TABLES)
def test_every_column_is_documented_and_of_its_kind(tmp_path, name):
    text = with_tables((ROOT / "docs/formats.md").read_text())
    columns = [c["name"] for c in load_schema(f"{name}.parquet.json")["columns"]]
    (listed,) = re.findall(rf"^\| `{name}` \|[^|]*\|([^|]*)\|", text, re.MULTILINE)
    assert re.findall(r"`(\w+)`", listed) == columns
    assert pl.read_parquet(write(tmp_path, "a") / table_file(name)).columns == columns


def test_each_question_is_one_statement_and_finds_what_is_there(tmp_path):
    folder, asked = write(tmp_path, "a", "b"), statements()
    answers = [query(folder, sql) for sql in asked]
    assert len(answers) == 20
    assert [sql for sql, answer in zip(asked, answers, strict=True) if not len(answer) and "diverged" not in sql
            and "coverage95 <" not in sql] == []  # fmt: skip
    assert answers[0].rows()[0][:2] == ("lost", 2)


def test_several_runs_have_a_column_of_their_name(tmp_path):
    a, b = write(tmp_path / "before", "a"), write(tmp_path / "after", "a", "b")
    found = pdhef.query([a, b], "SELECT run, COUNT(*) AS n FROM drives GROUP BY run ORDER BY n")
    assert found.rows() == [(str(a), 2), (str(b), 3)]
    assert "run" not in query(str(a), "SELECT * FROM drives").columns


@pytest.mark.parametrize(
    ("sql", "said"),
    [
        ("SELECT lgo FROM drives", "did you mean log?"),
        ("SELECT * FROM drvies", "did you mean drives?"),
        ("SELEC 1", "docs/formats.md"),
        ("SELECT * FROM read_parquet('/nowhere')", "No such file"),
    ],
)
def test_a_wrong_statement_is_one_line_with_the_nearest_name(tmp_path, sql, said):
    with pytest.raises(UsageError, match=re.escape(said)):
        query(write(tmp_path, "a"), sql)


def test_rows_with_more_columns_than_the_terminal_are_printed_line_by_line(tmp_path):
    printed = called("query", write(tmp_path, "one", "two"), "SELECT * FROM drives").stdout
    assert re.findall(r"(?m)^log +(\w+) *\nfile ", printed) == ["one", "two", "bad"]
    assert max(map(len, printed.splitlines())) <= 100


def test_a_damaged_table_is_named_and_only_if_it_is_asked_about(tmp_path):
    folder = write(tmp_path, "a")
    (folder / table_file("checks")).write_bytes(b"PAR1")
    assert len(query(folder, "SELECT * FROM drives")) == 2
    with pytest.raises(OutputError, match=r"checks\.parquet"):
        query(folder, "SELECT * FROM checks")


def _run(folder: Path, logs: list[object], **changed: object) -> Path:
    (folder / "run.json").write_text(json.dumps(seal({"format": "pdhef.run", "logs": logs, **changed})))
    return folder


def test_logs_stand_in_the_order_of_the_run_and_failed_ones_have_no_report(tmp_path):
    (tmp_path / "logs" / "b").mkdir(parents=True)
    (tmp_path / "logs" / "b" / "report.json").write_text('{"format": "pdhef.report"}')
    run = open_run(_run(tmp_path, [{"log": "b", "outcome": "ok"}, {"log": "a", "outcome": "failed: empty"}]))
    assert [(x.label, x.outcome) for x in run.logs] == [("b", "ok"), ("a", "failed: empty")]
    assert run.logs[0].report() == {"format": "pdhef.report"}
    assert run.logs[1].report() is None
    assert run.logs[0].estimates() is None


@pytest.mark.parametrize("label", ["../out", "a/b", "..", "", 3, None])
def test_a_label_that_leads_out_of_the_folder_is_refused(tmp_path, label):
    with pytest.raises(OutputError, match="name of a log's folder"):
        open_run(_run(tmp_path, [{"log": label, "outcome": "ok"}]))


def test_a_folder_that_is_no_run_is_refused_with_what_it_lacks(tmp_path):
    with pytest.raises(OutputError, match=r"without run\.json"):
        open_run(tmp_path)
    with pytest.raises(OutputError, match="no such folder") as missing:
        open_run(tmp_path / "none")
    assert missing.value.exit_code == 2
    with pytest.raises(OutputError, match="format 'other'"):
        open_run(_run(tmp_path, [], format="other"))
