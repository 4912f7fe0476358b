"""Rauch–Tung–Striebel smoother over the forward pass of any Gaussian filter (Rauch, Tung and Striebel 1965).

The forward pass provides for each step k

- x_k, P_k: state [n] and covariance [n, n] after the measurements of step k,
- x⁻_k, P⁻_k: their prediction from step k − 1,
- C_k = Cov(x_{k−1}, x⁻_k) [n, n]: P_{k−1} Fᵀ of a linear model, or the cross covariance of sigma points.

The backward pass corrects step k − 1 by the change of step k, with the gain G = C_k (P⁻_k)⁻¹:

    x^s_{k−1} = x_{k−1} + G (x^s_k − x⁻_k),   P^s_{k−1} = P_{k−1} + G (P^s_k − P⁻_k) Gᵀ.

C_k = 0 separates the steps before a restart from those after it. The predictions of step 0 are not used.
"""

import numpy as np

from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.estimators.gaussian import dot, times

#: Share of a variance below which the rest of it is rounding: the state depends linearly on the previous ones.
ROUNDING = 1e-14


@njit(cache=True)
def smooth_states(x, predicted_x, predicted_P, cross):  # type: ignore[no-untyped-def]
    """Return the smoothed states [K, n]."""
    smoothed = x.copy()
    L = np.empty_like(predicted_P[0])
    for k in range(x.shape[0] - 1, 0, -1):
        _factorize(predicted_P[k], L)
        change = smoothed[k] - predicted_x[k]
        _solve(L, change)
        for i in range(change.shape[0]):
            smoothed[k - 1, i] += dot(cross[k, i], change)
    return smoothed


@njit(cache=True)
def smooth_covariances(P, predicted_P, cross):  # type: ignore[no-untyped-def]
    """Return the smoothed covariances [K, n, n]."""
    smoothed = P.copy()
    L = np.empty_like(P[0])
    for k in range(P.shape[0] - 1, 0, -1):
        _factorize(predicted_P[k], L)
        gain = cross[k].copy()
        for i in range(gain.shape[0]):
            _solve(L, gain[i])
        smoothed[k - 1] += times(gain, times(smoothed[k] - predicted_P[k], gain.T.copy()))
    return smoothed


@njit(cache=True)
def _factorize(P, L):  # type: ignore[no-untyped-def]
    """Write the lower Cholesky factor of a covariance; a state without further variance has a column of zeros."""
    for i in range(P.shape[0]):
        for j in range(i + 1):
            rest = P[i, j]
            for m in range(j):
                rest -= L[i, m] * L[j, m]
            if i == j:
                L[i, i] = np.sqrt(rest) if rest > ROUNDING * P[i, i] else 0.0
            else:
                L[i, j] = rest / L[j, j] if L[j, j] > 0.0 else 0.0


@njit(cache=True)
def _solve(L, b):  # type: ignore[no-untyped-def]
    """Replace b [n] by (L Lᵀ)⁻¹ b."""
    n = b.shape[0]
    for i in range(n):
        for m in range(i):
            b[i] -= L[i, m] * b[m]
        b[i] = b[i] / L[i, i] if L[i, i] > 0.0 else 0.0
    for i in range(n - 1, -1, -1):
        b[i] = b[i] / L[i, i] if L[i, i] > 0.0 else 0.0
        for m in range(i):
            b[m] -= L[i, m] * b[i]
