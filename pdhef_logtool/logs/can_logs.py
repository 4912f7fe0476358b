"""Logs of raw CAN frames, BLF and ASC (extra ``formats``): a topic ``can`` that a DBC in the mapping file decodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from io import TextIOWrapper
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs.can_decoding import Frames
from pdhef_logtool.logs.container import describe_damage
from pdhef_logtool.logs.table_clocks import number_stamps
from pdhef_logtool.logs.table_file import TableFile, Tables
from pdhef_logtool.records.errors import LogError
from pdhef_logtool.records.extras import required
from pdhef_logtool.records.signals import FloatArray, Loss

#: Of CAN FD.
_MOST_BYTES = 64
#: Frames that become an array at once.
_BLOCK_FRAMES = 65_536
_PARTS = ("id", "length", "is_extended", "bus", "is_error", "is_remote")


def open_blf(file: TableFile) -> Tables:
    """Read a BLF file; raises LogError where it has no frames."""
    can = required("can.io", "formats", "reads BLF files", file.name)
    return _open(file, lambda: can.BLFReader(file.stream), "blf")


def open_asc(file: TableFile) -> Tables:
    """Read an ASC file; raises LogError where it has no frames."""
    can = required("can.io", "formats", "reads ASC files", file.name)
    return _open(file, lambda: can.ASCReader(TextIOWrapper(file.stream)), "asc")


def _open(file: TableFile, reader: Callable[[], Any], kind: str) -> Tables:
    losses: list[Loss] = []
    blocks: list[_Block] = []
    try:
        with reader() as source:
            if file.size < getattr(source, "file_size", 0):
                what = f"the file ends after {file.size} of {source.file_size} bytes"
                losses.append(Loss("truncated", what, file.name))
            messages = iter(source)
            while not blocks or len(blocks[-1].stamps) == _BLOCK_FRAMES:
                blocks.append(_Block())
                blocks[-1].read(messages)
    except LogError:
        raise
    except Exception as error:  # noqa: BLE001  any error of a damaged file
        what = f"frames behind the damage cannot be read: {describe_damage(error)[1]}"
        losses.append(Loss("truncated", what, file.name))
    parts = [block.arrays() for block in blocks if block.stamps]
    if not parts:
        raise LogError(expected="CAN frames", got="none that can be read", where=file.name)
    clock = number_stamps(np.concatenate([stamps for stamps, _, _ in parts]), "s")
    order = np.argsort(clock, kind="stable")
    numbers = np.concatenate([rows for _, rows, _ in parts])[order].T
    widest = max(data.shape[1] for _, _, data in parts)
    data = np.concatenate([np.pad(d, ((0, 0), (0, widest - d.shape[1]))) for _, _, d in parts])[order]
    frames = Frames(clock[order], dict(zip(_PARTS, numbers, strict=True)), data)
    return Tables(kind, [frames.table("can")], losses)


class _Block:
    """Frames as they are read; what is read before an error stays."""

    def __init__(self) -> None:
        self.stamps: list[float] = []
        self._numbers: list[tuple[int, ...]] = []
        self._data: list[bytes] = []

    def read(self, messages: Iterator[Any]) -> None:
        """Read up to a number of frames."""
        for message in islice(messages, _BLOCK_FRAMES):
            data = bytes(message.data[:_MOST_BYTES])
            bus = message.channel if isinstance(message.channel, int) else -1
            flags = message.is_extended_id, bus, message.is_error_frame, message.is_remote_frame
            self._numbers.append((message.arbitration_id, len(data), *flags))
            self._data.append(data)
            self.stamps.append(message.timestamp)

    def arrays(self) -> tuple[FloatArray, NDArray[np.int32], NDArray[np.uint8]]:
        """Return times in s [N], the numbers of a frame [N, 6], and bytes [N, k]."""
        widest = max(1, *map(len, self._data))
        data = b"".join(d.ljust(widest, b"\0") for d in self._data)
        rows = np.frombuffer(data, np.uint8).reshape(-1, widest)
        return np.asarray(self.stamps), np.asarray(self._numbers, np.int32), rows
