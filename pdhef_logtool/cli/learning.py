"""``pdhef learn``, ``extract``, ``train``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from pdhef_logtool.cli import console, learning_tables, options

if TYPE_CHECKING:
    from pdhef_logtool.runs.config import RunConfig


@options.command(shared="mapping", car="Car to start from (mass, geometry, sensor noise, priors)")
def learn(
    *,
    logs: options.TruthLogs,
    output: Annotated[
        Path, Option("--output", "-o", metavar="CAR", help="Folder of the car to write; may equal --car.")
    ],
    config: RunConfig,
    split: Annotated[
        str | None,
        Option(help="Only drives of this split of a simulated set; any: also of splits that are refused by default."),
    ] = None,
) -> None:
    """Learn a car from its drives: parameters for later drives and, with ground truth, a residual."""
    from pdhef_logtool.learning.drives import LearnSettings
    from pdhef_logtool.learning.learn import learn as learn_car

    settings = LearnSettings(config=config, split=split)
    with console.reporter() as reporter:
        result = learn_car(logs, output, settings, reporter=reporter)
    console.finish(result, learning_tables.render_learning)


@options.command(shared="mapping", car="Nominal car (default: from the manifest of a simulated set)")
def extract(
    *,
    logs: options.TruthLogs,
    output: Annotated[Path, Option("--output", "-o", help="Folder for the dataset.")],
    config: RunConfig,
    split: Annotated[str | None, Option(help="Split of all drives of this command: train, validation or test.")] = None,
    model: Annotated[
        str, Option("--filter", help="Filter of the residuals: physics, or phy-ukf for train --paper.")
    ] = "physics",
    where: Annotated[str | None, Option(metavar="EXPR", help="Condition on the rows to keep.")] = None,
    jobs: options.Jobs = 1,
    resume: Annotated[bool, Option("--resume", help="Keep drives with unchanged log and settings.")] = False,
) -> None:
    """Write the residual dataset for train: the accelerations that the physics do not explain."""
    from pdhef_logtool.learning.network.extract_command import ExtractSettings
    from pdhef_logtool.learning.network.extract_command import extract as write_residuals

    settings = ExtractSettings(config, split=split, model=model, where=where)
    with console.reporter() as reporter:
        result = write_residuals(logs, output, settings, jobs=jobs, resume=resume, reporter=reporter)
    console.finish(result, learning_tables.render_extraction)


@options.command()
def train(
    *,
    dataset: Annotated[Path, Argument(metavar="DATASET", help="Dataset folder of pdhef extract.")],
    output: Annotated[Path, Option("--output", "-o", help="Folder for the model bundle.")],
    init: Annotated[Path | None, Option(help="Model bundle to fine-tune, or default.")] = None,
    paper: Annotated[bool, Option("--paper", help="Use the hyperparameters of Table 1 of the paper.")] = False,
    seed: Annotated[int, Option(help="Seed of initial weights, sample order and dropout.")] = 0,
    epochs: Annotated[int | None, Option(help="Number of epochs. Default: from the hyperparameters.")] = None,
    device: Annotated[str, Option(help="PyTorch device: cpu or cuda.")] = "cpu",
) -> None:
    """Train the residual network on a dataset of extract."""
    from pdhef_logtool.learning.network.train_command import run_training

    with console.reporter() as reporter:
        result = run_training(
            dataset, output, init=init, paper=paper, seed=seed, epochs=epochs, device=device, progress=reporter.progress
        )
    console.finish(result, learning_tables.render_training)
