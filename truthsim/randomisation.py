"""Other cars of the same kind, with the differences due to production, load, and wear of the tyres.

``randomise`` draws from the table ``SPREADS``. A draw that oversteers is repeated, as no such car is sold.
"""

import numpy as np

from truthsim.linear_theory import understeer_gradient_rad_per_m_s2
from truthsim.tyres import Tyre
from truthsim.vehicle import GRAVITY_M_S2, Vehicle

#: Relative half-widths of uniform factors, and their meaning.
SPREADS: dict[str, float] = {
    "load": 0.12,  # mass, between the driver alone and all seats with luggage; all inertias scale with it
    "inertia": 0.10,  # each of yaw, roll and pitch in addition: distribution of the load
    "cg_height": 0.06,
    "springs": 0.12,  # all four, each damper axle and each bar on its own
    "dampers": 0.25,  # they wear most
    "anti_roll": 0.15,
    "tyre_stiffness": 0.15,  # both axles together: make, wear, pressure
    "tyre_balance": 0.06,  # each axle on its own
    "relaxation": 0.30,  # both axles together
    "tyre_shape": 0.06,
    "tyre_load_sensitivity": 0.30,
    "tyre_vertical": 0.10,
    "compliance": 0.25,  # each axle on its own
    "drag": 0.15,
    "rolling_resistance": 0.25,
}
#: Half-width of the shift of the CG along the car, as a share of the wheelbase.
CG_SHIFT = 0.03
#: Minimum understeer of a draw: 0.5 degrees per g.
_LEAST_UNDERSTEER = np.radians(0.5) / GRAVITY_M_S2
_FRICTION = 0.85


def randomise(vehicle: Vehicle, seed: int) -> Vehicle:
    """Return another car of the vehicle's kind; the same seed gives the same car.

    Geometry that a maker fixes (track, wheelbase, wheel radius, roll centres, steering ratio, drive and brake split)
    is unchanged. ``SPREADS`` lists the drawn factors, each uniform in 1 ± its spread.
    """
    rng = np.random.default_rng(np.random.SeedSequence(entropy=seed, spawn_key=(200,)))
    while True:
        drawn = _draw(vehicle, rng)
        if understeer_gradient_rad_per_m_s2(drawn, _FRICTION) > _LEAST_UNDERSTEER:
            return drawn


def _draw(vehicle: Vehicle, rng: np.random.Generator) -> Vehicle:
    def factor(name: str) -> float:
        return float(1.0 + SPREADS[name] * rng.uniform(-1.0, 1.0))

    wheelbase = vehicle.cg_to_front_axle_m + vehicle.cg_to_rear_axle_m
    back = float(CG_SHIFT * wheelbase * rng.uniform(-1.0, 1.0))
    load, stiffness, relaxation = factor("load"), factor("tyre_stiffness"), factor("relaxation")
    tyre_vertical = factor("tyre_vertical")

    def tyre(of: Tyre) -> Tyre:
        return of._replace(
            stiffness_peak=of.stiffness_peak * stiffness * factor("tyre_balance"),
            lateral_shape=of.lateral_shape * factor("tyre_shape"),
            lateral_load_sensitivity=of.lateral_load_sensitivity * factor("tyre_load_sensitivity"),
            lateral_relaxation_m=of.lateral_relaxation_m * relaxation,
            lateral_relaxation_min_m=of.lateral_relaxation_min_m * relaxation,
            longitudinal_relaxation_m=of.longitudinal_relaxation_m * relaxation,
        )

    return vehicle._replace(
        mass_kg=vehicle.mass_kg * load,
        yaw_inertia_kg_m2=vehicle.yaw_inertia_kg_m2 * load * factor("inertia"),
        roll_inertia_kg_m2=vehicle.roll_inertia_kg_m2 * load * factor("inertia"),
        pitch_inertia_kg_m2=vehicle.pitch_inertia_kg_m2 * load * factor("inertia"),
        cg_to_front_axle_m=vehicle.cg_to_front_axle_m + back,
        cg_to_rear_axle_m=vehicle.cg_to_rear_axle_m - back,
        cg_height_m=vehicle.cg_height_m * factor("cg_height"),
        front_spring_n_per_m=vehicle.front_spring_n_per_m * factor("springs"),
        rear_spring_n_per_m=vehicle.rear_spring_n_per_m * factor("springs"),
        front_damper_n_s_per_m=vehicle.front_damper_n_s_per_m * factor("dampers"),
        rear_damper_n_s_per_m=vehicle.rear_damper_n_s_per_m * factor("dampers"),
        front_anti_roll_n_m_per_rad=vehicle.front_anti_roll_n_m_per_rad * factor("anti_roll"),
        rear_anti_roll_n_m_per_rad=vehicle.rear_anti_roll_n_m_per_rad * factor("anti_roll"),
        tyre_vertical_n_per_m=vehicle.tyre_vertical_n_per_m * tyre_vertical,
        front_compliance_rad_per_n=vehicle.front_compliance_rad_per_n * factor("compliance"),
        rear_compliance_rad_per_n=vehicle.rear_compliance_rad_per_n * factor("compliance"),
        rolling_resistance=vehicle.rolling_resistance * factor("rolling_resistance"),
        drag_area_m2=vehicle.drag_area_m2 * factor("drag"),
        front_tyre=tyre(vehicle.front_tyre),
        rear_tyre=tyre(vehicle.rear_tyre),
    )
