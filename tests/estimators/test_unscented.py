"""The unscented transform against closed forms, filterpy, numpy and scipy."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import MerweScaledSigmaPoints
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from pdhef_logtool.estimators.unscented import (
    cholesky_lower,
    draw_sigma_points,
    innovation_moments,
    kalman_update,
    mean_and_covariance,
    repair_covariance,
    unscented_weights,
)

SEEDS = st.integers(0, 2**32 - 1)


def random_covariance(rng: np.random.Generator, n: int) -> np.ndarray:
    a = rng.standard_normal((n, n))
    scale = np.diag(10.0 ** rng.uniform(-2, 1, n))
    return scale @ (a @ a.T + 0.1 * np.eye(n)) @ scale


def sigma_points(x: np.ndarray, P: np.ndarray, scale: float) -> np.ndarray:
    chi = np.empty((2 * len(x) + 1, len(x)))
    draw_sigma_points(x, P, scale, np.empty_like(P), chi)
    return chi


@settings(derandomize=True, deadline=None, max_examples=60)
@given(
    SEEDS, st.integers(1, 6), st.integers(1, 4), st.sampled_from([(1.0, 2.0, 0.0), (0.5, 2.0, 1.0), (1.0, 0.0, 2.0)])
)
def test_linear_maps_are_exact(seed, n, m, spread):
    rng = np.random.default_rng(seed)
    x, P = rng.standard_normal(n), random_covariance(rng, n)
    A, b = rng.standard_normal((n, n)), rng.standard_normal(n)
    H = rng.standard_normal((m, n))
    wm, wc, scale = unscented_weights(n, *spread)
    chi = sigma_points(x, P.copy(), scale[0])

    moved = chi @ A.T + b
    mean, covariance = np.empty(n), np.empty((n, n))
    mean_and_covariance(moved, wm, wc, mean, covariance)
    size = np.abs(A @ P @ A.T).max()
    np.testing.assert_allclose(mean, A @ x + b, rtol=0, atol=1e-11 * (1 + np.sqrt(size)) * 10)
    np.testing.assert_allclose(covariance, A @ P @ A.T, rtol=0, atol=1e-11 * size)

    z_hat, S, Pxz = np.empty(m), np.empty((m, m)), np.empty((n, m))
    innovation_moments(chi, x, chi @ H.T, wm, wc, z_hat, S, Pxz)
    np.testing.assert_allclose(z_hat, H @ x, rtol=0, atol=1e-10 * (1 + np.sqrt(size)) * 10)
    np.testing.assert_allclose(S, H @ P @ H.T, rtol=0, atol=1e-10 * np.abs(H @ P @ H.T).max())
    np.testing.assert_allclose(Pxz, P @ H.T, rtol=0, atol=1e-10 * np.abs(P).max() * np.abs(H).max() * n)


def test_second_moment_of_a_square_is_exact():
    # E[x^2] = m^2 + p and, with beta = 2, Var[x^2] = 4 m^2 p + 2 p^2 of a Gaussian: n + lambda = 3 meets both.
    m, p = 0.7, 0.3
    wm, wc, scale = unscented_weights(1, 1.0, 0.0, 2.0)
    chi = sigma_points(np.array([m]), np.array([[p]]), scale[0])
    mean, covariance = np.empty(1), np.empty((1, 1))
    mean_and_covariance(chi**2, wm, wc, mean, covariance)
    assert mean[0] == pytest.approx(m**2 + p, rel=1e-13)
    assert covariance[0, 0] == pytest.approx(4 * m**2 * p + 2 * p**2, rel=1e-13)


@pytest.mark.parametrize("n", [1, 3, 4, 5])
@pytest.mark.parametrize("spread", [(1.0, 2.0, 0.0), (0.1, 2.0, -0.5), (1e-3, 2.0, 0.0), (0.7, 1.0, 1.0)])
def test_weights_and_points_agree_with_filterpy(n, spread):
    reference = MerweScaledSigmaPoints(n, *spread)
    wm, wc, scale = unscented_weights(n, *spread)
    np.testing.assert_allclose(wm, reference.Wm, rtol=1e-12)
    np.testing.assert_allclose(wc, reference.Wc, rtol=1e-12)
    rng = np.random.default_rng(n)
    x, P = rng.standard_normal(n), random_covariance(rng, n)
    np.testing.assert_allclose(sigma_points(x, P.copy(), scale[0]), reference.sigma_points(x, P), rtol=1e-9, atol=1e-12)


def test_default_weights_cannot_make_a_covariance_indefinite():
    for n in range(1, 8):
        wm, wc, _ = unscented_weights(n)
        assert wm.sum() == pytest.approx(1.0)
        assert (wc >= 0).all()


@settings(derandomize=True, deadline=None, max_examples=60)
@given(SEEDS, st.integers(1, 6))
def test_cholesky_agrees_with_numpy(seed, n):
    P = random_covariance(np.random.default_rng(seed), n)
    L = np.full((n, n), np.nan)
    assert cholesky_lower(P, L)
    np.testing.assert_allclose(L, np.linalg.cholesky(P), rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize(
    "P", [np.diag([1.0, -1.0]), np.array([[1.0, 2.0], [2.0, 1.0]]), np.zeros((2, 2)), np.full((2, 2), np.nan)]
)
def test_cholesky_refuses_what_is_not_positive_definite(P):
    assert not cholesky_lower(P, np.empty((2, 2)))


@settings(derandomize=True, deadline=None, max_examples=80)
@given(SEEDS, st.integers(2, 6), st.floats(-6, 6))
def test_repair_gives_the_nearest_positive_definite_matrix(seed, n, log_size):
    rng = np.random.default_rng(seed)
    broken = 10.0**log_size * rng.standard_normal((n, n))  # neither symmetric nor definite
    P = broken.copy()
    repair_covariance(P)
    np.testing.assert_allclose(P, P.T, rtol=0, atol=1e-14 * np.abs(P).max())
    assert cholesky_lower(P, np.empty((n, n)))
    # Higham 1988: the nearest positive semidefinite matrix clips the eigenvalues of the symmetric part.
    w, v = np.linalg.eigh(0.5 * (broken + broken.T))
    nearest = (v * np.maximum(w, 0.0)) @ v.T
    np.testing.assert_allclose(P, nearest, rtol=0, atol=1e-11 * np.abs(broken).max() + 1e-11)


@pytest.mark.parametrize("size", [np.inf, np.nan])
def test_repair_leaves_what_is_not_finite_to_the_filter(size):
    P = np.diag([size, 1.0])
    repair_covariance(P)
    assert not np.isfinite(P).all()


def test_repair_leaves_a_good_covariance_alone():
    P = random_covariance(np.random.default_rng(4), 4)
    repaired = P.copy()
    repair_covariance(repaired)
    np.testing.assert_allclose(repaired, P, rtol=1e-9, atol=1e-12)


def test_points_of_an_indefinite_covariance_are_those_of_its_repair():
    P = np.array([[1.0, 1.5, 0.0], [1.5, 1.0, 0.0], [0.0, 0.0, 1.0]])
    x = np.array([1.0, 2.0, 3.0])
    wm, wc, scale = unscented_weights(3)
    chi = sigma_points(x, P, scale[0])  # repairs P in place
    mean, covariance = np.empty(3), np.empty((3, 3))
    mean_and_covariance(chi, wm, wc, mean, covariance)
    np.testing.assert_allclose(covariance, P, atol=1e-12)
    assert P[0, 0] == pytest.approx(1.25)  # eigenvalues 2.5 and -0.5 -> 2.5 and 0


@settings(derandomize=True, deadline=None, max_examples=80)
@given(SEEDS, st.integers(2, 5), st.lists(st.booleans(), min_size=1, max_size=4))
def test_update_agrees_with_the_linear_kalman_filter(seed, n, use):
    rng = np.random.default_rng(seed)
    m, used = len(use), np.array(use)
    x, P = rng.standard_normal(n), random_covariance(rng, n)
    H, R, z = rng.standard_normal((m, n)), np.diag(rng.uniform(0.1, 2.0, m)), 3 * rng.standard_normal(m)
    nu = z - H @ x
    nu[~used] = np.nan  # a missing channel must not leak through its mask
    S = H @ P @ H.T + R
    x_new, P_new = x.copy(), P.copy()
    nis, dof, log_likelihood = kalman_update(x_new, P_new, nu, S, P @ H.T, used)

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


def test_update_keeps_a_covariance_definite_where_rounding_would_break_it():
    # A measurement 1e16 times better than the prior: P - K S K' is zero in one direction, to rounding.
    x, P = np.zeros(2), np.array([[1e8, 1e8 - 1.0], [1e8 - 1.0, 1e8]])
    H = np.array([[1.0, 0.0]])
    kalman_update(x, P, np.array([1.0]), H @ P @ H.T + 1e-10, P @ H.T, np.array([True]))
    assert np.linalg.eigvalsh(P).min() > 0
