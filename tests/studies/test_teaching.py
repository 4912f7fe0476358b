"""The study of teaching: its pairs, and that the stored results meet the requirements."""

from __future__ import annotations

import json
import math

from studies import teaching
from studies.teaching import CARS, PairResult, Score


def pair(untaught: float, hybrid: float) -> PairResult:
    scores = [Score(value, value, 0.6, 0.95) for value in (untaught, untaught, hybrid)]
    return PairResult("car", "a", "b", *scores, kinematic_deg=1.0, paper_deg=1.0, rung="linear")


def test_a_pair_is_worse_beyond_the_larger_of_both_limits() -> None:
    assert not pair(0.2, 0.229).worse and pair(0.2, 0.231).worse
    assert not pair(2.0, 2.09).worse and pair(2.0, 2.11).worse
    text = teaching.summary([pair(1.0, 0.5), pair(1.0, 0.8)])
    assert "0.63 (2 pairs)" in text and "worse" in teaching.pair_table([pair(0.2, 0.3)])


#: Scored drives of the stored pairs that are worse than untaught, as README.md and docs/teaching.md state.
WORSE = ["f1tenth_xray_0"]


def test_the_stored_results_have_every_pair_and_only_the_named_one_is_worse_than_untaught() -> None:
    stored = json.loads(teaching.RESULTS_FILE.read_text(encoding="utf-8"))
    counts = {car.name: len(car.parts) for car in CARS}
    for car in CARS:
        wanted = len(car.parts) - car.taught_on if car.taught_on > 1 else counts[car.name] * (counts[car.name] - 1)
        assert sum(r["car"] == car.name for r in stored) == wanted
    errors = [(r["untaught"]["rmse_deg"], r["hybrid"]["rmse_deg"]) for r in stored]
    worse = [after > max(1.05 * before, before + 0.03) for before, after in errors]
    assert [r["scored"] for r, is_worse in zip(stored, worse, strict=True) if is_worse] == WORSE
    assert all(after <= 1.07 * before for (before, after), is_worse in zip(errors, worse, strict=True) if is_worse)
    assert math.prod(after / before for before, after in errors) <= 0.93 ** len(errors)
