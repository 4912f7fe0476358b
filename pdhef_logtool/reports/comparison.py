"""The page of a comparison of two runs, and of the history of several."""

import math

import numpy as np

from pdhef_logtool.evaluation.units import read_unit
from pdhef_logtool.reports.charts import FAULT, PLAIN, Charts, Interval, IntervalsFigure, against
from pdhef_logtool.reports.page import render
from pdhef_logtool.results import comparing
from pdhef_logtool.results.comparing import ComparedFigure, Comparison

#: Maximum number of drives in the table, half of them from either end.
_MOST_DRIVES = 200
_KIND = {"worse": "bad", "no figure": "bad", "better": "good", "not worse": "good", "equal": "good", "inconclusive": ""}
_BLUE = "#0072b2"


def comparison_page(comparison: Comparison) -> bytes:
    """Return the page of a comparison as a complete HTML file."""
    charts = Charts()
    heads, history = comparing.history_table(comparison)
    first = None if comparison.equal else next(iter(comparison.figures), None)
    if history:
        _draw_history(comparison, charts)
    if first is not None:
        _draw(comparison, first, charts)
    return render(
        "comparison.html",
        charts,
        comparison=comparison,
        **{about: comparing.sentence(about, comparison) for about in ("paired", "verdict", "changes")},
        kind=_KIND[comparison.verdict],
        notes=comparing.notes_of(comparison),
        unpaired=[line for line in comparison.unpaired if line not in comparison.failures],
        first=first,
        scale=read_unit(first.unit if first is not None else ""),
        half=_MOST_DRIVES // 2,
        heads=heads,
        history=history,
        interval=comparing.interval_text,
        percent=comparing.percent,
        expm1=math.expm1,
        zip=zip,
    )


def _draw_history(comparison: Comparison, charts: Charts) -> None:
    unit, factor = read_unit(next((row.unit for row in comparison.history if row.unit), ""))
    levels = []
    for row in comparison.history:
        low, value, high = (factor * x for x in (row.figure.low, row.figure.value, row.figure.high))
        levels.append(Interval(row.run, low, value, high, FAULT if row.verdict == "worse" else _BLUE))
    charts.figures["history"] = IntervalsFigure(
        f"{comparison.history[0].requirement.name}, 95 % interval", unit, levels
    )


def _draw(comparison: Comparison, first: ComparedFigure, charts: Charts) -> None:
    colours = {"bad": FAULT, "good": _BLUE, "": PLAIN}
    asked = [_interval(f, colours[_KIND[f.verdict]]) for f in comparison.figures if f.drives]
    others = [_interval(figure, PLAIN) for figure in comparison.others]
    if asked or others:
        charts.figures["changes"] = IntervalsFigure("Median change, 95 % interval", "%", [*asked, *others], zero=0.0)
    unit, factor = read_unit(first.unit)
    a, b = (np.array([d[side] for d in first.drives], dtype=np.float64) * factor for side in "ab")
    positive = (a > 0.0) & (b > 0.0)
    if positive.any():
        title = f"{first.requirement.name} of each drive: above the line B is worse"
        labels = f"A [{unit or '1'}]", f"B [{unit or '1'}]"
        charts.figures["drives"] = against(title, *labels, a[positive], b[positive], _BLUE)


def _interval(figure: ComparedFigure, colour: str) -> Interval:
    low, middle, high = (100.0 * math.expm1(getattr(figure.change, k)) for k in ("low", "median", "high"))
    return Interval(figure.requirement.name, low, middle, high, colour)
