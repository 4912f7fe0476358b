"""A mapping against a log: everything that the log lacks is named at once, with near misses."""

from __future__ import annotations

import numpy as np
import pytest
from fake_drive_log import FakeLog, FakeTopic

from pdhef_logtool.mapping import Mapping, QualityGate, SignalSource, check_mapping, resolve_mapping
from pdhef_logtool.records.errors import MappingError

T = np.arange(5, dtype=np.int64) + 1_000_000_000


def log() -> FakeLog:
    zeros = np.zeros(5)
    return FakeLog(
        {
            "/imu/data": FakeTopic(
                "sensor_msgs/msg/Imu",
                T,
                {
                    "header.stamp": T,
                    "header.frame_id": np.array(["a"] * 5, dtype=object),
                    "linear_acceleration.x": zeros,
                    "linear_acceleration.y": zeros,
                    "angular_velocity.z": zeros,
                    "seconds": zeros,
                },
            ),
            "/steer": FakeTopic("x/Steer", T, {"stamp": T, "angle": zeros, "gyro": np.zeros((5, 3)), "data[]": zeros}),
            "/bare": FakeTopic("std_msgs/msg/Float32", T, {"data": zeros}),
        }
    )


def mapping(**sources: SignalSource) -> Mapping:
    return Mapping(signals=sources)


def test_what_is_there_passes() -> None:
    sources = (
        SignalSource("ax_m_s2", "/imu/data", "linear_acceleration.x"),
        SignalSource("ay_m_s2", "/steer", "gyro[1]", stamp="stamp"),
        SignalSource("speed_m_s", "/steer", "data[4]"),
        SignalSource("steer_rad", "/imu/data", "seconds", stamp="seconds", stamp_unit="s"),
    )
    vectors = (
        SignalSource("enu_velocity_m_s", "/steer", "gyro"),
        SignalSource("ecef_position_m", "/steer", ("angle", "gyro[0]", "gyro[1]")),
    )
    gate = QualityGate("/steer", "angle", min=0.0)
    check_mapping(Mapping({s.name: s for s in sources}, {s.name: s for s in vectors}, quality=gate), log())


def test_everything_that_lacks_is_named_with_the_nearest() -> None:
    bad = Mapping(
        signals={
            "ax_m_s2": SignalSource("ax_m_s2", "/imu/dat", "linear_acceleration.x"),
            "ay_m_s2": SignalSource("ay_m_s2", "/imu/data", "linear_accel.y"),
            "yaw_rate_rad_s": SignalSource("yaw_rate_rad_s", "/imu/data", "angular_velocity"),
            "steer_rad": SignalSource("steer_rad", "/steer", "angle", stamp="header.stamp"),
            "friction": SignalSource("friction", "/imu/data", "header.frame_id"),
            "speed_m_s": SignalSource("speed_m_s", "/steer", "gyro[3]"),
        },
        truth={"quat_wxyz": SignalSource("quat_wxyz", "/steer", "angle")},
        quality=QualityGate("/state", "mode", values=(1.0,)),
    )
    with pytest.raises(MappingError) as caught:
        check_mapping(bad, log())
    line = str(caught.value)
    for part in (
        "ax_m_s2: no topic /imu/dat (did you mean /imu/data?)",
        "ay_m_s2: /imu/data has no field linear_accel.y (did you mean linear_acceleration.y?)",
        "yaw_rate_rad_s: /imu/data.angular_velocity contains several numbers: name one, such as angular_velocity.z",
        "steer_rad: /steer has no stamp header.stamp (did you mean stamp?)",
        "friction: /imu/data.header.frame_id is a string, not a number",
        "speed_m_s: /steer has no field gyro[3]",
        "quat_wxyz: /steer.angle is one number, quat_wxyz needs 4",
        "truth_quality: no topic /state",
    ):
        assert part in line, part
    assert "\n" not in line


@pytest.mark.parametrize(
    ("stamp", "unit", "said"),
    [("seconds", "ros", "give stamp_unit"), ("header.stamp", "s", "stamp_unit = "), ("header", "ros", "is no time")],
)
def test_the_kind_of_the_stamp_is_checked(stamp: str, unit: str, said: str) -> None:
    source = SignalSource("ax_m_s2", "/imu/data", "linear_acceleration.x", stamp=stamp, stamp_unit=unit)  # type: ignore[arg-type]
    with pytest.raises(MappingError, match=said):
        check_mapping(mapping(ax_m_s2=source), log())


def test_stamps_that_the_file_leaves_open_come_from_the_schema() -> None:
    open_ = (("ax_m_s2", "/imu/data", "linear_acceleration.x"), ("steer_rad", "/steer", "angle"))
    sources = {n: SignalSource(n, *where) for n, *where in (*open_, ("speed_m_s", "/bare", "data"))}
    stated = SignalSource("ay_m_s2", "/imu/data", "linear_acceleration.y", stamp="publish_time")
    gate = QualityGate("/steer", "angle", min=0.0)
    got = resolve_mapping(log(), Mapping({**sources, "ay_m_s2": stated}, quality=gate))
    assert {n: s.stamp for n, s in got.signals.items()} == {
        "ax_m_s2": "header.stamp",
        "steer_rad": "stamp",
        "speed_m_s": "log_time",
        "ay_m_s2": "publish_time",
    }
    assert got.quality is not None
    assert got.quality.stamp == "stamp"
