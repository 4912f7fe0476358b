"""Rotations of a sensor in a car, and recorded coordinate frames, which are compared with the drive."""

from __future__ import annotations

import math
from itertools import permutations, product

import numpy as np

from pdhef_logtool.car.vehicle import GRAVITY_M_S2
from pdhef_logtool.mapping.frames import Placement
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.signals import FloatArray

#: A mean acceleration in this range is gravity.
IS_GRAVITY_M_S2 = (0.75 * GRAVITY_M_S2, 1.25 * GRAVITY_M_S2)
#: Accuracy of a rotation that was estimated from a drive with grade, crossfall, sideslip and bias.
APART_DEG = 12.0
#: Largest angle between the mean gravity of a drive and the car's vertical.
TILT_DEG = 15.0
#: Rounding error of recorded frames that are rotated by multiples of 90 degrees.
_WRITTEN_DEG = 0.5
_REMEDY = 'mend the frames, or name the axes in a mapping file, or --waive "imu.frames"'


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


def placed_rotation(placed: Placement) -> FloatArray:
    """Return the rotation [3, 3] of recorded frames, snapped to a multiple of 90 degrees within the rounding error."""
    step = nearest_step(placed.rotation)
    return step if _between_deg(step, placed.rotation) < _WRITTEN_DEG else placed.rotation


def gravity_agrees(placed: Placement, force: FloatArray) -> str:
    """Return why frames agree with gravity, the mean acceleration [3]; empty if they do not or gravity is removed."""
    tilt = _tilt_deg(placed, force)
    if tilt is None or tilt > TILT_DEG:
        return ""
    named = f"{placed.frame} in {placed.base}"
    return f"the recorded frames give it ({named}), and gravity is {tilt:.0f} deg off their vertical"


def frames_check(placed: Placement, shown: FloatArray | None, evidence: str, force: FloatArray) -> Check | None:
    """Compare frames with the rotation [3, 3] from the drive, otherwise with gravity; None without both."""
    said = f"the recorded frames ({placed.frame} in {placed.base}): {rotation_text(placed_rotation(placed))}"
    apart = None if shown is None else _between_deg(placed.rotation, shown)
    tilt = _tilt_deg(placed, force)
    if apart is not None and apart <= APART_DEG:
        return Check("imu.frames", "ay_m_s2", "passed", f"{said}; the drive agrees within {apart:.0f} deg")
    if shown is not None:
        evidence = f"{said}; the drive shows that {rotation_text(shown)}: {evidence}"
    elif tilt is not None and tilt > TILT_DEG:
        evidence = f"{said}, but gravity is {tilt:.0f} deg off their vertical"
    else:
        return None
    return Check("imu.frames", "ay_m_s2", "failed", evidence, _REMEDY)


def frames_alone(placed: Placement, believed: str) -> Check:
    """Report that only frames and gravity show how the IMU is mounted."""
    evidence = f"{rotation_text(placed_rotation(placed))}: {believed}; the drive does not show the rest"
    return Check("imu.frames", "ay_m_s2", "undecided", evidence, _REMEDY)


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


def _tilt_deg(placed: Placement, force: FloatArray) -> float | None:
    """Return the angle between the frames' vertical and gravity; None if the sensor subtracts gravity."""
    size = float(np.linalg.norm(force))
    if not IS_GRAVITY_M_S2[0] < size < IS_GRAVITY_M_S2[1]:
        return None
    return angle_deg(float(placed.rotation[2] @ force) / size)


def _between_deg(a: FloatArray, b: FloatArray) -> float:
    return angle_deg(0.5 * float(np.trace(a @ b.T) - 1.0))


def angle_deg(cosine: float) -> float:
    """Return the angle of a cosine, deg; rounding may exceed 1."""
    return math.degrees(math.acos(float(np.clip(cosine, -1.0, 1.0))))
