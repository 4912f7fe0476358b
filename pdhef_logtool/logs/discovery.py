"""Find the logs that a command line names, and give each a name for tables and output folders."""

import glob
import hashlib
import os
import re
import unicodedata
from collections import Counter
from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, takewhile
from pathlib import Path
from typing import TypeAlias

from pdhef_logtool.logs.byte_source import ChangedError, require_regular, unreadable
from pdhef_logtool.logs.formats import COMPRESSED_SUFFIXES, ROSBAG2_METADATA, log_suffixes, without_general
from pdhef_logtool.logs.remote_place import LogPlace, RemotePlace, place_of
from pdhef_logtool.logs.table_file import NO_SETTINGS, TableSettings
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.storage.documents import file_sha256

#: Stems are folder names on any system.
_STEM_BYTES = 100
_NOT_IN_NAMES = frozenset('<>:"/\\|?*')
_DEVICE = re.compile(r"CON|PRN|AUX|NUL|CONIN\$|CONOUT\$|(COM|LPT)[0-9¹²³]", re.IGNORECASE)
#: A folder with this file is an output of ours, and its recordings are no input.
RUN_FILE = "run.json"


@dataclass(frozen=True, slots=True)
class LogInput:
    """A log and its ``stem``: unique in a run, fit for a folder name on any system, equal to ``log`` in the tables.

    The stem is the log's name; hash digits follow if it is not unique or not valid as a folder.
    ``span_s``: only this slice of it, in seconds from its start; it takes precedence over a slice for all logs.
    """

    path: LogPlace
    stem: str
    span_s: tuple[float, float] | None = None

    @property
    def local(self) -> Path | None:
        """The file or folder on this machine; None for a remote log."""
        return self.path if isinstance(self.path, Path) else None

    @property
    def folder(self) -> Path | None:
        """Its folder on this machine; None for a remote log: no files beside it are searched."""
        return self.path.parent if isinstance(self.path, Path) else None


#: A log or several, as users name them, or as :func:`find_logs` returned them.
Logs: TypeAlias = "str | LogPlace | Sequence[str | LogPlace] | Sequence[LogInput]"


def find_logs(
    arguments: Logs, *, private_redirects: bool = False, settings: TableSettings = NO_SETTINGS
) -> list[LogInput]:
    """Expand paths, patterns and URLs to logs in a stable order; each log once. Logs that were found already are kept.

    A file or rosbag2 folder that is named itself is a log, readable or not. Folders, and
    ``s3://bucket/prefix/``, are searched for logs by suffix; a rosbag2 folder of this machine, or a folder of CSV files
    of one recording, counts as one log. Any other URL is one log. ``@list.txt`` means the lines of a file.
    ``private_redirects`` as for :class:`~pdhef_logtool.logs.remote_place.RemotePlace`.

    Raises
    ------
    UsageError : An argument names no log. LogError : A store cannot be searched.
    """
    logs: dict[str, LogPlace] = {}
    several = [arguments] if isinstance(arguments, str | Path | RemotePlace) else arguments
    if already := [a for a in several if isinstance(a, LogInput)]:
        return already
    named = (a.url if isinstance(a, RemotePlace) else str(a) for a in several)
    for argument in chain.from_iterable(map(_lines, named)):
        places = list(_expand(argument, private_redirects, settings))
        if not places:
            raise UsageError(
                expected=f"at least one log ({', '.join(log_suffixes())} or a rosbag2 folder)",
                got="none",
                where=str(place_of(argument)),
                remedy="name a log, a folder with logs, or a glob pattern in quotes",
            )
        for place in places:
            logs.setdefault(place.identity if isinstance(place, RemotePlace) else os.path.realpath(place), place)
    return _with_stems(list(logs.values()))


def with_free_stem(log: LogInput, taken: Container[str]) -> LogInput:
    """Return a log with its stem, or with digits appended if :func:`as_taken` of the stem is in ``taken``."""
    if as_taken(log.stem) not in taken:
        return log
    return replace(log, stem=_with_digits(log.stem, "/".join(_parts(log.path)), taken))


def one_place(argument: str, *, private_redirects: bool = False) -> LogPlace:
    """Return the place that an argument, or the one line of ``@list.txt``, names.

    ``private_redirects`` as for :class:`~pdhef_logtool.logs.remote_place.RemotePlace`.

    Raises
    ------
    UsageError : It names several, or none.
    """
    lines = list(_lines(argument))
    if len(lines) != 1:
        raise UsageError(expected="one log", got=f"{len(lines)} of them", where=argument)
    return place_of(lines[0], private_redirects=private_redirects)


def _lines(argument: str) -> Iterator[str]:
    """Yield an argument, or the lines of the file that it names by ``@``."""
    listed = Path(argument[1:])
    if not argument.startswith("@") or Path(argument).exists() or not listed.is_file():
        yield argument
        return
    try:
        lines = listed.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, ValueError) as error:
        got = "another encoding" if isinstance(error, ValueError) else error.strerror or "none"
        raise UsageError(expected="a text file in UTF-8, a log a line", got=got, where=argument) from error
    yield from (line for line in map(str.strip, lines) if line and not line.startswith("#"))


def folders_of(inputs: Sequence[LogInput]) -> list[str]:
    """Return the folder of each log below their common folder, ``car/day``; empty for those directly in it."""
    folders = [_parts(i.path)[:-1] for i in inputs]
    n = len(_common(folders))
    return ["/".join(folder[n:]) for folder in folders]


def identity_of(log: LogInput) -> str:
    """Return the identity of a log, independent of its path: the sha256 of its content.

    An object on a server is not fetched: its identity is the sha256 of its URL, size and ETag (or modification time).

    Raises
    ------
    LogError : It is neither a folder nor a regular file, cannot be read, or is an object that cannot be asked for.
    """
    if isinstance(log.path, Path):
        try:
            return hash_log(log.path)
        except OSError as error:
            raise unreadable(error, log.path) from error
    from pdhef_logtool.logs.remote_source import identity_of_object

    return identity_of_object(log.path)


def hash_log(path: Path) -> str:
    """Return the sha256 of a log file, or of the names and contents of a log folder's files in order.

    Raises
    ------
    LogError : It is neither a folder nor a regular file.
    """
    if not path.is_dir():
        require_regular(path)
        return file_sha256(path)
    total = hashlib.sha256()
    for file_path in _files_of(path):
        total.update(file_path.relative_to(path).as_posix().encode() + b"\0")
        total.update(bytes.fromhex(file_sha256(file_path)))
    return total.hexdigest()


def log_state(path: LogPlace) -> tuple[tuple[int, int, int], ...]:
    """Return an identity that changes when a file of a local log is replaced or written: file number, size, time."""
    if isinstance(path, RemotePlace):
        return ()  # each request names the version of the object
    files = (f.stat() for f in _files_of(path) if f.exists())
    return tuple((s.st_ino, s.st_size, s.st_mtime_ns) for s in files)


def _files_of(path: Path) -> list[Path]:
    """Return a file, or all files of a folder in order."""
    return sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]


def check_unchanged(path: LogPlace, state: tuple[tuple[int, int, int], ...]) -> None:
    """Raise a ChangedError if a log is not in this :func:`log_state` any more."""
    if log_state(path) != state:
        raise ChangedError(
            expected="the same file until its end",
            got="one that was changed while it was read",
            where=str(path),
            remedy="run it again when it is complete",
        )


def _expand(argument: str, private_redirects: bool, settings: TableSettings) -> Iterator[LogPlace]:
    place = place_of(argument, private_redirects=private_redirects)
    if isinstance(place, RemotePlace):
        yield from (
            _search_store(place) if place.scheme == "s3" and (not place.key or argument.endswith("/")) else (place,)
        )
    else:
        visited: set[str] = set()
        is_pattern = not place.exists() and glob.has_magic(argument)
        for match in _matches(argument) if is_pattern else [place]:
            if match.is_dir():
                yield from _search(match, visited, settings)
            else:
                yield match


def _search_store(prefix: RemotePlace) -> list[RemotePlace]:
    """Return the logs below a prefix of a store, by the rules for folders: no hidden ones, none of our outputs."""
    from pdhef_logtool.logs.remote_source import keys_below

    keys = keys_below(prefix)
    outputs = tuple(key.removesuffix(RUN_FILE) for key in keys if key.rpartition("/")[2] == RUN_FILE)
    folders: dict[str, set[str]] = {}
    for key in keys:
        hidden = any(part.startswith(".") for part in key.removeprefix(prefix.key).split("/"))
        if _bare_name(key) != key and not key.startswith(outputs) and not hidden:
            folders.setdefault(key.rpartition("/")[0], set()).add(key)
    logs = sorted(key for names in folders.values() for key in without_general(names))
    return [RemotePlace(f"{prefix.scheme}://{prefix.host}/{key}") for key in logs]


def _matches(pattern: str) -> list[Path]:
    """Return the matches of a glob pattern; ``**`` does not follow links to folders, which could form a loop."""
    if "**" not in Path(pattern).parts:
        return [Path(name) for name in sorted(glob.glob(pattern))]  # noqa: PTH207 (the pattern may be absolute)
    parts = Path(pattern).parts
    first = next(i for i, part in enumerate(parts) if glob.has_magic(part))
    root = Path(*parts[:first])
    below = str(Path(*(part if part == "**" else re.sub(r"\*\*+", "*", part) for part in parts[first:])))
    paths = (p for p in root.glob(below) if not any(x.startswith(".") for x in p.relative_to(root).parts))
    return sorted(paths, key=str)


def names_of_logs(folder: Path) -> set[str]:
    """Return the names of the logs in a folder, by their suffixes, without those in folders below it."""
    files = (e.name for e in folder.iterdir() if not (e.name.startswith(".") or e.is_dir()))
    names = {name for name in files if _bare_name(name) != name}
    return without_general(names - {"history.jsonl", "journal.jsonl"})  # of cars and runs


def _search(folder: Path, visited: set[str], settings: TableSettings) -> Iterator[Path]:
    """Yield the logs below a folder; each folder is visited once, because links may form a loop."""
    from pdhef_logtool.logs.recording_folder import is_recording

    place = os.path.realpath(folder)
    if place in visited:
        return
    visited.add(place)
    if (folder / ROSBAG2_METADATA).is_file():
        yield folder
        return
    if (folder / RUN_FILE).is_file():
        return
    entries = [e for e in sorted(folder.iterdir()) if not e.name.startswith(".")]
    logs = names_of_logs(folder)
    if is_recording(folder, logs, settings):
        yield folder
        logs = set()
    for entry in entries:
        if entry.is_dir():
            yield from _search(entry, visited, settings)
        elif entry.name in logs:
            yield entry


def _bare_name(name: str) -> str:
    """Return the name without the suffixes of a log, or the unchanged name if it has no suffix of a log."""
    bare = name
    for suffix in COMPRESSED_SUFFIXES:
        bare = bare.removesuffix(suffix)
    for suffix in log_suffixes():
        if bare.endswith(suffix) and bare != suffix:
            return bare.removesuffix(suffix)
    return name


def _parts(place: LogPlace) -> tuple[str, ...]:
    """Return the components of a path; all links but the last component are resolved."""
    if isinstance(place, RemotePlace):
        return (place.host, *place.parts[1:])
    return (*Path(os.path.realpath(place.parent)).parts[1:], place.name)


def _common(paths: Sequence[tuple[str, ...]]) -> tuple[str, ...]:
    """Return the parts that all paths begin with."""
    alike = takewhile(lambda parts: len(set(parts)) == 1, zip(*paths, strict=False))
    return tuple(parts[0] for parts in alike)


def _with_stems(paths: list[LogPlace]) -> list[LogInput]:
    parts = [_parts(p) for p in paths]
    n = len(_common([p[:-1] for p in parts]))
    relative = [p[n:] for p in parts]
    names = ["__".join([*r[:-1], _bare_name(r[-1])]) for r in relative]
    counts = Counter(map(as_taken, names))
    # Names that stay as they are come first, so that no other name can take theirs.
    staying = {name for name in names if counts[as_taken(name)] == 1 and _portable(name) == name}
    taken = {as_taken(name) for name in staying}
    logs = []
    for place, name, parts_below in zip(paths, names, relative, strict=True):
        origin = place.identity if isinstance(place, RemotePlace) else "/".join(parts_below)
        logs.append(LogInput(place, name if name in staying else _with_digits(name, origin, taken)))
        taken.add(as_taken(logs[-1].stem))
    return logs


def _with_digits(name: str, origin: str, taken: Container[str]) -> str:
    """Return a portable name that is free, with digits of its origin."""
    digits = hashlib.sha256(os.fsencode(origin)).hexdigest()
    made = (_portable(name, digits[:n]) for n in range(8, len(digits) + 1))
    return next(stem for stem in made if as_taken(stem) not in taken)


def as_taken(name: str) -> str:
    """Return a key that two names share if a file system may regard them as equal."""
    return unicodedata.normalize("NFC", name).casefold()


def _portable(name: str, digits: str = "") -> str:
    """Return a name that can be a folder on any system: printable, not hidden, no way out, of at most 100 bytes."""
    kept = "".join("_" if not c.isprintable() or c in _NOT_IN_NAMES else c for c in name).strip(". ")
    if not kept or _DEVICE.fullmatch(kept.partition(".")[0].rstrip()):
        kept = f"log-{kept}".rstrip("-")
    end = f"-{digits}" if digits else ""
    return kept.encode()[: _STEM_BYTES - len(end)].decode(errors="ignore").rstrip(". ") + end
