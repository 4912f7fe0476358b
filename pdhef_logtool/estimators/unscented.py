"""The scaled unscented transform and the Kalman update on it, compiled (Wan & van der Merwe 2000).

See docs/method.md#filter.

All functions operate on small float64 arrays, avoid allocation in inner loops, and contain no vehicle model.
"""

from __future__ import annotations

import math

import numpy as np

from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.records.signals import FloatArray

#: Smallest variance on the diagonal of a repaired covariance.
COVARIANCE_FLOOR = 1e-12


def unscented_weights(n: int, alpha: float = 1.0, beta: float = 2.0, kappa: float = 0.0) -> tuple[FloatArray, ...]:
    """Return mean weights [2n+1], covariance weights [2n+1] and [1] the scale c with χ = x ± columns of √(c P).

    The defaults give a centre weight of 0 for the mean and no negative weight, so that a weighted covariance is
    never indefinite.
    """
    lam = alpha**2 * (n + kappa) - n
    wm = np.full(2 * n + 1, 0.5 / (n + lam))
    wc = wm.copy()
    wm[0] = lam / (n + lam)
    wc[0] = wm[0] + 1.0 - alpha**2 + beta
    return wm, wc, np.array([n + lam])


@njit(cache=True)
def cholesky_lower(P, L):  # type: ignore[no-untyped-def]
    """Write the lower Cholesky factor of P [n, n] to L; return False where P is not positive definite."""
    n = P.shape[0]
    for i in range(n):
        for j in range(i + 1):
            s = P[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                if not s > 0.0:
                    return False
                L[i, i] = math.sqrt(s)
            else:
                L[i, j] = s / L[j, j]
        for j in range(i + 1, n):
            L[i, j] = 0.0
    return True


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


@njit(cache=True)
def _partial_root(P, there, L):  # type: ignore[no-untyped-def]
    """Write the lower Cholesky factor of the entries of P [n, n] that are ``there`` [n]; the others get zeros.

    Returns False where these entries are not positive definite. L is zero above its diagonal and stays so.
    """
    n = P.shape[0]
    for j in range(n):
        if not there[j]:
            L[j:, j] = 0.0
            continue
        s = P[j, j]
        for k in range(j):
            s -= L[j, k] * L[j, k]
        if not s > 0.0:
            return False
        L[j, j] = math.sqrt(s)
        per_root = 1.0 / L[j, j]
        for i in range(j + 1, n):
            s = P[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            L[i, j] = s * per_root
    return True


@njit(cache=True)
def partial_root(P, places, there, L):  # type: ignore[no-untyped-def]
    """Write the factor as :func:`_partial_root`; P is repaired in ``places`` if needed."""
    if _partial_root(P, there, L):
        return
    n = places.shape[0]
    dense = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            dense[i, j] = P[places[i], places[j]]
    repair_covariance(dense)
    for i in range(n):
        for j in range(n):
            P[places[i], places[j]] = dense[i, j]
    _partial_root(P, there, L)


@njit(cache=True)
def covariance_root(P, L):  # type: ignore[no-untyped-def]
    """Write the lower Cholesky factor of P [n, n] to L; P is repaired if needed."""
    if not cholesky_lower(P, L):
        repair_covariance(P)
        cholesky_lower(P, L)


@njit(cache=True)
def draw_sigma_points(x, P, scale, L, chi):  # type: ignore[no-untyped-def]
    """Write the 2n+1 sigma points of (x, P) to chi [2n+1, n]; L [n, n] is work space. P is repaired if needed."""
    n = x.shape[0]
    covariance_root(P, L)
    root = math.sqrt(scale)
    for j in range(n):
        chi[0, j] = x[j]
    for i in range(n):
        for j in range(n):
            d = root * L[j, i]
            chi[1 + i, j] = x[j] + d
            chi[1 + n + i, j] = x[j] - d


@njit(cache=True)
def mean_and_covariance(chi, wm, wc, x, P):  # type: ignore[no-untyped-def]
    """Write the weighted mean and covariance of chi [s, n] to x [n] and P [n, n]."""
    s, n = chi.shape
    for j in range(n):
        m = 0.0
        for i in range(s):
            m += wm[i] * chi[i, j]
        x[j] = m
    for a in range(n):
        for b in range(a + 1):
            c = 0.0
            for i in range(s):
                c += wc[i] * (chi[i, a] - x[a]) * (chi[i, b] - x[b])
            P[a, b] = c
            P[b, a] = c


@njit(cache=True)
def innovation_moments(chi, x, zeta, wm, wc, z_hat, S, Pxz):  # type: ignore[no-untyped-def]
    """Write predicted measurement [m], its covariance without R [m, m] and the cross covariance [n, m].

    chi [s, n] are the sigma points of mean x, zeta [s, m] their measurements.
    """
    s, n = chi.shape
    m = zeta.shape[1]
    mean_and_covariance(zeta, wm, wc, z_hat, S)
    for k in range(m):
        for a in range(n):
            c = 0.0
            for i in range(s):
                c += wc[i] * (chi[i, a] - x[a]) * (zeta[i, k] - z_hat[k])
            Pxz[a, k] = c


@njit(cache=True)
def _factor_used(S, index, used, L):  # type: ignore[no-untyped-def]
    """Factor as :func:`cholesky_lower` the first ``used`` rows and columns of S that ``index`` names."""
    for i in range(used):
        for j in range(i + 1):
            s = S[index[i], index[j]]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                if not s > 0.0:
                    return False
                L[i, i] = math.sqrt(s)
            else:
                L[i, j] = s / L[j, j]
    return True


@njit(cache=True)
def whiten(nu, S, use, index, L, w):  # type: ignore[no-untyped-def]
    """Whiten the innovation nu [m], of covariance S [m, m], in the channels of ``use`` (bool [m]).

    Writes which channels are used to ``index`` [m], and in their order the factor of their covariance to L [m, m] and
    w = L⁻¹ν [m]. Returns the results of :func:`kalman_update`.
    """
    used = 0
    for k in range(nu.shape[0]):
        if use[k]:
            index[used] = k
            used += 1
    if used == 0:
        return 0.0, 0, 0.0
    if not _factor_used(S, index, used, L):
        A = np.empty((used, used))
        for i in range(used):
            for j in range(used):
                A[i, j] = S[index[i], index[j]]
        repair_covariance(A)
        _factor_used(A, np.arange(used), used, L)
    det, nis = 1.0, 0.0
    for i in range(used):
        s = nu[index[i]]
        for j in range(i):
            s -= L[i, j] * w[j]
        w[i] = s / L[i, i]
        nis += w[i] * w[i]
        det *= L[i, i]
    return nis, used, -0.5 * (nis + used * math.log(2.0 * math.pi)) - math.log(det)


@njit(cache=True)
def kalman_update(x, P, nu, S, Pxz, use):  # type: ignore[no-untyped-def]
    """Update x [n], P [n, n] in place with the channels of ``use`` (bool [m]).

    nu [m] is the innovation, S [m, m] its covariance with R. P −= K S Kᵀ = (P_xz L⁻ᵀ)(P_xz L⁻ᵀ)ᵀ with S = L Lᵀ: a
    symmetric form; if rounding makes it indefinite it is repaired.

    Returns
    -------
    nis : νᵀ S⁻¹ ν over the used channels. dof : how many. log_likelihood : of the innovation, Gaussian.
    """
    n, m = Pxz.shape
    work = np.empty((n + m + 1, m))  # one allocation, as it takes longer than the computation
    G, L, w = work[:n], work[n : n + m], work[n + m]
    index = np.empty(m, dtype=np.int64)
    nis, d, log_likelihood = whiten(nu, S, use, index, L, w)
    if d == 0:
        return nis, d, log_likelihood
    for a in range(n):  # G = P_xz L⁻ᵀ, by forward substitution
        for i in range(d):
            s = Pxz[a, index[i]]
            for j in range(i):
                s -= L[i, j] * G[a, j]
            G[a, i] = s / L[i, i]
    for a in range(n):
        for i in range(d):
            x[a] += G[a, i] * w[i]
        for b in range(a + 1):
            s = P[a, b]
            for i in range(d):
                s -= G[a, i] * G[b, i]
            P[a, b] = s
            P[b, a] = s
    check = np.empty((n, n))
    if not cholesky_lower(P, check):
        repair_covariance(P)
    return nis, d, log_likelihood
