"""The figures of a page as PNG, for slides: drawn from the same records by matplotlib, which needs no browser."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from pdhef_logtool.records.printable import printable
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.reports.charts import (
    BarsFigure,
    Charts,
    Figure,
    IntervalsFigure,
    PointsFigure,
    StripFigure,
    TimeFigure,
)
from pdhef_logtool.reports.encoding import Grid
from pdhef_logtool.storage.files import write_bytes

_Axes: TypeAlias = Any
#: Inches, at _DPI a slide's width of 1600 points.
_WIDTH, _HEIGHT, _SQUARE, _DPI = 10.0, 4.2, 6.0, 160
_ROW = 0.24


def write_pictures(charts: Charts, folder: Path, label: str) -> tuple[Path, ...]:
    """Write ``KEY.png`` of every figure into a folder and return the files; ``label`` names the drive in each.

    Raises
    ------
    OutputError
        A picture cannot be written.
    """
    made = []
    for key, figure in charts.figures.items():
        path = folder / f"{key}.png"
        write_bytes(path, picture(figure, charts, label))
        made.append(path)
    return tuple(made)


def picture(figure: Figure, charts: Charts, label: str = "") -> bytes:
    """Return one figure as PNG; the same figure gives the same bytes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    height = _SQUARE if isinstance(figure, PointsFigure) else _HEIGHT
    if isinstance(figure, StripFigure):
        height = 1.1 + _ROW * len(figure.rows)
    if isinstance(figure, IntervalsFigure):
        height = 1.1 + 1.4 * _ROW * len(figure.intervals)
    canvas = Canvas(figsize=(_SQUARE + 1.0 if isinstance(figure, PointsFigure) else _WIDTH, height), dpi=_DPI)
    FigureCanvasAgg(canvas)
    axes = canvas.add_subplot()
    axes.grid(color="#e3e6ea", linewidth=0.8)
    axes.set_axisbelow(True)
    _drawing(figure)(figure, axes, charts)
    title = figure.heading if not label else f"{printable(label, 60)}: {figure.heading}"
    axes.set_title(title.replace("$", r"\$"), loc="left", fontsize=10, fontweight="bold")
    canvas.tight_layout()
    file = io.BytesIO()
    canvas.savefig(file, format="png", metadata={"Software": None})
    return file.getvalue()


def _drawing(figure: Figure) -> Callable[[Any, _Axes, Charts], None]:
    drawings: dict[type, Callable[[Any, _Axes, Charts], None]] = {
        TimeFigure: _time,
        StripFigure: _strip,
        PointsFigure: _points,
        IntervalsFigure: _intervals,
        BarsFigure: _bars,
    }
    return drawings[type(figure)]


def _instants(grid: Grid, start_s: float, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return seconds and values of a series on the grid, two a cell as on the page."""
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


def _strip(figure: StripFigure, axes: _Axes, charts: Charts) -> None:
    for i, row in enumerate(figure.rows):
        spans = [(s.start_s, max(s.end_s - s.start_s, 0.0)) for s in row.spans]
        axes.broken_barh(spans, (i - 0.3, 0.6), facecolor=row.colour, edgecolor=row.colour, linewidth=0.6)
    axes.set_yticks(range(len(figure.rows)), [_plain(r.label) for r in figure.rows], fontsize=8)
    axes.set_ylim(len(figure.rows) - 0.5, -0.5)
    if (grid := charts.grid) is not None:
        axes.set_xlim(charts.start_s(), charts.start_s() + grid.cells * grid.cell_s)
    axes.set_xlabel("s from the log's start")


def _points(figure: PointsFigure, axes: _Axes, _: Charts) -> None:
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


def _intervals(figure: IntervalsFigure, axes: _Axes, _: Charts) -> None:
    for i, interval in enumerate(figure.intervals):
        axes.plot([interval.low, interval.high], [i, i], color=interval.colour, linewidth=2, marker="|", markersize=8)
        axes.plot([interval.middle], [i], color=interval.colour, marker="o")
    if figure.zero is not None:
        axes.axvline(figure.zero, color="#1a1a1a", linewidth=0.9, linestyle="--")
    axes.set_yticks(range(len(figure.intervals)), [_plain(i.label) for i in figure.intervals], fontsize=8)
    axes.set_ylim(len(figure.intervals) - 0.5, -0.5)
    axes.set_xlabel(figure.unit)


def _bars(figure: BarsFigure, axes: _Axes, _: Charts) -> None:
    axes.bar(
        figure.edges[:-1], figure.counts, np.diff(figure.edges), align="edge", color=figure.colour, edgecolor="white"
    )
    axes.set_xlabel(figure.unit)
    axes.set_ylabel("number")


def _legend(axes: _Axes) -> None:
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))


def _plain(text: str) -> str:
    """Return a label in one line; a dollar begins no formula, an underscore hides nothing."""
    line = printable(text, 60).replace("$", r"\$")
    return f" {line}" if line.startswith("_") else line
