"""Recorded drives and their damaged copies: counts, intervals of loss, and values against an independent reader."""

from __future__ import annotations

import json
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
    log = open_log(path)
    read = log.read(_COMPARED[name])
    for topic, paths in _COMPARED[name].items():
        messages = expected[topic]
        assert len(messages) == len(read[topic])
        np.testing.assert_array_equal(read[topic].log_time_ns, [stamp for stamp, _ in messages])
        for field in paths:
            np.testing.assert_array_equal(
                read[topic].fields[field], np.array([attribute(m, field) for _, m in messages], dtype=np.float64)
            )
    log.close()


def test_stamps_arrays_and_elements_equal_those_of_an_independent_reader(shared_dir: Path) -> None:
    bag = shared_dir / "data/drives/f1tenth_hoons_run2.bag"
    expected = decoded_by_rosbags([bag])
    log = open_log(bag)
    read = log.read(
        {
            "/imu": ["header.stamp", "linear_acceleration", "angular_velocity_covariance", "orientation"],
            "/sensors/wheel_speed": ["data[0]", "data[1]", "data[7]", "data"],
        }
    )
    imu = [m for _, m in expected["/imu"]]
    stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in imu]
    assert read["/imu"].fields["header.stamp"].dtype == np.int64
    np.testing.assert_array_equal(read["/imu"].fields["header.stamp"], stamps)
    np.testing.assert_array_equal(
        read["/imu"].fields["linear_acceleration"],
        [[m.linear_acceleration.x, m.linear_acceleration.y, m.linear_acceleration.z] for m in imu],
    )
    np.testing.assert_array_equal(
        read["/imu"].fields["orientation"],
        [[m.orientation.w, m.orientation.x, m.orientation.y, m.orientation.z] for m in imu],
    )
    np.testing.assert_array_equal(
        read["/imu"].fields["angular_velocity_covariance"], [m.angular_velocity_covariance for m in imu]
    )
    wheel = np.array([m.data for _, m in expected["/sensors/wheel_speed"]], dtype=np.float64)
    np.testing.assert_array_equal(read["/sensors/wheel_speed"].fields["data[0]"], wheel[:, 0])
    np.testing.assert_array_equal(read["/sensors/wheel_speed"].fields["data[1]"], wheel[:, 1])
    np.testing.assert_array_equal(read["/sensors/wheel_speed"].fields["data"], wheel)
    assert np.all(np.isnan(read["/sensors/wheel_speed"].fields["data[7]"]))
    log.close()


@pytest.mark.parametrize("name", ["revs_250lm_a_flipped_byte.mcap", "revs_250lm_a_flipped_byte_crc_only.mcap"])
def test_a_flipped_byte_costs_its_chunk_and_says_which_interval(shared_dir: Path, name: str) -> None:
    facts = json.loads((shared_dir / FAULTY / "faults.json").read_text())[name]
    log = open_log(shared_dir / FAULTY / name)
    good = open_log(shared_dir / REVS)
    fields = {"/imu/data": ["angular_velocity.z"]}
    counts = {topic: len(columns) for topic, columns in log.read({}, stamps=[t.name for t in log.topics]).items()}
    assert counts == facts["messages_in_the_other_chunks"]
    (loss,) = log.lost
    first, last = facts["chunk_log_time_ns"]
    assert (loss.kind, loss.severity) == ("bad-chunk", "lost")
    assert (loss.start_ns, loss.end_ns) == (first, last + 1)
    assert loss.count == sum(facts["messages_in_that_chunk"].values())
    assert {t.name: t.messages for t in log.topics} == counts
    read, whole = log.read(fields)["/imu/data"], good.read(fields)["/imu/data"]
    at = np.searchsorted(whole.log_time_ns, read.log_time_ns)
    np.testing.assert_array_equal(read.fields["angular_velocity.z"], whole.fields["angular_velocity.z"][at])
    log.close()
    good.close()


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
