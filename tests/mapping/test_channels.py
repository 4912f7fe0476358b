"""Reading mapped fields: values, times, cleaning with counts, and the truth gate."""

from dataclasses import replace

import numpy as np
import pytest
from fake_drive_log import FakeLog, FakeTopic
from hypothesis import given, settings
from hypothesis import strategies as st

from pdhef_logtool.logs.drive_log import Columns
from pdhef_logtool.mapping import Mapping, QualityGate, SignalSource, fit_clocks, read_signals
from pdhef_logtool.mapping.channels import clean_samples, gate_mask, si_values
from pdhef_logtool.records.signals import Channel, Loss

T0 = 1_700_000_000_000_000_000
MS = 1_000_000


def imu_log(n: int = 200, seed: int = 1, **changes: np.ndarray) -> FakeLog:
    rng = np.random.default_rng(seed)
    stamps = T0 + np.arange(n, dtype=np.int64) * 10 * MS
    fields = {
        "header.stamp": stamps,
        "linear_acceleration.y": rng.normal(size=n),
        "angular_velocity.z": rng.normal(size=n),
    }
    fields |= changes
    log_time = stamps + 2 * MS
    return FakeLog({"/imu": FakeTopic("sensor_msgs/msg/Imu", log_time, fields)})


def imu_mapping(**changes: object) -> Mapping:
    ay = SignalSource("ay_m_s2", "/imu", "linear_acceleration.y")
    yaw = SignalSource("yaw_rate_rad_s", "/imu", "angular_velocity.z")
    return Mapping(signals={s.name: replace(s, **changes) for s in (ay, yaw)})


def read_all(log: FakeLog, mapping: Mapping) -> tuple[dict[str, Channel], dict[str, Channel], dict[str, Loss]]:
    clocks = fit_clocks(log, mapping, log.start_ns, log.end_ns)
    got = read_signals(log, mapping, clocks, log.start_ns, log.end_ns)
    return got.signals, got.truth, {f"{x.kind} {x.where.split(' ')[0]}": x for x in got.losses}


def test_scale_offset_latency_and_arrival():
    log = imu_log()
    signals, _, losses = read_all(log, imu_mapping(scale=-9.81, offset=0.5, latency_s=0.0031))
    topic = log.contents["/imu"]
    np.testing.assert_allclose(signals["ay_m_s2"].values, 0.5 - 9.81 * topic.fields["linear_acceleration.y"])
    np.testing.assert_array_equal(signals["ay_m_s2"].stamps_ns, topic.fields["header.stamp"] - 3_100_000)
    np.testing.assert_array_equal(signals["ay_m_s2"].arrival_ns, topic.log_time_ns)
    assert signals["ay_m_s2"].unit == "m/s^2"
    assert signals["ay_m_s2"].source == "/imu.linear_acceleration.y"
    assert not losses


@pytest.mark.parametrize(("unit", "factor"), [("s", 1e-9), ("ms", 1e-6), ("us", 1e-3)])
def test_numbers_as_stamps(unit, factor):
    log = imu_log()
    topic = log.contents["/imu"]
    topic.fields["t"] = topic.fields.pop("header.stamp") * factor
    signals, _, _ = read_all(log, imu_mapping(stamp="t", stamp_unit=unit))
    # float64 seconds since 1970 resolve 0.24 µs.
    np.testing.assert_allclose(signals["ay_m_s2"].stamps_ns - (topic.log_time_ns - 2 * MS), 0, atol=500)


@pytest.mark.parametrize("names", [("sec", "nanosec"), ("seconds", "nanos")])
def test_a_stamp_in_two_numbers_is_exact(names):
    log = imu_log()
    topic = log.contents["/imu"]
    stamps = topic.fields.pop("header.stamp")
    topic.fields[f"header.stamp.{names[0]}"] = (stamps // 1_000_000_000).astype(np.float64)
    topic.fields[f"header.stamp.{names[1]}"] = (stamps % 1_000_000_000).astype(np.float64)
    signals, _, _ = read_all(log, imu_mapping())
    np.testing.assert_array_equal(signals["ay_m_s2"].stamps_ns, stamps)


def test_what_is_dropped_is_counted_and_named():
    log = imu_log()
    topic = log.contents["/imu"]
    ay, yaw, stamps = (topic.fields[p] for p in ("linear_acceleration.y", "angular_velocity.z", "header.stamp"))
    ay[[3, 7]] = np.nan
    ay[[20, 21, 22]] = 100.0
    yaw[9] = np.inf
    stamps[50] = stamps[49]
    stamps[60] = 0
    stamps[[70, 71]] = stamps[[71, 70]]
    mapping = imu_mapping(valid_min=-50.0, valid_max=50.0)
    signals, _, losses = read_all(log, mapping)
    assert {k: (x.count, x.severity) for k, x in losses.items()} == {
        "nan ay_m_s2": (2, "lost"), "out-of-range ay_m_s2": (3, "note"), "nan yaw_rate_rad_s": (1, "lost"),
        "duplicate-stamp /imu": (1, "note"), "bad-stamp /imu": (1, "lost"), "out-of-order /imu": (1, "note"),
    }  # fmt: skip
    assert losses["nan ay_m_s2"].start_ns == topic.log_time_ns[3]
    assert losses["nan ay_m_s2"].end_ns == topic.log_time_ns[7] + 1
    assert len(signals["ay_m_s2"]) == 200 - 2 - 3 - 1 - 1
    assert len(signals["yaw_rate_rad_s"]) == 200 - 1 - 1 - 1
    for channel in signals.values():
        assert np.all(np.diff(channel.stamps_ns) > 0)
        assert np.isfinite(channel.values).all()
    # Of two messages with one stamp the first to arrive stays.
    at = np.searchsorted(signals["ay_m_s2"].stamps_ns, stamps[49])
    assert signals["ay_m_s2"].values[at] == ay[49]


@pytest.mark.parametrize("shift_s", [-3.0, 5.0])
def test_a_delay_that_cannot_be_is_unknown(shift_s):
    log = imu_log()
    log.contents["/imu"].log_time_ns += np.int64(shift_s * 1e9)
    signals, _, losses = read_all(log, imu_mapping())
    np.testing.assert_array_equal(signals["ay_m_s2"].arrival_ns, signals["ay_m_s2"].stamps_ns)
    assert losses["delay-unknown /imu"].severity == "note"


def test_vectors_take_a_scale_per_axis_and_lists_of_fields():
    stamps = T0 + np.arange(20, dtype=np.int64) * 50 * MS
    xyz = np.random.default_rng(3).normal(size=(20, 3))
    fields = {"v": xyz, "w": np.full(20, 0.5)} | {f"q.{a}": xyz[:, i] for i, a in enumerate("xyz")}
    velocity = SignalSource("ecef_velocity_m_s", "/gnss", "v", scale=(1.0, -1.0, 2.0))
    attitude = SignalSource("quat_wxyz", "/gnss", ("w", "q.x", "q.y", "q.z"))
    log = FakeLog({"/gnss": FakeTopic("gnss/Pose", stamps, fields)})
    _, truth, _ = read_all(log, Mapping(truth={s.name: s for s in (velocity, attitude)}))
    np.testing.assert_allclose(truth["ecef_velocity_m_s"].values, xyz * [1.0, -1.0, 2.0])
    np.testing.assert_allclose(truth["quat_wxyz"].values, np.column_stack([np.full(20, 0.5), xyz]))


def test_an_empty_window_gives_empty_channels():
    log = imu_log()
    mapping = imu_mapping()
    clocks = fit_clocks(log, mapping, log.start_ns, log.end_ns)
    got = read_signals(log, mapping, clocks, log.end_ns + 10, log.end_ns + 20)
    assert [len(c) for c in got.signals.values()] == [0, 0]
    assert got.losses == ()


# --------------------------------------------------------------------------------------------- properties


@st.composite
def messy_samples(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    n = draw(st.integers(0, 30))
    seed = draw(st.integers(0, 2**31))
    rng = np.random.default_rng(seed)
    stamps = rng.integers(1, 12, n)  # Few values, so that stamps collide.
    arrival = stamps + rng.integers(0, 3, n)
    values = rng.choice([np.nan, -3e13, -2.0, 0.0, 1.0, 2.0, 9.0], n)
    return stamps.astype(np.int64), arrival.astype(np.int64), values


@settings(max_examples=80, deadline=None, derandomize=True)
@given(samples=messy_samples())
def test_cleaning_agrees_with_a_dictionary(samples):
    stamps, arrival, values = samples
    best: dict[int, tuple[int, float]] = {}
    for s, a, v in zip(stamps.tolist(), arrival.tolist(), values.tolist(), strict=True):
        if abs(v) < 1e12 and v <= 5.0 and (s not in best or (a, v) < best[s]):
            best[s] = (a, v)
    got = clean_samples(stamps, arrival, values, valid_max=5.0)
    assert got.stamps_ns.tolist() == sorted(best)
    assert got.values.tolist() == [best[s][1] for s in sorted(best)]
    assert len(got.nan_at) == int((~(np.abs(values) < 1e12)).sum())
    assert len(got.out_of_range_at) == int((values > 5.0).sum())


# --------------------------------------------------------------------------------------------- truth gate


@settings(max_examples=100, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10_000))
def test_gate_agrees_with_a_search_by_hand(seed):
    rng = np.random.default_rng(seed)
    stamps = np.sort(rng.integers(0, 100, 30))
    gate_stamps = np.sort(rng.integers(0, 100, rng.integers(0, 12)))
    values = rng.choice([np.nan, 1.0, 2.0, 3.0, 4.0], gate_stamps.shape[0])
    gate = QualityGate("/g", "f", min=2.5, max=3.5, values=(1.0,))
    got = gate_mask(stamps, gate_stamps, values, gate, hold_ns=15)
    for stamp, keep in zip(stamps, got, strict=True):
        before = [i for i, g in enumerate(gate_stamps) if g <= stamp]
        expected = bool(before) and values[before[-1]] in (1.0, 3.0) and stamp - gate_stamps[before[-1]] <= 15
        assert keep == expected


@pytest.mark.parametrize(
    ("sent", "modes", "kept"),
    [
        (slice(None), np.where(np.arange(100) // 20 == 2, 1.0, 4.0), np.arange(100) // 20 != 2),
        (slice(0, 41, 5), np.full(9, 4.0), np.arange(100) < 51),  # every 50 ms until 0.4 s
    ],
    ids=["rejected", "silent for more than two periods"],
)
def test_truth_that_the_gate_rejects_is_counted(sent, modes, kept):
    log = imu_log(100)
    stamps = log.contents["/imu"].fields["header.stamp"]
    log.contents["/status"] = FakeTopic("x/S", stamps[sent] + MS, {"stamp": stamps[sent], "mode": modes})
    base = imu_mapping()
    vx = replace(base.signals["ay_m_s2"], name="vx_m_s")
    mapping = replace(base, truth={"vx_m_s": vx}, quality=QualityGate("/status", "mode", values=(4.0,)))
    signals, truth, losses = read_all(log, mapping)
    assert len(signals["ay_m_s2"]) == 100
    np.testing.assert_array_equal(truth["vx_m_s"].stamps_ns, stamps[kept])
    loss = losses["truth-quality vx_m_s"]
    assert (loss.count, loss.severity) == (np.count_nonzero(~kept), "note")


N = 4


def columns(**fields: np.ndarray) -> Columns:
    times = np.arange(N, dtype=np.int64)
    return Columns("/a", times, times, fields)


@pytest.mark.parametrize(
    ("name", "raw", "shape"),
    [
        ("enu_velocity_m_s", np.ones((N, 2)), (N, 3)),
        ("quat_wxyz", np.ones((N, 3)), (N, 4)),
        ("enu_velocity_m_s", np.ones(N), (N, 3)),
        ("speed_m_s", np.ones((N, 3)), (N,)),
    ],
)
def test_what_is_not_the_signal_s_shape_is_missing_at_every_sample(name, raw, shape):
    values = si_values(columns(v=raw), SignalSource(name, "/a", "v"))
    assert values.shape == shape
    assert np.isnan(values).all()
