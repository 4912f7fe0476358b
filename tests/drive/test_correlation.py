"""The shift between two signals is the one that Pearson's coefficient at every shift gives."""

from __future__ import annotations

import numpy as np
import pytest

from pdhef_logtool.drive.correlation import (
    CommonGrid,
    Shift,
    find_shift,
    on_common_grid,
    shift_error,
)
from pdhef_logtool.drive.interpolation import Bracket
from pdhef_logtool.records.signals import FloatArray

_UNKNOWN = Shift(float("nan"), float("nan"), False)


def by_every_shift(a: FloatArray, b: FloatArray, reach: int) -> FloatArray:
    """Return the coefficient at each shift as it is defined; NaN where a side varies by less than rounding."""
    found, n = np.full(2 * reach + 1, np.nan), len(a)
    for k in range(max(-reach, 2 - n), min(reach, n - 2) + 1):
        x, y = a[max(0, -k) : n - max(0, k)], b[max(0, k) : n - max(0, -k)]
        known = np.isfinite(x) & np.isfinite(y)
        sides = [(v[known], 1e-9 * np.nanvar(of)) for v, of in ((x, a), (y, b))]
        if np.count_nonzero(known) > 1 and all(v.var() > least for v, least in sides):
            found[k + reach] = np.corrcoef(x[known], y[known])[0, 1]
    return found


def pair(kind: str, rng: np.random.Generator, n: int) -> tuple[FloatArray, FloatArray]:
    """Make two signals of which one follows the other."""
    walk = np.cumsum(rng.standard_normal(n))
    late = np.roll(walk, int(rng.integers(-40, 40))) + rng.uniform() * rng.standard_normal(n)
    if kind == "holes":
        walk[rng.random(n) < 0.3] = late[rng.random(n) < 0.3] = np.nan
    made = {
        "walk": (walk, late), "holes": (walk, late), "equal": (walk, walk.copy()), "constant": (np.zeros(n), late),
        "ties": (np.arange(n) % 2.0, np.arange(n) % 2.0), "far from zero": (walk + 1e4, late),
        "tiny and huge": (walk * 1e-100, late * 1e100),
    }  # fmt: skip
    return made[kind]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["walk", "holes", "equal", "constant", "ties", "far from zero", "tiny and huge"])
@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid value")
def test_the_shift_is_that_of_every_shift(kind: str) -> None:
    rng = np.random.default_rng(0)
    for _ in range(40):
        a, b = pair(kind, rng, int(rng.integers(2, 200)))
        shift, every = find_shift(CommonGrid(0.01, a, b), 0.3), by_every_shift(a, b, 30)
        if not np.isfinite(every).any():
            assert repr(shift) == repr(_UNKNOWN)
            continue
        best = np.flatnonzero(every > np.nanmax(every) - 1e-6)  # equal to rounding
        assert shift.correlation == pytest.approx(np.nanmax(every), abs=1e-6)
        assert np.abs(shift.shift_s / 0.01 - (best - 30)).min() <= 0.5 + 1e-6
        assert shift.inside == (0.3 - abs(shift.shift_s) > 1e-9)


@pytest.mark.parametrize("share", [0.0, 0.4])
def test_columns_on_an_even_grid_are_those_of_numpy(share: float) -> None:
    rng = np.random.default_rng(1)
    stamps = np.cumsum(rng.integers(8_000_000, 12_000_000, 500)).astype(np.int64)
    stamps = stamps[(rng.random(500) >= share) | (np.arange(500) % 499 == 0)]
    for _ in range(3):
        values = np.cumsum(rng.standard_normal(len(stamps)))
        found = on_common_grid(stamps, values, stamps.copy(), values)
        on_grid = Bracket(
            stamps,
            np.arange(stamps[0], stamps[-1] + 1, round(found.step_s * 1e9)),
            round(3 * np.median(np.diff(stamps))),
        ).linear(values)
        known, n = np.flatnonzero(np.isfinite(on_grid)), len(on_grid)
        slope, offset = np.polyfit(known / n, on_grid[known], 1)
        expected = on_grid - offset - slope * (np.arange(n) / n)
        same = on_common_grid(stamps, values, stamps, values)
        for column in (same.a, same.b, found.a, found.b):
            np.testing.assert_allclose(column, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("coloured", [False, True])
def test_the_error_of_a_shift_is_that_of_its_scatter(coloured: bool) -> None:
    """Noise is white or as slow as a bend: the spread of shifts over many drives is the error that is stated."""
    rng, ratios = np.random.default_rng(3), []
    for _ in range(40):
        a, noise = (np.convolve(rng.standard_normal(6200), np.hanning(200), "valid") for _ in range(2))
        noise = noise[:6000] if coloured else 6.0 * rng.standard_normal(6000)
        b = np.roll(a[:6000], 7) + 0.1 * noise
        grid = CommonGrid(0.01, a[:6000], b)
        shift = find_shift(grid, 0.5).shift_s
        ratios.append((shift - 0.07) / shift_error(grid, shift))
    assert 0.3 < np.sqrt(np.mean(np.square(ratios))) < 1.3
