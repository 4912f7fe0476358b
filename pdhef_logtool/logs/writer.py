"""MCAP writing: ROS 2 topics from columns, other messages as ready bytes, merged by log time.

Every file has zstd chunks, message indexes, statistics, a summary and CRCs: other readers need them. Channels and
schemas are written before the first chunk that uses them and again in the summary.
"""

import contextlib
import struct
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence, Sized
from pathlib import Path
from typing import IO, Any

import numpy as np
from isal.isal_zlib import crc32
from mcap import records as mcap_records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from pdhef_logtool.logs.container import MCAP_MAGIC, Block, ChannelRecord, items_at_bytes, rows_by_channel
from pdhef_logtool.logs.definitions import message_definition
from pdhef_logtool.logs.drive_log import Columns
from pdhef_logtool.logs.mcap_index import FOOTER, INDEX_RECORD, RECORD
from pdhef_logtool.logs.mcap_log import MESSAGE_HEAD
from pdhef_logtool.logs.resource_limits import MIB
from pdhef_logtool.logs.wire_layout import CdrEncoder
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.records.signals import IntArray
from pdhef_logtool.records.version import LIBRARY
from pdhef_logtool.storage.files import PendingFile, open_new, writing

#: Of message records, as far as they come together; in a chunk.
CHUNK_BYTES = MIB
#: Of zstd.
_LEVEL = 6
_LARGEST_ID = np.iinfo(np.uint16).max


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
        import zstandard

        self._path, self._compressor = path, zstandard.ZstdCompressor(level=level)
        self._schemas: dict[tuple[str, str, bytes], mcap_records.Schema] = {}
        self._channels: list[mcap_records.Channel] = []
        self._encoders: dict[str, tuple[int, CdrEncoder]] = {}
        self._sequences: Counter[int] = Counter()
        self._counts: Counter[int] = Counter()
        self._chunk_indexes: list[mcap_records.ChunkIndex] = []
        self._attachment_indexes: list[mcap_records.AttachmentIndex] = []
        self._metadata_indexes: list[mcap_records.MetadataIndex] = []
        self._crc = 0
        self._at = 0
        self._pending = PendingFile(path)
        with writing(path):
            self._file: IO[bytes] = open_new(self._pending.path)
        self._emit(MCAP_MAGIC)
        self._emit_record(mcap_records.Header(profile=profile, library=LIBRARY))

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
        """Add a ROS 2 CDR topic for :class:`~.drive_log.Columns`.

        Parameters
        ----------
        topic : topic name.
        type_name : ROS 2 type, ``pkg/msg/Type``.
        constants : constant fields of every message, by path (texts, numbers, arrays such as covariances).
        definition : ros2msg text; the type's own from ``schemas/`` or the common ROS 2 packages when absent.

        Raises
        ------
        MappingError : the definition does not parse.
        """
        definition = message_definition(type_name) if definition is None else definition
        encoder = CdrEncoder(topic, type_name, definition, constants or {})
        channel = self.add_channel(ChannelRecord(-1, topic, "cdr", type_name, "ros2msg", definition.encode()))
        self._encoders[topic] = (channel, encoder)

    def add_channel(self, record: ChannelRecord) -> int:
        """Add a channel and return its id; without name and encoding of the schema, a channel without schema.

        Raises
        ------
        OutputError : there are too many channels.
        """
        schema = 0
        if record.schema_name or record.schema_encoding:
            schema = self._add_schema(record.schema_name, record.schema_encoding, record.schema_data)
        channel = mcap_records.Channel(
            id=self._next_id(self._channels),
            topic=record.topic,
            message_encoding=record.encoding,
            metadata=dict(record.metadata),
            schema_id=schema,
        )
        self._channels.append(channel)
        self._emit_record(channel)
        return channel.id

    def _add_schema(self, name: str, encoding: str, data: bytes) -> int:
        key = (name, encoding, data)
        if key not in self._schemas:
            self._schemas[key] = mcap_records.Schema(
                id=self._next_id(self._schemas), data=data, encoding=encoding, name=name
            )
            self._emit_record(self._schemas[key])
        return self._schemas[key].id

    def _next_id(self, taken: Sized) -> int:
        if len(taken) >= _LARGEST_ID:
            raise OutputError(expected=f"at most {_LARGEST_ID} channels", got="more", where=self._path)
        return len(taken) + 1

    def write(self, batches: Sequence[Columns], raws: Iterable[Block] = ()) -> None:
        """Write batches and raw messages on channels of :meth:`add_channel`, which ascend in log time.

        Both are merged by log time, of equal times raw messages first. Raw messages are consumed as they come.
        """
        ours = self._records([self._encode(batch) for batch in batches if len(batch.log_time_ns)])
        group: list[Block] = []
        for raw in raws:
            group += [raw] if len(raw) else []
            if sum(int((part.length + MESSAGE_HEAD.itemsize).sum()) for part in group) >= CHUNK_BYTES:
                before, ours = ours.split(group[-1].log_time_ns[-1])
                self._emit_messages(self._records([*group, before]))
                group = []
        self._emit_messages(self._records([*group, ours]) if group else ours)

    @staticmethod
    def _records(parts: Sequence[Block]) -> Block:
        """Return messages in order of log time, one behind the other, each behind the head of its record."""
        block = Block.merged(parts, MESSAGE_HEAD.itemsize)
        head = np.empty(len(block), dtype=MESSAGE_HEAD)
        head["op"], head["size"] = Opcode.MESSAGE, block.length + MESSAGE_HEAD.itemsize - RECORD.size
        head["channel"], head["sequence"] = block.channel, block.sequence
        head["log"], head["publish"] = block.log_time_ns, block.publish_time_ns
        if len(block):
            items = items_at_bytes(block.buffer, MESSAGE_HEAD.itemsize)
            items[block.offset - MESSAGE_HEAD.itemsize] = head.view(items.dtype)
        return block

    def _emit_messages(self, block: Block) -> None:
        """Write :meth:`_records` in chunks."""
        first = 0
        start, end = block.offset - MESSAGE_HEAD.itemsize, block.offset + block.length
        while first < len(block):
            last = max(int(np.searchsorted(end, start[first] + CHUNK_BYTES, side="right")), first + 1)
            content, rows = block.buffer[start[first] : end[last - 1]], slice(first, last)
            self._emit_chunk(content, block.channel[rows], block.log_time_ns[rows], start[rows] - start[first])
            first = last

    def _encode(self, batch: Columns) -> Block:
        """Return the messages of a batch."""
        channel, encoder = self._encoders[batch.topic]
        n = len(batch.log_time_ns)
        rows = encoder.encode(n, batch.fields)
        number, size = np.arange(n), rows.shape[1]
        sequence = self._sequences[channel] + number
        self._sequences[channel] += n
        times = batch.log_time_ns.astype(np.int64), batch.publish_time_ns.astype(np.int64)
        return Block(rows.data.cast("B"), np.full(n, channel), *times, sequence, number * size, np.full(n, size))

    def _emit_chunk(self, records: bytes | memoryview, channel: IntArray, log_time: IntArray, offset: IntArray) -> None:
        """Write message records as a chunk; channel, log time and offset [N] of each record in it."""
        stored = self._compressor.compress(records)
        start_ns, end_ns = int(log_time.min()), int(log_time.max())
        about: dict[str, Any] = {
            "compression": "zstd",
            "message_start_time": start_ns,
            "message_end_time": end_ns,
            "uncompressed_size": len(records),
        }
        chunk_start, chunk_length = self._emit_record(
            mcap_records.Chunk(data=stored, uncompressed_crc=crc32(records), **about)
        )
        index_at = self._at
        offsets: dict[int, int] = {}
        index = bytearray()
        pairs = np.stack((log_time, offset), axis=1).astype("<u8")
        for id_, rows in rows_by_channel(channel).items():
            offsets[id_] = index_at + len(index)
            data = pairs[rows].tobytes()
            length = INDEX_RECORD.size - RECORD.size + len(data)
            index += INDEX_RECORD.pack(Opcode.MESSAGE_INDEX, length, id_, len(data)) + data
            self._counts[id_] += len(rows)
        self._emit(bytes(index))
        self._chunk_indexes.append(
            mcap_records.ChunkIndex(
                chunk_start_offset=chunk_start,
                chunk_length=chunk_length,
                message_index_offsets=offsets,
                message_index_length=self._at - index_at,
                compressed_size=len(stored),
                **about,
            )
        )

    def attachment(self, record: mcap_records.Attachment) -> None:
        """Add a file."""
        start, length = self._emit_record(record)
        about = {name: getattr(record, name) for name in ("create_time", "log_time", "name", "media_type")}
        index = mcap_records.AttachmentIndex(offset=start, length=length, data_size=len(record.data), **about)
        self._attachment_indexes.append(index)

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a record of key-value pairs."""
        start, length = self._emit_record(mcap_records.Metadata(name=name, metadata=dict(values)))
        self._metadata_indexes.append(mcap_records.MetadataIndex(offset=start, length=length, name=name))

    def close(self) -> None:
        """Write the summary and give the file its name."""
        if self._file.closed:
            return
        self._emit_record(mcap_records.DataEnd(data_section_crc=self._crc))
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
        statistics = mcap_records.Statistics(
            attachment_count=len(self._attachment_indexes),
            channel_count=len(self._channels),
            channel_message_counts=dict(sorted(self._counts.items())),
            chunk_count=len(self._chunk_indexes),
            message_count=self._counts.total(),
            message_end_time=max((chunk.message_end_time for chunk in self._chunk_indexes), default=0),
            message_start_time=min((chunk.message_start_time for chunk in self._chunk_indexes), default=0),
            metadata_count=len(self._metadata_indexes),
            schema_count=len(self._schemas),
        )
        indexes = *self._chunk_indexes, *self._attachment_indexes, *self._metadata_indexes
        summary = _bytes_of(*self._schemas.values(), *self._channels, statistics, *indexes)
        head = struct.pack("<BQQQ", Opcode.FOOTER, FOOTER.size - RECORD.size, start, 0)
        self._emit(summary)
        self._emit_record(
            mcap_records.Footer(summary_start=start, summary_offset_start=0, summary_crc=crc32(head, crc32(summary)))
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

    def _emit_record(self, record: mcap_records.McapRecord) -> tuple[int, int]:
        data, start = _bytes_of(record), self._at
        self._emit(data)
        return start, len(data)


def _bytes_of(*records: mcap_records.McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data
