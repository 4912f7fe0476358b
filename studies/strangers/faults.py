"""Logs of a well-known layout with one thing wrong in each: mounting, unit, sign, place, delay, what is missing."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import permutations, product

import numpy as np

from pdhef_logtool.records.signals import FloatArray
from studies.strangers.cars import Car, Series, drive
from studies.strangers.containers import Topic
from studies.strangers.recordings import (
    DEG,
    DOWN,
    G_M_S2,
    KMH,
    Recording,
    answers,
    fix,
    imu,
    message,
    odometry,
    road_car,
    scalar,
    steering,
    velocity,
)

USUAL = ("imu", "steer", "speed", "truth", "truth rate")
IMU = frozenset({"ax_m_s2", "ay_m_s2", "yaw_rate_rad_s"})
#: Words for an IMU that does not lie as the car does.
MOUNTING = r"mount|rotat|upside|z-down|z down|lies|imu[^.;]{0,60}(turned|tilt)|(turned|tilt)[^.;]{0,60}imu"
_EMPTY = np.empty(0, dtype=np.int64)


def right_angles() -> list[FloatArray]:
    """Return the 24 rotations in steps of 90 degrees, the identity first."""
    found = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        turn = np.zeros((3, 3))
        turn[range(3), order] = signs
        if np.linalg.det(turn) > 0.0:
            found.append(turn)
    return found


def rotation(axis: tuple[float, float, float], angle_rad: float) -> FloatArray:
    """Return the matrix of a turn about an axis (Rodrigues)."""
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle_rad) * cross + (1.0 - np.cos(angle_rad)) * cross @ cross)


def mountings() -> Iterator[Recording]:
    """IMUs turned by 90 degrees about any axis, by 7 degrees about a skew one, and with z down."""
    car = drive("short")
    for i, turn in enumerate(right_angles()):
        upright = i == 0
        yield Recording(
            name=f"mounting-{i:02}",
            kind="mounting-90",
            group="fault",
            what="IMU turned in steps of 90 degrees, all 24 ways",
            container="mcap",
            topics=road_car(car, imu=imu(car.force.times(turn), car.rate.times(turn))),
            right=answers(car, *USUAL),
            cause="" if upright else MOUNTING,
            at_fault=frozenset() if upright else IMU,
        )
    for name, what, turn in (
        ("mounting-7deg", "IMU tilted by 7 degrees about a skew axis", rotation((1.0, 1.0, 0.0), 7.0 * DEG)),
        ("z-down", "IMU with axes forward, right, down", DOWN),
    ):
        car = drive("sedan")
        yield Recording(
            name=name,
            group="fault",
            what=what,
            container="mcap",
            topics=road_car(car, imu=imu(car.force.times(turn), car.rate.times(turn))),
            right=answers(car, *USUAL),
            cause=MOUNTING,
            at_fault=IMU,
        )


def units_and_signs() -> Iterator[Recording]:
    """One quantity of a sound log in another unit, or with its sign turned."""
    car = drive("sedan")
    side = np.diag([1.0, -1.0, 1.0])
    yaw = np.diag([1.0, 1.0, -1.0])
    units, signs = r"unit|degree|deg/s|\bdeg\b|km/h|\bg\b|factor|scale|57\.|9\.8|3\.6", r"sign|negat|opposite|mirror"
    planted: tuple[tuple[str, str, str, str, dict[str, Topic]], ...] = (
        ("accelerations-in-g", "accelerations in g", "ax_m_s2 ay_m_s2", units,
         {"imu": imu(car.force.times(1.0 / G_M_S2), car.rate)}),
        ("yaw-rate-deg", "angular rates of the IMU in deg/s", "yaw_rate_rad_s", units,
         {"imu": imu(car.force, car.rate.times(1.0 / DEG))}),
        ("steering-deg", "road-wheel angle in degrees", "steer_rad", units,
         {"steering": steering(car.steer.times(1.0 / DEG))}),
        ("speed-kmh", "speed in km/h", "speed_m_s", units, {"speed": velocity(car.speed.times(1.0 / KMH))}),
        ("ay-sign", "lateral acceleration positive to the right", "ay_m_s2", signs,
         {"imu": imu(car.force.times(side), car.rate)}),
        ("yaw-rate-sign", "yaw rate positive to the right", "yaw_rate_rad_s", signs,
         {"imu": imu(car.force, car.rate.times(yaw))}),
        ("steering-sign", "steering positive to the right", "steer_rad", signs,
         {"steering": steering(car.steer.times(-1.0))}),
        ("truth-rates-deg", "truth rates in deg/s in nav_msgs/Odometry", "truth.yaw_rate_rad_s", units,
         {"truth": odometry(car, rate=car.yaw_rate.times(1.0 / DEG))}),
    )  # fmt: skip
    for name, what, at_fault, cause, topics in planted:
        yield Recording(
            name=name,
            group="fault",
            what=what,
            container="mcap",
            topics=road_car(car, **topics),
            right=answers(car, *USUAL),
            cause=cause,
            at_fault=frozenset(at_fault.split()),
        )
    brief = drive("brief")
    for name, what, factor in (
        ("steering-deg-brief", "12 s with the road-wheel angle in degrees", 1.0 / DEG),
        ("steering-sign-brief", "12 s with steering positive to the right", -1.0),
    ):
        yield Recording(
            name=name,
            group="fault",
            what=what,
            container="mcap",
            topics=road_car(brief, steering=steering(brief.steer.times(factor))),
            right=answers(brief, *USUAL),
            cause=f"steer.*({units}|{signs}|undecided|not excited|too little|cannot tell)",
            at_fault=frozenset({"steer_rad"}),
        )


def places_and_delays() -> Iterator[Recording]:
    """Sensors and truth that are right in themselves, but not here and not now."""
    rear, car = drive("sedan", -1.45), drive("sedan")
    yield Recording(
        name="rear-axle-accelerometer",
        group="fault",
        what="accelerometer 1.45 m behind the centre of gravity",
        container="mcap",
        topics=road_car(rear),
        right={
            **answers(rear, *USUAL),
            "ay_m_s2": (rear.force[1], car.force[1]),
            "ax_m_s2": (rear.force[0], car.force[0]),
        },
        cause=r"lever|behind|rear axle|place|position|-1\.[345]",
        at_fault=frozenset({"ax_m_s2", "ay_m_s2"}),
    )
    late = car.rate.late(0.038)
    yield Recording(
        name="late-gyro",
        group="fault",
        what="gyro 38 ms late, accelerations and truth in time",
        container="mcap",
        topics=road_car(car, imu=imu(car.force, late)),
        right={**answers(car, *USUAL), "yaw_rate_rad_s": (late[2], car.rate[2])},
        cause=r"late|delay|latency|lag",
        at_fault=frozenset({"yaw_rate_rad_s"}),
    )
    turn = 0.25 * DEG
    offset = car.body_velocity.times(np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]))
    given = answers(car, *USUAL)
    yield Recording(
        name="truth-sideslip-offset",
        group="fault",
        what="truth with a constant sideslip offset of 0.25 degrees",
        container="mcap",
        topics=road_car(car, truth=odometry(car, body=offset)),
        right={**given, "truth.vy_m_s": (offset[1], *given["truth.vy_m_s"])},
        cause=r"offset|bias|constant",
        at_fault=frozenset({"truth.vy_m_s", "truth.vx_m_s", "truth.sideslip_rad", "truth.yaw_rad"}),
    )


def missing_things() -> Iterator[Recording]:
    """Logs that lack something, or have too much of it."""
    car, other = drive("hatchback"), drive("other")
    own_type = message("/driver", "teamx_msgs/msg/DriverInput", car.steer, {"steering_angle": car.steer.values})
    yield Recording(
        name="no-definitions",
        group="fault",
        what="rosbag2 as up to Humble, without message definitions; the steering in a type of the team's own",
        container="rosbag2-bare",
        topics=road_car(car, steering=own_type),
        right=answers(car, "imu", "speed", "truth", "truth rate"),
        cause=r"definition",
    )
    yield from _nameless()
    yield Recording(
        name="no-imu",
        group="fault",
        what="no IMU; the yaw rate stands in the wheel odometry",
        container="rosbag1",
        topics=(
            odometry(car, "/odom", body=_forward(car.body_velocity), up_to=2),
            steering(car.steer),
            odometry(car, "/mocap/odometry"),
        ),
        right=answers(car, "yaw rate", "steer", "speed", "truth", "truth rate"),
    )
    yield Recording(
        name="speed-from-ins",
        group="fault",
        what="no speed but that of the GNSS/INS",
        container="mcap",
        topics=road_car(car, speed=None),
        right=answers(car, *USUAL),
        cause=r"(?s)(INS|GNSS|GPS|truth|/ins/odometry).*speed|speed.*(INS|GNSS|GPS|truth|/ins/odometry)",
        at_fault=frozenset({"speed_m_s"}),
    )
    enu = car.velocity.every(5)
    course = message(
        "/vel",
        "geometry_msgs/msg/TwistStamped",
        enu,
        {"twist.linear.x": enu.values[:, 0], "twist.linear.y": enu.values[:, 1]},
        constants={"header.frame_id": "gps"},
    )
    yield Recording(
        name="speed-from-gnss",
        group="fault",
        what="no speed but the velocity east and north of a satellite receiver",
        container="rosbag1",
        topics=road_car(car, speed=course, truth=fix(car, "/fix")),
        right=answers(car, "imu", "steer", "speed"),
        allowed=answers(car, "truth"),
        cause=r"(?s)(GNSS|GPS|satellite|/vel\b).*speed|speed.*(GNSS|GPS|satellite|/vel\b)",
        at_fault=frozenset({"speed_m_s"}),
    )
    bits = np.clip(np.rint((car.steering_wheel.values + 10.0) / 0.001), 0, 65535).astype(np.int64)
    frame = np.zeros((len(bits), 8))
    frame[:, 0], frame[:, 1] = bits // 256, bits % 256
    yield Recording(
        name="raw-can",
        group="fault",
        what="steering in raw CAN frames, without the file that describes them",
        container="mcap",
        topics=(
            message(
                "/can0/received_messages",
                "can_msgs/msg/Frame",
                car.steering_wheel,
                {"id": np.full(len(bits), 0x25), "dlc": np.full(len(bits), 8), "data": frame},
            ),
            imu(car.force, car.rate),
        ),
        right=answers(car, "imu"),
        cause=r"\bdbc\b",
    )
    nothing = Series(_EMPTY, _EMPTY, np.empty((0, 3)))
    yield Recording(
        name="empty-imu",
        group="fault",
        what="an IMU topic without a message",
        container="mcap",
        topics=(
            Topic("/imu/data", "sensor_msgs/msg/Imu", nothing.stamps_ns, nothing.arrival_ns, {}),
            *road_car(car, imu=None, truth=None),
        ),
        right=answers(car, "steer", "speed"),
        cause=r"(?is)/imu/data.{0,80}(empty|no message|without (a )?message|0 messages|holds no)"
        r"|(empty|no message|without (a )?message|0 messages).{0,80}/imu/data",
    )
    yield Recording(
        name="no-steering",
        group="fault",
        what="no steering",
        container="rosbag2",
        topics=road_car(car, steering=None),
        right=answers(car, "imu", "speed", "truth", "truth rate"),
        cause=r"steer",
    )
    strange = [imu(other.force, other.rate, f"/car_{i}/imu/data", f"car_{i}/imu") for i in (2, 3)]
    here = [replace(t, name=f"/car_1{t.name}") for t in road_car(car)]
    yield Recording(
        name="several-cars",
        group="fault",
        what="IMUs of three cars, the rest of one",
        container="mcap",
        topics=(*strange, *here),
        right=answers(car, *USUAL),
        cause=r"/car_[23]/imu",
        at_fault=IMU,
    )
    yield Recording(
        name="bare-numbers",
        group="fault",
        what="std_msgs/Float32 a signal, named by its topic alone",
        container="rosbag1",
        topics=(
            scalar("/car/steering_angle", car.steer),
            scalar("/car/speed", car.speed),
            scalar("/car/lateral_acceleration", car.force[1]),
            scalar("/car/longitudinal_acceleration", car.force[0]),
            scalar("/car/yaw_rate", car.rate[2]),
            scalar("/car/battery_voltage", car.speed.times(0.0, 12.4)),
        ),
        right=answers(car, "imu", "steer", "speed"),
    )


def _forward(body: Series) -> Series:
    """Wheel odometry knows no sideslip."""
    return Series(body.stamps_ns, body.arrival_ns, np.column_stack([body.values[:, 0], 0.0 * body.values[:, 0]]))


def _columns(car: Car) -> dict[str, FloatArray]:
    """Return sensors and what is no signal, without order and under names that say nothing."""
    clock = car.force
    rng = np.random.default_rng(5)
    count = np.arange(len(clock.stamps_ns))
    return {
        "c": car.rate.values[:, 2],
        "k": car.force.values[:, 1],
        "a": car.steer.along(clock).values,
        "h": car.force.values[:, 2],
        "e": car.speed.along(clock).values,
        "b": car.rate.values[:, 0],
        "f": car.force.values[:, 0],
        "d": car.rate.values[:, 1],
        "g": 40.0 + 0.01 * count + rng.normal(0.0, 0.2, len(count)),
        "i": np.asarray(count % 256, dtype=np.float64),
    }


def _nameless() -> Iterator[Recording]:
    """Columns of one topic by letter, at one speed, which decides nothing, and by number, on a road that does."""
    car = drive("bends")
    yield Recording(
        name="shuffled-names",
        group="fault",
        what="one JSON topic whose fields are called a to k, at almost one speed",
        container="mcap-json",
        topics=(message("/q", "Row", car.force, _columns(car), stamp=None),),
        right=answers(car, "imu", "steer", "speed"),
    )
    car = drive("sedan")
    numbers = np.stack(list(_columns(car).values()), axis=1)
    yield Recording(
        name="numbered",
        group="fault",
        what="one std_msgs/Float32MultiArray, on a road with stops",
        container="rosbag2",
        topics=(message("/array", "std_msgs/msg/Float32MultiArray", car.force, {"data": numbers}, stamp=None),),
        right=answers(car, "imu", "steer", "speed"),
    )


def faults() -> Iterator[Recording]:
    """Yield all of them."""
    yield from mountings()
    yield from units_and_signs()
    yield from places_and_delays()
    yield from missing_things()
