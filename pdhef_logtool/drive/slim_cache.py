"""A cache of reduced logs, in a folder or an object store: a log that was read once is only asked for what it is.

The key of an entry is the source's identity and all that decides what of it is kept: mapping, ground truth,
definitions, resource limits and version. It appears when it is complete, so that several processes may share a cache;
a damaged entry is regenerated.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.slim import slim_log
from pdhef_logtool.logs.discovery import LogInput, hash_log, identity_of
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.reduced_log import FORMAT, is_whole
from pdhef_logtool.mapping import Mapping
from pdhef_logtool.mapping.vendors import load_vendors
from pdhef_logtool.records.errors import OutputError, PdhefError
from pdhef_logtool.records.version import __version__
from pdhef_logtool.storage.documents import digest, jsonable
from pdhef_logtool.storage.files import scratch_folder
from pdhef_logtool.storage.object_store import ObjectFolder, is_url

#: A process examines what a cache contains each time that it has added this share of what it may contain.
_LOOK_SHARE = 0.05
#: Bytes that this process adds to a cache before it checks its size again.
_left_bytes: dict[str, float] = {}
_DAMAGED = "its reduced log in the cache is damaged and is written again"


@dataclass(frozen=True, slots=True)
class SlimCache:
    """Reduced logs of logs that are read alike.

    Attributes
    ----------
    place : folder, or URL of what fsspec can write to. mapping : None recognises types. options : as for a run.
    """

    place: str
    mapping: Mapping | None
    options: ReadOptions

    @contextmanager
    def standing_in(self, log: LogInput, warn: Callable[[str], None] = lambda _text: None) -> Iterator[LogInput]:
        """Yield the reduced log of a log with the log's name and slice, made if it is not there.

        A log that cannot be reduced is yielded as it is, and so is each log when the cache cannot be written;
        ``warn`` is given that, and which entry was damaged.
        """
        with scratch_folder() as scratch:
            yield self._found(log, Path(scratch), warn) or log

    def _found(self, log: LogInput, scratch: Path, warn: Callable[[str], None]) -> LogInput | None:
        try:
            identity = identity_of(log)
        except (OSError, PdhefError):  # a reader it states what is wrong with it
            return None
        key = self._key(identity)
        try:
            path = self._fetched(key, scratch)
            if path is not None and _is_sound(path):
                with suppress(OSError):
                    os.utime(path)  # it is used: others go first
                return replace(log, path=path)
            if path is not None:
                warn(f"{log.stem}: {_DAMAGED}")
            made = (Path(self.place) if self._is_folder else scratch) / key
            try:
                record = slim_log(log, made, self.mapping, self.options)
            except OutputError:
                raise
            except PdhefError:
                return None
            if record.identity != identity:  # it changed meanwhile
                made.unlink()
                return None
            if self._is_folder:
                self._make_room(made)
            else:
                ObjectFolder(self.place).put(key, made)
        except (OSError, OutputError) as error:
            warn(f"{log.stem}: the cache {self.place} is not used: {' '.join(str(error).split())}")
            return None
        return replace(log, path=made)

    def _key(self, identity: str) -> str:
        return f"{identity[:2]}/{identity}-{self._setting}.mcap"

    @property
    def _setting(self) -> str:
        """Digest of all that decides what is kept of a log, as files are and not as they are called."""
        mapping: dict[str, Any] = jsonable(self.mapping) or {}
        mapping["file"], vendors = "", repr(load_vendors())
        if self.mapping is not None:
            if self.mapping.can is not None:
                mapping["can"]["dbc"] = ""
            mapping["dbc"] = [hash_log(path) if path.exists() else path.name for path in self.mapping.dbc]
            vendors = vendors if self.mapping.fill_recognised or self.mapping.recorders else ""
        msgs = "" if self.options.msgs is None else hash_log(self.options.msgs)
        said = (FORMAT, __version__, mapping, vendors, msgs, self.options.prefer_truth, self.options.budget)
        return digest(said)[:16]

    @property
    def _is_folder(self) -> bool:
        return not is_url(self.place)

    def _make_room(self, made: Path) -> None:
        """Remove what was not used for longest where there is more than there may be, but for what was just made."""
        if self.options.cache_max_gb is None:
            return
        most = self.options.cache_max_gb * 1e9
        left = _left_bytes.get(self.place, 0.0) - made.stat().st_size
        if left < 0.0:
            left = _LOOK_SHARE * most
            entries = [(state.st_mtime_ns, state.st_size, path) for path, state in _entries(Path(self.place))]
            size = sum(entry[1] for entry in entries)
            for _, size_bytes, path in sorted(entries):
                if size <= most:
                    break
                if path != made:
                    path.unlink(missing_ok=True)
                    size -= size_bytes
        _left_bytes[self.place] = left

    def _fetched(self, key: str, scratch: Path) -> Path | None:
        """Return an entry as a file of this machine, None where there is none."""
        if self._is_folder:
            path = Path(self.place) / key
            return path if path.is_file() else None
        path = scratch / "found.mcap"
        return path if ObjectFolder(self.place).get(key, path) else None


def _entries(place: Path) -> Iterator[tuple[Path, os.stat_result]]:
    """Yield the entries of a folder; those that another process removes are left out."""
    for path in place.glob("??/*.mcap"):
        with suppress(OSError):
            yield path, path.stat()


def _is_sound(path: Path) -> bool:
    """Return whether a file is a reduced log that is as it was written."""
    try:
        if not is_whole(path):
            return False
        with closing(open_log(path)) as log:
            return log.reduced is not None
    except (OSError, PdhefError):
        return False
