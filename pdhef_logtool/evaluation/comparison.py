"""Sideslip errors of several estimators on the same driving, compared by a bootstrap of blocks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.evaluation.bootstrap import Interval, block_bootstrap_difference, block_bootstrap_interval
from pdhef_logtool.evaluation.requirement_blocks import BLOCK_S
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """Errors [N] of one line of a table in rad, NaN where not scored, at stamps [N].

    ``inside`` [N]: within the 95 % interval; None where nothing was asked of intervals.
    """

    name: str
    error: FloatArray
    stamps_ns: IntArray
    inside: BoolArray | None = None

    @property
    def scored(self) -> int:
        """Stamps with an error."""
        return int(np.count_nonzero(np.isfinite(self.error)))


@dataclass(frozen=True, slots=True)
class Compared:
    """One line: RMSE in rad, the share of the stamps that any line scores, and RMSE less the yardstick's, paired.

    ``difference`` is None for the yardstick itself and for errors at other stamps. ``covered``: share of the errors
    inside their 95 % interval; None without.
    """

    name: str
    rmse: Interval
    share: float
    difference: Interval | None
    covered: float | None


def compare(lines: Sequence[Errors], yardstick: str | None) -> Iterator[Compared]:
    """Yield the lines that scored anything; ``yardstick`` names one of them, None: nothing is compared."""
    yard = next((line for line in lines if line.name == yardstick), None)
    most = max((line.scored for line in lines), default=0)
    for line in lines:
        if not line.scored:
            continue
        finite = np.isfinite(line.error)
        paired = yard is not None and yard is not line and np.array_equal(yard.stamps_ns, line.stamps_ns)
        yield Compared(
            name=line.name,
            rmse=block_bootstrap_interval(line.error, line.stamps_ns, block_s=BLOCK_S),
            share=line.scored / most,
            difference=block_bootstrap_difference(line.error, yard.error, line.stamps_ns, block_s=BLOCK_S)
            if paired and yard is not None
            else None,
            covered=None if line.inside is None else float(np.mean(line.inside[finite])),
        )


def end_to_end(stamps_ns: Sequence[IntArray]) -> IntArray:
    """Return the stamps of several slices, each moved behind the one before, so that no block contains two of them."""
    moved: list[IntArray] = []
    begin = 0
    for stamps in (s for s in stamps_ns if s.size):
        moved.append(stamps - stamps[0] + begin)
        begin = int(moved[-1][-1]) + round(BLOCK_S * 1e9)
    return np.concatenate(moved) if moved else np.empty(0, dtype=np.int64)
