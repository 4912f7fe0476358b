"""A web server on this machine: files with ranges and ETags, every request counted, faults on demand."""

import hashlib
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from email.utils import formatdate
from functools import lru_cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from tempfile import TemporaryDirectory

import pytest


@dataclass(frozen=True)
class Request:
    """A requested path, and the bytes [start, end) that were sent."""

    path: str
    start: int
    end: int
    headers: dict[str, str]


#: Action of a fault on the n-th request of a path (from 0). It returns True if it answered and recorded the request.
Fault = Callable[["_Handler", int], bool]


@dataclass
class CountingServer:
    """Files by path; ``without``: headers that are not sent. ``ranges`` False answers with all of a file."""

    files: dict[str, bytes] = field(default_factory=dict)
    requests: list[Request] = field(default_factory=list)
    fault: Fault | None = None
    ranges: bool = True
    without: frozenset[str] = frozenset()
    url: str = ""
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def place(self, path: str) -> str:
        """Return the URL of a file."""
        return f"{self.url}/{path}"

    @property
    def bytes_sent(self) -> int:
        """Bytes of files that went out."""
        return sum(r.end - r.start for r in self.requests)

    def twice(self) -> int:
        """Return how many bytes went out more than once, by file; a request of a byte is a check of the version."""
        total = 0
        for path in {r.path for r in self.requests}:
            reached = 0
            for start, end in sorted((r.start, r.end) for r in self.requests if r.path == path and r.end > r.start + 1):
                total += max(0, min(reached, end) - start)
                reached = max(reached, end)
        return total


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    of: CountingServer

    def log_message(self, *_: object) -> None:
        pass

    def do_GET(self) -> None:
        of, path = self.of, self.path.split("?")[0].lstrip("/")
        with of._lock:
            n = sum(r.path == path for r in of.requests)
        try:
            self._answer(path, n)
        except (BrokenPipeError, ConnectionResetError):
            self.close_connection = True

    def _answer(self, path: str, n: int) -> None:
        of, data = self.of, self.of.files.get(path)
        if of.fault is not None and of.fault(self, n):
            return
        if data is None or self.headers.get("If-Match", _etag(data)) != _etag(data):
            self.note(path, 0, 0)
            self.plain(404 if data is None else 412)
            return
        start, end, heads = 0, len(data), {"ETag": _etag(data), "Last-Modified": formatdate(1e9, usegmt=True)}
        if is_part := of.ranges and "Range" in self.headers:
            start, end = self.asked(len(data))
            heads["Content-Range"] = f"bytes {start}-{end - 1}/{len(data)}"
        if is_part and start >= len(data):
            self.note(path, 0, 0)
            self.plain(416, {"Content-Range": f"bytes */{len(data)}"})
            return
        self.note(path, start, end)
        self.send(206 if is_part else 200, {**heads, "Content-Length": str(end - start)})
        self.wfile.write(data[start:end])

    def asked(self, size: int) -> tuple[int, int]:
        """Return the range of bytes [start, end) that the request asks for."""
        low, _, high = self.headers["Range"].removeprefix("bytes=").partition("-")
        return int(low), min(int(high) + 1, size)

    def send(self, status: int, headers: dict[str, str]) -> None:
        self.send_response(status)
        for name, value in headers.items():
            if name not in self.of.without:
                self.send_header(name, value)
        self.end_headers()

    def note(self, path: str, start: int, end: int) -> None:
        with self.of._lock:
            self.of.requests.append(Request(path, start, end, dict(self.headers)))

    def plain(self, status: int, headers: dict[str, str] | None = None) -> None:
        self.send(status, {"Content-Length": "0", **(headers or {})})


@lru_cache(maxsize=64)
def _etag(data: bytes) -> str:
    return f'"{hashlib.md5(data, usedforsecurity=False).hexdigest()}"'


@contextmanager
def empty_cache() -> Iterator[None]:
    """Use an empty cache folder for remote logs."""
    with TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setenv("PDHEF_CACHE_DIR", folder)
        yield


@contextmanager
def serving(**files: bytes) -> Iterator[CountingServer]:
    """Serve files, by path, until the block ends; no earlier command has fetched any."""
    of = CountingServer(dict(files))
    handler = type("Handler", (_Handler,), {"of": of})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.daemon_threads = True
    of.url = f"http://127.0.0.1:{server.server_address[1]}"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        with empty_cache():
            yield of
    finally:
        server.shutdown()
        server.server_close()


def status(code: int, headers: dict[str, str] | None = None, times: int = 10**9, after: int = 0, of: str = "") -> Fault:
    """Answer requests ``after`` .. ``after + times`` of paths that begin with ``of`` with a status and no bytes."""

    def fault(handler: _Handler, n: int) -> bool:
        path = handler.path.split("?")[0].lstrip("/")
        if not (after <= n < after + times and path.startswith(of)):
            return False
        handler.note(path, 0, 0)
        handler.plain(code, headers)
        return True

    return fault


def cutting(after_bytes: int, times: int = 10**9) -> Fault:
    """Close the connection after some bytes of an answer."""

    def fault(handler: _Handler, n: int) -> bool:
        path = handler.path.lstrip("/")
        data = handler.of.files[path]
        start, end = handler.asked(len(data))
        if n >= times or end - start <= after_bytes:
            return False
        of_file = {"Content-Range": f"bytes {start}-{end - 1}/{len(data)}", "Content-Length": str(end - start)}
        handler.send(206, of_file)
        handler.wfile.write(data[start : start + after_bytes])
        handler.wfile.flush()
        handler.close_connection = True
        handler.note(path, start, start + after_bytes)
        return True

    return fault


def stalling(seconds: float) -> Fault:
    """Say nothing for some time, and close the connection."""

    def fault(handler: _Handler, _: int) -> bool:
        handler.note(handler.path.split("?")[0].lstrip("/"), 0, 0)
        time.sleep(seconds)
        handler.close_connection = True
        return True

    return fault
