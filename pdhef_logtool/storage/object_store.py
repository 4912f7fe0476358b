"""A folder of an object store, by fsspec: objects appear complete or not at all.

Credentials come from the environment. Errors of a store are OutputErrors, which name the URL without credentials.
"""

import re
import weakref
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from pdhef_logtool.records.errors import OutputError, UsageError
from pdhef_logtool.records.processes import is_alive, process_name
from pdhef_logtool.storage.files import scratch_folder
from pdhef_logtool.storage.outputs import LOCK_FILE

_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+://.")
#: Schemes of object stores: their objects appear when they are complete.
_STORES = frozenset({"s3", "s3a", "gs", "gcs", "az", "abfs", "abfss", "memory"})
#: A lock that was not renewed for this time is left over. Stores refuse clocks that differ by more than 15 minutes.
LEFT_OVER_S = 1800.0
#: Timeouts and retries of S3, by botocore with growing waits.
_S3_CLIENT = {"connect_timeout": 15, "read_timeout": 60, "retries": {"mode": "standard", "total_max_attempts": 5}}
_AT_ONCE = 16
_CREDENTIALS = "give credentials that permit this, by the environment: docs/remote.md"


def is_url(place: Path | str) -> bool:
    """Return whether an output is a URL rather than a local folder."""
    return isinstance(place, str) and _URL.match(place) is not None


@dataclass(frozen=True, slots=True)
class ObjectFolder:
    """The objects below a URL of an object store, by their relative names: ``logs/drive/report.json``."""

    url: str

    @property
    def shown(self) -> str:
        """The URL for messages and files, without user, password and query."""
        parts = urlsplit(self.url)
        return f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}".rstrip("/")

    def names(self) -> list[str]:
        """Return the names of all objects, ascending."""
        with self._asking() as (store, root):
            paths = store.find(root)
        # Some stores give paths a slash more than they take.
        return sorted(path.lstrip("/").removeprefix(f"{root.lstrip('/')}/") for path in paths)

    def get(self, name: str, to: Path) -> bool:
        """Copy an object to a file; False if it does not exist."""
        with self._asking(name) as (store, root):
            partial = to.with_name(f".{to.name}.partial")
            to.parent.mkdir(parents=True, exist_ok=True)
            try:
                store.get_file(f"{root}/{name}", str(partial))
            except FileNotFoundError:
                return False
            partial.replace(to)
        return True

    def get_all(self, names: Iterable[str], folder: Path) -> None:
        """Copy objects to a folder, under their names, many at once."""
        with ThreadPoolExecutor(_AT_ONCE) as several:
            list(several.map(lambda name: self.get(name, folder / name), names))

    def put(self, name: str, path: Path) -> None:
        """Copy a file to an object, which is replaced."""
        with self._asking(name) as (store, root):
            store.put_file(str(path), f"{root}/{name}")

    def remove(self, names: Iterable[str]) -> None:
        """Remove objects, whether they are there or not."""

        def remove_one(name: str) -> None:  # not `rm`, which takes a name for a pattern
            with self._asking(name) as (store, root), suppress(FileNotFoundError):
                store.rm_file(f"{root}/{name}")

        with ThreadPoolExecutor(_AT_ONCE) as several:
            list(several.map(remove_one, names))

    def acquire(self) -> None:
        """Create the lock object of the folder; raises OutputError if another command has locked it.

        The lock of a command that has ended on this machine, or has not renewed it for long, is replaced.
        """
        with self._asking() as (store, root):
            if self._is_left_over(self._holder()):
                self.remove([LOCK_FILE])
            try:
                store.pipe_file(f"{root}/{LOCK_FILE}", process_name().encode(), mode="create")
            except Exception:
                if (holder := self._holder()) is None:
                    raise
                raise self._held(holder) from None

    def renew(self) -> None:
        """Renew the lock of the folder; raises OutputError if it is lost."""
        with self._asking() as (store, root):
            if (holder := self._holder()) != process_name():
                raise self._held(holder or "")
            store.pipe_file(f"{root}/{LOCK_FILE}", process_name().encode())

    def release(self) -> None:
        """Release the lock if this process has it."""
        with suppress(OutputError):
            if self._holder() == process_name():
                self.remove([LOCK_FILE])

    def _holder(self) -> str | None:
        with self._asking() as (store, root), suppress(FileNotFoundError):
            return bytes(store.cat_file(f"{root}/{LOCK_FILE}")).decode("ascii", "replace")
        return None

    def _is_left_over(self, holder: str | None) -> bool:
        if holder is None:
            return False
        with suppress(ValueError):
            if (alive := is_alive(holder)) is not None:
                return not alive
        with self._asking() as (store, root):
            age = datetime.now(UTC) - store.modified(f"{root}/{LOCK_FILE}").astimezone(UTC)
            return bool(age.total_seconds() > LEFT_OVER_S)

    def _held(self, holder: str) -> OutputError:
        process = ".".join(holder.split("-")[1:2])
        return OutputError(
            expected="an output folder that no other command is writing to",
            got=f"one that process {process} of this or another machine is writing to",
            where=self.shown,
            remedy=f"wait for it, choose another one, or remove {LOCK_FILE} there if that process has ended",
        )

    def _store(self) -> tuple[Any, str]:
        """Return the file system and the path there; fsspec opens it once a process."""
        import fsspec

        scheme = self.url.partition("://")[0].lower()
        try:
            if scheme not in _STORES:
                raise ValueError(f"{scheme}://, which is no object store")
            options = {"config_kwargs": _S3_CLIENT} if scheme in ("s3", "s3a") else {}
            store, root = fsspec.core.url_to_fs(self.url, use_listings_cache=False, **options)
        except (ImportError, ValueError) as error:
            raise UsageError(
                expected=f"a folder, or a URL of an object store ({', '.join(sorted(_STORES))})",
                got=" ".join(str(error).split()),
                where=self.shown,
                remedy="pip install 'pdhef-logtool[s3]' for s3://",
            ) from error
        return store, root.rstrip("/")

    @contextmanager
    def _asking(self, name: str = "") -> Iterator[tuple[Any, str]]:
        """Yield the file system and the path there; errors of a store become OutputErrors."""
        try:
            yield self._store()
        except (OutputError, UsageError):
            raise
        except Exception as error:
            got, remedy = words_of(error)
            where = f"{self.shown}/{name}".rstrip("/")
            expected = "an object store that can be used"
            raise OutputError(expected=expected, got=got, where=where, remedy=remedy) from error


def words_of(error: Exception) -> tuple[str, str]:
    """Return the cause of an error in one line without credentials, and a remedy."""
    kind = type(error).__name__
    text = getattr(error, "strerror", None) or (error.args[0] if error.args else "") or kind
    line = str(text).partition("\n")[0].partition("?")[0][:200]
    if isinstance(error, PermissionError):
        return f"a refusal ({line})", _CREDENTIALS
    if "Credentials" in kind or "Unauthorized" in kind:
        return "no credentials", _CREDENTIALS
    if isinstance(error, FileNotFoundError):
        return f"no such object ({line})", "check the URL; the bucket must exist"
    if "Connect" in kind or "Timeout" in kind:
        return f"no answer ({kind})", "check the network, the URL and AWS_ENDPOINT_URL, or try again later"
    return f"{kind}: {line}", "check the URL, or try again later"


def s3_system() -> Any:
    """Return fsspec's file system for S3."""
    import fsspec

    return fsspec.filesystem("s3", config_kwargs=_S3_CLIENT, use_listings_cache=False)


class Mirror:
    """A local copy of requested objects of an object folder; it is removed with its owner."""

    def __init__(self, url: str) -> None:
        self.objects = ObjectFolder(url)
        scratch = scratch_folder()
        weakref.finalize(self, scratch.cleanup)
        # Outputs contain the name of their folder.
        self.folder = Path(scratch.name) / (self.objects.shown.rpartition("/")[2] or "out")
        self.folder.mkdir()

    def fetch(self, name: str) -> Path | None:
        """Return the local file of an object, fetched once; None if it does not exist."""
        path = self.folder / name
        return path if path.is_file() or self.objects.get(name, path) else None
