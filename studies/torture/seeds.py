"""Small intact files of every container, encoding and format, to be damaged: seconds of one drive each.

They are written by :mod:`studies.strangers.containers`.
"""

import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, IndexType, Writer

from studies.mcap_logs import Message, messages, write_log
from studies.pages import read_toml
from studies.strangers.cars import Series
from studies.strangers.containers import Topic, copied, write
from studies.strangers.recordings import imu, message, steering, velocity

START_NS = 1_767_225_600_000_000_000
_STAMPS = START_NS + np.arange(150) * 20_000_000
_RATE = 0.3 * np.sin(np.arange(150) * 0.06)
_SPEED = 15.0 + np.arange(150) * 0.02
#: Topics of tables and CAN logs.
TOPICS = (
    Topic("/imu", "bus", _STAMPS, _STAMPS, {"accel_y [m/s^2]": _SPEED * _RATE, "yaw_rate [rad/s]": _RATE}),
    Topic("/car", "bus", _STAMPS, _STAMPS, {"speed [m/s]": _SPEED, "steering_angle [rad]": 0.2 * _RATE}),
)
#: Stamps, yaw rate and speed of the recordings.
_FEW_NS, _R, _V = _STAMPS[:60], _RATE[:60], _SPEED[:60]
_CHUNK_BYTES = 12_000


def _ros_topics() -> tuple[Topic, ...]:
    """Return a car that turns: IMU, odometry as ground truth, steering and speed with types of their own."""

    def series(values: Any) -> Series:
        return Series(_FEW_NS, _FEW_NS, values)

    zero = 0.0 * _V
    force, rate = np.stack([zero + 0.1, _V * _R, zero + 9.81], axis=1), np.stack([zero, zero, _R], axis=1)
    motion = {"twist.twist.linear.x": _V, "twist.twist.linear.y": zero + 0.1, "twist.twist.angular.z": _R}
    motion |= {"pose.pose.position.x": np.cumsum(_V) * 0.02}
    frames: dict[str, str | float | Sequence[float]]
    frames = {"header.frame_id": "base", "child_frame_id": "base", "pose.pose.orientation.w": 1.0}
    return (
        imu(series(force), series(rate), frame="base"),
        message("/rtk/odometry", "nav_msgs/msg/Odometry", series(_V), motion, constants=frames),
        steering(series(0.2 * _R), "/vehicle/steering"),
        velocity(series(_V), "/vehicle/speed"),
    )


def _texts() -> Iterator[Message]:
    """Yield messages of unequal sizes: texts of 0 to 4 characters."""
    for i, stamp in enumerate(_FEW_NS.tolist()):
        text = b"a" * (i % 5) + b"\0"
        data = b"\0\1\0\0" + len(text).to_bytes(4, "little") + text
        yield Message(stamp, stamp, "/note", data, "cdr", ("std_msgs/msg/String", "ros2msg", b"string data\n"))


def _mcap(path: Path, container: str, compression: str = "ZSTD", index: str = "ALL", use_chunking: bool = True) -> None:
    """Write a log with a metadata record and an attachment."""

    def notes(writer: Writer) -> None:
        writer.add_metadata("drive", {"driver": "nobody", "tyres": "summer"})
        writer.add_attachment(START_NS, START_NS, "note.txt", "text/plain", b"a note")

    topics, texts = _ros_topics(), list(_texts())
    if container != "mcap":
        state = {"stamp.sec": _FEW_NS / 1e9, "speed": _V, "rate": _R, "wheels": np.stack([_V] * 4, axis=1)}
        topics, texts = (Topic("/vehicle/state", "car.State", _FEW_NS, _FEW_NS, state),), []
    with tempfile.TemporaryDirectory() as folder:
        written = sorted([*messages(write(topics, Path(folder) / "log", container)), *texts], key=lambda m: m[0])
    options = {"compression": CompressionType[compression], "index_types": IndexType[index]}
    profile = "ros2" if texts else ""
    write_log(path, written, profile, notes, chunk_size=_CHUNK_BYTES, use_chunking=use_chunking, **options)


def _bag(path: Path, compression: str = "") -> None:
    from rosbags.rosbag1 import Writer

    writer = Writer(path)
    writer.chunk_threshold = _CHUNK_BYTES
    if compression:
        writer.set_compression(writer.CompressionFormat[compression])
    copied(_ros_topics(), path, writer, ros1=True)


def _database(path: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        (database,) = write(_ros_topics(), Path(folder) / "bag", "rosbag2").glob("*.db3")
        shutil.copyfile(database, path)


#: Options of each seed, and suffix and layouts of each format, documented in their file.
_TABLES = read_toml(Path(__file__).with_suffix(".toml"))
_WRITERS: dict[str, Callable[..., None]] = {".mcap": _mcap, ".bag": _bag, ".db3": _database}
#: Writer of each seed, by file name.
SEEDS: dict[str, Callable[[Path], None]] = {
    name: partial(_WRITERS[Path(name).suffix], **entry) for name, entry in _TABLES["seeds"].items()
}


def write_seeds(folder: Path) -> dict[str, bytes]:
    """Write the seeds that are missing; return all by name."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, write_seed in SEEDS.items():
        if not (folder / name).is_file():
            write_seed(folder / name)
    return {name: (folder / name).read_bytes() for name in SEEDS}


RECORDINGS = ("mcap", "bag", "db3")
#: Suffix and layouts of each format; those of the recordings are seeds.
FORMATS: dict[str, tuple[str, list[str]]] = {
    **{name: (suffix, layouts) for name, (suffix, *layouts) in _TABLES["formats"].items()},
    **{suffix: (suffix, [name for name in SEEDS if name.endswith(suffix)]) for suffix in RECORDINGS},
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
