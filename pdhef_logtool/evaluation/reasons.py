"""When an estimator had a reason not to use its sensors as usual: intervals, and a summary of them.

An interval of a reason runs from a stamp with its bit to the last one with it that follows no more than
:data:`MERGE_S` behind the one before: a gyro that is stuck for seconds is one interval, though a sample of it may move.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pdhef_logtool.records.reasons import REASONS
from pdhef_logtool.records.signals import IntArray
from pdhef_logtool.records.tracks import StateTrack

#: Stamps with the same reason up to this far apart are one interval.
MERGE_S = 0.5
#: Intervals that a summary names, and that a list of faults contains.
NAMED_INTERVALS = 3
LISTED_INTERVALS = 50
#: Signal by what the name of a reason ends with.
_SENSORS = {"ay": "ay_m_s2", "yaw_rate": "yaw_rate_rad_s"}


@dataclass(frozen=True, slots=True)
class Interval:
    """A part of the drive, [start_ns, end_ns)."""

    start_ns: int
    end_ns: int


@dataclass(frozen=True, slots=True)
class ReasonFacts:
    """How often one reason held.

    Attributes
    ----------
    name, text : the reason for programs and for people.
    share : of all stamps of the track, in (0, 1]. share_within : of the stamps inside the intervals; a sensor at half
        the rate of the stamps is missing at one half of them.
    intervals : their number. first_ns, end_ns : from the first interval's start to the last one's end.
    longest : up to :data:`NAMED_INTERVALS` of the longest, in order of time.
    """

    name: str
    text: str
    share: float
    share_within: float
    intervals: int
    first_ns: int
    end_ns: int
    longest: tuple[Interval, ...]


@dataclass(frozen=True, slots=True)
class SensorFault:
    """One kind of fault of one sensor over a drive.

    Attributes
    ----------
    sensor : signal. kind : ``burst``, ``spike``, ``stuck``, ``dead`` or ``missing``.
    count, seconds : of all intervals. intervals : up to :data:`LISTED_INTERVALS` of the longest, in order of time.
    """

    sensor: str
    kind: str
    count: int
    seconds: float
    intervals: tuple[Interval, ...]


@dataclass(slots=True)
class _Spans:
    """Intervals of one reason: first and last stamps, how many stamps have the bit, how many lie within at all."""

    first_ns: list[int] = field(default_factory=list)
    last_ns: list[int] = field(default_factory=list)
    stamps: int = 0
    within: int = 0
    last_index: int = 0

    def add(self, stamps_ns: IntArray, index: IntArray) -> None:
        """Take the stamps [M] with the bit, M > 0, and their places in the whole track."""
        before_ns = self.last_ns[-1] if self.last_ns else int(stamps_ns[0])
        before = self.last_index if self.last_ns else int(index[0]) - 1
        new = np.diff(stamps_ns, prepend=before_ns) > MERGE_S * 1e9
        new[0] |= not self.last_ns
        starts = np.flatnonzero(new)
        # The last stamp before each start, and at the end, ends an interval.
        ends = stamps_ns[np.append(starts[starts > 0] - 1, len(stamps_ns) - 1)].tolist()
        if not new[0]:
            self.last_ns[-1] = ends.pop(0)
        self.first_ns += stamps_ns[starts].tolist()
        self.last_ns += ends
        steps = np.diff(index, prepend=before)
        self.within += int(np.where(new, 1, steps).sum())
        self.stamps += len(index)
        self.last_index = int(index[-1])


class ReasonIntervals:
    """Intervals of every reason of one track, gathered from window to window; the windows leave no mark."""

    def __init__(self) -> None:
        self._spans: dict[int, _Spans] = {}
        self._count = 0

    def append(self, stamps_ns: IntArray, reason: IntArray) -> None:
        """Take the stamps and bit masks [N] of the next window."""
        for r in REASONS:
            rows = np.flatnonzero(reason & r.bit)
            if rows.size:
                self._spans.setdefault(r.bit, _Spans()).add(stamps_ns[rows], self._count + rows)
        self._count += len(stamps_ns)

    def intervals(self) -> dict[str, list[Interval]]:
        """Return the intervals in order of time, by name of the reason; those that never held are left out."""
        return {r.name: _intervals(self._spans[r.bit]) for r in REASONS if r.bit in self._spans}

    def summary(self) -> tuple[ReasonFacts, ...]:
        """Return one record a reason that held, in order of the bits."""
        facts = []
        for r in REASONS:
            if r.bit not in self._spans:
                continue
            spans = self._spans[r.bit]
            intervals = _intervals(spans)
            facts.append(
                ReasonFacts(
                    name=r.name,
                    text=r.text,
                    share=spans.stamps / self._count,
                    share_within=spans.stamps / spans.within,
                    intervals=len(intervals),
                    first_ns=intervals[0].start_ns,
                    end_ns=intervals[-1].end_ns,
                    longest=_longest(intervals, NAMED_INTERVALS),
                )
            )
        return tuple(facts)


def summarise_reasons(track: StateTrack) -> tuple[ReasonFacts, ...] | None:
    """Return the summary of a whole track; None where the source gives no reasons."""
    gathered = _gathered(track)
    return None if gathered is None else gathered.summary()


def sensor_faults(track: StateTrack) -> tuple[SensorFault, ...] | None:
    """Return the faults that an estimator found in its sensors; None where it does not look."""
    gathered = _gathered(track)
    if gathered is None:
        return None
    faults = []
    for name, intervals in gathered.intervals().items():
        kind, _, sensor = name.partition("_")
        seconds = sum(i.end_ns - i.start_ns for i in intervals) * 1e-9
        listed = _longest(intervals, LISTED_INTERVALS)
        faults.append(SensorFault(_SENSORS[sensor], kind, len(intervals), seconds, listed))
    return tuple(sorted(faults, key=lambda f: f.sensor))


def _gathered(track: StateTrack) -> ReasonIntervals | None:
    if not len(track.reason) == len(track) > 0:
        return None
    gathered = ReasonIntervals()
    gathered.append(track.stamps_ns, track.reason)
    return gathered


def _longest(intervals: list[Interval], most: int) -> tuple[Interval, ...]:
    longest = sorted(intervals, key=lambda i: (i.start_ns - i.end_ns, i.start_ns))[:most]
    return tuple(sorted(longest, key=lambda i: i.start_ns))


def _intervals(spans: _Spans) -> list[Interval]:
    """``end_ns`` is one past the last stamp inside."""
    return [Interval(a, b + 1) for a, b in zip(spans.first_ns, spans.last_ns, strict=True)]
