"""The page of a comparison of two runs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from pdhef_logtool.evaluation.units import read_unit
from pdhef_logtool.reports.charts import Charts, Interval, IntervalsFigure, against
from pdhef_logtool.reports.colours import FAULT, PLAIN
from pdhef_logtool.reports.page import render
from pdhef_logtool.results.comparing import ComparedFigure, Comparison
from pdhef_logtool.results.comparison_words import (
    interval_text,
    notes_of,
    paired_text,
    percent,
    verdict_text,
)

#: Maximum number of drives in the table, half of them from either end.
_MOST_DRIVES = 200
_KIND = {"worse": "bad", "no figure": "bad", "better": "good", "not worse": "good", "equal": "good", "inconclusive": ""}
_BLUE = "#0072b2"


def comparison_page(comparison: Comparison) -> bytes:
    """Return the page of a comparison as a complete HTML file."""
    charts = Charts()
    if comparison.figures and not comparison.equal:
        _draw(comparison, charts)
    return render(
        "comparison.html",
        charts,
        comparison=comparison,
        paired=paired_text(comparison),
        verdict=verdict_text(comparison),
        kind=_KIND[comparison.verdict],
        notes=notes_of(comparison),
        unpaired=[line for line in comparison.unpaired if line not in comparison.failures],
        drives=_drives(comparison.figures[0]) if comparison.figures and not comparison.equal else None,
        interval=interval_text,
        percent=percent,
        expm1=math.expm1,
    )


def _draw(comparison: Comparison, charts: Charts) -> None:
    asked = [
        _interval(figure, {"bad": FAULT, "good": _BLUE}.get(_KIND[figure.verdict], PLAIN))
        for figure in comparison.figures
        if figure.drives
    ]
    others = [_interval(figure, PLAIN) for figure in comparison.others]
    if asked or others:
        charts.figures["changes"] = IntervalsFigure("Median change, 95 % interval", "%", [*asked, *others], zero=0.0)
    figure = comparison.figures[0]
    unit, factor = read_unit(figure.unit)
    a, b = (np.array([getattr(d, side) for d in figure.drives]) * factor for side in "ab")
    positive = (a > 0.0) & (b > 0.0)
    if positive.any():
        title = f"{figure.figure.signal} {figure.figure.metric} of each drive: above the line B is worse"
        labels = f"A [{unit or '1'}]", f"B [{unit or '1'}]"
        charts.figures["drives"] = against(title, *labels, a[positive], b[positive], _BLUE)


def _interval(figure: ComparedFigure, colour: str) -> Interval:
    low, middle, high = (100.0 * math.expm1(getattr(figure.change, k)) for k in ("low", "median", "high"))
    return Interval(figure.figure.short, low, middle, high, colour)


def _drives(figure: ComparedFigure) -> dict[str, Any]:
    """Return the table of the drives of the first figure; of many drives, only both ends."""
    unit, factor = read_unit(figure.unit)
    half = _MOST_DRIVES // 2
    shown = figure.drives if len(figure.drives) <= _MOST_DRIVES else (*figure.drives[:half], *figure.drives[-half:])
    rest = len(figure.drives) - len(shown)
    return {"unit": unit, "factor": factor, "label": figure.figure.label, "left_out": rest, "rows": shown}
