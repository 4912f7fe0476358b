"""Rows of the largest errors of a drive, at least a second apart."""

from __future__ import annotations

import numpy as np

from pdhef_logtool.records.signals import FloatArray, IntArray

#: Largest number of rows; least distance of two rows in time, and as a share of the drive.
PLACES, _APART_S, _APART_SHARE = 10, 1.0, 0.02


def largest_places(stamps_ns: IntArray, error: FloatArray) -> list[int]:
    """Return the rows of the largest absolute errors [N], the largest first, without NaN."""
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
