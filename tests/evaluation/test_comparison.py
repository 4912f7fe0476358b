"""Errors on the same driving, compared: paired, by blocks, slices never in one block."""

from __future__ import annotations

import numpy as np

from pdhef_logtool.evaluation.comparison import Errors, compare, end_to_end
from pdhef_logtool.evaluation.requirement_blocks import BLOCK_S


def test_slices_end_to_end_share_no_block() -> None:
    slices = [np.arange(n, dtype=np.int64) * 10_000_000 + start for n, start in ((700, 5), (1, 10**18), (450, 0))]
    joined = end_to_end([slices[0], np.empty(0, dtype=np.int64), *slices[1:]])
    assert joined[0] == 0 and joined.size == 1151 and (np.diff(joined) > 0).all()
    owner = np.repeat([0, 1, 2], [700, 1, 450])
    for origin in (0, 3):
        block = (joined[origin:] - joined[origin]) // round(BLOCK_S * 1e9)
        assert all(np.unique(owner[origin:][block == b]).size == 1 for b in np.unique(block))
    assert end_to_end([]).size == 0


def test_lines_are_compared_with_the_yardstick_where_both_are_known() -> None:
    stamps = np.arange(6000, dtype=np.int64) * 10_000_000
    sign = np.where(np.arange(6000) % 2, 1.0, -1.0)
    yard = Errors("yard", np.radians(0.5) * sign, stamps, np.arange(6000) < 5700)
    half = Errors("half", np.where(np.arange(6000) < 3000, np.nan, np.radians(0.3) * sign), stamps)
    none = Errors("none", np.full(6000, np.nan), stamps)
    first, second = compare([yard, half, none], "yard")
    assert (first.name, first.share, first.difference, first.covered) == ("yard", 1.0, None, 0.95)
    assert (second.name, second.share, second.covered) == ("half", 0.5, None)
    assert second.difference is not None
    np.testing.assert_allclose(np.degrees([second.difference.value, second.difference.high]), -0.2)
    np.testing.assert_allclose(np.degrees([first.rmse.low, first.rmse.value, first.rmse.high]), 0.5)
    assert all(one.difference is None for one in compare([yard, half], None))
    short = Errors("short", half.error[:10], stamps[:10])
    assert [one.difference for one in compare([yard, Errors("x", yard.error[:9], stamps[:9]), short], "yard")] == [
        None
    ] * 2
