"""The interface of :mod:`pdhef_logtool.compiled.vectors` in plain NumPy: the reference for its compiled functions."""

from __future__ import annotations

import numpy as np

LANES = 8
ROOM, MOST = 2 * LANES, 13


def load(array: np.ndarray, at: int) -> np.ndarray:
    return array.reshape(-1)[at : at + LANES].copy()


def store(array: np.ndarray, at: int, vector: np.ndarray) -> None:
    array.reshape(-1)[at : at + LANES] = vector


def spread(number: float) -> np.ndarray:
    return np.full(LANES, number)


def first_half_twice(vector: np.ndarray) -> np.ndarray:
    return np.tile(vector[: LANES // 2], 2)


def total(vector: np.ndarray) -> float:
    return float(vector.sum())


def inner_products(rows: np.ndarray, width: int, at: int, to: int, count: int) -> np.ndarray:
    flat = rows.reshape(-1)
    products = np.zeros(LANES)
    products[:count] = flat[to : to + count * width].reshape(count, width) @ flat[at : at + width]
    return products


def factor(P: np.ndarray, there: np.ndarray, L: np.ndarray) -> bool:
    entries = np.flatnonzero(there[:MOST])
    try:
        root = np.linalg.cholesky(P[np.ix_(entries, entries)])
    except np.linalg.LinAlgError:
        return False
    L[:MOST] = 0.0
    L[np.ix_(entries, entries)] = root
    return True


def aligned(size: int) -> np.ndarray:
    return np.zeros(size)
