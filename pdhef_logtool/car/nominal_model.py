"""The nominal 3-DOF single-track model f_nom and its measurement function, compiled (docs/method.md#model, Eq 1-4).

State [v_x, v_y, r] at the centre of gravity, ISO 8855, SI. Slip angles are singular at zero speed. Below the vehicle's
low-speed limit, the model therefore blends to the kinematic single-track model, in which yaw rate and lateral velocity
approach r = v_x tan δ / L and v_y = l_r r with a short time constant.
"""

import math
from typing import Any, NamedTuple

from pdhef_logtool.car.elementary_functions import arctangent, sine
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters
from pdhef_logtool.compiled.cache import inline, njit

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


class Prepared(NamedTuple):
    """Constants of a step by steering and friction, common to all points."""

    cos: float
    r_kin_per_vx: float
    b_front: float
    b_rear: float
    peak_front: float  # over the mass, m/s²
    peak_rear: float
    inertia: float  # m / I_z
    per_blend: float


def model_parameters(vehicle: VehicleParameters, *, roll_correction: bool = False) -> ModelParameters:
    """Flatten vehicle parameters for the compiled model.

    With ``roll_correction``, the measured a_y is (1 + g·K_φ) times the planar a_y (docs/method.md#model).
    """
    blend_m_s, imu_m, tyres = vehicle.low_speed_blend_m_s, vehicle.imu_position_m, vehicle.tyres
    ay_roll_gain = GRAVITY_M_S2 * vehicle.roll_gradient_rad_per_m_s2 if roll_correction else 0.0
    values: list[Any] = [vehicle.mass_kg, vehicle.yaw_inertia_kg_m2]
    values += [vehicle.cg_to_front_axle_m, vehicle.cg_to_rear_axle_m]
    for is_front, tyre in ((True, tyres.front), (False, tyres.rear)):
        values += [*vehicle.magic_formula(is_front, 1.0), tyre.keeps_stiffness]
    values += [BLEND_START_SHARE * blend_m_s, blend_m_s, *imu_m[:2], ay_roll_gain]
    return ModelParameters(*values)


@njit(cache=True)
def dynamic_share(vx, p):  # type: ignore[no-untyped-def]
    """Return the weight in [0, 1] of the dynamic model at speed ``vx``; the rest is kinematic."""
    w = (vx - p.blend_low_m_s) / (p.blend_high_m_s - p.blend_low_m_s)
    return min(1.0, max(0.0, w))


@inline
def prepare(steer, friction, p):  # type: ignore[no-untyped-def]
    """Return the constants of the model at a steering angle and a friction."""
    return Prepared(
        math.cos(steer),
        math.tan(steer) / (p.front_m + p.rear_m),
        p.front_B / friction if p.front_fixed_stiffness else p.front_B,
        p.rear_B / friction if p.rear_fixed_stiffness else p.rear_B,
        friction * p.front_D_n / p.mass_kg,
        friction * p.rear_D_n / p.mass_kg,
        p.mass_kg / p.yaw_inertia_kg_m2,
        1.0 / (p.blend_high_m_s - p.blend_low_m_s),
    )


# positional: numbers of one point in an inner loop for vectorization.
@inline
def magic_formula(v, vy, r, angle, c, p):  # type: ignore[no-untyped-def]
    """Return F_yf/m and F_yr/m of the tyres in m/s² (Eq 2-4), each along its own axle."""
    front = c.b_front * (angle - arctangent(vy + p.front_m * r, v))
    rear = -c.b_rear * arctangent(vy - p.rear_m * r, v)
    front = arctangent(front - p.front_E * (front - arctangent(front, 1.0)), 1.0)
    rear = arctangent(rear - p.rear_E * (rear - arctangent(rear, 1.0)), 1.0)
    return c.peak_front * sine(p.front_C * front), c.peak_rear * sine(p.rear_C * rear)


@inline
def accelerations(vx, vy, r, steer, c, p):  # type: ignore[no-untyped-def]
    """Return (F_yf cos δ + F_yr)/m in m/s² and (l_f F_yf cos δ − l_r F_yr)/I_z in rad/s² (Eq 1-4)."""
    ff, fr = magic_formula(max(vx, p.blend_low_m_s), vy, r, steer, c, p)
    ff *= c.cos
    return ff + fr, c.inertia * (p.front_m * ff - p.rear_m * fr)


@inline
def derivative(vx, vy, r, ax, steer, c, p):  # type: ignore[no-untyped-def]
    """Return d/dt [v_x, v_y, r] (Eq 1-4, blended to the kinematic model at low speed).

    ``ax`` is the accelerometer's longitudinal acceleration at the IMU, m/s².
    """
    w = min(1.0, max(0.0, (vx - p.blend_low_m_s) * c.per_blend))
    ay, turn = accelerations(vx, vy, r, steer, c, p)
    r_kin = vx * c.r_kin_per_vx
    follow = (1.0 - w) * (1.0 / KINEMATIC_TIME_CONSTANT_S)
    vy_dot = w * (ay - vx * r) + (follow * (p.rear_m * r_kin - vy) if w < 1.0 else 0.0)
    r_dot = w * turn + (follow * (r_kin - r) if w < 1.0 else 0.0)  # tan δ may be infinite
    # a_cg = a_imu − ω̇ × p − ω × (ω × p), x component
    return ax + r_dot * p.imu_y_m + r * r * p.imu_x_m + vy * r, vy_dot, r_dot


@njit(cache=True)
def state_derivative(vx, vy, r, steer, ax, friction, p):  # type: ignore[no-untyped-def]
    """Return d/dt [v_x, v_y, r], see :func:`derivative`."""
    return derivative(vx, vy, r, ax, steer, prepare(steer, friction, p), p)


@njit(cache=True)
def planar_lateral_acceleration(vx, vy, r, steer, friction, p):  # type: ignore[no-untyped-def]
    """Return the lateral acceleration at the centre of gravity in m/s²; v_x r in the kinematic range."""
    w = dynamic_share(vx, p)
    ay, _ = accelerations(vx, vy, r, steer, prepare(steer, friction, p), p)
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


# positional: numbers of one point in an inner loop for vectorization.
@inline
def rk4_step(vx, vy, r, ax, steer, h, c, p):  # type: ignore[no-untyped-def]
    """Return [v_x, v_y, r] after an RK4 step of ``h`` s with constant inputs."""
    g, sixth = 0.5 * h, h / 6.0
    a1, b1, c1 = derivative(vx, vy, r, ax, steer, c, p)
    a2, b2, c2 = derivative(vx + g * a1, vy + g * b1, r + g * c1, ax, steer, c, p)
    a3, b3, c3 = derivative(vx + g * a2, vy + g * b2, r + g * c2, ax, steer, c, p)
    a4, b4, c4 = derivative(vx + h * a3, vy + h * b3, r + h * c3, ax, steer, c, p)
    vx += sixth * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
    vy += sixth * (b1 + 2.0 * b2 + 2.0 * b3 + b4)
    return vx, vy, r + sixth * (c1 + 2.0 * c2 + 2.0 * c3 + c4)


# positional: scalars, as in the model's other functions.
@njit(cache=True)
def rk4_steps(vx, vy, r, steer, ax, friction, dt, n, p):  # type: ignore[no-untyped-def]
    """Advance [v_x, v_y, r] by ``dt`` s in ``n`` RK4 steps with constant inputs."""
    c = prepare(steer, friction, p)
    for _ in range(n):
        vx, vy, r = rk4_step(vx, vy, r, ax, steer, dt / n, c, p)
    return vx, vy, r
