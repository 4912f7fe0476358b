"""Logs of raw CAN frames, BLF, ASC and candump: a topic ``can`` that a DBC decodes.

BLF and ASC state the local time of the recorder without its zone; it is read as UTC.
"""

import datetime as dt
import re
import struct
import zlib
from array import array
from collections.abc import Callable, Mapping
from functools import partial
from mmap import ACCESS_READ, mmap
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs.can_decoding import EXTENDED_FLAG, ID_BITS, Frames
from pdhef_logtool.logs.constants import CONSTANTS, numbered
from pdhef_logtool.logs.container import LOSSES_OF_A_KIND, describe_damage
from pdhef_logtool.logs.table_clocks import ascending_rows, placed, text_clock, to_ns
from pdhef_logtool.logs.table_file import TableFile, Tables
from pdhef_logtool.records.errors import LogError
from pdhef_logtool.records.signals import NS_PER_S, IntArray, Loss, is_dated

_PARTS = ("id", "length", "is_extended", "bus", "is_error", "is_remote")
_ROW = struct.Struct(f"{len(_PARTS)}i")
#: Bytes of the numbers of a frame: its time and parts.
_ROW_BYTES = np.dtype([("stamp", np.int64), ("parts", np.int32, len(_PARTS))]).itemsize
#: Maximum data length of CAN FD.
_MOST_BYTES = CONSTANTS["can"]["bytes_of_code"][-1]


def _tables(
    kind: str, file: TableFile, stamps: IntArray, numbers: NDArray[np.int32], data: NDArray[np.uint8], lost: list[Loss]
) -> Tables:
    """Build the topic ``can`` from times [N], numbers [N, 6] and the concatenated data of the frames."""
    if not len(stamps):
        got = f"none that can be read{''.join(f'; {loss.what}' for loss in lost[:1])}"
        remedy = "candump -l and candump -t a record times" * (kind == "candump")
        raise LogError(expected="CAN frames with times", got=got, where=file.name, remedy=remedy)
    widest = max(1, int(numbers[:, 1].max()))
    file.check(len(stamps) * (_ROW_BYTES + widest), f"{len(stamps)} frames")
    rows = np.zeros((len(stamps), widest), np.uint8)
    rows[np.arange(widest) < numbers[:, 1:2]] = data
    order = np.argsort(stamps, kind="stable")
    parts = dict(zip(_PARTS, numbers[order].T, strict=True))
    return Tables(kind, [Frames(placed(stamps)[order], parts, rows[order]).table("can")], lost)


def _start_ns(year: int, month: int, day: int, hour: int, minute: int, second: int, micro: int) -> int:
    """Return a date and time in ns since 1970; 0 for an invalid date or one of another century."""
    try:
        seconds = dt.datetime(year, month, day, hour, minute, second, micro, dt.UTC).timestamp()
    except ValueError:
        return 0
    return int(to_ns(seconds)) if 0.0 < seconds < CONSTANTS["can"]["last_date_s"] else 0


# BLF: objects "LOBJ", most of them in compressed containers. An object may continue in the next container.
_SIGNATURE = b"LOBJ"
_BLF = CONSTANTS["blf"]
_CONTAINER, _CONTAINER_HEAD = _BLF["container"], _BLF["container_head"]
_HEAD, _PADDING, _LONGEST = _BLF["head"], _BLF["padding"], _BLF["longest"]
_FILE_HEAD = struct.Struct("<4xI8xQ16x8H")
_OBJECT_HEAD = struct.Struct("<4xHHII")


def _layout(parts: Mapping[str, tuple[str, int]]) -> np.dtype[np.void]:
    formats, offsets = zip(*parts.values(), strict=True)
    return np.dtype({"names": [*parts], "formats": [*formats], "offsets": [*offsets]})


_LAYOUTS = {name: _layout(parts) for name, parts in _BLF["layouts"].items()}
_TIME = _LAYOUTS["time"]
#: Kinds of frames: name of the layout, minimum and maximum bytes of it, flag of a remote frame.
_FRAMES: dict[int, tuple[str, int, int, int]] = numbered(_BLF["frames"])


def open_blf(file: TableFile) -> Tables:
    """Read a BLF file; raises LogError if it has no frames."""
    if file.size < _FILE_HEAD.size:
        raise LogError(expected="a BLF file", got=f"{file.size} bytes", where=file.name)
    return _Blf(file, mmap(file.stream.fileno(), 0, access=ACCESS_READ)).tables()


class _Blf:
    """Reader of a BLF file. Behind damage, it continues at the next signature."""

    def __init__(self, file: TableFile, data: mmap) -> None:
        self._file, self._data = file, data
        self._head, self._stated, year, month, _, day, hour, minute, second, ms = _FILE_HEAD.unpack_from(data)
        self._start_ns = _start_ns(year, month, day, hour, minute, second, 1000 * ms)
        self._losses: list[Loss] = []
        self._blocks: list[tuple[IntArray, NDArray[np.int32], NDArray[np.uint8]]] = []
        # Bytes of an object that continues in the next container; None behind a lost container.
        self._tail: bytes | None = b""
        self._unpacked = 0

    def tables(self) -> Tables:
        """Read the file."""
        data, size = self._data, self._file.size
        objects, rest = self._objects(data, min(self._head, max(data.find(_SIGNATURE), 0)), "the file", final=True)
        is_cut = self._stated > size or size - rest > _PADDING
        if is_cut:
            what = f"the file ends after {size} of {max(self._stated, size + 1)} bytes"
            self._losses.append(Loss("truncated", what, self._file.name))
        if size - rest > _CONTAINER_HEAD and _OBJECT_HEAD.unpack_from(data, rest)[3] == _CONTAINER:
            objects.append((rest, _HEAD, size - rest, _CONTAINER))
        self._decode(data, objects)
        for start, _, length, kind in objects:
            if kind == _CONTAINER:
                self._read_container(start, start + length, f"the container at byte {start}")
        self._feed(b"", "the last container", final=True)
        if len(self._tail or b"") > _PADDING and not is_cut:
            self._lose("truncated", "the last object is incomplete")
        self._blocks.append((np.empty(0, np.int64), np.empty((0, len(_PARTS)), np.int32), np.empty(0, np.uint8)))
        stamps, numbers, content = (np.concatenate(parts) for parts in zip(*self._blocks, strict=True))
        return _tables("blf", self._file, stamps, numbers, content, self._losses)

    def _lose(self, kind: str, what: str) -> None:
        """Add a loss; the last one counts all losses beyond the limit."""
        count = (self._losses.pop().count or 1) + 1 if len(self._losses) > LOSSES_OF_A_KIND else None
        self._losses.append(Loss(kind, what, self._file.name, count=count))

    def _read_container(self, start: int, end: int, place: str) -> None:
        """Read a container; a damaged or too large one is a loss."""
        method, size = struct.unpack_from("<H6xI", self._data, start + _HEAD)
        stored = self._data[start + _CONTAINER_HEAD : end]
        try:
            self._file.limits.check_unpacked(size, len(stored), place)
            self._file.check(self._unpacked + size, f"{place} and those before it")
            block = _unpacked(stored, size, is_cut=end == self._file.size) if method else stored
        except (ValueError, LogError, zlib.error) as error:
            kind, text = describe_damage(error)
            self._feed(b"", place, final=True)
            self._tail = None
            self._lose(kind, f"{place} is lost: {text}")
        else:
            self._unpacked += len(block)
            self._feed(block, place)

    def _feed(self, block: bytes, place: str, *, final: bool = False) -> None:
        """Read the objects of a container. An incomplete object is kept for the next container."""
        data = (self._tail or b"") + block
        first = max(0, data.find(_SIGNATURE)) if self._tail is None else 0
        objects, rest = self._objects(data, first, place, final=final)
        self._decode(data, objects)
        self._tail = data[rest:]

    def _objects(
        self, data: bytes | mmap, position: int, place: str, *, final: bool
    ) -> tuple[list[tuple[int, int, int, int]], int]:
        """Return the valid objects from a position on, and the position of an incomplete object at the end.

        With ``final`` no data follow: an incomplete object is damaged if another signature follows it.
        """
        objects: list[tuple[int, int, int, int]] = []
        size, search, checked = len(data), position, -1
        while (start := data.find(_SIGNATURE, search)) >= 0 and start + _HEAD <= size:
            head, version, length, kind = _OBJECT_HEAD.unpack_from(data, start)
            sound = _is_sound(head, version, length, kind)
            if sound and start + length > size and (not final or data.find(_SIGNATURE, start + _HEAD) < 0):
                break
            if not sound or start + length > size:
                search = start + len(_SIGNATURE)
                continue
            if start - position > _PADDING:
                last, *_, other = objects[-1] if objects else (-1, _CONTAINER)
                if last > checked and other not in _FRAMES and data.find(_SIGNATURE, last + _HEAD, position) >= 0:
                    position = checked = last  # its length is wrong: it covers others
                    search = objects.pop()[0] + _HEAD
                    continue
                self._lose("bad-chunk", f"{start - position} bytes of {place} are damaged, from byte {position}")
            objects.append((start, head, length, kind))
            position = search = start + length
        rest = start if start >= 0 else max(position, size - len(_SIGNATURE) + 1)
        if rest - position > _PADDING:
            self._lose("bad-chunk", f"{rest - position} bytes of {place} are damaged, from byte {position}")
        return objects, rest

    def _decode(self, data: bytes | mmap, objects: list[tuple[int, int, int, int]]) -> None:
        """Add the frames among objects."""
        for kind, (name, fewest, _, remote) in _FRAMES.items():
            layout = _LAYOUTS[name]
            chosen = np.array([o[:3] for o in objects if o[3] == kind], np.int64)
            if not len(chosen):
                continue
            raw, (start, head, length) = np.frombuffer(data, np.uint8), chosen.T[:, :, np.newaxis]
            times = raw[start + np.arange(_TIME.itemsize)].view(_TIME)[:, 0]
            places = np.minimum(start + head + np.arange(layout.itemsize), len(raw) - 1)
            part = raw[places].view(layout)[:, 0]
            content = part["data"]
            if "extension" in part.dtype.names:  # variable length; other data can follow
                end = np.where(part["extension"] > 0, part["extension"], length[:, 0])[:, np.newaxis]
                content = np.where(np.arange(_MOST_BYTES) < end - head - fewest, content, 0)
            is_remote = (part["flags"] & remote) > 0
            count = np.where(is_remote, 0, np.minimum(part["length"], content.shape[1]))
            number, bus = part["id"].astype(np.int64), part["bus"].astype(np.int64) - 1
            is_error = np.full(len(number), name == "error")
            is_extended = (number & EXTENDED_FLAG) > 0
            numbers = np.stack((number & ID_BITS, count, is_extended, bus, is_error, is_remote), axis=1)
            unit = np.where(times["unit"] == 1, _BLF["time_unit_ns"], 1)
            most = np.iinfo(np.int64).max // 2 // unit  # no sum overflows
            stamps = self._start_ns + np.clip(times["time"], -most, most) * unit
            there = np.arange(content.shape[1]) < count[:, np.newaxis]
            self._blocks.append((stamps, numbers.astype(np.int32), content[there].astype(np.uint8)))


def _is_sound(head: int, version: int, length: int, kind: int) -> bool:
    """Return whether an object may have this header, length and kind."""
    if kind not in _FRAMES:
        return bool(length >= _CONTAINER_HEAD if kind == _CONTAINER else _HEAD <= length <= _LONGEST)
    _, fewest, most, _ = _FRAMES[kind]
    return version in (1, 2) and _TIME.itemsize <= head and fewest <= length - head < most


def _unpacked(stored: bytes, size: int, *, is_cut: bool) -> bytes:
    """Decompress a container; of a truncated one (``is_cut``), its beginning."""
    inflater = zlib.decompressobj()
    block = inflater.decompress(stored, size + 1)
    if len(block) > size or not (inflater.eof or is_cut):
        raise ValueError(f"its contents are not the stated {size} bytes")
    return block


# ASC: a line for each event, with its time in s.
_BASE = re.compile(r"\s*base\s+(hex|dec)(?:\s+timestamps\s+(absolute|relative))?", re.I)
_BEGIN = re.compile(r"\s*(?:date|begin\s+triggerblock)\b\s*(.*)", re.I)
_MILLISECONDS = re.compile(r"(?<=:\d\d\.)\d{1,2}(?!\d)")
_EVENT = re.compile(rb"\s*(\d{1,9}(?:\.\d{1,12})?)\s+(.*)", re.S)
#: Bus, then an error frame, or identifier, remote frame, length and data.
_CLASSIC = re.compile(
    rb"(\d+)\s+(?:(errorframe)|([\da-f]+)(x?)\s+[rt]x\s+(?:(r)\b|d\s+([\da-f]+)(?:\s+(.*)|$)))", re.I | re.S
)
_FD_FRAME = re.compile(
    rb"canfd\s+(\d+)\s+[rt]x\s+(?:(errorframe)|([\da-f]+)(x?)\s+(?:\S+\s+)??[01]\s+[01]\s+[\da-f]+()\s+(\d+)(?:\s+(.*)|$))",
    re.I | re.S,
)
_FRAME_SHAPE = re.compile(rb"\d+\s+(?:\S+\s+[rt]x\s|errorframe)|canfd\s", re.I)
#: A step back in time by more begins a measurement.
_STEP_NS = NS_PER_S
#: Bases of numbers.
_HEX, _DECIMAL = 16, 10


#: A frame: time in ns, data, and the numbers of ``_PARTS``.
_Frame: TypeAlias = tuple[int, bytes, tuple[int, ...]]


class _TextLog:
    """The frames of a log with one frame per line.

    ``read`` returns None for a line without a frame, and raises ValueError for a frame that cannot be read.
    """

    def __init__(self, file: TableFile, read: Callable[[bytes], _Frame | None]) -> None:
        self.file, stamps, numbers, data = file, array("q"), bytearray(), bytearray()
        self.losses: list[Loss] = []
        unreadable = array("q")
        first = ""
        for number, line in enumerate(file.stream, 1):
            try:
                if (frame := read(line)) is None:
                    continue
                stamp_ns, content, parts = frame
                row = _ROW.pack(*parts)
                stamps.append(stamp_ns)
            except (ValueError, OverflowError, struct.error):
                first = first or f"line {number}, {line[:60].decode('ascii', 'replace').strip()!r}"
                unreadable.append(number)
            else:
                numbers += row
                data += content
        if unreadable:
            what = f"{len(unreadable)} lines of frames cannot be read, the first: {first}"
            self.losses.append(Loss("bad-row", what, file.name, count=len(unreadable)))
        self.stamps = np.frombuffer(stamps, np.int64)
        self.numbers = np.frombuffer(numbers, np.int32).reshape(-1, len(_PARTS))
        self._data = np.frombuffer(data, np.uint8)

    def tables(self, kind: str) -> Tables:
        """Return the frames, without those of times that were recorded before."""
        # Buses are written with small delays; after a larger step back, times that were recorded before are left out.
        latest = np.maximum.accumulate(self.stamps)
        in_order = np.where(latest - self.stamps < _STEP_NS, latest, self.stamps)
        rows, lost = ascending_rows(in_order, self.file.name)
        used = np.isin(np.arange(len(in_order)), rows)
        data = self._data[np.repeat(used, self.numbers[:, 1])]
        losses = [*self.losses, *lost]
        return _tables(kind, self.file, self.stamps[used], self.numbers[used], data, losses)


def open_asc(file: TableFile) -> Tables:
    """Read an ASC file; raises LogError if it has no frames."""
    return _TextLog(file, _Asc().read).tables("asc")


class _Asc:
    """Reader of the lines of an ASC file."""

    def __init__(self) -> None:
        self._base, self._is_relative, self._is_empty = _HEX, False, True
        self._begins_ns: int | None = None
        self._start_ns = self._now_ns = 0

    def _read_head(self, line: str) -> None:
        """Read a line without a time. A date begins a measurement."""
        if match := _BASE.match(line):
            self._base = _HEX if match[1].lower() == "hex" else _DECIMAL
            self._is_relative = (match[2] or "").lower() == "relative"
        elif begin := _BEGIN.match(line):
            self._begins_ns = _date_ns(begin[1]) or self._begins_ns or 0

    def read(self, line: bytes) -> _Frame | None:
        """Read a line."""
        event = _EVENT.match(line)
        if event is None:
            self._read_head(line.decode("ascii", "ignore"))
            return None
        time_ns, text = round(float(event[1]) * NS_PER_S), event[2].rstrip()
        if self._begins_ns is None and not self._is_relative and time_ns < self._now_ns - _STEP_NS:
            self._begins_ns = 0
        if self._begins_ns is not None:
            self._begin(self._begins_ns, time_ns)
        self._now_ns = self._now_ns + time_ns if self._is_relative else time_ns
        match = _CLASSIC.match(text) or _FD_FRAME.match(text)
        if match is None:
            if _FRAME_SHAPE.match(text):
                raise ValueError(text)
            return None
        bus, is_error, identifier, extended, remote, length, content = match.groups()
        base, most = (self._base, 8) if match.re is _CLASSIC else (_DECIMAL, _MOST_BYTES)
        count = min(int(length or b"0", base), most)
        data = bytes([int(byte, self._base) for byte in (content or b"").split(None, count)[:count]])
        number = int(identifier or b"0", self._base)
        if len(data) < count or number > ID_BITS:
            raise ValueError(text)
        self._is_empty = False
        parts = number, count, bool(extended), int(bus) - 1, bool(is_error), bool(remote)
        return self._start_ns + self._now_ns, data, parts

    def _begin(self, begins_ns: int, time_ns: int) -> None:
        """Begin a measurement with its first event. If the times continue, they have the same origin as before."""
        self._begins_ns = None
        goes_on = not begins_ns if self._is_relative else time_ns >= self._now_ns
        if self._is_empty or not goes_on:
            self._start_ns, self._now_ns = begins_ns, 0


def _date_ns(text: str) -> int:
    """Return a date and time behind a weekday in ns since 1970; 0 for another text.

    python-can does not pad milliseconds.
    """
    from polars import Series

    padded = _MILLISECONDS.sub(lambda digits: digits[0].zfill(3), " ".join(text.split()[1:]).replace(". ", " "))
    (stamp,) = text_clock(Series([padded])).stamps_ns.tolist()
    return stamp if is_dated(stamp) else 0


# candump: ``(1609459200.123456) can0 123#DEADBEEF`` of -l, ``(...)  can0  123   [4]  DE AD BE EF`` of -t.
_CANDUMP = re.compile(
    rb"\s*\((\d{1,10}\.\d{1,9}|\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\.\d{1,9})\)\s+(\S+)\s+(?:[rt]x\s+\S+\s+\S+\s+)?"
    rb"([\da-f]{3}|[\da-f]{8})(?:#(?:#[\da-f])?(r)?([\da-f.]*)|\s+\[(\d+)\]\s*(r)?((?:\s*[\da-f]{2}\b)*))(?![^\s_'e])",
    re.I,
)
_ERROR_FLAG, _DIFFERENCES = CONSTANTS["candump"]["error_flag"], CONSTANTS["candump"]["differences"]


def open_candump(file: TableFile) -> Tables:
    """Read a log of ``candump`` (can-utils); raises LogError if it has no frames with times."""
    interfaces: dict[bytes, int] = {}
    log = _TextLog(file, partial(_candump_frame, interfaces=interfaces))
    if len(log.stamps) and np.mean(np.diff(log.stamps, prepend=log.stamps[0]) < 0) >= _DIFFERENCES:
        what = "times are differences between frames, and are summed"
        log.losses.append(Loss("clock", what, file.name, severity="note"))
        log.stamps = np.cumsum(log.stamps)
    # The number at the end of each interface, or its place among all if two have the same.
    buses = [int(end[0]) if (end := re.findall(rb"\d{1,4}$", name)) else -1 for name in interfaces]
    if len(set(buses)) < len(buses):
        buses = [sorted(interfaces).index(name) for name in interfaces]
    bus = _PARTS.index("bus")
    log.numbers[:, bus] = np.array(buses, np.int32)[log.numbers[:, bus]]
    return log.tables("candump")


def _candump_frame(line: bytes, interfaces: dict[bytes, int]) -> _Frame | None:
    match = _CANDUMP.match(line)
    if match is None:
        if line.strip():
            raise ValueError(line)
        return None
    time, interface, identifier, remote, data, count, remote_too, listed = match.groups()
    whole, _, fraction = time.partition(b".")
    stamp_ns = int(whole) * NS_PER_S if whole.isdigit() else int(np.datetime64(whole.decode(), "ns").astype(np.int64))
    is_remote = bool(remote or remote_too)
    content = b"" if is_remote else bytes.fromhex((listed if data is None else data.replace(b".", b"")).decode())
    number, bus = int(identifier, _HEX), interfaces.setdefault(interface, len(interfaces))
    is_error, number = bool(number & _ERROR_FLAG), number & ~_ERROR_FLAG
    if len(content) > _MOST_BYTES or (count and not is_remote and len(content) != int(count)) or number > ID_BITS:
        raise ValueError(line)
    parts = number, len(content), len(identifier) > 3, bus, is_error, is_remote
    return stamp_ns + int(fraction.ljust(9, b"0")), content, parts
