"""``pdhef identify``, ``extract``, ``train``, ``tune``, ``trust``, ``calibrate``, ``learn``, ``retrain``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from pdhef_logtool.cli import console, learning_tables, options
from pdhef_logtool.records.errors import UsageError

if TYPE_CHECKING:
    from pdhef_logtool.runs.config import RunConfig

commands = typer.Typer()


@options.command(
    commands,
    "pdhef identify drives/ --car guess.toml -o mycar",
    "pdhef identify drive.mcap --car guess.toml -o mycar --end 150 --holdout 0",
    "pdhef identify logs/ --car guess.toml -o mycar --without-truth",
    shared="cache",
    car="Where the fit starts (mass, geometry, sensor noise, priors)",
)
def identify(
    logs: options.TruthLogs,
    output: options.CarOutput,
    config: RunConfig,
    holdout: Annotated[float, Option(help="Share at the end of each slice that is only scored, once.")] = 0.25,
    parts: Annotated[
        str, Option(help="Of the model of physics: auto (by held-out driving), static, or names with commas.")
    ] = "auto",
    without_truth: Annotated[
        bool, Option("--without-truth", help="From the sensors of several logs alone: no truth is looked at.")
    ] = False,
    as_json: options.JsonFlag = False,
) -> None:
    """Fit a car's tyres, steering and biases to its drives. Roll gradient and filter noise are fitted too."""
    if without_truth:
        from pdhef_logtool.learning.car.without_truth_command import identify_without_truth

        with console.progress() as bar:
            found = identify_without_truth(logs, output, config, progress=bar, warn=console.warn)
        console.finish(found, learning_tables.render_without_truth, as_json)
    from pdhef_logtool.learning.car.identify_command import identify as fit
    from pdhef_logtool.learning.car.physics_fit import physics_parts

    with console.progress() as bar:
        result = fit(logs, output, config, holdout=holdout, parts=physics_parts(parts), progress=bar, warn=console.warn)
    console.finish(result, learning_tables.render_identification, as_json)


@options.command(
    commands,
    "pdhef extract logs/ -o residuals --car mycar --jobs 2",
    "pdhef extract drive.mcap -o residuals --car mycar --prefer-truth rtk \\",
    "  --truth-smoothing 0.15",
    "pdhef extract 'held_out/*.mcap' -o residuals_test --split test --resume",
    'pdhef extract logs/ -o residuals --where "vx_km_h > 30" --per-cell 600',
    notes="Drives are split 70/15/15 by a hash of their content and --seed, unless the manifest of a simulated set "
    "beside them has a split, or --split puts all of them into one. Of drives with the same signals one is taken. "
    "Columns of --where: the features, truth_vx_m_s, truth_vy_m_s; _deg and _km_h in place of _rad and _m_s "
    "(docs/retrain.md).",
    shared="cache sensors friction",
    car="The nominal car (default: what a set's manifest names)",
)
def extract(
    *,
    logs: options.TruthLogs,
    output: Annotated[Path, Option("--output", "-o", help="Folder of the dataset.")],
    config: RunConfig,
    truth_smoothing: Annotated[str, Option(help="auto (by its noise), none, or seconds to either side.")] = "auto",
    split: Annotated[str | None, Option(help="train, validation or test for all drives of this command.")] = None,
    seed: Annotated[int, Option(help="Seed of the split by drive.")] = 0,
    vary: Annotated[float, Option(help="Make friction and car wrong by this spread for a part of the drives.")] = 0.0,
    model: Annotated[
        str, Option("--filter", help="Whose residuals: physics, or phy-ukf for --paper and --baselines.")
    ] = "physics",
    where: Annotated[str | None, Option(metavar="EXPR", help="Learn only from rows on which this holds.")] = None,
    per_cell: Annotated[
        float | None,
        Option(metavar="SECONDS", help="Of each cell of speed, |a_y| and friction at most so much, drawn by --seed."),
    ] = None,
    jobs: options.Jobs = 1,
    resume: Annotated[bool, Option("--resume", help="Keep drives whose log and settings are as they were.")] = False,
    as_json: options.JsonFlag = False,
) -> None:
    """Write the residual dataset that train learns from. A residual is what a car's physics leave unexplained."""
    from pdhef_logtool.learning.network.extract_command import ExtractSettings
    from pdhef_logtool.learning.network.extract_command import extract as write_residuals

    settings = ExtractSettings(
        config,
        truth_smoothing=truth_smoothing,
        split=split,
        seed=seed,
        vary=vary,
        model=model,
        where=where,
        per_cell_s=per_cell,
    )
    with console.progress() as bar:
        result = write_residuals(logs, output, settings, jobs=jobs, resume=resume, progress=bar, warn=console.warn)
    console.finish(result, learning_tables.render_extraction, as_json)


@options.command(
    commands,
    "pdhef train residuals/ -o model",
    "pdhef train mycar/ -o mycar_model --init model --epochs 10",
    "pdhef train residuals/ -o model --baselines",
    notes="An interrupted training goes on from its last whole epoch when the same command is given again.",
)
def train(
    *,
    dataset: Annotated[Path, Argument(metavar="DATASET", help="Folder that pdhef extract wrote.")],
    output: Annotated[Path, Option("--output", "-o", help="Folder of the model bundle to write.")],
    init: Annotated[Path | None, Option(help="Model bundle to fine-tune, or many-cars, or default.")] = None,
    baselines: Annotated[bool, Option("--baselines", help="Train pure-lstm and linear-regression instead.")] = False,
    paper: Annotated[bool, Option("--paper", help="The paper's Table 1 instead of the default recipe.")] = False,
    seed: Annotated[int, Option(help="Seed of weights, order and dropout.")] = 0,
    epochs: Annotated[int | None, Option(help="Default: the recipe's.")] = None,
    device: Annotated[str, Option(help="PyTorch device: cpu or cuda.")] = "cpu",
    as_json: options.JsonFlag = False,
) -> None:
    """Train the residual network on a dataset of extract. Writes weights, loss history and plot."""
    from pdhef_logtool.learning.network.train_command import run_training

    if baselines:
        from pdhef_logtool.learning.network.baselines import run_baselines

        if init is not None:
            raise UsageError(expected="--baselines or --init", got="both", where="train")
        with console.progress() as bar:
            both = run_baselines(dataset, output, paper=paper, seed=seed, epochs=epochs, device=device, progress=bar)
        console.finish(both, learning_tables.render_baselines, as_json)
    with console.progress() as bar:
        result = run_training(
            dataset, output, init=init, paper=paper, seed=seed, epochs=epochs, device=device, progress=bar
        )
    console.finish(result, learning_tables.render_training, as_json)


@options.command(
    commands,
    "pdhef tune logs/ --split validation --car mycar -o mycar --jobs 2",
    "pdhef tune logs/ --split validation --car mycar -o mycar --trials 256",
    notes="Every estimator gets the same search space, drives and number of trials. All trials and a plot of them "
    "are kept with the car. Drives that a set's manifest marks test or extrapolation are refused (docs/learn.md).",
    shared="cache sensors friction network model signal_map",
    car="The car whose filter noise is tuned",
)
def tune(
    *,
    logs: options.TruthLogs,
    output: options.CarOutput,
    config: RunConfig,
    estimators: Annotated[
        str | None,
        Option(
            "--estimators",
            "-e",
            help="Out of phy-ukf-tuned, physics, pd-hef, pd-hef-smoothed. Default: the first two, and pd-hef "
            "where the car has a network of its own or --network names one.",
        ),
    ] = None,
    trials: Annotated[int, Option(help="Of each estimator.")] = 128,
    seed: Annotated[int, Option(help="Seed of the search.")] = 0,
    split: options.Split = None,
    any_split: options.AnySplit = False,
    jobs: options.Jobs = 1,
    as_json: options.JsonFlag = False,
) -> None:
    """Tune the noise of a car's filters for sideslip. All filters are searched alike."""
    from pdhef_logtool.learning.noise.tune_command import TuneSettings
    from pdhef_logtool.learning.noise.tune_command import tune as search_noise

    names = None if estimators is None else options.split_names(estimators)
    settings = TuneSettings(config=config, names=names, trials=trials, seed=seed, split=split, any_split=any_split)
    with console.progress() as bar:
        result = search_noise(logs, output, settings, jobs=jobs, progress=bar, warn=console.warn)
    console.finish(result, learning_tables.render_tuning, as_json)


@options.command(
    commands,
    "pdhef trust drive.mcap --car mycar --start 155 -o mycar",
    "pdhef trust logs/ --split test --car mycar -o mycar",
    notes="Give driving that neither the network nor the car was fitted to; drives that a manifest marks train or "
    "validation are refused. The filter runs at trust 0, 0.25, 0.5, 0.75 and 1. The cap is 1 only if a bootstrap of "
    "blocks confirms the gain, at most 0.5 on a mean gain, else 0 (docs/learn.md). All figures are kept with the car.",
    shared="cache sensors friction network model",
    car="The car of the drives",
)
def trust(
    logs: options.TruthLogs,
    output: options.CarOutput,
    config: RunConfig,
    split: options.Split = None,
    any_split: options.AnySplit = False,
    seed: Annotated[int, Option(help="Seed of the bootstrap.")] = 0,
    as_json: options.JsonFlag = False,
) -> None:
    """Find how far the network may be trusted on a car. Without truth in the drives it cannot be told."""
    from pdhef_logtool.learning.drives import LearnSettings
    from pdhef_logtool.learning.evidence.trust_command import trust as try_network

    settings = LearnSettings(config=config, seed=seed, split=split, any_split=any_split)
    with console.progress() as bar:
        result = try_network(logs, output, settings, progress=bar, warn=console.warn)
    console.finish(result, learning_tables.render_trust, as_json)


@options.command(
    commands,
    "pdhef calibrate logs/ --split validation --car mycar -o mycar",
    "pdhef calibrate logs/ --car mycar --vary 0 -o mycar",
    notes="Give drives of many kinds that neither network nor filter noise was fitted to; drives that a set's "
    "manifest marks test or extrapolation are refused (docs/learn.md).",
    shared="estimators cache sensors friction network model",
    car="The car that the estimators run with",
)
def calibrate(
    logs: options.TruthLogs,
    output: options.CarOutput,
    config: RunConfig,
    vary: Annotated[float, Option(help="Run each drive twice more with friction and car wrong by this spread.")] = 0.1,
    seed: Annotated[int, Option(help="Seed of --vary.")] = 0,
    split: options.Split = None,
    any_split: options.AnySplit = False,
    as_json: options.JsonFlag = False,
) -> None:
    """Fit the 95 % intervals of a car's estimators. Each regime of driving has its own."""
    from pdhef_logtool.learning.evidence.calibrate_command import CalibrateSettings
    from pdhef_logtool.learning.evidence.calibrate_command import calibrate as fit_intervals

    settings = CalibrateSettings(config=config, spread=vary, seed=seed, split=split, any_split=any_split)
    with console.progress() as bar:
        result = fit_intervals(logs, output, settings, progress=bar, warn=console.warn)
    console.finish(result, learning_tables.render_calibration, as_json)


@options.command(
    commands,
    "pdhef learn drives/ --car guess.toml -o mycar",
    "pdhef learn drive.mcap --car guess.toml -o mycar --end 150 --holdout 0",
    notes="The drives are cut in parts that do not mix. Physics, noise, network with its trust, and intervals are "
    "learnt one after the other; a step that makes the error on held-out driving worse is undone. The end of a drive "
    "(or some drives of many) is scored once, against all baselines: learn.md in the car's folder (docs/learn.md). The "
    "same command again goes on where it was interrupted.",
    shared="cache sensors friction network",
    car="Where it starts (mass, geometry, sensor noise, priors)",
)
def learn(
    *,
    logs: options.TruthLogs,
    output: Annotated[Path, Option("--output", "-o", metavar="CAR", help="Folder of the car to write.")],
    config: RunConfig,
    holdout: Annotated[float, Option(help="Share of the driving that is only scored, once, at the end.")] = 0.15,
    trials: Annotated[int, Option(help="Of the search for the noise of physics.")] = 64,
    seed: Annotated[int, Option(help="Of the search, of bootstraps and of vehicles that are made wrong.")] = 0,
    split: options.Split = None,
    any_split: options.AnySplit = False,
    fresh: Annotated[bool, Option("--fresh", help="Forget what an earlier call with this output has found.")] = False,
    as_json: options.JsonFlag = False,
) -> None:
    """Teach a car all that drives with truth can. One command from a vehicle file to a proven car."""
    from pdhef_logtool.learning.learn.learn_command import CourseSettings
    from pdhef_logtool.learning.learn.learn_command import learn as teach

    settings = CourseSettings(
        config=config, holdout=holdout, trials=trials, seed=seed, split=split, any_split=any_split
    )
    with console.progress() as bar:
        result = teach(logs, output, settings, fresh=fresh, progress=bar, warn=console.warn, say=console.say)
    console.finish(result, learning_tables.render_course, as_json)


@options.command(
    commands,
    "pdhef retrain logs/ -o retrained --car mycar --jobs 2",
    "pdhef retrain logs/ -o retrained --car mycar --gate gate.toml --strict",
    "pdhef run new/ -o out --car retrained/accepted/0123456789ab/car",
    notes="Every drive has one part in it: it trains the network, stops the training, says how far the network may be "
    "followed, fits intervals, or decides at the end. Car and candidate run on the last ones, and pdhef compare says "
    "whether the candidate is worse: then it is kept under rejected/ with the reason, else under accepted/ "
    "(docs/retrain.md). The same command again does what is new and nothing else. Exit codes: 0 accepted, 3 accepted "
    "with drives left out, 4 rejected.",
    shared="cache sensors friction",
    car="The car whose network is trained on",
)
def retrain(
    *,
    logs: options.TruthLogs,
    output: Annotated[Path, Option("--output", "-o", metavar="DIR", help="Folder of stages and candidates.")],
    config: RunConfig,
    gate: Annotated[
        Path | None, Option(metavar="FILE", help="gate.toml of pdhef compare. Default: pd-hef at most 2 % worse.")
    ] = None,
    strict: Annotated[bool, Option("--strict", help="That nobody can tell closes the gate.")] = False,
    init: Annotated[
        Path | None, Option(help="Model bundle to begin with, many-cars, or none. Default: the car's, else many-cars.")
    ] = None,
    epochs: Annotated[int | None, Option(help="Default: 15, from nothing 30.")] = None,
    seed: Annotated[int, Option(help="Of who does what, of training and of bootstraps.")] = 0,
    jobs: options.Jobs = 1,
    as_json: options.JsonFlag = False,
) -> None:
    """Train a car's network on, and let a gate judge it. The drives of the gate are kept aside."""
    from pdhef_logtool.learning.retrain.retrain_command import DEFAULT_GATE, RetrainSettings
    from pdhef_logtool.learning.retrain.retrain_command import retrain as train_again
    from pdhef_logtool.results.gate import load_gate

    asked = DEFAULT_GATE if gate is None else load_gate(gate)
    settings = RetrainSettings(config=config, seed=seed, init=init, epochs=epochs, gate=asked, strict=strict)
    with console.progress() as bar:
        result = train_again(logs, output, settings, jobs=jobs, progress=bar, warn=console.warn, say=console.say)
    console.finish(result, learning_tables.render_retraining, as_json)
