"""Decode raw CAN frames into the signals of a DBC file, column by column.

A source with the field ``can:<message>.<signal>`` is read through a view: a virtual topic that contains the frames of
that message (for a multiplexed signal, of that selector) and the signal as a column. Later code reads a view like a
topic. Recognition examines one view per message (:func:`decoded_frames`). DBC files are given on the command line or
attached to the log.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs import can_decoding as dbc
from pdhef_logtool.logs.drive_log import Columns, DriveLog, Requests, TopicInfo
from pdhef_logtool.logs.message_schema import FieldInfo
from pdhef_logtool.mapping.evidence import Pieces
from pdhef_logtool.mapping.naming import VOCABULARY
from pdhef_logtool.mapping.records import CAN_PREFIX, CanSettings, Mapping as SignalMapping, SignalSource, near
from pdhef_logtool.records.errors import MappingError
from pdhef_logtool.records.signals import BoolArray, IntArray, Loss

if TYPE_CHECKING:
    from cantools.database.can import Database, Message, Signal

#: Names of the fields of a frame, best first, by part; names are compared in lower case without underscores.
NAMES = {part: tuple(names.split()) for part, names in VOCABULARY["can_fields"].items()}
#: Kinds of fields that contain a part; all others are flags.
_KINDS = {"id": ("number",), "data": ("array", "string"), "length": ("number",)}

#: Flags of frames without data that SocketCAN keeps above the 29 bits of an identifier.
NO_DATA_FLAGS = (1 << 30) | (1 << 29)


def with_can_signals(log: DriveLog, mapping: SignalMapping) -> DriveLog:
    """Return a log with a view for each ``can:`` source of the mapping, or ``log`` if the mapping has no such source.

    Raises
    ------
    MappingError
        A DBC cannot be read, lacks a message or signal, or a topic contains no recognisable frames; all are named.
    """
    sources = [s for s in mapping.sources() if s.can_signal is not None]
    if not sources or isinstance(log, CanSignalLog):
        return log
    if mapping.can is None:
        raise MappingError(
            expected="[can] with dbc = the file that describes the frames",
            got=f"{sources[0].label} without it",
            where="mapping",
            remedy="see docs/formats.md",
        )
    views: dict[str, _CanView] = {}
    databases = [(path, dbc.load_dbc(log.definition(path))) for path in mapping.can.dbc]
    recorded = {t.name for t in log.topics}
    # check_mapping names the other topics, with the nearest one.
    topics = [topic for topic in dict.fromkeys(s.topic for s in sources) if topic in recorded]
    paths = {topic: _frame_paths(topic, log.fields(topic), mapping.can) for topic in topics}
    problems: list[str] = []
    for source in (s for s in sources if s.topic in paths):
        view = _make_view(source, paths[source.topic], databases)
        buses = _buses(log, view) if isinstance(view, _CanView) and mapping.can.bus is None else []
        if isinstance(view, str):
            problems.append(view)
        elif len(buses) > 1:
            problems.append(f"message {view.message.name} is on buses {buses}: set [can] bus and bus_field")
        else:
            views[source.read_topic] = view
    if problems:
        raise MappingError(
            expected="CAN frames, and messages and signals of the DBC",
            got="; ".join(dict.fromkeys(problems)),
            where=", ".join(p.name for p in mapping.can.dbc),
            remedy='write field = "can:<message>.<signal>"; [can] names the fields of a frame',
        )
    return CanSignalLog(log, views, mapping.can)


def decoded_frames(log: DriveLog, topics: Sequence[TopicInfo]) -> "CanSignalLog | None":
    """Return a log with a view for each message of its DBC files that occurs in the topics of frames, or None.

    If several files define an identifier, the file named like the topic decides, else the one with most identifiers.
    """
    databases = [(path, dbc.load_dbc(path)) for path in log.databases] if topics else []
    views: dict[str, _CanView] = {}
    settings = CanSettings(tuple(p if p in log.given_databases else Path(p.name) for p, _ in databases))
    for topic in topics if databases else ():
        paths = _frame_paths(topic.name, log.fields(topic.name, quiet=True), settings)
        if isinstance(paths, str):
            continue
        sent = _identifiers(log, topic.name, paths)
        ranked = sorted(databases, key=lambda d: (not _is_named_like(d[0], topic.name), -dbc.fit_of(d[1], sent)))
        described: set[tuple[int, bool]] = set()
        for _, database in ranked:
            for message in (m for m in database.messages if m.frame_id in sent):
                key = (message.frame_id, message.is_extended_frame)
                for ending, signals, selectors in dbc.signal_groups(message) if key not in described else ():
                    name = f"{topic.name}.{CAN_PREFIX}{message.name}{ending}"
                    by_name = {s.name: s for s in signals}
                    views[name] = _CanView(topic.name, paths, message, by_name, selectors, True)
            described |= {(m.frame_id, m.is_extended_frame) for m in database.messages}
    return CanSignalLog(log, views, settings) if views else None


def _identifiers(log: DriveLog, topic: str, paths: "_FramePaths") -> frozenset[int]:
    """Return the identifiers of a topic's frames in pieces of the log."""
    seen = Pieces(log).read([(topic, paths.parts["id"])]).values()
    return frozenset(int(i) & dbc.ID_BITS for its in seen for i in np.unique(its.values[np.isfinite(its.values)]))


def _buses(log: DriveLog, view: "_CanView") -> list[int]:
    """Return the buses of a message in a log of frames alone; other logs usually have a topic for each bus."""
    is_frames = any(t.name == view.topic and t.type_name == dbc.CAN_TYPE for t in log.topics)
    if not is_frames or "bus" not in {f.path for f in log.fields(view.topic)}:
        return []
    frames = log.read({view.topic: [view.paths.parts["id"], "bus"]}, quiet=True)[view.topic].fields
    return [int(bus) for bus in np.unique(frames["bus"][frames[view.paths.parts["id"]] == view.message.frame_id])]


def _is_named_like(path: Path, topic: str) -> bool:
    return path.stem.lower() in topic.lower()


@dataclass(frozen=True, slots=True)
class _FramePaths:
    """Field paths in a topic: by the part of a frame, and of the flags of frames without data."""

    parts: Mapping[str, str]
    no_data: tuple[str, ...]

    @property
    def all(self) -> tuple[str, ...]:
        return (*self.parts.values(), *self.no_data)


@dataclass(frozen=True, slots=True, eq=False)
class _CanView:
    """Signals of one message by field. Each multiplexer in ``selectors`` must contain one of its listed values."""

    topic: str
    paths: _FramePaths
    message: "Message"
    signals: "Mapping[str, Signal]"
    selectors: dbc.Selectors
    unflagged_may_be_extended: bool


class CanSignalLog(DriveLog):
    """A log with a view for each CAN signal; all other topics are passed through.

    ``short_frames`` counts the frames that the last read dropped: :class:`Loss` by topic and message.
    """

    def __init__(self, log: DriveLog, views: Mapping[str, _CanView], settings: CanSettings) -> None:
        self._log = log
        self.path, self.kind, self.size = log.path, log.kind, log.size
        self.recording_span = log.recording_span
        self._settings = settings
        self._views = views
        self.short_frames: tuple[Loss, ...] = ()

    def as_mapped(self, mapping: SignalMapping) -> SignalMapping:
        """Return a mapping that names fields of views, as one of ``can:`` sources with the DBC files."""
        mapping = mapping.changed(self.as_source)
        used = any(s.can_signal is not None for s in (*mapping.signals.values(), *mapping.truth.values()))
        return replace(mapping, can=self._settings if used else None)

    def as_source(self, source: SignalSource) -> SignalSource:
        """Return a source that names a field of a view as a ``can:`` source."""
        view = self._views.get(source.topic)
        if view is None or not isinstance(source.field, str):
            return source
        return replace(source, topic=view.topic, field=f"{CAN_PREFIX}{view.message.name}.{source.field}")

    @property
    def topics(self) -> tuple[TopicInfo, ...]:
        """Return the log's topics, and one for each view."""
        wanted = {t.name: t for t in self._log.topics}
        views = (TopicInfo(name, v.message.name, "can", wanted[v.topic].messages) for name, v in self._views.items())
        return (*wanted.values(), *views)

    @property
    def lost(self) -> tuple[Loss, ...]:
        """Losses of the log."""
        return self._log.lost

    def fields(self, topic: str, *, quiet: bool = False) -> tuple[FieldInfo, ...]:
        """Return a topic's leaves; for a view, the leaves of its topic that are no part of frames, and the signals."""
        view = self._views.get(topic)
        if view is None:
            return self._log.fields(topic, quiet=quiet)
        fields = self._log.fields(view.topic, quiet=quiet)
        stamps = (f for f in fields if f.path.partition("[")[0] not in view.paths.all)
        return (*stamps, *(FieldInfo(path, "number", unit=s.unit or "") for path, s in view.signals.items()))

    def unreadable(self, topic: str) -> str:
        """Return why no field of a topic is known."""
        return self._log.unreadable(self._views[topic].topic if topic in self._views else topic)

    def first_messages(self, topic: str, most: int) -> list[object]:
        """Return the first messages of a topic whole."""
        return self._log.first_messages(self._views[topic].topic if topic in self._views else topic, most)

    def read(
        self, requests: Requests, start_ns: int | None = None, end_ns: int | None = None, *, quiet: bool = False
    ) -> dict[str, Columns]:
        """Read fields; each topic of frames is read once for all of its signals."""
        raw: dict[str, list[str]] = {}
        for topic, paths in requests.items():
            view = self._views.get(topic)
            wanted = paths if view is None else (*view.paths.all, *(p for p in paths if p not in view.signals))
            merged = raw.setdefault(topic if view is None else view.topic, [])
            merged += [p for p in wanted if p not in merged]
        read = self._log.read(raw, start_ns, end_ns, quiet=quiet) if raw else {}
        short: dict[str, Loss] = {}
        matches = {}
        for topic, paths in requests.items():
            view = self._views.get(topic)
            matches[topic] = read[topic] if view is None else self._view_columns(view, read, topic, paths, short)
        self.short_frames = tuple(short.values())
        return matches

    def close(self) -> None:
        """Release the files."""
        self._log.close()

    def _view_columns(
        self, view: _CanView, read: dict[str, Columns], topic: str, paths: Sequence[str], short: dict[str, Loss]
    ) -> Columns:
        frames = read[view.topic]
        rows = np.flatnonzero(_is_message(frames, view, self._settings))
        data, available = _payload(frames, view.paths, rows)
        signals = {p: view.signals[p] for p in paths if p in view.signals}
        needed = max(map(dbc.bytes_of, (*signals.values(), *(s for s, _ in view.selectors))), default=0)
        short_ns = frames.log_time_ns[rows[available < needed]]
        if short_ns.size:
            where = f"{view.topic}.{CAN_PREFIX}{view.message.name}"
            what, span = "frame that ends before its signal dropped", (int(short_ns.min()), int(short_ns.max()) + 1)
            loss = Loss("undecodable", what, where, *span, len(short_ns))
            short[where] = max(loss, short.get(where, loss), key=lambda x: x.count or 0)
        use = (available >= needed) & dbc.are_sent(data, available, view.selectors)
        rows, data = rows[use], data[use]
        fields = {p: frames.fields[p][rows] for p in paths if p not in signals}
        is_j1939 = dbc.has_j1939_identifier(view.message)
        for path, signal in signals.items():
            fields[path] = dbc.signal_values(data, signal, is_j1939=is_j1939) if rows.size else np.empty(0)
        return Columns(topic, frames.log_time_ns[rows], frames.publish_time_ns[rows], fields)


def _is_message(frames: Columns, view: _CanView, settings: CanSettings) -> BoolArray:
    """Return which frames [N] carry data of the view's message."""
    paths, fields = view.paths.parts, frames.fields
    number = np.asarray(fields[paths["id"]], dtype=np.float64)
    is_valid = (number >= -(2.0**31)) & (number < 2.0**32)
    # Signed 32-bit fields contain an identifier with the extended flag as a negative number.
    ids = np.floor(np.where(is_valid, number, 0.0)).astype(np.int64) & (2**32 - 1)
    fits = is_valid & ((ids & NO_DATA_FLAGS) == 0)
    bare = ids & dbc.ID_BITS
    fits &= (bare & settings.id_mask) == (view.message.frame_id & settings.id_mask)
    flagged = (ids & dbc.EXTENDED_FLAG) != 0
    if "extended" in paths:
        flagged |= fields[paths["extended"]] > 0.0
    elif view.unflagged_may_be_extended and view.message.is_extended_frame:
        flagged[:] = True
    flagged |= bare > dbc.BASE_ID_BITS
    fits &= flagged == view.message.is_extended_frame
    for path in view.paths.no_data:
        fits &= ~(fields[path] > 0.0)
    if "bus" in paths and settings.bus is not None:
        fits &= fields[paths["bus"]] == settings.bus
    return np.asarray(fits, dtype=np.bool_)


def _payload(frames: Columns, paths: _FramePaths, rows: IntArray) -> tuple[NDArray[np.uint8], IntArray]:
    """Return the bytes [N, k] of frames and how many of them each frame has [N]."""
    number = np.asarray(frames.fields[paths.parts["data"]], dtype=np.float64)[rows]
    if number.ndim == 1:
        number = number[:, np.newaxis]
    valid = np.isfinite(number) & (number >= 0.0) & (number <= 255.0)
    available = np.cumprod(valid, axis=1, dtype=np.int64).sum(axis=1)
    if "length" in paths.parts:
        stated_length = np.asarray(frames.fields[paths.parts["length"]], dtype=np.float64)[rows]
        # Above 8 a length code of CAN FD is no number of bytes, and the array itself has the right length.
        shorter = (stated_length >= 0.0) & (stated_length <= 8.0) & (stated_length < available)
        available = np.where(shorter, stated_length, available).astype(np.int64)
    return np.where(valid, number, 0.0).astype(np.uint8), available


def _make_view(
    source: SignalSource, paths: _FramePaths | str, databases: "Sequence[tuple[Path, Database]]"
) -> _CanView | str:
    """Return the view of a source, or a text that describes the error."""
    if isinstance(paths, str):
        return paths
    names = source.can_signal
    if names is None or not all(names):
        return f"{source.label} names no message and signal"
    message_name, signal_name = names
    holders = [(path, m) for path, database in databases for m in database.messages if m.name == message_name]
    if not holders:
        names_of_messages = [m.name for _, d in databases for m in d.messages]
        return f"the DBC has no message {message_name}{near(message_name, names_of_messages)}"
    holders = [h for h in holders if _is_named_like(h[0], source.topic)] or holders
    if len(holders) > 1:
        return f"message {message_name} is in {' and in '.join(p.name for p, _ in holders)}"
    message = holders[0][1]
    by_name = {s.name: s for s in message.signals}
    if signal_name not in by_name:
        return f"message {message_name} has no signal {signal_name}{near(signal_name, list(by_name))}"
    signal = by_name[signal_name]
    if signal.length > dbc.MOST_BITS:
        return f"{message_name}.{signal_name} has {signal.length} bits, at most {dbc.MOST_BITS} make a number"
    standard_ids = {m.frame_id for _, d in databases for m in d.messages if not m.is_extended_frame}
    signals, selectors = dict.fromkeys(source.paths, signal), tuple(dbc.selectors_of(signal, by_name))
    return _CanView(source.topic, paths, message, signals, selectors, message.frame_id not in standard_ids)


def holds_frames(topic: str, fields: tuple[FieldInfo, ...]) -> bool:
    """Return whether the field names of a topic match raw CAN frames."""
    return not isinstance(_frame_paths(topic, fields, CanSettings(())), str)


def _frame_paths(topic: str, fields: tuple[FieldInfo, ...], settings: CanSettings) -> _FramePaths | str:
    """Return the field paths of the parts of frames in a topic, or a text that lists the missing parts."""
    kinds = _plain_kinds(fields)
    given = {part: getattr(settings, f"{part}_field") for part in ("id", "data", "length", "extended")}
    matches = {part: [path] if path else _best(kinds, part) for part, path in given.items()}
    several = ((part, its) for part, its in matches.items() if len(its) > 1)
    problems = [f"{topic} has {' and '.join(its)}: name the field in [can] {part}_field" for part, its in several]
    for part, what in (("id", "identifier"), ("data", "data")):
        if not matches[part]:
            problems.append(f"{topic} has no field that is known as a frame's {what}: name it in [can] {part}_field")
    parts = {part: its[0] for part, its in matches.items() if its}
    if settings.bus_field:
        parts["bus"] = settings.bus_field
    if "data" in parts and settings.data_encoding != "bytes":
        parts["data"] += f"|{settings.data_encoding}"
    elif "data" in parts and kinds.get(parts["data"]) == "string":
        problems.append(f'{topic}.{parts["data"]} is a text: set [can] data_encoding = "hex" or "base64"')
    no_data = (*_best(kinds, "error"), *_best(kinds, "remote"))
    return "; ".join(problems) if problems else _FramePaths(parts, no_data)


def _plain_kinds(fields: tuple[FieldInfo, ...]) -> dict[str, str]:
    """Return kinds by path; an array of numbers is one ``array``, and fields in arrays of structs are excluded."""
    kinds: dict[str, str] = {}
    for leaf in fields:
        base, bracket, rest = leaf.path.partition("[")
        if not bracket:
            kinds[base] = leaf.kind
        elif rest.endswith("]") and "." not in rest and "[" not in rest and leaf.kind == "number":
            kinds[base] = "array"
    return kinds


def _best(kinds: Mapping[str, str], part: str) -> list[str]:
    """Return the least nested paths that end in the first name of a part of a frame with any match."""
    paths = [path for path, kind in kinds.items() if kind in _KINDS.get(part, ("number", "bool"))]
    for name in NAMES[part]:
        matches = [p for p in paths if p.rsplit(".", 1)[-1].replace("_", "").lower() == name]
        if matches:
            depth = min(p.count(".") for p in matches)
            return [p for p in matches if p.count(".") == depth]
    return []
