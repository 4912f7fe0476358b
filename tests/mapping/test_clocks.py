"""Device clocks against log time: the fitted line, its robustness, and the survey that all windows share."""

from __future__ import annotations

import numpy as np
import pytest
from fake_drive_log import FakeLog, FakeTopic
from hypothesis import given, settings
from hypothesis import strategies as st

from pdhef_logtool.mapping import ClockModel, Mapping, SignalSource, clock_key, fit_clocks
from pdhef_logtool.mapping.clocks import apply_clock, fit_clock_line
from pdhef_logtool.records.errors import MappingError

T0 = 1_700_000_000_000_000_000


@settings(max_examples=50, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 10_000),
    offset_s=st.floats(-1e9, 1e9),
    drift_ppm=st.floats(-300, 300),
    jitter_ms=st.floats(0.1, 20),
    outliers=st.booleans(),
)
def test_the_line_finds_offset_and_drift(
    seed: int, offset_s: float, drift_ppm: float, jitter_ms: float, outliers: bool
) -> None:
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


def test_a_step_of_the_clock_shows_in_the_residual() -> None:
    device = np.arange(2000, dtype=np.int64) * 10_000_000
    log_time = T0 + device
    device[1000:] += 400_000_000
    assert fit_clock_line(device, log_time)[3] > 0.15


@pytest.mark.parametrize("n", [1, 2, 5])
def test_a_few_messages_are_enough(n: int) -> None:
    device = np.arange(n, dtype=np.int64) * 10_000_000 + 77
    reference, reference_log, drift, _ = fit_clock_line(device, T0 + device)
    got = apply_clock(device, ClockModel(reference, reference_log, drift))
    np.testing.assert_allclose(got - T0 - device, 0, atol=2)


def device_log(n: int, duration_s: float) -> FakeLog:
    stamps = np.rint(np.linspace(1.0, 1.0 + duration_s, n) * 1e9).astype(np.int64)
    log_time = T0 + np.rint(stamps * (1 + 1e-4)).astype(np.int64)
    return FakeLog({"/imu": FakeTopic("x/Imu", log_time, {"t": stamps * 1e-9, "a": np.zeros(n)})})


def test_a_long_log_is_surveyed_in_parts() -> None:
    log = device_log(40_000, 4000.0)
    source = SignalSource("ay_m_s2", "/imu", "a", stamp="t", stamp_unit="s", clock="device")
    clock = fit_clocks(log, Mapping(signals={"ay_m_s2": source}), log.start_ns, log.end_ns)[clock_key(source)]
    assert clock.samples < 10_000
    topic = log.contents["/imu"]
    stamps = np.rint(topic.fields["t"] * 1e9).astype(np.int64)
    np.testing.assert_allclose(apply_clock(stamps, clock) - topic.log_time_ns, 0, atol=2000)
    assert clock.drift == pytest.approx(1e-4, rel=1e-3)
    assert clock.median_period_s == pytest.approx(0.1, rel=1e-3)


def test_a_device_clock_without_stamps_is_one_line() -> None:
    log = device_log(100, 1.0)
    log.contents["/imu"].fields["t"][:] = np.nan
    source = SignalSource("ay_m_s2", "/imu", "a", stamp="t", stamp_unit="s", clock="device")
    with pytest.raises(MappingError, match="no usable stamp"):
        fit_clocks(log, Mapping(signals={"ay_m_s2": source}), log.start_ns, log.end_ns)
