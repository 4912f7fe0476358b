"""The drives of runs as one table: a row per run, drive and estimator, from run.json and metrics.parquet."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from pdhef_logtool.records.geometry import DEGREES
from pdhef_logtool.results.opened_run import OpenedRun

if TYPE_CHECKING:
    import polars as pl

#: Figures of whole drives: signal, metric and factor to the unit in the name of the column.
FIGURES: dict[str, tuple[str, str, float]] = {
    "sideslip_rmse_deg": ("sideslip_rad", "rmse", DEGREES),
    "vy_rmse_m_s": ("vy_m_s", "rmse", 1.0),
    "yaw_rate_rmse_deg_s": ("yaw_rate_rad_s", "rmse", DEGREES),
    "vx_rmse_m_s": ("vx_m_s", "rmse", 1.0),
    "coverage95": ("sideslip_rad", "coverage95", 1.0),
    "consistency_m_s": ("vy_m_s", "d2", 1.0),
}
TEXTS = ("run", "drive", "car", "outcome", "estimator")
#: First characters of a text that a spreadsheet evaluates as a formula.
_FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n")


def drive_rows(runs: Sequence[tuple[str, OpenedRun]]) -> pl.DataFrame:
    """Return the drives of named runs: :data:`TEXTS`, ``selected`` and :data:`FIGURES`, null where not computed.

    A figure whose ground truth is an input of the estimator is null. Drives without a figure have one row.

    Raises
    ------
    OutputError : metrics.parquet of a run is damaged.
    """
    import polars as pl

    tables = [_rows(name, run) for name, run in runs]
    return pl.concat(tables).with_row_index("number")


def independent_figures(run: OpenedRun, signal: str, metric: str, segment: str = "all") -> pl.DataFrame:
    """Return log, estimator, value, unit and main (selected estimator) of a figure with independent ground truth.

    Raises
    ------
    OutputError : metrics.parquet of the run is damaged.
    """
    import polars as pl

    texts = {"log": pl.String, "main": pl.String}
    mains = pl.DataFrame([(log.label, log.main()) for log in run.logs], schema=texts, orient="row")
    rows = run.metrics().filter(pl.col("signal") == signal)
    dependent = rows.filter(pl.col("metric") == "not_independent").select("log", "estimator")
    scored = rows.filter(pl.col("metric") == metric, pl.col("segment") == segment, pl.col("value").is_finite())
    scored = scored.select("log", "estimator", "value", "unit").join(dependent, on=["log", "estimator"], how="anti")
    return scored.collect().join(mains, on="log").sort("log", "estimator")


def _rows(name: str, run: OpenedRun) -> pl.DataFrame:
    import polars as pl

    text = pl.String
    drives = pl.DataFrame(
        {
            "drive": [log.label for log in run.logs],
            "car": [str((log.entry.get("car") or {}).get("name") or "") for log in run.logs],
            "outcome": [log.outcome.partition(":")[0] for log in run.logs],
            "main": [log.main() for log in run.logs],
        },
        schema={"drive": text, "car": text, "outcome": text, "main": text},
    )
    signals = sorted({signal for signal, _, _ in FIGURES.values()})
    metrics = sorted({"not_independent", *(metric for _, metric, _ in FIGURES.values())})
    rows = (
        run.metrics()
        .filter(
            (pl.col("segment") == "all") & pl.col("signal").is_in(signals) & pl.col("metric").is_in(metrics),
            ~pl.col("estimator").str.contains("~", literal=True),
        )
        .select(pl.col("log").alias("drive"), "estimator", "signal", "metric", "value")
        .collect()
    )
    flagged = rows.filter(pl.col("metric") == "not_independent").select("drive", "estimator", "signal")
    independent = rows.join(flagged, on=["drive", "estimator", "signal"], how="anti")
    figures = independent.group_by("drive", "estimator").agg(
        (pl.col("value").filter((pl.col("signal") == signal) & (pl.col("metric") == metric)).first() * factor).alias(c)
        for c, (signal, metric, factor) in FIGURES.items()
    )
    joined = drives.join(figures, on="drive", how="left", maintain_order="left")
    return joined.select(
        pl.lit(name).alias("run"),
        "drive",
        "car",
        "outcome",
        estimator=pl.coalesce("estimator", "main"),
        selected=(pl.col("estimator") == pl.col("main")) | pl.col("estimator").is_null(),
        **{c: pl.col(c).fill_nan(None) for c in FIGURES},
    ).sort("drive", "estimator", maintain_order=True)


def csv_text(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return rows as CSV (RFC 4180); an apostrophe precedes a text that a spreadsheet would evaluate as a formula."""
    file = io.StringIO(newline="")
    writer = csv.writer(file)
    writer.writerow(heads)
    for row in rows:
        writer.writerow([_plain(cell) for cell in row])
    return file.getvalue()


def _plain(cell: object) -> object:
    if not isinstance(cell, str):
        return cell
    # Spreadsheets ignore leading spaces before a formula.
    return f"'{cell}" if cell.lstrip().startswith(_FORMULA) or cell.startswith(_FORMULA) else cell
