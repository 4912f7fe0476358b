"""What every output of a run offers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pdhef_logtool.records.signals import FloatArray, IntArray, Loss, Signals
from pdhef_logtool.records.tracks import StateTrack

#: Name of the track that holds the truth.
TRUTH = "truth"

#: What positions are rounded to in files: a power of two, so that their last bytes are zero.
_PLACE_M = 2.0**-13


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


def single(values: FloatArray) -> FloatArray:
    """Round to single precision: the bytes that are zero then take no space in a compressed file."""
    with np.errstate(over="ignore"):
        return np.asarray(values, dtype=np.float32).astype(np.float64)


def to_place(values: FloatArray) -> FloatArray:
    """Round positions in m to 0.12 mm."""
    return np.asarray(np.round(values / _PLACE_M) * _PLACE_M, dtype=np.float64)


def first_of_slots(stamps_ns: IntArray, step_ns: int, before_ns: int | None) -> IntArray:
    """Return the rows [K] that open a slot of ``step_ns``; none that ``before_ns``, the stamp before, has opened."""
    slot = stamps_ns // step_ns
    before = slot[:1] - 1 if before_ns is None else np.array([before_ns // step_ns])
    return np.flatnonzero(np.diff(slot, prepend=before) != 0)


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
