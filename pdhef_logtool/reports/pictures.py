"""Figures of a page as PNG for report.pdf, drawn from the same records by matplotlib."""

from __future__ import annotations

import io
from typing import Any, TypeAlias

import numpy as np

from pdhef_logtool.records.printable import printable
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.reports.charts import Charts, Figure, PointsFigure, TimeFigure
from pdhef_logtool.reports.encoding import Grid

_Axes: TypeAlias = Any
#: Sizes in inches; at _DPI the width is 1600 pixels.
_WIDTH, _HEIGHT, _SQUARE, _DPI = 10.0, 4.2, 6.0, 160


def picture(figure: Figure, charts: Charts) -> bytes:
    """Return a figure over time or in a plane as PNG; equal figures give equal bytes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    size = (_WIDTH, _HEIGHT) if isinstance(figure, TimeFigure) else (_SQUARE + 1.0, _SQUARE)
    canvas = Canvas(figsize=size, dpi=_DPI)
    FigureCanvasAgg(canvas)
    axes = canvas.add_subplot()
    axes.grid(color="#e3e6ea", linewidth=0.8)
    axes.set_axisbelow(True)
    if isinstance(figure, TimeFigure):
        _time(figure, axes, charts)
    elif isinstance(figure, PointsFigure):
        _points(figure, axes)
    axes.set_title(figure.heading.replace("$", r"\$"), loc="left", fontsize=10, fontweight="bold")
    canvas.tight_layout()
    file = io.BytesIO()
    canvas.savefig(file, format="png", metadata={"Software": None})
    return file.getvalue()


def _instants(grid: Grid, start_s: float, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return seconds and values of a series on the grid, two per cell as on the page."""
    times = np.asarray(start_s + (np.arange(2 * grid.cells) * 0.5 + 0.25) * grid.cell_s, dtype=np.float64)
    return times, np.ravel(values) if values.ndim == 2 else np.repeat(values, 2)


def _time(figure: TimeFigure, axes: _Axes, charts: Charts) -> None:
    grid, start = charts.grid, charts.start_s()
    assert grid is not None
    for band in figure.bands:
        times, low = _instants(grid, start, band.low)
        axes.fill_between(times, low, _instants(grid, start, band.high)[1], color=band.colour, alpha=0.2, linewidth=0,
                          label=_plain(band.label))  # fmt: skip
    drawn: list[FloatArray] = []
    for line in figure.series:
        if line.group:
            continue
        times, values = _instants(grid, start, line.values)
        drawn.append(values[np.isfinite(values)])
        axes.plot(times, values, color=line.colour, linewidth=0.8 * line.width, label=_plain(line.label))
    if figure.log:
        axes.set_yscale("log")
    elif drawn and (values_drawn := np.concatenate(drawn)).size:
        levels = [] if figure.level is None else [figure.level]
        least, most = (float(f(np.append(values_drawn, levels))) for f in (np.min, np.max))
        room = 0.06 * (most - least) or 0.5
        axes.set_ylim(0.0 if least >= 0.0 > least - room else least - room, most + room)
    if figure.level is not None:
        axes.axhline(figure.level, color="#8a93a0", linewidth=0.9, linestyle="--", zorder=1)
    for mark in figure.marks:
        axes.annotate(mark.label, (mark.at_s, mark.value), fontsize=7, ha="center", va="center",
                      bbox={"boxstyle": "circle,pad=0.2", "fc": "white", "ec": "#1a1a1a", "lw": 0.8})  # fmt: skip
    axes.set_xlim(start, start + grid.cells * grid.cell_s)
    axes.set_xlabel("s from the log's start")
    _legend(axes)


def _points(figure: PointsFigure, axes: _Axes) -> None:
    for cloud in figure.clouds:
        style: dict[str, Any] = {"linewidth": 1.2} if cloud.line else {"linestyle": "", "marker": ".", "markersize": 2}
        axes.plot(cloud.x, cloud.y, color=cloud.colour, label=_plain(cloud.label), **style)
    if figure.equal:
        axes.set_aspect("equal", adjustable="datalim")
    if figure.log:
        axes.set_xscale("log")
        axes.set_yscale("log")
    axes.set_xlabel(figure.x_label)
    axes.set_ylabel(figure.y_label)
    _legend(axes)


def _legend(axes: _Axes) -> None:
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))


def _plain(text: str) -> str:
    """Return a label in one line, with dollar signs and a leading underscore escaped for matplotlib."""
    line = printable(text, 60).replace("$", r"\$")
    return f" {line}" if line.startswith("_") else line
