"""The tables of a run, and questions about them: contents, order, documentation, and every statement of the docs."""

import json
import re
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from scipy import stats

import pdhef_logtool as pdhef
from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.records.errors import OutputError, UsageError
from pdhef_logtool.results.clips import write_clips
from pdhef_logtool.results.events import FoundEvents, event_condition, find_events
from pdhef_logtool.results.fleet import ANSWER, Breakdown, Fleet, breakdowns, read_fleet
from pdhef_logtool.results.opened_run import TABLES, open_run, table_file
from pdhef_logtool.results.parquet_sink import load_schema
from pdhef_logtool.results.querying import query
from pdhef_logtool.results.run_report import LogOutcome
from pdhef_logtool.results.tables import add_verdicts, drive_part, read_part, write_part, write_tables
from pdhef_logtool.storage.documents import file_sha256, seal
from studies.documentation_tables import with_tables
from tests.command_line import called
from tests.results import source_log
from tests.results.made_run import START_NS, entry, row, write_estimates, write_run
from tests.run_report import TRUTH, report, truth

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


# ---- Where something holds in the drives of a run, and clips of it ----

N = 600


def _find(folder: Path, where: str, **options: Any) -> FoundEvents:
    return find_events(open_run(folder), event_condition(where), **options)


def _report(folder: Path, label: str, **vehicle: Any) -> dict[str, Any]:
    document = report()
    document["log"] |= {"name": label, "start_ns": START_NS - 1_000_000_000, "end_ns": START_NS + 10_000_000_000}
    document["vehicle"] |= vehicle
    place = folder / "logs" / label / "report.json"
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text(json.dumps(document))
    return document


@pytest.fixture
def run(tmp_path):
    entries = [entry("a"), entry("b"), entry("no_truth"), entry("bad", outcome="failed: empty", main=None)]
    reports = {label: _report(tmp_path / "out", label) for label in ("a", "b", "no_truth")}
    folder = write_run(tmp_path / "out", {}, entries=entries, reports=reports)
    slip = np.zeros(N)
    slip[100:111] = np.deg2rad(np.linspace(1.0, 3.0, 11))
    slip[130:141] = -np.deg2rad(4.0)
    speed = np.full(N, 20.0)
    speed[:50] = 2.0
    still = {"vx_m_s": speed, "vy_m_s": np.zeros(N), "sideslip_rad": np.zeros(N)}
    wild = {**still, "sideslip_rad": np.where(np.arange(N) < 50, 1.02 * np.pi, 0.0)}
    valid = np.ones(N, dtype=np.bool_)
    valid[105:] = False
    write_estimates(folder, "a", truth=still, pd_hef={**still, "sideslip_rad": slip}, physics=still)
    write_estimates(folder, "b", truth=still, pd_hef={**wild, "valid": valid})
    write_estimates(folder, "no_truth", pd_hef=still)
    return folder


def test_rows_have_drive_start_end_and_peak(run):
    found = _find(run, "abs(sideslip_error_deg) > 1.5 and speed_m_s > 10")
    first, second = found.events
    assert len(_find(run, "abs(sideslip_error_deg) > 1.5 and speed_m_s > 10", pad_s=0.15).events) == 1
    assert (first.drive, second.drive, found.searched) == ("a", "a", 2)
    assert (first.start_ns, first.end_ns) == (START_NS + 1_030_000_000, START_NS + 1_100_000_001)
    assert first.start_s == pytest.approx(2.03)
    assert (first.peak, first.peak_ns) == (pytest.approx(3.0, abs=1e-4), START_NS + 1_100_000_000)
    assert second.peak == pytest.approx(4.0, abs=1e-4)
    assert found.left_out == {"no_truth": "it has no ground truth", "bad": "failed: empty"}
    assert found.exit_code == 3


def test_an_error_is_known_only_where_it_is_scored(run):
    assert [e.drive for e in _find(run, "abs(sideslip_error_deg) > 170").events] == ["b"]
    assert not _find(run, "abs(sideslip_error_deg) > 181").events
    slow = {**report(), "vehicle": {**report()["vehicle"], "low_speed_blend_m_s": 3.0}}
    entries = [entry("a"), entry("b"), entry("no_truth")]
    write_run(run, {}, entries=entries, reports={e["log"]: slow for e in entries})
    assert not _find(run, "abs(sideslip_error_deg) > 170").events
    unknown = _find(run, "not abs(vx_error_m_s) > 1").events  # the error of an invalid value is not below 1 either
    ends = {e.drive: round((e.end_ns - START_NS) * 1e-9, 2) for e in unknown}
    assert ends == {"a": 5.99, "b": 1.04}


def test_other_tracks_are_read_at_the_same_stamps(run, tmp_path):
    found = _find(run, "abs(sideslip_deg - physics.sideslip_deg) > 2.5")
    assert [e.drive for e in found.events] == ["a", "a"]
    assert found.left_out["b"] == "it has no estimator physics"
    assert len(_find(run, "speed_km_h < 8", estimator="physics").events) == 1
    with pytest.raises(UsageError, match="an estimator of this run: pd-hef, physics, truth, got ukf"):
        _find(run, "ukf.sideslip_deg > 1")
    with pytest.raises(UsageError, match="--estimator: expected an estimator of this run"):
        _find(run, "sideslip_deg > 1", estimator="ukf")
    scored = write_run(tmp_path / "scored", {}, entries=[entry("a", main=None)])
    write_estimates(scored, "a", esc={"vx_m_s": np.ones(9)})
    with pytest.raises(UsageError, match="an estimator of this run: esc, got none named"):
        _find(scored, "vx_m_s > 0")
    assert len(_find(scored, "vx_m_s > 0", estimator="esc").events) == 1


@pytest.fixture
def clipped(tmp_path):
    """Return a run without full copies, and the folder with its log."""
    logs = tmp_path / "logs" / "deep"
    logs.mkdir(parents=True)
    source_log.write_source(logs / "drive.mcap")
    from pdhef_logtool.logs.discovery import hash_log

    sha256 = hash_log(logs / "drive.mcap")
    entries, reports = [entry("drive", file="drive.mcap", sha256=sha256)], {"drive": _report(tmp_path / "out", "drive")}
    folder = write_run(tmp_path / "out", {}, entries=entries, reports=reports)
    slip = np.zeros(N)
    slip[300:310] = 1.0
    stamps = source_log.START_NS + 10_000_000 * np.arange(N, dtype=np.int64)
    write_estimates(folder, "drive", pd_hef={"sideslip_rad": slip, "stamps_ns": stamps})
    return folder, tmp_path / "logs"


def test_a_clip_has_the_topics_of_the_source_and_ours_around_the_event(clipped):
    folder, logs = clipped
    found = _find(folder, "sideslip_rad > 0.5", pad_s=1.0)
    (name,) = write_clips(open_run(folder), found, pad_s=1.0, source=logs).clips
    with closing(open_log(folder / name)) as clip:
        assert {"/imu", "/can/speed", "/pdhef/pd_hef/state"} <= {t.name for t in clip.topics}
        assert clip.start_ns >= source_log.START_NS + 2_000_000_000
        assert clip.end_ns <= source_log.START_NS + 4_100_000_000
        messages = {t.name: t.messages for t in clip.topics}
        assert (messages["/imu"], messages["/pdhef/pd_hef/state"]) == (209, 210)
    write_clips(open_run(folder), _find(folder, "sideslip_rad > 2"), pad_s=1.0, source=logs)
    assert list((folder / "clips").iterdir()) == []  # only clips of the last search


def test_a_source_that_is_not_found_or_is_another_file_is_told(clipped):
    folder, logs = clipped
    found = _find(folder, "sideslip_rad > 0.5")
    told: list[str] = []
    without = write_clips(open_run(folder), found, pad_s=1.0, tell=told.append)
    assert (without.clips, without.exit_code) == ((), 3)
    assert "--source DIR" in told[0]
    (logs / "deep" / "drive.mcap").write_bytes(b"another")
    write_clips(open_run(folder), found, pad_s=1.0, source=logs, tell=told.append)
    assert "1 of that name with other content" in told[1]


def test_a_segment_bounds_what_is_found(run):
    document = _report(run, "a")
    ends = [(1.0, 1.05), (1.32, 1.35)]
    document["segments"] = [
        {"name": "slalom", "start_ns": START_NS + round(a * 1e9), "end_ns": START_NS + round(b * 1e9), "text": ""}
        for a, b in ends
    ]
    write_run(run, {}, entries=[entry("a")], reports={"a": document})
    found = _find(run, "slalom")
    assert [(e.start_ns, e.end_ns) for e in found.events] == [
        (START_NS + round(a * 1e9), START_NS + round((b - 0.01) * 1e9) + 1) for a, b in ends
    ]
    [late] = _find(run, 'slalom AND abs("pd-hef".sideslip_error_deg) > 3.5').events
    assert late.start_ns == START_NS + 1_320_000_000
    assert all(e.end_ns <= START_NS + 1_000_000_000 for e in _find(run, "NOT slalom AND speed_m_s < 10").events)


@pytest.mark.parametrize(
    ("where", "expected", "got"),
    [
        ("abs(sidslip_error_deg) > 2", "one of the columns vx_m_s, vy_m_s,", "sidslip_error_deg"),
        ("stamp_ns > 1", "one of the columns", "stamp_ns"),
        ("speed_m_s > 2 and", "a condition in the SQL of Polars", "unable to parse"),
        ("speed_m_s", "a condition, such as a comparison", "speed_m_s"),
        ("max(speed_m_s) > 1", "one of the columns", "max"),
        ("truth.sideslip_error_rad > 1", "an estimator before an error", "truth.sideslip_error_rad"),
        ("speed_m_s > 1 -- valid", "columns, numbers and operators", "-"),
        ("valid = 'true'", "columns, numbers and operators", "''"),
        ("valid or " * 300 + "valid", "columns, numbers and operators in at most 2000 characters", "2705 characters"),
    ],
)
def test_a_wrong_condition_is_one_line_with_the_names(where, expected, got):
    with pytest.raises(UsageError) as error:
        event_condition(where)
    assert f"--where: expected {expected}" in str(error.value) and f"got {got}" in str(error.value)


@pytest.mark.parametrize(
    "where",
    [
        "valid AND 1 = (SELECT 1 FROM read_csv('{file}'))",
        'valid AND 1 = (SELECT 1 FROM "read_csv"/**/("{file}"))',
        "EXISTS (TABLE x)",
        "read_csv('{file}')",
    ],
)
def test_a_condition_reads_no_file(where, tmp_path, monkeypatch):
    (tmp_path / "file.csv").write_text("a\n1\n")
    monkeypatch.setattr(pl, "sql_expr", lambda _: pytest.fail("Polars executes subqueries"))
    with pytest.raises(UsageError, match="--where"):
        event_condition(where.format(file=tmp_path / "file.csv"))


# ---- The figures of a fleet: exact intervals, rankings that need evidence, and no score without ground truth ----

LOST = {"kind": "truncated", "where": "a.mcap", "severity": "lost", "start_ns": None, "end_ns": None}
LOST |= {"what": "ends at byte 3; what follows is gone (a.mcap)"}
CELL = {"speed": 4, "ay": 1, "seconds": 5.0, "scored": 100, "sideslip_mse_rad2": 1e-4}
SPACE = {"speed_edges_m_s": [0, 5, 10, 15, 20], "ay_edges_m_s2": [0, 1, 2], "cells": [CELL]}


class Run:
    """A run's folder that a test fills."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.logs: list[dict[str, Any]] = []
        self.rows: list[MetricRow] = []
        self.reports: dict[str, dict[str, Any]] = {}

    def add(self, label: str, errors: Mapping[str, float] | None = None, outcome: str = "ok", **changes: Any) -> None:
        self.logs.append(entry(label, outcome=outcome))
        if outcome.startswith("failed"):
            return
        self.reports[label] = report(None, **{"operating_space": SPACE, "metadata": {}, **changes})
        independent = "sideslip_rad" not in self.reports[label]["truth"]["not_independent"]
        for name, value in (errors or {}).items():
            self.rows += [
                row(label, figure, estimator=name, segment=segment, independent=independent)
                for segment, figure in (("all", value), ("linear", 99.0))
            ]

    def read(self, **options: Any) -> Fleet:
        write_run(self.folder, {}, entries=self.logs, rows=self.rows, reports=self.reports)
        return read_fleet(open_run(self.folder), **options)


@pytest.fixture
def run_folder(tmp_path):
    return Run(tmp_path)


def test_six_drives_rank_nobody_and_seven_can(run_folder):
    for i in range(6):
        run_folder.add(f"d{i}", {"pd-hef": 0.01 + 0.001 * i, "physics": 0.02, "zero": 0.2})
    found = run_folder.read()
    assert found.ranking == () and found.least_to_rank == 7
    run_folder.add("d6", {"pd-hef": 0.01, "physics": 0.02, "zero": 0.2})
    assert [(r.place, r.estimator) for r in run_folder.read().ranking] == [(1, "pd-hef"), (2, "physics"), (3, "zero")]


def test_drives_without_independent_truth_stand_apart_and_score_nothing(run_folder):
    run_folder.add("good", {"pd-hef": 0.01})
    run_folder.add("none", truth=truth())
    run_folder.add("own", {"pd-hef": 0.0}, truth=TRUTH | {"not_independent": ["sideslip_rad"]})
    for name, d2 in (("pd-hef", 0.3), ("zero", 0.1)):
        run_folder.rows.append(row("none", d2, estimator=name, signal="vy_m_s", metric="d2"))
    found = run_folder.read()
    assert [d.label for d in found.scored] == ["good"]
    assert [(d.label, d.unscored) for d in found.without_truth] == [
        ("none", "the log has no ground truth"),
        ("own", "its ground truth is not independent"),
    ]
    (answer, _) = found.distributions
    assert (answer.estimator, answer.median.units) == (ANSWER, 1)


def test_failures_are_told_by_reason(run_folder):
    run_folder.add("ok", {"pd-hef": 0.01}, outcome="lost: 2 things", losses=[LOST, {**LOST, "severity": "note"}])
    for i in range(12):
        run_folder.add(f"f{i}", outcome=f"failed: /x/{i}.mcap: expected a log, got {i} bytes; copy it again")
    found = run_folder.read()
    first = found.failed[0]
    assert (first.count, first.reason) == (12, "expected a log, got 0 bytes; copy it again")
    assert len(found.failed[0].labels) == 10
    assert len(found.failed) == 1 and found.logs == 13 and len(found.drives) == 1
    assert [f.reason for f in found.losses] == ["ends at byte 3; what follows is gone"]


def test_effects_have_intervals_and_keys_without_one_are_not_significant(run_folder):
    rng = np.random.default_rng(2)
    for i in range(40):
        wet = i % 2
        metadata = {"road": "wet" if wet else "dry", "water": str(wet), "odometer": str(1000 + i)}
        metadata |= {"driver": f"x{i}", "tyre": "ab"[i % 3 == 0], "same": "1"}
        run_folder.add(f"d{i}", {"pd-hef": float((3.0 if wet else 1.0) * rng.lognormal(0.0, 0.2))}, metadata=metadata)
    found = run_folder.read()
    by_key = {b.key: b for b in found.breakdowns}
    assert found.breakdowns[0].key == "road" and found.breakdowns[0].also == ("water",)
    dry, wet = found.breakdowns[0].groups
    assert (dry.value, dry.drives, wet.value, wet.drives) == ("dry", 20, "wet", 20)
    assert wet.effect.share == pytest.approx(2.0, abs=0.5) and wet.effect.low > 1.0 and wet.effect.significant
    assert 1.0 + dry.effect.share == pytest.approx(1.0 / (1.0 + wet.effect.share))
    assert not {"same", "driver", "odometer"} & set(by_key) and by_key["tyre"].p > 0.05
    (only,) = run_folder.read(by=["same"]).breakdowns
    assert [(g.value, g.scored, g.effect) for g in only.groups] == [("1", 40, None)]
    assert run_folder.read(by=["driver"]).breakdowns[0].groups[0].value == "28 others"
    (nothing,) = run_folder.read(by=["no such key"]).breakdowns
    assert [g.value for g in nothing.groups] == ["not given"]


def test_the_operating_space_adds_up_and_empty_cells_are_empty(run_folder):
    space = SPACE | {"cells": [{"speed": 0, "ay": 2, "seconds": 1.0, "scored": 300, "sideslip_mse_rad2": 9e-4}]}
    run_folder.add("a", {"pd-hef": 0.1})
    run_folder.add("b", {"pd-hef": 0.1})
    run_folder.add("c", {"pd-hef": 0.1}, operating_space=space)
    run_folder.add("older", {"pd-hef": 0.1}, operating_space=None)
    found = run_folder.read().space
    assert found is not None and found.drives == 3
    assert found.seconds[4, 1] == 10.0 and found.seconds.sum() == 11.0
    assert found.rmse_rad[4, 1] == pytest.approx(0.01) and found.rmse_rad[0, 2] == pytest.approx(0.03)
    assert np.isnan(found.rmse_rad[1, 1])


def found(errors: list[float], days: list[int] | None = None, **keys: list[str]) -> tuple[Breakdown, ...]:
    of_drives = [dict(zip(keys, values, strict=True)) for values in zip(*keys.values(), strict=True)]
    return breakdowns(np.array(errors), of_drives, {"day": days or [None] * len(errors), "car": [None] * len(errors)})


def test_an_effect_is_that_of_welch():
    rng = np.random.default_rng(0)
    a, b = rng.lognormal(0.0, 0.3, 12), rng.lognormal(0.4, 0.5, 9)
    (only,) = found([*a, *b], k=["a"] * 12 + ["b"] * 9)
    reference = stats.ttest_ind(np.log(b), np.log(a), equal_var=False)
    effect = only.groups[1].effect
    assert effect is not None and effect.p == pytest.approx(reference.pvalue)
    low, high = reference.confidence_interval()
    assert (effect.low, effect.high) == pytest.approx((np.expm1(low), np.expm1(high)))


def test_of_fleets_without_effects_few_show_any():
    rng = np.random.default_rng(1)
    wrong = naive = 0
    for _ in range(40):
        keys = rng.integers(0, 3, (8, 40))
        errors = rng.lognormal(size=40)
        shown = found([*errors], **{f"k{k}": [*map(str, v)] for k, v in enumerate(keys)})
        effects = [g.effect for b in shown for g in b.groups if g.effect is not None]
        assert all(e.significant == (e.low > 0.0 or e.high < 0.0) for e in effects)
        wrong += any(e.significant for e in effects)
        logs = np.log(errors)
        naive += any(stats.ttest_ind(logs[v == x], logs[v != x]).pvalue < 0.05 for v in keys for x in range(3))
    assert wrong <= 5 and naive >= 16


def test_days_that_differ_are_no_effect_of_the_weather():
    rng = np.random.default_rng(3)
    wrong = 0
    for _ in range(100):
        day = np.repeat(np.arange(12), 8)
        errors = np.exp(rng.normal(size=12)[day] + 0.3 * rng.normal(size=96))
        (weather,) = found([*errors], day.tolist(), weather=["wet" if d % 2 else "dry" for d in day])
        wrong += weather.p < 0.05
    assert wrong <= 10  # nominal 5
