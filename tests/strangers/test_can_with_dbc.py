"""Raw CAN in BLF with the DBC of a car: its signals are mapped on first contact, without a mapping file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool import inspect_log
from studies.strangers.cars import Series, drive

DBC = """VERSION ""
NS_ :
BS_:
BU_: ECU
BO_ 133 LWI_01: 8 ECU
 SG_ LWI_Lenkradwinkel : 0|16@1- (0.1,0) [-3200|3200] "deg" ECU
BO_ 257 ESP_02: 8 ECU
 SG_ ESP_Querbeschleunigung : 0|16@1- (0.001,0) [-3|3] "g" ECU
 SG_ ESP_Laengsbeschl : 16|16@1- (0.01,0) [-30|30] "m/s2" ECU
 SG_ ESP_Gierrate : 32|16@1- (0.01,0) [-160|160] "deg/s" ECU
BO_ 178 ESP_19: 8 ECU
 SG_ ESP_HL_Radgeschw : 0|16@1+ (0.01,0) [0|655] "km/h" ECU
 SG_ ESP_HR_Radgeschw : 16|16@1+ (0.01,0) [0|655] "km/h" ECU
 SG_ ESP_VL_Radgeschw : 32|16@1+ (0.01,0) [0|655] "km/h" ECU
 SG_ ESP_VR_Radgeschw : 48|16@1+ (0.01,0) [0|655] "km/h" ECU
"""


def _frames(series: Series, number: int, *columns: np.ndarray) -> list[tuple[float, int, bytes]]:
    data = np.round(np.stack(columns, axis=1)).astype("<i2")
    times = (series.arrival_ns / 1e9).tolist()
    return [(t, number, row.tobytes().ljust(8, b"\0")) for t, row in zip(times, data, strict=True)]


def test_signals_of_a_dbc_are_mapped_on_first_contact(tmp_path: Path) -> None:
    can = pytest.importorskip("can")
    car = drive("short")
    (tmp_path / "car.dbc").write_text(DBC)
    wheels = 360.0 * car.wheels.values[:, (2, 3, 0, 1)]
    messages = _frames(car.steering_wheel, 133, np.degrees(car.steering_wheel.values) * 10.0)
    yaw_rate = np.degrees(car.rate.values[:, 2]) * 100.0
    messages += _frames(car.force, 257, car.force.values[:, 1] / 9.80665e-3, car.force.values[:, 0] * 100.0, yaw_rate)
    messages += _frames(car.wheels, 178, *wheels.T)
    with can.BLFWriter(str(tmp_path / "car.blf")) as writer:
        for t, number, data in sorted(messages):
            ours = {"arbitration_id": number, "is_extended_id": False, "data": data}
            writer.on_message_received(can.Message(timestamp=t, channel=0, **ours))
    found = inspect_log(tmp_path / "car.blf", msgs=tmp_path / "car.dbc")
    fields = {name: (source.field, source.scale) for name, source in found.mapping.signals.items()}
    degree = pytest.approx(np.radians(1.0))
    assert fields == {
        "ax_m_s2": ("ESP_Laengsbeschl", 1.0),
        "ay_m_s2": ("ESP_Querbeschleunigung", pytest.approx(9.80665)),
        "yaw_rate_rad_s": ("ESP_Gierrate", degree),
        "steering_wheel_rad": ("LWI_Lenkradwinkel", degree),
        **{
            f"wheel_speed_{wheel}_m_s": (f"ESP_{name}_Radgeschw", pytest.approx(1.0 / 3.6))
            for wheel, name in (("fl", "VL"), ("fr", "VR"), ("rl", "HL"), ("rr", "HR"))
        },
    }
    assert not any(check.verdict == "failed" for check in found.checks)
    without = inspect_log(tmp_path / "car.blf")
    assert any("--set msgs=" in str(note) for note in without.to_dict()["notes"])
