"""Layouts of published definitions that were built last and are run once: nobody looked at them while building."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from studies.strangers.cars import drive
from studies.strangers.layouts import course_deg, heading_deg, micros, north_east
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
)
from truthsim.recording import quaternion


def applanix() -> Recording:
    """Applanix POS: one solution with velocity north, east, down, rates in deg/s, axes forward, right, down."""
    car = drive("sedan")
    clock = car.velocity
    force, rate = car.force.times(DOWN).along(clock).values, car.rate.times(DOWN).along(clock).values / DEG
    north, east = north_east(car)
    lat, lon, alt = car.fix.along(clock).values.T
    axes = ("long", "trans", "down")
    solution = {
        "latitude": lat, "longitude": lon, "altitude": alt, "north_vel": north, "east_vel": east,
        "heading": heading_deg(car), "track_angle": course_deg(car), "speed": car.ground_speed.values,
        **{f"ang_rate_{axis}": rate[:, i] for i, axis in enumerate(axes)},
        **{f"{axis}_accel": force[:, i] for i, axis in enumerate(axes)},
    }  # fmt: skip
    return Recording(
        name="applanix",
        group="held-out",
        what="Applanix POS: NavigationSolution (deg/s, forward, right, down; velocity north, east, down)",
        container="rosbag1",
        topics=(message("/applanix/nav", "applanix_msgs/msg/NavigationSolution", clock, solution),),
        right={
            "truth.enu_velocity_m_s": answers(car, "truth")["truth.enu_velocity_m_s"],
            **answers(car, "imu", "speed"),
        },
        allowed=answers(car, "truth", "truth rate"),
        page="https://docs.ros.org/en/electric/api/applanix_msgs/html/__NavigationSolution_8py_source.html",
    )


def awapi() -> Recording:
    """Autoware's web interface: velocity, steering and angular velocity with their targets in one message."""
    car = drive("suv")
    clock = car.speed.every(2)
    steer = car.steer.along(clock).values
    at = car.position.along(clock).values
    roll, pitch, yaw = car.attitude.along(clock).values.T
    status = {
        "pose.position.x": at[:, 0], "pose.position.y": at[:, 1], "pose.orientation": quaternion(roll, pitch, yaw),
        "eulerangle.roll": roll, "eulerangle.pitch": pitch, "eulerangle.yaw": yaw,
        "velocity": clock.values, "acceleration": np.gradient(clock.values, 0.02), "steering": steer,
        "steering_velocity": np.gradient(steer, 0.02), "angular_velocity": car.yaw_rate.along(clock).values,
        "gear": 2.0 + 0.0 * steer, "energy_level": 0.8 + 0.0 * steer, "target_velocity": np.roll(clock.values, -20),
        "target_steering": np.roll(steer, -5), "target_steering_velocity": np.gradient(np.roll(steer, -5), 0.02),
    }  # fmt: skip
    return Recording(
        name="awapi",
        group="held-out",
        what="Autoware's AwapiVehicleStatus (m/s, rad, rad/s, targets beside), a standard IMU",
        container="rosbag2",
        topics=(
            message("/awapi/vehicle/get/status", "awapi_awiv_adapter/msg/AwapiVehicleStatus", clock, status),
            imu(car.force, car.rate, "/sensing/imu/imu_data"),
        ),
        right=answers(car, "imu", "steer", "speed"),
        page="https://tier4.github.io/autoware.iv/pulls/1529/awapi/awapi_awiv_adapter/Readme",
    )


def vehicle_dynamics() -> Recording:
    """The vehicle's signals of an SDV hackathon as JSON: m/s, rad/s, rad, four wheels as a list."""
    car = drive("hatchback")
    clock = car.force
    speed = car.speed.along(clock).values
    signals = {
        "speed": speed, "speedDisplayed": 1.05 * speed, "speedPerWheel": car.wheels.along(clock).values,
        "longAcc": car.force.values[:, 0], "latAcc": car.force.values[:, 1],
        "yawrate": car.rate[2].along(clock).values,
        "steeringWheelAngle": car.steering_wheel.along(clock).values,
        "steeringWheelAngleSpeed": np.gradient(car.steering_wheel.along(clock).values, 0.01),
        "drvSteerTorque": 2.0 * car.steering_wheel.along(clock).values, "timeSinceLastClick": 0.0 * speed,
        "wheelSteeringAngleFront": car.steer.along(clock).values, "wheelSteeringAngleRear": 0.0 * speed,
    }  # fmt: skip
    fields = {"header.timestamp": clock.stamps_ns // 1000, **{f"signals.{n}": v for n, v in signals.items()}}
    return Recording(
        name="vehicle-dynamics",
        group="held-out",
        what="vehicle_dynamics of an SDV hackathon as JSON: speed, latAcc, yawrate, steeringWheelAngle, listed wheels",
        container="mcap-json-bare",
        topics=(message("/vehicle_dynamics", "", clock, fields, stamp=None),),
        right=answers(car, "imu", "speed"),
        allowed=answers(car, "steer", "steering wheel", "wheels"),
        page="https://github.com/Eclipse-SDV-Hackathon-Chapter-Two/ASAP/blob/main/vehicle_dynamics.md",
    )


def rover() -> Recording:
    """PX4's Ackermann rover: forward speed, lateral acceleration positive to the right, rates forward, right, down."""
    car = drive("bends")
    rate = car.rate.times(DOWN)
    clock = car.force
    steer = car.steer.along(clock).values
    status = {
        "timestamp": micros(clock),
        "measured_forward_speed": car.speed.along(clock).values,
        "adjusted_forward_speed_setpoint": np.roll(car.speed.along(clock).values, -30),
        "steering_setpoint_normalized": -steer / 0.6,
        "adjusted_steering_setpoint_normalized": -steer / 0.6,
        "measured_lateral_acceleration": -car.force.values[:, 1],
    }
    rates = {"timestamp": micros(rate), "timestamp_sample": micros(rate), "xyz": rate.values}
    return Recording(
        name="px4-rover",
        group="held-out",
        what="PX4: RoverAckermannStatus (lateral acceleration positive right), VehicleAngularVelocity",
        container="mcap",
        topics=(
            message("/fmu/out/rover_ackermann_status", "px4_msgs/msg/RoverAckermannStatus", clock, status, stamp=None),
            message(
                "/fmu/out/vehicle_angular_velocity", "px4_msgs/msg/VehicleAngularVelocity", rate, rates, stamp=None
            ),
        ),
        right={k: v for k, v in answers(car, "imu", "speed").items() if k != "ax_m_s2"},
        page="https://github.com/PX4/PX4-Autopilot/blob/main/msg/RoverAckermannStatus.msg",
    )


def platform() -> Recording:
    """AutonomouStuff's platform: feedback of the steering wheel in rad, velocity and acceleration of the car."""
    car = drive("suv")
    speed = car.speed
    motion = {"velocity": speed.values, "accleration": np.gradient(speed.values, 0.01)}
    return Recording(
        name="astuff-platform",
        group="held-out",
        what="AutonomouStuff: SteeringFeedback (rad at the wheel), VelocityAccel; a standard IMU",
        container="mcap-ros1",
        topics=(
            message(
                "/steering_feedback",
                "automotive_platform_msgs/msg/SteeringFeedback",
                car.steering_wheel,
                {"steering_wheel_angle": car.steering_wheel.values},
            ),
            message("/velocity_accel", "automotive_platform_msgs/msg/VelocityAccel", speed, motion),
            imu(car.force, car.rate, "/an_device/Imu", "an_device"),
        ),
        right=answers(car, "imu", "steering wheel", "speed"),
        page="https://docs.ros.org/en/jazzy/p/automotive_platform_msgs/msg/SteeringFeedback.html",
    )


def steering_controller() -> Recording:
    """ROS 2's steering controllers: positions of two steered wheels, velocities of two driven ones, commands beside."""
    car = drive("hatchback")
    clock = car.wheels
    rates = car.wheels.values[:, 2:] / car.wheel_radius_m
    steer = car.steer.along(clock).values
    state = {
        "traction_wheels_position": np.cumsum(rates, axis=0) * 0.02,
        "traction_wheels_velocity": rates,
        "steer_positions": np.stack([steer, steer], axis=1),
        "linear_velocity_command": np.roll(car.speed.along(clock).values, -10)[:, None],
        "steering_angle_command": np.roll(steer, -5)[:, None],
    }
    return Recording(
        name="steering-controller",
        group="held-out",
        what="ros2_controllers: SteeringControllerStatus (rad, rad/s, commands beside), odometry, a standard IMU",
        container="rosbag2-mcap",
        topics=(
            message(
                "/ackermann_controller/controller_state", "control_msgs/msg/SteeringControllerStatus", clock, state
            ),
            odometry(car, "/ackermann_controller/odometry", body=car.body_velocity.times(np.diag([1.0, 0.0]))),
            imu(car.force, car.rate, "/imu_broadcaster/imu"),
        ),
        right=answers(car, "imu", "steer", "speed"),
        allowed=answers(car, "wheel rates"),
        page="https://github.com/ros-controls/control_msgs/blob/master/control_msgs/msg/SteeringControllerStatus.msg",
    )


def four_wheel_steering() -> Recording:
    """A vehicle that can steer its rear axle too: angles of virtual wheels in rad, speed in m/s."""
    car = drive("sedan")
    clock = car.steer
    speed = car.speed.along(clock).values
    state = {
        "data.front_steering_angle": clock.values,
        "data.rear_steering_angle": 0.0 * clock.values,
        "data.front_steering_angle_velocity": np.gradient(clock.values, 0.01),
        "data.speed": speed,
        "data.acceleration": np.gradient(speed, 0.01),
    }
    return Recording(
        name="four-wheel-steering",
        group="held-out",
        what="four_wheel_steering_msgs: front and rear angle, speed; a standard IMU and fix",
        container="rosbag1",
        topics=(
            message("/vehicle/odom_steer", "four_wheel_steering_msgs/msg/FourWheelSteeringStamped", clock, state),
            imu(car.force, car.rate, "/imu/data_raw"),
            fix(car, "/gps/fix"),
        ),
        right=answers(car, "imu", "steer", "speed"),
        page="https://github.com/ros-drivers/four_wheel_steering_msgs/blob/master/msg/FourWheelSteering.msg",
    )


def toyota() -> Recording:
    """Decoded CAN messages by the names of opendbc's Toyota file, one topic each, as JSON."""
    car = drive("hatchback")
    moves, steer, wheels = car.force, car.steering_wheel, car.wheels
    rates = car.rate[2].along(moves).values
    kinematics = {"ACCEL_Y": moves.values[:, 1], "YAW_RATE": rates / DEG, "STEERING_TORQUE": 0.0 * rates}
    angle = {"STEER_ANGLE": steer.values / DEG, "STEER_FRACTION": 0.0 * steer.values}
    angle["STEER_RATE"] = np.gradient(steer.values, 0.01) / DEG
    corners = {f"WHEEL_SPEED_{w}": wheels.values[:, i] / KMH for i, w in enumerate(("FL", "FR", "RL", "RR"))}
    engine = {"RPM": 1200.0 + 40.0 * car.speed.values}
    topics = (
        ("KINEMATICS", moves, kinematics),
        ("STEER_ANGLE_SENSOR", steer, angle),
        ("WHEEL_SPEEDS", wheels, corners),
    )
    return Recording(
        name="toyota-can",
        group="held-out",
        what="opendbc's Toyota messages as JSON: YAW_RATE (deg/s), ACCEL_Y, STEER_ANGLE (deg), WHEEL_SPEED_FR (km/h)",
        container="mcap-json",
        topics=tuple(
            message(f"/can/{name}", f"toyota.{name}", clock, fields, stamp=None)
            for name, clock, fields in (*topics, ("ENGINE_RPM", car.speed, engine))
        ),
        right={k: v for k, v in answers(car, "imu", "steering wheel", "wheels").items() if k != "ax_m_s2"},
        page="https://github.com/commaai/opendbc/blob/master/opendbc/dbc/generator/toyota/_toyota_2017.dbc",
    )


def leo() -> Recording:
    """Firmware of a small rover: gyro_x and accel_x in SI, odometry of the wheels as velocity_lin."""
    car = drive("suv")
    force, rate = car.force, car.rate.along(car.force)
    reading = {f"gyro_{a}": rate.values[:, i] for i, a in enumerate("xyz")}
    reading |= {f"accel_{a}": force.values[:, i] for i, a in enumerate("xyz")}
    clock = car.speed.every(5)
    at, yaw = car.position.along(clock).values, car.attitude[2].along(clock).values
    odom = {
        "velocity_lin": clock.values, "velocity_ang": car.yaw_rate.along(clock).values,
        "pose_x": at[:, 0], "pose_y": at[:, 1], "pose_yaw": yaw,
    }  # fmt: skip
    return Recording(
        name="leo",
        group="held-out",
        what="Leo Rover's firmware: Imu (gyro_z, accel_x), WheelOdom (velocity_lin)",
        container="rosbag2",
        topics=(
            message(
                "/firmware/imu",
                "leo_msgs/msg/Imu",
                force,
                reading | {"temperature": 30.0 + 0.0 * force.values[:, 0]},
                stamp="stamp",
            ),
            message("/firmware/wheel_odom", "leo_msgs/msg/WheelOdom", clock, odom, stamp="stamp"),
        ),
        right=answers(car, "imu", "speed"),
        allowed=answers(car, "truth", "truth rate"),
        page="https://docs.ros.org/en/jazzy/p/leo_msgs/msg/Imu.html",
    )


def racerender() -> Recording:
    """Columns of a data logger as RaceRender reads them: g under X and Y, km/h under KPH, heading of the satellites."""
    car = drive("sedan")
    clock = car.ground_speed.every(2)
    lat, lon, alt = car.fix.along(clock).values.T
    force = car.force.along(clock).values / G_M_S2
    columns = {
        "Time": (clock.stamps_ns - clock.stamps_ns[0]) * 1e-9,
        "Longitude": lon, "Latitude": lat, "Altitude": alt, "X": force[:, 0], "Y": force[:, 1],
        "KPH": clock.values / KMH, "Heading": course_deg(car)[::2], "Lap": 1.0 + 0.0 * lat,
        "RPM": 1500.0 + 40.0 * clock.values, "Gear": 3.0 + 0.0 * lat, "Accuracy": 1.5 + 0.0 * lat,
    }  # fmt: skip
    return Recording(
        name="racerender",
        group="held-out",
        what="a data logger's columns as RaceRender reads them: KPH, X and Y in g, Heading, Latitude",
        container="mcap-json-bare",
        topics=(message("/datalogger", "", clock, columns, stamp=None),),
        right=answers(car, "speed"),
        allowed={k: v for k, v in answers(car, "imu", "truth").items() if k != "yaw_rate_rad_s"},
        page="https://racerender.com/Developer/DataFormat.html",
    )


def held_out_layouts() -> Iterator[Recording]:
    """Yield all of them."""
    for make in (
        applanix, awapi, vehicle_dynamics, rover, platform, steering_controller, four_wheel_steering, toyota, leo,
        racerender,
    ):  # fmt: skip
        yield make()
