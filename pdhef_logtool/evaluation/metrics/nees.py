"""``nees``: whether the covariance of an estimate is as large as its errors."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pdhef_logtool.evaluation.blocks import HeldRows, SegmentMasks, SegmentSums, row_blocks
from pdhef_logtool.evaluation.metrics.metric import Metric, MetricRow, OfTrack
from pdhef_logtool.evaluation.track_errors import selected
from pdhef_logtool.records.signals import BoolArray, FloatArray
from pdhef_logtool.records.tracks import StateTrack

#: Rows whose covariances are in memory at once.
NEES_ROWS = 1 << 16
#: Of a covariance in units of its mean variance: far above what rounding does to it.
LEAST_DETERMINANT = 1e-9


def _rows(estimate: StateTrack, truth: StateTrack | None, masks: SegmentMasks, log: str) -> Iterator[MetricRow]:
    if truth is None:
        return
    sums = SegmentSums()
    for a, b in row_blocks(len(truth)):
        block = HeldRows(estimate.rows(a, b))
        if block.covariance.shape[0]:
            sums.add(masks.rows(a, b), _nees_of(block, HeldRows(truth.rows(a, b))))
    for segment, (n, (total,)) in sums.totals().items():
        yield MetricRow(log, estimate.name, "state", segment, "nees", float(total) / n, "1", n)


def nees(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return eᵀ P⁻¹ e, [N], of errors [N, k] and covariances [N, k, k]; NaN where P is not positive definite."""
    out = np.full(error.shape[0], np.nan)
    finite = np.isfinite(error).all(axis=1) & np.isfinite(covariance.reshape(len(covariance), -1)).all(axis=1)
    good = finite & _surely_positive_definite(covariance)
    unsure = np.flatnonzero(finite & ~good)
    good[unsure] = np.linalg.eigvalsh(covariance[unsure])[:, 0] > 0
    e = selected(error, good)
    out[good] = (e * np.linalg.solve(selected(covariance, good), e[:, :, None])[:, :, 0]).sum(axis=1)
    return out


def _surely_positive_definite(covariance: FloatArray) -> BoolArray:
    """Return which matrices [N, k, k] are so by far more than rounding, [N]: their eigenvalues need not be asked.

    All pivots are positive, and their product, the determinant, bounds the smallest eigenvalue.
    """
    k = covariance.shape[1]
    left = {(i, j): covariance[:, i, j].copy() for i in range(k) for j in range(i + 1)}
    scale = sum(left[i, i] for i in range(k)) / k
    sure = np.ones(len(covariance), dtype=np.bool_)
    determinant = np.ones(len(covariance))
    with np.errstate(all="ignore"):
        for j in range(k):
            sure &= left[j, j] > 0.0
            determinant *= left[j, j] / scale
            for i in range(j + 1, k):
                share = left[i, j] / left[j, j]
                for m in range(j + 1, i + 1):
                    left[i, m] -= share * left[m, j]
    return sure & (determinant > LEAST_DETERMINANT)


def _nees_of(estimate: StateTrack, truth: StateTrack) -> FloatArray:
    error = np.stack([getattr(estimate, s) - getattr(truth, s) for s in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s")], axis=1)
    error[~(estimate.valid & truth.valid)] = np.nan
    covariance = estimate.covariance
    if truth.covariance.shape[0]:
        covariance = covariance + truth.covariance
    parts = range(0, len(error), NEES_ROWS)
    return np.concatenate(
        [np.empty(0), *(nees(error[i : i + NEES_ROWS], covariance[i : i + NEES_ROWS]) for i in parts)]
    )


METRICS = (
    Metric(
        "nees",
        "NEES",
        "mean eᵀ (P + P_truth)⁻¹ e over [v_x, v_y, r]; 3 when P is right. Signal `state`",
        OfTrack(_rows),
        best=3.0,
        unit="1",
    ),
)
