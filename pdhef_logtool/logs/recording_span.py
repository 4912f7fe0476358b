"""The recording span of a log: determined before windows are read, from the log times of all messages.

Log times depend on the recorder's clock. One message at time 0 makes a log 56 years long; a clock that is set after
boot splits a recording in two; a clock that is set back records the same times twice. So three cases are removed:

* *Outlier stamps*: a few messages that are far from all others are left out.
* *Clock resets*: stretches that are too far apart for a pause. The stretch with most messages is kept.
* *Steps back*: if a topic's time falls back in file order, the order in the file is the right one. Messages after the
  step are left out while their times were recorded before, and ``BREAK_NS`` around, so that two passes are never
  interleaved and the break is a gap.

A sound log keeps all messages, and its first and last log time.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs.container import Container
from pdhef_logtool.records.signals import NS_PER_S, BoolArray, IntArray, Loss

#: A longer silence ends a stretch.
SILENCE_NS = 600 * NS_PER_S
#: A stretch with at most this many messages is an outlier: too short for any estimate.
OUTLIER_MESSAGES = 3
#: No drive continues in the same log after a longer pause; clocks that are set jump by months and years.
EPOCH_NS = 86_400 * NS_PER_S
#: Recorders with several threads write up to a second out of order; a clock that is set back falls further...
STEP_BACK_NS = NS_PER_S
#: ... for at least this many messages, behind the median of as many before; single wrong times are no step.
STEP_BACK_MESSAGES = 5
#: Left out beside times that were recorded twice: the true duration of the step is unknown.
BREAK_NS = NS_PER_S
#: Messages left out are a note below this share of a log's messages, a loss above it.
NOTED_SHARE = 0.01

OUTLIER, OTHER_EPOCH, TIME_JUMP = "outlier", "other-epoch", "time-jump"
_WHAT = {
    OUTLIER: "messages far from all others are left out, recorded at {when}",
    OTHER_EPOCH: "messages of another time are left out, recorded at {when}: the recorder's clock was set",
    TIME_JUMP: "messages are left out: the recorder's clock stepped back, and their times were recorded before",
}

#: Messages of a channel in a span: number of the file, of the span, and id of the channel.
Place: TypeAlias = tuple[int, int, int]
#: A topic, and the number of its channel among those of the same topic in a span: their times need not ascend together.
_Lane: TypeAlias = tuple[str, int]


@dataclass(frozen=True, slots=True)
class RecordingSpan:
    """Recording span of a log: the times at which its messages are used.

    Attributes
    ----------
    intervals : [start, end) in ns, ascending, apart by more than ``SILENCE_NS``; none for a log without messages.
    repeated : which messages [N] within them are left out, as their times were recorded before.
    left_out : messages left out, by topic and reason. losses : in words.
    """

    intervals: tuple[tuple[int, int], ...]
    repeated: Mapping[Place, BoolArray] = field(default_factory=dict)
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

    def used(self, place: Place, log_time_ns: IntArray) -> BoolArray:
        """Return which messages of a channel in a span (all of them, in file order) are used."""
        used, repeated = _inside(log_time_ns, self.intervals), self.repeated.get(place)
        return used & ~repeated if repeated is not None and len(repeated) == len(used) else used


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


def survey(containers: Sequence[Container], where: str) -> RecordingSpan:
    """Find the times of a log; ``where`` is its name in losses."""
    whole: list[tuple[str, int, int, int]] = []
    lanes: dict[_Lane, list[tuple[Place, IntArray]]] = {}
    for c, container in enumerate(containers):
        for span in container.spans:
            numbers: Counter[str] = Counter()
            for id_, count in span.counts.items():
                topic = container.channels[id_].topic
                if span.times is None:
                    whole.append((topic, span.start_ns, span.end_ns, count))
                else:
                    parts = lanes.setdefault((topic, numbers[topic]), [])
                    parts.append(((c, span.index, id_), span.times[id_]))
                    numbers[topic] += 1
    times = {lane: np.concatenate([its for _, its in parts]) for lane, parts in lanes.items()}
    recording_span, repeated = _survey(times, where, whole)
    by_place: dict[Place, BoolArray] = {}
    for lane, mask in repeated.items():
        ends = np.cumsum([len(its) for _, its in lanes[lane]])
        masks = zip((place for place, _ in lanes[lane]), np.split(mask, ends[:-1]), strict=True)
        by_place |= {place: its for place, its in masks if its.any()}
    return replace(recording_span, repeated=by_place)


def survey_stamps(stamps_ns: Mapping[str, IntArray], where: str) -> RecordingSpan:
    """Find the times of a log from the ascending log times [N] of each topic; ``where`` as for :func:`survey`."""
    return _survey({(topic, 0): times for topic, times in stamps_ns.items()}, where)[0]


def survey_rows(times_ns: IntArray, where: str) -> tuple[BoolArray, tuple[Loss, ...]]:
    """Return which of the times [N] of rows in file order are used, and losses; ``where`` as for :func:`survey`."""
    lane: _Lane = ("", 0)
    recording_span, repeated = _survey({lane: times_ns}, where)
    used = _inside(times_ns, recording_span.intervals)
    return used & ~repeated[lane] if lane in repeated else used, recording_span.losses


def _survey(
    times_ns: Mapping[_Lane, IntArray], where: str, whole: Sequence[tuple[str, int, int, int]] = ()
) -> tuple[RecordingSpan, dict[_Lane, BoolArray]]:
    """Return the times of a log, and which messages [N] of each lane were recorded before.

    Parameters
    ----------
    times_ns : log times in file order. whole : topic, start, end and messages of sound pieces without known times.
    """
    topics = sorted({topic for topic, _ in times_ns} | {topic for topic, *_ in whole})
    number = {topic: i for i, topic in enumerate(topics)}
    pieces = [np.array([(start, end, n, number[topic]) for topic, start, end, n in whole], _PIECE)]
    pieces += [_stretches(its, number[topic]) for (topic, _), its in times_ns.items() if len(its)]
    every = np.concatenate(pieces)
    intervals, left_out, losses = _kept_epoch(every, topics, where)
    repeated = _repeated(times_ns, intervals)
    for (topic, _), mask in repeated.items():
        left_out.setdefault(topic, Counter())[TIME_JUMP] += int(mask.sum())
    if repeated:
        again = np.concatenate([times_ns[lane][mask] for lane, mask in repeated.items()])
        losses.append(_loss(TIME_JUMP, where, again, again + 1, len(again), int(every["count"].sum())))
    return RecordingSpan(tuple(intervals), left_out=left_out, losses=tuple(losses)), repeated


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


#: A piece of a recording: messages of a topic in [start, end).
_PIECE = np.dtype([(name, np.int64) for name in ("start", "end", "count", "topic")])


def _stretches(times_ns: IntArray, topic: int) -> NDArray[np.void]:
    """Return the pieces of times that a silence keeps apart."""
    if (times_ns[1:] < times_ns[:-1]).any():
        times_ns = np.sort(times_ns)
    first = np.flatnonzero(np.append(True, np.diff(times_ns.astype(np.float64)) > SILENCE_NS))
    pieces = np.empty(len(first), _PIECE)
    pieces["start"], pieces["end"] = times_ns[first], times_ns[np.append(first[1:], 0) - 1] + 1
    pieces["count"], pieces["topic"] = np.diff(first, append=len(times_ns)), topic
    return pieces


def _repeated(times_ns: Mapping[_Lane, IntArray], intervals: Sequence[tuple[int, int]]) -> dict[_Lane, BoolArray]:
    """Return which messages [N] were recorded before, of all lanes, if the time of one of them clearly stepped back."""
    if not any((np.diff(times) < -STEP_BACK_NS).any() for times in times_ns.values()):
        return {}
    inside = {lane: _inside(times, intervals) for lane, times in times_ns.items()}
    if not any(steps_back(times[inside[lane]]).size for lane, times in times_ns.items()):
        return {}
    repeated = {lane: np.zeros(len(times), np.bool_) for lane, times in times_ns.items()}
    for lane, times in times_ns.items():
        rows = np.flatnonzero(inside[lane])
        for place, low, high in recorded_twice(times[rows]) if rows.size else ():
            later = rows[place:]
            repeated[lane][later] |= (times[later] >= low) & (times[later] <= high)
    return {lane: mask for lane, mask in repeated.items() if mask.any()}


def _groups(start_ns: IntArray, end_ns: IntArray, silence_ns: int) -> IntArray:
    """Number the groups of intervals [K], ascending by start, that a longer silence keeps apart."""
    reach = np.maximum.accumulate(end_ns)[:-1]
    # As floats: the difference of two times need not fit into int64.
    apart = start_ns[1:].astype(np.float64) - reach.astype(np.float64) > silence_ns
    return np.concatenate([[0], np.cumsum(apart)]).astype(np.int64)


def _inside(times_ns: IntArray, intervals: Sequence[tuple[int, int]]) -> BoolArray:
    inside = np.zeros(times_ns.shape[0], np.bool_)
    for start, end in intervals:
        inside |= (times_ns >= start) & (times_ns < end)
    return inside


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
        return (datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=ns // NS_PER_S)).strftime("%Y-%m-%d %H:%M:%S UTC")
    except (OverflowError, ValueError):
        return f"{ns} ns"
