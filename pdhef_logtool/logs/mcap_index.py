"""The summary of an MCAP as an index: extents and contents of its chunks, without walking the file.

For remote files, where every read is a request. An index is used only if it is complete, if its sums agree with the
file's statistics, and if its times are those of a sound recording; otherwise the file is walked like any other.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from isal.isal_zlib import crc32
from mcap.opcode import Opcode

from pdhef_logtool.logs.byte_source import ByteSource, CutError
from pdhef_logtool.logs.container import MAX_TIME_NS, MCAP_MAGIC
from pdhef_logtool.logs.recording_span import SILENCE_NS, STEP_BACK_NS

#: One request brings the summary of a drive of several minutes; a longer one takes a second request.
TAIL_BYTES = 256 << 10
_MOST_SUMMARY_BYTES = 64 << 20
RECORD = struct.Struct("<BQ")  # opcode, size of the content
FOOTER = struct.Struct("<BQQQI")  # the same, then: start of summary and of its offsets, CRC of the summary
_CHUNK_INDEX = struct.Struct("<QQQQI")  # first and last time, offset, length, bytes of the message indexes' offsets
STATISTICS = struct.Struct("<QHIIIIQQI")
_CRC = struct.Struct("<I")
_EXTENT = struct.Struct("<QQ")
_OFFSETS = np.dtype([("id", "<u2"), ("at", "<u8")])
COUNTS = np.dtype([("id", "<u2"), ("n", "<u8")])
_INDEX = struct.Struct("<BQHI")  # message index: opcode, size, channel, size of its pairs
_PAIR = struct.Struct("<QQ")  # log time and offset of a message


@dataclass(frozen=True, slots=True)
class IndexedChunk:
    """A chunk record in bytes [start, end), its message indexes up to ``index_end``; times as the record has them."""

    start: int
    end: int
    index_end: int
    first_ns: int
    last_ns: int
    counts: dict[int, int]


@dataclass(frozen=True, slots=True)
class McapIndex:
    """Content of a summary: schema and channel records, chunks and attachments [start, end) in file order."""

    schemas: tuple[bytes, ...]
    channels: tuple[bytes, ...]
    chunks: tuple[IndexedChunk, ...]
    attachments: tuple[tuple[int, int], ...]


def read_index(source: ByteSource) -> McapIndex | None:
    """Read the summary of an MCAP from its end; None without a usable one."""
    try:
        section = _summary(source)
        return None if section is None else _index(*section)
    except (struct.error, ValueError, IndexError, CutError):
        return None


def _summary(source: ByteSource) -> tuple[bytes, int] | None:
    """Return the bytes of the summary section and where it begins."""
    size = source.size
    foot = size - len(MCAP_MAGIC) - FOOTER.size
    if foot <= len(MCAP_MAGIC):
        return None
    tail = max(0, size - TAIL_BYTES)
    source.prefetch([(tail, size)])
    end = source.read(foot, size - foot)
    opcode, length, start, _, crc = FOOTER.unpack_from(end)
    if opcode != Opcode.FOOTER or length != FOOTER.size - RECORD.size or end[FOOTER.size :] != MCAP_MAGIC:
        return None
    if not 0 < start < foot or foot - start > _MOST_SUMMARY_BYTES:
        return None
    source.prefetch([(start, size)])
    summary = source.read(start, foot - start)
    if crc and crc32(end[: FOOTER.size - _CRC.size], crc32(summary)) != crc:
        return None
    return summary, start


def _records(summary: bytes) -> Iterator[tuple[int, bytes]]:
    offset = 0
    while offset < len(summary):
        opcode, length = RECORD.unpack_from(summary, offset)
        if offset + RECORD.size + length > len(summary):
            raise ValueError("a cut record")
        yield opcode, summary[offset + RECORD.size : offset + RECORD.size + length]
        offset += RECORD.size + length


def _index(summary: bytes, start: int) -> McapIndex | None:
    schemas, channels, chunks, attachments = [], [], [], []
    claimed: Counter[int] | None = None
    counted = (0, 0, 0)
    for opcode, record in _records(summary):
        if opcode == Opcode.SCHEMA:
            schemas.append(record)
        elif opcode == Opcode.CHANNEL:
            channels.append(record)
        elif opcode == Opcode.CHUNK_INDEX:
            chunks.append(_chunk(record))
        elif opcode == Opcode.ATTACHMENT_INDEX:
            begin, length = _EXTENT.unpack_from(record)
            attachments.append((begin, begin + length))
        elif opcode == Opcode.STATISTICS:
            total, _, _, files, _, n, _, _, size = STATISTICS.unpack_from(record)
            entries = np.frombuffer(record, COUNTS, size // COUNTS.itemsize, STATISTICS.size)
            claimed = Counter(dict(zip(entries["id"].tolist(), entries["n"].tolist(), strict=True)))
            counted = total, n, files
    chunks.sort(key=lambda chunk: chunk.start)
    attachments.sort()
    held: Counter[int] = Counter()
    for chunk in chunks:
        held.update(chunk.counts)
    agrees = claimed is not None and +claimed == held and counted == (held.total(), len(chunks), len(attachments))
    declared = {int.from_bytes(record[:2], "little") for record in channels}
    if not agrees or not held.keys() <= declared or not _apart(chunks, attachments, start) or not _in_order(chunks):
        return None
    return McapIndex(tuple(schemas), tuple(channels), tuple(chunks), tuple(attachments))


def _chunk(record: bytes) -> IndexedChunk:
    """Read a chunk index; how many messages each channel has follows from where the message indexes lie."""
    first, last, start, length, size = _CHUNK_INDEX.unpack_from(record)
    offsets = np.frombuffer(record, _OFFSETS, size // _OFFSETS.itemsize, _CHUNK_INDEX.size)
    (index_size,) = struct.unpack_from("<Q", record, _CHUNK_INDEX.size + size)
    end, index_end = start + length, start + length + index_size
    order = np.argsort(offsets["at"], kind="stable")
    begins = offsets["at"][order].tolist()
    counts: dict[int, int] = {}
    for id_, low, high in zip(offsets["id"][order].tolist(), begins, [*begins[1:], index_end], strict=True):
        n, rest = divmod(high - low - _INDEX.size, _PAIR.size)
        if n < 0 or rest or id_ in counts:
            raise ValueError("message indexes that do not follow each other")
        if n:
            counts[id_] = n
    if not counts or begins[0] != end:
        raise ValueError("a chunk without message indexes")
    return IndexedChunk(start, end, index_end, first, last, counts)


def _apart(chunks: list[IndexedChunk], attachments: list[tuple[int, int]], limit: int) -> bool:
    """Return whether no two records overlap, and all end before the summary."""
    extents = sorted([*((c.start, c.index_end) for c in chunks), *attachments])
    ends = [len(MCAP_MAGIC), *(end for _, end in extents)]
    return all(start >= end for (start, _), end in zip(extents, ends, strict=False)) and max(ends) <= limit


def _in_order(chunks: list[IndexedChunk]) -> bool:
    """Return whether the chunks' times are plausible for a sound recording; other files are walked."""
    newest: dict[int, int] = {}
    for chunk in chunks:
        if not 0 <= chunk.last_ns - chunk.first_ns < SILENCE_NS or chunk.last_ns >= MAX_TIME_NS:
            return False
        for id_ in chunk.counts:
            if chunk.first_ns < newest.get(id_, 0) - STEP_BACK_NS:
                return False
            newest[id_] = max(newest.get(id_, 0), chunk.last_ns)
    return True
