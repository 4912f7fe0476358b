"""``lag_s``: delay of an estimate after ground truth; ``rmse_aligned``: error without that shift and a constant."""

from __future__ import annotations

import numpy as np

from pdhef_logtool.drive.correlation import find_shift, on_common_grid
from pdhef_logtool.evaluation.metrics.errors import errors_of_drive
from pdhef_logtool.evaluation.metrics.metric import described, rms
from pdhef_logtool.records.geometry import wrap_angle
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray

MAX_LAG_S = 0.3
MIN_LAG_CORRELATION = 0.5
#: More driving does not make the lag more certain than the sampling of the signals.
LAG_SPAN_NS = 600_000_000_000


def lag_s(stamps_ns: IntArray, estimate: FloatArray, truth: FloatArray) -> float:
    """Return the delay of the estimate [N] after the ground truth [N] in s; NaN without a clear peak."""
    finite = np.isfinite(estimate) & np.isfinite(truth)
    if np.count_nonzero(finite) < 2:
        return float("nan")
    stamps = stamps_ns[finite]
    shift = find_shift(on_common_grid(stamps, truth[finite], stamps, estimate[finite]), MAX_LAG_S)
    clear = shift.inside and shift.correlation >= MIN_LAG_CORRELATION
    return shift.shift_s if clear else float("nan")


def _lag_of_start(_: FloatArray, since_start_ns: IntArray, estimate: FloatArray, truth: FloatArray) -> float:
    end = int(np.searchsorted(since_start_ns, LAG_SPAN_NS))
    return lag_s(since_start_ns[:end], estimate[:end], truth[:end])


def _rms_aligned(
    _: FloatArray, since_start_ns: IntArray, estimate: FloatArray, truth: FloatArray, straight: BoolArray
) -> float | None:
    """Return the RMS error [N] without the lag and without the ground truth's mean on straights.

    A lag that is not clear is 0. None without straights: an offset of ground truth is an error elsewhere.
    """
    lag = np.nan_to_num(_lag_of_start(_, since_start_ns, estimate, truth))
    then_ns = since_start_ns - lag * 1e9
    covered = (then_ns >= since_start_ns[0]) & (then_ns <= since_start_ns[-1])
    if not straight.any() or not covered.any():
        return None
    shifted = np.interp(then_ns[covered], since_start_ns, truth - np.mean(truth[straight]))
    return rms(np.asarray(wrap_angle(estimate[covered] - shifted), dtype=np.float64))


METRICS = described(
    errors_of_drive,
    lag_s=(_lag_of_start, "error", "since_start_ns", "estimate", "truth"),
    rmse_aligned=(_rms_aligned, "error", "since_start_ns", "estimate", "truth", "straight"),
)
