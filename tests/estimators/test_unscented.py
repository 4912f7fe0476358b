"""Linear algebra of the filters against numpy; transform and update are in the filter that filterpy checks."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from pdhef_logtool.estimators import rts
from pdhef_logtool.estimators.unscented import cholesky, repair_covariance, update

SEEDS = st.integers(0, 2**32 - 1)
random_cases = settings(derandomize=True, deadline=None, max_examples=60)


def random_covariance(rng: np.random.Generator, n: int) -> np.ndarray:
    a = rng.standard_normal((n, n))
    scale = np.diag(10.0 ** rng.uniform(-2, 1, n))
    return scale @ (a @ a.T + 0.1 * np.eye(n)) @ scale


def root_of(P: np.ndarray) -> np.ndarray:
    """Return the factor of P, which may be repaired."""
    root = np.zeros_like(P)
    cholesky(P, root)
    return np.triu(root).T


@random_cases
@given(SEEDS, st.integers(1, 6), st.integers(0, 5))
def test_the_root_is_that_of_numpy_and_zero_for_an_entry_without_variance(seed, n, known):
    P = random_covariance(np.random.default_rng(seed), n)
    np.testing.assert_allclose(root_of(P), np.linalg.cholesky(P), rtol=1e-8, atol=1e-12)
    P[known % n, :] = P[:, known % n] = 0.0
    L = root_of(P)
    assert not L[known % n].any() and not L[:, known % n].any()
    np.testing.assert_allclose(L @ L.T, P, rtol=1e-12, atol=1e-12 * np.abs(P).max())


@random_cases
@given(SEEDS, st.integers(2, 6), st.floats(-6, 6))
def test_repair_gives_the_nearest_positive_definite_matrix(seed, n, log_size):
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


@pytest.mark.parametrize("size", [np.inf, np.nan])
def test_repair_keeps_non_finite_values_for_the_filter(size):
    P = np.diag([size, 1.0])
    repair_covariance(P)
    assert not np.isfinite(P).all()


def test_the_root_after_an_update_that_rounds_to_zero_is_definite():
    # A measurement 1e16 times better than the prior: P - K S K' is zero in one direction, to rounding.
    x, P = np.zeros(2), np.array([[1e8, 1e8 - 1.0], [1e8 - 1.0, 1e8]])
    H = np.array([[1.0, 0.0]])
    update(x, P, np.array([1.0]), H @ P @ H.T + 1e-10, H @ P, np.array([True]))
    L = root_of(P)
    assert np.isfinite(L).all() and (np.diag(L) >= 0.0).all()
    np.testing.assert_allclose(L @ L.T, P, atol=1e-4)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 5), steps=st.integers(1, 8), restart=st.booleans())
def test_smoothed_states_are_those_of_dense_least_squares(seed, n, steps, restart):
    rng = np.random.default_rng(seed)
    transitions, roots = rng.standard_normal((2, steps, n, n))
    noises = roots @ roots.transpose(0, 2, 1) + 0.1 * np.eye(n)
    jacobians, stds = rng.standard_normal((steps, n)), rng.uniform(0.3, 1.4, steps)
    measured, offsets = rng.standard_normal(steps), rng.standard_normal((steps, n))
    transitions[[0, *([steps // 2] if restart else [])]] = 0.0  # these states do not depend on the one before
    predicted_x, x = np.empty((steps, n)), np.zeros((steps, n))
    predicted_P, P, cross = (np.zeros((steps, n, n)) for _ in range(3))
    rows, wanted = np.zeros((steps, n + 1, steps, n)), np.zeros((steps, n + 1))  # in standard deviations
    for k in range(steps):
        f, h = transitions[k], jacobians[k]
        predicted_x[k], cross[k] = f @ x[k - 1] + offsets[k], P[k - 1] @ f.T
        predicted_P[k] = f @ cross[k] + noises[k]
        gain = predicted_P[k] @ h / (h @ predicted_P[k] @ h + stds[k] ** 2)
        x[k] = predicted_x[k] + gain * (measured[k] - h @ predicted_x[k])
        P[k] = predicted_P[k] - np.outer(gain, h @ predicted_P[k])
        white = np.linalg.inv(np.linalg.cholesky(noises[k]))
        rows[k, :n, k - 1] = -white @ f
        rows[k, :n, k] += white
        rows[k, n, k] = h / stds[k]
        wanted[k] = *(white @ offsets[k]), measured[k] / stds[k]
    dense = rows.reshape(-1, steps * n)
    covariance = np.linalg.inv(dense.T @ dense).reshape(steps, n, steps, n)
    expected = np.linalg.lstsq(dense, wanted.ravel(), rcond=None)[0]
    scale = max(1.0, float(np.abs(predicted_P).max()))
    smoothed = rts.smooth_states(x, predicted_x, predicted_P, cross)
    np.testing.assert_allclose(smoothed.ravel(), expected, rtol=1e-9, atol=1e-9 * scale)
    covariances = rts.smooth_covariances(P, predicted_P, cross)
    for k in range(steps):
        np.testing.assert_allclose(covariances[k], covariance[k, :, k], rtol=1e-9, atol=1e-9 * scale)


def test_a_state_without_variance_keeps_its_value():
    P = np.tile(np.diag([1.0, 0.0]), (3, 1, 1))
    predicted_P = P + np.diag([0.5, 0.0])
    x, predicted_x = np.array([[0.0, 7.0], [1.0, 7.0], [2.0, 7.0]]), np.array([[0.0, 7.0], [0.0, 7.0], [1.0, 7.0]])
    smoothed = rts.smooth_states(x, predicted_x, predicted_P, P)
    assert smoothed[:, 1].tolist() == [7.0] * 3
    assert smoothed[1, 0] == pytest.approx(1.0 + 1.0 / 1.5)
