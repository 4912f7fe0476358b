"""Helpers for the reader tests: fields that every log contains, and values decoded by an independent reader."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from pdhef_logtool.logs.drive_log import DriveLog


def numeric_paths(log: DriveLog, topic: str) -> list[str]:
    """Every path of a topic that can be read as a column."""
    return [
        leaf.path
        for leaf in log.fields(topic)
        if leaf.kind != "string" and "[]." not in leaf.path and "][" not in leaf.path
    ]


def decoded_by_rosbags(
    paths: Sequence[Path], topics: Collection[str] | None = None
) -> dict[str, list[tuple[int, Any]]]:
    """Log time and decoded message of every message by topic, through rosbags' own containers and deserialisers."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    found: dict[str, list[tuple[int, Any]]] = defaultdict(list)
    with AnyReader(list(paths), default_typestore=get_typestore(Stores.LATEST)) as reader:
        wanted = [c for c in reader.connections if topics is None or c.topic in topics]
        for connection, stamp, data in reader.messages(wanted):
            found[connection.topic].append((stamp, reader.deserialize(data, connection.msgtype)))
    return found


def attribute(message: Any, path: str) -> Any:
    """Follow a dotted path without indices."""
    for name in path.split("."):
        message = getattr(message, name)
    return message
