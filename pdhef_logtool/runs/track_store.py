"""Whole tracks and signals of a log on disk, column by column, so that scoring contains only what it works on.

Ten hours at 100 Hz are 3.6 million rows: a track of them takes 0.8 GB, a column 29 MB. The columns of a short drive
never see the disk, for its files would take longer than its figures, and neither do those that never change.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import DTypeLike, NDArray

from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.storage.files import open_new, writing

_SIGNALS = "signals"
#: A column up to this length stays in memory: nearly three minutes at 100 Hz, where a track takes 5 MB.
ROWS_HELD = 1 << 14


@dataclass(slots=True)
class _Column:
    """A column that grows: rows so far, and what a row is.

    While all rows are the same, as of a signal without estimate, that one row represents them; then they are in
    memory, and from :data:`ROWS_HELD` on in a file.
    """

    path: Path
    dtype: DTypeLike
    row: tuple[int, ...]
    rows: int = 0
    _same: NDArray[Any] | None = field(init=False, default=None)
    _held: NDArray[Any] | None = field(init=False)

    def __post_init__(self) -> None:
        self._held = np.empty((0, *self.row), self.dtype)

    def append(self, values: NDArray[Any]) -> None:
        if not values.shape[0]:
            return
        before, self.rows = self.rows, self.rows + values.shape[0]
        if not before or self._same is not None:
            first = values[:1] if self._same is None else self._same
            if _all_are(values, first):
                self._same = first.copy()
                return
            values, self._same = np.concatenate([np.repeat(first, before, axis=0), values]), None
        is_first = self._held is not None
        if self._held is not None:
            values = np.concatenate([self._held, values])
            self._held = values if self.rows <= ROWS_HELD else None
        if self._held is None:
            with writing(self.path):
                if is_first:
                    self.path.parent.mkdir(parents=True, exist_ok=True)
                with open_new(self.path, "ab") as file:
                    file.write(np.ascontiguousarray(values).data)

    def read(self, start: int, end: int) -> NDArray[Any]:
        rows = max(min(end, self.rows) - start, 0)
        if self._same is not None:
            return np.repeat(self._same, rows, axis=0)
        if self._held is not None:
            return self._held[start:end]
        width = int(np.prod(self.row, dtype=np.int64))
        values = np.fromfile(self.path, self.dtype, rows * width, offset=start * width * np.dtype(self.dtype).itemsize)
        return values.reshape(rows, *self.row)


def _all_are(values: NDArray[Any], row: NDArray[Any]) -> bool:
    """Return whether all rows [N] have the bits of a row [1], so that not known is the same as not known."""
    bits = [np.ascontiguousarray(v).view(f"u{v.dtype.itemsize}") for v in (values, row)]
    return bool((bits[0] == bits[1]).all())


@dataclass(slots=True)
class _Columns:
    """The columns of one record by field, and what else the record has."""

    columns: dict[str, _Column] = field(default_factory=dict)
    others: dict[str, Any] = field(default_factory=dict)


class _Stored:
    """Rows of a record on disk: a column is read each time that it is asked for, and nothing of it is kept."""

    __slots__ = ()
    _stored: _Columns
    _start: int
    _end: int

    def __init__(self, stored: _Columns, start: int = 0, end: int | None = None) -> None:
        end = stored.columns["stamps_ns"].rows if end is None else end
        for name, value in {"_stored": stored, "_start": start, "_end": end, **stored.others}.items():
            object.__setattr__(self, name, value)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name not in self._stored.columns:
            raise AttributeError(name)
        return self._stored.columns[name].read(self._start, self._end)

    def __len__(self) -> int:
        return self._end - self._start

    def rows(self, start: int, end: int) -> Self:
        """Return the rows [start, end), each column read on first access."""
        return type(self)(self._stored, self._start + start, min(self._start + end, self._end))


@dataclass(slots=True)
class _Window:
    """Rows of the signals of a window, and which tracks of how many rows are drawn in it."""

    rows: int
    drawn: list[tuple[str, int]] = field(default_factory=list)


def _in_memory(stored: _Columns, start: int, end: int, kind: type[Any]) -> Any:
    return kind(**stored.others, **{name: column.read(start, end) for name, column in stored.columns.items()})


class StoredTrack(_Stored, StateTrack):
    """A track on disk."""

    __slots__ = ("_end", "_start", "_stored")


class StoredSignals(_Stored, Signals):
    """Signals on disk."""

    __slots__ = ("_end", "_start", "_stored")


class TrackStore:
    """Append-only store of windows in a folder of its own; gone when the context ends.

    Raises
    ------
    OutputError
        The folder, which is made when something is written to it, or a file in it cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._stored: dict[str, _Columns] = {}
        self._windows: list[_Window] = []

    def append(self, track: StateTrack, *, drawn: bool = False) -> None:
        """Add the next window of a track; :meth:`windows` gives back what is ``drawn``."""
        key = f"track-{track.name}"
        self._append(key, track)
        if drawn:
            self._windows[-1].drawn.append((key, len(track)))

    def append_signals(self, signals: Signals) -> None:
        """Add the next window of the signals, before its tracks."""
        self._append(_SIGNALS, signals)
        self._windows.append(_Window(len(signals)))

    def append_drawn(self, track: StateTrack) -> None:
        """Add the next window of a track that :meth:`windows` gives back and :meth:`read` does not."""
        key = f"drawn-{track.name}"
        self._append(key, track)
        self._windows[-1].drawn.append((key, len(track)))

    def windows(self) -> Iterator[tuple[Signals, list[StateTrack]]]:
        """Yield signals and drawn tracks window by window, as they were added, each in memory."""
        row_of: Counter[str] = Counter()
        for window in self._windows:
            parts: list[Any] = []
            for key, rows in [(_SIGNALS, window.rows), *window.drawn]:
                parts.append(
                    _in_memory(self._stored[key], row_of[key], row_of[key] + rows, Signals if not parts else StateTrack)
                )
                row_of[key] += rows
            yield parts[0], parts[1:]

    def _append(self, key: str, record: StateTrack | Signals) -> None:
        stored = self._stored.setdefault(key, _Columns())
        number = list(self._stored).index(key)
        for f in fields(record):
            values = getattr(record, f.name)
            if not isinstance(values, np.ndarray):
                stored.others.setdefault(f.name, values)
                continue
            if f.name not in stored.columns:
                path = self._folder / f"{number}-{f.name}"
                stored.columns[f.name] = _Column(path, values.dtype, values.shape[1:])
            stored.columns[f.name].append(values)

    def read(self, name: str) -> StateTrack | None:
        """Return the whole track of a name, None if there is none; its columns can be read while the store is open."""
        stored = self._stored.get(f"track-{name}")
        return None if stored is None else StoredTrack(stored)

    def signals(self) -> Signals:
        """Return the signals of all windows; their columns can be read while the store is open."""
        return StoredSignals(self._stored[_SIGNALS])

    def close(self) -> None:
        """Remove everything; harmless when called twice."""
        if self._folder.exists():
            shutil.rmtree(self._folder, ignore_errors=True)

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the folder."""
        self.close()
