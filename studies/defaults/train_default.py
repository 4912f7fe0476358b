"""Make the car that the package ships from nothing: simulate, fit, extract, train, tune, trust, calibrate.

    python -m studies.defaults.train_default [--seed 0] [-o FOLDER] [--work out/train-default] [--jobs 2]

Short drives of one simulated car whose vehicle file is right, with the friction told. ``physics`` is fitted on five
minutes of other drives (:mod:`studies.defaults.fit_physics`), its noise with it; the residual network learns what it
lacks. The direct network, the regression and the paper's network see the same drives, with the nominal model. Filter
noise of all tuned estimators is chosen on validation drives in one search (stage noise). Seeds other than 0 train
networks for spreads and take fit and noise of the shipped car. A second set, of other cars of the same kind, is for the
model card. Logs that are there already as they should be are kept.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import torch

from pdhef_logtool.car.car import (
    FIT_FILE,
    INTERVALS_FILE,
    NETWORK_FOLDER,
    NOISE_FILE,
    SHIPPED_CARS,
    UNSURE_FILE,
    VEHICLE_FILE,
)
from pdhef_logtool.learning.network.fit import Recipe
from pdhef_logtool.learning.network.train_command import dataset_for, train_on
from pdhef_logtool.records.errors import EXIT_OK, EXIT_PARTIAL
from pdhef_logtool.residual_model.bundle import MODELS, NOMINAL_MODEL, PAPER_FOLDER, PHYSICS_MODEL, SHIPPED
from pdhef_logtool.residual_model.features import PAPER_FEATURES
from studies.defaults import fit_physics
from studies.pages import SAMPLE_VEHICLE, options

HOME = SHIPPED_CARS["saloon"]
#: Seeds and vehicles of the sets: apart from those of the condition table, the paper's scenarios and the tests.
SETS = {"one_car": (1000, "default"), "other_cars": (2000, "randomised"), "evidence": (3000, "default")}
DRIVES = 800
#: Of the sets that nothing is trained on: for the card, and for the evidence that the network helps.
OTHER_DRIVES = {"other_cars": 200, "evidence": 200}
EPOCHS, BASELINE_EPOCHS = 66, 40
PAPER_EPOCHS = 15
TRIALS = 64
#: Wrong frictions and vehicle files that the intervals allow for: no car is as its file says, a load alone makes this
#: much; and those for an unsure car.
USUAL_SPREAD, UNSURE_SPREAD = 0.08, 0.2
MAPPING = """# Recognised types, and the friction that the simulator drove on.
fill_recognised = true

[signals.friction]
topic = "/truth/perfect/state"
field = "friction"
"""


def main(arguments: list[str] | None = None) -> int:
    """Train and write the car."""
    parser = options("defaults.train_default", __doc__)
    parser.add_argument("--seed", type=int, default=0, help="of weights, order and dropout; the data stay the same")
    parser.add_argument("-o", "--output", type=Path, default=HOME, help="the car's folder")
    parser.add_argument("--work", type=Path, default=Path("out/train-default"), help="logs and dataset; kept")
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--drives", type=int, default=DRIVES, help="of each of the two sets")
    parser.add_argument("--epochs", type=int, default=EPOCHS)
    parser.add_argument("--trials", type=int, default=TRIALS, help="of each tuned estimator")
    given = parser.parse_args(arguments)
    began = time.monotonic()

    def say(text: str) -> None:
        print(f"[{(time.monotonic() - began) / 60.0:5.1f} min] {text}", flush=True)

    work, car = given.work, given.output
    network = car / NETWORK_FOLDER
    work.mkdir(parents=True, exist_ok=True)
    if not (car / VEHICLE_FILE).is_file():
        car.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(SAMPLE_VEHICLE, car / VEHICLE_FILE)
        if given.seed:
            for part in (FIT_FILE, NOISE_FILE):
                shutil.copyfile(HOME / part, car / part)
    mapping = work / "mapping.toml"
    mapping.write_text(MAPPING, encoding="utf-8")
    for name, (seed, vehicles) in SETS.items():
        count = min(given.drives, OTHER_DRIVES.get(name, given.drives))
        say(f"simulate {count} drives: {name}")
        what = ["--count", count, "--seed", seed, "--vehicles", vehicles, "--jobs", given.jobs]
        pdhef("simulate", "suite", *what, "-o", work / name)
    if given.seed == 0:
        say("fit physics, whose residual the network learns")
        fit_physics.main(["-o", str(car), "--work", str(work / "fit"), "--jobs", str(given.jobs)])
    say("extract")
    told = ["--car", car, "--mapping", mapping]
    # The paper's network and the baselines beside it have the nominal model, as the paper has it.
    for model in MODELS:
        output = ("-o", work / model, "--filter", model, "--jobs", given.jobs, "--resume")
        pdhef("extract", work / "one_car", *told, *output)
    say("train the residual network, and beside it the baselines on the same drives")
    how = ("--baselines", "--seed", given.seed, "--epochs", BASELINE_EPOCHS)
    beside = _start("train", work / NOMINAL_MODEL, "-o", network, *how)
    if given.jobs == 1:
        _finish(beside)
    torch.set_num_threads(1)  # small networks: a second thread brings nothing, a second process does
    recipe = Recipe(seed=given.seed, epochs=given.epochs)

    def epoch(text: str, _share: float) -> None:
        say(text)

    train_on(dataset_for(work / PHYSICS_MODEL, PHYSICS_MODEL), network, recipe, progress=epoch)
    say("train the paper's network on the same drives")
    paper = replace(recipe, feature_names=PAPER_FEATURES, hidden=128, dropout=0.2, epochs=PAPER_EPOCHS, odd=False)
    train_on(dataset_for(work / NOMINAL_MODEL, NOMINAL_MODEL), network / PAPER_FOLDER, paper, progress=epoch)
    _finish(beside)
    # The shipped network goes by its name, wherever the package lies.
    told += ["--network", SHIPPED if car.resolve() == HOME else network]
    validation = [work / "one_car", "--split", "validation", *told]
    if given.seed == 0:
        say("tune the noise of all tuned estimators alike, on validation drives")
        pdhef("learn", *validation, "--stages", "noise", "--trials", given.trials, "-o", car)
    say("evidence that the network helps on this car")
    pdhef("learn", work / "evidence", *told, "--stages", "gain", "--any-split", "-o", car)
    if given.seed == 0:
        say("calibrate the intervals: for a car that is nearly as its file says, and for one that may have changed")
        for spread, place in ((USUAL_SPREAD, car), (UNSURE_SPREAD, work / "unsure")):
            pdhef("learn", *validation, "--stages", "intervals", "--vary", spread, "-o", place)
        shutil.copyfile(work / "unsure" / INTERVALS_FILE, car / UNSURE_FILE)
    say(f"done: {car}")
    return 0


def _start(*words: object) -> subprocess.Popen[bytes]:
    """Start the command line as a user would; its warnings go to the terminal."""
    command = [sys.executable, "-m", "pdhef_logtool", *(str(w) for w in words)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, env={**os.environ, "OMP_NUM_THREADS": "1"})


def _finish(process: subprocess.Popen[bytes]) -> None:
    if process.wait() not in (EXIT_OK, EXIT_PARTIAL):
        raise SystemExit(f"failed ({process.returncode}): {process.args!r}")


def pdhef(*words: object) -> None:
    """Run one command of the tool; a failure ends the program."""
    _finish(_start(*words))


if __name__ == "__main__":
    sys.exit(main())
