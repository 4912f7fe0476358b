"""A figure over several runs, in the order given: each run against the previous one and against the first."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pdhef_logtool.evaluation.units import read_unit
from pdhef_logtool.results.comparing import ComparedFigure, compared_figure
from pdhef_logtool.results.drive_rows import independent_figures
from pdhef_logtool.results.gate import MAIN, Figure
from pdhef_logtool.results.opened_run import OpenedRun
from pdhef_logtool.results.paired_change import holm

#: Family-wise error rate of the marks of a trend.
SIGNIFICANT = 0.05


@dataclass(frozen=True, slots=True)
class TrendRow:
    """One run.

    Attributes
    ----------
    run : its folder or URL. logs, failed : how many, and how many of them failed.
    scored, median : drives with the figure, and its median over them in ``unit`` of metrics.parquet (NaN: none).
    previous, first : its figure against that of the run before and of the first run; None without a common drive.
    p_previous, p_first : two-sided p-values of the sign test, corrected for all comparisons of the trend (Holm).
    differences : what else differs from the run before, a line each.
    regression : against which runs the figure is significantly higher: ``previous``, ``first``, both or none.
    """

    run: str
    logs: int
    failed: int
    scored: int
    median: float
    unit: str
    previous: ComparedFigure | None = None
    first: ComparedFigure | None = None
    p_previous: float = math.nan
    p_first: float = math.nan
    differences: tuple[str, ...] = ()
    regression: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Trend:
    """The runs in the order given. ``figure``: what is compared; its limit is the accepted increase."""

    figure: Figure
    rows: tuple[TrendRow, ...]

    @property
    def regressions(self) -> tuple[TrendRow, ...]:
        """Runs whose figure is significantly higher than that of the run before or of the first run."""
        return tuple(row for row in self.rows if row.regression)

    def to_dict(self) -> dict[str, Any]:
        """Return the trend as one JSON-able document; changes are shares: 0.05 is 5 % more."""
        return {
            "format": "pdhef.trend",
            "version": 1,
            "signal": self.figure.signal,
            "metric": self.figure.metric,
            "estimator": self.figure.estimator,
            "limit": self.figure.limit or 0.0,
            "regressions": [row.run for row in self.regressions],
            "runs": [_to_dict(row) for row in self.rows],
        }


def _to_dict(row: TrendRow) -> dict[str, Any]:
    plain = ("run", "logs", "failed", "scored", "median", "unit", "differences", "regression")
    changes = {"previous": _change(row.previous, row.p_previous), "first": _change(row.first, row.p_first)}
    return {**{key: getattr(row, key) for key in plain}, **changes}


def _change(figure: ComparedFigure | None, p: float) -> dict[str, Any] | None:
    if figure is None:
        return None
    shares = {key: math.expm1(getattr(figure.change, key)) for key in ("median", "low", "high")}
    dependence = figure.change.dependence
    return {
        "drives": figure.change.drives,
        **shares,
        "p_holm": p,
        "design_effect": dependence.design_effect,
        "dependence": dependence.by,
    }


def trend_of(runs: Sequence[OpenedRun], figure: Figure, cluster: str | None = None) -> Trend:
    """Return the trend of a figure over runs.

    Parameters
    ----------
    figure : its limit is the increase (a share) up to which a run is no regression. cluster : as in ``compare_runs``.

    Raises
    ------
    OutputError : The figures of a run are damaged. UsageError : No drive has the estimator, or the key.
    """
    against: dict[tuple[int, str], ComparedFigure] = {}
    differences: list[tuple[str, ...]] = [()]
    for number in range(1, len(runs)):
        previous, lines = compared_figure(runs[number - 1], runs[number], figure, cluster)
        first = previous if number == 1 else compared_figure(runs[0], runs[number], figure, cluster)[0]
        differences.append(lines)
        for name, compared in (("previous", previous), ("first", first)):
            if compared is not None:
                against[number, name] = compared
    looks = [place for place in against if place != (1, "first")]  # of the second run both are the same
    corrected = dict(zip(looks, holm([against[place].change.sign_p for place in looks]), strict=True))
    if (1, "previous") in corrected:
        corrected[1, "first"] = corrected[1, "previous"]
    limit = math.log1p(figure.limit or 0.0)
    rows = []
    for number, run in enumerate(runs):
        names = [name for name in ("previous", "first") if (number, name) in against]
        worse = [
            name
            for name in names
            if corrected[number, name] < SIGNIFICANT and against[number, name].change.median > limit
        ]
        rows.append(
            TrendRow(
                run.place,
                len(run.logs),
                sum(log.outcome.startswith("failed") for log in run.logs),
                *_median(run, figure),
                against.get((number, "previous")),
                against.get((number, "first")),
                corrected.get((number, "previous"), math.nan),
                corrected.get((number, "first"), math.nan),
                differences[number],
                tuple(worse),
            )
        )
    return Trend(figure, tuple(rows))


def _median(run: OpenedRun, figure: Figure) -> tuple[int, float, str]:
    """Return how many drives of a run have the figure, its median over them, and its unit."""
    rows = independent_figures(run, figure.signal, figure.metric, figure.segment)
    wanted = rows["main"] if figure.estimator == MAIN else figure.estimator
    values = rows.filter(rows["estimator"] == wanted)
    unit = str(values["unit"][0]) if len(values) else ""
    return len(values), float(np.median(values["value"].to_numpy())) if len(values) else math.nan, unit


def shown_median(row: TrendRow) -> str:
    """Return the median in the unit that people read, a dash for none."""
    unit, factor = read_unit(row.unit)
    return f"{row.median * factor:.3g} {unit}".strip() if math.isfinite(row.median) else "-"


def mark(row: TrendRow) -> str:
    """Return the words for a regression, empty for none."""
    return f"regression against the {' and the '.join(row.regression)} run" if row.regression else ""
