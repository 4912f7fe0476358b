"""Sensors of the simulated car: what a recorder would have got, with noise, bias, drift, delay and tilt.

Numbers are the paper experiment's (METHOD §9). Every error source draws from a stream of its own, so that changing one
leaves the others as they were.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pdhef_logtool.geometry import ecef_from_geodetic, enu_from_ecef_rotation, geodetic_from_ecef
from pdhef_logtool.signals import WHEELS, FloatArray, IntArray
from truthsim.motion import Motion
from truthsim.vehicle import GRAVITY_M_S2, Vehicle

#: Local ENU origin of the positions: latitude, longitude (deg), ellipsoidal height (m).
ORIGIN_GEODETIC = (48.0, 11.0, 500.0)

IMU_PERIOD_S = 0.01
#: A steering sensor and the wheel-speed unit sample when they like, not when the IMU does.
STEER_PHASE_S = 0.003
WHEEL_PHASE_S = 0.006


class SensorNoise(NamedTuple):
    """1-sigma errors. White noise is Student-t with 4 degrees of freedom scaled to the sigma; GNSS/INS is Gaussian."""

    acceleration_m_s2: float = 0.12
    yaw_rate_rad_s: float = 0.004
    steer_rad: float = 0.0008
    wheel_speed_m_s: float = 0.08
    acceleration_bias_m_s2: float = 0.08
    yaw_rate_bias_rad_s: float = 0.0015
    steer_bias_rad: float = 0.0008
    wheel_scale: float = 0.003
    #: Slow walk: Ornstein–Uhlenbeck with this spread and time constant.
    acceleration_walk_m_s2: float = 0.02
    yaw_rate_walk_rad_s: float = 0.0004
    walk_time_s: float = 120.0
    can_delay_s: float = 0.010
    #: Further arrival delay, uniform in [0, jitter]; order on a topic is kept.
    jitter_s: float = 0.0
    rtk_position_m: float = 0.010
    rtk_velocity_m_s: float = 0.012
    rtk_heading_rad: float = 0.0005
    rtk_yaw_rate_rad_s: float = 0.0010
    rtk_tilt_rad: float = 0.0005
    #: Time constant of the INS's own error; white noise of a third of each sigma comes on top.
    rtk_time_s: float = 2.0
    rtk_delay_s: float = 0.020
    #: A toothed wheel with 48 teeth gives no pulse in time below this speed, and the sensor reads zero.
    wheel_dead_m_s: float = 0.15


#: Sensors that err in nothing but delay, tilt, wheel slip and quantisation.
NO_NOISE = SensorNoise(
    acceleration_m_s2=0.0,
    yaw_rate_rad_s=0.0,
    steer_rad=0.0,
    wheel_speed_m_s=0.0,
    acceleration_bias_m_s2=0.0,
    yaw_rate_bias_rad_s=0.0,
    steer_bias_rad=0.0,
    wheel_scale=0.0,
    acceleration_walk_m_s2=0.0,
    yaw_rate_walk_rad_s=0.0,
    rtk_position_m=0.0,
    rtk_velocity_m_s=0.0,
    rtk_heading_rad=0.0,
    rtk_yaw_rate_rad_s=0.0,
    rtk_tilt_rad=0.0,
)


@dataclass(frozen=True, slots=True, eq=False)
class SensorChannel:
    """Samples of one sensor.

    Attributes
    ----------
    times_s : [N], measurement time since the start. arrival_s : [N], when the recorder had it.
    fields : by name with unit, each [N].
    """

    times_s: FloatArray
    arrival_s: FloatArray
    fields: dict[str, FloatArray]

    def stamps_ns(self, start_ns: int) -> IntArray:
        """Return measurement times in ns, to the microsecond."""
        return start_ns + np.round(self.times_s * 1e6).astype(np.int64) * 1000

    def arrival_ns(self, start_ns: int) -> IntArray:
        """Return arrival times in ns, to the microsecond."""
        return start_ns + np.round(self.arrival_s * 1e6).astype(np.int64) * 1000


def student_t(rng: np.random.Generator, sigma: float, size: int) -> FloatArray:
    """Student-t noise with 4 degrees of freedom and standard deviation ``sigma`` (its variance is 4/(4−2) = 2)."""
    return np.asarray(rng.standard_t(4, size) * (sigma / np.sqrt(2.0)), dtype=np.float64)


def slow_walk(rng: np.random.Generator, sigma: float, time_constant_s: float, step_s: float, size: int) -> FloatArray:
    """Ornstein–Uhlenbeck process with stationary standard deviation ``sigma``, started from that distribution."""
    keep = np.exp(-step_s / time_constant_s)
    drive = rng.standard_normal(size)
    drive[1:] *= np.sqrt(1.0 - keep**2)
    walk = np.empty(size)
    value = 0.0
    for i, d in enumerate(drive.tolist()):
        value = keep * value + d
        walk[i] = value
    return np.asarray(sigma * walk)


def sense(
    motion: Motion, vehicle: Vehicle, noise: SensorNoise, seed: int, rtk_rate_hz: int
) -> dict[str, SensorChannel]:
    """Turn a motion recorded at ``IMU_PERIOD_S`` with the phases 0, steering, wheels into sensor channels.

    Returns ``imu``, ``steering``, ``wheels``, ``rtk`` and ``fix``.
    """
    names = ("ax", "ay", "yaw_rate", "other", "steer", *WHEELS, "rtk", "arrival", "fix")
    streams = {
        name: np.random.default_rng(np.random.SeedSequence(entropy=seed, spawn_key=(i,)))
        for i, name in enumerate(names)
    }
    channels = {
        "imu": _imu(motion, noise, streams),
        "steering": _steering(motion, noise, streams["steer"]),
        "wheels": _wheels(motion, vehicle, noise, streams),
    }
    rtk = _rtk(motion, noise, streams["rtk"], max(1, round(1.0 / (rtk_rate_hz * IMU_PERIOD_S))))
    channels["rtk"] = rtk
    channels["fix"] = _fix(rtk, rtk_rate_hz)
    for name in ("imu", "steering", "wheels"):
        channels[name] = _with_jitter(channels[name], noise, streams["arrival"])
    return channels


def _with_jitter(channel: SensorChannel, noise: SensorNoise, rng: np.random.Generator) -> SensorChannel:
    late = rng.uniform(0.0, 1.0, channel.times_s.shape[0]) * noise.jitter_s
    arrival = np.maximum.accumulate(channel.arrival_s + late)
    return SensorChannel(channel.times_s, arrival, channel.fields)


def specific_force_m_s2(motion: Motion) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What a perfect accelerometer fixed to the body at the CG reads on its x, y, z axes, each [N].

    The planar acceleration and gravity's reaction seen from a body rolled by φ (positive to the right) and pitched by
    θ (positive nose down): to first order a_y + g φ and a_x − g θ.
    """
    a_x, a_y = motion.column("ax_m_s2"), motion.column("ay_m_s2")
    roll, pitch = motion.column("roll_rad"), motion.column("pitch_rad")
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    # Rows of Rx(roll)ᵀ Ry(pitch)ᵀ on (a_x, a_y, g).
    x = cp * a_x - sp * GRAVITY_M_S2
    up = sp * a_x + cp * GRAVITY_M_S2
    return x, cr * a_y + sr * up, -sr * a_y + cr * up


def body_rates_rad_s(motion: Motion) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What perfect gyros fixed to the body read on its x, y, z axes, each [N]."""
    roll, pitch = motion.column("roll_rad"), motion.column("pitch_rad")
    roll_rate, pitch_rate = motion.column("roll_rate_rad_s"), motion.column("pitch_rate_rad_s")
    yaw_rate = motion.column("yaw_rate_rad_s")
    cr, sr = np.cos(roll), np.sin(roll)
    level = yaw_rate * np.cos(pitch)
    return roll_rate - yaw_rate * np.sin(pitch), pitch_rate * cr + level * sr, level * cr - pitch_rate * sr


def _imu(motion: Motion, noise: SensorNoise, streams: dict[str, np.random.Generator]) -> SensorChannel:
    n = motion.times_s.shape[0]
    clean_x, clean_y, clean_z = specific_force_m_s2(motion)
    rate_x, rate_y, rate_z = body_rates_rad_s(motion)

    def spoilt(clean: FloatArray, stream: str, white: float, bias: float, walk: float) -> FloatArray:
        rng = streams[stream]
        offset = bias * rng.standard_normal()
        drift = slow_walk(rng, walk, noise.walk_time_s, IMU_PERIOD_S, n)
        return np.asarray(clean + offset + drift + student_t(rng, white, n))

    acceleration = (noise.acceleration_m_s2, noise.acceleration_bias_m_s2, noise.acceleration_walk_m_s2)
    rate = (noise.yaw_rate_rad_s, noise.yaw_rate_bias_rad_s, noise.yaw_rate_walk_rad_s)
    fields = {
        "ax_m_s2": spoilt(clean_x, "ax", *acceleration),
        "ay_m_s2": spoilt(clean_y, "ay", *acceleration),
        "az_m_s2": spoilt(clean_z, "other", *acceleration),
        "roll_rate_rad_s": spoilt(rate_x, "other", *rate),
        "pitch_rate_rad_s": spoilt(rate_y, "other", *rate),
        "yaw_rate_rad_s": spoilt(rate_z, "yaw_rate", *rate),
    }
    # Steps of a 16-bit sensor of ±16 m/s² and ±4 rad/s.
    for name in fields:
        step = 2.0**-11 if name.endswith("m_s2") else 2.0**-13
        fields[name] = np.round(fields[name] / step) * step
    return SensorChannel(motion.times_s, motion.times_s + noise.can_delay_s, fields)


def _steering(motion: Motion, noise: SensorNoise, rng: np.random.Generator) -> SensorChannel:
    clean = motion.column("steer_rad", 1)
    offset = noise.steer_bias_rad * rng.standard_normal()
    times = motion.times_s + motion.phases_s[1]
    return SensorChannel(
        times,
        times + noise.can_delay_s,
        {"steer_rad": clean + offset + student_t(rng, noise.steer_rad, clean.shape[0])},
    )


def _wheels(
    motion: Motion, vehicle: Vehicle, noise: SensorNoise, streams: dict[str, np.random.Generator]
) -> SensorChannel:
    times = motion.times_s + motion.phases_s[2]
    fields = {}
    for w in WHEELS:
        rng = streams[w]
        rim = motion.column(f"spin_{w}_rad_s", 2) * vehicle.wheel_radius_m
        scale = 1.0 + noise.wheel_scale * rng.standard_normal()
        read = np.maximum(scale * rim + student_t(rng, noise.wheel_speed_m_s, rim.shape[0]), 0.0)
        step = 2.0**-8
        fields[f"{w}_m_s"] = np.where(np.abs(rim) < noise.wheel_dead_m_s, 0.0, np.round(read / step) * step)
    return SensorChannel(times, times + noise.can_delay_s, fields)


def _rtk(motion: Motion, noise: SensorNoise, rng: np.random.Generator, every: int) -> SensorChannel:
    """GNSS/INS at the CG: ENU position and velocity, attitude, and the body velocity that follows from them."""
    rows = slice(None, None, every)
    n = motion.times_s[rows].shape[0]

    def error(sigma: float) -> FloatArray:
        slow = slow_walk(rng, sigma * np.sqrt(8.0) / 3.0, noise.rtk_time_s, every * IMU_PERIOD_S, n)
        return np.asarray(slow + sigma / 3.0 * rng.standard_normal(n))

    yaw = motion.column("yaw_rad")[rows]
    v_x, v_y = motion.column("vx_m_s")[rows], motion.column("vy_m_s")[rows]
    east = v_x * np.cos(yaw) - v_y * np.sin(yaw) + error(noise.rtk_velocity_m_s)
    north = v_x * np.sin(yaw) + v_y * np.cos(yaw) + error(noise.rtk_velocity_m_s)
    heading = yaw + error(noise.rtk_heading_rad)
    fields = {
        "x_m": motion.column("x_m")[rows] + error(noise.rtk_position_m),
        "y_m": motion.column("y_m")[rows] + error(noise.rtk_position_m),
        "z_m": error(2.0 * noise.rtk_position_m),
        "roll_rad": motion.column("roll_rad")[rows] + error(noise.rtk_tilt_rad),
        "pitch_rad": motion.column("pitch_rad")[rows] + error(noise.rtk_tilt_rad),
        "yaw_rad": heading,
        "vx_m_s": east * np.cos(heading) + north * np.sin(heading),
        "vy_m_s": -east * np.sin(heading) + north * np.cos(heading),
        "yaw_rate_rad_s": motion.column("yaw_rate_rad_s")[rows] + noise.rtk_yaw_rate_rad_s * rng.standard_normal(n),
    }
    times = motion.times_s[rows]
    return SensorChannel(times, times + noise.rtk_delay_s, fields)


def _fix(rtk: SensorChannel, rtk_rate_hz: int) -> SensorChannel:
    """The receiver's own fix at 10 Hz: geodetic position of the CG."""
    rows = slice(None, None, max(1, rtk_rate_hz // 10))
    x, y, z = (rtk.fields[k][rows] for k in ("x_m", "y_m", "z_m"))
    lat, lon, alt = geodetic_from_enu(x, y, z)
    return SensorChannel(rtk.times_s[rows], rtk.arrival_s[rows], {"lat_deg": lat, "lon_deg": lon, "alt_m": alt})


def geodetic_from_enu(
    east_m: FloatArray, north_m: FloatArray, up_m: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Latitude, longitude (deg) and height (m) of points [N] in the local ENU frame at ``ORIGIN_GEODETIC``."""
    lat, lon, alt = (np.array([v]) for v in ORIGIN_GEODETIC)
    turn = enu_from_ecef_rotation(float(np.deg2rad(lat[0])), float(np.deg2rad(lon[0])))
    ecef = ecef_from_geodetic(lat, lon, alt) + np.stack([east_m, north_m, up_m], axis=1) @ turn
    found = geodetic_from_ecef(ecef)
    return np.rad2deg(found[:, 0]), np.rad2deg(found[:, 1]), found[:, 2]
