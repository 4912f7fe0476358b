"""From a log to aligned signals and ground truth, window by window, with everything decided once a log beforehand."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator, Sequence
from collections.abc import Mapping as Mapped
from dataclasses import dataclass, field, replace

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters, correct_signals
from pdhef_logtool.drive.alignment import (
    SURVEY_S,
    AlignmentPlan,
    Clock,
    align,
    count_late,
    has_imu,
    no_alignment,
    plan_alignment,
)
from pdhef_logtool.drive.channel_hash import ChannelHash
from pdhef_logtool.drive.mounting import survey_log
from pdhef_logtool.drive.setup import Setup, clocks_of
from pdhef_logtool.drive.truth import (
    LatencyEstimate,
    TruthPlan,
    dependent_signals,
    derive_truth,
    truth_at,
)
from pdhef_logtool.logs.drive_log import DriveLog, windows
from pdhef_logtool.mapping import (
    ClockModel,
    MappedChannels,
    Mapping,
    clock_key,
    fit_clocks,
    join_channels,
    merge_losses,
    read_signals,
)
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.ledger import Role, SampleCount
from pdhef_logtool.records.readings import impossible_readings
from pdhef_logtool.records.signals import Channel, FloatArray, IntArray, Loss, Signals, join_signals
from pdhef_logtool.records.steps import last_known
from pdhef_logtool.records.tracks import StateTrack

#: A silence of a channel is given from here on, and from this many of its periods.
TOLD_GAP_S = 1.0
TOLD_GAP_PERIODS = 10.0
#: Why a signal's samples are not used although nothing is wrong with them.
_NOT_NEEDED = "not-needed"
#: Before every stamp.
_FIRST_NS = -(1 << 63)
_JUMP = "samples whose stamps jump back behind what had been processed were dropped"
_IMPOSSIBLE = "readings that no vehicle can have were taken as missing by the estimators"
_LATE = "samples arrived much later than their neighbours: they were not waited for and count as missing"


@dataclass(frozen=True, slots=True, eq=False)
class DrivePlan:
    """What is decided from the first ten minutes of a log and applies to all of its windows.

    Attributes
    ----------
    survey_truth : channels of the ground truth that it was decided on.
    latency : of the ground truth against the sensors; None without ground truth yaw rate or gyro.
    dependent : ground truth quantities that are an input of the estimators, with the reason.
    derivation : by ground truth quantity, how it is derived.
    decided_s : seconds of the log, or of that of the set-up, that the sensors' part was decided on.
    checks : of signals, ground truth and vehicle file.
    refused : mapped channels, those of ground truth with ``truth.``, that nothing is computed from, with the reason.
    """

    mapping: Mapping
    vehicle: VehicleParameters
    clocks: dict[str, ClockModel]
    alignment: AlignmentPlan
    truth: TruthPlan | None
    latency: LatencyEstimate | None
    dependent: dict[str, str]
    derivation: dict[str, str]
    survey_truth: dict[str, Channel]
    start_ns: int
    end_ns: int
    decided_s: float
    checks: tuple[Check, ...] = ()
    refused: dict[str, str] = field(default_factory=dict)

    @property
    def truth_latency_s(self) -> float:
        """Latency that all estimators' comparison with ground truth uses; 0 unless it is out of its own uncertainty."""
        is_significant = self.latency is not None and abs(self.latency.latency_s) > 2.0 * self.latency.std_error_s
        return self.latency.latency_s if is_significant and self.latency is not None else 0.0

    @property
    def has_truth_pose(self) -> bool:
        """Whether the ground truth has position and heading."""
        return {"position_m", "yaw_rad"} <= self.derivation.keys()

    @property
    def margin_ns(self) -> int:
        """How much of the channels a window needs on both sides."""
        truth_margin = 0 if self.truth is None else self.truth.margin_ns
        return max(self.alignment.margin_ns, truth_margin)


@dataclass(frozen=True, slots=True, eq=False)
class DriveWindow:
    """One window: what the estimators see, and the ground truth at the same stamps (None if the log has none)."""

    signals: Signals
    truth: StateTrack | None
    share_done: float


def plan_drive(
    log: DriveLog,
    mapping: Mapping,
    vehicle: VehicleParameters,
    start_ns: int,
    end_ns: int,
    *,
    require_imu: bool = True,
    clock: Clock = "arrival",
    setup: Setup | None = None,
    waived: Sequence[str] = (),
) -> DrivePlan:
    """Read at most ten minutes of the slice [start_ns, end_ns) and decide clocks, alignment and ground truth.

    Parameters
    ----------
    require_imu : False gives a plan with no alignment (``alignment.channels`` empty) where there is no IMU.
    clock : as for :func:`~.alignment.plan_alignment`. setup : the sensors' part of the plan; None decides it here.
    waived : names of checks whose failure does not stop the use of a channel.

    Raises
    ------
    MappingError : The log lacks what is mapped, or there is no IMU to set the stamps.
    """
    mapping = with_gyro_delay(mapping, vehicle)
    if setup is not None:
        mapping = setup.applied_to(mapping)
    clocks = fit_clocks(log, mapping, start_ns, end_ns)
    if setup is not None:
        clocks |= clocks_of(setup, log, mapping, start_ns)
    span_ns = (start_ns, min(end_ns, start_ns + round(SURVEY_S * 1e9)))
    looked_at = survey_log(log, mapping, clocks, span_ns, vehicle)
    mapping, survey = looked_at.mapping, looked_at.channels
    if setup is not None:
        alignment = setup.alignment
    elif require_imu or has_imu(survey.signals):
        alignment = plan_alignment(
            survey.signals,
            steering_ratio=vehicle.steering_ratio,
            wheel_radius_m=vehicle.wheel_radius_m,
            clock=clock,
        )
    else:
        alignment = no_alignment(survey.signals)
    # What a set-up reads must not depend on later samples.
    refused = looked_at.refused(waived, is_causal=setup is not None)
    mapping, sound = without_refused_truth(mapping, refused), looked_at
    if mapping is not looked_at.mapping:
        sound = survey_log(log, mapping, clocks, span_ns, vehicle, rescale=False)
    truth, derived = sound.truth_plan, sound.truth
    derivation = {} if derived is None else dict(derived.derivation)
    return DrivePlan(
        mapping=mapping,
        vehicle=vehicle,
        clocks=clocks,
        alignment=alignment.without(refused),
        truth=truth,
        latency=sound.latency,
        dependent=dependent_signals(survey.signals, sound.channels.truth) if truth else {},
        derivation=derivation,
        survey_truth=sound.channels.truth,
        start_ns=start_ns,
        end_ns=end_ns,
        decided_s=(end_ns - start_ns) * 1e-9 if setup is None else setup.decided_s,
        checks=looked_at.checks,
        refused=refused,
    )


def without_refused_truth(mapping: Mapping, refused: Mapped[str, str]) -> Mapping:
    """Return the mapping without refused ground truth; without any if a quantity that is derived is refused."""
    names = {n.removeprefix("truth.") for n in refused if n.startswith("truth.")}
    if not names:
        return mapping
    kept = {n: s for n, s in mapping.truth.items() if n not in names}
    return replace(mapping, truth=kept if names <= mapping.truth.keys() else {})


def setup_of(plan: DrivePlan) -> Setup:
    """Return what of a plan can be frozen: mapping, clocks and alignment of the sensors."""
    keys = {clock_key(source) for source in plan.mapping.signals.values()}
    return Setup(
        signals=plan.mapping.signals,
        clocks={key: clock for key, clock in plan.clocks.items() if key in keys},
        alignment=plan.alignment,
        decided_s=plan.decided_s,
        can=plan.mapping.can,
    )


def with_gyro_delay(mapping: Mapping, vehicle: VehicleParameters) -> Mapping:
    """Return the mapping with the gyro's delay that the car has: all of it, in place of the mapping's own."""
    delay_s, gyro = vehicle.sensors.yaw_rate_delay_s, mapping.signals.get("yaw_rate_rad_s")
    if delay_s == 0.0 or gyro is None or gyro.latency_s == delay_s:
        return mapping
    note = f"the car's gyro is {delay_s * 1e3:.1f} ms late, in place of latency_s = {gyro.latency_s:g} of the mapping"
    signals = {**mapping.signals, gyro.name: replace(gyro, latency_s=delay_s)}
    return replace(mapping, signals=signals, notes=(*mapping.notes, note))


@dataclass(slots=True)
class DriveReader:
    """Reads a planned drive once from start to end; ``losses``, ``samples`` and ``counts`` grow while it does.

    A drive of a single window keeps it for the next request. ``counts`` are those of
    :class:`~pdhef_logtool.mapping.channels.MappedChannels`, of all windows so far; ``hashes`` of the channels' content,
    complete once all windows were read.
    """

    log: DriveLog
    plan: DrivePlan
    window_s: float
    losses: tuple[Loss, ...] = ()
    samples: dict[str, int] | None = None
    counts: dict[tuple[Role, str], Counter[str]] = field(default_factory=dict)
    hashes: dict[Role, ChannelHash] = field(default_factory=lambda: {"signal": ChannelHash(), "truth": ChannelHash()})
    _done: bool = False
    _only: DriveWindow | None = None
    _speed: tuple[IntArray, FloatArray] = (np.empty(0, np.int64), np.empty(0))

    @property
    def can_repeat(self) -> bool:
        """Whether :meth:`windows` can be asked again: it then yields what it has read."""
        return self._only is not None

    def windows(self) -> Iterator[DriveWindow]:
        """Yield the drive's windows in order; joined, they are bit-identical to one window over all."""
        if self._only is not None:
            yield self._only
            return
        plan = self.plan
        margin = plan.margin_ns
        signals: dict[str, Channel] = {}
        truth: dict[str, Channel] = {}
        counts: dict[str, int] = {}
        done_ns: int | None = None
        hashed_ns = _FIRST_NS
        self._speed = np.empty(0, np.int64), np.empty(0)
        ends = list(windows(plan.start_ns, plan.end_ns, round(self.window_s * 1e9), self.log.recording_span))
        for a, b in ends:
            part = read_signals(self.log, plan.mapping, plan.clocks, a, b)
            self.losses = merge_losses([self.losses, part.losses])
            for key, count in part.counts.items():
                self.counts.setdefault(key, Counter()).update(count)
            for role, store, new in _by_role(signals, truth, part):
                for name, channel in new.items():
                    self.losses = merge_losses([self.losses, _gaps(store.get(name), channel)])
                    back = 0 if done_ns is None else int(np.searchsorted(channel.stamps_ns, done_ns - margin))
                    if back:
                        first, last_back = int(channel.stamps_ns[0]), int(channel.stamps_ns[back - 1]) + 1
                        jump = Loss("time-jump", _JUMP, channel.source, first, last_back, back)
                        self.losses = merge_losses([self.losses, [jump]])
                    counts[channel.source] = counts.get(channel.source, 0) + len(channel)
                    joined = join_channels([store[name], channel]) if name in store else channel
                    self._count_joined(role, name, (store.get(name), channel, joined), back, done_ns)
                    store[name] = joined
            self.samples = counts
            last = (a, b) == ends[-1]
            stamps = [c.stamps_ns for c in signals.values() if len(c)]
            if not stamps:
                continue
            if done_ns is None:
                done_ns = min(int(s[0]) for s in stamps)
            newest = max(int(s[-1]) for s in stamps) + 1
            until = newest if last else min(newest, b) - margin
            if until <= done_ns:
                continue
            self._hash(signals, truth, hashed_ns, None if last else until)
            hashed_ns = until
            window = self._window(signals, truth, done_ns, until, (b - plan.start_ns) / (plan.end_ns - plan.start_ns))
            if len(ends) == 1:
                self._done, self._only = True, window
            yield window
            done_ns = until
            signals = {n: c.between(until - margin) for n, c in signals.items()}
            truth = {n: c.between(until - margin) for n, c in truth.items()}
        self._done = True

    def _count_joined(
        self, role: Role, name: str, parts: tuple[Channel | None, Channel, Channel], back: int, done_ns: int | None
    ) -> None:
        """Count what of a window's channel comes too late: ``back`` samples of it, or for a stamp that is there."""
        before, channel, joined = parts
        if before is None or done_ns is None:
            seam, behind = (0 if before is None else len(before) + len(channel) - len(joined)), 0
        else:
            seam = sum(len(c.between(done_ns)) for c in (before, channel)) - len(joined.between(done_ns))
            behind = int(np.searchsorted(channel.stamps_ns, done_ns))
        self.counts[role, name].update({"time-jump": back, "late": behind - back, "duplicate-stamp": seam})

    def _hash(self, signals: dict[str, Channel], truth: dict[str, Channel], start_ns: int, end_ns: int | None) -> None:
        """Hash the samples with stamps in [start_ns, end_ns), which no later window changes."""
        for channels, sources, accumulator in (
            (signals, self.plan.mapping.signals, self.hashes["signal"]),
            (truth, self.plan.mapping.truth, self.hashes["truth"]),
        ):
            for name, channel in channels.items():
                accumulator.add(channel.between(start_ns, end_ns), round(sources[name].latency_s * 1e9))

    def ledger(self) -> tuple[SampleCount, ...]:
        """Return what became of every sample of the mapped topics; empty until all windows were read."""
        return sample_ledger(self.log, self.plan, self.counts) if self._done else ()

    def _window(
        self, signals: dict[str, Channel], truth: dict[str, Channel], start_ns: int, end_ns: int, share: float
    ) -> DriveWindow:
        plan = self.plan
        aligned = correct_signals(align(signals, plan.alignment, start_ns, end_ns), plan.vehicle)
        counts = count_late(signals, plan.alignment, start_ns, end_ns)
        late = [Loss("late", _LATE, signals[n].source, start_ns, end_ns, count, "note") for n, count in counts.items()]
        for name, count in counts.items():
            self.counts["signal", name]["late"] += count
        self.losses = merge_losses([self.losses, late, _impossible(aligned)])
        at_stamps = None
        if plan.truth is not None:
            at_stamps = truth_at(
                derive_truth(truth, plan=plan.truth),
                aligned.stamps_ns,
                plan.truth_latency_s,
                standstill_m_s=plan.vehicle.standstill_m_s,
            )
            at_stamps = replace(at_stamps, measured_speed_m_s=self._measured_speed(aligned))
        return DriveWindow(aligned, at_stamps, share)

    def _measured_speed(self, aligned: Signals) -> FloatArray:
        """Return the last known speed at the stamps [N] of a window, of GNSS where no other sensor measures it."""
        of_gnss = np.hypot(*aligned.gnss_velocity_m_s.T)
        speed = np.where(np.isfinite(aligned.speed_m_s), aligned.speed_m_s, of_gnss)
        stamps, speed = (np.concatenate(pair) for pair in zip(self._speed, (aligned.stamps_ns, speed), strict=True))
        last = np.flatnonzero(np.isfinite(speed))[-1:]
        self._speed = stamps[last], speed[last]
        return last_known(stamps, speed)[len(stamps) - len(aligned) :]


def sample_ledger(
    log: DriveLog, plan: DrivePlan, counts: Mapped[tuple[Role, str], Counter[str]]
) -> tuple[SampleCount, ...]:
    """Return what became of every sample of the mapped topics, of the counts of all windows of the plan's slice."""
    messages = {t.name: t.messages for t in log.topics}
    whole = plan.start_ns <= log.start_ns and plan.end_ns >= log.end_ns
    aligned = {c.name for c in plan.alignment.channels}
    samples = []
    for (role, name), count in counts.items():
        source = (plan.mapping.signals if role == "signal" else plan.mapping.truth)[name]
        dropped = Counter({reason: n for reason, n in count.items() if reason != "read"})
        total = count["read"]
        if source.read_topic in messages:  # a signal of raw CAN frames is read of some of its topic's messages
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


def _by_role(
    signals: dict[str, Channel], truth: dict[str, Channel], part: MappedChannels
) -> tuple[tuple[Role, dict[str, Channel], dict[str, Channel]], ...]:
    return ("signal", signals, part.signals), ("truth", truth, part.truth)


def with_look_ahead(
    windows: Iterable[DriveWindow], look_ahead_s: float
) -> Iterator[tuple[DriveWindow, Signals | None]]:
    """Yield the windows that contain a stamp, each with the signals of the ``look_ahead_s`` behind its last stamp.

    They are fewer only where the drive ends, and None where there are none or none are asked for. No more windows
    are held at once than that takes.
    """
    held: deque[DriveWindow] = deque()
    look_ahead_ns = round(look_ahead_s * 1e9)
    for window in windows:
        if len(window.signals):
            held.append(window)
        while held and held[-1].signals.stamps_ns[-1] - held[0].signals.stamps_ns[-1] >= look_ahead_ns:
            yield _with_following(held, look_ahead_ns)
    while held:
        yield _with_following(held, look_ahead_ns)


def _with_following(held: deque[DriveWindow], look_ahead_ns: int) -> tuple[DriveWindow, Signals | None]:
    """Take the first window from ``held``; return it with what follows within the time."""
    first = held.popleft()
    if not held or look_ahead_ns == 0:
        return first, None
    following = join_signals([w.signals for w in held])
    until = int(np.searchsorted(following.stamps_ns, first.signals.stamps_ns[-1] + look_ahead_ns, side="right"))
    return first, following.rows(0, until)


def _impossible(signals: Signals) -> list[Loss]:
    losses = []
    for name, mask in impossible_readings(signals).items():
        stamps = signals.stamps_ns[mask]
        losses.append(Loss("impossible", _IMPOSSIBLE, name, int(stamps[0]), int(stamps[-1]) + 1, len(stamps), "note"))
    return losses


def _gaps(before: Channel | None, channel: Channel) -> list[Loss]:
    """Return the silences within a window's channel and between it and the window before."""
    stamps = channel.stamps_ns
    if before is not None and len(before):
        stamps = np.concatenate([before.stamps_ns[-1:], stamps])
    if stamps.shape[0] < 3:
        return []
    steps = np.diff(stamps)
    least = max(TOLD_GAP_S * 1e9, TOLD_GAP_PERIODS * float(np.median(steps)))
    gaps = [
        (int(stamps[i]), int(stamps[i + 1]), f"no samples for {steps[i] * 1e-9:.2f} s")
        for i in np.flatnonzero(steps > least)
    ]
    return [Loss("gap", what, channel.source, start_ns, end_ns, 1, "note") for start_ns, end_ns, what in gaps]
