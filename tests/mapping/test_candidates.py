"""Candidates: signals selected from a drive with third-party names, units, nesting and signs."""

import csv
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_drive_log import FakeLog, FakeTopic

from pdhef_logtool.drive.survey import survey_log
from pdhef_logtool.logs.message_schema import stated_units
from pdhef_logtool.mapping import AutoMapping, auto_map, fit_clocks
from pdhef_logtool.mapping.channels import si_of
from pdhef_logtool.mapping.mapping_file import mapping_from_dict
from pdhef_logtool.mapping.naming import meaning_among, meaning_of
from pdhef_logtool.mapping.vendors import load_vendors, meaning_of_source
from pdhef_logtool.records.errors import MappingFileError
from tests.mapping.winding_road import AX, AY, DEG, EAST, FIX, NORTH, RATE, STEER, YAW, G, N, S, T, V

HALF_TRACK = 0.75


def topic(type_name: str = "car_msgs/msg/State", encoding: str = "cdr", **fields: np.ndarray) -> FakeTopic:
    named = {k.replace("__", "."): np.asarray(v, dtype=np.float64) for k, v in fields.items()}
    return FakeTopic(type_name, T + 2_000_000, {"header.stamp": T} | named, encoding=encoding)


def found(**contents: FakeTopic) -> AutoMapping:
    return auto_map(FakeLog({"/" + k.replace("__", "/"): v for k, v in contents.items()}))


def surveyed(**contents: FakeTopic) -> AutoMapping:
    """Return the automatic mapping with the signs of the drive and the checks that the drive did not pass."""
    log = FakeLog({"/" + k.replace("__", "/"): v for k, v in contents.items()})
    auto = auto_map(log)
    span = (log.start_ns, log.end_ns)
    survey = survey_log(log, auto.mapping, fit_clocks(log, auto.mapping, *span), span)
    checks = tuple(c for c in survey.checks if c.verdict != "passed")
    return replace(auto, mapping=replace(survey.mapping, checks=checks))


def unsettled(auto: AutoMapping) -> set[str]:
    """Return the signals with a questionable or undecided sign."""
    return {c.subject for c in auto.mapping.checks if c.name.endswith((".sign", ".candidate", ".corrected"))}


def test_a_constant_speed_with_a_unit_is_taken_with_a_doubt_and_a_filler_is_not():
    steady = topic(speed_mps=np.full(N, 20.0), yaw_rate_radps=RATE, ay_mps2=20.0 * RATE)
    assert found(car=steady).mapping.signals["speed_m_s"].field == "speed_mps"
    assert "speed_m_s.candidate" in {c.name for c in found(car=steady).mapping.checks}
    assert "speed_m_s" not in found(car=topic(speed_mps=np.zeros(N), yaw_rate_radps=RATE)).mapping.signals


def taken(auto: AutoMapping) -> dict[str, tuple[str, float]]:
    return {n: (s.label, round(float(s.scale), 6)) for n, s in auto.mapping.signals.items()}


def undecided(auto: AutoMapping) -> set[str]:
    assert all(c.verdict == "undecided" and c.evidence and c.remedy for c in auto.mapping.checks)
    return {c.name for c in auto.mapping.checks}


def imu_fields(scale: float = 1.0, rate_scale: float = 1.0, prefix: str = "") -> dict[str, np.ndarray]:
    return {
        f"{prefix}linear_acceleration__x": AX / scale,
        f"{prefix}linear_acceleration__y": AY / scale,
        f"{prefix}linear_acceleration__z": (G + 0.0 * S) / scale,
        f"{prefix}angular_velocity__x": 0.01 * np.sin(S) / rate_scale,
        f"{prefix}angular_velocity__y": 0.01 * np.cos(S) / rate_scale,
        f"{prefix}angular_velocity__z": RATE / rate_scale,
    }


SPEED = {"vehicle__speed": topic(speed_mps=V)}


@pytest.mark.parametrize("acceleration", [1.0, G, G * 1e-3])
@pytest.mark.parametrize(("rate", "prefix"), [(1.0, ""), (DEG, "imu__")])
def test_units_that_no_name_tells_come_from_gravity_and_from_turning(acceleration, rate, prefix):
    auto = found(sensors__core=topic(**imu_fields(acceleration, rate, prefix)), **SPEED)
    got = taken(auto)
    assert set(got) == {"ax_m_s2", "ay_m_s2", "yaw_rate_rad_s", "speed_m_s"}
    assert got["ay_m_s2"][1] == pytest.approx(acceleration, rel=1e-3)
    assert got["yaw_rate_rad_s"][1] == pytest.approx(rate, rel=1e-3)
    assert undecided(auto) == set()


def test_a_unit_that_nothing_tells_is_taken_by_convention_and_told():
    still = {k: v * 0.001 for k, v in imu_fields().items() if "angular" in k}
    auto = found(gyro=topic(**still))
    assert taken(auto) == {"yaw_rate_rad_s": ("/gyro.angular_velocity.z", 1.0)}
    assert undecided(auto) == {"yaw_rate_rad_s.candidate"}
    for km_h in (100.0, 30.0):  # as m/s, only race cars reach the first
        auto = found(car=topic(speed=km_h + 5.0 * np.sin(S)))
        assert taken(auto) == {"speed_m_s": ("/car.speed", round(1.0 / 3.6, 6) if km_h > 70.0 else 1.0)}
        assert undecided(auto) == {"speed_m_s.candidate"}


@pytest.mark.parametrize(
    ("field", "raw", "signal", "scale"),
    [
        ("steering_wheel_angle", STEER * 16.0, "steering_wheel_rad", 1.0),
        ("SteeringWheelAngle", STEER * 16.0 / DEG, "steering_wheel_rad", DEG),
        ("steeringAngle", STEER, "steer_rad", 1.0),
        ("steer_ang", STEER / DEG, "steer_rad", DEG),
        ("steering_angle", STEER * 16.0 / DEG, "steering_wheel_rad", DEG),
        ("front_tire_angle_deg", -STEER / DEG, "steer_rad", -DEG),
        ("roadwheel_angle_deg", STEER / DEG, "steer_rad", DEG),
        ("steering_deg", -STEER * 16.0 / DEG, "steering_wheel_rad", -DEG),
    ],
)
def test_a_steering_angle_is_told_by_the_paths_curvature(field, raw, signal, scale):
    auto = surveyed(imu__data=topic(**imu_fields()), chassis=topic(**{field: raw}), **SPEED)
    steering = {n: v for n, v in taken(auto).items() if n.startswith("steer")}
    assert steering == ({signal: (f"/chassis.{field}", round(scale, 6))} if signal else {})
    # Gravity is upward in the IMU, so that its yaw rate counts to the left, and steering has to.
    assert not unsettled(auto)


def test_steering_is_not_turned_after_an_imu_that_may_hang_upside_down():
    down = imu_fields()
    down |= {k: -down[k] for k in ("linear_acceleration__y", "linear_acceleration__z", "angular_velocity__z")}
    contents = {"vn__common": topic(**down), "chassis": topic(steering_wheel_angle_deg=STEER * 16.0 / DEG), **SPEED}
    assert taken(surveyed(**contents))["steering_wheel_rad"][1] == round(DEG, 6)


def test_a_measured_angle_of_any_type_goes_before_a_command():
    drive = topic("ackermann_msgs/msg/AckermannDriveStamped", drive__steering_angle=STEER)
    imu = {"imu__data": topic("sensor_msgs/msg/Imu", **imu_fields())}
    alone = found(drive=drive, chassis=topic(torque=STEER), **imu, **SPEED)
    assert taken(alone)["steer_rad"] == ("/drive.drive.steering_angle", 1.0)
    assert any("not from a measured angle" in n for n in alone.mapping.notes)
    both = found(drive=drive, chassis=topic(steering_wheel_angle_deg=STEER * 16.0 / DEG), **imu, **SPEED)
    assert "steer_rad" not in taken(both)
    assert taken(both)["steering_wheel_rad"] == ("/chassis.steering_wheel_angle_deg", round(DEG, 6))
    assert not any("not from a measured angle" in n for n in both.mapping.notes)
    assert [a.chosen for a in both.ambiguities] == ["/chassis.steering_wheel_angle_deg"]


def test_a_steering_angle_that_does_not_follow_the_car_is_in_doubt():
    noise = np.random.default_rng(0).normal(0.0, 0.2, N)
    auto = found(imu__data=topic(**imu_fields()), a__steering=topic("std_msgs/msg/Float32", data=noise), **SPEED)
    (candidate,) = [c for c in auto.candidates if c.source.topic == "/a/steering"]
    assert "correlation with the path's curvature is only" in candidate.doubt


def test_commands_setpoints_and_estimates_are_no_sensors():
    auto = found(
        steering_cmd=topic(steering_wheel_angle=STEER),
        target__steering=topic(angle=STEER),
        ekf__state=topic(speed=V, yaw_rate=RATE, sideslip=0.1 * STEER),
        bus=topic(target_speed=V, vehicle_speed=3.6 * V, **imu_fields()),
    )
    assert set(taken(auto)) == {"ax_m_s2", "ay_m_s2", "yaw_rate_rad_s", "speed_m_s", "steer_rad"}
    assert any(n.startswith("steer_rad comes from the command") for n in auto.mapping.notes)
    assert taken(auto)["speed_m_s"] == ("/bus.vehicle_speed", round(1 / 3.6, 6))
    assert auto.mapping.truth == {}


@pytest.mark.parametrize(
    ("names", "unit", "signal", "scale"),
    [
        (("front_left", "front_right", "rear_left", "rear_right"), 1.0 / 3.6, "m_s", 1.0 / 3.6),
        (("WheelSpd_FL", "WheelSpd_FR", "WheelSpd_RL", "WheelSpd_RR"), 0.31, "rad_s", 1.0),
        (("fl_rpm", "fr_rpm", "rl_rpm", "rr_rpm"), 0.31 * math.pi / 30.0, "rad_s", math.pi / 30.0),
        (("lf", "rf", "lr", "rr"), 1.0, "m_s", 1.0),
    ],
)
def test_wheel_speeds_by_the_speed(names, unit, signal, scale):
    sides = (-1.0, 1.0, -1.0, 1.0)
    wheels = {n: (V + side * HALF_TRACK * RATE) / unit for n, side in zip(names, sides, strict=True)}
    auto = found(imu__data=topic(**imu_fields()), can__wheel_speeds=topic("x/WheelSpeeds", **wheels), **SPEED)
    for wheel, name in zip(("fl", "fr", "rl", "rr"), names, strict=True):
        assert taken(auto)[f"wheel_speed_{wheel}_{signal}"] == (f"/can/wheel_speeds.{name}", round(scale, 6))
    assert undecided(auto) == set()


def test_the_odd_sign_is_turned_by_the_wheels_and_of_two_alone_is_told():
    lateral = {"lat_accel_mps2": AY, "long_accel_mps2": AX, "yaw_rate_dps": -RATE / DEG}
    both = surveyed(daq=topic(**lateral), chassis=topic(steering_angle_rad=STEER), **SPEED, **WITNESSES["wheels"])
    assert taken(both)["yaw_rate_rad_s"] == ("/daq.yaw_rate_dps", round(-DEG, 6))
    assert unsettled(both) == set()
    two = surveyed(daq=topic(**lateral), **SPEED)
    assert taken(two)["yaw_rate_rad_s"][1] == round(DEG, 6)
    assert unsettled(two) >= {"yaw_rate_rad_s", "ay_m_s2"}


WHEELS = {"fl_kph": 3.6 * (V - HALF_TRACK * RATE), "fr_kph": 3.6 * (V + HALF_TRACK * RATE)}


WITNESSES = {
    "path": {"gps__fix": topic("sensor_msgs/msg/NavSatFix", **FIX)},
    "wheels": {"can__wheels": topic("x/WheelSpeeds", **WHEELS)},
}


@pytest.mark.parametrize("witness", WITNESSES.values(), ids=WITNESSES)
def test_what_is_all_positive_to_the_right_is_turned_by_the_way_the_car_turned(witness):
    right = {"lat_accel_mps2": -AY, "long_accel_mps2": AX, "yaw_rate_dps": -RATE / DEG}
    auto = surveyed(daq=topic(**right), chassis=topic(roadwheel_angle_rad=-STEER), **SPEED, **witness)
    got = {n: v[1] for n, v in taken(auto).items() if not n.startswith("wheel")}
    assert got == {"ax_m_s2": 1, "ay_m_s2": -1, "yaw_rate_rad_s": round(-DEG, 6), "steer_rad": -1, "speed_m_s": 1}
    assert unsettled(auto) == set()


@pytest.mark.parametrize(
    ("raw", "scale", "offset"),
    [
        (np.mod(90.0 - YAW / DEG, 360.0), -DEG, math.pi / 2.0),
        (np.mod(math.pi / 2.0 - YAW, 2.0 * math.pi), -1.0, math.pi / 2.0),
        (np.angle(np.exp(1j * YAW)), 1.0, 0.0),
        (np.angle(np.exp(1j * YAW)) / DEG, DEG, 0.0),
        (np.mod(200.0 - YAW / DEG, 360.0), None, None),
    ],
    ids=["compass deg", "compass rad", "east rad", "east deg", "turned away"],
)
@pytest.mark.parametrize("names", [("vel_n", "vel_e", "vel_d"), ("north_velocity", "east_velocity", "up_velocity"), ()])
def test_the_path_shows_how_a_heading_counts(raw, scale, offset, names):
    velocity = dict(zip(names, (NORTH, EAST, 0.01 * np.sin(S)), strict=False))
    auto = found(ins__solution=topic(heading=raw, **FIX, **velocity), imu__data=topic(**imu_fields()), **SPEED)
    yaw = auto.mapping.truth.get("yaw_rad")
    assert (scale, offset) == (None, None) if yaw is None else (yaw.scale, yaw.offset) == (scale, offset)
    expected = {"lat_deg", "lon_deg"} | ({"enu_velocity_m_s"} if names else set()) | ({"yaw_rad"} if scale else set())
    assert set(auto.mapping.truth) == expected
    if names:
        source = auto.mapping.truth["enu_velocity_m_s"]
        assert source.paths == (names[1], names[0], names[2])
        assert source.scale == (1.0, 1.0, -1.0 if names[2] == "vel_d" else 1.0)


@pytest.mark.parametrize("attitude", [True, False])
def test_a_receiver_has_a_course_and_an_ins_a_heading_also_without_a_vertical_velocity(attitude):
    fields = {"north_vel_cmps": 100.0 * NORTH, "east_vel_cmps": 100.0 * EAST} if attitude else {}
    fields |= {"roll": 0.01 * np.sin(S)} if attitude else {}
    compass = np.mod(90.0 - YAW / DEG, 360.0)
    gnss = topic(heading=compass, speed_kmh=3.6 * V, **FIX, **fields)
    mapping = found(gps=gnss, imu__data=topic(**imu_fields())).mapping
    assert mapping.signals["speed_m_s"].field == "speed_kmh"
    assert ("gnss_course_rad" in mapping.signals, "yaw_rad" in mapping.truth) == (not attitude, attitude)
    if attitude:
        velocity = mapping.truth["enu_velocity_m_s"]
        assert velocity.paths == ("east_vel_cmps", "north_vel_cmps", "north_vel_cmps")
        assert velocity.scale == (0.01, 0.01, 0.0)
        tables = {
            "truth": {"enu_velocity_m_s": {"topic": "/gps", "field": [*velocity.paths], "scale": [0.01, 0.01, 0.0]}}
        }
        assert mapping_from_dict(tables, where="m").truth["enu_velocity_m_s"].scale == velocity.scale


def test_a_magnitude_takes_its_sign_from_another_field():
    bus = topic(steering_angle_deg=np.abs(STEER) / DEG, steering_angle_deg_sign=1.0 * (STEER < 0.0))
    source = found(bus=bus, imu__data=topic(**imu_fields()), **SPEED).mapping.signals["steer_rad"]
    assert source.field == ("steering_angle_deg", "steering_angle_deg_sign")
    raw = [bus.fields[path] for path in source.paths]
    np.testing.assert_allclose(si_of(source, raw), STEER, atol=1e-9)
    tables = {
        "signals": {"steer_rad": {"topic": "/bus", "field": [*source.paths], "scale": [DEG, 1.0], "combine": "signed"}}
    }
    assert mapping_from_dict(tables, where="m").signals["steer_rad"].combine == "signed"


def test_a_steering_beside_pedals_is_a_share():
    auto = found(controls=topic(steer=STEER / 0.5, throttle=0.3 + 0.0 * S), imu__data=topic(**imu_fields()), **SPEED)
    assert not {"steer_rad", "steering_wheel_rad"} & set(auto.mapping.signals)
    assert any(note.startswith("/controls.steer is not used: it may be a share") for note in auto.mapping.notes)


@pytest.mark.parametrize("share", [1.0, 3.0])
def test_a_steering_without_a_unit_may_be_a_share(share):
    auto = found(controls=topic(steer=STEER * share), imu__data=topic(**imu_fields()), **SPEED)
    doubts = [c.evidence for c in auto.mapping.checks if c.name == "steer_rad.candidate"]
    assert any("a share of the largest angle" in doubt for doubt in doubts) is (share > 1.0)


def test_a_velocity_in_the_axes_of_the_world_is_no_speed():
    course = np.cumsum(RATE) * 0.01 + 0.3
    world = {"velocity__linear__x": V * np.cos(course), "velocity__linear__y": V * np.sin(course)}
    auto = found(car=topic(**world, **imu_fields()))
    assert not {"vx_m_s", "vy_m_s"} & set(auto.mapping.truth)
    assert auto.mapping.signals["speed_m_s"].combine == "norm"
    assert any("not in the car's axes" in note for note in auto.mapping.notes)


def test_short_names_beside_others():
    short = {"ax": AX, "ay": AY, "az": G + 0.0 * S, "gx": 0.01 * np.sin(S), "gy": 0.01 * np.cos(S), "gz": RATE}
    assert taken(found(ins=topic(**short), **SPEED))["yaw_rate_rad_s"] == ("/ins.gz", 1.0)
    state = {"vx": V, "vy": 0.01 * RATE, "r": RATE, "ax": AX, "ay": AY}
    assert taken(found(state=topic(**state)))["yaw_rate_rad_s"] == ("/state.r", 1.0)


@pytest.mark.parametrize("units", [(G, 1.0 / 3.6), (1.0, 1.0), (1.0, 0.44704)])
def test_units_of_a_speed_and_an_acceleration_at_once(units):
    auto = found(car=topic(accx=2.0 * AX / units[0], speed=(V + np.cumsum(AX) * 0.01) / units[1]))
    got = taken(auto)
    assert (got["ax_m_s2"][1], got["speed_m_s"][1]) == pytest.approx(units, rel=1e-4)


def test_truth_of_a_vendors_message_by_its_names():
    slip = topic(lng_vel_kmh=V * 3.6, lat_vel_kmh=0.2 * RATE * 3.6, yaw_rate_dps=-RATE / DEG)
    auto = surveyed(imu__data=topic(**imu_fields()), ins__slip=slip, **SPEED)
    truth = {n: (s.label, round(float(s.scale), 6)) for n, s in auto.mapping.truth.items()}
    assert truth == {
        "vx_m_s": ("/ins/slip.lng_vel_kmh", round(1 / 3.6, 6)),
        "vy_m_s": ("/ins/slip.lat_vel_kmh", round(1 / 3.6, 6)),
        "yaw_rate_rad_s": ("/ins/slip.yaw_rate_dps", round(-DEG, 6)),
    }


def test_a_sideslip_that_does_not_say_what_it_is_is_told():
    auto = found(imu__data=topic(**imu_fields()), esp=topic(sideslip_deg=RATE), **SPEED)
    assert set(auto.mapping.truth) == {"sideslip_rad"}
    assert "truth.source" in undecided(auto)


@pytest.mark.parametrize("turned", [False, True])
def test_a_vector_whose_x_is_not_the_speed_is_no_velocity_of_the_body(turned):
    yaw = np.cumsum(RATE) * 0.01 if turned else 0.02 * RATE
    state = topic(speed_mps=V, velocities__x=V * np.cos(yaw), velocities__y=V * np.sin(yaw))
    state.fields = {n.replace("velocities", "linear_velocities"): v for n, v in state.fields.items()}
    assert ("vy_m_s" in found(state=state).mapping.truth) is not turned


def test_odometry_stands_in_for_a_gyro_and_a_navigation_system_for_a_speed():
    motion = {"linear__x": V, "linear__y": 0.0 * V, "angular__z": RATE}
    fields = {f"twist__twist__{n}": v for n, v in motion.items()} | {f"pose__pose__position__{a}": S for a in "xy"}
    odometry = topic("nav_msgs/msg/Odometry", **fields)
    auto = found(wheel__odom=odometry)
    assert taken(auto)["yaw_rate_rad_s"] == ("/wheel/odom.twist.twist.angular.z", 1.0)
    assert any("no IMU gives it" in n for n in auto.mapping.notes)
    ins = found(ins__odometry=odometry, imu__data=topic("sensor_msgs/msg/Imu", **imu_fields()))
    assert taken(ins)["speed_m_s"] == ("/ins/odometry.twist.twist.linear.x", 1.0)
    assert any("input is the true speed" in n for n in ins.mapping.notes)


def test_documented_types_say_unit_sign_and_page():
    raptor = topic("raptor_dbw_msgs/msg/SteeringReport", steering_wheel_angle=STEER * 16.0 / DEG)
    px4 = topic("px4_msgs/msg/SensorCombined")
    px4.fields |= {"gyro_rad": np.stack([0 * S, 0 * S, -RATE], axis=1)}
    px4.fields |= {"accelerometer_m_s2": np.stack([AX, -AY, -G + 0 * S], axis=1)}
    auto = found(vehicle__steering=raptor, fmu__out=px4)
    got = taken(auto)
    assert got["steering_wheel_rad"] == ("/vehicle/steering.steering_wheel_angle", round(DEG, 6))
    assert got["ay_m_s2"] == ("/fmu/out.accelerometer_m_s2[1]", -1.0)
    assert all("https://" in c.reason for c in auto.candidates if c.taken)


def test_an_ins_whose_type_is_documented_is_truth_before_a_bare_fix():
    velocity = {"north_velocity": V, "east_velocity": 0 * V, "up_velocity": 0 * V}
    ins = topic("novatel_oem7_msgs/msg/INSPVA", **FIX, **velocity, azimuth=S)
    fix = topic("sensor_msgs/msg/NavSatFix", **FIX, status__status=0 * S)
    auto = found(novatel__inspva=ins, gps__fix=fix)
    assert {s.topic for s in auto.mapping.truth.values()} == {"/novatel/inspva"}
    assert set(auto.mapping.truth) == {"lat_deg", "lon_deg", "yaw_rad", "enu_velocity_m_s"}
    assert auto.mapping.truth["enu_velocity_m_s"].paths == ("east_velocity", "north_velocity", "up_velocity")
    assert auto.mapping.quality is None
    assert any("/gps/fix is not used" in n for n in auto.mapping.notes)


def test_positions_in_one_or_two_topics_show_the_unit_of_a_speed():
    apart = {f"bus__{n}": topic(value=v) for n, v in FIX.items()}
    for places in ({"gps__fix": topic("sensor_msgs/msg/NavSatFix", **FIX)}, apart):
        auto = found(**places, bus__vehicle_speed=topic(value=3.6 * V))
        assert taken(auto) == {"speed_m_s": ("/bus/vehicle_speed.value", round(1 / 3.6, 6))}
        assert undecided(auto) == set()


def test_a_documented_trap_is_left_out_with_its_reason():
    auto = found(novatel__corrimu=topic("novatel_oem7_msgs/msg/CORRIMU", yaw_rate=RATE, lateral_acc=AY))
    assert auto.mapping.signals == {}
    assert any("per sample" in n for n in auto.mapping.notes)


def test_wheels_by_axle_and_the_output_of_a_steering_system():
    axles = {f"axle_{i}_{side}_wheel_speed": V / 0.3 for i in (1, 2) for side in ("left", "right")}
    auto = found(
        wheel_rpt=topic(**axles), steering_rpt=topic(output=16.0 * STEER), imu__data=topic(**imu_fields()), **SPEED
    )
    got = taken(auto)
    assert got["steering_wheel_rad"][0] == "/steering_rpt.output"
    wheels = {n: v[0] for n, v in got.items() if n.startswith("wheel_speed")}
    assert wheels["wheel_speed_fr_rad_s"] == "/wheel_rpt.axle_1_right_wheel_speed"
    assert wheels["wheel_speed_rl_rad_s"] == "/wheel_rpt.axle_2_left_wheel_speed"


def test_a_documented_sign_decides_which_one_is_wrong():
    rates = FakeTopic("px4_msgs/msg/VehicleAngularVelocity", T, {"xyz": np.stack([0.0 * S, 0.0 * S, -RATE], axis=1)})
    auto = surveyed(rates=rates, rover=topic(measured_forward_speed=V, measured_lateral_acceleration=-AY))
    assert taken(auto)["ay_m_s2"] == ("/rover.measured_lateral_acceleration", -1.0)
    assert unsettled(auto) == set()


@pytest.mark.parametrize(
    ("factor", "signal", "scale", "is_doubted"),
    [(3.6, "m_s", 1 / 3.6, True), (60.0 / (2.0 * math.pi * 0.3), "rad_s", 2.0 * math.pi / 60.0, False)],
)
def test_wheels_without_any_speed_are_told_by_turning_and_a_tie_with_a_doubt(factor, signal, scale, is_doubted):
    wheels = {f"{w}_speed": factor * V for w in ("lf", "rf", "lb", "rb")}
    auto = found(imu__data=topic(**imu_fields()), wheels=topic(**wheels))
    assert taken(auto)[f"wheel_speed_rl_{signal}"] == ("/wheels.lb_speed", round(scale, 6))
    assert (f"wheel_speed_rl_{signal}.candidate" in undecided(auto)) is is_doubted


def test_an_export_is_told_by_its_fields():
    vbo = {"satellites": 9.0 + 0.0 * S, "latitude": 60.0 * FIX["latitude"], "longitude": -60.0 * FIX["longitude"],
           "velocity kmh": 3.6 * V, "heading": (90.0 - np.degrees(np.cumsum(RATE) * 0.01)) % 360.0,
           "Long accel g": AX / G, "Lat accel g": AY / G, "Yaw_rate deg/s": RATE / DEG}  # fmt: skip
    fields = {k: np.asarray(v, dtype=np.float64) for k, v in vbo.items()}
    auto = auto_map(FakeLog({"/vbo": FakeTopic("", T, fields, encoding="json")}))
    got = taken(auto)
    assert got["speed_m_s"] == ("/vbo.velocity kmh", round(1 / 3.6, 6))
    assert got["ay_m_s2"] == ("/vbo.Lat accel g", G)
    assert got["yaw_rate_rad_s"] == ("/vbo.Yaw_rate deg/s", round(DEG, 6))
    assert {auto.mapping.truth[n].scale for n in ("lat_deg", "lon_deg")} == {1 / 60.0, -1 / 60.0}


def test_every_shipped_entry_names_its_page():
    vendors = load_vendors()
    assert len(vendors.types) > 20
    for kind in vendors.types.values():
        assert kind.page.startswith(("https://", "truthsim/"))
        assert "read 20" in kind.page
        assert all(meaning_of_source(source).quantity for source in kind.fields.values())


def test_a_users_file_comes_first(tmp_path, monkeypatch):
    entry = (
        '[[types]]\ntype = ["car_msgs/State"]\nvendor = "me"\npage = "https://example.org"\nread = "2026-11-22"\n'
        'fields = [{ field = "q7", signal = "yaw_rate_rad_s", scale = -0.5 }]\n'
    )
    (tmp_path / "mine.toml").write_text(entry)
    monkeypatch.setenv("PDHEF_VENDORS", str(tmp_path / "mine.toml"))
    assert taken(found(a=topic(q7=RATE))) == {"yaw_rate_rad_s": ("/a.q7", -0.5)}
    (tmp_path / "mine.toml").write_text(entry.replace("yaw_rate_rad_s", "yaw"))
    with pytest.raises(MappingFileError, match="'yaw' is no signal"):
        load_vendors()


@pytest.mark.filterwarnings("error", "ignore::ResourceWarning")
@pytest.mark.parametrize("values", ["nan", "inf", "huge", "zero", "noise", "few"])
def test_values_that_are_no_drive_break_nothing(values):
    noise = np.random.default_rng(0).normal(size=N)
    made = {"nan": S * np.nan, "inf": S + np.inf, "huge": 1e300 * noise, "zero": 0.0 * S}.get(values, noise)
    names = ("speed", "yaw_rate", "accel_x", "accel_y", "accel_z", "steering_angle", "fl_speed", "fr_speed")
    fields = dict.fromkeys((*names, "latitude", "longitude", "heading", "sideslip", "", ".", "a..b"), made)
    message = topic()
    message.fields |= fields
    if values == "few":
        message.log_time_ns = T[:2]
        message.fields = {k: v[:2] for k, v in message.fields.items()}
    auto = found(ins__car=message, gps__fix=topic("sensor_msgs/msg/NavSatFix", latitude=made, longitude=made))
    # Values that are no measurement are not selected. Noise is reported as undecided.
    if values in ("nan", "inf", "huge", "zero"):
        assert taken(auto) == {}
    else:
        assert undecided(auto)


def test_a_rate_of_the_steering_is_no_steering_angle():
    assert meaning_of("/steering_velocity", "std_msgs/msg/Float64", "data") is None
    for name, path in (("/steering", "data"), ("/velocity_and_steering", "angle")):
        meaning = meaning_of(name, "std_msgs/msg/Float64", path)
        assert meaning is not None and meaning.quantity == "steering"


with Path(__file__).with_name("names.csv").open(encoding="utf-8") as _names:
    #: Titles of columns with their unit and the names beside them, and the quantity that they mean, if any.
    NAMES = list(csv.DictReader(_names))


@pytest.mark.parametrize("row", NAMES, ids=lambda row: "-".join([row["name"], row["unit"], row["beside"]]).strip("-"))
def test_a_name_is_the_quantity_that_it_and_the_names_beside_it_show(row):
    meaning = meaning_among("log", "", row["name"], row["unit"], {row["name"], *row["beside"].split()})
    assert (meaning.quantity if meaning else "", meaning.part if meaning else "") == (row["quantity"], row["part"])
    scale = meaning.scale if meaning else None
    assert scale == (pytest.approx(float(row["scale"])) if row["scale"] else None)


@pytest.mark.parametrize(
    ("kind", "comment", "name", "scale"),
    [
        ("float32", "[degree]", "steering", DEG), ("float64", "km/h, without a sign", "speed", 1 / 3.6),
        ("float32", "16|16@1+ (0.005,-163.84) [-163.84|163.835] deg/s", "Yaw_Rate", DEG),
        ("int16", "0.01 deg", "steer", 0.01 * DEG), ("int16", "单位0.01度", "steer", 0.01 * DEG),
        ("int32", "[deg / 1e-7]", "latitude", 1e-7), ("int32", "degrees * 1E7", "latitude", 1e-7),
        ("int16", "in 1/512 m/s^2", "acceleration_lateral", 1 / 512), ("float32", "in 0.1 deg steps", "steer", DEG),
        ("float32", "meters/sec^2", "longaccel", 1.0), ("float32", "(g)", "lat_acc", G),
        ("float32", "m/s or km/h", "speed", None), ("float32", "angle of the wheels, e.g. a g", "lat_acc", None),
    ],
)  # fmt: skip
@pytest.mark.parametrize("text", ["{k} {n} # {c}\n", "# {c}\n{k} {n}\n{k} x\n", "S s\n===\nMSG: p/S\n{k} {n} #{c}\n"])
def test_units_in_comments_of_a_definition(kind, comment, name, scale, text):
    units = stated_units(text.format(k=kind, n=name, c=comment))
    meaning = meaning_of("log", "", name, units["S" if "S" in units else ""][name][1])
    assert meaning.scale == (None if scale is None else pytest.approx(scale))


def test_a_comment_above_describes_the_fields_up_to_a_blank_line_and_no_field_with_a_comment_of_its_own():
    units = stated_units("# km/h\nfloat32 a\nfloat32 b # Nm\nfloat32 c\n\nfloat32 d\n#\nfloat32 e\n")[""]
    assert {name: unit for name, (_, unit) in units.items()} == {"a": "km/h", "b": "", "c": "km/h", "d": "", "e": ""}


def test_a_v_without_a_unit_is_a_speed_if_the_acceleration_follows_it():
    fields = {"v": V, "ax": AX, "ay": AY, "yaw_rate": RATE}
    assert taken(found(state=topic(**fields)))["speed_m_s"] == ("/state.v", 1.0)
    assert "speed_m_s" not in taken(found(state=topic(**(fields | {"v": np.sin(np.arange(len(V)))}))))


def test_the_axis_of_a_lateral_velocity_is_that_of_the_acceleration_beside_it():
    fields = {"VelForward": V, "VelLateral": -0.2 * RATE, "AccelLateral": -AY, "AngRateDown": -RATE}
    fields["AccelDown"] = np.full(len(V), -G)
    steering = topic(road_wheel_angle_rad=2.7 * RATE / np.maximum(V, 1.0))
    auto = surveyed(ins=topic(**fields), steering=steering, wheel__speed=topic(speed_mps=V))
    assert auto.mapping.signals["ay_m_s2"].scale == -1.0
    assert auto.mapping.truth["vy_m_s"].scale == -1.0


def test_columns_without_names_by_the_drive():
    auto = found(box=topic(ch1=3.6 * V, ch2=AX, ch3=AY, ch4=RATE, ch5=12.0 + 0.0 * S))
    assert {n: s[0] for n, s in taken(auto).items()} == {
        "speed_m_s": "/box.ch1", "ax_m_s2": "/box.ch2", "ay_m_s2": "/box.ch3", "yaw_rate_rad_s": "/box.ch4",
    }  # fmt: skip
    assert {c.subject for c in auto.mapping.checks} >= {"speed_m_s", "yaw_rate_rad_s"}


def test_numbers_that_mean_not_available_change_no_unit():
    speed, steering = 3.6 * V, STEER * 16.0 / DEG
    speed[100:180], steering[900:980] = 655.35, -9999.0
    box = topic(speed_kmh=speed, steering_wheel_angle_deg=steering, yaw_rate=RATE, lat_acc=AY)
    got = found(box=box).mapping.signals
    assert (got["speed_m_s"].scale, got["steering_wheel_rad"].scale) == pytest.approx((1.0 / 3.6, DEG))
    assert (got["speed_m_s"].valid_max, got["steering_wheel_rad"].valid_min) == (110.0, -32.0)


def test_a_unit_that_the_values_exclude_is_replaced_with_a_doubt():
    auto = found(box=topic(speed_mps=V, lat_acc_mps2=AY, yaw_rate_radps=RATE / DEG))
    assert taken(auto)["yaw_rate_rad_s"][1] == pytest.approx(DEG, rel=1e-3)
    assert "yaw_rate_rad_s.candidate" in undecided(auto)


def test_ground_truth_without_units_beside_a_speed_in_km_h():
    box = topic(speed_kmh=3.6 * V, yaw_rate=RATE, lat_acc=AY, truth_vx=V, truth_vy=-0.2 * RATE)
    truth = found(box=box).mapping.truth
    assert (truth["vx_m_s"].scale, truth["vy_m_s"].scale) == (1.0, 1.0)


@pytest.mark.parametrize(("yaw", "is_rate"), [(RATE, True), (RATE / DEG, True), (np.cumsum(RATE) * 0.01, False)])
def test_a_yaw_that_turns_the_car_is_its_rate(yaw, is_rate):
    rates = taken(found(box=topic(speed_mps=V, lat_acc=AY, yaw=yaw)))
    assert ("yaw_rate_rad_s" in rates) == is_rate


def test_axes_by_gravity_and_of_a_level_device_by_the_speed():
    down = {"acc_x": AX, "acc_y": -AY, "acc_z": -G + 0.0 * S, "gyro_z": -RATE}
    turned = taken(found(box=topic(**down)))
    assert (turned["ay_m_s2"], turned["yaw_rate_rad_s"]) == (("/box.acc_y", -1.0), ("/box.gyro_z", -1.0))
    level = topic(acc_x=-AY, acc_y=AX, acc_z=G + 0.0 * S, speed_kmh=3.6 * V)
    turned = taken(found(box=level))
    assert (turned["ax_m_s2"], turned["ay_m_s2"]) == (("/box.acc_y", 1.0), ("/box.acc_x", -1.0))


def test_an_acceleration_alone_is_not_proposed():
    """It may be the derivative of the speed."""
    assert set(taken(found(state=topic(vEgo=V, aEgo=AX, yawRate=RATE)))) == {"speed_m_s", "yaw_rate_rad_s"}
