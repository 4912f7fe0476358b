"""Random errors of friction and vehicle file in training data (docs/method.md#limits).

In operation, friction and vehicle of the nominal model differ from the real ones. A network trained with exact ones
would attribute the model error to other causes. A share of the drives of a training set is therefore extracted with a
nominal model with random errors, constant over a drive; features and targets follow from it as in operation.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.car.vehicle import AxleTyre, VehicleParameters

#: Share of the drives without variation: most logs have a good vehicle file.
UNVARIED_SHARE = 0.4
#: 1-sigma of the natural logarithm, as multiples of the requested spread.
SPREADS = {
    "friction": 1.5,
    "mass": 0.7,  # with all inertia
    "inertia": 0.7,
    "stiffness": 1.0,  # both axles
    "stiffness_of_axle": 0.5,  # each on its own
    "peak": 0.5,  # both axles
    "roll": 1.5,
}
#: 1-sigma of the shift of the CG as a share of the wheelbase, times the spread.
CG_SHIFT = 0.2
#: Largest spread.
MAX_VARIATION = 0.3
#: Limit of a draw in multiples of 1-sigma.
LIMIT = 2.5


@dataclass(frozen=True, slots=True)
class Variation:
    """Vehicle of the nominal model of a drive, and factor on every friction."""

    vehicle: VehicleParameters
    friction_factor: float


def vary(vehicle: VehicleParameters, spread: float, key: str) -> Variation:
    """Draw the vehicle and the friction factor of the nominal model of a drive.

    Parameters
    ----------
    spread : approximate relative 1-sigma of the stiffness; 0 for no variation.
    key : the same key gives the same draw, for instance the hash of the log and a seed.
    """
    rng = np.random.default_rng(int.from_bytes(hashlib.sha256(key.encode()).digest()[:8]))
    if spread == 0.0 or rng.uniform() < UNVARIED_SHARE:
        return Variation(vehicle, 1.0)

    def normal() -> float:
        return float(np.clip(rng.standard_normal(), -LIMIT, LIMIT))

    factor = {name: float(np.exp(spread * sigma * normal())) for name, sigma in SPREADS.items()}
    shift = CG_SHIFT * spread * vehicle.wheelbase_m * normal()
    axle = float(np.exp(spread * SPREADS["stiffness_of_axle"] * normal()))

    def tyre(old: AxleTyre, of_axle: float) -> AxleTyre:
        stiffness = factor["stiffness"] * of_axle
        if old.cornering_stiffness_n_per_rad is not None:
            changed = {"cornering_stiffness_n_per_rad": old.cornering_stiffness_n_per_rad * stiffness}
        else:
            assert old.B is not None and old.D_n is not None
            changed = {"B": old.B * stiffness / factor["peak"], "D_n": old.D_n * factor["peak"]}
        return old.model_copy(update=changed)

    tyres = vehicle.tyres.model_copy(
        update={
            "front": tyre(vehicle.tyres.front, factor["stiffness_of_axle"]),
            "rear": tyre(vehicle.tyres.rear, axle),
        }
    )
    varied = vehicle.model_copy(
        update={
            "mass_kg": vehicle.mass_kg * factor["mass"],
            "yaw_inertia_kg_m2": vehicle.yaw_inertia_kg_m2 * factor["mass"] * factor["inertia"],
            "cg_to_front_axle_m": vehicle.cg_to_front_axle_m + shift,
            "cg_to_rear_axle_m": vehicle.cg_to_rear_axle_m - shift,
            "roll_gradient_rad_per_m_s2": vehicle.roll_gradient_rad_per_m_s2 * factor["roll"],
            "friction": None if vehicle.friction is None else vehicle.friction * factor["friction"],
            "tyres": tyres,
        }
    )
    return Variation(varied, factor["friction"])
