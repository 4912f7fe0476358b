"""The page of the condition table: percentiles over drives, paired bootstrap, summary and figures.

Drives with NaN (without a scored sample) do not count.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
import polars as pl
from numpy.typing import NDArray

from studies.pages import number, table, template, write
from studies.pictures import save, subplots

#: The estimator of interest, and the references of its RMSE ratios.
SUBJECT = "pd-hef"
REFERENCES = ("physics", "phy-ukf", "pd-hef-paper")
MARGIN = 1.05
#: In the picture with their spans, from the naive to the best; the others are medians in grey.
DRAWN = ("zero", "open-loop", "phy-ukf", "physics", "pd-hef", "pd-hef-smoothed")
#: Okabe and Ito (2008), without yellow.
COLOURS = ("#000000", "#E69F00", "#56B4E9", "#0072B2", "#D55E00", "#009E73")
FloatArray = NDArray[np.float64]


#: Resamples of a bootstrap, and the level of its intervals.
RESAMPLES, LEVEL = 2000, 0.95


@dataclass(frozen=True, slots=True)
class Bound:
    """A figure with its percentile interval; ``drives`` is how many it was taken over, NaN bounds below two."""

    value: float
    low: float
    high: float
    drives: int


def percentiles(values: FloatArray, levels: tuple[float, ...] = (10.0, 50.0, 90.0)) -> tuple[float, ...]:
    """Return percentiles over drives [N] by linear interpolation."""
    finite = values[np.isfinite(values)]
    return tuple(np.percentile(finite, levels).tolist()) if finite.size else (float("nan"),) * len(levels)


def median(values: FloatArray) -> float:
    """Return the median over drives [N]; NaN without any."""
    return percentiles(values, (50.0,))[0]


def median_ratio(rmse: FloatArray, other: FloatArray) -> Bound:
    """Return median(rmse) / median(other) over drives [N], paired, with its bootstrap interval.

    The bootstrap draws whole drives with replacement, the same for both sides.
    """
    finite = np.isfinite(rmse) & np.isfinite(other)
    a, b = rmse[finite], other[finite]
    drives, nan = len(a), float("nan")
    if drives == 0:
        return Bound(nan, nan, nan, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        value = float(np.median(a) / np.median(b))
        if drives < 2:
            return Bound(value, nan, nan, drives)
        draw = np.random.default_rng(0).integers(drives, size=(RESAMPLES, drives))
        resampled = np.median(a[draw], axis=1) / np.median(b[draw], axis=1)
    low, high = np.nanpercentile(resampled, [50.0 * (1.0 - LEVEL), 50.0 * (1.0 + LEVEL)])
    return Bound(value, float(low), float(high), drives)


def verdict(bound: Bound, *, margin: float = 1.05) -> str:
    """Return the verdict from the interval of a ratio: better, worse (by more than the margin), not worse, or open."""
    if not np.isfinite(bound.low):
        return "–"
    if bound.high < 1.0:
        return "better"
    if bound.low > margin:
        return "worse"
    return "not worse" if bound.high <= margin else "open"


class Figures:
    """Sideslip figures by row, estimator, metric and segment: values over drives."""

    def __init__(self, metrics: pl.DataFrame) -> None:
        sideslip = metrics.filter(pl.col("signal").cast(pl.String) == "sideslip_rad")
        columns = ("row", "estimator", "metric", "segment", "drive", "value", "n")
        self._by: dict[tuple[str, ...], dict[str, tuple[float, float]]] = {}
        for *key, drive, value, n in sideslip.select(columns).sort("drive").iter_rows():
            self._by.setdefault(tuple(key), {})[drive] = (value, n)
        self.rows = {key[0] for key in self._by}
        self.estimators = {key[1] for key in self._by if key[2] == "rmse"}

    def get(
        self, row: str, estimator: str, metric: str = "rmse", segment: str = "all"
    ) -> tuple[FloatArray, FloatArray]:
        """Return values [N] and samples [N] over the drives, or empty arrays without drives."""
        pairs = np.array([*self._by.get((row, estimator, metric, segment), {}).values()]).reshape(-1, 2)
        return pairs[:, 0], pairs[:, 1]

    def ratio(self, row: str, reference: str) -> Bound:
        """Return the ratio of the median RMSE of subject and reference on their common drives."""
        a, b = (self._by.get((row, name, "rmse", "all"), {}) for name in (SUBJECT, reference))
        both = sorted(a.keys() & b.keys())
        return median_ratio(np.array([a[d][0] for d in both]), np.array([b[d][0] for d in both]))


def write_page(out: Path, folder: Path) -> None:
    """Render the page and its two figures from the results in a folder."""
    facts = json.loads((folder / "facts.json").read_text(encoding="utf-8"))
    figures = Figures(pl.read_parquet(folder / "metrics.parquet"))
    names = [n for n in facts["order"] if n in figures.estimators]
    rows = [r for r in facts["rows"] if r in figures.rows]
    references = [r for r in REFERENCES if r in names] if SUBJECT in names else []
    pictures = out / "conditions"
    pictures.mkdir(parents=True, exist_ok=True)
    spans = {n: np.degrees([percentiles(figures.get(r, n)[0]) for r in rows]).reshape(-1, 3) for n in names}
    drawn = {n: spans.pop(n) for n in DRAWN if n in spans}
    label = "sideslip RMSE in degrees: median and 10th to 90th percentile over drives"
    plot(pictures / "sideslip.png", rows, drawn, label, medians=spans)
    bounds = {name: [figures.ratio(r, name) for r in rows] for name in references}
    label = f"median sideslip RMSE of {SUBJECT} over that of the reference, 95 % interval"
    ratios = {name: np.array([(b.low, b.value, b.high) for b in of]) for name, of in bounds.items()}
    plot(pictures / "ratios.png", rows, ratios, label, limits={1.0: "-", MARGIN: ":"})
    texts = {"summary": summary(figures, facts["rows"], rows, [*drawn]), "counts": counts(rows, bounds)}
    given = {key: facts[key] for key in ("command", "car", "version")}
    write(out / "conditions.md", template(__file__, **given, **texts, subject=SUBJECT, margin=MARGIN))


def _deg(value: float, digits: int = 3) -> str:
    return number(math.degrees(value), digits)


def summary(figures: Figures, described: Mapping[str, str], rows: Sequence[str], names: Sequence[str]) -> str:
    """Return the median RMSE of the main estimators, and the coverage of the subject, by row."""
    body = []
    for row in rows:
        cells = [_deg(median(figures.get(row, n)[0])) for n in names]
        covered, samples = figures.get(row, SUBJECT, "coverage95")
        share = f"{100 * np.average(covered, weights=samples):.0f} %" if covered.size else "–"
        body.append([row, described[row], str(figures.get(row, names[0])[0].size), *cells, share])
    return table(["row", "condition", "drives", *names, f"coverage of {SUBJECT}"], body)


def counts(rows: Sequence[str], bounds: Mapping[str, Sequence[Bound]]) -> str:
    """Return in how many rows the ratio of medians is better, not worse, open or worse."""
    body = []
    for reference, of in bounds.items():
        words = [verdict(b) for b in of]
        above = [f"{r} ({b.value:.2f})" for r, b in zip(rows, of, strict=True) if b.value > MARGIN]
        numbers = [str(words.count(w)) for w in ("better", "not worse", "open", "worse")]
        body.append([reference, *numbers, ", ".join(above) or "none"])
    return table(["reference", "better", "not worse", "open", "worse", f"ratio above {MARGIN}"], body)


def plot(
    path: Path, rows: Sequence[str], spans: Mapping[str, FloatArray], label: str, *,
    medians: Mapping[str, FloatArray] = MappingProxyType({}), limits: Mapping[float, str] = MappingProxyType({}),
) -> None:  # fmt: skip
    """Draw low, middle and high [rows, 3] of every name in a lane per row, and medians in grey."""
    fig, grid = subplots(1, 1, 9.0, 1.5 + 0.36 * len(rows), {"font.size": 9})
    axes = grid[0, 0]
    for row in range(0, len(rows), 2):
        axes.axhspan(row - 0.5, row + 0.5, color="0.94", linewidth=0)
    step = 0.8 / max(len(spans), 1)
    for i, (name, span) in enumerate(spans.items()):
        y = np.arange(len(rows)) + (i - 0.5 * (len(spans) - 1)) * step
        colour, marker = COLOURS[i % len(COLOURS)], "osD^vP"[i % 6]
        axes.hlines(y, span[:, 0], span[:, 2], color=colour, linewidth=1.6, alpha=0.55)
        axes.plot(span[:, 1], y, marker, markersize=4.5, color=colour, label=name)
    for i, span in enumerate(medians.values()):
        label_of = None if i else "the others of the table"
        axes.plot(span[:, 1], np.arange(len(rows)), "|", markersize=7, color="0.6", zorder=1.5, label=label_of)
    for limit, dash in limits.items():
        axes.axvline(limit, color="black", linewidth=0.8, linestyle=dash)
    axes.set(xscale="log", xlabel=label, ylim=(len(rows) - 0.5, -0.5))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set_yticks(range(len(rows)), rows)
    axes.tick_params(axis="y", length=0)
    axes.grid(alpha=0.4, axis="x")
    fig.legend(frameon=False, loc="outside upper center", ncols=7)
    save(fig, path)
