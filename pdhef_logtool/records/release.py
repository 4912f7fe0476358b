"""What had arrived by a scored stamp: the rule that keeps estimates causal."""

from __future__ import annotations

import numpy as np

from pdhef_logtool.records.signals import IntArray

#: An output is not predicted further than this beyond the newest processed step; the stamp is then not valid.
MAX_PREDICTION_S = 0.3


def released_steps(ready_ns: IntArray, stamps_ns: IntArray) -> IntArray:
    """Return for each scored stamp the newest step whose data had arrived by then, −1 for none.

    ``ready_ns`` [K] is non-decreasing, ``stamps_ns`` [M]; the result is int64 [M] (METHOD §1, §6 "Delay").
    """
    return np.searchsorted(ready_ns, stamps_ns, side="right").astype(np.int64) - 1
