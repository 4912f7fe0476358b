"""The optional states of the filter find what they stand for; a tyre with a reference friction keeps its stiffness."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from reference_car import drive, magic_tyre, slalom, with_noise

from pdhef_logtool.car.vehicle import AxleTyre, Sensors, Tyres, VehicleParameters, default_vehicle
from pdhef_logtool.estimators.phy_ukf import FORCE_SCALE_STD, PhysicsUkf

pytestmark = pytest.mark.slow

VEHICLE = default_vehicle()
Q_STD = (0.089, 0.06, 0.03, 0.021)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize(
    ("column", "state", "bias", "prior", "share"),
    [
        ("yaw_rate_rad_s", 5, 0.004, {"yaw_rate_bias_std_rad_s": 0.005}, 1.0),
        ("ay_m_s2", 4, 0.15, {"ay_bias_std_m_s2": 0.15}, 0.8),
        ("steer_rad", 6, 0.003, {"steer_bias_std_rad": 0.003}, 0.7),
    ],
)
def test_bias_states_find_the_sensor_that_is_allowed_to_be_wrong(column, state, bias, prior, share):
    """Three biases meet two equations: only the one whose prior is wide can be told from the others."""
    good = drive(slalom(0.03), duration_s=40.0)
    biased = with_noise(good.signals, seed=1)
    biased = replace(biased, **{column: getattr(biased, column) + bias})
    tight = {"ay_bias_std_m_s2": 0.01, "yaw_rate_bias_std_rad_s": 1e-4, "steer_bias_std_rad": 1e-4}
    vehicle = VEHICLE.model_copy(update={"sensors": Sensors(**(tight | prior))})
    plain = PhysicsUkf(vehicle, q_std=Q_STD)
    steps = replace(plain, bias_states=True).run(biased, None)[0]
    assert steps.x[-500:, state].mean() == pytest.approx(bias, rel=0.25)
    late = good.time_s > 15.0
    error = rms((steps.x[:, 1] - good.vy)[late])
    assert error < share * rms((plain.run(biased, None)[0].x[:, 1] - good.vy)[late])


def test_the_force_scale_is_found():
    def stronger(alpha: float, mu: float, front: bool) -> float:
        return 1.08 * magic_tyre(alpha, mu, front)

    good = drive(slalom(0.05), duration_s=20.0, tyre=stronger)
    noisy = with_noise(good.signals, seed=2)
    plain = PhysicsUkf(VEHICLE, q_std=Q_STD)
    steps = replace(plain, force_scale=True).run(noisy, None)[0]
    late = good.time_s > 5.0
    assert steps.x[late, 4].mean() == pytest.approx(0.08, abs=0.03)
    assert rms((steps.x[:, 1] - good.vy)[late]) < 0.7 * rms((plain.run(noisy, None)[0].x[:, 1] - good.vy)[late])


def test_without_force_the_scale_keeps_its_spread():
    straight = drive(lambda _t: 0.0, duration_s=10.0)
    steps = PhysicsUkf(VEHICLE, force_scale=True).run(straight.signals, None)[0]
    np.testing.assert_allclose(np.sqrt(steps.P[-1, 4, 4]), FORCE_SCALE_STD, rtol=0.02)


def test_extra_variance_takes_a_channel_out():
    good = drive(slalom(0.03), duration_s=5.0)
    extra = np.zeros((len(good.signals), 2))
    extra[200:300, 1] = 1e8
    missing = good.signals.yaw_rate_rad_s.copy()
    missing[200:300] = np.nan
    a = PhysicsUkf(VEHICLE).run(good.signals, None, None, extra)[0]
    b = PhysicsUkf(VEHICLE).run(replace(good.signals, yaw_rate_rad_s=missing), None)[0]
    np.testing.assert_allclose(a.x, b.x, atol=1e-5)


def _with_reference(friction: float | None) -> VehicleParameters:
    tyres = VEHICLE.tyres
    axles = {
        k: AxleTyre(**{**getattr(tyres, k).model_dump(), "reference_friction": friction}) for k in ("front", "rear")
    }
    return VEHICLE.model_copy(update={"tyres": Tyres(**axles)})


@pytest.mark.parametrize("front", [True, False])
def test_a_reference_friction_keeps_stiffness_and_scales_the_peak(front):
    plain, kept = _with_reference(None), _with_reference(0.85)
    for mu in (0.2, 0.85, 1.1):
        assert kept.cornering_stiffness_n_per_rad(front, mu) == pytest.approx(
            plain.cornering_stiffness_n_per_rad(front, 0.85)
        )
        assert kept.magic_formula(front, mu)[2] == pytest.approx(mu / 0.85 * plain.magic_formula(front, 0.85)[2])
    assert kept.magic_formula(front, 0.85) == pytest.approx(plain.magic_formula(front, 0.85))
    # The compiled model agrees: a small steering step at low friction meets the same force.
    signals = drive(lambda _t: 0.002, duration_s=2.0, mu=0.3).signals
    a = PhysicsUkf(kept).run(signals, None)[0].x[-1]
    b = PhysicsUkf(plain).run(replace(signals, friction=np.full(len(signals), 0.85)), None)[0].x[-1]
    assert math.isclose(a[1], b[1], rel_tol=0.05)
