"""A drive log over one or several containers: columns of the fields asked for, in windows of log time."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path

import numpy as np

from pdhef_logtool.logs.budget import DEFAULT_BUDGET
from pdhef_logtool.logs.container import Block, ChannelRecord, Container, Span, SpanDamageError
from pdhef_logtool.logs.decoding import (
    ChannelDecoder,
    channel_schema,
    concatenate_columns,
    empty_column,
    missing_column,
)
from pdhef_logtool.logs.drive_log import Columns, FieldInfo, TopicInfo
from pdhef_logtool.logs.message_schema import MessageSchema, NoSchemaError, SchemaError, Selection, leaves, resolve
from pdhef_logtool.records.errors import MappingError
from pdhef_logtool.records.signals import BoolArray, IntArray, Loss

#: Neighbouring windows share the span at their border; this many decoded spans are kept for the next window.
_KEPT_SPANS = 2
#: No sound schema takes longer; what such ones take, and those that are refused, is bounded for the log.
_SLOW_SCHEMA_S = 0.25


class ColumnarLog:
    """See :class:`~pdhef_logtool.logs.drive_log.DriveLog`.

    Parameters
    ----------
    path : file or folder as the user named it.
    kind : ``mcap``, ``rosbag1``, ``rosbag2-sqlite3`` or ``rosbag2-mcap``.
    containers : the log's files in order of recording.
    lost : damage found while the log was opened, beside the containers' own.
    distro : ROS distribution for types without definitions.
    """

    def __init__(
        self, path: Path, kind: str, containers: Sequence[Container], lost: Sequence[Loss] = (), distro: str = ""
    ) -> None:
        self.path = path
        self.kind = kind
        self.containers = tuple(containers)
        self._opened_lost = tuple(lost)
        self.distro = distro
        self._damaged: dict[tuple[int, int], Loss] = {}
        # Messages that do not decode, by container, channel and span: a repeated read must not count them again.
        self._undecodable: dict[tuple[int, int, int], IntArray] = {}
        self._schemas: dict[tuple[int, int], MessageSchema | SchemaError] = {}
        self._slow_schemas_s = 0.0
        self._plans: dict[tuple[str, tuple[str, ...]], _Plan] = {}
        self._kept: dict[tuple[int, int, frozenset[int] | None], Block] = {}

    @property
    def topics(self) -> tuple[TopicInfo, ...]:
        """All topics by name; ``messages`` leaves out those of spans found damaged so far."""
        counts: Counter[str] = Counter()
        first: dict[str, ChannelRecord] = {}
        for c, container in enumerate(self.containers):
            for channel in container.channels.values():
                first.setdefault(channel.topic, channel)
            for span in container.spans:
                if (c, span.index) not in self._damaged:
                    for id_, n in span.counts.items():
                        counts[container.channels[id_].topic] += n
        return tuple(
            TopicInfo(name, first[name].type_name, first[name].encoding, counts[name]) for name in sorted(first)
        )

    @property
    def start_ns(self) -> int:
        """First log time; 0 for a log without messages."""
        return min((s.start_ns for c in self.containers for s in c.spans), default=0)

    @property
    def end_ns(self) -> int:
        """Last log time + 1; 0 for a log without messages."""
        return max((s.end_ns for c in self.containers for s in c.spans), default=0)

    @property
    def lost(self) -> tuple[Loss, ...]:
        """What could not be read, as far as is known by now."""
        found = list(self._opened_lost)
        for c, container in enumerate(self.containers):
            found.extend(container.lost)
            found.extend(loss for (of, _), loss in sorted(self._damaged.items()) if of == c)
            found.extend(self._undecodable_losses(c, container))
            for (of, channel), schema in sorted(self._schemas.items(), key=itemgetter(0)):
                if of == c and isinstance(schema, SchemaError) and not isinstance(schema, NoSchemaError):
                    what = f"its messages cannot be decoded: {schema}"
                    found.append(Loss("bad-schema", what, container.channels[channel].topic))
        return tuple(found)

    def _undecodable_losses(self, c: int, container: Container) -> Iterator[Loss]:
        counts: Counter[int] = Counter()
        for (of, channel, _), rows in self._undecodable.items():
            if of == c:
                counts[channel] += len(rows)
        for channel, n in sorted(counts.items()):
            what = f"{n} messages do not fit the type of their topic"
            yield Loss("undecodable", what, container.channels[channel].topic, count=n)

    def fields(self, topic: str) -> tuple[FieldInfo, ...]:
        """Return the scalar leaves of a topic's schema; empty when the encoding carries none."""
        for c, container in enumerate(self.containers):
            for channel in container.channels.values():
                if channel.topic == topic:
                    schema = self._schema(c, channel)
                    if isinstance(schema, MessageSchema):
                        return tuple(leaves(schema.root))
        return ()

    def read(
        self,
        requests: Mapping[str, Sequence[str]],
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> dict[str, Columns]:
        """Read the fields asked for of messages with log time in [start, end).

        Raises
        ------
        MappingError : the log has no such topic, no such field, or cannot decode the topic.
        """
        plans = {topic: self._plan(topic, tuple(dict.fromkeys(paths))) for topic, paths in requests.items()}
        return self._collect(plans, start_ns, end_ns)

    def read_stamps(self, start_ns: int | None = None, end_ns: int | None = None) -> dict[str, Columns]:
        """Read only log and publish times of every topic."""
        return self._collect({t.name: _Plan((), {}) for t in self.topics}, start_ns, end_ns)

    def close(self) -> None:
        """Release the files."""
        self._kept.clear()
        for container in self.containers:
            container.close()

    def load(self, c: int, span: Span, want: frozenset[int] | None = None) -> Block | None:
        """Read a span of the c-th container; None and a recorded loss if it is damaged."""
        container = self.containers[c]
        want = want if container.selective else None
        key = (c, span.index)
        if key in self._damaged:
            return None
        kept = self._kept.get((*key, want))
        if kept is not None:
            return kept
        try:
            block = container.load(span, want)
        except SpanDamageError as error:
            count = sum(span.counts.values()) or None
            held = f"{count} messages" if count else "an unknown number of messages"
            self._damaged[key] = Loss(
                "bad-chunk", f"{held} lost: {error}", str(container.path), span.start_ns, span.end_ns, count
            )
            return None
        self._kept[(*key, want)] = block
        while len(self._kept) > _KEPT_SPANS:
            self._kept.pop(next(iter(self._kept)))
        return block

    def _schema(self, c: int, channel: ChannelRecord) -> MessageSchema | SchemaError:
        key = (c, channel.id)
        if key not in self._schemas:
            started = time.monotonic()
            try:
                if self._slow_schemas_s > DEFAULT_BUDGET.seconds:
                    raise SchemaError(f"the schemas before it took {self._slow_schemas_s:.0f} s")
                self._schemas[key] = channel_schema(channel, self.distro, self._example(c, channel))
            except SchemaError as error:
                self._schemas[key] = error
            took = time.monotonic() - started
            if took > _SLOW_SCHEMA_S or isinstance(self._schemas[key], SchemaError):
                self._slow_schemas_s += took
        return self._schemas[key]

    def _example(self, c: int, channel: ChannelRecord) -> bytes | None:
        """Return a channel's first message if its schema has to be taken from it."""
        if channel.encoding != "json" or channel.schema_data.strip():
            return None
        for span in self.containers[c].spans:
            if channel.id in span.counts:
                block = self.load(c, span)
                if block is None:
                    continue
                rows = np.flatnonzero(block.channel == channel.id)
                if rows.size:
                    row = int(rows[0])
                    at, n = int(block.offset[row]), int(block.length[row])
                    return bytes(block.buffer[at : at + n])
        return None

    def _plan(self, topic: str, paths: tuple[str, ...]) -> _Plan:
        if (topic, paths) in self._plans:
            return self._plans[topic, paths]
        decoders: dict[tuple[int, int], ChannelDecoder] = {}
        problems: list[MappingError] = []
        found = False
        for c, container in enumerate(self.containers):
            for channel in container.channels.values():
                if channel.topic != topic:
                    continue
                found = True
                if not paths:
                    continue
                schema = self._schema(c, channel)
                if isinstance(schema, SchemaError):
                    problems.append(
                        MappingError(
                            expected="messages as ROS 2 CDR, ROS 1, JSON or protobuf with a schema that parses",
                            got=str(schema),
                            where=topic,
                            remedy="map another topic",
                        )
                    )
                    continue
                try:
                    selections = tuple(resolve(schema, topic, path) for path in paths)
                    decoders[(c, channel.id)] = ChannelDecoder(schema, selections)
                except MappingError as error:
                    problems.append(error)
        if not found:
            raise self._no_such_topic(topic)
        if paths and not decoders:
            raise problems[0]
        # A second publisher of another type under the same topic lacks the fields: NaN there.
        selections = next(iter(decoders.values())).selections if decoders else ()
        self._plans[topic, paths] = _Plan(selections, decoders)
        return self._plans[topic, paths]

    def _no_such_topic(self, topic: str) -> MappingError:
        import difflib

        names = [t.name for t in self.topics]
        near = difflib.get_close_matches(topic, names, n=3, cutoff=0.3) or names[:5]
        return MappingError(
            expected="a topic of the log",
            got=repr(topic),
            where=str(self.path),
            remedy=f"nearest: {', '.join(near)}" if near else "the log has no topics",
        )

    def _collect(self, plans: Mapping[str, _Plan], start_ns: int | None, end_ns: int | None) -> dict[str, Columns]:
        parts: dict[str, list[Columns]] = {topic: [] for topic in plans}
        overlapping = (
            (c, container, span)
            for c, container in enumerate(self.containers)
            for span in container.spans
            if (start_ns is None or span.end_ns > start_ns) and (end_ns is None or span.start_ns < end_ns)
        )
        for c, container, span in overlapping:
            topic_of = {i: ch.topic for i, ch in container.channels.items() if ch.topic in plans and i in span.counts}
            if not topic_of:
                continue
            block = self.load(c, span, frozenset(topic_of))
            if block is None:
                continue
            keep = in_window(block.log_time_ns, start_ns, end_ns)
            for id_, topic in topic_of.items():
                mine = block.channel == id_
                rows = np.flatnonzero(mine if keep is None else mine & keep)
                if rows.size:
                    parts[topic].append(self._decode(topic, plans[topic], c, span, id_, block, rows))
        return {topic: _join(topic, plans[topic], parts[topic]) for topic in plans}

    def _decode(self, topic: str, plan: _Plan, c: int, span: Span, id_: int, block: Block, rows: IntArray) -> Columns:
        decoder = plan.decoders.get((c, id_))
        if decoder is None:
            fields = {s.path: missing_column(s, len(rows)) for s in plan.selections}
        else:
            fields = decoder.columns(block, rows)
        if decoder is not None and decoder.undecodable:
            key = (c, id_, span.index)
            seen = self._undecodable.get(key, np.empty(0, dtype=np.int64))
            # Count by place in the channel: which other channels a block holds depends on what was asked for.
            places = np.searchsorted(np.flatnonzero(block.channel == id_), decoder.undecodable)
            self._undecodable[key] = np.union1d(seen, places.astype(np.int64))
        return Columns(topic, block.log_time_ns[rows], block.publish_time_ns[rows], fields)


@dataclass(frozen=True, slots=True)
class _Plan:
    """What is read of one topic: the resolved paths and a decoder a channel."""

    selections: tuple[Selection, ...]
    decoders: Mapping[tuple[int, int], ChannelDecoder]


def in_window(log_time_ns: IntArray, start_ns: int | None, end_ns: int | None) -> BoolArray | None:
    """Tell which log times lie in [start, end); None: all of them."""
    keep: BoolArray | None = None
    if start_ns is not None:
        keep = log_time_ns >= start_ns
    if end_ns is not None:
        keep = (log_time_ns < end_ns) if keep is None else keep & (log_time_ns < end_ns)
    return None if keep is None or keep.all() else keep


def _join(topic: str, plan: _Plan, parts: Sequence[Columns]) -> Columns:
    if not parts:
        none = np.empty(0, dtype=np.int64)
        return Columns(topic, none, none.copy(), {s.path: empty_column(s) for s in plan.selections})
    log_time = np.concatenate([p.log_time_ns for p in parts])
    publish_time = np.concatenate([p.publish_time_ns for p in parts])
    fields = {s.path: concatenate_columns([p.fields[s.path] for p in parts]) for s in plan.selections}
    if np.all(log_time[1:] >= log_time[:-1]):
        return Columns(topic, log_time, publish_time, fields)
    order = np.argsort(log_time, kind="stable")
    return Columns(topic, log_time[order], publish_time[order], {p: f[order] for p, f in fields.items()})
