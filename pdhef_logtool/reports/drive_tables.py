"""Tables of one drive, from its report.json: figures over the whole drive, in display units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

from pdhef_logtool.evaluation.metrics.handling import responses
from pdhef_logtool.evaluation.metrics.metric import Metric
from pdhef_logtool.evaluation.metrics.registry import registered
from pdhef_logtool.evaluation.units import LABELS, SCORED_SIGNALS, SIGNALS, read_unit
from pdhef_logtool.reports.drive_figures import Roles

_Table = dict[str, Any]
_BySignal: TypeAlias = dict[str, dict[str, dict[str, Mapping[str, Any]]]]


def scores(report: Mapping[str, Any], roles: Roles) -> list[_Table]:
    """Return the errors over the whole drive, one table per signal, the selected estimate first."""
    causal, by_signal = {e["name"]: bool(e["causal"]) for e in report["estimators"]}, _by_signal(report)
    tables = []
    for signal in [s for s in LABELS if s in SCORED_SIGNALS]:
        figures = by_signal.get(signal, {})
        order = [n for n in roles.names if "rmse" in figures.get(n, {})]
        shown = [m for m in registered().values() if m.of_truth and any(m.name in figures[n] for n in order)]
        rows = [
            {"name": n, "causal": causal[n], "values": [_read(figures[n], m.name) for m in shown]}
            | {"n": figures[n]["rmse"]["n"]}
            for n in order
        ]
        table: dict[str, Any] = {"name": LABELS[signal], "heads": [m.head() for m in shown], "rows": rows}
        table["independent"] = signal not in report["truth"]["not_independent"]
        tables += [table | {"unit": read_unit(figures[order[0]]["rmse"]["unit"])[0]}] if order else []
    return tables


def definitions(report: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Return label, name and definition of each metric of a report."""
    names = {m["metric"] for m in report["metrics"]}
    return [(m.label, m.name, m.definition.replace("`", "")) for m in registered().values() if m.name in names]


def by_segment(report: Mapping[str, Any], roles: Roles) -> list[_Table]:
    """Return the RMSE of sideslip in rad by segment (``main``, ``rival``, None if unknown), the whole drive first."""
    tables: dict[str, _Table] = {}
    for m in report["metrics"]:
        if (m["signal"], m["metric"]) == ("sideslip_rad", "rmse") and m["estimator"] in (roles.main, roles.rival):
            row = tables.setdefault(m["segment"], {"segment": m["segment"], "main": None, "rival": None, "n": m["n"]})
            row["main" if m["estimator"] == roles.main else "rival"] = m["value"]
    return sorted(tables.values(), key=lambda row: (row["segment"] != "all", row["segment"]))


def whole_figures(report: Mapping[str, Any], names: Sequence[str], *, manoeuvres: bool) -> _Table | None:
    """Return metrics that need no ground truth, of manoeuvres or the others, NIS per degree of freedom.

    A table has heads, and rows of a name and its values; None without any value.
    """
    by_signal = _by_signal(report)

    def value(name: str, signal: str, metric: Metric) -> float | None:
        rows = by_signal.get(signal, {}).get(name, {})
        figure, over = _read(rows, metric.name), _read(rows, "nis_dof") if metric.name == "nis" else 1.0
        return figure / over if figure is not None and over else None

    wanted = [m for m in registered().values() if (m.columns is responses) == manoeuvres]
    wanted = [m for m in wanted if not m.of_truth and m.name != "nis_dof"]
    columns = {(signal, m): [value(name, signal, m) for name in names] for m in wanted for signal in SIGNALS}
    shown = {key: values for key, values in columns.items() if any(v is not None for v in values)}
    heads = [f"{LABELS[s]}: {m.head(s)}" if len(m.brief) > 1 else m.head(s) for s, m in shown]
    rows = [
        (name, values)
        for name, *values in zip(names, *shown.values(), strict=True)
        if any(v is not None for v in values)
    ]
    return {"heads": heads, "rows": rows} if rows else None


def disagreements(report: Mapping[str, Any], roles: Roles) -> dict[str, float]:
    """Return the RMS sideslip difference in rad between each other estimator and the selected estimate."""
    values = {}
    for m in report["metrics"]:
        first, _, second = m["estimator"].partition("~")
        if (m["metric"], m["segment"]) == ("disagreement_rms", "all") and roles.main in (first, second):
            values[second if first == roles.main else first] = m["value"]
    return {name: float(value) for name, value in values.items() if value is not None}


def _by_signal(report: Mapping[str, Any]) -> _BySignal:
    """Return the rows of the whole drive by signal, estimator and metric."""
    rows: _BySignal = {}
    for m in report["metrics"]:
        if m["segment"] == "all":
            rows.setdefault(m["signal"], {}).setdefault(m["estimator"], {})[m["metric"]] = m
    return rows


def _read(rows: Mapping[str, Mapping[str, Any]], key: str) -> float | None:
    """Return a figure in display units."""
    row = rows.get(key)
    return None if row is None or row["value"] is None else float(row["value"]) * read_unit(row["unit"])[1]
