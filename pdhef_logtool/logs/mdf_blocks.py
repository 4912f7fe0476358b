"""Survey of the blocks of an MDF file before a library opens it: number, unpacked size and circular links."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Mapping

from pdhef_logtool.logs.constants import CONSTANTS
from pdhef_logtool.logs.table_file import TableFile
from pdhef_logtool.records.errors import LogError

_FIRST = 64
#: Places of the links that are followed, by kind of block; empty: all links of a list of data.
_FOLLOWED, _FOLLOWED_3 = (
    {kind.encode(): places for kind, places in CONSTANTS["mdf"][name].items()} for name in ("followed", "followed_3")
)
#: Links that lead to blocks of one kind only.
_CHAINS: Mapping[tuple[bytes, int], bytes] = {
    (b"", 0): b"HD", (b"HD", 0): b"DG", (b"DG", 0): b"DG", (b"DG", 1): b"CG", (b"CG", 0): b"CG", (b"CG", 1): b"CN",
    (b"CN", 0): b"CN",
}  # fmt: skip
_LISTS = frozenset({b"DL", b"LD", b"HL"})


def is_unfinished(file: TableFile) -> bool:
    """Return whether the recorder did not complete lengths and links, and leave the stream at its start."""
    file.stream.seek(0)
    head = file.stream.read(_FIRST).ljust(_FIRST)
    file.stream.seek(0)
    return head[8:9] == b"4" and (head[:7] == b"UnFinMF" or any(head[60:62]))


def survey_blocks(file: TableFile) -> int:
    """Follow the links of an MDF file and return how many lead beyond its end.

    Raises
    ------
    LogError : links form a circle, or lead to a block of another kind; the file is unfinished and has several lists of
        data, which asammdf does not complete.
    LimitError : more groups, channels or unpacked data than a file of this size may contain.
    """
    stream, limits, unfinished = file.stream, file.limits, is_unfinished(file)
    stream.seek(_FIRST)
    is_old = stream.read(2) == b"HD"
    base, link, followed = (4, struct.Struct("<I"), _FOLLOWED_3) if is_old else (24, struct.Struct("<Q"), _FOLLOWED)
    kinds: Counter[bytes] = Counter()
    seen: set[int] = set()
    unpacked = missing = 0
    pending: list[tuple[int, bytes, int]] = [(_FIRST, b"", 0)]
    while pending:
        address, parent, place = pending.pop()
        if address > file.size - base:
            missing += 1
            continue
        stream.seek(address)
        head = stream.read(base)
        kind = head[:2] if is_old else head[2:4]
        if _CHAINS.get((parent, place), kind) != kind:
            raise _damage(f"a block {_CHAINS[parent, place].decode()} at byte {address}", "another one", file)
        if kind == b"DZ":
            unpacked += int.from_bytes(stream.read(16)[8:], "little")
        if kind not in followed or ((parent, place) == (b"CN", 5) and kind not in _LISTS):
            continue
        if address in seen:
            raise _damage("links that lead to other blocks", f"a circle at byte {address}", file)
        seen.add(address)
        kinds[kind] += 1
        count = int.from_bytes(head[16:24], "little") if kind in _LISTS else 1 + max(followed[kind])
        limits.check("metadata_bytes", 8 * count, file.name)
        data = stream.read(count * link.size)
        links = [target for (target,) in link.iter_unpack(data[: len(data) // link.size * link.size])]
        missing += len(links) < count
        if kind == b"DL" and links[:1] > [0] and unfinished:
            raise _damage("a finished recording", "an unfinished one with several lists of data", file)
        pending += [(links[i], kind, i) for i in followed[kind] or range(len(links)) if i < len(links) and links[i]]
    limits.check("channels", kinds[b"CG"], file.name)
    limits.check("schema_leaves", kinds[b"CN"] / max(1, kinds[b"CG"]), f"{file.name}, channels of a group")
    limits.check_table(unpacked, file.size, file.name)
    return missing


def _damage(expected: str, got: str, file: TableFile) -> LogError:
    return LogError(
        expected=expected, got=got, where=file.name, remedy="the file is damaged: give the recording itself"
    )
