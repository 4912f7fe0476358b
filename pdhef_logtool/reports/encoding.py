"""Series as a page contains them: envelopes on a grid of cells, quantised, as differences, deflated, in base64.

The page undoes it (``decode`` of ``report.js``): 36,000 cells of two values cost 50 to 120 kB.
"""

from __future__ import annotations

import base64
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.records.signals import FloatArray, IntArray

#: Width of a cell: 10 Hz, finer for a drive below ten minutes, coarser for one above an hour.
CELL_NS = 100_000_000
MOST_CELLS = 36_000
_FINE_CELLS = 6_000
#: A cell contains at least so many steps between stamps, so that stamps that come a little late leave none empty.
_STEPS_A_CELL = 2.5
#: Quantised values are 0 to LEVELS; GAP represents "not known".
LEVELS = 65_534
GAP = 65_535


@dataclass(frozen=True, slots=True)
class Grid:
    """Cells of equal width over a drive: cell i is [start_ns + i cell_ns, start_ns + (i + 1) cell_ns)."""

    start_ns: int
    cell_ns: int
    cells: int

    @property
    def cell_s(self) -> float:
        """Width of a cell."""
        return self.cell_ns * 1e-9

    def seconds(self, stamp_ns: int) -> float:
        """Return a stamp in seconds from the grid's start."""
        return (stamp_ns - self.start_ns) * 1e-9


def grid_of(stamps_ns: IntArray) -> Grid:
    """Return the grid for stamps [N], N ≥ 1, in order of time."""
    start, end = int(stamps_ns[0]), int(stamps_ns[-1])
    duration = end - start
    step = float(np.median(np.diff(stamps_ns))) if len(stamps_ns) > 1 else 0.0
    wanted = min(CELL_NS, duration / _FINE_CELLS)
    cell = max(int(_STEPS_A_CELL * step), int(wanted), -(-duration // (MOST_CELLS - 1)), 1)
    return Grid(start, cell, duration // cell + 1)


class Envelope:
    """The least and the largest value of each cell in the order in which they came: ``values`` [cells, 2].

    A cell without a known value is NaN; unknown ones beside known ones do not count. Values come block by block.
    """

    def __init__(self, grid: Grid) -> None:
        self._grid = grid
        self.values: FloatArray = np.full((grid.cells, 2), np.nan)

    def add(self, stamps_ns: IntArray, values: FloatArray) -> None:
        """Take the next values [M] in order of time."""
        cell = (stamps_ns - self._grid.start_ns) // self._grid.cell_ns
        usable = np.isfinite(values) & (cell >= 0) & (cell < self._grid.cells)
        if not usable.any():
            return
        cell, values = cell[usable], values[usable]
        before = self.values[cell[0]]
        if np.isfinite(before[0]):  # what came in the block before of the cell that both share
            cell, values = np.concatenate([[cell[0]] * 2, cell]), np.concatenate([before, values])
        begins = np.flatnonzero(np.diff(cell, prepend=-1))
        sizes = np.diff(begins, append=len(values))
        low, high = (f.reduceat(values, begins) for f in (np.minimum, np.maximum))
        first_low, first_high = (_first(values == np.repeat(extreme, sizes), begins) for extreme in (low, high))
        falls = first_high < first_low
        self.values[cell[begins]] = np.stack([np.where(falls, high, low), np.where(falls, low, high)], axis=1)

    @property
    def largest(self) -> FloatArray:
        """The largest value of each cell [cells]."""
        return np.asarray(np.max(self.values, axis=1), dtype=np.float64)

    @property
    def least(self) -> FloatArray:
        """The least value of each cell [cells]."""
        return np.asarray(np.min(self.values, axis=1), dtype=np.float64)


def _first(hit: NDArray[np.bool_], begins: IntArray) -> IntArray:
    """Return the place of the first hit of each group; each has one."""
    places = np.flatnonzero(hit)
    result: IntArray = places[np.searchsorted(places, begins)]
    return result


class FirstKnown:
    """Picks the first stamp of each cell at which all is known, block by block."""

    def __init__(self, grid: Grid) -> None:
        self._grid, self._last = grid, -1

    def rows(self, stamps_ns: IntArray, is_known: NDArray[np.bool_]) -> IntArray:
        """Return the rows of the next block [M], at most one a cell."""
        cell = (stamps_ns - self._grid.start_ns) // self._grid.cell_ns
        rows = np.flatnonzero(is_known & (cell > self._last) & (cell < self._grid.cells))
        if not len(rows):
            return rows
        self._last = int(cell[rows[-1]])
        return rows[np.flatnonzero(np.diff(cell[rows], prepend=-1))]


class Means:
    """Means over spans of equal length from the grid's start, block by block."""

    def __init__(self, grid: Grid, span_s: float) -> None:
        self._grid, self._span_ns = grid, int(span_s * 1e9)
        self._sums = np.zeros(grid.cells * grid.cell_ns // self._span_ns + 1)
        self._counts = np.zeros_like(self._sums)

    def add(self, stamps_ns: IntArray, values: FloatArray) -> None:
        """Take the next values [M]; unknown ones do not count."""
        is_finite = np.isfinite(values)
        span = np.clip((stamps_ns[is_finite] - self._grid.start_ns) // self._span_ns, 0, len(self._sums) - 1)
        self._sums += np.bincount(span, weights=values[is_finite], minlength=len(self._sums))
        self._counts += np.bincount(span, minlength=len(self._sums))

    @property
    def values(self) -> FloatArray:
        """The mean at each cell [cells]; NaN where less than half of what a span usually has is known."""
        made = np.full(len(self._sums), np.nan)
        if self._counts.any():
            enough = self._counts > 0.5 * np.median(self._counts[self._counts > 0])
            made[enough] = self._sums[enough] / self._counts[enough]
        middle = np.arange(self._grid.cells) * self._grid.cell_ns + self._grid.cell_ns // 2
        return np.asarray(made[middle // self._span_ns], dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Encoded:
    """A series as text: value = low + step q, with q of 0 to LEVELS, GAP where it is not known."""

    low: float
    step: float
    count: int
    base64: str


def encode(values: FloatArray, resolution: float = 0.0) -> Encoded:
    """Return values [M] or [M, 2] (row by row) as text; NaN and infinities are gaps.

    ``resolution``: what nobody sees in the unit of the values; noise below it is not stored.
    """
    flat = np.ravel(values)
    is_finite = np.isfinite(flat)
    inside = flat[is_finite]
    low = float(inside.min()) if inside.size else 0.0
    span = float(inside.max()) - low if inside.size else 0.0
    step = max(span / LEVELS, resolution) or 1.0
    q = np.full(len(flat), GAP, dtype=np.uint16)
    q[is_finite] = np.clip(np.rint((inside - low) / step), 0, LEVELS).astype(np.uint16)
    # Differences modulo 2¹⁶, their sign in the lowest bit, all low bytes before all high ones: zeros are together.
    steps = np.diff(q, prepend=np.uint16(0)).view(np.int16)
    folded = ((steps << 1) ^ (steps >> 15)).view(np.uint16)
    planes = (folded & 0xFF).astype(np.uint8).tobytes() + (folded >> 8).astype(np.uint8).tobytes()
    return Encoded(low, step, len(flat), base64.b64encode(zlib.compress(planes, 7)).decode("ascii"))


def decode(encoded: Encoded) -> FloatArray:
    """Return the values [M] of a text again, as the page does; gaps are NaN."""
    planes = np.frombuffer(zlib.decompress(base64.b64decode(encoded.base64)), dtype=np.uint8).astype(np.uint16)
    folded = planes[: encoded.count] | planes[encoded.count :] << 8
    steps = (folded >> 1) ^ -(folded & 1)
    q = np.cumsum(steps, dtype=np.uint16)
    return np.where(q == GAP, np.nan, encoded.low + encoded.step * q)
