"""The page of a run: its content and links, and that text from a log is never executed."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from pdhef_logtool.reports.comparison import comparison_page
from pdhef_logtool.reports.fleet import fleet_page
from pdhef_logtool.reports.pages import remove_pages, write_pages
from pdhef_logtool.results.comparing import compare_runs, figure
from pdhef_logtool.results.opened_run import open_run
from tests.results.made_run import entry, row, write_run
from tests.run_report import text_of

HOSTILE = "</script><script>alert(1)</script>\"'><img src=x onerror=alert(1)>\u202egnp"


def run_of(folder: Path, drives: Mapping[str, Mapping[str, Any]], failed: Mapping[str, str] | None = None) -> Path:
    """Write a run: ``drives`` with RMSE in rad of pd-hef and physics, and changes of the report; ``failed`` reasons."""
    rows, reports = [], {}
    cells = [{"speed": 1, "ay": 0, "seconds": 90.0, "scored": 9, "sideslip_mse_rad2": 1e-4}]
    for label, drive in drives.items():
        given = dict(drive)
        errors = zip(("pd-hef", "physics"), given.pop("errors", ()), strict=False)
        rows += [row(label, value, estimator=name) for name, value in errors]
        reports[label] = {
            "format": "pdhef.report",
            "log": {"name": label, "duration_s": 100.0, "kind": "mcap"},
            "vehicle": {"name": "golf"},
            "truth": {"available": True, "not_independent": []},
            "selected_estimate": "pd-hef",
            "operating_space": {"speed_edges_m_s": [0, 5, 10], "ay_edges_m_s2": [0, 1], "cells": cells},
            **given,
        }
        place = folder / "logs" / label
        place.mkdir(parents=True)
        (place / "report.json").write_text(json.dumps(reports[label]))
        (place / "report.html").write_text("x")
    entries = [entry(label, car=None) for label in drives]
    entries += [entry(label, car=None, outcome=f"failed: {why}") for label, why in (failed or {}).items()]
    return write_run(folder, {}, entries=entries, rows=rows, reports=reports)


def words(folder: Path, **options: Any) -> str:
    return fleet_page(open_run(folder), **options).html.decode()


def test_a_run_with_everything_says_everything(tmp_path):
    drives: dict[str, dict[str, Any]] = {
        f"d{i}": {"errors": (0.001 * (1 + i), 0.0015 * (1 + i)), "metadata": {"road": "ab"[i // 5]}} for i in range(10)
    }
    drives["blind"] = {"truth": {"available": False, "not_independent": []}}
    page = words(run_of(tmp_path, drives, {"bad": "/x/bad.mcap: expected a log, got 3 bytes"}))
    assert "12 logs, " in page and "1 failed" in page and "1 of 12 logs failed" in page
    assert "+50.0%" in page
    assert '<a href="logs/d7/report.html">d7</a>' in page
    assert "the log has no ground truth" in page and "3 bytes (expected: a log)." in page
    assert "<h3>road" in page
    assert 'class="empty"' in page and "16.5 min" in page
    for key in ("worst", "medians", "spread", "against"):
        assert f'data-figure="{key}"' in page


@pytest.mark.parametrize("drives", [{}, {"a": {"truth": {"available": False, "not_independent": []}}}])
def test_without_a_score_there_is_no_verdict_and_no_empty_figure(tmp_path, drives):
    page = words(run_of(tmp_path, drives, {"bad": "empty"}))
    assert "No verdict" in page and "<figure" not in page.split("<script type")[0]


def test_what_logs_say_is_text(tmp_path):
    drives = {f"d{i}": {"errors": (0.001, 0.002), "metadata": {HOSTILE: HOSTILE[: 20 + i % 2]}} for i in range(4)}
    page = words(run_of(tmp_path, drives, {"bad": HOSTILE}))
    assert "<script>alert" not in page and "<img" not in page and "\u202e" not in page
    assert "&lt;/script&gt;" in page


@pytest.mark.slow
def test_every_page_of_a_run_is_written_and_removed(tmp_path):
    drives: dict[str, dict[str, Any]] = {f"d{i}": {"errors": (0.001, 0.002)} for i in range(4)}
    folder = run_of(tmp_path, drives, {"bad": "empty"})
    written = write_pages(open_run(folder))
    assert written.fleet.file == folder / "report.html"
    assert 'href="logs/bad/report.html"' in (folder / "report.html").read_text()
    assert 'href="../../report.html"' in (folder / "logs" / "bad" / "report.html").read_text()
    assert written.to_dict()["page"] == str(folder / "report.html")
    remove_pages(open_run(folder))
    assert not [*folder.rglob("*.html")]


def test_a_damaged_table_is_told_and_stops_no_other_page(tmp_path):
    folder = run_of(tmp_path, {"a": {"errors": (0.001, 0.002)}}, {"bad": "empty"})
    (folder / "tables/metrics.parquet").write_bytes(b"PAR1 no")
    written = write_pages(open_run(folder))
    assert written.fleet.file is None and written.exit_code == 3
    assert any("no page of the run" in line for line in written.wrong)
    assert written.pages[1].file is not None


TEN = {f"d{i}": 0.001 * (1 + i) for i in range(10)}
MARKUP = "<img src=x onerror=alert(1)>"


def _page(a: Path, b: Path, limit: float | None = 0.05) -> str:
    return comparison_page(compare_runs(open_run(a), open_run(b), (figure(limit=limit),))).decode()


def test_a_page_says_what_the_terminal_says(tmp_path):
    a = write_run(tmp_path / "a", TEN)
    worse = {label: value * (1.1 + 0.01 * i) for i, (label, value) in enumerate(TEN.items())}
    page = _page(a, write_run(tmp_path / "b", {**worse, "new": 0.1}, config={"friction": 0.3}))
    text = text_of(page)
    assert "Verdict B is worse" in text
    assert "Gate closed drives in B only: new" in text
    assert "configuration: friction auto → 0.3" in text
    assert "d9 0.573 0.682 +19.0 %" in text
    assert page.count('data-figure="') == 2


def test_names_that_are_markup_stay_texts_and_a_run_without_truth_has_a_page(tmp_path):
    a = write_run(tmp_path / "a", {MARKUP: float("nan"), "d": 0.1}, config={MARKUP: 1})
    entries = [entry(MARKUP), entry("d", main=MARKUP)]
    b = write_run(tmp_path / "b", {MARKUP: 0.1, "d": float("nan")}, entries=entries)
    page = _page(a, b)
    assert "<img" not in page
    assert "no drive has the figure on both sides (is there ground truth?): sideslip RMSE" in text_of(page)
    assert "No drive has the figure on both sides." in text_of(page)
