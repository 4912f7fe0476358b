"""Prior of a car's calibration from drives with ground truth: the calibration's own fit, with their sideslip besides.

The sideslip of the model is a third channel beside yaw rate and a_y, without its mean over a few seconds: offsets of
the ground truth are 0.2 to 0.3 degrees and differ between days, and the bank of the road, which the model lacks, would
be taken for the tyres. Only the tyres are taught: biases, gains and delays of sensors are those of a drive, and the
bank of a road enters them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

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
from pdhef_logtool.records.signals import FloatArray, IntArray

#: Least error of the sideslip of a single track, rad; larger errors count linearly.
SIDESLIP_STD_RAD = math.radians(0.3)
#: What ground truth teaches.
TYRES = (FRONT_STIFFNESS, REAR_STIFFNESS, PEAK, RELAXATION)
#: Correlation of a parameter between two drives of a car, about the mean of its prior (docs/teaching.md).
CORRELATION = 0.6
#: Mean over so many seconds that does not count. On simulated roads with bank, a constant alone doubles the sideslip
#: error of other drives.
SLOW_S = 4.0


class TaughtProblem(JointProblem):
    """The joint fit with v_y / v_x of the ground truth [N] by drive, NaN where unknown, on the grid of the driving."""

    def __init__(
        self, drives: Sequence[Driving], slopes: Sequence[FloatArray], vehicle_file: VehicleParameters
    ) -> None:
        super().__init__(drives, vehicle_file)
        self._least_std = self._error_std = np.array([*ERROR_STD, SIDESLIP_STD_RAD])
        self._slopes = [slope[kept] for slope, kept in zip(slopes, self._kept, strict=True)]

    def errors_of(self, theta: FloatArray) -> FloatArray:
        """Return errors of yaw rate, a_y and sideslip over their standard deviations, [3, K]."""
        errors = super().errors_of(theta)
        of_drives = zip(self._drives, self._out, self._kept, self._slopes, strict=True)
        rows = [_without_slow(out[2, k] / d.columns[SPEED, k] - slope) for d, out, k, slope in of_drives]
        return np.concatenate([errors, np.concatenate(rows)[None] / self._error_std[2]])


def taught_parameters(
    drives: Sequence[Driving], slopes: Sequence[FloatArray], vehicle_file: VehicleParameters, support: float = 1.0
) -> tuple[TaughtParameter, ...]:
    """Return the prior of a car's calibration from its drives, which were read with ``vehicle_file``.

    Of the correlation between drives the share ``support`` counts: the spread between drives is the least width of the
    prior, so that the sensors of a later drive can overrule it.
    """
    correlation = support * CORRELATION
    problem = TaughtProblem(drives, slopes, vehicle_file)
    fit, level = problem.solve(), float(f"{level_of(drives):.4g}")
    variances = np.minimum(np.diag(fit.covariance), 1.0)
    stds = np.sqrt(1.0 - correlation**2 * (1.0 - variances))
    return tuple(
        TaughtParameter(
            name=p.name,
            value=float(f"{p.value(correlation * float(t)):.9g}"),
            std=float(f"{s * p.std:.6g}"),
            ay_m_s2=level,
        )
        for p, t, s in zip(parameters_of(vehicle_file), fit.theta, stds, strict=True)
        if p.name in TYRES
    )


def slopes_of(driving: Driving, stamps_ns: IntArray, sideslip_rad: FloatArray) -> FloatArray:
    """Return v_y / v_x of the ground truth [N] on the grid of a drive; NaN between stamps where it is unknown."""
    if not len(driving.stamps_ns):
        return np.empty(0)
    start = int(driving.stamps_ns[0])
    middle_ns = driving.stamps_ns - round(0.5 * STEP_S * 1e9)  # a cell has the mean of its samples
    seconds, grid = ((s - start).astype(np.float64) for s in (stamps_ns, middle_ns))
    return np.interp(grid, seconds, np.tan(sideslip_rad), left=np.nan, right=np.nan)


def _without_slow(error: FloatArray) -> FloatArray:
    """Return errors [K] less their mean over :data:`SLOW_S` about each, 0 where unknown."""
    finite = np.isfinite(error)
    half = round(0.5 * SLOW_S / (KEPT_STEPS * STEP_S))
    sums, counts = (np.concatenate([[0.0], np.cumsum(x)]) for x in (np.where(finite, error, 0.0), finite))
    first = np.maximum(np.arange(error.size) - half, 0)
    last = np.minimum(np.arange(error.size) + half + 1, error.size)
    mean = (sums[last] - sums[first]) / np.maximum(counts[last] - counts[first], 1.0)
    return np.where(finite, error - mean, 0.0)
