"""The selected estimate of a drive against the best physics, signal by signal, with a bootstrap of blocks of time.

Errors are those of :mod:`~pdhef_logtool.evaluation.metrics`, correlated over seconds, so that whole blocks are drawn
(:mod:`~pdhef_logtool.evaluation.bootstrap`). The best physics is the best by this drive's ground truth: a rival that
was chosen in hindsight, which favours no estimate.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.evaluation.blocks import row_blocks
from pdhef_logtool.evaluation.bootstrap import Interval, block_sums, rmse_difference_interval, rmse_interval
from pdhef_logtool.evaluation.comparison import BLOCK_S
from pdhef_logtool.evaluation.metrics import signal_error
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.records.tracks import StateTrack

#: What a drive is judged by, in the order in which it is given.
JUDGED_SIGNALS = ("sideslip_rad", "vy_m_s", "yaw_rate_rad_s", "vx_m_s")
#: Of fewer blocks no interval is given: with five, all of one sign come by chance in more than one of twenty drives.
LEAST_BLOCKS = 6
#: Of a longer drive blocks are longer.
_MOST_BLOCKS = 1000


@dataclass(frozen=True, slots=True)
class Standing:
    """The error of one estimator in one signal, in its unit.

    Attributes
    ----------
    rmse : None where nothing is scored. rival : the best physics; None where none is scored beside it.
    rival_rmse : of the rival, and ``difference`` the estimator's RMSE less the rival's, at the stamps of both.
    block_s : length of a block; the bounds of intervals are NaN below :data:`LEAST_BLOCKS` of them.
    """

    signal: str
    estimator: str
    rmse: Interval | None
    rival: str | None
    rival_rmse: float | None
    difference: Interval | None
    block_s: float


def standings(
    name: str, rivals: Sequence[str], read: Callable[[str], StateTrack | None], truth: StateTrack, low_speed_m_s: float
) -> list[Standing]:
    """Return how an estimator compares in each of :data:`JUDGED_SIGNALS`.

    Parameters
    ----------
    rivals : estimators on physics alone. read : returns the track of a name, at the stamps of ``truth``.
    """
    track = read(name)
    assert track is not None
    block_s = BLOCK_S * max(1, -(-_duration_s(truth) // (BLOCK_S * _MOST_BLOCKS)))
    results = []
    for signal in JUDGED_SIGNALS:

        def sums(*tracks: StateTrack, signal: str = signal) -> tuple[FloatArray, FloatArray]:
            return _sums(tracks, truth, signal, low_speed_m_s, block_s)

        rmse = _with_bounds(rmse_interval(*sums(track)))
        best: tuple[float, str, Interval] | None = None
        for rival in rivals:
            other = read(rival)
            assert other is not None
            squares, counts = sums(track, other)
            if rmse is None or not counts.size:
                continue
            theirs = float(np.sqrt(squares[1].sum() / counts.sum()))
            if best is None or theirs < best[0]:
                best = theirs, rival, rmse_difference_interval(squares, counts)
        rival_rmse, chosen, difference = best or (None, None, None)
        bounded = None if difference is None else _with_bounds(difference)
        results.append(Standing(signal, name, rmse, chosen, rival_rmse, bounded, block_s))
    return results


def _duration_s(track: StateTrack) -> float:
    n = len(track)
    if not n:
        return 0.0
    return float(track.rows(n - 1, n).stamps_ns[0] - track.rows(0, 1).stamps_ns[0]) * 1e-9


def _with_bounds(interval: Interval) -> Interval | None:
    if interval.blocks == 0:
        return None
    nan = float("nan")
    return interval if interval.blocks >= LEAST_BLOCKS else Interval(interval.value, nan, nan, interval.blocks)


def _sums(
    tracks: Sequence[StateTrack], truth: StateTrack, signal: str, low_speed_m_s: float, block_s: float
) -> tuple[FloatArray, FloatArray]:
    """Return sums of squared errors [tracks, K] and counts [K] by block, of the stamps at which all are scored."""
    first_ns: int | None = None
    by_block: dict[int, FloatArray] = {}
    for a, b in row_blocks(len(truth)):
        part = truth.rows(a, b)
        stamps = part.stamps_ns
        errors = [signal_error(t.rows(a, b), part, signal, low_speed_m_s) for t in tracks]
        finite = np.isfinite(np.stack(errors)).all(axis=0)
        if first_ns is None and finite.any():
            first_ns = int(stamps[np.argmax(finite)])
        sums, counts, numbers = block_sums(errors, stamps, block_s, first_ns)
        for number, column in zip(numbers.tolist(), np.vstack([sums, counts]).T, strict=True):
            by_block[number] = by_block[number] + column if number in by_block else column
    rows = np.stack([*by_block.values()], axis=1) if by_block else np.zeros((len(tracks) + 1, 0))
    return rows[:-1], rows[-1]
