"""Descent of fits: without information the priors stay."""

from __future__ import annotations

import numpy as np

from pdhef_logtool.car.descent import descend


def test_residuals_without_information_leave_the_priors() -> None:
    result, _ = descend(
        lambda theta: np.full(3, 2.0) + 0.0 * theta[0],
        lambda errors, theta: float(errors @ errors + theta @ theta),
        lambda errors, _: errors,
        np.zeros(2),
        iterations=3,
        least_gain=lambda _: 0.0,
        derivative_step=1e-3,
        max_step=1.0,
    )
    assert result.theta.tolist() == [0.0, 0.0]
    assert result.normal.tolist() == np.eye(2).tolist()
