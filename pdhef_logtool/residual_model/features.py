"""The network's inputs, one piece of code for training and service (METHOD §5).

The pure physics filter runs in parallel and gives the reference for ε_phy: Δr = r_m − r̂⁻ and Δβ = β̂⁺ − β̂⁻, prior and
posterior of that filter. Nothing here depends on what the hybrid filter does, and nothing on truth.
"""

from __future__ import annotations

import numpy as np

from pdhef_logtool.records.signals import FloatArray

#: Name and order of the features. The paper's six come first; a network for one car uses all but the last seven,
#: which tell cars apart.
FEATURES = (
    "vx_m_s",  # posterior of the physics filter
    "ay_m_s2",  # measured
    "steer_rad",  # measured
    "yaw_rate_rad_s",  # measured
    "delta_yaw_rate_rad_s",
    "delta_sideslip_rad",
    "physics_vy_m_s",
    "physics_yaw_rate_rad_s",
    "friction",  # as the nominal model is told it
    "ax_m_s2",  # measured; 0 where missing
    "cg_to_front_axle_m",
    "cg_to_rear_axle_m",
    "inertia_ratio",  # I_z / (m l_f l_r)
    "front_stiffness_per_mass",  # m/s² per rad, at that friction
    "rear_stiffness_per_mass",
    "front_peak_per_mass",  # m/s², at friction 1
    "rear_peak_per_mass",
)
PAPER_FEATURES = FEATURES[:6]
ONE_CAR_FEATURES = FEATURES[:10]

# Entries of the filter's state, as in estimators.physics.
_VX, _VY, _YAW_RATE = 0, 1, 2


# positional: one array a sensor or state, in the order of the features
def make_features(
    steer_rad: FloatArray,
    ay_m_s2: FloatArray,
    yaw_rate_rad_s: FloatArray,
    posterior: FloatArray,
    prior: FloatArray,
    predicted_ay_m_s2: FloatArray,
    friction: FloatArray,
    ax_m_s2: FloatArray,
    car: FloatArray,
) -> FloatArray:
    """Return the features [K, 17] at each step; always finite where the filter's state is.

    A missing measurement is replaced by what the physics filter predicts for it, so that a dropped channel looks to
    the network like one that agrees with physics.

    Parameters
    ----------
    steer_rad : [K], held where missing. ay_m_s2, yaw_rate_rad_s : [K], NaN where missing.
    posterior, prior : states of the physics filter, [K, ≥3] over v_x, v_y, r; the prior is NaN where it starts.
    predicted_ay_m_s2 : [K], the nominal model's a_y at the posterior.
    friction : [K]. ax_m_s2 : [K], NaN where missing. car : [K, 7], the last seven features.
    """
    prior = np.where(np.isfinite(prior), prior, posterior)
    vx = posterior[:, _VX]
    rate = np.where(np.isfinite(yaw_rate_rad_s), yaw_rate_rad_s, prior[:, _YAW_RATE])
    beta_after = np.arctan2(posterior[:, _VY], np.maximum(vx, 0.1))
    beta_before = np.arctan2(prior[:, _VY], np.maximum(prior[:, _VX], 0.1))
    columns = np.stack(
        [
            vx,
            np.where(np.isfinite(ay_m_s2), ay_m_s2, predicted_ay_m_s2),
            steer_rad,
            rate,
            rate - prior[:, _YAW_RATE],
            beta_after - beta_before,
            posterior[:, _VY],
            posterior[:, _YAW_RATE],
            friction,
            np.where(np.isfinite(ax_m_s2), ax_m_s2, 0.0),
        ],
        axis=1,
    )
    return np.concatenate([columns, car], axis=1)
