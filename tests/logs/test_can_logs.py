"""BLF and ASC logs, and signals of DBC files in them. python-can writes files and is an independent reader."""

import struct
import zlib
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import cantools
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from pdhef_logtool import ReadOptions, inspect_log, load_mapping
from pdhef_logtool.logs.can_decoding import Decoder, Frames
from pdhef_logtool.logs.can_logs import open_asc, open_blf, open_candump
from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.resource_limits import DEFAULT_LIMITS
from pdhef_logtool.logs.table_clocks import RELATIVE_NS
from pdhef_logtool.logs.table_file import TableFile, Tables
from pdhef_logtool.mapping import read_signals
from pdhef_logtool.records.errors import LogError, PdhefError
from pdhef_logtool.records.signals import Loss

can = pytest.importorskip("can")

START_NS = 1_714_564_800 * 10**9
HEAD = 'VERSION ""\nNS_ :\nBS_:\nBU_: A\n'
MOTION = """BO_ 291 Motion: 8 A
 SG_ AccelY : 0|16@1- (0.001,0) [0|0] "g" A
 SG_ Speed : 16|16@1+ (0.01,0) [0|0] "km/h" A
"""
#: Parts of a frame in the order of :func:`rows_of`.
PARTS = ("id", "is_extended", "bus", "is_error", "is_remote", "length")


def read(path: Path) -> Tables:
    """Read a file in this process."""
    with path.open("rb") as stream:
        reader = {".blf": open_blf, ".asc": open_asc, ".log": open_candump}[path.suffix]
        return reader(TableFile(stream, path.stat().st_size, path.name, DEFAULT_LIMITS))


def frames_of(tables: Tables) -> Frames:
    """The frames of the topic ``can``."""
    (table,) = tables.tables
    return Frames.of_table(table)


def rows_of(tables: Tables) -> list[tuple[Any, ...]]:
    """Frames as tuples: the parts, then their bytes."""
    frames = frames_of(tables)
    columns = (frames.parts[name].tolist() for name in PARTS)
    return [(*row, bytes(data[: row[-1]])) for row, data in zip(zip(*columns, strict=True), frames.data, strict=True)]


def row_of(message: Any) -> tuple[Any, ...]:
    """The same of a message of python-can."""
    data = bytes(message.data)
    return (
        message.arbitration_id, message.is_extended_id, message.channel, message.is_error_frame,
        message.is_remote_frame, len(data), data,
    )  # fmt: skip


def sent(time_s: float, identifier: int, data: bytes, **more: Any) -> Any:
    """A message of python-can on channel 0."""
    parts = {"channel": 0, "is_extended_id": identifier > 0x7FF, **more}
    return can.Message(timestamp=START_NS / 1e9 + time_s, arbitration_id=identifier, data=data, **parts)


def write(path: Path, messages: Sequence[Any], **more: Any) -> Path:
    """Write messages by python-can."""
    with can.Logger(str(path), **more) as writer:
        for message in messages:
            writer.on_message_received(message)
    return path


@st.composite
def messages(draw: st.DrawFn) -> list[Any]:
    """Frames of all kinds, 1 ms apart."""
    results = []
    for i in range(draw(st.integers(1, 30))):
        kind = draw(st.sampled_from(["classic", "fd", "remote", "error"]))
        extended = draw(st.booleans())
        identifier = draw(st.integers(0, (1 << 29) - 1 if extended else 0x7FF))
        length = draw(st.sampled_from([*range(9), 12, 20, 64] if kind == "fd" else [*range(9)]))
        data = b"" if kind in ("remote", "error") else draw(st.binary(min_size=length, max_size=length))
        flags = {"is_fd": kind == "fd", "is_remote_frame": kind == "remote", "is_error_frame": kind == "error"}
        bus = draw(st.integers(0, 3))
        results.append(sent(i / 1000, identifier, data, is_extended_id=extended, channel=bus, **flags))
    return results


@settings(max_examples=25, deadline=None)
@given(written=messages(), container=st.sampled_from([200, 1000, 100_000]), level=st.sampled_from([0, 6]))
def test_blf_is_read_as_python_can_reads_it(written, container, level, tmp_path_factory):
    path = tmp_path_factory.mktemp("blf") / "a.blf"
    write(path, written, max_container_size=container, compression_level=level)
    tables = read(path)
    assert tables.losses == []
    expected = list(can.BLFReader(str(path)))
    assert sorted(rows_of(tables)) == sorted(map(row_of, expected))
    times = [round(m.timestamp * 1e9) for m in expected]
    np.testing.assert_allclose(frames_of(tables).stamps_ns - START_NS, np.array(times) - START_NS, atol=1000)


@pytest.mark.parametrize("suffix", ["asc", "log"])
@settings(max_examples=25, deadline=None)
@given(written=messages())
def test_text_is_read_as_python_can_wrote_it(written, suffix, tmp_path_factory):
    path = tmp_path_factory.mktemp(suffix) / f"a.{suffix}"
    write(path, written)
    tables = read(path)
    assert tables.losses == []
    assert [r[:2] + r[4:] for r in rows_of(tables) if not r[3]] == [
        r[:2] + r[4:] for r in map(row_of, written) if not r[3]
    ]
    assert [(r[2], r[3]) for r in rows_of(tables)] == [(m.channel, m.is_error_frame) for m in written]
    np.testing.assert_allclose(frames_of(tables).stamps_ns - START_NS, np.arange(len(written)) * 10**6, atol=1000)


def candump(path: Path, *lines: str) -> Tables:
    """Write lines and read them."""
    path.write_text("\n".join([*lines, ""]))
    return read(path)


@pytest.mark.parametrize(
    ("line", "row"),
    [
        (" (1714564800.5)  can1  123   [2]  DE AD   '..'", (0x123, 0, 1, 0, 0, 2, b"\xde\xad")),
        (" (2024-05-01 12:00:00.500000)  can0  RX - -  00000123   [0]  remote request", (0x123, 1, 0, 0, 1, 0, b"")),
        (" (1714564800.5)  vcan0  20000004   [1]  08   ERRORFRAME", (4, 1, 0, 1, 0, 1, b"\x08")),
        ("(1714564800.500000) can3 7FF##3" + "AB" * 12, (0x7FF, 0, 3, 0, 0, 12, b"\xab" * 12)),
    ],
)
def test_forms_of_candump(line, row, tmp_path):
    tables = candump(tmp_path / "a.log", line)
    assert rows_of(tables) == [row]
    assert frames_of(tables).stamps_ns.tolist() == [START_NS + 500 * 10**6]
    assert tables.losses == []


def test_lines_of_candump_that_are_no_frames_are_counted(tmp_path):
    bad = ["(5.0) can0 12#11", "(5.0) can0 123#1", " (5.0)  can0  123   [2]  11"]
    bad += [f"(5.0) can0 123##0{'00' * 65}", "end"]
    tables = candump(tmp_path / "a.log", "(5.0) can0 123#11", "", *bad)
    assert [(loss.kind, loss.count) for loss in tables.losses] == [("bad-row", len(bad))]
    assert "line 3" in tables.losses[0].what
    with pytest.raises(LogError, match="candump -l and candump -t a record times"):
        candump(tmp_path / "b.log", " can0  123   [1]  11")


def test_times_of_candump_may_be_differences_and_frames_recorded_again_are_left_out(tmp_path):
    lines = [f" (000.0{1 + i % 2}0000)  can0  123   [1]  {i:02X}" for i in range(20)]
    tables = candump(tmp_path / "a.log", *lines)
    assert np.ptp(frames_of(tables).stamps_ns) == 29 * 10**7
    assert [loss.severity for loss in tables.losses] == ["note"]
    times = [1.0, 2.0, 3.0, 6.5, 6.4, 9.0, 5.5, 6.0, 9.5]
    tables = candump(tmp_path / "b.log", *(f"({t}) can0 123#{i:02X}" for i, t in enumerate(times)))
    assert [row[-1][0] for row in rows_of(tables)] == [0, 1, 2, 4, 3, 5, 8]
    assert [loss.count for loss in tables.losses] == [2]


def blf_object(kind: int, payload: bytes, time: int, *, unit: int = 2, version: int = 1) -> bytes:
    """One object with its header, and the padding that follows it."""
    head = 32 if version == 1 else 40
    data = struct.pack("<4sHHIIIHHq", b"LOBJ", head, version, head + len(payload), kind, unit, 0, 0, time)
    data += bytes(head - 32) + payload
    return data + bytes(len(data) % 4)


def classic(identifier: int, data: bytes, channel: int = 1) -> bytes:
    """The payload of a classic frame."""
    return struct.pack("<HBBI8s", channel, 0, len(data), identifier, data)


def container(objects: bytes, *, compressed: bool = True, size: int | None = None) -> bytes:
    """A container of objects."""
    stored = zlib.compress(objects) if compressed else objects
    head = struct.pack("<4sHHII", b"LOBJ", 16, 1, 32 + len(stored), 10)
    head += struct.pack("<H6xI4x", 2 * compressed, len(objects) if size is None else size)
    return head + stored + bytes(len(stored) % 4)


def blf(path: Path, *parts: bytes, date: tuple[int, ...] = (2024, 5, 3, 1, 12, 0, 0, 0)) -> Path:
    """A BLF file that began on 2024-05-01, 12:00:00."""
    size = 144 + sum(map(len, parts))
    head = struct.pack("<4sI8xQQII8H", b"LOGG", 144, size, 0, 0, 0, *date)
    path.write_bytes(head.ljust(144, b"\0") + b"".join(parts))
    return path


def numbered(count: int, first: int = 0) -> bytes:
    """Objects of frames 10 ms apart with their number as data."""
    numbers = range(first, first + count)
    return b"".join(blf_object(1, classic(256, struct.pack("<I", i)), i * 10**7) for i in numbers)


def numbers_of(tables: Tables) -> list[int]:
    """The numbers in the data of :func:`numbered` frames."""
    return frames_of(tables).data[:, :4].copy().view("<u4")[:, 0].tolist()


@pytest.mark.parametrize(
    ("objects", "times_ns", "date"),
    [
        ([blf_object(86, classic(256, b"\1"), 10**9 * t) for t in (-5, -1, 0, 3)], [-5e9, -1e9, 0, 3e9], None),
        (
            [
                blf_object(1, classic(256, b"\1"), 200_000, unit=1),
                blf_object(1, classic(257, b"\2"), 3 * 10**9, version=2),
                blf_object(96, bytes(48), 4 * 10**9),  # an event of another kind
            ],
            [2e9, 3e9],
            None,
        ),
        ([numbered(3)], [0, 1e7, 2e7], (0,) * 8),
    ],
    ids=["before the trigger", "units and versions of headers", "without a date"],
)
def test_times_of_a_blf(objects, times_ns, date, tmp_path):
    tables = read(blf(tmp_path / "a.blf", container(b"".join(objects)), **({"date": date} if date else {})))
    assert (frames_of(tables).stamps_ns - (RELATIVE_NS if date else START_NS)).tolist() == times_ns
    assert tables.losses == []


@pytest.mark.parametrize("compressed", [True, False])
def test_damage_costs_its_container_only(compressed, tmp_path):
    stream, size = numbered(300), 1500  # objects that continue in the next container
    parts = [container(stream[i : i + size], compressed=compressed) for i in range(0, len(stream), size)]
    damaged = bytearray(parts[3])
    for place in range(40, 200):
        damaged[place] ^= 0x55
    tables = read(blf(tmp_path / "a.blf", *parts[:3], bytes(damaged), *parts[4:]))
    found = numbers_of(tables)
    assert set(range(300)) - set(found) <= set(range(93, 126))
    assert len(found) >= 300 - size // 48 - 2
    assert [loss.kind for loss in tables.losses] == ["bad-chunk"]
    assert "container at byte" in tables.losses[0].what


@pytest.mark.parametrize(
    ("offset", "value"),
    [(8, bytes(4)), (8, b"\xff" * 4), (0, b"XXXX"), (4, b"\0\0"), (6, b"\7\0")],
    ids=["size-0", "size-4GiB", "signature", "header-0", "version-7"],
)
def test_a_damaged_object_costs_itself(offset, value, tmp_path):
    objects = bytearray(numbered(20))
    place = 48 * 7 + offset
    objects[place : place + len(value)] = value
    tables = read(blf(tmp_path / "a.blf", container(bytes(objects)), container(numbered(5, first=20))))
    assert numbers_of(tables) == [i for i in range(25) if i != 7]
    assert [loss.kind for loss in tables.losses] == ["bad-chunk"]


@pytest.mark.parametrize(
    ("bad", "limits", "kind", "text"),
    [
        ([container(bytes(1 << 20), size=3 << 30)], {}, "over-budget", "budget="),
        ([container(bytes(1 << 20))] * 6, {"table_bytes": 3 << 20}, "over-budget", "table bytes"),
        ([container(numbered(5), size=100)], {}, "bad-chunk", "100 bytes"),
    ],
    ids=["beyond the limits", "together beyond the limits", "larger than it states"],
)
def test_a_container_that_harms_is_a_loss_of_itself(bad, limits, kind, text, tmp_path):
    path = blf(tmp_path / "a.blf", container(numbered(5)), *bad, container(numbered(5, first=5)))
    with path.open("rb") as stream:
        tables = open_blf(TableFile(stream, path.stat().st_size, "a.blf", replace(DEFAULT_LIMITS, **limits)))
    assert numbers_of(tables) == list(range(10))
    assert any(loss.kind == kind and text in loss.what for loss in tables.losses)


@pytest.mark.parametrize("suffix", [".blf", ".asc", ".log"])
def test_mutants_are_read_or_refused_in_one_line(suffix, tmp_path):
    messages = [sent(i / 100, 0x100 + i % 3, bytes(range(i % 9))) for i in range(60)]
    more = {"max_container_size": 700} if suffix == ".blf" else {}
    sound = write(tmp_path / f"a{suffix}", messages, **more).read_bytes()
    random = np.random.default_rng(7)
    readable = 0
    for _ in range(150):
        data = bytearray(sound)
        for _ in range(int(random.integers(1, 6))):
            place = int(random.integers(0, len(data)))
            match random.integers(0, 3):
                case 0:
                    data[place] = int(random.integers(0, 256))
                case 1:
                    data[place : place + 4] = [0, 0, 0, 0] if random.integers(2) else [255] * 4
                case _:
                    del data[place : place + int(random.integers(1, 300))]
        (tmp_path / f"b{suffix}").write_bytes(data)
        try:
            tables = read(tmp_path / f"b{suffix}")
        except PdhefError:
            continue
        readable += len(frames_of(tables).stamps_ns) == len(messages) or bool(tables.losses)
    assert readable > 75


def asc(path: Path, *lines: str, encoding: str = "utf-8") -> Tables:
    """Write lines and read them."""
    path.write_bytes("\r\n".join(lines).encode(encoding) + b"\r\n")
    return read(path)


@pytest.mark.parametrize(
    ("date", "expected_ns"),
    [
        ("Wed May 1 12:00:00 2024", START_NS),
        ("Wed May 01 12:00:00.250 pm 2024", START_NS + 250 * 10**6),
        ("Wed May 1 12:00:00 am 2024", START_NS - 43_200 * 10**9),
        ("Mit Mai 1 12:00:00.250 2024", START_NS + 250 * 10**6),
        ("Die Mär 5 12:00:00 2024", 1_709_640_000 * 10**9),
        ("Die Dez 31 09:00:00.5 pm 2024", 1_735_678_800 * 10**9 + 5 * 10**6),
        ("nobody knows", RELATIVE_NS),
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "cp1252"])
def test_dates_of_an_asc(date, expected_ns, encoding, tmp_path):
    lines = f"date {date}", "base hex  timestamps absolute", "   0.010000 1  100  Rx   d 2 01 02"
    tables = asc(tmp_path / "a.asc", *lines, encoding=encoding)
    assert frames_of(tables).stamps_ns.tolist() == [expected_ns + 10**7]


def test_relative_times_of_an_asc_are_summed_over_all_lines(tmp_path):
    tables = asc(
        tmp_path / "a.asc",
        "date Wed May 1 12:00:00 2024",
        "base dec  timestamps relative",
        "no internal events logged",
        "// version 9.0.0",
        "Begin Triggerblock Wed May 1 12:00:00 2024",
        "   0.000000 Start of measurement",
        "   0.500000 1  291  Rx   d 2 10 255  Length = 0 BitCount = 0 ID = 291",
        "   0.250000 1  Statistic: D 0 R 0 XD 0 XR 0 E 0 O 0 B 0.00%",
        "   0.250000 2  419434496x  Tx   d 1 7",
        "End TriggerBlock",
    )
    assert ((frames_of(tables).stamps_ns - START_NS) / 1e9).tolist() == [0.5, 1.0]
    assert rows_of(tables) == [
        (291, False, 0, False, False, 2, bytes([10, 255])),
        (419434496, True, 1, False, False, 1, b"\7"),
    ]
    assert tables.losses == []


def test_lines_of_an_asc_that_are_no_frames(tmp_path):
    tables = asc(
        tmp_path / "a.asc",
        "base hex timestamps absolute",
        " 0.1 1 100 Rx d 1 01",
        " 0.2 1 100 TxRq d 1 01",  # a request: the frame itself follows
        " 0.3 CANFD 1 Rx 101 Name 1 0 9 12 01 02 03 04 05 06 07 08 09 0a 0b 0c 0 0 0",
        " 0.4 J1939TP FEE3p 6 0 0 - Rx d 23 A0 0F",
        " 0.5 1 ErrorFrame",
        " 0.6 1 100x Rx r",
        " 0.7 1 STEER Rx d 2 01 02",
        " 0.8 1 100 Rx d 8 01 02 03",
        " 0.9 1 100 Rx d 1 1ff",
    )
    found = rows_of(tables)
    assert [row[0] for row in found] == [0x100, 0x101, 0, 0x100]
    assert [row[5] for row in found] == [1, 12, 0, 0]
    (loss,) = tables.losses
    assert (loss.kind, loss.count, loss.severity) == ("bad-row", 3, "lost")
    assert "line 8" in loss.what
    assert "STEER" in loss.what


def measurement(date: str, first_s: float, *, count: int = 3) -> list[str]:
    """A block of frames 0.1 s apart."""
    frames = [f" {first_s + i / 10:.4f} 1 100 Rx d 1 0{i}" for i in range(count)]
    return [f"Begin Triggerblock {date}", *frames, "End TriggerBlock"]


def test_measurements_of_an_asc_follow_their_dates(tmp_path):
    head = "date Wed May 1 12:00:00 2024", "base hex timestamps absolute"
    first = measurement("Wed May 1 12:00:00 2024", 0.0)
    restarted = asc(tmp_path / "a.asc", *head, *first, *measurement("Wed May 1 12:01:00 2024", 0.0))
    goes_on = asc(tmp_path / "a.asc", *head, *first, *measurement("Wed May 1 12:01:00 2024", 60.0))
    for tables in (restarted, goes_on):
        seconds = (frames_of(tables).stamps_ns - START_NS) / 1e9
        np.testing.assert_allclose(seconds, [0.0, 0.1, 0.2, 60.0, 60.1, 60.2])
        assert tables.losses == []


def test_a_measurement_that_begins_before_the_end_of_another_is_a_loss(tmp_path):
    first = ["base hex timestamps absolute", *measurement("", 0.0, count=9), " 5.0 1 100 Rx d 0"]
    for second in (measurement("", 0.05), measurement("", 0.0)[1:]):
        tables = asc(tmp_path / "a.asc", *first, *second)
        assert len(frames_of(tables).stamps_ns) == 10
        assert [(loss.kind, loss.count) for loss in tables.losses] == [("out-of-order", 3)]


def decoded(
    frames: Sequence[tuple[int, bytes]] | Frames, *dbcs: str
) -> tuple[dict[str, Any], list[Loss], dict[Any, Any]]:
    """Tables of frames 10 ms apart by name, losses, and losses of columns."""
    if not isinstance(frames, Frames):
        frames = made([(0, *frame) for frame in frames])
    databases = [
        (f"{i}.dbc", cantools.database.load_string(HEAD + dbc, "dbc", strict=False)) for i, dbc in enumerate(dbcs)
    ]
    lost: list[Loss] = []
    columns: dict[tuple[str, str], list[Loss]] = {}
    tables: dict[str, Any] = {}
    for table in Decoder(frames, databases, tables, lost, columns).tables():
        tables[table.name] = table
    return tables, lost, columns


def made(rows: Sequence[tuple[int, int, bytes]]) -> Frames:
    """Frames of bus, identifier and data."""
    bus, ids, data = zip(*rows, strict=True)
    width = max(map(len, data))
    content = np.frombuffer(b"".join(d.ljust(width, b"\0") for d in data), np.uint8).reshape(-1, width)
    parts = {"id": np.array(ids), "bus": np.array(bus), "length": np.array([len(d) for d in data])}
    return Frames(START_NS + np.arange(len(rows)) * 10**7, parts, content)


def column(table: Any, path: str) -> list[float]:
    """A column as a whole."""
    return table.load(path, slice(0, len(table.stamps_ns))).tolist()


def test_the_same_identifiers_on_two_buses_are_two_tables():
    rows = [(bus, 291, struct.pack("<hH4x", 100 * bus + i, 0)) for i in range(5) for bus in (1, 0)]
    tables, lost, _ = decoded(made(rows), MOTION)
    assert [*tables] == ["Motion", "Motion#bus1"]
    assert column(tables["Motion"], "AccelY") == pytest.approx([0.001 * i for i in range(5)])
    assert column(tables["Motion#bus1"], "AccelY") == pytest.approx([0.1 + 0.001 * i for i in range(5)])
    assert lost == []


def j1939(identifier: int, signals: str = ' SG_ Speed : 0|16@1+ (0.01,0) [0|0] "km/h" A\n') -> str:
    """A DBC of one message with an identifier of 29 bits."""
    return f"BO_ {identifier | 1 << 31} Group: 8 A\n{signals}"


@pytest.mark.parametrize(
    ("stated", "sent_as", "matches"),
    [
        (0x18FEF1FE, 0x18FEF127, True),  # source address
        (0x18FEF1FE, 0x0CFEF1FE, True),  # priority
        (0x18FEF1FE, 0x18FEF227, False),
        (0x18FEF1FE, 0x19FEF127, False),  # data page
        (0x18EF00FE, 0x18EF2142, True),  # the destination of PDU 1 is no part of its group
        (0x18EF00FE, 0x18EE2142, False),
        (0x18FEF100, 0x18FEF127, True),  # no null address: a broadcast
        (0x17330B10, 0x17330B11, False),  # no null address, and no broadcast: another message
    ],
)
def test_messages_of_j1939_are_identified_by_their_group(stated, sent_as, matches):
    tables, lost, _ = decoded([(sent_as, bytes([i, 0, 0, 0, 0, 0, 0, 0])) for i in range(4)], j1939(stated))
    assert [*tables] == (["Group"] if matches else [])
    assert [(loss.kind, loss.severity) for loss in lost] == ([] if matches else [("unknown-frame", "note")])


def test_the_frame_format_of_a_dbc_states_j1939():
    dbc = j1939(0x18EF0003) + (
        'BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";\n'
        'BA_DEF_DEF_ "VFrameFormat" "StandardCAN";\n'
        f'BA_ "VFrameFormat" BO_ {0x18EF0003 | 1 << 31} 3;\n'
    )
    tables, _, _ = decoded([(0x18EF2142, bytes(8))], dbc)
    assert [*tables] == ["Group"]


def test_each_source_address_has_a_table():
    rows = [(0x18FEF121, b"\1"), (0x18FEF10B, b"\2"), (0x0CFEF10B, b"\3"), (0x18FEF10B, b"\4")]
    tables, _, _ = decoded([(i, d.ljust(8, b"\0")) for i, d in rows], j1939(0x18FEF1FE))
    values = {name: column(table, "Speed") for name, table in tables.items()}
    assert values == {"Group": pytest.approx([0.02, 0.03, 0.04]), "Group#sa21": pytest.approx([0.01])}


def test_raw_values_without_a_meaning_are_not_available():
    signals = (
        ' SG_ Speed : 0|16@1+ (0.01,0) [0|0] "km/h" A\n SG_ Switch : 16|2@1+ (1,0) [0|0] "" A\n'
        ' SG_ Accel : 32|16@1- (0.001,0) [0|0] "g" A\n'
    )
    raw = [0x1234, 0xFAFF, 0xFE00, 0xFFFF]
    frames = [(0x18FEF100, struct.pack("<HBxH2x", r, s, 0xFFFF)) for r, s in zip(raw, (0, 1, 2, 3), strict=True)]
    tables, lost, columns = decoded(frames, j1939(0x18FEF1FE, signals))
    np.testing.assert_allclose(column(tables["Group"], "Speed"), [46.6, 642.55, np.nan, np.nan])
    np.testing.assert_allclose(column(tables["Group"], "Switch"), [0, 1, 2, np.nan])
    np.testing.assert_allclose(column(tables["Group"], "Accel"), [-0.001] * 4)  # a signed signal has no such values
    assert lost == []
    (note,) = columns["Group", "Speed"]
    assert (note.kind, note.count, note.severity) == ("not-available", 2, "note")
    standard, _, _ = decoded([(291, struct.pack("<hH4x", 0, 0xFFFF))], MOTION)
    assert column(standard["Motion"], "Speed") == [655.35]


def test_named_raw_values_of_a_dbc_are_not_available():
    dbc = MOTION + 'VAL_ 291 Speed 65535 "SNA" 65534 "Signal_Error" 0 "No_Error" ;\n'
    tables, _, columns = decoded([(291, struct.pack("<hH4x", 0, s)) for s in (65535, 65534, 0, 500)], dbc)
    np.testing.assert_allclose(column(tables["Motion"], "Speed"), [np.nan, np.nan, 0, 5])
    assert [x.count for x in columns["Motion", "Speed"]] == [2]


def test_values_outside_of_the_range_of_the_dbc_are_lost():
    dbc = MOTION.replace("(0.01,0) [0|0]", "(0.01,0) [0|250]")
    raw = [100, 0xFFFF, 25_000, 25_001, 200, 0xFFFF]
    tables, _, columns = decoded([(291, struct.pack("<hH4x", 0, r)) for r in raw], dbc)
    np.testing.assert_allclose(column(tables["Motion"], "Speed"), [1, np.nan, 250, np.nan, 2, np.nan])
    (loss,) = columns["Motion", "Speed"]
    assert (loss.kind, loss.count, loss.severity) == ("out-of-range", 3, "lost")
    assert "[0|250]" in loss.what
    assert "655.35" in loss.what


def test_a_range_that_the_signal_does_not_keep_is_ignored():
    dbc = MOTION.replace("(0.01,0) [0|0]", "(0.01,0) [0|1]")
    tables, _, columns = decoded([(291, struct.pack("<hH4x", 0, 10 * r)) for r in range(200)], dbc)
    assert np.isfinite(column(tables["Motion"], "Speed")).all()
    assert [(loss.kind, loss.severity) for loss in columns["Motion", "Speed"]] == [("out-of-range", "note")]


def test_short_frames_give_the_signals_that_they_contain():
    frames = [(291, struct.pack("<h", i)) for i in range(4)]
    tables, lost, _ = decoded(frames, MOTION)
    assert [f.path for f in tables["Motion"].fields] == ["AccelY"]
    assert column(tables["Motion"], "AccelY") == pytest.approx([0, 0.001, 0.002, 0.003])
    (loss,) = lost
    assert (loss.kind, loss.where, loss.count, loss.severity) == ("undecodable", "Motion", 4, "lost")
    assert "Speed" in loss.what
    assert "2 bytes" in loss.what
    mixed, lost, columns = decoded([*frames, (291, struct.pack("<hH", 9, 700))], MOTION)
    np.testing.assert_allclose(column(mixed["Motion"], "Speed"), [np.nan] * 4 + [7])
    assert [loss.count for loss in lost] == [4]
    assert columns == {("Motion", "Speed"): []}


def test_frames_that_all_end_before_their_multiplexer_are_a_loss():
    dbc = 'BO_ 291 Pages: 4 A\n SG_ Page M : 24|8@1+ (1,0) [0|0] "" A\n SG_ X m0 : 0|8@1+ (1,0) [0|0] "" A\n'
    tables, lost, _ = decoded([(291, bytes(2))], dbc)
    assert tables == {}
    assert [(loss.kind, loss.count) for loss in lost] == [("undecodable", 1)]


def test_frames_of_no_database_are_named():
    frames = [(291, bytes(8)), *((0x300 + i, bytes(8)) for i in range(7))]
    tables, lost, _ = decoded(frames, MOTION)
    assert [*tables] == ["Motion"]
    assert [(x.kind, x.count, x.severity) for x in lost] == [("unknown-frame", 7, "note")]
    assert lost[0].what.startswith("7 frames, no identifier of 0.dbc: 0x300, 0x301")


def test_multiplexed_signals_have_a_table_for_each_selector():
    dbc = """BO_ 5 Mux: 2 A
 SG_ Sel M : 0|8@1+ (1,0) [0|0] "" A
 SG_ First m0 : 8|8@1+ (1,0) [0|0] "deg" A
 SG_ Second m1 : 8|8@1+ (2,0) [0|0] "km/h" A
"""
    frames = [(5, bytes([i % 2, i])) for i in range(40)] + [(5, b"")]
    tables, lost, _ = decoded(frames, dbc)
    assert {name: len(t.stamps_ns) for name, t in tables.items()} == {"Mux": 41, "Mux_Sel_0": 20, "Mux_Sel_1": 20}
    assert column(tables["Mux_Sel_0"], "First") == list(range(0, 40, 2))
    assert column(tables["Mux_Sel_1"], "Second") == [2 * i for i in range(1, 40, 2)]
    assert [loss.where for loss in lost] == ["Mux"]


STEERING = MOTION.replace("291 Motion", "292 Steering").replace("AccelY", "Angle").replace('"g"', '"deg"')


@pytest.fixture(params=[".blf", ".asc", ".log", ".mf4"])
def drive(request, tmp_path):
    """A log of Motion and Steering frames on bus 1, with others between them."""
    if request.param == ".mf4":
        pytest.importorskip("asammdf")
    messages = []
    for i in range(300):
        frames = (291, struct.pack("<hH4x", i, 7000 + i)), (0x1ABCDEF, b"\1\2\3"), (292, struct.pack("<hH4x", -i, 0))
        messages += [sent(i / 100 + k / 1000, *frame, channel=1) for k, frame in enumerate(frames)]
    return write(tmp_path / f"a{request.param}", messages)


def kinds_of(log: DriveLog) -> list[str]:
    """What is lost and noted, but for the start of an MDF without a time zone."""
    return [loss.kind for loss in log.lost if loss.kind != "no-clock"]


def test_a_log_is_decoded_by_its_mapping_or_by_given_databases(drive, tmp_path):
    (tmp_path / "dbc").mkdir()
    (tmp_path / "dbc/car.dbc").write_text(HEAD + MOTION)
    (tmp_path / "dbc/steering.dbc").write_text(HEAD + STEERING)
    (tmp_path / "m.toml").write_text(
        '[can]\ndbc = ["dbc/car.dbc"]\n[signals.ay_m_s2]\ntopic = "can"\nfield = "can:Motion.AccelY"\nscale = 9.80665\n'
    )
    with closing(open_log(drive)) as log:
        assert [(t.name, t.messages) for t in log.topics] == [("can", 900)]
        found = read_signals(log, load_mapping(tmp_path / "m.toml"), {}, log.start_ns, log.end_ns)
        assert kinds_of(log) == []
    with closing(open_log(drive, msgs=tmp_path / "dbc")) as log:
        assert [(t.name, t.messages) for t in log.topics] == [("can", 900), ("Motion", 300), ("Steering", 300)]
        assert {f.path: f.unit for f in log.fields("Motion")} == {"AccelY": "g", "Speed": "km/h"}
        values = log.read({"Motion": ["AccelY"], "Steering": ["Angle"]})
        assert kinds_of(log) == ["unknown-frame"]
    resolution_ns = 200_000 if drive.suffix == ".mf4" else 1000
    for name, path, factor in (("Motion", "AccelY", 1e-3), ("Steering", "Angle", -1e-3)):
        read, late_ns = values[name], 2 * 10**6 * (name == "Steering")
        np.testing.assert_allclose(read.fields[path], np.arange(300) * factor, atol=1e-12)
        np.testing.assert_allclose(
            read.log_time_ns - START_NS, np.arange(300) * 10**7 + late_ns, rtol=0.0, atol=resolution_ns
        )
    np.testing.assert_allclose(found.signals["ay_m_s2"].values, np.arange(300) * 9.80665e-3, atol=1e-9)


def test_a_mapping_of_frames_names_the_bus_where_several_send_a_message(tmp_path):
    path = write(tmp_path / "a.blf", [sent(i / 100, 291, bytes([i % 2] * 3), channel=i % 2) for i in range(100)])
    (tmp_path / "car.dbc").write_text(HEAD + MOTION)
    signal = '[signals.ay_m_s2]\ntopic = "can"\nfield = "can:Motion.AccelY"\n'
    read = {}
    for bus in (None, 0, 1):
        which = "" if bus is None else f'bus_field = "bus"\nbus = {bus}\n'
        (tmp_path / "m.toml").write_text(f'[can]\ndbc = "car.dbc"\n{which}{signal}')
        with closing(open_log(path)) as log:
            if bus is None:
                with pytest.raises(PdhefError, match=r"Motion is on buses \[0, 1\]"):
                    read_signals(log, load_mapping(tmp_path / "m.toml"), {}, log.start_ns, log.end_ns)
            else:
                found = read_signals(log, load_mapping(tmp_path / "m.toml"), {}, log.start_ns, log.end_ns)
                read[bus] = set(found.signals["ay_m_s2"].values.tolist())
                assert len(found.signals["ay_m_s2"].values) == 50  # the frames are shorter than the message
    assert {bus: round(max(values), 9) for bus, values in read.items()} == {0: 0.0, 1: 0.257}


def test_a_dbc_that_matches_nothing_is_named(tmp_path):
    path = write(tmp_path / "a.blf", [sent(i / 100, 300, bytes(8)) for i in range(100)])
    (tmp_path / "car.dbc").write_text(HEAD + MOTION)
    notes = " ".join(map(str, inspect_log(path, options=ReadOptions(msgs=tmp_path / "car.dbc")).to_dict()["notes"]))
    assert "car.dbc contains none of their identifiers" in notes
    assert "--set msgs" not in notes


def test_an_object_that_covers_others_costs_itself(tmp_path):
    marker = bytearray(blf_object(96, bytes(48), 0))
    marker[8:12] = struct.pack("<I", 1001)
    parts = [bytearray(container(numbered(5, first=i))) for i in range(40, 60, 5)]
    parts[1][8:12] = struct.pack("<I", len(parts[1]) + 50)
    objects = numbered(5) + bytes(marker) + numbered(35, first=5)
    tables = read(blf(tmp_path / "a.blf", container(objects), *map(bytes, parts)))
    assert set(range(60)) - set(numbers_of(tables)) <= set(range(45, 50))
    assert {loss.kind for loss in tables.losses} == {"bad-chunk"}


def test_a_cut_blf_is_read_as_far_as_it_goes(tmp_path):
    path = write(
        tmp_path / "a.blf", [sent(i / 100, 256, struct.pack("<I", i)) for i in range(600)], max_container_size=2000
    )
    data = path.read_bytes()
    (tmp_path / "b.blf").write_bytes(data[: len(data) // 2])
    tables = read(tmp_path / "b.blf")
    found = numbers_of(tables)
    assert found == list(range(len(found)))
    assert 200 < len(found) < 400
    assert [loss.kind for loss in tables.losses] == ["truncated"]


def test_many_damaged_places_are_counted(tmp_path):
    bad = container(numbered(1))[:32] + b"no zlib!"
    parts = [bad[:8] + struct.pack("<I", len(bad)) + bad[12:]] * 50
    tables = read(blf(tmp_path / "a.blf", container(numbered(5)), *parts))
    assert numbers_of(tables) == list(range(5))
    assert len(tables.losses) < 30
    assert sum(loss.count or 1 for loss in tables.losses) == 50
