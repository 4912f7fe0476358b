"""GNSS as a sensor: recognised messages, their units, and the messages that are ground truth instead."""

from __future__ import annotations

import numpy as np
import pytest

from pdhef_logtool.mapping.navigation import receiver_signals
from pdhef_logtool.mapping.recognition import auto_map
from tests.fake_drive_log import FakeLog, FakeTopic

STAMP = np.arange(200, dtype=np.int64) * 100_000_000 + 1_700_000_000_000_000_000
NAV_PVT = ("vel_n", "vel_e", "g_speed", "h_acc", "s_acc", "fix_type", "lat", "lon")


@pytest.mark.parametrize(
    ("fields", "signals"),
    [
        (NAV_PVT, {"gnss_velocity_east_m_s": ("vel_e", 1e-3), "gnss_velocity_accuracy_m_s": ("s_acc", 1e-3)}),
        (("velN", "velE", "gSpeed", "hAcc", "fixType"), {"gnss_velocity_north_m_s": ("velN", 1e-3)}),
        (("vel_n", "vel_e", "g_speed", "c_acc", "s_acc"), {"gnss_velocity_north_m_s": ("vel_n", 1e-2)}),
        (("hor_speed", "trk_gnd"), {"gnss_speed_m_s": ("hor_speed", 1.0)}),
        (("vn", "ve", "cog", "mode", "latitude"), {"gnss_latitude_deg": ("latitude", 57.29577951308232)}),
        (("n", "e", "d", "h_accuracy", "n_sats", "tow"), {"gnss_velocity_east_m_s": ("e", 1e-3)}),
        (("lat", "lon", "height", "h_accuracy", "n_sats"), {"gnss_latitude_deg": ("lat", 1.0)}),
        (("lat", "lon", "h_msl", "h_acc", "v_acc"), {"gnss_longitude_deg": ("lon", 1e-7)}),
        (("speed_raw", "heading_raw", "True_Head"), {"gnss_speed_m_s": ("speed_raw", 1.0 / 3.6)}),
        (("track", "speed", "err_track", "err_horz"), {"gnss_position_accuracy_m": ("err_horz", 0.5)}),
    ],
    ids=[
        "NAV-PVT",
        "NAV-PVT camel case",
        "NAV-VELNED",
        "BESTVEL",
        "PVTGeodetic",
        "VelNed",
        "PosLlh",
        "NAV-POSLLH",
        "VBO",
        "GPSFix",
    ],
)
@pytest.mark.parametrize("base", ["", "receiver.solution."])
def test_messages_of_receivers_are_recognised_below_any_struct(fields, signals, base):
    found = receiver_signals("/gps", "log_time", [f"{base}{name}" for name in fields])
    for name, (field, scale) in signals.items():
        assert found[name].field == f"{base}{field}"
        assert found[name].scale == pytest.approx(scale)


def test_a_course_is_counter_clockwise_from_east():
    course = receiver_signals("/gps", "log_time", ["hor_speed", "trk_gnd"])["gnss_course_rad"]
    assert isinstance(course.scale, float)
    north, east = (course.scale * deg + course.offset for deg in (0.0, 90.0))
    assert (north, east) == pytest.approx((np.pi / 2.0, 0.0))


@pytest.mark.parametrize(
    "fields",
    [("north_velocity", "east_velocity", "azimuth"), ("vn", "ve", "cog", "heading"), ("x", "y"), ()],
    ids=["INSPVA", "INSNavGeod", "others", "none"],
)
def test_a_message_with_a_heading_is_no_sensor(fields):
    assert receiver_signals("/ins", "log_time", fields) == {}


def test_the_accuracy_of_a_fix_is_the_root_of_its_variances():
    paths = ["latitude", "longitude", "position_covariance_type", "status.status", "position_covariance"]
    accuracy = receiver_signals("/fix", "log_time", paths)["gnss_position_accuracy_m"]
    assert (accuracy.combine, accuracy.scale) == ("root", (0.5, 0.5))
    assert accuracy.paths == ("position_covariance[0]", "position_covariance[4]")


def _log(**topics):
    rng = np.random.default_rng(0)
    imu = {
        f"{part}.{axis}": rng.standard_normal(200)
        for part in ("linear_acceleration", "angular_velocity")
        for axis in "xyz"
    }
    contents = {"/imu": FakeTopic("sensor_msgs/msg/Imu", STAMP, imu)}
    for name, (type_name, fields) in topics.items():
        contents[f"/{name.replace('__', '/')}"] = FakeTopic(
            type_name, STAMP, {f: rng.standard_normal(200) for f in fields}
        )
    return FakeLog(contents)


def test_a_receiver_is_mapped_with_its_quality_and_rates_of_the_imu():
    signals = auto_map(_log(gps__pvt=("ublox_msgs/msg/NavPVT", NAV_PVT))).mapping.signals
    assert signals["gnss_velocity_east_m_s"].label == "/gps/pvt.vel_e"
    assert {"gnss_fix_type", "gnss_velocity_accuracy_m_s", "gnss_position_accuracy_m"} <= set(signals)
    assert signals["roll_rate_rad_s"].field == "angular_velocity.x"
    assert signals["pitch_rate_rad_s"].field == "angular_velocity.y"


def test_an_instrument_that_is_ground_truth_is_no_sensor():
    log = _log(
        truth__twist=("geometry_msgs/msg/TwistStamped", ("twist.linear.x", "twist.linear.y", "twist.angular.z")),
        truth__pvt=("ublox_msgs/msg/NavPVT", NAV_PVT),
    )
    assert not [name for name in auto_map(log).mapping.signals if name.startswith("gnss_")]


def test_a_heading_of_two_antennas_is_never_mapped_by_itself():
    fields = (*NAV_PVT, "heading")
    assert "gnss_heading_rad" not in auto_map(_log(gps__pvt=("vendor_msgs/msg/Pvt", fields))).mapping.signals
