"""Drives of the car of ``reference_car`` under a side force that its model lacks: the residual, known exactly."""

import math

import numpy as np
from reference_car import Drive, drive

from pdhef_logtool.records.tracks import StateTrack, make_track

#: Residual of v̇_y; that of ṙ is zero.
PULL_M_S2 = 0.5


def weaving(seconds: float = 20.0, speed: float = 22.0) -> Drive:
    """Drive a weaving course at 100 Hz."""

    def steer(t: float) -> float:
        return 0.03 * math.sin(2 * math.pi * 0.4 * t) + 0.02 * math.sin(2 * math.pi * 0.13 * t + 1.0)

    return drive(steer, seconds, speed, lambda t: 0.3 * math.sin(0.5 * t), side_pull_m_s2=PULL_M_S2)


def truth_of(stamps: np.ndarray, state: np.ndarray) -> StateTrack:
    """Return ground truth with v_x, v_y and r [N, 3], valid where they are known."""
    names = ("vx_m_s", "vy_m_s", "yaw_rate_rad_s")
    return make_track("truth", stamps, **dict(zip(names, state.T, strict=True)), valid=np.isfinite(state).all(axis=1))
