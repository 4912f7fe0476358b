"""What every output of a run offers, and the file that appears only when it is complete."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, Self

from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.records.signals import Loss, Signals
from pdhef_logtool.records.tracks import StateTrack

#: Name of the track that holds the truth.
TRUTH = "truth"


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened in [start_ns, end_ns): a segment, a divergence, a loss."""

    name: str
    start_ns: int
    end_ns: int
    text: str


class Sink(Protocol):
    """One output of one log, fed window by window.

    For each window :meth:`append_signals` comes at most once and :meth:`append` once per estimator and once for the
    track named ``truth`` (if there is one), in any order. The first track whose name was already given in the
    current window opens the next one. Then either :meth:`finish` or :meth:`abort` ends the sink; nothing stands
    under the final name before :meth:`finish` returns.
    """

    @property
    def lost(self) -> tuple[Loss, ...]:
        """What of the source this output cannot hold."""
        ...

    def append_signals(self, signals: Signals) -> None:
        """Take what the estimators saw in this window."""
        ...

    def append(self, track: StateTrack) -> None:
        """Take one track of this window."""
        ...

    def finish(self, report: Mapping[str, Any], events: Sequence[Event] = ()) -> None:
        """Write what belongs to the whole log and give the output its final name.

        ``report`` is the document of :func:`pdhef_logtool.sinks.report.build_report`.
        """
        ...

    def abort(self) -> None:
        """Remove what was written; harmless after :meth:`finish` and when called twice."""
        ...


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
            raise _cannot_write(target, error) from error

    def commit(self) -> None:
        """Give the written file its final name; it is on the disk before the name is."""
        try:
            with self.path.open("rb") as file:
                os.fsync(file.fileno())
            self.path.replace(self.target)
        except OSError as error:
            self.discard()
            raise _cannot_write(self.target, error) from error

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
            raise _cannot_write(target, error) from error


def _cannot_write(target: Path, error: OSError) -> OutputError:
    return OutputError(
        expected="a place to write to",
        got=error.strerror or type(error).__name__,
        where=str(target),
        remedy="choose another output folder or free some space",
    )
