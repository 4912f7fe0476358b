"""Lossless copies of a log's messages into an MCAP, in order of log time; a few spans are in memory at a time.

Chunks of an MCAP are copied unchanged if all their channels are kept: checked, but not compressed again.

Messages of an MCAP keep schema, topic, encoding, channel metadata, both times, sequence and payload; attachments and
metadata records are copied too. Bags and rosbag2 databases keep their bytes and definitions.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace

from pdhef_logtool.logs.columnar_log import ColumnarLog, in_window
from pdhef_logtool.logs.container import Block, ChannelRecord, RawChunk, Span
from pdhef_logtool.logs.definitions import message_definition
from pdhef_logtool.logs.writer import McapLogWriter, RawMessage

#: Times of MCAP are unsigned; times in this package are signed.
_UNSIGNED = (1 << 64) - 1

#: Number of a channel in the log: file of the log, and channel id in that file.
_Key = tuple[int, int]
#: A message behind log time, file, span and row.
_Sortable = tuple[int, int, int, int, RawMessage]


@dataclass(frozen=True, slots=True)
class SourceChannels:
    """Channels of a log and of its copy.

    Attributes
    ----------
    ids : channel of the copy by file and channel of the source.
    verbatim : channels of MCAP files that keep their id, their schema's id and their definition.
    """

    ids: Mapping[_Key, int]
    verbatim: frozenset[_Key] = frozenset()


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
) -> SourceChannels:
    """Add all channels of a log to a writer, except channels of topics that are left out.

    Without ``whole_metadata`` channels keep only the metadata that state how messages are sent.

    Equal channels of split files become one channel. Channels keep their ids; if the ids of split files contradict each
    other, the ids of the first file are kept.
    """
    ids: dict[_Key, int] = {}
    ids_by_content: dict[str, int] = {}
    verbatim: set[_Key] = set()
    for c, container in enumerate(log.containers):
        same_file: set[int] = set()
        for channel in container.channels.values():
            if leave_out(channel.topic):
                continue
            target = channel
            if not whole_metadata and not _TRANSPORT.issuperset(channel.metadata):
                target = replace(channel, metadata={k: v for k, v in channel.metadata.items() if k in _TRANSPORT})
            if channel.encoding == "cdr" and not channel.schema_data:
                target = _with_definition(target)
            identity = str(replace(target, id=0, schema_id=0, metadata=dict(sorted(target.metadata.items()))))
            id_ = ids_by_content.get(identity)
            if id_ is None or id_ in same_file:  # two publishers of one file stay two channels
                id_ = writer.add_channel(target)
                ids_by_content[identity] = id_
            same_file.add(id_)
            ids[(c, channel.id)] = id_
            if target is channel and container.whole_chunks and writer.has_ids_of(id_, channel):
                verbatim.add((c, channel.id))
    return SourceChannels(ids, frozenset(verbatim))


def iterate_copy(
    log: ColumnarLog,
    channels: SourceChannels,
    start_ns: int | None = None,
    end_ns: int | None = None,
) -> Iterator[RawMessage | RawChunk]:
    """Yield the messages of a log with log time in [start, end) in log-time order, with the copy's channel ids.

    Messages of equal log time are in file order. Spans that overlap in time are merged; only these are in memory.
    Damaged spans are left out and reported by ``log.lost``.

    Chunks that can be copied as they are, are yielded whole: sound chunks of MCAP files that are inside the window and
    contain and declare only channels with unchanged ids. They are in order of their first log times, and in file order
    where they overlap.
    """
    unchanged = [frozenset(id_ for of, id_ in channels.verbatim if of == c) for c in range(len(log.containers))]
    spans = _in_file_order_where_overlapping(_spans_to_copy(log, channels, start_ns, end_ns), unchanged)
    for c, container in enumerate(log.containers):
        container.prefetch(span for of, span in spans if of == c)
    pending: list[_Sortable] = []
    for c, span in spans:
        ready = bisect_left(pending, (span.start_ns,))
        yield from (message for *_, message in pending[:ready])
        del pending[:ready]
        block = log.load(c, span)
        if block is None:
            continue
        inside = in_window(block.log_time_ns, start_ns, end_ns) is None
        chunk = log.containers[c].raw_chunk(span, block, unchanged[c]) if inside else None
        if chunk is None:
            pending += _messages(block, (c, span.index), channels, start_ns, end_ns)
            pending.sort()
        else:
            yield chunk
    yield from (message for *_, message in pending)


def _messages(
    block: Block, place: tuple[int, int], channels: SourceChannels, start_ns: int | None, end_ns: int | None
) -> Iterator[_Sortable]:
    """Yield the messages of a span; ``place``: its file and number.

    Messages of other channels are left out, and messages before 1970: an MCAP file cannot contain their times.
    """
    c = place[0]
    keep = in_window(block.log_time_ns, start_ns, end_ns)
    columns = [getattr(block, f.name) for f in fields(block) if f.name not in ("buffer", "dropped")]
    rows = zip(*((column if keep is None else column[keep]).tolist() for column in columns), strict=True)
    for row, (channel, log_time, publish_time, sequence, offset, length) in enumerate(rows):
        id_ = channels.ids.get((c, channel)) if log_time >= 0 else None
        if id_ is None:
            continue
        data = bytes(block.buffer[offset : offset + length])
        yield log_time, *place, row, RawMessage(id_, log_time, publish_time & _UNSIGNED, sequence, data)


def _spans_to_copy(
    log: ColumnarLog, channels: SourceChannels, start_ns: int | None, end_ns: int | None
) -> list[tuple[int, Span]]:
    """Return file and span of the spans that contain messages to be copied, by start, file and place."""
    spans = [
        (c, span)
        for c, container in enumerate(log.containers)
        for span in container.spans
        if span.overlaps(start_ns, end_ns) and (not span.counts or any((c, id_) in channels.ids for id_ in span.counts))
    ]
    return sorted(spans, key=lambda item: (item[1].start_ns, item[0], item[1].index))


def _in_file_order_where_overlapping(
    spans: Sequence[tuple[int, Span]], unchanged: Sequence[frozenset[int]]
) -> list[tuple[int, Span]]:
    """Sort groups of overlapping spans that will all be copied as they are back to the order of the file.

    Readers return messages of equal log times in file order, which then equals the order in the source.
    """
    groups: list[list[tuple[int, Span]]] = []
    end_ns = 0
    for c, span in spans:
        if not groups or span.start_ns >= end_ns:
            groups.append([])
            end_ns = span.end_ns
        end_ns = max(end_ns, span.end_ns)
        groups[-1].append((c, span))
    for group in groups:
        if all(unchanged[c].issuperset(span.counts) for c, span in group):
            group.sort(key=lambda item: (item[0], item[1].index))
    return [item for group in groups for item in group]


def _with_definition(channel: ChannelRecord) -> ChannelRecord:
    """Return a channel of an old database with the definition of its type in the common packages, if any."""
    try:
        text = message_definition(channel.type_name)
    except KeyError:
        return channel
    return replace(channel, schema_encoding="ros2msg", schema_data=text.encode())
