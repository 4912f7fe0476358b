"""Regression of a column on others, with errors that count independent samples."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from pdhef_logtool.drive.columns import independent_samples, student
from pdhef_logtool.records.signals import BoolArray, FloatArray

#: Blocks of a drive that errors are estimated from; fewer give no information on them.
LEAST_BLOCKS, MOST_BLOCKS = 4, 10


def fit(
    measured: FloatArray, regressors: Sequence[FloatArray], use: BoolArray
) -> tuple[FloatArray, FloatArray, float] | None:
    """Regress a column on others where ``use`` and all are known.

    Returns
    -------
    coefficients, standard errors with the independent samples counted, and the residual's 1-sigma; None where there
    are too few, or where the regressors do not vary apart from one another.
    """
    matrix = np.stack(regressors, axis=1)
    usable = use & np.isfinite(measured) & np.isfinite(matrix).all(axis=1)
    samples = independent_samples(int(np.count_nonzero(usable)))
    if samples < 4.0 * len(regressors):
        return None
    a, b = matrix[usable], measured[usable]
    scale = np.linalg.norm(a, axis=0)
    if (scale <= 1e-12).any() or np.linalg.cond(a / scale) > 1e4:
        return None
    coefficients = np.linalg.lstsq(a / scale, b, rcond=None)[0] / scale
    spread = float(np.sqrt(np.mean((b - a @ coefficients) ** 2) * samples / (samples - len(regressors))))
    covariance = np.linalg.inv(a.T @ a / a.shape[0]) * spread**2 / samples
    errors = np.maximum(np.sqrt(np.diag(covariance)), _block_errors(a / scale, b, samples) / scale)
    return coefficients, errors, spread


def _block_errors(a: FloatArray, b: FloatArray, samples: float) -> FloatArray:
    """Return the jackknife's standard errors of a regression over blocks of the drive; 0 with too few samples.

    What is left is not noise: grade, crossfall, roll and sliding last as long as a bend does.
    """
    count = min(MOST_BLOCKS, int(samples // (2.0 * a.shape[1])))
    if count < LEAST_BLOCKS:
        return np.zeros(a.shape[1])
    edges = np.linspace(0, a.shape[0], count + 1).astype(int)
    squares = [a[i:j].T @ a[i:j] for i, j in pairwise(edges)]
    products = [a[i:j].T @ b[i:j] for i, j in pairwise(edges)]
    square, product = sum(squares), sum(products)
    without = [np.linalg.lstsq(square - s, product - p, rcond=None)[0] for s, p in zip(squares, products, strict=True)]
    return np.asarray(np.std(without, axis=0) * np.sqrt(count - 1.0) * student(count))
