"""Find the mounting of a sensor in a recorded frame tree (``/tf_static``)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.logs.message_schema import value_at
from pdhef_logtool.records.geometry import rotation_from_quat
from pdhef_logtool.records.signals import FloatArray

#: Names of the vehicle frame, without the prefix before a slash.
BASES = ("base_link", "base_footprint", "ego_vehicle", "vehicle", "base", "car", "chassis")
_TYPES = frozenset({"tf2_msgs/TFMessage", "tf/tfMessage"})
#: Limits: messages of fixed frames to read, and frames between a sensor and its car.
MOST_MESSAGES = 500
MOST_STEPS = 16


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """Mounting of a sensor: the rotation [3, 3] from its axes to the vehicle frame's."""

    frame: str
    base: str
    rotation: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
    """A frame in its parent."""

    parent: str
    rotation: FloatArray
    position_m: FloatArray


def placement_of(log: DriveLog, topic: str) -> Placement | None:
    """Return the mounting of a topic's sensor; None if no chain of recorded frames connects it to a car."""
    frame = next((f for m in log.first_messages(topic, 1) if (f := _name(m, "header", "frame_id"))), "")
    steps = _fixed_frames(log) if frame else {}
    if frame not in steps:
        return None
    current, rotation = frame, np.eye(3)
    for _ in range(MOST_STEPS):
        step = steps.get(current)
        if step is None or current.rpartition("/")[2] in BASES:
            break
        current, rotation = step.parent, step.rotation @ rotation
    is_placed = current.rpartition("/")[2] in BASES and current != frame
    return Placement(frame, current, rotation) if is_placed else None


def _fixed_frames(log: DriveLog) -> Mapping[str, _Step]:
    """Return the fixed frames by name; a frame that is defined twice with different poses is excluded."""
    by_name: dict[str, _Step] = {}
    moved: set[str] = set()
    for topic in log.topics:
        if topic.type_name.replace("/msg/", "/") not in _TYPES or not topic.name.endswith("tf_static"):
            continue
        for message in log.first_messages(topic.name, MOST_MESSAGES):
            transforms = value_at(message, ("transforms",))
            for item in transforms if isinstance(transforms, list | tuple) else ():
                name, step = _name(item, "child_frame_id"), _step(item)
                if step is None:
                    continue
                first = by_name.setdefault(name, step)
                same = first.parent == step.parent and np.allclose(first.rotation, step.rotation, atol=1e-6)
                if not (same and np.allclose(first.position_m, step.position_m, atol=1e-6)):
                    moved.add(name)
    return {name: step for name, step in by_name.items() if name not in moved}


def _step(transform: object) -> _Step | None:
    quaternion = _numbers(transform, "rotation", "wxyz")
    position = _numbers(transform, "translation", "xyz")
    if not (np.isfinite(quaternion).all() and np.isfinite(position).all()):
        return None
    if abs(float(np.linalg.norm(quaternion)) - 1.0) > 0.01:
        return None
    return _Step(_name(transform, "header", "frame_id"), rotation_from_quat(quaternion[None, :])[0], position)


def _numbers(transform: object, part: str, axes: str) -> FloatArray:
    values = [value_at(transform, ("transform", part, axis)) for axis in axes]
    return np.array([v if isinstance(v, int | float) else np.nan for v in values], dtype=np.float64)


def _name(message: object, *steps: str) -> str:
    value = value_at(message, steps)
    return value.lstrip("/") if isinstance(value, str) else ""
