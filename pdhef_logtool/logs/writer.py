"""MCAP writing: ROS 2 topics from columns, other messages as ready bytes, merged by log time.

Every file has zstd chunks, message indexes, statistics, a summary and CRCs: other readers need them. Channels and
schemas are written before the first chunk that uses them and again in the summary.
"""

from __future__ import annotations

import contextlib
import struct
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from isal.isal_zlib import crc32
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from numpy.typing import NDArray

from pdhef_logtool.logs.container import MCAP_MAGIC, ChannelRecord, RawChunk
from pdhef_logtool.logs.encoding import CdrEncoder
from pdhef_logtool.logs.mcap_log import MESSAGE_HEAD
from pdhef_logtool.logs.schema_files import message_definition
from pdhef_logtool.records.errors import MappingError, OutputError
from pdhef_logtool.records.signals import IntArray
from pdhef_logtool.records.version import LIBRARY
from pdhef_logtool.storage.files import PendingFile, open_new, writing

if TYPE_CHECKING:
    from zstandard import ZstdCompressor

#: Of message records, as far as they come together; in a chunk.
CHUNK_BYTES = 1 << 20
#: Of zstd.
_LEVEL = 6
_LARGEST_ID = 0xFFFF
_PACKED_HEAD = struct.Struct("<BQHIQQ")


@dataclass(frozen=True, slots=True, eq=False)
class TopicBatch:
    """Messages of one topic as columns.

    Attributes
    ----------
    log_time_ns, publish_time_ns : int64 [N]; log times ascend.
    fields : by dotted path, [N] or [N, k]; a time path such as ``header.stamp`` takes int64 nanoseconds, a
        quaternion struct the columns w, x, y, z.
    """

    topic: str
    log_time_ns: IntArray
    publish_time_ns: IntArray
    fields: Mapping[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class RawMessage:
    """A message as ready bytes on a channel of :meth:`McapLogWriter.add_raw_channel`."""

    channel: int
    log_time_ns: int
    publish_time_ns: int
    sequence: int
    data: bytes


#: Message records to be written: log time, channel, bytes, and where they are: number of the source and row in it.
_LISTED = np.dtype([("log", "<i8"), ("channel", "<i8"), ("length", "<i8"), ("source", "<i8"), ("row", "<i8")])


class _Merged:
    """Message records of several topics in order of log time, taken from the front.

    Parameters
    ----------
    topics : channel, log times [N] and complete records uint8 [N, size] of each topic.
    """

    def __init__(self, topics: Sequence[tuple[int, IntArray, NDArray[np.uint8]]]) -> None:
        self.sources = [records for _, _, records in topics]
        self.listed = _in_order(
            [_listed(log, channel, records.shape[1], i) for i, (channel, log, records) in enumerate(topics)]
        )
        self.ends: IntArray = np.cumsum(self.listed["length"])
        self.position = 0

    def take_until(self, until_ns: int | None) -> NDArray[np.void]:
        """Remove and return the records before a time (None: all)."""
        first, self.position = self.position, len(self.listed)
        if until_ns is not None:
            self.position = max(first, int(np.searchsorted(self.listed["log"], until_ns, side="left")))
        return self.listed[first : self.position]

    def take_chunk(self) -> NDArray[np.void]:
        """Remove and return the records of one chunk."""
        first, self.position = self.position, _end_of_chunk(self.ends, self.position)
        return self.listed[first : self.position]

    @property
    def next_ns(self) -> int | None:
        """Log time of the first record that is left."""
        return int(self.listed["log"][self.position]) if self.position < len(self.listed) else None


def _listed(log_time_ns: Any, channel: Any, length: Any, source: int) -> NDArray[np.void]:
    listed = np.empty(len(log_time_ns), _LISTED)
    listed["log"], listed["channel"], listed["length"], listed["source"] = log_time_ns, channel, length, source
    listed["row"] = np.arange(len(listed))
    return listed


def _in_order(parts: Sequence[NDArray[np.void]]) -> NDArray[np.void]:
    """Return lists of records as one, in order of log time; of equal times the earlier list comes first."""
    listed = np.concatenate([np.empty(0, _LISTED), *parts])
    return listed[np.argsort(listed["log"], kind="stable")]


def _end_of_chunk(ends: IntArray, first: int) -> int:
    """Return the record behind the chunk that begins with a record; ``ends`` are sums of bytes [N]."""
    base = int(ends[first - 1]) if first else 0
    return max(int(np.searchsorted(ends, base + CHUNK_BYTES, side="right")), first + 1)


class McapLogWriter(contextlib.AbstractContextManager["McapLogWriter"]):
    """Writes one MCAP file under a temporary name and renames it on :meth:`close`; removes it on an error.

    Parameters
    ----------
    path : file to write; its folder is made when it is missing.
    profile : MCAP profile. level : of zstd.

    Raises
    ------
    OutputError : the file cannot be written.
    """

    def __init__(self, path: Path, *, profile: str = "ros2", level: int = _LEVEL) -> None:
        self._path, self._level = path, level
        self._schemas: dict[int, Schema] = {}
        self._schema_ids: dict[tuple[str, str, bytes], int] = {}
        self._channels: dict[int, Channel] = {}
        self._encoders: dict[str, tuple[int, CdrEncoder]] = {}
        self._sequences: Counter[int] = Counter()
        self._counts: Counter[int] = Counter()
        self._chunk_indexes: list[ChunkIndex] = []
        self._attachment_indexes: list[AttachmentIndex] = []
        self._metadata_indexes: list[MetadataIndex] = []
        self._first_ns: int | None = None
        self._last_ns = 0
        self._crc = 0
        self._at = 0
        self._compressor: ZstdCompressor | None = None
        self._pending = PendingFile(path)
        with writing(path):
            self._file: IO[bytes] = open_new(self._pending.path)
        self._emit(MCAP_MAGIC)
        self._emit_record(Header(profile=profile, library=LIBRARY))

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Close the file, or remove it if an exception passes."""
        if kind is None:
            self.close()
        else:
            self.abort()

    def add_topic(
        self,
        topic: str,
        type_name: str,
        *,
        constants: Mapping[str, str | float | Sequence[float]] | None = None,
        definition: str | None = None,
    ) -> None:
        """Add a ROS 2 CDR topic for :class:`TopicBatch`.

        Parameters
        ----------
        topic : topic name.
        type_name : ROS 2 type, ``pkg/msg/Type``.
        constants : constant fields of every message, by path (texts, numbers, arrays such as covariances).
        definition : ros2msg text; the type's own from ``schemas/`` or the common ROS 2 packages when absent.

        Raises
        ------
        MappingError : the type is unknown, a constant does not fit it, or the topic was added before.
        """
        if topic in self._encoders:
            raise MappingError(expected="a new topic", got="one that was added before", where=topic)
        if definition is None:
            try:
                definition = message_definition(type_name)
            except KeyError as error:
                raise MappingError(
                    expected="a common ROS 2 type or one of our own",
                    got=type_name,
                    where=topic,
                    remedy="give its definition",
                ) from error
        encoder = CdrEncoder(topic, type_name, definition, constants or {})
        channel = self.add_channel(ChannelRecord(-1, topic, "cdr", type_name, "ros2msg", definition.encode()))
        self._encoders[topic] = (channel, encoder)

    def add_channel(self, record: ChannelRecord) -> int:
        """Add a channel and return its id; without name and encoding of the schema it has none.

        The ids are those of the record if these are free, otherwise others in ascending order.

        Raises
        ------
        OutputError : there are too many channels.
        """
        schema = 0
        if record.schema_name or record.schema_encoding:
            schema = self._add_schema(record.schema_name, record.schema_encoding, record.schema_data, record.schema_id)
        channel = Channel(
            id=self._free_id(self._channels, record.id),
            topic=record.topic,
            message_encoding=record.encoding,
            metadata=dict(record.metadata),
            schema_id=schema,
        )
        self._channels[channel.id] = channel
        self._emit_record(channel)
        return channel.id

    def add_raw_channel(
        self,
        topic: str,
        *,
        schema_name: str,
        schema_encoding: str,
        schema_data: bytes,
        message_encoding: str,
        metadata: Mapping[str, str],
    ) -> int:
        """Add a channel for :class:`RawMessage`, as :meth:`add_channel`."""
        schema = schema_name, schema_encoding, schema_data
        return self.add_channel(ChannelRecord(-1, topic, message_encoding, *schema, metadata))

    def has_ids_of(self, channel_id: int, record: ChannelRecord) -> bool:
        """Return whether a channel has the ids of a record, which a :class:`RawChunk` of its file needs."""
        return channel_id == record.id and self._channels[channel_id].schema_id == record.schema_id

    def _add_schema(self, name: str, encoding: str, data: bytes, wanted: int) -> int:
        key = (name, encoding, data)
        held = self._schemas.get(wanted)
        if held is not None and (held.name, held.encoding, held.data) == key:
            return wanted
        if key in self._schema_ids and (held is not None or not wanted):
            return self._schema_ids[key]
        schema = Schema(id=self._free_id(self._schemas, wanted or -1), data=data, encoding=encoding, name=name)
        self._schemas[schema.id] = schema
        self._schema_ids.setdefault(key, schema.id)
        self._emit_record(schema)
        return schema.id

    def _free_id(self, taken: Mapping[int, object], wanted: int) -> int:
        """Return the wanted id if it is free, otherwise the next above all ids, or a gap."""
        if 0 <= wanted <= _LARGEST_ID and wanted not in taken:
            return wanted
        above = max(taken, default=0) + 1
        if above <= _LARGEST_ID:
            return above
        free = next((i for i in range(1, _LARGEST_ID + 1) if i not in taken), None)
        if free is None:
            raise OutputError(expected="at most 65535 channels", got="more", where=str(self._path))
        return free

    def write(self, batches: Sequence[TopicBatch], raws: Iterable[RawMessage | RawChunk] = ()) -> None:
        """Write messages merged by log time; on equal times raw messages come first, then batches in their order.

        Raw messages are consumed as they come (in ascending log time) and not held. Raw chunks are written as they
        are; the batches then become separate chunks, and all chunks are sorted by their first log times.
        """
        merged = _Merged([self._encode(batch) for batch in batches if len(batch.log_time_ns)])
        group: list[RawMessage] = []
        size = 0
        for raw in raws:
            if isinstance(raw, RawChunk):
                start_ns = raw.start_ns
                if group:
                    self._write_merged(group, merged, merged.take_until(start_ns))
                    group, size = [], 0
                while merged.next_ns is not None and merged.next_ns < start_ns:
                    self._write_merged([], merged, merged.take_chunk())
                self._emit_chunk(raw)
                continue
            group.append(raw)
            size += len(raw.data) + MESSAGE_HEAD.itemsize
            if size >= CHUNK_BYTES:
                self._write_merged(group, merged, merged.take_until(raw.log_time_ns))
                group, size = [], 0
        self._write_merged(group, merged, merged.take_until(None))

    def _encode(self, batch: TopicBatch) -> tuple[int, IntArray, NDArray[np.uint8]]:
        """Return channel, log times and message records of a batch."""
        if batch.topic not in self._encoders:
            raise MappingError(expected="a topic of this file", got="an unknown one", where=batch.topic)
        if np.any(np.diff(batch.log_time_ns) < 0):
            raise MappingError(expected="ascending log times", got="a step back", where=batch.topic)
        channel, encoder = self._encoders[batch.topic]
        n = len(batch.log_time_ns)
        rows = encoder.encode(n, batch.fields, head=MESSAGE_HEAD.itemsize)
        head = np.zeros(n, dtype=MESSAGE_HEAD)
        head["op"] = Opcode.MESSAGE
        head["size"] = 22 + rows.shape[1] - MESSAGE_HEAD.itemsize
        head["channel"] = channel
        head["sequence"] = self._sequences[channel] + np.arange(n)
        head["log"] = batch.log_time_ns
        head["publish"] = batch.publish_time_ns
        self._sequences[channel] += n
        rows[:, : MESSAGE_HEAD.itemsize] = head.view(np.uint8).reshape(n, MESSAGE_HEAD.itemsize)
        return channel, batch.log_time_ns.astype(np.int64), rows

    def _write_merged(self, raws: Sequence[RawMessage], merged: _Merged, listed: NDArray[np.void]) -> None:
        """Merge raw messages and listed records by log time and cut into chunks."""
        raw_records = [
            _PACKED_HEAD.pack(Opcode.MESSAGE, 22 + len(r.data), r.channel, r.sequence, r.log_time_ns, r.publish_time_ns)
            + r.data
            for r in raws
        ]
        if raws:
            log_time, channel = [r.log_time_ns for r in raws], [r.channel for r in raws]
            listed = _in_order([_listed(log_time, channel, [*map(len, raw_records)], -1), listed])
        ends = np.cumsum(listed["length"])
        first = 0
        while first < len(listed):
            last = _end_of_chunk(ends, first)
            part = listed[first:last]
            start = ends[first:last] - part["length"] - (ends[first] - part["length"][0])
            content = np.empty(int(part["length"].sum()), dtype=np.uint8)
            for i in np.unique(part["source"]).tolist():
                its = part["source"] == i
                scatter(content, start[its], part["row"][its], raw_records if i < 0 else merged.sources[i])
            self.write_chunk(content.data, part["channel"], part["log"], start)
            first = last

    def write_chunk(
        self, records: bytes | memoryview, channel: IntArray, log_time_ns: IntArray, offset: IntArray
    ) -> None:
        """Write message records as one chunk; channel, log time and offset [N] of each record in it."""
        if self._compressor is None:
            import zstandard

            self._compressor = zstandard.ZstdCompressor(level=self._level)
        stored = self._compressor.compress(records)
        self._emit_chunk(RawChunk("zstd", stored, len(records), crc32(records), channel, log_time_ns, offset))

    def _emit_chunk(self, chunk: RawChunk) -> None:
        channel, log_time, offset, stored = chunk.channel, chunk.log_time_ns, chunk.offset, chunk.stored
        start_ns, end_ns = int(log_time.min()), int(log_time.max())
        about: dict[str, Any] = {
            "compression": chunk.compression,
            "message_start_time": start_ns,
            "message_end_time": end_ns,
            "uncompressed_size": chunk.size,
        }
        chunk_start, chunk_length = self._emit_record(Chunk(data=stored, uncompressed_crc=chunk.crc, **about))
        index_at = self._at
        offsets: dict[int, int] = {}
        index = bytearray()
        order = np.argsort(channel, kind="stable")
        pairs = np.empty((len(order), 2), dtype="<u8")
        pairs[:, 0], pairs[:, 1] = log_time[order], offset[order]
        ids, firsts = np.unique(channel[order], return_index=True)
        for id_, mine in zip(ids.tolist(), np.split(pairs, firsts[1:]), strict=True):
            offsets[id_] = index_at + len(index)
            data = mine.tobytes()
            index += struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + len(data), id_, len(data)) + data
            self._counts[id_] += len(mine)
        self._emit(bytes(index))
        self._chunk_indexes.append(
            ChunkIndex(
                chunk_start_offset=chunk_start,
                chunk_length=chunk_length,
                message_index_offsets=offsets,
                message_index_length=self._at - index_at,
                compressed_size=len(stored),
                **about,
            )
        )
        self._first_ns = start_ns if self._first_ns is None else min(self._first_ns, start_ns)
        self._last_ns = max(self._last_ns, end_ns)

    def attachment(self, record: Attachment) -> None:
        """Add a file."""
        start, length = self._emit_record(record)
        about = {name: getattr(record, name) for name in ("create_time", "log_time", "name", "media_type")}
        index = AttachmentIndex(offset=start, length=length, data_size=len(record.data), **about)
        self._attachment_indexes.append(index)

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a record of key-value pairs."""
        start, length = self._emit_record(Metadata(name=name, metadata=dict(values)))
        self._metadata_indexes.append(MetadataIndex(offset=start, length=length, name=name))

    def close(self) -> None:
        """Write the summary and give the file its name."""
        if self._file.closed:
            return
        self._emit_record(DataEnd(data_section_crc=self._crc))
        self._emit_summary()
        try:
            with writing(self._path):
                self._file.close()
        except BaseException:
            self.abort()
            raise
        self._pending.commit()

    def abort(self) -> None:
        """Remove the written part."""
        with contextlib.suppress(OSError):  # the buffered rest may not fit the disk either
            self._file.close()
        self._pending.discard()

    def _emit_summary(self) -> None:
        start = self._at
        builder = RecordBuilder()
        offsets: list[SummaryOffset] = []
        statistics = Statistics(
            attachment_count=len(self._attachment_indexes),
            channel_count=len(self._channels),
            channel_message_counts=dict(sorted(self._counts.items())),
            chunk_count=len(self._chunk_indexes),
            message_count=self._counts.total(),
            message_end_time=self._last_ns,
            message_start_time=self._first_ns or 0,
            metadata_count=len(self._metadata_indexes),
            schema_count=len(self._schemas),
        )
        groups: list[tuple[Opcode, Sequence[McapRecord]]] = [
            (Opcode.SCHEMA, list(self._schemas.values())),
            (Opcode.CHANNEL, list(self._channels.values())),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._chunk_indexes),
            (Opcode.ATTACHMENT_INDEX, self._attachment_indexes),
            (Opcode.METADATA_INDEX, self._metadata_indexes),
        ]
        for opcode, records in groups:
            group_start = builder.count
            for record in records:
                record.write(builder)
            if records:
                offsets.append(
                    SummaryOffset(
                        group_opcode=opcode, group_start=start + group_start, group_length=builder.count - group_start
                    )
                )
        offset_start = start + builder.count
        for offset in offsets:
            offset.write(builder)
        summary: bytes = builder.end()  # type: ignore[no-untyped-call]
        head = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offset_start)
        self._emit(summary)
        self._emit_record(
            Footer(
                summary_start=start,
                summary_offset_start=offset_start,
                summary_crc=crc32(head, crc32(summary)),
            )
        )
        self._emit(MCAP_MAGIC)

    def _emit(self, data: bytes) -> None:
        try:
            with writing(self._path):
                self._file.write(data)
        except BaseException:
            self.abort()
            raise
        self._crc = crc32(data, self._crc)
        self._at += len(data)

    def _emit_record(self, record: McapRecord) -> tuple[int, int]:
        builder = RecordBuilder()
        record.write(builder)
        data: bytes = builder.end()  # type: ignore[no-untyped-call]
        start = self._at
        self._emit(data)
        return start, len(data)


def scatter(
    content: NDArray[np.uint8], start: IntArray, row: IntArray, source: NDArray[np.uint8] | Sequence[bytes]
) -> None:
    """Copy records of ``source``, by their rows there, to their places in a chunk."""
    if isinstance(source, np.ndarray):
        size = source.shape[1]
        record = np.dtype((np.void, size))
        # A view of a record at every byte: one indexed assignment copies them all.
        places = np.ndarray((len(content) - size + 1,), dtype=record, buffer=content.data, strides=(1,))
        places[start] = source[row].view(record)[:, 0]
        return
    for to, i in zip(start.tolist(), row.tolist(), strict=True):
        data = source[i]
        content[to : to + len(data)] = np.frombuffer(data, dtype=np.uint8)
