"""Turn the columns of a drive into the topics of its log."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs.drive_log import Columns
from pdhef_logtool.records.signals import WHEELS, FloatArray, IntArray
from truthsim.faults import KINDS, TARGETS, Fault
from truthsim.sensors import IMU_PERIOD_S, RTK_FIXED, RTK_LOST, SensorChannel, SensorNoise

#: The steering message has no header, only a stamp.
STEERING_REPORT = """builtin_interfaces/Time stamp
float32 steering_tire_angle
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


#: Resolution of written values, far below the noise (16 µm) or any use (60 nm), because meaningless digits do not
#: compress.
RTK_STEP = 2.0**-16
PERFECT_STEP = 2.0**-24

#: Topics that may be omitted from a log, by their name on the command line.
PARTS: dict[str, tuple[str, ...]] = {
    "imu": ("/imu/data",),
    "steering": ("/vehicle/status/steering_status",),
    "wheels": ("/vehicle/wheel_speeds",),
    "rtk": ("/rtk/odometry", "/rtk/fix", "/rtk/quality"),
    "perfect": ("/truth/perfect/odometry", "/truth/perfect/state"),
    "events": ("/truthsim/events",),
}

_EXACT = (
    "vx_m_s",
    "vy_m_s",
    "yaw_rate_rad_s",
    "sideslip_rad",
    "ax_m_s2",
    "ay_m_s2",
    "roll_rad",
    "roll_rate_rad_s",
    "pitch_rad",
    "steer_rad",
    "friction",
    "bank_rad",
    "grade_rad",
)


@dataclass(frozen=True, slots=True, eq=False)
class Topic:
    """One topic of the log: constants of every message, and the columns.

    ``definition`` is only needed for types that neither ROS 2 nor ``schemas/`` contains.
    """

    name: str
    type_name: str
    constants: Mapping[str, str | float | Sequence[float]]
    stamps_ns: IntArray
    arrival_ns: IntArray
    fields: Mapping[str, NDArray[Any]]
    definition: str | None = None

    def between(self, start_ns: int, end_ns: int) -> Columns:
        """Return the messages that arrive in [start, end)."""
        rows = slice(*np.searchsorted(self.arrival_ns, [start_ns, end_ns], side="left").tolist())
        return Columns(
            topic=self.name,
            log_time_ns=self.arrival_ns[rows],
            publish_time_ns=self.stamps_ns[rows],
            fields={path: column[rows] for path, column in self.fields.items()},
        )


def quaternion(roll_rad: FloatArray, pitch_rad: FloatArray, yaw_rad: FloatArray) -> FloatArray:
    """Hamilton quaternions [N, 4] (w, x, y, z) of yaw, then pitch, then roll, which rotate the body into ENU."""
    cr, sr = np.cos(roll_rad / 2), np.sin(roll_rad / 2)
    cp, sp = np.cos(pitch_rad / 2), np.sin(pitch_rad / 2)
    cy, sy = np.cos(yaw_rad / 2), np.sin(yaw_rad / 2)
    return np.stack(
        [
            cy * cp * cr + sy * sp * sr,
            cy * cp * sr - sy * sp * cr,
            cy * sp * cr + sy * cp * sr,
            sy * cp * cr - cy * sp * sr,
        ],
        axis=1,
    )


def topics_of(
    channels: Mapping[str, SensorChannel],
    times_s: FloatArray,
    truth: Mapping[str, FloatArray],
    *,
    noise: SensorNoise,
    faults: Sequence[Fault],
    rtk_rate_hz: int,
    start_ns: int,
    steering_wheel: bool,
) -> Iterator[Topic]:
    """Yield the topics of a log: sensors, RTK and exact ground truth, and the faults if any.

    ``steering_wheel`` adds the angle at the steering wheel, the measured quantity of the steering sensor.
    """
    imu, steering, wheels = (channels[k] for k in ("imu", "steering", "wheels"))

    def topic(
        name: str,
        type_name: str,
        channel: SensorChannel,
        *,
        constants: Mapping[str, str | float | Sequence[float]],
        fields: Mapping[str, NDArray[Any]],
    ) -> Topic:
        stamps, arrival = channel.stamps_ns(start_ns), channel.arrival_ns(start_ns)
        return Topic(name, type_name, constants, stamps, arrival, {"header.stamp": stamps, **fields})

    acceleration, rate = noise.acceleration_m_s2**2, noise.yaw_rate_rad_s**2
    yield topic(
        "/imu/data",
        "sensor_msgs/msg/Imu",
        imu,
        constants={
            "header.frame_id": "base_link",
            "orientation_covariance": [-1.0] + [0.0] * 8,
            "angular_velocity_covariance": _diagonal(rate, rate, rate),
            "linear_acceleration_covariance": _diagonal(acceleration, acceleration, acceleration),
        },
        fields={
            "linear_acceleration.x": imu.fields["ax_m_s2"],
            "linear_acceleration.y": imu.fields["ay_m_s2"],
            "linear_acceleration.z": imu.fields["az_m_s2"],
            "angular_velocity.x": imu.fields["roll_rate_rad_s"],
            "angular_velocity.y": imu.fields["pitch_rate_rad_s"],
            "angular_velocity.z": imu.fields["yaw_rate_rad_s"],
        },
    )
    stamps = steering.stamps_ns(start_ns)
    yield Topic(
        "/vehicle/status/steering_status",
        "autoware_vehicle_msgs/msg/SteeringReport",
        {},
        stamps,
        steering.arrival_ns(start_ns),
        {"stamp": stamps, "steering_tire_angle": steering.fields["steer_rad"]},
        definition=STEERING_REPORT,
    )
    if steering_wheel:
        yield topic(
            "/vehicle/steering_wheel",
            "truthsim_msgs/msg/SteeringWheel",
            steering,
            constants={"header.frame_id": "base_link"},
            fields={"angle_rad": steering.fields["steering_wheel_rad"]},
        )
    yield topic(
        "/vehicle/wheel_speeds",
        "truthsim_msgs/msg/WheelSpeeds",
        wheels,
        constants={"header.frame_id": "base_link"},
        fields={f"{w}_m_s": wheels.fields[f"{w}_m_s"] for w in WHEELS},
    )

    rtk, fix = channels["rtk"], channels["fix"]
    held = not np.all(rtk.fields["quality"] == RTK_FIXED)
    place, tilt = noise.rtk_position_m**2, noise.rtk_tilt_rad**2
    # The heading error adds a lateral velocity error in the body frame: 0.015 m/s at 30 m/s.
    speed = noise.rtk_velocity_m_s**2 + (30.0 * noise.rtk_heading_rad) ** 2
    yield topic(
        "/rtk/odometry",
        "nav_msgs/msg/Odometry",
        rtk,
        constants={
            "header.frame_id": "map",
            "child_frame_id": "base_link",
            "pose.covariance": _diagonal(place, place, 4.0 * place, tilt, tilt, noise.rtk_heading_rad**2),
            "twist.covariance": _diagonal(speed, speed, speed, rate, rate, noise.rtk_yaw_rate_rad_s**2),
        },
        fields=_rounded(_odometry(rtk.fields), RTK_STEP) | (_pose_covariance(rtk, noise) if held else {}),
    )
    yield topic(
        "/rtk/fix",
        "sensor_msgs/msg/NavSatFix",
        fix,
        constants={
            "header.frame_id": "base_link",
            "status.service": 1.0,
            "position_covariance_type": 2.0,
        },
        fields={
            "latitude": fix.fields["lat_deg"],
            "longitude": fix.fields["lon_deg"],
            "altitude": fix.fields["alt_m"],
            # sensor_msgs/NavSatStatus: ground-based augmentation, a plain fix, none.
            "status.status": np.select(
                [fix.fields["quality"] == RTK_FIXED, fix.fields["quality"] == RTK_LOST], [2, -1], 0
            ),
            "position_covariance": _diagonals(fix.fields["position_std_m"][:, None] ** 2 * np.array([1.0, 1.0, 4.0])),
        },
    )
    yield topic(
        "/rtk/quality",
        "truthsim_msgs/msg/RtkQuality",
        fix,
        constants={"header.frame_id": "base_link"},
        fields={"quality": fix.fields["quality"], "position_std_m": fix.fields["position_std_m"]},
    )

    every = max(1, round(1.0 / (rtk_rate_hz * IMU_PERIOD_S)))
    exact = {name: column[::every] for name, column in truth.items()}
    perfect = SensorChannel(times_s[::every], times_s[::every], exact)
    yield topic(
        "/truth/perfect/odometry",
        "nav_msgs/msg/Odometry",
        perfect,
        constants={"header.frame_id": "map", "child_frame_id": "base_link"},
        fields=_rounded(_odometry(exact), PERFECT_STEP),
    )
    yield topic(
        "/truth/perfect/state",
        "truthsim_msgs/msg/VehicleTruth",
        perfect,
        constants={"header.frame_id": "base_link"},
        fields={
            **_rounded({name: exact[name] for name in _EXACT}, PERFECT_STEP),
            "longitudinal_force_n": np.stack([exact[f"fx_{w}_n"] for w in WHEELS], axis=1),
            "lateral_force_n": np.stack([exact[f"fy_{w}_n"] for w in WHEELS], axis=1),
            "vertical_force_n": np.stack([exact[f"fz_{w}_n"] for w in WHEELS], axis=1),
            "slip_angle_rad": np.stack([exact[f"slip_angle_{w}_rad"] for w in WHEELS], axis=1),
        },
    )
    if faults:
        yield _events(faults, float(times_s[-1]), start_ns)


def _events(faults: Sequence[Fault], end_s: float, start_ns: int) -> Topic:
    """Return two messages per fault, at its start and at its end, or at the end of the drive."""
    rows = [
        (
            min(at_s, end_s),
            KINDS.index(f.kind),
            TARGETS.index(f.target),
            active,
            f.value,
            f.start_s,
            min(f.end_s, end_s),
        )
        for f in faults
        for at_s, active in ((f.start_s, 1.0), (f.end_s, 0.0))
        if f.start_s <= end_s
    ]
    table = np.array(sorted(rows), dtype=np.float64).reshape(-1, 7)
    stamps = start_ns + np.round(table[:, 0] * 1e6).astype(np.int64) * 1000
    names = ("kind", "target", "active", "value", "start_s", "end_s")
    return Topic(
        "/truthsim/events",
        "truthsim_msgs/msg/SensorFault",
        {"header.frame_id": "base_link"},
        stamps,
        stamps,
        {"header.stamp": stamps, **{name: table[:, i] for i, name in enumerate(names, start=1)}},
    )


def _pose_covariance(rtk: SensorChannel, noise: SensorNoise) -> dict[str, FloatArray]:
    place = rtk.fields["position_std_m"] ** 2
    angle = np.full_like(place, noise.rtk_tilt_rad**2)
    heading = np.full_like(place, noise.rtk_heading_rad**2)
    return {"pose.covariance": _diagonals(np.stack([place, place, 4.0 * place, angle, angle, heading], axis=1))}


def _diagonals(values: FloatArray) -> FloatArray:
    """Diagonal matrices [N, k * k], row-major, of their diagonals [N, k]."""
    n, k = values.shape
    out = np.zeros((n, k * k))
    out[:, :: k + 1] = values
    return out


def _diagonal(*values: float) -> list[float]:
    return np.diag(np.array(values)).ravel().tolist()


def _rounded(fields: Mapping[str, FloatArray], step: float) -> dict[str, FloatArray]:
    return {path: np.asarray(np.round(column / step) * step) for path, column in fields.items()}


def _odometry(state: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    return {
        "pose.pose.position.x": state["x_m"],
        "pose.pose.position.y": state["y_m"],
        "pose.pose.position.z": state["z_m"],
        "pose.pose.orientation": quaternion(state["roll_rad"], state["pitch_rad"], state["yaw_rad"]),
        "twist.twist.linear.x": state["vx_m_s"],
        "twist.twist.linear.y": state["vy_m_s"],
        "twist.twist.angular.z": state["yaw_rate_rad_s"],
    }
