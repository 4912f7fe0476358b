"""Injected faults match their kind, signal and time interval; all other samples are unchanged."""

import json

import numpy as np
import pytest
from other_readers import read_with_other_libraries
from scipy import stats

from pdhef_logtool.records.errors import UsageError
from truthsim.drive import START_NS, Drive, simulate_drive, write_drive
from truthsim.faults import FIELDS, KINDS, TARGETS, apply_faults, parse_fault
from truthsim.sensors import SensorChannel

pytestmark = pytest.mark.slow

DURATION_S = 30.0


@pytest.fixture(scope="module")
def clean():
    return simulate_drive("banked-road", seed=4, duration_s=DURATION_S)


def with_faults(drive: Drive, *texts: str, seed: int = 4) -> dict[str, SensorChannel]:
    return apply_faults(drive.channels, [parse_fault(t) for t in texts], drive.noise, seed)


def inside(channel: SensorChannel, start_s: float, end_s: float) -> np.ndarray:
    return (channel.times_s >= start_s) & (channel.times_s < end_s)


@pytest.mark.parametrize("target", FIELDS)
@pytest.mark.parametrize("kind", ["burst20", "stuck", "dead", "flip", "bias0.5", "dropout"])
def test_a_fault_changes_its_field_in_its_interval_and_nothing_else(clean, kind, target):
    message, field = FIELDS[target]
    faulty = with_faults(clean, f"{kind}:{target}:8:14")
    for name, channel in faulty.items():
        before = clean.channels[name]
        assert np.array_equal(channel.times_s, before.times_s) and np.array_equal(channel.arrival_s, before.arrival_s)
        for key, column in channel.fields.items():
            rows = inside(channel, 8.0, 14.0)
            assert np.array_equal(column[~rows], before.fields[key][~rows], equal_nan=True)
            touched = name == message and (key == field or (target == "steer" and key == "steering_wheel_rad"))
            changed = np.mean(column[rows] != before.fields[key][rows])
            assert changed > 0.9 if touched else changed == 0.0, key
    values, usual = faulty[message].fields[field], clean.channels[message].fields[field]
    rows = inside(faulty[message], 8.0, 14.0)
    exact = {"stuck": usual[np.argmax(rows)], "dead": 0.0, "flip": -usual[rows], "dropout": np.nan}
    if kind in exact:
        np.testing.assert_array_equal(values[rows], exact[kind])
    elif kind == "bias0.5":
        assert values[rows] - usual[rows] == pytest.approx(0.5, abs=1e-3 if message == "imu" else 0.004)


@pytest.mark.parametrize("factor", [5.0, 20.0])
@pytest.mark.parametrize(
    ("target", "sigma"), [("ay", 0.12), ("yaw_rate", 0.004), ("steer", 0.0008), ("wheel_rl", 0.08)]
)
def test_a_burst_has_its_factor_times_the_usual_noise(clean, target, sigma, factor):
    message, field = FIELDS[target]
    added = []
    for seed in range(12):
        faulty = with_faults(clean, f"burst{factor:g}:{target}:5:25", seed=seed)
        rows = inside(faulty[message], 5.0, 25.0)
        added.append((faulty[message].fields[field] - clean.channels[message].fields[field])[rows])
    noise = np.concatenate(added)
    # On top of the noise that is there: both together have factor times sigma.
    assert np.sqrt(noise.std() ** 2 + sigma**2) == pytest.approx(factor * sigma, rel=0.03)
    assert abs(noise.mean()) < 4.0 * noise.std() / np.sqrt(noise.size)
    assert stats.kurtosis(noise) > 1.0  # Student-t, as the sensor's own


def test_late_and_lost_messages_and_a_clock_that_jumps(clean):
    before = clean.channels["imu"]
    rows = inside(before, 10.0, 12.0)
    late = with_faults(clean, "delay30:imu:10:12")["imu"]
    assert late.arrival_s[rows] - before.arrival_s[rows] == pytest.approx(0.030)
    assert np.all(np.diff(late.arrival_s) >= 0.0) and np.array_equal(late.times_s, before.times_s)
    # The messages right after queue behind the last late one, the others are untouched.
    assert np.array_equal(late.arrival_s[before.times_s >= 12.03], before.arrival_s[before.times_s >= 12.03])
    assert np.array_equal(late.arrival_s[before.times_s < 10.0], before.arrival_s[before.times_s < 10.0])

    gone = with_faults(clean, "dropout:imu:10:12")["imu"]
    assert np.array_equal(gone.times_s, before.times_s[~rows])
    assert np.array_equal(gone.fields["ay_m_s2"], before.fields["ay_m_s2"][~rows])

    jumped = with_faults(clean, "jump0.5:imu:10:12")["imu"]
    assert jumped.times_s[rows] - before.times_s[rows] == pytest.approx(0.5)
    assert np.array_equal(jumped.times_s[~rows], before.times_s[~rows])
    assert np.array_equal(jumped.arrival_s, before.arrival_s)

    everything = with_faults(clean, "delay30:all:0:end")
    for name in ("imu", "steering", "wheels"):
        assert everything[name].arrival_s - clean.channels[name].arrival_s == pytest.approx(0.030), name
    assert everything["rtk"] is clean.channels["rtk"]


def test_rtk_outages_open_the_gate_and_close_it(clean):
    faults = [parse_fault("float:rtk:5:8"), parse_fault("lost:rtk:10:14")]
    drive = simulate_drive("banked-road", seed=4, duration_s=DURATION_S, faults=faults)
    rtk, fix = drive.channels["rtk"], drive.channels["fix"]
    assert np.all(rtk.fields["quality"][inside(rtk, 5.0, 8.0)] == 5)
    assert np.all(rtk.fields["quality"][inside(rtk, 10.0, 14.0)] == 0)
    good = rtk.fields["quality"] == 4
    assert good.mean() == pytest.approx(1.0 - 7.0 / DURATION_S, abs=0.01)
    error = np.hypot(rtk.fields["x_m"] - drive.truth["x_m"], rtk.fields["y_m"] - drive.truth["y_m"])
    assert error[good].max() < 0.06 < 0.1 < error[inside(rtk, 5.0, 8.0)].max()
    # Coasting, the error grows and ends with the outage; the stated sigma grows with it.
    coast = error[inside(rtk, 10.0, 14.0)]
    assert coast[-20:].mean() > coast[:20].mean()
    assert rtk.fields["position_std_m"][inside(rtk, 13.9, 14.0)].min() > 0.1
    assert np.all(np.isnan(fix.fields["lat_deg"]) == (fix.fields["quality"] == 0))
    for key in ("x_m", "vy_m_s"):
        assert np.array_equal(rtk.fields[key][good], clean.channels["rtk"].fields[key][good])
    for name in ("imu", "steering", "wheels"):
        for key, column in drive.channels[name].fields.items():
            assert np.array_equal(column, clean.channels[name].fields[key])


@pytest.mark.parametrize(
    "text",
    [
        *("", "burst20", "burst:ay:1:2", "burst0.5:ay:1:2", "stuck3:ay:1:2", "stuck:speed:1:2", "explode:ay:1:2"),
        *("stuck:ay:2:1", "stuck:ay:-1:1", "stuck:ay:a:b", "delay30:ay:1:2", "delay-3:imu:1:2", "float:imu:1:2"),
        *("dead:rtk:1:2", "stuck:ay:nan:2", "stuck:ay:1:2:3", "burst2.0.0:ay:1:2"),
    ],
)
def test_what_is_no_fault_is_refused_in_one_line(text):
    with pytest.raises(UsageError, match="burst20:yaw_rate:5:8"):
        parse_fault(text)


def test_a_log_tells_its_faults_as_events_and_in_its_metadata(tmp_path):
    texts = ("burst20:yaw_rate:2:4", "dropout:wheels:3:end", "lost:rtk:1:2")
    drive = simulate_drive("step-steer", faults=[parse_fault(t) for t in texts])
    write_drive(drive, tmp_path / "faulty.mcap", steering_wheel=True)
    messages, _, metadata = read_with_other_libraries(tmp_path / "faulty.mcap")
    events = [m for *_, m in messages["/truthsim/events"]]
    told = [((e.header.stamp.sec * 10**9 + e.header.stamp.nanosec - START_NS) * 1e-9, e.active) for e in events]
    assert told == [(1.0, True), (2.0, True), (2.0, False), (3.0, True), (4.0, False), (6.0, False)]
    first = events[1]
    assert (KINDS[first.kind], TARGETS[first.target], first.value) == ("burst", "yaw_rate", 20.0)
    assert all(getattr(first, f"KIND_{k.upper()}") == i for i, k in enumerate(KINDS))
    assert all(getattr(first, f"TARGET_{t.upper()}") == i for i, t in enumerate(TARGETS))
    recorded = json.loads(metadata["faults"])
    assert [f["fault"] for f in recorded] == list(texts) and recorded[1]["end_s"] == 6.0
    assert len(messages["/vehicle/wheel_speeds"]) == 300
    statuses = np.array([m.status.status for *_, m in messages["/rtk/fix"]])
    qualities = np.array([m.quality for *_, m in messages["/rtk/quality"]])
    assert np.all(statuses[10:20] == -1) and np.all(qualities[10:20] == 0) and np.sum(qualities != 4) == 10
    odometry = [m for *_, m in messages["/rtk/odometry"]]
    assert odometry[199].pose.covariance[0] > odometry[110].pose.covariance[0] > odometry[50].pose.covariance[0]
    wheel = np.array([m.angle_rad for *_, m in messages["/vehicle/steering_wheel"]])
    road = np.array([m.steering_tire_angle for *_, m in messages["/vehicle/status/steering_status"]])
    assert wheel == pytest.approx(16.0 * road, abs=1e-5)
