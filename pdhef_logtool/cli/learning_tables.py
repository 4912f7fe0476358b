"""Output of the learning commands on the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pdhef_logtool.cli.console import cell, table, three_lines

if TYPE_CHECKING:
    from rich.console import Console

    from pdhef_logtool.learning.learn import LearnResult
    from pdhef_logtool.learning.network.baselines import BaselinesResult
    from pdhef_logtool.learning.network.extract_command import ExtractResult
    from pdhef_logtool.learning.network.train_command import TrainResult


#: Above this number of drives, only the drives without data are listed.
MOST_DRIVES = 40


def render_learning(result: LearnResult, console: Console) -> None:
    """Print result, assumptions and next step, and the tables of teaching."""
    used, left_out = len(result.drives), len(result.records) - len(result.drives)
    left = f", {left_out} left out" if left_out else ""
    head = three_lines(
        result.text,
        f"{used} drive{'s' * (used != 1)}{left}; decisions by held-out driving",
        f"pdhef run LOG --car {result.car} -o OUT",
    )
    console.print(head)
    if "rungs" in result.figures:
        console.print()
        _teaching(result.figures, console)


def _teaching(figures: Mapping[str, Any], console: Console) -> None:
    """Print the tested residual models, the improvement by teaching, and the recommended drives."""
    rungs = table("residual model", ">RMSE °, held-out\nblocks", ">difference °²", ">± 1 se", "outcome")
    for t in figures["rungs"]:
        outcome = "" if not t["against"] else "better" if t["taken"] else "not better"
        outcome = "used" if t["rung"] == figures["rung"] else outcome
        against = [cell(t[k] if t["against"] else None, digits=4) for k in ("difference_deg2", "standard_error_deg2")]
        rungs.add_row(t["rung"], cell(t["rmse_deg"], digits=3), *against, outcome)
    console.print(rungs)
    console.print()
    drives = table("drive", ">seconds", ">physics °", ">with residual °", "calibration", fold=4)
    for d in figures["drives"]:
        errors = (cell(d[key], digits=3) for key in ("physics_deg", "corrected_deg"))
        drives.add_row(d["name"], cell(d["seconds"], digits=0), *errors, d["calibration"])
    console.print(drives)
    for p in figures["priors"]:
        console.print(
            f"  tyre prior at {p['ay_m_s2']:.1f} m/s²: helps with a probability of {p['support']:.2f} (0: unused)"
        )


def render_extraction(result: ExtractResult, console: Console) -> None:
    """Print the data of each drive and of the dataset."""
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
        what = "these contain no new data" if shown else "all contain data"
        console.print(f"{len(result.results)} drives, listed in manifest.json; {what}")
    if shown:
        console.print(drives)
    splits = result.manifest["splits"].items()
    split_texts = (f"{name}: {s['drives']} drives, {s['usable_rows']} usable rows" for name, s in splits)
    console.print(", ".join(split_texts))
    console.print(f"dataset in {result.output}", soft_wrap=True)


def render_training(result: TrainResult, console: Console) -> None:
    """Print the losses of a training, relative to the mean square of the target."""
    best = min(result.history, key=lambda e: e.validation_loss)
    seconds = sum(e.seconds for e in result.history)
    losses = f"training {best.train_loss:.4f}, validation {best.validation_loss:.4f} of the target's mean square"
    console.print(f"{len(result.history)} epochs in {seconds:.0f} s; best epoch {best.epoch}: {losses}")
    if result.test_loss is not None:
        console.print(f"test drives: {result.test_loss:.4f}")
    console.print(f"model in {result.model} ({result.bundle.sha256[:12]})", soft_wrap=True)


def render_baselines(result: BaselinesResult, console: Console) -> None:
    """Print the errors of both baselines."""
    render_training(result.pure_lstm, console)
    errors = result.regression.provenance["sideslip_rmse_deg"]
    shown = ", ".join(f"{split} {value:.3f}" for split, value in errors.items() if value is not None)
    console.print(f"linear regression, sideslip RMSE in degrees: {shown}")
    console.print(f"coefficients in {result.regression_file}", soft_wrap=True)
