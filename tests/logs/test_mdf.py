"""MDF 3 and 4: conversions, invalid samples, times, frames of newer loggers, damaged and hostile files."""

import datetime as dt
import gc
import struct
import tempfile
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray

from pdhef_logtool.logs.mdf_conversions import conversion_rule, formula_rule
from pdhef_logtool.logs.mdf_log import open_mdf
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.resource_limits import DEFAULT_LIMITS
from pdhef_logtool.records.errors import LogError
from tests.command_line import called
from tests.table_contents import opened, parsed

asammdf = pytest.importorskip("asammdf")
from asammdf.blocks import v2_v3_blocks, v4_blocks  # noqa: E402

N = 300
TIME_S = np.arange(N) * 0.01
AY = 0.3 * np.sin(2.0 * TIME_S)
SPEED = 70.0 + TIME_S
START_NS = 1_714_564_800 * 10**9
START = dt.datetime.fromtimestamp(START_NS // 10**9, tz=dt.UTC)


read_mdf = partial(parsed, open_mdf)


def written(path: Path, signals: Sequence[Any], version: str = "4.10", start: dt.datetime = START) -> Path:
    with asammdf.MDF(version=version) as file:
        file.start_time = start
        file.append(signals, comment="car", common_timebase=True)
        return Path(file.save(path, overwrite=True))


def signal(name: str, values: NDArray[Any], **more: Any) -> Any:
    return asammdf.Signal(values, TIME_S[: len(values)], name=name, **more)


# ---- files block by block ----


@dataclass
class Ch:
    """A channel of :func:`mdf4`: kind and sync as in the standard, data type (0: integer, 4: float, 10: bytes)."""

    name: str
    offset: int = 0
    bits: int = 64
    kind: int = 0
    sync: int = 0
    data_type: int = 4
    flags: int = 0
    invalid_bit: int = 0
    linear: tuple[float, float] | None = None
    stored: bytes = b""


def mdf4(
    channels: Sequence[Ch], records: bytes, rows: int, size: int, invalid_bytes: int = 0, packed: tuple[int, ...] = ()
) -> bytes:
    """Return an MDF 4.10 as recorders write it: one group IMU, data in the last block.

    ``packed`` : size that a compressed block claims.
    """
    about = b"<FHcomment><TX>x</TX><tool_id>x</tool_id><tool_vendor>x</tool_vendor></FHcomment>\0"
    blocks: dict[str, tuple[list[str], bytes]] = {
        "HD": (["DG", "FH", "", "", "", ""], struct.pack("<QhhB", START_NS, 0, 0, 0) + bytes(19)),
        "FH": (["", "MD"], struct.pack("<QhhB", START_NS, 0, 0, 0) + bytes(3)),
        "MD": ([], about),
        "DG": (["", "CG", "DZ" if packed else "DT", ""], bytes(8)),
        "CG": (["", "CN0", "TX", "", "", ""], struct.pack("<QQHHIII", 0, rows, 0, 0, 0, size, invalid_bytes)),
        "TX": ([], b"IMU\0"),
    }
    for i, c in enumerate(channels):
        blocks[f"TX{i}"] = [], f"{c.name}\0".encode()
        if c.linear:
            blocks[f"CC{i}"] = ["", "", "", ""], struct.pack("<BBHHHdddd", 1, 0, 0, 0, 2, 0.0, 0.0, *c.linear)
        if c.stored:
            blocks[f"SD{i}"] = [], c.stored
        links = [f"CN{i + 1}", "", f"TX{i}", "", f"CC{i}", f"SD{i}", "", ""]
        numbers = c.kind, c.sync, c.data_type, 0, c.offset, c.bits, c.flags, c.invalid_bit, 0, 0, *[0.0] * 6
        blocks[f"CN{i}"] = links, struct.pack("<BBBBIIIIBxHdddddd", *numbers)
    if packed:
        data = zlib.compress(records)
        blocks["DZ"] = [], struct.pack("<2sBBIQQ", b"DT", 0, 0, 0, packed[0], len(data)) + data
    else:
        blocks["DT"] = [], records
    return assembled(blocks)


def assembled(blocks: Mapping[str, tuple[list[str], bytes]], version: int = 410) -> bytes:
    """Return a file of blocks: their links, by name, and data; a name begins with the identifier of its block."""
    at: dict[str, int] = {}
    for _ in range(2):  # the first pass finds the addresses
        first = f"MDF     {version / 100:.2f}    test".encode().ljust(28, b"\0") + struct.pack("<H", version)
        out = bytearray(first.ljust(64, b"\0"))
        for name, (links, data) in blocks.items():
            at[name] = len(out)
            head = struct.pack("<4s4xQQ", f"##{name[:2]}".encode(), 24 + 8 * len(links) + len(data), len(links))
            out += head + struct.pack(f"<{len(links)}Q", *(at.get(n, 0) for n in links)) + data
            out += bytes(-len(out) % 8)
    return bytes(out)


TIME = Ch("time", kind=2, sync=1)


def imu(rows: int = N, offset: int = 8, **more: Any) -> bytes:
    samples = np.zeros(rows, [("t", "<f8"), ("a", "<f8")])
    samples["t"], samples["a"] = TIME_S[:rows], AY[:rows]
    return mdf4([TIME, Ch("AccY", offset)], samples.tobytes(), rows, 16, **more)


def block(data: bytes, kind: bytes, number: int = 0) -> int:
    """Return the address of the n-th block of a kind."""
    return [i for i in range(0, len(data), 8) if data[i : i + 4] == b"##" + kind][number]


def patched(data: bytes, at: int, value: int) -> bytes:
    return data[:at] + struct.pack("<Q", value) + data[at + 8 :]


# ---- groups, windows, cut files ----


def mdf(path: Path, version: str = "4.10") -> Path:
    """Write two channel groups with separate clocks."""
    with asammdf.MDF(version=version) as file:
        file.start_time = START
        file.append(
            [signal("IMU.AccY", AY, unit="g"), signal("IMU.AccX", AY, unit="g")],
            comment="IMU 100 Hz", common_timebase=True,
        )  # fmt: skip
        speed = asammdf.Signal(SPEED[::10].astype(np.float32), TIME_S[::10], name="Speed\\XCP:1", unit="km/h")
        file.append([speed])
        return Path(file.save(path, overwrite=True))


@pytest.mark.parametrize("version", ["4.10", "4.11", "3.30"])
def test_channel_groups_keep_their_clocks_and_units(version, tmp_path):
    read = opened(mdf(tmp_path / "a.mf4", version))
    assert (read.kind, sorted(read.topics.values()), read.lost) == (f"mdf-{version[0]}", [N // 10, N], ())
    assert read.units == {"IMU_AccY": "g", "IMU_AccX": "g", "Speed": "km/h"}
    np.testing.assert_array_equal(read.columns["IMU_AccY"], AY)
    np.testing.assert_array_equal(read.columns["Speed"], SPEED[::10].astype(np.float32))
    other, imu = sorted(read.stamps_ns.values(), key=len)
    assert np.abs(np.diff(imu) - 10_000_000).max() <= 1
    assert imu[0] == other[0] == START_NS


def test_a_file_that_ends_within_its_data_is_read_so_far(tmp_path):
    whole, cut = opened(tmp_path / "a.mf4", imu()), opened(tmp_path / "b.mf4", imu()[: -16 * 100 - 5])
    assert whole.lost == ()
    np.testing.assert_array_equal(whole.columns["AccY"], AY)
    rows, (loss,) = len(cut.columns["AccY"]), cut.lost
    assert (loss.kind, loss.severity, loss.count) == ("truncated", "lost", N - rows)
    np.testing.assert_array_equal(cut.columns["AccY"], AY[:rows])
    assert N - 102 <= rows <= N - 100
    assert called("inspect", tmp_path / "b.mf4").returncode == 3


def test_links_beyond_the_end_are_a_loss(tmp_path):
    data = imu()
    read = read_mdf(patched(data, block(data, b"CN", 0) + 24, len(data) + 64))
    assert "1 blocks are beyond the end of the file" in read.what()


# ---- conversions ----


def block_of(version: int, kind: int, **parameters: Any) -> Any:
    of = v2_v3_blocks if version == 3 else v4_blocks
    return of.ChannelConversion(conversion_type=kind, **parameters)


P = {f"P{i}": value for i, value in enumerate((0.5, -2.0, 3.0, 0.25, 1.0, 7.0, 1.5), 1)}
PAIRS = {"raw_0": 10.0, "phys_0": 1.0, "raw_1": 0.0, "phys_1": 5.0, "raw_2": 20.0, "phys_2": -3.0}
ORACLES: Mapping[tuple[int, int], tuple[dict[str, Any], Callable[[float], float]]] = {
    (4, 0): ({}, lambda x: x),
    (4, 1): ({"a": 0.5, "b": -3.0}, lambda x: 0.5 * x - 3.0),
    (3, 0): ({"a": 0.5, "b": -3.0}, lambda x: 0.5 * x - 3.0),
    (3, 65535): ({}, lambda x: x),
    (4, 2): (P, lambda x: (0.5 * x**2 - 2.0 * x + 3.0) / (0.25 * x**2 + x + 7.0)),
    (3, 9): (P, lambda x: (0.5 * x**2 - 2.0 * x + 3.0) / (0.25 * x**2 + x + 7.0)),
    (3, 6): (P, lambda x: (-2.0 - 0.25 * (x - 8.0)) / (3.0 * (x - 8.0) - 0.5)),
    (4, 3): ({"formula": "2*X1^2-X1/4+sin(X1)"}, lambda x: 2.0 * x**2 - x / 4.0 + np.sin(x)),
    (3, 10): ({"formula": "2*X1^2-X1/4+sin(X1)"}, lambda x: 2.0 * x**2 - x / 4.0 + np.sin(x)),
    (4, 4): ({**PAIRS, "val_param_nr": 6}, lambda x: np.interp(x, [0, 10, 20], [5, 1, -3])),
    (3, 1): ({**PAIRS, "ref_param_nr": 3}, lambda x: np.interp(x, [0, 10, 20], [5, 1, -3])),
    (4, 5): ({**PAIRS, "val_param_nr": 6}, lambda x: 5.0 if x <= 5 else 1.0 if x <= 15 else -3.0),
    (3, 2): ({**PAIRS, "ref_param_nr": 3}, lambda x: 5.0 if x <= 5 else 1.0 if x <= 15 else -3.0),
    (4, 6): (
        {"val_param_nr": 4, "lower_0": 2.0, "upper_0": 4.0, "phys_0": 0.5, "default": -9.0},
        lambda x: 0.5 if 2.0 <= x < 4.0 else -9.0,
    ),
}


@pytest.mark.parametrize(("version", "kind"), ORACLES)
@settings(max_examples=20, deadline=None)
@given(raw=st.lists(st.floats(-100.0, 100.0), min_size=1))
def test_a_conversion_is_that_of_the_standard(version, kind, raw):
    parameters, oracle = ORACLES[version, kind]
    rule = conversion_rule(block_of(version, kind, **parameters), version)
    with np.errstate(all="ignore"):
        expected = [oracle(np.float64(x)) for x in raw]
    np.testing.assert_allclose(rule(np.asarray(raw)), expected, rtol=1e-9, atol=1e-9)


def test_numbers_with_texts_stay_numbers_and_texts_among_scaled_numbers_are_missing():
    texts = {"ref_param_nr": 3, "val_0": 0, "text_0": b"off", "val_1": 1, "text_1": b"on"}
    raw = np.asarray([0, 1, 200])
    assert conversion_rule(block_of(4, 7, **texts, default_addr=b""), 4)(raw).tolist() == [0, 1, 200]
    linear = block_of(4, 1, a=0.01, b=-1.0)
    scaled = conversion_rule(block_of(4, 7, **texts, default_addr=linear), 4)(raw)
    np.testing.assert_allclose(scaled, [np.nan, np.nan, 1.0])
    ranges = {"ref_param_nr": 2, "lower_0": 254, "upper_0": 255, "text_0": b"not available", "default_addr": linear}
    of_ranges = conversion_rule(block_of(4, 8, **ranges), 4)
    np.testing.assert_allclose(of_ranges(np.asarray([100, 254, 255])), [0, np.nan, np.nan])
    old = {"ref_param_nr": 2, "lower_0": 254, "upper_0": 255, "text_0": b"x", "default_addr": b'"0.01*{X}+-1"'}
    np.testing.assert_allclose(conversion_rule(block_of(3, 12, **old), 3)(np.asarray([100, 255])), [0, np.nan])


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os').system('true')", "().__class__", "X.real", "X if X else 1", "[X]", "lambda: X", "Y", "'a'*X",
        "open(X)", "exp(X, X)", "exp(x=X)", "X1 and 1", "X << 2", "X*" * 260 + "X", "-" * 90 + "X", "9e999999", "",
        "X := 3", "f'{X}'", "1" * 400 + "*X", "1j*X", "pow(X)",
    ],
)  # fmt: skip
def test_a_formula_that_is_no_arithmetic_is_refused_unless_it_is_a_number(text):
    if text == "9e999999":
        assert np.isinf(formula_rule(text)(np.zeros(2))).all()
        return
    with pytest.raises(ValueError, match="its formula"):
        formula_rule(text)


@pytest.mark.parametrize("version", ["4.10", "3.30"])
def test_a_formula_of_a_file_runs_nothing(version, tmp_path):
    canary = tmp_path / "canary"
    hostile = {"formula": f"__import__('pathlib').Path('{canary}').touch() or X"}
    ours = [signal("bad", AY, conversion=hostile), signal("good", AY, conversion={"formula": "2*X+1"})]
    path = written(tmp_path / "a.mf4", ours, version)
    read = read_mdf(path)
    np.testing.assert_allclose(read.columns["good"], 2.0 * AY + 1.0)
    assert set(read.columns) == {"good"}
    assert "bad cannot be read: its formula" in read.what()
    assert called("inspect", path).returncode == 3
    assert not canary.exists()


@pytest.mark.parametrize("version", ["4.10", "3.30"])
def test_conversions_of_a_file_are_applied(version, tmp_path):
    raw = np.arange(N, dtype=np.int16)
    texts = {"val_0": 0, "text_0": b"P", "val_1": 1, "text_1": b"R", "default_addr": b"?"}
    ours = [
        signal("lin", raw, conversion={"a": 0.5, "b": 1.0}, unit="g"),
        signal("gear", raw % 3, conversion=texts),
        signal("tab", raw, conversion={"raw_0": 0, "phys_0": 0, "raw_1": 300, "phys_1": 3, "interpolation": True}),
        signal("text", np.asarray([b"a"] * N), encoding="utf-8"),
    ]  # fmt: skip
    read = read_mdf(written(tmp_path / "a.mf4", ours, version))
    assert read.units["lin"] == "g"
    np.testing.assert_allclose(read.columns["lin"], raw * 0.5 + 1.0)
    np.testing.assert_allclose(read.columns["gear"], raw % 3)
    np.testing.assert_allclose(read.columns["tab"], raw / 100.0)
    assert "no columns of numbers: text" in read.what("note")
    assert "text" not in read.columns


# ---- invalid samples ----


@pytest.mark.parametrize(("low", "high"), [(None, None), (0.5, 2.0), (1.0, 1.2)])
def test_invalid_samples_are_missing_at_their_own_times(low, high, tmp_path):
    invalid = np.arange(N) % 10 == 3
    path = written(tmp_path / "a.mf4", [signal("ay", AY, invalidation_bits=invalid), signal("v", SPEED)])
    window = (None, None) if low is None or high is None else (START_NS + int(low * 1e9), START_NS + int(high * 1e9))
    with closing(open_log(path)) as log:
        read = log.read({"car": ["ay", "v"]}, *window)["car"]
        assert log.lost == ()
    rows = np.round((read.log_time_ns - START_NS) / 1e7).astype(int)
    np.testing.assert_array_equal(read.fields["ay"], np.where(invalid, np.nan, AY)[rows])
    np.testing.assert_array_equal(read.fields["v"], SPEED[rows])


# ---- times ----


@pytest.fixture(params=["UTC", "Asia/Tokyo"])
def time_zone(request):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TZ", request.param)
        time.tzset()
        yield request.param
    time.tzset()


@pytest.mark.parametrize("version", ["4.10", "3.10"])
def test_a_local_start_does_not_depend_on_the_time_zone_of_the_machine(version, tmp_path, time_zone):
    start = START.replace(tzinfo=None) if version[0] == "4" else START
    read = read_mdf(written(tmp_path / "a.mf4", [signal("ay", AY)], version, start))
    assert read.stamps_ns["car"][0] == START_NS
    assert "local time without a time zone" in read.what("note")


@pytest.mark.parametrize(("sync", "what"), [(2, "an angle"), (3, "a distance"), (4, "an index")])
def test_a_master_that_is_no_time_is_no_clock(sync, what, tmp_path):
    samples = np.column_stack([TIME_S, AY]).tobytes()
    distance = Ch("s", kind=2, sync=sync)
    with pytest.raises(LogError, match=f"its master is {what}, no time"):
        read_mdf(mdf4([distance, Ch("AccY", 8)], samples, N, 16))
    read = read_mdf(mdf4([distance, Ch("AccY", 8), TIME], samples, N, 16))
    np.testing.assert_array_equal(read.columns["AccY"], AY)


# ---- bus logging of newer loggers ----


def can_file(
    length: Sequence[Ch], numbers: Mapping[str, Sequence[int]], frames: Sequence[bytes], is_variable: bool
) -> bytes:
    """A group of frames with virtual bus channel, identifiers with bit 31, no IDE; one byte for each length."""
    names = [(name, "u1") for name in numbers]
    samples = np.zeros(len(frames), [("t", "<f8"), ("id", "<u4"), ("data", "<u8" if is_variable else "(8,)u1"), *names])
    samples["t"] = TIME_S[: len(frames)]
    samples["id"] = [291, 291 | 1 << 31] * (len(frames) // 2)
    stored = b"".join(struct.pack("<I", len(f)) + f for f in frames)
    if is_variable:
        samples["data"] = np.cumsum([0, *(len(f) + 4 for f in frames[:-1])])
    else:
        samples["data"] = [list(f.ljust(8, b"\0")) for f in frames]
    for name, values in numbers.items():
        samples[name] = values
    size = samples.dtype.itemsize
    channels = [
        TIME,
        Ch("CAN_DataFrame", 8, 8 * (size - 8), data_type=10),
        Ch("CAN_DataFrame.ID", 8, 32, data_type=0),
        Ch("CAN_DataFrame.DataBytes", 12, 64, int(is_variable), data_type=10, stored=stored if is_variable else b""),
        Ch("CAN_DataFrame.BusChannel", kind=6, bits=0, data_type=0, linear=(2.0, 0.0)),
        Ch("CAN_DataFrame.Dir", kind=6, bits=0, data_type=0),
        *length,
    ]
    return mdf4(channels, samples.tobytes(), len(frames), size)


DLC = Ch("CAN_DataFrame.DLC", 20, 8, data_type=0)
LENGTH = Ch("CAN_DataFrame.DataLength", 20, 8, data_type=0)
SHORT = [bytes(range(1, 9)), b"\x01\x02"] * 2
LONG = [bytes(range(1, 13)), bytes(range(64))] * 2


@pytest.mark.parametrize(
    ("length", "numbers", "frames", "is_variable"),
    [
        ([DLC], {"dlc": [8, 2, 8, 2]}, SHORT, False),
        ([DLC], {"dlc": [9, 15, 9, 15]}, LONG, True),
        ([LENGTH], {"length": [12, 64, 12, 64]}, LONG, True),
        ([LENGTH], {"length": [9, 15, 9, 15]}, LONG, True),
        ([Ch("CAN_DataFrame.DataLength", kind=6, bits=0, data_type=0)], {"dlc": [0] * 4}, [bytes(range(8))] * 4, False),
        ([Ch("CAN_DataFrame.DataLength", kind=6, bits=0, data_type=0), DLC], {"dlc": [8, 2, 8, 2]}, SHORT, True),
    ],
)  # fmt: skip
def test_frames_of_newer_loggers(length, numbers, frames, is_variable, tmp_path):
    contents = opened(tmp_path / "a.mf4", can_file(length, numbers, frames, is_variable))
    read = contents.columns
    assert ([*contents.topics], contents.lost) == (["can"], ())
    assert read["id"].tolist() == [291] * 4
    assert read["is_extended"].tolist() == [0, 1, 0, 1]
    assert read["bus"].tolist() == [2] * 4
    assert read["length"].tolist() == [len(f) for f in frames]
    data = np.column_stack([read[f"data[{i}]"] for i in range(max(map(len, frames)))])
    assert [bytes(row[np.isfinite(row)].astype(np.uint8)) for row in data] == frames


# ---- files that are made to harm ----


def circle(kind: bytes, number: int, link: int) -> bytes:
    data = imu()
    return patched(data, block(data, kind, number) + 24 + 8 * link, block(data, kind))


def far_data() -> bytes:
    data = can_file([DLC], {"dlc": [8, 2, 8, 2]}, SHORT, True)
    return patched(data, block(data, b"DT") + 24 + 12, 2**40)


def many_rows() -> bytes:
    clock = Ch("time", kind=3, sync=1, bits=0, linear=(0.0, 0.01))
    return mdf4([clock, Ch("n", kind=6, bits=0, data_type=0)], b"", 2**40, 0)


MANY = [Ch(f"c{i}", 8) for i in range(DEFAULT_LIMITS.schema_leaves)]
FAR_BIT, OUTSIDE = [TIME, Ch("AccY", 8, flags=2, invalid_bit=2**20)], "AccY is outside of its record"
HARMFUL: dict[str, tuple[Callable[[], bytes], str]] = {
    **{
        f"circle {of}": (partial(circle, *of), "circle")
        for of in ((b"CN", 1, 0), (b"CN", 0, 1), (b"DG", 0, 0), (b"CG", 0, 0))
    },
    "no header": (lambda: imu().replace(b"##HD", b"##XX"), "a block HD at byte 64"),
    "data of a frame": (far_data, "data of a frame are missing"),
    "packed": (lambda: imu(packed=(2**40,)), "table bytes"),
    "rows": (many_rows, "table bytes"),
    "channels": (partial(mdf4, [TIME, *MANY], bytes(16), 1, 16), "schema leaves"),
    "bit of invalid samples": (partial(mdf4, FAR_BIT, bytes(17 * N), N, 16, invalid_bytes=1), OUTSIDE),
    **{f"offset {of}": (partial(imu, offset=of), f"with times.*{OUTSIDE}") for of in (1000, 2**31, 12)},
}


@pytest.mark.parametrize(("make", "match"), HARMFUL.values(), ids=HARMFUL)
def test_a_file_that_is_made_to_harm_is_one_line(make, match, tmp_path):
    with pytest.raises(LogError, match=match):
        read_mdf(make())


def test_a_file_that_a_recorder_has_not_finished_leaves_no_copy(tmp_path, monkeypatch):
    data = bytearray(imu())
    data[:8] = b"UnFinMF "
    struct.pack_into("<H", data, 60, 0b101)  # counters of rows and the length of the last block
    struct.pack_into("<Q", data, block(bytes(data), b"CG") + 24 + 48 + 8, 0)
    struct.pack_into("<Q", data, block(bytes(data), b"DT") + 8, 24)
    (tmp_path / "a.mf4").write_bytes(data)
    (tmp_path / "t").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "t"))
    read = read_mdf(tmp_path / "a.mf4")
    np.testing.assert_array_equal(read.columns["AccY"], AY)
    assert "has not finished" in read.what("note")
    del read
    gc.collect()
    assert list((tmp_path / "t").iterdir()) == []
    assert (tmp_path / "a.mf4").read_bytes() == data
