"""Output of ``pdhef run`` and ``pdhef metrics``: the selected estimate as text, a table, output files, the plan."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from pdhef_logtool.cli.console import cell, named_lines, print_indented, table, three_lines
from pdhef_logtool.evaluation.metrics.metric import registered
from pdhef_logtool.evaluation.requirement_verdicts import joint_notes, next_steps
from pdhef_logtool.evaluation.units import LABELS, read_unit
from pdhef_logtool.evaluation.validation_plan import shown as value_text
from pdhef_logtool.records.geometry import DEGREES
from pdhef_logtool.records.printable import all_printable, listed
from pdhef_logtool.results import selected_estimate as selected
from pdhef_logtool.results.opened_run import LOGS, PAGE_FILE
from pdhef_logtool.results.plan_verdicts import PlanVerdicts
from pdhef_logtool.results.run_report import lines_of
from pdhef_logtool.results.selected_estimate import assumptions_of, degrees, figures_of
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
#: Largest number of logs with the same failure in a line.
_MOST_FAILED = 5
_TEXTS = {
    "result": "Result",
    "consistency": "Consistency",
    "band": "95 % CI",
    "hindsight": "In hindsight",
    "assumed": "Assumed",
    "next": "Then",
}


def render_run(result: RunResult, console: Console) -> None:
    """Print the selected estimate of each log, or one table for several logs, and the location of the outputs."""
    reports_by_log = [(r, all_printable(r.report)) for r in result.results]
    reports = [report for _, report in reports_by_log if report is not None]
    is_joint = len(reports) > 1 and all(report["answer"] for report in reports)
    first, *others = [assumptions_of(report) for report in reports] or [[]]
    assumed = [clause for clause in first if all(clause in clauses for clauses in others)]
    console.print(_head(result, reports, assumed))
    console.print()
    if is_joint:
        console.print(_joint_table(reports))
        console.print()
    for log_result, report in reports_by_log:
        if report is None:
            console.print(Text.assemble((log_result.outcome.log, "bold"), f"  {log_result.outcome.outcome}\n"))
        else:
            _render_log(report, console, assumed if is_joint else None)
    if result.requirements is not None:
        render_plan(result.requirements, console)
    failed = [r for r, report in reports_by_log if report is None]
    lost = [r for r in result.results if r.outcome.lost]
    if lost or failed:
        done = f"{len(result.results) - len(failed)} done, {len(failed)} failed, {len(lost)} with input lost"
        console.print(f"{len(result.results)} logs: {done}")
    if result.place is not None:
        _print_outputs(result.place, console, [r.outcome.log for r in result.results])


def _head(result: RunResult, reports: Sequence[_Report], assumed: Sequence[str]) -> Table:
    """Return the first three lines: result, assumptions, next step."""
    texts = [_texts(report) for report in reports]
    failed = [r.outcome.log for r in result.results if r.report is None]
    alone = len(result.results) == 1
    said = _range(reports) if not alone else selected.result_of(reports[0]) if reports else "the log failed"
    steps = [f"{', '.join(failed[:_MOST_FAILED])} failed: read the cause below"] if failed else []
    steps += dict.fromkeys(c for t in texts for c in _clauses(t, "next"))
    plan = None if result.requirements is None else result.requirements.to_dict()
    text = "; ".join(assumed) or ("differs by log, see below" if len(reports) > 1 else "none")
    return _three_lines(said, text, plan, steps, "no action needed")


def _three_lines(
    said: str, assumed: str, plan: Mapping[str, Any] | None, steps: Sequence[str], otherwise: str
) -> Table:
    """Return result, with the counts of a plan, assumptions, and the first step, ``otherwise`` without any."""
    result = Text.assemble(said, "; ", plan_line(plan)) if plan else said
    return three_lines(result, assumed, next(iter(next_steps(plan, steps)), otherwise))


def _range(reports: Sequence[_Report]) -> str:
    """Return the lowest and highest sideslip error of the selected estimate over several logs."""
    errors = [
        figures_of(r).get((r["selected_estimate"], "sideslip_rad", "all", "rmse")) for r in reports if r["answer"]
    ]
    scored = [e for e in errors if e is not None]
    if not scored:
        return f"sideslip of {len(reports)} logs is not scored" if reports else "all logs failed"
    return f"Sideslip RMSE of {len(scored)} logs: {degrees(min(scored))} to {degrees(max(scored))}"


def _fleet_head(summary: Mapping[str, Any]) -> Table:
    """Return the three lines of a run of many logs."""
    errors = summary["errors"]
    rmse = f"median sideslip RMSE {degrees(errors[0]['median_rad'])}" if errors else "no drive is scored"
    said, steps = f"{rmse} of {summary['scored']} drives", ["read the failures below"] if summary["failed"] else []
    page = f"open {Path(summary['output']) / PAGE_FILE}"
    return _three_lines(said, "differs by drive, see report.json", summary["plan"], steps, page)


def render_fleet(summary: Mapping[str, Any], console: Console) -> None:
    """Print a run of many logs: errors over drives, worst drives, failures, and the location of the outputs."""
    console.print(_fleet_head(summary))
    console.print()
    if summary["errors"]:
        keys, errors = ("median_rad", "p90_rad", "max_rad"), summary["errors"]
        rows = ((of["estimator"], str(of["drives"]), *(cell(of[key], DEGREES, 3) for key in keys)) for of in errors)
        console.print(f"RMSE of sideslip over {summary['scored']} drives with an independent ground truth")
        console.print(table("sideslip by", ">drives", ">median °", ">p90 °", ">largest °", rows=rows))
        console.print()
    if summary["worst"]:
        names = list(dict.fromkeys(n for d in summary["worst"] for n in d["errors_rad"] if n != d["main"]))[:3]
        rows = (
            (d["log"], d["main"], *(cell(d["errors_rad"].get(n), DEGREES, 3) for n in (d["main"], *names)))
            for d in summary["worst"]
        )
        console.print(table("worst drives", "by", ">RMSE °", *(f">{n} °" for n in names), rows=rows, fold=1))
        console.print()
    for kind in summary["failed"]:
        console.print(Text.assemble((f"{kind['count']} failed: ", "bold"), kind["reason"]))
        print_indented(listed(kind["labels"], count=kind["count"]), console)
    if checks := summary["checks_failed"]:
        console.print(Text.assemble((f"{len(checks)} with failed checks", "bold"), ", see report.json:"))
        print_indented(listed(checks), console)
    left = f", {summary['remaining']} not done" if summary["remaining"] else ""
    logs, done, lost = (summary[key] for key in ("logs", "done", "lost"))
    console.print(f"{logs} logs: {done} done, {logs - done} failed, {lost} with input lost{left}")
    _print_outputs(summary["output"], console)


def _print_outputs(output: Path | str, console: Console, labels: Sequence[str] = ()) -> None:
    """Print the folder of the outputs, and the page of the run or of its only log."""
    folders = [Path(output) / LOGS / label for label in labels] if len(labels) == 1 else []
    page = next((f / PAGE_FILE for f in folders if (f / PAGE_FILE).is_file()), Path(output) / PAGE_FILE)
    shown = f"; open {page} in a browser" if page.is_file() else ""
    console.print(f"outputs in {output}{shown}", soft_wrap=True)


def _render_log(report: _Report, console: Console, common: Sequence[str] | None = None) -> None:
    """Print the log of a run with one log.

    ``common``: assumptions of several logs; a table has their figures, and only what needs attention is printed.
    """
    texts, is_named = _texts(report), report["answer"] is not None and report["answer"]["named"]
    if common is None:
        later = _clauses(texts, "next")[1:]  # the head contains the first one
        shown = {key: text for key, text in texts.items() if key not in ("result", "assumed", "next")}
        shown |= {"next": "; ".join(later)} if later else {}
        lines = lines_of("checks", report, True)
    else:
        is_scored = figures_of(report).get((report["selected_estimate"], "sideslip_rad", "all", "rmse")) is not None
        rest = [clause for clause in assumptions_of(report) if clause not in common]
        shown = {} if is_scored or "result" not in texts else {"result": texts["result"]}
        shown |= {"assumed": "; ".join(rest)} if rest else {}
        lines = [*lines_of("checks", report, False), *lines_of("losses", report, False)]
        if not (shown or lines or is_named):
            return
    log, has_table = report["log"], common is None or is_named
    about = f"  {log['kind']}, {log['duration_s']:.1f} s" if has_table else ""
    console.print(Text.assemble((log["name"], "bold"), about))
    for line in lines:
        print_indented(line, console)
    if shown:
        console.print(named_lines({f"  {_TEXTS[key]}": text for key, text in shown.items()}))
    if has_table:
        console.print(_table(report, console))
    for line in lines_of("below", report, _shown(report)) if common is None else ():
        print_indented(line, console)
    console.print()


def _texts(report: _Report) -> dict[str, str]:
    """Return the texts of the selected estimate in order; empty without an estimate."""
    texts = (report["answer"] or {"texts": {}})["texts"]
    return {key: texts[key] for key in _TEXTS if texts.get(key)}


def _clauses(texts: Mapping[str, str], key: str) -> list[str]:
    """Return the independent clauses of a text."""
    return texts[key].split("; ") if texts.get(key) else []


def _shown(report: _Report) -> list[Mapping[str, Any]]:
    """Return the displayed estimators: the selected estimate first, estimators that are not causal last."""
    answer = report["answer"]
    ran = {e["name"]: e for e in report["estimators"] if e["outcome"] == "ran"}
    if answer is not None and not answer["named"]:
        return [ran[name] for name in answer["shown"]]
    return sorted(ran.values(), key=lambda e: not e["causal"])


def _table(report: _Report, console: Console) -> Table:
    """Return the table of the displayed estimators, with as many columns as fit the terminal."""
    values, truth = figures_of(report), report["truth"]
    shown = [e for e in _shown(report) if any(name == e["name"] for name, *_ in values)]  # --keep metrics has less
    asked = _columns(truth=truth["available"], main=report["selected_estimate"] or "").items()
    columns = [(k, c) for k, c in asked if any(values.get((e["name"], *k)) is not None for e in shown)]
    others = [".".join(k) for k, _ in columns if ".".join(k) not in _LEAVE_LAST] if truth["available"] else []
    for leave in (None, *others, *_LEAVE_LAST[:-2]):
        columns = [(k, c) for k, c in columns if ".".join(k) != leave]
        heads = (f">{head}" + (" †" if k[0] in truth["not_independent"] else "") for k, (head, *_) in columns)
        made = table("\nestimator", *heads)
        for column in made.columns:
            column.no_wrap = True
        for e in shown:
            figures = (cell(values.get((e["name"], *k)), factor, digits) for k, (_, factor, digits) in columns)
            made.add_row(e["name"] + ("" if e["causal"] else " *"), *figures)
        if Measurement.get(console, console.options.update(max_width=10_000), made).maximum <= console.width:
            break
    return made


def _columns(*, truth: bool, main: str) -> dict[_Key, _Column]:
    """Return the columns of the table: columns of the metrics by signal, and ratios and differences of two."""
    metrics, columns = registered(), dict[_Key, _Column]()

    def add(name: str, signal: str, segment: str = "all", *, top: str = "", head: str = "", key: str = "") -> None:
        unit, factor = read_unit(metrics[name].unit_of(signal))
        label = metrics[name].head(signal)
        if not top and not unit:  # in two lines, as the others
            top, _, label = label.rpartition(" ")
        columns[signal, segment, key or name] = head or f"{top}\n{label}", factor, metrics[name].digits

    if not truth:
        add("reference_rms", "sideslip_rad", head="sideslip: RMS\nfrom reference °")
        add("disagreement_rms", "sideslip_rad", head=f"sideslip: RMS\nfrom {main} °", key="from_main")
        add("d2", "vy_m_s", top="lateral kin.")
        columns[_NIS_RATIO] = "innovations\nNIS/dof", 1.0, 2
    asked = [(signal, metric) for metric in metrics.values() for signal in metric.terminal]
    signals = [*dict.fromkeys(signal for signal, _ in asked)]
    topped = {"state"}
    for signal, metric in sorted(asked, key=lambda a: (signals.index(a[0]), a[1].unit == "1")):  # shares last
        add(metric.name, signal, top="" if signal in topped else LABELS[signal])
        topped.add(signal)
    if truth:
        for segment in ("linear", "nonlinear"):
            add("rmse", "sideslip_rad", segment, top=segment)
        columns[_NIS_RATIO] = "\nNIS/dof", 1.0, 2
    return columns


def _joint_table(reports: Sequence[_Report]) -> Table:
    """Return one line per log: errors of the selected estimate, physics and the baseline, and points to check."""
    mains = list(dict.fromkeys(report["selected_estimate"] for report in reports))
    rivals = [n for n in ("physics", "zero") if [n] != mains and any(n in r["answer"]["shown"] for r in reports)]
    head = f">{mains[0]}\nRMSE °" if len(mains) == 1 else ">sideslip\nRMSE °"
    joint = table("\nlog", ">\ns", head, *(f">{n}\nRMSE °" for n in rivals), ">CI 95 %\ncovers", "\nlook at", fold=1)
    joint.columns[-1].overflow = "fold"
    for report in reports:
        values, main = figures_of(report), report["selected_estimate"]
        errors = [cell(values.get((n, "sideslip_rad", "all", "rmse")), DEGREES, 3) for n in (main, *rivals)]
        compared = (values.get((n, "sideslip_rad", "all", "rmse")) for n in (main, "zero"))
        inside = values.get((main, "sideslip_rad", "all", "coverage95"))
        seconds = f"{report['log']['duration_s']:.0f}"
        notes = lines_of("look_at", report, inside, main if len(mains) > 1 else "", selected.is_worse(*compared))
        joint.add_row(report["log"]["name"], seconds, *errors, cell(inside), *(notes or [""]))
    return joint


#: Styles of the outcomes of requirements.
STYLES = {"PASS": "green", "FAIL": "bold red", "INCONCLUSIVE": "dim"}


def plan_line(plan: Mapping[str, Any]) -> Text:
    """Return the number of requirements by outcome of a plan with its verdicts, and the name of the plan."""
    counts = Counter(str(r["outcome"]) for r in plan["requirements"])
    parts = [Text(f"{counts[outcome]} {outcome}", style) for outcome, style in STYLES.items() if counts[outcome]]
    name = f"plan {plan['file']}" if plan["file"] else "default plan, no gate"
    return Text.assemble(Text(", ").join(parts), f" ({name})")


def render_plan(plan_result: PlanVerdicts, console: Console) -> None:
    """Print the requirements in a table, and the next steps for inconclusive ones."""
    made = table("", "id", "requirement", ">value", ">margin", fold=3)
    for v in plan_result.verdicts:
        unit = v.requirement.unit
        value, margin = ("-" if x is None else value_text(x, unit) for x in (v.value, v.margin))
        made.add_row(Text(v.outcome, STYLES[v.outcome]), v.requirement.id, v.requirement.label, value, margin)
    console.print(made)
    to_do: dict[str, list[str]] = {}
    for v in plan_result.verdicts:
        if v.outcome != "PASS":
            value = "" if v.value is None else f"{value_text(v.value, v.requirement.unit)}; "
            what = v.reason.removeprefix(value)
            to_do.setdefault(f"{what}. Next: {v.next}" if v.next else what, []).append(v.requirement.id)
    for what, ids in to_do.items():
        print_indented(f"{', '.join(ids)}: {what}", console)
    for note in joint_notes({v.requirement.id: v.notes for v in plan_result.verdicts}):
        print_indented(f"note: {note}", console)
    console.print()
