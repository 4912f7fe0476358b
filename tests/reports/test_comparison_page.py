"""The page of a comparison."""

from __future__ import annotations

from pathlib import Path

from pdhef_logtool.reports.comparison import comparison_page
from pdhef_logtool.results.comparing import compare_runs, figure
from pdhef_logtool.results.opened_run import open_run
from tests.results.made_run import entry, write_run
from tests.run_report import text_of

TEN = {f"d{i}": 0.001 * (1 + i) for i in range(10)}
HOSTILE = "<img src=x onerror=alert(1)>"


def _page(a: Path, b: Path, limit: float | None = 0.05) -> str:
    return comparison_page(compare_runs(open_run(a), open_run(b), (figure(limit=limit),))).decode()


def test_a_page_says_what_the_terminal_says(tmp_path: Path) -> None:
    a = write_run(tmp_path / "a", TEN)
    worse = {label: value * (1.1 + 0.01 * i) for i, (label, value) in enumerate(TEN.items())}
    page = _page(a, write_run(tmp_path / "b", {**worse, "new": 0.1}, config={"friction": 0.3}))
    text = text_of(page)
    assert "Verdict B is worse" in text
    assert "Gate closed drives in B only: new" in text
    assert "configuration: friction auto → 0.3" in text
    assert "d9 0.573 0.682 +19.0 %" in text
    assert page.count('data-figure="') == 2


def test_names_that_are_markup_stay_texts_and_a_run_without_truth_has_a_page(tmp_path: Path) -> None:
    a = write_run(tmp_path / "a", {HOSTILE: float("nan"), "d": 0.1}, config={HOSTILE: 1})
    entries = [entry(HOSTILE), entry("d", main=HOSTILE)]
    b = write_run(tmp_path / "b", {HOSTILE: 0.1, "d": float("nan")}, entries=entries)
    page = _page(a, b)
    assert "<img" not in page
    assert "no drive has the figure on both sides (is there ground truth?): sideslip RMSE" in text_of(page)
    assert "No drive has the figure on both sides." in text_of(page)
