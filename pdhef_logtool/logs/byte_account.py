"""Keeping account of a file's bytes while it is read: which were decoded, and which are lost."""

from __future__ import annotations

from collections.abc import Iterable

from pdhef_logtool.logs.drive_log import ByteLedger

_Extent = tuple[int, int]


class ByteAccount:
    """Extents of one file that were decoded or lost; a byte that is both is lost, one that is neither was unwanted.

    Parameters
    ----------
    size : bytes of the file; what is told beyond them is left out.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self.cut = False
        self._decoded: set[_Extent] = set()
        self._lost: set[_Extent] = set()
        self._last: _Extent = (0, 0)  # neighbours are joined as they come

    def decode(self, start: int, end: int) -> None:
        """Note that bytes [start, end) were read."""
        if start == self._last[1]:
            self._last = (self._last[0], end)
            return
        self._decoded.add(self._last)
        self._last = (start, end)

    def lose(self, start: int, end: int) -> None:
        """Note that bytes [start, end) are lost: at least one, wherever the file has any."""
        start = min(start, self.size - 1)
        self._lost.add((start, max(end, start + 1)))

    def lose_share(self, extent: _Extent, share: float) -> None:
        """Note that a share of an extent is lost, without it being known where in it."""
        start, end = extent
        self.lose(start, start + round((end - start) * share))

    def ledger(self, file: str) -> ByteLedger:
        """Add up what there is by now."""
        lost = self._covered(self._lost)
        decoded = self._covered([*self._lost, *self._decoded, self._last]) - lost
        return ByteLedger(file, self.size, decoded, self.size - decoded - lost, lost, self.cut)

    def _covered(self, extents: Iterable[_Extent]) -> int:
        """Return how many bytes of the file the extents cover together."""
        covered = reached = 0
        for start, end in sorted(extents):
            start, end = max(start, reached), min(end, self.size)
            if end > start:
                covered += end - start
                reached = end
        return covered
