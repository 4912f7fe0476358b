"""The page of one drive."""

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

from pdhef_logtool.evaluation.metrics.handling import responses
from pdhef_logtool.evaluation.metrics.metric import Metric, registered
from pdhef_logtool.evaluation.requirement_verdicts import next_steps
from pdhef_logtool.evaluation.units import AY_NOTE, LABELS, SCORED_SIGNALS, SIGNALS, read_unit
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.reports.charts import Charts
from pdhef_logtool.reports.drive_figures import Roles, drive_figures
from pdhef_logtool.reports.page import render
from pdhef_logtool.reports.pages import Page
from pdhef_logtool.results.opened_run import ESTIMATES_FILE, OpenedLog
from pdhef_logtool.results.selected_estimate import NAIVE, figures_of
from pdhef_logtool.results.sink import TRUTH

#: The best filter with physics only; the errors of the baseline would hide all others in a figure.
_PHYSICS = "physics"
#: Maximum number of rows of tables that grow with the length of the log.
_MOST_ROWS = 200


def drive_page(log: OpenedLog, back: str = "") -> Page:
    """Return the page of a log of a run; for a failed log, a page with the reason.

    ``back``: address of the page of the whole run, empty without one. Raises OutputError for a damaged report.json.
    """
    report = log.report()
    if report is None:
        reason = log.outcome.removeprefix("failed: ")
        return Page(render("failed.html", label=log.label, reason=reason, back=back), Charts())
    figures, path, wrong = None, None, ""
    roles = roles_of(report)
    try:
        path = log.file(ESTIMATES_FILE)
        figures = None if path is None else drive_figures(path, report, roles)
    except OutputError as error:
        wrong = f"the figures cannot be drawn: {error}"
    charts = Charts() if figures is None else figures["charts"]
    texts = (report.get("answer") or {}).get("texts") or {}
    key_figures = whole_figures(report, (TRUTH, *roles.names), manoeuvres=True)
    html = render(
        "drive.html",
        charts,
        label=log.label,
        back=back,
        report=report,
        roles=roles,
        outcome=log.outcome,
        steps=next_steps(report.get("plan"), texts.get("next", "").split("; ")),
        identical=identical_to_selected(report),
        drawn=figures,
        path=path,
        wrong=wrong,
        scores=scores(report, roles),
        segments=by_segment(report, roles),
        consistency=whole_figures(report, roles.names, manoeuvres=False),
        key_figures=key_figures,
        apart=disagreements(report),
        definitions=definitions(report),
        checks=sorted(report.get("checks") or (), key=lambda c: ("failed", "undecided", "passed").index(c["verdict"])),
        losses=(report.get("losses") or ())[:_MOST_ROWS],
        samples=report["ledger"]["samples"][:_MOST_ROWS],
        ay_note=AY_NOTE,
    )
    return Page(html, charts, wrong, key_figures=key_figures)


def roles_of(report: Mapping[str, Any]) -> Roles:
    """Return the names to draw: the selected estimate, physics (else the first other filter), others."""
    names: list[str] = [e["name"] for e in report["estimators"] if e["outcome"] == "ran"]
    selected = report.get("selected_estimate")
    main: str = selected if selected in names else next(iter(names), "")
    identical = identical_to_selected(report)
    others = [n for n in names if n not in identical]
    rival = next((n for n in (_PHYSICS, *sorted(others, key=lambda n: n == NAIVE)) if n in others and n != main), "")
    return Roles(main, rival, tuple(n for n in names if n not in (main, rival)))


def identical_to_selected(report: Mapping[str, Any]) -> list[str]:
    """Return the estimators with the same sideslip as the selected estimate: the same filter with another name."""
    return [name for name, apart in disagreements(report).items() if apart == 0.0]


_Table: TypeAlias = dict[str, Any]
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
    """Return the table of the metrics that need no ground truth, either those of ``manoeuvres`` or the others.

    It has heads, and rows of a name and its values; None if all values are unknown. NIS is per degree of freedom.
    """
    figures = figures_of(report)

    def value(name: str, signal: str, metric: Metric) -> float | None:
        figure = figures.get((name, signal, "all", "nis_ratio" if metric.name == "nis" else metric.name))
        return None if figure is None else figure * read_unit(metric.unit_of(signal))[1]

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


def disagreements(report: Mapping[str, Any]) -> dict[str, float]:
    """Return the RMS sideslip difference in rad between each other estimator and the selected estimate."""
    figures = figures_of(report).items()
    return {name: v for (name, *_, segment, m), v in figures if (segment, m) == ("all", "from_main") and v is not None}


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
