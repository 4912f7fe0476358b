"""Inputs of the network, the same code for training and service (docs/method.md#network).

A filter on physics runs in parallel and provides ε_phy: Δr = r_m − r̂⁻ and Δβ = β̂⁺ − β̂⁻ from its prior and posterior.
The inputs depend neither on the hybrid filter nor on ground truth.

Linear residual models take signals of the same table after four causal low-pass filters (:func:`slow_features`).
``odd`` signals change their sign when left and right are exchanged: steering angle, yaw rate, a_y and the sideslip of
``physics``. ``even`` signals do not: speed and a_x. A residual model uses even signals only as factors of odd ones, so
that it is odd and has no constant.
"""

from dataclasses import dataclass

import numpy as np

from pdhef_logtool.records.signals import FloatArray

#: Name and order of the features. The paper's six come first.
FEATURES = (
    "vx_m_s",  # posterior of the physics filter
    "ay_m_s2",  # measured
    "steer_rad",  # measured
    "yaw_rate_rad_s",  # measured
    "delta_yaw_rate_rad_s",
    "delta_sideslip_rad",
    "physics_vy_m_s",
    "physics_yaw_rate_rad_s",
    "friction",  # input of the model
    "ax_m_s2",  # measured; 0 where missing
    "utilisation",  # |a_y| / (μ g)
    "roll_rad",  # of the physics filter; 0 without this state, as for the next three
    "roll_rate_rad_s",
    "front_force_per_mass",  # of the axle, m/s²
    "rear_force_per_mass",
)
PAPER_FEATURES = FEATURES[:6]
#: Features that change their sign when left and right are exchanged.
ODD_FEATURES = frozenset(FEATURES) - {"vx_m_s", "friction", "ax_m_s2", "utilisation"}

ODD = ("steer_rad", "yaw_rate_rad_s", "ay_m_s2", "sideslip_rad")
EVEN = ("speed_m_s", "ax_m_s2")
#: Time constants of the low-pass filters, s.
TIME_CONSTANTS_S = (0.05, 0.3, 1.5, 6.0)
ODD_COUNT, EVEN_COUNT = len(ODD) * len(TIME_CONSTANTS_S), len(EVEN) * len(TIME_CONSTANTS_S)
#: Column of ``even`` with the speed for the region of validity, filtered with 0.3 s.
SPEED_COLUMN = len(EVEN)


@dataclass(frozen=True, slots=True, eq=False)
class SlowFeatures:
    """Features of steps: ``odd`` [K, 16] and ``even`` [K, 8], by time constant; a row with NaN has no residual."""

    odd: FloatArray
    even: FloatArray


def _slow_signals(features: FloatArray) -> FloatArray:
    """Return [K, 6] over :data:`ODD` and :data:`EVEN`."""
    column = {name: features[:, i] for i, name in enumerate(FEATURES)}
    sideslip = column["physics_vy_m_s"] / np.maximum(column["vx_m_s"], 1.0)  # m/s
    odd = (column["steer_rad"], column["physics_yaw_rate_rad_s"], column["ay_m_s2"], sideslip)
    return np.stack([*odd, column["vx_m_s"], column["ax_m_s2"]], axis=1)


def slow_features(features: FloatArray, dt_s: FloatArray, memory: FloatArray | None) -> tuple[SlowFeatures, FloatArray]:
    """Return the low-passed features of consecutive steps, and the memory of the filters for the next ones.

    Parameters
    ----------
    features : [K, 15]; rows with NaN are unknown.
    dt_s : [K], duration before each step; NaN where a sequence starts.
    memory : [4, 6], from the previous window; None at the start of a log.
    """
    from pdhef_logtool.residual_model.low_pass import low_pass  # compiled

    signals = _slow_signals(features)
    count = signals.shape[1]
    memory = np.zeros((len(TIME_CONSTANTS_S), count)) if memory is None else memory.copy()
    given = np.where(np.isfinite(signals).all(axis=1, keepdims=True), signals, np.nan)
    out = np.empty((len(TIME_CONSTANTS_S), *signals.shape))
    for tau, of_tau, filtered in zip(TIME_CONSTANTS_S, memory, out, strict=True):
        low_pass(given, dt_s, 1.0 / (2.0 * np.pi * tau), of_tau, filtered)
    split = len(ODD)
    odd, even = (np.concatenate(list(part), axis=1) for part in (out[..., :split], out[..., split:]))
    return SlowFeatures(odd, even), memory
