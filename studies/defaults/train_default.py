"""Regenerate the shipped car: simulate, fit, extract, train, tune.

    python -m studies.defaults.train_default [--seed 0] [-o FOLDER] [--work out/train-default] [--steps STEP ...]

Short drives of one simulated car with its correct vehicle file and the true friction. ``physics`` and its noise are
fitted on five minutes of other drives (:mod:`studies.defaults.fit_physics`); the residual network learns the model
residual. The direct network and the regression use the same drives, with the nominal model; the paper's network uses
the drives of :mod:`studies.defaults.paper_drives`. Filter noise of all tuned estimators is chosen on validation drives
in one search. Seeds other than 0 train networks for spreads and take fit and noise of the shipped car. Existing logs
with unchanged settings are kept.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
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
from studies.pages import SAMPLE_VEHICLE, options

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


@dataclass(frozen=True, slots=True)
class Training:
    """Options of the command; the steps read and write these folders."""

    car: Path
    work: Path
    seed: int
    jobs: int
    drives: int
    epochs: int
    trials: int

    @property
    def network(self) -> Path:
        """Folder of the trained network."""
        return self.car / NETWORK_FOLDER

    @property
    def of_car(self) -> tuple[object, ...]:
        """Options that name the car and the mapping."""
        return "--car", self.car, "--mapping", self.work / "mapping.toml"

    @property
    def config(self) -> RunConfig:
        """The car and the mapping."""
        return RunConfig(car=self.car, mapping=self.work / "mapping.toml")


def simulate(t: Training) -> None:
    """Write the vehicle file and the drives."""
    t.work.mkdir(parents=True, exist_ok=True)
    t.car.mkdir(parents=True, exist_ok=True)
    text = part_toml(read_vehicle_file(SAMPLE_VEHICLE).vehicle, "Written by python -m studies.defaults.train_default.")
    (t.car / VEHICLE_FILE).write_text(f"{text}\n[network]\ngain = {GAIN}\n", encoding="utf-8")
    if t.seed:
        shutil.copyfile(HOME / FIT_FILE, t.car / FIT_FILE)
    what = ("--count", t.drives, "--seed", SEED, "--vehicles", "default", "--jobs", t.jobs)
    pdhef("simulate", "suite", *what, "-o", t.work / "one_car")
    paper_drives.write_drives(t.work / PAPER_DRIVES, count=min(t.drives, paper_drives.COUNT), processes=t.jobs)


def fit(t: Training) -> None:
    """Fit ``physics``; the network learns its residual."""
    fit_physics.main(["-o", str(t.car), "--work", str(t.work / "fit"), "--jobs", str(t.jobs)])


def noise(t: Training) -> None:
    """Tune the noise of all tuned filters alike, on validation drives."""
    logs = chosen_logs([str(t.work / "one_car")], LearnSettings(config=t.config, split="validation"))
    fitted = read_fit(t.car / FIT_FILE).model_copy(update={"filter": tune(logs, t.config, t.trials)})
    (t.car / FIT_FILE).write_text(part_toml(fitted, fit_physics.HEAD), encoding="utf-8")


def extract(t: Training) -> None:
    """Extract residuals: the paper's network and the baselines have the nominal model, as the paper has it."""
    sets = [(t.work / "one_car", t.work / model, model) for model in MODELS]
    for drives, residuals, model in (*sets, (t.work / PAPER_DRIVES, t.work / PAPER_RESIDUALS, NOMINAL_MODEL)):
        output = ("-o", residuals, "--filter", model, "--jobs", t.jobs, "--resume")
        pdhef("extract", drives, *t.of_car, *output)


def train(t: Training) -> None:
    """Train the residual network and the baselines beside it."""
    how = ("-o", t.network, "--seed", t.seed)
    beside = _start("studies.defaults.train_baselines", t.work / NOMINAL_MODEL, *how)
    if t.jobs == 1:
        _finish(beside)
    torch.set_num_threads(1)  # small networks: a second process is faster than a second thread
    recipe = Recipe(seed=t.seed, epochs=t.epochs)

    train_on(read_dataset(t.work / PHYSICS_MODEL, PHYSICS_MODEL), t.network, recipe, progress=_print_epoch)
    _finish(beside)


def paper(t: Training) -> None:
    """Train the paper's network by Table 1."""
    torch.set_num_threads(1)
    recipe = replace(PAPER_RECIPE, seed=t.seed, **PAPER_WINDOWS)
    train_on(
        read_dataset(t.work / PAPER_RESIDUALS, NOMINAL_MODEL), t.network / PAPER_FOLDER, recipe, progress=_print_epoch
    )  # fmt: skip


STEPS: dict[str, Callable[[Training], None]] = {
    step.__name__: step for step in (simulate, fit, noise, extract, train, paper)
}
#: Seeds other than 0 take these parts from the shipped car.
ONLY_OF_SEED_0 = ("fit", "noise")


def main(arguments: list[str] | None = None) -> int:
    """Train and write the car."""
    parser = options("defaults.train_default", __doc__)
    parser.add_argument("--seed", type=int, default=0, help="of weights, order and dropout; the data stay the same")
    parser.add_argument("-o", "--output", type=Path, default=HOME, help="the car's folder")
    parser.add_argument("--work", type=Path, default=Path("out/train-default"), help="logs and dataset; kept")
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--drives", type=int, default=DRIVES, help="number of drives")
    parser.add_argument("--epochs", type=int, default=EPOCHS)
    parser.add_argument("--trials", type=int, default=TRIALS, help="of each tuned estimator")
    parser.add_argument("--steps", nargs="+", choices=STEPS, default=list(STEPS), help="default: all")
    given = parser.parse_args(arguments)
    training = Training(given.output, given.work, given.seed, given.jobs, given.drives, given.epochs, given.trials)
    began = time.monotonic()
    for name, step in STEPS.items():
        if name in given.steps and not (given.seed and name in ONLY_OF_SEED_0):
            print(f"[{(time.monotonic() - began) / 60.0:5.1f} min] {name}: {step.__doc__}", flush=True)
            step(training)
    return 0


def _print_epoch(text: str, _share: float) -> None:
    print(text, flush=True)


def _start(*words: object) -> subprocess.Popen[bytes]:
    """Start a module as a user would; its warnings go to the terminal."""
    command = [sys.executable, "-m", *(str(w) for w in words)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, env={**os.environ, "OMP_NUM_THREADS": "1"})


def _finish(process: subprocess.Popen[bytes]) -> None:
    if process.wait() not in (EXIT_OK, EXIT_PARTIAL):
        raise SystemExit(f"failed ({process.returncode}): {process.args!r}")


def pdhef(*words: object) -> None:
    """Run one command of the tool; a failure ends the program."""
    _finish(_start("pdhef_logtool", *words))


if __name__ == "__main__":
    sys.exit(main())
