"""The tables of one drive, from its report.json: figures over the whole drive, angles in degrees."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pdhef_logtool.records.geometry import DEGREES
from pdhef_logtool.reports.drive_figures import Roles

SIGNALS = {"sideslip_rad": "sideslip", "vy_m_s": "v_y", "yaw_rate_rad_s": "yaw rate", "vx_m_s": "v_x", "ay_m_s2": "a_y"}
#: Figures of a signal as columns: metric and head.
_SCORES = (("rmse", "RMSE"), ("mae", "mean"), ("p95_abs", "95 %"), ("max_abs", "largest"), ("bias", "bias"))
HEADS = tuple(head for _, head in _SCORES)
_SHOWN = {"rad": (DEGREES, "°"), "rad/s": (DEGREES, "°/s")}

_Row = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Score:
    """The figures of one estimator: ``values`` in the order of :data:`HEADS`, shares, and how many stamps."""

    name: str
    causal: bool
    values: Sequence[float | None]
    coverage: float | None
    availability: float | None
    n: int


@dataclass(frozen=True, slots=True)
class ScoreTable:
    """The figures of one signal in ``unit``; ``independent``: whether its truth is a check at all."""

    name: str
    unit: str
    independent: bool
    rows: Sequence[Score]


@dataclass(frozen=True, slots=True)
class SegmentScore:
    """RMSE of sideslip in one segment in rad, None where it is not known."""

    segment: str
    main: float | None
    rival: float | None
    n: int


@dataclass(frozen=True, slots=True)
class Consistency:
    """What an estimator says of itself: NIS over its degrees of freedom, its autocorrelation, d2 in m/s."""

    name: str
    nis: float | None
    autocorrelation: float | None
    d2_m_s: float | None


@dataclass(frozen=True, slots=True)
class Residual:
    """What sensors say of each other, in ``unit``."""

    signal: str
    rms: float | None
    bias: float | None
    unit: str


def scores(report: Mapping[str, Any], roles: Roles) -> list[ScoreTable]:
    """Return the errors over the whole drive, a table a signal, the answer first."""
    causal = {e["name"]: bool(e["causal"]) for e in report["estimators"]}
    tables = []
    for signal, name in SIGNALS.items():
        found = _by_estimator(report, signal)
        order = [n for n in (roles.main, roles.rival, *roles.others) if "rmse" in found.get(n, {})]
        if not order:
            continue
        unit = found[order[0]]["rmse"]["unit"]
        factor, shown = _SHOWN.get(unit, (1.0, unit))
        rows = [
            Score(
                n,
                causal[n],
                [_value(found[n], metric, factor) for metric, _ in _SCORES],
                _value(found[n], "coverage95"),
                _value(found[n], "availability"),
                found[n]["rmse"]["n"],
            )
            for n in order
        ]
        tables.append(ScoreTable(name, shown, signal not in report["truth"]["not_independent"], rows))
    return tables


def by_segment(report: Mapping[str, Any], roles: Roles) -> list[SegmentScore]:
    """Return the RMSE of sideslip by segment, the whole drive first."""
    found: dict[str, dict[str, _Row]] = {}
    for m in report["metrics"]:
        if (m["signal"], m["metric"]) == ("sideslip_rad", "rmse") and m["estimator"] in (roles.main, roles.rival):
            found.setdefault(m["segment"], {})[m["estimator"]] = m
    return [
        SegmentScore(segment, _value(own, roles.main), _value(own, roles.rival), next(iter(own.values()))["n"])
        for segment, own in sorted(found.items(), key=lambda item: (item[0] != "all", item[0]))
    ]


def consistency(report: Mapping[str, Any], roles: Roles | None) -> list[Consistency]:
    """Return what needs no truth, of each estimator that has any of it."""
    state, lateral = _by_estimator(report, "state"), _by_estimator(report, "vy_m_s")
    rows = []
    for name in () if roles is None else (roles.main, roles.rival, *roles.others):
        own = state.get(name, {})
        nis, dof = _value(own, "nis"), _value(own, "nis_dof")
        row = Consistency(
            name,
            nis / dof if nis is not None and dof else None,
            _value(own, "nis_autocorrelation"),
            _value(lateral.get(name, {}), "d2"),
        )
        if (row.nis, row.autocorrelation, row.d2_m_s) != (None, None, None):
            rows.append(row)
    return rows


def residuals(report: Mapping[str, Any]) -> list[Residual]:
    """Return the residuals of the sensors."""
    found = [(s, _by_estimator(report, s).get("sensors", {})) for s in SIGNALS]
    return [
        Residual(SIGNALS[s], _value(own, "residual_rms"), _value(own, "residual_bias"), own["residual_rms"]["unit"])
        for s, own in found
        if "residual_rms" in own
    ]


def disagreements(report: Mapping[str, Any], roles: Roles) -> dict[str, float]:
    """Return by how many rad RMS the sideslip of each other estimator and that of the answer differ."""
    found = {}
    for m in report["metrics"]:
        first, _, second = m["estimator"].partition("~")
        if (m["metric"], m["segment"]) == ("disagreement_rms", "all") and roles.main in (first, second):
            found[second if first == roles.main else first] = m["value"]
    return {name: float(value) for name, value in found.items() if value is not None}


def _by_estimator(report: Mapping[str, Any], signal: str) -> dict[str, dict[str, _Row]]:
    """Return the rows of a signal over the whole drive by estimator and metric."""
    found: dict[str, dict[str, _Row]] = {}
    for m in report["metrics"]:
        if (m["signal"], m["segment"]) == (signal, "all"):
            found.setdefault(m["estimator"], {})[m["metric"]] = m
    return found


def _value(rows: Mapping[str, _Row], key: str, factor: float = 1.0) -> float | None:
    value = rows[key]["value"] if key in rows else None
    return None if value is None else float(value) * factor
