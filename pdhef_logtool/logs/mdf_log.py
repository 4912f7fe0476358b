"""MDF 3 and 4 (extra ``formats``): each channel group is a topic with its own clock; columns are read when needed.

A group of bus logging becomes a topic ``can`` of raw frames.
"""

from __future__ import annotations

import gc
import logging
import re
import sys
from collections.abc import Iterator
from contextlib import redirect_stdout, suppress
from functools import partial
from io import BytesIO, StringIO
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs.can_decoding import Frames
from pdhef_logtool.logs.container import describe_damage
from pdhef_logtool.logs.message_schema import FieldInfo
from pdhef_logtool.logs.table_clocks import NO_TIME, placed
from pdhef_logtool.logs.table_columns import field_name, unique
from pdhef_logtool.logs.table_file import TableFile, Tables
from pdhef_logtool.logs.table_log import Table
from pdhef_logtool.records.errors import LogError
from pdhef_logtool.records.extras import required
from pdhef_logtool.records.signals import IntArray, Loss

_FRAMES = "CAN_DataFrame"
#: Parts of a frame by the names of the standard for bus logging.
_PARTS = {"id": "ID", "length": "DataLength", "is_extended": "IDE", "bus": "BusChannel"}
_DATA_BLOCK = re.compile(rb"##(?:DT|SD|DV)\0{4}")
_LONGEST_NAME = 40
#: Times from the start of a recording beyond this are damaged.
_LONGEST_S = 4e9


def open_mdf(file: TableFile) -> Tables:
    """Read an MDF file; groups and channels that cannot be read are losses."""
    asammdf = required("asammdf", "formats", "reads MDF files", file.name)
    logging.getLogger("asammdf").setLevel(logging.CRITICAL)
    losses: list[Loss] = []
    source, got = _opened(asammdf, file.stream)
    if source is None and (copy := _repaired(file)):
        source, got = _opened(asammdf, copy)
        losses.append(Loss("truncated", "the last block of data is incomplete", file.name))
    if source is None:
        raise LogError(expected="an MDF file with readable channels", got=got, where=file.name)
    groups = [Group(source, number) for number in range(len(source.groups))]
    names = unique(group.name for group in groups)
    tables: list[Table] = []
    for name, group in zip(names, groups, strict=True):
        try:
            with redirect_stdout(StringIO()):
                tables += group.tables(name)
        except Exception as error:  # noqa: BLE001  any error of a damaged block
            what = f"the channel group cannot be read: {describe_damage(error)[1]}"
            losses.append(Loss("bad-group", what, name))
    if not tables:
        raise LogError(expected="a channel group with times", got="none that can be read", where=file.name)
    return Tables(f"mdf-{str(source.version)[:1]}", tables, losses)


def _repaired(file: TableFile) -> BytesIO | None:
    """Return a version 4 file whose last block of data has the length that is left; None if none is cut."""
    file.stream.seek(0)
    data = bytearray(file.stream.read())
    starts = [m.start() for m in _DATA_BLOCK.finditer(data) if m.start() + 16 <= len(data)]
    cut = [start for start in starts if start + int.from_bytes(data[start + 8 : start + 16], "little") > len(data)]
    if not cut:
        return None
    data[cut[-1] + 8 : cut[-1] + 16] = (len(data) - cut[-1]).to_bytes(8, "little")
    return BytesIO(data)


def _opened(asammdf: Any, stream: BinaryIO) -> tuple[Any, str]:
    """Return the file, or None and why it cannot be opened."""
    hook, sys.unraisablehook = sys.unraisablehook, lambda _: None  # the end of a half-opened object is an error there
    source, got = None, ""
    try:
        try:
            source = asammdf.MDF(stream, use_display_names=False)
        except Exception as error:  # noqa: BLE001  any error of a damaged file
            got = describe_damage(error)[1]
        if source is None:
            gc.collect()
    finally:
        sys.unraisablehook = hook
    return source, got


class Group:
    """A channel group of a file."""

    def __init__(self, source: Any, number: int) -> None:
        self._source, self._number = source, number
        self._group = source.groups[number]
        self._columns: dict[str, NDArray[Any]] = {}

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
        return any(channel.name == _FRAMES for channel in self._group.channels)

    def tables(self, name: str) -> Iterator[Table]:
        """Yield the table of the group, none without samples or times."""
        master = self._source.masters_db.get(self._number)
        if master is None or not self._group.channel_group.cycles_nr:
            return
        self._check_layout()
        stamps, order = self._stamps()
        if self.is_frames:
            parts = {part: self._frames(end)[order].astype(np.int64) for part, end in _PARTS.items() if self._has(end)}
            data = np.atleast_2d(self._frames("DataBytes"))[order].astype(np.uint8)
            parts.setdefault("length", np.full(len(stamps), data.shape[1]))
            yield Frames(stamps, parts, data).table(name)
            return
        indices = [i for i in range(len(self._group.channels)) if i != master]
        titles = unique(field_name(self._group.channels[i].name) for i in indices)
        fields = tuple(FieldInfo(t, "number", unit=self._unit(i)) for t, i in zip(titles, indices, strict=True))
        yield Table(name, stamps, fields, partial(self._load, dict(zip(titles, indices, strict=True)), order))

    def _check_layout(self) -> None:
        """Raise ValueError for a channel outside of its record: asammdf would read and write memory of others."""
        for channel in self._group.channels:
            if hasattr(channel, "start_offset"):  # version 3
                start = channel.start_offset + 8 * getattr(channel, "additional_byte_offset", 0)
            else:
                start = 8 * channel.byte_offset + channel.bit_offset
            if start + channel.bit_count > 8 * self._group.channel_group.samples_byte_nr:
                raise ValueError(f"channel {channel.name} is outside of its record")

    def _stamps(self) -> tuple[IntArray, NDArray[Any]]:
        """Return the times in ascending order, and the rows that they are of; rows without a time are left out."""
        seconds = np.asarray(self._source.get_master(self._number), np.float64)
        start_ns = round(self._source.start_time.timestamp() * 1e6) * 1000
        finite = np.isfinite(seconds) & (np.abs(np.nan_to_num(seconds)) < _LONGEST_S)
        stamps = np.where(finite, np.round(np.where(finite, seconds, 0.0) * 1e9).astype(np.int64) + start_ns, NO_TIME)
        rows = np.flatnonzero(finite)
        order = rows[np.argsort(stamps[rows], kind="stable")]
        in_order: slice | NDArray[Any] = slice(None) if np.array_equal(order, np.arange(len(stamps))) else order
        return placed(stamps)[in_order], in_order  # type: ignore[return-value]

    def _load(self, indices: dict[str, int], order: Any, path: str, rows: slice) -> NDArray[Any]:
        if path not in self._columns:
            with redirect_stdout(StringIO()):  # what asammdf prints of a channel that it cannot read
                signal = self._source.get(group=self._number, index=indices[path])
                samples = np.asarray(signal.samples)
                if samples.dtype.kind in "SUO":  # a conversion to texts: its numbers
                    samples = np.asarray(self._source.get(group=self._number, index=indices[path], raw=True).samples)
            invalid = getattr(signal, "invalidation_bits", None)
            if invalid is not None and np.any(invalid):
                samples = np.where(np.asarray(invalid, np.bool_), np.nan, samples)
            self._columns[path] = samples[order]
        return self._columns[path][rows]

    def _unit(self, index: int) -> str:
        with suppress(Exception):  # a damaged block of a unit is no reason to lose the channel
            return str(self._source.get_channel_unit(group=self._number, index=index) or "")
        return ""

    def _has(self, end: str) -> bool:
        return any(channel.name == f"{_FRAMES}.{end}" for channel in self._group.channels)

    def _frames(self, end: str) -> NDArray[Any]:
        return np.asarray(self._source.get(f"{_FRAMES}.{end}", group=self._number, raw=True, samples_only=True)[0])
