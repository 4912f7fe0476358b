"""Logs of many hours: the messages of a sample drive, repeated."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from studies.mcap_logs import Message, messages, stamp_ns, stamped, write_log
from studies.pages import ROOT

_IMU = "/imu/data"
_TOPICS = (_IMU, "/vehicle/status/steering_status", "/vehicle/wheel_speeds", "/truth/perfect/odometry")


def write_hours(path: Path, hours: float) -> None:
    """Write a log of the given hours: the sample road drive repeated, each time from the end of the last one."""
    once = [m for m in messages(ROOT / "sample_logs" / "road.mcap") if m.topic in _TOPICS]
    imu_ns = [m.log_time_ns for m in once if m.topic == _IMU]
    lasts_ns = imu_ns[-1] - imu_ns[0] + 10_000_000

    def repeated() -> Iterator[Message]:
        for shift_ns in range(0, round(hours * 3600e9 / lasts_ns) * lasts_ns, lasts_ns):
            for m in once:
                at_ns, published_ns = m.log_time_ns + shift_ns, m.publish_time_ns + shift_ns
                yield stamped(m, stamp_ns(m) + shift_ns)._replace(log_time_ns=at_ns, publish_time_ns=published_ns)

    write_log(path, repeated(), "ros2")
