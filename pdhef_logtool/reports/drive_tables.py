"""Tables of one drive, from its report.json: figures over the whole drive, in display units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pdhef_logtool.evaluation.metrics.independence import NOT_INDEPENDENT
from pdhef_logtool.evaluation.metrics.registry import registered
from pdhef_logtool.evaluation.units import LABELS, SCORED_SIGNALS, SIGNALS, read_unit
from pdhef_logtool.reports.drive_figures import Roles

_Row = Mapping[str, Any]
#: NIS and its degrees of freedom, which tables show as a ratio.
_RATIO = ("nis", "nis_dof")


@dataclass(frozen=True, slots=True)
class Score:
    """The figures of one estimator: ``values`` by column in display units, and the number of stamps."""

    name: str
    causal: bool
    values: Sequence[float | None]
    n: int


@dataclass(frozen=True, slots=True)
class ScoreTable:
    """The figures of one signal in ``unit``; ``independent``: whether its ground truth is an independent check."""

    name: str
    unit: str
    independent: bool
    heads: Sequence[str]
    rows: Sequence[Score]


@dataclass(frozen=True, slots=True)
class SegmentScore:
    """RMSE of sideslip in one segment in rad, None if unknown."""

    segment: str
    main: float | None
    rival: float | None
    n: int


@dataclass(frozen=True, slots=True)
class Consistency:
    """Figures of whole estimators: ``rows`` of a name and its values, in display units."""

    heads: Sequence[str]
    rows: Sequence[tuple[str, Sequence[float | None]]]


@dataclass(frozen=True, slots=True)
class Residual:
    """Residual between redundant sensors, in ``unit``."""

    signal: str
    rms: float | None
    bias: float | None
    unit: str


def scores(report: Mapping[str, Any], roles: Roles) -> list[ScoreTable]:
    """Return the errors over the whole drive, one table per signal, the selected estimate first."""
    causal = {e["name"]: bool(e["causal"]) for e in report["estimators"]}
    tables = []
    for signal in SCORED_SIGNALS:
        figures = _by_estimator(report, signal)
        order = [n for n in (roles.main, roles.rival, *roles.others) if "rmse" in figures.get(n, {})]
        if not order:
            continue
        shown = [
            m
            for m in registered().values()
            if m.of_truth and m.name != NOT_INDEPENDENT and any(m.name in figures[n] for n in order)
        ]
        rows = [Score(n, causal[n], [_read(figures[n], m.name) for m in shown], figures[n]["rmse"]["n"]) for n in order]
        unit = read_unit(figures[order[0]]["rmse"]["unit"])[0]
        independent = signal not in report["truth"]["not_independent"]
        tables.append(ScoreTable(LABELS[signal], unit, independent, [m.head() for m in shown], rows))
    return sorted(tables, key=lambda t: [*LABELS.values()].index(t.name))


def definitions(report: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Return label, name and definition of each metric of a report."""
    names = {m["metric"] for m in report["metrics"]}
    return [(m.label, m.name, m.definition.replace("`", "")) for m in registered().values() if m.name in names]


def by_segment(report: Mapping[str, Any], roles: Roles) -> list[SegmentScore]:
    """Return the RMSE of sideslip by segment, the whole drive first."""
    by_segment_name: dict[str, dict[str, _Row]] = {}
    for m in report["metrics"]:
        if (m["signal"], m["metric"]) == ("sideslip_rad", "rmse") and m["estimator"] in (roles.main, roles.rival):
            by_segment_name.setdefault(m["segment"], {})[m["estimator"]] = m
    return [
        SegmentScore(segment, _value(rows, roles.main), _value(rows, roles.rival), next(iter(rows.values()))["n"])
        for segment, rows in sorted(by_segment_name.items(), key=lambda item: (item[0] != "all", item[0]))
    ]


def consistency(report: Mapping[str, Any], roles: Roles | None) -> Consistency | None:
    """Return the figures of whole estimators; None without any."""
    names = () if roles is None else (roles.main, roles.rival, *roles.others)
    by_signal = {signal: _by_estimator(report, signal) for signal in SIGNALS}
    shown = [
        (signal, m)
        for m in registered().values()
        for signal, by_name in by_signal.items()
        if not m.of_truth and m.name not in _RATIO
        if any(_read(by_name.get(name, {}), m.name) is not None for name in names)
    ]
    rows = []
    for name in names:
        nis, dof = (_read(by_signal["state"].get(name, {}), metric) for metric in _RATIO)
        ratio = nis / dof if nis is not None and dof else None
        values = [ratio, *(_read(by_signal[signal].get(name, {}), m.name) for signal, m in shown)]
        if any(value is not None for value in values):
            rows.append((name, values))
    heads = ["NIS per degree of freedom", *(m.head(signal) for signal, m in shown)]
    return Consistency(heads, rows) if rows else None


def residuals(report: Mapping[str, Any]) -> list[Residual]:
    """Return the residuals of the sensors."""
    residual_metrics = [(s, _by_estimator(report, s).get("sensors", {})) for s in LABELS]
    return [
        Residual(LABELS[s], _value(row, "residual_rms"), _value(row, "residual_bias"), row["residual_rms"]["unit"])
        for s, row in residual_metrics
        if "residual_rms" in row
    ]


def disagreements(report: Mapping[str, Any], roles: Roles) -> dict[str, float]:
    """Return the RMS sideslip difference in rad between each other estimator and the selected estimate."""
    values = {}
    for m in report["metrics"]:
        first, _, second = m["estimator"].partition("~")
        if (m["metric"], m["segment"]) == ("disagreement_rms", "all") and roles.main in (first, second):
            values[second if first == roles.main else first] = m["value"]
    return {name: float(value) for name, value in values.items() if value is not None}


def _by_estimator(report: Mapping[str, Any], signal: str) -> dict[str, dict[str, _Row]]:
    """Return the rows of a signal over the whole drive by estimator and metric."""
    metrics: dict[str, dict[str, _Row]] = {}
    for m in report["metrics"]:
        if (m["signal"], m["segment"]) == (signal, "all"):
            metrics.setdefault(m["estimator"], {})[m["metric"]] = m
    return metrics


def _value(rows: Mapping[str, _Row], key: str) -> float | None:
    value = rows[key]["value"] if key in rows else None
    return None if value is None else float(value)


def _read(rows: Mapping[str, _Row], key: str) -> float | None:
    """Return a figure in display units."""
    value = _value(rows, key)
    return None if value is None else value * read_unit(rows[key]["unit"])[1]
