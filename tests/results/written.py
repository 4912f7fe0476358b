"""Number formats of files, defined a second time: steps for state values, single precision for inputs, else 12 bits."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Exponents of two.
_STEPS = {
    "x_m": -10,
    "y_m": -10,
    "yaw_rad": -17,
    "vx_m_s": -13,
    "vy_m_s": -13,
    "yaw_rate_rad_s": -17,
    "sideslip_rad": -20,
    "ay_m_s2": -12,
}


def as_written(values: NDArray[Any], column: str = "") -> NDArray[Any]:
    """Return a column as the file holds it."""
    if values.dtype != np.float64:
        return values
    if column in _STEPS:
        return np.ldexp(np.round(np.ldexp(values, -_STEPS[column])), _STEPS[column])
    if column in ("friction", "network_trust", "r_scale"):
        return values.astype(np.float32).astype(np.float64)
    part, exponent = np.frexp(values.astype(np.float32).astype(np.float64))
    scaled = np.ldexp(part, 13)
    nearest = np.trunc(scaled + np.copysign(0.5, scaled))  # halves away from zero
    return np.where(np.isfinite(values), np.ldexp(nearest, exponent - 13), values)
