"""Objects on servers, asked for ranges of their bytes: HTTP by aiohttp, S3 by aiobotocore, both as fsspec sets them up.

Each response is compared with the state of the object when it was opened. If a new request can help, the
error is :class:`TryAgainError`; any other error is final.
"""

from __future__ import annotations

import asyncio
import re
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from dataclasses import dataclass
from typing import Any, NoReturn, TypeVar

from pdhef_logtool.logs.byte_source import ChangedError, SourceError
from pdhef_logtool.logs.remote_place import RemotePlace
from pdhef_logtool.records.extras import required

T = TypeVar("T")

_BLOCK_BYTES = 1 << 20
#: Progress from which on a cut answer counts as none of the tries.
_PROGRESS_BYTES = 64 << 10
#: Temporary status codes: too many requests, timeouts, restarts.
_PASSING = frozenset({408, 425, 429, 500, 502, 503, 504, 520, 521, 522, 523, 524})
_REFUSED = {401: "it asks who you are", 403: "it refuses access", 407: "the proxy asks who you are"}
_CONTENT_RANGE = re.compile(r"bytes (?:(\d+)-(\d+)|\*)/(\d+|\*)")


@dataclass(frozen=True, slots=True)
class Patience:
    """Timeouts and retries: silence of a connection, tries of a range without progress, waits between tries."""

    connect_s: float = 15.0
    silence_s: float = 30.0
    tries: int = 5
    first_wait_s: float = 0.5
    most_wait_s: float = 20.0


PATIENCE = Patience()


class TryAgainError(Exception):
    """The response is incomplete; a new request may help. ``wait_s`` is the wait that the server asks for, else 0."""

    def __init__(self, what: str, wait_s: float = 0.0) -> None:
        super().__init__(what)
        self.wait_s = wait_s


@dataclass(frozen=True, slots=True)
class ObjectState:
    """State of an object when it was opened: bytes, and the server's names of this version (empty: none)."""

    size: int
    etag: str
    modified: str


EMPTY = ObjectState(0, "", "")


@dataclass(frozen=True, slots=True)
class Answer:
    """A response in transfer: the object's state, the offset of its bytes, and the bytes. Size -1: known at the end."""

    state: ObjectState
    start: int
    blocks: AsyncIterator[bytes]


class RemoteObject(ABC):
    """An object that gives ranges of its bytes."""

    def __init__(self, place: RemotePlace, system: Any) -> None:
        self.place = place
        self._system = system  # of fsspec

    @property
    def loop(self) -> asyncio.AbstractEventLoop:
        """The loop that its requests run on, in another thread."""
        loop: asyncio.AbstractEventLoop = self._system.loop
        return loop

    @abstractmethod
    def ask(self, start: int, end: int, pinned: ObjectState | None) -> AbstractAsyncContextManager[Answer]:
        """Request bytes [start, end); with ``pinned`` only if the object is unchanged.

        Raises
        ------
        TryAgainError : no response yet. SourceError : the object does not exist or is unreadable.
        """

    def error(self, got: str, remedy: str, expected: str = "an object that can be read") -> SourceError:
        """Return the error for this object."""
        return SourceError(expected=expected, got=got, where=str(self.place), remedy=remedy)

    def changed(self, what: str) -> ChangedError:
        """Return the error for an object that has changed since it was opened."""
        return ChangedError(
            expected="the object that was opened",
            got=f"another one ({what})",
            where=str(self.place),
            remedy="run again when nothing writes to it any more",
        )

    def refuse(self, status: int, wait_s: float) -> NoReturn:
        """Raise the error of a status without content."""
        if status in _PASSING:
            raise TryAgainError(f"status {status}", wait_s)
        if status in (412, 416):
            raise self.changed(f"status {status}")
        if status in _REFUSED:
            remedy = "give credentials by the environment: docs/remote.md"
            raise self.error(f"status {status}: {_REFUSED[status]}", remedy)
        if status in (404, 410):
            raise self.error("no such object", "check the URL")
        raise self.error(f"status {status}", "check the URL")

    def require_unchanged(self, pinned: ObjectState | None, state: ObjectState) -> None:
        """Raise the error for a changed object if two states differ."""
        if pinned is None:
            return
        for was, now, what in (
            (pinned.etag, state.etag, "its ETag changed"),
            (pinned.modified, state.modified, "it was modified"),
        ):
            if was and now and was != now:
                raise self.changed(what)
        if state.size not in (-1, pinned.size):
            raise self.changed(f"{state.size} bytes instead of {pinned.size}")


def remote_object(place: RemotePlace) -> RemoteObject:
    """Return the object at a place, without a request.

    Raises
    ------
    UsageError : A required package is not installed.
    """
    return S3Object(place) if place.scheme == "s3" else HttpObject(place)


class HttpObject(RemoteObject):
    """An object of a web server, whose redirects are checked. Proxies and ``netrc`` are the environment's."""

    def __init__(self, place: RemotePlace) -> None:
        aiohttp = required("aiohttp", "http", f"reads {place.scheme}://", place)
        import fsspec

        timeout = aiohttp.ClientTimeout(total=None, sock_connect=PATIENCE.connect_s, sock_read=PATIENCE.silence_s)
        client: dict[str, Any] = {"trust_env": True, "auto_decompress": False, "timeout": timeout}
        options: dict[str, Any] = {}
        if not place.private_redirects:
            import yarl

            from pdhef_logtool.logs.redirect_guard import guarded_client

            client["origin"] = yarl.URL(place.url).raw_host or ""
            options["get_client"] = guarded_client
        super().__init__(place, fsspec.filesystem("http", client_kwargs=client, **options))

    @asynccontextmanager
    async def ask(self, start: int, end: int, pinned: ObjectState | None) -> AsyncIterator[Answer]:
        """See :class:`RemoteObject`."""
        import aiohttp
        import yarl

        from pdhef_logtool.logs.redirect_guard import PrivateRedirectError

        headers = {"Range": f"bytes={start}-{end - 1}", "Accept-Encoding": "identity", **_conditions(pinned)}
        url = self.place.url
        try:
            session = await self._system.set_session()
            # An encoded URL is sent unchanged: a signature may depend on its characters.
            asked = yarl.URL(url, encoded=url.isascii() and url.isprintable() and " " not in url)
            async with session.get(asked, headers=headers) as response:
                yield self._answer(response, start, end, pinned)
        except PrivateRedirectError as error:
            raise self.error(
                f"a redirect to {error}, an address of this machine or its network",
                "give the URL that it leads to, or allow it by --set allow_private_redirects=true",
                "an object, or a redirect to a public address",
            ) from None
        except (aiohttp.InvalidURL, aiohttp.NonHttpUrlClientError, aiohttp.TooManyRedirects, ValueError):
            raise self.error("a URL that cannot be asked for", "check the URL") from None
        except (aiohttp.ClientConnectorCertificateError, aiohttp.ClientSSLError):
            raise self.error("a server without a valid certificate", "check the URL") from None
        except aiohttp.ClientConnectorDNSError:
            raise TryAgainError(f"no such server as {self.place.host}") from None
        except (aiohttp.ServerTimeoutError, TimeoutError):
            raise TryAgainError(f"silence of {PATIENCE.silence_s:g} s") from None
        except aiohttp.ClientPayloadError:
            raise TryAgainError("an answer that is cut") from None
        except (aiohttp.ClientError, OSError) as error:  # without its text, which can contain the URL
            why = getattr(error, "strerror", None) or type(error).__name__
            raise TryAgainError(f"no connection ({why})") from None

    def _answer(self, response: Any, start: int, end: int, pinned: ObjectState | None) -> Answer:
        head: Mapping[str, str] = response.headers
        etag, modified = head.get("ETag", ""), head.get("Last-Modified", "")
        part = _CONTENT_RANGE.fullmatch(head.get("Content-Range", "").strip())
        if response.status == 416 and pinned is None and part is not None and part[3] == "0":
            return Answer(ObjectState(0, etag, modified), 0, _nothing())
        if response.status == 206 and part is not None and part[1] is not None and part[3] != "*":
            state = ObjectState(int(part[3]), etag, modified)
            self.require_unchanged(pinned, state)
            if int(part[1]) != start or int(part[2]) >= end:
                raise self.error("other bytes than were asked for", "the server does not give ranges: read a copy")
            return Answer(state, start, response.content.iter_chunked(_BLOCK_BYTES))
        if response.status == 200:  # the server gives no ranges: all of it comes
            if head.get("Content-Encoding", "identity") != "identity":
                raise self.error("an answer that is compressed on its way", "read a copy")
            state = ObjectState(int(head.get("Content-Length", -1)), etag, modified)
            self.require_unchanged(pinned, state)
            return Answer(state, 0, response.content.iter_chunked(_BLOCK_BYTES))
        if response.status == 206:
            raise self.error("a part of unknown size", "the server does not give ranges: read a copy")
        return self.refuse(response.status, _seconds(head.get("Retry-After", "")))


class S3Object(RemoteObject):
    """An object of an S3 store. Credentials, region and endpoint are what the environment gives to any AWS tool."""

    def __init__(self, place: RemotePlace) -> None:
        super().__init__(place, s3_system(place))

    @asynccontextmanager
    async def ask(self, start: int, end: int, pinned: ObjectState | None) -> AsyncIterator[Answer]:
        """See :class:`RemoteObject`."""
        from botocore.exceptions import ClientError

        asked: dict[str, str] = {"Bucket": self.place.host, "Key": self.place.key, "Range": f"bytes={start}-{end - 1}"}
        if pinned is not None and pinned.etag:
            asked["IfMatch"] = pinned.etag
        async with self.client() as client:
            try:
                response = await client.get_object(**asked)
            except ClientError as error:
                if _status_of(error)[0] != 416 or pinned is not None:
                    raise
                yield Answer(EMPTY, 0, _nothing())  # an empty object, which has no range
                return
            async with response["Body"] as body:
                yield self._answer(response, body, start, pinned)

    @asynccontextmanager
    async def client(self) -> AsyncIterator[Any]:
        """Yield the client of the bucket; convert its errors."""
        import aiohttp
        from botocore.exceptions import (
            BotoCoreError,
            ClientError,
            HTTPClientError,
            IncompleteReadError,
            NoCredentialsError,
            ResponseStreamingError,
        )

        try:
            await self._system.set_session()
            yield await self._system.get_s3(self.place.host)
        except ClientError as error:
            self.refuse(*_status_of(error))
        except NoCredentialsError:
            raise self.error("no credentials", "give them by the environment: docs/remote.md") from None
        except (IncompleteReadError, ResponseStreamingError, aiohttp.ClientPayloadError):
            raise TryAgainError("an answer that is cut") from None
        except (HTTPClientError, TimeoutError, aiohttp.ClientError, OSError) as error:
            raise TryAgainError(f"no answer ({type(error).__name__})") from None
        except BotoCoreError as error:
            raise self.error(f"a request that cannot be made ({type(error).__name__})", "check the URL") from None

    def _answer(self, response: Mapping[str, Any], body: Any, start: int, pinned: ObjectState | None) -> Answer:
        modified = response.get("LastModified")
        part = _CONTENT_RANGE.fullmatch(str(response.get("ContentRange", "")))
        size = int(part[3]) if part is not None and part[3] != "*" else int(response["ContentLength"])
        state = ObjectState(size, response.get("ETag", ""), "" if modified is None else modified.isoformat())
        self.require_unchanged(pinned, state)
        first = int(part[1]) if part is not None and part[1] is not None else 0
        if part is not None and first != start:
            raise self.error("other bytes than were asked for", "the store does not give ranges: read a copy")
        return Answer(state, first, body.iter_chunks(_BLOCK_BYTES))


def keys_below(prefix: RemotePlace) -> list[str]:
    """Return the keys of all objects of a store that begin with a prefix.

    Raises
    ------
    SourceError : The store does not list them.
    """
    store = S3Object(prefix)

    async def listed() -> list[str]:
        keys: list[str] = []
        async with store.client() as client:
            pages = client.get_paginator("list_objects_v2").paginate(Bucket=prefix.host, Prefix=prefix.key)
            async for page in pages:
                keys += [str(entry["Key"]) for entry in page.get("Contents", ())]
        return keys

    return asyncio.run_coroutine_threadsafe(try_in_turn(listed, store), store.loop).result()


async def try_in_turn(
    once: Callable[[], Awaitable[T]], remote: RemoteObject, place: Callable[[], int] = lambda: 0
) -> T:
    """Call a function until it succeeds and return its result; give up after several tries without progress.

    Parameters
    ----------
    place : returns the number of bytes received so far.

    Raises
    ------
    SourceError : All tries failed, or one failed for good.
    """
    tries, reached = 0, place()
    while True:
        try:
            return await once()
        except TryAgainError as error:
            tries += 1
            if place() - reached >= _PROGRESS_BYTES:
                tries, reached = 1, place()
            if tries >= PATIENCE.tries:
                got = f"{error}, {tries} times in turn"
                raise remote.error(got, "try again later", "a server that answers") from None
            wait_s = max(error.wait_s, PATIENCE.first_wait_s * 2 ** (tries - 1))
            await asyncio.sleep(min(wait_s, PATIENCE.most_wait_s))


def s3_system(place: RemotePlace) -> Any:
    """Return fsspec's file system for S3, which asks once: how often a request is made again is decided here."""
    required("s3fs", "s3", "reads s3://", place)
    import fsspec

    client = {
        "connect_timeout": PATIENCE.connect_s,
        "read_timeout": PATIENCE.silence_s,
        "retries": {"total_max_attempts": 1},
    }
    return fsspec.filesystem("s3", config_kwargs=client, use_listings_cache=False)


def _conditions(pinned: ObjectState | None) -> dict[str, str]:
    """Return the headers by which a server refuses another version; a weak ETag never matches a range."""
    if pinned is None:
        return {}
    if pinned.etag and not pinned.etag.startswith("W/"):
        return {"If-Match": pinned.etag}
    return {"If-Unmodified-Since": pinned.modified} if pinned.modified else {}


def _status_of(error: Any) -> tuple[int, float]:
    """Return status and seconds to wait of an S3 error."""
    metadata = error.response.get("ResponseMetadata", {})
    status, code = int(metadata.get("HTTPStatusCode") or 0), str(error.response.get("Error", {}).get("Code", ""))
    if code in ("SlowDown", "RequestTimeout", "ThrottlingException", "RequestLimitExceeded"):
        status = 503
    return status, _seconds(metadata.get("HTTPHeaders", {}).get("retry-after", ""))


def _seconds(text: str) -> float:
    """Return the seconds of a Retry-After header; 0 where it gives a date, or none."""
    return float(text) if text.strip().isdecimal() else 0.0


async def _nothing() -> AsyncIterator[bytes]:
    for block in (b"",):
        yield block
