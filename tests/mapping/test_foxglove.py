"""Foxglove's messages, and ROS types in JSON and protobuf, are recognised like their ROS counterparts."""

import math
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import AutoMapping, auto_map, fit_clocks, read_signals
from pdhef_logtool.records.signals import Channel
from studies.strangers import containers
from studies.strangers.containers import Topic
from tests.fake_drive_log import FakeLog, FakeTopic

STEP = np.arange(40)
STAMPS = 100_000_000_000 + STEP * 100_000_000
ONE = np.ones(40)
Fields = Mapping[str, np.ndarray]


def mapped(folder: Path, container: str, **topics: tuple[str, Fields]) -> tuple[AutoMapping, dict[str, Channel]]:
    """Write topics (type, columns) that are recorded 20 ms after their stamps, and map the log."""
    contents = [Topic(f"/{n}", kind, STAMPS, STAMPS + 20_000_000, columns) for n, (kind, columns) in topics.items()]
    with closing(open_log(containers.write(contents, folder / "log", container))) as log:
        found = auto_map(log)
        read = read_signals(log, found.mapping, fit_clocks(log, found.mapping, log.start_ns, log.end_ns), 0, 10**12)
    return found, {**read.signals, **read.truth}


def stamped(place: str, names: tuple[str, str]) -> dict[str, np.ndarray]:
    return {f"{place}.{names[0]}": STAMPS // 10**9, f"{place}.{names[1]}": STAMPS % 10**9}


ENCODINGS = pytest.mark.parametrize(
    ("container", "times"), [("mcap-protobuf", ("seconds", "nanos")), ("mcap-json", ("sec", "nsec"))]
)
FIX = {"latitude": 57.0 + STEP * 1e-5, "longitude": 12.0 * ONE, "altitude": 30.0 * ONE}


@ENCODINGS
def test_a_location_fix_is_a_satellite_fix_with_angles_from_north(tmp_path, container, times):
    fix = {**stamped("timestamp", times), **FIX, "heading": 0.1 * STEP, "course": 0.1 * STEP + 0.02}
    found, got = mapped(tmp_path, container, gps=("foxglove.LocationFix", fix))
    assert set(found.mapping.truth) == {"lat_deg", "lon_deg", "alt_m", "yaw_rad", "course_rad"}
    np.testing.assert_array_equal(got["lat_deg"].stamps_ns, STAMPS)
    np.testing.assert_allclose(got["yaw_rad"].values, math.pi / 2 - 0.1 * STEP, atol=1e-12)
    np.testing.assert_allclose(got["course_rad"].values, math.pi / 2 - 0.1 * STEP - 0.02, atol=1e-12)
    assert any("two antennas" in note for note in found.mapping.notes)


def test_a_heading_that_repeats_the_course_is_no_yaw():
    fix = FakeTopic("foxglove.LocationFix", STAMPS, {**FIX, "heading": 0.1 * STEP, "course": 0.1 * STEP})
    mapping = auto_map(FakeLog({"/gps": fix})).mapping
    assert "yaw_rad" not in mapping.truth
    assert "course_rad" in mapping.truth
    assert any("repeats the course" in note for note in mapping.notes)


@ENCODINGS
def test_odometry_is_truth_or_speed_by_its_name(tmp_path, container, times):
    def odometry(scale: float) -> tuple[str, Fields]:
        position = {"pose.position.x": 2.0 * STEP, "pose.position.y": 0.5 * ONE, "pose.position.z": 0.0 * ONE}
        attitude = dict(zip("xyzw", (0.0, 0.0, 0.6, 0.8), strict=True))
        turned = {f"pose.orientation.{axis}": value * ONE for axis, value in attitude.items()}
        ahead = {"linear_velocity.x": 20.0 * scale * ONE, "linear_velocity.y": 0.01 * STEP}
        return "foxglove.Odometry", {
            **stamped("timestamp", times), **position, **turned, **ahead, "angular_velocity.z": 0.3 + 0.01 * STEP,
        }  # fmt: skip

    found, got = mapped(tmp_path, container, truth=odometry(1.0), wheel=odometry(1.01))
    assert {s.topic for s in found.mapping.signals.values()} == {"/wheel"}
    truth = {"vx_m_s", "vy_m_s", "yaw_rate_rad_s", "x_m", "y_m", "quat_wxyz"}
    assert {n: s.topic for n, s in found.mapping.truth.items()} == dict.fromkeys(truth, "/truth")
    np.testing.assert_allclose(got["speed_m_s"].values, 20.2)
    np.testing.assert_allclose(got["yaw_rate_rad_s"].values, 0.3 + 0.01 * STEP)
    np.testing.assert_allclose(got["quat_wxyz"].values[0], [0.8, 0.0, 0.0, 0.6])
    np.testing.assert_array_equal(got["vx_m_s"].stamps_ns, STAMPS)


def test_a_list_of_poses_is_said_and_not_guessed():
    poses = FakeTopic("foxglove.PosesInFrame", STAMPS, {"poses[].position.x": ONE})
    found = auto_map(FakeLog({"/ground_truth/poses": poses}))
    assert not found.mapping.truth
    assert [(a.candidates, a.chosen) for a in found.ambiguities] == [(("/ground_truth/poses",), None)]
    assert "list of poses" in str(found.ambiguities[0])


IMU = {"linear_acceleration.x": ONE, "linear_acceleration.y": 2.0 * ONE, "linear_acceleration.z": 9.8 * ONE,
       "angular_velocity.z": 0.5 * ONE}  # fmt: skip


@pytest.mark.parametrize("name", ["sensor_msgs/Imu", "sensor_msgs/msg/Imu", "sensor_msgs.Imu", "ros.sensor_msgs.Imu"])
def test_a_ros_type_in_json_is_recognised_by_its_name(tmp_path, name):
    imu = {**stamped("header.stamp", ("sec", "nanosec")), **IMU}
    found, got = mapped(tmp_path, "mcap-json", imu=(name, imu))
    assert set(found.mapping.signals) == {"ax_m_s2", "ay_m_s2", "yaw_rate_rad_s"}
    assert set(got["ay_m_s2"].values) == {2.0}
    np.testing.assert_array_equal(got["ay_m_s2"].stamps_ns, STAMPS)


def test_a_name_without_the_fields_is_said_and_spoils_nothing(tmp_path):
    other, fix = ("sensor_msgs/Imu", {"acc": np.ones((40, 3))}), ("foxglove.LocationFix", {"lat": ONE})
    found, _ = mapped(tmp_path, "mcap-json", imu=("sensor_msgs/Imu", IMU), x=other, gps=fix)
    assert found.mapping.signals["ax_m_s2"].topic == "/imu"
    assert not found.ambiguities
    assert sorted(n.partition(" ")[0] for n in found.mapping.notes if "fields differ from" in n) == ["/gps", "/x"]
