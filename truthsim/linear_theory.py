"""Textbook linear theory of a vehicle, for comparison with the simulator.

This module shares no code with the simulation: gradients are closed forms; frequency responses are solved from the
linear equations of the single-track model with relaxing tyres, a rolling body and axles that roll on their tyres.
"""

import math

import numpy as np

from truthsim.tyres import Tyre
from truthsim.vehicle import Vehicle

_G = 9.80665


def tyre_stiffness_n_per_rad(tyre: Tyre, load_n: float, friction: float) -> float:
    """Pacejka's K = p1 F_z0 sin(2 atan(F_z / (p2 F_z0))), times the small power of friction."""
    grip = (friction / tyre.stiffness_friction) ** tyre.stiffness_friction_power
    sine = math.sin(2.0 * math.atan(load_n / (tyre.stiffness_load * tyre.nominal_load_n)))
    return float(grip * tyre.stiffness_peak * tyre.nominal_load_n * sine)


def axle_stiffness_n_per_rad(vehicle: Vehicle, friction: float) -> tuple[float, float]:
    """Cornering stiffness of the front and the rear axle under their static loads, without compliance."""
    lf, lr = vehicle.cg_to_front_axle_m, vehicle.cg_to_rear_axle_m
    half = 0.5 * vehicle.mass_kg * _G / (lf + lr)
    front = 2.0 * tyre_stiffness_n_per_rad(vehicle.front_tyre, half * lr, friction)
    rear = 2.0 * tyre_stiffness_n_per_rad(vehicle.rear_tyre, half * lf, friction)
    return front, rear


def understeer_gradient_rad_per_m_s2(vehicle: Vehicle, friction: float) -> float:
    """Road-wheel angle beyond L/R per lateral acceleration: m/L (l_r (1/C_f + c_f) − l_f (1/C_r − c_r))."""
    front, rear = axle_stiffness_n_per_rad(vehicle, friction)
    lf, lr = vehicle.cg_to_front_axle_m, vehicle.cg_to_rear_axle_m
    give_front = 1.0 / front + vehicle.front_compliance_rad_per_n
    give_rear = 1.0 / rear - vehicle.rear_compliance_rad_per_n
    return vehicle.mass_kg / (lf + lr) * (lr * give_front - lf * give_rear)


class _Roll:
    """Roll stiffness, damping and arms of a vehicle in linear theory."""

    def __init__(self, vehicle: Vehicle) -> None:
        half_square = 0.5 * vehicle.track_m**2
        self.unsprung = 2.0 * (vehicle.front_unsprung_mass_kg + vehicle.rear_unsprung_mass_kg)
        self.sprung = vehicle.mass_kg - self.unsprung
        lf, lr = vehicle.cg_to_front_axle_m, vehicle.cg_to_rear_axle_m
        self.sprung_x = 2.0 * (vehicle.rear_unsprung_mass_kg * lr - vehicle.front_unsprung_mass_kg * lf) / self.sprung
        height = (vehicle.mass_kg * vehicle.cg_height_m - self.unsprung * vehicle.wheel_radius_m) / self.sprung
        share = (lr + self.sprung_x) / (lf + lr)
        self.share_front = share
        self.centres = (vehicle.front_roll_centre_height_m, vehicle.rear_roll_centre_height_m)
        self.arm = height - share * self.centres[0] - (1.0 - share) * self.centres[1]
        self.stiffness = (
            vehicle.front_spring_n_per_m * half_square + vehicle.front_anti_roll_n_m_per_rad,
            vehicle.rear_spring_n_per_m * half_square + vehicle.rear_anti_roll_n_m_per_rad,
        )
        self.damping = (vehicle.front_damper_n_s_per_m * half_square, vehicle.rear_damper_n_s_per_m * half_square)
        self.tyre_stiffness = vehicle.tyre_vertical_n_per_m * half_square
        self.tyre_damping = vehicle.tyre_vertical_n_s_per_m * half_square
        self.axle_inertia = (
            vehicle.front_unsprung_mass_kg * half_square,
            vehicle.rear_unsprung_mass_kg * half_square,
        )
        self.axle_mass = (2.0 * vehicle.front_unsprung_mass_kg, 2.0 * vehicle.rear_unsprung_mass_kg)


def steady_roll(vehicle: Vehicle) -> tuple[float, tuple[float, float]]:
    """Roll angle (rad) and load transfer (N, inner to outer wheel, front and rear) per lateral acceleration (m/s²).

    Springs and bars of an axle are in series with its tyres. The body's moment about the roll axis is
    m_s h_arm (a_y + g φ); forces in the links of an axle (roll centre, axle mass) act on its tyres only.
    """
    roll = _Roll(vehicle)
    lf, lr, radius = vehicle.cg_to_front_axle_m, vehicle.cg_to_rear_axle_m, vehicle.wheel_radius_m
    axle_force = (vehicle.mass_kg * lr / (lf + lr), vehicle.mass_kg * lf / (lf + lr))
    links = [h * f + (radius - h) * m for h, f, m in zip(roll.centres, axle_force, roll.axle_mass, strict=True)]
    # Axle angle p: (k + t) p = k φ + links;  body: m_s arm (1 + g φ) = Σ k (φ − p).
    stiffness, moment = 0.0, roll.sprung * roll.arm
    for k, link in zip(roll.stiffness, links, strict=True):
        series = k * roll.tyre_stiffness / (k + roll.tyre_stiffness)
        stiffness += series
        moment += k * link / (k + roll.tyre_stiffness)
    angle = moment / (stiffness - roll.sprung * _G * roll.arm)
    transfers = [
        roll.tyre_stiffness * (k * angle + link) / (k + roll.tyre_stiffness) / vehicle.track_m
        for k, link in zip(roll.stiffness, links, strict=True)
    ]
    return angle, (transfers[0], transfers[1])


def frequency_response(
    vehicle: Vehicle, frequency_hz: float, speed_m_s: float, friction: float
) -> tuple[complex, complex, complex]:
    """Yaw rate (1/s), lateral acceleration (m/s²) and roll angle per road-wheel angle (rad) at one frequency.

    The steering angle is the rack's. Unknowns: v_y, r, F_f, F_r, roll, both axles' roll, a_y.
    """
    s = 2j * math.pi * frequency_hz
    v = speed_m_s
    roll = _Roll(vehicle)
    lf, lr, track, radius = (
        vehicle.cg_to_front_axle_m,
        vehicle.cg_to_rear_axle_m,
        vehicle.track_m,
        vehicle.wheel_radius_m,
    )
    stiffness = axle_stiffness_n_per_rad(vehicle, friction)
    give = 1.0 + vehicle.compliance_lag_s * s
    comply = (vehicle.front_compliance_rad_per_n / give, -vehicle.rear_compliance_rad_per_n / give)
    relax = tuple(1.0 + t.lateral_relaxation_m / v * s for t in (vehicle.front_tyre, vehicle.rear_tyre))
    lean = roll.sprung / vehicle.mass_kg * roll.arm
    # Yawing also changes the spin of outer and inner wheels.
    spin_inertia = (vehicle.front_wheel_inertia_kg_m2 + vehicle.rear_wheel_inertia_kg_m2) * track**2 / (2 * radius**2)
    inertia = vehicle.roll_inertia_kg_m2 + roll.sprung * roll.arm**2 * roll.unsprung / vehicle.mass_kg
    v_y, r, body, a_y = 0, 1, 4, 7
    a = np.zeros((8, 8), dtype=np.complex128)
    b = np.zeros(8, dtype=np.complex128)
    a[0, v_y], a[0, r], a[0, a_y] = s, v, -1.0
    a[1, 2], a[1, 3], a[1, a_y] = 1.0, 1.0, -vehicle.mass_kg
    a[2, r], a[2, 2], a[2, 3] = (vehicle.yaw_inertia_kg_m2 + spin_inertia) * s, -lf, lr
    a[3, body] = inertia * s**2 - roll.sprung * _G * roll.arm
    a[3, a_y] = -roll.sprung * roll.arm
    a[3, r] = -roll.sprung * roll.arm * roll.sprung_x * s
    for i, at_x in enumerate((lf, -lr)):
        force, axle, slip, turn = 2 + i, 5 + i, 4 + i, 6 + i
        a[slip, v_y], a[slip, r] = stiffness[i] / v, stiffness[i] * at_x / v
        a[slip, body] = stiffness[i] * lean * s / v
        a[slip, force] = relax[i] + stiffness[i] * comply[i]
        spring = roll.stiffness[i] + roll.damping[i] * s
        tyre = roll.tyre_stiffness + roll.tyre_damping * s
        a[3, body] += spring
        a[3, axle] -= spring
        a[turn, axle] = roll.axle_inertia[i] * s**2 + spring + tyre
        # The axle has the lateral acceleration of the wheels, to which the leaning body contributes.
        arm = (radius - roll.centres[i]) * roll.axle_mass[i]
        a[turn, body] = -spring - arm * lean * s**2
        a[turn, force] = -roll.centres[i]
        a[turn, a_y], a[turn, r] = -arm, -arm * at_x * s
    b[4] = stiffness[0]
    solution = np.linalg.solve(a, b)
    return complex(solution[r]), complex(solution[a_y]), complex(solution[body])
