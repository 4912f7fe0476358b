"""Levenberg-Marquardt descent for fits to drives, with robust errors, adaptive scales and normal priors."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np

from pdhef_logtool.records.signals import FloatArray

#: Number of attempts per step, factor on the damping after a failed attempt, and divisor after a successful one.
_TRIES, _MORE, _LESS = 6, 6.0, 5.0

_Errors = TypeVar("_Errors")


class Descent(NamedTuple):
    """Result of a descent: θ, the normal matrix of the last step including the priors, and the cost."""

    theta: FloatArray
    normal: FloatArray
    cost: float


def linearised(
    errors: Callable[[FloatArray], _Errors],
    scaled: Callable[[_Errors, _Errors], FloatArray],
    theta: FloatArray,
    here: _Errors,
    step: float,
) -> tuple[FloatArray, FloatArray]:
    """Return the residuals [R] at θ [K], with the errors ``here``, and their derivatives [R, K] by differences."""
    residuals = scaled(here, here)
    jacobian = np.empty((residuals.size, theta.size))
    for i, moved in enumerate(theta + step * np.eye(theta.size)):
        jacobian[:, i] = (scaled(errors(moved), here) - residuals) / step
    return residuals, jacobian


def descend(
    errors: Callable[[FloatArray], _Errors],
    cost: Callable[[_Errors, FloatArray], float],
    scaled: Callable[[_Errors, _Errors], FloatArray],
    theta: FloatArray,
    *,
    iterations: int,
    least_gain: Callable[[_Errors], float],
    derivative_step: float,
    max_step: float,
) -> tuple[Descent, _Errors]:
    """Minimize the cost; return the result and the errors there.

    Parameters
    ----------
    errors : function of the parameters θ [K], which are distances from the prior in standard deviations.
    cost : function of errors and θ, including |θ|² for the priors.
    scaled : function that returns residuals [R] from errors, and from the errors that determine the scales; the cost
        approximates their sum of squares.
    least_gain : function of errors: decrease of the cost below which the search ends.
    derivative_step, max_step : step of θ for derivatives, and the largest step of the search.
    """
    values_here = errors(theta)
    value = cost(values_here, theta)
    damping = 1e-2
    normal = np.eye(theta.size)
    for _ in range(iterations):
        residuals, jac = linearised(errors, scaled, theta, values_here, derivative_step)
        normal = jac.T @ jac + np.eye(theta.size)
        gradient = jac.T @ residuals + theta
        gain = 0.0
        if not gradient.any():  # the residuals do not depend on θ, or this is the minimum
            break
        for _ in range(_TRIES):
            step = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
            step *= min(1.0, max_step / float(np.max(np.abs(step))))
            there = errors(theta + step)
            new = cost(there, theta + step)
            if new < value:
                gain = value - new
                theta, values_here, value = theta + step, there, new
                damping = max(damping / _LESS, 1e-5)
                break
            damping *= _MORE
        if gain <= 0.0 or gain < least_gain(values_here):
            break
    return Descent(theta, normal, value), values_here
