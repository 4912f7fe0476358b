"""Selected estimate of a drive compared with the best physics estimate, by signal.

The blocks and the interval of an RMSE are as for requirements (:mod:`~pdhef_logtool.evaluation.requirement_blocks`);
whole blocks are drawn for the interval of a difference (:mod:`~pdhef_logtool.evaluation.bootstrap`). The best physics
estimate is the one with the lowest error against this drive's ground truth, which is an advantage over the selected
estimate.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.evaluation.bootstrap import Interval, rmse_difference_interval
from pdhef_logtool.evaluation.requirement_blocks import BLOCK_S, RequirementBlocks, ScoredDrive, requirement_blocks
from pdhef_logtool.evaluation.requirement_bounds import LEAST_BLOCKS, pooled
from pdhef_logtool.evaluation.validation_plan import Requirement
from pdhef_logtool.records.tracks import StateTrack

#: Compared signals, in the order of output.
JUDGED_SIGNALS = ("sideslip_rad", "vy_m_s", "yaw_rate_rad_s", "vx_m_s")


@dataclass(frozen=True, slots=True)
class Standing:
    """The error of one estimator in one signal, in its unit.

    Attributes
    ----------
    rmse : None without scored stamps. rival : the best physics estimate; None if no other one is scored.
    rival_rmse : of the rival. difference : RMSE of the estimator minus RMSE of the rival, at the stamps of both.
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
    """Return the comparison of an estimator in each of :data:`JUDGED_SIGNALS`.

    Parameters
    ----------
    rivals : estimators on physics alone. read : returns a track by name, at the stamps of ``truth``.
    """
    everywhere = {"all": np.ones(len(truth), dtype=np.bool_)}
    drive = ScoredDrive(read, truth, everywhere, low_speed_m_s)
    results = []
    for signal in JUDGED_SIGNALS:
        alone = _blocks(signal, name, None, drive)
        best: tuple[float, str, Interval] | None = None
        for rival in rivals:
            if (both := _blocks(signal, name, rival, drive)) is not None:
                counts = np.array(both.n, dtype=np.float64)
                squares = counts * np.array([both.value, both.baseline]) ** 2
                theirs = float(np.sqrt(squares[1].sum() / counts.sum()))
                if best is None or theirs < best[0]:
                    best = theirs, rival, rmse_difference_interval(squares, counts)
        rival_rmse, chosen, difference = best or (None, None, None)
        bounded = None if difference is None else _with_bounds(difference)
        rmse, block_s = (None, BLOCK_S) if alone is None else (_rmse(alone), alone.block_s)
        results.append(Standing(signal, name, rmse, chosen, rival_rmse, bounded, block_s))
    return results


def _blocks(signal: str, name: str, rival: str | None, drive: ScoredDrive) -> RequirementBlocks | None:
    return next(iter(requirement_blocks([Requirement("", "", signal, baseline=rival)], name, drive)), None)


def _rmse(blocks: RequirementBlocks) -> Interval:
    counts, values = np.array(blocks.n, dtype=np.float64), np.array(blocks.value)
    of = pooled(counts, values, None, squares=True, positive=True, level=0.95)
    return _with_bounds(Interval(of.value, of.low, of.high, of.units))


def _with_bounds(interval: Interval) -> Interval:
    nan = float("nan")
    return interval if interval.blocks >= LEAST_BLOCKS else Interval(interval.value, nan, nan, interval.blocks)
