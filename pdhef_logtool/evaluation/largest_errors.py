"""The places of the largest errors of a drive, at least a second apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.evaluation.blocks import row_blocks
from pdhef_logtool.evaluation.metrics import signal_error
from pdhef_logtool.records.geometry import wrap_angle
from pdhef_logtool.records.signals import FloatArray, IntArray
from pdhef_logtool.records.tracks import StateTrack

#: Places at most; two of them are further apart than this, and than this share of the drive.
PLACES, _APART_S, _APART_SHARE = 10, 1.0, 0.02


@dataclass(frozen=True, slots=True)
class ErrorPlace:
    """A place of a large sideslip error: stamp in ns, angles in rad, and the track that ``truth_rad`` is of."""

    stamp_ns: int
    estimate_rad: float
    truth_rad: float
    error_rad: float
    against: str


def largest_errors(
    estimate: StateTrack, truth: StateTrack | None, others: Sequence[StateTrack], low_speed_m_s: float
) -> list[ErrorPlace]:
    """Return the largest sideslip errors of a track [N], the largest first.

    Without ground truth that scores it, the largest differences from the first of ``others`` that has a sideslip at
    its stamps.
    """
    for reference in (truth, *others):
        if reference is None or len(reference) != len(estimate):
            continue
        parts = [(estimate.rows(a, b), reference.rows(a, b)) for a, b in row_blocks(len(reference))]
        if reference is truth:
            error = np.concatenate([signal_error(e, r, "sideslip_rad", low_speed_m_s) for e, r in parts])
        else:
            error = np.concatenate([wrap_angle(_known(e, low_speed_m_s) - _known(r, low_speed_m_s)) for e, r in parts])
        stamps, beta = (np.concatenate([getattr(e, key) for e, _ in parts]) for key in ("stamps_ns", "sideslip_rad"))
        if np.isfinite(error).any():
            return [
                ErrorPlace(int(stamps[i]), float(beta[i]), float(beta[i] - error[i]), float(error[i]), reference.name)
                for i in largest_places(stamps, error)
            ]
    return []


def _known(track: StateTrack, low_speed_m_s: float) -> FloatArray:
    """Return the sideslip [N], NaN where it is not valid or the car too slow for a direction."""
    return np.where(track.valid, track.without_sideslip_below(low_speed_m_s).sideslip_rad, np.nan)


def largest_places(stamps_ns: IntArray, error: FloatArray) -> list[int]:
    """Return the rows of the largest absolute errors [N], the largest first; NaN does not count."""
    if not len(stamps_ns):
        return []
    size = np.nan_to_num(np.abs(error), nan=0.0)
    apart_ns = int(max(_APART_S * 1e9, _APART_SHARE * float(stamps_ns[-1] - stamps_ns[0])))
    rows: list[int] = []
    while len(rows) < PLACES and size.max() > 0.0:
        row = int(np.argmax(size))
        rows.append(row)
        stamp = int(stamps_ns[row])
        size[slice(*np.searchsorted(stamps_ns, [stamp - apart_ns, stamp + apart_ns + 1]))] = 0.0
    return rows
