"""What ``pdhef run`` and ``pdhef metrics`` print: one table a log, then the verdicts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rich.text import Text

from pdhef_logtool.cli.console import cell, table
from pdhef_logtool.sinks.report import diverged_line, friction_line, reasons_line

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from pdhef_logtool.evaluation.thresholds import Verdict
    from pdhef_logtool.runs.pipeline import LogResult, RunResult

_DEG = math.degrees(1.0)
#: Column head, signal, metric, factor to the shown unit, digits.
_COLUMNS: tuple[tuple[str, str, str, float, int], ...] = (
    ("sideslip\nRMSE °", "sideslip_rad", "rmse", _DEG, 3),
    ("\np95 °", "sideslip_rad", "p95_abs", _DEG, 3),
    ("\nmax °", "sideslip_rad", "max_abs", _DEG, 2),
    ("\nlag ms", "sideslip_rad", "lag_s", 1e3, 0),
    ("\n95 % cover", "sideslip_rad", "coverage95", 1.0, 2),
    ("v_y\nRMSE m/s", "vy_m_s", "rmse", 1.0, 3),
    ("v_x\nRMSE m/s", "vx_m_s", "rmse", 1.0, 3),
    ("yaw rate\nRMSE °/s", "yaw_rate_rad_s", "rmse", _DEG, 3),
    ("a_y\nRMSE m/s²", "ay_m_s2", "rmse", 1.0, 3),
    ("1 s lateral\nRMSE m", "lateral_1s_m", "rmse", 1.0, 3),
)
#: Where there is no truth.
_WITHOUT_TRUTH = (("v_y\nd2 m/s", "vy_m_s", "d2", 1.0, 3),)
_SEGMENTS = ("linear", "nonlinear")
_LEAVE_FIRST = ("v_x\nRMSE m/s", "\nmax °", "1 s lateral\nRMSE m", "v_y\nRMSE m/s", "\np95 °", "a_y\nRMSE m/s²")
#: Width of the columns that always stand: name, two segments, NIS.
_FIXED_WIDTH = 43


def render_run(result: RunResult, console: Console) -> None:
    """Print one table a log and where the outputs are."""
    for one in result.results:
        _render_log(one, console)
    if result.verdicts:
        _render_verdicts(result.verdicts, console)
    failed = [r for r in result.results if r.report is None]
    lost = [r for r in result.results if r.outcome.lost]
    if len(result.results) > 1 or failed:
        done = f"{len(result.results) - len(failed)} done, {len(failed)} failed, {len(lost)} with input lost"
        console.print(f"{len(result.results)} logs: {done}")
    if result.output is not None:
        console.print(f"outputs in {result.output}", soft_wrap=True)


def _render_verdicts(verdicts: Sequence[Verdict], console: Console) -> None:
    judged = table("threshold", "estimator", "log", ">value", ">margin", "verdict", fold=3)
    for v in verdicts:
        mark = "" if v.independent else " †"
        value, margin = ("-" if x is None else f"{x:.4g}" for x in (v.value, v.margin))
        judged.add_row(v.threshold.label + mark, v.estimator, v.log, value, margin, v.outcome)
    console.print(judged)
    console.print(f"{len(verdicts)} verdicts, {sum(v.failed for v in verdicts)} failed\n")


def _render_log(one: LogResult, console: Console) -> None:
    report = one.report
    if report is None:
        console.print(Text.assemble((one.outcome.log, "bold"), f"  {one.outcome.outcome}\n"))
        return
    drive = f"{report['log']['kind']}, {report['log']['duration_s']:.1f} s, vehicle {report['vehicle']['name']}"
    console.print(Text.assemble((one.outcome.log, "bold"), f"  {drive}"))
    for loss in report["losses"]:
        word = "lost" if loss["severity"] == "lost" else "note"
        told = loss["count"] is None or loss["kind"] == "gap" or str(loss["count"]) in loss["what"].split()
        count = "" if told else f"{loss['count']} × "
        span = ""
        if loss["start_ns"] is not None and loss["end_ns"] is not None:
            start = report["log"]["start_ns"]
            span = f", {(loss['start_ns'] - start) / 1e9:.2f} to {(loss['end_ns'] - start) / 1e9:.2f} s"
        console.print(f"  {word}: {count}{loss['what']} ({loss['where']}{span})")
    console.print(_table(report, console.width))
    if not report["truth"]["available"]:
        console.print("  no truth in this log: estimates, NIS and disagreement only")
        for row in report["metrics"]:
            if row["metric"] == "disagreement_rms" and row["segment"] == "all" and row["value"] is not None:
                pair = " and ".join(row["estimator"].split("~"))
                console.print(f"  sideslip of {pair}: rms difference {row['value'] * _DEG:.3f}°")
    if report["truth"]["not_independent"]:
        console.print("  † the truth is an input or the estimate itself: no independent check")
    if found := friction_line(report):
        console.print(f"  friction: {found}")
    for estimator in report["estimators"]:
        if estimator["outcome"] == "skipped":
            console.print(f"  {estimator['name']} skipped: {estimator['reason']}")
    for note, names in _notes(report).items():
        console.print(f"  {', '.join(names)}: {note}")
    console.print()


def _notes(report: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return what the estimators have to say, reasons last, with the names of all that say the same."""
    told: dict[str, list[str]] = {}
    for estimator in report["estimators"]:
        found = [diverged_line(report, estimator["name"]), reasons_line(estimator, report["log"]["start_ns"])]
        for note in [*estimator["notes"], *filter(None, found)]:
            told.setdefault(note, []).append(estimator["name"])
    return told


def _table(report: Mapping[str, Any], width: int) -> Table:
    values = {(m["estimator"], m["signal"], m["segment"], m["metric"]): m["value"] for m in report["metrics"]}
    present = {(m["signal"], m["metric"]) for m in report["metrics"] if m["segment"] == "all"}
    asked = _COLUMNS if report["truth"]["available"] else _WITHOUT_TRUTH
    shown = [c for c in asked if (c[1], c[2]) in present]
    # On a narrow terminal the columns that matter least go, rather than all of them being squeezed.
    for head in _LEAVE_FIRST:
        if _width(shown) > width:
            shown = [c for c in shown if c[0] != head]
    dependent = report["truth"]["not_independent"]
    scored = {m["segment"] for m in report["metrics"] if (m["signal"], m["metric"]) == ("sideslip_rad", "rmse")}
    by_segment = [s for s in _SEGMENTS if s in scored]
    nis = any(m["metric"] == "nis" for m in report["metrics"])
    heads = [head + (" †" if signal in dependent else "") for head, signal, *_ in shown]
    heads += [f"{segment}\nRMSE °" for segment in by_segment] + ["\nNIS/dof"] * nis
    errors = table("\nestimator", *(f">{head}" for head in heads))
    ran = [e for e in report["estimators"] if e["outcome"] == "ran"]
    for estimator in sorted(ran, key=lambda e: not e["causal"]):  # those that know the future stand apart, below
        name = estimator["name"]
        cells = [name + ("" if estimator["causal"] else " (not causal)")]
        cells += [cell(values.get((name, signal, "all", metric)), f, d) for _, signal, metric, f, d in shown]
        cells += [cell(values.get((name, "sideslip_rad", s, "rmse")), _DEG, 3) for s in by_segment]
        cells += [cell(_nis_ratio(values, name), digits=2)] * nis
        errors.add_row(*cells)
    return errors


def _width(columns: list[tuple[str, str, str, float, int]]) -> int:
    return _FIXED_WIDTH + sum(max(len(line) for line in head.splitlines()) + 2 for head, *_ in columns)


def _nis_ratio(values: Mapping[tuple[str, str, str, str], float | None], name: str) -> float | None:
    nis, dof = values.get((name, "state", "all", "nis")), values.get((name, "state", "all", "nis_dof"))
    return None if nis is None or not dof else nis / dof
