"""The hash that says whether two files are recordings of one drive."""

from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.mapping import Mapping, SignalSource
from studies.strangers.containers import Topic, write

START_NS = 1_700_000_000_000_000_123
SECONDS = np.arange(600) * 0.01
ALL = ("/imu", "/speed", "/ins", "/other")
MAPPED = ALL[:3]

IMU = {"linear_acceleration.z": np.full(600, 9.81)}


def _write(path: Path, topics: tuple[str, ...], container: str, factor: float = 1.0, ay_offset: float = 0.0) -> Path:
    """Write a drive; ``factor`` scales the true lateral velocity."""
    rate, speed = 0.2 * np.sin(SECONDS), np.full(600, 15.0)
    imu = IMU | {"angular_velocity.z": rate, "linear_acceleration.y": 15.0 * rate + ay_offset}
    velocity = {"twist.twist.linear.x": speed, "twist.twist.linear.y": factor * rate, "twist.twist.angular.z": rate}
    ins = velocity | {"pose.pose.position.x": 15.0 * SECONDS}
    of_topics: dict[str, tuple[str, dict[str, np.ndarray], int, int]] = {
        "/imu": ("sensor_msgs/msg/Imu", imu, 1, 1),
        "/speed": ("geometry_msgs/msg/TwistStamped", {"twist.linear.x": speed}, 5, 2),
        "/ins": ("nav_msgs/msg/Odometry", ins, 5, 3),
        "/other": ("sensor_msgs/msg/Imu", imu, 10, 4),
    }
    found = []
    for topic in topics:
        kind, fields, step, late_ms = of_topics[topic]
        stamps_ns = START_NS + np.arange(0, 600, step, dtype=np.int64) * 10_000_000
        columns = {"header.stamp": stamps_ns} | {n: v[::step] for n, v in fields.items()}
        found.append(Topic(topic, kind, stamps_ns, stamps_ns + late_ms * 1_000_000, columns))
    return write(found, path, container)


def _hashes(path: Path, **changed: object) -> tuple[str | None, str | None]:
    sources = (
        SignalSource("ay_m_s2", "/imu", ("linear_acceleration.y",), **changed),
        SignalSource("yaw_rate_rad_s", "/imu", ("angular_velocity.z",), **changed),
        SignalSource("speed_m_s", "/speed", ("twist.linear.x",)),
        SignalSource("vx_m_s", "/ins", ("twist.twist.linear.x",)),
        SignalSource("vy_m_s", "/ins", ("twist.twist.linear.y",)),
    )
    mapping = Mapping({s.name: s for s in sources[:3]}, {s.name: s for s in sources[3:]})
    with read_drive(str(path), Car.load(), mapping) as drive:
        assert len(drive.whole().signals) > 580
        return drive.recorded().signals_sha256, drive.recorded().truth_sha256


@pytest.fixture(scope="module")
def full(tmp_path_factory):
    path = _write(tmp_path_factory.mktemp("full") / "drive", ALL, "rosbag2-mcap")
    return path, _hashes(path)


@pytest.mark.slow
def test_a_slim_copy_and_other_containers_have_one_hash(tmp_path, full):
    _, expected = full
    assert None not in expected
    assert expected[0] != expected[1]
    assert _hashes(_write(tmp_path / "slim", MAPPED, "rosbag2-mcap")) == expected
    assert _hashes(_write(tmp_path / "database", ALL, "rosbag2")) == expected
    assert _hashes(_write(tmp_path / "drive", MAPPED, "rosbag1")) == expected


def test_a_latency_that_becomes_known_leaves_the_drive_the_same(full):
    assert _hashes(full[0], latency_s=0.02) == full[1]


def test_another_truth_is_another_truth_of_the_same_drive(tmp_path, full):
    signals, truth = _hashes(_write(tmp_path / "truth", MAPPED, "rosbag2-mcap", factor=1.0 + 1e-12))
    assert signals == full[1][0]
    assert truth != full[1][1]


def test_other_values_and_another_scale_are_another_drive(tmp_path, full):
    signals, truth = _hashes(_write(tmp_path / "other", MAPPED, "rosbag2-mcap", ay_offset=1e-9))
    assert signals != full[1][0]
    assert truth == full[1][1]
    assert _hashes(full[0], scale=1.01)[0] != full[1][0]
