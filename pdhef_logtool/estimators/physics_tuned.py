"""``phy-ukf-tuned``: the physics filter with the noise that stands in the vehicle file, corrected for body roll."""

from __future__ import annotations

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.estimators.physics import PHY_UKF_Q_STD, PhysicsUkf

NAME = "phy-ukf-tuned"


def physics_ukf_tuned(vehicle: VehicleParameters, *, use_speed: bool = True) -> PhysicsUkf:
    """Return the filter of ``[filter.phy-ukf-tuned]``.

    ``q_std`` may leave out the a_x bias, ``r_std`` any measurement; what is left out is that of ``phy-ukf``.

    Raises
    ------
    KeyError
        The vehicle file has no such table.
    """
    tuning, sensors = vehicle.filter[NAME], vehicle.sensors
    q = (*tuning.q_std, *PHY_UKF_Q_STD[len(tuning.q_std) :])
    return PhysicsUkf(
        vehicle,
        q_std=(q[0], q[1], q[2], q[3]),
        r_std=(
            tuning.r_std.get("ay_m_s2", sensors.ay_std_m_s2),
            tuning.r_std.get("yaw_rate_rad_s", sensors.yaw_rate_std_rad_s),
            tuning.r_std.get("speed_m_s", sensors.speed_std_m_s),
        ),
        use_speed=use_speed,
        roll_correction=True,
        name=NAME,
    )
