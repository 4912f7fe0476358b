"""Extra variance takes a channel out of the filter; a tyre with a reference friction keeps its stiffness."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from reference_car import drive, slalom

from pdhef_logtool.car.vehicle import AxleTyre, Tyres, VehicleParameters, default_vehicle
from pdhef_logtool.estimators.phy_ukf import PhysicsUkf

pytestmark = pytest.mark.slow

VEHICLE = default_vehicle()


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
