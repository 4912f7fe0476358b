"""Output of ``pdhef run`` and ``pdhef metrics``: the selected estimate as text, a table, output files, the plan."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from rich.console import Console
from rich.measure import Measurement

from pdhef_logtool.cli.console import BREAK, cell, protected, table
from pdhef_logtool.cli.printing import print_template
from pdhef_logtool.evaluation.metrics.metric import registered
from pdhef_logtool.evaluation.units import LABELS, read_unit
from pdhef_logtool.results.opened_run import LOGS, PAGE_FILE
from pdhef_logtool.results.selected_estimate import assumptions_of, figures_of
from pdhef_logtool.runs.run_result import RunResult

_Report: TypeAlias = Mapping[str, Any]
#: Signal, segment and metric.
_Key: TypeAlias = tuple[str, str, str]
#: Head of a column of the table of estimators, factor to the displayed unit, digits.
_Column: TypeAlias = tuple[str, float, int]

_NIS_RATIO: _Key = ("state", "all", "nis_ratio")
#: Columns in the order of their omission in a narrow terminal, after all columns that are not listed; two are kept.
_LEAVE_LAST = """
    vx_m_s.all.rmse sideslip_rad.all.max_abs lateral_1s_m.all.rmse vy_m_s.all.rmse sideslip_rad.all.p95_abs
    ay_m_s2.all.rmse state.all.nis_ratio sideslip_rad.all.lag_s sideslip_rad.linear.rmse yaw_rate_rad_s.all.rmse
    sideslip_rad.nonlinear.rmse sideslip_rad.all.rmse sideslip_rad.all.coverage95
""".split()  # noqa: SIM905 - a list with quotes is longer


def render_run(result: RunResult, console: Console) -> None:
    """Print the selected estimate of each log, or one table for several logs, and the location of the outputs."""
    logs = [(r.outcome, r.report) for r in result.results]
    reports = [report for _, report in logs if report is not None]
    first, *others = [assumptions_of(report) for report in reports] or [[]]
    assumed = [clause for clause in first if all(clause in clauses for clauses in others)]
    plan = None if result.requirements is None else result.requirements.to_dict()
    tables = [None if report is None else (_shown(report), _table(report, console)) for _, report in logs]
    page = _page_of(result.place, [outcome.log for outcome, _ in logs])
    of_run = {"assumed": assumed, "plan": plan, "output": result.place, "page": page}
    print_template("run", console, logs=logs, reports=reports, tables=tables, **of_run)


def render_fleet(summary: Mapping[str, Any], console: Console) -> None:
    """Print a run of many logs: errors over drives, worst drives, failures, and the location of the outputs."""
    output = summary["output"]
    print_template("fleet", console, r=summary, next_page=Path(output) / PAGE_FILE, page=_page_of(output))


def _page_of(output: Path | str | None, labels: Sequence[str] = ()) -> Path | None:
    """Return the page of the run, or of its only log, None without one."""
    if output is None:
        return None
    folders = [Path(output) / LOGS / label for label in labels] if len(labels) == 1 else []
    return next((page for folder in (*folders, Path(output)) if (page := folder / PAGE_FILE).is_file()), None)


def _shown(report: _Report) -> list[Mapping[str, Any]]:
    """Return the displayed estimators: the selected estimate first, estimators that are not causal last."""
    answer = report["answer"]
    ran = {e["name"]: e for e in report["estimators"] if e["outcome"] == "ran"}
    if answer is not None and not answer["named"]:
        return [ran[name] for name in answer["shown"]]
    return sorted(ran.values(), key=lambda e: not e["causal"])


def _table(report: _Report, console: Console) -> list[list[str]]:
    """Return heads and rows of the table of the displayed estimators, with as many columns as fit the terminal."""
    values, truth = figures_of(report), report["truth"]
    shown = [e for e in _shown(report) if any(name == e["name"] for name, *_ in values)]  # --keep metrics has less
    asked = _columns(truth=truth["available"], main=report["selected_estimate"] or "").items()
    columns = [(k, c) for k, c in asked if any(values.get((e["name"], *k)) is not None for e in shown)]
    others = [".".join(k) for k, _ in columns if ".".join(k) not in _LEAVE_LAST] if truth["available"] else []
    for leave in (None, *others, *_LEAVE_LAST[:-2]):
        columns = [(k, c) for k, c in columns if ".".join(k) != leave]
        heads = [f"!>{head}" + (" †" if k[0] in truth["not_independent"] else "") for k, (head, *_) in columns]
        rows = [[f"!{BREAK}estimator", *heads]]
        for e in shown:
            figures = (cell(values.get((e["name"], *k)), factor, digits) for k, (_, factor, digits) in columns)
            rows.append([e["name"] + ("" if e["causal"] else " *"), *figures])
        made = table(*map(protected, rows[0]), rows=rows[1:])
        if Measurement.get(console, console.options.update(max_width=10_000), made).maximum <= console.width:
            break
    return rows


def _columns(*, truth: bool, main: str) -> dict[_Key, _Column]:
    """Return the columns of the table: columns of the metrics by signal, and ratios and differences of two."""
    metrics, columns = registered(), dict[_Key, _Column]()

    def add(name: str, signal: str, segment: str = "all", *, top: str = "", head: str = "", key: str = "") -> None:
        unit, factor = read_unit(metrics[name].unit_of(signal))
        label = metrics[name].head(signal)
        if not top and not unit:  # in two lines, as the others
            top, _, label = label.rpartition(" ")
        columns[signal, segment, key or name] = head or f"{top}{BREAK}{label}", factor, metrics[name].digits

    if not truth:
        add("reference_rms", "sideslip_rad", head=f"sideslip: RMS{BREAK}from reference °")
        add("disagreement_rms", "sideslip_rad", head=f"sideslip: RMS{BREAK}from {main} °", key="from_main")
        add("d2", "vy_m_s", top="lateral kin.")
        columns[_NIS_RATIO] = f"innovations{BREAK}NIS/dof", 1.0, 2
    asked = [(signal, metric) for metric in metrics.values() for signal in metric.terminal]
    signals = [*dict.fromkeys(signal for signal, _ in asked)]
    topped = {"state"}
    for signal, metric in sorted(asked, key=lambda a: (signals.index(a[0]), a[1].unit == "1")):  # shares last
        add(metric.name, signal, top="" if signal in topped else LABELS[signal])
        topped.add(signal)
    if truth:
        for segment in ("linear", "nonlinear"):
            add("rmse", "sideslip_rad", segment, top=segment)
        columns[_NIS_RATIO] = f"{BREAK}NIS/dof", 1.0, 2
    return columns
