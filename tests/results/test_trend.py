"""A figure over runs: regressions are marked, also those that come in small steps, and equal runs are not."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool.cli.app import app
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.results.comparison_words import change_text
from pdhef_logtool.results.gate import Figure
from pdhef_logtool.results.opened_run import open_run
from pdhef_logtool.results.trend import Trend, trend_of
from tests.command_line import pdhef, said
from tests.results.made_run import entry, row, write_run

DRIVES = [f"d{i}" for i in range(40)]


def runs_of(place: Path, *levels: float, spread: float = 0.1, seed: int = 0) -> list[Path]:
    """Write a run per level: the drives' errors times the level, with noise."""
    rng = np.random.default_rng(seed)
    base = rng.lognormal(-5.0, 0.5, len(DRIVES))
    return [
        write_run(
            place / f"r{i}",
            dict(zip(DRIVES, base * level * np.exp(spread * rng.normal(size=len(DRIVES))), strict=True)),
            versions={"numpy": f"2.{i}"},
        )
        for i, level in enumerate(levels)
    ]


def of(folders: list[Path], limit: float | None = None) -> Trend:
    return trend_of([open_run(f) for f in folders], Figure(limit=limit))


def test_a_step_is_marked_where_it_happens_and_stays_marked_against_the_first_run(tmp_path: Path) -> None:
    found = of(runs_of(tmp_path, 1.0, 1.0, 1.3, 1.3))
    assert [r.regression for r in found.rows] == [(), (), ("previous", "first"), ("first",)]
    assert found.rows[2].differences == ("versions: numpy 2.1 → 2.2",)
    assert [r.scored for r in found.rows] == [40] * 4 and found.rows[0].unit == "rad"
    json.dumps(found.to_dict())
    assert of([tmp_path / "r0", tmp_path / "r2"], limit=0.5).regressions == ()


def test_small_steps_add_up_against_the_first_run(tmp_path: Path) -> None:
    found = of(runs_of(tmp_path, 1.0, 1.02, 1.05, 1.12, spread=0.08))
    assert "previous" not in found.rows[2].regression and found.rows[3].regression[-1:] == ("first",)


def test_equal_and_unrelated_runs_are_no_regressions(tmp_path: Path) -> None:
    wrong = sum(bool(of(runs_of(tmp_path / str(i), *[1.0] * 5, seed=i)).regressions) for i in range(10))
    assert wrong <= 1
    (folder,) = runs_of(tmp_path / "one", 1.0)
    other = write_run(tmp_path / "other", {"x": 0.1})
    found = of([folder, folder, other])
    assert found.rows[1].previous is not None and found.rows[1].previous.verdict == "equal"
    assert found.rows[2].previous is None and found.rows[2].regression == ()
    assert change_text(found.rows[2].previous) == "no common drive with the figure"


def test_runs_in_which_logs_failed_are_rows_too(tmp_path: Path) -> None:
    bad = entry("bad", outcome="failed: cut", main=None)
    a = write_run(tmp_path / "a", {}, entries=[bad])
    b = write_run(tmp_path / "b", {"d": 0.1}, entries=[entry("d"), bad])
    found = of([a, b, b])
    assert [(r.failed, r.scored) for r in found.rows] == [(1, 0), (1, 1), (1, 1)] and found.regressions == ()
    assert change_text(found.rows[1].first) == "no common drive with the figure"
    with pytest.raises(UsageError, match="an estimator of these runs: pd-hef, got pd-hof"):
        trend_of([open_run(b), open_run(b)], Figure(estimator="pd-hof"))


def test_a_drive_whose_estimator_has_seen_the_ground_truth_is_not_in_the_median(tmp_path: Path) -> None:
    flags = [row("d1", 1.0, metric="not_independent")]
    a = write_run(tmp_path / "a", {"d0": 0.1, "d1": 9.0}, rows=flags)
    assert [(r.scored, r.median) for r in of([a, a]).rows] == [(1, 0.1)] * 2


def test_the_command_prints_rows_and_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folders = runs_of(tmp_path, 1.0, 1.0, 1.5)
    failed = entry("bad", outcome="failed: no log", main=None)
    write_run(tmp_path / "r3", dict.fromkeys(DRIVES, 0.01), entries=[*map(entry, DRIVES), failed])
    pdhef("trend", *folders)
    out = capsys.readouterr().out
    assert out.startswith("Result   1 significant regression of sideslip RMSE in 3 runs")
    assert f"Nextpdhefcompare{folders[1]}{folders[2]}" in "".join(out.split())  # long paths are wrapped
    assert "regression against the previous and the first run" in out and "versions: numpy 2.1 → 2.2" in out
    document = said(capsys, "trend", *folders, tmp_path / "r3", "--max-regression", "5%")
    assert document["regressions"][0].endswith("r2") and document["runs"][3]["failed"] == 1
    assert document["runs"][2]["previous"]["median"] == pytest.approx(0.5, abs=0.1)
    with pytest.raises(UsageError, match="RUN: expected two runs or more, got 1"):
        app(["trend", str(folders[0])], prog_name="pdhef", standalone_mode=False)
