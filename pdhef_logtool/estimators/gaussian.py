"""Covariance of a Kalman filter in plain loops: prediction by a Jacobian, and update by one scalar measurement.

NumPy's products would load SciPy's BLAS.
"""

import numpy as np

from pdhef_logtool.compiled.cache import njit


@njit(cache=True)
def dot(a, b):  # type: ignore[no-untyped-def]
    """Return the product of two vectors."""
    total = 0.0
    for i in range(a.shape[0]):
        total += a[i] * b[i]
    return total


@njit(cache=True)
def times(a, b):  # type: ignore[no-untyped-def]
    """Return the product of a sparse and a dense matrix."""
    out = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for m in range(a.shape[1]):
            if a[i, m] != 0.0:
                for j in range(b.shape[1]):
                    out[i, j] += a[i, m] * b[m, j]
    return out


@njit(cache=True)
def propagate(p, f):  # type: ignore[no-untyped-def]
    """Replace a covariance [n, n] by F P Fᵀ."""
    p[:, :] = times(f, times(f, p).T.copy())


@njit(cache=True)
def correct(x, p, h, residual, variance):  # type: ignore[no-untyped-def]
    """Update state and covariance in place with a scalar measurement of Jacobian h [n]."""
    ph = np.empty_like(h)
    for i in range(h.shape[0]):
        ph[i] = dot(p[i], h)
    s = dot(h, ph) + variance
    for i in range(x.shape[0]):
        x[i] += ph[i] / s * residual
        for j in range(x.shape[0]):
            p[i, j] -= ph[i] * ph[j] / s


@njit(cache=True)
def update(x, p, h, z, variance):  # type: ignore[no-untyped-def]
    """Update state and covariance in place with a measurement z = h x."""
    correct(x, p, h, z - dot(h, x), variance)
