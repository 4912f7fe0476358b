"""The page of a whole run: errors over drives, ranking, effects of conditions, operating range, failures."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pdhef_logtool.evaluation.operating_space import AY_EDGES_M_S2, SPEED_EDGES_M_S
from pdhef_logtool.evaluation.requirement_verdicts import next_steps
from pdhef_logtool.evaluation.units import LABELS, read_unit
from pdhef_logtool.records.geometry import DEGREES
from pdhef_logtool.records.signals import LEAST_DIVISOR, FloatArray
from pdhef_logtool.reports.charts import INK, BarsFigure, Charts, Interval, IntervalsFigure, against, colour
from pdhef_logtool.reports.page import duration, render
from pdhef_logtool.reports.pages import Page
from pdhef_logtool.results.fleet import ANSWER, JUDGED, LEAST_DRIVES, Distribution, Fleet, Space, read_fleet
from pdhef_logtool.results.opened_run import PAGE_FILE, OpenedRun
from pdhef_logtool.storage.documents import jsonable

#: Maximum numbers of table rows, of requested keys, and of bars of a histogram.
MOST_ROWS, _MOST_KEYS, _MOST_BARS = 1000, 12, 40
#: Quantile of the drives' errors that ends the histogram; larger errors are counted in the last bar.
_MOST_SHARE = 0.98
_LEVELS = 8
#: Maximum number of drives in the figure of the first screen.
_WORST = 10
#: Maximum ratio of a median error to the selected estimate's in the figures; tables contain all estimators.
_DRAWN = 5.0
#: Minimum range of the table of the operating space, so that driving without data is visible.
_SPEED_M_S, _AY_M_S2 = 40.0, 8.0


def fleet_page(run: OpenedRun, by: Sequence[str] = ()) -> Page:
    """Return the page of a run.

    Parameters
    ----------
    by : keys to break the drives down by; by default all that distinguish drives.

    Raises
    ------
    OutputError
        metrics.parquet is damaged.
    """
    fleet = read_fleet(run, by)
    pages = {log.label for log in run.logs if log.file(PAGE_FILE) is not None}
    mains = {d.main for d in fleet.scored}
    shown = [b for b in fleet.breakdowns if by or any(g.effect for g in b.groups)][: None if by else _MOST_KEYS]
    charts = Charts()
    _add_figures(charts, fleet)
    texts: dict[str, Any] = {
        "plan": run.document.get("plan"),
        "seconds": sum(d.seconds for d in fleet.drives),
        "steps": next_steps(run.document.get("plan"), ["repair the failed logs: causes below"] if fleet.failed else ()),
        "worst": _worst(fleet, charts),
        "answer": next((d for d in fleet.distributions if (d.estimator, d.signal) == (ANSWER, JUDGED)), None),
        "rows": _rows(_told(fleet)),
        "mains": {ANSWER} if len(mains) > 1 else mains,
        "names": list(dict.fromkeys(d.estimator for d in fleet.distributions if d.estimator != ANSWER)),
        "ranked": any(r.place is not None for r in fleet.ranking),
        "dependence": fleet.dependence.text(len(fleet.scored)),
        "breakdowns": shown,
        "comparisons": sum(b.comparisons for b in fleet.breakdowns),
        "idle_keys": [b.key for b in fleet.breakdowns if b not in shown],
        "space": None if fleet.space is None else _space_rows(fleet.space),
        "held": sorted(fleet.drives, key=lambda d: d.label)[:MOST_ROWS],
        "most_rows": MOST_ROWS,
        "least": LEAST_DRIVES,
    }
    html = render("fleet.html", charts, fleet=fleet, pages=pages, run=run.document, **texts)
    return Page(html, charts, document=_document(fleet, texts))


def _document(fleet: Fleet, texts: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of the page as JSON-able values."""
    more = {"worst_drives": fleet.worst, "without_truth": fleet.without_truth[:MOST_ROWS]}
    kept = ("logs", "ranking", "least_to_rank", "dependence", "breakdowns", "failed", "losses")
    whole = {key: getattr(fleet, key) for key in kept} | {"scored": len(fleet.scored)}
    return {"format": "pdhef.fleet", "version": 1, **jsonable({**texts, **more, **whole})}


def _worst(fleet: Fleet, charts: Charts) -> tuple[str, float | None] | None:
    """Return the drive with the largest sideslip error; add the figure of the largest errors."""
    ranked = sorted(fleet.scored, key=lambda d: -d.error())
    if not ranked:
        return (fleet.drives[0].label, None) if fleet.logs == 1 and fleet.drives else None
    if len(ranked) > 1:
        bars = [Interval(d.label, math.nan, d.error() * DEGREES, math.nan, colour(d.main)) for d in ranked[:_WORST]]
        title = f"The {len(bars)} drives with the largest sideslip RMSE"
        charts.figures["worst"] = IntervalsFigure(title, "RMSE in °", bars, zero=0.0)
    return ranked[0].label, ranked[0].error()


def _add_figures(charts: Charts, fleet: Fleet) -> None:
    judged = [d for d in _told(fleet) if d.signal == JUDGED]
    if not judged or len(fleet.drives) == 1:
        return
    first = judged[0]
    bars = []
    for d in (d for d in judged if d.median.value <= _DRAWN * first.median.value):
        low, middle, high = (DEGREES * x for x in (d.median.low, d.median.value, d.median.high))
        bars.append(Interval(d.estimator, low, middle, high, INK if d.estimator == ANSWER else colour(d.estimator)))
    title = f"Median RMSE of sideslip over {first.median.units} drives, 95 % interval"
    title += "" if len(bars) == len(judged) else f" (beyond {_DRAWN:g} times the selected estimate's: table)"
    charts.figures["medians"] = IntervalsFigure(title, "RMSE in °", bars)
    if first.median.units > 2:
        values = first.values * DEGREES
        edges, counts = _histogram(values)
        beyond = " (last bar: and above)" if values[-1] > edges[-1] else ""
        title = f"Drives by RMSE of the selected estimate's sideslip{beyond}"
        charts.figures["spread"] = BarsFigure(title, "RMSE in °", edges.tolist(), counts.tolist())
    rival, drives = _rival(fleet), fleet.scored
    if rival is not None:
        ours, other = (np.array([d.error(name) * DEGREES for d in drives]) for name in (ANSWER, rival))
        both = np.isfinite(ours) & np.isfinite(other) & (ours > 0.0) & (other > 0.0)
        if np.count_nonzero(both) > 2:
            title = f"One point per drive; below the line the selected estimate has the lower error, above it {rival}"
            labels = f"RMSE of {rival}, °", "RMSE of the selected estimate, °"
            charts.figures["against"] = against(title, *labels, other[both], ours[both], INK)


def _rival(fleet: Fleet) -> str | None:
    """Return the estimator to compare with the selected one: physics if it ran, else the best of the others."""
    mains = {d.main for d in fleet.scored}
    judged = sorted((d for d in fleet.distributions if d.signal == JUDGED), key=lambda d: d.median.value)
    names = [d.estimator for d in judged if d.estimator != ANSWER and {d.estimator} != mains]
    return "physics" if "physics" in names else next(iter(names), None)


def _told(fleet: Fleet) -> list[Distribution]:
    """Return the distributions, first of the selected estimate; an estimator that is always selected appears once."""
    mains = {d.main for d in fleet.scored}
    if len(mains) > 1:
        return list(fleet.distributions)
    shown = [d for d in fleet.distributions if d.estimator != ANSWER]
    return sorted(shown, key=lambda d: d.estimator not in mains)


def _histogram(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return edges [B + 1] and counts [B]; values beyond the quantile are in the last bar."""
    most = max(float(np.quantile(values, _MOST_SHARE)), LEAST_DIVISOR)
    bars = int(np.clip(2.0 * math.sqrt(len(values)), 5, _MOST_BARS))
    edges = np.linspace(0.0, most, bars + 1)
    counts, _ = np.histogram(np.minimum(values, most), edges)
    return edges, counts.astype(np.float64)


def _rows(distributions: Sequence[Distribution]) -> list[dict[str, Any]]:
    """Return rows with the median and its bounds, 10th and 90th percentile, and the largest value."""
    rows = []
    for d in distributions:
        unit, factor = read_unit(d.unit)
        quantiles = d.median.value, d.median.low, d.median.high, *np.quantile(d.values, [0.1, 0.9, 1.0]).tolist()
        row = {"signal": LABELS[d.signal], "unit": unit, "estimator": d.estimator, "drives": d.median.units}
        rows.append(row | {"figures": [x * factor for x in quantiles]})
    return sorted(rows, key=lambda r: [*LABELS.values()].index(r["signal"]))


def _space_rows(space: Space) -> tuple[list[str], list[tuple[str, list[dict[str, Any]]]], int, int]:
    """Return heads, rows with the highest speed first, and the numbers of empty and of all cells."""
    rows = _reach(SPEED_EDGES_M_S, space.seconds.any(axis=1), _SPEED_M_S)
    columns = _reach(AY_EDGES_M_S2, space.seconds.any(axis=0), _AY_M_S2)
    seconds = space.seconds[:rows, :columns]
    most = float(seconds.max()) or 1.0
    made = []
    for i in reversed(range(rows)):
        cells = []
        for j in range(columns):
            spent, rmse = float(seconds[i, j]), float(space.rmse_rad[i, j])
            # Times differ by orders of magnitude: a level is a factor of three.
            level = max(0, _LEVELS + math.floor(math.log(spent / most, 3.0))) if spent else 0
            kind = f"h{min(level, _LEVELS)}" if spent else "empty"
            time = duration(spent) if spent else ""
            cells.append({"kind": kind, "minutes": time, "rmse_rad": rmse if math.isfinite(rmse) else None})
        made.append((_bin(SPEED_EDGES_M_S, i), cells))
    return ([_bin(AY_EDGES_M_S2, j) for j in range(columns)], made, int(np.count_nonzero(seconds == 0.0)), seconds.size)


def _reach(edges: Sequence[float], used: Any, least: float) -> int:
    last = int(np.flatnonzero(used)[-1]) + 1 if used.any() else 0
    return max(last, int(np.searchsorted(edges, least)))


def _bin(edges: Sequence[float], i: int) -> str:
    return f"{edges[i]:g}–{edges[i + 1]:g}" if i + 1 < len(edges) else f"above {edges[i]:g}"
