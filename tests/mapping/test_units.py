"""The posterior of units: what a gain shows, what two gains show together, and what remains a tie."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pdhef_logtool.mapping.candidates import HYPOTHESES
from pdhef_logtool.mapping.fields import BY_DRIVING, CERTAIN, RARE, SAME, Gain, Unit, posterior

SPEED, RATE = (
    [Unit(*u, energy=RARE.get(u[0], 0.0)) for u in units]
    for units in (HYPOTHESES["speed"][:3], HYPOTHESES["steering"])  # only an accurate gain separates knots from mph
)


@pytest.mark.parametrize("true", SPEED, ids=[u.name for u in SPEED])
def test_a_second_speed_shows_the_unit_and_an_odd_scale_shows_none(true: Unit) -> None:
    shares = posterior([SPEED], [Gain((1,), 1.04 / true.factor, SAME)])
    assert SPEED[int(shares.argmax())] is true and shares.max() > CERTAIN
    assert posterior([SPEED], [Gain((1,), 1.25 / true.factor, SAME)]).sum() < 0.1


@pytest.mark.parametrize("speed", SPEED, ids=[u.name for u in SPEED])
@pytest.mark.parametrize("rate", RATE, ids=[u.name for u in RATE])
def test_turning_shows_the_units_of_speed_and_yaw_rate_at_once(speed: Unit, rate: Unit) -> None:
    joint = posterior([RATE, SPEED], [Gain((-1, -1), 1.1 * speed.factor * rate.factor, BY_DRIVING)])
    best = np.unravel_index(int(joint.argmax()), joint.shape)
    assert (RATE[best[0]], SPEED[best[1]]) == (rate, speed)
    assert joint.max() > CERTAIN


def test_units_with_the_same_factor_are_a_tie() -> None:
    alike = [Unit("km/h", 1 / 3.6), Unit("rad/s", 0.3, spread=0.4)]
    shares = posterior([alike], [Gain((1,), math.sqrt(3.6 / 0.3), BY_DRIVING)])
    assert shares.max() < CERTAIN < shares.sum()


def test_gains_that_contradict_each_other_show_no_unit() -> None:
    gains = [Gain((1,), 1.0, SAME), Gain((1,), 3.6, SAME)]
    assert posterior([SPEED], gains).sum() < 0.5
