"""Rotations of a sensor in a car, and recorded frames compared with them: they are evidence, and may be wrong."""

from __future__ import annotations

import math
from itertools import permutations, product

import numpy as np

from pdhef_logtool.car.vehicle import GRAVITY_M_S2
from pdhef_logtool.mapping.frames import Placement
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.signals import FloatArray

#: Mean accelerations between these are gravity.
IS_GRAVITY_M_S2 = (0.75 * GRAVITY_M_S2, 1.25 * GRAVITY_M_S2)
#: A rotation found from a drive is as good as this, grade and crossfall, sideslip and bias in it.
APART_DEG = 12.0
#: Gravity of a drive is along the car's vertical but for so much.
TILT_DEG = 15.0
#: A frame that is turned by 90 degrees is written with so few digits.
_WRITTEN_DEG = 0.5
_REMEDY = 'mend the frames, or name the axes in a mapping file, or --waive "imu.frames"'


def angles_deg(rotation: FloatArray) -> tuple[float, float, float]:
    """Return roll, pitch and yaw of a sensor in the car [3, 3]: it is turned by yaw first, then pitch, then roll."""
    m = rotation
    pitch = math.asin(float(np.clip(-m[2, 0], -1.0, 1.0)))
    if abs(m[2, 0]) > 1.0 - 1e-6:  # straight up or down: roll and yaw are one angle
        return 0.0, math.degrees(pitch), math.degrees(math.atan2(-m[0, 1], m[1, 1]))
    roll, yaw = math.atan2(m[2, 1], m[2, 2]), math.atan2(m[1, 0], m[0, 0])
    return math.degrees(roll), math.degrees(pitch), math.degrees(yaw)


def rotation_text(rotation: FloatArray) -> str:
    """Return a sensor's rotation in words."""
    roll, pitch, yaw = (round(a) + 0 if abs(a - round(a)) < 0.05 else round(a, 1) for a in angles_deg(rotation))
    return f"the IMU is mounted with roll {roll:g}, pitch {pitch:g}, yaw {yaw:g} deg"


def nearest_step(rotation: FloatArray) -> FloatArray:
    """Return the multiple of 90 degrees [3, 3] that a rotation is nearest to."""
    rows = np.eye(3)[list(permutations(range(3)))]
    steps = np.concatenate([rows * np.array(signs)[:, None] for signs in product((1.0, -1.0), repeat=3)]) + 0.0
    steps = steps[np.linalg.det(steps) > 0.0]
    return np.asarray(steps[np.argmax(np.sum(steps * rotation, axis=(1, 2)))])


def placed_rotation(placed: Placement) -> FloatArray:
    """Return the rotation [3, 3] that frames give, the multiple of 90 degrees where it is one but for its digits."""
    step = nearest_step(placed.rotation)
    return step if _between_deg(step, placed.rotation) < _WRITTEN_DEG else placed.rotation


def gravity_agrees(placed: Placement, force: FloatArray) -> str:
    """Return why frames are accepted by gravity, the mean [3] of the accelerations; empty where it does not show it."""
    tilt = _tilt_deg(placed, force)
    if tilt is None or tilt > TILT_DEG:
        return ""
    named = f"{placed.frame} in {placed.base}"
    return f"the recorded frames give it ({named}), and gravity is {tilt:.0f} deg off their vertical"


def frames_check(placed: Placement, shown: FloatArray | None, evidence: str, force: FloatArray) -> Check | None:
    """Compare frames against the rotation [3, 3] that the drive shows, else with gravity; None without both."""
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
    """Report that nothing but frames and gravity shows how the IMU lies."""
    evidence = f"{rotation_text(placed_rotation(placed))}: {believed}; the drive does not show the rest"
    return Check("imu.frames", "ay_m_s2", "undecided", evidence, _REMEDY)


def _tilt_deg(placed: Placement, force: FloatArray) -> float | None:
    """Return the angle from the vertical of frames to gravity; None where the sensor takes gravity off."""
    size = float(np.linalg.norm(force))
    if not IS_GRAVITY_M_S2[0] < size < IS_GRAVITY_M_S2[1]:
        return None
    return math.degrees(math.acos(float(np.clip(placed.rotation[2] @ force / size, -1.0, 1.0))))


def _between_deg(a: FloatArray, b: FloatArray) -> float:
    return math.degrees(math.acos(float(np.clip(0.5 * (np.trace(a @ b.T) - 1.0), -1.0, 1.0))))
