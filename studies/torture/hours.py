"""Logs of many hours: the messages of a sample drive, repeated."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

from studies.mcap_logs import Message, messages, write_log
from studies.pages import ROOT

_IMU = "/imu/data"
_TOPICS = (_IMU, "/vehicle/status/steering_status", "/vehicle/wheel_speeds", "/truth/perfect/odometry")


def later(message: Message, shift_ns: int) -> Message:
    """Return a message in CDR that begins with its stamp, a while later."""
    head, seconds, nanoseconds = struct.unpack_from("<4sII", message.data)
    stamp = divmod(seconds * 10**9 + nanoseconds + shift_ns, 10**9)
    data = struct.pack("<4sII", head, *stamp) + message.data[12:]
    at_ns, published_ns = message.log_time_ns + shift_ns, message.publish_time_ns + shift_ns
    return message._replace(log_time_ns=at_ns, publish_time_ns=published_ns, data=data)


def write_hours(path: Path, hours: float) -> None:
    """Write a log of the given hours: the sample road drive repeated, each time from the end of the last one."""
    once = [m for m in messages(ROOT / "sample_logs" / "road.mcap") if m.topic in _TOPICS]
    imu_ns = [m.log_time_ns for m in once if m.topic == _IMU]
    lasts_ns = imu_ns[-1] - imu_ns[0] + 10_000_000

    def repeated() -> Iterator[Message]:
        for shift_ns in range(0, round(hours * 3600e9 / lasts_ns) * lasts_ns, lasts_ns):
            yield from (later(m, shift_ns) for m in once)

    write_log(path, repeated(), "ros2")
