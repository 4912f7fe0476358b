"""A drive block by block: what is summed, counted and kept, so that memory does not grow with the drive.

A drive of one block gives the bits of numpy over the whole; of several, sums differ in their last bits.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from math import ceil
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.records.signals import BoolArray, FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack

#: Rows in memory at once: 44 minutes at 100 Hz, 2 MB a column.
BLOCK_ROWS = 1 << 18


def row_blocks(n: int) -> Iterator[tuple[int, int]]:
    """Yield [a, b) of each block of n rows; of none one empty block."""
    return ((a, min(a + BLOCK_ROWS, n)) for a in range(0, max(n, 1), BLOCK_ROWS))


def blocks_with_halo(stamped: Signals | StateTrack, span_s: float, rows: int) -> Iterator[tuple[int, int, int, int]]:
    """Yield each block [a, b) inside [first, end), which reaches ``rows``, then ``span_s``, then ``rows`` further."""
    n = len(stamped)

    def stamp(i: int) -> int:
        return int(stamped.rows(i, i + 1).stamps_ns[0])

    def beyond(start: int, way: int) -> int:
        start = i = min(max(start + way * rows, 0), n - 1)
        last, step = (0 if way < 0 else n - 1), 1
        while i != last and abs(stamp(i) - stamp(start)) <= span_s * 1e9:
            i = min(max(i + way * step, 0), n - 1)
            step *= 2
        return i + way * rows

    for a, b in row_blocks(n):
        yield (max(beyond(a, -1), 0) if a else 0), a, b, (min(beyond(b - 1, 1) + 1, n) if b < n else n)


def median_step_ns(stamped: Signals | StateTrack) -> float:
    """Return the median step between stamps, at most 2³² − 1; of a single stamp any number."""
    steps = np.empty(max(len(stamped) - 1, 0), dtype=np.uint32)
    for a, b in row_blocks(len(stamped)):
        before = max(a - 1, 0)
        steps[before : max(b - 1, 0)] = np.minimum(np.diff(stamped.rows(before, b).stamps_ns), np.iinfo(np.uint32).max)
    return float(np.median(steps, overwrite_input=True)) if steps.size else 1.0


class HeldRows(StateTrack):
    """Rows of a track; each column is read once, as a column on disk is read at every access."""

    __slots__ = ("_rows",)
    _rows: StateTrack

    def __init__(self, rows: StateTrack) -> None:
        object.__setattr__(self, "_rows", rows)

    def __getattr__(self, name: str) -> Any:
        """Fill the field of a column, which is empty until it is asked for."""
        if name == "_rows":
            raise AttributeError(name)
        value = getattr(self._rows, name)
        object.__setattr__(self, name, value)
        return value

    def __len__(self) -> int:
        """Return the number of stamps."""
        return len(self._rows)


class SegmentMasks(Mapping[str, BoolArray]):
    """Masks [N] by segment, a bit a row each: of ten hours at 100 Hz ten segments take 7 MB, as booleans 36 MB."""

    def __init__(self, names: Sequence[str], bits: NDArray[np.unsignedinteger]) -> None:
        self._place = {name: i for i, name in enumerate(names)}
        self.bits = bits

    def __getitem__(self, name: str) -> BoolArray:
        return np.asarray(self.bits & (1 << self._place[name]), dtype=np.bool_)

    def __iter__(self) -> Iterator[str]:
        return iter(self._place)

    def __len__(self) -> int:
        return len(self._place)

    def rows(self, start: int, end: int) -> SegmentMasks:
        """Return the rows [start, end)."""
        return SegmentMasks([*self._place], self.bits[start:end])


def packed(masks: Mapping[str, BoolArray], n: int) -> SegmentMasks:
    """Return masks [n] as bits; raises ValueError where one has another shape."""
    if not isinstance(masks, SegmentMasks):
        bits = np.zeros(n, dtype=np.min_scalar_type((1 << len(masks)) - 1))
        for i, (name, mask) in enumerate(masks.items()):
            if mask.shape != (n,):
                raise ValueError(f"mask {name}: expected shape ({n},), got {mask.shape}")
            bits[mask] |= 1 << i
        return SegmentMasks([*masks], bits)
    if masks.bits.shape != (n,):
        raise ValueError(f"masks: expected shape ({n},), got {masks.bits.shape}")
    return masks


class SegmentSums:
    """Counts and sums of columns by segment."""

    def __init__(self) -> None:
        self._blocks: dict[str, list[list[float]]] = {}

    def add(self, masks: Mapping[str, BoolArray], *columns: NDArray[np.generic]) -> None:
        """Take a block of columns [M]; the stamps count at which the first column is finite."""
        finite = np.isfinite(columns[0])
        if not finite.any():
            return
        for segment, mask in masks.items():
            use = mask & finite
            self.add_to(segment, *(columns if use.all() else (c[use] for c in columns)))

    def add_to(self, segment: str, *columns: NDArray[np.generic]) -> None:
        """Take columns [M] that lie in a segment."""
        sums = self._blocks.setdefault(segment, [])
        if len(columns[0]):
            sums.append([len(columns[0]), *(float(np.sum(c)) for c in columns)])

    def totals(self) -> dict[str, tuple[int, FloatArray]]:
        """Return the count and the sums of each segment that has any stamp."""
        totals = {segment: np.sum(sums, axis=0) for segment, sums in self._blocks.items() if sums}
        return {segment: (int(total[0]), total[1:]) for segment, total in totals.items()}


class ErrorSums:
    """Figures of errors; of them only sums and the largest are kept. ``most``: no more errors will come."""

    def __init__(self, most: int) -> None:
        self._room = ceil(0.05 * most) + 2
        self._sums: list[list[float]] = []
        self._largest: FloatArray = np.empty(0)
        self.n = 0

    def add(self, error: FloatArray) -> None:
        """Take finite errors [M]."""
        if not error.size:
            return
        size = np.abs(error)
        self.n += error.size
        self._sums.append([float(np.sum(v)) for v in (error**2, size, error)])
        largest = np.concatenate([self._largest, size])
        self._largest = (
            np.partition(largest, -self._room)[-self._room :].copy() if len(largest) > self._room else largest
        )

    def figures(self) -> dict[str, float]:
        """Return rmse, mae, bias, p95_abs and max_abs of at least one error."""
        squares, sizes, errors = np.sum(self._sums, axis=0) / self.n
        # Linear between the two order statistics around the rank, as np.percentile has it.
        rank = 0.95 * (self.n - 1)
        below = int(rank)
        largest = np.sort(self._largest)
        low, high = largest[below - self.n], largest[min(below + 1, self.n - 1) - self.n]
        share, step = rank - below, high - low
        return {
            "rmse": float(np.sqrt(squares)),
            "mae": float(sizes),
            "bias": float(errors),
            "p95_abs": float(low + step * share if share < 0.5 else high - step * (1.0 - share)),
            "max_abs": float(largest[-1]),
        }
