"""A drive log over one or several containers: columns of the fields asked for, in windows of log time."""

import re
import time
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from types import MappingProxyType

import numpy as np
from mcap.records import Attachment, Metadata

from pdhef_logtool.logs import message_schema
from pdhef_logtool.logs.compression import decompress_messages
from pdhef_logtool.logs.container import UNVERIFIED, Block, ChannelRecord, Container, Span, count_text, describe_damage
from pdhef_logtool.logs.decoding import ChannelDecoder, channel_schema, concatenate_columns, missing_column
from pdhef_logtool.logs.definitions import SHIPPED
from pdhef_logtool.logs.drive_log import Columns, DriveLog, Requests, TopicInfo
from pdhef_logtool.logs.recording_span import RecordingSpan, survey
from pdhef_logtool.logs.remote_place import LogPlace
from pdhef_logtool.logs.resource_limits import KIB, MIB, LimitError
from pdhef_logtool.records.errors import MappingError
from pdhef_logtool.records.signals import BoolArray, IntArray, Loss
from pdhef_logtool.storage.files import scratch_folder, write_bytes

#: Loaded spans are kept up to this size, without payloads above ``_LARGE_BYTES`` (images, point clouds): the samples
#: that recognition reads, and all of a short log, are decompressed once.
_KEPT_BYTES, _LARGE_BYTES = 16 * MIB, 16 * KIB
#: A message in the text of a DBC file.
_DBC = re.compile(r"^BO_ \d+ \w+ *:", re.MULTILINE)


class ColumnarLog(DriveLog):
    """Messages of containers as columns; see :class:`~pdhef_logtool.logs.drive_log.DriveLog`.

    Parameters
    ----------
    path : file, folder or object as the user named it.
    kind : ``mcap``, ``rosbag1``, ``rosbag2-sqlite3`` or ``rosbag2-mcap``.
    containers : the log's files in order of recording.
    lost : damage found while the log was opened, beside the containers' own.
    distro : ROS distribution for types without definitions.
    custom : metadata of the log beside the containers' records.
    """

    def __init__(
        self,
        path: LogPlace,
        kind: str,
        containers: Sequence[Container],
        lost: Sequence[Loss] = (),
        distro: str = "",
        custom: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        self.path = path
        self.kind = kind
        self.containers = tuple(containers)
        self.size = sum(container.size for container in self.containers)
        self._opened_lost = tuple(lost)
        self._custom = custom
        self.distro = distro
        self.definitions = SHIPPED  # of types that the log does not define; set before anything is read
        self._channels: dict[tuple[int, int], _Channel] = {}
        self._by_topic: dict[str, list[_Channel]] = {}
        for c, container in enumerate(self.containers):
            for record in container.channels.values():
                channel = self._channels[c, record.id] = _Channel(c, record)
                self._by_topic.setdefault(record.topic, []).append(channel)
        self._seen: set[tuple[int, int, frozenset[int] | None]] = set()  # what was loaded before
        self._schemas_s = 0.0  # processor time that parsing took
        self._plans: dict[tuple[str, tuple[str, ...]], _Plan] = {}
        self._kept: dict[tuple[int, int, frozenset[int] | None], Block] = {}
        self._kept_bytes = 0
        self._closing = ExitStack()

    @property
    def topics(self) -> tuple[TopicInfo, ...]:
        """All topics by name; ``messages`` does not count spans found damaged so far."""
        counts: Counter[str] = Counter()
        for container in self.containers:
            for span in container.spans:
                if span.index not in container.damaged:
                    for id_, n in span.counts.items():
                        counts[container.channels[id_].topic] += n
        firsts = ((name, channels[0].record) for name, channels in sorted(self._by_topic.items()))
        return tuple(TopicInfo(name, first.type_name, first.encoding, counts[name]) for name, first in firsts)

    @cached_property
    def recording_span(self) -> RecordingSpan:  # type: ignore[override]
        """When the log was recorded; determined at the first access."""
        return survey(self.containers, str(self.path))

    @property
    def lost(self) -> tuple[Loss, ...]:
        """Losses so far."""
        of_containers = (loss for container in self.containers for loss in container.lost)
        of_channels = (loss for channel in self._channels.values() for loss in channel.losses())
        return (*self._opened_lost, *self.recording_span.losses, *of_containers, *of_channels)

    @property
    def messages(self) -> "ColumnarLog | None":
        """The log itself."""
        return self

    @property
    def is_indexed(self) -> bool:
        """Whether the index of the log is complete and consistent."""
        sound = all(container.by_index for container in self.containers)
        return sound and all(loss.kind == UNVERIFIED for loss in self.lost)

    @property
    def databases(self) -> tuple[Path, ...]:
        """The DBC files given with the log, otherwise those among its attachments and metadata."""
        return self.given_databases or self._stored_databases

    @cached_property
    def _stored_databases(self) -> tuple[Path, ...]:
        stored = [(a.name, a.data) for a in self.attachments() if a.name.endswith(".dbc")]
        entries = ((r.name, key, text) for r in self.metadata_records() for key, text in r.metadata.items())
        for name, key, text in entries:
            if _DBC.search(text):
                stored.append((key if key.endswith(".dbc") else f"{name}.{key}.dbc", text.encode()))
        folder = Path(self._closing.enter_context(scratch_folder())) if stored else Path()
        paths = [folder / Path(name).name for name, _ in stored]
        for path, (_, data) in zip(paths, stored, strict=True):
            write_bytes(path, data)
        return tuple(paths)

    def definition(self, path: Path) -> Path:
        """Return the file of a definition in the log; a name without a folder is an attached file."""
        attached = {} if path.exists() and len(path.parts) > 1 else {p.name: p for p in self.databases}
        return attached.get(path.name, path)

    def metadata(self) -> dict[str, str]:
        """Return the entries of metadata records by ``key`` and ``record.key``, and rosbag2's ``custom_data``."""
        entries: dict[str, str] = {}
        for record in self.metadata_records():
            entries |= record.metadata
            entries |= {f"{record.name}.{key}": value for key, value in record.metadata.items()}
        return entries | dict(self._custom)

    def attachments(self) -> Iterator[Attachment]:
        """Yield the files that the log contains."""
        return (attachment for container in self.containers for attachment in container.records(Attachment))

    def metadata_records(self) -> Iterator[Metadata]:
        """Yield the metadata records."""
        return (record for container in self.containers for record in container.records(Metadata))

    @property
    def is_remote(self) -> bool:
        """Whether each read is a network request."""
        return any(container.is_remote for container in self.containers)

    @property
    def chunks_read(self) -> tuple[int, int]:
        """Number of spans that were read, and of all spans."""
        return len({(c, index) for c, index, _ in self._seen}), sum(len(c.spans) for c in self.containers)

    def index_times(self, start_ns: int, end_ns: int) -> dict[str, IntArray]:
        """Return each topic's log times in [start, end), ascending, as the indexes have them."""
        parts: dict[str, list[IntArray]] = {topic: [] for topic in self._by_topic}
        for container in self.containers:
            for span in container.spans:
                its = (span.times or {}) if span.overlaps(start_ns, end_ns) else {}
                for id_ in span.counts.keys() & its.keys():
                    parts[container.channels[id_].topic].append(its[id_])
        ordered = {topic: np.sort(np.concatenate(part), kind="stable") for topic, part in parts.items() if part}
        return {topic: times[slice(*np.searchsorted(times, (start_ns, end_ns)))] for topic, times in ordered.items()}

    def covered_topics(self, topics: Collection[str]) -> frozenset[str]:
        """Return the topics with all messages in spans with one of these topics: they need no further read."""
        held, apart = set(topics), set[str]()
        for container in self.containers:
            names = {id_: channel.topic for id_, channel in container.channels.items()}
            for span in container.spans:
                inside = {names[id_] for id_ in span.counts}
                (apart if inside.isdisjoint(topics) else held).update(inside)
        return frozenset(held - apart)

    def prefetch(self, topics: Collection[str], spans_ns: Sequence[tuple[int, int]]) -> None:
        """Prepare to read these topics in [start, end) of each span."""
        for container in self.containers:
            expected = (s for start, end in spans_ns for s in self._to_read(topics, container, start, end))
            container.prefetch({span.index: span for span in expected}.values())

    def fields(self, topic: str, *, quiet: bool = False) -> tuple[message_schema.FieldInfo, ...]:
        """Return the scalar leaves of a topic's schema; empty for an encoding without schema.

        With ``quiet`` a schema that does not parse is not reported as a loss.
        """
        for channel in self._by_topic.get(topic, ()):
            channel.asked |= not quiet
            schema = self._schema(channel)
            if isinstance(schema, message_schema.MessageSchema):
                return schema.fields
        return ()

    def unreadable(self, topic: str) -> str:
        """Return why a topic has no readable fields, for example a missing definition; empty if it has some."""
        schemas = [self._schema(channel) for channel in self._by_topic.get(topic, ())]
        if not schemas or any(isinstance(schema, message_schema.MessageSchema) for schema in schemas):
            return ""
        return str(schemas[0])

    def first_messages(self, topic: str, most: int) -> list[object]:
        """Return the first messages of a topic, decoded; messages that do not decode are left out."""
        messages: list[object] = []
        for channel in self._by_topic.get(topic, ()):
            schema = self._schema(channel)
            if not isinstance(schema, message_schema.MessageSchema):
                continue
            decode = ChannelDecoder(schema, ()).single_decoder()
            with self.containers[channel.c].meter.running():
                payloads = self._payloads(channel)
                messages += [decode(payload) for payload in islice(payloads, most - len(messages))]
        return [message for message in messages if message is not None]

    def _payloads(self, channel: "_Channel") -> Iterator[bytes]:
        """Yield the messages of a channel, undecoded."""
        id_ = channel.record.id
        for span in self.containers[channel.c].spans:
            block = self.load(channel.c, span, frozenset({id_})) if id_ in span.counts else None
            if block is not None:
                yield from map(block.message, block.rows.get(id_, ()))

    def read(
        self, requests: Requests, start_ns: int | None = None, end_ns: int | None = None, *, quiet: bool = False
    ) -> dict[str, Columns]:
        """Read columns; see :class:`~.drive_log.DriveLog`."""
        plans = {topic: self._plan(topic, tuple(dict.fromkeys(paths))) for topic, paths in requests.items()}
        if not quiet:
            for channel in (channel for topic, paths in requests.items() if paths for channel in self._by_topic[topic]):
                channel.asked = True
        parts: dict[str, list[Columns]] = {topic: [] for topic in plans}
        for c, container in enumerate(self.containers):
            spans = tuple(self._to_read(plans, container, start_ns, end_ns))
            container.prefetch(spans)
            with container.meter.running():
                for columns in (its for span in spans for its in self._read_span(plans, c, span, start_ns, end_ns)):
                    parts[columns.topic].append(columns)
        return {topic: _join(topic, plans[topic], parts[topic]) for topic in plans}

    def forget(self) -> None:
        """Release the blocks of the log's beginning."""
        self._kept.clear()

    def close(self) -> None:
        """Release the files."""
        self.forget()
        for container in self.containers:
            container.close()
        self._closing.close()

    def load(
        self, c: int, span: Span, want: frozenset[int] | None = None, payloads: frozenset[int] | None = None
    ) -> Block | None:
        """Read a span of the c-th container; None and a recorded loss if it is damaged, or if no time is left for it.

        Any error of a container's load is a loss of the span.

        Parameters
        ----------
        want : channels of the needed messages. payloads : channels of the needed payloads. None: all.
        """
        payloads = want if payloads is None else payloads
        container = self.containers[c]
        want = want if container.selective else None
        key = (c, span.index)
        if span.index in container.damaged | container.late:
            return None
        kept = self._kept.get((*key, want))
        if kept is not None and (not kept.dropped if payloads is None else kept.dropped.isdisjoint(payloads)):
            return kept
        extent, unread = container.extent(span), container.late
        try:
            container.meter.check()
            unread = container.damaged
            with container.meter.running(extent[1] - extent[0]):
                block = container.load(span, want)
                if container.zstd_messages:
                    block = decompress_messages(block, container.meter.limits)
        except Exception as error:  # noqa: BLE001
            kind, text = describe_damage(error)
            count = sum(span.counts.values()) or None
            what = f"{count_text(count)} lost at byte {extent[0]}: {text}"
            container.lose(kind, what, span.start_ns, span.end_ns, count)
            unread.add(span.index)
            return None
        if (*key, want) not in self._seen:
            self._seen.add((*key, want))
            _correct_span(container, span, block, want)
        if kept is None and self._kept_bytes < _KEPT_BYTES:
            self._kept[(*key, want)] = small = block.without_large(_LARGE_BYTES)
            self._kept_bytes += small.nbytes
        return block

    def _schema(self, channel: "_Channel") -> message_schema.MessageSchema | message_schema.SchemaError:
        """Return the schema of a channel, or the reason why it is unknown. It is parsed once, within the log's time.

        All schemas together get the part of the time limit that does not depend on the size of the log.
        """
        if channel.schema is not None:
            return channel.schema
        record, meter = channel.record, self.containers[channel.c].meter
        started = time.process_time()
        try:
            meter.check()
            meter.limits.check("seconds", self._schemas_s, "the time for all schemas")
            with meter.running():
                channel.schema = channel_schema(
                    record, self.distro, self._payloads(channel), meter.limits, self.definitions
                )
        except message_schema.SchemaError as error:
            channel.schema = error
        except LimitError as error:  # of time
            channel.schema = message_schema.SchemaError(describe_damage(error)[1])
        finally:
            self._schemas_s += time.process_time() - started
        return channel.schema

    def _plan(self, topic: str, paths: tuple[str, ...]) -> "_Plan":
        if (topic, paths) in self._plans:
            return self._plans[topic, paths]
        decoders: dict[_Channel, ChannelDecoder] = {}
        problems: list[MappingError] = []
        if topic not in self._by_topic:
            raise message_schema.nearest(topic, sorted(self._by_topic), "a topic of the log", self.path)
        for channel in self._by_topic[topic] if paths else ():
            schema = self._schema(channel)
            try:
                if isinstance(schema, message_schema.SchemaError):
                    expected = "messages as ROS 2 CDR, ROS 1, JSON or protobuf with a schema that parses"
                    remedy = "give its definition with --set msgs=DIR, or map another topic"
                    raise MappingError(expected=expected, got=str(schema), where=topic, remedy=remedy)
                selections = tuple(message_schema.resolve(schema, topic, path) for path in paths)
                decoders[channel] = ChannelDecoder(schema, selections)
            except MappingError as error:
                problems.append(error)
        if paths and not decoders:
            raise problems[0]
        # A second publisher of another type under the same topic lacks the fields: NaN there.
        selections = next(iter(decoders.values())).selections if decoders else ()
        self._plans[topic, paths] = _Plan(selections, decoders)
        return self._plans[topic, paths]

    @staticmethod
    def _to_read(
        topics: Collection[str], container: Container, start_ns: int | None, end_ns: int | None
    ) -> Iterator[Span]:
        """Yield the spans of a window that contain any of the requested topics."""
        ids = {id_ for id_, channel in container.channels.items() if channel.topic in topics}
        for span in container.spans:
            if not ids.isdisjoint(span.counts) and span.overlaps(start_ns, end_ns):
                yield span

    def _read_span(
        self, plans: "Mapping[str, _Plan]", c: int, span: Span, start_ns: int | None, end_ns: int | None
    ) -> Iterator[Columns]:
        """Yield the columns of the requested topics in a span, by channel."""
        channels = self.containers[c].channels
        wanted = frozenset(id_ for id_ in span.counts if channels[id_].topic in plans)
        payloads = frozenset(id_ for id_ in wanted if plans[channels[id_].topic].selections)
        block = self.load(c, span, wanted, payloads)
        if block is None:
            return
        keep = in_window(block.log_time_ns, start_ns, end_ns)
        is_inside = bool(keep.all())
        # By the channels of the block: the counts of the span can be from a wrong index.
        for id_, rows in block.rows.items():
            channel = self._channels.get((c, id_))  # reading may show further channels
            if channel is None or channel.record.topic not in plans:
                continue
            if self.recording_span.left_out:
                rows = rows[self.recording_span.used((c, span.index, id_), block.log_time_ns[rows])]
            rows = rows if is_inside else rows[keep[rows]]
            columns = self._decode(plans[channel.record.topic], channel, span, block, rows) if rows.size else None
            if columns is not None:
                yield columns

    def _decode(self, plan: "_Plan", channel: "_Channel", span: Span, block: Block, rows: IntArray) -> Columns | None:
        """Decode some messages of a channel. Any error of a decoder is a loss of these messages."""
        decoder, id_, topic = plan.decoders.get(channel), channel.record.id, channel.record.topic
        try:
            if decoder is None:
                fields = {s.path: missing_column(s, len(rows)) for s in plan.selections}
            else:
                fields = decoder.columns(block, rows)
        except Exception as error:  # noqa: BLE001
            kind, text = describe_damage(error)
            kind = "undecodable" if kind == "bad-chunk" else kind
            what = f"{len(rows)} messages cannot be decoded: {text}"
            channel.failed[span.index] = Loss(kind, what, topic, span.start_ns, span.end_ns, len(rows))
            return None
        if decoder is not None and decoder.undecodable:
            seen = channel.undecodable.get(span.index, np.empty(0, dtype=np.int64))
            # Count by position in the channel: the other channels of a block depend on the request.
            places = np.searchsorted(block.rows[id_], decoder.undecodable)
            channel.undecodable[span.index] = np.union1d(seen, places.astype(np.int64))
        return Columns(topic, block.log_time_ns[rows], block.publish_time_ns[rows], fields)


@dataclass(slots=True, eq=False)
class _Channel:
    """A channel of the c-th container, with what is known of its messages.

    ``asked``: whether it was requested or listed. ``undecodable``: messages that do not decode, by span, and
    ``failed``: losses of whole spans, as a repeated read must not count them again.
    """

    c: int
    record: ChannelRecord
    schema: message_schema.MessageSchema | message_schema.SchemaError | None = None
    asked: bool = False
    undecodable: dict[int, IntArray] = field(default_factory=dict)
    failed: dict[int, Loss] = field(default_factory=dict)

    def losses(self) -> Iterator[Loss]:
        """Yield the losses and notes of its messages; of its schema none before it is asked for."""
        yield from self.failed.values()
        topic, schema = self.record.topic, self.schema if self.asked else None
        if self.asked and (undecodable := sum(map(len, self.undecodable.values()))):
            what = f"{undecodable} messages do not fit the type of their topic"
            yield Loss("undecodable", what, topic, count=undecodable)
        if isinstance(schema, message_schema.SchemaError) and not isinstance(schema, message_schema.NoSchemaError):
            yield Loss("bad-schema", f"its messages cannot be decoded: {schema}", topic)
        if isinstance(schema, message_schema.MessageSchema) and schema.borrowed:
            files = ", ".join(map(str, schema.borrowed))
            what = f"read by {files} of this machine, as the log does not define its type: correct only if they match"
            yield Loss("borrowed-definition", f"{what} the recorded version", topic, severity="note")


@dataclass(frozen=True, slots=True)
class _Plan:
    """How a topic is read: the resolved paths and a decoder per channel."""

    selections: tuple[message_schema.Selection, ...]
    decoders: Mapping[_Channel, ChannelDecoder]


def _correct_span(container: Container, span: Span, block: Block, want: frozenset[int] | None) -> None:
    """Correct the counts of a span, which an index gave, by its content; missing messages are a loss."""
    held = block.counts
    declared = {id_: n for id_, n in held.items() if id_ in container.channels}
    claimed = {id_: n for id_, n in span.counts.items() if want is None or id_ in want}
    times = block.log_time_ns
    undeclared = sum(held.values()) - sum(declared.values()) - container.undeclared.get(span.index, 0)
    outside = 0
    if len(times) and (times.min() < span.start_ns or times.max() >= span.end_ns):
        outside = int(np.count_nonzero((times < span.start_ns) | (times >= span.end_ns)))
    if declared == claimed and not outside and undeclared <= 0:
        return
    others = {id_: n for id_, n in span.counts.items() if id_ not in claimed}
    actual = {id_: times[block.rows[id_]] for id_ in declared}
    container.spans[span.index] = replace(span, counts=others | declared, times={**(span.times or {}), **actual})
    missing = sum(max(n - declared.get(id_, 0), 0) for id_, n in claimed.items())
    start, _ = container.extent(span)
    for kind, count, text in (
        ("missing-messages", missing, "that the index names are not there"),
        ("unknown-channel", undeclared, "are on channels that no readable record declares"),
        ("bad-times", outside, "have log times outside of those that the index names"),
    ):
        if count > 0:
            what = f"{count} messages {text}, at byte {start}"
            container.lose(kind, what, span.start_ns, span.end_ns, count)


def in_window(log_time_ns: IntArray, start_ns: int | None, end_ns: int | None) -> BoolArray:
    """Return which of the log times are in [start, end)."""
    keep: BoolArray = log_time_ns >= (log_time_ns.min(initial=0) if start_ns is None else start_ns)
    return keep if end_ns is None else keep & (log_time_ns < end_ns)


def _join(topic: str, plan: _Plan, parts: Sequence[Columns]) -> Columns:
    none = np.empty(0, dtype=np.int64)
    log_time = np.concatenate([none, *(p.log_time_ns for p in parts)])
    publish_time = np.concatenate([none, *(p.publish_time_ns for p in parts)])
    fields = {
        s.path: concatenate_columns([*(p.fields[s.path] for p in parts), missing_column(s, 0)]) for s in plan.selections
    }
    if np.all(log_time[1:] >= log_time[:-1]):
        return Columns(topic, log_time, publish_time, fields)
    order = np.argsort(log_time, kind="stable")
    return Columns(topic, log_time[order], publish_time[order], {p: f[order] for p, f in fields.items()})
