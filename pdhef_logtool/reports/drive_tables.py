"""Tables of one drive, from its report.json: figures over the whole drive, in display units."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pdhef_logtool.evaluation.metrics.independence import NOT_INDEPENDENT
from pdhef_logtool.evaluation.metrics.registry import registered
from pdhef_logtool.evaluation.units import LABELS, SCORED_SIGNALS, SIGNALS, read_unit
from pdhef_logtool.reports.drive_figures import Roles

_Table = dict[str, Any]
#: NIS and its degrees of freedom, which tables show as a ratio.
_RATIO = ("nis", "nis_dof")


def scores(report: Mapping[str, Any], roles: Roles) -> list[_Table]:
    """Return the errors over the whole drive, one table per signal, the selected estimate first."""
    causal, by_signal = {e["name"]: bool(e["causal"]) for e in report["estimators"]}, _by_signal(report)
    tables = []
    for signal in [s for s in LABELS if s in SCORED_SIGNALS]:
        figures = by_signal.get(signal, {})
        order = [n for n in roles.names if "rmse" in figures.get(n, {})]
        shown = [
            m
            for m in registered().values()
            if m.of_truth and m.name != NOT_INDEPENDENT and any(m.name in figures[n] for n in order)
        ]
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


def consistency(report: Mapping[str, Any], roles: Roles | None) -> _Table | None:
    """Return the figures of whole estimators: heads, and rows of a name and its values; None without any."""
    names, by_signal = () if roles is None else roles.names, _by_signal(report)
    shown = [
        (signal, m)
        for m in registered().values()
        for signal in SIGNALS
        if not m.of_truth and m.name not in _RATIO
        if any(_read(by_signal.get(signal, {}).get(name, {}), m.name) is not None for name in names)
    ]
    rows = []
    for name in names:
        nis, dof = (_read(by_signal.get("state", {}).get(name, {}), metric) for metric in _RATIO)
        ratio = nis / dof if nis is not None and dof else None
        values = [ratio, *(_read(by_signal[signal].get(name, {}), m.name) for signal, m in shown)]
        if any(value is not None for value in values):
            rows.append((name, values))
    heads = ["NIS per degree of freedom", *(m.head(signal) for signal, m in shown)]
    return {"heads": heads, "rows": rows} if rows else None


def disagreements(report: Mapping[str, Any], roles: Roles) -> dict[str, float]:
    """Return the RMS sideslip difference in rad between each other estimator and the selected estimate."""
    values = {}
    for m in report["metrics"]:
        first, _, second = m["estimator"].partition("~")
        if (m["metric"], m["segment"]) == ("disagreement_rms", "all") and roles.main in (first, second):
            values[second if first == roles.main else first] = m["value"]
    return {name: float(value) for name, value in values.items() if value is not None}


def _by_signal(report: Mapping[str, Any]) -> dict[str, dict[str, dict[str, Mapping[str, Any]]]]:
    """Return the rows of the whole drive by signal, estimator and metric."""
    rows: dict[str, dict[str, dict[str, Mapping[str, Any]]]] = {}
    for m in report["metrics"]:
        if m["segment"] == "all":
            rows.setdefault(m["signal"], {}).setdefault(m["estimator"], {})[m["metric"]] = m
    return rows


def _read(rows: Mapping[str, Mapping[str, Any]], key: str) -> float | None:
    """Return a figure in display units."""
    row = rows.get(key)
    return None if row is None or row["value"] is None else float(row["value"]) * read_unit(row["unit"])[1]
