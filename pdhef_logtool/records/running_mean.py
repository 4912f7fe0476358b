"""The running mean of columns."""

import numpy as np

from pdhef_logtool.records.signals import LEAST_DIVISOR, FloatArray


def running_mean(columns: FloatArray, half: int, weights: FloatArray | float = 1.0) -> FloatArray:
    """Return the mean of columns [N] or [N, c] over the finite rows up to ``half`` before and after each.

    ``weights`` of the rows [N]; if all are 0, the mean is 0.
    """
    rows, n = np.arange(len(columns)), len(columns)
    table = columns.reshape(n, -1)
    finite = np.asarray(np.isfinite(table).all(axis=1))
    weight = np.where(finite, weights, 0.0)[:, None]
    table = np.hstack([weight * np.where(finite[:, None], table, 0.0), weight])
    sums = np.concatenate([np.zeros((1, table.shape[1])), np.cumsum(table, axis=0)])
    around = sums[np.minimum(rows + half + 1, n)] - sums[np.maximum(rows - half, 0)]
    mean = around[:, :-1] / np.maximum(around[:, -1:], LEAST_DIVISOR)
    return np.asarray(mean.reshape(columns.shape), dtype=np.float64)
