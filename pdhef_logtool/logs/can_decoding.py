"""Signals of a DBC from raw CAN frames, column by column.

A signal's bits are gathered from the few bytes that contain it, for all frames at once. Bit numbers follow the DBC: bit
b is bit b mod 8 of byte b div 8; a little-endian signal starts at its least significant bit, a big-endian one at its
most significant bit.
"""

from __future__ import annotations

import stat
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs.message_schema import FieldInfo
from pdhef_logtool.logs.table_log import Table
from pdhef_logtool.records.errors import MappingFileError
from pdhef_logtool.records.signals import FloatArray, IntArray

if TYPE_CHECKING:
    from cantools.database.can import Database, Message, Signal

CAN_TYPE = "can/msg/Frame"
_MAX_DBC_BYTES = 32 << 20
#: Bits of a signal that become a number.
_MOST_BITS = 64


#: Multiplexers with the values under which something is sent.
Selectors: TypeAlias = "tuple[tuple[Signal, tuple[int, ...]], ...]"


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """Raw frames of a bus.

    Attributes
    ----------
    stamps_ns : [N], ascending.
    parts : by name, [N]: ``id``, ``length`` (bytes), ``is_extended``, and what else the file contains of a frame.
    data : [N, k], zero behind the length.
    """

    stamps_ns: IntArray
    parts: Mapping[str, NDArray[Any]]
    data: NDArray[np.uint8]

    @classmethod
    def of_table(cls, table: Table) -> Frames:
        """Return the frames of a table that :meth:`table` made."""
        rows = slice(0, len(table.stamps_ns))
        names = [f.path for f in table.fields if not f.path.startswith("data[")]
        parts = {name: np.asarray(table.load(name, rows)).astype(np.int64) for name in names}
        return cls(table.stamps_ns, parts, np.nan_to_num(table.load("data", rows)).astype(np.uint8))

    def table(self, name: str) -> Table:
        """Return the frames as they are, with NaN behind the length."""
        names = [f"data[{i}]" for i in range(self.data.shape[1])]

        def load(path: str, rows: slice) -> NDArray[Any]:
            if path in self.parts:
                return self.parts[path][rows]
            past = np.arange(self.data.shape[1]) >= self.parts["length"][rows, np.newaxis]
            values = np.where(past, np.nan, self.data[rows])
            return values if path == "data" else values[:, names.index(path)]

        fields = tuple(FieldInfo(path, "number") for path in (*self.parts, *names))
        return Table(name, self.stamps_ns, fields, load, CAN_TYPE)

    def decoded(self, databases: Sequence[Database]) -> Iterator[Table]:
        """Yield a table for each message of the databases that the frames contain, with its signals and units.

        An identifier that several databases define is that of the one with the largest share of its messages on a bus.
        Signals that are sent under some values of a multiplexer only have a table for each of these conditions.
        """
        owner = self._owners(databases)
        for message, number in ((m, n) for n, database in enumerate(databases) for m in database.messages):
            rows = np.flatnonzero(self._are(message) & (owner == number))
            if not rows.size or message.length > self.data.shape[1]:
                continue
            for ending, signals, selectors in signal_groups(message):
                its = rows
                for selector, values in selectors:
                    raw = raw_bits(self.data[its], selector.start, selector.length, selector.byte_order)
                    its = its[np.isin(raw, np.asarray(values, np.uint64))]
                if its.size:
                    yield self._message(f"{message.name}{ending}", signals, its)

    def _owners(self, databases: Sequence[Database]) -> IntArray:
        """Return the number of the database that describes each frame [N]; -1 without one."""
        ids, buses = self.parts["id"], self.parts.get("bus", np.zeros(len(self.stamps_ns)))
        owner, most = np.full(len(ids), -1), np.zeros(len(ids))
        for number, database in enumerate(databases):
            described = np.isin(ids, [m.frame_id for m in database.messages])
            for bus in np.unique(buses[described]):
                its = described & (buses == bus)
                weight = fit_of(database, frozenset(ids[its].tolist()))
                its &= weight > most
                owner[its], most[its] = number, weight
        return owner

    def _are(self, message: Message) -> NDArray[np.bool_]:
        ids = self.parts["id"]
        fits = (ids == message.frame_id) & (self.parts["length"] >= message.length)
        if "is_extended" in self.parts:
            fits &= (self.parts["is_extended"] > 0) == message.is_extended_frame
        for flag in ("is_error", "is_remote"):
            fits &= self.parts.get(flag, np.zeros(len(ids))) == 0
        return np.asarray(fits, np.bool_)

    def _message(self, name: str, signals: Sequence[Signal], its: IntArray) -> Table:
        by_name = {s.name: s for s in signals}
        fields = tuple(FieldInfo(s.name, "number", unit=s.unit or "") for s in signals)
        data = self.data[its]
        return Table(
            name,
            self.stamps_ns[its],
            fields,
            lambda path, rows: signal_values(data[rows], by_name[path]),
            f"can/msg/{name}",
        )


def raw_bits(data: NDArray[np.uint8], start: int, length: int, byte_order: str) -> NDArray[np.uint64]:
    """Gather an unsigned integer of at most 64 bits from frames.

    Parameters
    ----------
    data : uint8 [N, k]; all bytes of the signal must be there.
    start : of the signal's least (little-endian) or most (big-endian) significant bit, in the DBC's numbering.
    byte_order : ``little_endian`` or ``big_endian``.
    """
    if byte_order == "little_endian":
        first, skipped = divmod(start, 8)
        last = (start + length - 1) // 8
        columns = range(first, last + 1)
    else:
        top = 8 * (start // 8) + 7 - start % 8
        first, last = top // 8, (top + length - 1) // 8
        skipped = 8 * (last + 1) - (top + length)
        columns = range(last, first - 1, -1)
    value = np.zeros(data.shape[0], np.uint64)
    for i, column in enumerate(columns):
        byte = data[:, column].astype(np.uint64)
        shift = 8 * i - skipped
        value |= byte << np.uint64(shift) if shift >= 0 else byte >> np.uint64(-shift)
    return value & np.uint64((1 << length) - 1)


def signal_values(data: NDArray[np.uint8], signal: Signal) -> FloatArray:
    """Decode one signal of frames uint8 [N, k] to ``scale * raw + offset``, float64 [N]."""
    raw = raw_bits(data, signal.start, signal.length, signal.byte_order)
    number: NDArray[Any]
    if signal.is_float:
        width = signal.length // 8
        number = raw.astype(f"<u{width}").view(f"<f{width}").astype(np.float64)
    elif signal.is_signed:
        sign = np.uint64(1 << (signal.length - 1))
        number = ((raw ^ sign) - sign).view(np.int64)
    else:
        number = raw
    return np.asarray(number.astype(np.float64) * float(signal.scale) + float(signal.offset), dtype=np.float64)


def fit_of(database: Database, sent: frozenset[int]) -> float:
    """Return how well a database describes the identifiers of a bus: those it defines, times their share of its own."""
    defined = sum(m.frame_id in sent for m in database.messages)
    return defined**2 / max(1, len(database.messages))


def signal_groups(message: Message) -> Iterator[tuple[str, list[Signal], Selectors]]:
    """Yield the signals of a message that are sent together: an ending of their name, they, and their multiplexers."""
    by_name = {s.name: s for s in message.signals}
    groups: dict[tuple[tuple[str, tuple[int, ...]], ...], list[Signal]] = {}
    for signal in message.signals:
        if signal.length <= _MOST_BITS:
            conditions = tuple((s.name, values) for s, values in selectors_of(signal, by_name))
            groups.setdefault(conditions, []).append(signal)
    for conditions, signals in groups.items():
        ending = "".join(f"_{name}_{values[0]}" for name, values in conditions)
        yield ending, signals, tuple((by_name[name], values) for name, values in conditions)


def selectors_of(signal: Signal, by_name: Mapping[str, Signal]) -> Iterator[tuple[Signal, tuple[int, ...]]]:
    """Yield the multiplexers above a signal and the values under which it is sent."""
    seen: set[str] = set()
    while signal.multiplexer_ids and signal.name not in seen:
        seen.add(signal.name)
        selector = by_name.get(signal.multiplexer_signal or "")
        if selector is None:
            return
        yield selector, tuple(int(v) for v in signal.multiplexer_ids)
        signal = selector


def load_dbc(path: Path) -> Database:
    """Read a DBC file; raises MappingFileError where it is none."""
    try:
        state = path.stat()
    except OSError as error:
        raise MappingFileError(
            expected="a DBC file", got=error.strerror or str(error), where=str(path), remedy="correct [can] dbc"
        ) from None
    if not stat.S_ISREG(state.st_mode) or state.st_size > _MAX_DBC_BYTES:
        raise MappingFileError(
            expected=f"a DBC file of at most {_MAX_DBC_BYTES >> 20} MiB",
            got=f"{state.st_size} bytes" if stat.S_ISREG(state.st_mode) else "no file",
            where=str(path),
            remedy="correct [can] dbc",
        )
    return _load_cached(path, state.st_mtime_ns, state.st_size)


@lru_cache(maxsize=16)
def _load_cached(path: Path, _modified_ns: int, _size: int) -> Database:
    import cantools
    from cantools.database.can import Database

    expected = "a DBC file"
    try:
        # Overlapping signals are an error of the file, not of the signals that are asked for.
        matches = cantools.database.load_file(path, strict=False)
    except Exception as error:  # noqa: BLE001  cantools' parsers raise any exception for a malformed file.
        reason = (str(error).splitlines() or [""])[0] or type(error).__name__
        raise MappingFileError(expected=expected, got=reason, where=str(path), remedy="correct [can] dbc") from None
    if not isinstance(matches, Database):
        raise MappingFileError(
            expected=expected, got="a file of another kind", where=str(path), remedy="correct [can] dbc"
        )
    return matches
