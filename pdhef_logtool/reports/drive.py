"""The page of one drive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.reports.charts import Charts
from pdhef_logtool.reports.drive_figures import DriveFigures, Roles, drive_figures
from pdhef_logtool.reports.page import render
from pdhef_logtool.results.opened_run import ESTIMATES_FILE, OpenedLog
from pdhef_logtool.sinks.report import reasons_line

#: What reports of earlier versions do not say: the default of a vehicle file.
_LOW_SPEED_M_S = 3.0
#: Of a shorter drive nothing can be said with any certainty.
_SHORT_S = 10.0
#: The figures of a page, in the order in which they stand.
OVER_TIME = ("sideslip", "error", "trust", "r_scale", "nis", "speed", "ay", "strip")
IN_PLANE = ("path", "ay_sideslip", "phase")
FIGURES = (*OVER_TIME, *IN_PLANE)
#: Rows of tables that a log can make as long as it likes.
_MOST_ROWS = 200
_CLASSES = {"better": "good", "same": "", "worse": "bad"}
_SIGNALS = {
    "sideslip_rad": "sideslip",
    "vy_m_s": "v_y",
    "yaw_rate_rad_s": "yaw rate",
    "vx_m_s": "v_x",
    "ay_m_s2": "a_y",
}
#: Figures of a signal over the whole drive, as columns: metric, head.
_SCORES = (("rmse", "RMSE"), ("mae", "mean"), ("p95_abs", "95 %"), ("max_abs", "largest"), ("bias", "bias"))


@dataclass(frozen=True, slots=True)
class Verdict:
    """A sentence on one signal; ``kind``: class of the style."""

    signal: str
    text: str
    kind: str


@dataclass(frozen=True, slots=True, eq=False)
class DrivePage:
    """The page of a drive: the HTML, and the figures in it."""

    html: bytes
    charts: Charts


def drive_page(log: OpenedLog, back: str = "") -> DrivePage:
    """Return the page of a log of a run; one that failed has a page that says why.

    ``back``: address of the page of the whole run, empty without one. Raises OutputError for a damaged report.json.
    """
    report = log.report()
    if report is None or not isinstance(report.get("log"), dict):
        return DrivePage(render("failed.html", label=log.label, outcome=log.outcome, back=back), Charts())
    figures, why_none = None, ""
    roles = roles_of(report)
    low_speed = report["vehicle"].get("low_speed_blend_m_s")
    if roles is None:
        why_none = "Nothing was estimated, so that there is nothing to draw."
    elif (path := log.file(ESTIMATES_FILE)) is None:
        why_none = f"{ESTIMATES_FILE} is not in the folder of this log; the figures of below are those of report.json."
    else:
        try:
            figures = drive_figures(path, report, roles, _LOW_SPEED_M_S if low_speed is None else low_speed)
        except OutputError as error:
            why_none = f"The figures cannot be drawn: {error}"
        if figures is None and not why_none:
            why_none = f"{ESTIMATES_FILE} has no row of {roles.main}."
    charts = Charts() if figures is None else figures.charts
    html = render(
        "drive.html",
        charts,
        label=log.label,
        outcome=log.outcome,
        back=back,
        report=report,
        roles=roles,
        verdicts=verdicts_of(report),
        drawn=figures,
        why_none=why_none,
        notices=_notices(report, figures, low_speed),
        scores=_scores(report, roles),
        segments=_by_segment(report, roles),
        without_truth=_without_truth(report, roles),
        estimators=_estimators(report),
        checks=sorted(report.get("checks") or (), key=lambda c: ("failed", "undecided", "passed").index(c["verdict"])),
        losses=(report.get("losses") or ())[:_MOST_ROWS],
        samples=[s for s in report["ledger"]["samples"] if s["dropped"]][:_MOST_ROWS],
        budget=report.get("error_budget"),
        faults=report.get("faults"),
        innovations=report.get("innovations") or (),
        metadata=report.get("metadata") or {},
        over_time=OVER_TIME,
        in_plane=IN_PLANE,
    )
    return DrivePage(html, charts)


def roles_of(report: Mapping[str, Any]) -> Roles | None:
    """Return who is drawn how: the answer and the best physics, as the verdict on sideslip has them."""
    ran = [e for e in report["estimators"] if e["outcome"] == "ran"]
    names: list[str] = [e["name"] for e in ran]
    if not names:
        return None
    answer = report.get("answer") or {}
    main: str = answer["main"] if answer.get("main") in names else names[0]
    told = next((str(v.get("rival")) for v in _told(report) if v.get("signal") == "sideslip_rad"), "")
    rival = told if told in names else _best_physics(report, ran, main)
    return Roles(main, rival, tuple(n for n in names if n not in (main, rival)))


def _best_physics(report: Mapping[str, Any], ran: Sequence[Mapping[str, Any]], main: str) -> str:
    """Return the estimator on physics alone with the least error, else the first; the first of any where none is."""
    errors = {m["estimator"]: m["value"] for m in report["metrics"] if _is_whole(m, "sideslip_rad", "rmse")}
    others = [e for e in ran if e["name"] != main]
    causal = next(e["causal"] for e in ran if e["name"] == main)
    physics: list[str] = [e["name"] for e in others if _on_physics(e) and (e["causal"] or not causal)]
    known = [n for n in physics if errors.get(n) is not None]
    if known:
        return min(known, key=lambda n: float(errors[n]))
    fallback: list[str] = [*physics, *(e["name"] for e in others), ""]
    return fallback[0]


def _on_physics(estimator: Mapping[str, Any]) -> bool:
    algorithm = estimator.get("algorithm") or {}
    return algorithm.get("physics_sha256") is not None and algorithm.get("network_sha256") is None


def _is_whole(row: Mapping[str, Any], signal: str, metric: str) -> bool:
    return (row["signal"], row["segment"], row["metric"]) == (signal, "all", metric)


def _told(report: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    return [v for v in report.get("verdicts") or () if isinstance(v, Mapping)]


def verdicts_of(report: Mapping[str, Any]) -> list[Verdict]:
    """Return the sentences at the head of a page; those of an older report are the words of its answer."""
    told = [
        Verdict(_SIGNALS.get(v.get("signal", ""), str(v.get("signal", ""))), str(v.get("text", "")),
                _CLASSES.get(str(v.get("outcome")), ""))
        for v in _told(report)
    ]  # fmt: skip
    answer = report.get("answer")
    if told or answer is None:
        return told
    return [Verdict("sideslip", str(answer["texts"]["result"]), "")]


def _notices(report: Mapping[str, Any], figures: DriveFigures | None, low_speed: float | None) -> list[str]:
    """Return what a reader must know before looking at the figures."""
    said = []
    duration = report["log"]["duration_s"]
    if duration < _SHORT_S:
        said.append(f"The log is only {duration:.1f} s long: too short to judge an estimator by.")
    if figures is not None and not figures.moves:
        said.append(
            "The car is never fast enough for a sideslip: below the low-speed blend of the car "
            f"({_LOW_SPEED_M_S if low_speed is None else low_speed:g} m/s) it has no direction. None is drawn."
        )
    if not report["truth"]["available"]:
        said.append(
            "The log has no truth: no error is known, and no estimate can be called good or bad. Shown instead: "
            "how far the estimates disagree, and how much sensors surprise the filters."
        )
    elif figures is not None and not figures.scored and figures.moves:
        said.append(
            "The truth of this log does not score sideslip: disagreement of the estimates is shown in place of errors."
        )
    if figures is not None and figures.absent:
        said.append(f"Not in estimates.parquet, so not drawn: {', '.join(figures.absent)}.")
    if low_speed is None:
        said.append(
            f"This report is of an earlier version: sideslip is left out below {_LOW_SPEED_M_S:g} m/s, "
            "the default of cars."
        )
    return said


def _scores(report: Mapping[str, Any], roles: Roles | None) -> list[dict[str, Any]]:
    """Return a table a signal: rows of estimators, the answer first, with factor and unit for people."""
    tables = []
    order = () if roles is None else (roles.main, roles.rival, *roles.others)
    causal = {e["name"]: e["causal"] for e in report["estimators"]}
    for signal, name in _SIGNALS.items():
        by_name: dict[str, dict[str, Any]] = {}
        for m in report["metrics"]:
            if m["signal"] == signal and m["segment"] == "all" and m["estimator"] in causal:
                by_name.setdefault(m["estimator"], {})[m["metric"]] = m
        rows = [(n, by_name[n]) for n in order if "rmse" in by_name.get(n, {})]
        if not rows:
            continue
        unit = rows[0][1]["rmse"]["unit"]
        factor, shown = {"rad": (57.29577951308232, "°"), "rad/s": (57.29577951308232, "°/s")}.get(unit, (1.0, unit))
        tables.append({
            "name": name, "unit": shown, "heads": [h for _, h in _SCORES],
            "independent": signal not in report["truth"]["not_independent"],
            "rows": [
                {
                    "name": n, "causal": causal[n], "n": own["rmse"]["n"],
                    "values": [_scaled(own, metric, factor) for metric, _ in _SCORES],
                    "coverage": _scaled(own, "coverage95", 1.0), "availability": _scaled(own, "availability", 1.0),
                }
                for n, own in rows
            ],
        })  # fmt: skip
    return tables


def _scaled(figures: Mapping[str, Mapping[str, Any]], metric: str, factor: float) -> float | None:
    value = figures.get(metric, {}).get("value")
    return None if value is None else float(value) * factor


def _by_segment(report: Mapping[str, Any], roles: Roles | None) -> list[dict[str, Any]]:
    """Return the RMSE of sideslip by segment, of the answer and the best physics."""
    if roles is None:
        return []
    found: dict[str, dict[str, Any]] = {}
    for m in report["metrics"]:
        if (m["signal"], m["metric"]) == ("sideslip_rad", "rmse") and m["estimator"] in (roles.main, roles.rival):
            found.setdefault(m["segment"], {})[m["estimator"]] = m
    return [
        {
            "segment": segment,
            "n": next(iter(own.values()))["n"],
            "main": own.get(roles.main, {}).get("value"),
            "rival": own.get(roles.rival, {}).get("value"),
        }
        for segment, own in sorted(found.items(), key=lambda item: (item[0] != "all", item[0]))
    ]


def _without_truth(report: Mapping[str, Any], roles: Roles | None) -> list[tuple[str, list[tuple[str, str, Any, str]]]]:
    """Return what can be said without truth, by kind: (who, of what, value, unit)."""
    kinds = (
        ("NIS over degrees of freedom (1 as expected)", "nis"),
        ("Whiteness: autocorrelation of NIS from stamp to stamp (0 when white)", "nis_autocorrelation"),
        ("d2: lateral velocity against the sensors over 2 s", "d2"),
        ("Residuals of the sensors, RMS", "residual_rms"),
        ("Residuals of the sensors, bias", "residual_bias"),
        ("Disagreement of two estimates' sideslip, RMS", "disagreement_rms"),
    )
    whole = [m for m in report["metrics"] if m["segment"] == "all"]
    dof = {m["estimator"]: m["value"] for m in whole if m["metric"] == "nis_dof"}
    tables = []
    for title, metric in kinds:
        rows = []
        for m in whole:
            if m["metric"] != metric or m["value"] is None:
                continue
            value, unit = float(m["value"]), m["unit"]
            if metric == "nis":
                value, unit = value / (dof.get(m["estimator"]) or float("nan")), ""
            elif unit == "rad":
                value, unit = value * 57.29577951308232, "°"
            rows.append(
                (
                    m["estimator"].replace("~", " and "),
                    _SIGNALS.get(m["signal"], ""),
                    value,
                    "" if unit == "1" else unit,
                )
            )
        if rows:
            tables.append((title, rows))
    del roles
    return tables


def _estimators(report: Mapping[str, Any]) -> list[dict[str, Any]]:
    start = report["log"]["start_ns"]
    return [
        {
            **e,
            "told": "; ".join(
                filter(None, [e["reason"], *e["notes"], *e.get("intervals", ()), reasons_line(e, start)])
            ),
        }
        for e in report["estimators"]
    ]
