"""Prior of a car's calibration: the calibration fit with ground-truth sideslip as an additional output.

The sideslip of the model is fitted together with yaw rate and a_y, after removal of its mean over a few seconds:
offsets of the ground truth are 0.2 to 0.3 degrees and differ between days, and the road bank, which the model lacks,
would be attributed to the tyres. Only tyre parameters are trained: biases, gains and delays of sensors belong to one
drive and include the effect of the road bank.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.car.model import TaughtParameter
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.estimators.calibration.calibration import as_prior, posterior_of
from pdhef_logtool.estimators.calibration.driving import STEP_S, Driving
from pdhef_logtool.estimators.calibration.joint import (
    ERROR_STD,
    KEPT_STEPS,
    PEAK,
    RATIO,
    REAR_STIFFNESS,
    RELAXATION,
    JointProblem,
    level_of,
    prior_of,
)
from pdhef_logtool.estimators.calibration.single_track import SPEED
from pdhef_logtool.learning.truth import MODEL_STD_RAD, weight_of
from pdhef_logtool.records.running_mean import running_mean
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.records.tracks import StateTrack

#: Correlation of a parameter between a drive with ground truth and a later drive, about the mean of its prior.
CORRELATION = 0.6
#: Parameters trained with ground truth.
TYRES = (RATIO, REAR_STIFFNESS, PEAK, RELAXATION)
#: Window of the mean to remove, in s. If only a constant is removed, the bank of simulated roads doubles the sideslip
#: error on other drives.
SLOW_S = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class TaughtDriving:
    """Driving for a calibration, with v_y / v_x of the ground truth and weights on its grid [N]; NaN where unknown."""

    driving: Driving
    slopes: FloatArray
    weights: FloatArray


class TaughtProblem(JointProblem):
    """Joint fit of yaw rate, a_y, and v_y / v_x of the ground truth."""

    def __init__(self, drives: Sequence[TaughtDriving], vehicle_file: VehicleParameters) -> None:
        super().__init__([d.driving for d in drives], vehicle_file)
        self._least_std = self._error_std = np.array([*ERROR_STD, MODEL_STD_RAD])
        self._taught = [(d.slopes[k], d.weights[k]) for d, k in zip(drives, self._kept, strict=True)]

    def errors_of(self, theta: FloatArray) -> FloatArray:
        """Return errors of yaw rate, a_y and sideslip over their standard deviations, [3, K]."""
        errors, rows = super().errors_of(theta), []
        for d, out, k, (slopes, weights) in zip(self._drives, self._out, self._kept, self._taught, strict=True):
            error = out[2, k] / d.columns[SPEED, k] - slopes
            fast = error - running_mean(error, round(0.5 * SLOW_S / (KEPT_STEPS * STEP_S)), weights)
            rows.append(np.nan_to_num(np.sqrt(weights) * fast))
        return np.concatenate([errors, np.concatenate(rows)[None] / self._error_std[2]])


def taught_parameters(
    drives: Sequence[TaughtDriving], vehicle_file: VehicleParameters, support: float = 1.0
) -> tuple[TaughtParameter, ...]:
    """Return the prior of a car's calibration from drives that were read with ``vehicle_file``.

    ``support`` scales the correlation between drives.
    """
    problem = TaughtProblem(drives, vehicle_file)
    posterior = posterior_of(problem, *problem.posterior(problem.solve()), prior_of(vehicle_file))
    tyres, level = [p for p in posterior if p.name in TYRES], level_of([d.driving for d in drives])
    return as_prior(tyres, support * CORRELATION, level)


def taught_driving(driving: Driving, truth: StateTrack) -> TaughtDriving:
    """Interpolate ground truth to the grid of driving; NaN in gaps of the ground truth and outside of stretches."""
    start = int(driving.stamps_ns[0]) if len(driving.stamps_ns) else 0
    middle_ns = driving.stamps_ns - round(0.5 * STEP_S * 1e9)  # a cell has the mean of its samples
    seconds, grid = ((s - start).astype(np.float64) for s in (truth.stamps_ns, middle_ns))
    slopes = np.interp(grid, seconds, np.tan(np.where(truth.valid, truth.sideslip_rad, np.nan)), np.nan, np.nan)
    std = np.interp(grid, seconds, np.nan_to_num(truth.sideslip_std_rad))
    inside = np.zeros(len(grid), dtype=np.bool_)
    for first, last in driving.stretches:
        inside[first:last] = True
    return TaughtDriving(driving, np.where(inside, slopes, np.nan), weight_of(std))
