"""The operating space: every second of driving in one cell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reference_car import make_signals

from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.evaluation.operating_space import AY_EDGES_M_S2, SPEED_EDGES_M_S, operating_space
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import make_track

VEHICLE = default_vehicle()


def signals(speed: float, ay: float, seconds: float = 20.0) -> Signals:
    n = round(seconds * 100)
    columns = {"speed_m_s": np.full(n, speed), "ay_m_s2": np.full(n, ay)}
    return make_signals(np.full(n - 1, 0.01), **columns)


@pytest.mark.parametrize(("speed", "ay", "cell"), [(0.0, 0.5, (0, 0)), (27.0, -4.5, (5, 4)), (90.0, 30.0, (12, 12))])
def test_a_steady_drive_is_in_one_cell_for_as_long_as_it_lasts(speed: float, ay: float, cell: tuple[int, int]) -> None:
    made = signals(speed, ay)
    (found,) = operating_space(made, None, None, VEHICLE)["cells"]
    assert (found["speed"], found["ay"]) == cell
    assert found["seconds"] == pytest.approx(20.0)
    friction = np.repeat([0.3, 0.4, 0.9], [900, 200, 900])
    assert operating_space(replace(made, friction=friction), None, None, VEHICLE)["friction_median"] == 0.4
    assert found["scored"] == 0 and np.isnan(found["sideslip_mse_rad2"])


def test_cells_have_the_error_of_their_stamps() -> None:
    made = signals(20.0, 0.2)
    n, at = len(made), np.arange(len(made))
    vx, ay = np.where(at < n // 2, 12.0, 33.0), np.where(at < n // 4, 0.5, 3.5)
    truth = make_track("truth", made.stamps_ns, vx_m_s=vx, vy_m_s=np.zeros(n), ay_m_s2=ay)
    off = np.where(at < n // 2, 0.01, 0.03)
    own = make_track("own", made.stamps_ns, vx_m_s=vx, vy_m_s=np.zeros(n), sideslip_rad=off)
    whole = operating_space(made, truth, own, VEHICLE)["cells"]
    error = {SPEED_EDGES_M_S[c["speed"]]: c["sideslip_mse_rad2"] for c in whole}
    assert error == {10.0: pytest.approx(1e-4), 30.0: pytest.approx(9e-4)}
    assert {AY_EDGES_M_S2[c["ay"]] for c in whole} >= {0.0, 3.0}
    assert sum(c["scored"] for c in whole) == n
    assert sum(c["seconds"] for c in whole) == pytest.approx(20.0)


def test_the_top_speed_is_that_of_the_drive_also_where_other_signals_are_unknown() -> None:
    made = signals(20.0, 2.0)
    n, at = len(made), np.arange(len(made))
    columns = {"speed_m_s": np.where(at == n // 2, 41.0, 20.0), "ay_m_s2": np.where(at > n // 4, np.nan, 2.0)}
    some = Signals(**{**{f: getattr(made, f) for f in made.__slots__}, **columns})
    part = np.where(at < n // 4, 19.0, np.nan)  # ground truth of a part
    truth = make_track("truth", made.stamps_ns, vx_m_s=part, vy_m_s=0.0 * part, ay_m_s2=part / 10.0)
    for of in (None, truth):
        space = operating_space(some, of, None, VEHICLE)
        assert (space["speed_max_m_s"], space["ay_max_m_s2"]) == (41.0, pytest.approx(2.0, abs=0.11))


def test_a_gap_is_no_driving() -> None:
    made = signals(10.0, 1.5, 4.0)
    stamps = made.stamps_ns + np.where(np.arange(len(made)) < 200, 0, 60_000_000_000)
    late = Signals(**{**{f: getattr(made, f) for f in made.__slots__}, "stamps_ns": stamps})
    assert sum(c["seconds"] for c in operating_space(late, None, None, VEHICLE)["cells"]) == pytest.approx(4.2, abs=0.1)
