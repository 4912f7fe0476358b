"""Gain limit of a car from errors at several residual gains (docs/method.md#gain). Pure functions.

A network may increase the errors on a new car. A residual gain above 0 therefore needs driving with ground truth
that neither the network nor the vehicle file was fitted to, and a gain above 0.5 needs a significant result of a paired
block bootstrap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray

#: Residual gains to evaluate; the first is physics alone.
TRUSTS = (0.0, 0.25, 0.5, 0.75, 1.0)
#: Largest gain limit without a significant result (docs/method.md#gain).
UNCONFIRMED_CAP = 0.5
#: Minimum block length, as errors are correlated over seconds; a shorter drive is one block
#: (docs/method.md#evaluation).
BLOCK_S = 10.0
#: Minimum number of blocks; with fewer, a percentile interval is too narrow.
MIN_BLOCKS = 8
#: Lateral acceleration of excited driving, and its minimum duration for a decision.
EXCITED_M_S2, MIN_EXCITED_S = 2.0, 20.0
#: Largest relative increase of the RMSE over a lower gain that counts as "not worse".
TOLERANCE = 0.05
RESAMPLES = 4000
LEVEL = 0.95


@dataclass(frozen=True, slots=True, eq=False)
class BlockErrors:
    """Squared sideslip errors in blocks, paired: every stamp is used at all gains.

    Attributes
    ----------
    squares : [T, B], sums in rad², rows as in :data:`TRUSTS`. counts : [B], stamps.
    scored_s, excited_s : scored seconds, and scored seconds above :data:`EXCITED_M_S2`.
    lost : number of stamps with an estimate at gain 0 but not at a higher gain.
    """

    squares: FloatArray
    counts: FloatArray
    scored_s: float
    excited_s: float
    lost: int = 0


@dataclass(frozen=True, slots=True)
class Bound:
    """A difference of mean squares in deg² with its 95 % bounds; NaN where there are too few blocks."""

    value_deg2: float
    low_deg2: float
    high_deg2: float


@dataclass(frozen=True, slots=True)
class TrustDecision:
    """The gain limit, its reason, and the figures for it.

    Attributes
    ----------
    rmse_deg : by gain as in :data:`TRUSTS`. against_zero : squared error minus the squared error of gain 0.
    """

    cap: float
    reason: str
    rmse_deg: tuple[float, ...]
    against_zero: tuple[Bound, ...]
    blocks: int
    scored_s: float
    excited_s: float


def block_errors(
    errors: FloatArray, truth_sideslip: FloatArray, stamps_ns: IntArray, excited: BoolArray, *, block_s: float = BLOCK_S
) -> BlockErrors:
    """Return the errors of one drive in blocks of equal length, none shorter than ``block_s``.

    Parameters
    ----------
    errors : [T, N] in rad, NaN where not scored; only stamps with an estimate at gain 0 are used. For a stamp without
        an estimate at another gain, its error is the larger of gain 0's error and the sideslip, so that missing
        estimates at difficult stamps do not reduce the RMSE.
    truth_sideslip : [N] in rad. stamps_ns : int64 [N]. excited : [N].
    """
    scored = np.isfinite(errors[0])
    if not scored.any():
        return BlockErrors(np.zeros((errors.shape[0], 0)), np.zeros(0), 0.0, 0.0)
    kept, t = errors[:, scored], (stamps_ns[scored] - stamps_ns[scored][0]) * 1e-9
    charge = np.fmax(np.abs(kept[0]), np.abs(truth_sideslip[scored]))
    lost = ~np.isfinite(kept)
    squares = np.where(lost, charge, kept) ** 2
    count = max(1, int(t[-1] // block_s))
    block = np.minimum((t / max(t[-1], 1e-9) * count).astype(np.int64), count - 1)
    sums = np.stack([np.bincount(block, weights=row, minlength=count).astype(np.float64) for row in squares])
    counts = np.bincount(block, minlength=count).astype(np.float64)
    held = counts > 0
    step_s = float(np.median(np.diff(stamps_ns))) * 1e-9 if stamps_ns.shape[0] > 1 else 0.0
    return BlockErrors(
        squares=sums[:, held],
        counts=counts[held],
        scored_s=float(np.count_nonzero(scored)) * step_s,
        excited_s=float(np.count_nonzero(scored & excited)) * step_s,
        lost=int(np.count_nonzero(lost.any(axis=0))),
    )


def join_blocks(drives: list[BlockErrors]) -> BlockErrors:
    """Concatenate the blocks of several drives."""
    return BlockErrors(
        squares=np.concatenate([d.squares for d in drives], axis=1),
        counts=np.concatenate([d.counts for d in drives]),
        scored_s=math.fsum(d.scored_s for d in drives),
        excited_s=math.fsum(d.excited_s for d in drives),
        lost=sum(d.lost for d in drives),
    )


def decide_cap(errors: BlockErrors, *, seed: int = 0) -> TrustDecision:
    """Return the gain limit that the errors support.

    - Too little excited driving: 0.
    - The largest gain with a squared error significantly lower than at gain 0 and an RMSE at most :data:`TOLERANCE`
      above the best lower gain's, both by the 95 % bounds of a paired block bootstrap.
    - Else the largest gain up to :data:`UNCONFIRMED_CAP` with a lower squared error than gain 0.
    - Else 0.
    """
    squares, counts = errors.squares * math.degrees(1.0) ** 2, errors.counts
    blocks, total = int(counts.shape[0]), float(counts.sum())
    mean = squares.sum(axis=1) / total if total else np.full(len(TRUSTS), np.nan)
    draws = (
        np.random.default_rng(seed).multinomial(blocks, np.full(blocks, 1.0 / blocks), RESAMPLES) if blocks else None
    )

    def bound(row: FloatArray) -> Bound:
        value = float(row.sum() / total) if total else math.nan
        if draws is None or blocks < MIN_BLOCKS:
            return Bound(value, math.nan, math.nan)
        low, high = np.percentile((draws @ row) / (draws @ counts), [50.0 * (1.0 - LEVEL), 50.0 * (1.0 + LEVEL)])
        return Bound(value, float(low), float(high))

    lower = [int(np.argmin(mean[:i])) if total and i else 0 for i in range(len(TRUSTS))]
    against_zero = tuple(bound(row - squares[0]) for row in squares)
    tolerated = [bound(row - (1.0 + TOLERANCE) ** 2 * squares[b]) for row, b in zip(squares, lower, strict=True)]
    confirmed = [
        t
        for t, gain, more in zip(TRUSTS, against_zero, tolerated, strict=True)
        if t > 0.0 and gain.high_deg2 < 0.0 and more.high_deg2 <= 0.0
    ]
    cap, reason = _rule(errors, mean, against_zero[-1], max(confirmed, default=0.0), TRUSTS[lower[-1]], blocks)
    return TrustDecision(
        cap=cap,
        reason=reason,
        rmse_deg=tuple(float(v) for v in np.sqrt(mean)),
        against_zero=against_zero,
        blocks=blocks,
        scored_s=errors.scored_s,
        excited_s=errors.excited_s,
    )


def _rule(
    errors: BlockErrors, mean: FloatArray, gain: Bound, confirmed: float, best: float, blocks: int
) -> tuple[float, str]:
    """Return gain limit and reason; NaN bounds count as not significant. ``gain`` is the bound of gain 1."""
    if not errors.excited_s >= MIN_EXCITED_S:
        return 0.0, (
            f"too little to decide on: {errors.excited_s:.1f} s above {EXCITED_M_S2:g} m/s², at least "
            f"{MIN_EXCITED_S:g} s are needed"
        )
    if confirmed == TRUSTS[-1]:
        return 1.0, "the improvement at residual gain 1 is confirmed"
    gained = [t for t, m in zip(TRUSTS, mean, strict=True) if 0.0 < t <= UNCONFIRMED_CAP and m < mean[0]]
    if not gained and confirmed <= UNCONFIRMED_CAP:
        return 0.0, "no improvement over physics alone"
    if blocks < MIN_BLOCKS:
        why = f"{blocks} blocks are too few to confirm residual gain 1 ({MIN_BLOCKS} are needed)"
    elif gain.low_deg2 > 0.0:
        why = "residual gain 1 is confirmed to be worse"
    elif not gain.high_deg2 < 0.0:
        why = "the improvement at residual gain 1 is not confirmed"
    else:
        why = f"residual gain 1 may be more than {TOLERANCE:.0%} worse than residual gain {best:g}"
    if confirmed > UNCONFIRMED_CAP:
        return confirmed, f"the improvement at residual gain {confirmed:g} is confirmed; {why}"
    return max(gained), f"an improvement on the mean; {why}"
