"""Signals of a DBC from raw CAN frames, column by column.

A signal's bits are gathered from the few bytes that contain it, for all frames at once. Bit numbers follow the DBC: bit
b is bit b mod 8 of byte b div 8. A message is identified by bus and identifier, in J1939 by its parameter group (PGN).
"""

import re
import stat
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs.constants import CONSTANTS
from pdhef_logtool.logs.container import rows_by_channel
from pdhef_logtool.logs.message_schema import FieldInfo
from pdhef_logtool.logs.resource_limits import MIB
from pdhef_logtool.records.errors import MappingFileError
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray, Loss

if TYPE_CHECKING:
    from cantools.database.can import Database, Message, Signal

    from pdhef_logtool.logs.table_log import Table

CAN_TYPE = "can/msg/Frame"
_MAX_DBC_BYTES = 32 * MIB
#: Bits of a signal that become a number.
MOST_BITS = 64
_CAN = CONSTANTS["can"]
ID_BITS, BASE_ID_BITS, EXTENDED_FLAG = _CAN["id_bits"], _CAN["base_id_bits"], _CAN["extended_flag"]
_BYTE, BYTE_BITS = 0xFF, 8
#: Identifiers in the number of a source.
_IDS = 1 << 32
#: Identifiers that a note names.
_SHOWN = 5
#: Names of raw values without a measurement, in signals of at least 8 bits; shorter ones are states.
_NO_VALUE = re.compile(r"(?<![a-z])(?<!no[ _-])(?:sna|invalid|error|fehler|(?:not|un|n)[ _-]?available)", re.I)
#: Maximum number of distinct values outside of a correct range, and their share of all distinct values.
_FEW_VALUES, _FEW_SHARE = 16, 0.1


class Source(NamedTuple):
    """Bus and identifier of a frame."""

    bus: int
    is_extended: bool
    identifier: int


#: Multiplexers with the values under which something is sent.
Selectors: TypeAlias = "tuple[tuple[Signal, tuple[int, ...]], ...]"


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """Raw frames of a bus.

    Attributes
    ----------
    stamps_ns : [N], ascending.
    parts : by name, [N]: ``id``, ``length`` (bytes), ``is_extended``, and other parts of a frame.
    data : [N, k], zero behind the length.
    """

    stamps_ns: IntArray
    parts: Mapping[str, NDArray[Any]]
    data: NDArray[np.uint8]

    @classmethod
    def of_table(cls, table: "Table") -> "Frames":
        """Return the frames of a table that :meth:`table` made."""
        rows = slice(0, len(table.stamps_ns))
        names = [f.path for f in table.fields if not f.path.startswith("data[")]
        parts = {name: np.asarray(table.load(name, rows)).astype(np.int64) for name in names}
        return cls(table.stamps_ns, parts, np.nan_to_num(table.load("data", rows)).astype(np.uint8))

    def table(self, name: str) -> "Table":
        """Return the frames as they are, with NaN behind the length."""
        from pdhef_logtool.logs.table_log import Table

        names = [f"data[{i}]" for i in range(self.data.shape[1])]

        def load(path: str, rows: slice) -> NDArray[Any]:
            if path in self.parts:
                return self.parts[path][rows]
            past = np.arange(self.data.shape[1]) >= self.parts["length"][rows, np.newaxis]
            values = np.where(past, np.nan, self.data[rows])
            return values if path == "data" else values[:, names.index(path)]

        fields = tuple(FieldInfo(path, "number") for path in (*self.parts, *names))
        return Table(name, self.stamps_ns, fields, load, CAN_TYPE)

    def by_source(self) -> dict[Source, IntArray]:
        """Return the rows of data frames by their source."""
        ids = self.parts["id"].astype(np.int64)
        zero = np.zeros(len(ids), np.int64)
        bus, extended = self.parts.get("bus", zero), self.parts.get("is_extended", ids > BASE_ID_BITS)
        rows = np.flatnonzero((self.parts.get("is_error", zero) == 0) & (self.parts.get("is_remote", zero) == 0))
        keys = (2 * bus.astype(np.int64) + (extended > 0)) * _IDS + (ids & ID_BITS)
        return {
            Source(key // (2 * _IDS), bool(key // _IDS & 1), key & ID_BITS): rows[its]
            for key, its in rows_by_channel(keys[rows]).items()
        }


@dataclass(frozen=True, slots=True, eq=False)
class Decoder:
    """Tables of signals from raw frames.

    Attributes
    ----------
    frames : raw frames. databases : DBC files and their names. names : names of existing tables.
    lost : list to which losses of frames are appended.
    column_losses : losses by table and column, added when a column is first loaded.
    """

    frames: Frames
    databases: "Sequence[tuple[str, Database]]"
    names: Collection[str]
    lost: list[Loss]
    column_losses: dict[tuple[str, str], list[Loss]]

    def tables(self) -> "Iterator[Table]":
        """Yield a table for each message, bus and source address of the frames, with signals and units.

        If several databases define an identifier, the database with the most of its messages on the bus is used. The
        table of the best bus and the most frequent address has the name of the message; the names of the others end
        with bus or address (``#bus1``). Multiplexed signals have a table for each value of their multiplexer.
        """
        rows = self.frames.by_source()
        described = [described_sources(database, rows) for _, database in self.databases]
        fits = {
            (number, bus): fit_of(database, frozenset(m.frame_id for s, m in described[number].items() if s.bus == bus))
            for bus in {source.bus for source in rows}
            for number, (_, database) in enumerate(self.databases)
        }
        senders: dict[int, dict[tuple[int, int], list[IntArray]]] = {}
        addressed: set[int] = set()
        unknown: dict[int, int] = {}
        for source, its in rows.items():
            able = [number for number, messages in enumerate(described) if source in messages]
            if not able:
                unknown[source.identifier] = unknown.get(source.identifier, 0) + len(its)
                continue
            message = described[max(able, key=lambda number: fits[number, source.bus])][source]
            if has_j1939_identifier(message) or source.identifier != message.frame_id:
                addressed.add(id(message))
            sender = source.bus, source.identifier & _BYTE
            senders.setdefault(id(message), {}).setdefault(sender, []).append(its)
        for number, message in ((n, m) for n, (_, database) in enumerate(self.databases) for m in database.messages):
            parts = {sender: np.sort(np.concatenate(its)) for sender, its in senders.get(id(message), {}).items()}
            ranked = sorted(parts, key=lambda its: (-fits[number, its[0]], its[0], -len(parts[its]), its))
            for bus, address in ranked:
                ending = f"bus{bus}" * (bus != ranked[0][0]) + f"sa{address:02X}" * (address != ranked[0][1])
                ending = f"#{ending}" * bool(ending)
                yield from self._messages(message, ending, parts[bus, address], is_j1939=id(message) in addressed)
        if unknown:
            names, count = ", ".join(name for name, _ in self.databases), sum(unknown.values())
            shown = ", ".join(f"0x{identifier:X}" for identifier in [*unknown][:_SHOWN])
            what = f"{count} frames, no identifier of {names}: {shown}{', ...' * (len(unknown) > _SHOWN)}"
            self.lost.append(Loss("unknown-frame", what, names, count=count, severity="note"))

    def _messages(self, message: "Message", ending: str, rows: IntArray, *, is_j1939: bool) -> "Iterator[Table]":
        """Yield the tables of a message from one sender, without the signals that no frame contains."""
        from pdhef_logtool.logs.table_log import Table

        data = self.frames.data
        lengths = np.minimum(self.frames.parts["length"], data.shape[1])
        for condition, signals, selectors in signal_groups(message):
            its = rows[are_sent(data[rows], lengths[rows], selectors)]
            if not its.size:
                continue
            name = f"{message.name}{condition}{ending}"
            name = next(
                n for n in (name, *(f"{name}#{i}" for i in range(2, 2 + len(self.names)))) if n not in self.names
            )
            beyond = {s.name: bytes_of(s) for s in signals if bytes_of(s) > lengths[its].min()}
            if beyond:
                short = lengths[its] < max(beyond.values())
                what = f"frames of {lengths[its].min()} bytes, {message.length} in the DBC, lack {', '.join(beyond)}"
                self.lost.append(Loss("undecodable", what, name, count=int(short.sum())))
            there = [s for s in signals if bytes_of(s) <= lengths[its].max()]
            if there:
                load = self._loader(name, {s.name: s for s in there}, data[its], lengths[its], is_j1939=is_j1939)
                fields = tuple(FieldInfo(s.name, "number", unit=s.unit or "") for s in there)
                yield Table(name, self.frames.stamps_ns[its], fields, load, f"can/msg/{message.name}")

    def _loader(
        self, name: str, signals: "Mapping[str, Signal]", data: NDArray[np.uint8], lengths: IntArray, *, is_j1939: bool
    ) -> Callable[[str, slice], FloatArray]:
        """Return the loader of columns. A column is decoded once, for all frames; missing values are NaN."""
        columns: dict[str, FloatArray] = {}

        def load(path: str, rows: slice) -> FloatArray:
            if path not in columns:
                signal = signals[path]
                there = lengths >= bytes_of(signal)
                values = np.full(len(there), np.nan)
                values[there] = signal_values(data[there], signal, is_j1939=is_j1939)
                losses = self.column_losses.setdefault((name, path), [])
                if none := int(np.isnan(values[there]).sum()):
                    what = f"the raw value of {path} means 'not available' or 'error'"
                    losses.append(Loss("not-available", what, name, count=none, severity="note"))
                outside, is_error = leaves_range(values, signal)
                if outside.any():
                    what = f"{path} is outside of [{signal.minimum}|{signal.maximum}] of the DBC"
                    what += f", first with {values[outside][0]:.10g}{'' if is_error else '; this range is ignored'}"
                    severity: Literal["lost", "note"] = "lost" if is_error else "note"
                    losses.append(Loss("out-of-range", what, name, count=int(outside.sum()), severity=severity))
                columns[path] = np.where(outside & is_error, np.nan, values)
            return columns[path][rows]

        return load


def has_j1939_identifier(message: "Message") -> bool:
    """Return whether the DBC states J1939 for a message, by its frame format or the null address in its identifier."""
    is_null_address = message.frame_id & _BYTE == _CAN["null_address"]
    return message.is_extended_frame and (message.protocol == "j1939" or is_null_address)


def parameter_group(identifier: int) -> int:
    """Return the PGN of a 29-bit identifier, without the destination address where it contains one."""
    group: int = identifier >> BYTE_BITS & _CAN["pgn_bits"]
    return group if _is_broadcast(identifier) else group & ~_BYTE


def _is_broadcast(identifier: int) -> bool:
    """Return whether the PDU format of a 29-bit identifier has no destination address."""
    return identifier >> 2 * BYTE_BITS & _BYTE >= int(_CAN["broadcast"])


def described_sources(database: "Database", sources: Iterable[Source]) -> "dict[Source, Message]":
    """Return the messages of a database by source.

    A 29-bit identifier that is not in the database is compared by PGN: with J1939 messages, and with messages with a
    broadcast PGN if no frame has their identifier.
    """
    exact = {(m.is_extended_frame, m.frame_id): m for m in reversed(database.messages)}
    sent = {source.identifier for source in sources if source.is_extended}
    groups = {
        parameter_group(m.frame_id): m
        for m in reversed(database.messages)
        if has_j1939_identifier(m) or (m.is_extended_frame and m.frame_id not in sent and _is_broadcast(m.frame_id))
    }
    by_group = {s: groups.get(parameter_group(s.identifier)) if s.is_extended else None for s in sources}
    matches = {s: exact.get((s.is_extended, s.identifier), by_group[s]) for s in sources}
    return {source: message for source, message in matches.items() if message is not None}


def _bytes_of(signal: "Signal") -> tuple[int, int, int]:
    """Return first and last byte of a signal, and the number of unused low bits in its least significant byte.

    Its start is the least significant bit of a little-endian signal, the most significant one of a big-endian signal.
    """
    if signal.byte_order == "little_endian":
        first, skipped = divmod(signal.start, BYTE_BITS)
        return first, (signal.start + signal.length - 1) // BYTE_BITS, skipped
    first, place = divmod(signal.start, BYTE_BITS)
    end = BYTE_BITS * (first + 1) - 1 - place + signal.length
    last = (end - 1) // BYTE_BITS
    return first, last, BYTE_BITS * (last + 1) - end


def bytes_of(signal: "Signal") -> int:
    """Return how many bytes a frame needs to contain a signal."""
    return _bytes_of(signal)[1] + 1


def raw_bits(data: NDArray[np.uint8], signal: "Signal") -> NDArray[np.uint64]:
    """Gather the unsigned integer of a signal of at most 64 bits from frames uint8 [N, k] that contain it."""
    first, last, skipped = _bytes_of(signal)
    value = np.zeros(data.shape[0], np.uint64)
    columns = range(first, last + 1) if signal.byte_order == "little_endian" else range(last, first - 1, -1)
    for i, column in enumerate(columns):
        byte = data[:, column].astype(np.uint64)
        shift = BYTE_BITS * i - skipped
        value |= byte << np.uint64(shift) if shift >= 0 else byte >> np.uint64(-shift)
    return value & np.uint64((1 << signal.length) - 1)


def are_sent(data: NDArray[np.uint8], lengths: IntArray, selectors: Selectors) -> BoolArray:
    """Return which frames, uint8 [N, k] with their lengths [N], have a listed value in each multiplexer."""
    sent = np.ones(len(data), np.bool_)
    for selector, values in selectors:
        sent &= lengths >= bytes_of(selector)
        if sent.any():
            sent[sent] = np.isin(raw_bits(data[sent], selector), np.asarray(values, np.uint64))
    return sent


def signal_values(data: NDArray[np.uint8], signal: "Signal", *, is_j1939: bool = False) -> FloatArray:
    """Decode one signal of frames uint8 [N, k] to ``scale * raw + offset``, float64 [N].

    The result is NaN for raw values that mean "not available" or "error": by their name in the DBC, or by SAE J1939-71
    (all bits set, or a most significant byte of 0xFE or 0xFF).
    """
    raw = raw_bits(data, signal)
    number: NDArray[Any] = raw
    if signal.is_float:
        width = signal.length // BYTE_BITS
        with np.errstate(invalid="ignore"):  # numpy warns about a signalling NaN
            number = raw.astype(f"<u{width}").view(f"<f{width}").astype(np.float64)
    elif signal.is_signed:
        sign = np.uint64(1 << (signal.length - 1))
        number = ((raw ^ sign) - sign).view(np.int64)
    values = np.asarray(number.astype(np.float64) * float(signal.scale) + float(signal.offset), dtype=np.float64)
    for code, text in (signal.choices or {}).items() if signal.length >= BYTE_BITS else ():
        if _NO_VALUE.search(str(text)):
            values[number == code] = np.nan
    if is_j1939 and not signal.is_float and not signal.is_signed and signal.length > 1:
        top_bits = min(signal.length, BYTE_BITS)
        least = _CAN["no_value"] if top_bits == BYTE_BITS else (1 << top_bits) - 1
        values[raw >> np.uint64(signal.length - top_bits) >= least] = np.nan
    return values


def leaves_range(values: FloatArray, signal: "Signal") -> tuple[NDArray[np.bool_], bool]:
    """Return which values [N] are outside of the range in the DBC, and whether this range is plausible.

    A range is implausible if many distinct values are outside.
    """
    margin, (low, high) = abs(float(signal.scale)) / 2, (signal.minimum, signal.maximum)
    if low is None or high is None or not low < high:
        return np.zeros(len(values), np.bool_), True
    outside = (values < float(low) - margin) | (values > float(high) + margin)
    allowed = max(_FEW_VALUES, _FEW_SHARE * len(np.unique(values))) if outside.any() else 0
    return outside, len(np.unique(values[outside])) <= allowed


def fit_of(database: "Database", sent: frozenset[int]) -> float:
    """Return the number of identifiers of a bus that a database defines, times their share of its definitions."""
    defined = sum(m.frame_id in sent for m in database.messages)
    return defined**2 / max(1, len(database.messages))


def signal_groups(message: "Message") -> "Iterator[tuple[str, list[Signal], Selectors]]":
    """Yield groups of signals that are sent together: the suffix of their topic, the signals, their multiplexers."""
    by_name = {s.name: s for s in message.signals}
    groups: dict[Selectors, list[Signal]] = {}
    for signal in message.signals:
        if signal.length <= MOST_BITS:
            groups.setdefault(tuple(selectors_of(signal, by_name)), []).append(signal)
    for selectors, signals in groups.items():
        yield "".join(f"_{selector.name}_{values[0]}" for selector, values in selectors), signals, selectors


def selectors_of(signal: "Signal", by_name: "Mapping[str, Signal]") -> "Iterator[tuple[Signal, tuple[int, ...]]]":
    """Yield the multiplexers above a signal and the values under which it is sent."""
    seen: set[str] = set()
    while signal.multiplexer_ids and signal.name not in seen:
        seen.add(signal.name)
        selector = by_name.get(signal.multiplexer_signal or "")
        if selector is None:
            return
        yield selector, tuple(int(v) for v in signal.multiplexer_ids)
        signal = selector


def load_dbc(path: Path) -> "Database":
    """Read a DBC file; raises MappingFileError for any other file."""
    try:
        state = path.stat()
    except OSError as error:
        raise _no_dbc(path, error.strerror or str(error)) from None
    if not stat.S_ISREG(state.st_mode) or state.st_size > _MAX_DBC_BYTES:
        raise _no_dbc(path, f"{state.st_size} bytes" if stat.S_ISREG(state.st_mode) else "no file")
    return _load_cached(path, state.st_mtime_ns, state.st_size)


def _no_dbc(path: Path, got: str) -> MappingFileError:
    expected = f"a DBC file of at most {_MAX_DBC_BYTES // MIB} MiB"
    return MappingFileError(expected=expected, got=got, where=str(path), remedy="correct [can] dbc")


@lru_cache(maxsize=16)
def _load_cached(path: Path, _modified_ns: int, _size: int) -> "Database":
    import cantools
    from cantools.database.can import Database

    try:
        # Overlapping signals are an error of the file, not of the requested signals.
        matches = cantools.database.load_file(path, strict=False)
    except Exception as error:  # noqa: BLE001  cantools' parsers raise any exception for a malformed file.
        raise _no_dbc(path, (str(error).splitlines() or [""])[0] or type(error).__name__) from None
    if not isinstance(matches, Database):
        raise _no_dbc(path, "a file of another kind")
    return matches
