"""Records and rounding that all output files share."""

import numpy as np

from pdhef_logtool.evaluation.manoeuvres import Event as Event
from pdhef_logtool.records.signals import FloatArray, IntArray

#: Name of the track that contains the ground truth.
TRUTH = "truth"

#: Recordings of longer drives contain a subset of the stamps.
LONGEST_WHOLE_NS = 600_000_000_000

#: Rounding steps in files, far below the resolution of sensors: powers of two, so that the last bytes are zero.
STEPS = dict.fromkeys(("yaw_rad", "yaw_rate_rad_s", "steer_rad"), 2.0**-17)
STEPS |= {"x_m": 2.0**-10, "y_m": 2.0**-10, "vx_m_s": 2.0**-13, "vy_m_s": 2.0**-13}
STEPS |= {"sideslip_rad": 2.0**-20, "ay_m_s2": 2.0**-12, "orientation": 2.0**-18}
#: Columns in single precision: values that a user has given, such as 0.85.
_SINGLE = frozenset({"friction", "network_trust", "r_scale"})
#: Bits that are cleared in single-precision values of other columns, which leaves 12 bits of mantissa.
BITS_OUT = 11


def rounded(name: str, values: FloatArray) -> FloatArray:
    """Round a column for files: motion to a step, given values to single precision, others to a relative 1.2e-4.

    The zero bytes take no space in a compressed file.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # values beyond single precision; signalling NaN
        step = STEPS.get(name)
        if step is not None:
            return np.asarray(np.rint(values / step) * step + 0.0, dtype=np.float64)  # + 0.0: no negative zeros
        short = np.array(values, dtype=np.float32)
        if name not in _SINGLE:
            bits = short.view(np.uint32)
            bits += np.uint32(1 << (BITS_OUT - 1))
            bits &= np.uint32((0xFFFFFFFF << BITS_OUT) & 0xFFFFFFFF)
            short[np.isnan(values)] = np.nan  # clearing bits turns some NaN into numbers
        return short.astype(np.float64)


def first_of_slots(stamps_ns: IntArray, step_ns: int) -> IntArray:
    """Return the rows [K] of the first stamp in each slot of ``step_ns``."""
    slot = stamps_ns // step_ns
    return np.flatnonzero(np.diff(slot, prepend=slot[:1] - 1) != 0)
