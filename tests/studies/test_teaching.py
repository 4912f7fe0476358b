"""The study of teaching: its pairs, and that the stored results meet the requirements."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from studies import teaching
from studies.teaching import CARS, PairResult, Score


def test_without_the_drives_it_says_so_and_ends_with_0(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys) -> None:
    monkeypatch.setattr(teaching, "DRIVES", tmp_path / "absent")
    assert teaching.main(["--out", str(tmp_path)]) == 0
    assert "needs ../shared" in capsys.readouterr().out


def pair(untaught: float, hybrid: float) -> PairResult:
    scores = [Score(value, value, 0.6, 0.95) for value in (untaught, untaught, hybrid)]
    return PairResult("car", "a", "b", *scores, kinematic_deg=1.0, paper_deg=1.0, rung="linear")


def test_a_pair_is_worse_beyond_the_larger_of_both_limits() -> None:
    assert not pair(0.2, 0.229).worse and pair(0.2, 0.231).worse
    assert not pair(2.0, 2.09).worse and pair(2.0, 2.11).worse
    text = teaching.summary([pair(1.0, 0.5), pair(1.0, 0.8)])
    assert "0.63 (2 pairs)" in text and "worse" in teaching.pair_table([pair(0.2, 0.3)])


def test_the_stored_results_have_every_pair_and_none_is_worse_than_untaught() -> None:
    stored = json.loads(teaching.RESULTS_FILE.read_text(encoding="utf-8"))
    counts = {car.name: len(car.parts) for car in CARS}
    for car in CARS:
        wanted = len(car.parts) - car.taught_on if car.taught_on > 1 else counts[car.name] * (counts[car.name] - 1)
        assert sum(r["car"] == car.name for r in stored) == wanted
    for r in stored:
        before, after = r["untaught"]["rmse_deg"], r["hybrid"]["rmse_deg"]
        assert after <= max(1.05 * before, before + 0.03), (r["taught"], r["scored"])
