"""Sensor readings of a simulated car, in SI units and ISO 8855 axes: the right answers of every log made here."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.records.signals import FloatArray, IntArray
from studies.pages import read_toml
from truthsim.batch import DriveSpec


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Values [N] or [N, k] at their measurement times, and when the recorder had them."""

    stamps_ns: IntArray
    arrival_ns: IntArray
    values: FloatArray

    def __getitem__(self, column: int | tuple[int, ...]) -> "Series":
        """Return one column, or some in a new order."""
        return Series(self.stamps_ns, self.arrival_ns, self.values[:, column])

    def times(self, factor: float | FloatArray, offset: float = 0.0) -> "Series":
        """Return it in another unit, sign or rotation (a matrix [k, k] that turns each row)."""
        turned = self.values @ factor.T if isinstance(factor, np.ndarray) else factor * self.values
        return Series(self.stamps_ns, self.arrival_ns, np.asarray(turned + offset))

    def late(self, seconds: float) -> "Series":
        """Return the values as if they had been measured later than they were."""
        return Series(self.stamps_ns + round(seconds * 1e9), self.arrival_ns + round(seconds * 1e9), self.values)

    def every(self, n: int) -> "Series":
        """Return each n-th sample."""
        return Series(self.stamps_ns[::n], self.arrival_ns[::n], self.values[::n])

    def along(self, clock: "Series") -> "Series":
        """Return it at another series' times: one message with several sensors."""
        clock_s, have = clock.stamps_ns * 1e-9, self.stamps_ns * 1e-9
        columns = self.values if self.values.ndim == 2 else self.values[:, None]
        read = np.stack([np.interp(clock_s - clock_s[0], have - clock_s[0], column) for column in columns.T], axis=1)
        return Series(clock.stamps_ns, clock.arrival_ns, read if self.values.ndim == 2 else read[:, 0])


@dataclass(frozen=True, slots=True, eq=False)
class Topic:
    """One topic: columns by dotted path ([N], [N, k] for an array or a vector struct, int64 ns for a ROS time)."""

    name: str
    type_name: str
    stamps_ns: IntArray
    arrival_ns: IntArray
    fields: Mapping[str, NDArray[Any]]
    constants: Mapping[str, str | float | Sequence[float]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Car:
    """One drive of one car. Each sensor and each quantity is an attribute, too.

    force, rate : specific force (m/s², with gravity) and angular rate (rad/s) of the IMU, forward, left, up, [N, 3].
    steer, steering_wheel : road-wheel angle and angle of the steering wheel, rad, left positive.
    wheels, wheel_rates : of fl, fr, rl, rr, m/s and rad/s, [N, 4]. speed : mean of the rear wheels, m/s.
    position, velocity, attitude : of GNSS/INS: east, north, up (m); east, north (m/s); roll, pitch, yaw (rad, ENU).
    east, north, ground_speed, velocity_enu : of the velocity, m/s, the last with a vertical one of 0, [N, 3].
    course, signed_course, heading : clockwise from north, degrees. course_enu : counter-clockwise from east, rad.
    body_velocity : forward and left, m/s, [N, 2]. yaw_rate : rad/s. fix : latitude, longitude (deg), height (m).
    sideslip : of the GNSS/INS, rad; 0 where the car hardly moves. roll, pitch, yaw, lat, lon, alt : as above.
    """

    ratio: float
    wheel_radius_m: float
    sensors: Mapping[str, Series]

    def __getattr__(self, name: str) -> "Series":
        """Return a sensor or a quantity."""
        if name not in self.sensors:
            raise AttributeError(name)
        return self.sensors[name]


_DRIVES, _SENSORS = (read_toml(Path(__file__).with_name(f"{name}.toml")) for name in ("drives", "sensors"))


@lru_cache(maxsize=16)
def drive(name: str, imu_x_m: float = 0.0) -> Car:
    """Drive one of ``drives.toml``, with the IMU ``imu_x_m`` before the centre of gravity."""
    made = DriveSpec(**_DRIVES[name], sensors=(("imu_x_m", imu_x_m),)).simulate()
    read: dict[str, Series] = {}
    for sensor, (channel_name, *names) in _SENSORS.items():
        channel = made.channels[channel_name]
        values = np.stack([channel.fields[n] for n in names], axis=1)
        series = Series(channel.stamps_ns(made.start_ns), channel.arrival_ns(made.start_ns), values)
        read[sensor] = series if len(names) > 1 else series[0]
    body, attitude = read["body_velocity"], read["attitude"]
    v_x, v_y = body.values.T
    yaw = attitude.values[:, 2]
    east, north = v_x * np.cos(yaw) - v_y * np.sin(yaw), v_x * np.sin(yaw) + v_y * np.cos(yaw)
    course = np.arctan2(east, north) / np.radians(1.0)
    of_body = {
        "velocity": np.stack([east, north], axis=1),
        "velocity_enu": np.stack([east, north, np.zeros_like(east)], axis=1),
        "course_enu": np.arctan2(north, east), "signed_course": course, "course": course % 360.0,
        "east": east, "north": north, "ground_speed": np.hypot(east, north),
        "sideslip": np.where(v_x > 1.0, np.arctan2(v_y, v_x), 0.0),
        "heading": (90.0 - yaw / np.radians(1.0)) % 360.0,
    }  # fmt: skip
    read |= {name: Series(body.stamps_ns, body.arrival_ns, values) for name, values in of_body.items()}
    read |= {name: attitude[i] for i, name in enumerate(("roll", "pitch", "yaw"))}
    read |= {name: read["fix"][i] for i, name in enumerate(("lat", "lon", "alt"))}
    wheels = read["wheels"]
    read["speed"] = wheels.times(np.array([[0.0, 0.0, 0.5, 0.5]]))[0]
    read["wheel_rates"] = Series(wheels.stamps_ns, wheels.arrival_ns, wheels.values / made.vehicle.wheel_radius_m)
    return Car(made.vehicle.steering_ratio, made.vehicle.wheel_radius_m, read)
