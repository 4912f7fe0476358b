"""A comparison in words, the same in the terminal, on the page and in JUnit."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

from pdhef_logtool.evaluation.requirement_verdicts import next_steps
from pdhef_logtool.evaluation.statistics import LEAST_CLUSTERS
from pdhef_logtool.results.comparing import INDEPENDENT, ComparedFigure, Comparison
from pdhef_logtool.results.selected_estimate import TEMPLATES
from pdhef_logtool.storage.templates import clauses, one_line, template


@cache
def _words() -> Any:
    """Return the sentences of ``comparison.txt`` as functions."""
    context = {"change_text": change_text, "percent": percent, "isfinite": math.isfinite}
    limits = {"LEAST_CLUSTERS": LEAST_CLUSTERS, "INDEPENDENT": INDEPENDENT}
    return template(TEMPLATES / "comparison.txt", **context, **limits).module


def paired_text(comparison: Comparison) -> str:
    """Return the number of drives in both runs, and how they were paired."""
    return one_line(_words().paired(comparison))


def verdict_text(comparison: Comparison) -> str:
    """Return the verdict in a sentence."""
    return one_line(_words().verdict(comparison))


def assumed_text(comparison: Comparison) -> str:
    """Return the assumptions of the verdict."""
    return one_line(_words().assumed(comparison))


def next_text(comparison: Comparison) -> str:
    """Return the next step."""
    plan = comparison.requirements
    steps = next_steps(None if plan is None else plan.to_dict())
    undecided = [f.detectable for f in comparison.figures if f.verdict == comparison.verdict]
    return one_line(_words().next(comparison, steps, [*filter(math.isfinite, undecided)]))


def notes_of(comparison: Comparison) -> list[str]:
    """Return remarks on the requested figures, a line each."""
    return clauses(_words().notes(comparison))


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
