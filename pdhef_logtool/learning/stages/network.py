"""Stage ``network``: the network trained on drives with ground truth, stopped by others, and its residual gain."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from pdhef_logtool.car.car import Car
from pdhef_logtool.learning.drives import NETWORK
from pdhef_logtool.learning.split import divided
from pdhef_logtool.learning.stages.gain import find_gain
from pdhef_logtool.learning.stages.task import StageOutput, Task
from pdhef_logtool.records.errors import EstimatorError
from pdhef_logtool.residual_model.bundle import NO_MODEL

#: Fine-tuning of a trained network; a network from random weights is a small one, for a minute or two of driving.
GENTLY: dict[str, Any] = {"learning_rate": 5e-4, "epochs": 15}
SMALL: dict[str, Any] = {"hidden": 32, "layers": 1}
#: Least driving for training, and the share of it that the network learns from; the rest stops the training.
LEAST_TRAINING_S, TRAIN_SHARE = 100.0, 0.8


def train_network(task: Task) -> StageOutput:
    """Train the network of the car, or a new small one, and find its residual gain.

    Raises
    ------
    EstimatorError
        There is too little driving, or no network is wanted.
    """
    from pdhef_logtool.learning.network.dataset import read_dataset
    from pdhef_logtool.learning.network.extract_command import ExtractSettings, extract
    from pdhef_logtool.learning.network.train_command import make_recipe, train_on

    part, init = task.split.network_part(), task.car.network
    if str(task.settings.config.network) == NO_MODEL:
        raise EstimatorError(expected="a network", got=NO_MODEL, where="network")
    seconds = task.split.seconds(part)
    learns, stops = divided(task.split.usable(part), TRAIN_SHARE)
    if seconds < LEAST_TRAINING_S or not stops:
        raise EstimatorError(
            expected=f"at least {LEAST_TRAINING_S:g} s of usable driving to train on",
            got=f"{seconds:.0f} s",
            where="network",
        )
    config = replace(task.settings.config, network=None)
    work, sets = task.work / "training", []
    for name, logs in (("train", learns), ("validation", stops)):
        extract(logs, work / name, ExtractSettings(config, split=name))
        sets.append(read_dataset(work / name))
    both = replace(sets[0], drives=tuple(d for s in sets for d in s.drives))
    recipe = replace(make_recipe(paper=False, seed=0, epochs=None, device="cpu"), **(SMALL if init is None else GENTLY))
    network = work / "model"
    train_on(both, network, recipe, init=init, progress=task.reporter.progress)
    settings = replace(task.settings, config=replace(config, network=network))
    output = find_gain(replace(task, car=Car.load(config.car, network=network), settings=settings))
    return replace(output, change=replace(output.change, command=f"learn --stages {NETWORK}"))
