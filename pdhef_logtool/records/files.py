"""The file that appears only when it is complete."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Self

from pdhef_logtool.records.errors import OutputError


class PendingFile:
    """A file that is written beside its target and takes the target's name when it is complete.

    The temporary name depends on the target alone, so that what a killed run left behind is overwritten by the next.

    Raises
    ------
    OutputError
        When the folder cannot be made or written.
    """

    def __init__(self, target: Path) -> None:
        self.target = target
        self.path = target.with_name(f".{target.name}.partial")
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            self._remove()
        except OSError as error:
            raise cannot_write(target, error) from error

    def commit(self) -> None:
        """Give the written file its final name; it is on the disk before the name is."""
        try:
            with self.path.open("rb") as file:
                os.fsync(file.fileno())
            self.path.replace(self.target)
        except OSError as error:
            self.discard()
            raise cannot_write(self.target, error) from error

    def discard(self) -> None:
        """Remove the temporary file, if there is one."""
        with contextlib.suppress(OSError):
            self._remove()

    def _remove(self) -> None:
        self.path.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Commit on success, discard on an exception."""
        if kind is None:
            self.commit()
        else:
            self.discard()


def write_bytes(target: Path, data: bytes) -> None:
    """Write a whole file through a temporary name; raises OutputError when it cannot be written."""
    with PendingFile(target) as pending:
        try:
            pending.path.write_bytes(data)
        except OSError as error:
            raise cannot_write(target, error) from error


def cannot_write(target: Path, error: OSError) -> OutputError:
    """Return the error for a place that cannot be written."""
    return OutputError(
        expected="a place to write to",
        got=error.strerror or type(error).__name__,
        where=str(target),
        remedy="choose another output folder or free some space",
    )
