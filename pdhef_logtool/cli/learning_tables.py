"""Output of the learning commands on the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pdhef_logtool.cli.console import cell, table, three_lines

if TYPE_CHECKING:
    from rich.console import Console

    from pdhef_logtool.learning.learn import LearnResult
    from pdhef_logtool.learning.network.extract_command import ExtractResult
    from pdhef_logtool.learning.network.train_command import TrainResult


def render_learning(result: LearnResult, console: Console) -> None:
    """Print result, assumptions and next step, and the table of teaching."""
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
    """Print the tested residual models."""
    rungs = table("residual model", ">RMSE °, held-out\nblocks", ">difference °²", ">± 1 se", "outcome")
    for t in figures["rungs"]:
        outcome = "" if not t["against"] else "better" if t["taken"] else "not better"
        outcome = "used" if t["rung"] == figures["rung"] else outcome
        against = [cell(t[k] if t["against"] else None, digits=4) for k in ("difference_deg2", "standard_error_deg2")]
        rungs.add_row(t["rung"], cell(t["rmse_deg"], digits=3), *against, outcome)
    console.print(rungs)


def render_extraction(result: ExtractResult, console: Console) -> None:
    """Print the data of the dataset by split; the manifest lists the drives."""
    splits = table("split", ">drives", ">usable rows", ">rows")
    for name, of in result.manifest["splits"].items():
        splits.add_row(name, *(str(of[key]) for key in ("drives", "usable_rows", "rows")))
    console.print(splits)
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
