"""The summary of an MCAP as an index: extents and contents of its chunks, without walking the file.

An index is used only if it is complete and its sums equal the statistics of the file.
"""

import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from typing import TypeAlias

from isal.isal_zlib import crc32
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, ChunkIndex, McapRecord, Schema, Statistics
from mcap.stream_reader import StreamReader

from pdhef_logtool.logs.byte_source import ByteSource, CutError
from pdhef_logtool.logs.container import MAX_TIME_NS, MCAP_MAGIC, Span
from pdhef_logtool.logs.recording_span import SILENCE_NS, STEP_BACK_NS
from pdhef_logtool.logs.resource_limits import DEFAULT_LIMITS, KIB, ResourceLimits

#: One request brings the summary of a drive of several minutes; a longer one takes a second request.
TAIL_BYTES = 256 * KIB
RECORD = struct.Struct("<BQ")  # opcode, size of the content
FOOTER = struct.Struct("<BQQQI")  # the same, then: start of summary and of its offsets, CRC of the summary
INDEX_RECORD = struct.Struct("<BQHI")  # opcode, size, channel, size of its pairs
INDEX_PAIR = struct.Struct("<QQ")  # log time and offset of a message
_UNREADABLE = (McapError, struct.error, ValueError, CutError)


@dataclass(frozen=True, slots=True)
class Extent:
    """Bytes [start, end) of a chunk record or a run of message records; message indexes follow up to ``index_end``."""

    start: int
    end: int
    index_end: int
    is_chunk: bool = True


#: A chunk, with its times and counts.
IndexedChunk: TypeAlias = tuple[Extent, Span]


@dataclass(frozen=True, slots=True)
class McapIndex:
    """Content of a summary: schemas and channels by id, chunks and attachments [start, end) in file order.

    ``in_order``: whether the times of the chunks ascend as in a sound recording.
    """

    schemas: Mapping[int, Schema]
    channels: Mapping[int, Channel]
    chunks: tuple[IndexedChunk, ...]
    attachments: tuple[tuple[int, int], ...]
    in_order: bool


def read_index(source: ByteSource, limits: ResourceLimits = DEFAULT_LIMITS) -> tuple[McapIndex | None, bool]:
    """Read the summary of an MCAP from its end.

    Returns
    -------
    index : None if the summary is missing or inconsistent. is_damaged : whether its CRC does not match.
    """
    try:
        summary, start, is_sound = _summary(source, limits)
        return (_index(summary, start, limits) if is_sound else None), not is_sound
    except _UNREADABLE:
        return None, False


def chunk_places(source: ByteSource, limits: ResourceLimits) -> list[int]:
    """Return the ascending offsets of chunks according to the summary, as far as it can be read."""
    places: list[int] = []
    with suppress(*_UNREADABLE):
        indexes = (r for r in _records(_summary(source, limits)[0], limits) if isinstance(r, ChunkIndex))
        places.extend(r.chunk_start_offset for r in indexes if source.read(r.chunk_start_offset, 1)[0] == Opcode.CHUNK)
    return sorted(places)


def _summary(source: ByteSource, limits: ResourceLimits) -> tuple[bytes, int, bool]:
    """Return the bytes from the summary section to the end of the file, their place, and whether their CRC matches.

    Raises
    ------
    ValueError : the file has no footer or no summary.
    """
    size = source.size
    foot = size - len(MCAP_MAGIC) - FOOTER.size
    if foot <= len(MCAP_MAGIC):
        raise ValueError("a file without a footer")
    source.prefetch([(max(0, size - TAIL_BYTES), size)])
    end = source.read(foot, size - foot)
    opcode, length, start, _, crc = FOOTER.unpack_from(end)
    if opcode != Opcode.FOOTER or length != FOOTER.size - RECORD.size or end[FOOTER.size :] != MCAP_MAGIC:
        raise ValueError("a file without a footer")
    if not 0 < start < foot or foot - start > limits.metadata_bytes:
        raise ValueError("a file without a summary")
    source.prefetch([(start, size)])
    summary = source.read(start, foot - start)
    return summary + end, start, crc in (0, crc32(end[: FOOTER.size - struct.calcsize("<I")], crc32(summary)))


def _records(summary: bytes, limits: ResourceLimits) -> Iterator[McapRecord]:
    most = limits.metadata_bytes
    return StreamReader(BytesIO(summary), skip_magic=True, emit_chunks=True, record_size_limit=most).records


def _index(summary: bytes, start: int, limits: ResourceLimits) -> McapIndex | None:
    records = list(_records(summary, limits))
    schemas = {record.id: record for record in records if isinstance(record, Schema)}
    channels = {record.id: record for record in records if isinstance(record, Channel)}
    chunks = sorted((_chunk(r) for r in records if isinstance(r, ChunkIndex)), key=lambda chunk: chunk[0].start)
    attachments = sorted((r.offset, r.offset + r.length) for r in records if isinstance(r, AttachmentIndex))
    counts: Counter[int] = Counter()
    for _, span in chunks:
        counts.update(span.counts)
    agrees = any(
        +Counter(r.channel_message_counts) == counts
        and (r.message_count, r.chunk_count, r.attachment_count) == (counts.total(), len(chunks), len(attachments))
        for r in records
        if isinstance(r, Statistics)
    )
    declared = counts.keys() <= channels.keys() and len(channels) <= limits.channels
    ascend = all(span.start_ns < span.end_ns for _, span in chunks)
    if not (agrees and declared and ascend and _apart(chunks, attachments, start)):
        return None
    return McapIndex(schemas, channels, tuple(chunks), tuple(attachments), _in_order(chunks))


def _chunk(record: ChunkIndex) -> IndexedChunk:
    """Read a chunk index; the places of the message indexes show the number of messages of each channel."""
    end = record.chunk_start_offset + record.chunk_length
    index_end = end + record.message_index_length
    offsets = sorted(record.message_index_offsets.items(), key=lambda item: item[1])
    places = [*(place for _, place in offsets), index_end]
    counts: dict[int, int] = {}
    for (id_, place), following in zip(offsets, places[1:], strict=True):
        n, rest = divmod(following - place - INDEX_RECORD.size, INDEX_PAIR.size)
        if n < 0 or rest:
            raise ValueError("message indexes that do not follow each other")
        if n:
            counts[id_] = n
    if not counts or places[0] != end:
        raise ValueError("a chunk without message indexes")
    first_ns, last_ns = (min(ns, MAX_TIME_NS) for ns in (record.message_start_time, record.message_end_time))
    return Extent(record.chunk_start_offset, end, index_end), Span(0, first_ns, last_ns + 1, counts)


def _apart(chunks: list[IndexedChunk], attachments: list[tuple[int, int]], limit: int) -> bool:
    """Return whether no two records overlap, and all end before the summary."""
    extents = sorted([*((extent.start, extent.index_end) for extent, _ in chunks), *attachments])
    ends = [len(MCAP_MAGIC), *(end for _, end in extents)]
    return all(start >= end for (start, _), end in zip(extents, ends, strict=False)) and max(ends) <= limit


def _in_order(chunks: list[IndexedChunk]) -> bool:
    """Return whether the chunks' times are plausible for a sound recording."""
    newest: dict[int, int] = {}
    for _, span in chunks:
        if span.end_ns - span.start_ns > SILENCE_NS or span.end_ns > MAX_TIME_NS:
            return False
        for id_ in span.counts:
            if span.start_ns < newest.get(id_, 0) - STEP_BACK_NS:
                return False
            newest[id_] = max(newest.get(id_, 0), span.end_ns - 1)
    return True
