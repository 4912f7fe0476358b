"""Values that a vehicle file leaves out, from rules that scale with mass and wheelbase.

A file needs the mass, and the wheelbase with the front axle's share of the weight (or both axle distances). Lengths
scale with the wheelbase, times with its square root, and axle stiffness with the axle load. Each rule has a relative
standard deviation over vehicles, which a calibration uses as its prior and intervals must cover.
"""

import math
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from pdhef_logtool.car.vehicle import GRAVITY_M_S2, SHORTEST_ROAD_CAR_M, VehicleParameters, default_vehicle

#: Share of the static weight on the front axle of a passenger car, if the file gives none. 0.63 for front-wheel drive,
#: 0.50 for rear-engined and sports cars.
FRONT_WEIGHT_SHARE, FRONT_WEIGHT_SHARE_SPREAD = 0.56, 0.08
#: Relative uncertainty of the distance from the rear axle to the centre of gravity for a car without any file: 1.71 m
#: for the default sedan, 1.46 ± 0.18 m for wheelbases of 2.4 to 3.0 m with 45 to 62 % on the front axle.
DEFAULT_CG_SPREAD = 0.18


@dataclass(frozen=True, slots=True)
class AssumedValue:
    """A missing entry: dotted name, value, relative standard deviation over vehicles, and rule."""

    entry: str
    value: float
    spread: float
    rule: str


def stiffness_per_load(mass_kg: float) -> float:
    """Return cornering stiffness over axle load in 1/rad by the class of vehicle.

    14.5 for cars, 6 for heavy trucks and for models below 50 kg; between the classes linear in the logarithm of mass.
    """
    return float(np.interp(math.log(mass_kg), np.log([50.0, 400.0, 4000.0, 12_000.0]), [6.0, 14.5, 14.5, 6.0]))


#: Rules by entry, in the order of their dependence: each computes it from the entries before it, including axle loads
#: in N.
_FORMULAS: dict[str, Callable[[Mapping[str, float]], float]] = {
    "yaw_inertia_kg_m2": lambda v: v["mass_kg"] * v["cg_to_front_axle_m"] * v["cg_to_rear_axle_m"],
    "track_m": lambda v: min(0.547 * v["wheelbase_m"], 2.1),
    "cg_height_m": lambda v: 0.2 * v["wheelbase_m"],
    "wheel_radius_m": lambda v: 0.11 * v["wheelbase_m"],
    "relaxation_length_m": lambda v: v["wheel_radius_m"] / 0.6,
    "cg_over_roll_axis_m": lambda v: 0.625 * v["cg_height_m"],
    "roll_frequency_rad_s": lambda v: 11.0 * math.sqrt(2.87 / v["wheelbase_m"]),
    "low_speed_blend_m_s": lambda v: 0.5655 * math.sqrt(GRAVITY_M_S2 * v["wheelbase_m"]),
    "tyres.front.cornering_stiffness_n_per_rad": lambda v: 0.97 * stiffness_per_load(v["mass_kg"]) * v["front_load_n"],
    "tyres.rear.cornering_stiffness_n_per_rad": lambda v: 1.03 * stiffness_per_load(v["mass_kg"]) * v["rear_load_n"],
}
#: Their spreads and words, by entry.
RULES = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))


def completed(raw: Mapping[str, Any]) -> tuple[dict[str, Any], tuple[AssumedValue, ...]]:
    """Return the completed entries of a vehicle file, and the assumed values.

    ``wheelbase_m`` and ``front_weight_share`` become the axle distances. Wrong entries are kept, because the validation
    reports them. No value is assumed unless mass and geometry are positive numbers.
    """
    entries: dict[str, Any] = {k: dict(v) if isinstance(v, Mapping) else v for k, v in raw.items()}
    assumed: list[AssumedValue] = []
    _axle_distances(entries, assumed)
    needed = ("mass_kg", "cg_to_front_axle_m", "cg_to_rear_axle_m")
    if not all(_is_positive(entries.get(name)) for name in needed):
        return entries, tuple(assumed)
    values = {name: float(entries[name]) for name in needed}
    front, rear = values["cg_to_front_axle_m"], values["cg_to_rear_axle_m"]
    weight_n = values["mass_kg"] * GRAVITY_M_S2
    values |= {"wheelbase_m": front + rear}
    values |= {"front_load_n": weight_n * rear / (front + rear), "rear_load_n": weight_n * front / (front + rear)}
    for entry, formula in _FORMULAS.items():
        *tables, name = entry.split(".")
        if tables and "tyres" in raw:
            continue
        table = entries
        for inner in tables:
            table = table.setdefault(inner, {})
        if name in table:
            values[name] = float(table[name]) if _is_positive(table[name]) else math.nan
            continue
        value = float(f"{formula(values):.4g}")
        table[name] = values[name] = value
        assumed.append(AssumedValue(entry, value, RULES[entry]["spread"], RULES[entry]["text"]))
    return entries, tuple(assumed)


def assumed_car(wheelbase_m: float) -> VehicleParameters:
    """Return the car that is assumed without a vehicle file: a model of this size, otherwise the default sedan."""
    sedan = default_vehicle()
    if not 0.15 <= wheelbase_m < SHORTEST_ROAD_CAR_M:
        return sedan
    # The power is that of 1:10 and 1:5 models; sideslip depends on forces over mass.
    mass_kg = sedan.mass_kg * (wheelbase_m / sedan.wheelbase_m) ** 2.5
    axles = dict.fromkeys(("cg_to_front_axle_m", "cg_to_rear_axle_m"), 0.5 * wheelbase_m)
    stated = {"name": f"model car of {wheelbase_m:.2g} m", "mass_kg": mass_kg, "friction": sedan.friction, **axles}
    raw, _ = completed(stated)
    return VehicleParameters.model_validate(raw)


def _axle_distances(entries: dict[str, Any], assumed: list[AssumedValue]) -> None:
    """Replace wheelbase and weight share by the axle distances, in place; complete the third of the three."""
    wheelbase, share = entries.get("wheelbase_m"), entries.get("front_weight_share")
    front, rear = entries.get("cg_to_front_axle_m"), entries.get("cg_to_rear_axle_m")
    if (front is not None and rear is not None) or not _is_positive(wheelbase):
        return  # an additional wheelbase is rejected as an unknown entry
    if front is not None or rear is not None:
        name, other = ("cg_to_rear_axle_m", front) if rear is None else ("cg_to_front_axle_m", rear)
        if _is_positive(other) and float(other) < float(wheelbase):
            entries[name] = float(entries.pop("wheelbase_m")) - float(other)
        return
    if share is None:
        share = FRONT_WEIGHT_SHARE
        text = "a passenger car's share of the weight on the front axle"
        assumed.append(AssumedValue("front_weight_share", share, FRONT_WEIGHT_SHARE_SPREAD, text))
    if not (_is_positive(share) and float(share) < 1.0):
        return
    for name in ("front_weight_share", "wheelbase_m"):
        entries.pop(name, None)
    entries["cg_to_front_axle_m"] = float(wheelbase) * (1.0 - float(share))
    entries["cg_to_rear_axle_m"] = float(wheelbase) * float(share)


def _is_positive(value: Any) -> TypeGuard[float]:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and math.isfinite(value) and value > 0
