"""ROS 1 bags (format 2.0) as a container: one walk over the record headers, chunks decoded one at a time.

Bags without an index are walked like any other, so that an unindexed bag gives every message of its complete chunks.
"""

from __future__ import annotations

import bz2
import contextlib
import mmap
import struct
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from pdhef_logtool.logs.container import (
    ROSBAG1_MAGIC,
    Block,
    ChannelRecord,
    MappedContainer,
    Span,
    SpanDamageError,
    block_from_lists,
)
from pdhef_logtool.logs.type_names import ros2_type_name

_OP_MESSAGE, _OP_BAG_HEADER, _OP_INDEX, _OP_CHUNK, _OP_CONNECTION = 2, 3, 4, 5, 7
_U32 = struct.Struct("<I")
_TIME = struct.Struct("<II")


class Rosbag1Container(MappedContainer):
    """One ROS 1 bag of format 2.0, its connections as channels."""

    form = "rosbag1"
    magic = ROSBAG1_MAGIC
    magic_text = "'#ROSBAG V2.0' at its start"
    remedy = "is it a ROS 1 bag?"

    def __init__(self, path: Path, shown_path: Path | None = None) -> None:
        self._chunks: list[tuple[str, int, int, int]] = []  # compression, uncompressed size, start, end
        super().__init__(path, shown_path)

    def _walk(self) -> None:
        data, size = self._data, len(self._data)
        at, index_at = len(self.magic), 0
        pending: list[tuple[str, int, int, int]] = []  # the chunk whose index records are being read
        times: list[int] = []
        counts: Counter[int] = Counter()
        disordered: set[int] = set()
        header_seen = False

        def close_chunk() -> None:
            if pending:
                self._add_chunk(pending.pop(), times, counts, not disordered)
            times.clear()
            disordered.clear()
            counts.clear()

        while at < size:
            record = _record_at(data, at, size)
            if record is None:
                padded_to = index_at if at < index_at <= size else size
                if not any(data[at:padded_to]):
                    at = padded_to  # some writers pad with zeros behind the last chunk or the last record
                    continue
                if not header_seen:
                    raise self.no_log("a complete bag header record", "a cut or malformed one")
                close_chunk()
                what = f"the file ends inside a record at byte {at} of {size}; what follows is gone"
                self.lose("truncated", what, self._end_ns())
                break
            fields, start, end = record
            op = fields.get("op", b"\0")[0]
            try:
                if op == _OP_BAG_HEADER:
                    header_seen = True
                    index_at = int.from_bytes(fields["index_pos"], "little")
                elif op == _OP_CHUNK:
                    close_chunk()
                    pending.append((fields["compression"].decode(), _U32.unpack(fields["size"])[0], start, end))
                elif op == _OP_INDEX and pending:
                    connection, stamps = _index_record(fields, data[start:end])
                    counts[connection] += len(stamps)
                    times.extend(stamps)
                    if any(a > b for a, b in pairwise(stamps)):
                        disordered.add(connection)
                elif op == _OP_CONNECTION:
                    self._add_connection(fields, data[start:end])
            except (KeyError, struct.error, ValueError, IndexError) as error:
                self.lose("bad-record", f"the record at byte {at} is malformed: {error}")
            at = end
        if not header_seen:
            raise self.no_log("a bag header record", "none")
        close_chunk()
        self._declare_from_chunks()
        if not index_at and not self.lost:
            what = "the bag has no index (it was not closed); its complete chunks were read by a scan"
            self.lose("unindexed", what, self._end_ns())
        self.drop_undeclared("connections")

    def _end_ns(self) -> int | None:
        return self.spans[-1].end_ns if self.spans else None

    def _declare_from_chunks(self) -> None:
        """Find connections that only the chunks declare, as in a bag without its index section."""
        for span in self.spans:
            if not set(span.counts) <= set(self.channels):
                with contextlib.suppress(SpanDamageError):  # a read of the span reports the damage
                    self._decode(self._chunks[span.index], declare=True)

    def _add_connection(self, fields: Mapping[str, bytes], payload: bytes) -> None:
        inner = _header_fields(payload)
        id_ = _U32.unpack(fields["conn"])[0]
        type_name = inner["type"].decode()
        metadata: dict[str, str] = {
            name: inner[name].decode("utf-8", errors="replace")
            for name in ("callerid", "latching", "md5sum")
            if name in inner
        }
        self.channels.setdefault(
            id_,
            ChannelRecord(
                id=id_,
                topic=fields["topic"].decode(),
                type_name=ros2_type_name(type_name),
                encoding="ros1",
                schema_name=type_name,
                schema_encoding="ros1msg",
                schema_data=inner.get("message_definition", b""),
                metadata=metadata,
            ),
        )

    def _add_chunk(
        self, chunk: tuple[str, int, int, int], times: Sequence[int], counts: Mapping[int, int], ordered: bool
    ) -> None:
        index = len(self.spans)
        self._chunks.append(chunk)
        if times:
            self.spans.append(Span(index, min(times), max(times) + 1, dict(counts), ordered))
            return
        try:
            block = self._decode(chunk, declare=True)
        except SpanDamageError as error:
            self._chunks.pop()
            self.lose("bad-chunk", f"a chunk without index lost: {error}", self._end_ns())
            return
        if not len(block):
            self._chunks.pop()
            return
        self.spans.append(Span(index, int(block.log_time_ns.min()), int(block.log_time_ns.max()) + 1, block.counts))

    def load(self, span: Span, want: frozenset[int] | None = None) -> Block:
        """Decode one chunk; see :class:`~pdhef_logtool.logs.container.Container`."""
        del want
        return self._decode(self._chunks[span.index], declare=False)

    def _decode(self, chunk: tuple[str, int, int, int], declare: bool) -> Block:
        compression, size, start, end = chunk
        content = _decompress(compression, self._data[start:end])
        if len(content) != size:
            raise SpanDamageError(f"decompressed to {len(content)} bytes instead of {size}")
        channels: list[int] = []
        stamps: list[int] = []
        offsets: list[int] = []
        lengths: list[int] = []
        at = 0
        while at < size:
            record = _record_at(content, at, size)
            if record is None:
                raise SpanDamageError("its last record is cut")
            fields, begin, at = record
            op = fields.get("op", b"\0")[0]
            try:
                if op == _OP_MESSAGE:
                    channels.append(_U32.unpack(fields["conn"])[0])
                    stamps.append(_time_ns(fields["time"]))
                    offsets.append(begin)
                    lengths.append(at - begin)
                elif op == _OP_CONNECTION and declare:
                    self._add_connection(fields, content[begin:at])
            except (KeyError, struct.error, ValueError) as error:
                raise SpanDamageError(f"a record is malformed: {error}") from error
        return block_from_lists(content, channels, stamps, stamps, [0] * len(stamps), offsets, lengths)


def _record_at(data: bytes | mmap.mmap, at: int, size: int) -> tuple[dict[str, bytes], int, int] | None:
    """Return header fields and data extent of the record at a byte; None if it is cut or no record."""
    if at + 8 > size:
        return None
    (header,) = _U32.unpack_from(data, at)
    if header == 0 or at + 8 + header > size:
        return None
    start = at + 8 + header
    (length,) = _U32.unpack_from(data, start - 4)
    if start + length > size:
        return None
    try:
        return _header_fields(data[at + 4 : at + 4 + header]), start, start + length
    except (struct.error, ValueError):
        return None


def _header_fields(text: bytes) -> dict[str, bytes]:
    fields: dict[str, bytes] = {}
    at = 0
    while at < len(text):
        (length,) = _U32.unpack_from(text, at)
        name, sign, value = text[at + 4 : at + 4 + length].partition(b"=")
        if not sign or at + 4 + length > len(text):
            raise ValueError("a header field without '='")
        fields[name.decode("ascii", errors="replace")] = value
        at += 4 + length
    return fields


def _time_ns(value: bytes) -> int:
    seconds, nanoseconds = _TIME.unpack(value)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def _index_record(fields: Mapping[str, bytes], payload: bytes) -> tuple[int, list[int]]:
    """Return the connection and the log times that an index record lists."""
    count = _U32.unpack(fields["count"])[0]
    words = np.frombuffer(payload, dtype="<u4", count=3 * count).reshape(count, 3).astype(np.int64)
    return _U32.unpack(fields["conn"])[0], (words[:, 0] * 1_000_000_000 + words[:, 1]).tolist()


def _decompress(compression: str, stored: bytes) -> bytes:
    try:
        if compression == "none":
            return stored
        if compression == "bz2":
            return bz2.decompress(stored)
        if compression == "lz4":
            import lz4.frame

            return bytes(lz4.frame.decompress(stored))
    except (OSError, RuntimeError, EOFError, ValueError, MemoryError) as error:
        raise SpanDamageError(str(error)) from error
    raise SpanDamageError(f"unknown compression {compression!r}")
