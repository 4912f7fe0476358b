"""The summary of an MCAP as an index: extents and contents of its chunks, without walking the file.

For remote files, where every read is a request. An index is used only if it is complete, if its sums agree with the
file's statistics, and if its times are those of a sound recording; otherwise the file is walked like any other.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO

import numpy as np
from isal.isal_zlib import crc32
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, ChunkIndex, Schema, Statistics
from mcap.stream_reader import StreamReader

from pdhef_logtool.logs.byte_source import ByteSource, CutError
from pdhef_logtool.logs.container import MAX_TIME_NS, MCAP_MAGIC
from pdhef_logtool.logs.recording_span import SILENCE_NS, STEP_BACK_NS
from pdhef_logtool.logs.resource_limits import DEFAULT_LIMITS, ResourceLimits

#: One request brings the summary of a drive of several minutes; a longer one takes a second request.
TAIL_BYTES = 256 << 10
_MOST_SUMMARY_BYTES = 64 << 20
RECORD = struct.Struct("<BQ")  # opcode, size of the content
FOOTER = struct.Struct("<BQQQI")  # the same, then: start of summary and of its offsets, CRC of the summary
STATISTICS = struct.Struct("<QHIIIIQQI")
_CRC = struct.Struct("<I")
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
    """Content of a summary: schemas and channels by id, chunks and attachments [start, end) in file order."""

    schemas: Mapping[int, Schema]
    channels: Mapping[int, Channel]
    chunks: tuple[IndexedChunk, ...]
    attachments: tuple[tuple[int, int], ...]


def read_index(source: ByteSource, limits: ResourceLimits = DEFAULT_LIMITS) -> McapIndex | None:
    """Read the summary of an MCAP from its end; None if there is none that can be used."""
    try:
        section = _summary(source)
        return None if section is None else _index(*section, limits)
    except (McapError, struct.error, ValueError, CutError):
        return None


def _summary(source: ByteSource) -> tuple[bytes, int] | None:
    """Return the bytes from the summary section to the end of the file, and where they begin."""
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
    return summary + end, start


def _index(summary: bytes, start: int, limits: ResourceLimits) -> McapIndex | None:
    reader = StreamReader(BytesIO(summary), skip_magic=True, emit_chunks=True, record_size_limit=limits.metadata_bytes)
    records = list(reader.records)
    schemas = {record.id: record for record in records if isinstance(record, Schema)}
    channels = {record.id: record for record in records if isinstance(record, Channel)}
    chunks = sorted((_chunk(r) for r in records if isinstance(r, ChunkIndex)), key=lambda chunk: chunk.start)
    attachments = sorted((r.offset, r.offset + r.length) for r in records if isinstance(r, AttachmentIndex))
    counts: Counter[int] = Counter()
    for chunk in chunks:
        counts.update(chunk.counts)
    agrees = any(
        +Counter(r.channel_message_counts) == counts
        and (r.message_count, r.chunk_count, r.attachment_count) == (counts.total(), len(chunks), len(attachments))
        for r in records
        if isinstance(r, Statistics)
    )
    declared = counts.keys() <= channels.keys() and len(channels) <= limits.channels
    if not (agrees and declared and _apart(chunks, attachments, start) and _in_order(chunks)):
        return None
    return McapIndex(schemas, channels, tuple(chunks), tuple(attachments))


def _chunk(record: ChunkIndex) -> IndexedChunk:
    """Read a chunk index; the places of the message indexes show the number of messages of each channel."""
    end = record.chunk_start_offset + record.chunk_length
    index_end = end + record.message_index_length
    offsets = sorted(record.message_index_offsets.items(), key=lambda item: item[1])
    places = [*(place for _, place in offsets), index_end]
    counts: dict[int, int] = {}
    for (id_, place), following in zip(offsets, places[1:], strict=True):
        n, rest = divmod(following - place - _INDEX.size, _PAIR.size)
        if n < 0 or rest:
            raise ValueError("message indexes that do not follow each other")
        if n:
            counts[id_] = n
    if not counts or places[0] != end:
        raise ValueError("a chunk without message indexes")
    return IndexedChunk(
        record.chunk_start_offset, end, index_end, record.message_start_time, record.message_end_time, counts
    )


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
