"""The scaled unscented transform and the Kalman update, compiled (Wan and van der Merwe 2000), without a model.

Sigma points are the columns of a block [rows · WIDTH], in which the entries of a state have the rows ``places``: the
centre, x ± each row of √n R with P = Rᵀ R, and copies of the centre up to whole vectors. With n = x.size and α = 1,
β = 2, κ = 0 a point has the weight w = 1/(2 n), and the centre 0 in the mean and 2 in the covariance. With the
deviations e of the points from the centre and their weighted sum δ, which is the change of the mean, the covariance is

    2 δ δᵀ + w Σ (e − δ)(e − δ)ᵀ = w Σ e eᵀ + δ δᵀ,

in which the centre's column has δ / √w.

The last n − m entries of a state are constants on which the model does not depend: the points along the rows that
they have alone are at the centre in all other entries, and a block has the first m rows of R only.

Covariances and roots may have further columns up to whole vectors (:func:`padded`), which are zero.
"""

import math

import numpy as np

from pdhef_logtool.compiled.cache import inline, kernel, njit
from pdhef_logtool.estimators.vehicle_model import LANES, PLACES, WIDTH, columns_of
from pdhef_logtool.records.signals import FloatArray

#: Smallest variance on the diagonal of a repaired covariance.
COVARIANCE_FLOOR = 1e-12

# Sums in any order, so that the compiler can take several terms at a time.
_sum = njit(forceinline=True, error_model="numpy", fastmath={"contract", "reassoc"}, _nrt=False)


def padded(rows: int, n: int) -> FloatArray:
    """Return zeros [rows, n] with columns up to whole vectors, which the compiler processes without a remainder."""
    return np.zeros((rows, (n + LANES - 1) // LANES * LANES))


def block(n: int) -> tuple[FloatArray, FloatArray]:
    """Return an empty block of sigma points, and the array of their deviations after a model."""
    return np.zeros(PLACES * WIDTH), np.zeros((padded(n, n).shape[1], WIDTH))


@inline
def _factor(P, root):  # type: ignore[no-untyped-def]
    # Gaussian elimination leaves R times the roots of the pivots; whole rows are faster than those from the diagonal.
    n, positive = P.shape[0], True
    for i in range(n):
        for j in range(root.shape[1]):
            root[i, j] = P[i, j]
    for k in range(n):
        pivot = root[k, k]
        positive = positive and (pivot > 0.0 or P[k, k] == 0.0)
        per_pivot = 1.0 / pivot if pivot > 0.0 else 0.0  # 0: the entry is known
        for i in range(k + 1, n):
            factor = root[k, i] * per_pivot
            for j in range(root.shape[1]):
                root[i, j] -= factor * root[k, j]
        per_root = math.sqrt(per_pivot)
        for j in range(root.shape[1]):
            root[k, j] *= per_root
    return positive


@kernel
def cholesky(P, root):  # type: ignore[no-untyped-def]
    """Write the upper Cholesky factor R of P = Rᵀ R [n, n] to ``root``; P is repaired if needed.

    An entry without variance has a row of zeros. Below the diagonal are remainders without meaning.
    """
    if not _factor(P, root):
        repair_covariance(P)
        _factor(P, root)


@njit(cache=True, _nrt=True)
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
    w, v = np.linalg.eigh(P[:, :n].copy())
    floor = max(COVARIANCE_FLOOR, 1e-13 * max(w[n - 1], 0.0))
    for i in range(n):
        for j in range(n):
            s = 0.0
            for k in range(n):
                s += v[i, k] * max(w[k], floor) * v[j, k]
            P[i, j] = s


@kernel
def draw(x, root, places, m, points):  # type: ignore[no-untyped-def]
    """Write the sigma points of the state x [n] with the root [n, n] of its covariance to a block.

    Returns
    -------
    columns : of the block, up to whole vectors.
    """
    spread, columns = math.sqrt(x.shape[0]), columns_of(2 * m)
    for j in range(x.shape[0]):
        first, centre = places[j] * WIDTH, x[j]
        for i in range(columns):
            points[first + i] = centre
        for i in range(min(j + 1, m)):
            away = spread * root[i, j]
            points[first + 1 + 2 * i] = centre + away
            points[first + 2 + 2 * i] = centre - away
    return columns


@_sum
def _deviate(points, first, columns, n, away, row):  # type: ignore[no-untyped-def]
    """Write the deviations of points from their centre to a row, and there √w times their sum; return the mean."""
    centre, moved = points[first], 0.0
    for i in range(columns):
        away[row, i] = points[first + i] - centre
    for i in range(columns):
        moved += away[row, i]
    away[row, 0] = math.sqrt(0.5 / n) * moved
    return centre + 0.5 / n * moved


@_sum
def _products(away, a, b, weight):  # type: ignore[no-untyped-def]
    """Return the weighted scalar products of row a with the four rows from b on."""
    s_0 = s_1 = s_2 = s_3 = 0.0
    for i in range(WIDTH):
        s_0 += away[a, i] * away[b, i]
        s_1 += away[a, i] * away[b + 1, i]
        s_2 += away[a, i] * away[b + 2, i]
        s_3 += away[a, i] * away[b + 3, i]
    return weight * s_0, weight * s_1, weight * s_2, weight * s_3


@inline
def _covariance(root, a, m, away, row):  # type: ignore[no-untyped-def]
    """Return the covariance of state entry a before the model with a result after it, of deviations in a ``row``."""
    s = 0.0
    for i in range(min(a + 1, m)):
        s += root[i, a] * (away[row, 1 + 2 * i] - away[row, 2 + 2 * i])
    return 0.5 / math.sqrt(root.shape[0]) * s


@kernel
def moments(points, places, m, q, x, P, away, count):  # type: ignore[no-untyped-def]
    """Write mean [n] and covariance [n, n] of sigma points, with ``q`` [n] added to the variances.

    ``away`` [n, WIDTH] are the deviations of the points, with rows of zeros up to whole vectors. ``count``: only the
    covariance of the first entries is needed.
    """
    n, columns = x.shape[0], columns_of(2 * m)
    for j in range(n):
        x[j] = _deviate(points, places[j] * WIDTH, columns, n, away, j)
    for a in range(min(m, count)):
        for b in range(a // LANES * LANES, P.shape[1], LANES):
            P[a, b], P[a, b + 1], P[a, b + 2], P[a, b + 3] = _products(away, a, b, 0.5 / n)
    for a in range(count):
        for b in range(min(a, m)):
            P[a, b] = P[b, a]
        P[a, a] += q[a]


@kernel
def reading_moments(reading, root, m, away, Pxz, row):  # type: ignore[no-untyped-def]
    """Write a row of P_xz, the covariance of a reading [WIDTH] of sigma points; return its mean and variance.

    The first row of ``away`` is overwritten by the deviations.
    """
    n, s = root.shape[0], 0.0
    mean = _deviate(reading, 0, columns_of(2 * m), n, away, 0)
    for i in range(2 * m + 1):
        s += away[0, i] * away[0, i]
    for a in range(n):
        Pxz[row, a] = _covariance(root, a, m, away, 0)
    return mean, 0.5 / n * s


@kernel
def cross_covariance(root, m, away, out, k):  # type: ignore[no-untyped-def]
    """Write covariance k [n, n] of the state before a step, with the root, and after it, with its deviations."""
    n = root.shape[0]
    for a in range(n):
        for b in range(n):
            out[k, a, b] = _covariance(root, a, m, away, b)
            for i in range(m, min(a, b) + 1):
                out[k, a, b] += root[i, a] * root[i, b]


@kernel
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
        for j in range(i):
            for a in range(P.shape[1]):
                Pxz[i, a] -= S[i, j] * Pxz[j, a]
        for a in range(P.shape[1]):
            Pxz[i, a] *= per_root
        for a in range(n):
            x[a] += nu[i] * Pxz[i, a]
        for a in range(n if use[i] else 0):
            gain = Pxz[i, a]
            for b in range(P.shape[1]):
                P[a, b] -= gain * Pxz[i, b]
    return nis, used, -0.5 * (nis + used * math.log(2.0 * math.pi)) - math.log(det)


@inline
def is_finite(x, P):  # type: ignore[no-untyped-def]
    """Return whether state and variances are numbers; so are all covariances then."""
    total = 0.0
    for i in range(x.shape[0]):
        total += abs(x[i]) + abs(P[i, i])
    return math.isfinite(total)


@inline
def keep_state(x, out, k):  # type: ignore[no-untyped-def]
    """Write a state [n] to row k of an output."""
    for a in range(x.shape[0]):
        out[k, a] = x[a]
