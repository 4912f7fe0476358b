"""Cells of text columns: every cell is a number, empty or unreadable, in each spelling that recorders write."""

from __future__ import annotations

from collections.abc import Callable
from random import Random

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdhef_logtool.logs.table_cells import read_cells

EMPTY = [
    "", " ", "nan", "NaN", "-nan(ind)", "nan(snan)", "1.#QNAN", "-1.#IND00", "#N/A", "n/a", "NULL", "None", "-", "--",
]  # fmt: skip
UNREADABLE = [
    "ERR", "****", "inf", "-Infinity", "1.#INF", "12.5 km/h", "1e999", "12:00", "0x", "1,2,3", "e5", "+", "x y",
]  # fmt: skip


@pytest.mark.parametrize(
    ("texts", "numbers"),
    [
        (["1.5", "-2", "+.5", "3.", "1e-3", "2E+02"], [1.5, -2.0, 0.5, 3.0, 1e-3, 200.0]),
        (["0", "0", "-0,123", "1,5E-05"], [0.0, 0.0, -0.123, 1.5e-05]),
        (["8,734.5", "987.25", "12,000,000"], [8734.5, 987.25, 12e6]),
        (["8.734,5", "987,25", "1.234", "12.000.000"], [8734.5, 987.25, 1234.0, 12e6]),
        (["8 734,5", "8\u00a0734,5", "12\u202f345\u202f678,0", "7"], [8734.5, 8734.5, 12345678.0, 7.0]),
        (["8'734.5", "8’734.5", "0.5"], [8734.5, 8734.5, 0.5]),
        (["\u22121.5", "\u2212.5", "2"], [-1.5, -0.5, 2.0]),
        (["0x4f", "0X10", "7"], [79.0, 16.0, 7.0]),
        (["true", "False", "TRUE"], [1.0, 0.0, 1.0]),
        (["1.234", "0,5", "0,25"], [1234.0, 0.5, 0.25]),  # the column has decimal commas
        (["1.234", "10.5", "11.5", "0,25"], [1.234, 10.5, 11.5, 0.25]),
        (["1,234", "0.5"], [1234.0, 0.5]),
    ],
)
def test_a_number_in_any_spelling(texts: list[str], numbers: list[float]) -> None:
    cells = read_cells(pl.Series(texts))
    assert cells.values.tolist() == numbers
    assert (cells.empty, cells.unreadable, cells.ambiguous) == (0, 0, "")


_SPELLINGS: dict[str, Callable[[float], str]] = {
    "point": str,
    "comma": lambda v: str(v).replace(".", ","),
    "grouped": lambda v: f"{v:,.2f}",
    "grouped-comma": lambda v: f"{v:,.2f}".translate(str.maketrans(",.", ".,")),
    "spaced": lambda v: f"{v:,.2f}".replace(",", "\u202f"),
    "minus": lambda v: str(v).replace("-", "\u2212"),
    "exponent": lambda v: f"{v:.17E}",
}


@settings(max_examples=30, deadline=None)
@given(
    numbers=st.lists(st.floats(-1e9, 1e9).map(lambda v: round(v, 2)), min_size=1, max_size=20),
    spelling=st.sampled_from([*_SPELLINGS]),
    others=st.lists(st.sampled_from([*EMPTY, *UNREADABLE]) | st.text(max_size=6), max_size=10),
    order=st.randoms(use_true_random=False),
)
def test_cells_are_numbers_empty_and_unreadable(
    numbers: list[float], spelling: str, others: list[str], order: Random
) -> None:
    texts = [_SPELLINGS[spelling](v) for v in numbers]
    cells = read_cells(pl.Series(texts))
    if not cells.ambiguous:
        np.testing.assert_allclose(cells.values, numbers, rtol=1e-12)
    mixed = [*texts, *others]
    order.shuffle(mixed)
    cells = read_cells(pl.Series(mixed))
    assert np.isfinite(cells.values).sum() + cells.empty + cells.unreadable == len(mixed)
    assert np.isfinite(cells.values).sum() >= len(numbers)
    if cells.unreadable:
        assert cells.example in mixed[cells.row]
        assert np.isnan(cells.values[cells.row])
