"""Series at irregular stamps: zero-phase smoothing, gap-free runs, and held measurements."""

import numpy as np

from pdhef_logtool.records.signals import NS_PER_S, S_PER_NS, BoolArray, FloatArray, IntArray

#: A longer step between stamps ends every run and every interval.
RUN_GAP_S = 0.5


def median_step_ns(stamps_ns: IntArray) -> float:
    """Return the median step between stamps; 1 for a single stamp."""
    return float(np.median(np.diff(stamps_ns))) if len(stamps_ns) > 1 else 1.0


def smooth(stamps_ns: IntArray, values: FloatArray, cutoff_hz: float, step_ns: float | None = None) -> FloatArray:
    """Smooth [N] with zero phase by a Gaussian with gain 1/√2 at ``cutoff_hz``; NaN stays, but does not spread.

    The Gaussian is truncated at 4 σ and does not cross steps of more than ``RUN_GAP_S``. ``step_ns``: the median step;
    computed by default.
    """
    out = np.full(values.shape, np.nan)
    if values.shape[0] < 2:
        return values.astype(np.float64)
    kernel = _gaussian(median_step_ns(stamps_ns) if step_ns is None else step_ns, cutoff_hz)
    reach = len(kernel) // 2
    finite = np.isfinite(values)
    for a, b in runs(stamps_ns, np.ones(values.shape[0], dtype=np.bool_)):
        here = finite[a:b]
        columns = here.astype(np.float64), np.where(here, values[a:b], 0.0)
        weight, total = (np.convolve(c, kernel)[reach : reach + b - a] for c in columns)
        out[a:b][here] = total[here] / weight[here]
    return out


def _gaussian(step_ns: float, cutoff_hz: float) -> FloatArray:
    """Return the weights [2 K + 1] of a Gaussian with gain 1/√2 at ``cutoff_hz``, truncated at 4 σ."""
    sigma_rows = float(np.sqrt(np.log(2.0)) / (2.0 * np.pi * cutoff_hz) / (step_ns * S_PER_NS))
    reach = int(4.0 * sigma_rows + 0.5)
    weights = np.exp(-0.5 / (sigma_rows * sigma_rows) * np.arange(-reach, reach + 1) ** 2)
    return np.asarray(weights / weights.sum(), dtype=np.float64)


def runs(stamps_ns: IntArray, mask: BoolArray) -> list[tuple[int, int]]:
    """Return [a, b) of the gap-free runs where the mask is True."""
    n = mask.shape[0]
    if n == 0:
        return []
    joined = mask[1:] & mask[:-1] & (np.diff(stamps_ns) <= RUN_GAP_S * NS_PER_S)
    starts = np.flatnonzero(mask & ~np.concatenate([[False], joined]))
    ends = np.flatnonzero(mask & ~np.concatenate([joined, [False]])) + 1
    return list(zip(starts.tolist(), ends.tolist(), strict=True))
