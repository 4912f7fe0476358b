"""A whole drive in memory: the log's channels as its plan reads them, aligned, with ground truth at the same stamps."""

import hashlib
from collections import Counter
from collections.abc import Collection, Mapping as Mapped
from dataclasses import dataclass, replace

import numpy as np

from pdhef_logtool.car.vehicle import correct_signals
from pdhef_logtool.drive.alignment import align
from pdhef_logtool.drive.plan import DrivePlan
from pdhef_logtool.drive.sensor_changes import SensorChange, find_changes
from pdhef_logtool.drive.truth import derive_truth, truth_at
from pdhef_logtool.drive.truth_steps import steps_from_truth
from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.mapping import ClockModel, clock_key, merge_losses, read_signals
from pdhef_logtool.mapping.records import SignalSource
from pdhef_logtool.records.ledger import Role, SampleCount
from pdhef_logtool.records.readings import impossible_readings, without_impossible
from pdhef_logtool.records.signals import NS_PER_S, S_PER_NS, Channel, FloatArray, Loss, Signals
from pdhef_logtool.records.steps import last_known
from pdhef_logtool.records.tracks import StateTrack

#: A gap of a channel is reported if it is longer than both this time and this many periods.
TOLD_GAP_S = 1.0
TOLD_GAP_PERIODS = 10.0
#: Reason for intact samples of a signal that is not needed.
_NOT_NEEDED = "not-needed"
_IMPOSSIBLE = "readings that no vehicle can have were taken as missing by the estimators"
_LATE = "samples arrived much later than their neighbours: they were not waited for and count as missing"


@dataclass(frozen=True, slots=True, eq=False)
class WholeDrive:
    """A drive in memory, as its plan reads it from the log.

    Attributes
    ----------
    signals, truth : [N] at the same stamps; N may be 0, and ``truth`` is None without ground truth.
    ledger : used and dropped samples of each mapped signal.
    changes : of the sensors in mid-drive, corrected in ``signals``. from_truth : steps from the ground truth, which
        are not corrected.
    signals_sha256, truth_sha256 : hashes of the channels' content; None without samples.
    """

    name: str
    plan: DrivePlan
    signals: Signals
    truth: StateTrack | None
    log_start_ns: int
    changes: tuple[SensorChange, ...] = ()
    from_truth: tuple[SensorChange, ...] = ()
    losses: tuple[Loss, ...] = ()
    ledger: tuple[SampleCount, ...] = ()
    signals_sha256: str | None = None
    truth_sha256: str | None = None

    def __repr__(self) -> str:
        return f"<WholeDrive {self.name}: {self.seconds:.1f} s, with{'out' * (self.truth is None)} ground truth>"

    @property
    def every_change(self) -> tuple[SensorChange, ...]:
        """All changes of sensors in mid-drive, corrected or not."""
        return (*self.changes, *self.from_truth)

    @property
    def seconds(self) -> float:
        """Time from first to last stamp."""
        return float(self.signals.stamps_ns[-1] - self.signals.stamps_ns[0]) * S_PER_NS

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last stamp in seconds from the log's start."""
        stamps = self.signals.stamps_ns
        return float(stamps[0] - self.log_start_ns) * S_PER_NS, float(stamps[-1] - self.log_start_ns) * S_PER_NS


def read_recorded(log: DriveLog, plan: DrivePlan, unchanged: Collection[str] = (), name: str = "") -> WholeDrive:
    """Read the slice of a plan once, align it and derive the ground truth; ``unchanged`` sensors are not corrected."""
    from pdhef_logtool.drive.sensor_faults import without_faults  # loads the compiler

    part = read_signals(log, plan.mapping, plan.clocks, plan.start_ns, plan.end_ns)
    if log.messages is not None:
        log.messages.forget()
    hashes = (channels_sha256(part.signals, plan.mapping.signals), channels_sha256(part.truth, plan.mapping.truth))
    gaps = [_gaps(channel) for channel in (*part.signals.values(), *part.truth.values())]
    signals, late_counts = align(part.signals, plan.alignment)
    signals = correct_signals(signals, plan.vehicle)
    late = []
    for name in sorted(late_counts.keys() & part.signals.keys()):
        part.counts["signal", name]["late"] += late_counts[name]
        channel = part.signals[name]
        start_ns, end_ns = int(channel.stamps_ns[0]), int(channel.stamps_ns[-1]) + 1
        late.append(Loss("late", _LATE, channel.source, start_ns, end_ns, late_counts[name], "note"))
    losses = merge_losses([part.losses, *gaps, late, _impossible(signals)])
    ledger = sample_ledger(log, plan, part.counts)
    truth = None
    if plan.truth is not None:
        derived, standstill = derive_truth(part.truth, plan=plan.truth), plan.vehicle.standstill_m_s
        truth = truth_at(derived, signals.stamps_ns, plan.truth_latency_s, standstill_m_s=standstill)
        del derived
    del part  # the channels take as much memory as all that follows
    # The end of a stuck value would be taken for a jump.
    signals, changes = find_changes(without_faults(without_impossible(signals), plan.vehicle), unchanged)
    truth = None if truth is None else replace(truth, measured_speed_m_s=_measured_speed(signals))
    from_truth = () if truth is None else steps_from_truth(signals, truth)
    return WholeDrive(name, plan, signals, truth, log.start_ns, changes, from_truth, losses, ledger, *hashes)


def channels_sha256(channels: Mapped[str, Channel], sources: Mapped[str, SignalSource]) -> str | None:
    """Return the hash of names, stamps on the log's clock and values in SI units; None without samples.

    Stamps are hashed before the latency of a source is subtracted, because mapping files and cars may change the
    latency of the same drive. Arrival times are not hashed.
    """
    total = hashlib.sha256()
    full = [(name, channel) for name, channel in sorted(channels.items()) if len(channel)]
    for name, channel in full:
        stamps_ns = channel.stamps_ns + round(sources[name].latency_s * NS_PER_S)
        # -0.0 and 0.0 are one value.
        values = np.ascontiguousarray(channel.values + 0.0, dtype="<f8")
        total.update(name.encode() + b"\0" + hashlib.sha256(stamps_ns.astype("<i8").data).digest())
        total.update(hashlib.sha256(values.data).digest())
    return total.hexdigest() if full else None


def _measured_speed(signals: Signals) -> FloatArray:
    """Return the last known speed [N]; from GNSS where no other sensor measures it."""
    of_gnss = np.hypot(*signals.gnss_velocity_m_s.T)
    speed = np.where(np.isfinite(signals.speed_m_s), signals.speed_m_s, of_gnss)
    return last_known(signals.stamps_ns, speed)


def sample_ledger(
    log: DriveLog, plan: DrivePlan, counts: Mapped[tuple[Role, str], Counter[str]]
) -> tuple[SampleCount, ...]:
    """Return the numbers of used and dropped samples of each mapped signal, from the counts of a plan's slice."""
    messages = {t.name: t.messages for t in log.topics}
    whole = plan.start_ns <= log.start_ns and plan.end_ns >= log.end_ns
    aligned = {c.name for c in plan.alignment.channels}
    samples = []
    for (role, name), count in counts.items():
        source = (plan.mapping.signals if role == "signal" else plan.mapping.truth)[name]
        dropped = Counter({reason: n for reason, n in count.items() if reason != "read"})
        total = count["read"]
        if source.read_topic in messages:  # a signal of raw CAN frames is in some messages of its topic only
            left_out = log.recording_span.left_out.get(source.topic, {})
            rest = messages[source.topic] - total - sum(left_out.values())
            total = messages[source.topic]
            dropped.update({**left_out, ("not-read" if whole else "outside-slice"): rest})
        used = total - sum(dropped.values())
        if role == "signal" and name not in aligned:
            dropped[_NOT_NEEDED], used = used, 0
        clock = plan.clocks.get(clock_key(source), ClockModel())
        reasons = {reason: n for reason, n in sorted(dropped.items()) if n}
        stamp = "log_time" if clock.unusable else source.stamp
        samples.append(SampleCount(role, name, source.label, stamp, total, used, reasons))
    return tuple(samples)


def _impossible(signals: Signals) -> list[Loss]:
    losses = []
    for name, mask in impossible_readings(signals).items():
        stamps = signals.stamps_ns[mask]
        losses.append(Loss("impossible", _IMPOSSIBLE, name, int(stamps[0]), int(stamps[-1]) + 1, len(stamps), "note"))
    return losses


def _gaps(channel: Channel) -> list[Loss]:
    """Return the gaps within a channel."""
    stamps = channel.stamps_ns
    if stamps.shape[0] < 3:
        return []
    steps = np.diff(stamps)
    least = max(TOLD_GAP_S * NS_PER_S, TOLD_GAP_PERIODS * float(np.median(steps)))
    longer, text = np.flatnonzero(steps > least), "no samples for {:.2f} s"
    spans = zip(stamps[longer].tolist(), stamps[longer + 1].tolist(), strict=True)
    return [Loss("gap", text.format((b - a) * S_PER_NS), channel.source, a, b, 1, "note") for a, b in spans]
