"""Small sound files of every container, encoding and format, to be damaged: seconds of one simulated drive each."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, IndexType, Writer

from pdhef_logtool.logs.definitions import message_definition
from studies import mcap_logs
from studies.strangers.containers import Topic, write

START_NS = 1_767_225_600_000_000_000
_RATE_HZ = 50
_SECONDS = 1.2
#: Types that carry their definition; the sequence and the text make messages of unequal sizes.
_OWN = {
    "ackermann_msgs/msg/AckermannDrive": "float32 steering_angle\nfloat64[4] wheels\nuint8[] spare\nstring note\n",
    "autoware_vehicle_msgs/msg/VelocityReport": "std_msgs/Header header\nfloat32 longitudinal_velocity\n",
}


_SCHEMA = Path(__file__).with_name("state.schema.json").read_bytes().strip()


@dataclass(frozen=True, slots=True)
class Message:
    """One message: topic, ROS 2 type, time, payload as CDR and as plain values."""

    topic: str
    type_name: str
    time_ns: int
    cdr: bytes
    values: dict[str, Any]


def messages() -> Iterator[Message]:
    """Yield a car that turns: IMU, odometry as ground truth, and an unknown type."""
    store = _store("LATEST")
    # Zeros, and texts of length 1: of frame_id, and of child_frame_id behind it.
    texts = b"\0\1\0\0" + bytes(8) + b"\1" + bytes(7)
    imu = store.deserialize_cdr(texts.ljust(316, b"\0"), "sensor_msgs/msg/Imu")
    odometry = store.deserialize_cdr((texts + b"\1").ljust(708, b"\0"), "nav_msgs/msg/Odometry")
    imu.orientation.w = odometry.pose.pose.orientation.w = 1.0
    odometry.child_frame_id, odometry.header = "base", imu.header
    imu.header.frame_id = "base"
    steering_type, speed_type = _OWN
    for i in range(int(_RATE_HZ * _SECONDS)):
        stamp_ns, t = START_NS + i * 1_000_000_000 // _RATE_HZ, i / _RATE_HZ
        seconds, nanoseconds = divmod(stamp_ns, 10**9)
        rate, speed = 0.3 * np.sin(3.0 * t), 15.0
        imu.header.stamp.sec, imu.header.stamp.nanosec = seconds, nanoseconds
        acceleration, twist = imu.linear_acceleration, odometry.twist.twist
        acceleration.x, acceleration.y, acceleration.z = 0.1, speed * rate, 9.81
        twist.linear.x, twist.linear.y = speed, 0.1
        imu.angular_velocity.z = twist.angular.z = rate
        odometry.pose.pose.position.x = speed * t
        spare = np.arange(i % 5, dtype=np.uint8)
        angle = store.types[steering_type](0.02 * np.sin(3.0 * t), np.full(4, speed), spare, "ok")
        stamp = {"sec": seconds, "nsec": nanoseconds}
        plain = {"stamp": stamp, "speed": speed, "rate": rate, "wheels": [speed] * 4}
        for topic, name, message in (
            ("/imu/data", "sensor_msgs/msg/Imu", imu),
            ("/rtk/odometry", "nav_msgs/msg/Odometry", odometry),
            ("/vehicle/steering", steering_type, angle),
            ("/vehicle/speed", speed_type, store.types[speed_type](imu.header, speed)),
        ):
            yield Message(topic, name, stamp_ns, bytes(store.serialize_cdr(message, name)), plain)


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


def _mcap(encoding: str, path: Path, **options: Any) -> None:
    def encoded() -> Iterator[mcap_logs.Message]:
        for m in messages():
            payload, schema = m.cdr, (m.type_name, "ros2msg", _definition(m.type_name))
            if encoding == "json":
                payload, schema = json.dumps(m.values).encode(), ("State", "jsonschema", _SCHEMA)
            elif encoding == "protobuf":
                payload, schema = _protobuf(m.values), ("car.State", "protobuf", _descriptors())
            yield mcap_logs.Message(m.time_ns, m.time_ns, m.topic, payload, encoding, schema)

    def notes(writer: Writer) -> None:
        writer.add_metadata("drive", {"driver": "nobody", "tyres": "summer"})
        writer.add_attachment(START_NS, START_NS, "note.txt", "text/plain", b"a note")

    mcap_logs.write_log(path, encoded(), "ros2" if encoding == "cdr" else "", notes, chunk_size=12_000, **options)


def _descriptors() -> bytes:
    from google.protobuf import descriptor_pb2, text_format

    text = Path(__file__).with_name("state.txtpb").read_text(encoding="utf-8")
    return bytes(text_format.Parse(text, descriptor_pb2.FileDescriptorSet()).SerializeToString())


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


def _copied(writer: Any, store: Any, *, ros1: bool) -> None:
    """Write all messages with a writer of rosbags."""
    newest, connections = _store("LATEST"), dict[str, Any]()
    with writer:
        for m in messages():
            if m.topic not in connections:
                connections[m.topic] = writer.add_connection(m.topic, m.type_name, typestore=store)
            data = newest.cdr_to_ros1(m.cdr, m.type_name) if ros1 else m.cdr
            writer.write(connections[m.topic], m.time_ns, data)


def _bag(compression: str, path: Path) -> None:
    from rosbags.rosbag1 import Writer

    writer = Writer(path)
    writer.chunk_threshold = 12_000
    if compression:
        writer.set_compression(writer.CompressionFormat[compression])
    _copied(writer, _store("ROS1_NOETIC"), ros1=True)


def _database(path: Path) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer

    with tempfile.TemporaryDirectory() as folder:
        writer = Writer(Path(folder) / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3)
        _copied(writer, _store("LATEST"), ros1=False)
        shutil.copyfile(Path(folder) / "bag" / "bag.db3", path)


#: Writer of each seed, by file name.
SEEDS: dict[str, Callable[[Path], None]] = {
    "zstd.mcap": partial(_mcap, "cdr"),
    "lz4.mcap": partial(_mcap, "cdr", compression=CompressionType.LZ4),
    "plain.mcap": partial(_mcap, "cdr", compression=CompressionType.NONE),
    "unchunked.mcap": partial(_mcap, "cdr", compression=CompressionType.NONE, use_chunking=False),
    "noindex.mcap": partial(_mcap, "cdr", index_types=IndexType.NONE),
    "json.mcap": partial(_mcap, "json"),
    "protobuf.mcap": partial(_mcap, "protobuf"),
    "plain.bag": partial(_bag, ""),
    "bz2.bag": partial(_bag, "BZ2"),
    "lz4.bag": partial(_bag, "LZ4"),
    "rosbag2.db3": _database,
}


def write_seeds(folder: Path) -> dict[str, bytes]:
    """Write the seeds that are missing; return all by name."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, write_seed in SEEDS.items():
        if not (folder / name).is_file():
            write_seed(folder / name)
    return {name: (folder / name).read_bytes() for name in SEEDS}


# ------------------------------------------------------------------------------------------------ tables

_STAMPS = START_NS + np.arange(150) * 20_000_000
_RATE = 0.3 * np.sin(np.arange(150) * 0.06)
_SPEED = 15.0 + np.arange(150) * 0.02
TOPICS = (
    Topic("/imu", "bus", _STAMPS, _STAMPS, {"accel_y [m/s^2]": _SPEED * _RATE, "yaw_rate [rad/s]": _RATE}),
    Topic("/car", "bus", _STAMPS, _STAMPS, {"speed [m/s]": _SPEED, "steering_angle [rad]": 0.2 * _RATE}),
)
RECORDINGS = ("mcap", "bag", "db3")
#: Suffix and layouts of each format; a number after a version of MDF is its compression.
FORMATS: dict[str, tuple[str, tuple[str, ...]]] = {
    "csv": ("csv", ("csv", "csv-german", "csv-gps", "csv-lab", "csv-dated", "csv-sources", "csv-pipes", "csv-long")),
    "vbo": ("vbo", ("vbo",)),
    "parquet": ("parquet", ("parquet", "parquet-nested", "parquet-long")),
    "mat5": ("mat", ("mat", "mat-series", "mat-pairs", "mat-recorder")),
    "mat73": ("mat", ("mat-7.3",)),
    "mdf3": ("mdf", ("3.30 0",)),
    "mdf4": ("mf4", ("mdf", "4.11 2", "can-mdf")),
    "blf": ("blf", ("can-blf",)),
    "asc": ("asc", ("can-asc",)),
    **{suffix: (suffix, tuple(name for name in SEEDS if name.endswith(suffix))) for suffix in RECORDINGS},
}


def table_seeds(name: str, folder: Path) -> list[bytes]:
    """Return the sound files of a format; a folder takes files in between."""
    if name in RECORDINGS:
        return [content for seed, content in write_seeds(folder).items() if seed in FORMATS[name][1]]
    return [_seed(layout, folder) for layout in FORMATS[name][1]]


def _seed(layout: str, folder: Path) -> bytes:
    version, _, compression = layout.partition(" ")
    path = write(TOPICS, folder / "seed", "mdf" if compression else layout)
    if compression:
        import asammdf

        with asammdf.MDF(path) as file, file.convert(version) as other:
            path = Path(other.save(folder / "other", overwrite=True, compression=int(compression)))
    return (next(path.glob("drive.*")) if path.is_dir() else path).read_bytes()
