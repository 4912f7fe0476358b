"""The truth vehicle: a planar two-track car with roll, pitch, load transfer, wheel spin and tyre relaxation.

Axes are ISO 8855. ``v_x, v_y`` are the velocity of the CG in the horizontal frame that turns with the yaw angle, so
that a_y = v̇_y + v_x r = ΣF_y/m holds exactly. The sprung mass rolls about the roll axis: the contact points move
sideways against the CG by the roll rate. Loads follow the springs, and where the suspension links carry force
directly (roll centre, anti-dive) they follow the accelerations with the lag of the wheels' own bounce.

What another vehicle must offer to take this one's place is the lower half of the file: ``STATE_SIZE``,
:func:`standing_state`, :func:`derivative`, :func:`observe` with ``OBSERVED``. Nothing else reads the state vector.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from pdhef_logtool.signals import FloatArray
from truthsim.tyres import Tyre, damped_slips, forces_n, slip_rates

GRAVITY_M_S2 = 9.80665
AIR_DENSITY_KG_M3 = 1.204


class Vehicle(NamedTuple):
    """A mid-size saloon with the paper's Table 3 mass and geometry; the rest are typical values (METHOD §13)."""

    mass_kg: float = 1440.0
    sprung_mass_kg: float = 1300.0
    yaw_inertia_kg_m2: float = 1523.0
    roll_inertia_kg_m2: float = 480.0
    pitch_inertia_kg_m2: float = 1500.0
    cg_to_front_axle_m: float = 1.16
    cg_to_rear_axle_m: float = 1.71
    track_m: float = 1.57
    cg_height_m: float = 0.64
    roll_centre_height_m: float = 0.10
    wheel_radius_m: float = 0.30
    #: One wheel with hub and brake disc; in front with its share of the drive train.
    front_wheel_inertia_kg_m2: float = 1.6
    rear_wheel_inertia_kg_m2: float = 1.2
    roll_stiffness_n_m_per_rad: float = 92000.0
    roll_damping_n_m_s_per_rad: float = 4300.0
    front_roll_share: float = 0.57
    pitch_stiffness_n_m_per_rad: float = 160000.0
    pitch_damping_n_m_s_per_rad: float = 10000.0
    #: Height at which the links take the longitudinal force (anti-dive and anti-squat), m.
    pitch_centre_height_m: float = 0.15
    #: Lag of link forces and compliances: a 35 kg wheel on a 220 kN/m tyre.
    link_lag_s: float = 0.0126
    #: Steering out of the bend under lateral force, per axle (front) and toe-in of the rear axle, rad/N.
    #: Steering-wheel angle per road-wheel angle; the vehicle is steered by the latter, as the rack has it.
    steering_ratio: float = 16.0
    front_compliance_rad_per_n: float = 1.87e-6
    rear_compliance_rad_per_n: float = 1.07e-6
    #: 0 parallel steering, 1 both wheels on one turning centre.
    ackermann: float = 0.5
    front_drive_share: float = 1.0
    front_brake_share: float = 0.66
    rolling_resistance: float = 0.012
    drag_area_m2: float = 0.66
    tyre: Tyre = Tyre()


#: Wheels are in the order front left, front right, rear left, rear right.
X, Y, YAW, V_X, V_Y, YAW_RATE, ROLL, ROLL_RATE, PITCH, PITCH_RATE = range(10)
LINK_A_X, LINK_A_Y, COMPLIANCE_FRONT, COMPLIANCE_REAR = range(10, 14)
SPIN, SLIP_X, SLIP_Y = 14, 18, 22
STATE_SIZE = 26

#: What the vehicle is told of the road where it stands: friction under the four wheels, bank (rad, positive to the
#: right), grade (rad, positive uphill), and how both change per metre driven (rad/m).
FRICTION, BANK, GRADE, BANK_PER_M, GRADE_PER_M = 0, 4, 5, 6, 7
ROAD_SIZE = 8

#: What the world may know of a vehicle, in the order of :func:`observe`.
OBSERVED = (
    "x_m",
    "y_m",
    "yaw_rad",
    "vx_m_s",
    "vy_m_s",
    "yaw_rate_rad_s",
    "ax_m_s2",
    "ay_m_s2",
    "yaw_acceleration_rad_s2",
    "roll_rad",
    "roll_rate_rad_s",
    "pitch_rad",
    "pitch_rate_rad_s",
    "steer_rad",
    *(f"spin_{w}_rad_s" for w in ("fl", "fr", "rl", "rr")),
    *(f"fx_{w}_n" for w in ("fl", "fr", "rl", "rr")),
    *(f"fy_{w}_n" for w in ("fl", "fr", "rl", "rr")),
    *(f"fz_{w}_n" for w in ("fl", "fr", "rl", "rr")),
    *(f"slip_angle_{w}_rad" for w in ("fl", "fr", "rl", "rr")),
    "z_m",
    "heave_m",
    "bank_rad",
    "grade_rad",
    "roll_acceleration_rad_s2",
    "pitch_acceleration_rad_s2",
    "specific_force_x_m_s2",
    "specific_force_y_m_s2",
    "specific_force_z_m_s2",
    "gyro_x_rad_s",
    "gyro_y_rad_s",
    "gyro_z_rad_s",
    *(f"friction_{w}" for w in ("fl", "fr", "rl", "rr")),
    *(f"suspension_{w}_m" for w in ("fl", "fr", "rl", "rr")),
)
OBSERVED_SIZE = len(OBSERVED)
_FORCES = 18


def standing_state(vehicle: Vehicle, speed_m_s: float) -> FloatArray:
    """Return the state [STATE_SIZE] of straight, level running at a speed, at the origin, heading east."""
    state = np.zeros(STATE_SIZE)
    state[V_X] = speed_m_s
    state[SPIN : SPIN + 4] = speed_m_s / vehicle.wheel_radius_m
    return state


@register_jitable
def wheel_loads_n(state: FloatArray, vehicle: Vehicle, loads_n: FloatArray) -> None:
    """Write the vertical loads [4] in N; they always add up to m g, and a wheel that lifts hands all to its partner."""
    wheelbase = vehicle.cg_to_front_axle_m + vehicle.cg_to_rear_axle_m
    weight = vehicle.mass_kg * GRAVITY_M_S2
    unsprung_kg = vehicle.mass_kg - vehicle.sprung_mass_kg
    above_pitch_centre = vehicle.wheel_radius_m - vehicle.pitch_centre_height_m
    above_roll_centre = vehicle.wheel_radius_m - vehicle.roll_centre_height_m
    pitch_moment = (
        (vehicle.mass_kg * vehicle.pitch_centre_height_m + unsprung_kg * above_pitch_centre) * state[LINK_A_X]
        - vehicle.pitch_stiffness_n_m_per_rad * state[PITCH]
        - vehicle.pitch_damping_n_m_s_per_rad * state[PITCH_RATE]
    )
    spring_moment = (
        vehicle.roll_stiffness_n_m_per_rad * state[ROLL] + vehicle.roll_damping_n_m_s_per_rad * state[ROLL_RATE]
    )
    unsprung_moment = 0.5 * unsprung_kg * above_roll_centre * state[LINK_A_Y]
    link_moment = vehicle.mass_kg * vehicle.roll_centre_height_m * state[LINK_A_Y]
    front = weight * vehicle.cg_to_rear_axle_m / wheelbase - pitch_moment / wheelbase
    front = min(max(front, 0.0), weight)
    rear = weight - front
    to_right_front = (
        vehicle.front_roll_share * spring_moment + link_moment * vehicle.cg_to_rear_axle_m / wheelbase + unsprung_moment
    ) / vehicle.track_m
    to_right_rear = (
        (1.0 - vehicle.front_roll_share) * spring_moment
        + link_moment * vehicle.cg_to_front_axle_m / wheelbase
        + unsprung_moment
    ) / vehicle.track_m
    to_right_front = min(max(to_right_front, -0.5 * front), 0.5 * front)
    to_right_rear = min(max(to_right_rear, -0.5 * rear), 0.5 * rear)
    loads_n[0] = 0.5 * front - to_right_front
    loads_n[1] = 0.5 * front + to_right_front
    loads_n[2] = 0.5 * rear - to_right_rear
    loads_n[3] = 0.5 * rear + to_right_rear


@register_jitable
def wheel_steer_rad(state: FloatArray, steer_rad: float, vehicle: Vehicle, wheel: int) -> float:
    """Angle of one wheel in rad: mean steering with part Ackermann in front, less compliance; toe at the rear."""
    if wheel >= 2:
        return float(state[COMPLIANCE_REAR])
    wheelbase = vehicle.cg_to_front_axle_m + vehicle.cg_to_rear_axle_m
    inner = vehicle.ackermann * vehicle.track_m / (2.0 * wheelbase) * steer_rad * steer_rad
    side = 1.0 if wheel == 0 else -1.0
    return float(steer_rad + side * inner - state[COMPLIANCE_FRONT])


@register_jitable
def _motion(
    state: FloatArray,
    steer_rad: float,
    drive_n_m: float,
    brake_n_m: float,
    road: FloatArray,
    vehicle: Vehicle,
    rate: FloatArray,
    observed: FloatArray,
) -> None:
    """Fill the state's rate and what forces say about it; the one place where the equations of motion stand."""
    v_x, v_y, yaw_rate = state[V_X], state[V_Y], state[YAW_RATE]
    radius = vehicle.wheel_radius_m
    unsprung_kg = vehicle.mass_kg - vehicle.sprung_mass_kg
    sprung_height = (vehicle.mass_kg * vehicle.cg_height_m - unsprung_kg * radius) / vehicle.sprung_mass_kg
    roll_arm = sprung_height - vehicle.roll_centre_height_m
    pitch_arm = sprung_height - vehicle.pitch_centre_height_m
    contact_left_m_s = vehicle.sprung_mass_kg / vehicle.mass_kg * roll_arm * state[ROLL_RATE]
    loads = observed[_FORCES + 8 : _FORCES + 12]
    wheel_loads_n(state, vehicle, loads)
    force_x, force_y, moment = 0.0, 0.0, 0.0
    axle_front, axle_rear = 0.0, 0.0
    for wheel in range(4):
        front = wheel < 2
        at_x = vehicle.cg_to_front_axle_m if front else -vehicle.cg_to_rear_axle_m
        at_y = 0.5 * vehicle.track_m if wheel % 2 == 0 else -0.5 * vehicle.track_m
        angle = wheel_steer_rad(state, steer_rad, vehicle, wheel)
        cos, sin = math.cos(angle), math.sin(angle)
        point_x = v_x - yaw_rate * at_y
        point_y = v_y + yaw_rate * at_x + contact_left_m_s
        forward = point_x * cos + point_y * sin
        left = -point_x * sin + point_y * cos
        spin = state[SPIN + wheel]
        slip_x, slip_y = state[SLIP_X + wheel], state[SLIP_Y + wheel]
        used_x, used_y = damped_slips(vehicle.tyre, slip_x, slip_y, forward, left, spin * radius)
        fx, fy, scaled = forces_n(vehicle.tyre, used_x, used_y, loads[wheel], road[wheel])
        rate[SLIP_X + wheel], rate[SLIP_Y + wheel] = slip_rates(
            vehicle.tyre, slip_x, slip_y, scaled, forward, left, spin * radius
        )

        inertia = vehicle.front_wheel_inertia_kg_m2 if front else vehicle.rear_wheel_inertia_kg_m2
        drive_share = vehicle.front_drive_share if front else 1.0 - vehicle.front_drive_share
        brake_share = vehicle.front_brake_share if front else 1.0 - vehicle.front_brake_share
        brake = 0.5 * brake_share * brake_n_m
        # A brake only opposes turning. The width of the transition keeps its slope within what the step can follow.
        brake_sign = math.tanh(spin / max(0.5, brake / (inertia * 1000.0)))
        resistance = vehicle.rolling_resistance * loads[wheel] * radius * math.tanh(spin / 0.5)
        torque = 0.5 * drive_share * drive_n_m - brake * brake_sign - resistance - radius * fx
        rate[SPIN + wheel] = torque / inertia

        body_x = fx * cos - fy * sin
        body_y = fx * sin + fy * cos
        force_x += body_x
        force_y += body_y
        moment += at_x * body_y - at_y * body_x
        if front:
            axle_front += fy
        else:
            axle_rear += fy
        observed[_FORCES + wheel] = fx
        observed[_FORCES + 4 + wheel] = fy
        observed[_FORCES + 12 + wheel] = -math.atan2(left, forward) if abs(forward) > 0.5 else 0.0

    force_x -= 0.5 * AIR_DENSITY_KG_M3 * vehicle.drag_area_m2 * v_x * abs(v_x)
    a_x, a_y = force_x / vehicle.mass_kg, force_y / vehicle.mass_kg
    yaw_acceleration = moment / vehicle.yaw_inertia_kg_m2

    cos, sin = math.cos(state[YAW]), math.sin(state[YAW])
    rate[X] = v_x * cos - v_y * sin
    rate[Y] = v_x * sin + v_y * cos
    rate[YAW] = yaw_rate
    rate[V_X] = a_x + v_y * yaw_rate
    rate[V_Y] = a_y - v_x * yaw_rate
    rate[YAW_RATE] = yaw_acceleration
    # About the sprung mass's own CG, which moves against the whole car's by the unsprung share of the roll.
    roll_inertia = vehicle.roll_inertia_kg_m2 + vehicle.sprung_mass_kg * roll_arm * roll_arm * (
        unsprung_kg / vehicle.mass_kg
    )
    rate[ROLL] = state[ROLL_RATE]
    rate[ROLL_RATE] = (
        vehicle.sprung_mass_kg * roll_arm * (a_y + GRAVITY_M_S2 * state[ROLL])
        - vehicle.roll_stiffness_n_m_per_rad * state[ROLL]
        - vehicle.roll_damping_n_m_s_per_rad * state[ROLL_RATE]
    ) / roll_inertia
    rate[PITCH] = state[PITCH_RATE]
    rate[PITCH_RATE] = (
        vehicle.sprung_mass_kg * pitch_arm * (-a_x + GRAVITY_M_S2 * state[PITCH])
        - vehicle.pitch_stiffness_n_m_per_rad * state[PITCH]
        - vehicle.pitch_damping_n_m_s_per_rad * state[PITCH_RATE]
    ) / vehicle.pitch_inertia_kg_m2
    lag = vehicle.link_lag_s
    rate[LINK_A_X] = (a_x - state[LINK_A_X]) / lag
    rate[LINK_A_Y] = (a_y - state[LINK_A_Y]) / lag
    rate[COMPLIANCE_FRONT] = (vehicle.front_compliance_rad_per_n * axle_front - state[COMPLIANCE_FRONT]) / lag
    rate[COMPLIANCE_REAR] = (vehicle.rear_compliance_rad_per_n * axle_rear - state[COMPLIANCE_REAR]) / lag

    observed[6], observed[7], observed[8] = a_x, a_y, yaw_acceleration


@register_jitable
def derivative(
    state: FloatArray,
    steer_rad: float,
    drive_n_m: float,
    brake_n_m: float,
    road: FloatArray,
    vehicle: Vehicle,
    rate: FloatArray,
    scratch: FloatArray,
) -> None:
    """Write the rate [STATE_SIZE] of a state under a mean road-wheel angle and total drive and brake torques.

    ``steer_rad`` is the mean angle of the front wheels as the rack has it; compliance comes on top in the vehicle.
    ``road`` [ROAD_SIZE] holds the friction of the wheels, bank and grade (see ``FRICTION`` and below).
    ``scratch`` [OBSERVED_SIZE] is overwritten.
    """
    _motion(state, steer_rad, drive_n_m, brake_n_m, road, vehicle, rate, scratch)


@register_jitable
def see(state: FloatArray, observed: FloatArray) -> None:
    """Write the first six columns of ``OBSERVED`` only: pose, velocities and yaw rate, all that a driver looks at."""
    for i in range(6):
        observed[i] = state[i]


@register_jitable
def observe(
    state: FloatArray,
    steer_rad: float,
    drive_n_m: float,
    brake_n_m: float,
    road: FloatArray,
    vehicle: Vehicle,
    scratch: FloatArray,
    observed: FloatArray,
) -> None:
    """Write what ``OBSERVED`` names [OBSERVED_SIZE]; ``scratch`` [STATE_SIZE] is overwritten.

    ``ax_m_s2`` and ``ay_m_s2`` are planar (ΣF/m, no gravity); forces are in the wheels' own frames.
    """
    _motion(state, steer_rad, drive_n_m, brake_n_m, road, vehicle, scratch, observed)
    see(state, observed)
    observed[9], observed[10] = state[ROLL], state[ROLL_RATE]
    observed[11], observed[12] = state[PITCH], state[PITCH_RATE]
    observed[13] = steer_rad
    for wheel in range(4):
        observed[14 + wheel] = state[SPIN + wheel]
    roll, pitch = state[ROLL], state[PITCH]
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    up = sp * observed[6] + cp * GRAVITY_M_S2
    place = _FORCES + 16
    observed[place], observed[place + 1] = 0.0, 0.0
    observed[place + 2], observed[place + 3] = road[BANK], road[GRADE]
    observed[place + 4], observed[place + 5] = scratch[ROLL_RATE], scratch[PITCH_RATE]
    observed[place + 6] = cp * observed[6] - sp * GRAVITY_M_S2
    observed[place + 7] = cr * observed[7] + sr * up
    observed[place + 8] = -sr * observed[7] + cr * up
    level = state[YAW_RATE] * cp
    observed[place + 9] = state[ROLL_RATE] - state[YAW_RATE] * sp
    observed[place + 10] = state[PITCH_RATE] * cr + level * sr
    observed[place + 11] = level * cr - state[PITCH_RATE] * sr
    for wheel in range(4):
        observed[place + 12 + wheel] = road[FRICTION + wheel]
        observed[place + 16 + wheel] = 0.0
