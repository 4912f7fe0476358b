"""What a run prints on the terminal: one table a log, then what to do next."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pdhef_logtool.evaluation.thresholds import Verdict
from pdhef_logtool.run.pipeline import LogResult, RunResult
from pdhef_logtool.sinks.report import diverged_line, friction_line, reasons_line

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from pdhef_logtool.learning.car.identify_command import IdentifyResult
    from pdhef_logtool.learning.evidence.calibrate_command import CalibrateResult
    from pdhef_logtool.learning.evidence.trust_command import TrustResult
    from pdhef_logtool.learning.network.baselines import BaselinesResult
    from pdhef_logtool.learning.network.extract_command import ExtractResult
    from pdhef_logtool.learning.network.train_command import TrainResult
    from pdhef_logtool.learning.noise.tune_command import TuneResult

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
        console.print(
            f"{len(result.results)} logs: {len(result.results) - len(failed)} done, {len(failed)} failed, "
            f"{len(lost)} with input lost",
            highlight=False,
        )
    if result.output is not None:
        console.print(f"outputs in {result.output}", highlight=False, soft_wrap=True)


def _render_verdicts(verdicts: Sequence[Verdict], console: Console) -> None:
    from rich.table import Table

    table = Table(box=None, header_style="bold", pad_edge=True)
    for head in ("threshold", "estimator", "log"):
        table.add_column(head, overflow="fold")
    for head in ("value", "margin"):
        table.add_column(head, justify="right")
    table.add_column("verdict")
    for v in verdicts:
        mark = "" if v.independent else " †"
        value, margin = ("-" if x is None else f"{x:.4g}" for x in (v.value, v.margin))
        table.add_row(v.threshold.label + mark, v.estimator, v.log, value, margin, v.outcome)
    console.print(table)
    failed = sum(v.failed for v in verdicts)
    console.print(f"{len(verdicts)} verdicts, {failed} failed", highlight=False)
    console.print()


def _render_log(one: LogResult, console: Console) -> None:
    report = one.report
    if report is None:
        console.print(f"[bold]{one.outcome.log}[/bold]  {one.outcome.outcome}", highlight=False)
        console.print()
        return
    seconds = report["log"]["duration_s"]
    console.print(
        f"[bold]{one.outcome.log}[/bold]  {report['log']['kind']}, {seconds:.1f} s, "
        f"vehicle {report['vehicle']['name']}",
        highlight=False,
    )
    for loss in report["losses"]:
        word = "lost" if loss["severity"] == "lost" else "note"
        told = loss["count"] is None or loss["kind"] == "gap" or str(loss["count"]) in loss["what"].split()
        count = "" if told else f"{loss['count']} × "
        span = ""
        if loss["start_ns"] is not None and loss["end_ns"] is not None:
            start = report["log"]["start_ns"]
            span = f", {(loss['start_ns'] - start) / 1e9:.2f} to {(loss['end_ns'] - start) / 1e9:.2f} s"
        console.print(f"  {word}: {count}{loss['what']} ({loss['where']}{span})", highlight=False)
    console.print(_table(report, console.width))
    if not report["truth"]["available"]:
        console.print("  no truth in this log: estimates, NIS and disagreement only", highlight=False)
        for row in report["metrics"]:
            if row["metric"] == "disagreement_rms" and row["segment"] == "all" and row["value"] is not None:
                pair = " and ".join(row["estimator"].split("~"))
                console.print(f"  sideslip of {pair}: rms difference {row['value'] * _DEG:.3f}°", highlight=False)
    if report["truth"]["not_independent"]:
        console.print("  † the truth is an input or the estimate itself: no independent check", highlight=False)
    if found := friction_line(report):
        console.print(f"  friction: {found}", highlight=False, markup=False)
    for estimator in report["estimators"]:
        if estimator["outcome"] == "skipped":
            console.print(f"  {estimator['name']} skipped: {estimator['reason']}", highlight=False)
    for note, names in _notes(report).items():
        console.print(f"  {', '.join(names)}: {note}", highlight=False, markup=False)
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
    from rich.table import Table

    values = {(m["estimator"], m["signal"], m["segment"], m["metric"]): m["value"] for m in report["metrics"]}
    present = {(m["signal"], m["metric"]) for m in report["metrics"] if m["segment"] == "all"}
    shown = [c for c in _COLUMNS if (c[1], c[2]) in present]
    # On a narrow terminal the columns that matter least go, rather than all of them being squeezed.
    for head in _LEAVE_FIRST:
        if _width(shown) > width:
            shown = [c for c in shown if c[0] != head]
    table = Table(box=None, header_style="bold", pad_edge=True)
    table.add_column("\nestimator")
    dependent = report["truth"]["not_independent"]
    for head, signal, *_ in shown:
        table.add_column(head + (" †" if signal in dependent else ""), justify="right")
    scored = {m["segment"] for m in report["metrics"] if (m["signal"], m["metric"]) == ("sideslip_rad", "rmse")}
    by_segment = [s for s in _SEGMENTS if s in scored]
    for segment in by_segment:
        table.add_column(f"{segment}\nRMSE °", justify="right")
    nis = any(m["metric"] == "nis" for m in report["metrics"])
    if nis:
        table.add_column("\nNIS/dof", justify="right")
    ran = [e for e in report["estimators"] if e["outcome"] == "ran"]
    for estimator in sorted(ran, key=lambda e: not e["causal"]):  # those that know the future stand apart, below
        name = estimator["name"]
        cells = [name + ("" if estimator["causal"] else " (not causal)")]
        cells += [_cell(values.get((name, signal, "all", metric)), f, d) for _, signal, metric, f, d in shown]
        cells += [_cell(values.get((name, "sideslip_rad", s, "rmse")), _DEG, 3) for s in by_segment]
        if nis:
            cells.append(_cell(_nis_ratio(values, name), 1.0, 2))
        table.add_row(*cells)
    return table


def _width(columns: list[tuple[str, str, str, float, int]]) -> int:
    return _FIXED_WIDTH + sum(max(len(line) for line in head.splitlines()) + 2 for head, *_ in columns)


def _nis_ratio(values: Mapping[tuple[str, str, str, str], float | None], name: str) -> float | None:
    nis, dof = values.get((name, "state", "all", "nis")), values.get((name, "state", "all", "nis_dof"))
    return None if nis is None or not dof else nis / dof


def _cell(value: float | None, factor: float, digits: int) -> str:
    return "-" if value is None else f"{value * factor:.{digits}f}"


def render_identification(result: IdentifyResult, console: Console) -> None:
    """Print what was identified, how well it is known, and how well the filter then does."""
    from rich.table import Table

    found = result.identification
    table = Table(box=None, header_style="bold")
    for head, side in (("parameter", "left"), ("value", "right"), ("95 % interval", "right"), ("prior", "right")):
        table.add_column(head, justify="right" if side == "right" else "left")
    table.add_column("unit")
    table.add_column("")
    for p in found.parameters:
        interval = f"{p.low:.4g} to {p.high:.4g}" if p.excited else "-"
        remark = "filter noise" if p.tuning else "" if p.excited else "kept: not excited further"
        table.add_row(p.name, f"{p.value:.5g}", interval, f"{p.prior:.4g}", p.unit, remark)
    console.print(table)
    console.print()
    scores = Table("part", box=None, header_style="bold")
    for head in ("seconds", "β = 0", "phy-ukf, starting file", "phy-ukf-tuned, identified"):
        scores.add_column(head, justify="right")
    for s in found.scores:
        scores.add_row(
            s.part, f"{s.seconds:.1f}", f"{s.zero_deg:.3f}°", f"{s.start_file_deg:.3f}°", f"{s.identified_deg:.3f}°"
        )
    console.print("sideslip RMSE", highlight=False)
    console.print(scores)
    for note in found.notes:
        console.print(f"  {note}", highlight=False)
    console.print(f"vehicle in {result.vehicle_file}, plot in {result.plot_file}", highlight=False, soft_wrap=True)


def render_extraction(result: ExtractResult, console: Console) -> None:
    """Print what each drive gave, and the dataset as a whole."""
    from rich.table import Table

    table = Table(box=None, header_style="bold", pad_edge=True)
    table.add_column("drive", overflow="fold")
    for head in ("seconds", "usable", "v̇_y residual\nRMS m/s²", "ṙ residual\nRMS rad/s²"):
        table.add_column(head, justify="right")
    table.add_column("split")
    table.add_column("truth")
    for drive in result.results:
        if drive.entry is None:
            table.add_row(drive.record.name, "-", "-", "-", "-", "-", "failed")
            continue
        e, truth = drive.entry, drive.entry["truth"]
        half_s = truth["smoothing_half_s"]
        how = truth["kind"] + (f", ±{half_s:g} s" if half_s else "") + (", kept" if drive.kept else "")
        table.add_row(
            drive.record.name,
            f"{e['duration_s']:.1f}",
            f"{100.0 * e['usable_rows'] / max(e['rows'], 1):.1f} %",
            _cell(e["residual_rms"]["vy_dot_m_s2"], 1.0, 3),
            _cell(e["residual_rms"]["yaw_acceleration_rad_s2"], 1.0, 3),
            e["split"],
            how,
        )
    console.print(table)
    splits = result.manifest["splits"].items()
    console.print(
        ", ".join(f"{name}: {s['drives']} drives, {s['usable_rows']} usable rows" for name, s in splits),
        highlight=False,
    )
    console.print(f"dataset in {result.output}", highlight=False, soft_wrap=True)


def render_training(result: TrainResult, console: Console) -> None:
    """Print how the training went; losses are shares of the target's own mean square."""
    best = min(result.history, key=lambda e: e.validation_loss)
    seconds = sum(e.seconds for e in result.history)
    console.print(
        f"{len(result.history)} epochs in {seconds:.0f} s; best epoch {best.epoch}: training {best.train_loss:.4f}, "
        f"validation {best.validation_loss:.4f} of the target's mean square",
        highlight=False,
    )
    if result.test_loss is not None:
        console.print(f"test drives: {result.test_loss:.4f}", highlight=False)
    console.print(f"model in {result.model} ({result.bundle.sha256[:12]})", highlight=False, soft_wrap=True)


def render_tuning(result: TuneResult, console: Console) -> None:
    """Print the best noise of each estimator and its sideslip error; all had the same drives and trials."""
    from rich.table import Table

    from pdhef_logtool.learning.noise.search import FACTORS

    table = Table(box=None, header_style="bold")
    table.add_column("\nestimator")
    for f in FACTORS:
        table.add_column(f"{f.name}\n{f.unit}", justify="right")
    for head in ("\nobjective °", "\nmedian °", "\npooled °", "file's own\nobjective °"):
        table.add_column(head, justify="right")
    for t in result.tuned:
        score = t.best.score
        table.add_row(
            t.name,
            *(f"{v:g}" for v in t.best.values),
            *(f"{v:.4f}" for v in (score.objective_deg, score.median_deg, score.pooled_deg)),
            "-" if t.before is None else f"{t.before.objective_deg:.4f}",
        )
    console.print("sideslip RMSE over drives", highlight=False)
    console.print(table)
    trials = len(result.tuned[0].trials)
    console.print(f"{len(result.drives)} drives, {trials} trials of each estimator", highlight=False)
    console.print(
        f"vehicle in {result.vehicle_file}, trials in {result.tuning_file}, plot in {result.plot_file}",
        highlight=False,
        soft_wrap=True,
    )


def render_calibration(result: CalibrateResult, console: Console) -> None:
    """Print how the 95 % intervals of sideslip stand before and after, on drives that were not fitted to."""
    from rich.table import Table

    table = Table(box=None, header_style="bold")
    for head in ("\nestimator", "\nvehicle file", "grip\nuse"):
        table.add_column(head)
    for head in ("\ndrives", "RMSE\n°", "covered %\nbefore", "\nafter", "width / normal\nbefore", "\nafter"):
        table.add_column(head, justify="right")
    for name, fitted in result.fitted.items():
        for c in fitted.coverage:
            table.add_row(
                name,
                "made wrong" if c.wrong_vehicle else "as given",
                c.bin,
                str(c.drives),
                f"{math.degrees(c.rmse_rad):.4f}",
                f"{100.0 * c.covered_before:.1f}",
                f"{100.0 * c.covered_after:.1f}",
                f"{c.width_before:.2f}",
                f"{c.width_after:.2f}",
            )
    console.print("95 % intervals of sideslip, each drive judged by a fit without it; width over 3.92 x RMSE")
    console.print(table)
    console.print(f"{len(result.drives)} drives; calibration in {result.file}", highlight=False, soft_wrap=True)


def render_trust(result: TrustResult, console: Console) -> None:
    """Print the sideslip error at each trust, its difference to trust 0 with bounds, and the cap with its reason."""
    from rich.table import Table

    from pdhef_logtool.learning.evidence.trust import TRUSTS

    d = result.decision
    table = Table(box=None, header_style="bold")
    for head in ("\ntrust", "sideslip\nRMSE °", "squared error less\nthat at 0, deg²", "\n95 % bounds"):
        table.add_column(head, justify="right")
    for trust, rmse, b in zip(TRUSTS, d.rmse_deg, d.against_zero, strict=True):
        known = trust > 0.0 and not math.isnan(b.low_deg2)
        bounds = f"{b.low_deg2:.4f} to {b.high_deg2:.4f}" if known else "-"
        table.add_row(f"{trust:g}", f"{rmse:.4f}", f"{b.value_deg2:.4f}" if trust else "-", bounds)
    console.print(table)
    seconds = f"{d.scored_s:.0f} s scored, {d.excited_s:.0f} s of them excited"
    console.print(f"{len(result.drives)} drives, {d.blocks} blocks, {seconds}", highlight=False)
    console.print(f"trust cap {d.cap:g}: {d.reason}", highlight=False)
    console.print(f"vehicle in {result.vehicle_file}, figures in {result.record_file}", highlight=False, soft_wrap=True)


def render_baselines(result: BaselinesResult, console: Console) -> None:
    """Print how both baselines came out."""
    render_training(result.pure_lstm, console)
    errors = result.regression.provenance["sideslip_rmse_deg"]
    shown = ", ".join(f"{split} {value:.3f}" for split, value in errors.items() if value is not None)
    console.print(f"linear regression, sideslip RMSE in degrees: {shown}", highlight=False)
    console.print(f"coefficients in {result.regression_file}", highlight=False, soft_wrap=True)
