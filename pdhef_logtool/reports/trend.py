"""The page of a trend over runs."""

from __future__ import annotations

import math

from pdhef_logtool.reports.charts import Charts, Interval, IntervalsFigure
from pdhef_logtool.reports.colours import FAULT, PLAIN
from pdhef_logtool.reports.page import render
from pdhef_logtool.results.comparison_words import change_text
from pdhef_logtool.results.trend import Trend, mark, shown_median


def trend_page(trend: Trend) -> bytes:
    """Return the page of a trend, a whole HTML file."""
    charts = Charts()
    intervals = []
    for row in trend.rows:
        if row.first is not None and row.first.drives:
            low, middle, high = (100.0 * math.expm1(getattr(row.first.change, k)) for k in ("low", "median", "high"))
            intervals.append(Interval(row.run, low, middle, high, FAULT if row.regression else PLAIN))
    if intervals:
        title = f"{trend.figure.label}: median change relative to the first run, 95 % interval"
        charts.figures["changes"] = IntervalsFigure(title, "%", intervals, zero=0.0)
    rows = [
        {
            "row": row,
            "median": shown_median(row),
            "previous": change_text(row.previous) if number else None,
            "first": change_text(row.first) if number else None,
            "p": [p for p in (row.p_previous, row.p_first) if math.isfinite(p)],
            "mark": mark(row),
        }
        for number, row in enumerate(trend.rows)
    ]
    return render("trend.html", charts, trend=trend, rows=rows)
