"""Lossless copies of a log's messages into an MCAP, in order of log time; a few spans are in memory at a time.

Messages of an MCAP keep schema, topic, encoding, channel metadata, both times, sequence and payload; attachments and
metadata records are copied too. Bags and rosbag2 databases keep their bytes and definitions.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

import numpy as np

from pdhef_logtool.logs.columnar_log import ColumnarLog, in_window
from pdhef_logtool.logs.container import Block, ChannelRecord
from pdhef_logtool.logs.definitions import message_definition
from pdhef_logtool.logs.writer import McapLogWriter

#: Number of a channel in the log: file of the log, and channel id in that file.
_Key = tuple[int, int]


def source_profile(log: ColumnarLog) -> str:
    """Return the MCAP profile that a full copy should carry: the source's own."""
    return log.containers[0].profile if log.containers else "ros2"


#: Entries of channel metadata that state how messages are sent.
_TRANSPORT = frozenset({"offered_qos_profiles", "topic_type_hash", "md5sum", "latching"})


def register_channels(
    writer: McapLogWriter,
    log: ColumnarLog,
    *,
    leave_out: Callable[[str], bool] = lambda _topic: False,
    whole_metadata: bool = True,
) -> dict[_Key, int]:
    """Add all channels of a log to a writer, except channels of topics that are left out; return their new ids.

    Without ``whole_metadata`` channels keep only the metadata that state how messages are sent. Equal channels of split
    files become one channel.
    """
    ids: dict[_Key, int] = {}
    ids_by_content: dict[str, int] = {}
    for c, container in enumerate(log.containers):
        same_file: set[int] = set()
        for channel in container.channels.values():
            if leave_out(channel.topic):
                continue
            target = channel
            if not whole_metadata:
                target = replace(channel, metadata={k: v for k, v in channel.metadata.items() if k in _TRANSPORT})
            if channel.encoding == "cdr" and not channel.schema_data:
                target = _with_definition(target)
            identity = str(replace(target, id=0, metadata=dict(sorted(target.metadata.items()))))
            id_ = ids_by_content.get(identity)
            if id_ is None or id_ in same_file:  # two publishers of one file stay two channels
                id_ = ids_by_content[identity] = writer.add_channel(target)
            same_file.add(id_)
            ids[c, channel.id] = id_
    return ids


def iterate_copy(
    log: ColumnarLog, ids: Mapping[_Key, int], start_ns: int | None = None, end_ns: int | None = None
) -> Iterator[Block]:
    """Yield the messages of a log with log time in [start, end) in log-time order, with the ``ids`` of the copy.

    Messages of equal log time are in the order of their spans. Spans that overlap in time are merged; only these are in
    memory.
    Damaged spans are left out and reported by ``log.lost``.
    """
    spans = [
        (c, span)
        for c, container in enumerate(log.containers)
        for span in container.spans
        if span.overlaps(start_ns, end_ns) and (not span.counts or any((c, id_) in ids for id_ in span.counts))
    ]
    spans.sort(key=lambda item: item[1].start_ns)
    for c, container in enumerate(log.containers):
        container.prefetch(span for of, span in spans if of == c)
    pending = Block.merged([])
    for c, span in spans:
        ready, pending = pending.split(span.start_ns)
        yield ready
        block = log.load(c, span)
        if block is not None:
            copied = _copied(block, c, ids, start_ns, end_ns)
            pending = Block.merged([pending, copied]) if len(pending) else copied
    yield pending


def _copied(block: Block, c: int, ids: Mapping[_Key, int], start_ns: int | None, end_ns: int | None) -> Block:
    """Return the messages to be copied of a span of file ``c``, in order of log time, with the copy's channel ids.

    Messages before 1970 are left out: an MCAP file cannot contain their times.
    """
    channel = np.full(len(block), -1)
    for id_, rows in block.rows.items():
        channel[rows] = ids.get((c, id_), -1)
    keep = np.flatnonzero((channel >= 0) & in_window(block.log_time_ns, max(start_ns or 0, 0), end_ns))
    return replace(block, channel=channel).take(keep[np.argsort(block.log_time_ns[keep], kind="stable")])


def _with_definition(channel: ChannelRecord) -> ChannelRecord:
    """Return a channel of an old database with the definition of its type in the common packages, if any."""
    try:
        text = message_definition(channel.type_name)
    except KeyError:
        return channel
    return replace(channel, schema_encoding="ros2msg", schema_data=text.encode())
