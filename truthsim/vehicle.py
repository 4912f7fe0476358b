"""The simulated vehicle: a body with six degrees of freedom on four unsprung masses and four turning wheels.

Axes are ISO 8855. The car moves in the plane of the road: ``v_x, v_y`` are the velocity of the whole car's CG along
and across its heading, so that a_y = v̇_y + v_x r = (ΣF_y + weight across the road)/m is exact. On top of that
plane the sprung mass heaves, rolls (positive to the right) and pitches (positive nose down) on springs, dampers and
anti-roll bars; each unsprung mass moves up and down between them and its tyre's vertical spring, and may leave the
road. The links are swing arms from each wheel to the roll centre (across) and to the pitch centre (along): forces in
the links act on the wheel immediately, while forces in the springs follow the motion of the body. Tilts are small, so
the sprung mass is linear in them; yaw, tyres, steering and the attitude of the road are not. As the body leans, the
wheels move sideways relative to the CG of the whole car.

The interface of a vehicle is the lower half of the file: ``STATE_SIZE``, :func:`standing_state`, :func:`derivative`,
:func:`observe` with ``OBSERVED``. Other modules do not access the state vector.
"""

import math
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from pdhef_logtool.records.signals import FloatArray
from truthsim.tyres import Tyre, damped_slips, forces_n, slip_rates

GRAVITY_M_S2 = 9.80665
AIR_DENSITY_KG_M3 = 1.204


class Vehicle(NamedTuple):
    """A mid-size saloon with the paper's Table 3 mass and geometry, and otherwise typical values.

    See docs/method.md#simulator.

    ``truthsim/vehicles/`` contains this and other vehicles as files.
    """

    mass_kg: float = 1440.0
    #: One wheel with hub, brake and its share of the links.
    front_unsprung_mass_kg: float = 35.0
    rear_unsprung_mass_kg: float = 35.0
    #: Of the whole car about its CG.
    yaw_inertia_kg_m2: float = 1523.0
    #: Of the sprung mass about its own CG.
    roll_inertia_kg_m2: float = 480.0
    pitch_inertia_kg_m2: float = 1500.0
    cg_to_front_axle_m: float = 1.16
    cg_to_rear_axle_m: float = 1.71
    track_m: float = 1.57
    cg_height_m: float = 0.64
    wheel_radius_m: float = 0.30
    #: One wheel with hub and brake disc; in front with its share of the drive train.
    front_wheel_inertia_kg_m2: float = 1.6
    rear_wheel_inertia_kg_m2: float = 1.2
    #: Springs and dampers by travel of the wheel.
    front_spring_n_per_m: float = 42_000.0
    rear_spring_n_per_m: float = 32_000.0
    front_damper_n_s_per_m: float = 3000.0
    rear_damper_n_s_per_m: float = 2600.0
    #: Roll moment of the axle's bar per angle between body and axle.
    front_anti_roll_n_m_per_rad: float = 16_000.0
    rear_anti_roll_n_m_per_rad: float = 10_000.0
    tyre_vertical_n_per_m: float = 220_000.0
    tyre_vertical_n_s_per_m: float = 150.0
    front_roll_centre_height_m: float = 0.10
    rear_roll_centre_height_m: float = 0.10
    #: Height at which the links take the longitudinal force (anti-dive and anti-squat), m.
    pitch_centre_height_m: float = 0.15
    #: Steering-wheel angle per road-wheel angle; the input of the vehicle is the road-wheel angle at the rack.
    steering_ratio: float = 16.0
    #: Steering out of the bend under lateral force, per axle (front) and toe-in of the rear axle, rad/N.
    front_compliance_rad_per_n: float = 1.87e-6
    rear_compliance_rad_per_n: float = 1.07e-6
    #: Lag of these compliances, by the wheel's inertia on its bushes.
    compliance_lag_s: float = 0.0126
    #: 0 parallel steering, 1 both wheels on one turning centre.
    ackermann: float = 0.5
    front_drive_share: float = 1.0
    front_brake_share: float = 0.66
    rolling_resistance: float = 0.012
    drag_area_m2: float = 0.66
    front_tyre: Tyre = Tyre()
    rear_tyre: Tyre = Tyre()


#: Wheels are in the order front left, front right, rear left, rear right.
X, Y, YAW, V_X, V_Y, YAW_RATE = range(6)
HEAVE, HEAVE_RATE, ROLL, ROLL_RATE, PITCH, PITCH_RATE = range(6, 12)
ALTITUDE, COMPLIANCE_FRONT, COMPLIANCE_REAR = range(12, 15)
WHEEL_HEIGHT, WHEEL_RATE, SPIN, SLIP_X, SLIP_Y, BRAKE = 15, 19, 23, 27, 31, 35
STATE_SIZE = 39

#: Elastic angle of a standing wheel before it slips in its brake, rad; build-up time of a turning wheel's brake, s.
BRAKE_GIVE_RAD = 0.01
BRAKE_LAG_S = 0.005
BRAKE_DAMPING_S = 0.002

#: Inputs of the vehicle from the road: friction under the four wheels, bank (rad, positive to the
#: right), grade (rad, positive uphill), and how both change per metre driven (rad/m).
FRICTION, BANK, GRADE, BANK_PER_M, GRADE_PER_M = 0, 4, 5, 6, 7
ROAD_SIZE = 8

#: Observable quantities of a vehicle, in the order of :func:`observe`.
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
_FEEL = _FORCES + 16


def standing_state(vehicle: Vehicle, speed_m_s: float) -> FloatArray:
    """Return the state [STATE_SIZE] of straight, level running at a speed, at the origin, heading east."""
    state = np.zeros(STATE_SIZE)
    state[V_X] = speed_m_s
    state[SPIN : SPIN + 4] = speed_m_s / vehicle.wheel_radius_m
    state[BRAKE : BRAKE + 4] = np.sign(speed_m_s)
    return state


@register_jitable
def static_load_n(vehicle: Vehicle, wheel: int) -> float:
    """Vertical load (N) of one wheel of the car at rest on a level road."""
    wheelbase = vehicle.cg_to_front_axle_m + vehicle.cg_to_rear_axle_m
    arm = vehicle.cg_to_rear_axle_m if wheel < 2 else vehicle.cg_to_front_axle_m
    return float(0.5 * vehicle.mass_kg * GRAVITY_M_S2 * arm / wheelbase)


@register_jitable
def wheel_load_n(static_n: float, height_m: float, rate_m_s: float, vehicle: Vehicle) -> float:
    """Return the vertical load (N) by the height of the wheel above its rest position; 0 for a tyre off the road."""
    load = static_n - vehicle.tyre_vertical_n_per_m * height_m - vehicle.tyre_vertical_n_s_per_m * rate_m_s
    return float(max(load, 0.0))


@register_jitable
def compression(state: FloatArray, sprung_x_m: float, vehicle: Vehicle, wheel: int) -> tuple[float, float]:
    """Return the compression of a wheel's suspension relative to rest (m), and its rate (m/s)."""
    x = (vehicle.cg_to_front_axle_m if wheel < 2 else -vehicle.cg_to_rear_axle_m) - sprung_x_m
    y = 0.5 * vehicle.track_m if wheel % 2 == 0 else -0.5 * vehicle.track_m
    corner = state[HEAVE] + y * state[ROLL] - x * state[PITCH]
    corner_rate = state[HEAVE_RATE] + y * state[ROLL_RATE] - x * state[PITCH_RATE]
    return state[WHEEL_HEIGHT + wheel] - corner, state[WHEEL_RATE + wheel] - corner_rate


@register_jitable
def suspension_force_n(travel_m: float, rate_m_s: float, other_m: float, vehicle: Vehicle, front: bool) -> float:
    """Return the change of force from rest by spring, damper and bar, N; ``other_m``: compression on the other side.

    The bar twists by the difference of both compressions over the track.
    """
    spring = vehicle.front_spring_n_per_m if front else vehicle.rear_spring_n_per_m
    damper = vehicle.front_damper_n_s_per_m if front else vehicle.rear_damper_n_s_per_m
    bar = vehicle.front_anti_roll_n_m_per_rad if front else vehicle.rear_anti_roll_n_m_per_rad
    twist = bar * (travel_m - other_m) / (vehicle.track_m * vehicle.track_m)
    return float(spring * travel_m + damper * rate_m_s + twist)


@register_jitable
def wheel_steer_rad(state: FloatArray, steer_rad: float, vehicle: Vehicle, wheel: int) -> float:
    """Return the angle of a wheel in rad: front with partial Ackermann and compliance, rear with toe by compliance."""
    if wheel >= 2:
        return float(state[COMPLIANCE_REAR])
    wheelbase = vehicle.cg_to_front_axle_m + vehicle.cg_to_rear_axle_m
    inner = vehicle.ackermann * vehicle.track_m / (2.0 * wheelbase) * steer_rad * steer_rad
    side = 1.0 if wheel == 0 else -1.0
    return float(steer_rad + side * inner - state[COMPLIANCE_FRONT])


@register_jitable
def brake_grip_rate(grip: float, spin_rad_s: float) -> float:
    """Return the rate of the relative brake friction, −1 to 1 (Dahl's model of dry friction).

    It is ±1 for a turning wheel, and balances the load of a standing wheel, so that a car on a hill does not creep.
    """
    turning = abs(spin_rad_s)
    return (spin_rad_s - turning * grip) / (BRAKE_GIVE_RAD + turning * BRAKE_LAG_S)


@register_jitable
def road_rates_rad_s(state: FloatArray, road: FloatArray) -> tuple[float, float, float]:
    """Return the rotation rates of the road's plane under the moving car, rad/s: about x, about y, and heading rate.

    Turning on a bank also tips the plane, as the heading is about the vertical, which is not the road's normal.
    """
    heading_rate = state[YAW_RATE] / (math.cos(road[BANK]) * math.cos(road[GRADE]))
    about_x = state[V_X] * road[BANK_PER_M] + heading_rate * math.sin(road[GRADE])
    about_y = -state[V_X] * road[GRADE_PER_M] + heading_rate * math.sin(road[BANK])
    return about_x, about_y, heading_rate


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
    """Write the rate of the state and the observed quantities by the equations of motion."""
    v_x, v_y, yaw_rate = state[V_X], state[V_Y], state[YAW_RATE]
    lf, lr, radius = vehicle.cg_to_front_axle_m, vehicle.cg_to_rear_axle_m, vehicle.wheel_radius_m
    mass = vehicle.mass_kg
    front_unsprung, rear_unsprung = vehicle.front_unsprung_mass_kg, vehicle.rear_unsprung_mass_kg
    unsprung = 2.0 * (front_unsprung + rear_unsprung)
    sprung = mass - unsprung
    sprung_x = 2.0 * (rear_unsprung * lr - front_unsprung * lf) / sprung
    sprung_height = (mass * vehicle.cg_height_m - unsprung * radius) / sprung
    front_share = (lr + sprung_x) / (lf + lr)
    roll_axis_height = (
        front_share * vehicle.front_roll_centre_height_m + (1.0 - front_share) * vehicle.rear_roll_centre_height_m
    )
    roll_arm = sprung_height - roll_axis_height
    pitch_arm = sprung_height - vehicle.pitch_centre_height_m
    # The body leans about its roll and pitch centres, so the CG of the whole car moves relative to the wheels.
    lean, dive = sprung / mass * roll_arm, sprung / mass * pitch_arm
    wheels_left_m, wheels_left_m_s = lean * state[ROLL], lean * state[ROLL_RATE]
    wheels_back_m, wheels_back_m_s = dive * state[PITCH], dive * state[PITCH_RATE]

    road_x, road_y, heading_rate = road_rates_rad_s(state, road)
    cos_bank, cos_grade = math.cos(road[BANK]), math.cos(road[GRADE])
    weight_x = -GRAVITY_M_S2 * math.sin(road[GRADE])
    weight_y = -GRAVITY_M_S2 * math.sin(road[BANK]) * cos_grade
    # Normal acceleration: gravity, and the vertical curvature of the road.
    pressing = GRAVITY_M_S2 * cos_bank * cos_grade + road_x * v_y - road_y * v_x

    force_x, force_y, moment = 0.0, 0.0, 0.0
    axle_front, axle_rear = 0.0, 0.0
    lift, roll_moment, pitch_moment = 0.0, 0.0, 0.0
    for wheel in range(4):
        front = wheel < 2
        tyre = vehicle.front_tyre if front else vehicle.rear_tyre
        arm_x = lf if front else -lr
        arm_y = 0.5 * vehicle.track_m if wheel % 2 == 0 else -0.5 * vehicle.track_m
        at_x, at_y = arm_x - wheels_back_m, arm_y + wheels_left_m
        travel, travel_rate = compression(state, sprung_x, vehicle, wheel)
        other, _ = compression(state, sprung_x, vehicle, wheel ^ 1)
        static = static_load_n(vehicle, wheel)
        load = wheel_load_n(static, state[WHEEL_HEIGHT + wheel], state[WHEEL_RATE + wheel], vehicle)

        angle = wheel_steer_rad(state, steer_rad, vehicle, wheel)
        cos, sin = math.cos(angle), math.sin(angle)
        point_x = v_x - yaw_rate * at_y - wheels_back_m_s
        point_y = v_y + yaw_rate * at_x + wheels_left_m_s
        forward = point_x * cos + point_y * sin
        left = -point_x * sin + point_y * cos
        spin = state[SPIN + wheel]
        slip_x, slip_y = state[SLIP_X + wheel], state[SLIP_Y + wheel]
        used_x, used_y = damped_slips(tyre, slip_x, slip_y, forward, left, spin * radius)
        fx, fy, scaled = forces_n(tyre, used_x, used_y, load, road[FRICTION + wheel])
        rate[SLIP_X + wheel], rate[SLIP_Y + wheel] = slip_rates(
            tyre, slip_x, slip_y, scaled, forward, left, spin * radius
        )

        inertia = vehicle.front_wheel_inertia_kg_m2 if front else vehicle.rear_wheel_inertia_kg_m2
        drive_share = vehicle.front_drive_share if front else 1.0 - vehicle.front_drive_share
        brake_share = vehicle.front_brake_share if front else 1.0 - vehicle.front_brake_share
        brake = 0.5 * brake_share * brake_n_m
        grip, grip_rate = state[BRAKE + wheel], brake_grip_rate(state[BRAKE + wheel], spin)
        rate[BRAKE + wheel] = grip_rate
        resistance = vehicle.rolling_resistance * load * radius * math.tanh(spin / 0.5)
        braking = brake * (grip + BRAKE_DAMPING_S * grip_rate)
        driving = 0.5 * drive_share * drive_n_m
        spinning_up = driving - braking - resistance - radius * fx
        rate[SPIN + wheel] = spinning_up / inertia

        body_x = fx * cos - fy * sin
        body_y = fx * sin + fy * cos
        force_x += body_x
        force_y += body_y
        moment += at_x * body_y - at_y * body_x
        if front:
            axle_front += fy
        else:
            axle_rear += fy

        # The springs at the wheel support the body, the swing arms at their pivots.
        roll_centre = vehicle.front_roll_centre_height_m if front else vehicle.rear_roll_centre_height_m
        spring = suspension_force_n(travel, travel_rate, other, vehicle, front)
        pivot_y = -roll_centre * body_y / arm_y
        # Brakes act within the wheel assembly; drive shafts transmit torque from the body and react on it.
        pivot_x = -(vehicle.pitch_centre_height_m * body_x + spinning_up - driving) / arm_x
        lift += spring + pivot_x + pivot_y
        roll_moment += arm_y * (spring + pivot_x)
        pitch_moment -= (arm_x - sprung_x) * (spring + pivot_y) - sprung_x * pivot_x + driving
        rate[WHEEL_RATE + wheel] = load - static - spring - pivot_x - pivot_y
        observed[_FORCES + wheel] = fx
        observed[_FORCES + 4 + wheel] = fy
        observed[_FORCES + 8 + wheel] = load
        observed[_FORCES + 12 + wheel] = -math.atan2(left, forward) if abs(forward) > 0.5 else 0.0
        observed[_FEEL + 16 + wheel] = travel

    drag = 0.5 * AIR_DENSITY_KG_M3 * vehicle.drag_area_m2 * v_x * abs(v_x)  # at the sprung mass's CG
    force_x -= drag
    # Accelerations in the plane of the road, and specific force: without the component of gravity.
    a_x, a_y = force_x / mass + weight_x, force_y / mass + weight_y
    felt_x, felt_y = a_x - weight_x, a_y - weight_y
    yaw_acceleration = moment / vehicle.yaw_inertia_kg_m2

    rate[X] = v_x * cos_grade * math.cos(state[YAW]) - v_y * cos_bank * math.sin(state[YAW])
    rate[Y] = v_x * cos_grade * math.sin(state[YAW]) + v_y * cos_bank * math.cos(state[YAW])
    # Height of the road's middle: lateral motion in a banked bend does not change it.
    rate[ALTITUDE] = v_x * math.sin(road[GRADE])
    rate[YAW] = heading_rate
    rate[V_X] = a_x + v_y * yaw_rate
    rate[V_Y] = a_y - v_x * yaw_rate
    rate[YAW_RATE] = yaw_acceleration

    # Longitudinal acceleration of unsprung masses loads the pitch arms; laterally, both sides of an axle cancel.
    arm_pull = (radius - vehicle.pitch_centre_height_m) * felt_x
    inertia_lift = -2.0 * arm_pull * (front_unsprung / lf - rear_unsprung / lr)
    lift += inertia_lift
    pitch_moment += sprung_x * inertia_lift
    supporting = sprung * GRAVITY_M_S2 + lift
    # About the sprung mass's CG, which moves relative to the whole car's by the unsprung share of the lean.
    roll_inertia = vehicle.roll_inertia_kg_m2 + sprung * roll_arm * roll_arm * unsprung / mass
    pitch_inertia = vehicle.pitch_inertia_kg_m2 + sprung * pitch_arm * pitch_arm * unsprung / mass
    roll_moment += roll_arm * (sprung * (felt_y + sprung_x * yaw_acceleration) + supporting * state[ROLL])
    pitch_moment += pitch_arm * (-sprung * felt_x - drag + supporting * state[PITCH])
    roll_acceleration = roll_moment / roll_inertia
    pitch_acceleration = pitch_moment / pitch_inertia
    heave_acceleration = lift / sprung + GRAVITY_M_S2 - pressing
    rate[HEAVE], rate[HEAVE_RATE] = state[HEAVE_RATE], heave_acceleration
    rate[ROLL], rate[ROLL_RATE] = state[ROLL_RATE], roll_acceleration
    rate[PITCH], rate[PITCH_RATE] = state[PITCH_RATE], pitch_acceleration

    for wheel in range(4):
        front = wheel < 2
        unsprung_mass = front_unsprung if front else rear_unsprung
        roll_centre = vehicle.front_roll_centre_height_m if front else vehicle.rear_roll_centre_height_m
        arm_x = lf if front else -lr
        arm_y = 0.5 * vehicle.track_m if wheel % 2 == 0 else -0.5 * vehicle.track_m
        across = (radius - roll_centre) * (felt_y + lean * roll_acceleration + arm_x * yaw_acceleration)
        rate[WHEEL_HEIGHT + wheel] = state[WHEEL_RATE + wheel]
        rate[WHEEL_RATE + wheel] = (
            rate[WHEEL_RATE + wheel] / unsprung_mass + across / arm_y + arm_pull / arm_x + GRAVITY_M_S2 - pressing
        )
    lag = vehicle.compliance_lag_s
    rate[COMPLIANCE_FRONT] = (vehicle.front_compliance_rad_per_n * axle_front - state[COMPLIANCE_FRONT]) / lag
    rate[COMPLIANCE_REAR] = (vehicle.rear_compliance_rad_per_n * axle_rear - state[COMPLIANCE_REAR]) / lag

    observed[6], observed[7], observed[8] = a_x, a_y, yaw_acceleration
    observed[_FEEL + 6], observed[_FEEL + 7] = felt_x, felt_y
    observed[_FEEL + 8] = pressing + heave_acceleration


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

    ``steer_rad`` is the mean angle of the front wheels at the rack; the vehicle adds compliance.
    ``road`` [ROAD_SIZE] contains the friction of the wheels, bank and grade (see ``FRICTION`` and below).
    ``scratch`` [OBSERVED_SIZE] is overwritten.
    """
    _motion(state, steer_rad, drive_n_m, brake_n_m, road, vehicle, rate, scratch)


@register_jitable
def see(state: FloatArray, observed: FloatArray) -> None:
    """Write only the first six columns of ``OBSERVED``: pose, velocities and yaw rate, the inputs of the driver."""
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
    """Write the quantities of ``OBSERVED`` [OBSERVED_SIZE]; ``scratch`` [STATE_SIZE] is overwritten.

    ``ax_m_s2`` and ``ay_m_s2`` are accelerations of the CG in the plane of the road (without gravity),
    ``yaw_rate_rad_s`` is about the road's normal; forces are in the wheels' frames. Roll, pitch and their rates are
    relative to the horizon: body and road together. ``specific_force`` and ``gyro`` are readings of perfect body-fixed
    sensors at the CG.
    """
    _motion(state, steer_rad, drive_n_m, brake_n_m, road, vehicle, scratch, observed)
    see(state, observed)
    road_x, road_y, _ = road_rates_rad_s(state, road)
    roll, pitch = state[ROLL], state[PITCH]
    observed[9], observed[10] = road[BANK] + roll, state[V_X] * road[BANK_PER_M] + state[ROLL_RATE]
    observed[11], observed[12] = pitch - road[GRADE], state[PITCH_RATE] - state[V_X] * road[GRADE_PER_M]
    observed[13] = steer_rad
    for wheel in range(4):
        observed[14 + wheel] = state[SPIN + wheel]
        observed[_FEEL + 12 + wheel] = road[FRICTION + wheel]
    observed[_FEEL], observed[_FEEL + 1] = state[ALTITUDE], state[HEAVE]
    observed[_FEEL + 2], observed[_FEEL + 3] = road[BANK], road[GRADE]
    observed[_FEEL + 4], observed[_FEEL + 5] = scratch[ROLL_RATE], scratch[PITCH_RATE]
    # From the road's plane into the body: Rx(roll)ᵀ Ry(pitch)ᵀ.
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    felt_x, felt_y, felt_z = observed[_FEEL + 6], observed[_FEEL + 7], observed[_FEEL + 8]
    up = sp * felt_x + cp * felt_z
    observed[_FEEL + 6] = cp * felt_x - sp * felt_z
    observed[_FEEL + 7] = cr * felt_y + sr * up
    observed[_FEEL + 8] = cr * up - sr * felt_y
    turn = sp * road_x + cp * state[YAW_RATE]
    across = road_y + state[PITCH_RATE]
    observed[_FEEL + 9] = state[ROLL_RATE] + cp * road_x - sp * state[YAW_RATE]
    observed[_FEEL + 10] = cr * across + sr * turn
    observed[_FEEL + 11] = cr * turn - sr * across
