"""Short drives of many simulated cars, each with a vehicle file of its own: what one network for many cars learns from.

Saloons and SUVs of all loads, heights, tyres and wear, with sensors of all qualities; hatchbacks are reserved for cars
that no network was trained on. The file of a car is fitted to a ramp steer (``fit_vehicle``), as after a measurement.
``physics`` is identified by the tool on the first drives, with ground truth of an INS that is mounted slightly askew.
Residuals are computed from the other drives with exact ground truth, because the network learned the noise of the INS
(the validation loss rose from the second epoch on). Drives are split by car.

    python -m studies.many_cars

Simulates the cars, extracts their residuals and trains the shipped network ``many-cars``: 25 minutes on two cores.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.car.car import FIT_FILE, VEHICLE_FILE, Car
from pdhef_logtool.car.parts import Fit, FittedPhysics, FittedValues, physics_sha256
from pdhef_logtool.car.toml_files import load_vehicle, part_toml, vehicle_toml
from pdhef_logtool.car.vehicle import AxleTyre, PhysicsParts, Tyres, VehicleParameters
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.learning.car.fit_data import load_fit_drive
from pdhef_logtool.learning.car.physics_fit import fit_physics
from pdhef_logtool.learning.network.fit import Recipe
from pdhef_logtool.learning.network.train_command import dataset_for, train_on
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.mapping.mapping_file import load_mapping
from pdhef_logtool.records.errors import SimulationError
from pdhef_logtool.residual_model.bundle import MANY_CARS, PHYSICS_MODEL, SHIPPED_FOLDERS
from pdhef_logtool.residual_model.features import FEATURES
from studies.defaults.fit_nominal_tyres import (
    LINEAR_A_Y_M_S2,
    axle_curves,
    axle_loads_n,
    fit_axle,
    ramp,
    roll_gradient_rad_per_m_s2,
)
from studies.defaults.train_default import MAPPING as TRAINING_MAPPING
from studies.defaults.train_default import pdhef
from studies.pages import ROOT, options
from truthsim.batch import DriveSpec, Job, run_jobs
from truthsim.linear_theory import understeer_gradient_rad_per_m_s2
from truthsim.sensors import SensorNoise
from truthsim.suite import draw_spec
from truthsim.vehicle import GRAVITY_M_S2, Vehicle
from truthsim.vehicle_choice import choose_vehicle

DATA, CARS_FOLDER = ROOT / "out" / "many-cars-data", ROOT / "out" / "many-cars"
SEED, EPOCHS = 4000, 48
CARS = 300
DRIVES_PER_CAR = 6
#: Of these, the drives that a car is identified on; no residual is taken from them. Steps of the fit, some 5 s a car.
FIT_DRIVES, FIT_ITERATIONS = 3, 4
#: With so little driving the parts are not chosen: those that a bare car cannot do without, and none that adapts.
PARTS = PhysicsParts(lag=True, load_transfer=True, braking=True, roll=True, biases=True)
DRIVE_S = 12.5
#: Of a set, beside its drives.
MAPPING_FILE = "mapping.toml"
BASE = Path("sample_logs/vehicle.toml")
KINDS = ("sedan", "suv")
#: Share of the cars that get the tyres of the other kind.
OTHER_TYRES_SHARE = 0.3
#: Ranges of the uniform draws, on top of what ``truthsim.randomisation`` draws.
RANGES = {"mass": (0.85, 1.15), "cg": (-0.10, 0.12), "height": (0.9, 1.1), "stiffness": (0.8, 1.25)}
#: Factors on the usual 1-sigma of sensors, uniform in the logarithm.
SENSOR_FACTORS = {
    "acceleration_m_s2": (0.5, 2.0),
    "yaw_rate_rad_s": (0.4, 1.6),
    "steer_rad": (0.5, 2.0),
    "wheel_speed_m_s": (0.5, 2.0),
    "acceleration_bias_m_s2": (0.3, 1.5),
    "yaw_rate_bias_rad_s": (0.2, 1.5),
    "steer_bias_rad": (0.5, 2.0),
    # Noise of accelerometers that is not white: vibration of the body, temperature.
    "acceleration_walk_m_s2": (1.0, 5.0),
    "walk_time_s": (0.005, 1.0),
}
DELAY_S = (0.0, 0.040)
STEER_GAIN = 0.01
#: Free play of the steering at the road wheels: up to 2.5 degrees at a steering wheel of ratio 15.
STEER_PLAY_RAD = (0.0, 0.003)
#: Where the IMU may be from where the car's file has it, forward and to the left; the same of the INS, and its heading.
LEVER_M, TRUTH_LEVER_M, TRUTH_HEADING_RAD = 0.15, 0.1, np.radians(0.3)
#: What a car is identified with: recognised types, the friction that was driven on, ground truth of a proving ground.
MAPPING = TRAINING_MAPPING + "".join(
    f"""
[truth.{name}]
topic = "/rtk/odometry"
field = "twist.twist.{field}"
"""
    for name, field in (("vx_m_s", "linear.x"), ("vy_m_s", "linear.y"), ("yaw_rate_rad_s", "angular.z"))
)
#: Less understeer than this no maker sells: 0.5 degrees per g.
LEAST_UNDERSTEER = np.radians(0.5) / GRAVITY_M_S2
#: A ramp steer at this friction shows the axles' curves.
FIT_FRICTION = 0.85
SPLITS = (("train", 0.84), ("validation", 0.92), ("test", 1.0))
_ATTEMPTS = 6


@dataclass(frozen=True, slots=True)
class DrawnCar:
    """One car: its name as ``--vehicle`` takes it, its file, and the sensors that it has."""

    text: str
    vehicle: VehicleParameters
    sensors: tuple[tuple[str, float], ...]


def draw_car(rng: np.random.Generator, base: VehicleParameters, kinds: tuple[str, ...] = KINDS) -> DrawnCar:
    """Draw a car that understeers and can be driven through a ramp steer, with its vehicle file."""
    while True:
        kind = str(rng.choice(kinds))
        words = [f"{kind}~{rng.integers(2**31)}"]
        words += [f"{name}={rng.uniform(*limits):.3f}" for name, limits in RANGES.items()]
        if rng.uniform() < OTHER_TYRES_SHARE:
            words.append(f"tyres={KINDS[1 - KINDS.index(kind)] if kind in KINDS else KINDS[0]}")
        text = ",".join(words)
        car = choose_vehicle(text)
        if understeer_gradient_rad_per_m_s2(car, FIT_FRICTION) < LEAST_UNDERSTEER:
            continue
        try:
            fitted = fit_vehicle(car, FIT_FRICTION, base)
        except (SimulationError, ValueError):
            continue  # rolls over or spins in the ramp
        entries = {"name": text, "wheel_radius_m": car.wheel_radius_m, "steering_ratio": car.steering_ratio}
        return DrawnCar(text, fitted.model_copy(update=entries), _sensors(rng))


def _sensors(rng: np.random.Generator) -> tuple[tuple[str, float], ...]:
    usual = SensorNoise()._asdict()
    values = {
        name: usual[name] * float(np.exp(rng.uniform(np.log(low), np.log(high))))
        for name, (low, high) in SENSOR_FACTORS.items()
    }
    values["can_delay_s"] = float(rng.uniform(*DELAY_S))
    values["steer_gain"] = STEER_GAIN
    values["steer_play_rad"] = float(rng.uniform(*STEER_PLAY_RAD))
    values["rtk_heading_offset_rad"] = float(rng.uniform(-TRUTH_HEADING_RAD, TRUTH_HEADING_RAD))
    for reach, names in ((LEVER_M, ("imu_x_m", "imu_y_m")), (TRUTH_LEVER_M, ("rtk_x_m", "rtk_y_m"))):
        values |= {name: float(rng.uniform(-reach, reach)) for name in names}
    return tuple((name, round(value, 6)) for name, value in sorted(values.items()))


def fit_vehicle(car: Vehicle, friction: float, vehicle: VehicleParameters) -> VehicleParameters:
    """Return the vehicle file with mass, geometry, axle tyres and roll gradient of a simulated car on a road.

    Raises
    ------
    SimulationError
        The car cannot be driven through the ramp.
    """
    motion = ramp(friction, car)
    if not np.isfinite(motion.column("ay_m_s2")).all():
        raise SimulationError(expected="a finite ramp steer", got="NaN or infinity", where="fit of a vehicle file")
    tyres, loads_n = {}, axle_loads_n(car)
    for axle, (alpha, force) in axle_curves(motion, car).items():
        # Beyond the peak the car slides in ever other ways; the curve is fitted up to it.
        whole = slice(0, int(np.argmax(force)) + 1)
        fit = fit_axle(alpha[whole] / friction, force[whole] / friction, loads_n[axle])
        tyres[axle] = AxleTyre(B=fit.B, C=fit.C, D_n=fit.D_n, E=fit.E, reference_friction=1.0)
    linear_m_s2 = min(LINEAR_A_Y_M_S2, 0.5 * friction * GRAVITY_M_S2)
    return vehicle.model_copy(
        update={
            "mass_kg": car.mass_kg,
            "yaw_inertia_kg_m2": car.yaw_inertia_kg_m2,
            "cg_to_front_axle_m": car.cg_to_front_axle_m,
            "cg_to_rear_axle_m": car.cg_to_rear_axle_m,
            "track_m": car.track_m,
            "cg_height_m": car.cg_height_m,
            "roll_gradient_rad_per_m_s2": roll_gradient_rad_per_m_s2(motion, linear_m_s2),
            "tyres": Tyres(front=tyres["front"], rear=tyres["rear"]),
        }
    )


def plan_cars(
    cars: int, drives: int, seed: int, folder: Path, base: VehicleParameters, kinds: tuple[str, ...] = KINDS
) -> list[Job]:
    """Draw the cars, write their files into ``folder``/cars and return the drives; one seed, one set."""
    (folder / "cars").mkdir(parents=True, exist_ok=True)
    jobs = []
    for index in range(cars):
        rng = np.random.default_rng(np.random.SeedSequence(entropy=seed, spawn_key=(500, index)))
        car = draw_car(rng, base, kinds)
        file = f"cars/car_{index:04d}.toml"
        (folder / file).write_text(vehicle_toml(car.vehicle), encoding="utf-8")
        place = (index + 0.5) / cars
        facts: list[tuple[str, Any]] = [
            ("vehicle_file", file),
            ("split", next(name for name, end in SPLITS if place < end)),
        ]
        for number in range(drives):
            candidates = tuple(_spec(rng, car) for _ in range(_ATTEMPTS))
            jobs.append(Job(f"car_{index:04d}_{number}.mcap", candidates, (*facts, ("car", index))))
    return jobs


def _spec(rng: np.random.Generator, car: DrawnCar) -> DriveSpec:
    return replace(draw_spec(rng, duration_s=DRIVE_S, vehicle=car.text), sensors=car.sensors)


def write_cars(
    folder: Path, *, cars: int, drives: int, seed: int, jobs: int = 1, kinds: tuple[str, ...] = KINDS
) -> dict[str, Any]:
    """Write a set of many cars and its manifest; drives that are there as they should be are kept."""
    planned = plan_cars(cars, drives, seed, folder, load_vehicle(BASE), kinds)
    head = {"command": "python -m studies.many_cars", "seed": seed, "cars": cars, "drives_per_car": drives}
    return run_jobs(planned, folder, head, processes=jobs)


def identify_cars(folder: Path) -> list[str]:
    """Identify the cars of a set on their first drives; return the logs of the others.

    Those of the others are in a manifest of their own in ``folder``/residuals, with the files of the identified cars.
    """
    manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    by_car: dict[int, list[dict[str, Any]]] = {}
    for entry in manifest["drives"]:
        if "sha256" in entry:
            by_car.setdefault(entry["car"], []).append(entry)
    others, mapping = folder / "residuals", folder / MAPPING_FILE
    others.mkdir(exist_ok=True)
    mapping.write_text(MAPPING, encoding="utf-8")
    kept = []
    for index, entries in by_car.items():
        name = f"car_{index:04d}"
        if not (others / name / FIT_FILE).is_file():
            vehicle_file, logs = folder / entries[0]["vehicle_file"], [folder / e["file"] for e in entries[:FIT_DRIVES]]
            (others / name).mkdir(exist_ok=True)
            shutil.copy(vehicle_file, others / name / VEHICLE_FILE)
            (others / name / FIT_FILE).write_text(identified(vehicle_file, logs, mapping), encoding="utf-8")
        for entry in entries[FIT_DRIVES:]:
            link = others / entry["file"]
            if not link.exists():
                link.hardlink_to(folder / entry["file"])
            kept.append({**entry, "vehicle_file": name})
    (others / "manifest.json").write_text(json.dumps({**manifest, "drives": kept}), encoding="utf-8")
    return [str(others / e["file"]) for e in kept]


def identified(file: Path, logs: Sequence[Path], mapping: Path) -> str:
    """Return the fit of a car with its ``physics`` as the tool identifies it on drives."""
    vehicle, given = load_vehicle(file), load_mapping(mapping)
    read = (load_fit_drive(LogInput(log, log.stem), Car.of(vehicle), given, ReadOptions())[1] for log in logs)
    drives = [drive for drive in read if drive is not None]
    fitted = fit_physics(drives, vehicle, PARTS, starts=({},), iterations=FIT_ITERATIONS)
    values = FittedValues.of(fitted.vehicle)
    noise = fitted.noise.model_copy(update={"physics_sha256": physics_sha256(values.applied_to(vehicle))})
    fit = Fit(physics_sha256=physics_sha256(vehicle), physics=FittedPhysics(values=values, noise=noise))
    return part_toml(fit, "Written by python -m studies.many_cars.")


def main() -> None:
    """Simulate, extract and train. Drives and residuals that exist already are kept."""
    options("many_cars", __doc__).parse_args()
    write_cars(CARS_FOLDER, cars=CARS, drives=DRIVES_PER_CAR, seed=SEED, jobs=2)
    logs = identify_cars(CARS_FOLDER)
    mapping = CARS_FOLDER / "extract.toml"
    mapping.write_text(TRAINING_MAPPING, encoding="utf-8")
    pdhef("extract", *logs, "-o", DATA, "--mapping", mapping, "--jobs", 2, "--resume")
    recipe = Recipe(seed=0, epochs=EPOCHS, feature_names=FEATURES)
    folder = SHIPPED_FOLDERS[MANY_CARS]
    train_on(dataset_for(DATA, PHYSICS_MODEL), folder, recipe, progress=lambda text, _share: print(text, flush=True))


if __name__ == "__main__":
    main()
