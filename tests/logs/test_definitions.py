"""Logs without type definitions: shipped definitions, definitions in a user's folder, and errors for unknown types."""

import json
import os
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded import T0, fields_of
from rosbags.typesys import Stores, get_typestore

from pdhef_logtool.logs.container import ChannelRecord, RawMessage, block_of
from pdhef_logtool.logs.decoding import NO_TIME_NS
from pdhef_logtool.logs.definitions import message_definition, read_definitions
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.writer import McapLogWriter
from pdhef_logtool.mapping import auto_map, choose_mapping
from pdhef_logtool.records.errors import MappingError, UsageError
from studies.strangers.containers import Topic, shapes, write

STEER, STATE, IMU = "teamx_msgs/msg/DriverInput", "vesc_msgs/msg/VescImuStamped", "vesc_msgs/msg/VescImu"
#: Definitions by type, of which the package ships none.
TEXTS = shapes()
START = 1_700_000_000_000_000_000


def bag(path: Path, topic: str, type_name: str, field: str) -> Path:
    """Write a rosbag2 database as Humble does, without definitions: three messages with 0, 0.1 and 0.2 in a field."""
    stamps_ns = START + np.arange(3, dtype=np.int64) * 10_000_000
    return write([Topic(topic, type_name, stamps_ns, stamps_ns, {field: 0.1 * np.arange(3)})], path, "rosbag2-bare")


def steering_bag(tmp_path: Path) -> Path:
    return bag(tmp_path / "b", "/steer", STEER, "steering_angle")


def test_a_missing_definition_is_the_cause_that_is_told(tmp_path):
    log = open_log(steering_bag(tmp_path))
    assert log.fields("/steer") == ()
    assert "no definition of teamx_msgs/DriverInput" in log.unreadable("/steer")
    with pytest.raises(MappingError, match=r"teamx_msgs/DriverInput; give its \.msg file by --set msgs=DIR"):
        choose_mapping(log, None, prefer_truth="perfect")


@pytest.mark.parametrize("layout", ["vesc_msgs/msg", ".", "msg", "src/vesc_msgs/msg"])
def test_definitions_of_a_folder_of_a_package_or_a_workspace(tmp_path, layout):
    path = bag(tmp_path / "b", "/car", STATE, "imu.linear_acceleration.x")
    folder = tmp_path / "defs" / layout
    folder.mkdir(parents=True)
    for name in (STATE, IMU):
        (folder / f"{name.rpartition('/')[2]}.msg").write_text(TEXTS[name])
    log = open_log(path, msgs=tmp_path / "defs")
    read = log.read({"/car": ["imu.linear_acceleration.x"]})["/car"].fields
    np.testing.assert_allclose(read["imu.linear_acceleration.x"], [0, 0.1, 0.2])


def test_common_packages_are_shipped(tmp_path):
    name = "ackermann_msgs/msg/AckermannDriveStamped"
    log = open_log(bag(tmp_path / "b", "/drive", name, "drive.steering_angle"))
    assert auto_map(log).mapping.signals["steer_rad"].field == "drive.steering_angle"
    assert "MSG: ackermann_msgs/AckermannDrive" in message_definition(name)


def test_an_empty_topic_is_said_to_be_empty(tmp_path):
    path = bag(tmp_path / "b", "/imu", "sensor_msgs/msg/Temperature", "temperature")
    import sqlite3

    with sqlite3.connect(next(path.glob("*.db3"))) as connection:
        connection.execute("insert into topics values (9, '/imu/data', 'sensor_msgs/msg/Imu', 'cdr', '', '')")
    with pytest.raises(MappingError, match=r"/imu/data \(sensor_msgs/Imu\) has no messages"):
        choose_mapping(open_log(path), None, prefer_truth="perfect")


def test_a_folder_without_definitions_is_refused(tmp_path):
    with pytest.raises(UsageError, match="without any"):
        read_definitions(tmp_path)
    with pytest.raises(UsageError, match="neither folder nor archive"):
        read_definitions(tmp_path / "none")


@pytest.mark.parametrize("name", ["definitions.zip", "car_msgs-1.0-py3-none-any.whl"])
def test_definitions_of_a_zip_file_or_a_wheel(tmp_path, name):
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
def test_an_installed_ros_is_looked_in_and_named(tmp_path, variable, monkeypatch):
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


def _write_raw(path: Path, payloads: Sequence[bytes], encoding: str, name: str, schema: str, text: str) -> None:
    with McapLogWriter(path, profile="") as writer:
        channel = writer.add_channel(ChannelRecord(-1, "/t", encoding, name, schema, text.encode()))
        writer.write([], [block_of(RawMessage(channel, T0 + i, T0 + i, i, p) for i, p in enumerate(payloads))])


def _read_json(path: Path, messages: Sequence[object], schema: object, fields: Sequence[str]) -> dict[str, Any]:
    text = "" if schema is None else json.dumps(schema)
    encoding = "" if schema is None else "jsonschema"
    _write_raw(path, [json.dumps(m).encode() for m in messages], "json", "T", encoding, text)
    return fields_of(path, "/t", *fields)


def test_missing_json_fields_and_short_arrays_are_nan(tmp_path):
    messages = [{"a": 1, "b": {"c": [1.5, 2.5]}, "d": True}, {"b": {"c": [3.5]}}, {"a": None, "b": {}, "d": False}]
    number = {"type": "number"}
    inner = {"type": "object", "properties": {"c": {"type": "array", "items": number}}}
    schema = {"type": "object", "properties": {"a": number, "b": inner, "d": {"type": "boolean"}}}
    read = _read_json(tmp_path / "x.mcap", messages, schema, ["a", "b.c[1]", "b.c", "d"])
    np.testing.assert_array_equal(read["a"], [1, np.nan, np.nan])
    np.testing.assert_array_equal(read["b.c[1]"], [2.5, np.nan, np.nan])
    np.testing.assert_array_equal(read["b.c"], [[1.5, 2.5], [3.5, np.nan], [np.nan, np.nan]])
    np.testing.assert_array_equal(read["d"], [1, np.nan, 0])


def test_json_times_are_nanoseconds_and_missing_ones_are_marked(tmp_path):
    messages = [{"stamp": {"sec": 5, "nsec": 7}}, {}]
    read = _read_json(tmp_path / "x.mcap", messages, None, ["stamp"])
    assert read["stamp"].dtype == np.int64
    assert read["stamp"].tolist() == [5_000_000_007, NO_TIME_NS]


def test_places_that_a_json_schema_leaves_open_are_found_in_the_messages(tmp_path):
    messages = [{"m": {"v": [1, 2]}}, {"m": {"v": [3, 4]}}]
    for schema in ({"type": "object"}, {"properties": {"m": {"properties": {"v": {"type": "array"}}}}}):
        read = _read_json(tmp_path / "x.mcap", messages, schema, ["m.v", "m.v[1]"])
        np.testing.assert_array_equal(read["m.v"], [[1, 2], [3, 4]])
        np.testing.assert_array_equal(read["m.v[1]"], [2, 4])


def test_a_json_message_that_is_no_json_is_counted(tmp_path):
    _write_raw(tmp_path / "x.mcap", [b'{"a": 1}', b"{", b'{"a": 3}'], "json", "T", "", "")
    with closing(open_log(tmp_path / "x.mcap")) as log:
        for start in (None, T0 + 1):  # a second read must not count it twice
            read = log.read({"/t": ["a"]}, start)["/t"].fields["a"]
            np.testing.assert_array_equal(read, [1, np.nan, 3] if start is None else [np.nan, 3])
            (loss,) = log.lost
            assert (loss.kind, loss.count, loss.severity) == ("undecodable", 1, "lost")


def test_a_cut_payload_costs_only_its_own_message(tmp_path):
    store = get_typestore(Stores.ROS2_HUMBLE)
    name = "geometry_msgs/msg/Vector3"
    full = [bytes(store.serialize_cdr(store.types[name](x=float(i), y=0.0, z=0.0), name)) for i in range(5)]
    payloads = [*full[:2], full[2][:11], *full[3:]]
    _write_raw(tmp_path / "x.mcap", payloads, "cdr", name, "ros2msg", store.generate_msgdef(name, ros_version=2)[0])
    with closing(open_log(tmp_path / "x.mcap")) as log:
        np.testing.assert_array_equal(log.read({"/t": ["x"]})["/t"].fields["x"], [0, 1, np.nan, 3, 4])
        assert [(loss.kind, loss.count) for loss in log.lost] == [("undecodable", 1)]


@pytest.mark.parametrize(
    ("path", "problem"),
    [
        ("angular_velocity.zz", "angular_velocity.z"),
        ("yaw.z", "angular_velocity.z"),
        ("header.frame_id", "text"),
        ("header", "struct"),
        ("orientation_covariance[9]", "nearest"),
        ("angular_velocity..z", "dotted path"),
        ("", "dotted path"),
    ],
)
def test_a_wrong_path_names_the_nearest(tmp_path, path, problem):
    with McapLogWriter(tmp_path / "x.mcap") as writer:
        writer.add_topic("/imu", "sensor_msgs/msg/Imu")
    with closing(open_log(tmp_path / "x.mcap")) as log:
        with pytest.raises(MappingError, match=problem):
            log.read({"/imu": [path]})
        with pytest.raises(MappingError, match="nearest: /imu"):
            log.read({"/imv": ["x"]})


def test_an_empty_window_has_columns_of_the_right_shape(tmp_path):
    with McapLogWriter(tmp_path / "x.mcap") as writer:
        writer.add_topic("/imu", "sensor_msgs/msg/Imu")
    shapes = {"header.stamp": (0,), "orientation": (0, 4), "orientation_covariance": (0, 9), "angular_velocity.z": (0,)}
    with closing(open_log(tmp_path / "x.mcap")) as log:
        columns = log.read({"/imu": [*shapes]})["/imu"]
        assert (log.start_ns, log.end_ns, len(columns)) == (0, 0, 0)
        assert columns.fields["header.stamp"].dtype == np.int64
        assert {path: column.shape for path, column in columns.fields.items()} == shapes
