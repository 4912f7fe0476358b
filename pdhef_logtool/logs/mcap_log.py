"""MCAP files as a container: one walk over the record headers, chunks decoded one at a time, every CRC checked.

The walk visits every top-level record by its length and uses no index, so that a file without a summary, with
channels that only its chunks declare, with chunks that no index names, or with a cut end reads like any other. Unwanted
chunks of a remote file are not walked: its index describes them, if it is consistent.
"""

from __future__ import annotations

import struct
from array import array
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from io import BytesIO
from itertools import accumulate
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from isal.isal_zlib import crc32
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment as AttachmentRecord
from mcap.records import Channel, Metadata, Schema, Statistics
from numpy.typing import NDArray

from pdhef_logtool.logs.byte_source import ByteSource
from pdhef_logtool.logs.compression import decompress
from pdhef_logtool.logs.container import (
    EVERYTHING,
    MAX_TIME_NS,
    MCAP_MAGIC,
    UNVERIFIED,
    Attachment,
    Block,
    ChannelRecord,
    FileContainer,
    RawChunk,
    Span,
    SpanDamageError,
    Wanted,
    block_from_lists,
    describe_damage,
)
from pdhef_logtool.logs.mcap_index import FOOTER, RECORD, IndexedChunk, chunk_places, read_index
from pdhef_logtool.logs.remote_place import LogPlace
from pdhef_logtool.logs.resource_limits import LimitError, Meter
from pdhef_logtool.logs.type_names import ros2_type_name
from pdhef_logtool.records.signals import IntArray, Loss

UintArray: TypeAlias = NDArray[np.uint64]

_MESSAGE_RECORD = struct.Struct("<BQHIQ")
_CHUNK = struct.Struct("<QQQII")  # start, end, uncompressed size, uncompressed CRC, length of the compression's name
_INDEX_HEAD = struct.Struct("<9sHI")  # head of the record, channel, bytes of the pairs
_INDEX_RECORD = struct.Struct("<BQHI")  # the same, with opcode and size
_U32, _U64 = struct.Struct("<I"), struct.Struct("<Q")
_UNCHUNKED_RUN_BYTES = 4 << 20  # unchunked messages are read in runs of this size
_CRC_BLOCK_BYTES = 4 << 20
_CHUNK_HEAD_BYTES = RECORD.size + _CHUNK.size + _U64.size  # without the name of the compression
_LONGEST_NAME = 4  # of a compression
_MESSAGES_A_CHECK = 1 << 16
#: Plain numbers: comparing with the members of an enumeration takes longer than reading a record.
_OP_MESSAGE, _OP_CHUNK, _OP_MESSAGE_INDEX = int(Opcode.MESSAGE), int(Opcode.CHUNK), int(Opcode.MESSAGE_INDEX)
_OP_SCHEMA, _OP_CHANNEL, _OP_HEADER = int(Opcode.SCHEMA), int(Opcode.CHANNEL), int(Opcode.HEADER)
_DECLARATIONS = (_OP_SCHEMA, _OP_CHANNEL)
_OP_STATISTICS = int(Opcode.STATISTICS)
_SUMMARY_ONLY = frozenset(
    int(op)
    for op in (
        Opcode.FOOTER,
        Opcode.CHUNK_INDEX,
        Opcode.ATTACHMENT_INDEX,
        Opcode.STATISTICS,
        Opcode.METADATA_INDEX,
        Opcode.SUMMARY_OFFSET,
    )
)
_FIRST_PRIVATE = 0x80  # other opcodes, neither defined nor private, are no records of the format
#: Head of a message record, before its payload.
MESSAGE_HEAD = np.dtype(
    [("op", "u1"), ("size", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log", "<u8"), ("publish", "<u8")]
)
_MESSAGE_BYTES = MESSAGE_HEAD.itemsize - RECORD.size
_INDEX_PAIR = np.dtype([("log", "<u8"), ("offset", "<u8")])


@dataclass(frozen=True, slots=True)
class _Extent:
    """Bytes [start, end) of a chunk record or a run of message records; message indexes follow up to ``index_end``."""

    start: int
    end: int
    is_chunk: bool
    index_end: int


class McapContainer(FileContainer):
    """One MCAP 1.0 file; its spans are chunks and runs of unchunked messages, in file order."""

    form = "mcap"
    magic = MCAP_MAGIC
    magic_text = "the MCAP magic bytes"
    remedy = "is it an MCAP 1.0 recording?"
    whole_chunks = True
    chunks: list[_Extent]

    def __init__(
        self,
        path: Path | ByteSource,
        shown_path: LogPlace | None = None,
        meter: Meter | None = None,
        wanted: Wanted = EVERYTHING,
    ) -> None:
        self.profile = ""
        self._wanted = wanted
        self.library = ""
        self._schemas: dict[int, Schema] = {}
        self._raw_channels: dict[int, Channel] = {}
        self._attachment_at: list[tuple[int, int]] = []
        self._metadata_at: list[tuple[int, int]] = []
        self._index_used = False
        self._index_wrong = False  # whether an index named other messages than are there
        self._indexed: list[int] | None = None  # where the chunks lie that the summary names
        self._walked = _Walk(self)
        super().__init__(path, shown_path, meter)

    def _walk(self) -> None:
        source, size, walk = self.source, self.source.size, self._walked
        header_seen = False
        skippable = self._skippable() if source.is_remote else {}
        for offset in self._places():
            if offset in skippable:
                self.position = walk.add_indexed(skippable[offset])
                continue
            if size - offset == len(MCAP_MAGIC) and source.read(offset, len(MCAP_MAGIC)) == MCAP_MAGIC:
                walk.closed = True
                return
            opcode, length = RECORD.unpack(source.read(offset, RECORD.size)) if offset + RECORD.size <= size else (0, 0)
            end = offset + RECORD.size + length
            if end > size or opcode == 0:
                if not header_seen:
                    raise self.no_log("a complete header record", "none, or one that runs past the end of the file")
                resume = self._next_indexed_chunk(offset)
                if resume is None:
                    walk.cut(offset)
                    return
                walk.skipped(offset, resume)
                self.position = resume
                continue
            if not header_seen:
                if opcode != _OP_HEADER:
                    raise self.no_log("a header record after the magic bytes", "none")
                self._read_header(offset, length)
                header_seen = True
            elif opcode == _OP_MESSAGE:
                end = walk.messages(offset)
            else:
                try:
                    walk.record(opcode, offset, end)
                except Exception as error:  # noqa: BLE001 (the next record is read in any case)
                    self.lose_record(offset, error)
            self.position = end
        if not header_seen:
            raise self.no_log("a header record after the magic bytes", "none")

    def _finish(self) -> None:
        self._walked.finish()
        self.is_remote = self.source.is_remote
        chunked = bool(self.chunks) and all(extent.is_chunk for extent in self.chunks)
        indexed = self._index_used if self.is_remote else self._walked.statistics is not None
        self.by_index = chunked and indexed and not self._index_wrong and all(x.kind == UNVERIFIED for x in self.lost)

    def _skippable(self) -> dict[int, IndexedChunk | tuple[int, int]]:
        """Return the chunks and attachments that are not wanted by their place, and have all else fetched."""
        everything = self._wanted == EVERYTHING or self.source.size <= self._wanted.above_bytes
        index = None if everything else read_index(self.source, self.meter.limits)
        unwanted: dict[int, IndexedChunk | tuple[int, int]] = {}
        if index is not None:
            self._index_used = True
            self._schemas.update(index.schemas)
            self._raw_channels.update(index.channels)
            topics = {id_: channel.topic for id_, channel in self._raw_channels.items()}
            for chunk in index.chunks:
                if not self._wanted.has([topics[id_] for id_ in chunk.counts], chunk.first_ns, chunk.last_ns):
                    unwanted[chunk.start] = chunk
            unwanted |= {extent[0]: extent for extent in index.attachments}
        ends = {start: (x.index_end if isinstance(x, IndexedChunk) else x[1]) for start, x in unwanted.items()}
        self.source.prefetch(zip([0, *ends.values()], [*ends, self.source.size], strict=True))
        return unwanted

    def _read_header(self, offset: int, length: int) -> None:
        self.meter.limits.check("metadata_bytes", length, "the header record")
        payload = self.source.read(offset + RECORD.size, length)
        try:
            (n,) = _U32.unpack_from(payload, 0)
            library = _U32.size + n
            (m,) = _U32.unpack_from(payload, library)
            self.profile = payload[_U32.size : library].decode()
            library += _U32.size
            self.library = payload[library : library + m].decode()
        except (struct.error, UnicodeDecodeError) as error:
            raise self.no_log("a header record with profile and library", "a malformed one") from error
        if library + m > length:
            raise self.no_log("a header record with profile and library", "a draft of the format before 1.0")

    def _next_indexed_chunk(self, after: int) -> int | None:
        """Return the first chunk behind a damaged place that the summary names, or None."""
        if self._indexed is None:
            self._indexed = chunk_places(self.source, self.meter.limits)
        position = bisect_right(self._indexed, after)
        return self._indexed[position] if position < len(self._indexed) else None

    def add_schema(self, payload: bytes) -> None:
        """Add a schema record."""
        self.meter.limits.check("metadata_bytes", len(payload), "a schema record")
        schema = Schema.read(ReadDataStream(BytesIO(payload)))
        self._schemas.setdefault(schema.id, schema)

    def add_channel(self, payload: bytes) -> None:
        """Add a channel record."""
        self.meter.limits.check("metadata_bytes", len(payload), "a channel record")
        channel = Channel.read(ReadDataStream(BytesIO(payload)))
        if channel.id not in self._raw_channels:
            self.meter.limits.check("channels", len(self._raw_channels) + 1, f"channel {channel.id}")
            self._raw_channels[channel.id] = channel

    def resolve_channels(self) -> None:
        """Join channels and schemas once all are known."""
        for id_, channel in self._raw_channels.items():
            schema = self._schemas.get(channel.schema_id)
            name = schema.name if schema else ""
            encoding = schema.encoding if schema else ""
            is_ros = channel.message_encoding in ("cdr", "ros1")
            self.channels[id_] = ChannelRecord(
                id=id_,
                topic=channel.topic,
                type_name=ros2_type_name(name) if is_ros else name,
                encoding=channel.message_encoding,
                schema_name=name,
                schema_encoding=encoding,
                schema_data=schema.data if schema else b"",
                metadata=dict(channel.metadata),
                schema_id=channel.schema_id if schema else 0,
            )

    def payload(self, start: int, end: int) -> bytes:
        """Return the content of the record in bytes [start, end)."""
        return self.source.read(start + RECORD.size, end - start - RECORD.size)

    def extent(self, span: Span) -> tuple[int, int]:
        """Return the bytes of the span's record or records."""
        extent = self.chunks[span.index]
        return extent.start, extent.end

    def prefetch(self, spans: Iterable[Span]) -> None:
        """See :class:`~pdhef_logtool.logs.container.Container`."""
        if self.source.is_remote:
            extents = (self.chunks[span.index] for span in spans)
            self.source.prefetch((extent.start, extent.index_end) for extent in extents)

    def load(self, span: Span, want: frozenset[int] | None = None) -> Block:
        """Decode one span."""
        del want
        extent = self.chunks[span.index]
        limits = self.meter.limits
        if not extent.is_chunk:
            limits.check("chunk_bytes", extent.end - extent.start, "messages without a chunk")
            return self._scan(self.source.read(extent.start, extent.end - extent.start))
        record = self.source.read(extent.start, extent.index_end - extent.start)
        content = self.chunk_content(record, extent.end - extent.start)
        block = _indexed_messages(content, record, extent.end - extent.start)
        block = self._scan(content) if block is None else block
        limits.check_messages(len(block), extent.end - extent.start)
        return block

    def chunk_content(self, record: bytes, end: int) -> bytes:
        """Decompress the chunk record that is the first ``end`` bytes, and check its CRC."""
        size, crc, compression, start, stored = _chunk_head(record, end)
        content = decompress(compression, memoryview(record)[start : start + stored], size, self.meter.limits)
        if crc and crc32(content) != crc:
            raise SpanDamageError("its CRC does not match")
        return content

    def _scan(self, content: bytes, declare: bool = False) -> Block:
        """Walk the records of a chunk's content; with ``declare``, add the schemas and channels in it."""
        offsets = array("q")
        offset, size = 0, len(content)
        while offset < size:
            if offset + RECORD.size > size:
                raise SpanDamageError("its last record is cut")
            opcode, length = RECORD.unpack_from(content, offset)
            end = offset + RECORD.size + length
            if end > size:
                raise SpanDamageError("its last record is cut")
            if opcode == _OP_MESSAGE:
                if length < _MESSAGE_BYTES:
                    raise SpanDamageError("a message record is too short")
                if len(offsets) % _MESSAGES_A_CHECK == 0:
                    self.meter.limits.check("chunk_messages", len(offsets), "a chunk")
                    self.meter.check()
                offsets.append(offset)
            elif declare and opcode in _DECLARATIONS:
                try:
                    (self.add_schema if opcode == _OP_SCHEMA else self.add_channel)(content[offset + RECORD.size : end])
                except LimitError as error:
                    self.lose(*describe_damage(error))
            elif opcode < _FIRST_PRIVATE and opcode not in _DECLARATIONS:
                raise SpanDamageError(f"it contains a record of kind {opcode}, which no chunk may")
            offset = end
        if not offsets:
            return block_from_lists(content, *[()] * 6)
        block = _gather_messages(content, np.array(offsets, dtype=np.int64))
        if block is None:
            raise SpanDamageError("its records contradict each other")
        return block

    def raw_chunk(self, span: Span, block: Block, kept: frozenset[int]) -> RawChunk | None:
        """See :class:`~pdhef_logtool.logs.container.Container`."""
        extent = self.chunks[span.index]
        if not extent.is_chunk or not len(block) or not kept.issuperset(np.unique(block.channel).tolist()):
            return None
        if max(int(block.log_time_ns.max()), int(block.publish_time_ns.max())) >= MAX_TIME_NS:
            return None  # the time does not fit the index
        content = bytes(block.buffer)
        head = block.offset - MESSAGE_HEAD.itemsize
        others = _records_between(content, np.append(0, block.offset + block.length), np.append(head, len(content)))
        if others is None or not all(self._is_known(op, content[start:end], kept) for op, start, end in others):
            return None
        record = self.source.read(extent.start, extent.end - extent.start)
        size, crc, compression, start, length = _chunk_head(record, len(record))
        return RawChunk(
            compression=compression,
            stored=record[start : start + length],
            size=size,
            crc=crc or crc32(content),
            channel=block.channel,
            log_time_ns=block.log_time_ns,
            offset=head,
        )

    def _is_known(self, opcode: int, payload: bytes, kept: frozenset[int]) -> bool:
        """Return whether a record of a chunk declares kept channels only, as this file declares them."""
        try:
            if opcode == Opcode.CHANNEL:
                channel = Channel.read(ReadDataStream(BytesIO(payload)))
                return channel.id in kept and channel == self._raw_channels[channel.id]
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(ReadDataStream(BytesIO(payload)))
                used = {self._raw_channels[id_].schema_id for id_ in kept}
                return schema.id in used and schema == self._schemas[schema.id]
        except (struct.error, UnicodeDecodeError, ValueError, McapError):
            return False
        return True

    def times(self, span: Span) -> tuple[IntArray, IntArray]:
        """Return a span's channels and log times; of a chunk, read its message indexes if it has some."""
        extent = self.chunks[span.index]
        indexes = _message_indexes(self.source.read(extent.end, extent.index_end - extent.end), 0)
        if not indexes:
            return super().times(span)
        channel = np.concatenate([np.full(len(times), id_, dtype=np.int64) for id_, times, _ in indexes])
        log_time = np.minimum(np.concatenate([times for _, times, _ in indexes]), np.uint64(MAX_TIME_NS))
        return channel, log_time.astype(np.int64)

    def crc(self, start: int, end: int) -> int:
        """Return the CRC-32 of bytes [start, end)."""
        crc: int = 0
        for offset in range(start, end, _CRC_BLOCK_BYTES):
            crc = crc32(self.source.read(offset, min(_CRC_BLOCK_BYTES, end - offset)), crc)
        return crc

    def attachments(self) -> Iterator[Attachment]:
        """Read the attachments; a damaged one is among the losses and left out."""
        for record in self._sound_records(self._attachment_at, AttachmentRecord):
            yield Attachment(record.name, record.media_type, record.data, record.log_time, record.create_time)

    def metadata_records(self) -> Iterator[Metadata]:
        """Read the metadata records; a damaged one is among the losses and left out."""
        yield from self._sound_records(self._metadata_at, Metadata)

    def _sound_records(self, extents: Iterable[tuple[int, int]], kind: Any) -> Iterator[Any]:
        for start, end in extents:
            try:
                record = kind.read(ReadDataStream(BytesIO(self.payload(start, end))))
            except Exception as error:  # noqa: BLE001 (the boundary)
                self.lose_record(start, error)
                continue
            yield record

    def note_attachment(self, start: int, end: int) -> None:
        """Add an attachment record; check its CRC block by block."""
        source = self.source
        place = start + RECORD.size + 2 * _U64.size  # behind both times
        name = ""
        for width in (_U32, _U32):  # name and media type
            (n,) = width.unpack(source.read(place, width.size))
            place += width.size
            if place + n > end:
                raise SpanDamageError("it runs past its end")
            self.meter.limits.check("metadata_bytes", n, "an attachment's name")
            text = source.read(place, n).decode()
            name, place = name or text, place + n
        (n,) = _U64.unpack(source.read(place, _U64.size))
        place += _U64.size + n  # a record may be padded behind its last member
        if place + _U32.size > end:
            raise SpanDamageError("it runs past its end")
        (crc,) = _U32.unpack(source.read(place, _U32.size))
        if crc and self.crc(start + RECORD.size, place) != crc:
            self.lose("bad-attachment", f"attachment {name!r} has a wrong CRC", count=1)
            return
        self.add_attachment(start, end)

    def add_attachment(self, start: int, end: int) -> None:
        """Add an attachment record."""
        self._attachment_at.append((start, end))

    def note_metadata(self, start: int, end: int) -> None:
        """Add a metadata record that can be read."""
        self.meter.limits.check("metadata_bytes", end - start, "a metadata record")
        Metadata.read(ReadDataStream(BytesIO(self.payload(start, end))))
        self._metadata_at.append((start, end))

    def open_chunk(self, extent: _Extent, claimed: Span) -> None:
        """Add a chunk by its content, if its channels or messages are not in an index; a damaged chunk is a loss.

        Parameters
        ----------
        claimed : log times of its header; counts of its message indexes, empty if these are inconsistent.
        """

        def read() -> Block:
            record = self.source.read(extent.start, extent.end - extent.start)
            block = self._scan(self.chunk_content(record, len(record)), declare=True)
            self.meter.limits.check_messages(len(block), len(record))
            return block

        block = self.add_content(extent, claimed, read)
        if block is None:
            return
        held = block.counts
        missing = sum(max(n - held.get(id_, 0), 0) for id_, n in claimed.counts.items())
        if missing:
            what = f"{missing} messages that the index names are not in the chunk at byte {extent.start}"
            self.lose("missing-messages", what, claimed.start_ns, claimed.end_ns, missing)
        if len(block):
            self._index_wrong |= self.spans[-1] != replace(claimed, index=len(self.spans) - 1, ordered=block.ordered)

    def check_statistics(self, total: int, by_channel: Mapping[int, int]) -> None:
        """Compare the counts of the walk with the file's statistics.

        An index can hide messages: if the statistics differ from the indexes, every chunk is opened.
        """
        counts: Counter[int] = Counter()
        for span in self.spans:
            counts.update(span.counts)
        if self.lost or (counts.total() == total and (not by_channel or counts == Counter(by_channel))):
            return
        self._index_wrong = True
        spans, extents = self.spans[:], self.chunks[:]
        self.spans.clear()
        self.chunks.clear()
        for extent, span in zip(extents, spans, strict=True):
            if extent.is_chunk:
                self.open_chunk(extent, span)
            else:
                self.add_span(extent, span)
        held = sum(sum(span.counts.values()) for span in self.spans)
        if held < total and not self.lost:
            what = f"the file's statistics name {total} messages, {held} of them are there"
            self.lose("missing-messages", what, count=total - held)


class _Walk:
    """State of the one pass over the top-level records."""

    def __init__(self, container: McapContainer) -> None:
        self.of = container
        self.closed = False
        self.data_end: tuple[int, int] | None = None  # extent of the record
        self.data_crc = 0
        self.footer: tuple[int, int] | None = None  # extent of the record
        self.bare_chunks = False  # whether any chunk has no CRC
        self.run: tuple[int, int] | None = None  # extent of consecutive unchunked messages
        self.run_times = (0, 0)
        self.run_counts: Counter[int] = Counter()
        self.run_ordered = True  # whether no log time of it steps back
        self.chunk: tuple[int, int] | None = None  # extent of the chunk before the message indexes that are being read
        self.index_end = 0
        self.head = (0, 0, 0)  # of the chunk: first and last log time, size
        self.index_counts: Counter[int] = Counter()
        self.index_at: list[tuple[int, int]] = []  # extents of the pairs of time and offset in each message index
        self.index_sound = True
        self.statistics: tuple[int, dict[int, int]] | None = None

    def record(self, opcode: int, start: int, end: int) -> None:
        """Handle one complete record that is no message."""
        of, source = self.of, self.of.source
        if opcode == _OP_MESSAGE_INDEX:
            self._message_index(start, end)
            return
        if self.chunk is not None and opcode == _FIRST_PRIVATE | _OP_MESSAGE_INDEX:
            self.index_sound = False  # an index with one wrong bit: its messages are found in the chunk
            return
        self._end_chunk()
        if opcode in _DECLARATIONS:
            # Stay inside a run: writers interleave declarations with the messages.
            of.meter.limits.check("metadata_bytes", end - start, "a declaration")
            (of.add_schema if opcode == _OP_SCHEMA else of.add_channel)(source.read(start + 9, end - start - 9))
            return
        self._end_run()
        if opcode == _OP_CHUNK:
            first, last, size, crc, _ = _CHUNK.unpack(source.read(start + RECORD.size, _CHUNK.size))
            self.bare_chunks |= bool(size and not crc)
            self.chunk, self.index_end = (start, end), end
            self.head = (min(first, MAX_TIME_NS), min(last, MAX_TIME_NS), size)
            self.index_counts, self.index_at, self.index_sound = Counter(), [], True
        elif opcode == Opcode.ATTACHMENT:
            of.note_attachment(start, end)
        elif opcode == Opcode.DATA_END:
            self._data_end(start, end)
        elif opcode == Opcode.METADATA:
            of.note_metadata(start, end)
        elif opcode == _OP_STATISTICS and self.data_end:
            self._statistics(start, end)
        elif opcode == Opcode.FOOTER and self.data_end:
            self.footer = (start, end)
        elif opcode < _FIRST_PRIVATE and (opcode not in _SUMMARY_ONLY or not self.data_end):
            raise SpanDamageError(f"no record of kind {opcode} is allowed here")
        elif opcode - _FIRST_PRIVATE == _OP_CHUNK and self._is_chunk(start, end):
            raise SpanDamageError("a chunk with one wrong bit in its opcode, which makes it a private record")

    def _is_chunk(self, start: int, end: int) -> bool:
        """Return whether a record of a private kind is laid out like a chunk."""
        head = self.of.source.read(start, min(end - start, _CHUNK_HEAD_BYTES + _LONGEST_NAME))
        if len(head) < _CHUNK_HEAD_BYTES + _LONGEST_NAME:
            return False
        n = _CHUNK.unpack_from(head, RECORD.size)[-1]
        place = RECORD.size + _CHUNK.size + n
        return n <= _LONGEST_NAME and bool(place + _U64.size + _U64.unpack_from(head, place)[0] == end - start)

    def add_indexed(self, indexed: IndexedChunk | tuple[int, int]) -> int:
        """Add a chunk or an attachment by its entry in the index; return the start of the next record."""
        of = self.of
        self._end_chunk()
        self._end_run()
        if not isinstance(indexed, IndexedChunk):
            of.add_attachment(*indexed)
            return indexed[1]
        span = Span(0, indexed.first_ns, indexed.last_ns + 1, indexed.counts, ordered=True)
        of.add_span(_Extent(indexed.start, indexed.end, True, indexed.index_end), span)
        return indexed.index_end

    def messages(self, offset: int) -> int:
        """Add the message records from here on with heads that are read ahead; return the start of the next record."""
        of = self.of
        self._end_chunk()
        size = of.source.size
        block, place = of.source.ahead(offset, min(_MESSAGE_RECORD.size, size - offset))
        base = offset - place
        last = min(len(block), size - base) - _MESSAGE_RECORD.size
        unpack, counts = _MESSAGE_RECORD.unpack_from, self.run_counts
        start = self.run[0] if self.run else offset
        first_ns, last_ns = self.run_times if self.run else (MAX_TIME_NS, 0)
        first = place
        while place <= last and block[place] == _OP_MESSAGE:
            _, length, channel, _, log_time = unpack(block, place)
            end = place + RECORD.size + length
            if length < _MESSAGE_BYTES or base + end > size:
                break
            if log_time < first_ns:
                first_ns = log_time
            if log_time > last_ns:
                last_ns = log_time
            elif log_time < last_ns:
                self.run_ordered = False
            counts[channel] += 1
            place = end
            if base + place - start >= _UNCHUNKED_RUN_BYTES:
                break
        if place == first:  # not even the first one is a message
            end = offset + RECORD.size + int(RECORD.unpack(of.source.read(offset, RECORD.size))[1])
            self._end_run()
            of.lose_record(offset, SpanDamageError("a message record is too short"))
            return end
        self.run, self.run_times = (start, base + place), (first_ns, last_ns)
        if base + place - start >= _UNCHUNKED_RUN_BYTES:
            self._end_run()
        return base + place

    def _message_index(self, start: int, end: int) -> None:
        """Add the messages that an index names, if it is consistent."""
        of = self.of
        if self.chunk is None:
            self._end_run()
            raise SpanDamageError("a message index without its chunk; the messages are lost")
        self.index_end = end
        sound, self.index_sound = self.index_sound, False
        block, place = of.source.ahead(start, min(end - start, _INDEX_HEAD.size))
        _, channel, n = _INDEX_HEAD.unpack_from(block, place)
        if n % _INDEX_PAIR.itemsize or start + _INDEX_HEAD.size + n > end or channel in self.index_counts:
            raise SpanDamageError(
                f"a message index that names {n / _INDEX_PAIR.itemsize:.10g} messages of channel {channel}"
            )
        if n:
            self.index_counts[channel] = n // _INDEX_PAIR.itemsize
            pairs = start + _INDEX_HEAD.size
            self.index_at.append((pairs, pairs + n))
        self.index_sound = sound

    def _index_agrees(self) -> tuple[bool, bool]:
        """Return whether the chunk's indexes are consistent, and whether no channel steps back in time."""
        assert self.chunk is not None
        of, size, counts = self.of, self.head[2], self.index_counts
        held = counts.total() * MESSAGE_HEAD.itemsize
        if not self.index_sound or not held or held > size or size > of.meter.limits.chunk_bytes:
            return False, False
        if not counts.keys() <= of._raw_channels.keys():
            return False, False
        first = self.chunk[1]
        record = of.source.read(first, self.index_end - first)
        times = np.frombuffer(b"".join([record[a - first : b - first] for a, b in self.index_at]), dtype="<u8")[0::2]
        ends = list(accumulate(counts.values()))
        back = times[1:] < times[:-1]
        back[[n - 1 for n in ends[:-1]]] = False  # from a channel to the next one
        ordered = not back.any()
        some = times[[0, *ends[:-1], *(n - 1 for n in ends)]] if ordered else times  # first and last of each
        span = min(int(some.min()), MAX_TIME_NS), min(int(some.max()), MAX_TIME_NS)
        return span == self.head[:2], ordered

    def _data_end(self, start: int, end: int) -> None:
        """Note the CRC of the data section."""
        self.data_end = (start, end)
        (self.data_crc,) = _U32.unpack(self.of.source.read(start + 9, 4))

    def _check_data(self) -> None:
        """Check the CRC of the data section if no other checksum or count protects the messages.

        After other damage, the check is skipped: it adds no information.
        """
        of = self.of
        if self.data_end is None or not self.data_crc or of.lost:
            return
        in_chunks = all(extent.is_chunk for extent in of.chunks)
        if self.statistics is not None and in_chunks and not self.bare_chunks:
            return
        if of._index_used:
            what = "the CRC of the data section was not verified, as not all of the log was read"
            of.lost.append(Loss(UNVERIFIED, what, str(of.path), severity="note"))
        elif of.crc(0, self.data_end[0]) != self.data_crc:
            what = (
                "the CRC of the data section does not match: some messages are damaged or missing, and it is "
                "unknown which; the messages that decode are used"
            )
            of.lose("bad-data-crc", what)

    def _check_summary(self) -> None:
        """Check the CRC of the summary, from which no message is read: damage of it is a note."""
        of = self.of
        if self.data_end is None or self.footer is None or of.lost:
            return
        footer_start, _ = self.footer
        _, _, start, _, crc = FOOTER.unpack(of.source.read(footer_start, FOOTER.size))
        if not crc or not self.data_end[1] <= start <= footer_start:
            return
        if of.crc(start, footer_start + FOOTER.size - 4) != crc:
            what = "the CRC of the summary does not match: its index is damaged, from which no message was read"
            of.lost.append(Loss("bad-summary-crc", what, str(of.path), severity="note"))

    def _statistics(self, start: int, end: int) -> None:
        """Note how many messages the file claims by channel."""
        self.of.meter.limits.check("metadata_bytes", end - start, "the statistics")
        record = Statistics.read(ReadDataStream(BytesIO(self.of.payload(start, end))))
        self.statistics = (record.message_count, {c: n for c, n in record.channel_message_counts.items() if n})

    def _end_run(self) -> None:
        if self.run is None:
            return
        first, last = (min(t, MAX_TIME_NS) for t in self.run_times)
        span = Span(0, first, last + 1, dict(self.run_counts), self.run_ordered)
        self.of.add_span(_Extent(*self.run, False, self.run[1]), span)
        self.run, self.run_counts, self.run_ordered = None, Counter(), True

    def _end_chunk(self, index_complete: bool = True) -> None:
        """Close a chunk; open it now if its channels or messages are only in its content."""
        if self.chunk is None:
            return
        first, last, size = self.head
        sound, ordered = self._index_agrees()
        fits = self.index_sound and self.index_counts.total() * MESSAGE_HEAD.itemsize <= size
        span = Span(0, first, last + 1, dict(self.index_counts) if fits else {}, ordered)
        extent, self.chunk = _Extent(*self.chunk, True, self.index_end), None
        if sound and index_complete:
            self.of.add_span(extent, span)
        else:
            self.of.open_chunk(extent, span)

    def cut(self, offset: int) -> None:
        """Note that the file ends inside a record."""
        of = self.of
        self._end_chunk(index_complete=False)
        self._end_run()
        of.lose_end(offset)

    def skipped(self, start: int, resume: int) -> None:
        """Note that a damaged stretch was stepped over."""
        of = self.of
        self._end_chunk(index_complete=False)
        self._end_run()
        what = f"bytes {start} to {resume} contain no readable record; reading resumes at the next chunk"
        of.lose("bad-record", what, of.last_ns())

    def finish(self) -> None:
        """Finish open records and check the file as a whole."""
        of = self.of
        self._end_chunk(index_complete=self.closed)
        self._end_run()
        if self.closed and not self.data_end:
            if not of.spans and all(loss.kind == "bad-record" for loss in of.lost):
                raise of.no_log("an MCAP 1.0 file", "a draft of the format before 1.0")
            of.lose("bad-record", "the data end record is missing")
            of.cut = True
        if not self.closed and not of.cut:
            of.lose("truncated", "the file ends without its closing magic bytes", of.last_ns())
        of.resolve_channels()
        self._check_data()
        if self.statistics is not None:
            of.check_statistics(*self.statistics)
            of.resolve_channels()
        self._check_summary()
        of.drop_undeclared("channels {}")


def _chunk_head(record: bytes, end: int) -> tuple[int, int, str, int, int]:
    """Return size, CRC, compression, and place and length of the stored bytes of the chunk record up to ``end``."""
    try:
        _, _, size, crc, n = _CHUNK.unpack_from(record, RECORD.size)
        name = RECORD.size + _CHUNK.size
        compression = record[name : name + n].decode()
        (stored,) = _U64.unpack_from(record, name + n)
    except (struct.error, UnicodeDecodeError) as error:
        raise SpanDamageError(f"malformed chunk header: {error}") from error
    if _CHUNK_HEAD_BYTES + n + stored > end:
        raise SpanDamageError("the chunk's records run past its end")
    return size, crc, compression, _CHUNK_HEAD_BYTES + n, stored


def _message_indexes(record: bytes, offset: int) -> list[tuple[int, UintArray, UintArray]] | None:
    """Return channel, log times [N] and offsets [N] of each message index from a byte on; None if one is malformed."""
    indexes: list[tuple[int, UintArray, UintArray]] = []
    while offset < len(record):
        opcode, length, channel, n = _INDEX_RECORD.unpack_from(record, offset)
        end = offset + RECORD.size + length
        if opcode != _OP_MESSAGE_INDEX or n % _INDEX_PAIR.itemsize or offset + _INDEX_RECORD.size + n > end:
            return None
        pairs = np.frombuffer(record, _INDEX_PAIR, n // _INDEX_PAIR.itemsize, offset + _INDEX_RECORD.size)
        indexes.append((channel, pairs["log"], pairs["offset"]))
        offset = end
    return indexes


def _indexed_messages(content: bytes, record: bytes, index_start: int) -> Block | None:
    """Return a chunk's messages through its message indexes; None if these do not name all of them."""
    indexes = _message_indexes(record, index_start)
    if not indexes:
        return None
    # Each channel's offsets ascend already, which the stable sort makes use of.
    offset = np.sort(np.concatenate([offsets for _, _, offsets in indexes]).view(np.int64), kind="stable")
    return _gather_messages(content, offset) if offset.size else None


def _gather_messages(content: bytes, offset: IntArray) -> Block | None:
    """Read message headers at known ascending offsets; None if the content has other messages than these."""
    n = len(content)
    if offset.size == 0 or offset[0] < 0 or offset[-1] + MESSAGE_HEAD.itemsize > n:
        return None
    # Gathered as plain bytes: NumPy copies structured items member by member.
    plain = np.dtype((np.void, MESSAGE_HEAD.itemsize))
    heads = np.ndarray((n - plain.itemsize + 1,), dtype=plain, buffer=content, strides=(1,))[offset]
    heads = heads.view(MESSAGE_HEAD)
    size = heads["size"].astype(np.int64)  # what does not fit is below 0
    if (heads["op"] != _OP_MESSAGE).any() or size.min() < _MESSAGE_BYTES or size.max() > n:
        return None
    ends = offset + (RECORD.size + size)
    if ends.max() > n:
        return None
    if offset[0] != 0 or ends[-1] != n or (offset[1:] != ends[:-1]).any():
        others = _records_between(content, np.append(0, ends), np.append(offset, n))
        if others is None or any(opcode < _FIRST_PRIVATE and opcode not in _DECLARATIONS for opcode, _, _ in others):
            return None
    return Block(
        buffer=content,
        channel=heads["channel"].astype(np.int64),
        log_time_ns=_held_times(heads["log"]),
        publish_time_ns=_held_times(heads["publish"]),
        sequence=heads["sequence"].astype(np.int64),
        offset=offset + MESSAGE_HEAD.itemsize,
        length=size - _MESSAGE_BYTES,
    )


def _held_times(times: UintArray) -> IntArray:
    """Return times [N] as int64, those above ``MAX_TIME_NS`` as that."""
    held = times.astype(np.int64)
    fit = held.min() >= 0 and held.max() <= MAX_TIME_NS
    return held if fit else np.minimum(times, np.uint64(MAX_TIME_NS)).astype(np.int64)


def _records_between(content: bytes, starts: IntArray, ends: IntArray) -> list[tuple[int, int, int]] | None:
    """Return opcode and extent of the records in the gaps [starts, ends); None if a gap is not filled by records."""
    records: list[tuple[int, int, int]] = []
    gaps = np.flatnonzero(starts != ends)
    for offset, end in zip(starts[gaps].tolist(), ends[gaps].tolist(), strict=True):
        while offset < end:
            if offset + RECORD.size > end:
                return None
            opcode, length = RECORD.unpack_from(content, offset)
            records.append((opcode, offset + RECORD.size, offset + RECORD.size + length))
            offset += RECORD.size + length
        if offset != end:
            return None
    return records
