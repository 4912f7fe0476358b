"""MDF 3 and 4 (extra ``formats``): each channel group is a topic with its own clock; columns are read when needed.

A group of bus logging becomes a topic ``can`` of raw frames. ``asammdf`` opens the file and returns raw values.
:mod:`~pdhef_logtool.logs.mdf_conversions` converts them.
"""

import datetime as dt
import logging
import re
import struct
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs.can_decoding import BASE_ID_BITS, BYTE_BITS, EXTENDED_FLAG, ID_BITS, Frames
from pdhef_logtool.logs.constants import CONSTANTS, numbered
from pdhef_logtool.logs.container import SpanDamageError, describe_damage
from pdhef_logtool.logs.mdf_conversions import conversion_rule
from pdhef_logtool.logs.message_schema import FieldInfo
from pdhef_logtool.logs.table_clocks import NO_TIME, TIME_UNITS_NS, ascending_rows, placed
from pdhef_logtool.logs.table_columns import field_name, unique
from pdhef_logtool.logs.table_file import NUMBER_BYTES, TableFile, Tables
from pdhef_logtool.logs.table_log import Table
from pdhef_logtool.records.errors import LogError
from pdhef_logtool.records.extras import required
from pdhef_logtool.records.signals import NS_PER_S, BoolArray, FloatArray, IntArray, Loss

_FRAMES = "CAN_DataFrame"
_MDF, _CAN = CONSTANTS["mdf"], CONSTANTS["can"]
#: Bytes of a frame by its data length code.
_LENGTHS = np.array(_CAN["bytes_of_code"])
_DATA_BLOCK = re.compile(rb"##(?:DT|SD|DV)\0{4}")
_LONGEST_NAME = 40
_SIZE = np.dtype("<u4")  # in front of data of variable length
_VARIABLE, _VIRTUAL = _MDF["variable"], _MDF["virtual"]
#: Types of masters by version.
_MASTERS = numbered(_MDF["masters"])
#: Flags of channels and of the start.
_ALL_INVALID, _SOME_INVALID = 1, 2
_LOCAL, _WITH_OFFSETS = 1, 2
#: Quantities of masters other than time, by type of synchronisation.
_NO_TIMES = numbered(_MDF["no_times"])

# Blocks that are surveyed before asammdf opens a file.
#: The start: kind, first digit of the version, and flags of unfinished parts.
_FIRST, _START = 64, struct.Struct("7sxc51x2s")
#: Heads of blocks: kind, and in version 4 the number of links. Link, or length of a block, of version 4.
_HEAD_3, _HEAD, _LINK = struct.Struct("<2s2x"), struct.Struct("<2x2s12xQ"), struct.Struct("<Q")
#: Places of the links that are followed, by kind of block; empty: all links of a list of data.
_FOLLOWED, _FOLLOWED_3 = (
    {kind.encode(): places for kind, places in _MDF[name].items()} for name in ("followed", "followed_3")
)
#: Links that lead to blocks of one kind only.
_CHAINS: Mapping[tuple[bytes, int], bytes] = {
    (b"", 0): b"HD", (b"HD", 0): b"DG", (b"DG", 0): b"DG", (b"DG", 1): b"CG", (b"CG", 0): b"CG", (b"CG", 1): b"CN",
    (b"CN", 0): b"CN",
}  # fmt: skip
_LISTS = frozenset({b"DL", b"LD", b"HL"})


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
    stream: Any = file.stream
    if is_unfinished(file):  # asammdf completes it in place
        losses.append(Loss("truncated", "the recorder has not finished the file", file.name, severity="note"))
        stream = BytesIO(file.stream.read())
    source = _opened(asammdf, stream)
    if isinstance(source, str) and (repaired := _repaired(file)):
        source = _opened(asammdf, repaired)
    if isinstance(source, str):
        raise LogError(expected="an MDF file with readable channels", got=source, where=file.name)
    start_ns, is_local = _start(source.header)
    groups: list[_Group] = []
    groups += [_Group(file, source, number, groups) for number in range(len(source.groups))]
    tables: list[Table] = []
    for group, name in zip(groups, unique(group.name for group in groups), strict=True):
        try:
            tables += group.tables(name, start_ns, losses)
        except Exception as error:  # noqa: BLE001  any error of a damaged block
            what = f"the channel group cannot be read: {describe_damage(error)[1]}"
            losses.append(Loss("bad-group", what, name))
    if not tables:
        got = next((f"{loss.where}: {loss.what}" for loss in losses if loss.kind == "bad-group"), "none with samples")
        raise LogError(expected="a channel group with times", got=got, where=file.name)
    if is_local:
        what = "the start is a local time without a time zone, read as UTC"
        losses.append(Loss("no-clock", what, file.name, severity="note"))
    return Tables(f"mdf-{str(source.version)[:1]}", tables, losses)


def is_unfinished(file: TableFile) -> bool:
    """Return whether the recorder did not complete lengths and links, and leave the stream at its start."""
    file.stream.seek(0)
    kind, version, flags = _START.unpack(file.stream.read(_START.size).ljust(_START.size))
    file.stream.seek(0)
    return version == b"4" and (kind == b"UnFinMF" or any(flags))


def survey_blocks(file: TableFile) -> int:
    """Follow the links of an MDF file and return how many lead beyond its end.

    Raises
    ------
    LogError : links form a circle, or lead to a block of another kind; the file is unfinished and has several lists of
        data, which asammdf does not complete.
    LimitError : more groups, channels or unpacked data than a file of this size may contain.
    """
    stream, limits, unfinished = file.stream, file.limits, is_unfinished(file)
    stream.seek(_FIRST)
    is_old = stream.read(2) == b"HD"
    base, link, followed = (_HEAD_3, struct.Struct("<I"), _FOLLOWED_3) if is_old else (_HEAD, _LINK, _FOLLOWED)
    kinds: Counter[bytes] = Counter()
    seen: set[int] = set()
    unpacked = missing = 0
    pending: list[tuple[int, bytes, int]] = [(_FIRST, b"", 0)]
    while pending:
        address, parent, place = pending.pop()
        if address > file.size - base.size:
            missing += 1
            continue
        stream.seek(address)
        kind, *links_stated = base.unpack(stream.read(base.size))
        if _CHAINS.get((parent, place), kind) != kind:
            raise _damage(f"a block {_CHAINS[parent, place].decode()} at byte {address}", "another one", file)
        if kind == b"DZ":
            unpacked += int.from_bytes(stream.read(2 * _LINK.size)[_LINK.size :], "little")
        if kind not in followed or ((parent, place) == (b"CN", 5) and kind not in _LISTS):
            continue
        if address in seen:
            raise _damage("links that lead to other blocks", f"a circle at byte {address}", file)
        seen.add(address)
        kinds[kind] += 1
        count = sum(links_stated) if kind in _LISTS else 1 + max(followed[kind])
        limits.check("metadata_bytes", _LINK.size * count, file.name)
        data = stream.read(count * link.size)
        links = [target for (target,) in link.iter_unpack(data[: len(data) // link.size * link.size])]
        missing += len(links) < count
        if kind == b"DL" and links[:1] > [0] and unfinished:
            raise _damage("a finished recording", "an unfinished one with several lists of data", file)
        pending += [(links[i], kind, i) for i in followed[kind] or range(len(links)) if i < len(links) and links[i]]
    limits.check("channels", kinds[b"CG"], file.name)
    limits.check("schema_leaves", kinds[b"CN"] / max(1, kinds[b"CG"]), f"{file.name}, channels of a group")
    file.check(unpacked)
    return missing


def _damage(expected: str, got: str, file: TableFile) -> LogError:
    return LogError(
        expected=expected, got=got, where=file.name, remedy="the file is damaged: give the recording itself"
    )


def _repaired(file: TableFile) -> BytesIO | None:
    """Return a copy of a version 4 file with the length of its cut last data block corrected; None without a cut."""
    file.stream.seek(0)
    data = bytearray(file.stream.read())
    blocks = [m.span() for m in _DATA_BLOCK.finditer(data) if m.end() + _LINK.size <= len(data)]
    cut = [(start, place) for start, place in blocks if start + _LINK.unpack_from(data, place)[0] > len(data)]
    if not cut:
        return None
    start, place = cut[-1]
    _LINK.pack_into(data, place, len(data) - start)
    return BytesIO(data)


def _opened(asammdf: Any, stream: Any) -> Any:
    """Return the file, or why it cannot be opened. Bus logging is not processed: asammdf would convert it."""
    try:
        return asammdf.MDF(stream, use_display_names=False, process_bus_logging=False)
    except Exception as error:  # noqa: BLE001  any error of a damaged file
        return describe_damage(error)[1]


def _start(header: Any) -> tuple[int, bool]:
    """Return the start of a recording in ns since 1970, 0 without a date, and whether it is a local time."""
    start, flags = int(getattr(header, "abs_time", 0)), getattr(header, "time_flags", 0)
    if flags == _LOCAL | _WITH_OFFSETS:
        start -= (header.tz_offset + header.daylight_save_time) * TIME_UNITS_NS["minutes"]
    elif not start and hasattr(header, "date"):
        text = b" ".join((header.date, header.time)).decode("latin-1").strip(" \0")
        with suppress(ValueError):
            date = dt.datetime.strptime(f"{text} +0000", "%d:%m:%Y %H:%M:%S %z")
            start, flags = round(date.timestamp()) * NS_PER_S, _LOCAL
    return (start, flags == _LOCAL) if 0 < start < _MDF["last_date_ns"] else (0, False)


class _Group:
    """A channel group of an opened file; its channels are named by their numbers.

    This class removes the conversions from asammdf's channels, because asammdf would run their formulas.

    Parameters
    ----------
    number : of the group among ``groups``, which are all of the file.
    """

    def __init__(self, file: TableFile, source: Any, number: int, groups: "Sequence[_Group]") -> None:
        self._file, self._source, self._number, self._groups = file, source, number, groups
        self._version, self._group = 4 if str(source.version) >= "4" else 3, source.groups[number]
        self._block, self._channels = self._group.channel_group, self._group.channels
        self._conversions = [channel.conversion for channel in self._channels]
        for channel in self._channels:
            channel.conversion = None
        self._contains_frames = any(channel.name == _FRAMES for channel in self._channels)
        self._rows = 0
        self._last: tuple[int, FloatArray] = -1, np.empty(0)

    @property
    def name(self) -> str:
        """Name by the acquisition, comment or source."""
        source = getattr(self._block, "acq_source", None)
        texts = (getattr(self._block, "acq_name", ""), getattr(self._block, "comment", ""), getattr(source, "name", ""))
        plain = (re.sub(r"<[^>]*>|\s+", " ", text or "").strip() for text in texts)
        if self._contains_frames:
            return "can"
        return field_name(next((t for t in plain if t and len(t) <= _LONGEST_NAME), f"group {self._number + 1}"))

    def tables(self, name: str, start_ns: int, losses: list[Loss]) -> Iterator[Table]:
        """Yield the table of a group, none without samples; channels that cannot be read become losses.

        Raises
        ------
        SpanDamageError : the group has no times, or its layout is damaged.
        """
        group, file = self._block, self._file
        if not self._channels or not group.cycles_nr:
            return
        row_bytes = group.samples_byte_nr + getattr(group, "invalidation_bytes_nr", 0) + NUMBER_BYTES
        file.check(group.cycles_nr * row_bytes, f"{file.name}, {name}")
        self._check_layout()
        stamps, rows = self._stamps(name, start_ns, losses)
        if self._contains_frames:
            yield self._frames(stamps, rows).table(name)
            return
        indices, texts = [], []
        for i, channel in enumerate(self._channels):
            is_compound = self._group.channel_dependencies[i] or self._is(i, _VARIABLE)
            if is_compound or channel.dtype_fmt.kind not in "iuf":
                texts.append(channel.name)
            elif channel.channel_type not in _MASTERS[self._version]:
                try:
                    conversion_rule(self._conversions[i], self._version)
                    indices.append(i)
                except ValueError as error:
                    losses.append(Loss("bad-column", f"{channel.name} cannot be read: {error}", name))
        if texts:
            what = f"no columns of numbers: {', '.join(texts)}"
            losses.append(Loss("bad-column", what, name, count=len(texts), severity="note"))
        titles = dict(zip(unique(field_name(self._channels[i].name) for i in indices), indices, strict=True))
        fields = tuple(FieldInfo(title, "number", unit=self._unit(i)) for title, i in titles.items())
        yield Table(name, stamps, fields, partial(self._load, titles, rows))

    def _unit(self, index: int) -> str:
        of_conversion = getattr(self._conversions[index], "unit", "")
        return of_conversion or getattr(self._channels[index], "unit", "")

    def _is(self, index: int, types: tuple[int, ...]) -> bool:
        """Return whether a channel is of one of these types of MDF 4."""
        return self._version == 4 and self._channels[index].channel_type in types

    def _check_layout(self) -> None:
        """Raise SpanDamageError for a channel outside of its record: asammdf would read and write memory of others."""
        group = self._block
        invalidation_bits = BYTE_BITS * getattr(group, "invalidation_bytes_nr", 0)
        for i, channel in enumerate(self._channels):
            end, last_bit = channel.bit_count, -1
            if self._version == 3:
                end += channel.start_offset + BYTE_BITS * getattr(channel, "additional_byte_offset", 0)
            else:
                end += BYTE_BITS * channel.byte_offset + channel.bit_offset if not self._is(i, _VIRTUAL) else -end
                last_bit = channel.pos_invalidation_bit if channel.flags & _SOME_INVALID else -1
            if end > BYTE_BITS * group.samples_byte_nr or last_bit >= invalidation_bits:
                raise SpanDamageError(f"channel {channel.name} is outside of its record")

    def _seconds(self) -> FloatArray:
        """Return the times of a group from the start of the recording in s [N]; SpanDamageError without times."""
        remote = getattr(self._block, "cg_master_index", None)
        group = self if remote is None else self._groups[remote]
        masters = [
            (getattr(channel, "sync_type", 1), i)
            for i, channel in enumerate(group._channels)
            if channel.channel_type in _MASTERS[self._version]
        ]
        kind, index = min(masters, default=(0, None))
        if index is None or kind in _NO_TIMES:
            raise SpanDamageError(f"its master is {_NO_TIMES[kind]}, no time" if masters else "it has no time channel")
        return group._values(index)

    def _stamps(self, name: str, start_ns: int, losses: list[Loss]) -> tuple[IntArray, NDArray[Any]]:
        """Return the ascending times of a group, and their rows; other rows are losses."""
        seconds = self._seconds()
        self._rows = len(seconds)
        if missing := self._block.cycles_nr - len(seconds):
            losses.append(Loss("truncated", f"the file ends after {len(seconds)} rows", name, count=missing))
        finite = np.abs(seconds) < _MDF["longest_s"]
        stamps = np.round(np.where(finite, seconds, 0.0) * NS_PER_S).astype(np.int64) + start_ns
        stamps = placed(np.where(finite, stamps, NO_TIME))
        # Frames of several buses are buffered before they are written; rows of channels are in order.
        order = np.argsort(stamps, kind="stable") if self._contains_frames else np.arange(len(stamps))
        rows, left_out = ascending_rows(stamps[order], name)
        losses += left_out
        return stamps[order[rows]], order[rows]

    def _raw(self, index: int) -> tuple[NDArray[Any], BoolArray | None]:
        """Return raw values [N] or [N, k] of a channel, and which rows are invalid [N]."""
        channel, rows = self._channels[index], np.arange(self._block.cycles_nr)
        is_virtual = self._is(index, _VIRTUAL)
        if not channel.bit_count and self._version == 3:
            return rows * (channel.sampling_rate or 1.0), None
        if is_virtual and not channel.flags & _SOME_INVALID:
            return rows, None
        values, invalid = self._source.get(
            group=self._number, index=index, raw=True, samples_only=True, ignore_invalidation_bits=True
        )
        return rows if is_virtual else np.asarray(values), invalid

    def _values(self, index: int) -> FloatArray:
        """Return physical values [N] of a channel, NaN for invalid samples."""
        raw, invalid = self._raw(index)
        if raw.ndim != 1 or raw.dtype.kind not in "biuf":
            raise SpanDamageError("it contains no numbers")
        values = conversion_rule(self._conversions[index], self._version)(raw)
        if getattr(self._channels[index], "flags", 0) & _ALL_INVALID:
            values[:] = np.nan
        elif invalid is not None:
            values[np.asarray(invalid, np.bool_)] = np.nan
        return values

    def _load(self, indices: Mapping[str, int], order: Any, path: str, rows: slice) -> FloatArray:
        if self._last[0] != indices[path]:
            values = self._values(indices[path])
            if len(values) != self._rows:
                raise SpanDamageError(f"{len(values)} values for {self._rows} times")
            self._last = indices[path], values[order]
        return self._last[1][rows]

    def _frames(self, stamps: IntArray, rows: Any) -> Frames:
        """Return the CAN frames of a group, without the row numbers of a virtual channel."""
        names = [channel.name.removeprefix(f"{_FRAMES}.") for channel in self._channels]
        parts = {
            name: np.nan_to_num(self._values(i), nan=-1.0)[rows].astype(np.int64)
            for i, name in enumerate(names)
            if name in ("ID", "IDE", "BusChannel", "DataLength", "DLC")
            and (self._conversions[i] or not self._is(i, _VIRTUAL))
        }
        data = self._bytes(names.index("DataBytes"))[rows]
        identifier = parts["ID"] & ID_BITS
        length = parts.get("DataLength", parts.get("DLC", np.full(len(stamps), data.shape[1])))
        if np.isin(length, _CAN["only_codes"]).any() or ("DLC" in parts and "DataLength" not in parts):
            length = _LENGTHS[length.clip(0, len(_LENGTHS) - 1)]
        is_flagged = ((parts["ID"] & EXTENDED_FLAG) > 0) | (parts.get("IDE", np.zeros(1)) > 0)
        extended = is_flagged | (identifier > BASE_ID_BITS)
        frames = {"id": identifier, "length": length.clip(0, data.shape[1]), "is_extended": extended}
        return Frames(stamps, frames | ({"bus": parts["BusChannel"]} if "BusChannel" in parts else {}), data)

    def _bytes(self, index: int) -> NDArray[np.uint8]:
        """Return the data of frames [N, k], zero behind the length."""
        is_variable = self._is(index, _VARIABLE[:1])
        if is_variable:
            self._channels[index].channel_type = 0  # its raw values are the places of the data
        raw, _ = self._raw(index)
        if not is_variable:
            return np.asarray(raw, np.uint8).reshape(len(raw), -1)
        stored = np.frombuffer(self._source._mdf._load_signal_data(self._group, index), np.uint8)
        begins = raw.astype(np.int64)
        if begins.min(initial=0) < 0 or begins.max(initial=0) > len(stored) - _SIZE.itemsize:
            raise SpanDamageError("data of a frame are missing")
        most, head = _LENGTHS[-1], _SIZE.itemsize
        frames = np.lib.stride_tricks.sliding_window_view(np.pad(stored, (0, most)), head + most)[begins]
        lengths = frames[:, :head].copy().view(_SIZE)
        data = frames[:, head : head + min(lengths.max(initial=0), most)]
        return np.where(np.arange(data.shape[1]) < lengths, data, np.uint8(0))
