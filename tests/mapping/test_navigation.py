"""Motion over ground: velocities, receivers as sensors, instruments that are ground truth, and joints of a model."""

import math
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import AutoMapping, auto_map, fit_clocks, read_signals
from pdhef_logtool.mapping.channels import si_values
from pdhef_logtool.mapping.joints import joint_names
from pdhef_logtool.mapping.mapping_file import load_mapping, mapping_from_dict, mapping_to_toml
from pdhef_logtool.mapping.navigation import receiver_signals
from pdhef_logtool.records.errors import MappingFileError
from pdhef_logtool.records.signals import Channel
from studies.strangers import containers
from studies.strangers.containers import Topic
from tests.fake_drive_log import FakeLog, FakeTopic
from tests.mapping.winding_road import AX, AY, EAST, FIX, NORTH, RATE, YAW, S, T, V

IMU = {"linear_acceleration.x": AX, "linear_acceleration.y": AY,
       "linear_acceleration.z": 9.81 + 0.0 * S, "angular_velocity.z": RATE}  # fmt: skip


def topic(type_name: str, fields: dict[str, np.ndarray], *examples: object) -> FakeTopic:
    return FakeTopic(type_name, T + 2_000_000, {"header.stamp": T} | fields, examples=examples)


def found(**contents: FakeTopic) -> AutoMapping:
    return auto_map(FakeLog({"/imu": topic("sensor_msgs/msg/Imu", IMU)} | {f"/{k}": v for k, v in contents.items()}))


def of_table(**columns: np.ndarray) -> AutoMapping:
    """The mapping of a table without types."""
    return auto_map(FakeLog({"csv": FakeTopic("table", T, columns)}))


@pytest.mark.parametrize(
    "name", ["{}", "truth_{}", "{}_gt", "rtk_{}", "ins_{}", "oxts_{}", "{}_rt3000", "kistler_{}", "true_{}"]
)
def test_a_table_of_two_instruments(name):
    """Sideslip and the words beside its name show the ground truth's instrument; the other columns are the car's."""
    truth = {name.format("vx"): V, name.format("vy"): 0.3 * RATE, name.format("yaw_rate"): 1.001 * RATE}
    own = {"speed": V, "accel_y": V * RATE, "yaw_rate": RATE, "steer": 2.9 * RATE / V}
    own = {f"can_{n}": column for n, column in own.items()} if name == "{}" else own
    mapping = of_table(**own, **truth).mapping
    assert {str(s.field) for s in mapping.truth.values()} == set(truth)
    assert {str(s.field) for s in mapping.signals.values()}.isdisjoint(truth)
    assert {"speed_m_s", "ay_m_s2", "yaw_rate_rad_s"} <= mapping.signals.keys()


def speed_of(auto: AutoMapping, east: np.ndarray = EAST, north: np.ndarray = NORTH) -> np.ndarray:
    source = auto.mapping.signals["speed_m_s"]
    log = FakeLog({source.topic: topic("x/msg/X", dict(zip(source.paths, (east, north), strict=True)))})
    return si_values(log.read({source.topic: source.paths})[source.topic], source)


def twist(factor: float = 1.0) -> FakeTopic:
    return topic("geometry_msgs/msg/TwistStamped", {"twist.linear.x": factor * EAST, "twist.linear.y": factor * NORTH})


@pytest.mark.parametrize("witness", [{}, {"fix": topic("sensor_msgs/msg/NavSatFix", FIX)}])
def test_a_velocity_east_and_north_gives_the_speed(witness):
    auto = found(vel=twist(), **witness)
    np.testing.assert_allclose(speed_of(auto), V)
    assert any("/vel" in n and "never negative" in n for n in auto.mapping.notes)
    assert not auto.ambiguities


@pytest.mark.parametrize("names", [("VelN", "VelE"), ("v_n", "v_e"), ("north_speed", "east_speed")])
def test_north_and_east_in_a_table_of_everything_are_speed_and_receiver(names):
    signals = of_table(AccX=AX, AccY=AY, GyroZ=RATE, **dict(zip(names, (NORTH, EAST), strict=True))).mapping.signals
    assert signals["speed_m_s"].paths == names[::-1]
    assert signals["gnss_velocity_north_m_s"].paths + signals["gnss_velocity_east_m_s"].paths == names


def test_the_truths_velocity_stands_in_with_a_mark():
    pva = {"north_velocity": NORTH, "east_velocity": EAST, "up_velocity": 0.0 * S}
    auto = found(ins=topic("novatel_oem7_msgs/msg/INSPVA", pva | FIX | {"height": 0.0 * S}))
    np.testing.assert_allclose(speed_of(auto), V)
    assert any("is also the ground truth" in n for n in auto.mapping.notes)


def test_a_length_is_written_and_read_back(tmp_path):
    mapping = found(vel=twist()).mapping
    (tmp_path / "m.toml").write_text(mapping_to_toml(mapping))
    assert load_mapping(tmp_path / "m.toml").signals == mapping.signals
    for table in ({"field": "a"}, {"field": ["a"], "scale": [1.0]}):
        with pytest.raises(MappingFileError, match="length of two or more fields"):
            mapping_from_dict({"signals": {"speed_m_s": {"topic": "/t", "combine": "norm", **table}}}, where="m")


NAMES = ("front_left_steering_joint", "rear_left_wheel_joint", "front_right_steering_joint", "rear_right_wheel_joint")


def joints(*examples: object) -> FakeTopic:
    steer = 2.7 * RATE / V
    position = np.stack([1.03 * steer, np.cumsum(V) * 0.033, 0.97 * steer, np.cumsum(V) * 0.033], axis=1)
    velocity = np.stack([0.0 * V, V / 0.3, 0.0 * V, V / 0.3], axis=1)
    return topic("sensor_msgs/msg/JointState", {"position": position, "velocity": velocity}, *examples)


def test_joints_by_the_names_in_the_messages():
    signals = found(joint_states=joints({"name": list(NAMES)}, {"name": list(NAMES)})).mapping.signals
    steer = signals["steer_rad"]
    assert (steer.paths, steer.scale) == (("position[0]",), 1.0)
    assert (signals["wheel_speed_rl_rad_s"].field, signals["wheel_speed_rr_rad_s"].field) == (
        "velocity[1]",
        "velocity[3]",
    )
    auto = found(joint_states=joints({"name": list(NAMES)}, {"name": list(reversed(NAMES))}))
    assert not {"steer_rad", "wheel_speed_rl_rad_s"} & set(auto.mapping.signals)
    assert any("/joint_states" in n and "their order differ" in n for n in auto.mapping.notes)
    assert "steer_rad" not in found(joint_command=joints({"name": list(NAMES)})).mapping.signals


@pytest.mark.parametrize("swap", [False, True])
@pytest.mark.parametrize("name", ["vel", "gnss_velocity", "gps_speed"])
def test_a_twist_that_turns_with_the_car_is_a_receivers_velocity(name, swap):
    """The car drives mostly to the east, so that x alone looks like a forward velocity."""
    sides = {"twist.linear.x": NORTH if swap else EAST, "twist.linear.y": EAST if swap else NORTH}
    fields = {**sides, "twist.linear.z": 0.0 * S}
    fix = topic("sensor_msgs/msg/NavSatFix", FIX)
    mapping = found(**{name: topic("geometry_msgs/msg/TwistStamped", fields)}, fix=fix).mapping
    assert not {"vx_m_s", "vy_m_s"} & set(mapping.truth)
    east, north = (mapping.signals[f"gnss_velocity_{side}_m_s"].paths[0] for side in ("east", "north"))
    assert (east, north) == (("twist.linear.y", "twist.linear.x") if swap else ("twist.linear.x", "twist.linear.y"))


def test_position_speed_and_heading_of_one_table_are_a_receivers():
    place = {name.upper(): values for name, values in FIX.items()}
    signals = of_table(**place, SPEED_KPH=3.6 * V, HEADING_DEG=90.0 - np.degrees(YAW)).mapping.signals
    assert {"gnss_latitude_deg", "gnss_longitude_deg", "gnss_speed_m_s", "gnss_course_rad"} <= set(signals)
    assert signals["gnss_speed_m_s"].scale == pytest.approx(1.0 / 3.6)


def test_letters_are_signals_where_physics_shows_them():
    mapping = of_table(u=V, v=0.3 * RATE, r=RATE, delta=2.9 * RATE / V, a_x=AX, a_y=np.roll(AY, -8)).mapping
    paths = {n: s.paths[0] for n, s in mapping.signals.items()}
    assert (paths["speed_m_s"], paths["yaw_rate_rad_s"]) == ("u", "r")
    assert {c.name for c in mapping.checks} >= {"truth.source"}


@pytest.mark.parametrize("name", ["steer_angle_status", "steer_angle_state"])
def test_a_status_that_is_an_angle_is_read(name):
    signals = of_table(yaw_rate=RATE, speed=V, accel_y=V * RATE, **{name: 2.9 * RATE / V}).mapping.signals
    assert "steer_rad" in signals or "steering_wheel_rad" in signals


NAV_PVT = ("vel_n", "vel_e", "g_speed", "h_acc", "s_acc", "fix_type", "lat", "lon")


@pytest.mark.parametrize(
    ("fields", "signals"),
    [
        (NAV_PVT, {"gnss_velocity_east_m_s": ("vel_e", 1e-3), "gnss_velocity_accuracy_m_s": ("s_acc", 1e-3)}),
        (("velN", "velE", "gSpeed", "hAcc", "fixType"), {"gnss_velocity_north_m_s": ("velN", 1e-3)}),
        (("vel_n", "vel_e", "g_speed", "c_acc", "s_acc"), {"gnss_velocity_north_m_s": ("vel_n", 1e-2)}),
        (("hor_speed", "trk_gnd"), {"gnss_speed_m_s": ("hor_speed", 1.0)}),
        (("vn", "ve", "cog", "mode", "latitude"), {"gnss_latitude_deg": ("latitude", 57.29577951308232)}),
        (("n", "e", "d", "h_accuracy", "n_sats", "tow"), {"gnss_velocity_east_m_s": ("e", 1e-3)}),
        (("lat", "lon", "height", "h_accuracy", "n_sats"), {"gnss_latitude_deg": ("lat", 1.0)}),
        (("lat", "lon", "h_msl", "h_acc", "v_acc"), {"gnss_longitude_deg": ("lon", 1e-7)}),
        (("speed_raw", "heading_raw", "True_Head"), {"gnss_speed_m_s": ("speed_raw", 1.0 / 3.6)}),
        (("track", "speed", "err_track", "err_horz"), {"gnss_position_accuracy_m": ("err_horz", 0.5)}),
    ],
    ids=[
        "NAV-PVT", "NAV-PVT camel case", "NAV-VELNED", "BESTVEL", "PVTGeodetic", "VelNed", "PosLlh", "NAV-POSLLH",
        "VBO", "GPSFix",
    ],
)  # fmt: skip
@pytest.mark.parametrize("base", ["", "receiver.solution."])
def test_messages_of_receivers_are_recognised_below_any_struct(fields, signals, base):
    found = receiver_signals("/gps", "log_time", [f"{base}{name}" for name in fields])
    for name, (field, scale) in signals.items():
        assert found[name].field == f"{base}{field}"
        assert found[name].scale == pytest.approx(scale)


def test_a_course_is_counter_clockwise_from_east():
    course = receiver_signals("/gps", "log_time", ["hor_speed", "trk_gnd"])["gnss_course_rad"]
    assert isinstance(course.scale, float)
    north, east = (course.scale * deg + course.offset for deg in (0.0, 90.0))
    assert (north, east) == pytest.approx((np.pi / 2.0, 0.0))


@pytest.mark.parametrize(
    "fields",
    [("north_velocity", "east_velocity", "azimuth"), ("vn", "ve", "cog", "heading"), ("x", "y"), ()],
    ids=["INSPVA", "INSNavGeod", "others", "none"],
)
def test_a_message_with_a_heading_is_no_sensor(fields):
    assert receiver_signals("/ins", "log_time", fields) == {}


def _noise(type_name: str, *fields: str) -> FakeTopic:
    rng = np.random.default_rng(0)
    return FakeTopic(type_name, T[:200], {f: rng.standard_normal(200) for f in fields})


def test_a_receiver_is_mapped_with_its_quality_and_rates_of_the_imu():
    parts = (f"{part}.{axis}" for part in ("linear_acceleration", "angular_velocity") for axis in "xyz")
    imu, pvt = _noise("sensor_msgs/msg/Imu", *parts), _noise("ublox_msgs/msg/NavPVT", *NAV_PVT)
    signals = auto_map(FakeLog({"/imu": imu, "/gps/pvt": pvt})).mapping.signals
    assert signals["gnss_velocity_east_m_s"].label == "/gps/pvt.vel_e"
    assert {"gnss_fix_type", "gnss_velocity_accuracy_m_s", "gnss_position_accuracy_m"} <= set(signals)
    assert signals["roll_rate_rad_s"].field == "angular_velocity.x"
    assert signals["pitch_rate_rad_s"].field == "angular_velocity.y"


def test_an_instrument_that_is_ground_truth_is_no_sensor():
    velocity = _noise("geometry_msgs/msg/TwistStamped", "twist.linear.x", "twist.linear.y", "twist.angular.z")
    log = FakeLog({"/truth/twist": velocity, "/truth/pvt": _noise("ublox_msgs/msg/NavPVT", *NAV_PVT)})
    assert not [name for name in auto_map(log).mapping.signals if name.startswith("gnss_")]


def write(path: Path, container: str) -> Path:
    """Write a log of two steered joints."""
    values = np.tile([0.1, 0.2], (3, 1))
    fields = dict.fromkeys(("position", "velocity", "effort"), values)
    joints = Topic(
        "/joint_states", "sensor_msgs/msg/JointState", T[:3], T[:3], fields, {"name": "left_steer right_steer"}
    )
    return containers.write([joints], path, container)


@pytest.mark.parametrize("container", ["rosbag1", "rosbag2"])
def test_joints_of_real_messages(tmp_path, container):
    with closing(open_log(write(tmp_path / "log", container))) as log:
        (topic,) = (t for t in log.topics if t.name == "/joint_states")
        assert joint_names(log, topic) == ("left_steer", "right_steer")


# ---- Foxglove's messages, and ROS types in JSON and protobuf, are recognised like their ROS counterparts ----

STEP = np.arange(40)
STAMPS = 100_000_000_000 + STEP * 100_000_000
ONE = np.ones(40)
Fields = Mapping[str, np.ndarray]


def mapped(folder: Path, container: str, **topics: tuple[str, Fields]) -> tuple[AutoMapping, dict[str, Channel]]:
    """Write topics (type, columns) that are recorded 20 ms after their stamps, and map the log."""
    contents = [Topic(f"/{n}", kind, STAMPS, STAMPS + 20_000_000, columns) for n, (kind, columns) in topics.items()]
    with closing(open_log(containers.write(contents, folder / "log", container))) as log:
        found = auto_map(log)
        read = read_signals(log, found.mapping, fit_clocks(log, found.mapping, log.start_ns, log.end_ns), 0, 10**12)
    return found, {**read.signals, **read.truth}


def stamped(place: str, names: tuple[str, str]) -> dict[str, np.ndarray]:
    return {f"{place}.{names[0]}": STAMPS // 10**9, f"{place}.{names[1]}": STAMPS % 10**9}


ENCODINGS = pytest.mark.parametrize(
    ("container", "times"), [("mcap-protobuf", ("seconds", "nanos")), ("mcap-json", ("sec", "nsec"))]
)
LOCATION_FIX = {"latitude": 57.0 + STEP * 1e-5, "longitude": 12.0 * ONE, "altitude": 30.0 * ONE}


@ENCODINGS
def test_a_location_fix_is_a_satellite_fix_with_angles_from_north(tmp_path, container, times):
    fix = {**stamped("timestamp", times), **LOCATION_FIX, "heading": 0.1 * STEP, "course": 0.1 * STEP + 0.02}
    found, got = mapped(tmp_path, container, gps=("foxglove.LocationFix", fix))
    assert set(found.mapping.truth) == {"lat_deg", "lon_deg", "alt_m", "yaw_rad", "course_rad"}
    np.testing.assert_array_equal(got["lat_deg"].stamps_ns, STAMPS)
    np.testing.assert_allclose(got["yaw_rad"].values, math.pi / 2 - 0.1 * STEP, atol=1e-12)
    np.testing.assert_allclose(got["course_rad"].values, math.pi / 2 - 0.1 * STEP - 0.02, atol=1e-12)
    assert any("two antennas" in note for note in found.mapping.notes)


def test_a_heading_that_repeats_the_course_is_no_yaw():
    fix = FakeTopic("foxglove.LocationFix", STAMPS, {**LOCATION_FIX, "heading": 0.1 * STEP, "course": 0.1 * STEP})
    mapping = auto_map(FakeLog({"/gps": fix})).mapping
    assert "yaw_rad" not in mapping.truth
    assert "course_rad" in mapping.truth
    assert any("repeats the course" in note for note in mapping.notes)


@ENCODINGS
def test_odometry_is_truth_or_speed_by_its_name(tmp_path, container, times):
    def odometry(scale: float) -> tuple[str, Fields]:
        position = {"pose.position.x": 2.0 * STEP, "pose.position.y": 0.5 * ONE, "pose.position.z": 0.0 * ONE}
        attitude = dict(zip("xyzw", (0.0, 0.0, 0.6, 0.8), strict=True))
        turned = {f"pose.orientation.{axis}": value * ONE for axis, value in attitude.items()}
        ahead = {"linear_velocity.x": 20.0 * scale * ONE, "linear_velocity.y": 0.01 * STEP}
        return "foxglove.Odometry", {
            **stamped("timestamp", times), **position, **turned, **ahead, "angular_velocity.z": 0.3 + 0.01 * STEP,
        }  # fmt: skip

    found, got = mapped(tmp_path, container, truth=odometry(1.0), wheel=odometry(1.01))
    assert {s.topic for s in found.mapping.signals.values()} == {"/wheel"}
    truth = {"vx_m_s", "vy_m_s", "yaw_rate_rad_s", "x_m", "y_m", "quat_wxyz"}
    assert {n: s.topic for n, s in found.mapping.truth.items()} == dict.fromkeys(truth, "/truth")
    np.testing.assert_allclose(got["speed_m_s"].values, 20.2)
    np.testing.assert_allclose(got["yaw_rate_rad_s"].values, 0.3 + 0.01 * STEP)
    np.testing.assert_allclose(got["quat_wxyz"].values[0], [0.8, 0.0, 0.0, 0.6])
    np.testing.assert_array_equal(got["vx_m_s"].stamps_ns, STAMPS)


def test_a_list_of_poses_is_said_and_not_guessed():
    poses = FakeTopic("foxglove.PosesInFrame", STAMPS, {"poses[].position.x": ONE})
    found = auto_map(FakeLog({"/ground_truth/poses": poses}))
    assert not found.mapping.truth
    assert [(a.candidates, a.chosen) for a in found.ambiguities] == [(("/ground_truth/poses",), None)]
    assert "list of poses" in str(found.ambiguities[0])


FOXGLOVE_IMU = {"linear_acceleration.x": ONE, "linear_acceleration.y": 2.0 * ONE, "linear_acceleration.z": 9.8 * ONE,
       "angular_velocity.z": 0.5 * ONE}  # fmt: skip


@pytest.mark.parametrize("name", ["sensor_msgs/Imu", "sensor_msgs/msg/Imu", "sensor_msgs.Imu", "ros.sensor_msgs.Imu"])
def test_a_ros_type_in_json_is_recognised_by_its_name(tmp_path, name):
    imu = {**stamped("header.stamp", ("sec", "nanosec")), **FOXGLOVE_IMU}
    found, got = mapped(tmp_path, "mcap-json", imu=(name, imu))
    assert set(found.mapping.signals) == {"ax_m_s2", "ay_m_s2", "yaw_rate_rad_s"}
    assert set(got["ay_m_s2"].values) == {2.0}
    np.testing.assert_array_equal(got["ay_m_s2"].stamps_ns, STAMPS)


def test_a_name_without_the_fields_is_said_and_spoils_nothing(tmp_path):
    other, fix = ("sensor_msgs/Imu", {"acc": np.ones((40, 3))}), ("foxglove.LocationFix", {"lat": ONE})
    found, _ = mapped(tmp_path, "mcap-json", imu=("sensor_msgs/Imu", FOXGLOVE_IMU), x=other, gps=fix)
    assert found.mapping.signals["ax_m_s2"].topic == "/imu"
    assert not found.ambiguities
    assert sorted(n.partition(" ")[0] for n in found.mapping.notes if "fields differ from" in n) == ["/gps", "/x"]
