"""Logs without type definitions: shipped definitions, definitions in a user's folder, and errors for unknown types."""

import base64
import json
import os
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, duration_pb2, message_factory, timestamp_pb2
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Field
from hypothesis import HealthCheck, given, settings, strategies as st
from mcap.writer import CompressionType
from recorded import T0, counts_of, fields_of
from rosbags.typesys import Stores, get_typestore

from pdhef_logtool.logs.container import ChannelRecord, RawMessage, block_of
from pdhef_logtool.logs.decoding import NO_TIME_NS
from pdhef_logtool.logs.definitions import message_definition, read_definitions
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.writer import McapLogWriter
from pdhef_logtool.mapping import auto_map, choose_mapping
from pdhef_logtool.records.errors import MappingError, UsageError
from studies.strangers.containers import Topic, shapes, write
from tests.mcap_files import mcap_writer

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


# ---- Protobuf messages become the columns that protobuf's own objects hold ----

_NUMBERS = {
    "a_double": Field.TYPE_DOUBLE, "a_float": Field.TYPE_FLOAT, "a_int32": Field.TYPE_INT32,
    "a_sint64": Field.TYPE_SINT64, "a_fixed32": Field.TYPE_FIXED32, "a_uint64": Field.TYPE_UINT64,
    "a_bool": Field.TYPE_BOOL,
}  # fmt: skip


def _add(message: Any, name: str, number: int, kind: int, **more: Any) -> Any:
    field = message.field.add(name=name, number=number, type=kind, label=more.pop("label", Field.LABEL_OPTIONAL))
    for key, value in more.items():
        if key == "packed":
            field.options.packed = value
        else:
            setattr(field, key, value)
    return field


def _files() -> descriptor_pb2.FileDescriptorSet:
    file = descriptor_pb2.FileDescriptorProto(name="car.proto", package="car", syntax="proto3")
    file.dependency.extend(["google/protobuf/timestamp.proto", "google/protobuf/duration.proto"])
    gear = file.enum_type.add(name="Gear")
    gear.value.add(name="N", number=0)
    gear.value.add(name="D", number=4)
    axes = file.message_type.add(name="Axes")
    for i, axis in enumerate("zyx"):
        _add(axes, axis, i + 1, Field.TYPE_DOUBLE)
    state = file.message_type.add(name="State")
    for i, (name, kind) in enumerate(_NUMBERS.items()):
        _add(state, name, i + 1, kind)
    _add(state, "gear", 20, Field.TYPE_ENUM, type_name=".car.Gear")
    _add(state, "stamp", 21, Field.TYPE_MESSAGE, type_name=".google.protobuf.Timestamp")
    _add(state, "age", 22, Field.TYPE_MESSAGE, type_name=".google.protobuf.Duration")
    _add(state, "axes", 23, Field.TYPE_MESSAGE, type_name=".car.Axes")
    _add(state, "packed", 24, Field.TYPE_SINT32, label=Field.LABEL_REPEATED)
    _add(state, "unpacked", 25, Field.TYPE_SINT32, label=Field.LABEL_REPEATED, packed=False)
    _add(state, "wheels", 26, Field.TYPE_MESSAGE, label=Field.LABEL_REPEATED, type_name=".car.Axes")
    _add(state, "payload", 27, Field.TYPE_BYTES)
    _add(state, "name", 28, Field.TYPE_STRING)
    _add(state, "parent", 29, Field.TYPE_MESSAGE, type_name=".car.State")
    entry = state.nested_type.add(name="LabelsEntry")
    entry.options.map_entry = True
    _add(entry, "key", 1, Field.TYPE_STRING)
    _add(entry, "value", 2, Field.TYPE_DOUBLE)
    _add(state, "labels", 30, Field.TYPE_MESSAGE, label=Field.LABEL_REPEATED, type_name=".car.State.LabelsEntry")
    state.oneof_decl.add(name="command")
    _add(state, "torque", 31, Field.TYPE_DOUBLE, oneof_index=0)
    _add(state, "brake", 32, Field.TYPE_DOUBLE, oneof_index=0)
    state.oneof_decl.add(name="_maybe")
    _add(state, "maybe", 33, Field.TYPE_DOUBLE, oneof_index=1, proto3_optional=True)
    # A file may precede its imports, and well-known files may be missing.
    files = descriptor_pb2.FileDescriptorSet(file=[file])
    timestamp_pb2.DESCRIPTOR.CopyToProto(files.file.add())
    return files


def _message_class() -> Any:
    pool = descriptor_pool.DescriptorPool()
    for module in (timestamp_pb2, duration_pb2):
        pool.AddSerializedFile(module.DESCRIPTOR.serialized_pb)
    pool.Add(_files().file[0])
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("car.State"))


State = _message_class()


def _write(path: Path, payloads: Sequence[bytes], *, schema: bytes | None = None, encoding: str = "protobuf") -> None:
    with mcap_writer(path, compression=CompressionType.ZSTD) as writer:
        data = _files().SerializeToString() if schema is None else schema
        schema_id = writer.register_schema("car.State", encoding, data)
        channel = writer.register_channel("/state", "protobuf", schema_id)
        for i, payload in enumerate(payloads):
            writer.add_message(channel, 10 + i, payload, 10 + i)


_FLOATS = st.floats(allow_nan=False, width=32)
_MESSAGES = st.fixed_dictionaries(
    {},
    optional={
        "a_double": st.floats(allow_nan=False),
        "a_float": _FLOATS,
        "a_int32": st.integers(-(2**31), 2**31 - 1),
        "a_sint64": st.integers(-(2**63), 2**63 - 1),
        "a_fixed32": st.integers(0, 2**32 - 1),
        "a_uint64": st.integers(0, 2**64 - 1),
        "a_bool": st.booleans(),
        "gear": st.sampled_from([0, 4, 77]),
        "packed": st.lists(st.integers(-300, 300), max_size=4),
        "unpacked": st.lists(st.integers(-300, 300), max_size=4),
        "payload": st.binary(max_size=9),
        "stamp": st.fixed_dictionaries({"seconds": st.integers(0, 2**32), "nanos": st.integers(0, 999_999_999)}),
        "axes": st.fixed_dictionaries({}, optional={a: st.floats(-9, 9) for a in "xyz"}),
        "wheels": st.lists(st.fixed_dictionaries({"x": st.floats(-9, 9)}), max_size=3),
        "maybe": st.floats(-9, 9),
        "labels": st.dictionaries(st.text(max_size=3), st.floats(-9, 9), max_size=2),
        "name": st.text(max_size=5),
    },
)


@pytest.mark.slow
@settings(max_examples=60, derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(values=st.lists(_MESSAGES, min_size=1, max_size=8), choices=st.lists(st.sampled_from(["", "torque", "brake"])))
def test_columns_equal_protobufs_own_objects(tmp_path_factory, values, choices):
    messages = [State(**v) for v in values]
    for message, choice in zip(messages, choices, strict=False):
        if choice:
            setattr(message, choice, 2.5)
    path = tmp_path_factory.mktemp("pb") / "a.mcap"
    _write(path, [m.SerializeToString() for m in messages])
    scalars = [*_NUMBERS, "gear"]
    arrays = ["packed", "unpacked", "payload"]
    optional = ["torque", "brake", "maybe"]
    got = fields_of(path, "/state", *scalars, *arrays, *optional, "stamp", "axes", "axes.y", "wheels[1].x", "packed[2]")
    for name in scalars:
        assert got[name].tolist() == [float(getattr(m, name)) for m in messages]
    for name in optional:
        expected = [getattr(m, name) if m.HasField(name) else np.nan for m in messages]
        np.testing.assert_array_equal(got[name], expected)
    for name in arrays:
        rows = [[float(x) for x in row if np.isfinite(x)] for row in got[name].tolist()]
        assert rows == [[float(x) for x in getattr(m, name)] for m in messages]
    stamps = [m.stamp.ToNanoseconds() if m.HasField("stamp") else NO_TIME_NS for m in messages]
    assert got["stamp"].tolist() == stamps
    axes = [[m.axes.x, m.axes.y, m.axes.z] if m.HasField("axes") else [np.nan] * 3 for m in messages]
    np.testing.assert_array_equal(got["axes"], axes)
    np.testing.assert_array_equal(got["axes.y"], [a[1] for a in axes])
    second = [m.wheels[1].x if len(m.wheels) > 1 else np.nan for m in messages]
    np.testing.assert_array_equal(got["wheels[1].x"], second)
    third = [m.packed[2] if len(m.packed) > 2 else np.nan for m in messages]
    np.testing.assert_array_equal(got["packed[2]"], third)


def test_fields_are_listed_without_maps_and_recursion(tmp_path):
    _write(tmp_path / "a.mcap", [b""])
    with closing(open_log(tmp_path / "a.mcap")) as log:
        kinds = {f.path: f.kind for f in log.fields("/state")}
    expected = {"stamp": "time", "age": "time", "a_bool": "bool", "name": "string"}
    assert kinds.items() >= (expected | dict.fromkeys(["axes.x", "packed[]", "wheels[].z"], "number")).items()
    assert not [p for p in kinds if p.startswith(("labels", "parent"))]


def test_a_payload_that_is_no_message_is_counted_and_nan(tmp_path):
    good = State(a_double=2.0).SerializeToString()
    _write(tmp_path / "a.mcap", [good, b"\xff\xff\xff", good, good[:-1]])
    with closing(open_log(tmp_path / "a.mcap")) as log:
        for _ in range(2):  # a second read does not count losses again
            column = log.read({"/state": ["a_double"]})["/state"].fields["a_double"]
            np.testing.assert_array_equal(column, [2.0, np.nan, 2.0, np.nan])
        assert [(x.kind, x.count) for x in log.lost] == [("undecodable", 2)]


@pytest.mark.parametrize(
    ("schema", "encoding", "says"),
    [
        (b"\x0a\xff", "protobuf", "cannot be parsed"),
        (b"", "protobuf", "contain no message car.State"),
        (_files().SerializeToString(), "proto", "'proto' schema"),
        (descriptor_pb2.FileDescriptorSet(file=[{"name": "a", "dependency": ["b"]}]).SerializeToString(), "protobuf",
         "a imports b"),
        (descriptor_pb2.FileDescriptorSet(
            file=[{"name": "a", "dependency": ["b"]}, {"name": "b", "dependency": ["a"]}]
         ).SerializeToString(), "protobuf", "imports itself"),
    ],
)  # fmt: skip
def test_a_schema_that_cannot_be_used_is_one_clear_line(tmp_path, schema, encoding, says):
    _write(tmp_path / "a.mcap", [b""], schema=schema, encoding=encoding)
    with closing(open_log(tmp_path / "a.mcap")) as log:
        assert log.fields("/state") == ()
        assert counts_of(log) == {"/state": 1}
        with pytest.raises(MappingError, match=says):
            log.read({"/state": ["a_double"]})


@pytest.mark.parametrize("ending", ["|hex", "|base64"])
def test_bytes_that_stand_as_text(tmp_path, ending):
    raw = [b"", b"\x00\xff\x10", b"12345678"]
    texts = [x.hex(" ") if ending == "|hex" else base64.b64encode(x).decode() for x in raw]
    _write(tmp_path / "a.mcap", [State(name=t).SerializeToString() for t in (*texts, "no digits")])
    got = fields_of(tmp_path / "a.mcap", "/state", f"name{ending}")[f"name{ending}"]
    assert [bytes(int(x) for x in row if np.isfinite(x)) for row in got] == [*raw, b""]
    with pytest.raises(MappingError, match="drop the ending"):
        fields_of(tmp_path / "a.mcap", "/state", f"payload{ending}")
