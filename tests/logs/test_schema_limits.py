"""Schemas and messages that cost more than they hold: refused in time, as a loss that names the channel."""

import json
import time
from contextlib import closing, nullcontext

import numpy as np
import pytest
from google.protobuf import descriptor_pb2
from hypothesis import HealthCheck, given, settings, strategies as st

from pdhef_logtool.logs.byte_source import SourceError
from pdhef_logtool.logs.container import Block, ChannelRecord
from pdhef_logtool.logs.decoding import ChannelDecoder, channel_schema
from pdhef_logtool.logs.definitions import message_definition
from pdhef_logtool.logs.message_schema import MessageSchema, NoSchemaError, SchemaError, leaves, resolve
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.resource_limits import DEFAULT_LIMITS, LimitError, Meter, ResourceLimits
from pdhef_logtool.records.errors import MappingError
from tests.mcap_files import mcap_writer

_NEXT = "=" * 80 + "\n"
_HEAD, _TAIL = "module p { module msg { module A_Constants { ", " }; struct A { long x; }; }; };"


def _schema(encoding: str, text: str | bytes, name: str = "p/msg/A", *examples: bytes) -> MessageSchema:
    data = text if isinstance(text, bytes) else text.encode()
    wire = {"ros1msg": "ros1", "jsonschema": "json", "": "json", "protobuf": "protobuf"}.get(encoding, "cdr")
    return channel_schema(ChannelRecord(1, "/t", wire, name, encoding, data), examples=examples)


def _columns(schema: MessageSchema, path: str, *messages: bytes) -> tuple[np.ndarray, list[int]]:
    decoder = ChannelDecoder(schema, (resolve(schema, "/t", path),))
    length = np.array([len(m) for m in messages])
    none = np.zeros(len(messages), dtype=np.int64)
    block = Block(b"".join(messages), none, none, none, none, np.cumsum(length) - length, length)
    return decoder.columns(block, np.arange(len(messages)))[path], decoder.undecodable


def _descriptors(*files: dict) -> bytes:
    found = descriptor_pb2.FileDescriptorSet()
    for file in files:
        messages = file.pop("messages", {})
        made = found.file.add(package="p", syntax="proto3", **file)
        for name, kinds in messages.items():
            message = made.message_type.add(name=name)
            for number, kind in enumerate(kinds, 1):
                message.field.add(name=f"f{number}", number=number, type=11, type_name=f".p.{kind}", label=1)
    return found.SerializeToString()


def _nested(levels: int, fields: int) -> str:
    steps = {f"d{i}": {"properties": {f"p{j}": {"$ref": f"#/d{i + 1}"} for j in range(fields)}} for i in range(levels)}
    return json.dumps({"$ref": "#/d0", **steps, f"d{levels}": {"type": "number"}})


_LISTED = "".join(f"{_NEXT}MSG: p/B{i}\nB{i + 1}[16] x\n" for i in range(6))
_CHAIN = "".join(f"{_NEXT}MSG: p/B{i}\nB{i + 1} x\n" for i in range(99))
_SQUARES = "".join(f"const long X{i + 1} = X{i} * X{i};" for i in range(60))
_TWELVE = tuple(f"M{i}" for i in range(12))
_MUTUAL = _descriptors({"name": "a", "messages": dict.fromkeys(_TWELVE, _TWELVE)})
_IMPORTS = _descriptors(*({"name": f"f{i}", "dependency": [f"f{i + 1}"]} for i in range(3000)))
_BOMBS = {
    "arrays in arrays": ("ros2msg", f"B0 x\n{_LISTED}{_NEXT}MSG: p/B6\nint8 x\n", "schema leaves"),
    "an endless array of texts": ("ros2msg", "string[4294967295] x\n", "schema leaves"),
    "an array of less than nothing": ("ros2msg", "float64[-3] x\n", "-3 elements"),
    "itself": ("ros2msg", "p/A[] x\n", "contains itself"),
    "deep": ("ros2msg", f"B0 x\n{_CHAIN}{_NEXT}MSG: p/B99\nint8 x\n", "schema depth"),
    "a long text": ("ros1msg", "".join(f"int8 a{i}\n" for i in range(40_000)), "schema bytes"),
    "brackets": ("ros2idl", f"{_HEAD}const long X = {'(' * 60}1{')' * 60};{_TAIL}", "nested too deeply"),
    "a number of gigabytes": ("ros2idl", f"{_HEAD}const long X = 1 << 99999999999;{_TAIL}", "cannot be parsed"),
    "squares": ("ros2idl", f"{_HEAD}const long X0 = 99;{_SQUARES}{_TAIL}", "cannot be parsed"),
    "references": ("jsonschema", _nested(13, 10), "schema leaves"),
    "brackets in JSON": ("jsonschema", "[" * 90_000, "nested too deeply"),
    "messages in messages": ("protobuf", _MUTUAL, "leaves"),
    "imports": ("protobuf", _IMPORTS, "which the descriptors lack"),
    "files": ("protobuf", _descriptors(*({"name": f"f{i}"} for i in range(30_000))), "schema leaves"),
}


@pytest.mark.parametrize("case", _BOMBS)
def test_a_schema_that_costs_too_much_is_refused_in_time(case):
    encoding, text, says = _BOMBS[case]
    started = time.process_time()
    with pytest.raises(SchemaError, match=says):
        _schema(encoding, text, "p.M0" if encoding == "protobuf" else "p/msg/A")
    assert time.process_time() - started < 5.0


def test_higher_limits_read_what_is_sound_and_large():
    channel = ChannelRecord(1, "/t", "cdr", "p/msg/A", "ros2msg", b"string[4000] x\n")
    with pytest.raises(SchemaError, match="--set budget"):
        channel_schema(channel)
    assert len(list(leaves(channel_schema(channel, limits=DEFAULT_LIMITS.times(2.0)).root))) == 1


def test_a_schema_that_refers_to_itself_is_open_there():
    text = '{"$ref": "#/d", "d": {"properties": {"a": {"$ref": "#/d"}, "b": {"type": "number"}}}}'
    schema = _schema("jsonschema", text)
    assert [leaf.path for leaf in leaves(schema.root)] == ["b"]
    values, _ = _columns(schema, "a.a.b", b'{"a": {"a": {"b": 2}}}')
    np.testing.assert_array_equal(values, [2.0])


def test_an_array_without_end_does_not_take_its_neighbours_along():
    schema = _schema("ros2msg", "int8 y\nfloat64[4294967295] x\n")
    with pytest.raises(MappingError, match="4294967295 elements, too many"):
        resolve(schema, "/t", "x")
    assert _columns(schema, "y", b"\0\1\0\0" + bytes(99))[1] == [0]


@pytest.mark.parametrize(
    "message",
    [b'{"a": ' * 900 + b"1" + b"}" * 900, b"[" * 50_000, b'{"a": ' + b"9" * 100_000 + b"}", b"\xff", b"", b"null"],
    ids=["deep", "deeper", "a long number", "no text", "nothing", "null"],
)
def test_a_hostile_json_message_is_one_that_does_not_decode(message):
    schema = _schema("jsonschema", '{"properties": {"a": {"type": "number"}}}')
    values, undecodable = _columns(schema, "a", b'{"a": 1}', message, b'{"a": ' + b"9" * 4000 + b"}")
    assert values[0] == 1.0
    assert np.isnan(values[1])
    assert np.isinf(values[2])
    assert set(undecodable) <= {1}
    if message.startswith((b"[", b"{")) and message.count(b"9") == 0:
        with pytest.raises(SchemaError):
            _schema("", b"", "", message)


@pytest.mark.parametrize(("wire", "head"), [("ros2msg", b"\0\1\0\0"), ("ros2msg", b"\0\0\0\0"), ("ros1msg", b"")])
def test_a_claimed_length_allocates_nothing(wire, head):
    schema = _schema(wire, f"int8 y\nE[] x\nfloat64[] z\nstring s\n{_NEXT}MSG: p/E\nuint8 a\n")
    for at in (4, 8, 12):
        message = bytearray(head + bytes(40))
        message[at : at + 4] = b"\xff\xff\xff\xff"
        assert _columns(schema, "y", bytes(message))[1] == [0]


def test_a_message_of_objects_without_end_is_not_turned_into_them():
    many = 40_000_000
    schema = _schema("ros2msg", f"E[] x\nint8 y\n{_NEXT}MSG: p/E\nuint8 a\n")
    assert _columns(schema, "y", b"\0\1\0\0" + many.to_bytes(4, "little") + bytes(many + 1))[1] == [0]
    # An image has as many bytes and is one object.
    image = _schema("ros2msg", "uint8[] x\nint8 y\n")
    assert _columns(image, "y", b"\0\1\0\0" + many.to_bytes(4, "little") + bytes(many) + b"\5")[0].tolist() == [5.0]


def test_a_schema_that_does_not_parse_is_a_loss_of_its_channel_and_no_other(tmp_path):
    path = tmp_path / "a.mcap"
    with mcap_writer(path) as writer:
        for topic, encoding, text, messages in [
            ("/bomb", "jsonschema", _nested(13, 10).encode(), "json"),
            ("/sound", "jsonschema", b'{"properties": {"x": {"type": "number"}}}', "json"),
            ("/other", "flatbuffer", b"\1\2", "flatbuffer"),
        ]:
            schema = writer.register_schema(topic, encoding, text)
            channel = writer.register_channel(topic, messages, schema)
            writer.add_message(channel, 5, b'{"x": 1}', 5)
    with closing(open_log(path)) as log:
        assert [len(log.fields(topic)) for topic in ("/bomb", "/bomb", "/sound", "/other")] == [0, 0, 1, 0]
        (loss,) = log.lost
        assert (loss.kind, loss.where, loss.severity) == ("bad-schema", "/bomb", "lost")


@pytest.mark.parametrize("name", ["../../x", "p/msg/../../../x", "/etc/x", "p/msg/T\n", "p/T", "", "no_such/msg/Type"])
def test_a_type_name_becomes_no_path(name):
    with pytest.raises(KeyError):
        message_definition(name)


def test_a_server_that_fails_is_no_bad_schema():
    def messages():
        raise SourceError(expected="an answer", got="none", where="/t")
        yield b""

    with pytest.raises(SourceError):
        channel_schema(ChannelRecord(1, "/t", "json", "", "", b""), examples=messages())


def test_a_type_without_a_definition_is_no_loss():
    with pytest.raises(NoSchemaError):
        _schema("", b"", "p/msg/Nowhere")
    with pytest.raises(NoSchemaError):
        channel_schema(ChannelRecord(1, "/t", "cdr", "p/msg/Nowhere", "", b""))


_TEXTS = {
    "ros2msg": message_definition("sensor_msgs/msg/Imu"),
    "ros1msg": "Header header\nfloat64[3] a\nB[] b\n" + _NEXT + "MSG: p/B\nstring s\ntime t\n",
    "ros2idl": f"{_HEAD}const long C = -(1) + 2;{_TAIL}",
    "jsonschema": _nested(2, 2),
}
_INSERTED = ["", "[", "]", "(", "<", '"', "\n", "\0", "9" * 30, "string", "[99999999]", "$ref", "{", "}"]
_CUT = st.tuples(st.integers(0, 5000), st.integers(0, 20), st.sampled_from(_INSERTED))


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.sampled_from(list(_TEXTS)), st.lists(_CUT, max_size=5), st.binary(max_size=60))
def test_a_mutated_schema_is_read_or_refused(encoding, cuts, message):
    text = _TEXTS[encoding]
    for at, n, new in cuts:
        text = text[: at % (len(text) + 1)] + new + text[at % (len(text) + 1) + n :]
    try:
        schema = _schema(encoding, text)
    except SchemaError as error:
        assert "\n" not in str(error)
        return
    for leaf in list(leaves(schema.root))[:2]:
        try:
            _columns(schema, leaf.path, message, b"\0\1\0\0" + message)
        except MappingError:
            continue


MIB = 1 << 20


@pytest.mark.parametrize(
    ("limit", "sound", "harmful"),
    [
        ("chunk_bytes", 64 * MIB, 1024 * MIB),
        ("chunk_ratio", 500, 10_000),
        ("chunk_messages", 200_000, 10_000_000),
        ("messages_per_byte", 1.0, 100.0),
        ("channels", 2000, 65_000),
        ("metadata_bytes", 16 * MIB, 512 * MIB),
        ("schema_bytes", MIB, 64 * MIB),
        ("schema_leaves", 5000, 1_000_000),
        ("schema_depth", 16, 200),
        ("array_width", 40_000, 10_000_000),
        ("table_bytes", 100 * MIB, 2048 * MIB),
        ("table_ratio", 16, 1000),
        ("seconds", 3.0, 60.0),
        ("seconds_per_mib", 10.0, 200.0),
    ],
)
def test_sound_amounts_pass_and_harmful_ones_do_not(limit, sound, harmful):
    DEFAULT_LIMITS.check(limit, sound, "a file")
    with pytest.raises(LimitError, match=f"a file: expected at most .* {limit.replace('_', ' ')}, got .*--set budget"):
        DEFAULT_LIMITS.check(limit, harmful, "a file")
    DEFAULT_LIMITS.times(harmful / sound).check(limit, harmful, "a file")


def test_every_default_is_tested():
    (mark,) = test_sound_amounts_pass_and_harmful_ones_do_not.pytestmark
    assert {name for name, *_ in mark.args[1]} == set(ResourceLimits.__slots__)


@pytest.mark.parametrize(
    ("size", "stored", "limit"),
    [(2, 1, ""), (1, 1 / MIB, ""), (2, 100 / MIB, "chunk ratio"), (1024, 1024, "chunk bytes"), (2, 0, "chunk ratio")],
)
def test_small_parts_may_unfold_as_they_like(size, stored, limit):
    with pytest.raises(LimitError, match=limit) if limit else nullcontext():
        DEFAULT_LIMITS.check_unpacked(size * MIB, round(stored * MIB), "a chunk")


@pytest.mark.parametrize(("size", "stored", "limit"), [(100, 1, ""), (600, 1, "table bytes"), (600, 20, "")])
def test_tables_may_be_as_large_as_their_file_gives_reason_for(size, stored, limit):
    with pytest.raises(LimitError, match=limit) if limit else nullcontext():
        DEFAULT_LIMITS.check_table(size * MIB, stored * MIB, "a file")


@pytest.mark.parametrize(
    ("count", "stored", "limit"),
    [(60_000, 1, ""), (10**5, 10**5, ""), (10**5, 1000, "messages per byte"), (10**7, 1 << 30, "chunk messages")],
)
def test_many_messages_need_bytes(count, stored, limit):
    with pytest.raises(LimitError, match=limit) if limit else nullcontext():
        DEFAULT_LIMITS.check_messages(count, stored)


def test_time_grows_with_what_is_read_and_counts_again_each_time(monkeypatch):
    now = [0.0]
    monkeypatch.setattr("pdhef_logtool.logs.resource_limits.time.thread_time", lambda: now[0])
    meter = Meter(ResourceLimits(seconds=5.0, seconds_per_mib=20.0))
    assert meter.allowed_s == 5.0
    for _ in range(2):
        with meter.running(MIB // 4):
            now[0] += 7.0
            meter.check()
    assert meter.allowed_s == 15.0
    meter.check()
    with meter.running(), pytest.raises(LimitError, match="longer than 15 s"):
        now[0] += 1.1
        meter.check()
