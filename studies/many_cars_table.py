"""docs/many_cars.md: one network for many cars against the network of one car, on cars that neither ever saw.

    python -m studies.many_cars_table [--train] [--one MODEL] [--many MODEL] [--out docs]

``--train`` first simulates the cars (``studies.many_cars``), extracts and trains the network for many cars, which
takes about 25 minutes on two cores. Each car has a vehicle file of its own (fitted to a ramp steer of it, or identified
on runs that are not scored); filter noise is that of the shipped model's vehicle file for all estimators alike.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.measuring import ROOT
from pdhef_logtool.car.vehicle import VehicleParameters, load_vehicle, vehicle_to_toml
from pdhef_logtool.estimators.registry import make_estimator
from pdhef_logtool.evaluation.metrics import signal_error
from pdhef_logtool.learning.network.dataset import read_dataset
from pdhef_logtool.learning.network.extract_command import ExtractSettings, run_extraction
from pdhef_logtool.learning.network.fit import Recipe
from pdhef_logtool.learning.network.train_command import make_recipe, train_on
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.residual_model.bundle import SHIPPED_FOLDERS, ModelBundle, load_bundle
from pdhef_logtool.residual_model.features import FEATURES
from pdhef_logtool.run.config import RunConfig
from studies import many_cars
from studies.condition_drives import SIDESLIP, ConditionDrive, independent_runs, read_drive
from studies.defaults.train_default import HOME, MAPPING, pdhef
from studies.independent_sim_logs import write_run
from studies.table_maths import Bound, median_ratio, pooled_rmse

DATA, MODEL = ROOT / "out" / "many-cars-data", SHIPPED_FOLDERS["many-cars"]
CARS, UNSEEN = ROOT / "out" / "many-cars", ROOT / "out" / "many-cars-unseen"
INDEPENDENT = ROOT.parent / "shared" / "data" / "independent_sim"
#: Runs of the independent simulator that its car is identified on; the others are scored.
IDENTIFY_ON = ("ramp_100kmh_mu100_long", "normal_40_80kmh_mu090")
UNSEEN_SEED, UNSEEN_CARS, UNSEEN_DRIVES = 4100, 24, 4
EPOCHS, HIDDEN = 22, 96
VARY = 0.1
#: Estimator by the name in the table: registered name, and which network it has.
COLUMNS = {
    "phy-ukf-tuned": ("phy-ukf-tuned", "one"),
    "physics-plus": ("physics-plus", "one"),
    "trust 0": ("pd-hef-trust0", "one"),
    "one car": ("pd-hef-trust1", "one"),
    "many cars": ("pd-hef-trust1", "many"),
}
LEAST_SAMPLES = 100
#: Fine-tuning: hatchbacks of their own, how many drives of each are fitted to, the last of these to stop by, and how
#: gently (as ``studies.real``).
TUNED_SET = ROOT / "out" / "many-cars-fine-tuned"
TUNED_SEED, TUNED_CARS, TUNED_DRIVES, FIT_DRIVES, STOP_DRIVES = 4200, 6, 20, 10, 2
FINE_EPOCHS, FINE_RATE = 15, 5e-4


@dataclass(frozen=True, slots=True)
class Case:
    """One log with the vehicle file of its car; ``friction`` where the log has none of its own."""

    log: Path
    vehicle: VehicleParameters
    friction: float | None = None


def train_networks() -> None:
    """Simulate, extract and train; what is there already as it should be is kept."""
    many_cars.write_cars(CARS, cars=many_cars.CARS, drives=many_cars.DRIVES_PER_CAR, seed=many_cars.SEED, jobs=2)
    mapping = CARS / "mapping.toml"
    mapping.write_text(MAPPING, encoding="utf-8")
    pdhef("extract", CARS, "-o", DATA, "--mapping", mapping, "--vary", VARY, "--jobs", 2, "--resume")
    recipe = Recipe(seed=0, epochs=EPOCHS, hidden=HIDDEN, feature_names=FEATURES)
    train_on(read_dataset(DATA), MODEL, recipe, progress=lambda text, _share: print(text, flush=True))


def cars_of(folder: Path, split: str | None) -> Iterator[Case]:
    """Yield the drives of a set of many cars, with the noise of the shipped model's vehicle file."""
    noise = load_vehicle(HOME / "vehicle.toml").filter
    for entry in json.loads((folder / "manifest.json").read_text(encoding="utf-8"))["drives"]:
        if "sha256" in entry and split in (None, entry["split"]):
            own = load_vehicle(folder / entry["vehicle_file"])
            yield Case(folder / entry["file"], own.model_copy(update={"filter": noise}))


def independent_cases(work: Path) -> Iterator[Case]:
    """Identify the independent simulator's car on some of its runs, and yield the others."""
    start = load_vehicle(many_cars.BASE).model_copy(update={"friction": 1.0})
    logs, fit = {}, []
    for source, friction in independent_runs(INDEPENDENT):
        log = work / f"{source.stem}.mcap"
        write_run(source, log)
        if source.stem.endswith(IDENTIFY_ON):
            fit.append(log)
        else:
            logs[log] = friction
    guess, found = work / "guess.toml", work / "identified.toml"
    guess.write_text(vehicle_to_toml(start), encoding="utf-8")
    pdhef("identify", *fit, "-o", found, "--vehicle", guess, "--holdout", 0)
    noise = load_vehicle(HOME / "vehicle.toml").filter
    vehicle = load_vehicle(found).model_copy(update={"filter": noise})
    for log, friction in logs.items():
        yield Case(log, vehicle, friction)


def fine_tuned(network: ModelBundle, work: Path) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Fine-tune on the first drives of each car, and score before and after on its others."""
    many_cars.write_cars(TUNED_SET, cars=TUNED_CARS, drives=TUNED_DRIVES, seed=TUNED_SEED, jobs=2, kinds=("hatchback",))
    mapping = work / "mapping.toml"
    mapping.write_text(MAPPING, encoding="utf-8")
    drives: dict[int, list[tuple[Path, Path]]] = {}
    for entry in json.loads((TUNED_SET / "manifest.json").read_text(encoding="utf-8"))["drives"]:
        if "sha256" in entry:
            pair = (TUNED_SET / entry["file"], TUNED_SET / entry["vehicle_file"])
            drives.setdefault(entry["car"], []).append(pair)
    noise = load_vehicle(HOME / "vehicle.toml").filter
    found: dict[str, list[tuple[float, float]]] = {}
    for car, pairs in drives.items():
        vehicle_file = pairs[0][1]
        parts = {"train": pairs[: FIT_DRIVES - STOP_DRIVES], "validation": pairs[FIT_DRIVES - STOP_DRIVES : FIT_DRIVES]}
        sets = []
        for split, logs in parts.items():
            folder = work / f"{car}-{split}"
            config = RunConfig(vehicle=vehicle_file, mapping=mapping)
            run_extraction([str(log) for log, _ in logs], folder, ExtractSettings(config, split=split))
            sets.append(read_dataset(folder))
        both = replace(sets[0], drives=sets[0].drives + sets[1].drives)
        recipe = replace(make_recipe(paper=False, seed=0, epochs=None, device="cpu"), learning_rate=FINE_RATE)
        recipe = replace(recipe, epochs=FINE_EPOCHS)
        own = train_on(both, work / f"{car}-model", recipe, init=network).bundle
        vehicle = load_vehicle(vehicle_file).model_copy(update={"filter": noise})
        columns = {
            "phy-ukf-tuned": ("phy-ukf-tuned", network),
            "physics-plus": ("physics-plus", network),
            "many cars": ("pd-hef-trust1", network),
            "many cars, fine-tuned": ("pd-hef-trust1", own),
        }
        for log, _ in pairs[FIT_DRIVES:]:
            case = Case(log, vehicle)
            drive = read_drive(log, vehicle, log.name)
            for column, (name, model) in columns.items():
                found.setdefault(column, []).append(error_of(name, case, drive, model))
    return {c: (np.array([v[0] for v in f]), np.array([v[1] for v in f])) for c, f in found.items()}


def error_of(name: str, case: Case, drive: ConditionDrive, model: ModelBundle) -> tuple[float, float]:
    """Return the sideslip RMSE in degrees and how many stamps it is over; NaN below some samples."""
    track, _ = make_estimator(name, case.vehicle, model=model).run(drive.signals, None)
    error = np.degrees(signal_error(track, drive.truth, SIDESLIP, case.vehicle.low_speed_blend_m_s))
    error = error[np.isfinite(error)]
    return (float(np.sqrt(np.mean(error**2))) if error.size >= LEAST_SAMPLES else np.nan), float(error.size)


def score(cases: Iterator[Case], models: dict[str, ModelBundle]) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return RMSE [N] and samples [N] over drives by column."""
    found: dict[str, list[tuple[float, float]]] = {column: [] for column in COLUMNS}
    for case in cases:
        drive = read_drive(case.log, case.vehicle, case.log.name, friction=case.friction)
        for column, (name, which) in COLUMNS.items():
            found[column].append(error_of(name, case, drive, models[which]))
    return {c: (np.array([v[0] for v in f]), np.array([v[1] for v in f])) for c, f in found.items()}


def table(found: dict[str, tuple[FloatArray, FloatArray]]) -> str:
    """Return a Markdown table: median and pooled RMSE, and the ratio of medians to ``physics-plus`` with its bounds."""
    lines = ["| estimator | median ° | pooled ° | median over that of `physics-plus` |", "| --- | --- | --- | --- |"]
    yardstick = found["physics-plus"][0]
    for column, (rmse, samples) in found.items():
        b: Bound = median_ratio(rmse, yardstick)
        lines.append(
            f"| {column} | {np.nanmedian(rmse):.3f} | {pooled_rmse(rmse, samples):.3f} |"
            f" {b.value:.2f} [{b.low:.2f}, {b.high:.2f}] |"
        )
    return "\n".join(lines)


def main() -> int:
    """Write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--train", action="store_true", help="simulate, extract and train first")
    parser.add_argument("--one", type=Path, default=HOME, help="model of one car")
    parser.add_argument("--many", type=Path, default=MODEL, help="model of many cars")
    parser.add_argument("--out", type=Path, default=ROOT / "docs")
    given = parser.parse_args()
    if given.train:
        train_networks()
    kinds = ("hatchback",)
    many_cars.write_cars(UNSEEN, cars=UNSEEN_CARS, drives=UNSEEN_DRIVES, seed=UNSEEN_SEED, jobs=2, kinds=kinds)
    models = {"one": load_bundle(given.one), "many": load_bundle(given.many)}
    parts = {
        "Saloons and SUVs that were not trained on": cars_of(CARS, "test"),
        "Hatchbacks, of which none was trained on": cars_of(UNSEEN, None),
    }
    with tempfile.TemporaryDirectory() as folder:
        if INDEPENDENT.is_dir():
            parts["The independent simulator's car, identified on two of its runs"] = independent_cases(Path(folder))
        found = {title: score(cases, models) for title, cases in parts.items()}
        title = f"Hatchbacks, fine-tuned on {FIT_DRIVES} drives of {many_cars.DRIVE_S:g} s each, scored on their others"
        found[title] = fine_tuned(models["many"], Path(folder))
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "many_cars.md").write_text(page(found, models), encoding="utf-8")
    print(given.out / "many_cars.md")
    return 0


def page(found: dict[str, dict[str, tuple[FloatArray, FloatArray]]], models: dict[str, ModelBundle]) -> str:
    """Return the page."""
    parts = []
    for title, scores in found.items():
        drives = len(scores["physics-plus"][0])
        parts.append(f"## {title}\n\n{drives} drives.\n\n{table(scores)}\n")
    networks = "\n".join(
        f"- **{name}**: {len(m.feature_names)} features, {m.layers} × {m.hidden}, validation loss"
        f" {m.provenance['validation_loss']:.3f}, sha256 `{m.sha256[:12]}`"
        for name, m in (("one car", models["one"]), ("many cars", models["many"]))
    )
    return f"""# One network for many cars

Written by `python -m studies.many_cars_table`; networks by `make train-default` and by the same command with
`--train`. Both networks at trust 1 whatever the evidence, so that the network is compared and not the caution.

{networks}

The network for many cars knows mass, geometry, stiffness and peak force of the vehicle file as inputs. It learns from
{many_cars.CARS} simulated saloons and SUVs with {many_cars.DRIVES_PER_CAR} drives of {many_cars.DRIVE_S:g} s each, all
with vehicle files and sensors of their own; {VARY:g} is the spread by which files and friction are made wrong on top.
Friction is told. Filter noise of all estimators is the shipped vehicle file's.

{chr(10).join(parts)}"""


if __name__ == "__main__":
    sys.exit(main())
