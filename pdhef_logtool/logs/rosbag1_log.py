"""ROS 1 bags (format 2.0) as a container: one walk over the record headers, chunks decoded one at a time.

Bags without an index are walked like any other, so that an unindexed bag gives every message of its complete chunks.
"""

import struct
from array import array
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from io import BytesIO

import numpy as np
from rosbags.rosbag1.reader import Header, ReaderError, RecordType

from pdhef_logtool.logs.compression import decompress
from pdhef_logtool.logs.container import Block, ChannelRecord, FileContainer, Span, SpanDamageError, block_from_lists
from pdhef_logtool.logs.resource_limits import MIB
from pdhef_logtool.logs.table_file import LogFile
from pdhef_logtool.records.signals import NS_PER_S, IntArray

#: A plain number: comparing with a member of an enumeration takes longer.
_OP_MESSAGE = int(RecordType.MSGDATA)
_U32 = struct.Struct("<I")
_LENGTH_BYTES, _LENGTHS_BYTES = _U32.size, 2 * _U32.size  # of the header, and of header and data, of a record
#: Bytes of a message record without data: five lengths, an opcode, a connection and a time with their names.
_LEAST_MESSAGE_BYTES = struct.calcsize("<5IBIQ") + len(b"op=conn=time=")


@dataclass(slots=True)
class _Chunk:
    """A chunk record in bytes [start, end) and the content of its index records."""

    start: int
    stored_start: int  # of the compressed bytes
    end: int
    compression: str
    size: int
    indexes: list[tuple[int, IntArray]] = field(default_factory=list)  # connection and log times


class Rosbag1Container(FileContainer):
    """One ROS 1 bag of format 2.0, its connections as channels."""

    kind = "rosbag1"
    profile = ""  # of ROS 1 messages beside ours of ROS 2
    magic = b"#ROSBAG V2.0\n"
    magic_text = "'#ROSBAG V2.0' at its start"
    remedy = "is it a ROS 1 bag?"
    chunks: list[_Chunk]

    def __init__(self, file: LogFile) -> None:
        self._found: list[_Chunk] = []
        self._is_truncated = False
        self._header: tuple[int, int] | None = None  # where the index section begins, and how many chunks there are
        self._infos: dict[int, Counter[int]] = {}  # counts by connection of the chunk at a byte, by the index section
        super().__init__(file)

    def _walk(self) -> None:
        size = self.source.size
        for offset in self._places():
            record = _record_at(self.source.read, offset, size, self.meter.limits.metadata_bytes)
            if record is None:
                index_at = self._header[0] if self._header else 0
                padded_to = index_at if offset < index_at <= size else size
                if self._is_zero(offset, padded_to):
                    self.position = padded_to  # some writers pad with zeros behind the last chunk or the last record
                    continue
                if self._header is None:
                    raise self.no_log("a complete bag header record", "a cut or malformed one")
                self._is_truncated = True
                return
            fields, start, end = record
            try:
                self._take(fields, offset, start, end)
            except Exception as error:  # noqa: BLE001 (the next record is read in any case)
                self.lose_record(offset, error)
            self.position = end

    def _take(self, fields: Header, offset: int, start: int, end: int) -> None:
        """Handle one complete record."""
        op = fields.get_uint8("op")
        if op == RecordType.CHUNK:
            compression, size = fields.get_string("compression"), fields.get_uint32("size")
            self._found.append(_Chunk(offset, start, end, compression, size))
            return
        if op == RecordType.BAGHEADER:
            self._header = fields.get_uint64("index_pos"), fields.get_uint32("chunk_count")
            return
        self.meter.limits.check("metadata_bytes", end - start, f"a record of kind {op}")
        if op == RecordType.CONNECTION:
            self._add_connection(fields, self.source.read(start, end - start))
        elif op == RecordType.CHUNK_INFO:
            pairs = np.frombuffer(self.source.read(start, end - start), dtype="<u4")
            counts = Counter(dict(zip(pairs[::2].tolist(), pairs[1::2].tolist(), strict=True)))
            self._infos[fields.get_uint64("chunk_pos")] = counts
        elif op == RecordType.IDXDATA and self._found:
            self._found[-1].indexes.append(_index(fields, self.source.read(start, end - start)))
        else:
            raise SpanDamageError(f"no record of kind {op} is allowed here")

    def _finish(self) -> None:
        if self._header is None:
            raise self.no_log("a bag header record", "none")
        for chunk in self._found:
            # Some index records of the last chunk may be missing.
            self._add_chunk(chunk, is_complete=not self._is_truncated or chunk is not self._found[-1])
        if self._is_truncated:
            self.lose_end(self.position)
        index_at, chunks = self._header
        if not index_at and not self.lost:
            what = "the bag has no index (it was not closed); its complete chunks were read by a scan"
            self.lose("unindexed", what, self.last_ns())
        missing = chunks - len(self._found)
        if index_at and missing > 0 and not self.lost:
            self.lose("missing-messages", f"the bag's header names {chunks} chunks, {missing} of them are not there")
        self.drop_undeclared("connections")

    def _add_chunk(self, chunk: _Chunk, *, is_complete: bool) -> None:
        """Add a chunk by its index records; by its content, if these are missing or implausible or hide messages."""
        span = Span.of(chunk.indexes)
        is_known = bool(span.counts) and span.counts.keys() <= self.channels.keys()
        agrees = self._infos.get(chunk.start, span.counts) == span.counts
        if is_complete and is_known and agrees and sum(span.counts.values()) * _LEAST_MESSAGE_BYTES <= chunk.size:
            self.add_span(chunk, span)
        else:
            self.add_content(chunk)

    def _is_zero(self, start: int, end: int) -> bool:
        return all(not any(self.source.read(offset, min(MIB, end - offset))) for offset in range(start, end, MIB))

    def _add_connection(self, fields: Header, payload: bytes) -> None:
        inner = Header.read(BytesIO(_U32.pack(len(payload)) + payload))
        id_ = fields.get_uint32("conn")
        if id_ in self.channels:
            return
        self.meter.limits.check("channels", len(self.channels) + 1, f"connection {id_}")
        metadata: dict[str, str] = {
            name: inner[name].decode("utf-8", errors="replace")
            for name in ("callerid", "latching", "md5sum")
            if name in inner
        }
        self.channels[id_] = ChannelRecord(
            id=id_,
            topic=fields.get_string("topic"),
            encoding="ros1",
            schema_name=inner.get_string("type"),
            schema_encoding="ros1msg",
            schema_data=inner.get("message_definition", b""),
            metadata=metadata,
        )

    def _decoded(self, chunk: _Chunk, *, declare: bool) -> Block:
        self.meter.limits.check("chunk_bytes", chunk.end - chunk.stored_start, "a chunk")
        stored = self.source.read(chunk.stored_start, chunk.end - chunk.stored_start)
        content = decompress(chunk.compression or "unnamed", stored, chunk.size, self.meter.limits)
        channels, stamps, offsets, lengths = (array("q") for _ in range(4))
        offset, size = 0, len(content)
        while offset < size:
            record = _record_at(lambda first, count: content[first : first + count], offset, size, size)
            if record is None:
                raise SpanDamageError("its last record is cut")
            fields, begin, offset = record
            try:
                op = fields.get_uint8("op")
                if op == _OP_MESSAGE:
                    self.meter.check_scan(len(stamps))
                    channels.append(fields.get_uint32("conn"))
                    stamps.append(fields.get_time("time"))
                    offsets.append(begin)
                    lengths.append(offset - begin)
                elif op != RecordType.CONNECTION:
                    raise SpanDamageError(f"it contains a record of kind {op}, which no chunk may")
                elif declare:
                    self._add_connection(fields, content[begin:offset])
            except (ReaderError, ValueError) as error:
                raise SpanDamageError(f"a record is malformed: {error}") from error
        self.meter.limits.check_messages(len(stamps), len(stored))
        return block_from_lists(content, channels, stamps, stamps, [0] * len(stamps), offsets, lengths)


def _index(fields: Header, payload: bytes) -> tuple[int, IntArray]:
    """Return the connection and the log times [N] of an index record."""
    count = fields.get_uint32("count")
    words = np.frombuffer(payload, dtype="<u4", count=3 * count).reshape(count, 3).astype(np.int64)
    return fields.get_uint32("conn"), words[:, 0] * NS_PER_S + words[:, 1]


def _record_at(read: Callable[[int, int], bytes], offset: int, size: int, most: int) -> tuple[Header, int, int] | None:
    """Return header fields and data extent of the record at a byte; None if it is cut or no record.

    Parameters
    ----------
    read : returns bytes by offset and count. size : of the file or chunk. most : bytes of a header.
    """
    if offset + _LENGTHS_BYTES > size:
        return None
    header = int.from_bytes(read(offset, _LENGTH_BYTES), "little")
    start = offset + _LENGTHS_BYTES + header
    if header == 0 or start > size or header > most:
        return None
    text = read(offset, start - offset)
    end = start + int.from_bytes(text[-_LENGTH_BYTES:], "little")
    if end > size:
        return None
    try:
        return Header.read(BytesIO(text)), start, end
    except (ReaderError, ValueError):
        return None
