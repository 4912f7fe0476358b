"""Sensor readings of a simulated car, in SI units and ISO 8855 axes: the right answers of every log made here."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from pdhef_logtool.records.signals import FloatArray, IntArray
from studies.pages import read_toml
from truthsim.batch import DriveSpec


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Values [N] or [N, k] at their measurement times, and when the recorder had them."""

    stamps_ns: IntArray
    arrival_ns: IntArray
    values: FloatArray

    def __getitem__(self, column: int | tuple[int, ...]) -> Series:
        """Return one column, or some in a new order."""
        return Series(self.stamps_ns, self.arrival_ns, self.values[:, column])

    def times(self, factor: float | FloatArray, offset: float = 0.0) -> Series:
        """Return it in another unit, sign or rotation (a matrix [k, k] that turns each row)."""
        turned = self.values @ factor.T if isinstance(factor, np.ndarray) else factor * self.values
        return Series(self.stamps_ns, self.arrival_ns, np.asarray(turned + offset))

    def late(self, seconds: float) -> Series:
        """Return the values as if they had been measured later than they were."""
        return Series(self.stamps_ns + round(seconds * 1e9), self.arrival_ns + round(seconds * 1e9), self.values)

    def every(self, n: int) -> Series:
        """Return each n-th sample."""
        return Series(self.stamps_ns[::n], self.arrival_ns[::n], self.values[::n])

    def along(self, clock: Series) -> Series:
        """Return it at another series' times: one message with several sensors."""
        clock_s, have = clock.stamps_ns * 1e-9, self.stamps_ns * 1e-9
        columns = self.values if self.values.ndim == 2 else self.values[:, None]
        read = np.stack([np.interp(clock_s - clock_s[0], have - clock_s[0], column) for column in columns.T], axis=1)
        return Series(clock.stamps_ns, clock.arrival_ns, read if self.values.ndim == 2 else read[:, 0])


@dataclass(frozen=True, slots=True, eq=False)
class Car:
    """One drive of one car.

    Attributes
    ----------
    force, rate : specific force (m/s², with gravity) and angular rate (rad/s) of the IMU, forward, left, up, [N, 3].
    steer, steering_wheel : road-wheel angle and angle of the steering wheel, rad, left positive.
    wheels : speeds of fl, fr, rl, rr, m/s, [N, 4]. ratio, wheel_radius_m : of steering and wheels.
    position, velocity, attitude : of GNSS/INS: east, north, up (m); east, north (m/s); roll, pitch, yaw (rad, ENU).
    body_velocity : forward and left, m/s, [N, 2]. yaw_rate : rad/s. fix : latitude, longitude (deg), height (m).
    """

    force: Series
    rate: Series
    steer: Series
    steering_wheel: Series
    wheels: Series
    ratio: float
    wheel_radius_m: float
    position: Series
    velocity: Series
    attitude: Series
    body_velocity: Series
    yaw_rate: Series
    fix: Series

    @property
    def speed(self) -> Series:
        """Mean of the rear wheels, m/s."""
        return self.wheels.times(np.array([[0.0, 0.0, 0.5, 0.5]]))[0]

    @property
    def ground_speed(self) -> Series:
        """Speed over ground as GNSS gives it, m/s."""
        v = self.velocity
        return Series(v.stamps_ns, v.arrival_ns, np.hypot(v.values[:, 0], v.values[:, 1]))

    @property
    def sideslip(self) -> Series:
        """Sideslip of the GNSS/INS, rad; 0 where the car hardly moves."""
        v = self.body_velocity
        moves = v.values[:, 0] > 1.0
        return Series(v.stamps_ns, v.arrival_ns, np.where(moves, np.arctan2(v.values[:, 1], v.values[:, 0]), 0.0))


_DRIVES = read_toml(Path(__file__).with_name("drives.toml"))
#: Channel of the simulator and its columns, by the name in :class:`Car`.
_SENSORS = {
    "force": ("imu", "ax_m_s2", "ay_m_s2", "az_m_s2"),
    "rate": ("imu", "roll_rate_rad_s", "pitch_rate_rad_s", "yaw_rate_rad_s"),
    "steer": ("steering", "steer_rad"),
    "steering_wheel": ("steering", "steering_wheel_rad"),
    "wheels": ("wheels", "fl_m_s", "fr_m_s", "rl_m_s", "rr_m_s"),
    "position": ("rtk", "x_m", "y_m", "z_m"),
    "attitude": ("rtk", "roll_rad", "pitch_rad", "yaw_rad"),
    "body_velocity": ("rtk", "vx_m_s", "vy_m_s"),
    "yaw_rate": ("rtk", "yaw_rate_rad_s"),
    "fix": ("fix", "lat_deg", "lon_deg", "alt_m"),
}


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
    body, yaw = read["body_velocity"], read["attitude"].values[:, 2]
    v_x, v_y = body.values.T
    enu = np.stack([v_x * np.cos(yaw) - v_y * np.sin(yaw), v_x * np.sin(yaw) + v_y * np.cos(yaw)], axis=1)
    velocity = Series(body.stamps_ns, body.arrival_ns, enu)
    return Car(**read, velocity=velocity, ratio=made.vehicle.steering_ratio, wheel_radius_m=made.vehicle.wheel_radius_m)
