"""Layouts of vehicles, simulators and data sets; held out at first, and developed with since they had been run."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pdhef_logtool.records.signals import WHEELS, IntArray
from studies.strangers.cars import drive
from studies.strangers.layouts import heading_deg, north_east
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
    scalar,
    xyz,
)
from truthsim.recording import quaternion

#: Radians a second in one revolution a minute.
RPM = 2.0 * np.pi / 60.0


def carla() -> Recording:
    """CARLA's bridge: wheel angles in degrees to the right, the control from -1 to 1, the simulator's odometry."""
    car = drive("sedan")
    clock = car.speed
    steer = car.steer.along(clock).values
    roll, pitch, yaw = car.attitude.along(clock).values.T
    status = {
        "velocity": clock.values,
        "acceleration.linear.x": np.gradient(clock.values, 0.01),
        "orientation": quaternion(roll, pitch, yaw),
        "wheel_angle_fl": -steer / DEG,
        "wheel_angle_fr": -steer / DEG,
        "control.steer": np.roll(-steer / 0.7, -10),
        "control.throttle": 0.3 + 0.0 * steer,
    }
    return Recording(
        name="carla",
        group="layout",
        what="CARLA: CarlaEgoVehicleStatus (wheel angles in degrees, right positive), IMU, speedometer, odometry",
        container="rosbag2-mcap",
        topics=(
            message("/carla/ego_vehicle/vehicle_status", "carla_msgs/msg/CarlaEgoVehicleStatus", clock, status),
            imu(car.force, car.rate, "/carla/ego_vehicle/imu", "ego_vehicle/imu"),
            scalar("/carla/ego_vehicle/speedometer", clock),
            odometry(car, "/carla/ego_vehicle/odometry"),
            fix(car, "/carla/ego_vehicle/gnss"),
        ),
        right=answers(car, "imu", "steer", "speed"),
        allowed=answers(car, "truth", "truth rate"),
        page="https://github.com/uulm-mrm/ros-carla-msgs/blob/master/msg/CarlaEgoVehicleStatus.msg",
    )


def nuscenes() -> Recording:
    """The CAN bus of nuScenes: rad at the steering wheel, right positive; wheels in rpm; a monitor in km/h, deg/s."""
    car = drive("hatchback")
    steer, wheels, slow = car.steering_wheel, car.wheels, car.speed.every(50)

    def utime(stamps_ns: IntArray) -> IntArray:
        return stamps_ns // 1000

    ms_imu = {
        "utime": utime(car.force.stamps_ns),
        "linear_accel": car.force.values,
        "rotation_rate": car.rate.along(car.force).values,
    }
    feedback = {"utime": utime(steer.stamps_ns), "value": -steer.values}
    rates = wheels.values / car.wheel_radius_m / RPM
    info = {
        "utime": utime(wheels.stamps_ns),
        **{f"{w.upper()}_wheel_speed": rates[:, i] for i, w in enumerate(WHEELS)},
        "odom_speed": car.speed.along(wheels).values / KMH,
        "longitudinal_accel": car.force[0].along(wheels).values,
        "transversal_accel": car.force[1].along(wheels).values / G_M_S2,
        "steer_raw": -car.steering_wheel.along(wheels).values / DEG,
        "pedal_cc": 100.0 + 0.0 * wheels.values[:, 0],
    }
    monitor = {
        "utime": utime(slow.stamps_ns),
        "vehicle_speed": slow.values / KMH,
        "yaw_rate": car.rate[2].along(slow).values / DEG,
        "steering": -car.steering_wheel.along(slow).values / DEG,
        "battery_level": 80.0 + 0.0 * slow.values,
    }
    return Recording(
        name="nuscenes",
        group="layout",
        what="nuScenes CAN bus: ms_imu, steeranglefeedback (right positive), zoe_veh_info (rpm, g), vehicle_monitor",
        container="mcap-json",
        topics=(
            message("/ms_imu", "ms_imu", car.force, ms_imu, stamp=None),
            message("/steeranglefeedback", "steeranglefeedback", steer, feedback, stamp=None),
            message("/zoe_veh_info", "zoe_veh_info", wheels, info, stamp=None),
            message("/vehicle_monitor", "vehicle_monitor", slow, monitor, stamp=None),
        ),
        right=answers(car, "imu", "steering wheel", "speed", "wheel rates"),
        page="https://github.com/nutonomy/nuscenes-devkit/blob/master/python-sdk/nuscenes/can_bus/README.md",
    )


def kitti() -> Recording:
    """KITTI's oxts packets at 10 Hz: two-letter names, forward, left, up; specific force and acceleration beside it."""
    car = drive("suv")
    clock = car.body_velocity.every(5)
    force, rate = car.force.along(clock).values, car.rate.along(clock).values
    north, east = (v[::5] for v in north_east(car))
    lat, lon, alt = car.fix.along(clock).values.T
    roll, pitch, yaw = car.attitude.every(5).values.T
    packet = {
        "lat": lat, "lon": lon, "alt": alt, "roll": roll, "pitch": pitch, "yaw": yaw, "vn": north, "ve": east,
        "vf": clock.values[:, 0], "vl": clock.values[:, 1], "vu": 0.0 * lat,
        "ax": force[:, 0], "ay": force[:, 1], "az": force[:, 2],
        "wx": rate[:, 0], "wy": rate[:, 1], "wz": rate[:, 2],
        "pos_accuracy": 0.05 + 0.0 * lat, "vel_accuracy": 0.02 + 0.0 * lat, "numsats": 9.0 + 0.0 * lat,
    }  # fmt: skip
    return Recording(
        name="kitti",
        group="layout",
        what="KITTI raw oxts at 10 Hz: vf, vl, ax, ay, wz",
        container="mcap-json",
        topics=(message("/oxts", "oxts", clock, packet, stamp=None),),
        right={k: v for k, v in answers(car, "imu", "speed", "truth").items() if k != "truth.enu_velocity_m_s"},
        allowed=answers(car, "truth", "truth rate"),
        page="https://www.cvlibs.net/datasets/kitti/raw_data.php",
    )


def adma() -> Recording:
    """GeneSys ADMA: accelerations in g, rates in deg/s, velocities in m/s, sideslip in degrees, all in one message."""
    car = drive("hatchback")
    clock = car.force
    g, rate = car.force.times(1.0 / G_M_S2), car.rate.times(1.0 / DEG).along(clock)
    north, east = north_east(car)
    body = car.body_velocity.along(clock).values
    roll, pitch, yaw = car.attitude.along(clock).values.T / DEG
    lat, lon, _ = car.fix.along(clock).values.T
    scaled = {
        **xyz(g, "acc_body_hr"), **xyz(g, "acc_body"), **xyz(g, "acc_hor"),
        **xyz(rate, "rate_body_hr"), **xyz(rate, "rate_body"), **xyz(rate, "rate_hor"),
        "ext_vel_dig_x": car.speed.along(clock).values,
        "inv_path_radius": rate.values[:, 2] * DEG / np.maximum(body[:, 0], 3.0),
        "side_slip_angle": car.sideslip.along(clock).values / DEG,
        "system_temp": 41.0 + 0.0 * roll,
        "ins_roll": roll, "ins_pitch": pitch, "ins_yaw": yaw, "gnss_cog": np.interp(
            clock.stamps_ns - clock.stamps_ns[0], car.velocity.stamps_ns - clock.stamps_ns[0],
            np.arctan2(east, north) / DEG,
        ),
        "ins_lat_abs": lat, "ins_long_abs": lon, "gnss_lat_abs": lat, "gnss_long_abs": lon,
        "ins_vel_hor.x": body[:, 0], "ins_vel_hor.y": body[:, 1],
        "kf_steady_state": 100.0 + 0.0 * roll,
    }  # fmt: skip
    return Recording(
        name="adma",
        group="layout",
        what="GeneSys ADMA: AdmaDataScaled (g, deg/s, m/s, degrees)",
        container="mcap",
        topics=(message("/genesys/adma/data_scaled", "adma_ros_driver_msgs/msg/AdmaDataScaled", clock, scaled),),
        right={k: v for k, v in answers(car, "imu", "speed", "truth").items() if k != "truth.enu_velocity_m_s"},
        allowed=answers(car, "truth", "truth rate"),
        page="https://github.com/GeneSysElektronik/adma_ros_driver/tree/ros_2/adma_ros_driver_msgs/msg",
    )


def comma_research() -> Recording:
    """comma.ai's first research logs: one accelerometer forward, right, down, another turned by 45 degrees, deg/s."""
    car = drive("sedan")
    clock = car.force
    slanted = np.array([[1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, np.sqrt(2.0)]]) / np.sqrt(2.0)
    wheels = car.wheels.along(clock).values
    log = {
        "times": (clock.stamps_ns - clock.stamps_ns[0]) * 1e-9,
        "app_accel": car.force.times(DOWN).values,
        "app_v_yaw": -car.yaw_rate.along(clock).values / DEG,
        "app_speed": car.ground_speed.along(clock).values,
        "app_heading": np.interp(
            clock.stamps_ns - clock.stamps_ns[0], car.velocity.stamps_ns - clock.stamps_ns[0], heading_deg(car)
        ),
        "fiber_accel": car.force.times(slanted).values,
        "fiber_gyro": car.rate.times(slanted).along(clock).values / DEG,
        "speed": car.speed.along(clock).values,
        "speed_abs": np.abs(car.speed.along(clock).values),
        **{f"speed_{w}": wheels[:, i] for i, w in enumerate(WHEELS)},
        "steering_angle": car.steering_wheel.along(clock).values / DEG,
        "gas": 0.2 + 0.0 * wheels[:, 0],
        "rpm": 1500.0 + 30.0 * car.speed.along(clock).values,
    }
    return Recording(
        name="comma-research",
        group="layout",
        what="comma.ai research logs: app_accel (forward, right, down), fiber_gyro (45 degrees, deg/s), speed_fl",
        container="mcap-json-bare",
        topics=(message("/log", "", clock, log, stamp=None),),
        right=answers(car, "imu", "speed", "wheels"),
        allowed=answers(car, "steering wheel"),
        page="https://github.com/commaai/research/blob/master/Logs.md",
    )


def pacmod() -> Recording:
    """PACMod: the steering wheel as the output of one system among several of the same type, wheels by axle."""
    car = drive("suv")
    steer = car.steering_wheel
    rates = car.wheels.values / car.wheel_radius_m
    axles = [f"axle_{i}_{side}_wheel_speed" for i in (1, 2) for side in ("left", "right")]
    report = {"output": steer.values, "manual_input": steer.values, "command": np.roll(steer.values, -8)}
    brake = car.speed.every(5)
    pedal = np.maximum(0.0, -np.gradient(brake.values, 0.05)) / 10.0
    return Recording(
        name="pacmod",
        group="layout",
        what="PACMod 4: SystemRptFloat of the steering (rad at the wheel), WheelSpeedRpt by axle; a standard IMU",
        container="rosbag1",
        topics=(
            message("/pacmod/steering_rpt", "pacmod4_msgs/msg/SystemRptFloat", steer, report),
            message("/pacmod/brake_rpt", "pacmod4_msgs/msg/SystemRptFloat", brake, {"output": pedal, "command": pedal}),
            message(
                "/pacmod/wheel_speed_rpt",
                "pacmod4_msgs/msg/WheelSpeedRpt",
                car.wheels,
                {name: rates[:, i] for i, name in enumerate(axles)},
            ),
            scalar("/pacmod/as_tx/vehicle_speed", car.speed, "std_msgs/msg/Float64"),
            imu(car.force, car.rate, "/imu/data_raw"),
        ),
        right=answers(car, "imu", "steering wheel", "speed", "wheel rates"),
        page="https://github.com/astuff/pacmod4_msgs/tree/master/msg",
    )


def eufs() -> Recording:
    """A student team's simulator: wheels in rpm called lf to rb, the true state in a type of its own."""
    car = drive("bends")
    rpm = car.wheels.values / car.wheel_radius_m / RPM
    sensors = {
        "steering": car.steer.along(car.wheels).values,
        **{f"{name}_speed": rpm[:, i] for i, name in enumerate(("lf", "rf", "lb", "rb"))},
    }
    clock = car.body_velocity
    at = car.position.values
    state = {
        "pose.pose.position.x": at[:, 0],
        "pose.pose.position.y": at[:, 1],
        "pose.pose.orientation": quaternion(*car.attitude.values.T),
        "twist.twist.linear.x": clock.values[:, 0],
        "twist.twist.linear.y": clock.values[:, 1],
        "twist.twist.angular.z": car.yaw_rate.values,
        "state_of_charge": 0.9 + 0.0 * at[:, 0],
    }
    return Recording(
        name="eufs",
        group="layout",
        what="Formula Student: eufs_msgs WheelSpeeds (rad, rpm), CarState as ground truth, a standard IMU",
        container="rosbag1",
        topics=(
            message("/ros_can/wheel_speeds", "eufs_msgs/msg/WheelSpeeds", car.wheels, sensors),
            message("/ground_truth/state", "eufs_msgs/msg/CarState", clock, state),
            imu(car.force, car.rate, "/imu"),
        ),
        right={
            k: v
            for k, v in answers(car, "imu", "steer", "wheel rates", "truth", "truth rate").items()
            if k != "truth.enu_velocity_m_s"
        },
        allowed=answers(car, "speed"),
        page="https://github.com/mrjoe3012/epsrc-eufs-msgs/tree/master/msg",
    )


def ds_dbw() -> Recording:
    """Dataspeed's newer kit: degrees where the older one has radians, under the same field name."""
    car = drive("hatchback")
    steer = car.steering_wheel
    report = {
        "steering_wheel_angle": steer.values / DEG,
        "cmd": np.roll(steer.values, -10) / DEG,
        "steering_column_torque": 1.5 * steer.values,
        "limit_rate": 450.0 + 0.0 * steer.values,
        "limit_value": 500.0 + 0.0 * steer.values,
    }
    twist = car.speed.every(2)
    return Recording(
        name="ds-dbw",
        group="layout",
        what="Dataspeed universal kit: SteeringReport in degrees; IMU and twist in standard types",
        container="rosbag2",
        topics=(
            message("/vehicle/steering/report", "ds_dbw_msgs/msg/SteeringReport", steer, report),
            imu(car.force, car.rate, "/vehicle/imu/data_raw", "base_footprint"),
            message(
                "/vehicle/twist",
                "geometry_msgs/msg/TwistStamped",
                twist,
                {"twist.linear.x": twist.values, "twist.angular.z": car.rate[2].along(twist).values},
            ),
        ),
        right=answers(car, "imu", "steering wheel", "speed"),
        page="https://docs.ros.org/en/jazzy/p/ds_dbw_msgs/msg/SteeringReport.html",
    )


def openxc() -> Recording:
    """OpenXC: a topic a signal with ``value``, degrees and km/h at 10 Hz; the phone's position beside it."""
    car = drive("sedan")
    slow = car.speed.every(10)
    lat, lon, _ = car.fix.values.T

    signals = (
        ("steering_wheel_angle", slow, car.steering_wheel.along(slow).values / DEG),
        ("vehicle_speed", slow, slow.values / KMH),
        ("engine_speed", slow, 1200.0 + 40.0 * slow.values),
        ("accelerator_pedal_position", slow, 15.0 + 0.0 * slow.values),
        ("fuel_level", slow, 63.0 + 0.0 * slow.values),
        ("latitude", car.fix, lat),
        ("longitude", car.fix, lon),
    )
    return Recording(
        name="openxc",
        group="layout",
        what="OpenXC: steering_wheel_angle in degrees, vehicle_speed in km/h, no inertial sensor",
        container="mcap-json",
        topics=tuple(
            message(
                f"/openxc/{name}",
                "openxc.SimpleMessage",
                clock,
                {"timestamp": clock.stamps_ns * 1e-9, "value": values},
                stamp=None,
            )
            for name, clock, values in signals
        ),
        right=answers(car, "steering wheel", "speed"),
        page="https://github.com/openxc/openxc-message-format",
    )


def mavros() -> Recording:
    """A rover over MAVROS: standard IMU twice, ground speed on a head-up display, pose of its own filter."""
    car = drive("bends")
    hud = car.ground_speed.every(5)
    display = {
        "groundspeed": hud.values,
        "airspeed": 0.0 * hud.values,
        "heading": heading_deg(car)[::5],
        "throttle": 0.4 + 0.0 * hud.values,
    }
    return Recording(
        name="mavros",
        group="layout",
        what="MAVROS: imu/data and imu/data_raw, VFR_HUD ground speed, local_position/odom",
        container="mcap-ros1",
        topics=(
            imu(car.force, car.rate, "/mavros/imu/data", "base_link"),
            imu(car.force, car.rate, "/mavros/imu/data_raw", "base_link"),
            message("/mavros/vfr_hud", "mavros_msgs/msg/VfrHud", hud, display),
            odometry(car, "/mavros/local_position/odom", up_to=2),
            fix(car, "/mavros/global_position/global"),
        ),
        right=answers(car, "imu", "speed"),
        allowed=answers(car, "truth", "truth rate"),
        page="https://github.com/mavlink/mavros/blob/master/mavros_msgs/msg/VFR_HUD.msg",
    )


def vehicle_layouts() -> Iterator[Recording]:
    """Yield all of them."""
    for make in (carla, nuscenes, kitti, adma, comma_research, pacmod, eufs, ds_dbw, openxc, mavros):
        yield make()
