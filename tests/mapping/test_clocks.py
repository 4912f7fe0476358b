"""Device clocks against log time, and unusable header stamps: log time replaces them and a note reports it."""

from dataclasses import replace

import numpy as np
import pytest
from fake_drive_log import FakeLog, FakeTopic
from hypothesis import given, settings, strategies as st

from pdhef_logtool.cli.inspecting import render_inspection
from pdhef_logtool.logs.drive_log import Columns
from pdhef_logtool.mapping import ClockModel, Mapping, QualityGate, SignalSource, clock_key, fit_clocks, read_signals
from pdhef_logtool.mapping.channels import clean_samples, gate_mask, si_values
from pdhef_logtool.mapping.clocks import apply_clock, fit_clock_line, why_unusable
from pdhef_logtool.records.errors import MappingError
from pdhef_logtool.records.signals import Channel, IntArray, Loss
from pdhef_logtool.runs.inspection.report import Steps, inspect_drive_log
from tests.command_line import rendered

T0 = 1_700_000_000_000_000_000


@settings(max_examples=50, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 10_000),
    offset_s=st.floats(-1e9, 1e9),
    drift_ppm=st.floats(-300, 300),
    jitter_ms=st.floats(0.1, 20),
    outliers=st.booleans(),
)
def test_the_line_finds_offset_and_drift(seed, offset_s, drift_ppm, jitter_ms, outliers):
    rng = np.random.default_rng(seed)
    n = 6000
    true_s = np.arange(n) * 0.01
    log_time = T0 + np.rint((true_s + 0.003 + rng.exponential(jitter_ms * 1e-3, n)) * 1e9).astype(np.int64)
    device = np.rint((offset_s + true_s * (1 - drift_ppm * 1e-6)) * 1e9).astype(np.int64)
    if outliers:
        log_time[rng.choice(n, 60, replace=False)] -= 2_000_000_000
    shuffle = rng.permutation(n)
    reference, reference_log, drift, _ = fit_clock_line(device, log_time)
    assert fit_clock_line(device[shuffle], log_time[shuffle])[:3] == (reference, reference_log, drift)
    clock = ClockModel(reference_stamp_ns=reference, reference_log_ns=reference_log, drift=drift)
    error_s = (apply_clock(device, clock) - (T0 + np.rint(true_s * 1e9).astype(np.int64))) * 1e-9
    # The time is known up to the smallest delay (3 ms here) and a low quantile of the jitter.
    assert np.abs(error_s - 0.003).max() < 0.3 * jitter_ms * 1e-3 + 1e-5


def test_a_step_of_the_clock_shows_in_the_residual():
    device = np.arange(2000, dtype=np.int64) * 10_000_000
    log_time = T0 + device
    device[1000:] += 400_000_000
    assert fit_clock_line(device, log_time)[3] > 0.15


@pytest.mark.parametrize("n", [1, 2, 5])
def test_a_few_messages_are_enough(n):
    device = np.arange(n, dtype=np.int64) * 10_000_000 + 77
    reference, reference_log, drift, _ = fit_clock_line(device, T0 + device)
    got = apply_clock(device, ClockModel(reference, reference_log, drift))
    np.testing.assert_allclose(got - T0 - device, 0, atol=2)


def fitted(log: FakeLog, *sources: SignalSource) -> dict[str, ClockModel]:
    return fit_clocks(log, Mapping(signals={s.name: s for s in sources}), log.start_ns, log.end_ns)


DEVICE = SignalSource("ay_m_s2", "/imu", "a", stamp="t", stamp_unit="s", clock="device")
STAMPED = SignalSource("ay_m_s2", "/imu", "v", stamp="header.stamp")


def device_log(n: int, duration_s: float) -> FakeLog:
    stamps = np.rint(np.linspace(1.0, 1.0 + duration_s, n) * 1e9).astype(np.int64)
    log_time = T0 + np.rint(stamps * (1 + 1e-4)).astype(np.int64)
    return FakeLog({"/imu": FakeTopic("x/Imu", log_time, {"t": stamps * 1e-9, "a": np.zeros(n)})})


def test_a_long_log_is_surveyed_in_parts():
    log = device_log(40_000, 4000.0)
    clock = fitted(log, DEVICE)[clock_key(DEVICE)]
    assert clock.samples < 10_000
    topic = log.contents["/imu"]
    stamps = np.rint(topic.fields["t"] * 1e9).astype(np.int64)
    np.testing.assert_allclose(apply_clock(stamps, clock) - topic.log_time_ns, 0, atol=2000)
    assert clock.drift == pytest.approx(1e-4, rel=1e-3)
    assert clock.median_period_s == pytest.approx(0.1, rel=1e-3)


def test_a_device_clock_without_stamps_is_one_line():
    log = device_log(100, 1.0)
    log.contents["/imu"].fields["t"][:] = np.nan
    with pytest.raises(MappingError, match="no usable stamp"):
        fitted(log, DEVICE)


MS, S = 1_000_000, 1_000_000_000
START = 1_700_000_000 * S
N = 1000
TRUE = START + np.arange(N, dtype=np.int64) * 10 * MS
LOG = TRUE + 3 * MS + np.random.default_rng(0).integers(0, MS, N)


def stepped(by_ns: int) -> IntArray:
    return TRUE + np.where(np.arange(N) < N // 2, 0, by_ns)


UNUSABLE = {
    "back by 3 s": (stepped(-3 * S), "step back"),
    "back by an hour": (stepped(-3600 * S), "step back"),
    "ahead by an hour": (stepped(3600 * S), "far off"),
    "in fives": (TRUE // (50 * MS) * (50 * MS), "repeat"),
}


@pytest.mark.parametrize("name", UNUSABLE)
def test_log_time_serves(name):
    stamps, why = UNUSABLE[name]
    assert why in why_unusable(stamps, LOG)
    log = FakeLog({"/imu": FakeTopic("a/b", LOG, {"header.stamp": stamps, "v": np.arange(float(N))})})
    late = replace(STAMPED, latency_s=0.001)
    found = read_signals(log, Mapping(signals={"ay_m_s2": late}), fitted(log, late), log.start_ns, log.end_ns)
    np.testing.assert_array_equal(found.signals["ay_m_s2"].stamps_ns, LOG - MS)
    np.testing.assert_array_equal(found.signals["ay_m_s2"].arrival_ns, LOG)
    assert [(x.kind, x.severity) for x in found.losses] == [("log-time-serves", "note")]
    assert why in found.losses[0].what
    assert +found.counts["signal", "ay_m_s2"] == {"read": N}


def test_sound_stamps_stay():
    late = LOG.copy()
    late[300:500] += np.linspace(5 * S, 0, 200).astype(np.int64)  # held up for five seconds, then sent in order
    twice = np.repeat(TRUE, 2)
    copied = np.sort(np.concatenate([LOG, LOG + MS]))  # every message again a millisecond later
    in_one_packet = np.repeat(TRUE[::5], 5)
    together = np.repeat(LOG[4::5], 5) + np.tile(np.arange(5) * 10_000, N // 5)
    wild = TRUE.copy()
    wild[[5, 100, 101, 700]] = [1, START + 10**18, START - 10**17, START + 500 * S]
    swapped = np.concatenate([TRUE[:400], TRUE[440:480], TRUE[400:440], TRUE[480:]])
    for stamps, log_time in (
        (TRUE, LOG),
        (TRUE, np.maximum.accumulate(late)),
        (twice, copied),
        (in_one_packet, together),
        (wild, LOG),
        (swapped, LOG),
        (TRUE - 3600 * S, LOG),
    ):
        assert why_unusable(stamps, log_time) == ""


@pytest.mark.parametrize(("behind_ns", "serves"), [(3600 * S, True), (-3 * S, True), (20 * MS, False)])
def test_one_topic_of_another_clock(behind_ns, serves):
    """A clock offset shared by all topics is accepted; a topic with a different offset has unusable stamps."""
    topics = {
        "/imu": FakeTopic("a/b", LOG, {"header.stamp": TRUE - behind_ns, "v": np.arange(float(N))}),
        "/steer": FakeTopic("a/b", LOG, {"header.stamp": TRUE, "v": np.arange(float(N))}),
    }
    log = FakeLog(topics)
    clocks = fitted(log, STAMPED, replace(STAMPED, name="steer_rad", topic="/steer"))
    assert bool(clocks["/imu.header.stamp"].unusable) == serves
    assert not clocks["/steer.header.stamp"].unusable
    assert not fitted(log, STAMPED)["/imu.header.stamp"].unusable


def test_a_step_between_the_parts_of_a_survey_is_found():
    n = 3600 * 10
    true = START + np.arange(n, dtype=np.int64) * 100 * MS
    stamps = true - np.where(np.arange(n) < 17_437, 0, 3 * S)
    log = FakeLog({"/imu": FakeTopic("a/b", true + 5 * MS, {"header.stamp": stamps, "v": np.zeros(n)})})
    assert "step back by 2.9 s" in fitted(log, STAMPED)["/imu.header.stamp"].unusable


def test_zero_stamps_lose_no_topic():
    zeros = np.zeros(N, np.int64)
    log = FakeLog({"/imu": FakeTopic("a/b", LOG, {"header.stamp": zeros, "v": np.arange(float(N))})})
    clock = fitted(log, STAMPED)["/imu.header.stamp"]
    assert clock.unusable == "100% of its stamps are zero or no time"
    assert clock.median_period_s == pytest.approx(0.01, abs=0.001)


@given(
    burst=st.integers(1, 12), spread_us=st.integers(0, 3000), period_ms=st.integers(40, 300), seed=st.integers(0, 99)
)
def test_the_rate_of_any_burst_pattern_is_messages_over_time(burst, spread_us, period_ms, seed):
    jitter = np.random.default_rng(seed).integers(0, 1 + 1000 * spread_us, 200 * burst)
    stamps = np.sort(START + np.repeat(np.arange(200) * period_ms * MS, burst) + jitter)
    assert Steps.of([stamps]).rate_hz == pytest.approx(burst * 1000.0 / period_ms, rel=0.06)


def test_a_delay_of_another_clock_is_named_and_not_shown_as_a_delay():
    count = np.arange(300, dtype=np.int64)
    text = {}
    for name, offset in (("simulation", START), ("boot", 3600 * S), ("arrival", 20 * MS)):
        stamps = START + count * 10 * MS - offset
        fields = {"header.stamp": stamps, "angular_velocity.z": np.sin(count * 0.01)}
        log = FakeLog(
            {"/imu": FakeTopic("sensor_msgs/msg/Imu", START + count * 10 * MS, fields, publish_time_ns=stamps)}
        )
        text[name] = rendered(render_inspection, inspect_drive_log(log), 120)
    assert "simulation clock" in text["simulation"]
    assert "other clock" in text["boot"]
    assert "clock" not in text["arrival"].split("Mapping")[0]
    assert "e+" not in "".join(text.values()).split("Values")[0]


# ---- Reading mapped fields: values, times, cleaning with counts, and the truth gate ----


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


FEW = 4


def columns(**fields: np.ndarray) -> Columns:
    times = np.arange(FEW, dtype=np.int64)
    return Columns("/a", times, times, fields)


@pytest.mark.parametrize(
    ("name", "raw", "shape"),
    [
        ("enu_velocity_m_s", np.ones((FEW, 2)), (FEW, 3)),
        ("quat_wxyz", np.ones((FEW, 3)), (FEW, 4)),
        ("enu_velocity_m_s", np.ones(FEW), (FEW, 3)),
        ("speed_m_s", np.ones((FEW, 3)), (FEW,)),
    ],
)
def test_what_is_not_the_signal_s_shape_is_missing_at_every_sample(name, raw, shape):
    values = si_values(columns(v=raw), SignalSource(name, "/a", "v"))
    assert values.shape == shape
    assert np.isnan(values).all()
