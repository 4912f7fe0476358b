"""Compiled nominal model for many states at once, for the sigma points of the filters.

The results equal :mod:`~pdhef_logtool.car.nominal_model` except for rounding. The points are in blocks of a work array;
each block contains ``WIDTH`` numbers of one quantity, then of the next. The inner loop over a block has no branches and
no library calls, so that the compiler generates vector instructions. Arctangent and sine are polynomials, because the
functions of the C library are scalar and would take most of a filter's time.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from pdhef_logtool.car.nominal_model import KINEMATIC_TIME_CONSTANT_S
from pdhef_logtool.compiled.cache import njit

#: Points of one inner loop: a constant, so that there is no remainder loop and all points are computed alike.
WIDTH = 16
#: Offsets of the quantities in a block of points: state, inputs, functions of the steering angle, and a_y.
AT_VX, AT_VY, AT_YAW_RATE, AT_STEER, AT_AX, AT_COS_STEER, AT_TAN_STEER, AT_AY = range(0, 8 * WIDTH, WIDTH)
BLOCK = 8 * WIDTH

_TAN_PI_8 = 0.41421356237309503
_TAN_3_PI_8 = 2.414213562373095
_HALF_PI = 0.5 * math.pi
_QUARTER_PI = 0.25 * math.pi
_INVERSE_PI = 1.0 / math.pi
#: π in two parts: the double, and its rounding error.
_PI_REST = 1.2246467991473532e-16
#: Adding and subtracting this value rounds to the nearest integer.
_ROUND = 1.5 * 2.0**52

# No check of divisors, which would be a branch; a·b + c may be one instruction.
_compiled = njit(cache=True, error_model="numpy", fastmath={"contract"})
_inline = njit(forceinline=True, error_model="numpy", fastmath={"contract"})


@_inline
def arctangent(y, x):  # type: ignore[no-untyped-def]
    """Return atan(y / x) in rad for x > 0, to 3e-16.

    |y| / x is reduced below tan(π/8) by atan q = π/4 + atan((q − 1)/(q + 1)) or π/2 − atan(1/q), with one division.
    There, (atan(√z)/√z − 1)/z is a polynomial of degree 9, interpolated at the Chebyshev points of [0, tan²(π/8)] with
    60 digits, which is near the best of its degree (Trefethen 2013, chapter 16); its error is 6e-17.
    """
    a = abs(y)
    steep = a > _TAN_3_PI_8 * x
    middle = a > _TAN_PI_8 * x
    upper = -x if steep else (a - x if middle else a)
    lower = a if steep else (a + x if middle else x)
    base = _HALF_PI if steep else (_QUARTER_PI if middle else 0.0)
    t = upper / lower
    z = t * t
    z2 = z * z
    z4 = z2 * z2
    low = (-0.3333333333333325 + 0.19999999999898407 * z) + z2 * (-0.1428571426609662 + 0.11111109636534361 * z)
    middle_part = (-0.0909085255717602 + 0.07691055158392605 * z) + z2 * (
        -0.06649613695285927 + 0.05736332165872438 * z
    )
    high = -0.04483334622156894 + 0.022750526991774364 * z
    value = base + (t + t * z * (low + z4 * (middle_part + z4 * high)))
    return -value if y < 0.0 else value


@_inline
def sine(x):  # type: ignore[no-untyped-def]
    """Return sin(x) for |x| up to 1e4 rad, to 3e-16.

    x is reduced to ±π/2 by multiples of π. There, (sin(√z)/√z − 1)/z is a polynomial of degree 7, found as in
    :func:`arctangent`; its error is 1e-18.
    """
    k = (x * _INVERSE_PI + _ROUND) - _ROUND
    odd = k - 2.0 * ((0.5 * k + _ROUND) - _ROUND)
    y = (x - k * math.pi) - k * _PI_REST
    z = y * y
    z2 = z * z
    low = (-0.16666666666666666 + 0.008333333333333316 * z) + z2 * (
        -0.00019841269841254974 + 2.7557319219163234e-06 * z
    )
    high = (-2.5052107616996182e-08 + 1.605897731246407e-10 * z) + z2 * (
        -7.64397029679794e-13 + 2.7314447669785093e-15 * z
    )
    value = y + y * z * (low + z2 * z2 * high)
    return value * (1.0 - 2.0 * odd * odd)


class _Constants(NamedTuple):
    """Constants of all points of a step, computed outside of the inner loop: divisions and friction."""

    b_front: float
    b_rear: float
    peak_front_n: float
    peak_rear_n: float
    blend_per_m_s: float
    per_mass: float
    per_inertia: float
    per_wheelbase: float


@njit(cache=True, error_model="numpy")
def _constants(friction, p):  # type: ignore[no-untyped-def]
    """Return the constants of a step at this friction."""
    return _Constants(
        p.front_B / friction if p.front_fixed_stiffness else p.front_B,
        p.rear_B / friction if p.rear_fixed_stiffness else p.rear_B,
        friction * p.front_D_n,
        friction * p.rear_D_n,
        1.0 / (p.blend_high_m_s - p.blend_low_m_s),
        1.0 / p.mass_kg,
        1.0 / p.yaw_inertia_kg_m2,
        1.0 / (p.front_m + p.rear_m),
    )


@_inline
def _axle_accelerations(vx, vy, r, steer, cos_steer, c, p):  # type: ignore[no-untyped-def]
    """Return a_y in m/s² and the yaw acceleration in rad/s² (Eq 1-4), as in the nominal model."""
    v = max(vx, p.blend_low_m_s)
    front = c.b_front * (steer - arctangent(vy + p.front_m * r, v))
    rear = -c.b_rear * arctangent(vy - p.rear_m * r, v)
    front = arctangent(front - p.front_E * (front - arctangent(front, 1.0)), 1.0)
    rear = arctangent(rear - p.rear_E * (rear - arctangent(rear, 1.0)), 1.0)
    ff = c.peak_front_n * cos_steer * sine(p.front_C * front)
    fr = c.peak_rear_n * sine(p.rear_C * rear)
    return c.per_mass * (ff + fr), c.per_inertia * (p.front_m * ff - p.rear_m * fr)


@_inline
def _share(vx, c, p):  # type: ignore[no-untyped-def]
    """Return the weight of the dynamic model, as ``dynamic_share``."""
    return min(1.0, max(0.0, (vx - p.blend_low_m_s) * c.blend_per_m_s))


# positional: scalars of one point in a vectorised inner loop.
@_inline
def _derivative(vx, vy, r, steer, cos_steer, tan_steer, ax, c, p):  # type: ignore[no-untyped-def]
    """Return d/dt [v_x, v_y, r] (Eq 1-4 with the blend to the kinematic model)."""
    w = _share(vx, c, p)
    ay, rdot = _axle_accelerations(vx, vy, r, steer, cos_steer, c, p)
    r_kin = vx * tan_steer * c.per_wheelbase
    follow = (1.0 - w) * (1.0 / KINEMATIC_TIME_CONSTANT_S)
    vy_dot = w * (ay - vx * r) + (follow * (p.rear_m * r_kin - vy) if w < 1.0 else 0.0)
    r_dot = w * rdot + (follow * (r_kin - r) if w < 1.0 else 0.0)  # tan δ may be infinite
    return ax + r_dot * p.imu_y_m + r * r * p.imu_x_m + vy * r, vy_dot, r_dot


@_inline
def _turn(block):  # type: ignore[no-untyped-def]
    """Write cosine and tangent of a block's steering angles."""
    for j in range(WIDTH):
        c = sine(block[AT_STEER + j] + _HALF_PI)
        block[AT_COS_STEER + j] = c
        block[AT_TAN_STEER + j] = sine(block[AT_STEER + j]) / c


@njit(cache=True)
def work_size(count):  # type: ignore[no-untyped-def]
    """Return the length of the work array for ``count`` points."""
    return (count + WIDTH - 1) // WIDTH * BLOCK


@njit(cache=True)
def place_count(points):  # type: ignore[no-untyped-def]
    """Return the capacity of a work array in points; all of them must be finite."""
    return points.shape[0] // BLOCK * WIDTH


@njit(forceinline=True)
def place(i):  # type: ignore[no-untyped-def]
    """Return the index of the first quantity of point ``i`` in the work array; the others are at offsets ``AT_*``."""
    return i // WIDTH * BLOCK + i % WIDTH


@_compiled
def advance_points(points, friction, dt, n, p):  # type: ignore[no-untyped-def]
    """Advance v_x, v_y and r of the points [work_size] by ``dt`` s in ``n`` RK4 steps with constant inputs, in place.

    Inputs: STEER in rad, AX of the accelerometer at the IMU in m/s².
    """
    k = _constants(friction, p)
    h = dt / n
    g = 0.5 * h
    sixth = h / 6.0
    for start in range(0, points.shape[0], BLOCK):
        block = points[start : start + BLOCK]
        _turn(block)
        for _ in range(n):
            for j in range(WIDTH):
                x, y, r = block[AT_VX + j], block[AT_VY + j], block[AT_YAW_RATE + j]
                steer, cos, tan = block[AT_STEER + j], block[AT_COS_STEER + j], block[AT_TAN_STEER + j]
                ax = block[AT_AX + j]
                x1, y1, r1 = _derivative(x, y, r, steer, cos, tan, ax, k, p)
                x2, y2, r2 = _derivative(x + g * x1, y + g * y1, r + g * r1, steer, cos, tan, ax, k, p)
                x3, y3, r3 = _derivative(x + g * x2, y + g * y2, r + g * r2, steer, cos, tan, ax, k, p)
                x4, y4, r4 = _derivative(x + h * x3, y + h * y3, r + h * r3, steer, cos, tan, ax, k, p)
                block[AT_VX + j] = x + sixth * (x1 + 2.0 * x2 + 2.0 * x3 + x4)
                block[AT_VY + j] = y + sixth * (y1 + 2.0 * y2 + 2.0 * y3 + y4)
                block[AT_YAW_RATE + j] = r + sixth * (r1 + 2.0 * r2 + 2.0 * r3 + r4)


@_compiled
def measure_points(points, friction, p):  # type: ignore[no-untyped-def]
    """Write the accelerometer readings in m/s² to AY of the points [work_size]; input STEER."""
    k = _constants(friction, p)
    for start in range(0, points.shape[0], BLOCK):
        block = points[start : start + BLOCK]
        for j in range(WIDTH):
            vx, r, steer = block[AT_VX + j], block[AT_YAW_RATE + j], block[AT_STEER + j]
            ay, r_dot = _axle_accelerations(vx, block[AT_VY + j], r, steer, sine(steer + _HALF_PI), k, p)
            w = _share(vx, k, p)
            ay = w * ay + (1.0 - w) * vx * r
            block[AT_AY + j] = (1.0 + p.ay_roll_gain) * ay + w * r_dot * p.imu_x_m - r * r * p.imu_y_m
