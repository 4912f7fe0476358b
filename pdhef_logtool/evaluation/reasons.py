"""Intervals and summary of the reasons for which an estimator did not use its sensors as usual.

Stamps with the bit of a reason that are at most :data:`MERGE_S` apart form one interval: a gyro that is stuck for
seconds gives one interval, even if single samples change.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.records.reasons import REASONS, Reason
from pdhef_logtool.records.signals import IntArray
from pdhef_logtool.records.tracks import StateTrack

#: Stamps with the same reason up to this far apart are one interval.
MERGE_S = 0.5
#: Largest number of intervals in a summary and in a list of faults.
NAMED_INTERVALS = 3
LISTED_INTERVALS = 50
#: Signal by the ending of a reason's name.
_SENSORS = {"ay": "ay_m_s2", "yaw_rate": "yaw_rate_rad_s"}


@dataclass(frozen=True, slots=True)
class Interval:
    """A part of the drive, [start_ns, end_ns)."""

    start_ns: int
    end_ns: int


@dataclass(frozen=True, slots=True)
class ReasonFacts:
    """Frequency of one reason.

    Attributes
    ----------
    name, text : the reason for programs and for people.
    share : of all stamps of the track, in (0, 1]. share_within : of the stamps inside the intervals; for example, a
        sensor at half the rate of the stamps is missing at half of them.
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
    sensor : signal. kind : ``burst``, ``spike``, ``stuck``, ``dead``, ``missing``, ``jump`` (of its bias) or ``gain``.
    count, seconds : of all intervals. intervals : up to :data:`LISTED_INTERVALS` of the longest, in order of time.
    """

    sensor: str
    kind: str
    count: int
    seconds: float
    intervals: tuple[Interval, ...]


def reason_intervals(track: StateTrack) -> dict[str, list[Interval]]:
    """Return the intervals of each reason in order of time; reasons that never apply are left out."""
    intervals = {}
    for reason, rows in _rows_of_reasons(track):
        stamps_ns = track.stamps_ns[rows]
        first, last = _runs(stamps_ns)
        ends = (stamps_ns[last] + 1).tolist()
        intervals[reason.name] = [Interval(a, b) for a, b in zip(stamps_ns[first].tolist(), ends, strict=True)]
    return intervals


def summarise_reasons(track: StateTrack) -> tuple[ReasonFacts, ...] | None:
    """Return one record per reason that applies, in order of the bits; None if the source provides no reasons."""
    if not _has_reasons(track):
        return None
    by_reason, facts = reason_intervals(track), []
    for reason, rows in _rows_of_reasons(track):
        intervals = by_reason[reason.name]
        first, last = _runs(track.stamps_ns[rows])
        facts.append(
            ReasonFacts(
                name=reason.name,
                text=reason.text,
                share=len(rows) / len(track),
                share_within=len(rows) / int((rows[last] - rows[first] + 1).sum()),
                intervals=len(intervals),
                first_ns=intervals[0].start_ns,
                end_ns=intervals[-1].end_ns,
                longest=_longest(intervals, NAMED_INTERVALS),
            )
        )
    return tuple(facts)


def sensor_faults(track: StateTrack) -> tuple[SensorFault, ...] | None:
    """Return the sensor faults that an estimator detected; None if the source provides no reasons."""
    if not _has_reasons(track):
        return None
    faults = []
    for name, intervals in reason_intervals(track).items():
        kind, _, sensor = name.partition("_")
        seconds = sum(i.end_ns - i.start_ns for i in intervals) * 1e-9
        listed = _longest(intervals, LISTED_INTERVALS)
        faults.append(SensorFault(_SENSORS[sensor], kind, len(intervals), seconds, listed))
    return tuple(sorted(faults, key=lambda f: f.sensor))


def _has_reasons(track: StateTrack) -> bool:
    return len(track.reason) == len(track) > 0


def _rows_of_reasons(track: StateTrack) -> Iterator[tuple[Reason, IntArray]]:
    """Yield each reason that applies with its rows [M], M > 0."""
    if _has_reasons(track):
        for reason in REASONS:
            if len(rows := np.flatnonzero(track.reason & reason.bit)):
                yield reason, rows


def _runs(stamps_ns: IntArray) -> tuple[IntArray, IntArray]:
    """Return the first and last entries of runs of stamps [M] that are at most :data:`MERGE_S` apart."""
    breaks = np.flatnonzero(np.diff(stamps_ns) > MERGE_S * 1e9)
    return np.append(0, breaks + 1), np.append(breaks, len(stamps_ns) - 1)


def _longest(intervals: list[Interval], most: int) -> tuple[Interval, ...]:
    longest = sorted(intervals, key=lambda i: (i.start_ns - i.end_ns, i.start_ns))[:most]
    return tuple(sorted(longest, key=lambda i: i.start_ns))
