"""Logs without type definitions: shipped definitions, definitions in a user's folder, and errors for unknown types."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool.logs.definitions import message_definition, read_definitions
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import auto_map
from pdhef_logtool.mapping.choosing import choose_mapping
from pdhef_logtool.records.errors import MappingError, UsageError
from studies.strangers.containers import Topic, shapes, write

STEER, STATE, IMU = "teamx_msgs/msg/DriverInput", "vesc_msgs/msg/VescImuStamped", "vesc_msgs/msg/VescImu"
#: Definitions by type, of which the package ships none.
TEXTS = dict(shapes())
START = 1_700_000_000_000_000_000


def bag(path: Path, topic: str, type_name: str, field: str) -> Path:
    """Write a rosbag2 database as Humble does, without definitions: three messages with 0, 0.1 and 0.2 in a field."""
    stamps_ns = START + np.arange(3, dtype=np.int64) * 10_000_000
    return write([Topic(topic, type_name, stamps_ns, stamps_ns, {field: 0.1 * np.arange(3)})], path, "rosbag2-bare")


def steering_bag(tmp_path: Path) -> Path:
    return bag(tmp_path / "b", "/steer", STEER, "steering_angle")


def test_a_missing_definition_is_the_cause_that_is_told(tmp_path: Path) -> None:
    log = open_log(steering_bag(tmp_path))
    assert log.fields("/steer") == ()
    assert "no definition of teamx_msgs/DriverInput" in log.unreadable("/steer")
    with pytest.raises(MappingError, match=r"teamx_msgs/DriverInput; give its \.msg file by --set msgs=DIR"):
        choose_mapping(log, None, prefer_truth="perfect")


@pytest.mark.parametrize("layout", ["vesc_msgs/msg", ".", "msg", "src/vesc_msgs/msg"])
def test_definitions_of_a_folder_of_a_package_or_a_workspace(tmp_path: Path, layout: str) -> None:
    path = bag(tmp_path / "b", "/car", STATE, "imu.linear_acceleration.x")
    folder = tmp_path / "defs" / layout
    folder.mkdir(parents=True)
    for name in (STATE, IMU):
        (folder / f"{name.rpartition('/')[2]}.msg").write_text(TEXTS[name])
    log = open_log(path, msgs=tmp_path / "defs")
    read = log.read({"/car": ["imu.linear_acceleration.x"]})["/car"].fields
    np.testing.assert_allclose(read["imu.linear_acceleration.x"], [0, 0.1, 0.2])


def test_common_packages_are_shipped(tmp_path: Path) -> None:
    name = "ackermann_msgs/msg/AckermannDriveStamped"
    log = open_log(bag(tmp_path / "b", "/drive", name, "drive.steering_angle"))
    assert auto_map(log).mapping.signals["steer_rad"].field == "drive.steering_angle"
    assert "MSG: ackermann_msgs/AckermannDrive" in message_definition(name)


def test_an_empty_topic_is_said_to_be_empty(tmp_path: Path) -> None:
    path = bag(tmp_path / "b", "/imu", "sensor_msgs/msg/Temperature", "temperature")
    import sqlite3

    with sqlite3.connect(next(path.glob("*.db3"))) as connection:
        connection.execute("insert into topics values (9, '/imu/data', 'sensor_msgs/msg/Imu', 'cdr', '', '')")
    with pytest.raises(MappingError, match=r"/imu/data \(sensor_msgs/Imu\) has no messages"):
        choose_mapping(open_log(path), None, prefer_truth="perfect")


def test_a_folder_without_definitions_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="without any"):
        read_definitions(tmp_path)
    with pytest.raises(UsageError, match="neither folder nor archive"):
        read_definitions(tmp_path / "none")


@pytest.mark.parametrize("name", ["definitions.zip", "car_msgs-1.0-py3-none-any.whl"])
def test_definitions_of_a_zip_file_or_a_wheel(tmp_path: Path, name: str) -> None:
    import zipfile

    path = steering_bag(tmp_path)
    with zipfile.ZipFile(tmp_path / name, "w") as archive:
        archive.writestr("source-1.0/teamx_msgs/msg/DriverInput.msg", TEXTS[STEER])
        archive.writestr("source-1.0/other_msgs/msg/DriverInput.msg", "float64 of_another\n")
    log = open_log(path, msgs=tmp_path / name)
    assert "steering_angle" in {f.path for f in log.fields("/steer")}
    log.read({"/steer": ["steering_angle"]})
    assert log.lost == ()


@pytest.mark.parametrize("variable", ["AMENT_PREFIX_PATH", "ROS_PACKAGE_PATH"])
def test_an_installed_ros_is_looked_in_and_named(
    tmp_path: Path, variable: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = steering_bag(tmp_path)
    folder = tmp_path / "ros" / ("share" if variable == "AMENT_PREFIX_PATH" else "stack") / "teamx_msgs" / "msg"
    folder.mkdir(parents=True)
    (folder / "DriverInput.msg").write_text(TEXTS[STEER])
    monkeypatch.setenv(variable, f"{tmp_path / 'nowhere'}{os.pathsep}{tmp_path / 'ros'}")
    log = open_log(path)
    assert "steering_angle" in {f.path for f in log.fields("/steer")}
    log.read({"/steer": ["steering_angle"]})
    (note,) = log.lost
    assert (note.severity, note.where) == ("note", "/steer")
    assert f"read by {folder / 'DriverInput.msg'} of this machine, as the log does not define its type" in note.what
