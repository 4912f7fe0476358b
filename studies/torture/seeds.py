"""Small sound recordings of every container and encoding, to be damaged: a second of one simulated drive each."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.logs.definitions import message_definition

START_NS = 1_767_225_600_000_000_000
_RATE_HZ = 50
_SECONDS = 1.2
#: Types that carry their definition; the sequence and the text make messages of unequal sizes.
_OWN = {
    "ackermann_msgs/msg/AckermannDrive": "float32 steering_angle\nfloat64[4] wheels\nuint8[] spare\nstring note\n",
    "autoware_vehicle_msgs/msg/VelocityReport": "std_msgs/Header header\nfloat32 longitudinal_velocity\n",
}


@dataclass(frozen=True, slots=True)
class Message:
    """One message: topic, ROS 2 type, time, payload as CDR and as plain values."""

    topic: str
    type_name: str
    time_ns: int
    cdr: bytes
    values: dict[str, Any]


def messages() -> list[Message]:
    """Return a car that turns: IMU, odometry as ground truth, and an unknown type."""
    store = _store("LATEST")
    types = store.types
    steering_type, speed_type = _OWN
    written = []
    for i in range(int(_RATE_HZ * _SECONDS)):
        stamp_ns, t = START_NS + i * 1_000_000_000 // _RATE_HZ, i / _RATE_HZ
        rate, speed = 0.3 * np.sin(3.0 * t), 15.0
        stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="base")
        vector, quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
        zeros9, zeros36 = np.zeros(9), np.zeros(36)
        level = quaternion(x=0.0, y=0.0, z=0.0, w=1.0)
        imu = types["sensor_msgs/msg/Imu"](
            header, level, zeros9, vector(0.0, 0.0, rate), zeros9, vector(0.1, speed * rate, 9.81), zeros9
        )
        pose = types["geometry_msgs/msg/PoseWithCovariance"](
            types["geometry_msgs/msg/Pose"](types["geometry_msgs/msg/Point"](speed * t, 0.0, 0.0), level), zeros36
        )
        twist = types["geometry_msgs/msg/TwistWithCovariance"](
            types["geometry_msgs/msg/Twist"](vector(speed, 0.1, 0.0), vector(0.0, 0.0, rate)), zeros36
        )
        odometry = types["nav_msgs/msg/Odometry"](header, "base", pose, twist)
        steering = 0.02 * np.sin(3.0 * t)
        angle = types[steering_type](steering, np.full(4, speed), np.arange(i % 5, dtype=np.uint8), "ok")
        plain = {
            "stamp": {"sec": stamp_ns // 10**9, "nsec": stamp_ns % 10**9},
            "speed": speed,
            "rate": rate,
            "wheels": [speed] * 4,
        }
        for topic, name, message in (
            ("/imu/data", "sensor_msgs/msg/Imu", imu),
            ("/rtk/odometry", "nav_msgs/msg/Odometry", odometry),
            ("/vehicle/steering", steering_type, angle),
            ("/vehicle/speed", speed_type, types[speed_type](header, speed)),
        ):
            written.append(Message(topic, name, stamp_ns, bytes(store.serialize_cdr(message, name)), plain))
    return written


def _store(release: str) -> Any:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores[release])
    for name, text in _OWN.items():
        store.register(get_types_from_msg(text, name))
    return store


def _definition(name: str) -> bytes:
    if name not in _OWN:
        return message_definition(name).encode()
    text: str = _store("LATEST").generate_msgdef(name, ros_version=2)[0]
    return text.encode()


def _mcap(compression: str, path: Path, *, chunks: bool = True, index: bool = True, encoding: str = "cdr") -> None:
    from mcap.writer import CompressionType, IndexType, Writer

    kinds = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4, "none": CompressionType.NONE}
    with path.open("wb") as file:
        writer = Writer(
            file,
            chunk_size=12_000,
            compression=kinds[compression],
            use_chunking=chunks,
            index_types=IndexType.ALL if index else IndexType.NONE,
        )
        writer.start("ros2" if encoding == "cdr" else "")
        channels: dict[str, int] = {}
        for i, m in enumerate(messages()):
            if m.topic not in channels:
                name, kind, schema = {
                    "cdr": (m.type_name, "ros2msg", _definition(m.type_name)),
                    "json": ("State", "jsonschema", json.dumps(_JSON_SCHEMA).encode()),
                    "protobuf": ("car.State", "protobuf", _descriptors()),
                }[encoding]
                channels[m.topic] = writer.register_channel(
                    m.topic, encoding, writer.register_schema(name, kind, schema)
                )
            payload = {"cdr": m.cdr, "json": json.dumps(m.values).encode(), "protobuf": b""}[encoding]
            payload = payload or _protobuf(m.values)
            writer.add_message(channels[m.topic], m.time_ns, payload, m.time_ns, i)
        writer.add_metadata("drive", {"driver": "nobody", "tyres": "summer"})
        writer.add_attachment(START_NS, START_NS, "note.txt", "text/plain", b"a note")
        writer.finish()  # type: ignore[no-untyped-call]


_JSON_SCHEMA = {
    "type": "object",
    "properties": {
        "stamp": {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}},
        "speed": {"type": "number"},
        "rate": {"type": "number"},
        "wheels": {"type": "array", "items": {"type": "number"}},
    },
}


def _descriptors() -> bytes:
    from google.protobuf import descriptor_pb2

    files = descriptor_pb2.FileDescriptorSet()
    file = files.file.add(name="state.proto", package="car", syntax="proto3")
    wheel = file.message_type.add(name="Wheel")
    wheel.field.add(name="speed", number=1, type=1, label=1)
    state = file.message_type.add(name="State")
    state.field.add(name="speed", number=1, type=1, label=1)
    state.field.add(name="rate", number=2, type=1, label=1)
    state.field.add(name="wheels", number=3, type=11, label=3, type_name=".car.Wheel")
    return bytes(files.SerializeToString())


def _protobuf(values: dict[str, Any]) -> bytes:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(_descriptors()).file:
        pool.Add(file)
    message = message_factory.GetMessageClass(pool.FindMessageTypeByName("car.State"))()
    message.speed, message.rate = values["speed"], values["rate"]
    for wheel in values["wheels"]:
        message.wheels.add(speed=wheel)
    return bytes(message.SerializeToString())


def _bag(compression: str, path: Path) -> None:
    from rosbags.rosbag1 import Writer

    store, newest = _store("ROS1_NOETIC"), _store("LATEST")
    writer = Writer(path)
    writer.chunk_threshold = 12_000
    if compression:
        writer.set_compression(writer.CompressionFormat[compression])
    with writer:
        connections: dict[str, Any] = {}
        for m in messages():
            if m.topic not in connections:
                connections[m.topic] = writer.add_connection(m.topic, m.type_name, typestore=store)
            message = newest.deserialize_cdr(m.cdr, m.type_name)
            if hasattr(message, "header"):
                header = store.types["std_msgs/msg/Header"]
                message.header = header(0, message.header.stamp, message.header.frame_id)
            writer.write(connections[m.topic], m.time_ns, store.serialize_ros1(message, m.type_name))


def _database(path: Path) -> None:
    import shutil
    import tempfile

    from rosbags.rosbag2 import StoragePlugin, Writer

    store = _store("LATEST")
    with tempfile.TemporaryDirectory() as folder:
        with Writer(Path(folder) / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
            connections: dict[str, Any] = {}
            for m in messages():
                if m.topic not in connections:
                    connections[m.topic] = writer.add_connection(m.topic, m.type_name, typestore=store)
                writer.write(connections[m.topic], m.time_ns, m.cdr)
        shutil.copyfile(Path(folder) / "bag" / "bag.db3", path)


#: Writer of each seed, by file name.
SEEDS: dict[str, Callable[[Path], None]] = {
    "zstd.mcap": partial(_mcap, "zstd"),
    "lz4.mcap": partial(_mcap, "lz4"),
    "plain.mcap": partial(_mcap, "none"),
    "unchunked.mcap": partial(_mcap, "none", chunks=False),
    "noindex.mcap": partial(_mcap, "zstd", index=False),
    "json.mcap": partial(_mcap, "zstd", encoding="json"),
    "protobuf.mcap": partial(_mcap, "zstd", encoding="protobuf"),
    "plain.bag": partial(_bag, ""),
    "bz2.bag": partial(_bag, "BZ2"),
    "lz4.bag": partial(_bag, "LZ4"),
    "rosbag2.db3": _database,
}


def write_seeds(folder: Path) -> dict[str, bytes]:
    """Write the seeds that are missing; return all by name."""
    folder.mkdir(parents=True, exist_ok=True)
    return dict(_seeds(folder))


def _seeds(folder: Path) -> Iterator[tuple[str, bytes]]:
    for name, write in SEEDS.items():
        path = folder / name
        if not path.is_file():
            write(path)
        yield name, path.read_bytes()
