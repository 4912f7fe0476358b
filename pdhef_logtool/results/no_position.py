"""Outputs of ``--no-position``: no pose, no topic that may contain a place, no metadata, and no name of a file."""

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any, TypeVar

import numpy as np

from pdhef_logtool.logs.drive_log import DriveLog, TopicInfo
from pdhef_logtool.logs.message_schema import FieldInfo
from pdhef_logtool.logs.remote_place import LogPlace
from pdhef_logtool.mapping.can_frames import holds_frames
from pdhef_logtool.mapping.naming import VOCABULARY, words_of
from pdhef_logtool.mapping.records import Mapping as SignalMapping
from pdhef_logtool.records.signals import POSITIONS
from pdhef_logtool.records.tracks import StateTrack

#: Words of quantities that move or control a car, that describe a device or a message, and that may be of a place.
_MOTION, _STATE, _PLACE = (frozenset(words.split()) for words in VOCABULARY["places"].values())
_LISTS = ("lexicon", "whole", "bare", "counting", "of_v")
#: All words of a field that is known not to be a place: none that this package does not look up.
_VOCABULARY = frozenset().union(
    *(VOCABULARY["words"][name].split() for name in _LISTS),
    *(words.split() for words in VOCABULARY["axes"].values()),
    *VOCABULARY["units"].values(),
    VOCABULARY["corners"][""],
    _MOTION,
    _STATE,
)
#: Signals and ground truth that state a place or a heading.
_POSES = POSITIONS | {"gnss_heading_rad", "gnss_course_rad", "yaw_rad", "course_rad", "quat_wxyz"}
#: Texts that contain the name of a coordinate frame.
_FRAMES = ("header.frame_id", "child_frame_id")
_DIGITS = 8
_T = TypeVar("_T")


def without_pose(track: StateTrack) -> StateTrack:
    """Return a track without position and heading."""
    unknown = np.full(len(track), np.nan)
    return replace(track, x_m=unknown, y_m=unknown, yaw_rad=unknown)


def topics_with_position(log: DriveLog, mapping: SignalMapping) -> frozenset[str]:
    """Return the topics that are not copied: all with a field that may be a position.

    A field cannot be a position if ``mapping`` maps it to a signal other than a pose, or if its name consists of
    known words and names a motion or a state. Raw CAN frames, texts and bytes count as positions.
    """
    sources = (mapping.truth | mapping.signals).items()
    poses = {(s.topic, path) for name, s in sources if name in _POSES for path in s.paths}
    mapped = {(s.topic, path) for _, s in sources for path in s.paths}
    return frozenset(t.name for t in log.topics if _may_contain_place(log, t, mapped - poses, poses))


def _may_contain_place(
    log: DriveLog, topic: TopicInfo, mapped: Collection[tuple[str, str]], poses: Collection[tuple[str, str]]
) -> bool:
    fields = log.fields(topic.name, quiet=True)
    if not fields or holds_frames(topic.name, fields) or topic.name in {name for name, _ in poses}:
        return True
    if topic.encoding == "json":  # a schema does not exclude further entries
        every = (_entries(message) for message in log.first_messages(topic.name, topic.messages))
        fields = tuple({*fields, *(entry for entries in every for entry in entries)})
    is_imu = topic.type_name.replace("/msg/", "/") == "sensor_msgs/Imu"
    return not all(
        (topic.name, f.path) in mapped or _is_no_place(topic.name, f) or (is_imu and f.path.startswith("orientation"))
        for f in fields
    )


def _entries(value: object, path: str = "") -> Iterator[FieldInfo]:
    """List the leaves of a decoded JSON message."""
    if isinstance(value, dict):
        for name, member in value.items():
            yield from _entries(member, f"{path}.{name}" if path else str(name))
    elif isinstance(value, list):
        for member in value:
            yield from _entries(member, f"{path}[]")
    else:
        yield FieldInfo(path, "string" if isinstance(value, str) else "bool" if isinstance(value, bool) else "number")


def _is_no_place(topic: str, field: FieldInfo) -> bool:
    if field.kind in ("bool", "time"):
        return True
    if field.kind == "string" or ("[" in field.path and field.code in ("u1", "i1")):
        return field.path in _FRAMES
    parts = [{w for w in words_of(part) if w.isalpha()} for part in (*topic.split("/"), *field.path.split("."))]
    named = next((i for i in reversed(range(len(parts))) if parts[i] & (_MOTION | _STATE)), None)
    if named is None or (parts[named] & _PLACE and not parts[named] & _MOTION):
        return False
    return set().union(*parts[named:]) <= _VOCABULARY and not set().union(*parts[named + 1 :]) & _PLACE


def neutral_stem(identity: str | None) -> str:
    """Return the name of a log in outputs: ``log-`` and the first digits of the hash of its content."""
    return f"log-{identity[:_DIGITS]}" if identity else "log"


def without_names(document: _T, place: LogPlace, stem: str) -> _T:
    """Replace the path and name of a log and the names of files in its folder in all texts of a JSON-able document."""
    name = stem + PurePath(place.name).suffix
    names = {str(place): name, f"{place.name}/": f"{name}/"}
    if str(place.parent) != ".":
        names[f"{place.parent}/"] = ""
    if "." in place.name:  # otherwise it may be a word of the text
        names[place.name] = name
    if isinstance(place, Path) and place.is_dir():
        names |= {p.name: f"{stem}_{i}{p.suffix}" for i, p in enumerate(sorted(place.rglob("*.*")))}
    pattern = re.compile("|".join(map(re.escape, sorted(names, key=len, reverse=True))))

    def hidden(value: Any) -> Any:
        if isinstance(value, str):
            return name if value == place.name else pattern.sub(lambda match: names[match[0]], value)
        if isinstance(value, Mapping):
            return {key: hidden(entry) for key, entry in value.items()}
        return [hidden(entry) for entry in value] if isinstance(value, list | tuple) else value

    result: _T = hidden(document)
    return result
