"""Prior of a car's calibration from drives with ground truth: the calibration's own fit, with their sideslip besides.

The sideslip of the model is a third channel beside yaw rate and a_y, without its mean over a few seconds: offsets of
the ground truth are 0.2 to 0.3 degrees and differ between days, and the bank of the road, which the model lacks, would
be taken for the tyres. Only the tyres are taught: biases, gains and delays of sensors are those of a drive, and the
bank of a road enters them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.car.taught import TaughtParameter
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.estimators.calibration.driving import STEP_S, Driving
from pdhef_logtool.estimators.calibration.joint import (
    ERROR_STD,
    FRONT_STIFFNESS,
    KEPT_STEPS,
    PEAK,
    REAR_STIFFNESS,
    RELAXATION,
    JointProblem,
    level_of,
    parameters_of,
)
from pdhef_logtool.estimators.calibration.single_track import SPEED
from pdhef_logtool.learning.truth import MODEL_STD_RAD, weight_of
from pdhef_logtool.records.running_mean import running_mean
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.records.tracks import StateTrack

#: What ground truth teaches.
TYRES = (FRONT_STIFFNESS, REAR_STIFFNESS, PEAK, RELAXATION)
#: Correlation of a parameter between two drives of a car, about the mean of its prior (docs/teaching.md).
CORRELATION = 0.6
#: Mean over so many seconds that does not count. On simulated roads with bank, a constant alone doubles the sideslip
#: error of other drives.
SLOW_S = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class TaughtDriving:
    """Driving for a calibration; on its grid [N] v_y / v_x of the ground truth, NaN where unknown, and its weight."""

    driving: Driving
    slopes: FloatArray
    weights: FloatArray


class TaughtProblem(JointProblem):
    """The joint fit with v_y / v_x of the ground truth besides."""

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
    """Return the prior of a car's calibration from its drives, which were read with ``vehicle_file``.

    Of the correlation between drives the share ``support`` counts: the spread between drives is the least width of the
    prior, so that the sensors of a later drive can overrule it.
    """
    correlation = support * CORRELATION
    problem = TaughtProblem(drives, vehicle_file)
    theta, level = problem.solve(), float(f"{level_of([d.driving for d in drives]):.4g}")
    variances = np.minimum(np.diag(problem.covariance(theta)), 1.0)
    stds = np.sqrt(1.0 - correlation**2 * (1.0 - variances))
    return tuple(
        TaughtParameter(
            name=p.name,
            value=float(f"{p.value(correlation * float(t)):.9g}"),
            std=float(f"{s * p.std:.6g}"),
            ay_m_s2=level,
        )
        for p, t, s in zip(parameters_of(vehicle_file), theta, stds, strict=True)
        if p.name in TYRES
    )


def taught_driving(driving: Driving, truth: StateTrack) -> TaughtDriving:
    """Return driving with a ground truth of any stamps, unknown between stamps where it is and outside of stretches."""
    start = int(driving.stamps_ns[0]) if len(driving.stamps_ns) else 0
    middle_ns = driving.stamps_ns - round(0.5 * STEP_S * 1e9)  # a cell has the mean of its samples
    seconds, grid = ((s - start).astype(np.float64) for s in (truth.stamps_ns, middle_ns))
    slopes = np.interp(grid, seconds, np.tan(np.where(truth.valid, truth.sideslip_rad, np.nan)), np.nan, np.nan)
    std = np.interp(grid, seconds, np.nan_to_num(truth.sideslip_std_rad))
    inside = np.zeros(len(grid), dtype=np.bool_)
    for first, last in driving.stretches:
        inside[first:last] = True
    return TaughtDriving(driving, np.where(inside, slopes, np.nan), weight_of(std))
