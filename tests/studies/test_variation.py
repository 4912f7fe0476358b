"""Wrong frictions and vehicles: right sizes, reproducible, and physically still a car."""

from __future__ import annotations

from itertools import islice

import pytest

from pdhef_logtool.car.vehicle import VehicleParameters, default_vehicle
from studies.defaults.variation import made_wrong

VEHICLE = default_vehicle()


def _drawn(spread: float, key: str, count: int) -> list[tuple[VehicleParameters, float]]:
    return list(islice(made_wrong(VEHICLE, spread, key), count))


def test_the_same_key_draws_the_same_and_others_draw_others():
    draws = _drawn(0.1, "a", 40)
    assert draws == _drawn(0.1, "a", 40)
    assert draws != _drawn(0.1, "b", 40)


def test_the_wheelbase_stays_and_the_friction_of_the_file_moves_with_the_signal():
    for drawn, factor in _drawn(0.2, "a", 50):
        assert drawn.wheelbase_m == pytest.approx(VEHICLE.wheelbase_m)
        assert drawn.cg_to_front_axle_m > 0.5
        assert drawn.friction == pytest.approx(VEHICLE.friction * factor)
