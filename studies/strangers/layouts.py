"""Logs in the layouts of published message definitions and recorders' exports, sound and excited.

Fields are those of the definitions, with their units and axes; parts of a message that only say how the device does
(status words, sub-messages of state) are left out.
"""

from __future__ import annotations

from collections.abc import Iterator

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
    xyz,
)
from truthsim.recording import quaternion


def north_east(car: Car) -> tuple[FloatArray, FloatArray]:
    """Return the velocity north and east, m/s."""
    east, north = car.velocity.values.T
    return north, east


def heading_deg(car: Car) -> FloatArray:
    """Return the heading clockwise from north, 0 to 360 degrees."""
    return np.asarray((90.0 - car.attitude.values[:, 2] / DEG) % 360.0)


def course_deg(car: Car) -> FloatArray:
    """Return the course clockwise from north, 0 to 360 degrees."""
    north, east = north_east(car)
    return np.asarray(np.arctan2(east, north) / DEG % 360.0)


def micros(series: Series) -> FloatArray:
    """Return microseconds since the device was switched on, 100 s before the drive."""
    return np.asarray((series.stamps_ns - series.stamps_ns[0]) / 1000.0 + 1e8)


# ------------------------------------------------------------------------------------------------ satellites, inertial


def novatel() -> Recording:
    """NovAtel OEM7 driver: INS solution and GNSS velocity in its own types, the IMU in the standard one."""
    car = drive("sedan")
    north, east = north_east(car)
    lat, lon, alt = car.fix.along(car.velocity).values.T
    pva = {"north_velocity": north, "east_velocity": east, "azimuth": heading_deg(car)}
    place = {"latitude": lat, "longitude": lon, "height": alt}
    vel = car.ground_speed.every(5)
    gnss = {"hor_speed": vel.values, "trk_gnd": course_deg(car)[::5]}
    return Recording(
        name="novatel",
        group="layout",
        what="NovAtel OEM7: INSPVA, BESTVEL, /gps/imu",
        container="mcap",
        topics=(
            message("/novatel/oem7/inspva", "novatel_oem7_msgs/msg/INSPVA", car.velocity, pva | place),
            message("/novatel/oem7/bestvel", "novatel_oem7_msgs/msg/BESTVEL", vel, gnss),
            imu(car.force, car.rate, "/gps/imu", "gps"),
            fix(car, "/gps/fix"),
        ),
        right={
            "truth.enu_velocity_m_s": answers(car, "truth")["truth.enu_velocity_m_s"],
            **answers(car, "imu", "speed"),
        },
        allowed=answers(car, "truth", "truth rate"),
        page="https://github.com/novatel/novatel_oem7_driver/tree/master/src/novatel_oem7_msgs/msg",
    )


def sbg() -> Recording:
    """SBG Ellipse in its NED convention: device axes forward, right, down."""
    car = drive("hatchback")
    force, rate = car.force.times(DOWN), car.rate.times(DOWN).along(car.force)
    north, east = north_east(car)
    data = {
        **xyz(force, "accel"),
        **xyz(rate, "gyro"),
        "time_stamp": micros(force),
        "temp": 30.0 + 0.0 * force.values[:, 0],
    }
    data |= {**xyz(force, "delta_vel"), **xyz(rate, "delta_angle")}
    lat, lon, alt = car.fix.along(car.velocity).values.T
    nav = {"velocity.x": north, "velocity.y": east, "position.x": lat, "position.y": lon, "position.z": alt}
    return Recording(
        name="sbg",
        group="layout",
        what="SBG Ellipse: SbgImuData and SbgEkfNav, axes forward, right, down; steering and speed of Autoware",
        container="rosbag2",
        topics=(
            message("/sbg/imu_data", "sbg_driver/msg/SbgImuData", force, data),
            message("/sbg/ekf_nav", "sbg_driver/msg/SbgEkfNav", car.velocity, nav),
            *road_car(car, imu=None, truth=None),
        ),
        right={
            "truth.enu_velocity_m_s": answers(car, "truth")["truth.enu_velocity_m_s"],
            **answers(car, "imu", "steer", "speed"),
        },
        allowed=answers(car, "truth", "truth rate"),
        page="https://github.com/SBG-Systems/sbg_ros2_driver/tree/master/msg",
    )


def septentrio() -> Recording:
    """Septentrio AsteRx: angular rates in deg/s, latitude in rad, heading in degrees."""
    car = drive("suv")
    rate = car.rate.times(1.0 / DEG).along(car.force)
    meas = {
        f"{name}_{axis}": series.values[:, i]
        for name, series in (("acceleration", car.force), ("angular_rate", rate))
        for i, axis in enumerate("xyz")
    }
    north, east = north_east(car)
    lat, lon, alt = car.fix.along(car.velocity).values.T
    ins = {
        "latitude": lat * DEG,
        "longitude": lon * DEG,
        "height": alt,
        "heading": heading_deg(car),
        "vn": north,
        "ve": east,
    }
    return Recording(
        name="septentrio",
        group="layout",
        what="Septentrio: ExtSensorMeas (deg/s) and INSNavGeod; steering and speed of Autoware",
        container="rosbag2-mcap",
        topics=(
            message("/extsensormeas", "septentrio_gnss_driver/msg/ExtSensorMeas", car.force, meas),
            message("/insnavgeod", "septentrio_gnss_driver/msg/INSNavGeod", car.velocity, ins),
            *road_car(car, imu=None, truth=None),
        ),
        right={
            "truth.enu_velocity_m_s": answers(car, "truth")["truth.enu_velocity_m_s"],
            **answers(car, "imu", "steer", "speed"),
        },
        allowed=answers(car, "truth", "truth rate"),
        page="https://github.com/septentrio-gnss/septentrio_gnss_driver/tree/master/msg",
    )


def ublox() -> Recording:
    """u-blox NAV-PVT: whole numbers of mm/s and 1e-5 degrees, no stamp; the IMU in the standard type."""
    car = drive("hatchback")
    clock = car.ground_speed.every(5)
    north, east = (v[::5] for v in north_east(car))
    lat, lon, alt = car.fix.along(clock).values.T
    pvt = {
        "lat": lat * 1e7, "lon": lon * 1e7, "height": alt * 1e3, "vel_n": north * 1e3, "vel_e": east * 1e3,
        "g_speed": clock.values * 1e3, "heading": course_deg(car)[::5] * 1e5, "num_sv": 14.0 + 0.0 * lat,
        "fix_type": 3.0 + 0.0 * lat, "i_tow": (clock.stamps_ns // 1_000_000) % 604_800_000,
    }  # fmt: skip
    return Recording(
        name="ublox",
        group="layout",
        what="u-blox: NavPVT (mm/s, 1e-5 degrees), a standard IMU, Autoware's steering",
        container="mcap",
        topics=(
            message("/ublox/navpvt", "ublox_msgs/msg/NavPVT", clock, pvt, stamp=None),
            imu(car.force, car.rate),
            steering(car.steer),
        ),
        right=answers(car, "imu", "steer", "speed"),
        allowed=answers(car, "truth"),
        page="https://github.com/KumarRobotics/ublox/blob/master/ublox_msgs/msg/NavPVT.msg",
    )


def vectornav() -> Recording:
    """VectorNav's common group: axes forward, right, down; velocity north, east, down."""
    car = drive("sedan")
    force, rate = car.force.times(DOWN), car.rate.times(DOWN).along(car.force)
    velocity_ned = Series(
        car.velocity.stamps_ns,
        car.velocity.arrival_ns,
        np.column_stack([*north_east(car), 0.0 * car.velocity.values[:, 0]]),
    ).along(force)
    common = {
        **xyz(force, "accel"), **xyz(force, "imu_accel"), **xyz(rate, "angularrate"), **xyz(rate, "imu_rate"),
        **xyz(velocity_ned, "velocity"), "timestartup": micros(force) * 1e3,
    }  # fmt: skip
    return Recording(
        name="vectornav",
        group="layout",
        what="VectorNav: CommonGroup, axes forward, right, down; speed and steering of Autoware",
        container="mcap",
        topics=(
            message("/vectornav/raw/common", "vectornav_msgs/msg/CommonGroup", force, common),
            *road_car(car, imu=None, truth=None),
        ),
        right=answers(car, "imu", "steer", "speed"),
        allowed=answers(car, "truth", "truth rate"),
        page="https://github.com/dawonn/vectornav/blob/ros2/vectornav_msgs/msg/CommonGroup.msg",
    )


def xsens() -> Recording:
    """Xsens MTi driver with vectors of their own; velocity east, north, up."""
    car = drive("suv")
    rate = car.rate.along(car.force)
    enu = answers(car, "truth")["truth.enu_velocity_m_s"][0].every(5)

    def vector(name: str, series: Series) -> Topic:
        return message(name, "geometry_msgs/msg/Vector3Stamped", series, xyz(series, "vector"))

    return Recording(
        name="xsens",
        group="layout",
        what="Xsens MTi: acceleration, angular velocity and velocity as Vector3Stamped; Autoware's steering and speed",
        container="rosbag1",
        topics=(
            vector("/imu/acceleration", car.force),
            vector("/imu/angular_velocity", rate),
            vector("/filter/velocity", enu),
            *road_car(car, imu=None, truth=None),
        ),
        right=answers(car, "imu", "steer", "speed"),
        allowed=answers(car, "truth", "truth rate"),
        page="https://github.com/leap-amr/xsens_ros_mti_driver/blob/master/README.md",
    )


# ------------------------------------------------------------------------------------------------ drive by wire

WHEEL_NAMES = ("front_left", "front_right", "rear_left", "rear_right")


def wheel_rates(car: Car) -> dict[str, FloatArray]:
    """Return the wheels' speeds in rad/s by the names that drive-by-wire kits use."""
    return {name: car.wheels.values[:, i] / car.wheel_radius_m for i, name in enumerate(WHEEL_NAMES)}


def dataspeed() -> Recording:
    """Dataspeed's drive-by-wire kit: angle of the steering wheel in rad, wheels in rad/s, the command beside it."""
    car = drive("suv")
    clock = car.steering_wheel
    report = {
        "steering_wheel_angle": clock.values,
        "steering_wheel_cmd": np.roll(clock.values, -10),
        "steering_wheel_torque": 2.0 * clock.values,
        "speed": car.speed.along(clock).values,
    }
    return Recording(
        name="dataspeed",
        group="layout",
        what="Dataspeed drive-by-wire: SteeringReport (rad, m/s), WheelSpeedReport (rad/s), IMU of the car",
        container="rosbag1",
        topics=(
            message("/vehicle/steering_report", "dbw_mkz_msgs/msg/SteeringReport", clock, report),
            message("/vehicle/wheel_speed_report", "dbw_mkz_msgs/msg/WheelSpeedReport", car.wheels, wheel_rates(car)),
            imu(car.force, car.rate, "/vehicle/imu/data_raw", "base_footprint"),
            fix(car, "/vehicle/gps/fix"),
        ),
        right=answers(car, "imu", "steering wheel", "speed", "wheel rates"),
        page="https://docs.ros.org/en/melodic/api/dbw_mkz_msgs/html/msg/SteeringReport.html",
    )


def raptor() -> Recording:
    """New Eagle's Raptor kit: angle of the steering wheel in degrees, wheels in rad/s."""
    car = drive("hatchback")
    clock = car.steering_wheel
    degrees = {"steering_wheel_angle": clock.values / DEG, "steering_wheel_angle_cmd": np.roll(clock.values, -5) / DEG}
    return Recording(
        name="raptor",
        group="layout",
        what="Raptor drive-by-wire: SteeringReport in degrees, WheelSpeedReport in rad/s; IMU; INS odometry as truth",
        container="rosbag2",
        topics=(
            message("/raptor_dbw_interface/steering_report", "raptor_dbw_msgs/msg/SteeringReport", clock, degrees),
            message(
                "/raptor_dbw_interface/wheel_speed_report",
                "raptor_dbw_msgs/msg/WheelSpeedReport",
                car.wheels,
                wheel_rates(car),
            ),
            imu(car.force, car.rate),
            odometry(car, "/ins/odometry"),
        ),
        right=answers(car, "imu", "steering wheel", "wheel rates", "truth", "truth rate"),
        allowed=answers(car, "speed"),
        page="https://github.com/NewEagleRaptor/raptor-dbw-ros2/tree/master/raptor_dbw_msgs/msg",
    )


# ------------------------------------------------------------------------------------------------ whole stacks

_ERPM_A_M_S = 4614.0


def vesc() -> Recording:
    """F1TENTH with a VESC: acceleration in g, rates in deg/s, speed in electrical revolutions, a steering command."""
    car = drive("bends")
    force, rate = car.force.times(1.0 / G_M_S2), car.rate.times(1.0 / DEG).along(car.force)
    reading = {**xyz(force, "imu.linear_acceleration"), **xyz(rate, "imu.angular_velocity")}
    state = {
        "state.speed": car.speed.values * _ERPM_A_M_S,
        "state.voltage_input": 11.1 + 0.0 * car.speed.values,
        "state.duty_cycle": car.speed.values / 40.0,
        "state.current_motor": 5.0 + np.gradient(car.speed.values) * 300.0,
    }
    command = {"drive.steering_angle": car.steer.values, "drive.speed": np.roll(car.speed.along(car.steer).values, -20)}
    odom = car.body_velocity.times(np.diag([1.0, 0.0]))
    return Recording(
        name="vesc",
        group="layout",
        what="F1TENTH and VESC: VescImuStamped (g, deg/s), VescStateStamped (ERPM), wheel odometry, steering command",
        container="rosbag1",
        topics=(
            message("/sensors/imu", "vesc_msgs/msg/VescImuStamped", force, reading),
            message("/sensors/core", "vesc_msgs/msg/VescStateStamped", car.speed, state),
            message("/drive", "ackermann_msgs/msg/AckermannDriveStamped", car.steer, command),
            odometry(car, "/odom", body=odom, rate=car.yaw_rate),
        ),
        right=answers(car, "imu", "steer", "speed"),
        page="https://github.com/f1tenth/vesc/tree/main/vesc_msgs/msg",
    )


def px4() -> Recording:
    """PX4 rover over its ROS 2 bridge: axes forward, right, down, times since the start of the board."""
    car = drive("sedan")
    force, rate = car.force.times(DOWN), car.rate.times(DOWN).along(car.force)
    combined = {"timestamp": micros(force), "gyro_rad": rate.values, "accelerometer_m_s2": force.values}
    north, east = north_east(car)
    at = car.position.values
    roll, pitch, yaw = car.attitude.values.T
    down = quaternion(roll, -pitch, np.pi / 2.0 - yaw)
    state = {
        "timestamp": micros(car.velocity), "x": at[:, 1], "y": at[:, 0], "z": -at[:, 2], "q": down,
        "vx": north, "vy": east, "yawspeed": -car.yaw_rate.values,
    }  # fmt: skip
    return Recording(
        name="px4",
        group="layout",
        what="PX4: SensorCombined and VehicleOdometry, axes forward, right, down; Autoware's steering and speed",
        container="mcap",
        topics=(
            message("/fmu/out/sensor_combined", "px4_msgs/msg/SensorCombined", force, combined, stamp=None),
            message("/fmu/out/vehicle_odometry", "px4_msgs/msg/VehicleOdometry", car.velocity, state, stamp=None),
            steering(car.steer),
            velocity(car.speed),
        ),
        right=answers(car, "imu", "steer", "speed"),
        allowed=answers(car, "truth", "truth rate"),
        page="https://github.com/PX4/PX4-Autopilot/blob/main/msg/SensorCombined.msg",
    )


def apollo() -> Recording:
    """Apollo in protobuf: axes right, forward, up; steering in per cent of an angle that the log does not hold."""
    car = drive("hatchback")
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    force, rate = car.force.times(turn), car.rate.times(turn).along(car.force)
    clock = car.wheels
    rates = car.wheels.values / car.wheel_radius_m
    chassis = {
        "header.timestamp_sec": clock.stamps_ns * 1e-9,
        "engine_rpm": 1500.0 + 20.0 * car.speed.along(clock).values,
        "speed_mps": car.speed.along(clock).values,
        "throttle_percentage": 12.0 + 0.0 * rates[:, 0],
        "steering_percentage": car.steering_wheel.along(clock).values / 8.2 * 100.0,
        **{f"wheel_speed.wheel_spd_{w}": rates[:, i] for i, w in enumerate(("fl", "fr", "rl", "rr"))},
    }
    corrected = {
        "header.timestamp_sec": force.stamps_ns * 1e-9,
        **xyz(force, "imu.linear_acceleration"),
        **xyz(rate, "imu.angular_velocity"),
    }
    east, north = car.velocity.values.T
    pose = {
        "header.timestamp_sec": car.velocity.stamps_ns * 1e-9,
        "pose.linear_velocity.x": east,
        "pose.linear_velocity.y": north,
        "pose.linear_velocity.z": 0.0 * east,
        "pose.angular_velocity_vrf.z": car.yaw_rate.values,
        "pose.heading": car.attitude.values[:, 2],
    }
    return Recording(
        name="apollo",
        group="layout",
        what="Apollo: Chassis, CorrectedImu (axes right, forward, up) and LocalizationEstimate in protobuf",
        container="mcap-protobuf",
        topics=(
            message("/apollo/canbus/chassis", "apollo.canbus.Chassis", clock, chassis, stamp=None),
            message(
                "/apollo/sensor/gnss/corrected_imu", "apollo.localization.CorrectedImu", force, corrected, stamp=None
            ),
            message(
                "/apollo/localization/pose", "apollo.localization.LocalizationEstimate", car.velocity, pose, stamp=None
            ),
        ),
        right=answers(car, "imu", "speed", "wheel rates"),
        allowed=answers(car, "steering wheel", "truth", "truth rate"),
        page="https://github.com/ApolloAuto/apollo/tree/master/modules/common_msgs/chassis_msgs",
    )


def openpilot() -> Recording:
    """Openpilot's carState as JSON: degrees at the steering wheel, wheels in m/s, yaw rate in rad/s."""
    car = drive("hatchback")
    clock = car.steering_wheel
    state = {
        "logMonoTime": clock.stamps_ns,
        "vEgo": car.speed.along(clock).values,
        "vEgoRaw": car.speed.along(clock).values,
        "aEgo": np.gradient(car.speed.along(clock).values, 0.01),
        "yawRate": car.rate[2].along(clock).values,
        "steeringAngleDeg": clock.values / DEG,
        "steeringRateDeg": np.gradient(clock.values, 0.01) / DEG,
        "steeringTorque": 50.0 * clock.values,
        "engineRpm": 1500.0 + 0.0 * clock.values,
        **{f"wheelSpeeds.{w}": car.wheels[i].along(clock).values for i, w in enumerate(("fl", "fr", "rl", "rr"))},
    }
    return Recording(
        name="openpilot",
        group="layout",
        what="openpilot's carState exported to JSON: steeringAngleDeg, vEgo, yawRate, wheelSpeeds",
        container="mcap-json",
        topics=(message("/carState", "cereal.CarState", clock, state, stamp=None),),
        right=answers(car, "yaw rate", "steering wheel", "speed", "wheels"),
        page="https://github.com/commaai/openpilot/blob/master/cereal/car.capnp",
    )


def vbox() -> Recording:
    """A VBOX file's channels as JSON: km/h, g, degrees, arc minutes with west positive."""
    car = drive("sedan")
    clock = car.ground_speed.every(5)
    lat, lon, alt = car.fix.along(clock).values.T
    channels = {
        "satellites": 12.0 + 0.0 * lat,
        "time": clock.stamps_ns * 1e-9 % 86400.0,
        "latitude": lat * 60.0,
        "longitude": -lon * 60.0,
        "velocity kmh": clock.values / KMH,
        "heading": course_deg(car)[::5],
        "height": alt,
        "Long accel": car.force[0].along(clock).values / G_M_S2,
        "Lat accel": car.force[1].along(clock).values / G_M_S2,
        "Yaw_rate deg/s": car.rate[2].along(clock).values / DEG,
    }
    return Recording(
        name="vbox",
        group="layout",
        what="VBOX channels exported to JSON: velocity in km/h, accelerations in g, yaw rate in deg/s",
        container="mcap-json-bare",
        topics=(message("/vbo", "", clock, channels, stamp=None),),
        right=answers(car, "imu", "speed"),
        page="https://en.racelogic.support/VBOX_Automotive/Knowledge_Base/VBO_File_Format",
    )


def autoware() -> Recording:
    """Autoware as it records: reports of the vehicle, one IMU, the pose of its own localisation."""
    car = drive("suv")
    curvature = np.tan(car.steer.along(car.speed).values) / 2.7
    report = {"longitudinal_velocity": car.speed.values, "heading_rate": car.speed.values * curvature}
    return Recording(
        name="autoware",
        group="layout",
        what="Autoware: SteeringReport, VelocityReport with a heading rate, tamagawa IMU, GNSS fix, kinematic_state",
        container="rosbag2-mcap",
        topics=(
            imu(car.force, car.rate, "/sensing/imu/tamagawa/imu_raw", "tamagawa/imu_link"),
            steering(car.steer),
            message("/vehicle/status/velocity_status", "autoware_vehicle_msgs/msg/VelocityReport", car.speed, report),
            odometry(car, "/localization/kinematic_state", up_to=2),
            fix(car, "/sensing/gnss/fix"),
            scalar("/sensing/temperature", car.speed.times(0.0, 31.0)),
        ),
        right=answers(car, "imu", "steer", "speed"),
        allowed=answers(car, "truth", "truth rate"),
        page="https://github.com/autowarefoundation/autoware_msgs/tree/main/autoware_vehicle_msgs/msg",
    )


def layouts() -> Iterator[Recording]:
    """Yield all of them."""
    for make in (
        novatel, sbg, septentrio, ublox, vectornav, xsens, dataspeed, raptor, vesc, px4, apollo, openpilot, vbox,
        autoware,
    ):  # fmt: skip
        yield make()
