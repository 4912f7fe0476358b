"""The scaled unscented transform and the Kalman update, compiled (Wan and van der Merwe 2000), without a model.

Sigma points are the columns of a block [rows · WIDTH], in which the entries of a state have the rows ``places``: the
centre, x + columns of √n L, x − columns of √n L, and copies of the centre up to whole vectors. With n = x.size and
α = 1, β = 2, κ = 0 a point has the weight w = 1/(2 n), and the centre 0 in the mean and 2 in the covariance. With the
deviations e of the points from the centre and their weighted sum δ, which is the change of the mean, the covariance is

    2 δ δᵀ + w Σ (e − δ)(e − δ)ᵀ = w Σ e eᵀ + δ δᵀ,

in which the centre's column has δ / √w.
"""

from __future__ import annotations

import math

import numpy as np

from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.estimators.vehicle_model import WIDTH

#: Smallest variance on the diagonal of a repaired covariance.
COVARIANCE_FLOOR = 1e-12

# Sums in any order, so that the compiler can take several terms at a time.
_compiled = njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})
_inline = njit(forceinline=True, error_model="numpy", fastmath={"contract", "reassoc"})


@_inline
def _factor(P, L):  # type: ignore[no-untyped-def]
    n = P.shape[0]
    for j in range(n):
        s = P[j, j]
        for k in range(j):
            s -= L[j, k] * L[j, k]
        if not s > 0.0:
            if P[j, j] != 0.0:
                return False
            L[j:, j] = 0.0  # the entry is known
            continue
        L[j, j] = math.sqrt(s)
        per_root = 1.0 / L[j, j]
        for i in range(j + 1, n):
            s = P[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            L[i, j] = s * per_root
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


@_compiled
def draw(x, L, places, columns, points):  # type: ignore[no-untyped-def]
    """Write the sigma points of the state x [n] with the root L [n, n] of its covariance to a block."""
    n = x.shape[0]
    root = math.sqrt(n)
    for j in range(n):
        row = places[j] * WIDTH
        for i in range(columns):
            points[row + i] = x[j]
        for i in range(j + 1):
            away = root * L[j, i]
            points[row + 1 + i] += away
            points[row + 1 + n + i] -= away


@_inline
def _products(a, row_a, b, row_b, columns):  # type: ignore[no-untyped-def]
    s = 0.0
    for i in range(columns):
        s += a[row_a + i] * b[row_b + i]
    return s


@_inline
def _deviate(block, row, columns, weight, out, first):  # type: ignore[no-untyped-def]
    """Write the deviations of a row of a block, with δ / √w in the centre's column; return the mean."""
    centre, moved = block[row], 0.0
    for i in range(columns):
        out[first + i] = block[row + i] - centre
        moved += out[first + i]
    out[first] = math.sqrt(weight) * moved
    return centre + weight * moved


@_compiled
def moments(points, places, columns, q, x, P, E):  # type: ignore[no-untyped-def]
    """Write mean [n] and covariance [n, n] of sigma points, with ``q`` [n] added to the variances; deviations to E."""
    n = x.shape[0]
    weight = 0.5 / n
    for j in range(n):
        x[j] = _deviate(points, places[j] * WIDTH, columns, weight, E, j * WIDTH)
    for a in range(n):
        for b in range(a + 1):
            P[a, b] = P[b, a] = weight * _products(E, a * WIDTH, E, b * WIDTH, columns)
        P[a, a] += q[a]


@_compiled
def reading_moments(readings, L, columns, z_hat, S, Pxz):  # type: ignore[no-untyped-def]
    """Write mean [m], covariance [m, m] and cross covariance [m, n] of the readings of sigma points with the root L.

    ``readings`` are replaced by their deviations.
    """
    n, m = L.shape[0], z_hat.shape[0]
    weight, root = 0.5 / n, math.sqrt(n)
    for k in range(m):
        z_hat[k] = _deviate(readings, k * WIDTH, columns, weight, readings, k * WIDTH)
        for b in range(k + 1):
            S[k, b] = S[b, k] = weight * _products(readings, k * WIDTH, readings, b * WIDTH, columns)
        for a in range(n):
            s = 0.0
            for i in range(a + 1):
                s += L[a, i] * (readings[k * WIDTH + 1 + i] - readings[k * WIDTH + 1 + n + i])
            Pxz[k, a] = weight * root * s


@_compiled
def cross_covariance(L, E, out):  # type: ignore[no-untyped-def]
    """Write the covariance [n, n] of the state before a step, with the root L, and after it, with deviations E."""
    n = L.shape[0]
    for a in range(n):
        for b in range(n):
            s = 0.0
            for i in range(a + 1):
                s += L[a, i] * (E[b * WIDTH + 1 + i] - E[b * WIDTH + 1 + n + i])
            out[a, b] = 0.5 / math.sqrt(n) * s


@_compiled
def update(x, P, nu, S, Pxz, use):  # type: ignore[no-untyped-def]
    """Update x [n], P [n, n] in place with the channels of ``use`` (bool [m]).

    ν [m] is the innovation, S [m, m] its covariance with R, P_xz [m, n]. With S = Λ Λᵀ and G = Λ⁻¹ P_xz, the gain is
    never formed: x += Gᵀ Λ⁻¹ ν, P −= Gᵀ G.

    Returns
    -------
    nis : νᵀ S⁻¹ ν over the used channels. dof : how many. log_likelihood : of the innovation, Gaussian.
    """
    n, m, used = x.shape[0], nu.shape[0], 0
    index, root, w, G = np.empty(m, np.int64), np.zeros((m, m)), np.empty(m), np.zeros((m, n))
    for k in range(m):
        if use[k]:
            index[used] = k
            used += 1
    if used == 0:
        return 0.0, 0, 0.0
    A = np.empty((used, used))
    for i in range(used):
        for j in range(used):
            A[i, j] = S[index[i], index[j]]
    cholesky(A, root[:used, :used])
    det, nis = 1.0, 0.0
    for i in range(used):
        w[i] = nu[index[i]]
        for j in range(i):
            w[i] -= root[i, j] * w[j]
        w[i] /= root[i, i]
        nis += w[i] * w[i]
        det *= root[i, i]
        for a in range(n):
            s = Pxz[index[i], a]
            for j in range(i):
                s -= root[i, j] * G[j, a]
            G[i, a] = s / root[i, i]
            x[a] += w[i] * G[i, a]
    for a in range(n):
        for b in range(a + 1):
            s = P[a, b]
            for i in range(used):
                s -= G[i, a] * G[i, b]
            P[a, b] = P[b, a] = s
    return nis, used, -0.5 * (nis + used * math.log(2.0 * math.pi)) - math.log(det)
