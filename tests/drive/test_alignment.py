"""Alignment: no value crosses a gap, each measurement counts once, late measurements do not delay a step."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.drive.alignment import AlignmentPlan, align, combine_wheel_speeds, plan_alignment
from pdhef_logtool.records.errors import MappingError
from pdhef_logtool.records.signals import SIGNAL_UNITS, Channel, Signals

T0 = 1_700_000_000_000_000_000
MS = 1_000_000


def channel(name, stamps_ns, values, delay_ns=2 * MS, topic="/a"):
    stamps_ns = np.asarray(stamps_ns, dtype=np.int64)
    arrival_ns = stamps_ns + np.asarray(delay_ns, dtype=np.int64)
    return Channel(name, SIGNAL_UNITS[name], f"{topic}.{name}", stamps_ns, arrival_ns, np.asarray(values, np.float64))


def regular(start_s, end_s, rate_hz):
    return T0 + np.round(np.arange(start_s * rate_hz, end_s * rate_hz) / rate_hz * 1e9).astype(np.int64)


def seconds(stamps_ns):
    return (np.asarray(stamps_ns) - T0) * 1e-9


def plan_of(channels, wheel_radius_m=0.3) -> AlignmentPlan:
    changed = {"steering_ratio": 16.0, "wheel_radius_m": wheel_radius_m}
    return plan_alignment(channels, default_vehicle().model_copy(update=changed))


def whole(channels, plan) -> Signals:
    return align(channels, plan)[0]


def imu(end_s=10.0):
    stamps = regular(0, end_s, 100)
    return {
        "yaw_rate_rad_s": channel("yaw_rate_rad_s", stamps, np.sin(seconds(stamps))),
        "ay_m_s2": channel("ay_m_s2", stamps, np.cos(seconds(stamps))),
        "ax_m_s2": channel("ax_m_s2", stamps, seconds(stamps)),
    }


# ---- the grid ----


def test_grid_is_the_imu_stamps_with_irregular_steps_kept():
    stamps = np.sort(np.unique(T0 + np.random.default_rng(1).integers(0, 5_000 * MS, 400)))
    channels = {"yaw_rate_rad_s": channel("yaw_rate_rad_s", stamps, np.arange(stamps.size))}
    signals = whole(channels, plan_of(channels))
    np.testing.assert_array_equal(signals.stamps_ns, stamps)
    np.testing.assert_array_equal(signals.yaw_rate_rad_s, np.arange(stamps.size))
    np.testing.assert_array_equal(signals.ready_ns, stamps + 2 * MS)


def test_grid_order_and_a_slow_gyro_does_not_set_the_clock():
    channels = imu()
    assert plan_of(channels).grid_channel == "yaw_rate_rad_s"
    slow = regular(0, 10, 5)
    channels["yaw_rate_rad_s"] = channel("yaw_rate_rad_s", slow, np.zeros(slow.size), topic="/gnss")
    plan = plan_of(channels)
    assert plan.grid_channel == "ay_m_s2"
    assert plan.grid_channels == ("ax_m_s2", "ay_m_s2")
    signals = whole(channels, plan)
    assert np.isfinite(signals.yaw_rate_rad_s).sum() == slow.size  # a measurement counts once


def test_stamps_in_a_wrong_unit_are_refused_in_one_line():
    """Nanoseconds that were milliseconds make a grid of a hundred thousand million rows a second."""
    stamps = np.arange(500) * 10
    channels = {name: channel(name, stamps, np.ones(500)) for name in ("ay_m_s2", "speed_m_s")}
    with pytest.raises(MappingError, match=r"1e\+08 samples a second"):
        plan_of(channels)


@pytest.mark.parametrize("channels", [{}, {"speed_m_s": channel("speed_m_s", regular(0, 1, 10), np.zeros(10))}])
def test_without_an_imu_the_error_says_what_to_map(channels):
    with pytest.raises(MappingError, match="map an IMU topic"):
        plan_of(channels)


# ---- inputs ----


def test_comparable_inputs_are_interpolated_and_slow_ones_held():
    channels = imu()
    fast = regular(0, 10, 83)
    slow = regular(0, 10, 2)
    channels["steering_wheel_rad"] = channel("steering_wheel_rad", fast, 16.0 * seconds(fast), topic="/can")
    channels["friction"] = channel("friction", slow, np.arange(slow.size), topic="/mu")
    plan = plan_of(channels)
    method = {c.name: c.method for c in plan.channels}
    assert method["steering_wheel_rad"] == "interpolate"
    assert method["friction"] == "hold"
    signals = whole(channels, plan)
    t = seconds(signals.stamps_ns)
    inside = t <= seconds(fast[-1])
    np.testing.assert_allclose(signals.steer_rad[inside], t[inside], atol=1e-6)
    assert np.isnan(signals.steer_rad[~inside]).all()
    np.testing.assert_array_equal(signals.friction, np.floor(t * 2 + 1e-9))


@settings(derandomize=True, max_examples=60, deadline=None)
@given(gap_s=st.floats(0.15, 3.0), rate=st.sampled_from([83.0, 30.0, 7.0]), at=st.floats(2.0, 5.0))
def test_no_value_crosses_a_gap(gap_s, rate, at):
    channels = imu()
    before, after = regular(0, at, rate), regular(at + gap_s + 5.0 / rate, 10, rate)
    stamps = np.concatenate([before, after])
    values = np.where(stamps < T0 + at * 1e9, 1.0, 2.0)
    channels["steer_rad"] = channel("steer_rad", stamps, values, topic="/can")
    channels["speed_m_s"] = channel("speed_m_s", stamps, values, topic="/can")
    plan = plan_of(channels)
    signals = whole(channels, plan)
    assert set(np.unique(signals.steer_rad[np.isfinite(signals.steer_rad)])) <= {1.0, 2.0}
    assert set(np.unique(signals.speed_m_s[np.isfinite(signals.speed_m_s)])) <= {1.0, 2.0}
    max_gap = {c.name: c.max_gap_s for c in plan.channels}["steer_rad"]
    deep = (signals.stamps_ns > before[-1] + (max_gap + 0.01) * 1e9) & (signals.stamps_ns < after[0])
    assert deep.any()
    assert np.isnan(signals.steer_rad[deep]).all()
    assert np.isnan(signals.speed_m_s[deep]).all()


def test_a_mapped_channel_without_a_sample_in_the_survey_still_comes_in_later():
    channels = imu(end_s=20)
    empty = {**channels, "speed_m_s": channel("speed_m_s", [], [], topic="/can")}
    plan = plan_of(empty)
    stamps = regular(15, 20, 10)
    signals = whole({**channels, "speed_m_s": channel("speed_m_s", stamps, stamps * 0 + 5.0, topic="/can")}, plan)
    assert np.isfinite(signals.speed_m_s).sum() == stamps.size
    assert "speed_m_s" in signals.available


# ---- measurements count once ----


def test_a_slow_measurement_stands_once_at_the_first_stamp_at_or_after():
    channels = imu()
    stamps = regular(0, 10, 10) + 4 * MS
    channels["speed_m_s"] = channel("speed_m_s", stamps, np.arange(stamps.size), topic="/can")
    signals = whole(channels, plan_of(channels))
    at = np.flatnonzero(np.isfinite(signals.speed_m_s))
    np.testing.assert_array_equal(signals.stamps_ns[at], stamps + 6 * MS)
    np.testing.assert_array_equal(signals.speed_m_s[at], np.arange(stamps.size))


# ---- wheels ----


def test_wheel_speeds_in_rad_s_become_columns_and_a_speed():
    channels = imu()
    stamps = channels["ay_m_s2"].stamps_ns
    for i, w in enumerate(("fl", "fr", "rl", "rr")):
        name = f"wheel_speed_{w}_rad_s"
        channels[name] = channel(name, stamps, np.full(stamps.size, 10.0 + i), topic="/wheels")
    plan = plan_of(channels, wheel_radius_m=0.5)
    assert plan.speed_from == "wheel speeds"
    signals = whole(channels, plan)
    np.testing.assert_allclose(signals.wheel_speed_m_s, np.tile([5.0, 5.5, 6.0, 6.5], (stamps.size, 1)))
    np.testing.assert_allclose(signals.speed_m_s, 5.75)
    assert {"speed_m_s", "wheel_speed_fl_m_s"} <= signals.available


def test_a_mapped_speed_beats_the_wheels_and_road_wheel_angle_beats_the_steering_wheel():
    channels = imu()
    stamps = channels["ay_m_s2"].stamps_ns
    wheels = {"wheel_speed_rl_m_s": 30.0, "wheel_speed_rr_m_s": 30.0}
    for name, value in {**wheels, "speed_m_s": 20.0, "steer_rad": 0.1, "steering_wheel_rad": 9.0}.items():
        channels[name] = channel(name, stamps, np.full(stamps.size, value), topic="/can")
    plan = plan_of(channels)
    signals = whole(channels, plan)
    assert np.all(signals.speed_m_s == 20.0)
    assert np.all(signals.steer_rad == 0.1)
    assert plan.to_dict()["unused"] == {"steering_wheel_rad": "steer_rad is mapped too"}


def test_combined_wheel_speed_withstands_one_wrong_wheel():
    nan = np.nan
    speeds = [[10.0, 10.2, 10.0, 99.0], [10.0, 10.2, 0.0, 10.2], [9.0, 11.0, nan, 10.5], [nan, 1.0, 2.0, 4.0]]
    speeds.append([nan, 1.0, nan, 2.0])
    np.testing.assert_allclose(combine_wheel_speeds(np.array(speeds)), [10.1, 10.1, 10.0, 3.0, nan])


# ---- arrival ----


def test_late_samples_are_not_waited_for_and_are_counted():
    channels = imu()
    stamps = regular(0, 10, 100)
    delay = np.full(stamps.size, 6 * MS)
    delay[500] = 800 * MS
    channels["speed_m_s"] = channel("speed_m_s", stamps, np.ones(stamps.size), delay_ns=delay, topic="/can")
    signals, late = align(channels, plan_of(channels))
    assert np.flatnonzero(np.isnan(signals.speed_m_s)).tolist() == [500]
    assert (signals.ready_ns - signals.stamps_ns).max() == 6 * MS
    assert late == {"speed_m_s": 1}


@pytest.mark.slow
@settings(derandomize=True, max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_lateness_matches_a_plain_loop(seed):
    rng = np.random.default_rng(seed)
    channels = imu(end_s=8)
    stamps = np.unique(T0 + rng.integers(0, 8_000 * MS, 300))
    delay = rng.integers(0, 20 * MS, stamps.size) + rng.choice([0, 300 * MS], stamps.size, p=[0.9, 0.1])
    channels["speed_m_s"] = channel("speed_m_s", stamps, np.ones(stamps.size), delay_ns=delay, topic="/can")
    plan = plan_of(channels)
    limit = {c.name: c.late_limit_s for c in plan.channels}["speed_m_s"]
    seconds, expected = ((stamps - stamps[0]) // 10**9).tolist(), 0
    for s, d in zip(seconds, delay.tolist(), strict=True):
        near = [e for r, e in zip(seconds, delay.tolist(), strict=True) if abs(r - s) <= 1]
        expected += d - min(near) > round(limit * 1e9)
    assert align(channels, plan)[1].get("speed_m_s", 0) == expected


# ---- irregular channels ----


def ragged(rng, name, topic, rate, share_late):
    n = int(40 * rate)
    stamps = T0 + np.cumsum(rng.gamma(2.0, 0.5 / rate * 1e9, n)).astype(np.int64)
    stamps = np.unique(stamps)
    for _ in range(2):  # two dropouts
        at = T0 + rng.integers(0, 40_000 * MS)
        stamps = stamps[(stamps < at) | (stamps > at + rng.integers(50 * MS, 8_000 * MS))]
    delay = rng.integers(0, 30 * MS, stamps.size) + rng.choice(
        [0, 400 * MS, 5_000 * MS], stamps.size, p=[1 - share_late, share_late / 2, share_late / 2]
    )
    return channel(name, stamps, rng.normal(size=stamps.size), delay_ns=delay, topic=topic)


@settings(derandomize=True, max_examples=15, deadline=None)
@given(shift=st.integers(-(10**15), 10**15))
def test_a_shift_of_the_clock_shifts_stamps_only(shift):
    rng = np.random.default_rng(5)
    rates = {"yaw_rate_rad_s": ("/imu", 100), "speed_m_s": ("/gnss", 9), "steer_rad": ("/can", 83)}
    channels = {name: ragged(rng, name, *of, 0.05) for name, of in rates.items()}
    moved = {
        n: channel(n, c.stamps_ns + shift, c.values, c.arrival_ns - c.stamps_ns, c.source.split(".")[0])
        for n, c in channels.items()
    }
    plan, plan_moved = plan_of(channels), plan_of(moved)
    assert plan == plan_moved
    a, b = whole(channels, plan), whole(moved, plan)
    np.testing.assert_array_equal(a.stamps_ns + shift, b.stamps_ns)
    np.testing.assert_array_equal(a.ready_ns + shift, b.ready_ns)
    for name in rates:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_a_receiver_with_positions_alone_gives_a_velocity_halfway_between_them():
    fixes = regular(0.0, 10.0, 5)
    north_m, east_m = 3.0 * seconds(fixes), 2.0 * seconds(fixes) ** 2
    degree_m = np.radians(1.0) * 6_378_137.0
    channels = {
        **imu(),
        "gnss_latitude_deg": channel("gnss_latitude_deg", fixes, 60.0 + north_m / degree_m, 80 * MS),
        "gnss_longitude_deg": channel("gnss_longitude_deg", fixes, 18.0 + 2.0 * east_m / degree_m, 80 * MS),
        "gnss_position_accuracy_m": channel("gnss_position_accuracy_m", fixes, np.full(fixes.size, 0.02), 80 * MS),
    }
    plan = plan_of(channels)
    assert {"gnss_velocity_east_m_s", "gnss_velocity_north_m_s"} <= plan.available
    signals = whole(channels, plan)
    seen = np.isfinite(signals.gnss_velocity_m_s[:, 0])
    assert seen.sum() == fixes.size - 1
    t = seconds(signals.stamps_ns[seen])
    east, north = signals.gnss_velocity_m_s[seen].T
    np.testing.assert_allclose(north, 3.0, atol=1e-3)
    np.testing.assert_allclose(east, 4.0 * t, atol=0.06)
    np.testing.assert_allclose(signals.gnss_velocity_std_m_s[seen], np.sqrt(2.0) * 0.02 * 5.0, rtol=1e-6)
    np.testing.assert_allclose(signals.gnss_late_s[seen], 0.18, atol=0.011)  # half a step, and the delay


def test_a_late_velocity_is_at_its_stamp_with_its_delay_and_is_not_waited_for():
    fixes = regular(0.0, 10.0, 10)
    velocity = {
        name: channel(name, fixes, np.full(fixes.size, 7.0), 150 * MS)
        for name in ("gnss_velocity_east_m_s", "gnss_velocity_north_m_s")
    }
    channels = {**imu(), "speed_m_s": channel("speed_m_s", fixes, np.full(fixes.size, 9.0)), **velocity}
    signals = whole(channels, plan_of(channels))
    seen = np.isfinite(signals.gnss_velocity_m_s[:, 0])
    np.testing.assert_allclose(signals.gnss_late_s[seen], 0.15, atol=0.011)
    assert np.isnan(signals.gnss_late_s[~seen]).all()
    assert (signals.ready_ns - signals.stamps_ns).max() < 20 * MS
