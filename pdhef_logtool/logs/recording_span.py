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
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Literal

import numpy as np
from numpy.typing import NDArray

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
    pieces, topics = _look(containers, times)
    intervals, left_out, losses = _kept_epoch(pieces, topics, where)
    cuts = _cuts(pieces, topics, intervals)
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
        losses.append(_loss(TIME_JUMP, where, all_of_it, all_of_it + 1, all_of_it.size, int(pieces["count"].sum())))
    return RecordingSpan(tuple(intervals), tuple(cuts), left_out, tuple(losses))


def survey_stamps(stamps_ns: Mapping[str, IntArray], where: str) -> RecordingSpan:
    """Find the times of a log from all log times [N] of each topic; ``where`` as for :func:`survey`."""
    listed = [_stretches(times, i) for i, times in enumerate(stamps_ns.values()) if len(times)]
    intervals, left_out, losses = _kept_epoch(np.concatenate([_NO_PIECE, *listed]), [*stamps_ns], where)
    return RecordingSpan(tuple(intervals), left_out=left_out, losses=tuple(losses))


def _kept_epoch(
    pieces: NDArray[np.void], topics: Sequence[str], where: str
) -> tuple[list[tuple[int, int]], dict[str, Counter[str]], list[Loss]]:
    """Return the intervals that are kept, the messages left out by topic and reason, and their losses."""
    intervals, kept, outlier = find_epochs(pieces["start"], pieces["end"], pieces["count"])
    left_out: dict[str, Counter[str]] = {}
    losses = []
    for reason, which in ((OUTLIER, outlier), (OTHER_EPOCH, ~kept & ~outlier)):
        out = pieces[which]
        for i in np.unique(out["topic"]).tolist():
            left_out.setdefault(topics[i], Counter())[reason] = int(out["count"][out["topic"] == i].sum())
        if len(out):
            total = int(pieces["count"].sum())
            losses.append(_loss(reason, where, out["start"], out["end"], int(out["count"].sum()), total))
    return intervals, left_out, losses


# ---- the look at the spans ----


#: A piece of a recording: messages of a channel in a span, [start, end); ``row`` in the span is -1 for all of them.
_NO_PIECE = np.array([], [(name, np.int64) for name in ("start", "end", "count", "topic", "file", "span", "row")])


def _of_messages(times_ns: IntArray, topic: int, file: int, span: int) -> NDArray[np.void]:
    """Return each message as a piece."""
    pieces = np.empty(len(times_ns), _NO_PIECE.dtype)
    pieces["start"], pieces["end"], pieces["count"], pieces["row"] = times_ns, times_ns + 1, 1, np.arange(len(times_ns))
    pieces["topic"], pieces["file"], pieces["span"] = topic, file, span
    return pieces


def _stretches(times_ns: IntArray, topic: int) -> NDArray[np.void]:
    """Return the pieces of ascending times that a silence keeps apart."""
    first = np.flatnonzero(np.append(True, np.diff(times_ns.astype(np.float64)) > SILENCE_NS))
    pieces = _of_messages(times_ns[first], topic, 0, 0)
    pieces["end"], pieces["count"] = times_ns[np.append(first[1:], 0) - 1] + 1, np.diff(first, append=len(times_ns))
    return pieces


def _look(containers: Sequence[Container], times: SpanTimes) -> tuple[NDArray[np.void], list[str]]:
    """Return pieces in file order, and the topics: each message where the bounds of a span are not enough."""
    looked: list[NDArray[np.void]] = [_NO_PIECE]
    names: dict[str, int] = {}
    newest: dict[int, int] = {}
    for c, container in enumerate(containers):
        topics = {id_: names.setdefault(channel.topic, len(names)) for id_, channel in container.channels.items()}
        for span in container.spans:
            if not span.counts:
                continue  # it has no message of a declared channel
            lasts = span.end_ns - span.start_ns
            is_torn = lasts <= 0 or lasts > SILENCE_NS
            is_torn |= any(span.start_ns < newest.get(topics[id_], 0) - STEP_BACK_NS for id_ in span.counts)
            stamps = times(c, span) if is_torn or (lasts > STEP_BACK_NS and not span.ordered) else {}
            if stamps is None:
                continue  # damaged: nothing of it can be read
            if not is_torn and not any((np.diff(its) < -STEP_BACK_NS).any() for its in stamps.values()):
                bounds = span.start_ns, span.end_ns
                whole = [(*bounds, n, topics[id_], c, span.index, -1) for id_, n in span.counts.items()]
                looked.append(np.array(whole, _NO_PIECE.dtype))
                last = dict.fromkeys(span.counts, span.end_ns - 1)
            else:
                looked += [_of_messages(its, topics[id_], c, span.index) for id_, its in stamps.items()]
                last = {id_: int(its.max(initial=0)) for id_, its in stamps.items()}
            for id_, last_ns in last.items():
                newest[topics[id_]] = max(newest.get(topics[id_], 0), last_ns)
    return np.concatenate(looked), [*names]


def _cuts(pieces: NDArray[np.void], topics: Sequence[str], intervals: Sequence[tuple[int, int]]) -> list[Cut]:
    """Return the intervals that were recorded twice, of all topics, if the time of one of them clearly stepped back."""
    is_message = pieces["row"] >= 0
    sequences: list[tuple[str, IntArray, NDArray[np.void]]] = []
    for i, topic in enumerate(topics) if is_message.any() else ():
        its = pieces[pieces["topic"] == i]
        # First and last time of a span, the only one of a message.
        ends = np.stack([its["start"], its["end"] - 1], axis=1)
        used = np.stack([its["row"] >= -1, its["row"] < 0], axis=1)
        times, places = ends[used], its[np.nonzero(used)[0]]
        if (inside := _inside(times, intervals)).any():
            # Left-out messages take the time of a neighbour, so that the others keep their places.
            last = np.maximum.accumulate(np.where(inside, np.arange(len(times)), -1))
            sequences.append((topic, times[np.where(last >= 0, last, int(np.argmax(inside)))], places))
    if not any(steps_back(times).size for _, times, _ in sequences):
        return []
    cuts = []
    for topic, times, places in sequences:
        for place, low, high in recorded_twice(times):
            c, index, row = (int(places[name][place]) for name in ("file", "span", "row"))
            cuts.append(Cut(topic, (c, index, max(row, 0)), low, high))
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
