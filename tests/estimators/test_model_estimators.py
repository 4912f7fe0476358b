"""The estimators that need a model, under the properties that hold for every estimator."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import test_estimators as properties
from hypothesis import given, settings
from hypothesis import strategies as st
from made_models import full_network
from reference_car import drive, keep, make_signals, slalom, with_noise

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.estimators.table import make_estimator, runnable, spec_of
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.signals import ALIGNED_SIGNALS, Signals
from pdhef_logtool.records.steps import MAX_PREDICTION_S
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.residual_model.linear_model import LinearModel

pytestmark = pytest.mark.slow

VEHICLE = default_vehicle()
NAMES = ("pd-hef", "pd-hef-paper", "pure-lstm", "linear-regression")


MODEL = full_network()


def run(name: str, signals: Signals, vehicle=VEHICLE) -> StateTrack:
    return run_window(make_estimator(name, Car.of(vehicle, network=MODEL)), signals)[0]


@pytest.fixture(scope="module")
def rough() -> Signals:
    """Noise, irregular stamps, missing samples, a gap that restarts the filter, messages late and bunched."""
    rng = np.random.default_rng(12)
    s = with_noise(drive(slalom(0.035, 0.5), speed=22.0, step_s=rng.uniform(0.004, 0.022, 500)).signals, seed=6)
    for column in (s.steer_rad, s.ax_m_s2, s.ay_m_s2, s.yaw_rate_rad_s):
        column[rng.random(len(s)) < 0.05] = np.nan
    ready = np.maximum.accumulate(s.stamps_ns + rng.integers(0, 45_000_000, len(s)))
    t = (s.stamps_ns - s.stamps_ns[0]) * 1e-9
    return keep(replace(s, ready_ns=ready), (t < 3.0) | (t > 3.8))


@pytest.mark.parametrize("name", NAMES)
@settings(derandomize=True, deadline=None, max_examples=15)
@given(j=st.integers(1, 400), seed=st.integers(0, 2**32 - 1), missing=st.booleans())
def test_nothing_that_arrives_later_changes_an_output(name, rough, j, seed, missing):
    rng = np.random.default_rng(seed)
    changed = {}
    for column in ALIGNED_SIGNALS:
        values = getattr(rough, column).copy()
        values[j:] = np.nan if missing else rng.normal(0, 5, len(rough) - j) + 10.0
        changed[column] = values
    before = int(np.searchsorted(rough.stamps_ns, rough.ready_ns[j], side="left"))
    properties.same_bits(run(name, rough), run(name, replace(rough, **changed)), before)


@pytest.mark.parametrize("fault", properties.FAULTS)
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.filterwarnings("error", "ignore::ResourceWarning")
def test_no_fault_breaks_an_estimator(name, fault):
    s = with_noise(drive(slalom(0.035, 0.5), 8.0, speed=22.0).signals, seed=9)
    s.friction[:] = 0.85
    faulty = properties.FAULTS[fault](replace(s, ready_ns=s.stamps_ns + 10_000_000))
    track = run(name, faulty)
    assert len(track) == len(faulty)
    for column in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "sideslip_rad", "ay_m_s2"):
        assert np.isfinite(getattr(track, column)[track.valid]).all(), column
        assert np.isnan(getattr(track, column)[~track.valid]).all(), column
    if len(faulty) > 1:
        assert track.valid[-50:].all(), "it must run again after the fault"


@pytest.mark.parametrize("name", NAMES)
def test_it_runs_on_what_it_needs_alone_and_not_on_what_is_too_late(name):
    plain = drive(slalom(), 3.0).signals
    estimator = make_estimator(name, Car.of(VEHICLE, network=MODEL))
    assert (estimator.name, estimator.causal) == (name, True)
    hashes = {"pure-lstm": MODEL.pure_lstm.sha256, "linear-regression": MODEL.linear_regression.sha256}
    assert name not in hashes or hashes[name] in estimator.notes[0]
    bare = make_signals(
        np.diff(plain.stamps_ns) * 1e-9, **{c: getattr(plain, c) for c in spec_of(name).needs | {"yaw_rate_rad_s"}}
    )
    assert run_window(estimator, bare)[0].valid[50:].all()
    late = replace(plain, ready_ns=plain.stamps_ns + round((MAX_PREDICTION_S + 0.02) * 1e9))
    assert not run_window(estimator, late)[0].valid.any()


def test_pure_lstm_says_what_its_network_says_and_predicts_it_over_the_delay():
    """The network output is constant, 0.25 m/s. Latency compensation adds the latency times the measured v̇_y."""
    lstm = MODEL.pure_lstm
    assert lstm is not None
    weights = {k: np.zeros_like(v) for k, v in lstm.weights.items()}
    constant = max(k for k in weights if k.endswith("bias") and k.startswith("head"))
    weights[constant][:] = 0.25
    model = replace(MODEL, pure_lstm=replace(lstm, weights=weights))
    made = drive(slalom(0.02, 0.5), 4.0)
    gain = 1.0 + 9.80665 * VEHICLE.roll_gradient_rad_per_m_s2
    on_time = replace(made.signals, ay_m_s2=gain * made.ay)
    track, _ = run_window(make_estimator("pure-lstm", Car.of(VEHICLE, network=model)), on_time)
    np.testing.assert_allclose(track.vy_m_s, 0.25, rtol=1e-6)
    np.testing.assert_array_equal(track.yaw_rate_rad_s, made.r)
    np.testing.assert_allclose(track.ay_m_s2, made.ay, rtol=1e-12, atol=1e-12)
    late = replace(on_time, ready_ns=on_time.stamps_ns + 20_000_000)
    track, _ = run_window(make_estimator("pure-lstm", Car.of(VEHICLE, network=model)), late)
    expected = 0.25 + 0.02 * (made.ay - made.vx * made.r)[:-2]
    np.testing.assert_allclose(track.vy_m_s[2:], expected, atol=1e-3)
    assert np.ptp(track.vy_m_s[2:]) > 0.01


def test_linear_regression_is_its_equation():
    """At constant features the low-pass has no say."""
    n = 1500
    signals = make_signals(
        np.full(n - 1, 0.01),
        steer_rad=np.full(n, 0.02), ax_m_s2=np.zeros(n), ay_m_s2=np.full(n, 3.0), yaw_rate_rad_s=np.full(n, 0.15),
        speed_m_s=np.full(n, 20.0),
    )  # fmt: skip
    model = replace(MODEL, linear_regression=LinearModel(("ay_m_s2", "yaw_rate_rad_s"), (-0.01, 0.2), 0.004, 2.0))
    track, _ = run_window(make_estimator("linear-regression", Car.of(VEHICLE, network=model)), signals)
    assert track.sideslip_rad[-1] == pytest.approx(0.004 - 0.03 + 0.03, abs=1e-9)
    step = replace(signals, ay_m_s2=np.where(np.arange(n) < 1000, 3.0, 1.0))
    after, _ = run_window(make_estimator("linear-regression", Car.of(VEHICLE, network=model)), step)
    share = 1.0 - math.exp(-2.0 * math.pi * 2.0 * 0.01 * 8)  # eight steps behind the jump
    assert after.sideslip_rad[1007] == pytest.approx(0.004 + 0.02 * share, abs=1e-9)


def test_what_the_model_has_not_is_skipped_with_the_reason():
    bare = replace(MODEL, pure_lstm=None, linear_regression=None)
    estimators, skipped = runnable(NAMES, Car.of(VEHICLE, network=bare), frozenset(ALIGNED_SIGNALS))
    assert [e.name for e in estimators] == ["pd-hef", "pd-hef-paper"]
    assert [s.name for s in skipped] == ["pure-lstm", "linear-regression"]
    assert all("--baselines" in s.reason for s in skipped)
    with pytest.raises(UsageError, match="--baselines"):
        make_estimator("pure-lstm", Car.of(VEHICLE, network=bare))
