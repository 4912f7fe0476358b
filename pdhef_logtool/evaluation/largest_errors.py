"""The places of the largest sideslip errors of a drive, at least a second apart, without the start of the estimate."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pdhef_logtool.evaluation.track_errors import signal_error
from pdhef_logtool.records.signals import NS_PER_S, FloatArray, IntArray
from pdhef_logtool.records.tracks import StateTrack

#: Largest number of rows; least distance of two rows in time, and as a share of the drive; duration of the start, in
#: which an estimator on a moving car has not found its state.
PLACES, _APART_NS, _APART_SHARE, _SETTLED_NS = 10, NS_PER_S, 0.02, 2 * NS_PER_S


def largest_errors(
    estimate: StateTrack, truth: StateTrack | None, others: Sequence[StateTrack], low_speed_m_s: float
) -> list[dict[str, Any]]:
    """Return the largest sideslip errors of a track [N], the largest first, as entries of report.json.

    Each has the stamp in ns, angles in rad, and the track that it is an error against.

    The first ``_SETTLED_NS`` do not count, where more follows. Without ground truth that scores it, the largest
    differences from the first of ``others`` that has a sideslip at its stamps.
    """
    for reference in (truth, *others):
        if reference is None or len(reference) != len(estimate):
            continue
        error = signal_error(estimate, reference, "sideslip_rad", low_speed_m_s)
        scored = np.flatnonzero(np.isfinite(error))
        if len(scored):
            settled = int(np.searchsorted(estimate.stamps_ns, estimate.stamps_ns[scored[0]] + _SETTLED_NS))
            error[: settled if settled <= scored[-1] else 0] = np.nan
            stamps, beta, name = estimate.stamps_ns, estimate.sideslip_rad, reference.name
            return [
                {
                    "stamp_ns": int(stamps[i]),
                    "estimate_rad": float(beta[i]),
                    "error_rad": float(error[i]),
                    "against": name,
                }
                for i in _largest_places(stamps, error)
            ]
    return []


def _largest_places(stamps_ns: IntArray, error: FloatArray) -> list[int]:
    """Return the rows of the largest absolute errors [N], the largest first, without NaN."""
    size = np.nan_to_num(np.abs(error), nan=0.0)
    apart_ns = int(max(_APART_NS, _APART_SHARE * float(stamps_ns[-1] - stamps_ns[0])))
    rows: list[int] = []
    while len(rows) < PLACES and size.max() > 0.0:
        row = int(np.argmax(size))
        rows.append(row)
        stamp = int(stamps_ns[row])
        size[slice(*np.searchsorted(stamps_ns, [stamp - apart_ns, stamp + apart_ns + 1]))] = 0.0
    return rows
