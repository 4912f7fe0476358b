"""Bytes of an object on a server, by fsspec: each block is fetched once, into a local copy from which all reads come.

Copies are in the user's cache folder, so that later commands do not fetch the same bytes again. The folder of a copy is
named by the hash of URL, size and version of the object. It contains the fetched parts of the object at their places in
a file, and an index with the extent and CRC of each of them. A damaged part is fetched again.

Missing blocks that follow each other are one request of at most 8 MB; four requests run in parallel. Each answer is
compared with the state of the object when it was opened.
"""

import asyncio
import hashlib
import os
import re
import shutil
import weakref
from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Iterable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import ExitStack, asynccontextmanager, suppress
from functools import cached_property
from http import HTTPStatus
from io import DEFAULT_BUFFER_SIZE
from pathlib import Path
from threading import Lock
from typing import Any

from isal.isal_zlib import crc32

from pdhef_logtool.logs.byte_source import ByteSource, ChangedError, SourceError, read_at
from pdhef_logtool.logs.redirect_guard import PrivateRedirectError, guarded_client
from pdhef_logtool.logs.remote_place import RemotePlace
from pdhef_logtool.logs.resource_limits import KIB, MIB
from pdhef_logtool.records.extras import required
from pdhef_logtool.storage.files import WINDOWS, scratch_folder, take_lock
from pdhef_logtool.storage.object_store import s3_system, words_of

BLOCK_BYTES, MOST_RANGE_BYTES = 64 * KIB, 8 * MIB
AT_ONCE = 4
#: Waits before a request is repeated, and timeouts. S3 requests are repeated by its library.
WAITS_S = (0.5, 1.0, 2.0, 4.0)
CONNECT_S, SILENCE_S = 15.0, 30.0
_CONTENT_RANGE = re.compile(r"bytes (\d+)-\d+/(\d+)")


#: Size of all copies together; least recently used ones are removed.
CACHE_BYTES = 4096 * MIB


class RemoteCopy:
    """Some bytes of one version of an object, in a file that several processes may fill.

    Parameters
    ----------
    name : of the object.
    identity : of its version; empty, or without a writable cache folder with locks: the copy is temporary.

    Attributes
    ----------
    path : the file.
    """

    def __init__(self, name: str, identity: str) -> None:
        self._lock, stack = Lock(), ExitStack()
        self.close = weakref.finalize(self, stack.close)
        stack.callback(_evict)
        try:
            self._open(stack, _cache_folder() / identity if identity else None, name)
        except (OSError, RuntimeError):  # also a user without a home
            self._open(stack, None, name)

    def _open(self, stack: ExitStack, cached: Path | None, name: str) -> None:
        folder = Path(stack.enter_context(scratch_folder())) if cached is None else cached
        self.path, index = folder / "object" / (name.replace("/", "_")[-80:] or "log"), folder / "index"
        self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        self._index = stack.enter_context(index.open("a+b", buffering=0))
        is_held = cached is None or WINDOWS or take_lock(self._index.fileno(), exclusive=False)
        if not (is_held and index.exists()):
            raise FileNotFoundError  # another process is removing the copy
        os.utime(index)
        self.path.touch()
        self._file = stack.enter_context(self.path.open("r+b", buffering=0))

    def write(self, offset: int, data: bytes) -> None:
        """Write bytes at an offset; raises OSError without room for them."""
        with self._lock:
            self._file.seek(offset)
            self._file.write(data)

    def read(self, offset: int, size: int) -> bytes:
        """Read bytes that were written."""
        with self._lock:
            return read_at(self._file, offset, size, offset + size)

    def note(self, start: int, end: int, crc: int) -> None:
        """Add bytes [start, end), which were written, to the index."""
        self._index.write(b"%d %d %d\n" % (start, end, crc))

    def extents(self) -> Iterator[tuple[int, int]]:
        """Yield [start, end) of the intact parts of the index."""
        self._index.seek(0)
        for line in self._index.readlines():
            with suppress(ValueError):  # a line that was cut off
                start, end, stated = map(int, line.split())
                crc = 0
                for offset in range(start, end, DEFAULT_BUFFER_SIZE):
                    crc = crc32(self.read(offset, min(DEFAULT_BUFFER_SIZE, end - offset)), crc)
                if crc == stated:
                    yield start, end


def _cache_folder() -> Path:
    caches = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(os.environ.get("PDHEF_CACHE_DIR") or Path(caches, "pdhef")) / "remote"


def _evict() -> None:
    """Remove the least recently used copies that are not in use, until the others fit in CACHE_BYTES."""
    total = 0
    with suppress(OSError, RuntimeError):
        for index in sorted(_cache_folder().glob("*/index"), key=lambda path: -path.stat().st_mtime):
            files = [path.stat() for path in (index.parent / "object").iterdir()]
            total += sum(getattr(file, "st_blocks", file.st_size >> 9) << 9 for file in files)
            with index.open("rb") as file:
                # Windows does not remove open files.
                if total > CACHE_BYTES and (WINDOWS or take_lock(file.fileno())):
                    shutil.rmtree(index.parent, ignore_errors=True)


class RemoteSource(ByteSource):
    """An object on a server, read through a local copy. Any read fails if the object has changed since it was opened.

    Raises
    ------
    SourceError : It does not exist, may not be read, or the server does not respond.
    UsageError : A required package is not installed.
    """

    is_remote = True

    def __init__(self, place: RemotePlace) -> None:
        self._place, self._system = place, _file_system(place)
        self._size: int | None = None
        self._version = ""
        self._requests: list[Future[None]] = []
        self._lock = Lock()
        self._at_once = asyncio.Semaphore(AT_ONCE)
        self._start(self._get, 0, 1).result()
        super().__init__(self._size or 0)

    @cached_property
    def _blocks(self) -> dict[int, Future[None]]:
        """Requests by the number of the block that they fetch."""
        return {n: _DONE for start, end in self._copy.extents() for n in _numbers(start, end)}

    @property
    def path(self) -> Path:
        """The copy: fetched blocks are valid, all of it after :meth:`fetch_whole`."""
        return self._copy.path

    def identity(self, size: int) -> str:
        """Return the hash of the URL without access tokens, of the size, and of ETag or time of modification."""
        return hashlib.sha256("\0".join((self._place.identity, str(size), self._version)).encode()).hexdigest()

    def fetch(self, offset: int, size: int) -> bytes:
        """See :class:`ByteSource`."""
        end = min(offset + size, self.size)
        self._wait(offset, end)
        return self._copy.read(offset, end - offset) if end > offset else b""

    def held_size(self, offset: int, size: int) -> int:
        """Return the bytes up to the end of the block: a read fetches whole blocks."""
        return min(size, BLOCK_BYTES - offset % BLOCK_BYTES)

    def prefetch(self, extents: Iterable[tuple[int, int]]) -> None:
        """See :class:`ByteSource`."""
        self._order([(max(start, 0), min(end, self.size)) for start, end in extents])

    def fetch_whole(self) -> None:
        """Fetch the whole object into the copy."""
        self._wait(0, self.size)

    def close(self) -> None:
        """Stop all requests and release the copy."""
        for request in self._requests:
            request.cancel()
        self._copy.close()

    def _order(self, extents: Iterable[tuple[int, int]]) -> Collection[Future[None]]:
        """Start to fetch the missing blocks of some extents; return the requests that bring all blocks of them."""
        wanted = sorted({n for start, end in extents if end > start for n in _numbers(start, end)})
        with self._lock:
            runs: list[range] = []
            for n in (n for n in wanted if n not in self._blocks):
                if runs and n == runs[-1].stop and len(runs[-1]) * BLOCK_BYTES < MOST_RANGE_BYTES:
                    runs[-1] = range(runs[-1].start, n + 1)
                else:
                    runs.append(range(n, n + 1))
            for run in runs:
                request = self._start(self._get, run.start * BLOCK_BYTES, min(run.stop * BLOCK_BYTES, self.size))
                self._requests.append(request)
                self._blocks.update(dict.fromkeys(run, request))
            return dict.fromkeys(self._blocks[n] for n in wanted)

    def _wait(self, start: int, end: int) -> None:
        """Return when bytes [start, end) are in the copy; raises SourceError if they cannot be fetched."""
        for request in self._order([(start, end)]):
            request.result()

    def _start(self, request: Callable[..., Awaitable[None]], *arguments: int) -> Future[None]:
        return asyncio.run_coroutine_threadsafe(_repeated(self._place, request, *arguments), self._system.loop)

    async def _get(self, start: int, end: int) -> None:
        async with self._at_once, self._ask(start, end) as (size, first, blocks):
            position, crc = first, 0
            async for block in blocks:
                try:
                    self._copy.write(position, block)
                except OSError:
                    remedy = "set PDHEF_CACHE_DIR to a folder on another"
                    raise _error(self._place, "no room for its bytes on this disk", remedy) from None
                position, crc = position + len(block), crc32(block, crc)
        size = position if size is None else size
        if position < min(end, size):
            raise ConnectionError("an answer that is cut")
        if self._size is None:
            self._size = size
        if position - first >= min(BLOCK_BYTES, size):
            self._copy.note(first, position, crc)

    @asynccontextmanager
    async def _ask(self, start: int, end: int) -> AsyncIterator[tuple[int | None, int, AsyncIterator[bytes]]]:
        """Request bytes [start, end); yield object size, offset of the response (0: all bytes) and its blocks."""
        place, part = self._place, f"bytes={start}-{end - 1}"
        if place.scheme == "s3":
            asked = {"Bucket": place.host, "Key": place.key, "Range": part}
            if self._size is None and (await self._system._info(f"{place.host}/{place.key}"))["size"] == 0:
                del asked["Range"]  # an empty object has no range
            response = await self._system._call_s3("get_object", **asked)
            async with response["Body"] as body:
                head = {"Content-Length": response["ContentLength"], "ETag": response["ETag"]}
                head["Content-Range"] = response.get("ContentRange", "")
                yield *self._compared(head), body.iter_chunks(MIB)
            return
        headers = {"Range": part, "Accept-Encoding": "identity"}
        session = await self._system.set_session()
        async with session.get(self._system.encode_url(place.url), headers=headers) as response:
            is_no_range = response.status == HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE
            if is_no_range and response.headers.get("Content-Range") == "bytes */0":
                async with session.get(self._system.encode_url(place.url)) as empty:
                    yield *self._compared(empty.headers), empty.content.iter_chunked(MIB)
                return
            if response.status not in (HTTPStatus.OK, HTTPStatus.PARTIAL_CONTENT):
                is_of_server = response.status >= HTTPStatus.INTERNAL_SERVER_ERROR
                kind = ConnectionError if is_of_server else _ERRORS.get(response.status, OSError)
                raise kind(f"status {response.status}")
            yield *self._compared(response.headers), response.content.iter_chunked(MIB)

    def _compared(self, head: Mapping[str, Any]) -> tuple[int | None, int]:
        """Return size and offset of an answer; raises ChangedError if the object is not the one that was opened."""
        part = _CONTENT_RANGE.match(str(head.get("Content-Range", "")))
        length = part[2] if part else head.get("Content-Length")
        size, version = None if length is None else int(length), head.get("ETag") or head.get("Last-Modified") or ""
        if self._size is None:
            self._version = version
            self._copy = RemoteCopy(self._place.name, self.identity(size) if version and size else "")
        elif version not in ("", self._version) or size not in (None, self._size):
            raise ChangedError(
                expected="the object that was opened",
                got="another one (its size, ETag or time of modification differs)",
                where=self._place,
                remedy="run again when the object no longer changes",
            )
        return size, int(part[1]) if part else 0


def identity_of_object(place: RemotePlace) -> str:
    """Return the hash of URL, size and version of an object; raises SourceError."""
    source = RemoteSource(place)
    source.close()
    return source.identity(source.size)


def keys_below(prefix: RemotePlace) -> list[str]:
    """Return the keys of all objects of a store that begin with a prefix; raises SourceError."""
    system = _file_system(prefix)
    listed = _repeated(prefix, system._find, f"{prefix.host}/{prefix.key}".rstrip("/"))
    paths: list[str] = asyncio.run_coroutine_threadsafe(listed, system.loop).result()
    return [path.removeprefix(f"{prefix.host}/") for path in paths]


async def _repeated(place: RemotePlace, request: Callable[..., Awaitable[Any]], *arguments: object) -> Any:
    """Return the result of a request, which is repeated after a temporary failure; raises SourceError."""
    for wait_s in (*WAITS_S, None):
        try:
            return await request(*arguments)
        except SourceError:
            raise
        except Exception as error:  # noqa: BLE001 (of any library; it becomes one line)
            got, remedy, temporary = _words_of(error)
            if wait_s is None or not temporary:
                tries = f", {len(WAITS_S) + 1} times in turn" if temporary else ""
                expected = "a server that answers" if temporary else "an object that can be read"
                raise _error(place, f"{got}{tries}", remedy, expected) from None
        await asyncio.sleep(wait_s)
    raise AssertionError


def _error(place: RemotePlace, got: str, remedy: str, expected: str = "an object that can be read") -> SourceError:
    return SourceError(expected=expected, got=got, where=place, remedy=remedy)


def _words_of(error: Exception) -> tuple[str, str, bool]:
    """Return cause, remedy, and whether a new request may help; without aiohttp's texts, which can contain the URL."""
    import aiohttp

    if isinstance(error, PrivateRedirectError):
        remedy = "give the URL that it leads to, or allow it by --set allow_private_redirects=true"
        return f"a redirect to {error}, an address of this machine or its network", remedy, False
    url, later = "check the URL", "try again later"
    invalid = (aiohttp.InvalidURL, aiohttp.NonHttpUrlClientError, aiohttp.TooManyRedirects, ValueError)
    reason = getattr(error, "strerror", None) or type(error).__name__
    causes: tuple[tuple[Any, str, str], ...] = (
        (aiohttp.ClientSSLError, "a server without a valid certificate", url),
        (invalid, "a URL that cannot be requested", url),
        (ConnectionError, str(error), later),
        (aiohttp.ClientPayloadError, "an answer that is cut", later),
        (TimeoutError, f"silence of {SILENCE_S:g} s", later),
        (aiohttp.ClientError, f"no connection ({reason})", f"{url}, or {later}"),
    )
    for kinds, cause, remedy in causes:
        if isinstance(error, kinds):
            return cause, remedy, later in remedy
    return *words_of(error), False


#: Errors by status. Timeouts, too many requests and 5xx are temporary, as a lost connection is.
_ERRORS: Mapping[int, type[OSError]] = {
    HTTPStatus.REQUEST_TIMEOUT: ConnectionError,
    HTTPStatus.TOO_EARLY: ConnectionError,
    HTTPStatus.TOO_MANY_REQUESTS: ConnectionError,
    HTTPStatus.UNAUTHORIZED: PermissionError,
    HTTPStatus.FORBIDDEN: PermissionError,
    HTTPStatus.PROXY_AUTHENTICATION_REQUIRED: PermissionError,
    HTTPStatus.NOT_FOUND: FileNotFoundError,
    HTTPStatus.GONE: FileNotFoundError,
}


def _file_system(place: RemotePlace) -> Any:
    """Return fsspec's file system of a place. Proxies and ``netrc`` are the environment's; redirects are checked."""
    if place.scheme == "s3":
        required("s3fs", "s3", "reads s3://", place)
        return s3_system()
    aiohttp = required("aiohttp", "http", f"reads {place.scheme}://", place)
    import fsspec
    import yarl

    timeout = aiohttp.ClientTimeout(total=None, sock_connect=CONNECT_S, sock_read=SILENCE_S)
    client: dict[str, Any] = {"trust_env": True, "auto_decompress": False, "timeout": timeout}
    options: dict[str, Any] = {}
    if not place.private_redirects:
        client["origin"] = yarl.URL(place.url).raw_host or ""
        options["get_client"] = guarded_client
    # An encoded URL is sent unchanged: a signature may depend on its characters.
    encoded = place.url.isascii() and place.url.isprintable() and " " not in place.url
    return fsspec.filesystem("http", client_kwargs=client, encoded=encoded, **options)


def _numbers(start: int, end: int) -> range:
    """Return the numbers of the blocks with bytes [start, end)."""
    return range(start // BLOCK_BYTES, -(-end // BLOCK_BYTES))


#: The request of blocks that the copy has.
_DONE: Future[None] = Future()
_DONE.set_result(None)
