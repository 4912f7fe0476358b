"""MCAP files as a container: one walk over the record headers, chunks decoded one at a time, every CRC checked.

The walk visits every top-level record by its length and trusts no index, so that a file without a summary, with
channels that only its chunks declare, with chunks that no index names, or with a cut end reads like any other.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment as AttachmentRecord
from mcap.records import Channel, Metadata, Schema
from numpy.typing import NDArray

from pdhef_logtool.logs.container import (
    MAX_TIME_NS,
    MCAP_MAGIC,
    Attachment,
    Block,
    ChannelRecord,
    MappedContainer,
    MetadataRecord,
    RawChunk,
    Span,
    SpanDamageError,
    block_from_lists,
)
from pdhef_logtool.logs.type_names import ros2_type_name
from pdhef_logtool.records.signals import IntArray

if TYPE_CHECKING:
    import zstandard

UintArray: TypeAlias = NDArray[np.uint64]

_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQI")  # start, end, uncompressed size, uncompressed CRC
_FOOTER_BYTES = 9 + 20
_UNCHUNKED_RUN_BYTES = 4 << 20  # unchunked messages are read in runs of this size
_MAPPED_BYTES = 32 << 20  # pages of the file that may stay mapped, roughly
_PAGES_AROUND_BYTES = 64 << 10  # Linux maps this much around a place that is read
_LARGEST_CHUNK_BYTES = 4 << 30  # a larger claim is damage, not a chunk
#: What stands before the payload of a message record.
MESSAGE_HEAD = np.dtype(
    [("op", "u1"), ("size", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log", "<u8"), ("publish", "<u8")]
)


class McapContainer(MappedContainer):
    """One MCAP 1.0 file; its spans are chunks and runs of unchunked messages, in file order."""

    form = "mcap"
    magic = MCAP_MAGIC
    magic_text = "the MCAP magic bytes"
    remedy = "is it an MCAP 1.0 recording?"

    def __init__(self, path: Path, shown_path: Path | None = None) -> None:
        self.profile = ""
        self.library = ""
        self._schemas: dict[int, Schema] = {}
        self._raw_channels: dict[int, Channel] = {}
        self._extents: list[tuple[int, int, bool, tuple[int, int]]] = []  # start, end, is chunk, its message indexes
        self._attachment_at: list[tuple[int, int]] = []
        self._metadata_at: list[tuple[int, int]] = []
        self._zstd: zstandard.ZstdDecompressor | None = None
        self._touched_bytes = 0
        super().__init__(path, shown_path)

    def _walk(self) -> None:
        data, size = self._data, len(self._data)
        at = len(MCAP_MAGIC)
        if at + 9 > size or data[at] != Opcode.HEADER:
            raise self.no_log("a header record after the magic bytes", "none")
        walk = _Walk(self)
        header_seen = False
        while at < size:
            if size - at == len(MCAP_MAGIC) and data[at:size] == MCAP_MAGIC:
                walk.closed = True
                break
            if at + 9 > size:
                walk.cut(at)
                break
            opcode, length = _RECORD.unpack_from(data, at)
            end = at + 9 + length
            if end > size or opcode == 0:
                if not header_seen:
                    raise self.no_log("a complete header record", "a record that runs past the end of the file")
                resume = self._next_indexed_chunk(at)
                if resume is None:
                    walk.cut(at)
                    break
                walk.skipped(at, resume)
                at = resume
                continue
            try:
                if not header_seen:
                    self._read_header(at + 9, length)
                    header_seen = True
                walk.record(opcode, at, at + 9, end)
            except (struct.error, UnicodeDecodeError, ValueError, IndexError, McapError) as error:
                walk.damaged_record(at, error)
            # Reading a header maps the pages around it as well.
            self._touched(min(end - at, _PAGES_AROUND_BYTES))
            at = end
        walk.finish()

    def _read_header(self, at: int, length: int) -> None:
        try:
            (n,) = struct.unpack_from("<I", self._data, at)
            (m,) = struct.unpack_from("<I", self._data, at + 4 + n)
            profile = self._data[at + 4 : at + 4 + n].decode()
            library = self._data[at + 8 + n : at + 8 + n + m].decode()
        except (struct.error, UnicodeDecodeError) as error:
            raise self.no_log("a header record with profile and library", "a malformed one") from error
        if 8 + n + m > length:
            raise self.no_log("a header record with profile and library", "a draft of the format before 1.0")
        self.profile, self.library = profile, library

    def _next_indexed_chunk(self, after: int) -> int | None:
        """Return the first chunk behind a damaged place that the summary names, or None."""
        data, size = self._data, len(self._data)
        foot = size - len(MCAP_MAGIC) - _FOOTER_BYTES
        if foot <= after or data[foot] != Opcode.FOOTER or data[-len(MCAP_MAGIC) :] != MCAP_MAGIC:
            return None
        (at,) = struct.unpack_from("<Q", data, foot + 9)
        found: list[int] = []
        while after < at < foot and at + 9 <= foot:
            opcode, length = _RECORD.unpack_from(data, at)
            if opcode == Opcode.CHUNK_INDEX and length >= 24 and at + 9 + length <= foot:
                (offset,) = struct.unpack_from("<Q", data, at + 9 + 16)
                if after < offset < foot and data[offset] == Opcode.CHUNK:
                    found.append(offset)
            at += 9 + length
        return min(found) if found else None

    def add_schema(self, payload: bytes) -> None:
        """Take note of a schema record."""
        schema = Schema.read(ReadDataStream(BytesIO(payload)))
        self._schemas.setdefault(schema.id, schema)

    def add_channel(self, payload: bytes) -> None:
        """Take note of a channel record."""
        channel = Channel.read(ReadDataStream(BytesIO(payload)))
        self._raw_channels.setdefault(channel.id, channel)

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

    def load(self, span: Span, want: frozenset[int] | None = None) -> Block:
        """Decode one span."""
        del want
        start, end, is_chunk, index_extent = self._extents[span.index]
        if not is_chunk:
            self._touched(end - start)
            return _scan_messages(self._data[start:end], None)
        content = self.chunk_content(start, end)
        indexed = self._indexed_messages(content, *index_extent)
        return indexed if indexed is not None else _scan_messages(content, None)

    def chunk_content(self, start: int, end: int) -> bytes:
        """Decompress the chunk record in [start, end) and check its CRC."""
        data = self._data
        try:
            _, _, size, crc = _CHUNK.unpack_from(data, start)
            (n,) = struct.unpack_from("<I", data, start + 28)
            compression = bytes(data[start + 32 : start + 32 + n]).decode()
            (stored,) = struct.unpack_from("<Q", data, start + 32 + n)
        except (struct.error, UnicodeDecodeError) as error:
            raise SpanDamageError(f"malformed chunk header: {error}") from error
        at = start + 40 + n
        if at + stored > end:
            raise SpanDamageError("the chunk's records run past its end")
        if size > _LARGEST_CHUNK_BYTES:
            raise SpanDamageError(f"it claims {size} bytes")
        with memoryview(data) as view, view[at : at + stored] as compressed:
            content = self._decompress(compression, compressed, size)
        self._touched(end - start)
        if len(content) != size:
            raise SpanDamageError(f"decompressed to {len(content)} bytes instead of {size}")
        if crc and zlib.crc32(content) != crc:
            raise SpanDamageError("its CRC does not match")
        return content

    def raw_chunk(self, span: Span, block: Block, kept: frozenset[int]) -> RawChunk | None:
        """Return the chunk that a block was read from, to be written to another file as it is.

        Parameters
        ----------
        span, block : the span, and what :meth:`load` gave, so that the chunk is known to be sound.
        kept : channels that have the same id and definition in the other file.

        Returns
        -------
        The chunk; None if these messages are in none, or if it holds or declares anything that the other file has
        not.
        """
        start, _, is_chunk, _ = self._extents[span.index]
        if not is_chunk or not len(block) or not kept.issuperset(np.unique(block.channel).tolist()):
            return None
        if max(int(block.log_time_ns.max()), int(block.publish_time_ns.max())) >= MAX_TIME_NS:
            return None  # the index could not hold the time that the message has
        content = bytes(block.buffer)
        head = block.offset - MESSAGE_HEAD.itemsize
        others = _records_between(content, np.append(0, block.offset + block.length), np.append(head, len(content)))
        if others is None or not all(self._is_known(op, content[at:end], kept) for op, at, end in others):
            return None
        _, _, size, crc = _CHUNK.unpack_from(self._data, start)
        (n,) = struct.unpack_from("<I", self._data, start + 28)
        compression = self._data[start + 32 : start + 32 + n].decode()
        (length,) = struct.unpack_from("<Q", self._data, start + 32 + n)
        at = start + 40 + n
        return RawChunk(
            compression=compression,
            stored=self._data[at : at + length],
            size=size,
            crc=crc or zlib.crc32(content),
            channel=block.channel,
            log_time_ns=block.log_time_ns,
            offset=head,
        )

    def _is_known(self, opcode: int, payload: bytes, kept: frozenset[int]) -> bool:
        """Tell whether a record of a chunk declares only what the kept channels are declared as in this file."""
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

    def _indexed_messages(self, content: bytes, start: int, end: int) -> Block | None:
        """Return the chunk's messages through its message indexes; None if these do not name all of them."""
        indexes = self._message_indexes(start, end)
        if not indexes:
            return None
        # Each channel's offsets ascend already, which the stable sort makes use of.
        offset = np.sort(np.concatenate([offsets.astype(np.int64) for _, _, offsets in indexes]), kind="stable")
        return _gather_messages(content, offset)

    def _message_indexes(self, start: int, end: int) -> list[tuple[int, UintArray, UintArray]] | None:
        """Return channel, log times [N] and offsets [N] of the message indexes in [start, end); None if one is bad."""
        found: list[tuple[int, UintArray, UintArray]] = []
        at = start
        while at < end:
            _, length = _RECORD.unpack_from(self._data, at)
            channel, n = struct.unpack_from("<HI", self._data, at + 9)
            if n % 16 or n + 6 > length:
                return None
            pairs = np.frombuffer(self._data[at + 15 : at + 15 + n], dtype="<u8")
            found.append((channel, pairs[0::2], pairs[1::2]))
            at += 9 + length
        return found

    def times(self, span: Span) -> tuple[IntArray, IntArray]:
        """Return a span's channels and log times; a chunk's from its message indexes, where it has them."""
        start, end = self._extents[span.index][3]
        indexes = self._message_indexes(start, end)
        if not indexes:
            return super().times(span)
        self._touched(end - start + _PAGES_AROUND_BYTES)
        channel = np.concatenate([np.full(len(times), id_, dtype=np.int64) for id_, times, _ in indexes])
        log_time = np.minimum(np.concatenate([times for _, times, _ in indexes]), np.uint64(MAX_TIME_NS))
        return channel, log_time.astype(np.int64)

    def crc_up_to(self, end: int) -> int:
        """Return the CRC of the file's first bytes."""
        crc = 0
        for start in range(0, end, _MAPPED_BYTES):
            with memoryview(self._data) as view, view[start : min(start + _MAPPED_BYTES, end)] as part:
                crc = zlib.crc32(part, crc)
            self._touched(_MAPPED_BYTES)
        return crc

    def _touched(self, size: int) -> None:
        """Give pages of the mapped file back now and then: they count as memory of this process."""
        self._touched_bytes += size
        if self._touched_bytes >= _MAPPED_BYTES:
            self._touched_bytes = 0
            if hasattr(mmap, "MADV_DONTNEED"):
                self._data.madvise(mmap.MADV_DONTNEED)

    def _decompress(self, compression: str, stored: memoryview, size: int) -> bytes:
        """Undo a chunk's compression; every library's own error becomes one."""
        if compression == "":
            return bytes(stored)
        if compression == "zstd":
            return self._decompress_zstd(stored, size)
        if compression != "lz4":
            raise SpanDamageError(f"unknown compression {compression!r}")
        import lz4.frame

        try:
            return bytes(lz4.frame.decompress(stored))
        except (RuntimeError, EOFError, ValueError, OverflowError, MemoryError) as error:
            raise SpanDamageError(str(error)) from error

    def _decompress_zstd(self, stored: memoryview, size: int) -> bytes:
        import zstandard

        if self._zstd is None:
            self._zstd = zstandard.ZstdDecompressor()
        try:
            if zstandard.frame_content_size(stored) not in (-1, size):
                raise SpanDamageError("its compressed content has another size")
            return self._zstd.decompress(stored, max_output_size=size)
        except (zstandard.ZstdError, OverflowError, MemoryError) as error:
            raise SpanDamageError(str(error)) from error

    def attachments(self) -> Iterator[Attachment]:
        """Read the attachments; a damaged one was reported by the walk and is left out."""
        for start, end in self._attachment_at:
            record = AttachmentRecord.read(ReadDataStream(BytesIO(self._data[start:end])))
            yield Attachment(record.name, record.media_type, record.data, record.log_time, record.create_time)

    def metadata_records(self) -> Iterator[MetadataRecord]:
        """Read the metadata records."""
        for start, end in self._metadata_at:
            record = Metadata.read(ReadDataStream(BytesIO(self._data[start:end])))
            yield MetadataRecord(record.name, dict(record.metadata))


class _Walk:
    """State of the one pass over the top-level records."""

    def __init__(self, container: McapContainer) -> None:
        self.of = container
        self.closed = False
        self.data_end = False
        self.run: tuple[int, int] | None = None  # extent of consecutive unchunked messages
        self.run_times: list[int] = []
        self.run_counts: Counter[int] = Counter()
        self.chunk: tuple[int, int, int, int] | None = None  # start, end, first log time, last log time
        self.index_extent = (0, 0)
        self.index_counts: Counter[int] = Counter()
        self.last_ns: int | None = None

    def record(self, opcode: int, at: int, start: int, end: int) -> None:
        """Handle one complete record."""
        of, data = self.of, self.of._data
        if opcode == Opcode.MESSAGE_INDEX and self.chunk is not None:
            (channel,) = struct.unpack_from("<H", data, start)
            (n,) = struct.unpack_from("<I", data, start + 2)
            self.index_counts[channel] += n // 16
            self.index_extent = (self.index_extent[0] or at, end)
            return
        self._end_chunk()
        if opcode == Opcode.MESSAGE:
            channel, _, log_time, _ = _MESSAGE.unpack_from(data, start)
            self.run = (self.run[0] if self.run else at, end)
            self.run_times.append(min(log_time, MAX_TIME_NS))
            self.run_counts[channel] += 1
            if end - self.run[0] >= _UNCHUNKED_RUN_BYTES:
                self._end_run()
            return
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            # Stay inside a run: writers interleave declarations with the messages.
            (of.add_schema if opcode == Opcode.SCHEMA else of.add_channel)(data[start:end])
            return
        self._end_run()
        if opcode == Opcode.CHUNK:
            first, last, _, _ = _CHUNK.unpack_from(data, start)
            self.chunk = (start, end, min(first, MAX_TIME_NS), min(last, MAX_TIME_NS))
        elif opcode == Opcode.ATTACHMENT:
            self._attachment(start, end)
        elif opcode == Opcode.DATA_END:
            self._data_end(at, start)
        elif opcode == Opcode.METADATA:
            Metadata.read(ReadDataStream(BytesIO(data[start:end])))
            of._metadata_at.append((start, end))

    def _data_end(self, at: int, start: int) -> None:
        """Check the CRC of the data section where nothing else protects the messages."""
        self.data_end = True
        of = self.of
        (crc,) = struct.unpack_from("<I", of._data, start)
        if crc and not all(is_chunk for _, _, is_chunk, _ in of._extents) and of.crc_up_to(at) != crc:
            what = "the CRC of the data section does not match: some unchunked messages are damaged"
            of.lose("bad-data-crc", what)

    def _attachment(self, start: int, end: int) -> None:
        of, data = self.of, self.of._data
        stream = ReadDataStream(BytesIO(data[start:end]))
        record = AttachmentRecord.read(stream)
        crc_at = start + stream.count - 4  # a record may be padded behind its last member
        (crc,) = struct.unpack_from("<I", data, crc_at)
        if crc and zlib.crc32(data[start:crc_at]) != crc:
            of.lose("bad-attachment", f"attachment {record.name!r} has a wrong CRC", count=1)
            return
        of._attachment_at.append((start, end))

    def _end_run(self) -> None:
        if self.run is None:
            return
        of = self.of
        times = self.run_times
        of._extents.append((*self.run, False, (0, 0)))
        ordered = all(a <= b for a, b in pairwise(times))
        of.spans.append(Span(len(of.spans), min(times), max(times) + 1, dict(self.run_counts), ordered))
        self.last_ns = max(times)
        self.run, self.run_times, self.run_counts = None, [], Counter()

    def _end_chunk(self, index_complete: bool = True) -> None:
        """Close a chunk; open it now if only its content tells its channels or its messages."""
        if self.chunk is None:
            return
        of = self.of
        start, end, first, last = self.chunk
        counts: Mapping[int, int] = dict(self.index_counts)
        extent, known = self.index_extent, set(of._raw_channels)
        self.chunk, self.index_extent, self.index_counts = None, (0, 0), Counter()
        index = len(of.spans)
        if not index_complete or not counts or not set(counts) <= known:
            try:
                content = of.chunk_content(start, end)
                block = _scan_messages(content, of)
            except SpanDamageError:
                # A read of this span reports the damage; without its content the span is kept as it is indexed.
                pass
            else:
                if not len(block):
                    return
                counts = block.counts
                first, last = int(block.log_time_ns.min()), int(block.log_time_ns.max())
        of._extents.append((start, end, True, extent))
        of.spans.append(Span(index, first, last + 1, counts))
        self.last_ns = last

    def cut(self, at: int) -> None:
        """Note that the file ends inside a record."""
        self._end_chunk(index_complete=False)
        self._end_run()
        what = f"the file ends inside a record at byte {at} of {len(self.of._data)}; what follows is gone"
        self.of.lose("truncated", what, self._after_last())

    def skipped(self, at: int, resume: int) -> None:
        """Note that a damaged stretch was stepped over."""
        self._end_chunk(index_complete=False)
        self._end_run()
        what = f"bytes {at} to {resume} hold no readable record; reading resumes at the next chunk"
        self.of.lose("bad-record", what, self._after_last())

    def damaged_record(self, at: int, error: Exception) -> None:
        """Note that one record cannot be parsed."""
        self.of.lose("bad-record", f"the record at byte {at} is malformed: {error}")

    def _after_last(self) -> int | None:
        return None if self.last_ns is None else self.last_ns + 1

    def finish(self) -> None:
        """Close what is open and check what only the whole file tells."""
        self._end_chunk()
        self._end_run()
        of = self.of
        if self.closed and not self.data_end:
            if not of.spans:
                raise of.no_log("an MCAP 1.0 file", "a draft of the format before 1.0")
            of.lose("bad-record", "the data end record is missing")
        if not self.closed and not any(loss.kind == "truncated" for loss in of.lost):
            of.lose("truncated", "the file ends without its closing magic bytes", self._after_last())
        of.resolve_channels()
        of.drop_undeclared("channels {}")


def _gather_messages(content: bytes, offset: IntArray) -> Block | None:
    """Read message headers at known ascending offsets; None if the content holds other messages than these."""
    n = len(content)
    if offset.size == 0 or offset[0] < 0 or offset[-1] + MESSAGE_HEAD.itemsize > n:
        return None
    # Gathered as plain bytes: NumPy copies structured items member by member.
    plain = np.dtype((np.void, MESSAGE_HEAD.itemsize))
    heads = np.ndarray((n - plain.itemsize + 1,), dtype=plain, buffer=content, strides=(1,))[offset]
    heads = heads.view(MESSAGE_HEAD)
    size = heads["size"].astype(np.int64)
    ends = offset + (9 + size)
    if (heads["op"] != Opcode.MESSAGE).any() or (size < 22).any() or (ends > n).any():
        return None
    starts = np.append(offset, n)
    ends = np.append(0, ends)
    if (starts != ends).any():
        others = _records_between(content, ends, starts)
        if others is None or any(opcode == Opcode.MESSAGE for opcode, _, _ in others):
            return None
    latest = np.uint64(MAX_TIME_NS)
    return Block(
        buffer=content,
        channel=heads["channel"].astype(np.int64),
        log_time_ns=np.minimum(heads["log"], latest).view(np.int64),
        publish_time_ns=np.minimum(heads["publish"], latest).view(np.int64),
        sequence=heads["sequence"].astype(np.int64),
        offset=offset + 31,
        length=size - 22,
    )


def _records_between(content: bytes, starts: IntArray, ends: IntArray) -> list[tuple[int, int, int]] | None:
    """Return opcode and extent of the records in the gaps [starts, ends); None if a gap is not filled by records."""
    found: list[tuple[int, int, int]] = []
    gaps = np.flatnonzero(starts != ends)
    for at, end in zip(starts[gaps].tolist(), ends[gaps].tolist(), strict=True):
        while at < end:
            if at + 9 > end:
                return None
            opcode, length = _RECORD.unpack_from(content, at)
            found.append((opcode, at + 9, at + 9 + length))
            at += 9 + length
        if at != end:
            return None
    return found


def _scan_messages(content: bytes, declare: McapContainer | None) -> Block:
    """Walk the records of a chunk's content, noting the schemas and channels it declares."""
    columns: tuple[list[int], ...] = ([], [], [], [], [], [])
    channels, logs, publishes, sequences, offsets, lengths = columns
    at, size = 0, len(content)
    while at < size:
        if at + 9 > size:
            raise SpanDamageError("its last record is cut")
        opcode, length = _RECORD.unpack_from(content, at)
        start, end = at + 9, at + 9 + length
        if end > size:
            raise SpanDamageError("its last record is cut")
        if opcode == Opcode.MESSAGE:
            if length < 22:
                raise SpanDamageError("a message record is too short")
            channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(content, start)
            channels.append(channel)
            sequences.append(sequence)
            logs.append(min(log_time, MAX_TIME_NS))
            publishes.append(min(publish_time, MAX_TIME_NS))
            offsets.append(start + 22)
            lengths.append(length - 22)
        elif declare is not None and opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            try:
                (declare.add_schema if opcode == Opcode.SCHEMA else declare.add_channel)(content[start:end])
            except (struct.error, UnicodeDecodeError, ValueError, McapError) as error:
                raise SpanDamageError(f"malformed declaration: {error}") from error
        at = end
    return block_from_lists(content, channels, logs, publishes, sequences, offsets, lengths)
