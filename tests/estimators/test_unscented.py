"""The unscented transform and the Kalman update against closed forms, filterpy, numpy and scipy."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import MerweScaledSigmaPoints, unscented_transform
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from pdhef_logtool.estimators.unscented import (
    cholesky,
    cross_covariance,
    draw,
    moments,
    reading_moments,
    repair_covariance,
    update,
)
from pdhef_logtool.estimators.vehicle_model import PLACES, WIDTH

SEEDS = st.integers(0, 2**32 - 1)
random_cases = settings(derandomize=True, deadline=None, max_examples=60)


def random_covariance(rng: np.random.Generator, n: int) -> np.ndarray:
    a = rng.standard_normal((n, n))
    scale = np.diag(10.0 ** rng.uniform(-2, 1, n))
    return scale @ (a @ a.T + 0.1 * np.eye(n)) @ scale


def root_of(P: np.ndarray) -> np.ndarray:
    """Return the factor of P, which may be repaired."""
    L = np.zeros_like(P)
    cholesky(P, L)
    return L


@random_cases
@given(SEEDS, st.integers(1, PLACES), st.integers(1, 4))
def test_sigma_points_and_moments_agree_with_filterpy(seed: int, n: int, m: int) -> None:
    """With functions that are not linear, so that the centre has a part; the rows of a state are not adjacent."""
    rng = np.random.default_rng(seed)
    x, P, q = rng.standard_normal(n), random_covariance(rng, n), rng.uniform(0.0, 1.0, n)
    places, columns = np.sort(rng.permutation(PLACES)[:n]), (2 * n + 8) // 8 * 8
    A, H = rng.standard_normal((n, n)), rng.standard_normal((m, n))
    L, block = root_of(P), np.full((PLACES, WIDTH), np.nan)
    draw(x, L, places, columns, block.ravel())
    reference = MerweScaledSigmaPoints(n, alpha=1.0, beta=2.0, kappa=0.0)
    want = reference.sigma_points(x, P)
    chi = block[places][:, : 2 * n + 1].T
    np.testing.assert_allclose(chi, want, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(block[places][:, 2 * n + 1 : columns], np.tile(x[:, None], columns - 2 * n - 1))

    moved, scale = np.sin(want @ A.T) + want, 1.0 + np.abs(P).max()
    block[places, :columns] = np.sin(A @ block[places, :columns]) + block[places, :columns]
    mean, covariance, E, cross = np.empty(n), np.empty((n, n)), np.empty(n * WIDTH), np.empty((n, n))
    moments(block.ravel(), places, columns, q, mean, covariance, E)
    cross_covariance(L, E, cross)
    want_mean, want_covariance = unscented_transform(moved, reference.Wm, reference.Wc, np.diag(q))
    np.testing.assert_allclose(mean, want_mean, atol=1e-11 * scale)
    np.testing.assert_allclose(covariance, want_covariance, atol=1e-11 * scale)
    want_cross = (want - x).T @ np.diag(reference.Wc) @ (moved - want_mean)
    np.testing.assert_allclose(cross, want_cross, atol=1e-11 * scale)

    readings = np.full((m, WIDTH), np.nan)
    readings[:, : 2 * n + 1] = np.cos(want @ H.T).T
    readings[:, 2 * n + 1 : columns] = readings[:, :1]
    z_hat, S, Pxz = np.empty(m), np.empty((m, m)), np.empty((m, n))
    zeta = readings[:, : 2 * n + 1].T.copy()
    reading_moments(readings.ravel(), L, columns, z_hat, S, Pxz)
    want_z, want_S = unscented_transform(zeta, reference.Wm, reference.Wc)
    np.testing.assert_allclose(z_hat, want_z, atol=1e-12)
    np.testing.assert_allclose(S, want_S, atol=1e-12)
    np.testing.assert_allclose(Pxz.T, (want - x).T @ np.diag(reference.Wc) @ (zeta - want_z), atol=1e-12 * scale)


@random_cases
@given(SEEDS, st.integers(1, 6), st.integers(0, 5))
def test_the_root_is_that_of_numpy_and_zero_for_an_entry_without_variance(seed: int, n: int, known: int) -> None:
    P = random_covariance(np.random.default_rng(seed), n)
    np.testing.assert_allclose(root_of(P), np.linalg.cholesky(P), rtol=1e-8, atol=1e-12)
    P[known % n, :] = P[:, known % n] = 0.0
    L = root_of(P)
    assert not L[known % n].any() and not L[:, known % n].any()
    np.testing.assert_allclose(L @ L.T, P, rtol=1e-12, atol=1e-12 * np.abs(P).max())


@random_cases
@given(SEEDS, st.integers(2, 6), st.floats(-6, 6))
def test_repair_gives_the_nearest_positive_definite_matrix(seed: int, n: int, log_size: float) -> None:
    rng = np.random.default_rng(seed)
    broken = 10.0**log_size * rng.standard_normal((n, n))  # neither symmetric nor definite
    P = broken.copy()
    repair_covariance(P)
    np.testing.assert_allclose(P, P.T, rtol=0, atol=1e-14 * np.abs(P).max())
    assert (np.diag(root_of(P)) > 0.0).all()
    # Higham 1988: the nearest positive semidefinite matrix clips the eigenvalues of the symmetric part.
    w, v = np.linalg.eigh(0.5 * (broken + broken.T))
    nearest = (v * np.maximum(w, 0.0)) @ v.T
    np.testing.assert_allclose(P, nearest, rtol=0, atol=1e-11 * np.abs(broken).max() + 1e-11)


def test_the_root_of_an_indefinite_matrix_is_that_of_its_repair() -> None:
    P = np.array([[1.0, 1.5, 0.0], [1.5, 1.0, 0.0], [0.0, 0.0, 1.0]])
    L = root_of(P)
    np.testing.assert_allclose(L @ L.T, P, atol=1e-12)
    assert P[0, 0] == pytest.approx(1.25)  # eigenvalues 2.5 and -0.5 -> 2.5 and 0


@pytest.mark.parametrize("size", [np.inf, np.nan])
def test_repair_keeps_non_finite_values_for_the_filter(size: float) -> None:
    P = np.diag([size, 1.0])
    repair_covariance(P)
    assert not np.isfinite(P).all()


@random_cases
@given(SEEDS, st.integers(2, 5), st.lists(st.booleans(), min_size=1, max_size=4))
def test_update_agrees_with_the_linear_kalman_filter(seed: int, n: int, use: list[bool]) -> None:
    rng = np.random.default_rng(seed)
    m, used = len(use), np.array(use)
    x, P = rng.standard_normal(n), random_covariance(rng, n)
    H, R, z = rng.standard_normal((m, n)), np.diag(rng.uniform(0.1, 2.0, m)), 3 * rng.standard_normal(m)
    nu = z - H @ x
    nu[~used] = np.nan  # a missing channel must not leak through its mask
    S = H @ P @ H.T + R
    x_new, P_new = x.copy(), P.copy()
    nis, dof, log_likelihood = update(x_new, P_new, nu, S, H @ P, used)

    Hu, Su, nu_u = H[used], S[np.ix_(used, used)], nu[used]
    if not used.any():
        assert (nis, dof, log_likelihood) == (0.0, 0, 0.0)
        np.testing.assert_array_equal(x_new, x)
        np.testing.assert_array_equal(P_new, P)
        return
    K = P @ Hu.T @ np.linalg.inv(Su)
    identity = np.eye(n)
    joseph = (identity - K @ Hu) @ P @ (identity - K @ Hu).T + K @ R[np.ix_(used, used)] @ K.T
    np.testing.assert_allclose(x_new, x + K @ nu_u, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(P_new, joseph, rtol=0, atol=1e-10 * np.abs(P).max())
    np.testing.assert_array_equal(P_new, P_new.T)
    assert dof == used.sum()
    assert nis == pytest.approx(nu_u @ np.linalg.solve(Su, nu_u), rel=1e-9)
    assert log_likelihood == pytest.approx(multivariate_normal(cov=Su).logpdf(nu_u), rel=1e-9, abs=1e-9)


def test_the_root_after_an_update_that_rounds_to_zero_is_definite() -> None:
    # A measurement 1e16 times better than the prior: P - K S K' is zero in one direction, to rounding.
    x, P = np.zeros(2), np.array([[1e8, 1e8 - 1.0], [1e8 - 1.0, 1e8]])
    H = np.array([[1.0, 0.0]])
    update(x, P, np.array([1.0]), H @ P @ H.T + 1e-10, H @ P, np.array([True]))
    L = root_of(P)
    assert np.isfinite(L).all() and (np.diag(L) >= 0.0).all()
    np.testing.assert_allclose(L @ L.T, P, atol=1e-4)
