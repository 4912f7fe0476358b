"""The scaled unscented transform and the Kalman update, compiled (Wan and van der Merwe 2000), without a model.

Sigma points are the columns of a block [rows · WIDTH], in which the entries of a state have the rows ``places``: the
centre, x + columns of √n L, x − columns of √n L, and copies of the centre up to whole vectors. With n = x.size and
α = 1, β = 2, κ = 0 a point has the weight w = 1/(2 n), and the centre 0 in the mean and 2 in the covariance. With the
deviations e of the points from the centre and their weighted sum δ, which is the change of the mean, the covariance is

    2 δ δᵀ + w Σ (e − δ)(e − δ)ᵀ = w Σ e eᵀ + δ δᵀ,

in which the centre's column has δ / √w.

The last n − m entries of a state are constants on which the model does not depend: the points along the columns that
they have alone are at the centre in all other entries, and a block has the first m columns of L only.
"""

from __future__ import annotations

import math

import numpy as np

from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.estimators.vehicle_model import WIDTH

#: Smallest variance on the diagonal of a repaired covariance.
COVARIANCE_FLOOR = 1e-12

_compiled = njit(cache=True, error_model="numpy", fastmath={"contract"})
_inline = njit(forceinline=True, error_model="numpy", fastmath={"contract"})
# Sums in any order, so that the compiler can take several terms at a time.
_sum = njit(forceinline=True, error_model="numpy", fastmath={"contract", "reassoc"})


@_inline
def _factor(P, L):  # type: ignore[no-untyped-def]
    # First C with P = Σ_k c_k c_kᵀ / c_kk, and above its diagonal C over c_kk: to take all roots at the end is faster.
    n = P.shape[0]
    for j in range(n):
        for i in range(j, n):
            s = P[i, j]
            for k in range(j):
                s -= L[i, k] * L[k, j]
            L[i, j] = s
        if not L[j, j] > 0.0 and P[j, j] != 0.0:
            return False
        per = 1.0 / L[j, j] if L[j, j] > 0.0 else 0.0  # 0: the entry is known
        for i in range(j + 1, n):
            L[j, i] = L[i, j] * per
    for j in range(n):
        per_root = 1.0 / math.sqrt(L[j, j]) if L[j, j] > 0.0 else 0.0
        L[:j, j] = 0.0
        for i in range(j, n):
            L[i, j] *= per_root
    return True


@_compiled
def cholesky(P, L):  # type: ignore[no-untyped-def]
    """Write the lower Cholesky factor of P [n, n] to L, which is zero above its diagonal; P is repaired if needed.

    An entry without variance has a column of zeros.
    """
    if not _factor(P, L):
        repair_covariance(P)
        _factor(P, L)


@njit(cache=True)
def repair_covariance(P):  # type: ignore[no-untyped-def]
    """Make P [n, n] symmetric positive definite in place by raising eigenvalues to the floor.

    Non-finite values are kept; the filter detects them.
    """
    n = P.shape[0]
    for i in range(n):
        for j in range(i):
            m = 0.5 * (P[i, j] + P[j, i])
            P[i, j] = m
            P[j, i] = m
    if not math.isfinite(np.sum(P)):
        return
    w, v = np.linalg.eigh(P)
    floor = max(COVARIANCE_FLOOR, 1e-13 * max(w[n - 1], 0.0))
    for i in range(n):
        for j in range(n):
            s = 0.0
            for k in range(n):
                s += v[i, k] * max(w[k], floor) * v[j, k]
            P[i, j] = s


@_inline
def _row(block, places, j):  # type: ignore[no-untyped-def]
    return block[places[j] * WIDTH :]


@_compiled
def draw(x, L, places, m, points):  # type: ignore[no-untyped-def]
    """Write the sigma points of the state x [n] with the root L [n, n] of its covariance to a block."""
    root = math.sqrt(x.shape[0])
    for j in range(x.shape[0]):
        row = _row(points, places, j)
        for i in range(WIDTH):
            row[i] = x[j]
        for i in range(min(j + 1, m)):
            away = root * L[j, i]
            row[1 + i] = x[j] + away
            row[1 + m + i] = x[j] - away


@_sum
def _products(block, places, a, b):  # type: ignore[no-untyped-def]
    """Return the scalar products of row a with four rows from b on; beyond the last row, the last row again."""
    last, of_a = places.shape[0] - 1, _row(block, places, a)
    row_0, row_1 = _row(block, places, b), _row(block, places, min(b + 1, last))
    row_2, row_3 = _row(block, places, min(b + 2, last)), _row(block, places, min(b + 3, last))
    s_0 = s_1 = s_2 = s_3 = 0.0
    for i in range(WIDTH):
        s_0 += of_a[i] * row_0[i]
        s_1 += of_a[i] * row_1[i]
        s_2 += of_a[i] * row_2[i]
        s_3 += of_a[i] * row_3[i]
    return s_0, s_1, s_2, s_3


@_sum
def _deviate(row, m, n):  # type: ignore[no-untyped-def]
    """Replace a row by its deviations from the centre, the centre by √(0.5 / n) times their sum; return the mean."""
    centre, moved = row[0], 0.0
    for i in range(WIDTH):
        row[i] = row[i] - centre if i <= 2 * m else 0.0
        moved += row[i]
    row[0] = math.sqrt(0.5 / n) * moved
    return centre + 0.5 / n * moved


@_inline
def _covariance(L, a, row, m):  # type: ignore[no-untyped-def]
    """Return the covariance of state entry a before the model with a result after it, of deviations ``row``."""
    s = 0.0
    for i in range(min(a + 1, m)):
        s += L[a, i] * (row[1 + i] - row[1 + m + i])
    return 0.5 / math.sqrt(L.shape[0]) * s


@_compiled
def moments(points, places, m, q, x, P):  # type: ignore[no-untyped-def]
    """Write mean [n] and covariance [n, n] of sigma points, with ``q`` [n] added to the variances.

    The points are replaced by their deviations.
    """
    n = x.shape[0]
    for j in range(n):
        x[j] = _deviate(_row(points, places, j), m, n)
    for a in range(n):
        end = min(a + 1, m)
        for b in range(0, end, 4):
            sums = _products(points, places, a, b)
            for i in range(min(4, end - b)):
                P[a, b + i] = P[b + i, a] = 0.5 / n * sums[i]
        P[a, a] += q[a]


@_compiled
def reading_moments(reading, L, m, covariance):  # type: ignore[no-untyped-def]
    """Write the covariance [n] of a reading [WIDTH] of sigma points with the state; return its mean and variance.

    The reading is replaced by its deviations.
    """
    n, s = L.shape[0], 0.0
    mean = _deviate(reading, m, n)
    for i in range(2 * m + 1):
        s += reading[i] * reading[i]
    for a in range(n):
        covariance[a] = _covariance(L, a, reading, m)
    return mean, 0.5 / n * s


@_compiled
def cross_covariance(L, deviations, places, m, out):  # type: ignore[no-untyped-def]
    """Write the covariance [n, n] of the state before a step, with the root L, and after it, with its deviations."""
    n = L.shape[0]
    for a in range(n):
        for b in range(n):
            out[a, b] = _covariance(L, a, _row(deviations, places, b), m)
            for i in range(m, n):
                out[a, b] += L[a, i] * L[b, i]


@_compiled
def update(x, P, nu, S, Pxz, use):  # type: ignore[no-untyped-def]
    """Update x [n], P [n, n] in place with the channels of ``use`` (bool [m]).

    ν [m] is the innovation, S [m, m] (lower triangle) its covariance with R, P_xz [m, n]. With
    S = Λ Λᵀ and G = Λ⁻¹ P_xz, the gain is never formed: x += Gᵀ Λ⁻¹ ν, P −= Gᵀ G. Λ, Λ⁻¹ ν and G replace S, ν and P_xz.

    Returns
    -------
    nis : νᵀ S⁻¹ ν over the used channels. dof : how many. log_likelihood : of the innovation, Gaussian.
    """
    n, used, det, nis = x.shape[0], 0, 1.0, 0.0
    for i in range(nu.shape[0]):
        used += use[i]
        for j in range(i + 1):
            if not (use[i] and use[j]):  # a channel that is not used has no covariance with anything
                S[i, j] = 1.0 if i == j else 0.0
            for k in range(j):
                S[i, j] -= S[i, k] * S[j, k]
            S[i, j] = math.sqrt(S[i, i]) if i == j else S[i, j] / S[j, j]
        per_root = 1.0 / S[i, i] if use[i] else 0.0
        nu[i] = nu[i] if use[i] else 0.0
        for j in range(i):
            nu[i] -= S[i, j] * nu[j]
        nu[i] *= per_root
        nis += nu[i] * nu[i]
        det *= S[i, i]
        for a in range(n):
            s = Pxz[i, a]
            for j in range(i):
                s -= S[i, j] * Pxz[j, a]
            Pxz[i, a] = s * per_root
            x[a] += nu[i] * Pxz[i, a]
        for a in range(n if use[i] else 0):
            gain = Pxz[i, a]
            for b in range(n):
                P[a, b] -= gain * Pxz[i, b]
    return nis, used, -0.5 * (nis + used * math.log(2.0 * math.pi)) - math.log(det)
