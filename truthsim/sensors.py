"""Sensors of the simulated car with noise, bias, drift, delay, tilt and outages, as recorded in a log.

Numbers are from the paper's experiment (docs/method.md#sensors). Every error source has a separate random stream, so
that a change of one does not affect the others.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pdhef_logtool.records.geometry import ecef_from_geodetic, enu_from_ecef_rotation, geodetic_from_ecef
from pdhef_logtool.records.signals import WHEELS, FloatArray, IntArray
from truthsim.motion import Motion
from truthsim.vehicle import Vehicle

#: Local ENU origin of the positions: latitude, longitude (deg), ellipsoidal height (m).
ORIGIN_GEODETIC = (48.0, 11.0, 500.0)

IMU_PERIOD_S = 0.01
#: The steering sensor and the wheel-speed unit sample independently of the IMU.
STEER_PHASE_S = 0.003
WHEEL_PHASE_S = 0.006


class SensorNoise(NamedTuple):
    """Errors of the sensors of a drive: 1-sigma where a spread, SI units.

    White noise is Student-t with 4 degrees of freedom, scaled to the sigma; that of GNSS/INS is Gaussian.

    Attributes
    ----------
    acceleration_m_s2 : white noise of a_x and a_y.
    yaw_rate_rad_s : white noise of the gyro.
    steer_rad : white noise of the road-wheel angle.
    wheel_speed_m_s : white noise of each wheel's speed.
    acceleration_bias_m_s2 : bias of a_x and a_y, constant over a drive.
    yaw_rate_bias_rad_s : bias of the gyro, constant over a drive.
    steer_bias_rad : bias of the road-wheel angle, constant over a drive.
    wheel_scale : relative error of the radius of each wheel.
    acceleration_walk_m_s2 : slow drift of the accelerometers (Ornstein–Uhlenbeck process).
    yaw_rate_walk_rad_s : slow drift of the gyro.
    walk_time_s : time constant of both drifts.
    can_delay_s : delay of each message on the bus.
    jitter_s : further delay, uniform from 0 to this value; the order on a topic is kept.
    rtk_position_m : error of the INS's position.
    rtk_velocity_m_s : error of its velocity.
    rtk_heading_rad : error of its heading.
    rtk_yaw_rate_rad_s : error of its yaw rate.
    rtk_tilt_rad : error of its roll and pitch.
    rtk_time_s : time constant of the errors of the INS; white noise of a third of each sigma is added.
    rtk_delay_s : delay of the INS's messages.
    rtk_heading_offset_rad : unknown mounting of the INS: offset of its heading.
    rtk_x_m : unknown mounting of the INS: position forward of the CG.
    rtk_y_m : the same, position to the left of the CG.
    wheel_dead_m_s : speed below which a wheel with 48 teeth gives no pulse in time and reads 0.
    acceleration_range_m_s2 : full scale of the 16-bit accelerometers; beyond it they read full scale.
    rate_range_rad_s : full scale of the 16-bit gyros.
    imu_x_m : position of the IMU forward of the CG.
    imu_y_m : position of the IMU to the left of the CG.
    imu_z_m : position of the IMU above the CG.
    steering_wheel_step_rad : resolution of the angle, which is measured at the steering wheel: 0.1°.
    steer_gain : relative error of the steering ratio.
    steer_play_rad : total free play between steering wheel and road wheels, as an angle of the road wheels.
    message_loss : share of the messages of IMU, steering and wheel speeds that the bus loses.
    rtk_outages_per_h : outages of the RTK fix per hour; half of them leave a float solution with 30 times the position
        error, in the others the INS coasts.
    rtk_outage_s : their mean duration (exponential distribution).
    """

    acceleration_m_s2: float = 0.12
    yaw_rate_rad_s: float = 0.004
    steer_rad: float = 0.0008
    wheel_speed_m_s: float = 0.08
    acceleration_bias_m_s2: float = 0.08
    yaw_rate_bias_rad_s: float = 0.0015
    steer_bias_rad: float = 0.0008
    wheel_scale: float = 0.003
    acceleration_walk_m_s2: float = 0.02
    yaw_rate_walk_rad_s: float = 0.0004
    walk_time_s: float = 120.0
    can_delay_s: float = 0.010
    jitter_s: float = 0.0
    rtk_position_m: float = 0.010
    rtk_velocity_m_s: float = 0.012
    rtk_heading_rad: float = 0.0005
    rtk_yaw_rate_rad_s: float = 0.0010
    rtk_tilt_rad: float = 0.0005
    rtk_time_s: float = 2.0
    rtk_delay_s: float = 0.020
    rtk_heading_offset_rad: float = 0.0
    rtk_x_m: float = 0.0
    rtk_y_m: float = 0.0
    wheel_dead_m_s: float = 0.15
    acceleration_range_m_s2: float = 16.0
    rate_range_rad_s: float = 4.0
    imu_x_m: float = 0.0
    imu_y_m: float = 0.0
    imu_z_m: float = 0.0
    steering_wheel_step_rad: float = 0.1 * np.pi / 180.0
    steer_gain: float = 0.0
    steer_play_rad: float = 0.0
    message_loss: float = 0.0
    rtk_outages_per_h: float = 0.0
    rtk_outage_s: float = 8.0


#: Values that may be negative: positions and an offset.
SIGNED = frozenset({"imu_x_m", "imu_y_m", "imu_z_m", "rtk_heading_offset_rad", "rtk_x_m", "rtk_y_m"})

#: Quality of a satellite fix, as in NMEA GGA.
RTK_FIXED, RTK_FLOAT, RTK_LOST = 4, 5, 0


class Outage(NamedTuple):
    """Interval in which the RTK only has ``quality``."""

    start_s: float
    end_s: float
    quality: int


@dataclass(frozen=True, slots=True, eq=False)
class SensorChannel:
    """Samples of one sensor.

    Attributes
    ----------
    times_s : [N], measurement time since the start. arrival_s : [N], arrival at the recorder.
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
    motion: Motion,
    vehicle: Vehicle,
    noise: SensorNoise,
    seed: int,
    rtk_rate_hz: int,
    outages: Sequence[Outage] = (),
) -> dict[str, SensorChannel]:
    """Turn a motion recorded at ``IMU_PERIOD_S`` with the phases 0, steering, wheels into sensor channels.

    ``outages`` of the RTK are added to the outages drawn from the noise. Returns ``imu``, ``steering``, ``wheels``,
    ``rtk`` (with the ``quality`` of every sample) and ``fix``.
    """
    names = ("ax", "ay", "yaw_rate", "other", "steer", *WHEELS, "rtk", "arrival", "fix", "gain", "loss", "outages")
    streams = {
        name: np.random.default_rng(np.random.SeedSequence(entropy=seed, spawn_key=(i,)))
        for i, name in enumerate(names)
    }
    channels = {
        "imu": _imu(motion, noise, streams),
        "steering": _steering(motion, vehicle, noise, streams),
        "wheels": _wheels(motion, vehicle, noise, streams),
    }
    every = max(1, round(1.0 / (rtk_rate_hz * IMU_PERIOD_S)))
    drawn = _draw_outages(float(motion.times_s[-1]), noise, streams["outages"])
    rtk = _rtk(motion, noise, streams, every, [*drawn, *outages])
    channels["rtk"] = rtk
    channels["fix"] = _fix(rtk, rtk_rate_hz)
    for name in ("imu", "steering", "wheels"):
        channels[name] = _through_the_bus(channels[name], noise, streams)
    return channels


def _through_the_bus(
    channel: SensorChannel, noise: SensorNoise, streams: dict[str, np.random.Generator]
) -> SensorChannel:
    late = streams["arrival"].uniform(0.0, 1.0, channel.times_s.shape[0]) * noise.jitter_s
    arrival = np.maximum.accumulate(channel.arrival_s + late)
    kept = streams["loss"].uniform(0.0, 1.0, channel.times_s.shape[0]) >= noise.message_loss
    return SensorChannel(channel.times_s[kept], arrival[kept], {k: v[kept] for k, v in channel.fields.items()})


def _columns(motion: Motion, *names: str) -> FloatArray:
    return np.stack([motion.column(name) for name in names], axis=1)


def imu_without_error(motion: Motion, noise: SensorNoise) -> tuple[FloatArray, FloatArray]:
    """Return specific force (m/s²) and rates (rad/s) of perfect sensors at the IMU's position, each [N, 3].

    The distance p from the CG adds ω̇ × p + ω × (ω × p).
    """
    force = _columns(motion, "specific_force_x_m_s2", "specific_force_y_m_s2", "specific_force_z_m_s2")
    rates = _columns(motion, "gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s")
    place = np.array([noise.imu_x_m, noise.imu_y_m, noise.imu_z_m])
    if place.any():
        turning = _columns(motion, "roll_acceleration_rad_s2", "pitch_acceleration_rad_s2", "yaw_acceleration_rad_s2")
        force = force + np.cross(turning, place) + np.cross(rates, np.cross(rates, place))
    return force, rates


def quantised(values: FloatArray, full_scale: float) -> FloatArray:
    """Return the readings of a 16-bit sensor with a symmetric full scale."""
    step = full_scale / 2.0**15
    return np.asarray(np.clip(np.round(values / step), -(2.0**15), 2.0**15 - 1.0) * step)


def _imu(motion: Motion, noise: SensorNoise, streams: dict[str, np.random.Generator]) -> SensorChannel:
    n = motion.times_s.shape[0]
    force, rates = imu_without_error(motion, noise)

    def spoilt(clean: FloatArray, stream: str, white: float, bias: float, walk: float) -> FloatArray:
        rng = streams[stream]
        offset = bias * rng.standard_normal()
        drift = slow_walk(rng, walk, noise.walk_time_s, IMU_PERIOD_S, n)
        return np.asarray(clean + offset + drift + student_t(rng, white, n))

    acceleration = (noise.acceleration_m_s2, noise.acceleration_bias_m_s2, noise.acceleration_walk_m_s2)
    rate = (noise.yaw_rate_rad_s, noise.yaw_rate_bias_rad_s, noise.yaw_rate_walk_rad_s)
    fields = {
        "ax_m_s2": spoilt(force[:, 0], "ax", *acceleration),
        "ay_m_s2": spoilt(force[:, 1], "ay", *acceleration),
        "az_m_s2": spoilt(force[:, 2], "other", *acceleration),
        "roll_rate_rad_s": spoilt(rates[:, 0], "other", *rate),
        "pitch_rate_rad_s": spoilt(rates[:, 1], "other", *rate),
        "yaw_rate_rad_s": spoilt(rates[:, 2], "yaw_rate", *rate),
    }
    for name in fields:
        full_scale = noise.acceleration_range_m_s2 if name.endswith("m_s2") else noise.rate_range_rad_s
        fields[name] = quantised(fields[name], full_scale)
    return SensorChannel(motion.times_s, motion.times_s + noise.can_delay_s, fields)


def _steering(
    motion: Motion, vehicle: Vehicle, noise: SensorNoise, streams: dict[str, np.random.Generator]
) -> SensorChannel:
    """Simulate the sensor at the steering wheel; noise and bias refer to the road-wheel angle, times the ratio."""
    rng = streams["steer"]
    clean = motion.column("steer_rad", 1)
    clean = clean + ahead_by_play(clean, noise.steer_play_rad)
    offset = noise.steer_bias_rad * rng.standard_normal()
    gain = 1.0 + noise.steer_gain * streams["gain"].standard_normal()
    read = gain * clean + offset + student_t(rng, noise.steer_rad, clean.shape[0])
    step = noise.steering_wheel_step_rad
    wheel = np.round(vehicle.steering_ratio * read / step) * step
    times = motion.times_s + motion.phases_s[1]
    return SensorChannel(
        times,
        times + noise.can_delay_s,
        {"steer_rad": wheel / vehicle.steering_ratio, "steering_wheel_rad": wheel},
    )


def ahead_by_play(steer_rad: FloatArray, play_rad: float) -> FloatArray:
    """Return the lead of the steering wheel over the road wheels [N], within half of the play to both sides.

    After a reversal the steering wheel turns twice as far as the road wheels until the play is used up: a spring with
    dry friction (Prandtl's stop element), like a steering column.
    """
    ahead, half = np.zeros_like(steer_rad), 0.5 * play_rad
    value = 0.0
    for k, turned in enumerate(np.diff(steer_rad).tolist(), start=1):
        value = min(half, max(-half, value + turned))
        ahead[k] = value
    return ahead


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


def _draw_outages(end_s: float, noise: SensorNoise, rng: np.random.Generator) -> list[Outage]:
    outages: list[Outage] = []
    time_s = 0.0
    while noise.rtk_outages_per_h > 0.0:
        time_s += rng.exponential(3600.0 / noise.rtk_outages_per_h)
        if time_s >= end_s:
            break
        length = rng.exponential(noise.rtk_outage_s)
        outages.append(Outage(time_s, time_s + length, RTK_FLOAT if rng.uniform() < 0.5 else RTK_LOST))
        time_s += length
    return outages


#: Ratio of the errors of a float solution to the errors of a fixed one: decimetres to centimetres.
_FLOAT_POSITION, _FLOAT_VELOCITY, _FLOAT_ANGLE = 30.0, 4.0, 4.0
#: 1-sigma errors of an INS of this class without satellites: acceleration and yaw rate.
_COAST_M_S2, _COAST_RAD_S = 0.02, 0.0003


def _rtk(
    motion: Motion,
    noise: SensorNoise,
    streams: dict[str, np.random.Generator],
    every: int,
    outages: Sequence[Outage],
) -> SensorChannel:
    """Return GNSS/INS at the assumed CG: ENU position and velocity, attitude, body velocity computed from these."""
    rng = streams["rtk"]
    rows = slice(None, None, every)
    times = motion.times_s[rows]
    n = times.shape[0]
    quality = np.full(n, float(RTK_FIXED))
    coast_s = np.zeros(n)
    drift = np.zeros((n, 4))
    for outage in outages:
        inside = (times >= outage.start_s) & (times < outage.end_s)
        quality[inside] = outage.quality
        if outage.quality == RTK_LOST:
            coast_s[inside] = times[inside] - outage.start_s
            drift[inside] = streams["outages"].standard_normal(4)
    loose = quality == RTK_FLOAT

    def error(sigma: float, in_float: float) -> FloatArray:
        slow = slow_walk(rng, sigma * np.sqrt(8.0) / 3.0, noise.rtk_time_s, every * IMU_PERIOD_S, n)
        return np.asarray((slow + sigma / 3.0 * rng.standard_normal(n)) * np.where(loose, in_float, 1.0))

    yaw = motion.column("yaw_rad")[rows]
    turning = motion.column("yaw_rate_rad_s")[rows]
    v_x = motion.column("vx_m_s")[rows] - turning * noise.rtk_y_m
    v_y = motion.column("vy_m_s")[rows] + turning * noise.rtk_x_m
    x_m = motion.column("x_m")[rows] + noise.rtk_x_m * np.cos(yaw) - noise.rtk_y_m * np.sin(yaw)
    y_m = motion.column("y_m")[rows] + noise.rtk_x_m * np.sin(yaw) + noise.rtk_y_m * np.cos(yaw)
    speed_drift, place_drift = _COAST_M_S2 * coast_s, 0.5 * _COAST_M_S2 * coast_s**2
    east = v_x * np.cos(yaw) - v_y * np.sin(yaw) + error(noise.rtk_velocity_m_s, _FLOAT_VELOCITY)
    north = v_x * np.sin(yaw) + v_y * np.cos(yaw) + error(noise.rtk_velocity_m_s, _FLOAT_VELOCITY)
    east, north = east + speed_drift * drift[:, 0], north + speed_drift * drift[:, 1]
    heading = (
        yaw
        + noise.rtk_heading_offset_rad
        + error(noise.rtk_heading_rad, _FLOAT_ANGLE)
        + _COAST_RAD_S * coast_s * drift[:, 3]
    )
    place = noise.rtk_position_m
    fields = {
        "x_m": x_m + error(place, _FLOAT_POSITION) + place_drift * drift[:, 0],
        "y_m": y_m + error(place, _FLOAT_POSITION) + place_drift * drift[:, 1],
        "z_m": motion.column("z_m")[rows] + error(2.0 * place, _FLOAT_POSITION) + place_drift * drift[:, 2],
        "roll_rad": motion.column("roll_rad")[rows] + error(noise.rtk_tilt_rad, 1.0),
        "pitch_rad": motion.column("pitch_rad")[rows] + error(noise.rtk_tilt_rad, 1.0),
        "yaw_rad": heading,
        "vx_m_s": east * np.cos(heading) + north * np.sin(heading),
        "vy_m_s": -east * np.sin(heading) + north * np.cos(heading),
        "yaw_rate_rad_s": turning + noise.rtk_yaw_rate_rad_s * rng.standard_normal(n),
        "quality": quality,
        "position_std_m": np.where(loose, _FLOAT_POSITION, 1.0) * place + place_drift,
    }
    return SensorChannel(times, times + noise.rtk_delay_s, fields)


def _fix(rtk: SensorChannel, rtk_rate_hz: int) -> SensorChannel:
    """Return the receiver's fix at 10 Hz: geodetic position of the CG, NaN without satellites."""
    rows = slice(None, None, max(1, rtk_rate_hz // 10))
    x, y, z = (rtk.fields[k][rows] for k in ("x_m", "y_m", "z_m"))
    lat, lon, alt = geodetic_from_enu(x, y, z)
    quality = rtk.fields["quality"][rows]
    none = quality == RTK_LOST
    fields = {"lat_deg": lat, "lon_deg": lon, "alt_m": alt}
    fields = {name: np.where(none, np.nan, column) for name, column in fields.items()}
    fields |= {"quality": quality, "position_std_m": rtk.fields["position_std_m"][rows]}
    return SensorChannel(rtk.times_s[rows], rtk.arrival_s[rows], fields)


def geodetic_from_enu(
    east_m: FloatArray, north_m: FloatArray, up_m: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Latitude, longitude (deg) and height (m) of points [N] in the local ENU frame at ``ORIGIN_GEODETIC``."""
    lat, lon, alt = (np.array([v]) for v in ORIGIN_GEODETIC)
    turn = enu_from_ecef_rotation(float(np.deg2rad(lat[0])), float(np.deg2rad(lon[0])))
    ecef = ecef_from_geodetic(lat, lon, alt) + np.stack([east_m, north_m, up_m], axis=1) @ turn
    geodetic = geodetic_from_ecef(ecef)
    return np.rad2deg(geodetic[:, 0]), np.rad2deg(geodetic[:, 1]), geodetic[:, 2]
