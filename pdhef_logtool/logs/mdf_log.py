"""MDF 3 and 4 (extra ``formats``): each channel group is a topic with its own clock; columns are read when needed.

A group of bus logging becomes a topic ``can`` of raw frames. ``asammdf`` opens the file and returns raw values; their
conversions are those of :mod:`~pdhef_logtool.logs.mdf_conversions`.
"""

from __future__ import annotations

import datetime as dt
import gc
import logging
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from functools import partial
from io import StringIO
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs.can_decoding import Frames
from pdhef_logtool.logs.container import describe_damage
from pdhef_logtool.logs.mdf_blocks import survey_blocks
from pdhef_logtool.logs.mdf_conversions import Rule, conversion_rule
from pdhef_logtool.logs.message_schema import FieldInfo
from pdhef_logtool.logs.table_columns import NO_TIME, field_name, placed, unique
from pdhef_logtool.logs.table_file import TableFile, Tables
from pdhef_logtool.logs.table_log import Table
from pdhef_logtool.records.errors import LogError
from pdhef_logtool.records.extras import required
from pdhef_logtool.records.signals import BoolArray, IntArray, Loss

_FRAMES = "CAN_DataFrame"
#: Bytes of a CAN FD frame by its data length code, and the numbers that are such codes and no lengths.
_LENGTHS = np.array([0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64])
_ONLY_CODES = (9, 10, 11, 13, 14, 15)
_DATA_BLOCK = re.compile(rb"##(?:DT|SD|DV)\0{4}")
_LONGEST_NAME = 40
#: Times from the start of a recording beyond this are damaged.
_LONGEST_S = 4e9
#: Dates of a header beyond this, in 2100, are damaged.
_LAST_DATE_NS = 4_102_444_800 * 10**9
#: Types of channels of MDF 4: values of variable length, masters, and those whose raw values are the row numbers.
_VARIABLE, _MASTERS, _VIRTUAL = 1, (2, 3), (3, 6)
#: Data types that are numbers, of MDF 4 and 3.
_NUMBERS, _NUMBERS_3 = frozenset(range(6)), frozenset({0, 1, 2, 3, *range(9, 17)})
#: Flags of a channel: all values are invalid, some are.
_ALL_INVALID, _SOME_INVALID = 1, 2
#: What a master other than time is, by its type of synchronisation.
_NO_TIMES = {2: "an angle", 3: "a distance", 4: "an index"}


def open_mdf(file: TableFile) -> Tables:
    """Read an MDF file; groups and channels that cannot be read are losses.

    Raises
    ------
    LogError : no group of it can be read. LimitError : it claims more than the limits allow.
    """
    asammdf = required("asammdf", "formats", "reads MDF files", file.name)
    logging.getLogger("asammdf").setLevel(logging.CRITICAL)
    losses: list[Loss] = []
    if missing := survey_blocks(file):
        losses.append(Loss("truncated", f"{missing} blocks are beyond the end of the file", file.name))
    file.stream.seek(0)
    is_open = file.stream.read(7) == b"UnFinMF"
    if is_open:
        losses.append(Loss("truncated", "the recorder has not finished the file", file.name, severity="note"))
    source, got = _opened(asammdf, _copy(file) if is_open else file.stream)
    if source is None and (copy := _repaired(file)):
        source, got = _opened(asammdf, copy)
        losses.append(Loss("truncated", "the last block of data is incomplete", file.name))
    if source is None:
        raise LogError(expected="an MDF file with readable channels", got=got, where=file.name)
    start_ns, is_local = _start(source.header)
    if is_local:
        what = "the start is a local time without a time zone, read as UTC"
        losses.append(Loss("no-clock", what, file.name, severity="note"))
    recording = _Recording(file, source, start_ns)
    recording.groups.extend(Group(recording, number) for number in range(len(source.groups)))
    tables: list[Table] = []
    for name, group in zip(unique(group.name for group in recording.groups), recording.groups, strict=True):
        try:
            tables += group.tables(name, losses)
        except Exception as error:  # noqa: BLE001  any error of a damaged block
            what = f"the channel group cannot be read: {describe_damage(error)[1]}"
            losses.append(Loss("bad-group", what, name))
    if not tables:
        got = next((f"{loss.where}: {loss.what}" for loss in losses if loss.kind == "bad-group"), "none with samples")
        raise LogError(expected="a channel group with times", got=got, where=file.name)
    return Tables(f"mdf-{str(source.version)[:1]}", tables, losses)


def _copy(file: TableFile) -> BinaryIO:
    """Return a copy that may be written, without a name."""
    copy = tempfile.TemporaryFile()  # noqa: SIM115  asammdf reads it as long as the log is open
    file.stream.seek(0)
    shutil.copyfileobj(file.stream, copy)
    return copy  # type: ignore[return-value]


def _repaired(file: TableFile) -> BinaryIO | None:
    """Return a version 4 file whose last block of data has the length that is left; None if none is cut."""
    copy = _copy(file)
    copy.seek(0)
    data = copy.read()
    starts = [m.start() for m in _DATA_BLOCK.finditer(data) if m.start() + 16 <= len(data)]
    cut = [start for start in starts if start + int.from_bytes(data[start + 8 : start + 16], "little") > len(data)]
    if not cut:
        return None
    copy.seek(cut[-1] + 8)
    copy.write((len(data) - cut[-1]).to_bytes(8, "little"))
    return copy


def _opened(asammdf: Any, stream: BinaryIO) -> tuple[Any, str]:
    """Return the file, or None and why it cannot be opened."""
    hook, sys.unraisablehook = sys.unraisablehook, lambda _: None  # the end of a half-opened object is an error there
    source, got = None, ""
    try:
        try:
            with redirect_stdout(StringIO()):
                # Bus logging would be converted by asammdf at once.
                source = asammdf.MDF(stream, use_display_names=False, process_bus_logging=False)
        except Exception as error:  # noqa: BLE001  any error of a damaged file
            got = describe_damage(error)[1]
        if source is None:
            gc.collect()
    finally:
        sys.unraisablehook = hook
    return source, got


def _start(header: Any) -> tuple[int, bool]:
    """Return the start of a recording in ns since 1970, 0 without a date, and whether it is a local time.

    The machine's time zone does not matter.
    """
    flags = getattr(header, "time_flags", 0)
    start, is_local = int(getattr(header, "abs_time", 0)), flags == 1
    if flags == 3:
        start -= (header.tz_offset + header.daylight_save_time) * 60 * 10**9
    if not start and hasattr(header, "date"):
        text = b" ".join((header.date, header.time)).decode("latin-1").strip(" \0")
        try:
            date = dt.datetime.strptime(text, "%d:%m:%Y %H:%M:%S").replace(tzinfo=dt.UTC)
        except ValueError:
            return 0, False
        start, is_local = int(date.timestamp()) * 10**9, True
    return (start, is_local) if 0 < start < _LAST_DATE_NS else (0, False)


@dataclass(frozen=True, slots=True, eq=False)
class _Recording:
    """An opened file: asammdf's object, and its groups by number."""

    file: TableFile
    source: Any
    start_ns: int
    groups: list[Group] = field(default_factory=list)


class Group:
    """A channel group of a file. It takes the conversions from asammdf, which would run their formulas."""

    def __init__(self, recording: _Recording, number: int) -> None:
        self._recording, self._number = recording, number
        self._group = recording.source.groups[number]
        self._channels = self._group.channels
        self._version = int(str(recording.source.version)[:1])
        self._conversions = [channel.conversion for channel in self._channels]
        for channel in self._channels:
            channel.conversion = None
        self._last: tuple[str, NDArray[Any]] = "", np.empty(0)

    @property
    def name(self) -> str:
        """Name by its acquisition, comment or source."""
        group = self._group.channel_group
        source = getattr(group, "acq_source", None)
        texts = (getattr(group, "acq_name", ""), getattr(group, "comment", ""), getattr(source, "name", ""))
        plain = (re.sub(r"<[^>]*>|\s+", " ", text or "").strip() for text in texts)
        if self.is_frames:
            return "can"
        return field_name(next((t for t in plain if t and len(t) <= _LONGEST_NAME), f"group {self._number + 1}"))

    @property
    def is_frames(self) -> bool:
        """Return whether it contains raw CAN frames."""
        return any(channel.name == _FRAMES for channel in self._channels)

    def tables(self, name: str, losses: list[Loss]) -> Iterator[Table]:
        """Yield the table of the group, none without samples; channels that cannot be read become losses.

        Raises
        ------
        ValueError : the group has no times, or its layout is damaged.
        """
        group, file = self._group.channel_group, self._recording.file
        if not self._channels or not group.cycles_nr:
            return
        row_bytes = group.samples_byte_nr + getattr(group, "invalidation_bytes_nr", 0)
        file.limits.check_table(group.cycles_nr * (row_bytes + 8), file.size, f"{file.name}, {name}")
        self._check_layout()
        stamps, order = self._stamps(name, losses)
        if self.is_frames:
            yield self._frames(stamps, order).table(name)
            return
        rules: dict[int, Rule] = {}
        texts: list[str] = []
        for i, channel in enumerate(self._channels):
            if channel.data_type not in (_NUMBERS if self._version >= 4 else _NUMBERS_3) or self._is_compound(i):
                texts.append(channel.name)
            elif not self._is_master(i):
                try:
                    rules[i] = conversion_rule(self._conversions[i], self._version)
                except ValueError as error:
                    losses.append(Loss("bad-column", f"{channel.name} cannot be read: {error}", name))
        if texts:
            what = f"no columns of numbers: {', '.join(texts)}"
            losses.append(Loss("bad-column", what, name, count=len(texts), severity="note"))
        titles = unique(field_name(self._channels[i].name) for i in rules)
        fields = tuple(FieldInfo(t, "number", unit=self._unit(i)) for t, i in zip(titles, rules, strict=True))
        yield Table(name, stamps, fields, partial(self._load, dict(zip(titles, rules, strict=True)), order))

    def _check_layout(self) -> None:
        """Raise ValueError for a channel outside of its record: asammdf would read and write memory of others."""
        group = self._group.channel_group
        for channel in self._channels:
            if hasattr(channel, "start_offset"):  # version 3
                start = channel.start_offset + 8 * getattr(channel, "additional_byte_offset", 0)
            else:
                start = 8 * channel.byte_offset + channel.bit_offset
                if channel.flags & _SOME_INVALID and channel.pos_invalidation_bit >= 8 * group.invalidation_bytes_nr:
                    raise ValueError(f"the invalidation bit of channel {channel.name} is outside of its record")
            if start + channel.bit_count > 8 * group.samples_byte_nr:
                raise ValueError(f"channel {channel.name} is outside of its record")

    def _is_compound(self, index: int) -> bool:
        """Return whether a channel is an array, a structure or of variable length."""
        is_variable = self._version >= 4 and self._channels[index].channel_type in (_VARIABLE, 5, 7)
        return is_variable or bool(self._group.channel_dependencies[index])

    def _is_master(self, index: int) -> bool:
        return self._channels[index].channel_type in (_MASTERS if self._version >= 4 else (1,))

    def _is_virtual(self, index: int) -> bool:
        """Return whether the raw values of a channel are the row numbers."""
        channel = self._channels[index]
        return channel.channel_type in _VIRTUAL if self._version >= 4 else channel.bit_count == 0

    def _clock(self) -> int:
        """Return the channel with the times; ValueError if there is none."""
        masters = [i for i in range(len(self._channels)) if self._is_master(i)]
        kinds = [getattr(self._channels[i], "sync_type", 1) for i in masters]
        if (i := next((i for i, kind in zip(masters, kinds, strict=True) if kind not in _NO_TIMES), None)) is not None:
            return i
        raise ValueError(f"its master is {_NO_TIMES[kinds[0]]}, no time" if kinds else "it has no time channel")

    def _seconds(self) -> NDArray[Any]:
        """Return the times from the start of the recording in s [N], which may be those of another group."""
        remote = getattr(self._group.channel_group, "cg_master_index", None)
        if remote is not None and remote != self._number:
            return self._recording.groups[remote]._seconds()
        return self._values(self._clock())

    def _stamps(self, name: str, losses: list[Loss]) -> tuple[IntArray, NDArray[Any] | slice]:
        """Return the times in ascending order, and the rows that they are of; rows without a time are losses."""
        seconds = self._seconds()
        if missing := self._group.channel_group.cycles_nr - len(seconds):
            losses.append(Loss("truncated", f"the file contains {len(seconds)} rows", name, count=missing))
        finite = np.isfinite(seconds) & (np.abs(np.nan_to_num(seconds)) < _LONGEST_S)
        if not finite.all():
            losses.append(Loss("bad-stamp", "row without a time", name, count=int((~finite).sum())))
        stamps = np.round(np.where(finite, seconds, 0.0) * 1e9).astype(np.int64) + self._recording.start_ns
        stamps = np.where(finite, stamps, NO_TIME)
        rows = np.flatnonzero(finite)
        order = rows[np.argsort(stamps[rows], kind="stable")]
        in_order = slice(None) if np.array_equal(order, np.arange(len(stamps))) else order
        return placed(stamps)[in_order], in_order

    def _raw(self, index: int) -> tuple[NDArray[Any], BoolArray | None]:
        """Return raw values [N] or [N, k] of a channel, and which rows are invalid [N]."""
        group, channel = self._group.channel_group, self._channels[index]
        values: NDArray[Any] = np.arange(group.cycles_nr)
        invalid = None
        if not self._is_virtual(index) or getattr(channel, "flags", 0) & _SOME_INVALID:
            with redirect_stdout(StringIO()):  # what asammdf prints of a channel that it cannot read
                read, invalid = self._recording.source.get(
                    group=self._number, index=index, raw=True, samples_only=True, ignore_invalidation_bits=True
                )
            values = values if self._is_virtual(index) else np.asarray(read)
        elif self._version < 4:
            values = values * (channel.sampling_rate or 1.0)
        return values, invalid

    def _values(self, index: int) -> NDArray[Any]:
        """Return physical values [N] of a channel, NaN where they are invalid."""
        raw, invalid = self._raw(index)
        if raw.ndim != 1 or raw.dtype.kind not in "biuf":
            raise ValueError("it contains no numbers")
        values = conversion_rule(self._conversions[index], self._version)(raw)
        if getattr(self._channels[index], "flags", 0) & _ALL_INVALID:
            return np.full(values.shape, np.nan)
        return values if invalid is None else np.where(np.asarray(invalid, np.bool_), np.nan, values)

    def _load(self, indices: Mapping[str, int], order: Any, path: str, rows: slice) -> NDArray[Any]:
        if self._last[0] != path:
            self._last = path, self._values(indices[path])[order]
        return self._last[1][rows]

    def _unit(self, index: int) -> str:
        conversion, channel = self._conversions[index], self._channels[index]
        return str(getattr(conversion, "unit", "") or getattr(channel, "unit", "") or "")

    def _frames(self, stamps: IntArray, order: Any) -> Frames:
        """Return the CAN frames. A virtual channel is used if its conversion makes a constant of the row numbers."""
        ends = {c.name.rpartition(".")[2]: i for i, c in enumerate(self._channels) if c.name.startswith(f"{_FRAMES}.")}
        named = ("ID", "IDE", "BusChannel", "DataLength", "DLC")
        used = {
            n: ends[n] for n in named if n in ends and (not self._is_virtual(ends[n]) or self._conversions[ends[n]])
        }
        parts = {n: np.nan_to_num(self._values(i), nan=-1.0)[order].astype(np.int64) for n, i in used.items()}
        data = self._bytes(ends["DataBytes"])[order]
        number = parts["ID"]
        length = parts.get("DataLength", parts.get("DLC", np.full(len(stamps), data.shape[1])))
        if np.isin(length, _ONLY_CODES).any() or ("DLC" in parts and "DataLength" not in parts):
            length = _LENGTHS[length.clip(0, 15)]
        extended = (number >> 31 & 1 > 0) | ((number & 0x1FFF_FFFF) > 0x7FF) | (parts.get("IDE", number * 0) > 0)
        frames = {"id": number & 0x1FFF_FFFF, "length": length.clip(0, data.shape[1])}
        frames["is_extended"] = extended.astype(np.int64)
        if "BusChannel" in parts:
            frames["bus"] = parts["BusChannel"]
        return Frames(stamps, frames, data)

    def _bytes(self, index: int) -> NDArray[np.uint8]:
        """Return the data of frames [N, k], zero behind the length."""
        channel = self._channels[index]
        is_variable = channel.channel_type == _VARIABLE
        if is_variable:
            channel.channel_type = 0  # its raw values are the places of the data
        raw, _ = self._raw(index)
        if not is_variable:
            return np.asarray(raw, np.uint8).reshape(len(raw), -1)
        stored = np.frombuffer(self._recording.source._mdf._load_signal_data(self._group, index), np.uint8)
        begins = raw.astype(np.int64)
        if begins.min(initial=0) < 0 or begins.max(initial=0) > len(stored) - 4:
            raise ValueError("data of a frame are missing")
        stored = np.pad(stored, (0, int(_LENGTHS[-1])))
        lengths = np.ascontiguousarray(stored[begins[:, np.newaxis] + np.arange(4)]).view("<u4")
        places = np.arange(min(int(lengths.max(initial=0)), int(_LENGTHS[-1])))
        return np.where(places < lengths, stored[begins[:, np.newaxis] + 4 + places], 0).astype(np.uint8)
