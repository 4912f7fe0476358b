"""Tracks of a log on disk, window by window, so that only one estimator's whole track is ever in memory."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import fields
from pathlib import Path
from typing import Self

import numpy as np

from pdhef_logtool.records.tracks import StateTrack, concatenate


class TrackStore:
    """Append-only store of track windows in a temporary folder beside the outputs; gone when the context ends."""

    def __init__(self, beside: Path) -> None:
        beside.mkdir(parents=True, exist_ok=True)
        self._folder = Path(tempfile.mkdtemp(prefix=".tracks-", dir=beside))
        self._windows: dict[str, list[Path]] = {}

    def append(self, track: StateTrack) -> None:
        """Add the next window of a track."""
        files = self._windows.setdefault(track.name, [])
        file = self._folder / f"{track.name}-{len(files)}.npz"
        np.savez(file, **{f.name: getattr(track, f.name) for f in fields(track) if f.name != "name"})
        files.append(file)

    def read(self, name: str) -> StateTrack | None:
        """Return the whole track of a name; None if there is none."""
        windows = []
        for file in self._windows.get(name, []):
            with np.load(file, allow_pickle=False) as columns:
                windows.append(StateTrack(name=name, **{key: columns[key] for key in columns.files}))
        return concatenate(windows) if windows else None

    def close(self) -> None:
        """Remove everything; harmless when called twice."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the folder."""
        self.close()
