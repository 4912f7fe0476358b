"""One drive gives the same columns in every encoding and every kind of MCAP file."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, IndexType, Writer

from pdhef_logtool.logs.open_log import open_log

_DEFINITION = "car_msgs/Stamp stamp\nstring name\nfloat64 speed\nint16[] counts\nbool ok\n" + "=" * 80
_DEFINITION += "\nMSG: car_msgs/Stamp\nint32 sec\nuint32 nanosec\n"
_ENCODINGS = ("cdr", "cdr-big-endian", "ros1", "json", "protobuf")
_PATHS = ("stamp", "speed", "counts", "counts[1]", "ok")


@dataclass(frozen=True)
class Row:
    stamp_ns: int
    name: str
    speed: float
    counts: tuple[int, ...]
    ok: bool


def _ros_payloads(rows: list[Row], encoding: str) -> tuple[str, str, bytes, list[bytes]]:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(_DEFINITION, "car_msgs/msg/State"))
    make, stamp = store.types["car_msgs/msg/State"], store.types["car_msgs/msg/Stamp"]
    payloads = []
    for r in rows:
        seconds, rest = divmod(r.stamp_ns, 1_000_000_000)
        message = make(
            stamp=stamp(sec=seconds, nanosec=rest),
            name=r.name,
            speed=r.speed,
            counts=np.array(r.counts, np.int16),
            ok=r.ok,
        )
        if encoding == "ros1":
            payloads.append(bytes(store.serialize_ros1(message, "car_msgs/msg/State")))
        else:
            little = encoding == "cdr"
            payloads.append(bytes(store.serialize_cdr(message, "car_msgs/msg/State", little_endian=little)))
    if encoding == "ros1":
        return "ros1", "car_msgs/State", _DEFINITION.encode(), payloads
    assert all(p[1] == (encoding == "cdr") for p in payloads)
    return "cdr", "car_msgs/msg/State", _DEFINITION.encode(), payloads


def _json_payloads(rows: list[Row]) -> tuple[str, str, bytes, list[bytes]]:
    schema = {
        "type": "object",
        "properties": {
            "stamp": {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}},
            "name": {"type": "string"},
            "speed": {"type": "number"},
            "counts": {"type": "array", "items": {"type": "integer"}},
            "ok": {"type": "boolean"},
        },
    }
    payloads = []
    for r in rows:
        seconds, rest = divmod(r.stamp_ns, 1_000_000_000)
        row = {"stamp": {"sec": seconds, "nsec": rest}, "name": r.name, "speed": r.speed}
        payloads.append(json.dumps({**row, "counts": r.counts, "ok": r.ok}).encode())
    return "json", "State", json.dumps(schema).encode(), payloads


def _protobuf_payloads(rows: list[Row]) -> tuple[str, str, bytes, list[bytes]]:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2

    files = descriptor_pb2.FileDescriptorSet()
    timestamp_pb2.DESCRIPTOR.CopyToProto(files.file.add())
    file = files.file.add(name="state.proto", package="car", syntax="proto3")
    file.dependency.append("google/protobuf/timestamp.proto")
    state = file.message_type.add(name="State")
    state.field.add(name="stamp", number=1, type=11, label=1, type_name=".google.protobuf.Timestamp")
    for number, (name, kind, label) in enumerate((("name", 9, 1), ("speed", 1, 1), ("counts", 5, 3), ("ok", 8, 1)), 2):
        state.field.add(name=name, number=number, type=kind, label=label)
    pool = descriptor_pool.DescriptorPool()
    for f in files.file:
        pool.Add(f)
    make = message_factory.GetMessageClass(pool.FindMessageTypeByName("car.State"))
    payloads = []
    for r in rows:
        message = make(name=r.name, speed=r.speed, counts=r.counts, ok=r.ok)
        message.stamp.FromNanoseconds(r.stamp_ns)
        payloads.append(message.SerializeToString())
    return "protobuf", "car.State", files.SerializeToString(), payloads


def _write(path: Path, rows: list[Row], encoding: str, container: dict[str, Any]) -> None:
    if encoding == "json":
        written, name, schema, payloads = _json_payloads(rows)
    elif encoding == "protobuf":
        written, name, schema, payloads = _protobuf_payloads(rows)
    else:
        written, name, schema, payloads = _ros_payloads(rows, encoding)
    schema_encoding = {"cdr": "ros2msg", "ros1": "ros1msg", "json": "jsonschema", "protobuf": "protobuf"}[written]
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=200, **container)
        writer.start()
        schema_id = writer.register_schema(name, schema_encoding, schema)
        channel = writer.register_channel("/state", written, schema_id)
        for i, payload in enumerate(payloads):
            writer.add_message(channel, 1000 + 10 * i, payload, 1001 + 10 * i)
        writer.finish()


_CONTAINERS = {
    "zstd": {"compression": CompressionType.ZSTD},
    "lz4": {"compression": CompressionType.LZ4},
    "stored": {"compression": CompressionType.NONE},
    "without CRCs": {"enable_crcs": False},
    "unchunked": {"use_chunking": False},
    "without index": {"index_types": IndexType.NONE},
    "without summary": {
        "index_types": IndexType.NONE, "use_statistics": False, "use_summary_offsets": False,
        "repeat_schemas": False, "repeat_channels": False,
    },
    "unchunked without summary": {
        "use_chunking": False, "index_types": IndexType.NONE, "use_statistics": False,
        "use_summary_offsets": False, "repeat_schemas": False, "repeat_channels": False,
    },
    "index without channels in the summary": {"repeat_schemas": False, "repeat_channels": False},
}  # fmt: skip

_ROWS = st.lists(
    st.builds(
        Row,
        stamp_ns=st.integers(0, 2**31 * 1_000_000_000 - 1),
        name=st.text(st.characters(codec="ascii", exclude_characters="\0"), max_size=6),
        speed=st.floats(allow_nan=False),
        counts=st.lists(st.integers(-(2**15), 2**15 - 1), max_size=4).map(tuple),
        ok=st.booleans(),
    ),
    min_size=1,
    max_size=25,
)


@pytest.mark.slow
@pytest.mark.parametrize("encoding", _ENCODINGS)
@settings(
    max_examples=40, derandomize=True, deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)  # fmt: skip
@given(rows=_ROWS, container=st.sampled_from(sorted(_CONTAINERS)), cut=st.integers(0, 25))
def test_columns_hold_what_was_written_however_it_was_written(
    tmp_path: Path, encoding: str, rows: list[Row], container: str, cut: int
) -> None:
    path = tmp_path / "a.mcap"
    if encoding == "json":
        rows = [r for r in rows if np.isfinite(r.speed)] or [Row(1, "", 1.0, (), True)]
    _write(path, rows, encoding, _CONTAINERS[container])
    log = open_log(path)
    whole = log.read({"/state": _PATHS})["/state"]
    split = 1000 + 10 * cut
    parts = [log.read({"/state": _PATHS}, a, b)["/state"] for a, b in ((None, split), (split, None))]
    assert not log.lost
    log.close()
    assert whole.log_time_ns.tolist() == [1000 + 10 * i for i in range(len(rows))]
    assert whole.publish_time_ns.tolist() == [1001 + 10 * i for i in range(len(rows))]
    assert whole.fields["stamp"].tolist() == [r.stamp_ns for r in rows]
    assert whole.fields["speed"].tolist() == [r.speed for r in rows]
    assert whole.fields["ok"].tolist() == [float(r.ok) for r in rows]
    second = [float(r.counts[1]) if len(r.counts) > 1 else np.nan for r in rows]
    np.testing.assert_array_equal(whole.fields["counts[1]"], second)
    arrays = [tuple(int(x) for x in row if np.isfinite(x)) for row in whole.fields["counts"].reshape(len(rows), -1)]
    assert arrays == [r.counts for r in rows]
    for name in ("stamp", "speed", "ok", "counts[1]"):
        np.testing.assert_array_equal(np.concatenate([p.fields[name] for p in parts]), whole.fields[name])
    assert sum(len(p) for p in parts) == len(rows)
