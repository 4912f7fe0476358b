"""Joints of a vehicle model (``sensor_msgs/JointState``): the messages, not the type, give the joint of each number."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace

from pdhef_logtool.logs.drive_log import DriveLog, TopicInfo
from pdhef_logtool.logs.message_schema import value_at
from pdhef_logtool.mapping.naming import Meaning, corner_of, words_of
from pdhef_logtool.mapping.records import SignalSource

#: Number of messages to read the names from: several nodes may send different joints to one topic.
MESSAGES = 200
_STEERS = frozenset({"steer", "steering", "steered"})
_WHEELS = frozenset({"wheel", "wheels", "whl", "tire", "tyre"})


def is_joints(topic: TopicInfo) -> bool:
    """Return whether a topic contains the states of joints."""
    return topic.type_name.replace("/msg/", "/") == "sensor_msgs/JointState"


def joint_names(log: DriveLog, topic: TopicInfo) -> tuple[str, ...]:
    """Return the joints of a topic in their order; empty if the order varies between messages."""
    messages = log.first_messages(topic.name, MESSAGES)
    orders = {tuple(str(n) for n in names) for m in messages if (names := _listed(value_at(m, ("name",))))}
    return next(iter(orders)) if len(orders) == 1 else ()


def _listed(value: object) -> tuple[object, ...]:
    return tuple(value) if isinstance(value, list | tuple) else ()


def joint_meanings(log: DriveLog, topic: TopicInfo) -> Iterator[tuple[str, Meaning]]:
    """Yield path and meaning of steered wheels (rad) and rotating wheels (rad/s)."""
    for i, name in enumerate(joint_names(log, topic)):
        words = words_of(name)
        corner, why = corner_of(words), f"joint {name!r} names it"
        if _STEERS & set(words):
            kind = "road" if corner or {"left", "right"} & set(words) else "wheel" if _WHEELS & set(words) else ""
            yield f"position[{i}]", Meaning("steering", kind, 1.0, "rad", 1.0, why)
        elif corner and (_WHEELS & set(words) or len(words) < 3):
            yield f"velocity[{i}]", Meaning("wheel rate", corner, 1.0, "radps", 1.0, why)


def mean_of_sides(log: DriveLog, topics: Mapping[str, TopicInfo], steering: SignalSource) -> SignalSource | None:
    """Return the mean of the left and right steered wheel if a steering angle is one of the two."""
    topic = topics.get(steering.topic)
    if topic is None or not is_joints(topic) or not isinstance(steering.field, str):
        return None
    names = joint_names(log, topic)
    joint = names[int(steering.field[len("position[") : -1])]
    for this, other in (("left", "right"), ("right", "left"), ("fl", "fr"), ("fr", "fl"), ("l", "r"), ("r", "l")):
        there = re.sub(rf"(?<![a-z]){this}(?![a-z])", other, joint)
        if there != joint and there in names:
            scale = float(steering.scale if isinstance(steering.scale, float) else steering.scale[0])
            fields = (steering.field, f"position[{names.index(there)}]")
            return replace(steering, field=fields, scale=(0.5 * scale, 0.5 * scale))
    return None
