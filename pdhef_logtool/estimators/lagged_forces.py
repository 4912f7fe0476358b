"""The single-track model with axle forces as states: they lag by the relaxation length and feel the load transfer.

State [v_x, v_y, r, f_f, f_r] at the centre of gravity, ISO 8855, SI; f = F_y / m is an axle's lateral force over the
vehicle's mass in m/s² (METHOD §3, Eq 5-7).

- Relaxation: (σ_y / v_x) ḟ + f = f_ss(α). A length of 0 is the static model.
- Load transfer takes ΔF_z = m_i a_y h / T from the inner wheel to the outer one of axle i. Each axle is taken to carry
  the transfer of its own share m_i of the mass, so that both have x = ΔF_z / F_z0 = 2 h a_y / (g T), whatever their
  roll stiffness, which a vehicle file does not know. A wheel whose force per load falls by the share s for each
  relative excess of load gives (1 + x)(1 − s x), and the two of an axle lose the share s x² (Eq 7).
- A magic formula that was fitted to an axle holds that loss already, for steady cornering, in which the axle's own
  force says what a_y was: a_y,i = F_ss(α) / m_i. What is left is the ratio (1 − s x²) / (1 − s x_i²): it differs from 1
  only while the axles' forces do not balance, in transients. A tyre that is given by its cornering stiffness knows
  nothing of it and gets the whole factor. On the drives of ``studies.defaults.tune_physics_q`` the load transfer
  raises the innovation likelihood (1.922 to 1.934 a sample) and leaves the sideslip as it is (median RMSE 0.091°
  without it, 0.090° with it).
"""

from __future__ import annotations

import math
from typing import NamedTuple

from pdhef_logtool.car.nominal_model import (
    KINEMATIC_TIME_CONSTANT_S,
    MAX_STEP_TIMES_POLE,
    MAX_SUBSTEPS,
    dynamic_share,
    magic_formula_force,
    substeps,
)
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters
from pdhef_logtool.records.compiled import njit


class ForceParameters(NamedTuple):
    """What the compiled model needs beside :class:`~pdhef_logtool.car.nominal_model.ModelParameters`."""

    relaxation_length_m: float
    load_sensitivity: float  # s
    transfer_per_ay: float  # x over a_y, s²/m
    front_share: float  # m_f / m
    rear_share: float
    front_holds_transfer: bool  # the formula was fitted with the load transfer of steady cornering in it
    rear_holds_transfer: bool


def force_parameters(vehicle: VehicleParameters) -> ForceParameters:
    """Flatten what the lag and the load transfer need."""
    return ForceParameters(
        relaxation_length_m=vehicle.relaxation_length_m,
        load_sensitivity=vehicle.load_sensitivity,
        transfer_per_ay=2.0 * vehicle.cg_height_m / (GRAVITY_M_S2 * vehicle.track_m),
        front_share=vehicle.cg_to_rear_axle_m / vehicle.wheelbase_m,
        rear_share=vehicle.cg_to_front_axle_m / vehicle.wheelbase_m,
        front_holds_transfer=vehicle.tyres.front.cornering_stiffness_n_per_rad is None,
        rear_holds_transfer=vehicle.tyres.rear.cornering_stiffness_n_per_rad is None,
    )


@njit(cache=True)
def transfer_factor(ay, f):  # type: ignore[no-untyped-def]
    """Return 1 − s x² of an axle at lateral acceleration ``ay``; x ends at 1, where the inner wheel is off the road."""
    x = min(1.0, abs(f.transfer_per_ay * ay))
    return 1.0 - f.load_sensitivity * x * x


@njit(cache=True)
def steady_forces(vx, vy, r, steer, ay, friction, p, f):  # type: ignore[no-untyped-def]
    """Return F_yf/m and F_yr/m in m/s² to which the tyres settle at this state and lateral acceleration ``ay``."""
    v = max(vx, p.blend_low_m_s)
    alpha_f = steer - math.atan((vy + p.front_m * r) / v)
    alpha_r = -math.atan((vy - p.rear_m * r) / v)
    ff = magic_formula_force(alpha_f, p.front_B, p.front_C, p.front_D_n, p.front_E, p.front_fixed_stiffness, friction)
    fr = magic_formula_force(alpha_r, p.rear_B, p.rear_C, p.rear_D_n, p.rear_E, p.rear_fixed_stiffness, friction)
    ff /= p.mass_kg
    fr /= p.mass_kg
    if f.load_sensitivity > 0.0:
        factor = transfer_factor(ay, f)
        front_factor = factor / transfer_factor(ff / f.front_share, f) if f.front_holds_transfer else factor
        rear_factor = factor / transfer_factor(fr / f.rear_share, f) if f.rear_holds_transfer else factor
        ff *= front_factor
        fr *= rear_factor
    return ff, fr


@njit(cache=True)
def settled_forces(vx, vy, r, steer, friction, p, f):  # type: ignore[no-untyped-def]
    """Return the steady forces at their own lateral acceleration (two rounds of a strong contraction)."""
    ff, fr = 0.0, 0.0
    for _ in range(3):
        ff, fr = steady_forces(vx, vy, r, steer, ff * math.cos(steer) + fr, friction, p, f)
    return ff, fr


@njit(cache=True)
def relaxation_rate(vx, p, f):  # type: ignore[no-untyped-def]
    """Return v_x / σ_y in 1/s; the speed does not fall below that at which slip angles end to be meant."""
    return max(vx, p.blend_low_m_s) / f.relaxation_length_m


# positional: scalars throughout; called four times a step, on sums of them.
@njit(cache=True)
def lagged_derivative(vx, vy, r, ff, fr, steer, cos_steer, ax, friction, max_rate, p, f):  # type: ignore[no-untyped-def]
    """Return d/dt [v_x, v_y, r, f_f, f_r], blended to the kinematic model at low speed.

    ``max_rate`` limits the relaxation rate, 1/s. Without lag the forces of the state are not looked at.
    """
    w = dynamic_share(vx, p)
    if f.relaxation_length_m > 0.0:
        rate = min(relaxation_rate(vx, p, f), max_rate)
        steady_f, steady_r = steady_forces(vx, vy, r, steer, ff * cos_steer + fr, friction, p, f)
        ff_dot = rate * (steady_f - ff)
        fr_dot = rate * (steady_r - fr)
    else:
        ff, fr = settled_forces(vx, vy, r, steer, friction, p, f)
        ff_dot = 0.0
        fr_dot = 0.0
    ffc = ff * cos_steer
    vy_dot = w * (ffc + fr - vx * r)
    r_dot = w * (p.front_m * ffc - p.rear_m * fr) * (p.mass_kg / p.yaw_inertia_kg_m2)
    if w < 1.0:
        r_kin = vx * math.tan(steer) / (p.front_m + p.rear_m)
        vy_dot += (1.0 - w) * (p.rear_m * r_kin - vy) / KINEMATIC_TIME_CONSTANT_S
        r_dot += (1.0 - w) * (r_kin - r) / KINEMATIC_TIME_CONSTANT_S
    vx_dot = ax + r_dot * p.imu_y_m + r * r * p.imu_x_m + vy * r
    return vx_dot, vy_dot, r_dot, ff_dot, fr_dot


@njit(cache=True)
def lagged_substeps(vx, dt, friction, p, f):  # type: ignore[no-untyped-def]
    """Return into how many RK4 steps ``dt`` must be divided for the fastest pole of the model and the lag."""
    n = substeps(vx, dt, friction, p)
    if f.relaxation_length_m > 0.0:
        n = max(n, math.ceil(dt * relaxation_rate(vx, p, f) / MAX_STEP_TIMES_POLE))
    return min(n, MAX_SUBSTEPS)


# positional: scalars throughout, as ``rk4_step`` of the nominal model with two states more.
@njit(cache=True)
def lagged_rk4_step(vx, vy, r, ff, fr, steer, ax, friction, dt, n, p, f):  # type: ignore[no-untyped-def]
    """Advance [v_x, v_y, r, f_f, f_r] by ``dt`` s in ``n`` RK4 steps with constant inputs.

    A lag much shorter than a step is taken as the shortest that the step can follow.
    """
    h = dt / n
    g = 0.5 * h
    c = math.cos(steer)
    max_rate = MAX_STEP_TIMES_POLE / h
    for _ in range(n):
        a1, b1, c1, d1, e1 = lagged_derivative(vx, vy, r, ff, fr, steer, c, ax, friction, max_rate, p, f)
        a2, b2, c2, d2, e2 = lagged_derivative(
            vx + g * a1, vy + g * b1, r + g * c1, ff + g * d1, fr + g * e1, steer, c, ax, friction, max_rate, p, f
        )
        a3, b3, c3, d3, e3 = lagged_derivative(
            vx + g * a2, vy + g * b2, r + g * c2, ff + g * d2, fr + g * e2, steer, c, ax, friction, max_rate, p, f
        )
        a4, b4, c4, d4, e4 = lagged_derivative(
            vx + h * a3, vy + h * b3, r + h * c3, ff + h * d3, fr + h * e3, steer, c, ax, friction, max_rate, p, f
        )
        k = h / 6.0
        vx += k * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
        vy += k * (b1 + 2.0 * b2 + 2.0 * b3 + b4)
        r += k * (c1 + 2.0 * c2 + 2.0 * c3 + c4)
        ff += k * (d1 + 2.0 * d2 + 2.0 * d3 + d4)
        fr += k * (e1 + 2.0 * e2 + 2.0 * e3 + e4)
    if not f.relaxation_length_m > 0.0:
        ff, fr = settled_forces(vx, vy, r, steer, friction, p, f)
    return vx, vy, r, ff, fr


@njit(cache=True)
def lagged_planar_ay(vx, r, ff, fr, steer, p):  # type: ignore[no-untyped-def]
    """Return the lateral acceleration at the centre of gravity in m/s²; v_x r in the kinematic range."""
    w = dynamic_share(vx, p)
    return w * (ff * math.cos(steer) + fr) + (1.0 - w) * vx * r


@njit(cache=True)
def lagged_measured_ay(vx, r, ff, fr, steer, p):  # type: ignore[no-untyped-def]
    """Return what the accelerometer reads: (1 + g K_φ) ΣF/m, moved to the IMU."""
    w = dynamic_share(vx, p)
    ffc = ff * math.cos(steer)
    ay = w * (ffc + fr) + (1.0 - w) * vx * r
    r_dot = w * (p.front_m * ffc - p.rear_m * fr) * (p.mass_kg / p.yaw_inertia_kg_m2)
    return (1.0 + p.ay_roll_gain) * ay + r_dot * p.imu_x_m - r * r * p.imu_y_m
