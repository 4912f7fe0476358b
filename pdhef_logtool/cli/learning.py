"""``pdhef learn``, ``extract``, ``train``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pdhef_logtool.cli import console, options
from pdhef_logtool.cli.console import cell, table, three_lines

if TYPE_CHECKING:
    from rich.console import Console

    from pdhef_logtool.learning.learn import LearnResult
    from pdhef_logtool.learning.network.extract_command import ExtractResult
    from pdhef_logtool.learning.network.train_command import TrainResult
    from pdhef_logtool.runs.config import RunConfig


@options.command()
def learn(logs: list[str], *, output: Path, config: RunConfig, split: str | None = None) -> None:
    """Learn a car from its drives: parameters for later drives and, with ground truth, a residual."""
    from pdhef_logtool.learning.drives import LearnSettings
    from pdhef_logtool.learning.learn import learn as learn_car

    settings = LearnSettings(config=config, split=split)
    with console.reporter() as reporter:
        result = learn_car(logs, output, settings, reporter=reporter)
    console.finish(result, render_learning)


@options.command()
def extract(
    logs: list[str],
    *,
    output: Path,
    config: RunConfig,
    split: str | None = None,
    model: str = "physics",
    where: str | None = None,
    jobs: int = 1,
    resume: bool = False,
) -> None:
    """Write the residual dataset for train: the accelerations that the physics do not explain."""
    from pdhef_logtool.learning.network.extract_command import ExtractSettings
    from pdhef_logtool.learning.network.extract_command import extract as write_residuals

    settings = ExtractSettings(config, split=split, model=model, where=where)
    with console.reporter() as reporter:
        result = write_residuals(logs, output, settings, jobs=jobs, resume=resume, reporter=reporter)
    console.finish(result, render_extraction)


@options.command()
def train(
    dataset: Path,
    *,
    output: Path,
    init: Path | None = None,
    paper: bool = False,
    seed: int = 0,
    epochs: int | None = None,
    device: str = "cpu",
) -> None:
    """Train the residual network on a dataset of extract."""
    from pdhef_logtool.learning.network.train_command import run_training

    with console.reporter() as reporter:
        result = run_training(
            dataset, output, init=init, paper=paper, seed=seed, epochs=epochs, device=device, progress=reporter.progress
        )
    console.finish(result, render_training)


def render_learning(result: LearnResult, console: Console) -> None:
    """Print result, assumptions and next step, and the table of teaching."""
    left_out = sum(bool(record.left_out) for record in result.records)
    used = len(result.records) - left_out
    left = f", {left_out} left out" if left_out else ""
    head = three_lines(
        result.text,
        f"{used} drive{'s' * (used != 1)}{left}; decisions by held-out driving",
        f"pdhef run LOG --car {result.car} -o OUT",
    )
    console.print(head)
    if "rungs" in result.figures:
        console.print()
        rungs = table("residual model", ">RMSE °, held-out\nblocks", ">difference °²", ">± 1 se", "outcome")
        for t in result.figures["rungs"]:
            outcome = "" if not t["against"] else "better" if t["taken"] else "not better"
            outcome = "used" if t["rung"] == result.figures["rung"] else outcome
            of_rung = (t[k] if t["against"] else None for k in ("difference_deg2", "standard_error_deg2"))
            rungs.add_row(t["rung"], cell(t["rmse_deg"], digits=3), *(cell(x, digits=4) for x in of_rung), outcome)
        console.print(rungs)


def render_extraction(result: ExtractResult, console: Console) -> None:
    """Print the data of the dataset by split; the manifest lists the drives."""
    keys, splits = ("drives", "usable_rows", "rows"), result.manifest["splits"].items()
    rows = ((name, *(str(of[key]) for key in keys)) for name, of in splits)
    console.print(table("split", ">drives", ">usable rows", ">rows", rows=rows))
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
