"""The hash that says whether two files are recordings of one drive."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Bag1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Bag2
from rosbags.typesys import Stores, get_typestore

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.mapping import Mapping, SignalSource

START_NS = 1_700_000_000_000_000_123
IMU, TWIST, ODOMETRY = "sensor_msgs/msg/Imu", "geometry_msgs/msg/TwistStamped", "nav_msgs/msg/Odometry"
SECONDS = 6.0


class Made:
    """Messages of a drive in the types of one ROS; ``factor`` scales the true lateral velocity."""

    def __init__(self, store: Stores, factor: float = 1.0, ay_offset: float = 0.0) -> None:
        self.store = get_typestore(store)
        self.factor, self.ay_offset = factor, ay_offset

    def _new(self, name: str, *values: object) -> object:
        return self.store.types[name](*values)

    def _header(self, stamp_ns: int, number: int) -> object:
        stamp = self._new("builtin_interfaces/msg/Time", stamp_ns // 10**9, stamp_ns % 10**9)
        own = ("seq",) if "seq" in self.store.types["std_msgs/msg/Header"].__dataclass_fields__ else ()
        return self._new("std_msgs/msg/Header", *([number] if own else []), stamp, "base_link")

    def _vector(self, x: float, y: float, z: float) -> object:
        return self._new("geometry_msgs/msg/Vector3", x, y, z)

    def messages(self) -> list[tuple[str, str, int, object]]:
        none, still = np.zeros(9), self._new("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
        found = []
        for i in range(round(SECONDS * 100)):
            stamp, at = START_NS + 10_000_000 * i, 0.01 * i
            rate, header = 0.2 * np.sin(at), self._header(stamp, i)
            lateral = self._vector(0.0, 15.0 * rate + self.ay_offset, 9.81)
            imu = self._new(IMU, header, still, none, self._vector(0.0, 0.0, rate), none, lateral, none)
            found.append(("/imu", IMU, stamp + 1_000_000, imu))
            if i % 5 == 0:
                twist = self._new("geometry_msgs/msg/Twist", self._vector(15.0, 0.0, 0.0), self._vector(0.0, 0.0, 0.0))
                found.append(("/speed", TWIST, stamp + 2_000_000, self._new(TWIST, header, twist)))
                place = self._new("geometry_msgs/msg/Point", 15.0 * at, 0.0, 0.0)
                pose = self._new(
                    "geometry_msgs/msg/PoseWithCovariance",
                    self._new("geometry_msgs/msg/Pose", place, still),
                    np.zeros(36),
                )
                velocity = self._new(
                    "geometry_msgs/msg/Twist", self._vector(15.0, self.factor * rate, 0.0), self._vector(0.0, 0.0, rate)
                )
                moved = self._new("geometry_msgs/msg/TwistWithCovariance", velocity, np.zeros(36))
                found.append(
                    ("/ins", ODOMETRY, stamp + 3_000_000, self._new(ODOMETRY, header, "base_link", pose, moved))
                )
            if i % 10 == 0:
                found.append(("/other", IMU, stamp + 4_000_000, imu))
        return found


def _fill(writer: Bag1 | Bag2, made: Made, serialize: str, topics: tuple[str, ...]) -> None:
    with writer:
        connections = {}
        for topic, kind, at_ns, message in made.messages():
            if topic in topics:
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=made.store)
                writer.write(connections[topic], at_ns, getattr(made.store, serialize)(message, kind))


def _bag1(path: Path, topics: tuple[str, ...], **changed: float) -> Path:
    writer = Bag1(path)
    writer.set_compression(writer.CompressionFormat.LZ4)
    _fill(writer, Made(Stores.ROS1_NOETIC, **changed), "serialize_ros1", topics)
    return path


def _bag2(path: Path, topics: tuple[str, ...], plugin: StoragePlugin, **changed: float) -> Path:
    _fill(Bag2(path, version=9, storage_plugin=plugin), Made(Stores.ROS2_HUMBLE, **changed), "serialize_cdr", topics)
    return path


MAPPED = ("/imu", "/speed", "/ins")
ALL = (*MAPPED, "/other")


def _hashes(path: Path, **changed: object) -> tuple[str | None, str | None]:
    mapping = Mapping(
        signals={
            "ay_m_s2": SignalSource("ay_m_s2", "/imu", ("linear_acceleration.y",), **changed),
            "yaw_rate_rad_s": SignalSource("yaw_rate_rad_s", "/imu", ("angular_velocity.z",), **changed),
            "speed_m_s": SignalSource("speed_m_s", "/speed", ("twist.linear.x",)),
        },
        truth={
            "vx_m_s": SignalSource("vx_m_s", "/ins", ("twist.twist.linear.x",)),
            "vy_m_s": SignalSource("vy_m_s", "/ins", ("twist.twist.linear.y",)),
        },
    )
    with read_drive(str(path), Car.load(), mapping) as drive:
        assert drive.signals_sha256 is None
        assert len(drive.whole().signals) > 580
        return drive.signals_sha256, drive.truth_sha256


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, tuple[str | None, str | None]]:
    path = _bag2(tmp_path_factory.mktemp("full") / "drive", ALL, StoragePlugin.MCAP)
    return path, _hashes(path)


@pytest.mark.slow
def test_a_slim_copy_and_other_containers_have_one_hash(tmp_path: Path, full: tuple[Path, tuple[str, str]]) -> None:
    _, expected = full
    assert None not in expected
    assert expected[0] != expected[1]
    assert _hashes(_bag2(tmp_path / "slim", MAPPED, StoragePlugin.MCAP)) == expected
    assert _hashes(_bag2(tmp_path / "database", ALL, StoragePlugin.SQLITE3)) == expected
    assert _hashes(_bag1(tmp_path / "drive.bag", MAPPED)) == expected


def test_a_latency_that_becomes_known_leaves_the_drive_the_same(full: tuple[Path, tuple[str, str]]) -> None:
    assert _hashes(full[0], latency_s=0.02) == full[1]


def test_another_truth_is_another_truth_of_the_same_drive(tmp_path: Path, full: tuple[Path, tuple[str, str]]) -> None:
    signals, truth = _hashes(_bag2(tmp_path / "truth", MAPPED, StoragePlugin.MCAP, factor=1.0 + 1e-12))
    assert signals == full[1][0]
    assert truth != full[1][1]


def test_other_values_and_another_scale_are_another_drive(tmp_path: Path, full: tuple[Path, tuple[str, str]]) -> None:
    signals, truth = _hashes(_bag2(tmp_path / "other", MAPPED, StoragePlugin.MCAP, ay_offset=1e-9))
    assert signals != full[1][0]
    assert truth == full[1][1]
    assert _hashes(full[0], scale=1.01)[0] != full[1][0]
