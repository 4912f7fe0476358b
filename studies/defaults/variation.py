"""Random errors of friction and vehicle file, constant over a drive: intervals have to cover both."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterator

import numpy as np

from pdhef_logtool.car.vehicle import AxleTyre, VehicleParameters

#: Share of the draws that are skipped.
UNVARIED_SHARE = 0.4
#: 1-sigma of the natural logarithm, as multiples of the requested spread. The mass has all inertia; stiffness and peak
#: are common to both axles, and each axle has another factor on its stiffness.
SPREADS = {
    "friction": 1.5, "mass": 0.7, "inertia": 0.7, "stiffness": 1.0, "stiffness_of_axle": 0.5, "peak": 0.5, "roll": 1.5
}  # fmt: skip
#: 1-sigma of the shift of the CG as a share of the wheelbase, times the spread.
CG_SHIFT = 0.2
#: Limit of a draw in multiples of 1-sigma.
LIMIT = 2.5


def made_wrong(vehicle: VehicleParameters, spread: float, key: str) -> Iterator[tuple[VehicleParameters, float]]:
    """Yield the variations of a key: vehicles, and factors on every friction.

    ``spread`` is the approximate relative 1-sigma of the stiffness.
    """
    for number in itertools.count():
        rng = np.random.default_rng(int.from_bytes(hashlib.sha256(f"{key}:{number}".encode()).digest()[:8]))
        if rng.uniform() >= UNVARIED_SHARE:
            yield _drawn(vehicle, spread, rng)


def _drawn(vehicle: VehicleParameters, spread: float, rng: np.random.Generator) -> tuple[VehicleParameters, float]:
    def normal() -> float:
        return float(np.clip(rng.standard_normal(), -LIMIT, LIMIT))

    factor = {name: float(np.exp(spread * sigma * normal())) for name, sigma in SPREADS.items()}
    shift = CG_SHIFT * spread * vehicle.wheelbase_m * normal()
    of_axle = {
        "front": factor["stiffness_of_axle"],
        "rear": float(np.exp(spread * SPREADS["stiffness_of_axle"] * normal())),
    }

    def tyre(axle: str) -> AxleTyre:
        old: AxleTyre = getattr(vehicle.tyres, axle)
        assert old.B is not None and old.D_n is not None
        B = old.B * (factor["stiffness"] * of_axle[axle]) / factor["peak"]
        return old.model_copy(update={"B": B, "D_n": old.D_n * factor["peak"]})

    update = {
        "mass_kg": vehicle.mass_kg * factor["mass"],
        "yaw_inertia_kg_m2": vehicle.yaw_inertia_kg_m2 * factor["mass"] * factor["inertia"],
        "cg_to_front_axle_m": vehicle.cg_to_front_axle_m + shift,
        "cg_to_rear_axle_m": vehicle.cg_to_rear_axle_m - shift,
        "roll_gradient_rad_per_m_s2": vehicle.roll_gradient_rad_per_m_s2 * factor["roll"],
        "friction": None if vehicle.friction is None else vehicle.friction * factor["friction"],
        "tyres": vehicle.tyres.model_copy(update={axle: tyre(axle) for axle in of_axle}),
    }
    return vehicle.model_copy(update=update), factor["friction"]
