"""The condition table as a page: ``conditions.md`` and, beside it, its Parquet tables and plots. No figure by hand."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType

import numpy as np
import polars as pl

from pdhef_logtool import __version__
from pdhef_logtool.estimators.table import SPECS
from pdhef_logtool.records.files import PendingFile
from pdhef_logtool.records.signals import FloatArray
from studies import fixed_grid
from studies.condition_drives import BIN_LEAST_S, BINS, NONLINEAR, SIDESLIP
from studies.error_budget import CAUSES
from studies.pages import number, table, write
from studies.pictures import save, subplots
from studies.table_maths import (
    RESAMPLES,
    Bound,
    geometric_mean,
    median,
    median_ratio,
    percentiles,
    pooled_mean,
    pooled_ratio,
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
_MARKS = {"better": "**<**", "not worse": "=", "worse": "**>**", "open": "?", "–": ""}


@dataclass(frozen=True, slots=True)
class Facts:
    """What the page says besides the figures. ``rows``: description by name, in order; ``order``: of the estimators."""

    command: str
    car: str
    setup: Mapping[str, str | None]
    rows: Mapping[str, str]
    subject: str | None
    references: Sequence[str]
    order: Sequence[str]
    notes: Sequence[str]
    calibration_seed: int


@dataclass(frozen=True)
class Tables:
    """Long tables in the columns of ``condition_runs.COLUMNS``; the latter two may be empty."""

    metrics: pl.DataFrame
    calibration: pl.DataFrame
    budget: pl.DataFrame

    @cached_property
    def figures(self) -> Figures:
        """Figures of the table's drives."""
        return Figures(self.metrics)


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
        found = self._by.get((row, estimator, signal, segment, metric), {})
        pairs = [found[d] for d in sorted(found)]
        return np.array([v for v, _ in pairs], dtype=np.float64), np.array([n for _, n in pairs], dtype=np.float64)

    def pair(self, row: str, first: str, second: str) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return sideslip RMSE of two estimators on the drives that both have, and their samples; each [N]."""
        a, b = (self._by.get((row, e, SIDESLIP, ALL, "rmse"), {}) for e in (first, second))
        both = sorted(a.keys() & b.keys())
        columns = [[a[d][0] for d in both], [b[d][0] for d in both], [a[d][1] for d in both], [b[d][1] for d in both]]
        first_rmse, second_rmse, first_n, second_n = (np.array(c, dtype=np.float64) for c in columns)
        return first_rmse, second_rmse, first_n, second_n

    def estimators(self, row: str | None = None) -> set[str]:
        """Return who has a sideslip RMSE, anywhere or in a row."""
        return {k[1] for k in self._by if k[2:] == (SIDESLIP, ALL, "rmse") and row in (None, k[0])}

    def rows(self) -> set[str]:
        """Return the rows that have figures."""
        return {k[0] for k in self._by}


@dataclass(frozen=True, slots=True)
class Chosen:
    """The fixed setting that is best on the calibration drives; ``ranking``: settings and scores in rad, best first."""

    name: str
    ranking: tuple[tuple[str, float], ...]


def choose_fixed(calibration: pl.DataFrame) -> Chosen | None:
    """Return the setting with the least geometric mean over rows of the median sideslip RMSE; None without any."""
    if calibration.is_empty():
        return None
    figures = Figures(calibration)
    rows = sorted(figures.rows())
    scores = {
        s: geometric_mean(np.array([median(figures.get(r, s)[0]) for r in rows])) for s in sorted(figures.estimators())
    }
    ranking = tuple(sorted(scores.items(), key=lambda item: (math.isnan(item[1]), item[1])))
    return Chosen(ranking[0][0], ranking) if ranking else None


def with_best(metrics: pl.DataFrame, chosen: Chosen | None) -> pl.DataFrame:
    """Return the metrics with the chosen setting's rows once more, under the name that the tables use."""
    if chosen is None:
        return metrics
    rows = metrics.filter(pl.col("estimator") == chosen.name)
    return pl.concat([metrics, rows.with_columns(estimator=pl.lit(fixed_grid.BEST))])


def write_page(out: Path, facts: Facts, given: Tables) -> None:
    """Write page, Parquet tables and plots."""
    chosen = choose_fixed(given.calibration)
    tables = Tables(with_best(given.metrics, chosen), given.calibration, given.budget)
    figures = tables.figures
    ran = figures.estimators()
    names = sorted((n for n in (*facts.order, fixed_grid.BEST) if n in ran), key=lambda n: n in NOT_CAUSAL)
    rows = [r for r in facts.rows if r in figures.rows()]
    references = [r for r in facts.references if r in ran and r != facts.subject]
    folder = out / "conditions"
    parts = [
        _head(facts, figures, rows, [n for n in names if n in NOT_CAUSAL]),
        _sideslip(figures, rows, names),
        _means(figures, rows, names),
        _against(figures, rows, facts.subject, references),
        _fixed(figures, rows, chosen, facts),
        _nonlinear(figures, rows, names),
        _consistency(figures, rows, [n for n in names if n in {facts.subject, *references}]),
        _coverage(figures, rows, names, facts.subject),
        _lags(figures, rows, [n for n in names if n in {facts.subject, "zero", *references}]),
        _budget(tables.budget, rows),
    ]
    folder.mkdir(parents=True, exist_ok=True)
    _write_parquet(folder, tables, rows, names)
    _plot_rows(folder / "sideslip.png", figures, rows, names)
    if facts.subject is not None and references:
        _plot_ratios(folder / "ratios.png", figures, rows, facts.subject, references)
        parts.append(f"![{facts.subject} against its references](conditions/ratios.png)\n")
    parts.insert(2, "![Sideslip RMSE by row](conditions/sideslip.png)\n")
    write(out / "conditions.md", "\n".join(p for p in parts if p))


def _deg(value: float, digits: int = 3) -> str:
    return number(math.degrees(value), digits)


def _grid(rows: Sequence[str], names: Sequence[str], cell: Callable[[str, str], str], corner: str = "row") -> str:
    return _table([corner, *names], [[r, *(cell(r, n) for n in names)] for r in rows])


def _table(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """Return a table with what parts it from the next."""
    return table(head, body) + "\n"


def _head(facts: Facts, figures: Figures, rows: Sequence[str], not_causal: Sequence[str]) -> str:
    network, calibrated = facts.setup["network"], facts.setup["intervals"]
    physics, noise = (str(facts.setup[k])[:12] for k in ("physics", "noise"))
    used = f"{facts.car} (physics {physics}, noise {noise})"
    ran = "none: no hybrid filter ran" if network is None else f"sha256 {network[:12]}"
    intervals = "as the estimators give them" if calibrated is None else f"calibrated, sha256 {calibrated[:12]}"
    drives = {r: max(figures.get(r, n)[0].size for n in figures.estimators(r)) for r in rows}
    lines = [
        "# Condition table",
        "",
        f"Written by `{facts.command}`; every figure comes from that command.",
        "",
        f"Car: {used}; network {ran}; pdhef-logtool {__version__}.",
        f"95 % intervals {intervals}.",
        "The vehicle file stays the same in all rows, whatever car is driven. Friction is told to every estimator from",
        "the drive, times the factor of the row, or not at all where the row says so. Truth is the simulator's state.",
        "",
        _table(["row", "drives", "what is different"], [[r, str(drives[r]), facts.rows[r]] for r in rows]),
    ]
    if not_causal:
        knows = ", ".join(f"`{n}`" for n in not_causal)
        lines += [f"Not causal, and so last and to be ranked apart: {knows} (it uses what is measured later).", ""]
    if facts.notes:
        lines += ["What did not run:", "", *(f"- {note}" for note in facts.notes), ""]
    return "\n".join(lines)


def _sideslip(figures: Figures, rows: Sequence[str], names: Sequence[str]) -> str:
    def mark(row: str, name: str) -> str:
        return "†" if pooled_mean(*figures.get(row, name, "availability")) < AVAILABLE else ""

    def middle(row: str, name: str) -> str:
        return _deg(median(figures.get(row, name)[0])) + mark(row, name)

    def spread(row: str, name: str) -> str:
        low, high = percentiles(figures.get(row, name)[0], (10.0, 90.0))
        return f"{_deg(low)}–{_deg(high)}" if math.isfinite(low) else "–"

    def pooled(row: str, name: str) -> str:
        return _deg(pooled_rmse(*figures.get(row, name))) + mark(row, name)

    return "\n".join(
        [
            "## Sideslip RMSE in degrees: median over drives",
            "",
            f"† the estimator gave no valid estimate at more than {100 * (1 - AVAILABLE):.0f} % of the stamps, which",
            "the figure leaves out.",
            "",
            _grid(rows, names, middle),
            "## Sideslip RMSE in degrees: 10th to 90th percentile over drives",
            "",
            _grid(rows, names, spread),
            "## Sideslip RMSE in degrees: pooled over all samples",
            "",
            _grid(rows, names, pooled),
        ]
    )


def common_rows(figures: Figures, rows: Sequence[str], names: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the rows in which all estimators have figures, and those estimators: who misses most rows is left out."""
    kept = [n for n in names if 2 * sum(figures.get(r, n)[0].size > 0 for r in rows) > len(rows)]
    return [r for r in rows if all(figures.get(r, n)[0].size for n in kept)], kept


def _means(figures: Figures, rows: Sequence[str], names: Sequence[str]) -> str:
    shared, kept = common_rows(figures, rows, names)
    if not shared:
        return ""

    def over(row_figure: Callable[[str, str], float]) -> list[float]:
        return [geometric_mean(np.array([row_figure(r, n) for r in shared])) for n in kept]

    medians = over(lambda r, n: median(figures.get(r, n)[0]))
    pooled = over(lambda r, n: pooled_rmse(*figures.get(r, n)))
    body = [[n, _deg(m), _deg(p)] for n, m, p in zip(kept, medians, pooled, strict=True)]
    title = f"## Geometric mean over {len(shared)} rows, in degrees\n\nThe rows in which all of these ran.\n"
    return f"{title}\n{_table(['estimator', 'of the medians', 'of the pooled RMSE'], body)}"


def ratios(figures: Figures, row: str, subject: str, reference: str) -> tuple[Bound, Bound]:
    """Return the ratio of medians and of pooled RMSE of two estimators in a row, paired."""
    a, b, n_a, n_b = figures.pair(row, subject, reference)
    return median_ratio(a, b), pooled_ratio(a, b, n_a, n_b)


def _against(figures: Figures, rows: Sequence[str], subject: str | None, references: Sequence[str]) -> str:
    if subject is None or not references:
        return ""
    found = {(r, ref): ratios(figures, r, subject, ref) for r in rows for ref in references}

    def cell(which: int) -> Callable[[str, str], str]:
        def text(row: str, reference: str) -> str:
            bound = found[row, reference][which]
            if not math.isfinite(bound.value):
                return "–"
            return f"{bound.value:.2f} [{number(bound.low, 2)}, {number(bound.high, 2)}] {_MARKS[verdict(bound)]}"

        return text

    lines = [
        f"## `{subject}` against its references",
        "",
        f"Ratio of sideslip RMSE, below 1 where `{subject}` is better, with the 95 % interval of a paired bootstrap",
        f"over drives ({RESAMPLES} resamples). **<** the whole interval lies below 1; = it lies below {MARGIN};",
        f"**>** it lies above {MARGIN}; ? it decides nothing.",
        "",
        "Of the medians:",
        "",
        _grid(rows, references, cell(0)),
        "Of the pooled RMSE:",
        "",
        _grid(rows, references, cell(1)),
    ]
    body = []
    for reference in references:
        for which, what in enumerate(("medians", "pooled")):
            bounds = {r: found[r, reference][which] for r in rows if math.isfinite(found[r, reference][which].value)}
            words = [verdict(b) for b in bounds.values()]
            over = [f"{r} ({b.value:.2f})" for r, b in bounds.items() if b.value > MARGIN]
            counts = [str(words.count(w)) for w in ("better", "not worse", "open", "worse")]
            body.append([reference, what, *counts, ", ".join(over) or "none"])
    head = ["reference", "of", "better", "not worse", "open", "worse", f"rows with a ratio above {MARGIN}"]
    return "\n".join([*lines, _table(head, body)])


def _fixed(figures: Figures, rows: Sequence[str], chosen: Chosen | None, facts: Facts) -> str:
    settings = sorted(n for n in figures.estimators() if fixed_grid.is_setting(n))
    if chosen is None or not settings:
        return ""
    body = []
    subject = facts.subject or fixed_grid.BEST
    for row in rows:
        medians = {s: median(figures.get(row, s)[0]) for s in settings if figures.get(row, s)[0].size}
        pooled = {s: pooled_rmse(*figures.get(row, s)) for s in medians}
        if medians:
            m, p = (min(d, key=d.__getitem__) for d in (medians, pooled))
            own = median(figures.get(row, subject)[0]), pooled_rmse(*figures.get(row, subject))
            body.append([row, m, _deg(medians[m]), _deg(own[0]), p, _deg(pooled[p]), _deg(own[1])])
    return "\n".join(
        [
            "## The best single fixed setting",
            "",
            f"Of {len(chosen.ranking)} settings of the hybrid filter (trust; factors on σ of a_y and on Q of "
            f"`{fixed_grid.BASE}`), `{fixed_grid.BEST}`",
            f"is the one with the least geometric mean over rows of the median on other drives (seed "
            f"{facts.calibration_seed}): **{chosen.name}**.",
            "",
            _table(["setting", "on the calibration drives, deg"], [[s, _deg(v)] for s, v in chosen.ranking[:5]]),
            "What nobody could have known beforehand, the best setting of each row on its own drives:",
            "",
            _table(["row", "best by median", "deg", f"`{subject}`", "best pooled", "deg", f"`{subject}`"], body),
        ]
    )


def _nonlinear(figures: Figures, rows: Sequence[str], names: Sequence[str]) -> str:
    title = "## Sideslip RMSE in the nonlinear range (|a_y| > 0.5 μ g), in degrees: median over drives\n\n"
    return title + _grid(rows, names, lambda row, name: _deg(median(figures.get(row, name, segment=NONLINEAR)[0])))


def _consistency(figures: Figures, rows: Sequence[str], names: Sequence[str]) -> str:
    if not names:
        return ""

    def state(row: str, name: str, metric: str) -> float:
        return pooled_mean(*figures.get(row, name, metric, signal="state"))

    def cell(row: str, name: str) -> str:
        nees = state(row, name, "nees") / 3.0
        nis = state(row, name, "nis") / state(row, name, "nis_dof")
        return f"{number(nees, 2)} / {number(nis, 2)}"

    title = "## NEES and NIS, each over its degrees of freedom (1 is right)\n\n"
    return title + _grid(rows, names, cell)


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


def _lags(figures: Figures, rows: Sequence[str], names: Sequence[str]) -> str:
    def cell(row: str, name: str) -> str:
        lags = [median(figures.get(row, name, "lag_s", signal=s)[0]) for s in (SIDESLIP, "yaw_rate_rad_s")]
        return " / ".join(number(1e3 * x, 1) for x in lags)

    if not names:
        return ""
    what = "By cross-correlation with the truth, median over drives; + is late."
    return f"## Lag of sideslip / yaw rate in ms\n\n{what}\n\n{_grid(rows, names, cell)}"


def _budget(budget: pl.DataFrame, rows: Sequence[str]) -> str:
    if budget.is_empty():
        return ""
    rmse: dict[tuple[str, str, str], float] = {}
    for key, part in budget.group_by("row", "estimator", "segment"):
        row, estimator, cause = map(str, key)
        rmse[row, estimator, cause] = pooled_rmse(part["value"].to_numpy(), part["n"].to_numpy())
    drives = max(part["drive"].n_unique() for _, part in budget.group_by("row"))
    lines = [
        "## Error budget",
        "",
        f"The same drives again ({drives} a row) with one cause taken away: by how much of itself the mean square of",
        "the sideslip error goes down (negative: up). Causes act together, so that shares need not add up to 100 %; a",
        "dash: nothing to take away. `told`: friction and sensors that the row withholds; `vehicle`: a vehicle file of",
        "that very car and road; `tilt`: roll, pitch, bank and grade in the accelerometers; `fault`: what is injected.",
        "The simulator cannot switch off what stays when all are gone: tyre relaxation, load transfer, combined slip,",
        "the shape of real tyre curves, quantisation, wheel slip, and the pull of a banked road on the car. A network",
        "was trained against one vehicle file and knows no other: for hybrid filters `vehicle` and `all` say little.",
        "",
    ]
    for estimator in sorted({e for _, e, _ in rmse}, reverse=True):
        body = []
        for row in rows:
            base = rmse.get((row, estimator, "base"))
            if base is None:
                continue
            shares = []
            for cause in CAUSES:
                left = rmse.get((row, estimator, cause))
                shares.append("–" if left is None else f"{100 * (1 - (left / base) ** 2):.0f} %")
            body.append([row, _deg(base), *shares, _deg(rmse.get((row, estimator, "all"), math.nan))])
        head = ["row", "pooled RMSE, deg", *CAUSES, "RMSE without all, deg"]
        lines += [f"`{estimator}`:", "", _table(head, body)]
    return "\n".join(lines)


def _write_parquet(folder: Path, tables: Tables, rows: Sequence[str], names: Sequence[str]) -> None:
    texts = ("row", "drive", "estimator", "signal", "segment", "metric", "unit")
    is_grid = pl.col("estimator").str.starts_with(f"{fixed_grid.PREFIX}(")
    compact = [
        *(pl.col(t).cast(pl.Categorical) for t in texts),
        pl.col("value").cast(pl.Float32),
        pl.col("n").cast(pl.Int32),
    ]
    files = {"metrics": tables.metrics.filter(~is_grid).select(compact)}
    if not tables.budget.is_empty():
        files["budget"] = tables.budget.select(compact)
    summary = []
    settings = sorted(n for n in tables.figures.estimators() if fixed_grid.is_setting(n))
    for row in rows:
        for name in (*names, *settings):
            values, samples = tables.figures.get(row, name)
            if values.size:
                low, middle, high = percentiles(values)
                pooled = pooled_rmse(values, samples)
                summary.append((row, name, int(values.size), *map(math.degrees, (middle, low, high, pooled))))
    columns = ("row", "estimator", "drives", "median_deg", "p10_deg", "p90_deg", "pooled_deg")
    files["sideslip"] = pl.DataFrame(summary, schema=columns, orient="row")
    for name, frame in files.items():
        with PendingFile(folder / f"{name}.parquet") as pending:
            frame.write_parquet(pending.path, compression="zstd", compression_level=19)


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
        bounds = [ratios(figures, r, subject, reference)[0] for r in rows]
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
    for at, dash in limits.items():
        axes.axvline(at, color="black", linewidth=0.8, linestyle=dash)
    axes.set(xscale="log", xlabel=label, ylim=(len(rows) - 0.5, -0.5))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set_yticks(range(len(rows)), rows)
    axes.tick_params(axis="y", length=0)
    axes.grid(alpha=0.4, axis="x")
    fig.legend(frameon=False, loc="outside upper center", ncols=7)
    save(fig, path)
