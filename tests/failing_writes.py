"""Makes the n-th call fail with which files are written, wherever in the program it stands."""

import errno
import io
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

#: The calls of ``os`` with which outputs come about, besides writing itself.
CALLS = ("fsync", "link", "mkdir", "rename", "replace")


class Failing:
    """Counts the calls; the ``number``-th fails, 0 fails none, and from then on every write (a disk stays full)."""

    def __init__(self, number: int, code: int) -> None:
        self.number, self.code, self.count = number, code, 0
        self._lock = threading.Lock()

    def call(self, *, again: bool) -> None:
        """Count one; ``again``: fails for good once something has failed."""
        with self._lock:
            self.count += 1
            if self.count == self.number or (again and 0 < self.number < self.count):
                raise OSError(self.code, os.strerror(self.code))


@contextmanager
def failing_writes(number: int, code: int = errno.ENOSPC, calls: tuple[str, ...] = CALLS) -> Iterator[Failing]:
    """Let the ``number``-th call of this block fail."""
    failing = Failing(number, code)

    class Raw(io.FileIO):
        def write(self, data: Any) -> int:
            failing.call(again=True)
            return super().write(data)

    open_path = Path.open

    def open_failing(self: Path, mode: str = "r", *arguments: Any, **options: Any) -> Any:
        if mode != "wb":
            return open_path(self, mode, *arguments, **options)
        failing.call(again=False)
        return io.BufferedWriter(Raw(os.fspath(self), "wb"))

    def wrapped(real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            failing.call(again=False)
            return real(*arguments, **options)

        return call

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Path, "open", open_failing)
        for name in calls:
            patch.setattr(os, name, wrapped(getattr(os, name)))
        yield failing
