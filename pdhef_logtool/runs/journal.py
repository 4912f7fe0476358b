"""journal.jsonl: one line per drive of a run of several logs. An interrupted run continues from it.

A line is on the disk before the next drive counts as done, and ends with a checksum. A damaged line is ignored, so that
its drive is run again. A log is identified by its content and keeps the label of its first run. Its location is stored
as a digest, so that no folder names are published, with size and time of change: a log with equal values is not read
again to identify it.
"""

import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.logs.remote_place import RemotePlace
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.results.opened_run import JOURNAL_FILE
from pdhef_logtool.results.run_report import LogOutcome
from pdhef_logtool.storage.documents import digest, file_sha256, jsonable
from pdhef_logtool.storage.files import PendingFile, open_new, writing

_FORMAT = {"format": "pdhef.journal", "version": 5}
#: Included in each checksum, so that lines of other versions of the format are ignored as damaged lines are.
_VERSION = b"pdhef.journal 5"
_DIGITS = 16
#: Bytes of the last entry of a line: the checksum of all bytes before it.
_SUM_BYTES = len(b',"sum":""}\n') + _DIGITS
#: Bytes of a log on a server, which nobody has asked for.
_ELSEWHERE = -1


@dataclass(frozen=True, slots=True)
class Place:
    """Location of a log: digest of path and slice, size in bytes and time of change (of a folder: of its files).

    For a log on a server, the digest of the URL; only the identity, which the server states, shows a change.
    """

    key: str
    bytes: int
    changed_ns: int

    @classmethod
    def of(cls, log: LogInput) -> "Place":
        """Return the place of a log; of one that is not there no bytes."""
        if isinstance(log.path, RemotePlace):
            return cls(_key(log.path.identity, log.span_s), _ELSEWHERE, 0)
        path = Path(os.path.realpath(log.path))
        stats = []
        with suppress(OSError):
            files = [p for p in path.rglob("*") if p.is_file()] if path.is_dir() else [path]
            stats = [p.stat() for p in files]
        return cls(
            _key(os.fsdecode(path), log.span_s),
            sum(f.st_size for f in stats),
            max((f.st_mtime_ns for f in stats), default=0),
        )

    @property
    def is_local(self) -> bool:
        """Whether it is a place of this machine."""
        return self.bytes != _ELSEWHERE


def _key(path: str, span_s: tuple[float, float] | None) -> str:
    return hashlib.sha256(os.fsencode(path) + repr(span_s).encode()).hexdigest()[:_DIGITS]


@dataclass(frozen=True, slots=True)
class Entry:
    """The journal's record of a drive; its outcome is read on demand.

    Attributes
    ----------
    identity : of the log's content, None if it cannot be read. setting, car : digests of settings and car (None: no
        car). keep : kept files.
    part : the file of its rows of the tables below the run's folder, None without.
    error_rad : RMSE of the selected sideslip, None without independent ground truth.
    failed : whether there is no result. again : whether a repetition may succeed, as after a full disk.
    quarantined : whether it took its worker along.
    offset : bytes into the journal.
    """

    label: str
    place: Place
    identity: str | None
    setting: str
    car: str | None
    keep: str
    part: str | None = None
    error_rad: float | None = None
    failed: bool = False
    again: bool = False
    quarantined: bool = False
    offset: int = -1


@dataclass(slots=True)
class Journal:
    """The journal of a run's folder.

    Attributes
    ----------
    entries : the last of each label. described : settings and cars by digest.
    damaged : lines that were left out when it was read. sizes : of all logs, in bytes.
    labels : of the drives by identity of their content.
    """

    path: Path
    entries: dict[str, Entry] = field(default_factory=dict)
    described: dict[str, dict[str, dict[str, Any]]] = field(default_factory=lambda: {"setting": {}, "car": {}})
    damaged: int = 0
    _places: dict[str, tuple[Place, str | None, str]] = field(default_factory=dict)
    sizes: set[int] = field(default_factory=set)
    labels: dict[str, list[str]] = field(default_factory=dict)
    _end: int = 0

    @classmethod
    def read(cls, folder: Path) -> "Journal":
        """Return the journal of a folder, empty without a file; damaged lines are ignored and counted.

        Raises
        ------
        OutputError
            It cannot be read.
        """
        journal = cls(folder / JOURNAL_FILE)
        for line in journal._lines():
            if (document := _document(line)) is None:
                journal.damaged += 1
            else:
                journal._take(document, journal._end)
            journal._end += len(line)
        journal._repeat_failures()
        return journal

    def _repeat_failures(self) -> None:
        """Repeat failed drives if a line is damaged: it may have recorded that a drive has not failed since."""
        for label, entry in self.entries.items():
            if self.damaged and entry.failed:
                self.entries[label] = replace(entry, again=True, quarantined=False)

    def _lines(self) -> Iterator[bytes]:
        try:
            with self.path.open("rb") as file:
                yield from file
        except FileNotFoundError:
            return
        except OSError as error:
            got = error.strerror or str(error)
            raise OutputError(expected="a readable journal", got=got, where=str(self.path)) from error

    def begin(self) -> None:
        """Make it a complete file: a new one in place of an old one, or the old one without damaged lines."""
        if self._end and not self.damaged:
            return
        with writing(self.path), PendingFile(self.path) as pending, open_new(pending.path) as new:
            had, self._end = self._end, new.write(_line(_FORMAT))
            for line in self._lines() if had else ():
                document = _document(line)
                if document is not None and "format" not in document:
                    self._take(document, self._end)
                    self._end += new.write(line)
        self._repeat_failures()

    def known(self, place: Place) -> tuple[str, str | None, bool]:
        """Return label and identity of the log that lay there last, empty without one, and whether it is unchanged."""
        was, identity, label = self._places.get(place.key, (None, None, ""))
        return label, identity, was == place

    def outcome(self, entry: Entry) -> LogOutcome:
        """Return how a drive ended; raises OutputError where its line was damaged since it was read."""
        return LogOutcome(**self._document_of(entry)["outcome"])

    def outputs(self, entry: Entry) -> dict[str, str]:
        """Return the :func:`states_of` a drive's files; raises OutputError as :meth:`outcome` does."""
        outputs: dict[str, str] = self._document_of(entry)["outputs"]
        return outputs

    def _document_of(self, entry: Entry) -> dict[str, Any]:
        with self.path.open("rb") as file:
            file.seek(entry.offset)
            document = _document(file.readline())
        if document is None:
            raise OutputError(
                expected=f"the line of {entry.label}",
                got="another content",
                where=str(self.path),
                remedy="--resume runs it again",
            )
        return document

    def add(self, entry: Entry, outcome: LogOutcome, outputs: Mapping[str, str]) -> Entry:
        """Write how a drive ended and return the entry with its offset; raises OutputError."""
        document = asdict(entry)
        del document["offset"]
        offset = self._append({**document, "outcome": jsonable(outcome), "outputs": dict(outputs)})
        entry = replace(entry, offset=offset)
        self._keep(entry)
        return entry

    def describe(self, kind: Literal["setting", "car"], digest: str, description: Mapping[str, Any]) -> None:
        """Record the values of a setting or a car once."""
        if digest not in self.described[kind]:
            self._append({kind: digest, "is": dict(description)})
            self.described[kind][digest] = dict(description)

    def _append(self, document: Mapping[str, Any]) -> int:
        offset, data = self._end, _line(document)
        with writing(self.path), open_new(self.path, "ab") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        self._end += len(data)
        return offset

    def _take(self, document: dict[str, Any], offset: int) -> None:
        if "is" in document:
            kind = "setting" if "setting" in document else "car"
            self.described[kind][document[kind]] = document["is"]
        elif "label" in document:
            content = {k: v for k, v in document.items() if k not in ("outcome", "outputs")}
            self._keep(Entry(**{**content, "place": Place(**content["place"])}, offset=offset))

    def _keep(self, entry: Entry) -> None:
        self.entries[entry.label] = entry
        self._places[entry.place.key] = entry.place, entry.identity, entry.label
        self.sizes.add(entry.place.bytes)
        if entry.identity is not None and entry.label not in (labels := self.labels.setdefault(entry.identity, [])):
            labels.append(entry.label)


def _line(document: Mapping[str, Any]) -> bytes:
    text = json.dumps(document, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    data = text.encode("utf-8", "backslashreplace")[:-1]
    return data + _sum(data)


def _document(line: bytes) -> dict[str, Any] | None:
    """Return the content of a line, None if the line is damaged."""
    if line[-_SUM_BYTES:] != _sum(line[:-_SUM_BYTES]):
        return None
    document: dict[str, Any] = json.loads(line)
    del document["sum"]
    return document


def _sum(data: bytes) -> bytes:
    """Return the end of a line: the checksum of all bytes before it."""
    text = hashlib.sha256(_VERSION + data).hexdigest()[:_DIGITS]
    return b',"sum":"%s"}\n' % text.encode()


def states_of(output: Path, names: Iterable[str]) -> dict[str, str]:
    """Return size and digest of the files below an output that exist, by name."""
    return {name: _state_of(output / name) for name in names if (output / name).is_file()}


def is_unchanged(path: Path, state: str) -> bool:
    """Return whether a file has this size and digest."""
    try:
        return state.startswith(f"{path.stat().st_size} ") and state == _state_of(path)
    except OSError:
        return False


def _state_of(path: Path) -> str:
    return f"{path.stat().st_size} {file_sha256(path)[:_DIGITS]}"


def digest_of(content: Any) -> str:
    """Return a short digest of JSON-able values."""
    return digest(content)[:_DIGITS]


def changes(old: Mapping[str, str], new: Mapping[str, str]) -> Iterator[str]:
    """Yield the differences between two settings or cars as texts."""
    for name in sorted({*old, *new}):
        before, after = old.get(name, "none"), new.get(name, "none")
        if before != after:
            yield f"{name} changed" if _is_digest(before) or _is_digest(after) else f"{name} {before} → {after}"


def _is_digest(text: str) -> bool:
    return len(text) >= _DIGITS and all(c in "0123456789abcdef" for c in text)
