"""MDF 3 and 4, bus logging and MAT 7.3: the extra ``formats``."""

from __future__ import annotations

import struct
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.table_clocks import RELATIVE_NS
from pdhef_logtool.mapping.channels import read_signals
from pdhef_logtool.mapping.mapping_file import load_mapping
from pdhef_logtool.records.errors import PdhefError
from tests.command_line import called

asammdf = pytest.importorskip("asammdf")
can = pytest.importorskip("can")
h5py = pytest.importorskip("h5py")

N = 300
TIME_S = np.arange(N) * 0.01
AY = 0.3 * np.sin(2.0 * TIME_S)
SPEED = 70.0 + TIME_S
START_NS = 1_714_564_800 * 10**9
DBC = """VERSION ""
NS_ :
BS_:
BU_: A
BO_ 291 Motion: 8 A
 SG_ AccelY : 0|16@1- (0.001,0) [0|0] "g" A
 SG_ Speed : 16|16@1+ (0.01,0) [0|0] "km/h" A
"""
MAPPING = """[can]
dbc = ["car.dbc"]
[signals.ay_m_s2]
topic = "can"
field = "can:Motion.AccelY"
scale = 9.80665
[signals.speed_m_s]
topic = "can"
field = "can:Motion.Speed"
scale = 0.2777777777777778
"""


def mdf(path: Path, version: str = "4.10") -> Path:
    """Two channel groups with clocks of their own."""
    import datetime as dt

    signal = asammdf.Signal
    with asammdf.MDF(version=version) as file:
        file.start_time = dt.datetime.fromtimestamp(START_NS // 10**9, tz=dt.UTC)
        imu = [signal(AY, TIME_S, name="IMU.AccY", unit="g"), signal(AY, TIME_S, name="IMU.AccX", unit="g")]
        file.append(imu, comment="IMU 100 Hz", common_timebase=True)
        file.append([signal(SPEED[::10].astype(np.float32), TIME_S[::10], name="Speed\\XCP:1", unit="km/h")])
        file.save(path, overwrite=True)
    return path


def frames() -> list[Any]:
    """CAN frames of the DBC, with others between them."""
    results = []
    for t, a, v in zip(TIME_S, AY, SPEED, strict=True):
        data = round(a * 1000).to_bytes(2, "little", signed=True) + round(v * 100).to_bytes(2, "little")
        at = START_NS / 1e9 + t
        ours = {"arbitration_id": 291, "data": data + bytes(4), "is_extended_id": False, "channel": 1}
        results.append(can.Message(timestamp=at, **ours))
        results.append(can.Message(timestamp=at + 1e-3, arbitration_id=0x1ABCDEF, data=b"\x01\x02\x03", channel=1))
    return results


@pytest.mark.parametrize("version", ["4.10", "4.11", "3.30"])
def test_channel_groups_of_mdf_keep_their_clocks_and_units(version: str, tmp_path: Path) -> None:
    path = mdf(tmp_path / "a.mf4", version)
    path = path if path.exists() else path.with_suffix(".mdf")
    with closing(open_log(path)) as log:
        assert log.kind == f"mdf-{version[0]}"
        imu, other = sorted(log.topics, key=lambda t: -t.messages)
        assert (imu.messages, other.messages) == (N, N // 10)
        assert {f.path: f.unit for t in log.topics for f in log.fields(t.name)} == {
            "IMU_AccY": "g", "IMU_AccX": "g", "Speed": "km/h",
        }  # fmt: skip
        read = log.read({imu.name: ["IMU_AccY"], other.name: ["Speed"]})
        assert log.lost == ()
    np.testing.assert_array_equal(read[imu.name].fields["IMU_AccY"], AY)
    np.testing.assert_array_equal(read[other.name].fields["Speed"], SPEED[::10].astype(np.float32))
    assert np.abs(np.diff(read[imu.name].log_time_ns) - 10_000_000).max() <= 1
    assert read[imu.name].log_time_ns[0] == read[other.name].log_time_ns[0] == START_NS


def test_a_window_of_an_mdf_is_that_part_of_its_columns(tmp_path: Path) -> None:
    with closing(open_log(mdf(tmp_path / "a.mf4"))) as log:
        whole = log.read({"IMU_100_Hz": ["IMU_AccY"]})["IMU_100_Hz"]
        part = log.read({"IMU_100_Hz": ["IMU_AccY"]}, START_NS + 10**9, START_NS + 2 * 10**9)["IMU_100_Hz"]
    np.testing.assert_array_equal(part.fields["IMU_AccY"], whole.fields["IMU_AccY"][100:200])


def test_a_cut_mdf_gives_what_is_readable_or_one_line(tmp_path: Path) -> None:
    data = mdf(tmp_path / "a.mf4").read_bytes()
    for share in (0.05, 0.3, 0.6, 0.9, 0.98):
        (tmp_path / "cut.mf4").write_bytes(data[: int(share * len(data))])
        done = called("inspect", tmp_path / "cut.mf4", "--json")
        assert done.returncode in (1, 3), share
        assert "internal error" not in done.stderr


def _metadata_first(rows: int, offset: int = 8) -> bytes:
    """An MDF 4.10 as recorders write it: one group with time and AccY [g], whose data are the last block."""
    samples = np.zeros(rows, [("t", "<f8"), ("a", "<f8")])
    samples["t"], samples["a"] = TIME_S[:rows], AY[:rows]
    stamp = struct.pack("<QhhB", START_NS, 0, 0, 0)
    about = b"<FHcomment><TX>x</TX><tool_id>x</tool_id><tool_vendor>x</tool_vendor></FHcomment>\0"

    def channel(kind: int, sync: int, offset: int) -> bytes:
        return struct.pack("<BBBBIIIIBxHdddddd", kind, sync, 4, 0, offset, 64, 0, 0, 0, 0, *[0.0] * 6)

    at: dict[str, int] = {}
    for _ in range(2):  # the first pass finds the addresses
        blocks = {
            "HD": (["DG", "FH", "", "", "", ""], stamp + bytes(19)),
            "FH": (["", "MD"], stamp + bytes(3)),
            "MD": ([], about),
            "DG": (["", "CG", "DT", ""], bytes(8)),
            "CG": (["", "CN", "TX", "", "", ""], struct.pack("<QQHHIII", 0, rows, 0, 0, 0, 16, 0)),
            "TX": ([], b"IMU\0"),
            "TX1": ([], b"time\0"),
            "TX2": ([], b"AccY\0"),
            "TX3": ([], b"g\0"),
            "CN": (["CN2", "", "TX1", "", "", "", "", ""], channel(2, 1, 0)),
            "CN2": (["", "", "TX2", "", "", "", "TX3", ""], channel(0, 0, offset)),
            "DT": ([], samples.tobytes()),
        }
        out = bytearray(b"MDF     4.10    test".ljust(28, b"\0") + struct.pack("<H", 410)).ljust(64, b"\0")
        for name, (links, data) in blocks.items():
            at[name] = len(out)
            head = struct.pack("<4s4xQQ", f"##{name[:2]}".encode(), 24 + 8 * len(links) + len(data), len(links))
            out += head + struct.pack(f"<{len(links)}Q", *(at.get(n, 0) for n in links)) + data
            out += bytes(-len(out) % 8)
    return bytes(out)


def test_an_mdf_that_ends_within_its_data_is_read_so_far(tmp_path: Path) -> None:
    data = _metadata_first(N)
    (tmp_path / "a.mf4").write_bytes(data)
    (tmp_path / "b.mf4").write_bytes(data[: -16 * 100 - 5])
    with closing(open_log(tmp_path / "a.mf4")) as log:
        assert log.lost == ()
        np.testing.assert_array_equal(log.read({"IMU": ["AccY"]})["IMU"].fields["AccY"], AY)
    with closing(open_log(tmp_path / "b.mf4")) as log:
        assert [(x.kind, x.severity) for x in log.lost] == [("truncated", "lost")]
        read = log.read({"IMU": ["AccY"]})["IMU"].fields["AccY"]
    np.testing.assert_array_equal(read, AY[: len(read)])
    assert N - 102 <= len(read) <= N - 100
    assert called("inspect", tmp_path / "b.mf4").returncode == 3


@pytest.mark.parametrize("offset", [1000, 2**31, 12])
def test_a_channel_outside_of_its_record_is_not_read(offset: int, tmp_path: Path) -> None:
    (tmp_path / "a.mf4").write_bytes(_metadata_first(N, offset))
    with pytest.raises(PdhefError, match="with times"):
        open_log(tmp_path / "a.mf4")


def test_what_asammdf_prints_of_a_damaged_channel_does_not_reach_the_output(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def get(*_: object, **__: object) -> None:
        print("CHANNEL =====")
        raise ValueError("damaged")

    with closing(open_log(mdf(tmp_path / "a.mf4"))) as log:
        monkeypatch.setattr(asammdf.MDF, "get", get)
        capsys.readouterr()
        read = log.read({"IMU_100_Hz": ["IMU_AccY"]})["IMU_100_Hz"]
        assert [(x.kind, x.severity) for x in log.lost] == [("bad-column", "lost")]
    assert np.isnan(read.fields["IMU_AccY"]).all()
    assert capsys.readouterr().out == ""


def _check_can(path: Path, tmp_path: Path, kind: str) -> None:
    (tmp_path / "car.dbc").write_text(DBC)
    (tmp_path / "m.toml").write_text(MAPPING)
    with closing(open_log(path)) as log:
        assert log.kind == kind
        assert [(t.name, t.messages) for t in log.topics] == [("can", 2 * N)]
        found = read_signals(log, load_mapping(tmp_path / "m.toml"), {}, log.start_ns, log.end_ns)
        assert log.lost == ()
    with closing(open_log(path, msgs=tmp_path / "car.dbc")) as log:
        assert [(t.name, t.messages) for t in log.topics] == [("can", 2 * N), ("Motion", N)]
        assert {f.path: f.unit for f in log.fields("Motion")} == {"AccelY": "g", "Speed": "km/h"}
        decoded = log.read({"Motion": ["AccelY"]})["Motion"].fields["AccelY"]
        np.testing.assert_allclose(decoded, np.round(AY, 3), atol=1e-12)
    ay, speed = found.signals["ay_m_s2"], found.signals["speed_m_s"]
    np.testing.assert_allclose(ay.values, np.round(AY, 3) * 9.80665, atol=1e-9)
    np.testing.assert_allclose(speed.values, np.round(SPEED, 2) / 3.6, atol=1e-9)
    assert np.abs(ay.stamps_ns - ay.stamps_ns[0] - np.round(TIME_S * 1e9)).max() < 2e5  # resolution of the formats


def test_raw_can_is_decoded_by_the_dbc_of_the_mapping(tmp_path: Path) -> None:
    path = tmp_path / "a.mf4"
    with can.Logger(str(path)) as writer:
        for message in frames():
            writer.on_message_received(message)
    _check_can(path, tmp_path, "mdf-4")


def test_bus_logging_is_decoded_by_several_databases(tmp_path: Path) -> None:
    folder = tmp_path / "dbc"
    folder.mkdir()
    (folder / "motion.dbc").write_text(DBC)
    other = DBC.replace("BO_ 291 Motion", "BO_ 292 Steering").replace("AccelY", "Angle").replace('"g"', '"deg"')
    (folder / "steering.dbc").write_text(other)
    with can.Logger(str(tmp_path / "a.mf4")) as writer:
        for message in frames():
            writer.on_message_received(message)
            if message.arbitration_id == 291:
                late = {"timestamp": message.timestamp + 1e-3, "data": message.data, "is_extended_id": False}
                writer.on_message_received(can.Message(arbitration_id=292, channel=1, **late))
    with closing(open_log(tmp_path / "a.mf4", msgs=folder)) as log:
        assert {"Motion", "Steering"} <= {t.name for t in log.topics}
        assert {f.path: f.unit for f in log.fields("Steering")} == {"Angle": "deg", "Speed": "km/h"}
        read = log.read({"Motion": ["AccelY"], "Steering": ["Angle"]})
    np.testing.assert_allclose(read["Steering"].fields["Angle"], np.round(AY, 3), atol=1e-12)
    assert np.median(read["Steering"].log_time_ns - read["Motion"].log_time_ns) == pytest.approx(1e6, abs=2e5)


def test_a_mat_file_of_version_7_3(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        file["t"], file["ay_g"] = TIME_S[None, :], AY[:, None]
        file["gnss/time"], file["gnss/speed_kmh"] = TIME_S[None, ::10], SPEED[None, ::10]
        file.create_dataset("#refs#/a", data=[1.0])
    data = bytearray(path.read_bytes())
    data[:19] = b"MATLAB 7.3 MAT-file"
    path.write_bytes(data)
    with closing(open_log(path)) as log:
        assert (log.kind, [(t.name, t.messages) for t in log.topics]) == ("mat-7.3", [("gnss", N // 10), ("mat", N)])
        read = log.read({"mat": ["ay_g"], "gnss": ["speed_kmh"]})
    np.testing.assert_array_equal(read["mat"].fields["ay_g"], AY)
    np.testing.assert_array_equal(read["gnss"].fields["speed_kmh"], SPEED[::10])
    assert read["mat"].log_time_ns[0] == RELATIVE_NS


@pytest.mark.parametrize(
    ("module", "name", "head"),
    [
        ("asammdf", "a.mf4", b"MDF     4.10    "),
        ("h5py", "a.mat", b"MATLAB 7.3 MAT-file"),
    ],
)
def test_a_missing_extra_is_one_line_with_the_command(
    module: str, name: str, head: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / name).write_bytes(head + bytes(100))
    done = called("inspect", tmp_path / name)
    assert done.returncode == 2
    assert "pip install 'pdhef-logtool[formats]'" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
