"""Wrong frictions and vehicles: right sizes, reproducible, and physically still a car."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest

from pdhef_logtool.car.vehicle import VehicleParameters, default_vehicle
from studies.defaults.variation import SPREADS, made_wrong

VEHICLE = default_vehicle()


def _drawn(spread: float, key: str, count: int) -> list[tuple[VehicleParameters, float]]:
    return list(islice(made_wrong(VEHICLE, spread, key), count))


def test_the_same_key_draws_the_same_and_others_draw_others():
    draws = _drawn(0.1, "a", 40)
    assert draws == _drawn(0.1, "a", 40)
    assert draws != _drawn(0.1, "b", 40)


def test_spread_of_the_draws():
    draws = _drawn(0.1, "a", 2400)
    changed = [vehicle for vehicle, _ in draws]
    logs = {
        "friction": np.log([factor for _, factor in draws]),
        "mass": np.log([d.mass_kg / VEHICLE.mass_kg for d in changed]),
        "roll": np.log([d.roll_gradient_rad_per_m_s2 / VEHICLE.roll_gradient_rad_per_m_s2 for d in changed]),
    }
    for name, values in logs.items():
        assert values.std() == pytest.approx(0.1 * SPREADS[name], rel=0.08)
        assert abs(values.mean()) < 0.02
    both = [
        np.log(d.cornering_stiffness_n_per_rad(f, 1.0) / VEHICLE.cornering_stiffness_n_per_rad(f, 1.0))
        for f in (True, False)
        for d in changed
    ]
    assert np.std(both) == pytest.approx(0.1 * np.hypot(SPREADS["stiffness"], SPREADS["stiffness_of_axle"]), rel=0.08)


def test_the_wheelbase_stays_and_the_friction_of_the_file_moves_with_the_signal():
    for drawn, factor in _drawn(0.2, "a", 50):
        assert drawn.wheelbase_m == pytest.approx(VEHICLE.wheelbase_m)
        assert drawn.cg_to_front_axle_m > 0.5
        assert drawn.friction == pytest.approx(VEHICLE.friction * factor)
