"""What every output of a run offers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

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


@dataclass(frozen=True, slots=True)
class Shown:
    """The estimators that a person is shown first; ``baseline`` is what the main one is held against, if anything."""

    main: str
    baseline: str | None = None


class Sink(ABC):
    """One output of one log, fed window by window.

    For each window :meth:`append_signals` comes at most once and :meth:`append` once per estimator and once for the
    track named ``truth`` (if there is one), in any order. The first track whose name was already given in the
    current window opens the next one. Then either :meth:`finish` or :meth:`abort` ends the sink; nothing stands
    under the final name before :meth:`finish` returns. ``lost``: what of the source this output cannot hold.
    """

    lost: tuple[Loss, ...] = ()

    def append_signals(self, signals: Signals) -> None:  # noqa: B027 (most outputs hold no inputs)
        """Take what the estimators saw in this window; nothing by default."""

    @abstractmethod
    def append(self, track: StateTrack) -> None:
        """Take one track [N] of this window."""

    @abstractmethod
    def finish(self, report: Mapping[str, Any], events: Sequence[Event] = ()) -> None:
        """Write what belongs to the whole log and give the output its final name.

        ``report`` is the document of :func:`pdhef_logtool.sinks.report.build_report`.
        """

    @abstractmethod
    def abort(self) -> None:
        """Remove what was written; harmless after :meth:`finish` and when called twice."""
