"""The page of the condition table: summary and figures in ``conditions.md``, all tables in ``studies/results``."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
import polars as pl

from pdhef_logtool import __version__
from pdhef_logtool.estimators.table import SPECS
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.storage.files import PendingFile
from studies.condition_drives import BIN_LEAST_S, BINS, NONLINEAR, SIDESLIP
from studies.pages import number, table, write
from studies.pictures import save, subplots
from studies.table_maths import (
    RESAMPLES,
    Bound,
    median,
    median_ratio,
    percentiles,
    pooled_mean,
    pooled_rmse,
    verdict,
)

ALL = "all"
NOT_CAUSAL = {s.name for s in SPECS if not s.causal}
#: Below this share of the scorable stamps an RMSE is marked: it leaves out what the estimator gave up on.
AVAILABLE = 0.99
#: A bin with fewer drives is marked.
BIN_DRIVES = 30
#: Steps of the aligned signals per second.
RATE_HZ = 100.0
MARGIN = 1.05
#: In the picture with their spans, from the naive to the best; the others are medians in grey.
DRAWN = ("zero", "open-loop", "phy-ukf", "physics", "pd-hef", "pd-hef-smoothed")
#: Okabe and Ito (2008), without yellow.
COLOURS = ("#000000", "#E69F00", "#56B4E9", "#0072B2", "#D55E00", "#009E73")
_UNAVAILABLE = f"""† the estimator has no valid estimate at more than {100 * (1 - AVAILABLE):.0f} % of the stamps,
which the figure leaves out.

"""
_RATIOS = f"""With the 95 % CI of a paired bootstrap over drives ({RESAMPLES} resamples). **<** the CI is below 1;
= it is below {MARGIN}; **>** it is above {MARGIN}; ? otherwise.

"""
_MARKS = {"better": "**<**", "not worse": "=", "worse": "**>**", "open": "?", "–": ""}


@dataclass(frozen=True, slots=True)
class Facts:
    """What the page contains besides figures. ``rows``: description by name; ``order``: of the estimators."""

    command: str
    car: str
    setup: Mapping[str, str | None]
    rows: Mapping[str, str]
    subject: str | None
    references: Sequence[str]
    order: Sequence[str]
    notes: Sequence[str]
    version: str = __version__


class Figures:
    """Per-drive figures by row, estimator, signal, segment and metric: drive names, values and samples."""

    def __init__(self, table: pl.DataFrame) -> None:
        self._by: dict[tuple[str, ...], dict[str, tuple[float, int]]] = {}
        columns = ("row", "estimator", "signal", "segment", "metric", "drive", "value", "n")
        for row, estimator, signal, segment, metric, drive, value, n in table.select(columns).iter_rows():
            self._by.setdefault((row, estimator, signal, segment, metric), {})[drive] = (value, n)

    def get(
        self, row: str, estimator: str, metric: str = "rmse", *, signal: str = SIDESLIP, segment: str = ALL
    ) -> tuple[FloatArray, FloatArray]:
        """Return values [N] and samples [N] over the drives; empty where there are none."""
        by_drive = self._by.get((row, estimator, signal, segment, metric), {})
        pairs = [by_drive[d] for d in sorted(by_drive)]
        return np.array([v for v, _ in pairs], dtype=np.float64), np.array([n for _, n in pairs], dtype=np.float64)

    def pair(self, row: str, first: str, second: str) -> tuple[FloatArray, FloatArray]:
        """Return sideslip RMSE [N] of two estimators on the drives that both have."""
        a, b = (self._by.get((row, e, SIDESLIP, ALL, "rmse"), {}) for e in (first, second))
        both = sorted(a.keys() & b.keys())
        return np.array([a[d][0] for d in both]), np.array([b[d][0] for d in both])

    def estimators(self, row: str | None = None) -> set[str]:
        """Return who has a sideslip RMSE, anywhere or in a row."""
        return {k[1] for k in self._by if k[2:] == (SIDESLIP, ALL, "rmse") and row in (None, k[0])}

    def rows(self) -> set[str]:
        """Return the rows that have figures."""
        return {k[0] for k in self._by}


def write_results(folder: Path, facts: Facts, metrics: pl.DataFrame) -> None:
    """Write the results from which the page is rendered: ``facts.json`` and ``metrics.parquet``."""
    folder.mkdir(parents=True, exist_ok=True)
    texts = ("row", "drive", "estimator", "signal", "segment", "metric", "unit")
    compact = [
        *(pl.col(t).cast(pl.Categorical) for t in texts),
        pl.col("value").cast(pl.Float32),
        pl.col("n").cast(pl.Int32),
    ]
    with PendingFile(folder / "metrics.parquet") as pending:
        metrics.select(compact).write_parquet(pending.path, compression="zstd", compression_level=19)
    write(folder / "facts.json", json.dumps(asdict(facts), indent=1) + "\n")


def write_page(out: Path, folder: Path) -> None:
    """Render the page, its two figures, and all tables (``tables.md``) from the results in a folder."""
    facts = Facts(**json.loads((folder / "facts.json").read_text(encoding="utf-8")))
    figures = Figures(pl.read_parquet(folder / "metrics.parquet"))
    ran = figures.estimators()
    names = sorted((n for n in facts.order if n in ran), key=lambda n: n in NOT_CAUSAL)
    rows = [r for r in facts.rows if r in figures.rows()]
    references = [r for r in facts.references if r in ran and r != facts.subject]
    write(folder / "tables.md", _tables(figures, rows, names, facts))
    pictures = out / "conditions"
    pictures.mkdir(parents=True, exist_ok=True)
    _plot_rows(pictures / "sideslip.png", figures, rows, names)
    parts = [_head(facts), _summary(facts, figures, rows, [n for n in DRAWN if n in names])]
    parts.append("![Sideslip RMSE by row](conditions/sideslip.png)\n")
    if facts.subject is not None and references:
        _plot_ratios(pictures / "ratios.png", figures, rows, facts.subject, references)
        parts += [_counts(figures, rows, facts.subject, references)]
        parts.append(f"![Ratio of {facts.subject} to its references](conditions/ratios.png)\n")
    if facts.notes:
        parts.append("\n".join(["Estimators that did not run:", "", *(f"- {note}" for note in facts.notes), ""]))
    write(out / "conditions.md", "\n".join(parts))


def _deg(value: float, digits: int = 3) -> str:
    return number(math.degrees(value), digits)


def _table(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """Return a table with what parts it from the next."""
    return table(head, body) + "\n"


def _head(facts: Facts) -> str:
    network, calibrated = facts.setup["network"], facts.setup["intervals"]
    physics, noise = (str(facts.setup[k])[:12] for k in ("physics", "noise"))
    return "\n".join(
        [
            "# Simulated conditions",
            "",
            "This page shows the sideslip error of all estimators on simulated drives. Each row changes one condition.",
            f"Command: `{facts.command}`.",
            "",
            f"Car: {facts.car} (physics {physics}, noise {noise}); network "
            f"{'none' if network is None else network[:12]}; 95 % intervals "
            f"{'as the estimators return them' if calibrated is None else calibrated[:12]}; "
            f"pdhef-logtool {facts.version}.",
            "The vehicle file is the same in all rows. Estimators get the true friction, unless the row changes it.",
            "The ground truth is the state of the simulator.",
            "",
        ]
    )


def _summary(facts: Facts, figures: Figures, rows: Sequence[str], names: Sequence[str]) -> str:
    """Return the median RMSE of the main estimators, and the coverage of the subject, by row."""
    drives = {r: max(figures.get(r, n)[0].size for n in figures.estimators(r)) for r in rows}
    subject = facts.subject
    head = ["row", "condition", "drives", *names, *([] if subject is None else [f"coverage of {subject}"])]
    body = []
    for row in rows:
        cells = [_deg(median(figures.get(row, n)[0])) for n in names]
        if subject is not None:
            covered = [figures.get(row, subject, "coverage95", segment=b) for b in BINS]
            values, samples = (np.concatenate([c[i] for c in covered]) for i in (0, 1))
            cells.append(f"{100 * pooled_mean(values, samples):.0f} %" if values.size else "–")
        body.append([row, facts.rows[row], str(drives[row]), *cells])
    lines = [
        "Sideslip RMSE in degrees, median over drives. `pd-hef-smoothed` is not causal: it uses later measurements.",
        "Coverage: share of samples in the 95 % confidence interval.",
        "",
        _table(head, body),
        "All estimators, percentiles, pooled errors, NEES, NIS, coverage by use of grip, and lag:",
        "`studies/results/conditions/tables.md`. All figures by drive: `metrics.parquet` in the same folder.",
        "",
    ]
    return "\n".join(lines)


def _counts(figures: Figures, rows: Sequence[str], subject: str, references: Sequence[str]) -> str:
    """Return in how many rows the ratio of medians is better, not worse, open or worse."""
    body = []
    for reference in references:
        bounds = {r: b for r in rows if math.isfinite((b := ratio(figures, r, subject, reference)).value)}
        words = [verdict(b) for b in bounds.values()]
        above = [f"{r} ({b.value:.2f})" for r, b in bounds.items() if b.value > MARGIN]
        counts = [str(words.count(w)) for w in ("better", "not worse", "open", "worse")]
        body.append([reference, *counts, ", ".join(above) or "none"])
    return "\n".join(
        [
            f"Rows by the ratio of the median RMSE of `{subject}` to a reference, with 95 % CI of a paired bootstrap",
            f"over drives. Better: the CI is below 1; not worse: below {MARGIN}; worse: above {MARGIN}; open: else.",
            "",
            _table(["reference", "better", "not worse", "open", "worse", f"ratio above {MARGIN}"], body),
        ]
    )


def _tables(figures: Figures, rows: Sequence[str], names: Sequence[str], facts: Facts) -> str:
    """Return all tables: a line for each row, a column for each estimator."""
    references = [r for r in facts.references if r in names and r != facts.subject]
    compared = [n for n in names if n in {facts.subject, *references}]

    def mark(row: str, name: str) -> str:
        return "†" if pooled_mean(*figures.get(row, name, "availability")) < AVAILABLE else ""

    def middle(row: str, name: str) -> str:
        return _deg(median(figures.get(row, name)[0])) + mark(row, name)

    def spread(row: str, name: str) -> str:
        low, high = percentiles(figures.get(row, name)[0], (10.0, 90.0))
        return f"{_deg(low)}–{_deg(high)}" if math.isfinite(low) else "–"

    def pooled(row: str, name: str) -> str:
        return _deg(pooled_rmse(*figures.get(row, name))) + mark(row, name)

    def ratio_text(row: str, reference: str) -> str:
        bound = ratio(figures, row, str(facts.subject), reference)
        if not math.isfinite(bound.value):
            return "–"
        return f"{bound.value:.2f} [{number(bound.low, 2)}, {number(bound.high, 2)}] {_MARKS[verdict(bound)]}"

    def nonlinear(row: str, name: str) -> str:
        return _deg(median(figures.get(row, name, segment=NONLINEAR)[0]))

    def consistency(row: str, name: str) -> str:
        nees, nis, dof = (
            pooled_mean(*figures.get(row, name, metric, signal="state")) for metric in ("nees", "nis", "nis_dof")
        )
        return f"{number(nees / 3.0, 2)} / {number(nis / dof, 2)}"

    sections = (
        ("Sideslip RMSE in degrees: median over drives", _UNAVAILABLE, names, middle),
        ("Sideslip RMSE in degrees: 10th to 90th percentile over drives", "", names, spread),
        ("Sideslip RMSE in degrees: pooled over all samples", "", names, pooled),
        (f"`{facts.subject}` against its references: ratio of the medians", _RATIOS, references, ratio_text),
        ("Sideslip RMSE in degrees in the nonlinear range (|a_y| > 0.5 μ g): median over drives", "", names, nonlinear),
        ("NEES and NIS over their degrees of freedom (expected value 1)", "", compared, consistency),
    )
    texts = [
        f"## {title}\n\n{text}{_table(['row', *columns], [[r, *(cell(r, n) for n in columns)] for r in rows])}"
        for title, text, columns, cell in sections
        if columns
    ]
    return "\n".join(["# Tables of the simulated conditions\n", *texts, _coverage(figures, rows, names, facts.subject)])


def ratio(figures: Figures, row: str, subject: str, reference: str) -> Bound:
    """Return the ratio of the medians of two estimators in a row, paired."""
    return median_ratio(*figures.pair(row, subject, reference))


def _bin_cell(figures: Figures, row: str, name: str, segment: str) -> str:
    width, samples = figures.get(row, name, "width95", segment=segment)
    if not width.size:
        return "–"
    coverage = pooled_mean(*figures.get(row, name, "coverage95", segment=segment))
    score = pooled_mean(*figures.get(row, name, "interval_score95", segment=segment))
    drives = int(np.count_nonzero(samples >= BIN_LEAST_S * RATE_HZ))
    few = "" if drives >= BIN_DRIVES else f" ({drives})"
    return f"{100 * coverage:.0f} % / {_deg(score, 2)} / {_deg(pooled_mean(width, samples), 2)}{few}"


def _coverage(figures: Figures, rows: Sequence[str], names: Sequence[str], subject: str | None) -> str:
    banded = [n for n in names if any(figures.get(r, n, "width95")[0].size for r in rows)]
    if not banded:
        return ""
    limits = [
        f"{b} ({low:g}–{high:g})" if math.isfinite(high) else f"{b} (> {low:g})" for b, (low, high) in BINS.items()
    ]
    lines = [
        "## Uncertainty of the sideslip by share of the grip",
        "",
        "Share of samples inside ± 1.96 σ (95 % is right) / interval score in degrees (smaller is better) / mean width",
        "in degrees, in bins of |a_y| / (μ g). In parentheses the number of drives with at least",
        f"{BIN_LEAST_S:g} s in the bin, where it is below {BIN_DRIVES}.",
        "",
    ]
    first = rows[0]
    body = [[n, *(_bin_cell(figures, first, n, b) for b in BINS)] for n in banded]
    lines += [f"All estimators in the row `{first}`:", "", _table(["estimator", *limits], body)]
    if subject in banded:
        body = [[r, *(_bin_cell(figures, r, str(subject), b) for b in BINS)] for r in rows]
        lines += [f"`{subject}` in all rows:", "", _table(["row", *limits], body)]
    return "\n".join(lines)


def _plot_rows(path: Path, figures: Figures, rows: Sequence[str], names: Sequence[str]) -> None:
    """Median with the span from the 10th to the 90th percentile, a line a row; most estimators as grey dots."""
    spans = {n: np.degrees([percentiles(figures.get(r, n)[0]) for r in rows]).reshape(-1, 3) for n in names}
    drawn = {n: spans.pop(n) for n in DRAWN if n in spans}
    label = "sideslip RMSE in degrees: median and 10th to 90th percentile over drives"
    _plot(path, rows, drawn, label, medians=spans)


def _plot_ratios(path: Path, figures: Figures, rows: Sequence[str], subject: str, references: Sequence[str]) -> None:
    """Ratios of medians with their intervals."""
    spans = {}
    for reference in references:
        bounds = [ratio(figures, r, subject, reference) for r in rows]
        spans[reference] = np.array([(b.low, b.value, b.high) for b in bounds])
    label = f"median sideslip RMSE of {subject} over that of the reference, 95 % interval"
    _plot(path, rows, spans, label, limits={1.0: "-", MARGIN: ":"})


def _plot(
    path: Path, rows: Sequence[str], spans: Mapping[str, FloatArray], label: str, *,
    medians: Mapping[str, FloatArray] = MappingProxyType({}), limits: Mapping[float, str] = MappingProxyType({}),
) -> None:  # fmt: skip
    """Draw low, middle and high [rows, 3] of every name in a lane of its own in each row, and medians in grey."""
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
