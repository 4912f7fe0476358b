"""MCAP files as a container: channels and chunks by the summary, or by one walk over the record headers.

A summary describes the chunks if its CRC, its sums and its statistics agree. Every chunk that it does not name is
decompressed when the file is opened, so that a file without a summary, with channels that only its chunks declare, or
with a cut end reads like any other. All records between the chunks are visited; every CRC is checked.
"""

import struct
from array import array
from bisect import bisect_right
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import cached_property
from io import BytesIO
from itertools import accumulate
from typing import Any, TypeAlias

import numpy as np
from isal.isal_zlib import crc32
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, Metadata, Schema, Statistics
from numpy.typing import NDArray

from pdhef_logtool.logs import container
from pdhef_logtool.logs.byte_source import ByteSource
from pdhef_logtool.logs.compression import decompress
from pdhef_logtool.logs.constants import WHOLE_BYTES
from pdhef_logtool.logs.mcap_index import INDEX_PAIR, INDEX_RECORD, RECORD, Extent, chunk_places, read_index
from pdhef_logtool.logs.resource_limits import KIB, MIB, LimitError
from pdhef_logtool.logs.table_file import LogFile
from pdhef_logtool.records.signals import IntArray, Loss

UintArray: TypeAlias = NDArray[np.uint64]

_CHUNK = struct.Struct("<QQQII")  # start, end, uncompressed size, uncompressed CRC, length of the compression's name
_U32, _U64 = struct.Struct("<I"), struct.Struct("<Q")
_CRC_BLOCK_BYTES = 4 * MIB
_CHUNK_HEAD_BYTES = RECORD.size + _CHUNK.size + _U64.size  # without the name of the compression
_LONGEST_NAME = 4  # of a compression
_ATTACHMENT_HEAD_BYTES = 64 * KIB  # at most, in front of its data
#: A plain number: comparing with a member of an enumeration takes longer than reading a record.
_OP_MESSAGE = int(Opcode.MESSAGE)
_DECLARATIONS = (Opcode.SCHEMA, Opcode.CHANNEL)
_INDEXES = (Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX)
_SUMMARY_ONLY = frozenset((*_INDEXES, Opcode.STATISTICS, Opcode.SUMMARY_OFFSET, Opcode.FOOTER))
_FIRST_PRIVATE = 0x80  # other opcodes, neither defined nor private, are no records of the format
_NO_SCHEMA = Schema(id=0, data=b"", encoding="", name="")
#: Head of a message record, before its payload.
MESSAGE_HEAD = np.dtype(
    [("op", "u1"), ("size", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log", "<u8"), ("publish", "<u8")]
)
_MESSAGE_BYTES = MESSAGE_HEAD.itemsize - RECORD.size


class McapContainer(container.FileContainer):
    """One MCAP 1.0 file; its spans are chunks and runs of unchunked messages, in file order."""

    kind = "mcap"
    magic = container.MCAP_MAGIC
    magic_text = "the MCAP magic bytes"
    remedy = "is it an MCAP 1.0 recording?"
    chunks: list[Extent]

    def __init__(self, file: LogFile, source: ByteSource | None = None) -> None:
        self.profile = ""
        self._schemas: dict[int, Schema] = {}
        self._raw_channels: dict[int, Channel] = {}
        self._records_at: dict[type, list[tuple[int, int]]] = {Attachment: [], Metadata: []}
        self._is_partial = False  # whether the chunks of a remote file are fetched when they are read
        self._closed = False
        self._data_end: int | None = None  # place of the record
        self._is_summary_damaged = False
        self._statistics: Statistics | None = None
        self._has_end = False  # whether the file ends with its magic bytes
        self._opened_chunks = 0  # number of chunks that no index describes
        super().__init__(file, source)

    def _walk(self) -> None:
        source, size = self.source, self.source.size
        indexed = self._indexed_chunks()
        self._has_end = source.read(size - len(container.MCAP_MAGIC), len(container.MCAP_MAGIC)) == container.MCAP_MAGIC
        places = [*sorted(indexed), size]
        self.position = self._read_header()
        for offset in self._places():
            if offset in indexed:
                self.position = self._add_chunk(*indexed[offset])
                continue
            if (
                size - offset == len(container.MCAP_MAGIC)
                and source.read(offset, len(container.MCAP_MAGIC)) == container.MCAP_MAGIC
            ):
                self._closed = True
                return
            opcode, end = self._record_head(offset)
            following = places[bisect_right(places, offset)]
            if end > following or opcode == 0:
                resume = following if following < size else self._next_chunk(offset)
                if resume is None:
                    self.lose_end(offset)
                    return
                what = f"bytes {offset} to {resume} contain no readable record; reading resumes at the next chunk"
                self.lose("bad-record", what, self.last_ns())
                end = resume
            elif opcode == _OP_MESSAGE:
                end = self._messages(offset)
            else:
                try:
                    end = self._record(opcode, offset, end)
                except Exception as error:  # noqa: BLE001 (the next record is read in any case)
                    self.lose_record(offset, error)
            self.position = end

    def _record_head(self, offset: int) -> tuple[int, int]:
        """Return opcode and end of the record at a byte; opcode 0 without a complete head."""
        if offset + RECORD.size > self.source.size:
            return 0, offset
        opcode, length = RECORD.unpack(self.source.read(offset, RECORD.size))
        return opcode, offset + RECORD.size + length

    def _indexed_chunks(self) -> dict[int, tuple[Extent, container.Span]]:
        """Return by their places the chunks that a sound summary describes; request all else of a remote file."""
        source = self.source
        index, self._is_summary_damaged = read_index(source, self.meter.limits)
        if index is None or (source.is_remote and not index.in_order):
            source.prefetch([(0, source.size)])
            return {}
        self._schemas.update(index.schemas)
        self._raw_channels.update(index.channels)
        if source.is_remote:
            self._is_partial = True
            parts = sorted([*((extent.start, extent.index_end) for extent, _ in index.chunks), *index.attachments])
            starts, ends = [start for start, _ in parts], [end for _, end in parts]
            source.prefetch(zip([0, *ends], [*starts, source.size], strict=True))
        return {extent.start: (extent, span) for extent, span in index.chunks}

    def _span_by_indexes(self, extent: Extent) -> container.Span | None:
        """Return the span that the message indexes of a chunk describe; None if one of them is malformed."""
        indexes = _message_indexes(self.source.read(extent.end, extent.index_end - extent.end), 0)
        if indexes is None:
            return None
        parts, pairs = indexes
        times, offsets, ends = _held_times(pairs[:, 0]), pairs[:, 1], list(accumulate(n for _, n in parts))
        falls = offsets[1:] < offsets[:-1]
        falls[[end - 1 for end in ends[:-1]]] = False  # from an index to the next one
        if falls.any():  # some writers sort an index by time
            times = times[np.lexsort((offsets, np.repeat(np.arange(len(parts)), [n for _, n in parts])))]
        return container.Span.of((id_, times[end - n : end]) for (id_, n), end in zip(parts, ends, strict=True))

    def _read_header(self) -> int:
        """Read the header record, which is the first one; return its end."""
        start = self.position
        opcode, end = self._record_head(start)
        if opcode != Opcode.HEADER or end > self.source.size:
            raise self.no_log("a complete header record after the magic bytes", "none")
        try:
            self.profile = _parsed(Header, self._payload(start, end)).profile
        except (struct.error, UnicodeDecodeError, McapError) as error:
            got = "a malformed one, or a draft of the format before 1.0"
            raise self.no_log("a header record with profile and library", got) from error
        return end

    def _next_chunk(self, after: int) -> int | None:
        """Return the first chunk behind a damaged place that a damaged summary names, or None."""
        position = bisect_right(self._named_chunks, after)
        return self._named_chunks[position] if position < len(self._named_chunks) else None

    @cached_property
    def _named_chunks(self) -> list[int]:
        return chunk_places(self.source, self.meter.limits)

    def _record(self, opcode: int, start: int, end: int) -> int:
        """Handle one complete record that is no message; return the start of the next one."""
        if opcode in _DECLARATIONS:
            self._declare(opcode, self._payload(start, end))
            return end
        if opcode == Opcode.CHUNK:
            return self._add_chunk(self._extent_of(start, end))
        if opcode == Opcode.ATTACHMENT:
            self._check_attachment(start, end)
        elif opcode == Opcode.DATA_END:
            self._data_end = start
        elif opcode == Opcode.METADATA:
            _parsed(Metadata, self._payload(start, end))
            self._records_at[Metadata].append((start, end))
        elif opcode == Opcode.STATISTICS and self._data_end:
            self._statistics = _parsed(Statistics, self._payload(start, end))
        elif opcode == Opcode.MESSAGE_INDEX or (
            opcode < _FIRST_PRIVATE and (opcode not in _SUMMARY_ONLY or not self._data_end)
        ):
            raise container.SpanDamageError(f"no record of kind {opcode} is allowed here")
        elif opcode - _FIRST_PRIVATE == Opcode.CHUNK and self._is_chunk(start, end):
            raise container.SpanDamageError("a chunk with one wrong bit in its opcode, which makes it a private record")
        return end

    def _payload(self, start: int, end: int) -> bytes:
        """Return the content of the declaration or metadata in bytes [start, end)."""
        self.meter.limits.check("metadata_bytes", end - start, "a declaration or metadata")
        return self.source.read(start + RECORD.size, end - start - RECORD.size)

    def _declare(self, opcode: int, payload: bytes) -> None:
        """Add a schema or channel record."""
        self.meter.limits.check("metadata_bytes", len(payload), "a declaration")
        if opcode == Opcode.SCHEMA:
            schema = _parsed(Schema, payload)
            self._schemas.setdefault(schema.id, schema)
            return
        channel = _parsed(Channel, payload)
        if channel.id not in self._raw_channels:
            self.meter.limits.check("channels", len(self._raw_channels) + 1, f"channel {channel.id}")
            self._raw_channels[channel.id] = channel

    def _is_chunk(self, start: int, end: int) -> bool:
        """Return whether a record of a private kind is laid out like a chunk."""
        head = self.source.read(start, min(end - start, _CHUNK_HEAD_BYTES + _LONGEST_NAME))
        if len(head) < _CHUNK_HEAD_BYTES + _LONGEST_NAME:
            return False
        n = _CHUNK.unpack_from(head, RECORD.size)[-1]
        place = RECORD.size + _CHUNK.size + n
        return n <= _LONGEST_NAME and bool(place + _U64.size + _U64.unpack_from(head, place)[0] == end - start)

    def _messages(self, offset: int) -> int:
        """Add the message records from here on with heads that are read ahead; return the start of the next record."""
        size = self.source.size
        block, place = self.source.ahead(offset, min(MESSAGE_HEAD.itemsize, size - offset))
        base, last = offset - place, len(block) - MESSAGE_HEAD.itemsize
        places = array("q")
        while place <= last and block[place] == _OP_MESSAGE:
            _, length = RECORD.unpack_from(block, place)
            end = place + RECORD.size + length
            if length < _MESSAGE_BYTES or base + end > size:
                break
            places.append(place)
            place = end
        if not places:
            self.lose_record(offset, container.SpanDamageError("a message record is too short"))
            return self._record_head(offset)[1]
        heads = _heads(block, np.array(places, dtype=np.int64))
        times, rows = _held_times(heads["log"]), container.rows_by_channel(heads["channel"].astype(np.int64))
        span = container.Span.of((id_, times[its]) for id_, its in rows.items())
        self.add_span(Extent(offset, base + place, base + place, is_chunk=False), span)
        return base + place

    def _extent_of(self, start: int, end: int) -> Extent:
        """Return the extent of the chunk record in bytes [start, end) and of the message indexes behind it."""
        index_end, size = end, self.source.size
        while index_end + INDEX_RECORD.size <= size:
            opcode, following = self._record_head(index_end)
            if opcode & ~_FIRST_PRIVATE != Opcode.MESSAGE_INDEX or following > size:
                break  # one wrong bit makes an index a private record
            index_end = following
        return Extent(start, end, index_end)

    def _add_chunk(self, extent: Extent, claimed: container.Span | None = None) -> int:
        """Add a chunk; return the end of its message indexes.

        The message indexes describe it if they agree with the summary (``claimed``), or in a file without an end with
        the head of the chunk; otherwise its content does. A remote chunk is described by the summary alone.
        """
        can_be_indexed = claimed is not None or not self._has_end
        named = claimed if self._is_partial else self._span_by_indexes(extent)
        if claimed is None:
            first, last, unpacked, *_ = _CHUNK.unpack(self.source.read(extent.start + RECORD.size, _CHUNK.size))
            fits = named is not None and sum(named.counts.values()) * MESSAGE_HEAD.itemsize <= unpacked
            counts = named.counts if named is not None and fits else {}
            claimed = container.Span(0, min(first, container.MAX_TIME_NS), min(last, container.MAX_TIME_NS) + 1, counts)
        if named is None or (claimed.counts and named.counts != claimed.counts):
            what = f"the message indexes of the chunk at byte {extent.start} are damaged"
            self.lose("bad-record", f"{what}: its messages are found without them")
        elif can_be_indexed and _agree(named, claimed) and named.counts.keys() <= self._raw_channels.keys():
            self.add_span(extent, named)
            return extent.index_end
        self._opened_chunks += 1
        block = self.add_content(extent, claimed)
        held = block.counts if block is not None else claimed.counts
        if missing := sum(max(n - held.get(id_, 0), 0) for id_, n in claimed.counts.items()):
            what = f"{missing} messages that the index names are not in the chunk at byte {extent.start}"
            self.lose("missing-messages", what, claimed.start_ns, claimed.end_ns, missing)
        return extent.index_end

    def _finish(self) -> None:
        if self._closed and not self._data_end:
            if not self.spans and all(loss.kind == "bad-record" for loss in self.lost):
                raise self.no_log("an MCAP 1.0 file", "a draft of the format before 1.0")
            self.lose("bad-record", "the data end record is missing")
            self.cut = True
        if not self._closed and not self.cut:
            self.lose("truncated", "the file ends without its closing magic bytes", self.last_ns())
        self._resolve_channels()
        self._check_data()
        held = sum(sum(span.counts.values()) for span in self.spans)
        if self._statistics is not None and held < (total := self._statistics.message_count) and not self.lost:
            what = f"the file's statistics name {total} messages, {held} of them are there"
            self.lose("missing-messages", what, count=total - held)
        if self._is_summary_damaged and not self.lost:
            what = "the CRC of the summary does not match: its index is damaged, from which no message was read"
            self.lost.append(Loss("bad-summary-crc", what, str(self.path), severity="note"))
        self.drop_undeclared("channels {}")
        self.is_remote = self.source.is_remote
        self.by_index = bool(self.chunks) and not self._opened_chunks and all(chunk.is_chunk for chunk in self.chunks)

    def _resolve_channels(self) -> None:
        """Join channels and schemas once all are known."""
        for id_, channel in self._raw_channels.items():
            schema = self._schemas.get(channel.schema_id, _NO_SCHEMA)
            self.channels[id_] = container.ChannelRecord(
                id=id_,
                topic=channel.topic,
                encoding=channel.message_encoding,
                schema_name=schema.name,
                schema_encoding=schema.encoding,
                schema_data=schema.data,
                metadata=dict(channel.metadata),
            )

    def _check_data(self) -> None:
        """Check the CRC of the data section if no other checksum or count protects the messages.

        Of a large remote file, this would fetch parts that are not needed otherwise: it is not verified, with a note.

        After other damage, the check is skipped: it adds no information.
        """
        if self._data_end is None or self.lost:
            return
        (crc,) = _U32.unpack(self.source.read(self._data_end + RECORD.size, _U32.size))
        chunks = self.chunks[:1] if self._is_partial else self.chunks
        if not crc or (self._statistics is not None and all(map(self._has_crc, chunks))):
            return
        if self._is_partial and self.source.size > WHOLE_BYTES:
            what = "the CRC of the data section was not verified, as the log is read in parts from its server"
            self.lost.append(Loss(container.UNVERIFIED, what, str(self.path), severity="note"))
        elif self._crc(0, self._data_end) != crc:
            what = (
                "the CRC of the data section does not match: some messages are damaged or missing, and it is "
                "unknown which; the messages that decode are used"
            )
            self.lose("bad-data-crc", what)

    def _has_crc(self, extent: Extent) -> bool:
        """Return whether messages are in a chunk with a CRC."""
        if not extent.is_chunk:
            return False
        _, _, size, crc, _ = _CHUNK.unpack(self.source.read(extent.start + RECORD.size, _CHUNK.size))
        return bool(crc or not size)

    def _crc(self, start: int, end: int) -> int:
        """Return the CRC-32 of bytes [start, end)."""
        crc: int = 0
        for offset in range(start, end, _CRC_BLOCK_BYTES):
            crc = crc32(self.source.read(offset, min(_CRC_BLOCK_BYTES, end - offset)), crc)
        return crc

    def prefetch(self, spans: Iterable[container.Span]) -> None:
        """See :class:`~pdhef_logtool.logs.container.Container`."""
        if self.source.is_remote:
            extents = (self.chunks[span.index] for span in spans)
            self.source.prefetch((extent.start, extent.index_end) for extent in extents)

    def _decoded(self, extent: Extent, *, declare: bool) -> container.Block:
        """Return the messages of a chunk or run; with ``declare``, add the schemas and channels in it.

        The message indexes are used only if the chunk contains the messages that they name, and no others.
        """
        size = extent.end - extent.start
        if not extent.is_chunk:
            self.meter.limits.check("chunk_bytes", size, "messages without a chunk")
            return self._scan(self.source.read(extent.start, size))
        record = self.source.read(extent.start, extent.index_end - extent.start)
        content = self.chunk_content(record, size)
        indexes = _message_indexes(record, size)
        # Each channel's offsets ascend already, which the stable sort makes use of.
        offsets = None if indexes is None else np.sort(indexes[1][:, 1].astype(np.int64), kind="stable")
        block = None if offsets is None else _gather_messages(content, offsets)
        block = self._scan(content) if block is None else block
        self.meter.limits.check_messages(len(block), size)
        for opcode, start, end in _other_records(block) if declare else ():
            if opcode in _DECLARATIONS:
                try:
                    self._declare(opcode, content[start:end])
                except LimitError as error:
                    self.lose(*container.describe_damage(error))
        return block

    def chunk_content(self, record: bytes, end: int) -> bytes:
        """Decompress the chunk record that is the first ``end`` bytes, and check its CRC."""
        head = ReadDataStream(BytesIO(record))
        try:
            head.read(RECORD.size + 2 * _U64.size)  # and times
            size, crc, compression, stored = head.read8(), head.read4(), head.read_prefixed_string(), head.read8()
        except (struct.error, UnicodeDecodeError, McapError) as error:
            raise container.SpanDamageError(f"malformed chunk header: {error}") from error
        start = head.count
        if start + stored > end:
            raise container.SpanDamageError("the chunk's records run past its end")
        content = decompress(compression, memoryview(record)[start : start + stored], size, self.meter.limits)
        if crc and crc32(content) != crc:
            raise container.SpanDamageError("its CRC does not match")
        return content

    def _scan(self, content: bytes) -> container.Block:
        """Return the messages among the records of a content; SpanDamageError if it contains anything else."""
        offsets = array("q")
        for opcode, start, _ in _records(content, 0, len(content)):
            if opcode == _OP_MESSAGE:
                self.meter.check_scan(len(offsets))
                offsets.append(start - RECORD.size)
            elif opcode < _FIRST_PRIVATE and opcode not in _DECLARATIONS:
                raise container.SpanDamageError(f"it contains a record of kind {opcode}, which no chunk may")
        if not offsets:
            return container.block_from_lists(content, *[()] * 6)
        block = _gather_messages(content, np.array(offsets, dtype=np.int64))
        if block is None:
            raise container.SpanDamageError("its records contradict each other")
        return block

    def records(self, kind: type[container.RecordT]) -> Iterator[container.RecordT]:
        """See :class:`~pdhef_logtool.logs.container.Container`."""
        for start, end in self._records_at[kind]:
            try:
                record: container.RecordT = _parsed(
                    kind, self.source.read(start + RECORD.size, end - start - RECORD.size)
                )
            except Exception as error:  # noqa: BLE001 (the boundary)
                self.lose_record(start, error)
                continue
            yield record

    def _check_attachment(self, start: int, end: int) -> None:
        """Add an attachment record; check its CRC block by block, unless the file is remote."""
        if self._is_partial:
            self._records_at[Attachment].append((start, end))
            return
        start += RECORD.size
        head = ReadDataStream(BytesIO(self.source.read(start, min(end - start, _ATTACHMENT_HEAD_BYTES))))
        head.read(2 * _U64.size)  # times
        name, _ = head.read_prefixed_string(), head.read_prefixed_string()
        size = head.read8()
        crc_at = start + head.count + size  # a record may be padded behind its last member
        if crc_at + _U32.size > end:
            raise container.SpanDamageError("it runs past its end")
        (crc,) = _U32.unpack(self.source.read(crc_at, _U32.size))
        if crc and self._crc(start, crc_at) != crc:
            self.lose("bad-attachment", f"attachment {name!r} has a wrong CRC", count=1)
            return
        self._records_at[Attachment].append((start - RECORD.size, end))


def _parsed(kind: Any, payload: bytes) -> Any:
    """Return a record of a kind from its content."""
    return kind.read(ReadDataStream(BytesIO(payload)))


def _message_indexes(record: bytes, offset: int) -> tuple[list[tuple[int, int]], UintArray] | None:
    """Return the message indexes from a byte on, None if one is malformed.

    Channel and count of each that is not empty, and the pairs [N, 2] of all: log time and offset in the chunk.
    """
    parts: list[tuple[int, int]] = []
    pairs: list[UintArray] = [np.empty(0, np.uint64)]
    while offset < len(record):
        if offset + INDEX_RECORD.size > len(record):
            return None
        opcode, length, channel, size = INDEX_RECORD.unpack_from(record, offset)
        start, end = offset + INDEX_RECORD.size, offset + RECORD.size + length
        if opcode != Opcode.MESSAGE_INDEX or size % INDEX_PAIR.size or start + size > end:
            return None
        if size:
            pairs.append(np.frombuffer(record, "<u8", 2 * size // INDEX_PAIR.size, start))
            parts.append((channel, size // INDEX_PAIR.size))
        offset = end
    return parts, np.concatenate(pairs).reshape(-1, 2)


def _heads(content: bytes, offset: IntArray) -> NDArray[np.void]:
    """Return the heads of messages at offsets [N]."""
    return container.items_at_bytes(content, MESSAGE_HEAD.itemsize)[offset].view(MESSAGE_HEAD)


def _gather_messages(content: bytes, offset: IntArray) -> container.Block | None:
    """Read message headers at known ascending offsets; None if the content has other messages than these."""
    n = len(content)
    if offset.size == 0 or offset[0] < 0 or offset[-1] + MESSAGE_HEAD.itemsize > n:
        return None
    heads = _heads(content, offset)
    size = heads["size"].astype(np.int64)  # what does not fit is below 0
    if (heads["op"] != _OP_MESSAGE).any() or size.min() < _MESSAGE_BYTES or size.max() > n:
        return None
    ends = offset + (RECORD.size + size)
    if ends.max() > n:
        return None
    block = container.Block(
        buffer=content,
        channel=heads["channel"].astype(np.int64),
        log_time_ns=_held_times(heads["log"]),
        publish_time_ns=_held_times(heads["publish"]),
        sequence=heads["sequence"].astype(np.int64),
        offset=offset + MESSAGE_HEAD.itemsize,
        length=size - _MESSAGE_BYTES,
    )
    if offset[0] == 0 and ends[-1] == n and (offset[1:] == ends[:-1]).all():
        return block
    with suppress(container.SpanDamageError):
        if all(opcode >= _FIRST_PRIVATE or opcode in _DECLARATIONS for opcode, *_ in _other_records(block)):
            return block
    return None


def _agree(span: container.Span, other: container.Span) -> bool:
    """Return whether two spans have the same bounds and counts."""
    return (span.start_ns, span.end_ns, span.counts) == (other.start_ns, other.end_ns, other.counts)


def _held_times(times: UintArray) -> IntArray:
    """Return times [N] as int64, those above ``MAX_TIME_NS`` as that."""
    return np.minimum(times, np.uint64(container.MAX_TIME_NS)).astype(np.int64)


def _other_records(block: container.Block) -> list[tuple[int, int, int]]:
    """Return opcode and extent of the records between the messages of a chunk; SpanDamageError if they fill no gap."""
    starts = np.append(0, block.offset + block.length)
    ends = np.append(block.offset - MESSAGE_HEAD.itemsize, len(block.buffer))
    gaps = np.flatnonzero(starts != ends)
    extents = zip(starts[gaps].tolist(), ends[gaps].tolist(), strict=True)
    return [record for offset, end in extents for record in _records(block.buffer, offset, end)]


def _records(content: bytes | memoryview, offset: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Yield opcode and extent of the content of the records in a part; SpanDamageError if they do not end with it."""
    while offset + RECORD.size <= end:
        opcode, length = RECORD.unpack_from(content, offset)
        offset += RECORD.size + length
        yield opcode, offset - length, offset
    if offset != end:
        raise container.SpanDamageError("its last record is cut")
