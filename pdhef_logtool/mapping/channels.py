"""Mapped fields into channels: SI values on the log's clock, cleaned, with every dropped sample counted."""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping as Mapped, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from pdhef_logtool.logs.drive_log import Columns, DriveLog
from pdhef_logtool.mapping.can_frames import CanSignalLog, with_can_signals
from pdhef_logtool.mapping.checking import resolve_mapping
from pdhef_logtool.mapping.clocks import ClockModel, clock_key, requests_of, stamps_on_log_clock
from pdhef_logtool.mapping.evidence import LARGEST
from pdhef_logtool.mapping.records import Mapping, QualityGate, SignalSource
from pdhef_logtool.records.ledger import Role
from pdhef_logtool.records.signals import SIGNAL_UNITS, TRUTH_UNITS, BoolArray, Channel, FloatArray, IntArray, Loss

#: A gate sample is valid for this many of its periods; after that the ground-truth quality is unknown.
GATE_HOLD_PERIODS = 2.0
#: Largest difference in log time between ground truth and a gate message with the same stamp.
GATE_MARGIN_NS = 2_000_000_000

#: Description of each kind of loss; count and span are reported with it.
LOSS_TEXTS = {
    "bad-stamp": "message without a usable stamp (zero, not a number, or a minute off the others) dropped",
    "nan": "sample that is not a number dropped",
    "out-of-range": "sample outside valid_min and valid_max dropped",
    "duplicate-stamp": "message with the stamp of an earlier one dropped",
    "out-of-order": "message recorded after a later one, sorted back by stamp",
    "truth-quality": "ground-truth sample rejected by the quality gate dropped",
    "delay-unknown": "log time is not 0 to 1 s after the stamps: the delay is unknown, the stamp is used as arrival",
}
LOST_KINDS = frozenset({"nan", "bad-stamp"})


@dataclass(frozen=True, slots=True, eq=False)
class MappedChannels:
    """Channels of one window of log time; each mapped name has a channel, which may be empty.

    ``counts`` has the number of messages ``read`` and of dropped messages by reason, for each section and name.
    ``stamps`` has the times of the requested topics.
    """

    signals: dict[str, Channel]
    truth: dict[str, Channel]
    losses: tuple[Loss, ...]
    counts: dict[tuple[Role, str], Counter[str]] = field(default_factory=dict)
    stamps: Mapped[str, Columns] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class CleanSamples:
    """Samples with ascending, unique stamps; ``*_at`` are the indices of dropped samples.

    ``same`` and ``other`` count samples dropped as duplicates of a stamp, with an equal and with a different value.
    """

    stamps_ns: IntArray
    arrival_ns: IntArray
    values: FloatArray
    nan_at: IntArray
    out_of_range_at: IntArray
    same: int = 0
    other: int = 0


def clean_samples(
    stamps_ns: IntArray,
    arrival_ns: IntArray,
    values: FloatArray,
    *,
    valid_min: float | None = None,
    valid_max: float | None = None,
) -> CleanSamples:
    """Drop values that are not finite or out of range, sort by stamp, and keep the first sample of each stamp.

    The result does not depend on the order of the samples: samples of one stamp and one arrival are distinguished by
    value, the smallest first.

    Parameters
    ----------
    stamps_ns, arrival_ns : int64 [N].
    values : float64 [N] or [N, k]; a row counts as bad when any of its entries is.
    """
    columns = values if values.ndim == 2 else values[:, np.newaxis]
    finite = (np.abs(columns) < LARGEST).all(axis=1)
    low, high = -np.inf if valid_min is None else valid_min, np.inf if valid_max is None else valid_max
    in_range = ((columns >= low) & (columns <= high)).all(axis=1)
    keep = finite & in_range
    nan_at = np.flatnonzero(~finite)
    out_of_range_at = np.flatnonzero(finite & ~in_range)
    if not keep.all():
        stamps_ns, arrival_ns, values, columns = stamps_ns[keep], arrival_ns[keep], values[keep], columns[keep]
    same = other = 0
    if stamps_ns.shape[0] > 1 and not np.all(stamps_ns[1:] > stamps_ns[:-1]):
        # With the values as last keys, the result does not depend on the input order.
        order = np.lexsort((*columns.T[::-1], arrival_ns, stamps_ns))
        ordered = stamps_ns[order]
        first = np.concatenate([[True], ordered[1:] > ordered[:-1]])
        equal = (columns[order][1:] == columns[order][:-1]).all(axis=1)
        same = int(np.count_nonzero(equal & ~first[1:]))
        other = int(np.count_nonzero(~first)) - same
        order = order[first]
        stamps_ns, arrival_ns, values = stamps_ns[order], arrival_ns[order], values[order]
    return CleanSamples(stamps_ns, arrival_ns, values, nan_at, out_of_range_at, same, other)


def gate_mask(
    stamps_ns: IntArray, gate_stamps_ns: IntArray, gate_values: FloatArray, gate: QualityGate, hold_ns: int
) -> BoolArray:
    """Return where ground truth is usable: the last gate sample passes and is at most ``hold_ns`` old.

    Parameters
    ----------
    stamps_ns : int64 [N], ground truth.
    gate_stamps_ns, gate_values : int64 [M] ascending, float64 [M]; NaN never passes.
    """
    if gate_stamps_ns.shape[0] == 0:
        return np.zeros(stamps_ns.shape[0], np.bool_)
    passes = np.zeros(gate_values.shape[0], np.bool_)
    if gate.min is not None or gate.max is not None:
        low, high = -np.inf if gate.min is None else gate.min, np.inf if gate.max is None else gate.max
        passes |= (gate_values >= low) & (gate_values <= high)
    if gate.values:
        passes |= np.isin(gate_values, np.asarray(gate.values))
    last = np.searchsorted(gate_stamps_ns, stamps_ns, side="right") - 1
    return np.asarray((last >= 0) & passes[last] & (stamps_ns - gate_stamps_ns[last] <= hold_ns), dtype=np.bool_)


def read_signals(
    log: DriveLog,
    mapping: Mapping,
    clocks: dict[str, ClockModel],
    start_ns: int,
    end_ns: int,
    stamps: Collection[str] = (),
) -> MappedChannels:
    """Read the mapped fields of the messages with log time in [start, end) into clean channels.

    Each topic is read once.

    Parameters
    ----------
    clocks : from :func:`pdhef_logtool.mapping.fit_clocks` over the whole span that is going to be read.
    stamps : topics to read the times of, mapped or not.
    """
    resolved = resolve_mapping(log, mapping)
    log = with_can_signals(log, resolved)
    gate = resolved.quality
    sources = (*resolved.signals.values(), *resolved.truth.values())
    requests = requests_of(log, sources)
    columns = log.read({**dict.fromkeys(stamps, ()), **requests}, start_ns, end_ns) if requests or stamps else {}
    reading = _Reading(log, clocks, columns)
    for source in sources:
        reading.times(source)
    if isinstance(log, CanSignalLog):
        reading.losses += log.short_frames
    signals = {n: reading.channel("signal", s, SIGNAL_UNITS.get(n, "")) for n, s in resolved.signals.items()}
    truth = {n: reading.channel("truth", s, TRUTH_UNITS.get(n, "")) for n, s in resolved.truth.items()}
    if gate is not None and truth:
        truth = reading.gated(gate, truth, start_ns, end_ns)
    times = {topic: columns[topic] for topic in stamps}
    return MappedChannels(signals, truth, merge_losses([reading.losses]), reading.counts, times)


def merge_losses(parts: Iterable[Iterable[Loss]]) -> tuple[Loss, ...]:
    """Add up losses of one kind at one place, in order of first occurrence; spans are united."""
    merged: dict[tuple[str, str, str, str], Loss] = {}
    for loss in (x for part in parts for x in part):
        key = (loss.kind, loss.where, loss.what, loss.severity)
        old = merged.get(key)
        if old is None:
            merged[key] = loss
            continue
        starts = [x for x in (old.start_ns, loss.start_ns) if x is not None]
        ends = [x for x in (old.end_ns, loss.end_ns) if x is not None]
        counts = [x for x in (old.count, loss.count) if x is not None]
        count = sum(counts) if counts else None
        merged[key] = replace(old, start_ns=min(starts, default=None), end_ns=max(ends, default=None), count=count)
    return tuple(merged.values())


def dropped(kind: str, where: str, log_time_ns: IntArray) -> Loss:
    """Return the loss record of samples with these log times [N]."""
    n = int(log_time_ns.shape[0])
    start, end = (int(log_time_ns.min()), int(log_time_ns.max()) + 1) if n else (None, None)
    return Loss(kind, LOSS_TEXTS[kind], where, start, end, n, "lost" if kind in LOST_KINDS else "note")


class _Times(NamedTuple):
    """Usable stamps of a topic on the log's clock and their log times [N], and which messages these are [M]."""

    stamps_ns: IntArray
    log_time_ns: IntArray
    usable: BoolArray


@dataclass(slots=True)
class _Reading:
    """Columns of topics, and data that their channels share. Each topic's losses by its stamps are counted once."""

    log: DriveLog
    clocks: Mapped[str, ClockModel]
    columns: Mapped[str, Columns]
    losses: list[Loss] = field(default_factory=list)
    counts: dict[tuple[Role, str], Counter[str]] = field(default_factory=dict)
    timed: dict[str, _Times] = field(default_factory=dict)
    measured: dict[tuple[str, float], tuple[IntArray, IntArray]] = field(default_factory=dict)

    def times(self, source: SignalSource) -> _Times | None:
        """Return the times of a source's topic; None if it was not read."""
        key, where, topic = clock_key(source), source.read_topic, self.columns.get(source.read_topic)
        if key in self.timed or topic is None:
            return self.timed.get(key)
        clock = self.clocks.get(key, ClockModel())
        stamps, usable = stamps_on_log_clock(self.log, topic, source, clock)
        times = topic.log_time_ns
        if not usable.all():
            self.losses.append(dropped("bad-stamp", where, times[~usable]))
            stamps, times = stamps[usable], times[usable]
        if stamps.shape[0] > 1 and not np.all(stamps[1:] > stamps[:-1]):
            late = np.concatenate([[False], stamps[1:] < np.maximum.accumulate(stamps)[:-1]])
            order = np.argsort(stamps, kind="stable")
            repeated = np.concatenate([[False], stamps[order][1:] == stamps[order][:-1]])
            lost = {"out-of-order": times[late], "duplicate-stamp": times[order[repeated]]}
            self.losses += [dropped(kind, where, lost_ns) for kind, lost_ns in lost.items() if lost_ns.size]
        if clock.unusable:
            what = f"log time is used instead of {source.stamp}: {clock.unusable}"
            self.losses.append(Loss("log-time-serves", what, where, severity="note"))
        if not clock.delay_known:
            self.losses.append(Loss("delay-unknown", LOSS_TEXTS["delay-unknown"], where, severity="note"))
        return self.timed.setdefault(key, _Times(stamps, times, usable))

    def channel(self, role: Role, source: SignalSource, unit: str) -> Channel:
        """Return the clean channel of a source, and count its samples and losses."""
        count = self.counts[role, source.name] = Counter()
        topic, times = self.columns.get(source.read_topic), self.times(source)
        if topic is None or times is None or len(topic) == 0:
            empty = np.empty(0, np.int64)
            shape = (0,) if source.columns == 1 else (0, source.columns)
            return Channel(source.name, unit, source.label, empty, empty, np.empty(shape))
        key = (clock_key(source), source.latency_s)
        if key not in self.measured:  # channels of one topic share their stamps
            measured_ns = times.stamps_ns - np.int64(round(source.latency_s * 1e9))
            is_known = self.clocks.get(key[0], ClockModel()).delay_known
            arrived_ns = np.maximum(times.log_time_ns if is_known else times.stamps_ns, measured_ns)
            self.measured[key] = measured_ns, arrived_ns
        values = si_values(topic, source)
        if not times.usable.all():
            values = values[times.usable]
        clean = clean_samples(*self.measured[key], values, valid_min=source.valid_min, valid_max=source.valid_max)
        lost = {"nan": clean.nan_at, "out-of-range": clean.out_of_range_at}
        count.update({"read": len(topic), "bad-stamp": int(np.count_nonzero(~times.usable))})
        count.update({kind: rows.shape[0] for kind, rows in lost.items()})
        count.update({"repeated": clean.same, "duplicate-stamp": clean.other})
        where = f"{source.name} ({source.label})"
        self.losses += [dropped(kind, where, times.log_time_ns[rows]) for kind, rows in lost.items() if rows.size]
        return Channel(source.name, unit, source.label, clean.stamps_ns, clean.arrival_ns, clean.values)

    def gated(self, gate: QualityGate, truth: dict[str, Channel], start_ns: int, end_ns: int) -> dict[str, Channel]:
        """Return the ground truth that passes the gate, and count what does not."""
        source = gate.as_source()
        period_ns = self.clocks.get(clock_key(source), ClockModel()).median_period_s * 1e9
        # A gate that was sent once applies to the whole log.
        whole_ns = max(0, self.log.end_ns - self.log.start_ns)
        hold_ns = int(GATE_HOLD_PERIODS * period_ns) if np.isfinite(period_ns) else whole_ns
        requests = requests_of(self.log, [source])
        # Ground truth in this window may depend on a gate message that was recorded before the window, or after it.
        columns = self.log.read(requests, start_ns - hold_ns - GATE_MARGIN_NS, end_ns + GATE_MARGIN_NS)
        times = _Reading(self.log, self.clocks, columns).times(source)
        stamps, values = np.empty(0, np.int64), np.empty(0)
        if times is not None and times.usable.size:
            stamps = times.stamps_ns - np.int64(round(source.latency_s * 1e9))
            values = si_values(columns[source.read_topic], source)[times.usable]
            order = np.lexsort((values, times.log_time_ns, stamps))
            stamps, values = stamps[order], values[order]
        passed: dict[str, Channel] = {}
        for name, channel in truth.items():
            keep = gate_mask(channel.stamps_ns, stamps, values, gate, hold_ns)
            if not keep.all():
                loss = dropped("truth-quality", f"{name} ({gate.describe()})", channel.arrival_ns[~keep])
                self.losses.append(loss)
                self.counts["truth", name]["truth-quality"] += loss.count or 0
            passed[name] = channel.take(keep)
        return passed


def signed(magnitude: FloatArray, sign: FloatArray) -> FloatArray:
    """Return a magnitude [N], negative where the separate sign field [N] is 1."""
    return np.where(sign > 0.5, -np.abs(magnitude), np.abs(magnitude))


def si_values(topic: Columns, source: SignalSource) -> FloatArray:
    """Return ``scale * raw + offset`` of a source: [N], the sum or length of several fields, or [N, k] for a vector."""
    return si_of(source, [np.asarray(topic.fields[p], dtype=np.float64) for p in source.paths])


def si_of(source: SignalSource, parts: Sequence[FloatArray]) -> FloatArray:
    """Return :func:`si_values` for the raw values of a source's fields."""
    raw = parts[0] if len(parts) == 1 else np.stack(parts, axis=1)
    width = source.columns
    if width == 1 and len(parts) > 1 and raw.ndim == 2:
        # Summed one by one: a matrix product may round differently with the number of rows.
        scales = np.broadcast_to(np.asarray(source.scale), len(parts))
        power = 2 if source.combine == "norm" else 1
        total = sum((s * raw[:, i]) ** power for i, s in enumerate(scales))
        if source.combine == "signed":
            total = scales[0] * signed(raw[:, 0], raw[:, 1])
        elif source.combine != "sum":
            total = np.sqrt(np.maximum(total, 0.0))
        return np.asarray(total + source.offset, dtype=np.float64)
    shape = (len(raw), width) if width > 1 else (len(raw),)
    if raw.shape != shape:
        raw = np.full(shape, np.nan)  # Wrong number of columns: every sample is counted as lost.
    return np.asarray(raw * np.asarray(source.scale) + np.asarray(source.offset), dtype=np.float64)
