"""Train the model that the package ships, from nothing: simulate, extract, train, tune, write its card.

    python -m benchmarks.train_default [--seed 0] [-o pdhef_logtool/models/default] [--work out/train-default] [--jobs 2]

Two sets of short drives: one car whose vehicle file is right, and other cars of its kind with the file of the first. In
part of the drives friction and vehicle file are made wrong besides (``extract --vary``). The residual network, the
direct network, the regression and the paper's network see the same rows. Filter noise of all tuned estimators is chosen
on validation drives in one search (``pdhef tune``) and stands in ``vehicle.toml`` beside the network, which it belongs
to. Seeds other than 0 train networks alone: for spreads.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

from pdhef_logtool.residual_model.bundle import PAPER_FOLDER
from pdhef_logtool.residual_model.features import PAPER_FEATURES
from pdhef_logtool.training.dataset import read_dataset
from pdhef_logtool.training.fit import Recipe
from pdhef_logtool.training.train_command import train_on

HOME = Path("pdhef_logtool/models/default")
VEHICLE = Path("sample_logs/vehicle.toml")
#: Seeds of the two sets: apart from those of the condition table, the paper's scenarios and the tests.
SETS = {"one_car": (1000, "default"), "other_cars": (2000, "randomised")}
DRIVES = 800
SPREAD = 0.1
EPOCHS = 30
PAPER_EPOCHS = 12
TRIALS = 64
MAPPING = """# Recognised types, and the friction that the simulator drove on.
fill_recognised = true

[signals.friction]
topic = "/truth/perfect/state"
field = "friction"
"""


def main(arguments: list[str] | None = None) -> int:
    """Train and write the model folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0, help="of weights, order and dropout; the data stay the same")
    parser.add_argument("-o", "--output", type=Path, default=HOME, help="model folder")
    parser.add_argument("--work", type=Path, default=Path("out/train-default"), help="logs and dataset; kept")
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--drives", type=int, default=DRIVES, help="of each of the two sets")
    parser.add_argument("--epochs", type=int, default=EPOCHS)
    given = parser.parse_args(arguments)
    began = time.monotonic()

    def say(text: str) -> None:
        print(f"[{(time.monotonic() - began) / 60.0:5.1f} min] {text}", flush=True)

    work, model = given.work, given.output
    work.mkdir(parents=True, exist_ok=True)
    mapping = work / "mapping.toml"
    mapping.write_text(MAPPING, encoding="utf-8")
    for name, (seed, vehicles) in SETS.items():
        say(f"simulate {given.drives} drives: {name}")
        what = ["--count", given.drives, "--seed", seed, "--vehicles", vehicles, "--jobs", given.jobs]
        _pdhef("simulate", "suite", *what, "-o", work / name)
    say("extract")
    sets = [work / name for name in SETS]
    told = ["--vehicle", VEHICLE, "--mapping", mapping, "--jobs", given.jobs]
    _pdhef("extract", *sets, "-o", work / "dataset", *told, "--vary", SPREAD, "--resume")
    data = read_dataset(work / "dataset")
    recipe = Recipe(seed=given.seed, epochs=given.epochs)

    def epoch(text: str, _share: float) -> None:
        say(text)

    say("train the residual network")
    train_on(data, model, recipe, progress=epoch)
    say("train the baselines on the same rows")
    _pdhef("train", work / "dataset", "-o", model, "--baselines", "--seed", given.seed, "--epochs", given.epochs)
    say("train the paper's network on the same rows")
    paper = replace(recipe, feature_names=PAPER_FEATURES, hidden=128, dropout=0.2, epochs=PAPER_EPOCHS)
    train_on(data, model / PAPER_FOLDER, paper, progress=epoch)
    if given.seed == 0:
        say("tune the noise of all tuned estimators alike, on validation drives")
        search = ["--split", "validation", "--trials", TRIALS, "--model", model]
        _pdhef("tune", work / "one_car", *search, *told, "-o", model / "vehicle.toml")
    facts = {"minutes": round((time.monotonic() - began) / 60.0, 1), "jobs": given.jobs, "seed": given.seed}
    (work / f"train-{given.seed}.json").write_text(json.dumps(facts) + "\n", encoding="utf-8")
    say(f"done: {model}")
    return 0


def _pdhef(*words: object) -> None:
    """Run the command line as a user would; its own words go to the terminal."""
    command = [sys.executable, "-m", "pdhef_logtool", *(str(w) for w in words)]
    done = subprocess.run(command, check=False, stdout=subprocess.DEVNULL)
    if done.returncode not in (0, 3):  # 3: some drives gave nothing
        raise SystemExit(f"failed ({done.returncode}): {' '.join(command)}")


if __name__ == "__main__":
    sys.exit(main())
