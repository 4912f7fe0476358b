"""Wrong frictions and vehicles for training: right sizes, reproducible, and physically still a car."""

from __future__ import annotations

import numpy as np
import pytest

from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.learning.variation import SPREADS, UNVARIED_SHARE, vary

VEHICLE = default_vehicle()


def test_nothing_is_varied_without_a_spread():
    assert vary(VEHICLE, 0.0, "a").vehicle == VEHICLE
    assert vary(VEHICLE, 0.0, "a").friction_factor == 1.0


def test_the_same_key_draws_the_same_and_others_draw_others():
    draws = [vary(VEHICLE, 0.1, str(k)) for k in range(40)]
    assert draws == [vary(VEHICLE, 0.1, str(k)) for k in range(40)]
    changed = [d for d in draws if d.vehicle != VEHICLE]
    assert len({d.friction_factor for d in changed}) == len(changed)


def test_share_and_spread_of_the_draws():
    draws = [vary(VEHICLE, 0.1, str(k)) for k in range(4000)]
    changed = [d for d in draws if d.vehicle != VEHICLE]
    assert 1.0 - len(changed) / len(draws) == pytest.approx(UNVARIED_SHARE, abs=0.03)
    logs = {
        "friction": np.log([d.friction_factor for d in changed]),
        "mass": np.log([d.vehicle.mass_kg / VEHICLE.mass_kg for d in changed]),
        "roll": np.log([d.vehicle.roll_gradient_rad_per_m_s2 / VEHICLE.roll_gradient_rad_per_m_s2 for d in changed]),
    }
    for name, values in logs.items():
        assert values.std() == pytest.approx(0.1 * SPREADS[name], rel=0.08)
        assert abs(values.mean()) < 0.02
    both = [
        np.log(d.vehicle.cornering_stiffness_n_per_rad(f, 1.0) / VEHICLE.cornering_stiffness_n_per_rad(f, 1.0))
        for f in (True, False)
        for d in changed
    ]
    assert np.std(both) == pytest.approx(0.1 * np.hypot(SPREADS["stiffness"], SPREADS["stiffness_of_axle"]), rel=0.08)


def test_the_wheelbase_stays_and_the_friction_of_the_file_moves_with_the_signal():
    for k in range(50):
        drawn = vary(VEHICLE, 0.2, str(k))
        assert drawn.vehicle.wheelbase_m == pytest.approx(VEHICLE.wheelbase_m)
        assert drawn.vehicle.cg_to_front_axle_m > 0.5
        assert drawn.vehicle.friction == pytest.approx(VEHICLE.friction * drawn.friction_factor)
