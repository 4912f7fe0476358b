"""Joints of a vehicle model (``sensor_msgs/JointState``): the messages, not the type, give the joint of each number."""

from collections.abc import Iterator

from pdhef_logtool.logs.drive_log import DriveLog, TopicInfo
from pdhef_logtool.logs.message_schema import values_at
from pdhef_logtool.mapping.naming import Meaning, corner_of, words_of

#: Number of messages to read the names from: several nodes may send different joints to one topic.
MESSAGES = 200
_STEERS = frozenset({"steer", "steering", "steered"})
_WHEELS = frozenset({"wheel", "wheels", "whl", "tire", "tyre"})


def is_joints(topic: TopicInfo) -> bool:
    """Return whether a topic contains the states of joints."""
    return topic.type_name.replace("/msg/", "/") == "sensor_msgs/JointState"


def joint_names(log: DriveLog, topic: TopicInfo) -> tuple[str, ...]:
    """Return the joints of a topic in their order; empty if the order varies between messages."""
    listed = values_at(log.first_messages(topic.name, MESSAGES), ("name",))
    orders = {tuple(map(str, names)) for names in listed if isinstance(names, list | tuple) and names}
    return next(iter(orders)) if len(orders) == 1 else ()


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
