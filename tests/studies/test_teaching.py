"""The study of teaching: its pairs, and that the stored results meet the requirements."""

from __future__ import annotations

import json
import math

from studies.pages import DOCS, RESULTS
from studies.teaching import CARS, STORED, Pair, is_worse, pair_table, ratio, summary


def pair(untaught: float, hybrid: float) -> Pair:
    ways = {"untaught": untaught, "prior": untaught, "hybrid": hybrid}
    scores = {n: {"rmse_deg": x, "without_constant_deg": x, "active": 0.6, "covered": 0.95} for n, x in ways.items()}
    about = {"car": "car", "taught": "a", "scored": "b", "rung": "linear", "reference": None}
    return {**about, **scores, "kinematic_deg": 1.0, "paper_deg": 1.0}


def test_a_pair_is_worse_beyond_the_larger_of_both_limits() -> None:
    assert not is_worse(pair(0.2, 0.229)) and is_worse(pair(0.2, 0.231))
    assert not is_worse(pair(2.0, 2.09)) and is_worse(pair(2.0, 2.11))
    text = summary([pair(1.0, 0.5), pair(1.0, 0.8)])
    assert "0.63 (2 pairs)" in text and "worse" in pair_table([pair(0.2, 0.3)])


#: Scored drives of the stored pairs that are worse than untaught, as README.md and docs/peers.md state.
WORSE = ["f1tenth_xray_0"]


def test_the_stored_results_have_every_pair_and_only_the_named_one_is_worse_than_untaught() -> None:
    stored = json.loads((RESULTS / "teaching" / STORED).read_text(encoding="utf-8"))
    counts = {car.name: len(car.parts) for car in CARS}
    for car in CARS:
        wanted = len(car.parts) - car.taught_on if car.taught_on > 1 else counts[car.name] * (counts[car.name] - 1)
        assert sum(r["car"] == car.name for r in stored) == wanted
    worse = [r for r in stored if is_worse(r)]
    assert [r["scored"] for r in worse] == WORSE
    assert all(ratio(r) <= 1.07 for r in worse)
    assert math.prod(map(ratio, stored)) <= 0.93 ** len(stored)
    page = (DOCS / "peers.md").read_text(encoding="utf-8")
    assert pair_table(stored) in page and summary(stored) in page
