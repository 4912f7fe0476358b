"""Logs of many hours: the signals of a sample drive, repeated."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.writer import McapLogWriter, TopicBatch
from pdhef_logtool.records.signals import FloatArray, IntArray
from studies.pages import ROOT
from truthsim.recording import STEERING_REPORT

_IMU = ("angular_velocity.z", "linear_acceleration.x", "linear_acceleration.y")
_WHEELS = ("fl_m_s", "fr_m_s", "rl_m_s", "rr_m_s")
_POSE = (*(f"pose.pose.position.{a}" for a in "xyz"), *(f"pose.pose.orientation.{a}" for a in "xyzw"))
_TWIST = tuple(f"twist.twist.{part}.{a}" for part in ("linear", "angular") for a in "xyz")
#: Type, path of the stamp, paths of the values, by topic.
_TOPICS = {
    "/imu/data": ("sensor_msgs/msg/Imu", "header.stamp", _IMU),
    "/vehicle/status/steering_status": ("autoware_vehicle_msgs/msg/SteeringReport", "stamp", ("steering_tire_angle",)),
    "/vehicle/wheel_speeds": ("truthsim_msgs/msg/WheelSpeeds", "header.stamp", _WHEELS),
    "/truth/perfect/odometry": ("nav_msgs/msg/Odometry", "header.stamp", (*_POSE, *_TWIST)),
}


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """One topic's columns: recorder's times, stamps, values [N]."""

    log_ns: IntArray
    stamp_ns: IntArray
    values: dict[str, FloatArray]

    def take(self, index: IntArray) -> Samples:
        """Return the samples at these places, in this order."""
        values = {k: v[index] for k, v in self.values.items()}
        return Samples(self.log_ns[index], self.stamp_ns[index], values)


Drive = dict[str, Samples]


def read_samples(path: Path) -> Drive:
    """Read the topics above."""
    log = open_log(path)
    try:
        columns = log.read({topic: [stamp, *paths] for topic, (_, stamp, paths) in _TOPICS.items()})
    finally:
        log.close()
    samples_by_topic = {}
    for topic, (_, stamp, paths) in _TOPICS.items():
        read = columns[topic]
        samples_by_topic[topic] = Samples(read.log_time_ns, read.fields[stamp], {p: read.fields[p] for p in paths})
    return samples_by_topic


def write_samples(path: Path, drives: Iterable[Drive]) -> None:
    """Write drives that follow one another; the rows of each in order of log time."""
    with McapLogWriter(path) as writer:
        for topic, (type_name, _, _) in _TOPICS.items():
            definition = STEERING_REPORT if "SteeringReport" in type_name else None
            writer.add_topic(topic, type_name, definition=definition)
        for drive in drives:
            batches = []
            for topic, samples in drive.items():
                s = samples.take(np.argsort(samples.log_ns, kind="stable"))
                batches.append(TopicBatch(topic, s.log_ns, s.log_ns, {_TOPICS[topic][1]: s.stamp_ns, **s.values}))
            writer.write(batches)


def _shifted(drive: Drive, shift_s: float) -> Drive:
    shift_ns = np.int64(round(shift_s * 1e9))
    return {t: replace(s, stamp_ns=s.stamp_ns + shift_ns, log_ns=s.log_ns + shift_ns) for t, s in drive.items()}


def write_hours(path: Path, hours: float) -> None:
    """Write a log of the given hours: the sample road drive repeated, each time from the end of the last one."""
    once = read_samples(ROOT / "sample_logs" / "road.mcap")
    imu = once["/imu/data"].log_ns
    lasts_ns = int(imu[-1] - imu[0]) + 10_000_000

    starts_s = (k * lasts_ns * 1e-9 for k in range(round(hours * 3600e9 / lasts_ns)))
    write_samples(path, (_shifted(once, at_s) for at_s in starts_s))
