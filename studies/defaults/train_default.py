"""Regenerate the shipped car: simulate, fit, extract, train, tune.

    python -m studies.defaults.train_default [-o FOLDER] [--work out/train-default] [--steps STEP ...]

Short drives of one simulated car with its correct vehicle file and the true friction. ``physics`` and its noise are
fitted on five minutes of other drives (:mod:`studies.defaults.fit_physics`); the residual network learns the model
residual. The direct network and the regression use the same drives, with the nominal model; the paper's network uses
the drives of :mod:`studies.defaults.paper_drives`. Filter noise of all tuned estimators is chosen on validation drives
in one search. Existing logs with unchanged settings are kept.
"""

import os
import subprocess
import sys
import time
from argparse import Namespace
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from pdhef_logtool.car.car import FIT_FILE, NETWORK_FOLDER, SHIPPED_CARS, VEHICLE_FILE, read_fit
from pdhef_logtool.car.toml_files import part_toml, read_vehicle_file
from pdhef_logtool.learning.drives import LearnSettings, chosen_logs
from pdhef_logtool.learning.network.dataset import read_dataset
from pdhef_logtool.learning.network.train_command import PAPER_RECIPE, Recipe, train_on
from pdhef_logtool.records.errors import EXIT_OK, EXIT_PARTIAL
from pdhef_logtool.residual_model.bundle import MODELS, NOMINAL_MODEL, PAPER_FOLDER, PHYSICS_MODEL
from pdhef_logtool.runs.config import RunConfig
from studies.defaults import fit_physics, paper_drives
from studies.defaults.noise import tune
from studies.defaults.train_baselines import train_baselines
from studies.pages import SAMPLE_VEHICLE, options
from truthsim.suite import write_suite

HOME = SHIPPED_CARS["saloon"]
#: Seed of the drives. The condition table, the paper and the tests use other seeds.
SEED, DRIVES = 1000, 800
#: Residual gain of the car: of 0, 0.25, 0.5, 0.75 and 1 the one with the lowest sideslip RMSE on 200 other drives.
GAIN = 0.75
EPOCHS = 66
#: Folders of the paper's network.
PAPER_DRIVES, PAPER_RESIDUALS = "paper", "paper-residuals"
#: An epoch of the paper's network is one batch of windows of 6.4 s, so that 200 epochs take less than half an hour.
PAPER_WINDOWS: dict[str, Any] = {"piece_steps": 640, "pieces_per_epoch": 64, "chunk_steps": 25}
TRIALS = 64


def simulate(t: Namespace) -> None:
    """Write the vehicle file and the drives."""
    t.work.mkdir(parents=True, exist_ok=True)
    t.output.mkdir(parents=True, exist_ok=True)
    text = part_toml(read_vehicle_file(SAMPLE_VEHICLE).vehicle, "Written by python -m studies.defaults.train_default.")
    (t.output / VEHICLE_FILE).write_text(f"{text}\n[network]\ngain = {GAIN}\n", encoding="utf-8")
    write_suite(t.work / "one_car", count=DRIVES, seed=SEED, processes=t.jobs)
    paper_drives.write_drives(t.work / PAPER_DRIVES, processes=t.jobs)


def fit(t: Namespace) -> None:
    """Fit ``physics``; the network learns its residual."""
    fit_physics.main(["-o", str(t.output), "--work", str(t.work / "fit"), "--jobs", str(t.jobs)])


def noise(t: Namespace) -> None:
    """Tune the noise of all tuned filters alike, on validation drives."""
    config = RunConfig(car=t.output, mapping=fit_physics.MAPPING)
    logs = chosen_logs([str(t.work / "one_car")], LearnSettings(config=config, split="validation"))
    fitted = read_fit(t.output / FIT_FILE).model_copy(update={"filter": tune(logs, config, TRIALS)})
    (t.output / FIT_FILE).write_text(part_toml(fitted, fit_physics.HEAD), encoding="utf-8")


def extract(t: Namespace) -> None:
    """Extract residuals: the paper's network and the baselines have the nominal model, as the paper has it."""
    sets = [(t.work / "one_car", t.work / model, model) for model in MODELS]
    for drives, residuals, model in (*sets, (t.work / PAPER_DRIVES, t.work / PAPER_RESIDUALS, NOMINAL_MODEL)):
        given = ("--car", t.output, "--mapping", fit_physics.MAPPING, "--filter", model, "--jobs", t.jobs, "--resume")
        words = ("pdhef_logtool", "extract", drives, *given, "-o", residuals)
        ended = subprocess.run([sys.executable, "-m", *map(str, words)], check=False)
        if ended.returncode not in (EXIT_OK, EXIT_PARTIAL):
            raise SystemExit(f"failed: {words}")


def train(t: Namespace) -> None:
    """Train the residual network and the baselines."""
    train_baselines(read_dataset(t.work / NOMINAL_MODEL, NOMINAL_MODEL), t.output / NETWORK_FOLDER)
    _train(t, PHYSICS_MODEL, PHYSICS_MODEL, "", Recipe(epochs=EPOCHS))


def paper(t: Namespace) -> None:
    """Train the paper's network by Table 1."""
    _train(t, PAPER_RESIDUALS, NOMINAL_MODEL, PAPER_FOLDER, replace(PAPER_RECIPE, **PAPER_WINDOWS))


def _train(t: Namespace, residuals: str, model: str, folder: str, recipe: Recipe) -> None:
    """Train a network of the car on residuals of a model."""
    network = t.output / NETWORK_FOLDER / folder
    train_on(read_dataset(t.work / residuals, model), network, recipe, progress=lambda text, _: print(text, flush=True))


STEPS: dict[str, Callable[[Namespace], None]] = {
    step.__name__: step for step in (simulate, fit, noise, extract, train, paper)
}


def main() -> None:
    """Train and write the car."""
    parser = options("defaults.train_default", __doc__)
    parser.add_argument("-o", "--output", type=Path, default=HOME, help="the car's folder")
    parser.add_argument("--work", type=Path, default=Path("out/train-default"), help="logs and dataset; kept")
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--steps", nargs="+", choices=STEPS, default=list(STEPS), help="default: all")
    given = parser.parse_args()
    torch.set_num_threads(1)  # small networks: a second thread gains nothing
    began = time.monotonic()
    for name, step in STEPS.items():
        if name in given.steps:
            print(f"[{(time.monotonic() - began) / 60.0:5.1f} min] {name}: {step.__doc__}", flush=True)
            step(given)


if __name__ == "__main__":
    main()
