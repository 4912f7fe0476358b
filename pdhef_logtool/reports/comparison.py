"""The page of a comparison of two runs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from pdhef_logtool.evaluation.units import read_unit
from pdhef_logtool.reports.charts import Charts, Cloud, Interval
from pdhef_logtool.reports.colours import FAULT, PLAIN
from pdhef_logtool.reports.page import render
from pdhef_logtool.results.comparing import ComparedFigure, Comparison, DriveFigure
from pdhef_logtool.results.comparison_words import (
    interval_text,
    largest_text,
    notes_of,
    one_signal_a_drive,
    paired_text,
    percent,
    verdict_text,
)

#: Drives in the table, half of them from either end.
_MOST_DRIVES = 200
_KIND = {"worse": "bad", "no figure": "bad", "better": "good", "not worse": "good", "equal": "good", "inconclusive": ""}
_BLUE = "#0072b2"


def comparison_page(found: Comparison) -> bytes:
    """Return the page of a comparison, a whole HTML file."""
    charts = Charts()
    if found.figures and not found.equal:
        _draw(found, charts)
    return render(
        "comparison.html",
        charts,
        found=found,
        paired=paired_text(found),
        verdict=verdict_text(found),
        kind=_KIND[found.verdict],
        notes=notes_of(found),
        unpaired=[line for line in found.unpaired if line not in found.failures],
        figures=[_row(one) for one in found.figures],
        others=[_row(one) for one in found.others],
        drives=_drives(found.figures[0]) if found.figures and not found.equal else None,
        signals=[{"of": one, "largest": largest_text(one)} for one in one_signal_a_drive(found)]
        if found.signals
        else [],
    )


def _row(one: ComparedFigure) -> dict[str, Any]:
    p = one.corrected_p
    return {
        "label": one.figure.label,
        "drives": one.change.drives,
        "clusters": one.change.clusters,
        "median": percent(math.expm1(one.change.median)),
        "interval": interval_text(one),
        "limit": None if one.figure.limit is None else percent(one.figure.limit),
        "verdict": one.verdict,
        "p": None if p is None else f"{p:.2g}",
        "changed": p is not None and p < 0.05,
    }


def _draw(found: Comparison, charts: Charts) -> None:
    asked = [
        _interval(one, {"bad": FAULT, "good": _BLUE}.get(_KIND[one.verdict], PLAIN))
        for one in found.figures
        if one.drives
    ]
    others = [_interval(one, PLAIN) for one in found.others]
    if asked or others:
        charts.intervals("changes", "Median change, 95 % interval", "%", [*asked, *others], zero=0.0)
    one = found.figures[0]
    unit, factor = read_unit(one.unit)
    a, b = (np.array([getattr(d, side) for d in one.drives]) * factor for side in "ab")
    known = (a > 0.0) & (b > 0.0)
    if known.any():
        ends = np.array([min(a[known].min(), b[known].min()), max(a[known].max(), b[known].max())])
        clouds = [Cloud("no change", PLAIN, ends, ends, line=True), Cloud("drives", _BLUE, a[known], b[known])]
        title = f"{one.figure.signal} {one.figure.metric} of each drive: above the line B is worse"
        charts.points("drives", title, f"A [{unit or '1'}]", f"B [{unit or '1'}]", clouds, log=True)


def _interval(one: ComparedFigure, colour: str) -> Interval:
    low, middle, high = (100.0 * math.expm1(getattr(one.change, k)) for k in ("low", "median", "high"))
    return Interval(one.figure.short, low, middle, high, colour)


def _drives(one: ComparedFigure) -> dict[str, Any]:
    """Return the table of the drives of the first figure, those at both ends where there are many."""
    unit, factor = read_unit(one.unit)
    half = _MOST_DRIVES // 2
    shown = one.drives if len(one.drives) <= _MOST_DRIVES else (*one.drives[:half], *one.drives[-half:])
    left_out = len(one.drives) - len(shown)
    return {"unit": unit, "label": one.figure.label, "left_out": left_out, "rows": [_drive(d, factor) for d in shown]}


def _drive(one: DriveFigure, factor: float) -> dict[str, Any]:
    return {
        "name": one.drive,
        "name_b": None if one.drive_b == one.drive else one.drive_b,
        "a": one.a * factor,
        "b": one.b * factor,
        "change": None if one.change is None else percent(one.change),
        "other_stamps": one.n_a != one.n_b,
    }
