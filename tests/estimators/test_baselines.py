"""What is particular to each baseline, against closed forms."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from reference_car import FRICTION, REAR_M, WHEELBASE_M, drive, keep, make_signals, slalom

from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.estimators.kinematic import Kinematic
from pdhef_logtool.estimators.open_loop import OpenLoop
from pdhef_logtool.estimators.pass_through import PassThrough

ZERO = PassThrough("zero", claims_zero_sideslip=True)


def straight(n: int, speed: float | np.ndarray, **columns):
    full = {
        "steer_rad": np.zeros(n),
        "ax_m_s2": np.zeros(n),
        "ay_m_s2": np.zeros(n),
        "yaw_rate_rad_s": np.zeros(n),
        "speed_m_s": np.full(n, speed),
        **columns,
    }
    return make_signals(np.full(n - 1, 0.01), **full)


def test_speed_between_its_samples_follows_the_accelerometer_for_half_a_second():
    n = 300
    speed = np.full(n, np.nan)
    speed[:100:10] = 20.0 + 2.0 * 0.01 * np.arange(0, 100, 10)
    track, _ = ZERO.run(straight(n, speed, ax_m_s2=np.full(n, 2.0)), None)
    known = np.arange(n) < 90 + 50  # the last sample is number 90
    np.testing.assert_allclose(track.vx_m_s[known], 20.0 + 0.02 * np.arange(n)[known], atol=1e-9)
    assert track.valid[:139].all()
    assert not track.valid[142:].any()
    assert (track.vy_m_s[known] == 0).all()


def test_speed_is_held_where_there_is_no_accelerometer():
    speed = np.where(np.arange(100) % 20 == 0, 17.0, np.nan)
    track, _ = ZERO.run(straight(100, speed, ax_m_s2=np.full(100, np.nan)), None)
    assert (track.vx_m_s == 17.0).all()


def test_gyro_dropout_makes_a_pass_through_invalid():
    rate = np.where(np.abs(np.arange(100) - 50) < 5, np.nan, 0.1)
    track, _ = ZERO.run(straight(100, 17.0, yaw_rate_rad_s=rate), None)
    np.testing.assert_array_equal(track.valid, np.isfinite(rate))


@pytest.mark.parametrize("leak_s", [0.5, 2.0])
def test_kinematic_answers_a_step_as_a_leaky_integrator(leak_s):
    """a_y - v r jumps to 0.4 m/s^2: v_y = 0.4 tau (1 - exp(-t / tau))."""
    n = 500
    signals = straight(n, 20.0, ay_m_s2=np.full(n, 2.4), yaw_rate_rad_s=np.full(n, 0.1))
    track, _ = Kinematic(leak_s=leak_s).run(signals, None)
    t = 0.01 * np.arange(n)
    want = 0.4 * leak_s * (1.0 - np.exp(-t / leak_s))
    np.testing.assert_allclose(track.vy_m_s, want, atol=0.02 * leak_s * 0.4)
    assert track.vy_m_s[-1] == pytest.approx(0.4 * leak_s * (1.0 - math.exp(-t[-1] / leak_s)), rel=2e-3)


def test_kinematic_converges_to_the_integral_with_the_step():
    """Without leak v_y is the integral of a_y - v_x r: the error of a sine halves with the step."""
    errors = []
    for step_s in (0.02, 0.01, 0.005):
        made = drive(slalom(0.03, 0.5), 4.0, step_s=step_s, speed_every=1)
        track, _ = Kinematic(leak_s=1e9).run(made.signals, None)
        errors.append(np.abs(track.vy_m_s - made.vy).max())
    assert errors[0] < 0.05
    assert errors[1] < 0.6 * errors[0]
    assert errors[2] < 0.6 * errors[1]


def test_kinematic_forgets_at_standstill_and_behind_a_gap():
    n = 600
    speed = np.where((np.arange(n) > 200) & (np.arange(n) < 300), 0.0, 20.0)
    signals = straight(n, speed, ay_m_s2=np.full(n, 0.4))
    track, _ = Kinematic(leak_s=5.0, slip_gate=False).run(signals, None)
    assert track.vy_m_s[199] > 0.5
    assert (track.vy_m_s[201:300] == 0).all()
    assert track.vy_m_s[400] > 0.2
    mask = (np.arange(n) < 400) | (np.arange(n) > 460)
    gapped, _ = Kinematic(leak_s=5.0, slip_gate=False).run(keep(signals, mask), None)
    assert gapped.vy_m_s[400] == 0.0
    assert 0.0 < gapped.vy_m_s[410] < 0.1


def test_open_loop_starts_rolling_without_slip():
    n = 400
    steer = np.where(np.abs(np.arange(n) - 200) < 3, np.nan, 0.02)
    track, _ = OpenLoop(default_vehicle()).run(straight(n, 10.0, steer_rad=steer), None)
    rate = 10.0 * math.tan(0.02) / WHEELBASE_M
    for start in (0, 203):
        assert track.yaw_rate_rad_s[start] == pytest.approx(rate, rel=1e-12)
        assert track.vy_m_s[start] == pytest.approx(REAR_M * rate, rel=1e-12)
    assert not track.valid[198:203].any()
    assert track.vy_m_s[190] != pytest.approx(REAR_M * rate, rel=1e-3)


def test_open_loop_uses_the_friction_of_the_log():
    made = drive(slalom(0.03, 0.5), 5.0, mu=0.4, speed_every=1)
    car = OpenLoop(default_vehicle())
    settled = made.time_s > 1
    assumed, _ = car.run(made.signals, None)
    known, _ = car.run(replace(made.signals, friction=np.full(len(made.signals), 0.4)), None)
    assert np.abs(known.sideslip_rad - made.sideslip)[settled].max() < 1e-5
    assert np.abs(assumed.sideslip_rad - made.sideslip)[settled].max() > 1e-3
    assert FRICTION != 0.4
