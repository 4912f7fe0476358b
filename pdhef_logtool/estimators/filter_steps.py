"""Posteriors of a filter on measurement time, the columns that kernels write."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from pdhef_logtool.estimators.vehicle_model import READINGS
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray
from pdhef_logtool.records.steps import StepColumns

# Inputs of a step; a_x is 0 where U_AX_KNOWN is 0. U_SPEED is the last speed sample that was accepted, 0 before any.
U_STEER, U_AX, U_FRICTION, U_AX_KNOWN, U_SPEED, U_STEER_KNOWN = range(6)
INPUTS = 6


@dataclass(frozen=True, slots=True, eq=False)
class PosteriorSteps(StepColumns):
    """Filter posteriors on measurement time: [K] each, state [K, n], covariance [K, n, n], inputs [K, 6].

    ``prior`` [K, n] is the state before the update, NaN where the filter starts. ``residual_rate``
    [K, 2] is added to v̇_y and ṙ from the step on; 0 in the pure physics filter.
    """

    stamps_ns: IntArray
    x: FloatArray
    P: FloatArray
    inputs: FloatArray
    nis: FloatArray
    nis_dof: FloatArray
    log_likelihood: FloatArray
    innovation: FloatArray
    valid: BoolArray
    diverged: BoolArray
    prior: FloatArray
    residual_rate: FloatArray

    @property
    def written(self) -> tuple[Any, ...]:
        """The columns that a kernel writes: all but the first and the last."""
        return tuple(getattr(self, f.name) for f in fields(PosteriorSteps)[1:-1])


@dataclass(frozen=True, slots=True, eq=False)
class LinkedSteps(StepColumns):
    """Posteriors of a forward pass, and the links between them for a smoother; of length 0 if not requested.

    ``linked`` [K]: the state follows from that of the step before; not at a start, a failure or a standstill.
    ``predicted_P`` [K, n, n] is the covariance before the update, with the inflation by an opened gate; ``cross``
    [K, n, n] the covariance between the state of the step before (rows) and the predicted state (columns).
    """

    posterior: PosteriorSteps
    linked: BoolArray
    predicted_P: FloatArray
    cross: FloatArray


def no_posterior(stamps_ns: IntArray, n: int, residual_rate: FloatArray) -> PosteriorSteps:
    """Return steps of ``n`` states for a kernel to write to, with no estimate in them."""
    count = len(stamps_ns)
    return PosteriorSteps(
        stamps_ns=stamps_ns,
        x=np.empty((count, n)),
        P=np.empty((count, n, n)),
        inputs=np.empty((count, INPUTS)),
        nis=np.full(count, np.nan),
        nis_dof=np.zeros(count),
        log_likelihood=np.zeros(count),
        innovation=np.full((count, READINGS), np.nan),
        valid=np.zeros(count, dtype=np.bool_),
        diverged=np.zeros(count, dtype=np.bool_),
        prior=np.full((count, n), np.nan),
        residual_rate=residual_rate,
    )
