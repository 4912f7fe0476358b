"""Small files that claim, unfold or hide much; places that are no files; names that steer terminals and paths.

Each must end within the limits of :mod:`studies.torture.workers` and with one of the exit codes that it names.
"""

import bz2
import json
import os
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import lz4.frame
import zstandard

from studies.pages import ROOT
from studies.torture.damage import ENDLESS_VIEW, HUGE_ROWS, MAGIC, Record, join_bag, join_mcap
from studies.torture.seeds import SEEDS, START_NS
from studies.torture.workers import LIMIT_S, Verdict, judge_process, measured

_NO_LOG, _EITHER, _SOUND, _ANY = (1,), (1, 3), (0, 3), (0, 1, 3)
_PAST_NS = START_NS - 315_360_000 * 10**9


@dataclass(frozen=True, slots=True)
class Bomb:
    """``make`` writes below a folder and returns what to inspect; ``codes`` are the exit codes that are right."""

    name: str
    make: Callable[[Path], Path]
    codes: tuple[int, ...]


def _text(data: bytes) -> bytes:
    return struct.pack("<I", len(data)) + data


def _schema(name: bytes, encoding: bytes, data: bytes) -> Record:
    return b"\3", struct.pack("<H", 1) + _text(name) + _text(encoding) + _text(data)


def _channel(id_: int, topic: bytes, encoding: bytes) -> Record:
    return b"\4", struct.pack("<HH", id_, 1) + _text(topic) + _text(encoding) + _text(b"")


def _message(channel: int, time_ns: int, payload: bytes) -> Record:
    return b"\5", struct.pack("<HIQQ", channel, 0, time_ns, time_ns) + payload


def _chunk(compression: bytes, stored: bytes, size: int, crc: int = 0) -> Record:
    head = struct.pack("<QQQI", START_NS, START_NS, size, crc)
    return b"\6", head + _text(compression) + struct.pack("<Q", len(stored)) + stored


def _mcap(*records: Record, behind: bytes = b"") -> bytes:
    """Return a file of records, and some bytes behind them."""
    end = [(b"\x0f", struct.pack("<I", 0)), (b"\2", struct.pack("<QQI", 0, 0, 0))]
    return MAGIC + join_mcap([(b"\1", _text(b"ros2") + _text(b"torture")), *records]) + behind + join_mcap(end) + MAGIC


def _placed(name: str, put: Callable[[Path], object], folder: Path) -> Path:
    put(folder / name)
    return folder / name


def _typed(name: bytes, encoding: bytes, schema: bytes, wire: bytes, payload: bytes, topic: bytes = b"/t") -> bytes:
    declared = _schema(name, encoding, schema), _channel(1, topic, wire)
    return _mcap(*declared, *(_message(1, START_NS + i * 10**7, payload) for i in range(50)))


def _zeros(kind: bytes, size: int) -> bytes:
    compressors: dict[bytes, Callable[[], Any]] = {
        b"zstd": lambda: zstandard.ZstdCompressor(level=3).compressobj(size=size),
        b"lz4": lz4.frame.LZ4FrameCompressor,
        b"bz2": lambda: bz2.BZ2Compressor(9),
    }
    compressor, block = compressors[kind](), bytes(1 << 20)
    begin = compressor.begin() if kind == b"lz4" else b""
    return b"".join([begin, *(compressor.compress(block) for _ in range(size >> 20)), compressor.flush()])


def _bag_chunk(compression: bytes, stored: bytes, size: int) -> bytes:
    head = {b"op": b"\3", b"index_pos": bytes(8), b"conn_count": bytes(4), b"chunk_count": struct.pack("<I", 1)}
    chunk = {b"op": b"\5", b"compression": compression, b"size": struct.pack("<I", size)}
    headers = (b"".join(_text(k + b"=" + v) for k, v in fields.items()) for fields in (head, chunk))
    return b"#ROSBAG V2.0\n" + join_bag(zip(headers, (b" " * 4000, stored), strict=True))


def _nested(levels: int) -> bytes:
    """Return a ROS type with ten members of the next level in each level."""
    parts = [b"L0 a"]
    parts += [
        b"=" * 80 + b"\nMSG: p/L%d\n" % i + b"\n".join(b"L%d f%d" % (i + 1, k) for k in range(10))
        for i in range(levels)
    ]
    return b"\n".join([*parts, b"=" * 80 + b"\nMSG: p/L%d\nfloat64 x\n" % levels])


def _json_references(levels: int) -> bytes:
    def kind(i: int) -> dict[str, object]:
        return {"type": "object", "properties": {f"p{k}": {"$ref": f"#/definitions/d{i + 1}"} for k in range(10)}}

    definitions = {f"d{i}": kind(i) for i in range(levels)} | {f"d{levels}": {"type": "number"}}
    return json.dumps({"type": "object", "$ref": "#/definitions/d0", "definitions": definitions}).encode()


def _descriptors(levels: int, width: int) -> bytes:
    from google.protobuf import descriptor_pb2

    files = descriptor_pb2.FileDescriptorSet()
    file = files.file.add(name="b.proto", package="p", syntax="proto3")
    for i in range(levels + 1):
        message = file.message_type.add(name=f"L{i}")
        kind = {"type": 11, "type_name": f".p.L{i + 1}"} if i < levels else {"type": 1}
        for k in range(width):
            message.field.add(name=f"f{k}", number=k + 1, label=1, **kind)
    return bytes(files.SerializeToString())


def _times(*extra: int) -> bytes:
    """Return a sound small log with messages at odd times among the others."""
    times = [START_NS + i * 10**7 for i in range(300)]
    return _mcap(*_DECLARED, *(_message(1, t, _CDR) for t in (*times[:150], *extra, *times[150:])))


def _claimed_counts() -> bytes:
    inner = join_mcap([*_DECLARED, _message(1, START_NS, _CDR)])
    index = b"\7", struct.pack("<HI", 1, 2**32 - 16) + bytes(64)
    return _mcap(_chunk(b"", inner, len(inner), zlib.crc32(inner)), index)


def _loops(folder: Path) -> Path:
    """Two links to the folder that they lie in: 2^n ways lead to everything."""
    (folder / "a").symlink_to(".")
    (folder / "b").symlink_to(".")
    return folder


def _sparse(path: Path) -> None:
    path.write_bytes(_mcap()[:40])
    os.truncate(path, 20 << 30)


def _metadata(text: str, folder: Path) -> Path:
    (folder / "metadata.yaml").write_text(text)
    return folder


def _laughs() -> str:
    lines = ['a0: &a0 ["ha", "ha", "ha", "ha", "ha", "ha", "ha", "ha", "ha"]']
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12)]
    return "\n".join([*lines, "rosbag2_bagfile_information:", "  relative_file_paths: *a11", ""])


def _database(statement: str, folder: Path) -> Path:
    import sqlite3

    path = folder / "drive.db3"
    SEEDS["rosbag2.db3"](path)
    with sqlite3.connect(path) as database:
        database.executescript(statement)
    database.close()
    return path


_FLOAT, _CDR = b"float64 data\n", b"\0\1\0\0" + bytes(8)
_DECLARED = _schema(b"std_msgs/msg/Float64", b"ros2msg", _FLOAT), _channel(1, b"/x", b"cdr")
_ODD_NAME = b"/wheels[/red]\x1b[2J\nwarning: all is well\0\xe2\x80\xae"


def _many_channels(n: int) -> bytes:
    channels = (_channel(i, b"/c%d" % i, b"cdr") for i in range(1, n))
    return _mcap(_DECLARED[0], *channels, *(_message(i, START_NS + i, _CDR) for i in range(1, n)))


def _made(name: str, codes: tuple[int, ...], content: Callable[[], bytes], suffix: str = ".mcap") -> Bomb:
    return Bomb(name, partial(_placed, f"drive{suffix}", lambda path: path.write_bytes(content())), codes)


GIB = 1 << 30
_MEMBERS = b"=" * 80 + b"\nMSG: "


def _chunks() -> tuple[Bomb, ...]:
    """Return compressed chunks and files that unfold to gigabytes, or claim to."""

    def mcap(name: str, kind: bytes, size: int, claimed: int) -> Bomb:
        return _made(name, _EITHER, lambda: _mcap(_chunk(kind, _zeros(kind, size), claimed)))

    def bag(name: str, kind: bytes, size: int) -> Bomb:
        return _made(name, _EITHER, lambda: _bag_chunk(kind, _zeros(kind, size), 1000), ".bag")

    return (
        mcap("zstd chunk of 4 GiB", b"zstd", 4 * GIB, 4 * GIB),
        mcap("zstd chunk that claims 1000 bytes and contains 4 GiB", b"zstd", 4 * GIB, 1000),
        mcap("zstd chunk that claims 100 GB", b"zstd", 1 << 20, 10**11),
        mcap("lz4 chunk of 2 GiB", b"lz4", 2 * GIB, 2 * GIB),
        mcap("lz4 chunk that claims 1000 bytes and contains 2 GiB", b"lz4", 2 * GIB, 1000),
        bag("bag: bz2 chunk that claims 1000 bytes and contains 3 GiB", b"bz2", 3 * GIB),
        bag("bag: lz4 chunk that claims 1000 bytes and contains 2 GiB", b"lz4", 2 * GIB),
        _made("whole file of 8 GiB as zstd", _EITHER, lambda: _zeros(b"zstd", 8 * GIB), ".mcap.zst"),
        _made("MCAP header and 4 GiB of zeros as zstd", _EITHER, lambda: _zeros(b"zstd", 4 * GIB), ".mcap.zstd"),
    )


def _declarations() -> tuple[Bomb, ...]:
    """Return channels, types and messages with large, endless or unusual declarations."""

    def ros(
        name: str, codes: tuple[int, ...], type_name: bytes, text: bytes, data: bytes = bytes(64),
        kinds: tuple[bytes, bytes] = (b"ros2msg", b"cdr"), topic: bytes = b"/t",
    ) -> Bomb:  # fmt: skip
        return _made(name, codes, lambda: _typed(type_name, kinds[0], text, kinds[1], data, topic))

    def json_(name: str, codes: tuple[int, ...], schema: bytes, data: bytes = b"{}") -> Bomb:
        return ros(name, codes, b"S", schema, data, (b"jsonschema" if schema else b"", b"json"))

    idl = b"module m {" * 500 + b"struct A { double x; };" + b"};" * 500
    structs = b"B[] a\n" + _MEMBERS + b"p/B\nstring s\n"
    endless = b"\5" + struct.pack("<QHIQQ", 2**63 - 8, 1, 0, START_NS, START_NS)
    markup = "a topic that is markup, terminal codes and a forged line"
    return (
        _made("65,534 channels", _ANY, lambda: _many_channels(65_535)),
        _made("an index that claims 268 million messages", _ANY, _claimed_counts),
        _made("a message size near 2^63", _EITHER, lambda: _mcap(*_DECLARED, behind=endless)),
        ros("ROS type of 10^12 leaves", _EITHER, b"p/msg/Root", _nested(12)),
        ros("ROS type that contains itself", _EITHER, b"p/msg/A", b"A a\n" + _MEMBERS + b"p/A\nA a\n"),
        ros("ROS array of 2^32", _ANY, b"p/msg/A", b"float64[4294967296] a\nfloat64 b\n"),
        ros("ROS 1 sequence that claims 2^32 - 1", _ANY, b"p/A", b"float64[] a\n", b"\xff" * 8, (b"ros1msg", b"ros1")),
        ros("CDR sequence of structs that claims 2^32 - 1", _ANY, b"p/msg/A", structs, b"\0\1\0\0" + b"\xff" * 8),
        ros("IDL of 500 modules", _ANY, b"p/msg/A", idl, bytes(64), (b"ros2idl", b"cdr")),
        json_("JSON schema of 10^12 leaves", _EITHER, _json_references(12)),
        json_("JSON schema 5000 deep", _EITHER, b'{"properties":{"a":' * 5000 + b"{}" + b"}}" * 5000),
        json_("JSON messages 900 deep, without a schema", _ANY, b"", b'{"a":' * 900 + b"1" + b"}" * 900),
        json_("JSON number of a million digits", _ANY, b"", b'{"a": ' + b"9" * 1_000_000 + b"}"),
        ros("protobuf type of 10^12 leaves", _EITHER, b"p.L0", _descriptors(12, 10), b"", (b"protobuf",) * 2),
        ros("a type name that is a path", _ANY, b"../../../pdhef_msgs/msg/VehicleStateEstimate", b""),
        ros(markup, _ANY, b"std_msgs/msg/Float64", _FLOAT, _CDR, topic=_ODD_NAME),
        _made("one message at time 0", _SOUND, lambda: _times(0)),
        _made("one message at 2^64 - 1", _SOUND, lambda: _times(2**64 - 1)),
        _made("a clock that jumps ten years", _SOUND, lambda: _times(*(_PAST_NS + i * 10**7 for i in range(100)))),
    )


BOMBS = (
    *_chunks(),
    *_declarations(),
    Bomb("a FIFO", partial(_placed, "drive.mcap", os.mkfifo), _NO_LOG),
    Bomb("a device", partial(_placed, "drive.mcap", lambda path: path.symlink_to("/dev/zero")), _NO_LOG),
    Bomb("two links to their own folder", _loops, (1, 2)),
    Bomb("20 GiB of nothing behind a header", partial(_placed, "drive.mcap", _sparse), _EITHER),
    Bomb("metadata.yaml that unfolds to 10^11 names", partial(_metadata, _laughs()), (1, 2)),
    Bomb("metadata.yaml 3000 deep", partial(_metadata, "rosbag2_bagfile_information: " + "[" * 3000), (1, 2)),
    Bomb("database whose messages are an endless view", partial(_database, ENDLESS_VIEW), _EITHER),
    Bomb("database whose rows are 900 MB of nothing each", partial(_database, HUGE_ROWS), _EITHER),
)


def former_cases() -> list[Bomb]:
    """Return the files beside the repository that caused failures of earlier versions, if present."""
    folder = ROOT.parent / "shared" / "torture"
    return [Bomb(p.name, lambda _, p=p: p, _ANY) for p in sorted([*folder.glob("*.mcap"), *folder.glob("*.bag")])]  # type: ignore[misc]


def judge_bomb(bomb: Bomb, folder: Path) -> Verdict:
    """Make a bomb in a folder and inspect it in a separate process."""
    process = measured("inspect", str(bomb.make(folder)), limit_s=3 * LIMIT_S)
    return judge_process(process, bomb.codes, LIMIT_S)
