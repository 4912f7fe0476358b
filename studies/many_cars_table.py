"""docs/many_cars.md: one network for many cars against the network of one car, on cars that neither ever saw.

    python -m studies.many_cars_table [--train] [--one NETWORK] [--many NETWORK] [--out docs]

``--train`` first simulates the cars (``studies.many_cars``), extracts and trains the network for many cars, which
takes about 25 minutes on two cores. Each car has a vehicle file of its own (fitted to a ramp steer of it, or identified
on runs that are not scored); filter noise is that of the shipped car for all estimators alike.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.car.car import NO_INTERVALS, Car
from pdhef_logtool.car.parts import PHYSICS
from pdhef_logtool.car.toml_files import load_vehicle, vehicle_toml
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.learning.drives import IDENTIFY, LearnSettings
from pdhef_logtool.learning.engine import learn
from pdhef_logtool.learning.network.fit import Recipe
from pdhef_logtool.learning.network.train_command import dataset_for, train_on
from pdhef_logtool.learning.stages.network import train_on_parts
from pdhef_logtool.residual_model.bundle import PHYSICS_MODEL, SHIPPED_FOLDERS, ModelBundle, load_bundle
from pdhef_logtool.residual_model.features import FEATURES
from pdhef_logtool.runs.config import RunConfig
from studies import many_cars
from studies.condition_drives import drives_of, independent_runs, read_drive, root_mean_square, sideslip_error
from studies.defaults.train_default import MAPPING, pdhef
from studies.pages import DOCS, INDEPENDENT, ROOT, options, table, write
from studies.table_maths import median_ratio, pooled_rmse

DATA, MODEL = ROOT / "out" / "many-cars-data", SHIPPED_FOLDERS["many-cars"]
CARS, UNSEEN = ROOT / "out" / "many-cars", ROOT / "out" / "many-cars-unseen"
#: Runs of the independent simulator that its car is identified on; the others are scored.
IDENTIFY_ON = ("ramp_100kmh_mu100_long", "normal_40_80kmh_mu090")
UNSEEN_SEED, UNSEEN_CARS, UNSEEN_DRIVES = 4100, 24, 4
EPOCHS = 48
#: Estimator by the name in the table: registered name, and which network it has.
COLUMNS = {
    "phy-ukf:tuned": ("phy-ukf:tuned", "one"),
    "physics": ("physics", "one"),
    "one car": ("pd-hef:gain=1", "one"),
    "many cars": ("pd-hef:gain=1", "many"),
}
LEAST_SAMPLES = 100
#: Fine-tuning: hatchbacks of their own, how many drives of each are fitted to, and the last of these to stop by.
TUNED_SET = ROOT / "out" / "many-cars-fine-tuned"
TUNED_SEED, TUNED_CARS, TUNED_DRIVES, FIT_DRIVES, STOP_DRIVES = 4200, 6, 20, 10, 2
#: Sideslip RMSE in degrees and how many stamps it is over, drive by drive.
Errors = list[tuple[float, float]]


@dataclass(frozen=True, slots=True)
class Case:
    """One log with its car; ``friction`` where the log has none of its own."""

    log: Path
    car: Car
    friction: float | None = None


def train_networks() -> None:
    """Simulate, extract and train; what is there already as it should be is kept."""
    many_cars.write_cars(CARS, cars=many_cars.CARS, drives=many_cars.DRIVES_PER_CAR, seed=many_cars.SEED, jobs=2)
    logs = many_cars.identify_cars(CARS)
    mapping = CARS / "extract.toml"
    mapping.write_text(MAPPING, encoding="utf-8")
    pdhef("extract", *logs, "-o", DATA, "--mapping", mapping, "--jobs", 2, "--resume")
    recipe = Recipe(seed=0, epochs=EPOCHS, feature_names=FEATURES)
    train_on(dataset_for(DATA, PHYSICS_MODEL), MODEL, recipe, progress=lambda text, _share: print(text, flush=True))


def with_shipped_noise(vehicle: VehicleParameters) -> Car:
    """Return a car of a vehicle with the shipped one's filter noise, but that of ``physics``, which has parts there."""
    noise = Car.load("saloon", network="none").noise
    return Car.of(vehicle, noise={n: one for n, one in noise.items() if n != PHYSICS})


def cars_of(folder: Path, split: str | None) -> Iterator[Case]:
    """Yield the drives of a set of many cars."""
    for entry in drives_of(folder, split):
        found = Car.load(folder / entry["vehicle_file"], network="none", intervals=NO_INTERVALS)
        car = with_shipped_noise(found.vehicle)
        if found.fitted_physics is not None:
            car = replace(found, noise={**car.noise, **found.noise})
        yield Case(folder / entry["file"], car)


def independent_cases(work: Path) -> Iterator[Case]:
    """Identify the independent simulator's car on some of its runs, and yield the others."""
    start = load_vehicle(many_cars.BASE).model_copy(update={"friction": 1.0})
    runs = [(log, friction) for _, log, friction in independent_runs(work)]
    fit = [log for log, _ in runs if log.stem.endswith(IDENTIFY_ON)]
    guess, found = work / "guess.toml", work / "identified"
    guess.write_text(vehicle_toml(start), encoding="utf-8")
    learn([str(log) for log in fit], found, LearnSettings(config=RunConfig(car=guess), stages=(IDENTIFY,), holdout=0.0))
    identified = Car.load(found, network="none")
    noise = with_shipped_noise(identified.vehicle).noise
    car = replace(identified, noise={**noise, PHYSICS: identified.noise[PHYSICS]})
    yield from (Case(log, car, friction) for log, friction in runs if log not in fit)


def fine_tuned(network: ModelBundle, work: Path) -> dict[str, Errors]:
    """Fine-tune on the first drives of each car, and score before and after on its others."""
    many_cars.write_cars(TUNED_SET, cars=TUNED_CARS, drives=TUNED_DRIVES, seed=TUNED_SEED, jobs=2, kinds=("hatchback",))
    mapping = work / "mapping.toml"
    mapping.write_text(MAPPING, encoding="utf-8")
    by_car: dict[int, list[dict[str, Any]]] = {}
    for entry in drives_of(TUNED_SET):
        by_car.setdefault(entry["car"], []).append(entry)
    found: dict[str, Errors] = {}
    for car, entries in by_car.items():
        vehicle_file = TUNED_SET / entries[0]["vehicle_file"]
        config = RunConfig(car=vehicle_file, mapping=mapping)
        logs = [TUNED_SET / e["file"] for e in entries]
        parts = {"train": logs[: FIT_DRIVES - STOP_DRIVES], "validation": logs[FIT_DRIVES - STOP_DRIVES : FIT_DRIVES]}
        own = train_on_parts(
            {s: ([str(log) for log in of], config) for s, of in parts.items()}, work / str(car), network
        )
        drawn = with_shipped_noise(load_vehicle(vehicle_file))
        columns = {
            "phy-ukf:tuned": ("phy-ukf:tuned", network),
            "physics": ("physics", network),
            "many cars": ("pd-hef:gain=1", network),
            "many cars, fine-tuned": ("pd-hef:gain=1", own),
        }
        for column, errors in score([Case(log, drawn) for log in logs[FIT_DRIVES:]], columns).items():
            found.setdefault(column, []).extend(errors)
    return found


def score(cases: Iterable[Case], columns: Mapping[str, tuple[str, ModelBundle]]) -> dict[str, Errors]:
    """Run the columns' estimators with their networks on every drive; an RMSE is NaN below some samples."""
    found: dict[str, Errors] = {column: [] for column in columns}
    for case in cases:
        drive = read_drive(case.log, case.car, friction=case.friction)
        for column, (name, network) in columns.items():
            error = np.degrees(sideslip_error(make_estimator(name, replace(case.car, network=network)), drive))
            n = np.count_nonzero(np.isfinite(error))
            found[column].append((root_mean_square(error) if n >= LEAST_SAMPLES else float("nan"), float(n)))
    return found


def error_table(found: Mapping[str, Errors]) -> str:
    """Return a Markdown table: median and pooled RMSE, and the ratio of medians to ``physics`` with its bounds."""
    body = []
    yardstick = np.array(found["physics"])[:, 0]
    for column, errors in found.items():
        rmse, samples = np.array(errors).T
        b = median_ratio(rmse, yardstick)
        figures = (f"{np.nanmedian(rmse):.3f}", f"{pooled_rmse(rmse, samples):.3f}")
        body.append([column, *figures, f"{b.value:.2f} [{b.low:.2f}, {b.high:.2f}]"])
    return table(["estimator", "median °", "pooled °", "median over that of `physics`"], body)


def main() -> None:
    """Write the page."""
    parser = options("many_cars_table", __doc__)
    parser.add_argument("--train", action="store_true", help="simulate, extract and train first")
    parser.add_argument("--one", type=Path, default=SHIPPED_FOLDERS["default"], help="network of one car")
    parser.add_argument("--many", type=Path, default=MODEL, help="network of many cars")
    parser.add_argument("--out", type=Path, default=DOCS)
    given = parser.parse_args()
    if given.train:
        train_networks()
    kinds = ("hatchback",)
    many_cars.write_cars(UNSEEN, cars=UNSEEN_CARS, drives=UNSEEN_DRIVES, seed=UNSEEN_SEED, jobs=2, kinds=kinds)
    models = {"one": load_bundle(given.one), "many": load_bundle(given.many)}
    parts = {
        "Saloons and SUVs that were not trained on": cars_of(CARS / "residuals", "test"),
        "Hatchbacks, of which none was trained on": cars_of(UNSEEN, None),
    }
    columns = {column: (name, models[which]) for column, (name, which) in COLUMNS.items()}
    with tempfile.TemporaryDirectory() as folder:
        if INDEPENDENT.is_dir():
            parts["The independent simulator's car, identified on two of its runs"] = independent_cases(Path(folder))
        found = {title: score(cases, columns) for title, cases in parts.items()}
        title = f"Hatchbacks, fine-tuned on {FIT_DRIVES} drives of {many_cars.DRIVE_S:g} s each, scored on their others"
        found[title] = fine_tuned(models["many"], Path(folder))
    write(given.out / "many_cars.md", page(found, models))


def page(found: Mapping[str, Mapping[str, Errors]], models: dict[str, ModelBundle]) -> str:
    """Return the page."""
    parts = [
        f"## {title}\n\n{len(scores['physics'])} drives.\n\n{error_table(scores)}\n" for title, scores in found.items()
    ]
    networks = "\n".join(
        f"- **{name}**: {len(m.feature_names)} features, {m.layers} × {m.hidden}, validation loss"
        f" {m.provenance['validation_loss']:.3f}, sha256 `{m.sha256[:12]}`"
        for name, m in (("one car", models["one"]), ("many cars", models["many"]))
    )
    return f"""# One network for many cars

Written by `python -m studies.many_cars_table`; networks by `make train-default` and by the same command with
`--train`. Both networks at trust 1 whatever the evidence, so that the network is compared and not the caution.
As served, a network has no trust on a car without evidence ([trust.md](trust.md)): there `pd-hef` is `physics`.

{networks}

The network for many cars knows mass, geometry, stiffness and peak force of the vehicle file as inputs. It learns from
{many_cars.CARS} simulated saloons and SUVs with {many_cars.DRIVES_PER_CAR} drives of {many_cars.DRIVE_S:g} s each, all
with vehicle files and sensors of their own, after `physics` of each was identified on {many_cars.FIT_DRIVES} of its
drives; the residuals are those of the others, and so are the drives that are scored. Friction is told. Filter noise of
all estimators is the shipped car's, but that of `physics`: it has no part on a car of which nothing was found.

{chr(10).join(parts)}"""


if __name__ == "__main__":
    main()
