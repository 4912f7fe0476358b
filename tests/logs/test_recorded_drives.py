"""Recorded drives and their damaged copies: counts, intervals of loss, and values against an independent reader."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from recorded import attribute, decoded_by_rosbags

from pdhef_logtool.logs.open_log import open_log

pytestmark = pytest.mark.slow

REVS = "data/drives/revs_250lm_a.mcap"
FAULTY = "data/drives/faulty"

_COMPARED = {
    "data/drives/revs_250lm_a.mcap": {
        "/imu/data": ["linear_acceleration.y", "angular_velocity.z"],
        "/vehicle/status/steering_status": ["steering_tire_angle"],
        "/ins/odometry": ["twist.twist.linear.x", "twist.twist.angular.z"],
    },
    "data/drives/f1tenth_hoons_run2.bag": {
        "/imu": ["linear_acceleration.x", "angular_velocity.z"],
        "/drive": ["drive.steering_angle"],
        "/optitrack/twist": ["twist.linear.y"],
    },
    "data/drives/lunda_v40": {"/vbox/sample": ["steer_ang_deg", "y_accel_g"], "/vbox/slip": ["lat_vel_kmh"]},
}


@pytest.mark.parametrize("name", sorted(_COMPARED))
def test_values_equal_those_of_an_independent_reader(shared_dir: Path, name: str) -> None:
    path = shared_dir / name
    expected = decoded_by_rosbags([path], _COMPARED[name])
    with closing(open_log(path)) as log:
        read = log.read(_COMPARED[name])
        for topic, paths in _COMPARED[name].items():
            messages = expected[topic]
            assert len(messages) == len(read[topic])
            np.testing.assert_array_equal(read[topic].log_time_ns, [stamp for stamp, _ in messages])
            for field in paths:
                np.testing.assert_array_equal(
                    read[topic].fields[field], np.array([attribute(m, field) for _, m in messages], dtype=np.float64)
                )


def test_stamps_arrays_and_elements_equal_those_of_an_independent_reader(shared_dir: Path) -> None:
    bag = shared_dir / "data/drives/f1tenth_hoons_run2.bag"
    expected = {topic: [m for _, m in messages] for topic, messages in decoded_by_rosbags([bag]).items()}
    imu, wheel = expected["/imu"], np.array([m.data for m in expected["/sensors/wheel_speed"]], dtype=np.float64)
    vectors = {"linear_acceleration": "xyz", "orientation": "wxyz"}
    with closing(open_log(bag)) as log:
        of_imu = log.read({"/imu": ["header.stamp", "angular_velocity_covariance", *vectors]})["/imu"].fields
        speeds = log.read({"/sensors/wheel_speed": ["data[0]", "data[1]", "data[7]", "data"]})
    assert of_imu["header.stamp"].dtype == np.int64
    np.testing.assert_array_equal(
        of_imu["header.stamp"], [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in imu]
    )
    for path, axes in vectors.items():
        np.testing.assert_array_equal(of_imu[path], [[getattr(attribute(m, path), a) for a in axes] for m in imu])
    np.testing.assert_array_equal(of_imu["angular_velocity_covariance"], [m.angular_velocity_covariance for m in imu])
    found = speeds["/sensors/wheel_speed"].fields
    for path, values in {"data[0]": wheel[:, 0], "data[1]": wheel[:, 1], "data": wheel}.items():
        np.testing.assert_array_equal(found[path], values)
    assert np.all(np.isnan(found["data[7]"]))


def test_a_split_folder_is_one_log(shared_dir: Path) -> None:
    split, whole = open_log(shared_dir / FAULTY / "revs_250lm_a_split"), open_log(shared_dir / REVS)
    assert split.kind == "rosbag2-mcap"
    assert [(t.name, t.messages) for t in split.topics] == [(t.name, t.messages) for t in whole.topics]
    fields = {"/ins/odometry": ["twist.twist.linear.y", "header.stamp"]}
    a, b = split.read(fields)["/ins/odometry"], whole.read(fields)["/ins/odometry"]
    np.testing.assert_array_equal(a.log_time_ns, b.log_time_ns)
    for path in fields["/ins/odometry"]:
        np.testing.assert_array_equal(a.fields[path], b.fields[path])
    assert (split.start_ns, split.end_ns, split.lost) == (whole.start_ns, whole.end_ns, ())
    split.close()
    whole.close()
