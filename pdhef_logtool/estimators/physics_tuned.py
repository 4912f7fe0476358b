"""``phy-ukf:tuned``: the physics filter with noise that belongs to the car, corrected for body roll."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pdhef_logtool.car.parts import FilterNoise
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.estimators.physics import PHY_UKF_Q_STD, PhysicsUkf

if TYPE_CHECKING:
    from pdhef_logtool.car.car import Car
    from pdhef_logtool.estimators.presets import Options

NAME = "phy-ukf:tuned"


def physics_ukf_tuned(vehicle: VehicleParameters, noise: FilterNoise, *, use_speed: bool = True) -> PhysicsUkf:
    """Return the filter with a noise; what that leaves out is ``phy-ukf``'s."""
    q = (*noise.q_std, *PHY_UKF_Q_STD[len(noise.q_std) :])
    return PhysicsUkf(
        vehicle,
        q_std=(q[0], q[1], q[2], q[3]),
        r_std=noise.measurement_std(vehicle.sensors),
        use_speed=use_speed,
        roll_correction=True,
        name=NAME,
    )


def build(name: str, car: Car, options: Options) -> PhysicsUkf:
    """Return ``phy-ukf:tuned`` of a car that has noise for it."""
    return physics_ukf_tuned(car.vehicle, car.noise[name], use_speed=options.use_speed)
