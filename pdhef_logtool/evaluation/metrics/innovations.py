"""Consistency of a filter's covariance with its errors and innovations, signal ``state``."""

from collections.abc import Iterator

import numpy as np

from pdhef_logtool.evaluation.metrics.metric import Columns, EvaluatedDrive, described, mean
from pdhef_logtool.records.signals import FloatArray

#: Least number of pairs of stamps for an autocorrelation.
LEAST_PAIRS = 10
_STATE = ("vx_m_s", "vy_m_s", "yaw_rate_rad_s")


def _errors(drive: EvaluatedDrive) -> Iterator[Columns]:
    if drive.truth is None:
        return
    for track in drive.tracks.values():
        if track.covariance.shape[0]:
            error = np.stack([getattr(track, s) - getattr(drive.truth, s) for s in _STATE], axis=1)
            error[~(track.valid & drive.truth.valid)] = np.nan
            covariance, of_truth = track.covariance, drive.truth.covariance
            values = nees(error, covariance + of_truth if of_truth.shape[0] else covariance)
            yield Columns(track.name, "state", {"nees": values})


def nees(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return eᵀ P⁻¹ e, [N], of errors [N, k] and covariances [N, k, k]; NaN where P is not positive definite.

    By elimination, P = L D Lᵀ, in the lower triangle, on all matrices at once.
    """
    left, e = [[*row] for row in covariance.transpose(1, 2, 0)], [*error.T]  # views, replaced one by one
    total = np.zeros(error.shape[0])
    with np.errstate(all="ignore"):
        for j, row in enumerate(left):
            pivot = np.where(row[j] > 0.0, row[j], np.nan)
            total += e[j] ** 2 / pivot
            for i in range(j + 1, len(left)):
                share = left[i][j] / pivot
                e[i] = e[i] - share * e[j]
                for m in range(j + 1, i + 1):
                    left[i][m] = left[i][m] - share * left[m][j]
    return total


def _innovations(drive: EvaluatedDrive) -> Iterator[Columns]:
    for track in drive.tracks.values():
        has_nis = track.nis_dof > 0
        nis = np.where(has_nis, track.nis, np.nan)
        dof = np.where(np.isfinite(nis), track.nis_dof, np.nan)
        yield Columns(track.name, "state", {"nis": nis, "nis_dof": dof, "diverged": track.diverged})


def _pairs(drive: EvaluatedDrive) -> Iterator[Columns]:
    """Yield NIS per degree of freedom before and after each step, where both are known."""
    for track in () if drive.signals is None else drive.tracks.values():
        ratio = track.nis / np.where(track.nis_dof > 0, track.nis_dof, np.nan)
        before = np.where(np.isfinite(ratio[1:]), ratio[:-1], np.nan)
        yield Columns(track.name, "state", {"before": before, "after": ratio[1:]}, of_steps=True)


def _autocorrelation(before: FloatArray, after: FloatArray) -> float | None:
    if len(before) < LEAST_PAIRS:
        return None
    with np.errstate(invalid="ignore", divide="ignore"):
        return float(np.corrcoef(before, after)[0, 1])


METRICS = (
    *described(_errors, nees=mean),
    *described(_innovations, nis=mean, nis_dof=mean, diverged=mean),
    *described(_pairs, nis_autocorrelation=(_autocorrelation, "before", "after")),
)
