"""``pdhef learn``, ``extract``, ``train``."""

from pathlib import Path
from typing import TYPE_CHECKING

from pdhef_logtool.cli import console, options

if TYPE_CHECKING:
    from pdhef_logtool.runs.config import RunConfig


@options.command()
def learn(logs: list[str], *, output: Path, config: "RunConfig", split: str | None = None) -> None:
    """Learn a car from its drives: parameters for later drives and, with ground truth, a residual."""
    from pdhef_logtool.learning.drives import LearnSettings
    from pdhef_logtool.learning.learn import learn as learn_car

    settings = LearnSettings(config=config, split=split)
    with console.reporter() as reporter:
        result = learn_car(logs, output, settings, reporter=reporter)
    console.finish(result, "learning")


@options.command()
def extract(
    logs: list[str],
    *,
    output: Path,
    config: "RunConfig",
    split: str | None = None,
    model: str = "physics",
    where: str | None = None,
    jobs: int = 1,
    resume: bool = False,
) -> None:
    """Write the residual dataset for train: the accelerations that the physics do not explain."""
    from pdhef_logtool.learning.network.extract_command import ExtractSettings, extract as write_residuals

    settings = ExtractSettings(config, split=split, model=model, where=where)
    with console.reporter() as reporter:
        result = write_residuals(logs, output, settings, jobs=jobs, resume=resume, reporter=reporter)
    console.finish(result, "extraction")


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
    console.finish(result, "training")
