"""The estimators that need a model, under the properties that hold for every estimator."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from made_models import full_network
from reference_car import drive, make_signals, slalom

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.residual_model.linear_model import LinearModel

pytestmark = pytest.mark.slow

VEHICLE = default_vehicle()
MODEL = full_network()


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
    track = run_estimator(make_estimator("pure-lstm", Car(VEHICLE, network=model)), on_time)
    np.testing.assert_allclose(track.vy_m_s, 0.25, rtol=1e-6)
    np.testing.assert_array_equal(track.yaw_rate_rad_s, made.r)
    np.testing.assert_allclose(track.ay_m_s2, made.ay, rtol=1e-12, atol=1e-12)
    late = replace(on_time, ready_ns=on_time.stamps_ns + 20_000_000)
    track = run_estimator(make_estimator("pure-lstm", Car(VEHICLE, network=model)), late)
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
    track = run_estimator(make_estimator("linear-regression", Car(VEHICLE, network=model)), signals)
    assert track.sideslip_rad[-1] == pytest.approx(0.004 - 0.03 + 0.03, abs=1e-9)
    step = replace(signals, ay_m_s2=np.where(np.arange(n) < 1000, 3.0, 1.0))
    after = run_estimator(make_estimator("linear-regression", Car(VEHICLE, network=model)), step)
    share = 1.0 - math.exp(-2.0 * math.pi * 2.0 * 0.01 * 8)  # eight steps behind the jump
    assert after.sideslip_rad[1007] == pytest.approx(0.004 + 0.02 * share, abs=1e-9)
