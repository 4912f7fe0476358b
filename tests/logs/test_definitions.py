"""Logs without type definitions: shipped definitions, definitions in a user's folder, and errors for unknown types."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from pdhef_logtool.logs.definitions import read_definitions
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.schema_files import message_definition
from pdhef_logtool.mapping import auto_map
from pdhef_logtool.mapping.choosing import choose_mapping
from pdhef_logtool.records.errors import MappingError, UsageError

STEER = "float32 steering_wheel_angle\n"
INNER = "float64 angle_rad\n"
OUTER = "std_msgs/Header header\nInner inner\n"
START = 1_700_000_000_000_000_000


def bag(path: Path, topics: dict[str, tuple[str, dict[str, str]]], messages: int = 3) -> Path:
    """Write a rosbag2 database as Humble does, without definitions: topics by name, with their types' texts."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    for _, texts in topics.values():
        for name, text in texts.items():
            store.register(get_types_from_msg(text, name))
    with Writer(path, version=8) as writer:
        for topic, (name, _) in topics.items():
            connection = writer.add_connection(topic, name, msgdef="", rihs01="RIHS01_0")
            kind = store.types[name]
            for i in range(messages):
                value = _example(store, kind, name, 0.1 * i)
                writer.write(connection, START + i * 10_000_000, store.serialize_cdr(value, name))
    import sqlite3

    (database,) = path.glob("*.db3")
    with sqlite3.connect(database) as connection:
        connection.execute("drop table if exists message_definitions")
    return path


def _example(store: object, kind: type, name: str, value: float) -> object:
    from rosbags.interfaces import Nodetype

    values = {}
    for field, (node, arguments) in store.fielddefs[name][1]:  # type: ignore[attr-defined]
        if node == Nodetype.NAME:
            values[field] = _example(store, store.types[arguments], arguments, value)  # type: ignore[attr-defined]
        else:
            values[field] = "" if arguments[0] == "string" else 0 if "int" in arguments[0] else value
    return kind(**values)


def test_a_missing_definition_is_the_cause_that_is_told(tmp_path: Path) -> None:
    path = bag(tmp_path / "b", {"/steer": ("dbw_msgs/msg/Steer", {"dbw_msgs/msg/Steer": STEER})})
    log = open_log(path)
    assert log.fields("/steer") == ()
    assert "no definition of dbw_msgs/Steer" in log.unreadable("/steer")
    with pytest.raises(MappingError, match=r"no definition of dbw_msgs/Steer; give its \.msg file by --set msgs=DIR"):
        choose_mapping(log, None, prefer_truth="perfect")


@pytest.mark.parametrize("layout", ["msg", "flat", "package", "workspace"])
def test_definitions_of_a_folder_of_a_package_or_a_workspace(tmp_path: Path, layout: str) -> None:
    texts = {"car_msgs/msg/Inner": INNER, "car_msgs/msg/Outer": OUTER}
    path = bag(tmp_path / "b", {"/car": ("car_msgs/msg/Outer", texts)})
    root = tmp_path / "defs"
    folder = {
        "msg": root / "car_msgs/msg",
        "flat": root,
        "package": root / "msg",
        "workspace": root / "src/car_msgs/msg",
    }
    folder[layout].mkdir(parents=True)
    for name, text in texts.items():
        (folder[layout] / f"{name.rpartition('/')[2]}.msg").write_text(text)
    log = open_log(path, msgs=root)
    assert [f.path for f in log.fields("/car") if f.kind == "number"] == ["inner.angle_rad"]
    np.testing.assert_allclose(log.read({"/car": ["inner.angle_rad"]})["/car"].fields["inner.angle_rad"], [0, 0.1, 0.2])


def test_common_packages_are_shipped(tmp_path: Path) -> None:
    name = "ackermann_msgs/msg/AckermannDriveStamped"
    drive = message_definition("ackermann_msgs/msg/AckermannDrive")
    texts = {"ackermann_msgs/msg/AckermannDrive": drive, name: "std_msgs/Header header\nAckermannDrive drive\n"}
    log = open_log(bag(tmp_path / "b", {"/drive": (name, texts)}))
    assert auto_map(log).mapping.signals["steer_rad"].field == "drive.steering_angle"
    assert "MSG: ackermann_msgs/AckermannDrive" in message_definition(name)


def test_an_empty_topic_is_said_to_be_empty(tmp_path: Path) -> None:
    path = bag(tmp_path / "b", {"/imu": ("sensor_msgs/msg/Temperature", {})})
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

    path = bag(tmp_path / "b", {"/steer": ("dbw_msgs/msg/Steer", {"dbw_msgs/msg/Steer": STEER})})
    with zipfile.ZipFile(tmp_path / name, "w") as archive:
        archive.writestr("source-1.0/dbw_msgs/msg/Steer.msg", STEER)
        archive.writestr("source-1.0/other_msgs/msg/Steer.msg", "float64 of_another\n")
    log = open_log(path, msgs=tmp_path / name)
    assert [f.path for f in log.fields("/steer")] == ["steering_wheel_angle"]
    log.read({"/steer": ["steering_wheel_angle"]})
    assert log.lost == ()


@pytest.mark.parametrize("variable", ["AMENT_PREFIX_PATH", "ROS_PACKAGE_PATH"])
def test_an_installed_ros_is_looked_in_and_named(
    tmp_path: Path, variable: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = bag(tmp_path / "b", {"/steer": ("dbw_msgs/msg/Steer", {"dbw_msgs/msg/Steer": STEER})})
    folder = tmp_path / "ros" / ("share" if variable == "AMENT_PREFIX_PATH" else "stack") / "dbw_msgs" / "msg"
    folder.mkdir(parents=True)
    (folder / "Steer.msg").write_text(STEER)
    monkeypatch.setenv(variable, f"{tmp_path / 'nowhere'}{os.pathsep}{tmp_path / 'ros'}")
    log = open_log(path)
    assert [f.path for f in log.fields("/steer")] == ["steering_wheel_angle"]
    log.read({"/steer": ["steering_wheel_angle"]})
    (note,) = log.lost
    assert (note.severity, note.where) == ("note", "/steer")
    assert f"read by {folder / 'Steer.msg'} of this machine, as the log does not define its type" in note.what
