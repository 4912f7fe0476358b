"""Search for the noise of the tuned filters of the shipped car."""

from __future__ import annotations

import math

import numpy as np
import pytest

from studies.defaults.noise import HIGH, LOW, Point, search

OPTIMUM = (0.3, 0.05, 1.5, 0.004)


def _bowl(values: Point) -> float:
    """Return an objective that grows with the distance from the optimum in logarithms."""
    return 0.1 + sum(math.log(v / o) ** 2 for v, o in zip(values, OPTIMUM, strict=True))


@pytest.mark.parametrize("seed", range(2))
def test_the_search_finds_the_optimum_inside_its_ranges(seed: int) -> None:
    trials = search(_bowl, 128, seed)
    assert trials == search(_bowl, 128, seed) != search(_bowl, 128, seed + 1)
    best = min(trials, key=lambda t: t.objective_deg)
    assert best.number >= 64, "the refinement improves on the exploration"
    assert np.abs(np.log(np.array(best.values) / OPTIMUM)).max() < math.log(1.4)
    values = np.array([t.values for t in trials])
    assert ((values >= LOW * 0.999) & (values <= HIGH * 1.001)).all()
