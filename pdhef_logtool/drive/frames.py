"""Rotations of a sensor in a car."""

from __future__ import annotations

import math
from itertools import permutations, product

import numpy as np

from pdhef_logtool.car.vehicle import GRAVITY_M_S2
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.signals import FloatArray

#: A mean acceleration in this range is gravity.
IS_GRAVITY_M_S2 = (0.75 * GRAVITY_M_S2, 1.25 * GRAVITY_M_S2)
#: Largest angle between the mean gravity of a drive and the car's vertical.
TILT_DEG = 15.0


def angles_deg(rotation: FloatArray) -> tuple[float, float, float]:
    """Return roll, pitch and yaw of a sensor rotation [3, 3], in the order yaw, pitch, roll."""
    m = rotation
    pitch = math.asin(float(np.clip(-m[2, 0], -1.0, 1.0)))
    if abs(m[2, 0]) > 1.0 - 1e-6:  # gimbal lock: roll and yaw are not separable
        return 0.0, math.degrees(pitch), math.degrees(math.atan2(-m[0, 1], m[1, 1]))
    roll, yaw = math.atan2(m[2, 1], m[2, 2]), math.atan2(m[1, 0], m[0, 0])
    return math.degrees(roll), math.degrees(pitch), math.degrees(yaw)


def rotation_text(rotation: FloatArray) -> str:
    """Return a sensor's rotation as text."""
    roll, pitch, yaw = (round(a) + 0 if abs(a - round(a)) < 0.05 else round(a, 1) for a in angles_deg(rotation))
    return f"the IMU is mounted with roll {roll:g}, pitch {pitch:g}, yaw {yaw:g} deg"


def nearest_step(rotation: FloatArray) -> FloatArray:
    """Return the nearest rotation [3, 3] by multiples of 90 degrees."""
    rows = np.eye(3)[list(permutations(range(3)))]
    steps = np.concatenate([rows * np.array(signs)[:, None] for signs in product((1.0, -1.0), repeat=3)]) + 0.0
    steps = steps[np.linalg.det(steps) > 0.0]
    return np.asarray(steps[np.argmax(np.sum(steps * rotation, axis=(1, 2)))])


def upright_check(named: FloatArray, force: FloatArray) -> Check | None:
    """Report that gravity, the mean acceleration [3], is not upward in the axes that a mapping names.

    ``named``: rows [3, 3] of forward, left and the yaw axis in the sensor's axes. The result is None without forward or
    left, and if the sensor subtracts gravity.
    """
    up, size = np.cross(named[0], named[1]), float(np.linalg.norm(force))
    least = math.cos(math.radians(2.0 * TILT_DEG)) * size
    if not up.any() or not IS_GRAVITY_M_S2[0] < size < IS_GRAVITY_M_S2[1] or up @ force > least:
        return None
    along = int(np.argmax(np.abs(force)))
    axis = f"{'-' if force[along] < 0.0 else '+'}{'xyz'[along]}"
    evidence = f"gravity is along {axis} of the accelerometer, not along its vertical: its axes are not the car's"
    remedy = 'turn them in a mapping file, or --waive "imu.mounting"'
    return Check("imu.mounting", "ay_m_s2", "undecided", evidence, remedy)


def angle_deg(cosine: float) -> float:
    """Return the angle of a cosine, deg; rounding may exceed 1."""
    return math.degrees(math.acos(float(np.clip(cosine, -1.0, 1.0))))
