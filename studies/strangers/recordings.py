"""A log with its right answers, and the messages that most logs here are made of."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.records.signals import FloatArray
from studies.pages import read_toml
from studies.strangers.cars import Car, Series
from studies.strangers.containers import Topic
from truthsim.recording import quaternion

#: Values of fields that are the same in each message.
Constants = Mapping[str, str | float | Sequence[float]]
DEG = np.pi / 180.0
KMH = 1.0 / 3.6
#: Turns forward, left, up into forward, right, down and back.
DOWN: FloatArray = np.diag([1.0, -1.0, -1.0])

SCORING = read_toml(Path(__file__).with_name("scoring.toml"))
#: Scored items: a part of a log that a person can find in it, and the channels that it may be mapped to.
ITEMS: dict[str, list[str]] = SCORING["items"]


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """A log and what the tool must find in it.

    Attributes
    ----------
    name : of the log. what : description in one line. page : where the layout is documented.
    group : ``fault``, ``layout``, ``recording`` (of others) or ``held-out`` (built last, run once).
    right : by channel (``truth.`` before ground truth) the expected series, any one of them.
    allowed : channels that may be mapped, and are not missed: an INS that is no ground truth, a second source.
    cause : pattern of a message that names the cause; empty for a log without a fault.
    at_fault : channels with the fault; of all others no check may fail.
    container, topics : of a log of our own making. kind : logs of one kind count as one.
    """

    name: str
    group: str
    what: str
    right: Mapping[str, Sequence[Series]]
    allowed: Mapping[str, Sequence[Series]] = field(default_factory=dict)
    cause: str = ""
    at_fault: frozenset[str] = frozenset()
    page: str = ""
    container: str = "mcap"
    topics: tuple[Topic, ...] = ()
    kind: str = ""


def answers(car: Car, *parts: str) -> dict[str, tuple[Series, ...]]:
    """Return the right channels of the parts of a log (``answers`` in ``scoring.toml``)."""
    by_channel: dict[str, list[str]] = {}
    for part in parts:
        by_channel |= SCORING["answers"][part]
    return {name: tuple(eval(each, {}, car.sensors) for each in right) for name, right in by_channel.items()}


def message(
    name: str,
    type_name: str,
    clock: Series,
    fields: Mapping[str, NDArray[Any]],
    *,
    stamp: str | None = "header.stamp",
    constants: Constants | None = None,
) -> Topic:
    """Return a topic at a series' times, with the time in the field ``stamp``."""
    columns: dict[str, NDArray[Any]] = {} if stamp is None else {stamp: clock.stamps_ns}
    return Topic(name, type_name, clock.stamps_ns, clock.arrival_ns, {**columns, **fields}, constants or {})


def xyz(series: Series, prefix: str, names: str = "xyz") -> dict[str, FloatArray]:
    """Return the three columns of a vector as ``prefix.x`` and so on."""
    return {f"{prefix}.{axis}": series.values[:, i] for i, axis in enumerate(names)}


# ------------------------------------------------------------------------------------------------ common messages


def imu(force: Series, rate: Series, name: str = "/imu/data", frame: str = "imu_link") -> Topic:
    """Return ``sensor_msgs/Imu`` without an orientation."""
    columns = xyz(force, "linear_acceleration") | xyz(rate.along(force), "angular_velocity")
    constants: Constants = {"header.frame_id": frame, "orientation_covariance": [-1.0] + [0.0] * 8}
    return message(name, "sensor_msgs/msg/Imu", force, columns, constants={**constants, "orientation.w": 1.0})


def steering(steer: Series, name: str = "/vehicle/status/steering_status") -> Topic:
    """Return Autoware's steering report, as it were the road-wheel angle."""
    fields = {"steering_tire_angle": steer.values}
    return message(name, "autoware_vehicle_msgs/msg/SteeringReport", steer, fields, stamp="stamp")


def velocity(speed: Series, name: str = "/vehicle/status/velocity_status") -> Topic:
    """Return Autoware's velocity report with the forward velocity alone."""
    return message(name, "autoware_vehicle_msgs/msg/VelocityReport", speed, {"longitudinal_velocity": speed.values})


def odometry(
    car: Car, name: str = "/ins/odometry", *, body: Series | None = None, rate: Series | None = None, up_to: int = 1
) -> Topic:
    """Return GNSS/INS as ``nav_msgs/Odometry``; ``body`` and ``rate`` take the place of its velocity and yaw rate."""
    clock = (body or car.body_velocity).every(up_to)
    roll, pitch, yaw = car.attitude.every(up_to).values.T
    pose = xyz(car.position.every(up_to), "pose.pose.position")
    pose["pose.pose.orientation"] = quaternion(roll, pitch, yaw)
    twist = xyz(clock, "twist.twist.linear", "xy")
    twist["twist.twist.angular.z"] = (rate or car.yaw_rate).every(up_to).values
    frames = {"header.frame_id": "map", "child_frame_id": "base_link"}
    return message(name, "nav_msgs/msg/Odometry", clock, pose | twist, constants=frames)


def fix(car: Car, name: str = "/gps/fix") -> Topic:
    """Return the receiver's ``sensor_msgs/NavSatFix``."""
    columns = dict(zip(("latitude", "longitude", "altitude"), car.fix.values.T, strict=True))
    constants: Constants = {"header.frame_id": "gps", "status.service": 1.0, "position_covariance_type": 2.0}
    return message(name, "sensor_msgs/msg/NavSatFix", car.fix, columns, constants=constants)


def scalar(name: str, series: Series, type_name: str = "std_msgs/msg/Float32") -> Topic:
    """Return a topic of one bare number."""
    return message(name, type_name, series, {"data": series.values}, stamp=None)


def road_car(car: Car, **replaced: Topic | None) -> tuple[Topic, ...]:
    """Return IMU, steering, speed and GNSS/INS ground truth; keywords replace a topic, None drops it."""
    usual: dict[str, Topic | None] = {"imu": imu(car.force, car.rate), "steering": steering(car.steer)}
    usual |= {"speed": velocity(car.speed), "truth": odometry(car)}
    return tuple(topic for topic in (usual | replaced).values() if topic is not None)
