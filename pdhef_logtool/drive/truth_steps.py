"""Steps of a sensor's bias, gain or delay against the ground truth in mid-drive: reported, and not corrected.

Ground truth must not improve the signals of the estimators. Over means of ``BLOCK_S``, the difference y between sensor
and ground truth x is regressed on what constant errors do (1, x, and the change of x over the block, which is what a
delay does to the mean), and on a step of one of them at each block. The F statistic of the likeliest step counts with
the variance of what remains, increased for its correlation from block to block (docs/method.md#changes). A bank of the
road resembles a bias and a gain of a_y, but begins slowly, while the samples of a changed sensor step.
"""

import numpy as np

from pdhef_logtool.drive.check_table import TABLE
from pdhef_logtool.drive.sensor_changes import SensorChange, cells_of, part_means, sample_steps
from pdhef_logtool.records.signals import LEAST_DIVISOR, NS_PER_S, S_PER_NS, FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack

#: Duration of a mean, least means on each side of a step, and share of a block that must have samples.
BLOCK_S, LEAST_BLOCKS, FILLED = 1.0, 3, 0.8
#: The ground truth drives faster than this, m/s.
MOVING_M_S = 0.5
#: Least F statistic, after the correlation of the remainder.
EVIDENCE = 40.0
#: Least steps that are reported, by signal and kind.
LEAST: dict[str, dict[str, float]] = TABLE["SIGNAL.change"]["least"]
#: Deviation that every remainder is assumed to have, and share of a jump that neighbouring samples have, by signal.
LEAST_STD = {"yaw_rate_rad_s": 0.001, "ay_m_s2": 0.05, "speed_m_s": 0.05}
SHARP = {"yaw_rate_rad_s": 0.5, "ay_m_s2": 0.75}


def steps_from_truth(signals: Signals, truth: StateTrack) -> tuple[SensorChange, ...]:
    """Return for each sensor of signals [N] its step from the ground truth in mid-drive, if there is one."""
    if not len(signals):
        return ()
    changes, end_ns = [], int(signals.stamps_ns[-1]) + 1
    for name, (y, x, turned) in _differences(signals, truth).items():
        columns = {"jump": np.ones(len(y)), "gain": x, "delay": -turned}
        table = np.column_stack([*columns.values()])
        rows = np.flatnonzero(np.isfinite(y) & np.isfinite(table).all(axis=1))
        if len(rows) < 2 * LEAST_BLOCKS + table.shape[1]:
            continue
        basis = np.linalg.qr(table[rows])[0]
        steps = {kind: _likeliest(y[rows], basis, columns[kind][rows], LEAST_STD[name]) for kind in LEAST[name]}
        kind = max(steps, key=lambda k: steps[k][0])
        evidence, block, size, std = steps[kind]
        if evidence < EVIDENCE or abs(size) < LEAST[name][kind]:
            continue
        start_ns = int(signals.stamps_ns[0]) + round(rows[block] * BLOCK_S * NS_PER_S)
        if kind == "jump":
            share, at_ns = _sharpest(signals, name, start_ns, size)
            if share < SHARP[name]:
                continue
            start_ns = at_ns
        changes.append(SensorChange(name, f"{kind}_from_truth", start_ns, end_ns, end_ns, size, std))
    return tuple(changes)


def _sharpest(signals: Signals, name: str, start_ns: int, size: float) -> tuple[float, int]:
    """Return the largest step of neighbouring samples near a time over ``size``, and the time of the best match."""
    cells = cells_of(signals)
    near = np.array([start_ns - BLOCK_S * NS_PER_S, start_ns + BLOCK_S * NS_PER_S]).astype(np.int64)
    first, last = cells.of_stamp[np.searchsorted(signals.stamps_ns, near).clip(0, len(signals) - 1)]
    shares = np.nan_to_num(sample_steps(getattr(signals, name), cells)[first : last + 1] / size)
    likest = int(np.argmin(np.abs(shares - 1.0)))
    return float(shares.max()), cells.time_of(first + likest)


def _differences(signals: Signals, truth: StateTrack) -> dict[str, tuple[FloatArray, FloatArray, FloatArray]]:
    """Return for each sensor its mean difference to ground truth x, x, and the change of x over a block [J]."""
    block = (signals.stamps_ns - signals.stamps_ns[0]) // round(BLOCK_S * NS_PER_S)
    count = int(block[-1]) + 1
    first = np.searchsorted(block, np.arange(count))
    seconds = np.diff(signals.stamps_ns[first] * S_PER_NS, append=np.nan)
    seconds = np.where(seconds > 0.0, seconds, np.nan)  # a block in a gap

    def mean(column: FloatArray) -> FloatArray:
        return part_means(column, block, count, FILLED)

    def gained(column: FloatArray) -> FloatArray:
        return np.asarray(np.diff(column[first], append=np.nan) / seconds)

    speed, turning = truth.vx_m_s, truth.vx_m_s * truth.yaw_rate_rad_s
    lateral = gained(truth.vy_m_s) + mean(turning)
    moving = np.where(mean(speed) > MOVING_M_S, 1.0, np.nan)
    sides = {
        "yaw_rate_rad_s": (mean(truth.yaw_rate_rad_s), gained(truth.yaw_rate_rad_s)),
        "ay_m_s2": (lateral, gained(turning)),
        "speed_m_s": (mean(speed), gained(speed)),
    }
    return {name: (moving * (mean(getattr(signals, name)) - x), x, turned) for name, (x, turned) in sides.items()}


def _likeliest(y: FloatArray, basis: FloatArray, u: FloatArray, least_std: float) -> tuple[float, int, float, float]:
    """Return F statistic, first block, size and 1-sigma of the likeliest step.

    It is a step of the coefficient of ``u`` [J] in ``y`` [J] beside an orthonormal basis [J, m].
    """
    rest = y - basis @ (basis.T @ y)
    # The column of a step is u from block k on: its products with others are sums from there.
    behind = np.cumsum((u[:, None] * np.column_stack([rest, u, basis]))[::-1], axis=0)[::-1]
    power = behind[:, 1] - (behind[:, 2:] ** 2).sum(axis=1)
    power = np.where(power > 1e-3 * behind[0, 1], power, np.inf)
    explained = behind[:, 0] ** 2 / power
    explained[:LEAST_BLOCKS] = explained[len(y) - LEAST_BLOCKS + 1 :] = 0.0
    k = int(np.argmax(explained))
    size = float(behind[k, 0] / power[k])
    left = rest - size * (u * (np.arange(len(y)) >= k) - basis @ behind[k, 2:])
    square = float(left @ left)
    correlation = float(np.clip(left[1:] @ left[:-1] / max(square, LEAST_DIVISOR), 0.0, 0.95))
    variance = (square / len(y) + least_std**2) * (1.0 + correlation) / (1.0 - correlation)
    return float(explained[k] / variance), k, size, float(np.sqrt(variance / power[k]))
