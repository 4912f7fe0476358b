"""Sensors that step away from the ground truth in mid-drive: found in the whole drive, reported, and not corrected.

Ground truth must not improve the signals of the estimators. Over means of ``BLOCK_S``, the difference between sensor
and ground truth is regressed on what explains it without a step (a bias, and for a_y the gain by body roll) and on a
step of either sign at each block. The F statistic of the likeliest step counts with the variance of what remains,
increased for its correlation from block to block (docs/method.md#changes). A bank of the road is no change of a_y: it
begins slowly, while the samples of a changed sensor step.
"""

from __future__ import annotations

import numpy as np

from pdhef_logtool.drive.sensor_changes import SensorChange, cells_of, sample_steps
from pdhef_logtool.records.signals import FloatArray, IntArray, Signals
from pdhef_logtool.records.tracks import StateTrack

#: Duration of a mean, least means on each side of a step, and share of a block that must have samples.
BLOCK_S, LEAST_BLOCKS, FILLED = 1.0, 3, 0.8
#: Least speed for the gain of a speed, m/s; others are compared in motion.
LEAST_SPEED_M_S, MOVING_M_S = 3.0, 0.5
#: Least F statistic, after the correlation of the remainder.
EVIDENCE = 30.0
#: Least steps that are reported, deviation that every remainder is assumed to have, and share of the step that
#: neighbouring samples have, by signal.
LEAST = {"yaw_rate_rad_s": (0.006, 0.001, 0.5), "ay_m_s2": (0.4, 0.05, 0.75), "speed_m_s": (0.03, 0.005, 0.5)}


def steps_from_truth(signals: Signals, truth: StateTrack) -> tuple[SensorChange, ...]:
    """Return for each sensor of signals [N] its step from the ground truth in mid-drive, if there is one."""
    if not len(signals):
        return ()
    found, cells, began_ns = [], cells_of(signals), int(signals.stamps_ns[0])
    end_ns = int(signals.stamps_ns[-1]) + 1
    for name, (y, x) in _differences(signals, truth).items():
        rows = np.flatnonzero(np.isfinite(y) & np.isfinite(x).all(axis=1))
        if len(rows) < 2 * LEAST_BLOCKS + x.shape[1]:
            continue
        least, least_std, sharp = LEAST[name]
        k, size, std, evidence = _likeliest_step(y[rows], x[rows], least_std)
        if evidence < EVIDENCE or abs(size) < least:
            continue
        # Steps of the samples in the block before, in the block and behind it, as share of the step.
        near = [began_ns + round(b * BLOCK_S * 1e9) for b in (rows[k - 1], rows[k] + 1)]
        first, last = cells.of_stamp[np.searchsorted(signals.stamps_ns, near).clip(0, len(signals) - 1)]
        unit = np.maximum(cells.speed[first : last + 1], LEAST_SPEED_M_S) if name == "speed_m_s" else 1.0
        shares = np.nan_to_num(sample_steps(getattr(signals, name), cells)[first : last + 1] / (size * unit))
        if shares.max() > sharp:
            kind = "gain_from_truth" if name == "speed_m_s" else "jump_from_truth"
            start_ns = cells.time_of(first + int(np.argmin(np.abs(shares - 1.0))))
            found.append(SensorChange(name, kind, start_ns, end_ns, end_ns, size, std))
    return tuple(found)


def _differences(signals: Signals, truth: StateTrack) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return for each sensor the difference to the ground truth [J] and the columns that explain it [J, m]."""
    block = (signals.stamps_ns - signals.stamps_ns[0]) // round(BLOCK_S * 1e9)
    count = int(block[-1]) + 1

    def mean(column: FloatArray) -> FloatArray:
        return _means(column, block, count)

    speed = mean(signals.speed_m_s)
    ones = np.ones((count, 1))
    moving = np.where(mean(truth.vx_m_s) > MOVING_M_S, 1.0, np.nan)
    first = np.searchsorted(block, np.arange(count))
    gained = np.diff(truth.vy_m_s[first], append=np.nan) / np.diff(signals.stamps_ns[first] * 1e-9, append=np.nan)
    turn = gained + mean(truth.vx_m_s * truth.yaw_rate_rad_s)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.log(
            np.where(np.minimum(speed, mean(truth.vx_m_s)) > LEAST_SPEED_M_S, speed / mean(truth.vx_m_s), np.nan)
        )
    return {
        "yaw_rate_rad_s": (moving * (mean(signals.yaw_rate_rad_s) - mean(truth.yaw_rate_rad_s)), ones),
        "ay_m_s2": (moving * (mean(signals.ay_m_s2) - turn), np.column_stack([ones, turn])),
        "speed_m_s": (ratio, ones),
    }


def _means(column: FloatArray, block: IntArray, count: int) -> FloatArray:
    """Return the means of a column [N] over blocks [J]; NaN where too many samples are missing."""
    finite = np.isfinite(column)
    samples = np.bincount(block[finite], minlength=count)
    total = np.bincount(block[finite], weights=column[finite], minlength=count)
    return np.where(samples > FILLED * np.bincount(block, minlength=count), total / np.maximum(samples, 1), np.nan)


def _likeliest_step(y: FloatArray, x: FloatArray, least_std: float) -> tuple[int, float, float, float]:
    """Return the block, size, 1-sigma and F statistic of the likeliest step of ``y`` [J] beside ``x`` [J, m]."""
    basis = np.linalg.qr(x)[0]
    rest = y - basis @ (basis.T @ y)
    # A step is 1 from block k on: its products with all columns are their sums from there.
    behind = np.cumsum(np.column_stack([rest, np.ones(len(y)), basis])[::-1], axis=0)[::-1]
    power = np.maximum(behind[:, 1] - (behind[:, 2:] ** 2).sum(axis=1), 1e-9)
    explained = behind[:, 0] ** 2 / power
    explained[:LEAST_BLOCKS] = explained[len(y) - LEAST_BLOCKS + 1 :] = 0.0
    k = int(np.argmax(explained))
    size = float(behind[k, 0] / power[k])
    left = rest - size * ((np.arange(len(y)) >= k) - basis @ behind[k, 2:])
    correlation = float(np.clip(left[1:] @ left[:-1] / max(left @ left, 1e-12), 0.0, 0.95))
    variance = (left @ left / len(y) + least_std**2) * (1.0 + correlation) / (1.0 - correlation)
    return k, size, float(np.sqrt(variance / power[k])), float(explained[k] / variance)
