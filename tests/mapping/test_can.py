"""Raw CAN frames become the columns that cantools decodes frame by frame."""

import base64
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cantools
import numpy as np
import pytest
from cantools.database.can import Message, Signal
from cantools.database.conversion import BaseConversion
from hypothesis import given, settings, strategies as st

from pdhef_logtool.logs.can_decoding import signal_values
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import Mapping, check_mapping, fit_clocks, load_mapping, read_signals
from pdhef_logtool.mapping.evidence import LARGEST
from pdhef_logtool.records.errors import MappingError
from pdhef_logtool.runs.inspection.report import inspect_log
from studies.strangers.containers import Topic, write
from tests.mcap_files import mcap_writer

S = 1_000_000_000

DBC = """VERSION ""
NS_ :
BS_:
BU_: ECU
BO_ 256 Motion: 8 ECU
 SG_ Speed : 0|16@1+ (0.01,0) [0|655.35] "km/h" ECU
 SG_ YawRate : 23|16@0- (0.005,-1) [-200|200] "deg/s" ECU
 SG_ Valid : 63|1@1+ (1,0) [0|1] "" ECU
BO_ 2566844672 Extended: 4 ECU
 SG_ Accel : 0|32@1- (1,0) [0|0] "m/s2" ECU
BO_ 257 Switched: 4 ECU
 SG_ Page M : 0|8@1+ (1,0) [0|0] "" ECU
 SG_ OnFirst m0 : 8|16@1- (0.1,0) [0|0] "" ECU
 SG_ OnThird m2 : 15|24@0+ (1,5) [0|0] "" ECU
SIG_VALTYPE_ 2566844672 Accel : 1;
"""


@dataclass(frozen=True)
class Frame:
    id: int
    data: bytes
    extended: bool = False
    error: bool = False
    remote: bool = False


@st.composite
def _signals(draw: st.DrawFn) -> tuple[Signal, int]:
    """A signal anywhere in a frame of up to 64 bytes, and the frame's length."""
    size = draw(st.sampled_from([1, 2, 5, 8, 12, 64]))
    is_float = size >= 8 and draw(st.booleans())
    length = draw(st.sampled_from([16, 32, 64])) if is_float else draw(st.integers(1, min(64, 8 * size)))
    at = draw(st.integers(0, 8 * size - length))
    order = draw(st.sampled_from(["little_endian", "big_endian"]))
    # Counted along the wire for big-endian signals: their start is bit 7 of byte 0 for at = 0.
    start = at if order == "little_endian" else 8 * (at // 8) + 7 - at % 8
    scale = draw(st.sampled_from([1, 0.01, -0.25, 3, 1e-7]))
    conversion = BaseConversion.factory(scale, draw(st.sampled_from([0, -40, 0.5])), None, is_float)
    signed = not is_float and draw(st.booleans())
    return Signal("S", start, length, order, signed, conversion=conversion), size


@settings(max_examples=100, derandomize=True, deadline=None)
@given(layout=_signals(), frames=st.lists(st.binary(min_size=64, max_size=64), min_size=1, max_size=5))
def test_any_layout_decodes_as_cantools_decodes_it(layout, frames):
    signal, size = layout
    message = Message(1, "M", size, [signal])
    data = np.frombuffer(b"".join(f[:size] for f in frames), np.uint8).reshape(len(frames), size)
    expected = [float(message.decode(f[:size], decode_choices=False)["S"]) for f in frames]
    with np.errstate(over="ignore", invalid="ignore"):
        got = signal_values(data, signal)
    # Integers above 2^53 are rounded once more or less than in cantools' integer arithmetic.
    np.testing.assert_allclose(got, expected, rtol=4e-16 * 4, atol=0.0)


# ---------------------------------------------------------------------------------------------- whole logs


def _write(path: Path, encoding: str, schema: tuple[str, str, bytes], payloads: Sequence[bytes]) -> None:
    with mcap_writer(path) as writer:
        schema_id = writer.register_schema(*schema) if schema[0] else 0
        channel = writer.register_channel("/can/raw", encoding, schema_id)
        for i, payload in enumerate(payloads):
            writer.add_message(channel, S + i * 1_000_000, payload, S + i * 1_000_000)


def _write_ros(path: Path, frames: Sequence[Frame]) -> None:
    stamps_ns = S + np.arange(len(frames), dtype=np.int64) * 1_000_000
    parts = {"id": "id", "is_rtr": "remote", "is_extended": "extended", "is_error": "error"}
    fields = {field: np.array([getattr(f, name) for f in frames]) for field, name in parts.items()}
    fields |= {"header.stamp": stamps_ns, "dlc": np.array([len(f.data) for f in frames])}
    fields["data"] = np.array([list(f.data.ljust(8, b"\xaa")) for f in frames])
    write([Topic("/can/raw", "can_msgs/msg/Frame", stamps_ns, stamps_ns, fields)], path, "mcap")


def _write_json(path: Path, frames: Sequence[Frame], data: Callable[[bytes], object]) -> None:
    # No flag for extended identifiers: bit 31 of the identifier says it, as SocketCAN has it.
    rows = [{"arbitration_id": f.id | (f.extended << 31), "data": data(f.data)} for f in frames]
    kind = {"type": "string"} if isinstance(rows[0]["data"], str) else {"type": "array", "items": {"type": "integer"}}
    schema = {"type": "object", "properties": {"arbitration_id": {"type": "integer"}, "data": kind}}
    _write(path, "json", ("Can", "jsonschema", json.dumps(schema).encode()), [json.dumps(r).encode() for r in rows])


def _mapping(folder: Path, fields: dict[str, str], more: str = "", dbc: str = DBC) -> Mapping:
    (folder / "car.dbc").write_text(dbc)
    tables = [f'[can]\ndbc = "car.dbc"\n{more}']
    tables += [f'[signals.{n}]\ntopic = "/can/raw"\nfield = "{f}"\n' for n, f in fields.items()]
    (folder / "mapping.toml").write_text("\n".join(tables))
    return load_mapping(folder / "mapping.toml")


_FIELDS = {"speed_m_s": "can:Motion.Speed", "yaw_rate_rad_s": "can:Motion.YawRate", "ax_m_s2": "can:Extended.Accel"}
_FIELDS |= {"ay_m_s2": "can:Switched.OnFirst", "friction": "can:Switched.OnThird"}


def _expected(frames: Sequence[Frame], field: str) -> list[tuple[int, float]]:
    """(stamp, value) of every frame that cantools decodes to the signal."""
    database: Any = cantools.database.load_string(DBC, "dbc")
    name, signal = field.removeprefix("can:").split(".")
    message = database.get_message_by_name(name)
    found = []
    for i, f in enumerate(frames):
        if f.error or f.remote or (f.id, f.extended) != (message.frame_id, message.is_extended_frame):
            continue
        try:
            values = message.decode(f.data, decode_choices=False, allow_truncated=True)
        except (cantools.database.DecodeError, ValueError):  # older releases let the empty frame's ValueError out
            continue
        if signal in values and np.isfinite(values[signal]):
            found.append((S + i * 1_000_000, float(values[signal])))
    return found


def _read(path: Path, mapping: Mapping) -> Any:
    log = open_log(path)
    try:
        check_mapping(mapping, log)
        clocks = fit_clocks(log, mapping, log.start_ns, log.end_ns)
        return read_signals(log, mapping, clocks, log.start_ns, log.end_ns)
    finally:
        log.close()


_EXTENDED_ID = 2566844672 & (2**29 - 1)
_DATA = st.binary(min_size=8, max_size=8)
_PAGES = st.builds(lambda page, rest: bytes([page]) + rest, st.integers(0, 3), st.binary(min_size=3, max_size=3))
_KINDS = [(256, _DATA), (256, st.binary(max_size=7)), (257, _PAGES), (256, _DATA, st.just(True)), (999, _DATA)]
_KINDS.append((_EXTENDED_ID, st.binary(min_size=4, max_size=4), st.just(True)))
_FRAMES = st.lists(st.one_of(*(st.builds(Frame, st.just(i), *of) for i, *of in _KINDS)), min_size=1, max_size=30)


@pytest.mark.slow
@pytest.mark.parametrize("form", ["ros", "json", "hex", "base64"])
@settings(max_examples=8, derandomize=True, deadline=None)
@given(frames=_FRAMES)
def test_frames_of_every_encoding_decode_as_cantools_decodes_them(tmp_path_factory, form, frames):
    folder = tmp_path_factory.mktemp("can")
    path = folder / "can.mcap"
    more = ""
    if form == "ros":
        _write_ros(path, frames)
    elif form == "json":
        _write_json(path, frames, list)
    else:
        _write_json(path, frames, bytes.hex if form == "hex" else lambda x: base64.b64encode(x).decode())
        more = f'data_encoding = "{form}"'
    channels = _read(path, _mapping(folder, _FIELDS, more))
    for name, field in _FIELDS.items():
        channel = channels.signals[name]
        expected = [(t, v) for t, v in _expected(frames, field) if abs(v) < LARGEST]  # no number of a car
        assert channel.stamps_ns.tolist() == [t for t, _ in expected]
        assert channel.values.tolist() == pytest.approx([v for _, v in expected], rel=1e-15)
    short = sum(f.id == 256 and not f.extended and len(f.data) < 4 for f in frames)  # without YawRate
    counted = {x.where: x.count for x in channels.losses if x.kind == "undecodable"}
    assert counted == ({"/can/raw.can:Motion": short} if short else {})


def test_error_and_remote_frames_carry_no_data(tmp_path):
    data = bytes(range(8))
    frames = [Frame(256, data), Frame(256, data, error=True), Frame(256, data, remote=True), Frame(256, data)]
    _write_ros(tmp_path / "a.mcap", frames)
    channel = _read(tmp_path / "a.mcap", _mapping(tmp_path, {"speed_m_s": "can:Motion.Speed"})).signals["speed_m_s"]
    assert channel.stamps_ns.tolist() == [S, S + 3_000_000]


def test_another_bus_and_masked_bits_are_told_apart(tmp_path):
    rows = [{"msg": {"no": 256 | priority << 11, "raw": [value, 0, 0, 0, 0, 0, 0, 0]}, "port": bus, "ide": 0}
            for priority, value, bus in ((0, 1, 0), (0, 2, 1), (0, 3, 0))]  # fmt: skip
    _write(tmp_path / "a.mcap", "json", ("", "", b""), [json.dumps(r).encode() for r in rows])
    more = 'id_field = "msg.no"\ndata_field = "msg.raw"\nbus_field = "port"\nbus = 0'
    channel = _read(tmp_path / "a.mcap", _mapping(tmp_path, {"speed_m_s": _FIELDS["speed_m_s"]}, more)).signals
    assert channel["speed_m_s"].values.tolist() == pytest.approx([0.01, 0.03])
    # The lowest three bits left out of the comparison: 0x101 counts as 0x100 too.
    rows = [{"id": i, "data": [i & 7] + [0] * 7} for i in (256, 257, 263, 264)]
    _write(tmp_path / "b.mcap", "json", ("", "", b""), [json.dumps(r).encode() for r in rows])
    more = f"id_mask = {(1 << 29) - 8}"
    channel = _read(tmp_path / "b.mcap", _mapping(tmp_path, {"speed_m_s": _FIELDS["speed_m_s"]}, more)).signals
    assert channel["speed_m_s"].values.tolist() == pytest.approx([0.0, 0.01, 0.07])


def test_inspect_shows_the_signals_and_counts_short_frames(tmp_path):
    frames = [Frame(256, bytes([i, 0] + [0] * 6)) for i in range(50)] + [Frame(256, b"1")]
    _write_ros(tmp_path / "a.mcap", frames)
    mapping = _mapping(tmp_path, {"speed_m_s": "can:Motion.Speed"})
    found = inspect_log(tmp_path / "a.mcap", mapping)
    report = found.signals["speed_m_s"]
    assert (report.topic, report.field, report.samples) == ("/can/raw", "can:Motion.Speed", 50)
    assert report.maximum == pytest.approx(0.49)
    assert [(x.kind, x.count, x.severity) for x in found.lost] == [("undecodable", 1, "lost")]
    assert [t.name for t in found.topics] == ["/can/raw"]


# --------------------------------------------------------------------------------------------------- errors


@pytest.mark.parametrize(
    ("field", "dbc", "says"),
    [
        ("can:Motoin.Speed", DBC, r"no message Motoin \(did you mean Motion\?\)"),
        ("can:Motion.YawRat", DBC, r"no signal YawRat \(did you mean YawRate\?\)"),
        ("can:Motion.Speed", "", "car.dbc"),
        ("can:Motion.Speed", "BO_ 256 Motion: 8 ECU\n SG_ Speed : nonsense", "car.dbc"),
        ("can:Motion.Speed", "\x00\xff\x00", "car.dbc"),
        ("can:Motion.Speed", None, "car.dbc"),
        ("can:Motion.Speed", "two files", "Motion is in car.dbc and in other.dbc"),
    ],
)
def test_a_dbc_that_cannot_be_used_is_one_clear_line(tmp_path, field, dbc, says):
    _write_ros(tmp_path / "a.mcap", [Frame(256, bytes(8))])
    two = dbc == "two files"
    mapping = _mapping(tmp_path, {"speed_m_s": field}, dbc=DBC if two else dbc or "")
    if dbc is None:
        (tmp_path / "car.dbc").unlink()
    if two:
        (tmp_path / "other.dbc").write_text(DBC)
        text = (tmp_path / "mapping.toml").read_text().replace('"car.dbc"', '["car.dbc", "other.dbc"]')
        (tmp_path / "mapping.toml").write_text(text)
        mapping = load_mapping(tmp_path / "mapping.toml")
    with pytest.raises(MappingError, match=says) as error:
        _read(tmp_path / "a.mcap", mapping)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("row", "says"),
    [
        ({"number": 256, "data": [1]}, "id_field"),
        ({"id": 256, "content": [1]}, "data_field"),
        ({"a": {"id": 256}, "b": {"id": 1}, "data": [1]}, "a.id and b.id"),
        ({"id": 256, "data": "AA"}, "data_encoding"),
    ],
)
def test_frames_that_are_not_recognised_ask_for_the_field(tmp_path, row, says):
    _write(tmp_path / "a.mcap", "json", ("", "", b""), [json.dumps(row).encode()])
    with pytest.raises(MappingError, match=says):
        _read(tmp_path / "a.mcap", _mapping(tmp_path, {"speed_m_s": "can:Motion.Speed"}))


def test_frames_without_their_description_are_said_to_need_one(tmp_path):
    frames = [Frame(0x10, bytes([i, 2, 3])) for i in range(5)]
    _write_ros(tmp_path / "ros.mcap", frames)
    _write_json(tmp_path / "json.mcap", frames, list)
    for name in ("ros", "json"):
        notes = inspect_log(tmp_path / f"{name}.mcap").notes
        assert any("/can/raw contains raw CAN frames" in n and "dbc" in n for n in notes), notes
