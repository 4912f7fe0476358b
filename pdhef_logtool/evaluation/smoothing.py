"""Series at irregular stamps: zero-phase smoothing, gap-free runs, and held measurements."""

from __future__ import annotations

import numpy as np

from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray

#: A longer step between stamps ends every run and every interval.
RUN_GAP_S = 0.5
#: Rows that are smoothed at once, so that they fit into the cache.
_NEAR_ROWS = 1 << 12


def median_step_ns(stamps_ns: IntArray) -> float:
    """Return the median step between stamps; 1 for a single stamp."""
    return float(np.median(np.diff(stamps_ns))) if len(stamps_ns) > 1 else 1.0


def _sigma_rows(step_ns: float, cutoff_hz: float) -> float:
    sigma_s = np.sqrt(np.log(2.0)) / (2.0 * np.pi * cutoff_hz)
    return float(sigma_s / (step_ns * 1e-9))


def smooth(stamps_ns: IntArray, values: FloatArray, cutoff_hz: float, step_ns: float | None = None) -> FloatArray:
    """Smooth [N] with zero phase by a Gaussian with gain 1/√2 at ``cutoff_hz``; NaN stays, but does not spread.

    The Gaussian is truncated at 4 σ and does not cross steps of more than ``RUN_GAP_S``. ``step_ns``: the median step;
    computed by default.
    """
    out = np.full(values.shape, np.nan)
    if values.shape[0] < 2:
        return values.astype(np.float64)
    sigma = _sigma_rows(median_step_ns(stamps_ns) if step_ns is None else step_ns, cutoff_hz)
    finite = np.isfinite(values)
    for a, b in runs(stamps_ns, np.ones(values.shape[0], dtype=np.bool_)):
        here = finite[a:b]
        if here.all():
            out[a:b] = _gaussian(values[a:b], sigma) / _gaussian_of_ones(b - a, sigma)
        else:
            weight = _gaussian(here.astype(np.float64), sigma)
            total = _gaussian(np.where(here, values[a:b], 0.0), sigma)
            out[a:b][here] = total[here] / weight[here]
    return out


def _gaussian(values: FloatArray, sigma_rows: float) -> FloatArray:
    """Return values [N], with 0 beyond their ends, filtered by a Gaussian truncated at 4 σ.

    The sums equal SciPy's ``gaussian_filter1d``, which takes longer to import than a short log takes to process.
    """
    reach = int(4.0 * sigma_rows + 0.5)
    weights = np.exp(-0.5 / (sigma_rows * sigma_rows) * np.arange(-reach, reach + 1) ** 2)
    weights /= weights.sum()
    n = len(values)
    padded = np.concatenate([np.zeros(reach), values, np.zeros(reach)])
    out: FloatArray = values * weights[reach]
    for a in range(0, n, _NEAR_ROWS):
        b = min(a + _NEAR_ROWS, n)
        part, beside = out[a:b], np.empty(b - a)
        for first in range(reach):
            last = 2 * reach - first
            np.add(padded[a + first : b + first], padded[a + last : b + last], out=beside)
            beside *= weights[first]
            part += beside
    return out


def _gaussian_of_ones(n: int, sigma_rows: float) -> FloatArray:
    """Return :func:`_gaussian` of n ones, which is constant except near the ends."""
    reach = int(4.0 * sigma_rows + 0.5)
    if n <= 2 * reach:
        return _gaussian(np.ones(n), sigma_rows)
    ends = _gaussian(np.ones(2 * reach + 1), sigma_rows)
    return np.concatenate([ends[:reach], np.full(n - 2 * reach, ends[reach]), ends[reach + 1 :]])


def runs(stamps_ns: IntArray, mask: BoolArray) -> list[tuple[int, int]]:
    """Return [a, b) of the gap-free runs where the mask is True."""
    n = mask.shape[0]
    if n == 0:
        return []
    joined = mask[1:] & mask[:-1] & (np.diff(stamps_ns) <= RUN_GAP_S * 1e9)
    starts = np.flatnonzero(mask & ~np.concatenate([[False], joined]))
    ends = np.flatnonzero(mask & ~np.concatenate([joined, [False]])) + 1
    return list(zip(starts.tolist(), ends.tolist(), strict=True))
