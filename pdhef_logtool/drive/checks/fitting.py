"""Regression of a column on others, with errors that count independent samples."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pdhef_logtool.drive.columns import independent_samples
from pdhef_logtool.records.signals import BoolArray, FloatArray

#: A figure of a fit counts from this many standard errors on.
SURE = 4.0


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
    return coefficients, np.sqrt(np.diag(covariance)), spread
