"""Foxglove's messages, and ROS types in JSON and protobuf, are recognised like their ROS counterparts."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Field

from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import AutoMapping, auto_map, fit_clocks, read_signals
from tests.mcap_files import mcap_writer

S = 1_000_000_000
_DOUBLE, _MESSAGE, _STRING = Field.TYPE_DOUBLE, Field.TYPE_MESSAGE, Field.TYPE_STRING

#: Fields as Foxglove declares them: (name, number, type or message name, rest).
_TYPES: dict[str, list[tuple[str, int, Any, str]]] = {
    "Vector3": [("x", 1, _DOUBLE, ""), ("y", 2, _DOUBLE, ""), ("z", 3, _DOUBLE, "")],
    "Quaternion": [("x", 1, _DOUBLE, ""), ("y", 2, _DOUBLE, ""), ("z", 3, _DOUBLE, ""), ("w", 4, _DOUBLE, "")],
    "Pose": [("position", 1, ".foxglove.Vector3", ""), ("orientation", 2, ".foxglove.Quaternion", "")],
    "LocationFix": [
        ("latitude", 1, _DOUBLE, ""), ("longitude", 2, _DOUBLE, ""), ("altitude", 3, _DOUBLE, ""),
        ("timestamp", 6, ".google.protobuf.Timestamp", ""), ("frame_id", 7, _STRING, ""),
        ("heading", 10, _DOUBLE, "optional"), ("course", 13, _DOUBLE, "optional"),
    ],
    "PosesInFrame": [("timestamp", 1, ".google.protobuf.Timestamp", ""), ("poses", 3, ".foxglove.Pose", "repeated")],
    "Odometry": [
        ("timestamp", 1, ".google.protobuf.Timestamp", ""), ("pose", 4, ".foxglove.Pose", ""),
        ("linear_velocity", 5, ".foxglove.Vector3", ""), ("angular_velocity", 6, ".foxglove.Vector3", ""),
    ],
}  # fmt: skip


def _descriptors() -> descriptor_pb2.FileDescriptorSet:
    files = descriptor_pb2.FileDescriptorSet()
    timestamp_pb2.DESCRIPTOR.CopyToProto(files.file.add())
    file = files.file.add(name="foxglove.proto", package="foxglove", syntax="proto3")
    file.dependency.append("google/protobuf/timestamp.proto")
    for name, members in _TYPES.items():
        message = file.message_type.add(name=name)
        for member, number, kind, rest in members:
            is_message = isinstance(kind, str)
            field = message.field.add(
                name=member,
                number=number,
                type=_MESSAGE if is_message else kind,
                label=Field.LABEL_REPEATED if rest == "repeated" else Field.LABEL_OPTIONAL,
            )
            if is_message:
                field.type_name = kind
            if rest == "optional":
                message.oneof_decl.add(name=f"_{member}")
                field.oneof_index = len(message.oneof_decl) - 1
                field.proto3_optional = True
    return files


_FILES = _descriptors()
_POOL = descriptor_pool.DescriptorPool()
for _file in _FILES.file:
    _POOL.Add(_file)


def _protobuf(kind: str, rows: Sequence[Mapping[str, Any]]) -> tuple[str, str, bytes, list[bytes]]:
    make = message_factory.GetMessageClass(_POOL.FindMessageTypeByName(f"foxglove.{kind}"))
    return "protobuf", f"foxglove.{kind}", _FILES.SerializeToString(), [make(**r).SerializeToString() for r in rows]


def _schema_of(value: object) -> dict[str, Any]:
    if isinstance(value, dict):
        return {"type": "object", "properties": {k: _schema_of(v) for k, v in value.items()}}
    if isinstance(value, list):
        return {"type": "array", "items": _schema_of(value[0])}
    return {"type": "string" if isinstance(value, str) else "number"}


def _json(name: str, rows: Sequence[Mapping[str, Any]]) -> tuple[str, str, bytes, list[bytes]]:
    return "json", name, json.dumps(_schema_of(dict(rows[0]))).encode(), [json.dumps(r).encode() for r in rows]


def _stamp(encoding: str, i: int) -> dict[str, int]:
    seconds, rest = divmod(100 * S + i * S // 10, S)
    return {"seconds": seconds, "nanos": rest} if encoding == "protobuf" else {"sec": seconds, "nsec": rest}


def _write(path: Path, topics: Mapping[str, tuple[str, str, bytes, list[bytes]]]) -> Path:
    with mcap_writer(path) as writer:
        for topic, (encoding, name, schema, payloads) in topics.items():
            schema_id = writer.register_schema(name, "jsonschema" if encoding == "json" else "protobuf", schema)
            channel = writer.register_channel(topic, encoding, schema_id)
            for i, payload in enumerate(payloads):
                # Recorded 20 ms after the measurement.
                at = 100 * S + i * S // 10 + 20_000_000
                writer.add_message(channel, at, payload, at)
    return path


def _map(path: Path) -> tuple[AutoMapping, dict[str, Any]]:
    log = open_log(path)
    found = auto_map(log)
    clocks = fit_clocks(log, found.mapping, log.start_ns, log.end_ns)
    channels = read_signals(log, found.mapping, clocks, log.start_ns, log.end_ns)
    log.close()
    return found, {**channels.signals, **channels.truth}


def _build(encoding: str, kind: str, rows: Sequence[Mapping[str, Any]]) -> tuple[str, str, bytes, list[bytes]]:
    stamped = [{"timestamp": _stamp(encoding, i), **r} for i, r in enumerate(rows)]
    return _protobuf(kind, stamped) if encoding == "protobuf" else _json(f"foxglove.{kind}", stamped)


@pytest.mark.parametrize("encoding", ["protobuf", "json"])
def test_a_location_fix_is_a_satellite_fix_with_angles_from_north(tmp_path: Path, encoding: str) -> None:
    where = {"longitude": 12.0, "altitude": 30.0}
    rows = [{**where, "latitude": 57.0 + i * 1e-5, "heading": 0.1 * i, "course": 0.1 * i + 0.02} for i in range(40)]
    found, got = _map(_write(tmp_path / "a.mcap", {"/gps": _build(encoding, "LocationFix", rows)}))
    assert set(found.mapping.truth) == {"lat_deg", "lon_deg", "alt_m", "yaw_rad", "course_rad"}
    assert got["lat_deg"].stamps_ns.tolist() == [100 * S + i * S // 10 for i in range(40)]
    np.testing.assert_allclose(got["yaw_rad"].values, [math.pi / 2 - 0.1 * i for i in range(40)], atol=1e-12)
    np.testing.assert_allclose(got["course_rad"].values, [math.pi / 2 - 0.1 * i - 0.02 for i in range(40)], atol=1e-12)
    assert any("two antennas" in note for note in found.mapping.notes)


def test_a_heading_that_repeats_the_course_is_no_yaw(tmp_path: Path) -> None:
    rows = [{"latitude": 57.0, "longitude": 12.0, "heading": 0.1 * i, "course": 0.1 * i} for i in range(40)]
    found, _ = _map(_write(tmp_path / "a.mcap", {"/gps": _build("protobuf", "LocationFix", rows)}))
    assert "yaw_rad" not in found.mapping.truth
    assert "course_rad" in found.mapping.truth
    assert any("repeats the course" in note for note in found.mapping.notes)


def _pose(x_m: float) -> dict[str, dict[str, float]]:
    orientation = {"x": 0.0, "y": 0.0, "z": 0.6, "w": 0.8}
    return {"position": {"x": x_m, "y": 0.5, "z": 0.0}, "orientation": orientation}


@pytest.mark.parametrize("encoding", ["protobuf", "json"])
def test_odometry_is_truth_or_speed_by_its_name(tmp_path: Path, encoding: str) -> None:
    def odometry(scale: float) -> tuple[str, str, bytes, list[bytes]]:
        rows = [
            {
                "pose": _pose(2.0 * i),
                "linear_velocity": {"x": 20.0 * scale, "y": 0.01 * i, "z": 0.0},
                "angular_velocity": {"x": 0.0, "y": 0.0, "z": 0.3 + 0.01 * i},
            }
            for i in range(40)
        ]
        return _build(encoding, "Odometry", rows)

    topics = {"/ground_truth/state": odometry(1.0), "/wheel/odom": odometry(1.01)}
    found, got = _map(_write(tmp_path / "a.mcap", topics))
    assert {s.topic for s in found.mapping.signals.values()} == {"/wheel/odom"}
    truth = {"vx_m_s", "vy_m_s", "yaw_rate_rad_s", "x_m", "y_m", "quat_wxyz"}
    assert {n: s.topic for n, s in found.mapping.truth.items()} == dict.fromkeys(truth, "/ground_truth/state")
    np.testing.assert_allclose(got["speed_m_s"].values, 20.2)
    np.testing.assert_allclose(got["yaw_rate_rad_s"].values, 0.3 + 0.01 * np.arange(40))
    np.testing.assert_allclose(got["quat_wxyz"].values[0], [0.8, 0.0, 0.0, 0.6])
    assert got["vx_m_s"].stamps_ns[1] == 100 * S + S // 10


def test_a_list_of_poses_is_said_and_not_guessed(tmp_path: Path) -> None:
    rows = [{"poses": [{"position": {"x": 1.0}}, {"position": {"x": 2.0}}]}] * 5
    found, _ = _map(_write(tmp_path / "a.mcap", {"/ground_truth/poses": _build("protobuf", "PosesInFrame", rows)}))
    assert not found.mapping.truth
    assert [(a.candidates, a.chosen) for a in found.ambiguities] == [(("/ground_truth/poses",), None)]
    assert "list of poses" in str(found.ambiguities[0])


_IMU = {
    "header": {"stamp": {"sec": 100, "nanosec": 0}, "frame_id": "imu"},
    "linear_acceleration": {"x": 1.0, "y": 2.0, "z": 9.8},
    "angular_velocity": {"x": 0.0, "y": 0.0, "z": 0.5},
}


@pytest.mark.parametrize("name", ["sensor_msgs/Imu", "sensor_msgs/msg/Imu", "sensor_msgs.Imu", "ros.sensor_msgs.Imu"])
def test_a_ros_type_in_json_is_recognised_by_its_name(tmp_path: Path, name: str) -> None:
    rows = [{**_IMU, "header": {"stamp": {"sec": 100, "nanosec": i * S // 10}, "frame_id": ""}} for i in range(9)]
    found, got = _map(_write(tmp_path / "a.mcap", {"/imu": _json(name, rows)}))
    assert set(found.mapping.signals) == {"ax_m_s2", "ay_m_s2", "yaw_rate_rad_s"}
    assert got["ay_m_s2"].values.tolist() == [2.0] * 9
    assert got["ay_m_s2"].stamps_ns.tolist() == [100 * S + i * S // 10 for i in range(9)]


def test_a_name_without_the_fields_is_said_and_spoils_nothing(tmp_path: Path) -> None:
    other = _json("sensor_msgs/Imu", [{"acc": [1.0, 2.0, 3.0]}])
    fix = _json("foxglove.LocationFix", [{"lat": 1.0}])
    found, _ = _map(_write(tmp_path / "a.mcap", {"/imu": _json("sensor_msgs/Imu", [_IMU]), "/x": other, "/gps": fix}))
    assert found.mapping.signals["ax_m_s2"].topic == "/imu"
    assert not found.ambiguities
    assert sorted(n.partition(" ")[0] for n in found.mapping.notes if "fields differ from" in n) == ["/gps", "/x"]
