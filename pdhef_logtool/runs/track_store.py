"""Tracks of a log on disk, window by window, so that only one estimator's whole track is ever in memory."""

from __future__ import annotations

import shutil
from dataclasses import fields
from pathlib import Path
from typing import Self

import numpy as np

from pdhef_logtool.records.files import open_new, writing
from pdhef_logtool.records.tracks import StateTrack, concatenate


class TrackStore:
    """Append-only store of track windows in a folder of their own; gone when the context ends.

    Raises
    ------
    OutputError
        The folder, which is made, or a file in it cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        with writing(folder):
            folder.mkdir(parents=True)
        self._windows: dict[str, list[Path]] = {}

    def append(self, track: StateTrack) -> None:
        """Add the next window of a track."""
        files = self._windows.setdefault(track.name, [])
        file = self._folder / f"{track.name}-{len(files)}.npz"
        with writing(file), open_new(file) as made:
            np.savez(made, **{f.name: getattr(track, f.name) for f in fields(track) if f.name != "name"})
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
