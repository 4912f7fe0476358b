"""Block bootstrap within one drive. Blocks are drawn instead of samples, because errors are correlated over seconds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdhef_logtool.records.signals import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Interval:
    """A value with its percentile interval. ``blocks``: number of blocks; below 2 the bounds are NaN."""

    value: float
    low: float
    high: float
    blocks: int


def block_bootstrap_difference(
    errors: FloatArray,
    other_errors: FloatArray,
    stamps_ns: IntArray,
    *,
    block_s: float = 10.0,
    n: int = 1000,
    seed: int = 0,
) -> Interval:
    """Return RMSE(errors) − RMSE(other_errors) with its interval, over the same stamps and draws.

    ``errors`` belong to the better estimator if the whole interval is below 0. ``block_s``: at least 10 s
    (docs/method.md#evaluation). ``n``: number of resamples.
    """
    sums, counts = _block_sums([errors, other_errors], stamps_ns, block_s)
    nan, blocks = float("nan"), int(counts.shape[0])
    if blocks == 0:
        return Interval(nan, nan, nan, 0)

    def difference(squares: FloatArray, stamps: FloatArray) -> FloatArray:
        first, second = np.sqrt(squares / stamps)
        return np.asarray(first - second)

    value = float(difference(sums.sum(axis=1), counts.sum()))
    if blocks < 2:
        return Interval(value, nan, nan, blocks)
    draws = np.random.default_rng(seed).multinomial(blocks, np.full(blocks, 1.0 / blocks), size=n)
    low, high = np.percentile(difference(sums @ draws.T, draws @ counts), [2.5, 97.5])
    return Interval(value, float(low), float(high), blocks)


def _block_sums(columns: list[FloatArray], stamps_ns: IntArray, block_s: float) -> tuple[FloatArray, FloatArray]:
    """Return sums of squares [columns, K] and samples [K] of the blocks that contain stamps with all columns [N]."""
    finite = np.isfinite(np.stack(columns)).all(axis=0)
    if not finite.any():
        return np.zeros((len(columns), 0)), np.zeros(0)
    block = (stamps_ns[finite] - stamps_ns[finite][0]) // round(block_s * 1e9)
    _, index = np.unique(block, return_inverse=True)
    sums = [np.bincount(index, weights=c[finite] ** 2) for c in columns]
    return np.stack(sums).astype(np.float64), np.bincount(index).astype(np.float64)
