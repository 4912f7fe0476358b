"""Bus logging in MDF, MAT 7.3, and the extra ``formats``."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from contextlib import closing
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pdhef_logtool.logs.mat_log import open_mat
from pdhef_logtool.logs.mdf_log import open_mdf
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.resource_limits import DEFAULT_LIMITS
from pdhef_logtool.logs.table_file import TableFile, Tables
from pdhef_logtool.mapping.channels import read_signals
from pdhef_logtool.mapping.mapping_file import load_mapping
from pdhef_logtool.records.errors import UsageError

pytest.importorskip("asammdf")
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


def _check_can(path: Path, tmp_path: Path, kind: str) -> None:
    (tmp_path / "car.dbc").write_text(DBC)
    (tmp_path / "m.toml").write_text(MAPPING)
    with closing(open_log(path)) as log:
        assert log.kind == kind
        assert [(t.name, t.messages) for t in log.topics] == [("can", 2 * N)]
        found = read_signals(log, load_mapping(tmp_path / "m.toml"), {}, log.start_ns, log.end_ns)
        assert [loss for loss in log.lost if loss.severity == "lost"] == []
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


@pytest.mark.parametrize(
    ("module", "reader", "head"),
    [("asammdf", open_mdf, b"MDF     4.10    "), ("h5py", open_mat, b"MATLAB 7.3 MAT-file")],
)
def test_a_missing_extra_is_a_usage_error_with_the_command(
    module: str, reader: Callable[[TableFile], Tables], head: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UsageError, match=re.escape("pip install 'pdhef-logtool[formats]'")):
        reader(TableFile(BytesIO(head + bytes(100)), len(head) + 100, "a", DEFAULT_LIMITS))
