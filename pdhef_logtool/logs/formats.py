"""The formats of logs (``formats.toml``): an entry defines how files of a format are recognised and opened.

A package adds formats by entry points of the group ``pdhef.log_formats``; each is a :class:`LogFormat`. Example, with
``Table`` (a topic with its own times) and ``TableLog`` of :mod:`~.table_log`::

    def open_npz(file: LogFile) -> DriveLog:
        with np.load(file.path) as archive:
            imu = {"ay": archive["ay"], "yaw_rate": archive["yaw_rate"]}
            stamps_ns = np.round(archive["t"] * 1e9).astype(np.int64)  # ascending, since 1970
        return TableLog(file, "npz", [Table.of_arrays("imu", stamps_ns, imu, {"ay": "g", "yaw_rate": "°/s"})])

    FORMAT = LogFormat("a NumPy archive", "npz_log:open_npz", (".npz",), b"PK", needs_suffix=True)
"""

import pkgutil
import tomllib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pdhef_logtool.logs.container import Container
from pdhef_logtool.logs.table_file import LogFile

if TYPE_CHECKING:
    from pdhef_logtool.logs.drive_log import DriveLog

GROUP = "pdhef.log_formats"
#: Bytes of a file's start by which its format is recognised.
HEAD_BYTES = 16
#: Suffixes of a file that is compressed as a whole, and its first bytes.
COMPRESSED_SUFFIXES = (".zstd", ".zst")
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
ROSBAG2_METADATA = "metadata.yaml"


@dataclass(frozen=True, slots=True)
class LogFormat:
    """One format.

    Attributes
    ----------
    title : for messages: ``an MCAP file``.
    opener : ``package.module:name`` of a function or class, which opens a :class:`LogFile` as a log, or as a container
        of messages, and raises LogError for a file of another format.
    libraries : None; or the opener is a reader of tables, which runs in a separate process
        (:mod:`~pdhef_logtool.logs.reader_process`), with the modules that it imports.
    suffixes : by which a search through folders takes files for logs. named : also, if it is named outright.
    magic : first bytes of every file, or several possible ones; empty: a file is recognised by its suffix.
    needs_suffix : whether files of other formats begin with the same bytes, so that the suffix must match too.
    is_general : whether such files often contain something else: a search through folders ignores them where logs of
        other formats are beside them. is_text : whether most of them do: it ignores them beside other general files.
    """

    title: str
    opener: str
    suffixes: tuple[str, ...]
    magic: bytes | tuple[bytes, ...] = b""
    needs_suffix: bool = False
    is_general: bool = False
    is_text: bool = False
    named: tuple[str, ...] = ()
    libraries: tuple[str, ...] | None = None

    def recognises(self, head: bytes, name: str) -> bool:
        """Return, by the first bytes and the name, whether a file is of this format."""
        if self.needs_suffix or not self.magic:
            return head.startswith(self.magic) and name.lower().endswith((*self.suffixes, *self.named))
        return head.startswith(self.magic)

    def open(self, file: LogFile) -> "DriveLog | Container":
        """Open a file."""
        if self.libraries is not None:
            from pdhef_logtool.logs.reader_process import open_tables

            return open_tables(file, self.opener, self.libraries)
        opener: Callable[[LogFile], Any] = pkgutil.resolve_name(self.opener)
        return opener(file)  # type: ignore[no-any-return]


def _shipped(opener: str, magic: Sequence[str] = (), **entries: Any) -> LogFormat:
    """Return a format of this package from its entries in ``formats.toml``."""
    entries |= {name: tuple(value) for name, value in entries.items() if isinstance(value, list)}
    starts = tuple(start.encode("latin-1") for start in magic) or b""
    return LogFormat(opener=f"{__package__}.{opener}", magic=starts, **entries)


_FILE = Path(__file__).with_suffix(".toml")
FORMATS = tuple(_shipped(**entries) for entries in tomllib.loads(_FILE.read_text(encoding="utf-8"))["formats"])


@cache
def formats_of_other_packages() -> tuple[LogFormat, ...]:
    """Return the formats of installed plug-ins, by the names of their entry points."""
    from importlib.metadata import entry_points

    entries = sorted(entry_points(group=GROUP), key=lambda entry: entry.name)
    return tuple(entry.load() for entry in entries)


def _every_format() -> Iterator[LogFormat]:
    """Yield all formats. Those of other packages are last, so that they are searched for only if necessary."""
    yield from FORMATS
    yield from formats_of_other_packages()


def recognised_format(head: bytes, name: str) -> LogFormat | None:
    """Return the format of a file by its first :data:`HEAD_BYTES` and its name; None if it is not a log."""
    return next((f for f in _every_format() if f.recognises(head, name)), None)


def log_suffixes() -> tuple[str, ...]:
    """Return the suffixes of logs in a search through folders."""
    return tuple(suffix for f in _every_format() for suffix in f.suffixes)


def without_general(names: set[str]) -> set[str]:
    """Return the names of the logs in one folder, without those of general formats beside others."""
    for only_texts in (False, True):
        ends = _ends(f for f in _every_format() if f.is_general and f.is_text >= only_texts)
        if kept := {name for name in names if not name.endswith(ends)}:
            return kept
    return names


def _ends(formats: Iterable[LogFormat]) -> tuple[str, ...]:
    ends = [suffix for f in formats for suffix in (*f.suffixes, *f.named)]
    return tuple(suffix + compressed for suffix in ends for compressed in ("", *COMPRESSED_SUFFIXES))


def what_is_a_log() -> str:
    """Return the formats in words."""
    return f"{', '.join(f.title for f in _every_format())} or a rosbag2 folder"
