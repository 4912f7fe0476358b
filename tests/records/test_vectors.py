"""Vectors of eight numbers, against numpy."""

from __future__ import annotations

import numpy as np

from pdhef_logtool.records.compiled import njit
from pdhef_logtool.records.vectors import (
    LANES,
    aligned,
    first_half_twice,
    inner_products,
    load,
    spread,
    store,
    total,
)

_WIDTH, _OTHERS = 2 * LANES, 5


@njit
def _all_of_it(a, b, out):
    x, y = load(a, 1), load(b, 0)
    store(out, LANES, (x + y) * (x - spread(3.0)) / y)
    return total(x)


@njit
def _products(rows, out):
    store(out, 0, inner_products(rows, _WIDTH, 2 * _WIDTH, _WIDTH, _OTHERS))
    store(out, LANES, first_half_twice(load(rows, 0)))


@njit
def _aligned(size):
    return aligned(size)


def test_every_operation_is_that_of_numpy():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(3, 3)), rng.uniform(1.0, 2.0, LANES)
    out = np.zeros(3 * LANES)
    x = a.ravel()[1:]
    assert np.isclose(_all_of_it(a, b, out), x.sum(), rtol=1e-14)
    np.testing.assert_allclose(out[LANES:-LANES], (x + b) * (x - 3.0) / b, rtol=1e-14)
    assert not out[:LANES].any()
    assert not out[-LANES:].any()


def test_products_of_rows_and_halves_are_those_of_numpy():
    rows, out = np.random.default_rng(1).normal(size=(6, _WIDTH)), np.full(2 * LANES, np.nan)
    _products(rows.ravel(), out)
    np.testing.assert_allclose(out[:_OTHERS], rows[1:] @ rows[2], rtol=1e-13)
    assert not out[_OTHERS:LANES].any()
    np.testing.assert_array_equal(out[LANES:], np.tile(rows[0, :4], 2))


def test_work_space_begins_with_a_line_of_the_cache():
    kept = [_aligned(size) for size in range(1, 40)]
    assert [(len(a), a.ctypes.data % 64) for a in kept] == [(size, 0) for size in range(1, 40)]
