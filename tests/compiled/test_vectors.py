"""Compiled vectors against their plain reference: every function, and the parts of the filter made of them."""

from __future__ import annotations

import inspect
from types import ModuleType
from typing import Any

import numpy as np
import plain_vectors
import pytest

from pdhef_logtool.compiled import vectors
from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.estimators import physics_filter

LANES, ROOM, MOST = vectors.LANES, vectors.ROOM, vectors.MOST
WIDTH, OTHERS = 2 * LANES, 5


def arithmetic(v: ModuleType) -> Any:
    load, store, spread, total = v.load, v.store, v.spread, v.total

    def kernel(a, b, out):  # type: ignore[no-untyped-def]
        x, y = load(a, 1), load(b, 0)
        store(out, LANES, (x + y) * (x - spread(3.0)) / y)
        out[0] = total(x)

    return kernel


def products(v: ModuleType) -> Any:
    load, store, first_half_twice, inner_products = v.load, v.store, v.first_half_twice, v.inner_products

    def kernel(rows, _, out):  # type: ignore[no-untyped-def]
        store(out, 0, inner_products(rows, WIDTH, 2 * WIDTH, WIDTH, OTHERS))
        store(out, LANES, first_half_twice(load(rows, 0)))

    return kernel


@pytest.mark.parametrize("make", [arithmetic, products])
def test_every_operation_is_that_of_the_reference(make: Any) -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(6, WIDTH)), rng.uniform(1.0, 2.0, LANES)
    ours, plain = np.full(3 * LANES, 7.0), np.full(3 * LANES, 7.0)
    njit(make(vectors))(a, b, ours)
    make(plain_vectors)(a, b, plain)
    np.testing.assert_allclose(ours, plain, rtol=1e-13)


@njit
def _factor(P, there, L):  # type: ignore[no-untyped-def]
    return vectors.factor(P, there, L)


@pytest.mark.parametrize("lacking", [(), (3,), (0, 6, 12), tuple(range(4, 13))])
def test_the_factor_is_that_of_the_reference(lacking: tuple[int, ...]) -> None:
    there = np.zeros(ROOM, np.bool_)
    there[:MOST] = True
    there[list(lacking)] = False
    a = np.random.default_rng(1).normal(size=(ROOM, ROOM)) * there * there[:, None]
    P, ours, plain = a @ a.T + 0.1 * np.diag(there), np.zeros((ROOM, ROOM)), np.zeros((ROOM, ROOM))
    assert _factor(P, there, ours) and plain_vectors.factor(P, there, plain)
    np.testing.assert_allclose(ours[:MOST, :MOST], plain[:MOST, :MOST], rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose((ours @ ours.T)[:MOST, :MOST], P[:MOST, :MOST], rtol=1e-11, atol=1e-13)
    P[1, 1] = -1.0
    assert not _factor(P, there, ours)
    assert not plain_vectors.factor(P, there, plain)


def test_both_have_the_same_interface() -> None:
    names = {n for n, f in vars(plain_vectors).items() if inspect.isfunction(f) or n in ("LANES", "ROOM", "MOST")}
    public = {n for n in names if hasattr(vectors, n)}
    assert names == public
    assert (plain_vectors.LANES, plain_vectors.ROOM, plain_vectors.MOST) == (LANES, ROOM, MOST)


def moved(v: ModuleType, x: np.ndarray, P: np.ndarray, there: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Draw sigma points of a state, and take mean and covariance of them again with the parts of the filter."""
    f = physics_filter
    points, L, scale = np.zeros(f.PLACES * f.WIDTH), np.zeros((ROOM, ROOM)), 13.0
    constants, q, x, P = f._make_constants(), np.full(ROOM, 0.01), x.copy(), P.copy()
    assert v.factor(P, there, L)
    draw, moments = (getattr(part, "py_func", part) for part in (f._draw, f._moments))
    draw(x, L, scale, constants, points)
    points[f.VY * f.WIDTH : (f.VY + 1) * f.WIDTH] *= 1.1
    moments(points, scale, q, constants, x, P, True)
    return x, P


def test_a_part_of_the_filter_is_what_its_equations_say(monkeypatch: pytest.MonkeyPatch) -> None:
    """The sigma points of the filter, run in plain Python on the reference: mean and covariance of a linear map."""
    there = np.zeros(ROOM, np.bool_)
    there[: physics_filter.PLACES] = True
    a = np.random.default_rng(2).normal(size=(ROOM, ROOM)) * there * there[:, None]
    x, P = np.random.default_rng(3).normal(size=ROOM) * there, a @ a.T + 0.1 * np.diag(there)
    for name in ("load", "store", "spread", "first_half_twice", "total", "inner_products"):
        monkeypatch.setattr(physics_filter, name, getattr(plain_vectors, name))
    mean, covariance = moved(plain_vectors, x, P, there)
    linear = np.eye(ROOM)
    linear[physics_filter.VY, physics_filter.VY] = 1.1
    n = physics_filter.AY_BIAS
    np.testing.assert_allclose(mean[:n], (linear @ x)[:n], rtol=1e-12, atol=1e-12)
    expected = linear @ P @ linear.T + 0.01 * np.eye(ROOM)
    np.testing.assert_allclose(covariance[:n, :n], expected[:n, :n], rtol=1e-10, atol=1e-10)


@njit
def _aligned(size):  # type: ignore[no-untyped-def]
    return vectors.aligned(size)


def test_work_space_begins_with_a_line_of_the_cache() -> None:
    kept = [_aligned(size) for size in range(1, 40)]
    assert [(len(a), a.ctypes.data % 64) for a in kept] == [(size, 0) for size in range(1, 40)]
