"""The log that the speed benchmarks read: one hour of five topics, 1.26 M messages, 449 MB of records, zstd chunks.

| topic | type | Hz | fields that vary |
| --- | --- | --- | --- |
| /imu | sensor_msgs/msg/Imu | 100 | orientation, angular velocity, linear acceleration |
| /odometry | nav_msgs/msg/Odometry | 100 | pose, twist |
| /steering | std_msgs/msg/Float64 | 50 | steering angle |
| /velocity | geometry_msgs/msg/TwistStamped | 50 | speed, yaw rate |
| /wheels | sensor_msgs/msg/JointState | 50 | angle and speed of four wheels |

The values are smooth motions with sensor noise, so that they compress like recorded ones. The variant with images holds
the same messages and /image (sensor_msgs/msg/Image) with 20 times as many bytes of noise, which nobody maps. It is
shorter than an hour (an hour would be 9 GB), and memory is compared with a log of the same length without images. A
third log has a minute of them, 150 MB of images, in chunks that images and sensors share, as recorders write them.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.measuring import CACHE
from pdhef_logtool.logs.container import ChannelRecord
from pdhef_logtool.logs.definitions import message_definition
from pdhef_logtool.logs.encoding import CdrEncoder
from pdhef_logtool.logs.writer import McapLogWriter, RawMessage, TopicBatch
from pdhef_logtool.records.geometry import quat_from_yaw
from pdhef_logtool.records.signals import FloatArray, IntArray
from pdhef_logtool.storage.files import PendingFile

START_NS = 1_700_000_000_000_000_000
HOUR_S = 3600
IMAGE_LOG_S = 360
SHARED_S = 60
IMAGE_TIMES = 20
IMAGE_HZ = 5
RAW_BYTES_PER_S = 124_650
_WINDOW_S = 60
_IMAGE = "sensor_msgs/msg/Image"

#: Fields of a mapped run: eleven of all five topics.
MAPPED = {
    "/imu": ("linear_acceleration.x", "linear_acceleration.y", "angular_velocity.z"),
    "/odometry": ("twist.twist.linear.x", "twist.twist.linear.y"),
    "/steering": ("data",),
    "/velocity": ("twist.linear.x",),
    "/wheels": ("velocity[0]", "velocity[1]", "velocity[2]", "velocity[3]"),
}


def hour_log() -> Path:
    """Return the one-hour log, written once."""
    return _cached("hour.mcap", HOUR_S, images=False)


def short_log() -> Path:
    """Return the short log without images."""
    return _cached("short.mcap", IMAGE_LOG_S, images=False)


def image_log() -> Path:
    """Return the short log with images."""
    return _cached("short_with_images.mcap", IMAGE_LOG_S, images=True)


def shared_log() -> Path:
    """Return a minute with images; its chunks contain images and all other topics."""
    path = CACHE / "shared_chunks.mcap"
    if path.exists():
        return path
    from mcap.reader import make_reader
    from mcap.writer import CompressionType, Writer

    with _cached("minute_with_images.mcap", SHARED_S, images=True).open("rb") as file, PendingFile(path) as pending:
        writer = Writer(str(pending.path), chunk_size=4 << 20, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="benchmark")
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(file).iter_messages():
            if channel.id not in channels:
                id_ = writer.register_schema(schema.name, schema.encoding, schema.data) if schema else 0
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, id_)
            to = channels[channel.id]
            writer.add_message(to, message.log_time, message.data, message.publish_time, message.sequence)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves it without types
    return path


def _cached(name: str, seconds: int, images: bool) -> Path:
    path = CACHE / name
    if not path.exists():
        CACHE.mkdir(parents=True, exist_ok=True)
        write_drive(path, seconds, images=images)
    return path


def write_drive(path: Path, seconds: int, *, images: bool, seed: int = 0) -> None:
    """Write a drive; the same arguments give the same bytes."""
    rng = np.random.default_rng(seed)
    with McapLogWriter(path) as writer:
        writer.add_topic("/imu", "sensor_msgs/msg/Imu", constants={"header.frame_id": "imu_link"})
        frames = {"header.frame_id": "map", "child_frame_id": "base_link"}
        writer.add_topic("/odometry", "nav_msgs/msg/Odometry", constants=frames)
        writer.add_topic("/steering", "std_msgs/msg/Float64")
        writer.add_topic("/velocity", "geometry_msgs/msg/TwistStamped", constants={"header.frame_id": "base_link"})
        writer.add_topic("/wheels", "sensor_msgs/msg/JointState", constants={"header.frame_id": "base_link"})
        image = _add_image_channel(writer) if images else None
        for begin in range(0, seconds, _WINDOW_S):
            length = min(_WINDOW_S, seconds - begin)
            batches = _window(rng, begin, length)
            writer.write(batches, () if image is None else _images(rng, image, begin, length))


def _stamps(begin_s: int, length_s: int, rate_hz: int, offset_ns: int) -> IntArray:
    n = length_s * rate_hz
    return START_NS + begin_s * 10**9 + offset_ns + np.arange(n, dtype=np.int64) * (10**9 // rate_hz)


def _window(rng: np.random.Generator, begin_s: int, length_s: int) -> list[TopicBatch]:
    """Make one window of a drive that weaves through two speeds of oscillation."""

    def columns(rate_hz: int, offset_ns: int) -> tuple[IntArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        stamps_ns = _stamps(begin_s, length_s, rate_hz, offset_ns)
        t = np.asarray((stamps_ns - START_NS) * 1e-9, dtype=np.float64)
        speed: FloatArray = 20.0 + 5.0 * np.sin(0.02 * t)
        steer: FloatArray = 0.03 * np.sin(0.4 * t) * np.cos(0.03 * t)
        return stamps_ns, t, speed, steer, speed * steer / 2.7

    def noisy(values: FloatArray, std: float) -> FloatArray:
        return values + std * rng.standard_normal(values.shape)

    def batch(topic: str, stamps_ns: IntArray, fields: dict[str, FloatArray], stamped: bool = True) -> TopicBatch:
        header = {"header.stamp": stamps_ns} if stamped else {}
        return TopicBatch(topic, stamps_ns + 1_000_000, stamps_ns, {**header, **fields})

    def vector(x: FloatArray, y: FloatArray, z: FloatArray) -> FloatArray:
        return np.stack([x, y, z], axis=1)

    batches = []
    stamps, t, speed, steer, rate = columns(100, 0)
    still = np.zeros(len(t))
    yaw = 0.1 * np.sin(0.05 * t)
    imu = {
        "orientation": quat_from_yaw(yaw),
        "linear_acceleration": noisy(vector(still, speed * rate, still + 9.81), 0.05),
        "angular_velocity": noisy(vector(still, still, rate), 0.002),
    }
    batches.append(batch("/imu", stamps, imu))
    odometry = {
        "pose.pose.position": noisy(vector(20.0 * t, 3.0 * np.sin(0.05 * t), still), 0.01),
        "pose.pose.orientation": quat_from_yaw(yaw),
        "twist.twist.linear": noisy(vector(speed, -0.4 * rate, still), 0.02),
        "twist.twist.angular": vector(still, still, rate),
    }
    batches.append(batch("/odometry", stamps, odometry))
    stamps, t, speed, steer, rate = columns(50, 300_000)
    still = np.zeros(len(t))
    batches.append(batch("/steering", stamps, {"data": noisy(steer, 1e-4)}, stamped=False))
    velocity = {"twist.linear": vector(noisy(speed, 0.05), still, still), "twist.angular": vector(still, still, rate)}
    batches.append(batch("/velocity", stamps, velocity))
    wheels = {
        "position": np.cumsum(np.tile(speed[:, None] / 0.3 / 50.0, 4), axis=0),
        "velocity": noisy(np.tile(speed[:, None] / 0.3, 4), 0.1),
    }
    batches.append(batch("/wheels", stamps, wheels))
    return batches


def _add_image_channel(writer: McapLogWriter) -> int:
    definition = message_definition(_IMAGE).encode()
    return writer.add_channel(ChannelRecord(-1, "/image", "cdr", _IMAGE, "ros2msg", definition))


def _images(rng: np.random.Generator, channel: int, begin_s: int, length_s: int) -> Iterator[RawMessage]:
    """Yield mono8 images of noise: 20 times as many bytes as the rest of the log."""
    width = 1024
    height = int(IMAGE_TIMES * RAW_BYTES_PER_S / IMAGE_HZ / width)
    encoder = CdrEncoder("/image", _IMAGE, message_definition(_IMAGE), {"header.frame_id": "camera"})
    for i, stamp in enumerate(_stamps(begin_s, length_s, IMAGE_HZ, 700_000).tolist()):
        # Height and the rest follow the header with its padding: 4 + 8 + 4 + 7 + 1 bytes.
        head = encoder.encode(1, {"header.stamp": np.array([stamp])}).tobytes()[:24]
        body = (
            np.array([height, width, 6], dtype="<u4").tobytes()
            + b"mono8\0\0\0"
            + np.array([width, width * height], dtype="<u4").tobytes()
        )
        data = head + body + rng.bytes(width * height)
        yield RawMessage(channel, stamp + 2_000_000, stamp, begin_s * IMAGE_HZ + i, data)
