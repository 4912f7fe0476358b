"""Inputs of residual models: signals of the physics filter after four causal low-pass filters.

``odd`` signals change their sign when left and right are exchanged: steering angle, yaw rate, a_y and the sideslip of
``physics``. ``even`` signals do not: speed and a_x. A residual model uses even signals only as factors of odd ones, so
that it is odd and has no constant. The inputs depend neither on the residual nor on ground truth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdhef_logtool.records.signals import FloatArray

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


def slow_features(signals: FloatArray, dt_s: FloatArray, memory: FloatArray | None) -> tuple[SlowFeatures, FloatArray]:
    """Return the features of a window, and the memory of the filters for the next one.

    Parameters
    ----------
    signals : [K, 6] over :data:`ODD` and :data:`EVEN`; NaN where unknown.
    dt_s : [K], duration before each step; NaN where a sequence starts.
    memory : [4, 6], from the previous window; None at the start of a log.
    """
    from pdhef_logtool.residual_model.low_pass import low_pass  # compiled

    count = signals.shape[1]
    memory = np.zeros((len(TIME_CONSTANTS_S), count)) if memory is None else memory.copy()
    given = np.where(np.isfinite(signals).all(axis=1, keepdims=True), signals, np.nan)
    out = np.empty((len(TIME_CONSTANTS_S), *signals.shape))
    for tau, of_tau, filtered in zip(TIME_CONSTANTS_S, memory, out, strict=True):
        low_pass(given, dt_s, 1.0 / (2.0 * np.pi * tau), of_tau, filtered)
    split = len(ODD)
    odd, even = (np.concatenate(list(part), axis=1) for part in (out[..., :split], out[..., split:]))
    return SlowFeatures(odd, even), memory
