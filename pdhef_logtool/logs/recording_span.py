"""The recording span of a log: determined before windows are read, from spans, and from stamps where spans are wide.

Log times depend on the recorder's clock. One message at time 0 makes a log 56 years long; a clock that is set after
boot splits a recording in two; a clock that is set back records the same times twice. So three cases are removed:

* *Outlier stamps*: a few messages that are far from all others are left out.
* *Clock resets*: stretches that are too far apart for a pause. The stretch with most messages is kept.
* *Steps back*: if a topic's time falls back in file order, the order in the file is the right one. Messages after the
  step are left out while their times were recorded before, and ``BREAK_NS`` around, so that two passes are never
  interleaved and the break is a gap.

A sound log keeps all messages, and its first and last log time.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Literal

import numpy as np

from pdhef_logtool.logs.container import Container, Span
from pdhef_logtool.records.signals import BoolArray, IntArray, Loss

#: A longer silence ends a stretch.
SILENCE_NS = 600_000_000_000
#: A stretch with at most this many messages is an outlier: too short for any estimate.
OUTLIER_MESSAGES = 3
#: No drive continues in the same log after a longer pause; clocks that are set jump by months and years.
EPOCH_NS = 86_400_000_000_000
#: Recorders with several threads write up to a second out of order; a clock that is set back falls further...
STEP_BACK_NS = 1_000_000_000
#: ... for at least this many messages, behind the median of as many before; single wrong times are no step.
STEP_BACK_MESSAGES = 5
#: Left out beside times that were recorded twice: the true duration of the step is unknown.
BREAK_NS = 1_000_000_000
#: Messages left out are a note below this share of a log's messages, a loss above it.
NOTED_SHARE = 0.01

OUTLIER, OTHER_EPOCH, TIME_JUMP = "outlier", "other-epoch", "time-jump"
_WHAT = {
    OUTLIER: "messages far from all others are left out, recorded at {when}",
    OTHER_EPOCH: "messages of another time are left out, recorded at {when}: the recorder's clock was set",
    TIME_JUMP: "messages are left out: the recorder's clock stepped back, and their times were recorded before",
}

#: Log times [N] of a span's messages by known channel, in file order; None if the span is damaged.
SpanTimes = Callable[[int, Span], Mapping[int, IntArray] | None]


@dataclass(frozen=True, slots=True)
class Cut:
    """Messages of a topic to leave out: log times in [low_ns, high_ns], at or after ``place`` (file, span, row)."""

    topic: str
    place: tuple[int, int, int]
    low_ns: int
    high_ns: int


@dataclass(frozen=True, slots=True)
class RecordingSpan:
    """Recording span of a log: the times at which its messages are used.

    Attributes
    ----------
    intervals : [start, end) in ns, ascending, apart by more than ``SILENCE_NS``; none for a log without messages.
    cuts : intervals left out within them. left_out : messages left out, by topic and reason. losses : in words.
    """

    intervals: tuple[tuple[int, int], ...]
    cuts: tuple[Cut, ...] = ()
    left_out: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    losses: tuple[Loss, ...] = ()

    @property
    def start_ns(self) -> int:
        """First log time; 0 without messages."""
        return self.intervals[0][0] if self.intervals else 0

    @property
    def end_ns(self) -> int:
        """Last log time + 1; 0 without messages."""
        return self.intervals[-1][1] if self.intervals else 0

    def unused(self, topic: str, c: int, span: Span, log_time_ns: IntArray) -> BoolArray | None:
        """Return which of a topic's messages in a span (all of them, in file order) are left out; None: none of them.

        Only of use if any message is ``left_out``.
        """
        of_earlier_passes = _cut_out(log_time_ns, topic, (c, span.index), self.cuts)
        unused = ~_inside(log_time_ns, self.intervals) | of_earlier_passes
        return unused if unused.any() else None


def find_epochs(
    start_ns: IntArray, end_ns: IntArray, count: IntArray
) -> tuple[list[tuple[int, int]], BoolArray, BoolArray]:
    """Find the stretches that belong together from pieces of recording [start, end) with their messages, [K] each.

    Returns
    -------
    intervals : [start, end) that are kept, ascending. kept, outlier : bool [K], by piece; a piece that is neither
        belongs to another clock reset.
    """
    n = start_ns.shape[0]
    if n == 0:
        return [], np.zeros(0, np.bool_), np.zeros(0, np.bool_)
    order = np.argsort(start_ns, kind="stable")
    stretch = _groups(start_ns[order], end_ns[order], SILENCE_NS)
    size = np.bincount(stretch, weights=count[order])
    first = np.flatnonzero(np.diff(stretch, prepend=-1))
    begin, end = start_ns[order][first], np.maximum.reduceat(end_ns[order], first)
    solid = np.flatnonzero(size > OUTLIER_MESSAGES)
    if solid.size == 0:  # a handful of messages: the largest stretch is the log
        solid = np.array([int(np.argmax(size))])
    epoch = _groups(begin[solid], end[solid], EPOCH_NS)
    weight = np.bincount(epoch, weights=size[solid])
    best = int(np.flatnonzero(weight == weight.max())[-1])  # of equals the last: its clock was set
    chosen = solid[epoch == best]
    kept, outlier = np.zeros(n, np.bool_), np.zeros(n, np.bool_)
    kept[order] = np.isin(stretch, chosen)
    outlier[order] = ~np.isin(stretch, solid)
    return [(int(begin[s]), int(end[s])) for s in chosen], kept, outlier


def steps_back(times_ns: IntArray) -> IntArray:
    """Return the places i ≥ 1 [K] at which times [N] fall back by more than ``STEP_BACK_NS`` and stay behind."""
    falls: IntArray = np.flatnonzero(np.diff(times_ns) < -STEP_BACK_NS) + 1
    n = STEP_BACK_MESSAGES
    falls = falls[(falls >= n) & (falls + n <= times_ns.shape[0])]
    around = np.arange(n)
    before = np.sort(times_ns[falls[:, None] - 1 - around], axis=1)[:, n // 2]
    following = times_ns[falls[:, None] + around]
    behind: BoolArray = (following < before[:, None] - STEP_BACK_NS).all(axis=1)
    return np.asarray(falls[behind], dtype=np.int64)


def recorded_twice(times_ns: IntArray) -> list[tuple[int, int, int]]:
    """Return (place, low, high): times [N] in [low, high] at or after a place repeat an earlier pass.

    A pass ends where the times fall back by more than ``STEP_BACK_NS``.
    """
    begins = np.concatenate([[0], np.flatnonzero(np.diff(times_ns) < -STEP_BACK_NS) + 1])
    low, high = np.minimum.reduceat(times_ns, begins), np.maximum.reduceat(times_ns, begins)
    repeated: list[tuple[int, int, int]] = []
    earlier: list[tuple[int, int]] = []
    for place, a, b in zip(begins.tolist(), low.tolist(), high.tolist(), strict=True):
        twice = [(x, y) for x, y in earlier if min(y, b) - max(x, a) > 0]
        repeated += [(place, x - BREAK_NS, y + BREAK_NS) for x, y in twice]
        apart = [(x, y) for x, y in earlier if (x, y) not in twice]
        earlier = [*apart, (min([a, *(x for x, _ in twice)]), max([b, *(y for _, y in twice)]))]
    return repeated


def survey(containers: Sequence[Container], times: SpanTimes, where: str) -> RecordingSpan:
    """Find the times of a log; only the stamps of spans that are torn or out of order are looked at.

    Parameters
    ----------
    times : reads the times of a span. where : name of the log in losses.
    """
    look = _look(containers, times)
    intervals, left_out, losses, total = _kept_epoch(look, where)
    cuts = _cuts(look, intervals)
    twice: list[IntArray] = []
    for c, span in ((c, span) for c, of in enumerate(containers) for span in of.spans) if cuts else ():
        place = (c, span.index)
        if not any(place >= cut.place[:2] and _touches(span, cut) for cut in cuts):
            continue
        for id_, channel_times in (times(c, span) or {}).items():
            topic = containers[c].channels[id_].topic
            again = channel_times[_inside(channel_times, intervals) & _cut_out(channel_times, topic, place, cuts)]
            if again.size:
                left_out.setdefault(topic, Counter())[TIME_JUMP] += again.size
                twice.append(again)
    if twice:
        all_of_it = np.concatenate(twice)
        losses.append(_loss(TIME_JUMP, where, all_of_it, all_of_it + 1, all_of_it.size, total))
    return RecordingSpan(tuple(intervals), tuple(cuts), left_out, tuple(losses))


def survey_stamps(stamps_ns: Mapping[str, IntArray], where: str) -> RecordingSpan:
    """Find the times of a log from all log times [N] of each topic; ``where`` as for :func:`survey`."""
    none = Span(0, 0, 0, {})
    look = [_Looked(0, none, {0: t}, {0: s}) for t, s in stamps_ns.items() if len(s)]
    intervals, left_out, losses, _ = _kept_epoch(look, where)
    return RecordingSpan(tuple(intervals), left_out=left_out, losses=tuple(losses))


def _kept_epoch(
    look: Sequence[_Looked], where: str
) -> tuple[list[tuple[int, int]], dict[str, Counter[str]], list[Loss], int]:
    """Return the intervals that are kept, the messages left out by topic and reason, their losses, and all messages."""
    pieces = [piece for of in look for piece in of.pieces()]
    start, end, count = (np.array([p[i] for p in pieces], dtype=np.int64) for i in (0, 1, 2))
    intervals, kept, outlier = find_epochs(start, end, count)
    left_out: dict[str, Counter[str]] = {}
    losses = []
    total = int(count.sum())
    for reason, which in ((OUTLIER, outlier), (OTHER_EPOCH, ~kept & ~outlier)):
        for i in np.flatnonzero(which).tolist():
            for topic, n in pieces[i][3].items():
                left_out.setdefault(topic, Counter())[reason] += n
        if count[which].any():
            rows = np.flatnonzero(which)
            losses.append(_loss(reason, where, start[rows], end[rows], int(count[rows].sum()), total))
    return intervals, left_out, losses, total


# ---- the look at the spans ----


@dataclass(frozen=True, slots=True, eq=False)
class _Looked:
    """A span, with its times by channel if these were read because the bounds of the span are not enough."""

    c: int
    span: Span
    topics: Mapping[int, str]
    stamps: Mapping[int, IntArray] | None = None

    def pieces(self) -> Iterator[tuple[int, int, int, Mapping[str, int]]]:
        """Yield start, end, messages, and messages by topic; one piece per stretch."""
        if self.stamps is None:
            counts: Counter[str] = Counter()
            for id_, messages in self.span.counts.items():
                counts[self.topics[id_]] += messages
            yield self.span.start_ns, self.span.end_ns, sum(counts.values()), counts
            return
        times = np.concatenate([*self.stamps.values()])
        channel = np.repeat([*self.stamps], [len(its) for its in self.stamps.values()])
        order = np.argsort(times, kind="stable")
        stretch = _groups(times[order], times[order], SILENCE_NS)
        for rows in np.split(order, np.flatnonzero(np.diff(stretch)) + 1):
            ids, n = np.unique(channel[rows], return_counts=True)
            by_topic: Counter[str] = Counter()
            for id_, m in zip(ids.tolist(), n.tolist(), strict=True):
                by_topic[self.topics[id_]] += m
            yield int(times[rows[0]]), int(times[rows[-1]]) + 1, rows.shape[0], by_topic

    def last_ns(self, id_: int) -> int:
        """Return the last time of a channel, 0 without any."""
        return self.span.end_ns - 1 if self.stamps is None else int(self.of_channel(id_).max(initial=0))

    def of_channel(self, id_: int) -> IntArray:
        """Return the times of a channel in file order; of an ordered span its bounds."""
        if self.stamps is None:
            return np.array([self.span.start_ns, self.span.end_ns - 1])
        return self.stamps.get(id_, np.empty(0, np.int64))


def _look(containers: Sequence[Container], times: SpanTimes) -> list[_Looked]:
    """Return all spans in file order, with their times if the bounds of a span are not enough."""
    looked: list[_Looked] = []
    newest: dict[str, int] = {}
    for c, container in enumerate(containers):
        topics = {id_: channel.topic for id_, channel in container.channels.items()}
        for span in container.spans:
            if not span.counts:
                continue  # it has no message of a declared channel
            lasts = span.end_ns - span.start_ns
            behind = any(span.start_ns < newest.get(topics[id_], 0) - STEP_BACK_NS for id_ in span.counts)
            of = _Looked(c, span, topics)
            if lasts <= 0 or lasts > SILENCE_NS or behind or (lasts > STEP_BACK_NS and not span.ordered):
                stamps = times(c, span)
                if stamps is None:
                    continue  # damaged: nothing of it can be read
                disorder = any((np.diff(times_ns) < -STEP_BACK_NS).any() for times_ns in stamps.values())
                if stamps and (lasts <= 0 or lasts > SILENCE_NS or behind or disorder):
                    of = _Looked(c, span, topics, stamps)
            for id_ in span.counts:
                newest[topics[id_]] = max(newest.get(topics[id_], 0), of.last_ns(id_))
            looked.append(of)
    return looked


def _cuts(looked: Sequence[_Looked], intervals: Sequence[tuple[int, int]]) -> list[Cut]:
    """Return the intervals that were recorded twice, of all topics, if the time of one of them clearly stepped back."""
    if all(of.stamps is None for of in looked):
        return []
    sequences: dict[str, tuple[IntArray, list[tuple[int, int, int, int]]]] = {}
    parts: dict[str, list[tuple[IntArray, int, int]]] = {}
    for of in looked:
        for id_ in of.span.counts:
            channel_times = of.of_channel(id_)
            inside = _inside(channel_times, intervals)
            if inside.any():  # left-out rows take the time of a neighbour, so that rows keep their places
                last = np.maximum.accumulate(np.where(inside, np.arange(channel_times.shape[0]), -1))
                channel_times = channel_times[np.where(last >= 0, last, int(np.argmax(inside)))]
                parts.setdefault(of.topics[id_], []).append((channel_times, of.c, of.span.index))
    for topic, those in parts.items():
        bounds = np.cumsum([0, *(channel_times.shape[0] for channel_times, _, _ in those)]).tolist()
        places = [(a, b, c, index) for a, b, (_, c, index) in zip(bounds[:-1], bounds[1:], those, strict=True)]
        sequences[topic] = np.concatenate([channel_times for channel_times, _, _ in those]), places
    if not any(steps_back(channel_times).size for channel_times, _ in sequences.values()):
        return []
    cuts = []
    for topic, (channel_times, places) in sequences.items():
        for place, low, high in recorded_twice(channel_times):
            c, index, row = next((c, index, place - a) for a, b, c, index in places if a <= place < b)
            cuts.append(Cut(topic, (c, index, row), low, high))
    return cuts


# ---- small things ----


def _groups(start_ns: IntArray, end_ns: IntArray, silence_ns: int) -> IntArray:
    """Number the groups of intervals [K], ascending by start, that a longer silence keeps apart."""
    if start_ns.shape[0] == 0:
        return np.empty(0, np.int64)
    reach = np.maximum.accumulate(end_ns)[:-1]
    # As floats: the difference of two times need not fit into int64.
    apart = start_ns[1:].astype(np.float64) - reach.astype(np.float64) > silence_ns
    return np.concatenate([[0], np.cumsum(apart)]).astype(np.int64)


def _inside(times_ns: IntArray, intervals: Sequence[tuple[int, int]]) -> BoolArray:
    inside = np.zeros(times_ns.shape[0], np.bool_)
    for start, end in intervals:
        inside |= (times_ns >= start) & (times_ns < end)
    return inside


def _cut_out(times_ns: IntArray, topic: str, place: tuple[int, int], cuts: Iterable[Cut]) -> BoolArray:
    """Return the mask of a topic's messages in a span, at ``place`` (file, span), that the cuts leave out."""
    left_out = np.zeros(times_ns.shape[0], np.bool_)
    for cut in cuts:
        if cut.topic == topic and place >= cut.place[:2]:
            first = cut.place[2] if place == cut.place[:2] else 0
            later = times_ns[first:]
            left_out[first:] |= (later >= cut.low_ns) & (later <= cut.high_ns)
    return left_out


def _touches(span: Span, cut: Cut) -> bool:
    return span.end_ns < span.start_ns or (span.start_ns <= cut.high_ns and span.end_ns > cut.low_ns)


def _loss(reason: str, where: str, start_ns: IntArray, end_ns: IntArray, count: int, total: int) -> Loss:
    first, last = int(start_ns.min()), int(end_ns.max())
    when = shown_time(first) if last - first < SILENCE_NS else f"{shown_time(first)} to {shown_time(last)}"
    inside = (first, last) if reason == TIME_JUMP else (None, None)  # the others are not of the log's time
    what = f"{count} {_WHAT[reason].format(when=when)}"
    severity: Literal["lost", "note"] = "lost" if count > NOTED_SHARE * total else "note"
    return Loss(reason, what, where, inside[0], inside[1], count, severity)


def shown_time(ns: int) -> str:
    """Return any time of the log's clock in UTC to the second."""
    try:
        return (datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=ns // 10**9)).strftime("%Y-%m-%d %H:%M:%S UTC")
    except (OverflowError, ValueError):
        return f"{ns} ns"
