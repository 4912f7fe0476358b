"""Keeping account of a file's bytes while it is read: which were decoded, and which are lost."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

_Extent = tuple[int, int]


@dataclass(frozen=True, slots=True)
class ByteLedger:
    """Account of the bytes of one file of a log; the three sums add up to its size.

    Attributes
    ----------
    file : its path. size : bytes when it was opened; of a file that is compressed as a whole, those inside of it.
    decoded : bytes that were read: framing, and chunks (or runs of messages or rows) with a message that was read.
    unwanted : sound as far as is known, and never asked for: attachments, metadata, index, other topics' chunks.
    lost : damaged, cut, above the resource limits. If the place of damage is unknown: the record that reports it.
    cut : the file ends before its time. What should follow is in no sum.
    checksummed : of ``decoded``, the bytes that a checksum of the file covers and that agree with it.

    In a database the rows' data count, one row behind the other; all else of the file is unwanted while rows can be
    read to the end, and lost where they cannot.
    """

    file: str
    size: int
    decoded: int
    unwanted: int
    lost: int
    cut: bool
    checksummed: int


def checksummed_share(ledgers: Sequence[ByteLedger]) -> float | None:
    """Return which share of the bytes that were read a verified checksum covers; None where none was read."""
    decoded = sum(ledger.decoded for ledger in ledgers)
    return sum(ledger.checksummed for ledger in ledgers) / decoded if decoded else None


def checksum_text(share: float | None) -> str:
    """Return :func:`checksummed_share` as a sentence; empty where it is not known."""
    if share is None:
        return ""
    if not share:
        return "No checksum of the file covers the bytes that were read."
    return f"A checksum of the file covers {100.0 * share:.3g} % of the bytes that were read, and agrees with them."


class _Extents:
    """Extents; an extent that continues the last one is joined to it."""

    def __init__(self) -> None:
        self._found: set[_Extent] = set()
        self._last: _Extent = (0, 0)

    def add(self, start: int, end: int) -> None:
        if start == self._last[1]:
            self._last = (self._last[0], end)
        else:
            self._found.add(self._last)
            self._last = (start, end)

    def __iter__(self) -> Iterator[_Extent]:
        yield from self._found
        yield self._last


class ByteAccount:
    """Extents of one file that were decoded or lost; a byte that is both is lost, one that is neither was unwanted.

    Parameters
    ----------
    size : bytes of the file; extents beyond it are ignored.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self.cut = False
        self._decoded = _Extents()
        self._verified = _Extents()
        self._lost: set[_Extent] = set()

    def decode(self, start: int, end: int) -> None:
        """Note that bytes [start, end) were read."""
        self._decoded.add(start, end)

    def verify(self, start: int, end: int) -> None:
        """Note that bytes [start, end) agree with a checksum of the file."""
        self._verified.add(start, end)

    def lose(self, start: int, end: int) -> None:
        """Note that bytes [start, end) are lost: at least one, wherever the file has any."""
        start = min(start, self.size - 1)
        self._lost.add((start, max(end, start + 1)))

    def lose_share(self, extent: _Extent, share: float) -> None:
        """Note that a share of an extent is lost, without it being known where in it."""
        start, end = extent
        self.lose(start, start + round((end - start) * share))

    def ledger(self, file: str) -> ByteLedger:
        """Return the sums so far."""
        lost = self._covered(self._lost)
        decoded = self._covered([*self._lost, *self._decoded]) - lost
        verified = self._covered([*self._lost, *self._verified]) - lost
        either = self._covered([*self._lost, *self._decoded, *self._verified]) - lost
        unwanted = self.size - decoded - lost
        return ByteLedger(file, self.size, decoded, unwanted, lost, self.cut, decoded + verified - either)

    def _covered(self, extents: Iterable[_Extent]) -> int:
        """Return how many bytes of the file the extents cover together."""
        covered = reached = 0
        for start, end in sorted(extents):
            start, end = max(start, reached), min(end, self.size)
            if end > start:
                covered += end - start
                reached = end
        return covered
