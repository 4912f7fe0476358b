"""The process noise with which a fitted ``physics`` is smoothed, found through the smoother itself.

A filter hears of an error of its model once, a smoother from both sides, and what a model lacks is no white noise: with
the noise that suits the filter it follows the model too far. Two factors, on the noise of v_y and of the yaw rate, are
found as the filter's noise is (:mod:`~.physics_fit`), on the same drives and with the fitted values, about what other
cars have asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pdhef_logtool.car.descent import descend
from pdhef_logtool.car.parts import SMOOTHING
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.estimators.physics_filter import physics_filter
from pdhef_logtool.estimators.smoothed import BLOCK_S, for_smoothing, smooth_steps
from pdhef_logtool.learning.car.fit_data import FitDrive, signals_of
from pdhef_logtool.learning.car.physics_fit import (
    CORRELATION_S,
    DERIVATIVE_STEP,
    LEAST_GAIN,
    MAX_STEP,
    NOISE_LOG_STD,
    DriveError,
    PhysicsFit,
    fit_cost,
    least_gain,
    scaled_errors,
)
from pdhef_logtool.records.signals import FloatArray

MAX_ITERATIONS, DIGITS = 6, 4


def smoothed_errors(
    drives: Sequence[FitDrive], start: VehicleParameters, fit: PhysicsFit, factors: Sequence[float]
) -> list[DriveError]:
    """Return the errors of the smoothed ``physics`` on drives, with factors on the noise of v_y and yaw rate."""
    estimator = for_smoothing(physics_filter(fit.vehicle, fit.noise), factors)
    errors = []
    for drive in drives:
        steps, _, links = estimator.linked_steps(signals_of(drive, start, fit.vehicle), None)
        stamps = steps.stamps_ns
        x, _ = smooth_steps(steps, links, len(stamps), int(stamps[0]), round(BLOCK_S * 1e9))
        errors.append(DriveError.of(drive, start, replace(steps, x=x), 1.0))  # a smoothed state has no innovation
    return errors


def fit_smoothing(drives: Sequence[FitDrive], start: VehicleParameters, fit: PhysicsFit) -> tuple[float, float]:
    """Return the factors on the process noise of v_y and yaw rate; the usual ones where others are not worth having."""

    def factors(theta: FloatArray) -> tuple[float, float]:
        scale = np.exp(NOISE_LOG_STD * theta)
        vy, rate = (float(f"{usual * by:.{DIGITS}g}") for usual, by in zip(SMOOTHING, scale, strict=True))
        return vy, rate

    def errors(theta: FloatArray) -> list[DriveError]:
        return smoothed_errors(drives, start, fit, factors(theta))

    usual = np.zeros(2)
    (theta, _, cost), _ = descend(
        errors,
        fit_cost,
        scaled_errors,
        usual,
        iterations=MAX_ITERATIONS,
        least_gain=least_gain,
        derivative_step=DERIVATIVE_STEP,
        max_step=MAX_STEP,
    )
    at_first = errors(usual)
    independent = sum(d.seconds for d in at_first) / CORRELATION_S
    gain = 0.5 * (fit_cost(at_first, usual) - cost) / max(independent, 1.0)
    return factors(theta) if gain > LEAST_GAIN else SMOOTHING
