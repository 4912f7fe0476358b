"""Writing of reduced logs: some topics of a log as they are, each in separate chunks, and the record of the source."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np
from mcap.opcode import Opcode

from pdhef_logtool.logs.columnar_log import ColumnarLog
from pdhef_logtool.logs.container import Block, ChannelRecord
from pdhef_logtool.logs.mcap_log import MESSAGE_HEAD
from pdhef_logtool.logs.message_schema import MessageSchema, parsing
from pdhef_logtool.logs.reduced_log import RECORD_ENTRY, RECORD_NAME, ReducedRecord
from pdhef_logtool.logs.writer import CHUNK_BYTES, McapLogWriter, scatter
from pdhef_logtool.records.errors import LogError
from pdhef_logtool.records.signals import IntArray

#: Bytes of a message record's payload before the message itself.
_BEFORE_DATA = 22


def write_record(writer: McapLogWriter, record: ReducedRecord) -> None:
    """Write the record that marks a file as a reduced log."""
    from pydantic import TypeAdapter

    writer.metadata(RECORD_NAME, {RECORD_ENTRY: TypeAdapter(ReducedRecord).dump_json(record).decode()})


def copy_topics(writer: McapLogWriter, log: ColumnarLog, topics: Collection[str]) -> None:
    """Write the messages of some topics as they are, a chunk holding one topic's, each topic's in the log's order.

    Messages whose times were recorded before are left out, as they could not be recognised in the copy.

    Raises
    ------
    LogError : the log is of a time before 1970, which an MCAP cannot represent.
    """
    if log.start_ns < 0:
        raise LogError(expected="log times from 1970 on", got=f"{log.start_ns} ns", where=str(log.path))
    pending: dict[str, _Pending] = {}
    for c, container in enumerate(log.containers):
        ids: dict[int, int] = {}
        by_topic: dict[str, list[int]] = {}
        for channel in container.channels.values():
            if channel.topic in topics:
                ids[channel.id] = _add_channel(writer, log, c, channel)
                by_topic.setdefault(channel.topic, []).append(channel.id)
        for span in container.spans:
            want = frozenset(span.counts).intersection(ids)
            block = log.load(c, span, want) if want else None
            if block is None:
                continue
            for topic, of_topic in by_topic.items():
                chunk = pending.setdefault(topic, _Pending())
                for id_ in of_topic:
                    rows = block.rows.get(id_, np.empty(0, np.int64))
                    times = block.log_time_ns[rows]
                    left_out = log.recording_span.recorded_before(topic, c, span, times)
                    chunk.add(block, rows[~left_out & (times >= 0)], ids[id_])
                # The order of two channels at equal times depends on what is read together.
                if chunk.size >= CHUNK_BYTES or len(of_topic) > 1:
                    chunk.write(writer)
    for chunk in pending.values():
        chunk.write(writer)


@dataclass(slots=True)
class _Pending:
    """Message records of one topic that wait for their chunk."""

    size: int = 0
    _parts: list[tuple[bytes, IntArray, IntArray, IntArray]] = field(default_factory=list)

    def add(self, block: Block, rows: IntArray, channel_id: int) -> None:
        """Add messages [K] of a block, to be written under a channel's id."""
        if not rows.size:
            return
        content, offset = _records(block, rows, channel_id)
        channel = np.full(rows.shape[0], channel_id, dtype=np.int64)
        self._parts.append((content, channel, block.log_time_ns[rows], offset + self.size))
        self.size += len(content)

    def write(self, writer: McapLogWriter) -> None:
        """Write what waits as one chunk."""
        if not self._parts:
            return
        content, channel, log_time, offset = zip(*self._parts, strict=True)
        writer.write_chunk(b"".join(content), np.concatenate(channel), np.concatenate(log_time), np.concatenate(offset))
        self.size = 0
        self._parts.clear()


def _records(block: Block, rows: IntArray, channel_id: int) -> tuple[bytes, IntArray]:
    """Return message records of a block's rows [K] in a row, and where each begins [K]."""
    head_size = MESSAGE_HEAD.itemsize
    length = block.length[rows]
    size = length + head_size
    start = np.cumsum(size) - size
    head = np.zeros(rows.shape[0], dtype=MESSAGE_HEAD)
    head["op"], head["size"], head["channel"] = int(Opcode.MESSAGE), length + _BEFORE_DATA, channel_id
    head["sequence"] = block.sequence[rows].astype(np.uint32)
    head["log"] = block.log_time_ns[rows].astype(np.uint64)
    head["publish"] = block.publish_time_ns[rows].astype(np.uint64)
    source = np.frombuffer(block.buffer, dtype=np.uint8)
    content = np.empty(int(size.sum()), dtype=np.uint8)
    for n in np.unique(length).tolist():
        mine = np.flatnonzero(length == n)
        records = np.empty((mine.shape[0], head_size + n), dtype=np.uint8)
        records[:, :head_size] = head[mine].view(np.uint8).reshape(-1, head_size)
        if n:
            places = np.ndarray((source.shape[0] - n + 1,), dtype=(np.void, n), buffer=source.data, strides=(1,))
            records[:, head_size:] = places[block.offset[rows[mine]]].view(np.uint8).reshape(-1, n)
        scatter(content, start[mine], np.arange(mine.shape[0]), records)
    return content.tobytes(), start


def _add_channel(writer: McapLogWriter, log: ColumnarLog, c: int, channel: ChannelRecord) -> int:
    """Add a channel as it is, with the definition that its messages are read by where its own is not enough."""
    schema = log.schema_of(c, channel)
    needs = bool(log.definitions.files) or not channel.schema_data.strip()
    if isinstance(schema, MessageSchema) and schema.store is not None and (needs or schema.borrowed):
        ros = 1 if schema.wire == "ros1" else 2
        with parsing(f"the definition of {channel.type_name}"):
            text = schema.store.generate_msgdef(schema.type_name, ros_version=ros)[0]
        channel = replace(channel, schema_encoding=f"ros{ros}msg", schema_data=text.encode())
    return writer.add_channel(channel)
