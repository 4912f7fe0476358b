"""Protobuf messages become the columns that protobuf's own objects hold."""

import base64
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, duration_pb2, message_factory, timestamp_pb2
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Field
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType
from recorded import counts_of, fields_of

from pdhef_logtool.logs.decoding import NO_TIME_NS
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.records.errors import MappingError
from tests.mcap_files import mcap_writer

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


STATE = _message_class()


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
    messages = [STATE(**v) for v in values]
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
    good = STATE(a_double=2.0).SerializeToString()
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
    _write(tmp_path / "a.mcap", [STATE(name=t).SerializeToString() for t in (*texts, "no digits")])
    got = fields_of(tmp_path / "a.mcap", "/state", f"name{ending}")[f"name{ending}"]
    assert [bytes(int(x) for x in row if np.isfinite(x)) for row in got] == [*raw, b""]
    with pytest.raises(MappingError, match="drop the ending"):
        fields_of(tmp_path / "a.mcap", "/state", f"payload{ending}")
