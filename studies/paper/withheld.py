"""A network that never saw the paper's manoeuvres: the shipped training less all lane changes and sine sweeps."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

from pdhef_logtool.car.car import FIT_FILE, NETWORK_FILE, NOISE_FILE, VEHICLE_FILE, Car
from pdhef_logtool.learning.network.fit import Recipe
from pdhef_logtool.learning.network.train_command import dataset_for, train_on
from pdhef_logtool.residual_model.bundle import PHYSICS_MODEL
from studies.defaults.train_default import EPOCHS, HOME, pdhef

#: Manoeuvres of A and B, and their like.
WITHHELD = ("dlc", "dlc-3888-2", "sine-sweep", "sine-sweep-wide")


@dataclass(frozen=True, slots=True, eq=False)
class Withheld:
    """Training drives of the shipped network by manoeuvre, and a car trained without :data:`WITHHELD` manoeuvres."""

    drives: Counter[str]
    car: Car


def manoeuvres(work: Path) -> dict[str, str]:
    """Return the manoeuvre of each training drive of the shipped network by name; ``work`` is its training folder."""
    manifest = json.loads((work / "one_car" / "manifest.json").read_text(encoding="utf-8"))
    return {Path(e["file"]).stem: e["manoeuvre"] for e in manifest["drives"]}


def counts(work: Path) -> Counter[str]:
    """Return how many training drives of each manoeuvre the shipped network had."""
    of = manoeuvres(work)
    return Counter(of[d.name] for d in dataset_for(work / PHYSICS_MODEL, PHYSICS_MODEL).drives if d.split == "train")


def train_withheld(work: Path, output: Path) -> None:
    """Train a network without :data:`WITHHELD`, and determine its gain limit on the drives of the shipped network.

    Physics and noise are the shipped car's.
    """
    output.mkdir(parents=True, exist_ok=True)
    for part in (VEHICLE_FILE, FIT_FILE, NOISE_FILE):
        shutil.copyfile(HOME / part, output / part)
    of, data = manoeuvres(work), dataset_for(work / PHYSICS_MODEL, PHYSICS_MODEL)
    kept = tuple(d for d in data.drives if of[d.name] not in WITHHELD)
    network = output.with_name(f"{output.name}-network")  # learn copies it into the car
    train_on(replace(data, drives=kept), network, Recipe(seed=0, epochs=EPOCHS))
    of_car = ["--car", output, "--mapping", work / "mapping.toml", "--network", network]
    pdhef("learn", work / "evidence", *of_car, "--stages", "gain", "--split", "any", "-o", output)


def withheld_car(work: Path, output: Path) -> Car:
    """Return the car with that network; train it first if it is missing."""
    if not (output / NETWORK_FILE).is_file():
        train_withheld(work, output)
    return Car.load(output)
