"""Sensor errors have the size, shape, delay and independence that docs/method.md#sensors gives them."""

import numpy as np
import pytest
from scipy import stats

from truthsim.manoeuvres import MANOEUVRES, Plan, Request
from truthsim.motion import Motion, simulate_motion
from truthsim.sensors import IMU_PERIOD_S, STEER_PHASE_S, WHEEL_PHASE_S, SensorNoise, sense
from truthsim.vehicle import Vehicle

G = 9.80665
PHASES = (0.0, STEER_PHASE_S, WHEEL_PHASE_S)
#: Sensors with no errors except delay, tilt, wheel slip and quantisation.
NO_NOISE = SensorNoise(
    acceleration_m_s2=0.0, yaw_rate_rad_s=0.0, steer_rad=0.0, wheel_speed_m_s=0.0, wheel_scale=0.0,
    acceleration_bias_m_s2=0.0, yaw_rate_bias_rad_s=0.0, steer_bias_rad=0.0,
    acceleration_walk_m_s2=0.0, yaw_rate_walk_rad_s=0.0,
    rtk_position_m=0.0, rtk_velocity_m_s=0.0, rtk_heading_rad=0.0, rtk_yaw_rate_rad_s=0.0, rtk_tilt_rad=0.0,
)  # fmt: skip
WHITE_ONLY = NO_NOISE._replace(
    acceleration_m_s2=0.12, yaw_rate_rad_s=0.004, steer_rad=0.0008, wheel_speed_m_s=0.08, rtk_yaw_rate_rad_s=0.001
)


def record(plan: Plan, friction: float = 0.85) -> Motion:
    return simulate_motion(plan, friction, period_s=IMU_PERIOD_S, phases_s=PHASES)


@pytest.fixture(scope="module")
def lane_change():
    return record(MANOEUVRES["dlc"].plan(Request(100.0 / 3.6, 0.85, 1, 9.5, 0.76)))


@pytest.fixture(scope="module")
def straight():
    return record(Plan(20.0, 200.0, steer_rad=np.zeros(200_001)))


@pytest.mark.slow
def test_white_noise_of_each_channel_has_the_stated_sigma(straight):
    clean, noisy = (sense(straight, Vehicle(), n, 5, 100) for n in (NO_NOISE, WHITE_ONLY))
    for channel, field, sigma in (
        ("imu", "ax_m_s2", 0.12),
        ("imu", "ay_m_s2", 0.12),
        ("imu", "yaw_rate_rad_s", 0.004),
        ("steering", "steer_rad", 0.0008),
        ("wheels", "fl_m_s", 0.08),
        ("wheels", "rr_m_s", 0.08),
        ("rtk", "yaw_rate_rad_s", 0.001),
    ):
        error = noisy[channel].fields[field] - clean[channel].fields[field]
        assert error.std() == pytest.approx(sigma, rel=0.05), field
        assert abs(error.mean()) < 4.0 * sigma / np.sqrt(error.shape[0]), field
        if channel != "rtk":
            assert stats.kurtosis(error) > 2.0, field
        assert abs(np.corrcoef(error[1:], error[:-1])[0, 1]) < 0.03, field
    errors = [noisy["imu"].fields[k] - clean["imu"].fields[k] for k in ("ax_m_s2", "ay_m_s2", "yaw_rate_rad_s")]
    assert np.abs(np.corrcoef(errors) - np.eye(3)).max() < 0.03


def test_messages_arrive_late_by_the_bus_and_keep_their_order(lane_change):
    channels = sense(lane_change, Vehicle(), SensorNoise(), 1, 100)
    for name in ("imu", "steering", "wheels"):
        delay = channels[name].arrival_ns(0) - channels[name].stamps_ns(0)
        assert np.all(delay == 10_000_000), name
    assert np.all(channels["rtk"].arrival_ns(0) - channels["rtk"].stamps_ns(0) == 20_000_000)
    late = sense(lane_change, Vehicle(), SensorNoise(jitter_s=0.015), 1, 100)["imu"]
    delay_s = (late.arrival_ns(0) - late.stamps_ns(0)) * 1e-9
    assert delay_s.min() >= 0.010 and 0.020 < delay_s.max() <= 0.025
    assert np.all(np.diff(late.arrival_ns(0)) >= 0)


def test_imu_reads_gravity_by_the_body_s_tilt(lane_change):
    imu = sense(lane_change, Vehicle(), NO_NOISE, 1, 100)["imu"].fields
    a_y, roll = lane_change.column("ay_m_s2"), lane_change.column("roll_rad")
    assert imu["ay_m_s2"] - a_y == pytest.approx(G * np.sin(roll) - a_y * (1.0 - np.cos(roll)), abs=0.015)
    # Leaning outward, it reads more than the car does, by g times the roll gradient: about 9 %.
    assert np.polyfit(a_y, imu["ay_m_s2"], 1)[0] == pytest.approx(1.0 + G * 0.0088, abs=0.006)
    a_x, pitch = lane_change.column("ax_m_s2"), lane_change.column("pitch_rad")
    assert imu["ax_m_s2"] == pytest.approx(a_x * np.cos(pitch) - G * np.sin(pitch), abs=0.015)
    assert imu["az_m_s2"].mean() == pytest.approx(np.mean(G * np.cos(roll) - a_y * np.sin(roll)), abs=0.02)


def test_sensors_sample_at_their_own_times(lane_change):
    channels = sense(lane_change, Vehicle(), NO_NOISE, 1, 100)
    steering = channels["steering"]
    assert (steering.times_s - channels["imu"].times_s) == pytest.approx(0.003)
    fine = simulate_motion(MANOEUVRES["dlc"].plan(Request(100.0 / 3.6, 0.85, 1, 9.5, 0.76)), 0.85, period_s=0.001)
    at = np.interp(steering.times_s, fine.times_s, fine.column("steer_rad"))
    inside = steering.times_s <= fine.times_s[-1]
    # The steering wheel's angle comes in steps of 0.1 degrees, rounded to the nearest.
    step = np.deg2rad(0.1)
    assert np.abs(steering.fields["steer_rad"] - at)[inside].max() <= 0.5 * step / 16.0 + 1e-9
    assert np.abs(steering.fields["steer_rad"] - at)[inside].max() > 0.4 * step / 16.0
    counts = steering.fields["steering_wheel_rad"] / step
    assert np.abs(counts - np.round(counts)).max() < 1e-6
    assert steering.fields["steering_wheel_rad"] == pytest.approx(16.0 * steering.fields["steer_rad"])
    wheels = channels["wheels"]
    rim = 0.30 * np.interp(wheels.times_s, fine.times_s, fine.column("spin_fl_rad_s"))
    inside = wheels.times_s <= fine.times_s[-1]
    assert np.abs(wheels.fields["fl_m_s"] - rim)[inside].max() < 0.003


def test_rtk_is_good_to_centimetres_and_consistent_in_itself(lane_change):
    errors: dict[str, list[float]] = {"x_m": [], "vx_m_s": [], "vy_m_s": [], "yaw_rad": []}
    for seed in range(40):
        rtk = sense(lane_change, Vehicle(), SensorNoise(), seed, 100)["rtk"].fields
        for name, spread in errors.items():
            spread.append(float(np.sqrt(np.mean((rtk[name] - lane_change.column(name)) ** 2))))
    rms = {name: float(np.sqrt(np.mean(np.square(spread)))) for name, spread in errors.items()}
    assert rms["x_m"] == pytest.approx(0.010, rel=0.2)
    assert rms["yaw_rad"] == pytest.approx(0.0005, rel=0.2)
    assert rms["vx_m_s"] == pytest.approx(0.012, rel=0.2)
    # A heading error turns forward speed into lateral velocity.
    assert rms["vy_m_s"] == pytest.approx(np.hypot(0.012, 27.7 * 0.0005), rel=0.2)


def test_an_imu_away_from_the_cg_feels_the_turning():
    # Steady bend: a place ahead is pulled inward by r² p, one to the left away from the middle, and a place ahead
    # gains the yaw acceleration times its lever while the bend begins.
    steer = 0.03 * np.clip((np.arange(8001) * 0.001 - 1.0) / 1.0, 0.0, 1.0)
    motion = record(Plan(20.0, 8.0, steer_rad=steer))
    at_cg = sense(motion, Vehicle(), NO_NOISE, 1, 100)["imu"].fields
    moved = sense(motion, Vehicle(), NO_NOISE._replace(imu_x_m=1.5, imu_y_m=-0.4), 1, 100)["imu"].fields
    yaw_rate = motion.column("yaw_rate_rad_s")
    steady = motion.times_s > 6.0
    d_x, d_y = moved["ax_m_s2"] - at_cg["ax_m_s2"], moved["ay_m_s2"] - at_cg["ay_m_s2"]
    assert d_x[steady].mean() == pytest.approx(-1.5 * np.mean(yaw_rate[steady] ** 2), rel=0.03)
    assert d_y[steady].mean() == pytest.approx(0.4 * np.mean(yaw_rate[steady] ** 2), rel=0.05)
    onset = (motion.times_s > 1.2) & (motion.times_s < 1.8)
    slope = np.gradient(yaw_rate, motion.times_s)[onset]
    assert d_y[onset].mean() == pytest.approx(1.5 * slope.mean() + 0.4 * np.mean(yaw_rate[onset] ** 2), rel=0.05)
    for name in ("yaw_rate_rad_s", "roll_rate_rad_s"):
        assert np.array_equal(moved[name], at_cg[name])


@pytest.mark.slow
def test_the_bus_loses_its_share_of_messages(straight):
    usual = sense(straight, Vehicle(), SensorNoise(), 3, 100)
    lossy = sense(straight, Vehicle(), SensorNoise(message_loss=0.1), 3, 100)
    for name in ("imu", "steering", "wheels"):
        share = lossy[name].times_s.shape[0] / usual[name].times_s.shape[0]
        assert share == pytest.approx(0.9, abs=0.012), name
        there = np.isin(usual[name].times_s, lossy[name].times_s)
        for field, column in lossy[name].fields.items():
            assert np.array_equal(column, usual[name].fields[field][there]), field
    assert np.array_equal(lossy["rtk"].times_s, usual["rtk"].times_s)


def test_an_ins_with_an_offset_sees_sideslip_where_none_is(lane_change):
    usual = sense(lane_change, Vehicle(), NO_NOISE, 1, 100)["rtk"].fields
    turned = sense(lane_change, Vehicle(), NO_NOISE._replace(rtk_heading_offset_rad=0.004), 1, 100)["rtk"].fields
    slip = [np.arctan2(f["vy_m_s"], f["vx_m_s"]) for f in (usual, turned)]
    assert slip[1] - slip[0] == pytest.approx(np.full(len(slip[0]), -0.004), abs=1e-9)
    moved = sense(lane_change, Vehicle(), NO_NOISE._replace(rtk_x_m=0.3, rtk_y_m=-0.2), 1, 100)["rtk"].fields
    rate = usual["yaw_rate_rad_s"]
    assert moved["vy_m_s"] - usual["vy_m_s"] == pytest.approx(0.3 * rate, abs=1e-9)
    assert moved["vx_m_s"] - usual["vx_m_s"] == pytest.approx(0.2 * rate, abs=1e-9)
    place = np.hypot(moved["x_m"] - usual["x_m"], moved["y_m"] - usual["y_m"])
    assert place == pytest.approx(np.full(len(place), np.hypot(0.3, 0.2)), abs=1e-9)
