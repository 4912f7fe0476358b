"""The page of one drive."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pdhef_logtool.evaluation.requirement_verdicts import next_steps
from pdhef_logtool.evaluation.units import AY_NOTE
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.reports.charts import Charts
from pdhef_logtool.reports.drive_figures import Roles, drive_figures
from pdhef_logtool.reports.drive_tables import by_segment, definitions, disagreements, scores, whole_figures
from pdhef_logtool.reports.page import render
from pdhef_logtool.results.fleet import cause_and_remedy
from pdhef_logtool.results.opened_run import ESTIMATES_FILE, OpenedLog
from pdhef_logtool.results.selected_estimate import NAIVE
from pdhef_logtool.results.sink import TRUTH

#: The best filter with physics only; the errors of the baseline would hide all others in a figure.
_PHYSICS = "physics"
#: Keys of the figures, in the order of the page.
OVER_TIME = ("sideslip", "error", "steer", "yaw_rate", "ay", "speed", "strip")
IN_PLANE = ("path", "ay_sideslip")
#: Maximum number of rows of tables that grow with the length of the log.
_MOST_ROWS = 200


@dataclass(frozen=True, slots=True, eq=False)
class DrivePage:
    """The page of a drive: the HTML, its figures, the error of a file that could not be read, the key figures."""

    html: bytes
    charts: Charts
    wrong: str = ""
    key_figures: dict[str, Any] | None = None


def drive_page(log: OpenedLog, back: str = "") -> DrivePage:
    """Return the page of a log of a run; for a failed log, a page with the reason.

    ``back``: address of the page of the whole run, empty without one. Raises OutputError for a damaged report.json.
    """
    report = log.report()
    if report is None or not isinstance(report.get("log"), dict):
        cause, remedy = cause_and_remedy(log.outcome.removeprefix("failed: "))
        return DrivePage(render("failed.html", label=log.label, cause=cause, remedy=remedy, back=back), Charts())
    figures, path, wrong = None, None, ""
    roles = roles_of(report)
    if roles is not None:
        try:
            path = log.file(ESTIMATES_FILE)
            figures = None if path is None else drive_figures(path, report, roles)
        except OutputError as error:
            wrong = f"the figures cannot be drawn: {error}"
    charts = Charts() if figures is None else figures.charts
    texts, names = (report.get("answer") or {}).get("texts") or {}, () if roles is None else roles.names
    key_figures = whole_figures(report, (TRUTH, *names), manoeuvres=True)
    html = render(
        "drive.html",
        charts,
        label=log.label,
        back=back,
        report=report,
        roles=roles,
        outcome=log.outcome,
        steps=next_steps(report.get("plan"), texts.get("next", "").split("; ")),
        identical=[] if roles is None else identical_to(report, roles.main),
        drawn=figures,
        path=path,
        wrong=wrong,
        scores=[] if roles is None else scores(report, roles),
        segments=[] if roles is None else by_segment(report, roles),
        consistency=whole_figures(report, names, manoeuvres=False),
        key_figures=key_figures,
        apart={} if roles is None else disagreements(report, roles),
        definitions=definitions(report),
        checks=sorted(report.get("checks") or (), key=lambda c: ("failed", "undecided", "passed").index(c["verdict"])),
        losses=(report.get("losses") or ())[:_MOST_ROWS],
        samples=report["ledger"]["samples"][:_MOST_ROWS],
        ay_note=AY_NOTE,
        over_time=OVER_TIME,
        in_plane=IN_PLANE,
    )
    return DrivePage(html, charts, wrong, key_figures)


def roles_of(report: Mapping[str, Any]) -> Roles | None:
    """Return the names to draw: the selected estimate, physics (else the first other filter), others."""
    names: list[str] = [e["name"] for e in report["estimators"] if e["outcome"] == "ran"]
    if not names:
        return None
    selected = report.get("selected_estimate")
    main: str = selected if selected in names else names[0]
    identical = identical_to(report, main)
    others = [n for n in names if n not in identical]
    rival = next((n for n in (_PHYSICS, *sorted(others, key=lambda n: n == NAIVE)) if n in others and n != main), "")
    return Roles(main, rival, tuple(n for n in names if n not in (main, rival)))


def identical_to(report: Mapping[str, Any], main: str) -> list[str]:
    """Return the estimators with bit-identical errors to ``main``: the same filter with another name."""
    figures: dict[str, dict[tuple[str, str], Any]] = {}
    for m in report["metrics"]:
        if m["segment"] == "all" and m["metric"] in ("rmse", "max_abs", "nis") and m["value"] is not None:
            figures.setdefault(m["estimator"], {})[m["signal"], m["metric"]] = m["value"]
    errors = figures.get(main, {})
    same = [n for n, f in figures.items() if n != main and "~" not in n and len(f) > 1 and f == errors]
    apart = [m["estimator"] for m in report["metrics"] if m["metric"] == "disagreement_rms" and m["value"] == 0.0]
    pairs = [n for pair in apart if main in (names := pair.split("~")) for n in names if n != main]
    return [*dict.fromkeys([*same, *pairs])]
