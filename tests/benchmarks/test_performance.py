"""The page of speed: its tables, its targets, and that a section is written anew alone."""

from importlib import import_module

from benchmarks import performance
from studies.pages import DOCS


def test_every_benchmark_says_what_it_measures_and_stands_on_the_page():
    page = (DOCS / performance.PAGE).read_text(encoding="utf-8")
    for name in performance.NAMES:
        module = import_module(f"benchmarks.{name}")
        assert module.__doc__
        assert callable(module.rows)
        assert f"\n### {name}\n\n<!-- begin {name} -->\n" in page
