"""Turn the independent simulator's runs (Parquet) into logs as a recorder would leave them.

Topics and types match the simulated sample logs, so that the same mapping reads both: IMU, steering and wheel speeds
from the runs' sensor columns, ``/truth/perfect/odometry`` from their states. The runs' licence keeps them out of
the repository.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from pdhef_logtool.logs.writer import McapLogWriter, TopicBatch
from pdhef_logtool.records.signals import WHEELS
from truthsim.recording import STEERING_REPORT, quaternion

START_NS = 1_767_225_600_000_000_000
RADIUS_M = 0.30


def write_run(source: Path, target: Path) -> None:
    """Write one run as MCAP."""
    run = pl.read_parquet(source)
    facts = json.loads(source.with_suffix(".json").read_text(encoding="utf-8"))
    column = {name: run[name].to_numpy().astype(np.float64) for name in run.columns}
    stamps = START_NS + np.round((column["t"] - column["t"][0]) * 1e6).astype(np.int64) * 1000
    zero = np.zeros(stamps.shape[0])
    topics: dict[str, tuple[str, dict[str, Any], dict[str, Any], str | None]] = {
        "/imu/data": (
            "sensor_msgs/msg/Imu",
            {"header.frame_id": "base_link", "orientation_covariance": [-1.0] + [0.0] * 8},
            {
                "header.stamp": stamps,
                "linear_acceleration.x": column["ax_m"],
                "linear_acceleration.y": column["ay_m"],
                "linear_acceleration.z": zero + 9.80665,
                "angular_velocity.z": column["yaw_rate_m"],
            },
            None,
        ),
        "/vehicle/status/steering_status": (
            "autoware_vehicle_msgs/msg/SteeringReport",
            {},
            {"stamp": stamps, "steering_tire_angle": column["steer_m"]},
            STEERING_REPORT,
        ),
        "/vehicle/wheel_speeds": (
            "truthsim_msgs/msg/WheelSpeeds",
            {"header.frame_id": "base_link"},
            {"header.stamp": stamps, **{f"{w}_m_s": RADIUS_M * column[f"w_{w}_m"] for w in WHEELS}},
            None,
        ),
        "/truth/perfect/odometry": (
            "nav_msgs/msg/Odometry",
            {"header.frame_id": "map", "child_frame_id": "base_link"},
            {
                "header.stamp": stamps,
                "pose.pose.position.x": column["x"],
                "pose.pose.position.y": column["y"],
                "pose.pose.position.z": zero,
                "pose.pose.orientation": quaternion(column["roll"], column["pitch"], column["yaw"]),
                "twist.twist.linear.x": column["vx"],
                "twist.twist.linear.y": column["vy"],
                "twist.twist.angular.z": column["yaw_rate"],
            },
            None,
        ),
    }
    with McapLogWriter(target) as writer:
        for topic, (type_name, constants, _, definition) in topics.items():
            writer.add_topic(topic, type_name, constants=constants, definition=definition)
        writer.metadata("independent_sim", {"run": str(facts["run"]), "friction": repr(facts["mu"])})
        writer.write([TopicBatch(topic, stamps, stamps, fields) for topic, (_, _, fields, _) in topics.items()])
