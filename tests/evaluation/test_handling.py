"""Key figures of manoeuvres against responses in closed form, of estimates and of ground truth alike."""

from __future__ import annotations

import math

import numpy as np
import pytest
from reference_car import signals_at

from pdhef_logtool.car.car import Car
from pdhef_logtool.evaluation.metrics import EvaluatedDrive, evaluate_drive
from pdhef_logtool.evaluation.metrics.handling import METRICS
from pdhef_logtool.evaluation.metrics.metric import CalibratedSignals
from pdhef_logtool.records.tracks import make_track

T0 = 1_700_000_000_000_000_000
T = np.arange(0.0, 8.0, 0.01)
STAMPS = T0 + np.round(T * 1e9).astype(np.int64)
VEHICLE = Car.load().vehicle
WHEELBASE_M = VEHICLE.cg_to_front_axle_m + VEHICLE.cg_to_rear_axle_m
DAMPING, OMEGA = 0.5, 8.0


def figures(steer, name, inside, truth, **estimates):
    signals = signals_at(STAMPS, steer_rad=steer)
    tracks = {k: make_track(k, STAMPS, **c) for k, c in estimates.items()}
    calibrated = CalibratedSignals(signals, VEHICLE)
    drive = EvaluatedDrive("x", tracks, make_track("truth", STAMPS, **truth), signals, {name: inside}, 3.0, calibrated)
    rows = evaluate_drive(drive, [m.name for m in METRICS])
    assert {row.segment for row in rows} <= {"all"}
    return {(row.estimator, row.signal, row.metric): row.value for row in rows}


def second_order(since):
    """Unit step response of a damped oscillator."""
    s = np.maximum(since, 0.0)
    root = math.sqrt(1.0 - DAMPING**2)
    turn = OMEGA * root * s
    return 1.0 - np.exp(-DAMPING * OMEGA * s) * (np.cos(turn) + DAMPING / root * np.sin(turn))


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_step_has_the_figures_of_its_oscillator(side):
    rise = np.clip((T - 1.0) / 0.1, 0.0, 1.0)  # half of it at 1.05 s
    found = figures(
        side * 0.03 * rise, "step-steer", (T > 0.5) & (T < 6.0),
        {"yaw_rate_rad_s": side * 0.3 * second_order(T - 1.05), "ay_m_s2": side * 6.0 * second_order(T - 1.05)},
        late={"yaw_rate_rad_s": side * 0.3 * second_order(T - 1.15), "ay_m_s2": np.full(len(T), np.nan)},
    )  # fmt: skip
    fine = np.arange(0.0, 1.0, 1e-5)
    time = fine[np.argmax(second_order(fine) >= 0.9)]
    overshoot = math.exp(-math.pi * DAMPING / math.sqrt(1.0 - DAMPING**2))
    for signal, size in (("yaw_rate_rad_s", 0.3), ("ay_m_s2", 6.0)):
        assert found["truth", signal, "step_response_time"] == pytest.approx(time, abs=1e-3)
        assert found["truth", signal, "step_overshoot"] == pytest.approx(overshoot, abs=2e-3)
        assert found["truth", signal, "step_peak"] == pytest.approx(side * size * (1.0 + overshoot), rel=2e-3)
    assert found["late", "yaw_rate_rad_s", "step_response_time"] == pytest.approx(time + 0.1, abs=1e-3)
    assert ("late", "ay_m_s2", "step_peak") not in found


def test_a_sine_with_dwell_has_the_ratios_of_its_decay():
    hz = 0.7
    steer = np.where(0.75 / hz > T, np.sin(2 * np.pi * hz * T), -1.0)
    steer = np.where(0.75 / hz + 0.5 < T, np.sin(2 * np.pi * hz * (T - 0.5)), steer)
    complete = 1.0 / hz + 0.5
    steer = 0.1 * np.where(complete <= T, 0.0, steer)
    rate = np.where(complete > T, 0.4 * steer / 0.1, -0.4 * np.exp(-(T - complete) / 0.8))
    peak = np.where((0.5 / hz < T) & (complete > T), -0.4, rate)  # held at its peak until the steering is complete
    found = figures(steer, "sine-with-dwell", (T >= 0.0) & (complete >= T), {"yaw_rate_rad_s": peak})
    at_zero = complete - math.asin(0.05) / (2 * np.pi * hz)
    for metric, after in (("dwell_ratio_1s", 1.0), ("dwell_ratio_1_75s", 1.75)):
        expected = math.exp(-(at_zero + after - complete) / 0.8)
        assert found["truth", "yaw_rate_rad_s", metric] == pytest.approx(expected, rel=0.02)


def test_the_understeer_gradient_is_the_slope_beyond_the_geometric_angle():
    speed, gradient = 20.0, 0.003
    ay = np.clip(0.8 * T, 0.0, 6.0)
    rate = ay / speed
    steer = WHEELBASE_M * rate / speed + gradient * ay + 0.02 * np.maximum(ay - 4.0, 0.0)  # and a limit
    motion = {"vx_m_s": np.full(len(T), speed), "yaw_rate_rad_s": rate, "ay_m_s2": ay}
    wrong = motion | {"ay_m_s2": 2.0 * ay}
    found = figures(steer, "ramp-steer", T < 7.5, motion, twice=wrong)
    assert found["truth", "ay_m_s2", "understeer_gradient"] == pytest.approx(gradient, rel=1e-6)
    assert found["twice", "ay_m_s2", "understeer_gradient"] == pytest.approx(0.5 * gradient, rel=1e-6)
    flat = figures(steer, "steady-circle", (T > 2.0) & (T < 2.5), motion)
    assert ("truth", "ay_m_s2", "understeer_gradient") not in flat  # one lateral acceleration has no slope


def test_a_lane_change_has_the_speed_of_its_first_stamp_and_other_drives_no_figures():
    speed = {"vx_m_s": 20.0 - T}
    found = figures(0.0 * T, "dlc-3888-2", ((T > 1.995) & (T < 4.0)) | (T > 6.0), speed)
    assert found == {("truth", "vx_m_s", "entry_speed"): pytest.approx(18.0)}
    assert figures(0.0 * T, "straight", T > 2.0, speed) == {}
