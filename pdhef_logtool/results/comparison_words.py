"""A comparison in words, the same in the terminal, on the page and in JUnit."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

from pdhef_logtool.evaluation.requirement_verdicts import next_steps
from pdhef_logtool.evaluation.statistics import LEAST_CLUSTERS
from pdhef_logtool.evaluation.validation_plan import shown
from pdhef_logtool.results.comparing import INDEPENDENT, ComparedFigure, Comparison
from pdhef_logtool.results.selected_estimate import TEMPLATES
from pdhef_logtool.storage.templates import clauses, one_line, template


@cache
def _words() -> Any:
    """Return the sentences of ``comparison.txt`` as functions."""
    context = {"change_text": change_text, "percent": percent, "isfinite": math.isfinite}
    limits = {"LEAST_CLUSTERS": LEAST_CLUSTERS, "INDEPENDENT": INDEPENDENT}
    return template(TEMPLATES / "comparison.txt", **context, **limits).module


def sentence(about: str, comparison: Comparison) -> str:
    """Return a sentence of a comparison: ``paired``, ``verdict``, ``changes``, ``assumed`` or ``next``."""
    if about != "next":
        return one_line(getattr(_words(), about)(comparison))
    plan = comparison.requirements
    steps = next_steps(None if plan is None else plan.to_dict())
    undecided = [f.detectable for f in comparison.figures if f.verdict == comparison.verdict]
    return one_line(_words().next(comparison, steps, [*filter(math.isfinite, undecided)]))


def notes_of(comparison: Comparison) -> list[str]:
    """Return remarks on the requested figures, a line each."""
    return clauses(_words().notes(comparison))


def history_table(comparison: Comparison) -> tuple[list[str], list[list[str]]]:
    """Return the heads of a history's table, ``>`` before heads of numbers, and the texts of its rows."""
    rows = []
    for row in comparison.history:
        of, step = row.figure, row.step
        value, *ends = (shown(x, row.unit) if math.isfinite(x) else "-" for x in (of.value, of.low, of.high))
        change = "0 %" if row.verdict == "equal" else "-" if step is None else percent(math.expm1(step.change.median))
        interval = "-" if step is None else interval_text(step)
        between = "-" if "-" in ends else " to ".join(ends)
        rows.append([row.run, row.version, str(of.units), value, between, change, interval, row.verdict or "-"])
    name = comparison.history[0].requirement.name if rows else ""
    return ["run", "version", ">drives", f">{name}", ">95 % interval", ">change", ">95 % interval", "verdict"], rows


def change_text(figure: ComparedFigure) -> str:
    """Return the median change with its interval: ``+3.1 % (+1.0 % to +5.2 %)``."""
    median, interval = percent(math.expm1(figure.change.median)), interval_text(figure)
    return median if interval == "-" else f"{median} ({interval})"


def interval_text(figure: ComparedFigure) -> str:
    """Return the 95 % interval of the median change, a dash without."""
    low, high = (math.expm1(x) for x in (figure.change.low, figure.change.high))
    return f"{percent(low)} to {percent(high)}" if math.isfinite(figure.change.low) else "-"


def percent(share: float) -> str:
    """Return a share with its sign; one too small for a digit keeps its sign, so that it does not pass for none."""
    if not math.isfinite(share):
        return "-" if math.isnan(share) else "+∞"
    if share and abs(share) < 5e-4:
        return f"{'+' if share > 0 else '-'}<0.1 %"
    return f"{share * 100:+.1f} %" if share else "0 %"
