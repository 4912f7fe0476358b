"""Where the ground truth differs from the sideslip reference by more than the uncertainty of the reference."""

from __future__ import annotations

import numpy as np

from pdhef_logtool.records.geometry import wrap_angle
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray
from pdhef_logtool.records.tracks import StateTrack

#: Duration of blocks over which differences are averaged, s; number of successive blocks, and of 1-sigmas, that make a
#: contradiction.
BLOCK_S, LEAST_BLOCKS, BEYOND_STD = 1.0, 3, 3.0
#: Share of equal neighbours that makes ground truth held; correlation with time that makes it drift.
HELD_SHARE, DRIFT_CORRELATION = 0.8, 0.8


def audit_truth(truth: StateTrack, reference: StateTrack, low_speed_m_s: float) -> tuple[str, ...]:
    """Return contradictions between ground truth [N] and the reference, as sentences."""
    seconds, difference, std, held = _blocks(truth, reference, low_speed_m_s)
    if len(seconds) < LEAST_BLOCKS:
        return ()
    beyond = np.abs(difference) > BEYOND_STD * std
    beyond &= _runs(beyond, seconds) >= LEAST_BLOCKS
    if not beyond.any():
        return ()
    difference = np.degrees(difference)
    where = f"from {seconds[beyond][0]:.0f} to {seconds[beyond][-1] + BLOCK_S:.0f} s of the log"
    uncertain = f"reference ± {np.degrees(np.sqrt(np.mean(std[beyond] ** 2))):.2f}°"
    share = f"{beyond.sum() * BLOCK_S:.0f} of {len(beyond) * BLOCK_S:.0f} s"
    contradiction = f"ground truth contradicts the estimated sideslip reference ({share}, {where}, {uncertain})"
    if np.median(held[beyond]) > HELD_SHARE:
        return (f"{contradiction}: it repeats its values there",)
    mean, spread = float(np.mean(difference)), float(np.std(difference))
    slope, _ = np.polyfit(seconds, difference, 1)
    if spread > 0.0 and abs(np.corrcoef(seconds, difference)[0, 1]) > DRIFT_CORRELATION:
        return (f"{contradiction}: it drifts by {60.0 * slope:+.2f}° per minute",)
    if spread < abs(mean) and beyond.mean() > 0.5:
        return (f"{contradiction}: it is turned by {mean:+.2f}°",)
    return (f"{contradiction}: mean difference {float(np.mean(difference[beyond])):+.2f}° there",)


def _blocks(truth: StateTrack, reference: StateTrack, low_speed_m_s: float) -> FloatArray:
    """Return by block [4, B]: start in s, mean difference and mean 1-sigma in rad, share of repeated ground truth."""
    if not len(reference):
        return np.empty((4, 0))
    used = truth.valid & reference.valid & (truth.vx_m_s > low_speed_m_s) & (reference.vx_m_s > low_speed_m_s)
    used &= np.isfinite(truth.sideslip_rad) & np.isfinite(reference.sideslip_std_rad)
    same = (np.diff(truth.vy_m_s, prepend=np.nan) == 0.0).astype(np.float64)
    columns = wrap_angle(truth.sideslip_rad - reference.sideslip_rad), reference.sideslip_std_rad, same
    number = (reference.stamps_ns[used] - reference.stamps_ns[0]) // round(BLOCK_S * 1e9)
    ids, inverse, counts = np.unique(number, return_inverse=True, return_counts=True)
    sums = np.zeros((len(ids), 3))
    np.add.at(sums, inverse, np.stack([c[used] for c in columns], axis=1))
    return np.vstack([ids * BLOCK_S, sums.T / counts])


def _runs(flags: BoolArray, start_s: FloatArray) -> IntArray:
    """Return the length of the run of true blocks, without a gap in time, that each block [B] is part of."""
    breaks = np.flatnonzero((np.diff(flags.astype(np.int64)) != 0) | (np.diff(start_s) > 1.5 * BLOCK_S)) + 1
    lengths = np.diff([0, *breaks, len(flags)])
    return np.asarray(np.repeat(lengths, lengths), dtype=np.int64)
