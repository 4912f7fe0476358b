"""Encode series for a page: envelopes on a grid of cells, quantised, as differences, deflated, in base64.

The page decodes it (``decode`` of ``report.js``): 36,000 cells of two values take 50 to 120 kB.
"""

import base64
import zlib
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray

#: Width of a cell: 10 Hz, finer for a drive below ten minutes, coarser above an hour.
CELL_NS = 100_000_000
MOST_CELLS = 36_000
_FINE_CELLS = 6_000
#: Minimum cell width in steps between stamps, so that late stamps leave no cell empty.
_STEPS_A_CELL = 2.5
#: Quantised values are 0 to LEVELS; GAP is the code for unknown values.
LEVELS = 65_534
GAP = 65_535


@dataclass(frozen=True, slots=True)
class Grid:
    """Cells of equal width over a drive: cell i is [start_ns + i cell_ns, start_ns + (i + 1) cell_ns)."""

    start_ns: int
    cell_ns: int
    cells: int


def grid_of(stamps_ns: IntArray) -> Grid:
    """Return the grid for ascending stamps [N], N ≥ 1."""
    start, end = int(stamps_ns[0]), int(stamps_ns[-1])
    duration = end - start
    step = float(np.median(np.diff(stamps_ns))) if len(stamps_ns) > 1 else 0.0
    wanted = min(CELL_NS, duration / _FINE_CELLS)
    cell = max(int(_STEPS_A_CELL * step), int(wanted), -(-duration // (MOST_CELLS - 1)), 1)
    return Grid(start, cell, duration // cell + 1)


def envelope(grid: Grid, stamps_ns: IntArray, values: FloatArray) -> FloatArray:
    """Return the smallest and largest value [N] in each cell, in the order of their occurrence, [cells, 2].

    A cell without a finite value is NaN.
    """
    result: FloatArray = np.full((grid.cells, 2), np.nan)
    cell, inside = _cells(grid, stamps_ns, np.isfinite(values))
    if not len(cell):
        return result
    values = values[inside]
    begins = np.flatnonzero(np.diff(cell, prepend=-1))
    sizes = np.diff(begins, append=len(values))
    low, high = (f.reduceat(values, begins) for f in (np.minimum, np.maximum))
    first_low, first_high = (_first(values == np.repeat(extreme, sizes), begins) for extreme in (low, high))
    falls = first_high < first_low
    result[cell[begins]] = np.stack([np.where(falls, high, low), np.where(falls, low, high)], axis=1)
    return result


def first_known(grid: Grid, stamps_ns: IntArray, is_known: BoolArray) -> IntArray:
    """Return the rows of the first known stamp of each cell."""
    cell, rows = _cells(grid, stamps_ns, is_known)
    return rows[np.flatnonzero(np.diff(cell, prepend=-1))]


def _cells(grid: Grid, stamps_ns: IntArray, is_known: BoolArray) -> tuple[IntArray, IntArray]:
    """Return the cells of the known stamps inside the grid, and their rows."""
    cell = (stamps_ns - grid.start_ns) // grid.cell_ns
    rows = np.flatnonzero(is_known & (cell >= 0) & (cell < grid.cells))
    return cell[rows], rows


def _first(hit: BoolArray, begins: IntArray) -> IntArray:
    """Return the index of the first hit of each group; each group has one."""
    places = np.flatnonzero(hit)
    return places[np.searchsorted(places, begins)]


def encode(values: FloatArray, resolution: float = 0.0) -> tuple[str, dict[str, float]]:
    """Return values [M] or [M, 2] (row by row) as text, and its scale; NaN and infinities are gaps.

    A value is low + step q, with q of 0 to LEVELS, or GAP for unknown values; the scale also has their ``count``.
    ``resolution``: minimum quantisation step, so that invisible noise is not stored.
    """
    flat = np.ravel(values)
    is_finite = np.isfinite(flat)
    inside = flat[is_finite]
    low = float(inside.min()) if inside.size else 0.0
    span = float(inside.max()) - low if inside.size else 0.0
    step = max(span / LEVELS, resolution) or 1.0
    q = np.full(len(flat), GAP, dtype=np.uint16)
    q[is_finite] = np.clip(np.rint((inside - low) / step), 0, LEVELS).astype(np.uint16)
    # Differences modulo 2¹⁶ with the sign in the lowest bit, and low bytes before high ones, compress better.
    steps = np.diff(q, prepend=np.uint16(0)).view(np.int16)
    folded = ((steps << 1) ^ (steps >> 15)).view(np.uint16)
    planes = (folded & 0xFF).astype(np.uint8).tobytes() + (folded >> 8).astype(np.uint8).tobytes()
    scale = {"low": low, "step": step, "count": len(flat)}
    return base64.b64encode(zlib.compress(planes, 7)).decode("ascii"), scale
