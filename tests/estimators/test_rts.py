"""The smoother against the joint distribution of all states, computed with dense matrices."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdhef_logtool.estimators import rts


def _spd(rng, n):
    root = rng.standard_normal((n, n))
    return root @ root.T + 0.1 * np.eye(n)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 5), steps=st.integers(1, 8), restart=st.booleans())
def test_smoothed_states_are_those_of_the_joint_gaussian(seed, n, steps, restart):
    rng = np.random.default_rng(seed)
    transitions, noises = rng.standard_normal((steps, n, n)), [_spd(rng, n) for _ in range(steps)]
    jacobians, variances = rng.standard_normal((steps, n)), rng.uniform(0.1, 2.0, steps)
    measured, offsets = rng.standard_normal(steps), rng.standard_normal((steps, n))
    if restart:  # the middle state does not depend on the previous one
        transitions[steps // 2] = 0.0
    predicted_x, x = np.empty((steps, n)), np.empty((steps, n))
    predicted_P, P, cross = (np.zeros((steps, n, n)) for _ in range(3))
    mean, joint = np.zeros(steps * n), np.zeros((steps * n, steps * n))
    for k in range(steps):
        now, last = slice(k * n, (k + 1) * n), slice((k - 1) * n, k * n)
        if k == 0:
            predicted_x[0], predicted_P[0] = offsets[0], noises[0]
            mean[now], joint[now, now] = offsets[0], noises[0]
        else:
            f = transitions[k]
            predicted_x[k], cross[k] = f @ x[k - 1] + offsets[k], P[k - 1] @ f.T
            predicted_P[k] = f @ cross[k] + noises[k]
            mean[now] = f @ mean[last] + offsets[k]
            joint[now, : k * n] = f @ joint[last, : k * n]
            joint[: k * n, now] = joint[now, : k * n].T
            joint[now, now] = f @ joint[last, last] @ f.T + noises[k]
        h = jacobians[k]
        gain = predicted_P[k] @ h / (h @ predicted_P[k] @ h + variances[k])
        x[k] = predicted_x[k] + gain * (measured[k] - h @ predicted_x[k])
        P[k] = predicted_P[k] - np.outer(gain, h @ predicted_P[k])
    sensing = np.zeros((steps, steps * n))
    for k in range(steps):
        sensing[k, k * n : (k + 1) * n] = jacobians[k]
    gain = np.linalg.solve(sensing @ joint @ sensing.T + np.diag(variances), sensing @ joint).T
    expected, covariance = mean + gain @ (measured - sensing @ mean), joint - gain @ sensing @ joint
    scale = max(1.0, float(np.abs(joint).max()))
    smoothed = rts.smooth_states(x, predicted_x, predicted_P, cross)
    np.testing.assert_allclose(smoothed.ravel(), expected, rtol=1e-9, atol=1e-9 * scale)
    covariances = rts.smooth_covariances(P, predicted_P, cross)
    for k in range(steps):
        now = slice(k * n, (k + 1) * n)
        np.testing.assert_allclose(covariances[k], covariance[now, now], rtol=1e-9, atol=1e-9 * scale)


def test_a_state_without_variance_keeps_its_value():
    P = np.tile(np.diag([1.0, 0.0]), (3, 1, 1))
    predicted_P = P + np.diag([0.5, 0.0])
    x, predicted_x = np.array([[0.0, 7.0], [1.0, 7.0], [2.0, 7.0]]), np.array([[0.0, 7.0], [0.0, 7.0], [1.0, 7.0]])
    smoothed = rts.smooth_states(x, predicted_x, predicted_P, P)
    assert smoothed[:, 1].tolist() == [7.0] * 3
    assert smoothed[1, 0] == pytest.approx(1.0 + 1.0 / 1.5)
