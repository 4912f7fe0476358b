"""Figures of a page as records, and the document from which the page's script draws them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from pdhef_logtool.estimators.table import all_specs
from pdhef_logtool.records.printable import printable
from pdhef_logtool.records.signals import S_PER_NS, FloatArray
from pdhef_logtool.reports.encoding import Grid, encode
from pdhef_logtool.results.plotted import colour_rgb
from pdhef_logtool.results.sink import TRUTH

INK = "#1a1a1a"
#: Colours of faults, notes and normal events, distinguishable for the colour-blind.
FAULT, NOTE, PLAIN = "#b2182b", "#7a5195", "#6b7785"
#: Minimum contrast of lines on white according to WCAG 2.1.
_LEAST_CONTRAST = 3.0


def colour(name: str) -> str:
    """Return the colour ``#rrggbb`` of an estimator or of the ground truth, which is the same on every page."""
    if name == TRUTH:
        return INK
    rgb: Sequence[int] = colour_rgb(name, {s.name: s.colour for s in all_specs()})
    while contrast(rgb) < _LEAST_CONTRAST:
        rgb = [part * 15 // 16 for part in rgb]
    return "#{:02x}{:02x}{:02x}".format(*rgb)


def contrast(rgb: Sequence[int]) -> float:
    """Return the contrast to white by WCAG 2.1, 1 to 21."""
    red, green, blue = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in (v / 255 for v in rgb))
    return 1.05 / (0.2126 * red + 0.7152 * green + 0.0722 * blue + 0.05)


#: Maximum number of intervals in a row of a strip; beyond, the intervals closest to each other are joined.
_MOST_SPANS = 1500
_LABEL_SIGNS = 60


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """A line over a page's grid: ``values`` [cells] or, from an envelope, [cells, 2].

    ``dash``: lengths of strokes and gaps in pixels. A ``group`` is visible if its box on the page is ticked.
    """

    label: str
    colour: str
    values: FloatArray
    width: float = 1.5
    dash: tuple[int, ...] = ()
    group: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Band:
    """An area between ``low`` and ``high``, [cells] each."""

    label: str
    colour: str
    low: FloatArray
    high: FloatArray
    group: str = ""


@dataclass(frozen=True, slots=True)
class Mark:
    """A numbered point in a time figure, in seconds from the log's start, at ``value`` in the figure's unit."""

    label: str
    at_s: float
    value: float


class Span(NamedTuple):
    """A time interval, in seconds from the log's start."""

    start_s: float
    end_s: float
    text: str = ""


@dataclass(frozen=True, slots=True)
class Row:
    """A row of a strip."""

    label: str
    colour: str
    spans: Sequence[Span]


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points ``x``, ``y`` [M]; points with ``at_s`` [M], seconds from the log's start, follow the page's zoom."""

    label: str
    colour: str
    x: FloatArray
    y: FloatArray
    at_s: FloatArray | None = None
    line: bool = False


@dataclass(frozen=True, slots=True)
class Interval:
    """A figure with its interval; unknown bounds are NaN."""

    label: str
    low: float
    middle: float
    high: float
    colour: str


@dataclass(frozen=True, slots=True, eq=False)
class Figure:
    """Base class of all figures; ``kind`` selects the drawing function of the page's script."""

    kind: ClassVar[str]
    title: str


@dataclass(frozen=True, slots=True, eq=False)
class TimeFigure(Figure):
    """Lines over time.

    ``level``: value of a horizontal line. ``resolution``: storage resolution in the unit. ``time``: of this figure.
    """

    kind = "time"
    unit: str
    series: Sequence[Series]
    bands: Sequence[Band] = ()
    marks: Sequence[Mark] = ()
    level: float | None = None
    resolution: float = 0.0
    height: int = 190
    time: Mapping[str, float] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class StripFigure(Figure):
    """Rows of intervals over time."""

    kind = "strip"
    rows: Sequence[Row]


@dataclass(frozen=True, slots=True, eq=False)
class PointsFigure(Figure):
    """Points in a plane. ``equal``: same scale on both axes; ``log``: logarithmic axes."""

    kind = "points"
    x_label: str
    y_label: str
    clouds: Sequence[Cloud]
    equal: bool = False
    log: bool = False


def against(title: str, x_label: str, y_label: str, x: FloatArray, y: FloatArray, colour: str) -> PointsFigure:
    """Return the figure of two positive values [M] of each drive, and the line on which they are equal."""
    ends = np.array([min(x.min(), y.min()), max(x.max(), y.max())])
    clouds = [Cloud("equal", PLAIN, ends, ends, line=True), Cloud("drives", colour, x, y)]
    return PointsFigure(title, x_label, y_label, clouds, log=True)


@dataclass(frozen=True, slots=True, eq=False)
class IntervalsFigure(Figure):
    """Figures with their intervals, one below the other; ``zero``: value of a vertical line."""

    kind = "intervals"
    unit: str
    intervals: Sequence[Interval]
    zero: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class BarsFigure(Figure):
    """A histogram: ``counts`` [B] between ``edges`` [B + 1]."""

    kind = "bars"
    unit: str
    edges: Sequence[float]
    counts: Sequence[float]
    colour: str = "#0072b2"


@dataclass(slots=True, eq=False)
class Charts:
    """The figures of one page by key, in order. ``grid``, ``origin_ns`` (0 s): for figures over time; None without."""

    grid: Grid | None = None
    origin_ns: int = 0
    figures: dict[str, Figure] = field(default_factory=dict)

    def time(self) -> dict[str, float] | None:
        """Return the grid: start and width of the cells in seconds from the origin, and their number."""
        grid = self.grid
        if grid is None:
            return None
        start_s, cell_s = (grid.start_ns - self.origin_ns) * S_PER_NS, grid.cell_ns * S_PER_NS
        return {"start": start_s, "cell": cell_s, "cells": grid.cells}

    def document(self) -> tuple[dict[str, Any], dict[str, str]]:
        """Return the document for the page's script, and the text blocks of series that it refers to, by name."""
        blocks: dict[str, str] = {}

        def plain(value: Any, resolution: float) -> Any:
            if isinstance(value, np.ndarray):
                name = f"b{len(blocks)}"
                blocks[name], scale = encode(value, resolution)
                return {"block": name, **scale}
            if isinstance(value, str):
                half = _LABEL_SIGNS // 2
                return printable(value if len(value) <= _LABEL_SIGNS else f"{value[: half - 1]}…{value[-half:]}")
            if isinstance(value, float):
                return float(f"{value:.9g}") if np.isfinite(value) else None
            if isinstance(value, list | tuple):
                return [plain(entry, resolution) for entry in value]
            if is_dataclass(value):
                return {f.name: plain(getattr(value, f.name), resolution) for f in fields(value)}
            return value

        figures = {k: {"kind": f.kind, **plain(f, getattr(f, "resolution", 0.0))} for k, f in self.figures.items()}
        return {"time": self.time(), "figures": figures}, blocks


def joined(spans: Sequence[Span]) -> list[Span]:
    """Return the spans in order of time, at most :data:`_MOST_SPANS`; those closer than their share are joined."""
    made = sorted(spans, key=lambda s: (s.start_s, s.end_s))
    least_s = (made[-1].end_s - made[0].start_s) / (_MOST_SPANS - 1) if len(made) > _MOST_SPANS else 0.0
    for i in range(len(made) - 1, 0, -1):
        if made[i].start_s - made[i - 1].end_s < least_s:
            last, span = made[i - 1], made.pop(i)
            made[i - 1] = Span(last.start_s, max(last.end_s, span.end_s), last.text or span.text)
    return made
