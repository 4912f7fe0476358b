"""The page of speed: its tables, its targets, and that a section is written anew alone."""

from __future__ import annotations

from importlib import import_module

import pytest

from benchmarks import performance
from benchmarks.measuring import Row, best_seconds


def test_a_row_holds_its_target_in_either_sense() -> None:
    assert [Row("a", 2.0, "s", 1.5).passed, Row("a", 2.0, "x", 1.5, "at least").passed] == [False, True]
    assert Row("a", 2.0, "s").passed is None
    row = Row("read", 1.234, "s", 1.0, peers={"rosbags": 27.31, "mcap": 168.4}, command="pdhef run")
    assert performance.cells(row) == (
        "read: `pdhef run`", "1.23 s", "at most 1 s", "MISS", "rosbags 27.3 x, mcap 168 x"
    )  # fmt: skip


def test_a_section_that_is_measured_anew_leaves_the_others_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(performance, "machine_facts", lambda: {"gauge": "0.2 s"})
    first = {name: performance.section(name, [Row(name, 1.0, "s")]) for name in performance.NAMES}
    whole = performance.page("", first)
    assert whole.count("\n## ") == len(performance.NAMES)
    anew = performance.page(whole, {"reading": performance.section("reading", [Row("reading", 2.0, "s")])})
    assert anew == whole.replace("| reading | 1 s", "| reading | 2 s")


def test_every_benchmark_says_what_it_measures_and_stands_on_the_page() -> None:
    page = performance.DOCUMENT.read_text(encoding="utf-8")
    for name in performance.NAMES:
        module = import_module(f"benchmarks.{name}")
        assert module.__doc__
        assert callable(module.rows)
        assert f"\n## {name}\n" in page


def test_seconds_are_of_the_processor() -> None:
    assert best_seconds({"nothing": lambda: None}, rounds=1)["nothing"] < 0.1
