"""Helpers for the reader tests: contents of logs, by this and by independent readers, and writers of small logs."""

from collections import defaultdict
from collections.abc import Collection, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.summary import Summary

from pdhef_logtool.logs.container import ChannelRecord
from pdhef_logtool.logs.drive_log import Columns, DriveLog
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.writer import McapLogWriter
from pdhef_logtool.records.signals import FloatArray

T0 = 1_700_000_000_000_000_000


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


def counts_of(log: DriveLog) -> dict[str, int]:
    """Number of messages of each topic that are read."""
    return {topic: len(columns) for topic, columns in log.read({t.name: () for t in log.topics}).items()}


def fields_of(path: Path, topic: str, *fields: str) -> dict[str, Any]:
    """Fields of a topic of a log."""
    with closing(open_log(path)) as log:
        return dict(log.read({topic: fields})[topic].fields)


def summary_of(path: Path) -> Summary:
    """Summary of an MCAP by another reader."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return summary


def messages_of(path: Path, without: str = "") -> list[tuple[object, ...]]:
    """Everything about every message of an MCAP by another reader, in order of log time, but for those of a topic."""
    with path.open("rb") as file:
        found = [row for row in make_reader(file, validate_crcs=True).iter_messages() if row[1].topic != without]
    about = [(c.message_encoding, tuple(sorted(c.metadata.items()))) for _, c, _ in found]
    schemas = [s and (s.name, s.encoding, s.data) for s, _, _ in found]
    stamps = [(m.log_time, c.topic, m.data, m.publish_time, m.sequence) for _, c, m in found]
    return [(*row, *of, schema) for row, of, schema in zip(stamps, about, schemas, strict=True)]


def raw_channel(writer: McapLogWriter, topic: str, name: str = "", text: bytes = b"", message: str = "cdr") -> int:
    """Add a channel with a ROS 2 definition, or without a schema."""
    return writer.add_channel(ChannelRecord(-1, topic, message, name, "ros2msg" if name else "", text))


def write_imu(path: Path, values: FloatArray, chunk: int = 10**9) -> Path:
    """Write an MCAP of an IMU with yaw rates at 100 Hz; a chunk has up to ``chunk`` messages."""
    stamps = T0 + np.arange(len(values)) * 10_000_000
    with McapLogWriter(path) as writer:
        writer.add_topic("/imu", "sensor_msgs/msg/Imu", constants={"header.frame_id": "imu"})
        for at in range(0, len(values), chunk):
            part = slice(at, at + chunk)
            writer.write([Columns("/imu", stamps[part], stamps[part], {"angular_velocity.z": values[part]})])
    return path


def write_vectors(path: Path, topic: str, count: int, storage: str = "sqlite3", compression: str = "") -> Path:
    """Write a rosbag2 folder, or a ROS 1 ``bag``, of vectors x = 0, 0.25, ... by the writer of another project."""
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    is_bag, name = storage == "bag", "geometry_msgs/msg/Vector3"
    store = get_typestore(Stores.ROS1_NOETIC if is_bag else Stores.ROS2_HUMBLE)
    serialize = store.serialize_ros1 if is_bag else store.serialize_cdr
    writer: Any = (
        rosbag1.Writer(path)
        if is_bag
        else rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin[storage.upper()])
    )
    if compression and is_bag:
        writer.set_compression(writer.CompressionFormat[compression])
    elif compression:
        writer.set_compression(rosbag2.CompressionMode[compression], rosbag2.CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection(topic, name, typestore=store)
        for i in range(count):
            message = store.types[name](x=0.25 * i, y=0.0, z=0.0)
            writer.write(connection, T0 + i, serialize(message, name))
    return path
