"""Cells of speed x |a_y| x friction in a dataset, and a selection with limited driving time per cell.

A row belongs to the cell of its features. Each second of a drive has a pseudo-random number from the hash of log, seed
and second; in each cell, the seconds with the smallest numbers are selected. The selection is therefore independent of
the order of the drives, and an added drive replaces only seconds with larger numbers.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.car.vehicle import GRAVITY_M_S2
from pdhef_logtool.learning.network.residuals import ResidualRows
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray
from pdhef_logtool.residual_model.features import FEATURES
from pdhef_logtool.results.condition import Condition, parse_condition

#: Lower bin edges; the last bin of each has no upper edge.
SPEED_M_S, AY_M_S2, FRICTION = (0.0, 10.0, 20.0, 30.0), (0.0, 2.0, 4.0, 6.0), (0.0, 0.35, 0.65)
EDGES = {"speed_m_s": SPEED_M_S, "abs_ay_m_s2": AY_M_S2, "friction": FRICTION}
COUNT = len(SPEED_M_S) * len(AY_M_S2) * len(FRICTION)
#: Cell number of rows without features.
NO_CELL = -1
#: Resolution of the random numbers, exact in float32.
_STEP = 2.0**-24


#: Columns for conditions of ``--where``; ground truth is never an input, but may select training data.
COLUMNS = (*FEATURES, "truth_vx_m_s", "truth_vy_m_s")


def condition_of(text: str) -> Condition:
    """Read the condition of ``--where``; raises UsageError."""
    return parse_condition(text, COLUMNS, of_tracks=False)


@dataclass(frozen=True, slots=True, eq=False)
class Picked:
    """Condition, cell and random number of each row [N]."""

    chosen: BoolArray
    cell: NDArray[np.int16]
    draw: NDArray[np.float32]


def pick(rows: ResidualRows, condition: Condition | None = None, key: str = "") -> Picked:
    """Return condition (None: all rows), cell and random number of rows; ``key`` is of the random numbers."""
    chosen = np.ones(len(rows), dtype=np.bool_)
    if condition is not None:
        columns = dict(zip(COLUMNS, [*rows.features.T, *rows.truth_velocity.T], strict=True))
        chosen = condition.is_true(columns)
    return Picked(chosen, cell_of(rows.features), draw_of(rows.stamps_ns, key))


@dataclass(frozen=True, slots=True)
class Cell:
    """One cell: lower edges of speed, |a_y| and friction, and their upper edges, infinite for the last bin."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    @property
    def in_reach(self) -> bool:
        """Whether the friction allows its lateral acceleration."""
        return self.low[1] < self.high[2] * GRAVITY_M_S2


def cells() -> list[Cell]:
    """Return all cells in numerical order: speed changes first, friction last."""
    bins = [list(zip(edges, (*edges[1:], math.inf), strict=True)) for edges in EDGES.values()]
    speed, ay, friction = bins
    return [
        Cell((s[0], a[0], f[0]), (s[1], a[1], f[1])) for f in friction for a in ay for s in speed
    ]  # fmt: skip


def cell_of(features: FloatArray) -> NDArray[np.int16]:
    """Return the cell of each row of features [N, 15]; :data:`NO_CELL` for unknown features."""
    speed, ay, friction = (features[:, FEATURES.index(n)] for n in ("vx_m_s", "ay_m_s2", "friction"))
    is_finite = np.isfinite(speed) & np.isfinite(ay) & np.isfinite(friction)
    number = np.zeros(len(features), dtype=np.int16)
    for edges, values in ((FRICTION, friction), (AY_M_S2, np.abs(ay)), (SPEED_M_S, speed)):
        number = number * np.int16(len(edges)) + np.searchsorted(edges[1:], values, side="right").astype(np.int16)
    return np.where(is_finite, number, np.int16(NO_CELL))


def draw_of(stamps_ns: IntArray, key: str) -> NDArray[np.float32]:
    """Return the pseudo-random number in [0, 1) of the second of each stamp."""
    seconds, inverse = np.unique(stamps_ns // 1_000_000_000, return_inverse=True)
    drawn = [int.from_bytes(hashlib.sha256(f"{key}:{s}".encode()).digest()[:3], "big") * _STEP for s in seconds]
    return np.array(drawn, dtype=np.float32)[inverse]


def rows_by_cell(cell: NDArray[np.int16], used: BoolArray) -> IntArray:
    """Return the number of used rows in each cell."""
    return np.bincount(cell[used & (cell >= 0)], minlength=COUNT).astype(np.int64)


def draw_limits(
    drives: Iterable[tuple[NDArray[np.int16], NDArray[np.float32], float]], per_cell_s: float
) -> list[float]:
    """Return for each cell the largest random number to select, so that the selection lasts at most ``per_cell_s``.

    Parameters
    ----------
    drives : cell and random number of the usable rows of each drive, and its period in seconds; in any order.
    """
    draws = [np.empty(0, dtype=np.float32) for _ in range(COUNT)]
    lasts = [np.empty(0) for _ in range(COUNT)]
    limits = [1.0] * COUNT
    for cell, draw, period_s in drives:
        for number in np.unique(cell[cell >= 0]).tolist():
            drawn, rows = np.unique(draw[(cell == number) & (draw < limits[number])], return_counts=True)
            joined = np.concatenate([draws[number], drawn])
            order = np.argsort(joined, kind="stable")
            joined, seconds = joined[order], np.concatenate([lasts[number], rows * period_s])[order]
            beyond = np.cumsum(seconds) > per_cell_s * (1.0 + 1e-9)
            if beyond.any():
                limits[number] = float(joined[int(np.argmax(beyond))])
            kept = joined < limits[number]
            draws[number], lasts[number] = joined[kept], seconds[kept]
    return limits


def is_chosen(cell: NDArray[np.int16], draw: NDArray[np.float32], limits: Sequence[float]) -> BoolArray:
    """Return the rows below the limits of their cells."""
    chosen: BoolArray = (cell >= 0) & (draw < np.asarray(limits, dtype=np.float32)[cell])
    return chosen


def table_of(seconds: Mapping[str, Sequence[float]]) -> dict[str, Any]:
    """Return the entry of the manifest for cells: edges, and the seconds of each cell by split."""
    return {
        "edges": {name: list(edges) for name, edges in EDGES.items()},
        "order": "speed changes first, friction last",
        "usable_s": {split: [round(s, 3) for s in values] for split, values in seconds.items()},
        "empty": {
            split: [n for n, (cell, s) in enumerate(zip(cells(), values, strict=True)) if cell.in_reach and s == 0.0]
            for split, values in seconds.items()
        },
    }
