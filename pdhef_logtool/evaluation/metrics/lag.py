"""``lag_s``: delay of an estimate after ground truth."""

from __future__ import annotations

import numpy as np

from pdhef_logtool.drive.correlation import find_shift, on_common_grid
from pdhef_logtool.evaluation.metrics.errors import errors_of_drive
from pdhef_logtool.evaluation.metrics.metric import Metric
from pdhef_logtool.records.signals import FloatArray, IntArray

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


METRICS = (
    Metric(
        "lag_s",
        "lag",
        "shift, within ± 0.3 s, at which the estimate correlates best with ground truth; positive = estimate late. "
        "Segment `all` only, its first ten minutes; NaN when the correlation stays below 0.5 or has no peak",
        columns=errors_of_drive,
        formula=_lag_of_start,
        over=("error", "since_start_ns", "estimate", "truth"),
        best=0.0,
        unit="s",
        whole=True,
        of_truth=True,
        digits=0,
        terminal=("sideslip_rad",),
    ),
)
