"""Recognition of well-known types: mapped, ambiguous and excluded topics."""

from pathlib import Path

import numpy as np
import pytest
from fake_drive_log import FakeLog, FakeTopic

from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import AutoMapping, auto_map, load_mapping

N = 400
T = 1_700_000_000_000_000_000 + np.arange(N, dtype=np.int64) * 20_000_000
S = np.arange(N) * 0.02


def topic(type_name: str, stamp: str = "header.stamp", **fields: np.ndarray) -> FakeTopic:
    named = {k.replace("__", "."): np.asarray(v, dtype=np.float64) for k, v in fields.items()}
    return FakeTopic(type_name, T + 2_000_000, ({stamp: T} if stamp else {}) | named)


def imu(**extra: np.ndarray) -> FakeTopic:
    out = topic("sensor_msgs/msg/Imu", linear_acceleration__x=S, linear_acceleration__y=S, angular_velocity__z=S)
    out.fields |= extra
    return out


def twist(type_name: str, base: str, forward: np.ndarray, left: np.ndarray, stamp: str = "header.stamp") -> FakeTopic:
    out = topic(type_name, stamp)
    prefix = f"{base}." if base else ""
    out.fields |= {
        f"{prefix}linear.x": forward,
        f"{prefix}linear.y": left,
        f"{prefix}linear.z": np.zeros(N),
        f"{prefix}angular.z": np.sin(S),
    }
    return out


FORWARD, LEFT = 10.0 + np.sin(S), 0.1 * np.sin(S)


def odometry(forward: np.ndarray = FORWARD, left: np.ndarray = LEFT, pose: bool = True) -> FakeTopic:
    out = twist("nav_msgs/msg/Odometry", "twist.twist", forward, left)
    value = S if pose else np.full(N, np.nan)
    out.fields |= {"pose.pose.position.x": value, "pose.pose.position.y": value}
    out.fields |= {f"pose.pose.orientation.{a}": np.zeros(N) for a in "xyz"} | {"pose.pose.orientation.w": np.ones(N)}
    out.fields |= {"pose.covariance": np.zeros((N, 36)), "twist.covariance": np.zeros((N, 36))}
    return out


def fix(status: float = 0.0) -> FakeTopic:
    place = {"latitude": 48.0 + S * 1e-5, "longitude": 11.0 + S * 1e-5, "altitude": S}
    return topic("sensor_msgs/msg/NavSatFix", **place, status__status=np.full(N, status))


def found(contents: dict[str, FakeTopic]) -> AutoMapping:
    return auto_map(FakeLog(contents))


def fields_of(auto: AutoMapping) -> dict[str, tuple[str, object, str]]:
    both = {**auto.mapping.signals, **{f"truth.{n}": s for n, s in auto.mapping.truth.items()}}
    return {n: (s.topic, s.field, s.stamp) for n, s in both.items()}


def test_autoware_types():
    steer = topic("autoware_vehicle_msgs/msg/SteeringReport", "stamp", steering_tire_angle=S)
    speed = topic("autoware_auto_vehicle_msgs/msg/VelocityReport", longitudinal_velocity=S)
    auto = found({"/imu": imu(), "/steer": steer, "/speed": speed})
    assert fields_of(auto) == {
        "ax_m_s2": ("/imu", "linear_acceleration.x", "header.stamp"),
        "ay_m_s2": ("/imu", "linear_acceleration.y", "header.stamp"),
        "yaw_rate_rad_s": ("/imu", "angular_velocity.z", "header.stamp"),
        "steer_rad": ("/steer", "steering_tire_angle", "stamp"),
        "speed_m_s": ("/speed", "longitudinal_velocity", "header.stamp"),
    }
    assert (auto.ambiguities, auto.missing, auto.mapping.origin) == ((), (), "auto")


def test_wheel_speeds_and_perfect_truth_of_the_simulator():
    wheels = topic("truthsim_msgs/msg/WheelSpeeds", fl_m_s=S, fr_m_s=S, rl_m_s=S, rr_m_s=S)
    truths = {"/truth/perfect/odometry": odometry(), "/rtk/odometry": odometry(), "/rtk/fix": fix(2.0)}
    contents = {"/imu": imu(), "/wheels": wheels, **truths}
    auto = found(contents)
    assert {n for n in auto.mapping.signals if n.startswith("wheel")} == {
        f"wheel_speed_{w}_m_s" for w in ("fl", "fr", "rl", "rr")
    }
    assert {s.topic for s in auto.mapping.truth.values()} == {"/truth/perfect/odometry"}
    assert auto.mapping.truth["quat_wxyz"].paths == tuple(f"pose.pose.orientation.{a}" for a in "wxyz")
    assert auto.missing == ("steer_rad",)
    assert any("perfect ground truth used; /rtk/fix, /rtk/odometry not used" in n for n in auto.mapping.notes)
    other = auto_map(FakeLog(contents), prefer_truth="rtk").mapping.truth
    assert {s.topic for s in other.values()} == {"/rtk/odometry"}
    # A single ground truth is used regardless of the preference.
    del contents["/truth/perfect/odometry"]
    assert {s.topic for s in auto_map(FakeLog(contents)).mapping.truth.values()} == {"/rtk/odometry"}


def test_our_own_outputs_are_never_read_back():
    state = topic("pdhef_msgs/msg/VehicleStateEstimate", vx_m_s=S)
    auto = found({"/pdhef/phy_ukf/odometry": odometry(), "/vehicle/state": state})
    assert fields_of(auto) == {}
    assert auto.ambiguities == ()
    assert auto.missing == ("steer_rad", "ax_m_s2", "ay_m_s2", "yaw_rate_rad_s", "speed_m_s")


def test_two_imus_are_said():
    (ambiguity,) = found({"/camera/imu": imu(), "/imu/data": imu()}).ambiguities
    assert (ambiguity.subject, ambiguity.chosen) == ("imu", "/imu/data")
    assert set(ambiguity.candidates) == {"/camera/imu", "/imu/data"}
    assert "mapping" in str(ambiguity)


@pytest.mark.parametrize(
    ("name", "role"),
    [
        ("/wheel/odometry", "speed"), ("/vehicle/odom", "speed"), ("/can/odom", "speed"), ("/oxts/odometry", "truth"),
        ("/ground_truth/state", "truth"), ("/vicon/car", "truth"), ("/odometry/filtered", "neither"),
        ("/localization/kinematic_state", "neither"), ("/something", "neither"), ("/ground/odometry", "speed"),
    ],
)  # fmt: skip
def test_names_tell_sensors_from_truth(name, role):
    auto = found({name: odometry()})
    assert ("speed_m_s" in auto.mapping.signals) == (role == "speed")
    assert ("vy_m_s" in auto.mapping.truth) == (role == "truth")
    # An unused topic is reported.
    assert [a.chosen for a in auto.ambiguities] == ([None] if role == "neither" else [])
    assert any("lateral velocity, which" in n for n in auto.mapping.notes) == (role == "speed")


def test_commands_are_no_sensors():
    drive = topic("ackermann_msgs/msg/AckermannDriveStamped", drive__steering_angle=S)
    command = twist("geometry_msgs/msg/TwistStamped", "twist", S, S)
    unstamped = twist("geometry_msgs/msg/Twist", "", 5 + S, 0 * S, stamp="")
    auto = found({"/vehicle/cmd_twist": command, "/drive": drive, "/cmd_vel": unstamped, "/vehicle/twist": unstamped})
    assert fields_of(auto) == {
        "steer_rad": ("/drive", "drive.steering_angle", "header.stamp"),
        "speed_m_s": ("/vehicle/twist", "linear.x", "log_time"),
        "yaw_rate_rad_s": ("/vehicle/twist", "angular.z", "log_time"),
    }
    assert any("command" in n for n in auto.mapping.notes)


def test_what_a_message_disowns_is_not_mapped():
    minus = np.full((N, 9), -1.0)
    auto = found({"/imu": imu(angular_velocity_covariance=minus)})
    assert set(auto.mapping.signals) == {"ax_m_s2", "ay_m_s2"}
    assert "yaw_rate_rad_s" in auto.missing
    assert auto.mapping.notes == ("/imu provides no angular rate (covariance -1)",)
    auto = found({"/imu": imu(linear_acceleration_covariance=minus)})
    assert set(auto.mapping.signals) == {"yaw_rate_rad_s"}
    assert auto.mapping.notes == ("/imu provides no acceleration (covariance -1)",)
    hidden_pose = odometry(pose=True)
    hidden_pose.fields["pose.covariance"] = np.full((N, 36), -1.0)
    auto = found({"/ins/odometry": hidden_pose})
    assert set(auto.mapping.truth) == {"vx_m_s", "vy_m_s", "yaw_rate_rad_s"}


def test_a_velocity_frame_that_cannot_be_told_is_not_guessed():
    auto = found({"/gps/vel": twist("geometry_msgs/msg/TwistStamped", "twist", 0 * S, 0 * S)})
    assert auto.mapping.truth == {}
    assert [a.chosen for a in auto.ambiguities] == [None]


def test_a_zero_twist_beside_a_moving_pose_is_a_filler():
    auto = found({"/gps/odom": odometry(forward=0 * S, left=0 * S)})
    assert set(auto.mapping.truth) == {"x_m", "y_m", "quat_wxyz"}


def test_a_yaw_rate_of_nothing_but_zeros_is_a_filler():
    out = odometry()
    out.fields["twist.twist.angular.z"] = np.zeros(N)
    assert set(found({"/ins/odom": out}).mapping.truth) == {"vx_m_s", "vy_m_s", "x_m", "y_m", "quat_wxyz"}
    out.fields["twist.twist.angular.z"] = np.where(np.arange(N) % 2, 0.0, 1.0)
    assert "yaw_rate_rad_s" in found({"/ins/odom": out}).mapping.truth
    out.fields["twist.covariance"] = np.full((N, 36), -1.0)
    assert set(found({"/ins/odom": out}).mapping.truth) == {"x_m", "y_m", "quat_wxyz"}


def test_what_was_ambiguous_names_its_readings_and_the_one_that_was_taken():
    heading = 0.5 * S
    vel = twist("geometry_msgs/msg/TwistStamped", "twist", 10 * np.cos(heading), 10 * np.sin(heading))
    (doubt,) = found({"/gps/vel": vel}).ambiguities
    readings = ("/gps/vel as body velocity", "/gps/vel as east, north, up")
    assert (doubt.candidates, doubt.chosen) == (readings, readings[1])
    assert doubt.reason == "x is not the direction of travel"
    # More messages go first, then the shorter name.
    few = FakeTopic("sensor_msgs/msg/Imu", T[:9], {k: v[:9] for k, v in imu().fields.items()})
    (doubt,) = found({"/a/imu": few, "/imu/long": imu(), "/imu/b": imu()}).ambiguities
    assert (doubt.candidates, doubt.chosen) == (("/imu/b", "/imu/long", "/a/imu"), "/imu/b")
    # A truth's name promises the body frame: what does not look like it is said, and taken all the same.
    auto = found({"/truth/vel": vel})
    assert set(auto.mapping.truth) == {"vx_m_s", "vy_m_s", "yaw_rate_rad_s"}
    assert [(a.candidates, a.chosen) for a in auto.ambiguities] == [(("/truth/vel as body velocity",), "/truth/vel")]


@pytest.mark.parametrize(
    ("name", "status", "lowest"), [("/rtk/fix", 2.0, 2.0), ("/rtk/fix", 1.0, 0.0), ("/gps/fix", 2.0, 0.0)]
)
def test_a_fix_is_gated_by_the_best_that_its_receiver_can_say(name, status, lowest):
    auto = found({name: fix(status)})
    gate = auto.mapping.quality
    assert gate is not None and (gate.topic, gate.min, gate.stamp) == (name, lowest, "header.stamp")
    assert auto.mapping.notes == (f"ground truth is used where {name}.status.status is at least {lowest:g}",)


@pytest.mark.parametrize(
    ("type_name", "lacks", "has"),
    [
        ("sensor_msgs/msg/NavSatFix", "longitude", {"latitude": S}),
        ("foxglove.LocationFix", "latitude", {"longitude": S, "altitude": S}),
        ("autoware_vehicle_msgs/msg/SteeringReport", "steering_tire_angle", {"angle": S}),
        ("autoware_vehicle_msgs/msg/VelocityReport", "longitudinal_velocity", {"lateral_velocity": S}),
        ("sensor_msgs/msg/Imu", "angular_velocity.z", {"orientation.w": S}),
        ("nav_msgs/msg/Odometry", "twist and pose", {"twist.twist.angular.z": S}),
        ("geometry_msgs/msg/PoseStamped", "pose.position.x", {"pose.orientation.w": S}),
    ],
)
def test_a_types_name_promises_nothing(type_name, lacks, has):
    """A topic without the fields of its type is not used, and does not hide one that has them."""
    name = "/ins/speed"
    bare = topic(type_name)
    bare.fields |= has
    auto = found({name: bare, "/truth/odometry": odometry()})
    assert {s.topic for s in (*auto.mapping.signals.values(), *auto.mapping.truth.values())} == {"/truth/odometry"}, (
        lacks
    )
    assert f"{name} is not used: its fields differ from {type_name}" in auto.mapping.notes
    assert auto.ambiguities == ()


def test_a_reference_instrument_beside_a_receiver_is_ground_truth_and_no_input(shared_dir):
    log = open_log(shared_dir / "data" / "drives" / "v40_swd_gnss.mcap")
    mapping = auto_map(log).mapping
    log.close()
    assert {s.topic for s in mapping.truth.values()} == {"/reference/slip"}
    assert {"vx_m_s", "vy_m_s"} <= set(mapping.truth)
    assert "/reference/slip" not in {s.topic for s in mapping.signals.values()}
    assert {"gnss_velocity_east_m_s", "gnss_velocity_north_m_s"} <= set(mapping.signals)


@pytest.mark.parametrize(
    ("drive", "reference", "unmapped"),
    [
        ("revs_250lm_a.mcap", "revs_250lm", set()),
        ("f1tenth_hoons_run2.bag", "f1tenth", set()),  # The speed is an array element, identified by a_y ≈ v r.
    ],
)
def test_real_drives_map_as_by_hand(shared_dir, drive, reference, unmapped):
    log = open_log(shared_dir / "data" / "drives" / drive)
    auto = auto_map(log)
    by_hand = load_mapping(Path(__file__).parents[1] / "reference" / "mappings" / f"{reference}.toml")
    assert set(auto.missing) == unmapped
    assert all(c.verdict == "undecided" for c in auto.mapping.checks)
    assert auto.ambiguities == ()
    for mine, theirs in ((auto.mapping.signals, by_hand.signals), (auto.mapping.truth, by_hand.truth)):
        assert {n: (s.topic, s.field, s.stamp) for n, s in mine.items()} == {
            n: (s.topic, s.field, s.stamp) for n, s in theirs.items() if n not in unmapped
        }
    log.close()


def test_a_standard_imu_in_g_and_degrees():
    wrong = imu(**{"linear_acceleration.x": 0.01 * np.sin(S), "linear_acceleration.y": 0.1 * np.sin(S)})
    wrong.fields |= {"linear_acceleration.z": np.ones(N), "angular_velocity.z": 20.0 * np.sin(S)}
    auto = found({"/imu": wrong})
    assert auto.mapping.signals["ay_m_s2"].scale == 9.80665
    assert auto.mapping.signals["yaw_rate_rad_s"].scale == pytest.approx(np.pi / 180.0)
    assert any("in g" in str(a) and "deg/s" in str(a) for a in auto.ambiguities)


def _circle(twist_angle: np.ndarray) -> FakeTopic:
    """Return an odometry on a circle; ``twist_angle`` is the direction of its twist."""
    out = odometry(10.0 * np.cos(twist_angle), 10.0 * np.sin(twist_angle))
    out.fields |= {"pose.pose.position.x": 20.0 * np.sin(0.5 * S), "pose.pose.position.y": -20.0 * np.cos(0.5 * S)}
    out.fields |= {"pose.pose.orientation.z": np.sin(0.25 * S), "pose.pose.orientation.w": np.cos(0.25 * S)}
    return out


def test_a_twist_in_the_axes_of_the_world_is_a_velocity_over_ground():
    assert "enu_velocity_m_s" in found({"/ground_truth/odom": _circle(0.5 * S)}).mapping.truth
    assert "vx_m_s" in found({"/ground_truth/odom": _circle(0.02 * np.sin(S))}).mapping.truth


def test_a_sideslip_that_follows_the_heading_is_in_the_axes_of_the_body():
    heading = 0.05 * np.sin(2.0 * S)  # about east, so that the axes of body and earth are nearly parallel
    sensor = imu(**{"angular_velocity.z": np.gradient(heading, S)})

    down = {n: -sensor.fields[n] for n in ("angular_velocity.z", "linear_acceleration.y")}
    hanging = imu(**down, **{"linear_acceleration.z": np.full(N, -9.81)})

    def truth(direction: np.ndarray, sensor: FakeTopic = sensor) -> set[str]:
        log = odometry(10.0 * np.cos(direction), 10.0 * np.sin(direction))
        log.fields |= {"pose.pose.position.x": 10.0 * S, "pose.pose.position.y": -0.25 * np.cos(2.0 * S)}
        return set(found({"/ground_truth/odom": log, "/imu": sensor}).mapping.truth)

    assert "vx_m_s" in truth(0.3 * heading)
    assert "enu_velocity_m_s" in truth(heading)
    assert "enu_velocity_m_s" in truth(heading, hanging)


def test_a_simulators_odometry_with_a_lateral_velocity_is_ground_truth():
    assert "vy_m_s" in found({"/carla/hero/odometry": _circle(0.02 * np.sin(S))}).mapping.truth
    assert "vy_m_s" not in found({"/robot/odometry": _circle(0.02 * np.sin(S))}).mapping.truth


def test_a_status_of_a_drive_is_measured():
    status = topic("ackermann_msgs/msg/AckermannDriveStamped", drive__steering_angle=S, drive__speed=5 + S)
    command = topic("ackermann_msgs/msg/AckermannDrive", "", steering_angle=S, speed=5 + S)
    signals = found({"/drive": command, "/drive_status": status}).mapping.signals
    assert {signals[n].topic for n in ("steer_rad", "speed_m_s")} == {"/drive_status"}
