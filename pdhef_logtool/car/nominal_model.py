"""The nominal 3-DOF single-track model f_nom and its measurement function, compiled (docs/method.md#model, Eq 1-4).

State [v_x, v_y, r] at the centre of gravity, ISO 8855, SI. Slip angles are singular at zero speed. Below the vehicle's
low-speed limit, the model therefore blends to the kinematic single-track model, in which yaw rate and lateral velocity
approach r = v_x tan δ / L and v_y = l_r r with a short time constant.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters
from pdhef_logtool.compiled.cache import njit

#: Time constant of the approach to the kinematic model, s: short for a car, long compared to a 10 ms step.
KINEMATIC_TIME_CONSTANT_S = 0.1
#: The blend starts at this share of the vehicle's low-speed limit and ends at the limit.
BLEND_START_SHARE = 0.5
#: Largest product of step and fastest pole of an RK4 step; longer steps are divided.
MAX_STEP_TIMES_POLE = 1.0
MAX_SUBSTEPS = 32


class ModelParameters(NamedTuple):
    """Parameters of the compiled model. Tyres: F = friction · D sin(C atan(B α − E (B α − atan B α)))."""

    mass_kg: float
    yaw_inertia_kg_m2: float
    front_m: float
    rear_m: float
    front_B: float
    front_C: float
    front_D_n: float
    front_E: float
    front_fixed_stiffness: bool  # B is then divided by the friction, so that stiffness does not depend on it
    rear_B: float
    rear_C: float
    rear_D_n: float
    rear_E: float
    rear_fixed_stiffness: bool
    blend_low_m_s: float
    blend_high_m_s: float
    imu_x_m: float
    imu_y_m: float
    ay_roll_gain: float  # relative excess of a tilted accelerometer over the planar a_y; 0 = not corrected


def model_parameters(vehicle: VehicleParameters, *, roll_correction: bool = False) -> ModelParameters:
    """Flatten vehicle parameters for the compiled model.

    With ``roll_correction``, the measured a_y is (1 + g·K_φ) times the planar a_y (docs/method.md#model).
    """
    bf, cf, df, ef = vehicle.magic_formula(True, 1.0)
    br, cr, dr, er = vehicle.magic_formula(False, 1.0)
    return ModelParameters(
        mass_kg=vehicle.mass_kg,
        yaw_inertia_kg_m2=vehicle.yaw_inertia_kg_m2,
        front_m=vehicle.cg_to_front_axle_m,
        rear_m=vehicle.cg_to_rear_axle_m,
        front_B=bf,
        front_C=cf,
        front_D_n=df,
        front_E=ef,
        front_fixed_stiffness=vehicle.tyres.front.keeps_stiffness,
        rear_B=br,
        rear_C=cr,
        rear_D_n=dr,
        rear_E=er,
        rear_fixed_stiffness=vehicle.tyres.rear.keeps_stiffness,
        blend_low_m_s=BLEND_START_SHARE * vehicle.low_speed_blend_m_s,
        blend_high_m_s=vehicle.low_speed_blend_m_s,
        imu_x_m=vehicle.imu_position_m[0],
        imu_y_m=vehicle.imu_position_m[1],
        ay_roll_gain=GRAVITY_M_S2 * vehicle.roll_gradient_rad_per_m_s2 if roll_correction else 0.0,
    )


@njit(cache=True)
def magic_formula_force(alpha, B, C, D_n, E, fixed_stiffness, friction):  # type: ignore[no-untyped-def]
    """Return the lateral axle force in N at slip angle ``alpha`` in rad (Eq 2)."""
    b = B / friction if fixed_stiffness else B
    ba = b * alpha
    return friction * D_n * math.sin(C * math.atan(ba - E * (ba - math.atan(ba))))


@njit(cache=True)
def dynamic_share(vx, p):  # type: ignore[no-untyped-def]
    """Return the weight in [0, 1] of the dynamic model at speed ``vx``; the rest is kinematic."""
    w = (vx - p.blend_low_m_s) / (p.blend_high_m_s - p.blend_low_m_s)
    return min(1.0, max(0.0, w))


@njit(cache=True)
def lateral_acceleration_and_yaw_acceleration(vx, vy, r, steer, friction, p):  # type: ignore[no-untyped-def]
    """Return (F_yf cos δ + F_yr)/m in m/s² and (l_f F_yf cos δ − l_r F_yr)/I_z in rad/s² (Eq 1-4)."""
    v = max(vx, p.blend_low_m_s)
    alpha_f = steer - math.atan((vy + p.front_m * r) / v)
    alpha_r = -math.atan((vy - p.rear_m * r) / v)
    ff = magic_formula_force(alpha_f, p.front_B, p.front_C, p.front_D_n, p.front_E, p.front_fixed_stiffness, friction)
    fr = magic_formula_force(alpha_r, p.rear_B, p.rear_C, p.rear_D_n, p.rear_E, p.rear_fixed_stiffness, friction)
    ffc = ff * math.cos(steer)
    return (ffc + fr) / p.mass_kg, (p.front_m * ffc - p.rear_m * fr) / p.yaw_inertia_kg_m2


@njit(cache=True)
def state_derivative(vx, vy, r, steer, ax, friction, p):  # type: ignore[no-untyped-def]
    """Return d/dt [v_x, v_y, r] (Eq 1-4, blended to the kinematic model at low speed).

    ``ax`` is the accelerometer's longitudinal acceleration at the IMU, m/s².
    """
    w = dynamic_share(vx, p)
    ay = 0.0
    rdot = 0.0
    if w > 0.0:
        ay, rdot = lateral_acceleration_and_yaw_acceleration(vx, vy, r, steer, friction, p)
    vy_dot = w * (ay - vx * r)
    r_dot = w * rdot
    if w < 1.0:
        r_kin = vx * math.tan(steer) / (p.front_m + p.rear_m)
        vy_dot += (1.0 - w) * (p.rear_m * r_kin - vy) / KINEMATIC_TIME_CONSTANT_S
        r_dot += (1.0 - w) * (r_kin - r) / KINEMATIC_TIME_CONSTANT_S
    # a_cg = a_imu − ω̇ × p − ω × (ω × p), x component
    vx_dot = ax + r_dot * p.imu_y_m + r * r * p.imu_x_m + vy * r
    return vx_dot, vy_dot, r_dot


@njit(cache=True)
def planar_lateral_acceleration(vx, vy, r, steer, friction, p):  # type: ignore[no-untyped-def]
    """Return the lateral acceleration at the centre of gravity in m/s²; v_x r in the kinematic range."""
    w = dynamic_share(vx, p)
    if w == 0.0:
        return vx * r
    ay, _ = lateral_acceleration_and_yaw_acceleration(vx, vy, r, steer, friction, p)
    return w * ay + (1.0 - w) * vx * r


@njit(cache=True)
def substeps(vx, dt, friction, p):  # type: ignore[no-untyped-def]
    """Return the number of RK4 steps in ``dt`` that the model's fastest pole requires."""
    v = max(vx, p.blend_low_m_s)
    cf = p.front_B * p.front_C * p.front_D_n * (1.0 if p.front_fixed_stiffness else friction)
    cr = p.rear_B * p.rear_C * p.rear_D_n * (1.0 if p.rear_fixed_stiffness else friction)
    lateral = (cf + cr) / (p.mass_kg * v)
    yaw = (p.front_m**2 * cf + p.rear_m**2 * cr) / (p.yaw_inertia_kg_m2 * v)
    n = math.ceil(dt * max(lateral, yaw, 1.0 / KINEMATIC_TIME_CONSTANT_S) / MAX_STEP_TIMES_POLE)
    return min(max(n, 1), MAX_SUBSTEPS)


# positional: scalars, as in the model's other functions.
@njit(cache=True)
def rk4_step(vx, vy, r, steer, ax, friction, dt, n, p):  # type: ignore[no-untyped-def]
    """Advance [v_x, v_y, r] by ``dt`` s in ``n`` RK4 steps with constant inputs."""
    h = dt / n
    for _ in range(n):
        a1, b1, c1 = state_derivative(vx, vy, r, steer, ax, friction, p)
        g = 0.5 * h
        a2, b2, c2 = state_derivative(vx + g * a1, vy + g * b1, r + g * c1, steer, ax, friction, p)
        a3, b3, c3 = state_derivative(vx + g * a2, vy + g * b2, r + g * c2, steer, ax, friction, p)
        a4, b4, c4 = state_derivative(vx + h * a3, vy + h * b3, r + h * c3, steer, ax, friction, p)
        vx += h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
        vy += h / 6.0 * (b1 + 2.0 * b2 + 2.0 * b3 + b4)
        r += h / 6.0 * (c1 + 2.0 * c2 + 2.0 * c3 + c4)
    return vx, vy, r
