"""Covariance of a Kalman filter in plain loops: prediction by a Jacobian, and update by one scalar measurement."""

from __future__ import annotations

import numpy as np

from pdhef_logtool.compiled.cache import njit


@njit(cache=True, error_model="numpy")
def propagate(cov, f):  # type: ignore[no-untyped-def]
    """Replace a covariance [n, n] by F P Fᵀ."""
    n = len(f)
    product = np.zeros((n, n))
    for i in range(n):
        for j in range(n):
            for k in range(n):
                product[i, j] += f[i, k] * cov[k, j]
    for i in range(n):
        for j in range(n):
            cov[i, j] = 0.0
            for k in range(n):
                cov[i, j] += product[i, k] * f[j, k]


@njit(cache=True, error_model="numpy")
def update(x, cov, h, z, variance):  # type: ignore[no-untyped-def]
    """Update mean [n] and covariance [n, n] in place by a measurement z = h x with noise; h [n]."""
    n = len(x)
    across = np.zeros(n)
    spread, innovation = variance, z
    for i in range(n):
        for j in range(n):
            across[i] += cov[i, j] * h[j]
        spread += h[i] * across[i]
        innovation -= h[i] * x[i]
    for i in range(n):
        x[i] += across[i] / spread * innovation
        for j in range(n):
            cov[i, j] -= across[i] * across[j] / spread
