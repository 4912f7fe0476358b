"""What the learning commands print on the terminal."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pdhef_logtool.cli.console import cell, table

if TYPE_CHECKING:
    from rich.console import Console

    from pdhef_logtool.learning.car.identify_command import IdentifyResult
    from pdhef_logtool.learning.car.without_truth_command import WithoutTruthResult
    from pdhef_logtool.learning.evidence.calibrate_command import CalibrateResult
    from pdhef_logtool.learning.evidence.trust_command import TrustResult
    from pdhef_logtool.learning.learn.learn_command import CourseResult
    from pdhef_logtool.learning.network.baselines import BaselinesResult
    from pdhef_logtool.learning.network.extract_command import ExtractResult
    from pdhef_logtool.learning.network.train_command import TrainResult
    from pdhef_logtool.learning.noise.tune_command import TuneResult
    from pdhef_logtool.learning.retrain.retrain_command import RetrainResult


#: Of more drives than these only those that gave nothing are listed.
MOST_DRIVES = 40


def render_identification(result: IdentifyResult, console: Console) -> None:
    """Print what was identified, how well it is known, and how well the filter then does."""
    found = result.identification
    parameters = table("parameter", ">value", ">95 % interval", ">prior", "unit", "")
    for p in found.parameters:
        interval = f"{p.low:.4g} to {p.high:.4g}" if p.excited else "-"
        remark = "filter noise" if p.tuning else "" if p.excited else "kept: not excited further"
        parameters.add_row(p.name, f"{p.value:.5g}", interval, f"{p.prior:.4g}", p.unit, remark)
    scores = table("part", ">seconds", ">β = 0", ">phy-ukf, starting car", ">phy-ukf:tuned, identified", ">physics")
    for s in found.scores:
        errors = (f"{value:.3f}°" for value in (s.zero_deg, s.start_file_deg, s.identified_deg, s.physics_deg))
        scores.add_row(s.part, f"{s.seconds:.1f}", *errors)
    console.print(parameters)
    console.print()
    console.print("sideslip RMSE")
    console.print(scores)
    for note in found.notes:
        console.print(f"  {note}")
    console.print(f"car in {result.car}", soft_wrap=True)


def render_without_truth(result: WithoutTruthResult, console: Console) -> None:
    """Print what a pool of logs says of its car without truth, and how well it is known."""
    parameters = table("parameter", ">value", ">± 1 sd", ">prior", ">± 1 sd", "unit")
    for p in result.calibration.parameters:
        spread = [f"{100.0 * s:.0f} %" if p.log else f"{s:.2g}" for s in (p.sd, p.prior_sd)]
        parameters.add_row(p.name, f"{p.value:.5g}", spread[0], f"{p.prior:.4g}", spread[1], p.unit)
    console.print(parameters)
    console.print(f"  {result.calibration.text}")
    console.print(f"car in {result.car}", soft_wrap=True)


def render_extraction(result: ExtractResult, console: Console) -> None:
    """Print what each drive gave, and the dataset as a whole."""
    residuals = (">v̇_y residual\nRMS m/s²", ">ṙ residual\nRMS rad/s²")
    drives = table("drive", ">seconds", ">usable", *residuals, "split", "truth", fold=1)
    few = len(result.results) <= MOST_DRIVES
    shown = [r for r in result.results if few or r.entry is None]
    for drive in shown:
        if drive.entry is None:
            said = f"as {drive.copy_of}" if drive.copy_of else "failed"
            drives.add_row(drive.record.name, "-", "-", "-", "-", "-", said)
            continue
        e, truth, rms = drive.entry, drive.entry["truth"], drive.entry["residual_rms"]
        half_s = truth["smoothing_half_s"]
        drives.add_row(
            drive.record.name,
            f"{e['duration_s']:.1f}",
            f"{100.0 * e['usable_rows'] / max(e['rows'], 1):.1f} %",
            cell(rms["vy_dot_m_s2"], digits=3),
            cell(rms["yaw_acceleration_rad_s2"], digits=3),
            e["split"],
            truth["kind"] + (f", ±{half_s:g} s" if half_s else "") + (", kept" if drive.kept else ""),
        )
    if not few:
        what = "these gave nothing of their own" if shown else "all gave something"
        console.print(f"{len(result.results)} drives, listed in manifest.json; {what}")
    if shown:
        console.print(drives)
    splits = result.manifest["splits"].items()
    told = (f"{name}: {s['drives']} drives, {s['usable_rows']} usable rows" for name, s in splits)
    console.print(", ".join(told))
    _print_cells(result.manifest["cells"], result.manifest["choice"], console)
    console.print(f"dataset in {result.output}", soft_wrap=True)


def _print_cells(held: Mapping[str, Any], choice: Mapping[str, Any] | None, console: Console) -> None:
    """Print how much of each cell of driving split train holds, and how many hold nothing."""
    from pdhef_logtool.learning.network.cells import AY_M_S2, FRICTION, SPEED_M_S, cells
    from pdhef_logtool.learning.network.dataset import CHOSEN_SPLIT

    seconds, empty = (held[key][CHOSEN_SPLIT] for key in ("usable_s", "empty"))
    most = math.inf if choice is None else choice["per_cell_s"]
    shown = table("friction", "|a_y|\nm/s²", *(f">{_span(SPEED_M_S, i)}\nm/s" for i in range(len(SPEED_M_S))))
    for first in range(0, len(seconds), len(SPEED_M_S)):
        row, bins = first // len(SPEED_M_S), cells()[first : first + len(SPEED_M_S)]
        row_of = zip(bins, seconds[first : first + len(bins)], strict=True)
        shown.add_row(
            _span(FRICTION, row // len(AY_M_S2)),
            _span(AY_M_S2, row % len(AY_M_S2)),
            *(f"{min(s, most):.0f}" if s >= 0.5 else "<1" if s else "-" if c.in_reach else "" for c, s in row_of),
        )
    console.print(f"seconds to learn from in split {CHOSEN_SPLIT}" + ("" if most == math.inf else ", as chosen"))
    console.print(shown)
    within = sum(c.in_reach for c in cells())
    console.print(f"{len(empty)} of the {within} cells that grip allows hold nothing")


def _span(edges: Sequence[float], number: int) -> str:
    low = f"{edges[number]:g}"
    return f"{low} to {edges[number + 1]:g}" if number + 1 < len(edges) else f"{low} up"


def render_training(result: TrainResult, console: Console) -> None:
    """Print how the training went; losses are shares of the target's own mean square."""
    best = min(result.history, key=lambda e: e.validation_loss)
    seconds = sum(e.seconds for e in result.history)
    losses = f"training {best.train_loss:.4f}, validation {best.validation_loss:.4f} of the target's mean square"
    console.print(f"{len(result.history)} epochs in {seconds:.0f} s; best epoch {best.epoch}: {losses}")
    if result.test_loss is not None:
        console.print(f"test drives: {result.test_loss:.4f}")
    console.print(f"model in {result.model} ({result.bundle.sha256[:12]})", soft_wrap=True)


def render_baselines(result: BaselinesResult, console: Console) -> None:
    """Print how both baselines came out."""
    render_training(result.pure_lstm, console)
    errors = result.regression.provenance["sideslip_rmse_deg"]
    shown = ", ".join(f"{split} {value:.3f}" for split, value in errors.items() if value is not None)
    console.print(f"linear regression, sideslip RMSE in degrees: {shown}")
    console.print(f"coefficients in {result.regression_file}", soft_wrap=True)


def render_tuning(result: TuneResult, console: Console) -> None:
    """Print the best noise of each estimator and its sideslip error; all had the same drives and trials."""
    from pdhef_logtool.learning.noise.search import FACTORS

    errors = (">\nobjective °", ">\nmedian °", ">\npooled °", ">car's own\nobjective °")
    tuned = table("\nestimator", *(f">{f.name}\n{f.unit}" for f in FACTORS), *errors)
    for t in result.tuned:
        best, before = t.best.score, None if t.before is None else t.before.objective_deg
        scores = (best.objective_deg, best.median_deg, best.pooled_deg, before)
        tuned.add_row(t.name, *(f"{v:g}" for v in t.best.values), *(cell(v, digits=4) for v in scores))
    console.print("sideslip RMSE over drives")
    console.print(tuned)
    trials = len(result.tuned[0].trials)
    console.print(f"{len(result.drives)} drives, {trials} trials of each estimator")
    console.print(f"car in {result.car}", soft_wrap=True)


def render_trust(result: TrustResult, console: Console) -> None:
    """Print the sideslip error at each trust, its difference to trust 0 with bounds, and the cap with its reason."""
    from pdhef_logtool.learning.evidence.trust import TRUSTS

    d = result.decision
    errors = table(">\ntrust", ">sideslip\nRMSE °", ">squared error less\nthat at 0, deg²", ">\n95 % bounds")
    for trust, rmse, b in zip(TRUSTS, d.rmse_deg, d.against_zero, strict=True):
        known = trust > 0.0 and not math.isnan(b.low_deg2)
        bounds = f"{b.low_deg2:.4f} to {b.high_deg2:.4f}" if known else "-"
        errors.add_row(f"{trust:g}", f"{rmse:.4f}", f"{b.value_deg2:.4f}" if trust else "-", bounds)
    console.print(errors)
    seconds = f"{d.scored_s:.0f} s scored, {d.excited_s:.0f} s of them excited"
    console.print(f"{len(result.drives)} drives, {d.blocks} blocks, {seconds}")
    console.print(f"trust cap {d.cap:g}: {d.reason}")
    console.print(f"car in {result.car}", soft_wrap=True)


def render_calibration(result: CalibrateResult, console: Console) -> None:
    """Print how the 95 % intervals of sideslip stand before and after, on drives that were not fitted to."""
    widths = (">covered %\nbefore", ">\nafter", ">width / normal\nbefore", ">\nafter")
    intervals = table("\nestimator", "\ncar", "grip\nuse", ">\ndrives", ">RMSE\n°", *widths)
    for entry in result.intervals.entries:
        for c in entry.coverage:
            covered = (f"{100.0 * c[key]:.1f}" for key in ("covered_before", "covered_after"))
            width = (f"{c[key]:.2f}" for key in ("width_before", "width_after"))
            given = "made wrong" if c["wrong_vehicle"] else "as given"
            rmse = cell(c["rmse_rad"], math.degrees(1.0), 4)
            intervals.add_row(entry.estimator, given, c["bin"], str(c["drives"]), rmse, *covered, *width)
    console.print("95 % intervals of sideslip, each drive judged by a fit without it; width over 3.92 x RMSE")
    console.print(intervals)
    console.print(f"{len(result.intervals.drives)} drives; intervals in {result.file}", soft_wrap=True)


def render_course(result: CourseResult, console: Console) -> None:
    """Print what each step came to, the part that was scored once, and what more driving would pay."""
    steps = table("step", "came to", ">held out °\nbefore", ">\nafter", "by")
    for s in result.steps:
        before, after = ("-" if x is None else f"{x[1]:.3f}" for x in (s.before, s.after))
        steps.add_row(s.name, s.status, before, after, "" if s.after is None else s.after[0])
    console.print(steps)
    console.print()
    scores = table("estimator", ">RMSE °", ">95 % interval", ">inside 95 %")
    for line in result.last:
        if "skipped" in line:
            scores.add_row(line["name"], "-", "-", "-")
            continue
        value, low, high = line["rmse_deg"]
        interval = "-" if low is None else f"{low:.3f} to {high:.3f}"
        scores.add_row(line["name"], cell(value, digits=3), interval, cell(line["covered"], 100.0, 0))
    if result.last:
        console.print("sideslip RMSE on the last part, scored once")
        console.print(scores)
    for text in result.more:
        console.print(f"  {text}")
    console.print(f"car in {result.car}, what each decision rests on in learn.md there", soft_wrap=True)


def render_retraining(result: RetrainResult, console: Console) -> None:
    """Print what the candidate learnt on, how it compares on the drives of the gate, and the verdict."""
    from pdhef_logtool.results.gate import Figure

    found = result.document
    _print_cells(found["cells"], None, console)
    console.print(", ".join(f"{role}: {count}" for role, count in found["drives_by_role"].items()) + " drives")
    shown = table("figure", ">drives", ">median change", ">95 % interval", "verdict", fold=1)
    for one in found["comparison"]["figures"]:
        figure = Figure(one["signal"], one["metric"], one["segment"], one["estimator"])
        median, low, high = ("-" if one[k] is None else f"{100.0 * one[k]:+.1f} %" for k in ("median", "low", "high"))
        shown.add_row(figure.label, str(one["drives"]), median, f"{low} to {high}", one["verdict"])
    console.print("the candidate against the car as it is, on the drives of the gate")
    console.print(shown)
    if found["judged"] > 1:
        console.print(f"{found['judged']} candidates were judged on these drives: the more there are, the less it says")
    for reason in found["reasons"]:
        console.print(f"rejected: {reason}")
    console.print(f"{'accepted' if result.accepted else 'rejected'}: {result.folder}", soft_wrap=True)
