"""Tyres of the simulated vehicle: load-sensitive magic formula with combined and relaxed slip.

Steady forces follow the similarity form of Pacejka (Tire and Vehicle Dynamics, 3rd ed., ch. 4.3 and 7): both slips
are scaled by initial stiffness over peak force, their resultant enters one curve per direction, and the force points
along the scaled slip. The initial slope is a property of the carcass and hardly depends on the road, so friction
scales the peak and only a small power of it the stiffness. Transients are the single-contact-point model (ch. 7):
(σ/|V_x|) ṡ + s = s_steady, with the forces then read at the relaxed slip.
"""

import math
from typing import NamedTuple

from numba.extending import register_jitable


class Tyre(NamedTuple):
    """One tyre (205/55 R16 class), the same on all four wheels."""

    nominal_load_n: float = 3530.0
    #: K_y(F_z) = stiffness_peak · F_z0 · sin(2 atan(F_z / (stiffness_load · F_z0)))
    stiffness_peak: float = 18.3
    stiffness_load: float = 1.75
    #: Power of friction that scales the slopes: a wet or icy road reduces them only a little.
    stiffness_friction_power: float = 0.08
    #: Friction to which the slopes refer.
    stiffness_friction: float = 0.85
    lateral_shape: float = 1.35
    lateral_curvature: float = -0.30
    #: Relative loss of peak friction per relative excess of load.
    lateral_load_sensitivity: float = 0.10
    longitudinal_stiffness_per_load: float = 22.0
    longitudinal_shape: float = 1.55
    longitudinal_curvature: float = 0.0
    longitudinal_peak_ratio: float = 1.05
    longitudinal_load_sensitivity: float = 0.08
    lateral_relaxation_m: float = 0.65
    lateral_relaxation_min_m: float = 0.30
    longitudinal_relaxation_m: float = 0.30
    #: Carcass damping as slip per metre per second of sliding; it decreases with speed (ch. 8.6) and prevents endless
    #: oscillation at standstill.
    lateral_damping_s_per_m: float = 0.06
    longitudinal_damping_s_per_m: float = 0.05
    damping_fade_m_s: float = 2.5


@register_jitable
def cornering_stiffness_n_per_rad(tyre: Tyre, load_n: float, friction: float) -> float:
    """Slope of the lateral force at zero slip, N/rad, for one tyre at a vertical load (N) on a road."""
    relative = load_n / (tyre.stiffness_load * tyre.nominal_load_n)
    road = (friction / tyre.stiffness_friction) ** tyre.stiffness_friction_power
    return float(tyre.stiffness_peak * tyre.nominal_load_n * math.sin(2.0 * math.atan(relative)) * road)


@register_jitable
def _curve(slip: float, shape: float, curvature: float) -> float:
    """Magic formula with slope 1 at the origin and peak 1, at a scaled slip ≥ 0."""
    x = slip / shape
    return math.sin(shape * math.atan(x - curvature * (x - math.atan(x))))


@register_jitable
def forces_n(
    tyre: Tyre, longitudinal_slip: float, lateral_slip: float, load_n: float, friction: float
) -> tuple[float, float, float]:
    """Force at the contact patch at given (relaxed) slips.

    Parameters
    ----------
    longitudinal_slip : κ, positive when driving.
    lateral_slip : tan α, positive for a force to the left.
    load_n : vertical load, N; no force below 1 N.

    Returns
    -------
    F_x, F_y (N, in the wheel's frame), and the scaled resultant slip (about 2.5 at the lateral peak).
    """
    if load_n < 1.0:
        return 0.0, 0.0, 0.0
    excess = (load_n - tyre.nominal_load_n) / tyre.nominal_load_n
    peak_x = friction * tyre.longitudinal_peak_ratio * load_n * (1.0 - tyre.longitudinal_load_sensitivity * excess)
    peak_y = friction * load_n * (1.0 - tyre.lateral_load_sensitivity * excess)
    road = (friction / tyre.stiffness_friction) ** tyre.stiffness_friction_power
    scaled_x = tyre.longitudinal_stiffness_per_load * load_n * road / peak_x * longitudinal_slip
    scaled_y = cornering_stiffness_n_per_rad(tyre, load_n, friction) / peak_y * lateral_slip
    resultant = math.sqrt(scaled_x * scaled_x + scaled_y * scaled_y)
    if resultant < 1e-12:
        return peak_x * scaled_x, peak_y * scaled_y, resultant
    force_x = peak_x * scaled_x / resultant * _curve(resultant, tyre.longitudinal_shape, tyre.longitudinal_curvature)
    force_y = peak_y * scaled_y / resultant * _curve(resultant, tyre.lateral_shape, tyre.lateral_curvature)
    return force_x, force_y, resultant


@register_jitable
def lateral_relaxation_length_m(tyre: Tyre, scaled_slip: float) -> float:
    """Relaxation length in m: contact stiffness over carcass stiffness, which decreases with sliding."""
    free = tyre.lateral_relaxation_m - tyre.lateral_relaxation_min_m
    return tyre.lateral_relaxation_min_m + free / (1.0 + scaled_slip * scaled_slip)


@register_jitable
def slip_rates(
    tyre: Tyre,
    longitudinal_slip: float,
    lateral_slip: float,
    scaled_slip: float,
    forward_m_s: float,
    left_m_s: float,
    rim_m_s: float,
) -> tuple[float, float]:
    """Rates (1/s) of the relaxed slips.

    Parameters
    ----------
    scaled_slip : resultant from :func:`forces_n`.
    forward_m_s, left_m_s : velocity of the contact point in the wheel's frame.
    rim_m_s : ω R_e.
    """
    sliding = rim_m_s - forward_m_s
    # The floor bounds the slips where a wheel slides without rolling forward (spin, burn-out).
    reference_y = max(abs(forward_m_s), 0.6 * abs(left_m_s))
    reference_x = max(abs(forward_m_s), 0.3 * abs(sliding))
    rate_x = (sliding - reference_x * longitudinal_slip) / tyre.longitudinal_relaxation_m
    rate_y = (-left_m_s - reference_y * lateral_slip) / lateral_relaxation_length_m(tyre, scaled_slip)
    return rate_x, rate_y


@register_jitable
def damped_slips(
    tyre: Tyre, longitudinal_slip: float, lateral_slip: float, forward_m_s: float, left_m_s: float, rim_m_s: float
) -> tuple[float, float]:
    """Add the carcass damping of low speed to the relaxed slips; above ``damping_fade_m_s`` they stay as they are."""
    speed = abs(forward_m_s)
    if speed >= tyre.damping_fade_m_s:
        return longitudinal_slip, lateral_slip
    fade = 0.5 * (1.0 + math.cos(math.pi * speed / tyre.damping_fade_m_s))
    return (
        longitudinal_slip + fade * tyre.longitudinal_damping_s_per_m * (rim_m_s - forward_m_s),
        lateral_slip - fade * tyre.lateral_damping_s_per_m * left_m_s,
    )
