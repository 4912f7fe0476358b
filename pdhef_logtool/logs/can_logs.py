"""Logs of raw CAN frames, BLF and ASC (extra ``formats``): a topic ``can`` that a DBC in the mapping file decodes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from pdhef_logtool.logs.can_decoding import Frames
from pdhef_logtool.logs.container import describe_damage
from pdhef_logtool.logs.log_file import LogFile
from pdhef_logtool.logs.resource_limits import Meter
from pdhef_logtool.logs.table_columns import extra, number_stamps
from pdhef_logtool.logs.table_log import TableLog
from pdhef_logtool.records.errors import LogError
from pdhef_logtool.records.signals import Loss

#: Of CAN FD.
_MOST_BYTES = 64
#: Frames between two checks of the reading time.
_METERED = 4096


def open_blf(file: LogFile) -> TableLog:
    """Open a BLF file; raises LogError where it has no frames."""
    return _open(file, "BLFReader", "blf")


def open_asc(file: LogFile) -> TableLog:
    """Open an ASC file; raises LogError where it has no frames."""
    return _open(file, "ASCReader", "asc")


def _open(file: LogFile, reader: str, kind: str) -> TableLog:
    io = extra("can.io", f"{kind.upper()} files", file.place)
    size = file.path.stat().st_size
    losses: list[Loss] = []
    stamps: list[float] = []
    numbers: list[tuple[int, int, bool, int, bool, bool]] = []
    data = bytearray()
    widest = 0
    with file.meter.running(size):
        try:
            source = getattr(io, reader)(str(file.path))
            if size < getattr(source, "file_size", 0):
                what = f"the file ends after {size} of {source.file_size} bytes"
                losses.append(Loss("truncated", what, str(file.place)))
            for message in _messages(source, file.meter):
                width = min(len(message.data), _MOST_BYTES)
                bus = message.channel if isinstance(message.channel, int) else -1
                flags = message.is_extended_id, bus, message.is_error_frame, message.is_remote_frame
                stamps.append(message.timestamp)
                numbers.append((message.arbitration_id, width, *flags))
                data += bytes(message.data[:width]).ljust(_MOST_BYTES, b"\0")
                widest = max(widest, width)
        except LogError:
            raise
        except Exception as error:  # noqa: BLE001  any error of a damaged file
            what = f"frames behind the damage cannot be read: {describe_damage(error)[1]}"
            losses.append(Loss("truncated", what, str(file.place)))
        if not stamps:
            raise LogError(expected="CAN frames", got="none that can be read", where=str(file.place))
        parts = np.asarray(numbers, np.int64)
        names = ("id", "length", "is_extended", "bus", "is_error", "is_remote")
        payload = np.frombuffer(bytes(data), np.uint8).reshape(-1, _MOST_BYTES)[:, : max(widest, 1)]
        clock = number_stamps(np.asarray(stamps), "s")
        order = np.argsort(clock, kind="stable")
        frames = Frames(clock[order], dict(zip(names, parts[order].T, strict=True)), payload[order])
        return TableLog(file, kind, [frames.table("can")], losses, [frames])


def _messages(reader: Any, meter: Meter) -> Iterator[Any]:
    with reader:
        for number, message in enumerate(reader):
            if number % _METERED == 0:
                meter.check()
            yield message
