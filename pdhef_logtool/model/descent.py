"""Levenberg-Marquardt descent for fits to drives, with robust errors, adaptive scales and normal priors."""

from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from pdhef_logtool.records.signals import FloatArray

#: Number of attempts per step, factor on the damping after a failed attempt, and divisor after a successful one.
_TRIES, _MORE, _LESS = 6, 6.0, 5.0

Errors = TypeVar("Errors")


class Descent(NamedTuple, Generic[Errors]):
    """Result of a descent: θ, the normal matrix of the last step including the priors, the cost, and the errors."""

    theta: FloatArray
    normal: FloatArray
    cost: float
    errors: Errors


def linearised(
    errors: Callable[[FloatArray], Errors],
    scaled: Callable[[Errors, Errors], FloatArray],
    theta: FloatArray,
    here: Errors,
    step: float,
) -> tuple[FloatArray, FloatArray]:
    """Return the residuals [R] at θ [K], with the errors ``here``, and their derivatives [R, K] by differences."""
    residuals = scaled(here, here)
    moved = [scaled(errors(theta + by), here) for by in step * np.eye(theta.size)]
    return residuals, (np.stack(moved, axis=1) - residuals[:, None]) / step


def descend(
    errors: Callable[[FloatArray], Errors],
    cost: Callable[[Errors, FloatArray], float],
    scaled: Callable[[Errors, Errors], FloatArray],
    theta: FloatArray,
    *,
    iterations: int,
    least_gain: Callable[[Errors], float],
    derivative_step: float,
    max_step: float,
) -> Descent[Errors]:
    """Minimize the cost.

    Parameters
    ----------
    errors : function of the parameters θ [K], which are distances from the prior in standard deviations.
    cost : function of errors and θ, including |θ|² for the priors.
    scaled : function that returns residuals [R] from errors, and from the errors that determine the scales; the cost
        approximates their sum of squares.
    least_gain : function of errors: decrease of the cost below which the search ends.
    derivative_step, max_step : step of θ for derivatives, and the largest step of the search.
    """
    here, damping, normal = errors(theta), 1e-2, np.eye(theta.size)
    value = cost(here, theta)
    for _ in range(iterations):
        residuals, jacobian = linearised(errors, scaled, theta, here, derivative_step)
        normal, gradient, gain = jacobian.T @ jacobian + np.eye(theta.size), jacobian.T @ residuals + theta, 0.0
        for _ in range(_TRIES):
            step = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
            step /= max(1.0, float(np.max(np.abs(step))) / max_step)
            there = errors(theta + step)
            if (new := cost(there, theta + step)) < value:
                theta, here, value, gain = theta + step, there, new, value - new
                damping = max(damping / _LESS, 1e-5)
                break
            damping *= _MORE
        if gain <= 0.0 or gain < least_gain(here):
            break
    return Descent(theta, normal, value, here)
