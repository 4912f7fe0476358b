"""Scores estimates that somebody else recorded in a log: which fields they are, their stamps, truth there, figures.

The scored stamps are the estimate's own. The truth is interpolated to them, its latency measured gyro to truth where
the log has an IMU; the sensors, which only cut the drive into segments, are interpolated to them too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters, default_vehicle, load_vehicle
from pdhef_logtool.drive.interpolation import Bracket
from pdhef_logtool.drive.truth import (
    SAME_SHARE,
    TruthTrack,
    dependent_signals,
    derive_truth,
    share_equal,
    truth_at,
)
from pdhef_logtool.drive.windows import DrivePlan, DriveReader, plan_drive
from pdhef_logtool.logs.discovery import LogInput, find_logs, hash_log
from pdhef_logtool.logs.drive_log import DriveLog, windows
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import (
    Mapping as SignalMapping,
)
from pdhef_logtool.mapping import (
    SignalSource,
    check_mapping,
    choose_mapping,
    join_channels,
    load_mapping,
    merge_losses,
    read_signals,
)
from pdhef_logtool.mapping.estimates import EstimateSource, choose_estimates, sources_of
from pdhef_logtool.records.errors import MappingError, UsageError
from pdhef_logtool.records.signals import (
    TRUTH_UNITS,
    WHEELS,
    Channel,
    FloatArray,
    IntArray,
    Loss,
    Signals,
    join_signals,
)
from pdhef_logtool.records.tracks import StateTrack, concatenate, make_track
from pdhef_logtool.run.config import RunConfig, time_slice
from pdhef_logtool.run.estimate_channels import RecordedEstimate, gap_ns, read_estimate
from pdhef_logtool.run.pipeline import (
    DeadReckoning,
    LogResult,
    Progress,
    RunResult,
    first_pose,
    judge,
    make_folder,
    read_thresholds,
    report_facts,
    without_whole,
    write_run,
    write_verdicts,
)
from pdhef_logtool.sinks.base import TRUTH, Event
from pdhef_logtool.sinks.report import EstimatorFacts, LogOutcome, build_report, write_json

if TYPE_CHECKING:
    from pdhef_logtool.evaluation.metrics import MetricRow


_RECORDED = "read from the log: nothing says whether it is causal, or what it was computed from"


def score_log(
    argument: str,
    config: RunConfig,
    *,
    estimates: Sequence[str] = (),
    truth: Sequence[str] = (),
    name: str | None = None,
    output: Path | None = None,
    junit: Path | None = None,
    progress: Progress = lambda _text, _share: None,
    warn: Callable[[str], None] = lambda _text: None,
) -> RunResult:
    """Score recorded estimates of one log against its truth; same figures, tables and report as a run.

    Parameters
    ----------
    argument : the log. config : of it count vehicle, mapping, slice, truth choice and thresholds.
    estimates : ``[SIGNAL=]TOPIC[.FIELD]``, together one estimator called ``name`` (default: its topic); without any,
        the mapping's ``[estimates.NAME.SIGNAL]`` tables, all or the one called ``name``.
    truth : likewise; without any, the mapping's or the recognised truth.
    output : folder for the files, None to write none. junit : as for :func:`pdhef_logtool.run.pipeline.run_logs`.

    Raises
    ------
    PdhefError
        There is no estimate, no truth, or nothing of the log can be used.
    """
    inputs = find_logs([argument])
    if len(inputs) != 1:
        raise UsageError(expected="one log", got=f"{len(inputs)} of them", where=argument)
    vehicle = default_vehicle() if config.vehicle is None else load_vehicle(config.vehicle)
    mapping = None if config.mapping is None else load_mapping(config.mapping)
    thresholds = read_thresholds(config, junit)
    if config.vehicle is None:
        slow = vehicle.low_speed_blend_m_s
        warn(
            f"no --vehicle: the truth is taken to be measured at the centre of gravity, sideslip is scored above "
            f"{slow:g} m/s, and segments are cut at friction {vehicle.assumed_friction:g}"
        )
    log = open_log(inputs[0].path)
    try:
        scoring = _Scoring(log, inputs[0], config, vehicle, warn)
        scoring.choose(mapping, estimates, truth, name)
        result = judge(scoring.score(output, progress), thresholds)
    finally:
        log.close()
    if output is not None:
        document = _config_document(config, scoring)
        write_run(output, document, [result])
    write_verdicts(junit, [result])
    return RunResult(output, (result,))


def _config_document(config: RunConfig, scoring: _Scoring) -> dict[str, Any]:
    document = config.to_dict()
    for key in ("estimators", "annotate", "sensors"):
        del document[key]
    document["estimates"] = {
        e.name: {name: source.label for name, source in e.signals.items()} for e in scoring.estimates
    }
    document["truth"] = {name: source.label for name, source in scoring.mapping.truth.items()}
    return document


class _Scoring:
    """One log being scored: what was chosen for it, and what the reader of the report must know."""

    def __init__(
        self,
        log: DriveLog,
        log_input: LogInput,
        config: RunConfig,
        vehicle: VehicleParameters,
        warn: Callable[[str], None],
    ) -> None:
        self.log, self.log_input, self.config, self.vehicle = log, log_input, config, vehicle
        self.mapping = SignalMapping()
        self.missing: tuple[str, ...] = ()
        self.estimates: tuple[EstimateSource, ...] = ()
        self.warnings: list[str] = []
        self._warn = warn

    def tell(self, text: str) -> None:
        """Say it now, and in the report."""
        self.warnings.append(text)
        self._warn(f"{self.log_input.stem}: {text}")

    def choose(
        self, mapping: SignalMapping | None, estimates: Sequence[str], truth: Sequence[str], name: str | None
    ) -> None:
        """Decide which fields are estimate, truth and sensors."""
        self.estimates = choose_estimates(self.log, estimates, mapping, name)
        named = sources_of(self.log, truth, TRUTH_UNITS, "--truth")[0] if truth else None
        can = None if mapping is None else mapping.can
        if mapping is not None and not mapping.signals and not mapping.truth:
            mapping = None  # a file of estimates alone leaves the rest to recognition
        if mapping is not None and named is not None:
            mapping = self._with_truth(mapping, named)
        chosen, self.missing = choose_mapping(
            self.log, mapping, self.tell, prefer_truth=self.config.prefer_truth, require_signals=False
        )
        if mapping is None and named is not None:
            chosen = replace(self._with_truth(chosen, named), can=can)
            check_mapping(chosen, self.log)
        self.mapping = chosen
        for estimate in self.estimates:
            check_mapping(estimate.as_mapping(), self.log)
        if not chosen.truth:
            raise MappingError(
                expected="a truth to score against",
                got="none mapped and none recognised",
                where=str(self.log.path),
                remedy="name it with --truth SIGNAL=TOPIC.FIELD or in a mapping file",
            )

    def _with_truth(self, mapping: SignalMapping, truth: dict[str, SignalSource]) -> SignalMapping:
        if mapping.quality is not None:
            self.tell(f"--truth replaces the mapped truth and its gate on {mapping.quality.describe()}")
        return replace(mapping, truth=truth, quality=None)

    def score(self, output: Path | None, progress: Progress) -> LogResult:
        """Read, compare and, with a folder, write."""
        log, stem = self.log, self.log_input.stem
        start_ns, end_ns = time_slice(self.config, log.start_ns, log.end_ns)
        sha256 = hash_log(self.log_input.path)
        progress(stem, 0.1)
        plan = plan_drive(log, self.mapping, self.vehicle, start_ns, end_ns, require_imu=False)
        recorded, losses = self._read_estimates(start_ns, end_ns)
        progress(stem, 0.3)
        truth, truth_losses, samples = read_truth(log, plan, self.config.window_s)
        progress(stem, 0.6)
        signals, sensor_losses, counts = self._read_sensors(plan)
        progress(stem, 0.8)
        samples |= counts
        scored_ns = np.unique(np.concatenate([r.track.stamps_ns for r in recorded]))
        plan = self._with_dependence(plan, recorded)
        rows, dependent = self._figures(plan, recorded, truth, signals)
        plan = replace(plan, dependent={**dependent, **plan.dependent})
        truth_track = truth_at(truth, scored_ns, plan.truth_latency_s)
        events = self._events(truth_track, signals_at(signals, scored_ns), recorded)
        for r in recorded:
            samples |= r.samples
        all_losses = merge_losses([log.lost, losses, truth_losses, sensor_losses])
        facts = report_facts(
            log, self.log_input, sha256, plan, self.missing, self.vehicle,
            [EstimatorFacts(r.track.name, causal=True, notes=[_RECORDED, *r.notes]) for r in recorded],
            rows, events, all_losses, self.warnings, samples,
        )  # fmt: skip
        read = {s.topic for e in self.estimates for s in e.signals.values()}
        topics = [replace(t, mapped=t.mapped or t.name in read) for t in facts.log.topics]
        latency = [] if plan.latency is not None else ["no gyro to measure the truth's latency with: taken as 0"]
        facts = replace(
            facts,
            log=replace(facts.log, topics=topics),
            truth=replace(facts.truth, notes=[*latency, *facts.truth.notes]),
        )
        report = build_report(facts)
        folder = None
        if output is not None:
            make_folder(output)
            folder = output / "logs" / stem
            _write(folder, report, rows, [truth_track, *(r.track for r in recorded)], plan)
        lost = tuple(f"{x.what} ({x.where})" for x in all_losses if x.severity == "lost")
        outcome = LogOutcome(log=stem, file=self.log_input.path.name, sha256=sha256, lost=lost)
        progress(stem, 1.0)
        return LogResult(outcome, folder, report, tuple(rows))

    def _read_estimates(self, start_ns: int, end_ns: int) -> tuple[list[RecordedEstimate], list[Loss]]:
        losses: list[Loss] = []
        recorded = []
        for estimate in self.estimates:
            found, lost = read_estimate(self.log, estimate, start_ns, end_ns, self.config.window_s)
            for note in found.notes:
                self.tell(f"{estimate.name}: {note}")
            recorded.append(found)
            losses += lost
        return recorded, losses

    def _read_sensors(self, plan: DrivePlan) -> tuple[Signals | None, tuple[Loss, ...], dict[str, int]]:
        if not plan.alignment.channels:
            self.tell("no IMU in the mapping: segments come from the truth alone")
            return None, (), {}
        sensors_alone = replace(plan, truth=None, mapping=replace(plan.mapping, truth={}, quality=None))
        reader = DriveReader(self.log, sensors_alone, self.config.window_s)
        seen = [w.signals for w in reader.windows() if len(w.signals)]
        return (join_signals(seen) if seen else None), reader.losses, reader.samples or {}

    def _with_dependence(self, plan: DrivePlan, recorded: Sequence[RecordedEstimate]) -> DrivePlan:
        """Add the truth channels that one of the estimates is, as a recorded channel."""
        found = dict(plan.dependent)
        for r in recorded:
            same = dependent_signals(r.channels, plan.survey_truth, role=f"estimate {r.track.name}'s")
            found |= {name: reason for name, reason in same.items() if name not in found}
        return replace(plan, dependent=found)

    def _figures(
        self,
        plan: DrivePlan,
        recorded: Sequence[RecordedEstimate],
        truth: TruthTrack,
        signals: Signals | None,
    ) -> tuple[list[MetricRow], dict[str, str]]:
        """Score each estimate at its own stamps; return what of the derived truth equals an estimate besides."""
        from pdhef_logtool.evaluation.metrics import SCORED_SIGNALS, score_track
        from pdhef_logtool.evaluation.segments import segment_masks

        rows: list[MetricRow] = []
        dependent: dict[str, str] = {}
        for r in recorded:
            at_stamps = truth_at(truth, r.track.stamps_ns, plan.truth_latency_s)
            masks = segment_masks(signals_at(signals, r.track.stamps_ns), at_stamps, self.vehicle)
            same = {
                name: f"the truth's {name} equals that of the estimate {r.track.name}"
                for name in SCORED_SIGNALS
                if _same_column(getattr(r.track, name), getattr(at_stamps, name))
            }
            dependent |= same
            figures = score_track(
                r.track,
                at_stamps,
                masks,
                log=self.log_input.stem,
                low_speed_m_s=self.vehicle.low_speed_blend_m_s,
                not_independent={**plan.dependent, **same},
            )
            if not any(row.metric == "rmse" for row in figures):
                self.tell(f"{r.track.name}: nowhere are estimate and truth known together, so there are no errors")
            # What the estimate does not claim is not missing from it.
            silent = {n for n in SCORED_SIGNALS if n not in r.claimed and not np.isfinite(getattr(r.track, n)).any()}
            rows += [
                row
                for row in figures
                if row.signal not in silent and (row.metric != "diverged" or "diverged" in r.claimed)
            ]
        return rows, dependent

    def _events(self, truth: StateTrack, signals: Signals, recorded: Sequence[RecordedEstimate]) -> list[Event]:
        from pdhef_logtool.evaluation.segments import find_intervals, segment_masks

        masks = without_whole(segment_masks(signals, truth, self.vehicle))
        events = [Event(s.name, s.start_ns, s.end_ns, "") for s in find_intervals(truth.stamps_ns, masks)]
        for r in recorded:
            events += [
                Event(f"{r.track.name} diverged", s.start_ns, s.end_ns, "the estimator reports its own divergence")
                for s in find_intervals(r.track.stamps_ns, {"diverged": r.track.diverged})
            ]
        return sorted(events, key=lambda e: (e.start_ns, e.end_ns, e.name))


def _same_column(estimate: FloatArray, truth: FloatArray) -> bool:
    known = np.isfinite(estimate) & np.isfinite(truth)
    return int(np.count_nonzero(known)) >= 10 and share_equal(estimate[known], truth[known]) >= SAME_SHARE


def _write(
    folder: Path, report: dict[str, Any], rows: Sequence[MetricRow], tracks: Sequence[StateTrack], plan: DrivePlan
) -> None:
    from pdhef_logtool.sinks.parquet import EstimatesSink, write_metrics

    start = first_pose(tracks[0])
    sink = EstimatesSink(folder / "estimates.parquet")
    try:
        for track in tracks:
            has_pose = track.name == TRUTH and plan.has_truth_pose
            sink.append(track if has_pose else DeadReckoning().add(track, start))
        sink.finish(report)
    except BaseException:
        sink.abort()
        raise
    write_metrics(folder / "metrics.parquet", rows)
    write_json(folder / "report.json", report)


def read_truth(log: DriveLog, plan: DrivePlan, window_s: float) -> tuple[TruthTrack, tuple[Loss, ...], dict[str, int]]:
    """Read and derive the whole truth on its own clock, window by window, with losses and samples by source.

    Raises
    ------
    MappingError
        The slice holds no truth.
    """
    alone = replace(plan.mapping, signals={})
    channels: dict[str, Channel] = {}
    tracks: list[StateTrack] = []
    losses: tuple[Loss, ...] = ()
    samples: dict[str, int] = {}
    done_ns: int | None = None
    for a, b in windows(plan.start_ns, plan.end_ns, round(window_s * 1e9)):
        if plan.truth is None:
            break
        part = read_signals(log, alone, plan.clocks, a, b)
        losses = merge_losses([losses, part.losses])
        for name, channel in part.truth.items():
            samples[channel.source] = samples.get(channel.source, 0) + len(channel)
            channels[name] = join_channels([channels[name], channel]) if name in channels else channel
        stamps = [c.stamps_ns for c in channels.values() if len(c)]
        if not stamps:
            continue
        newest = max(int(s[-1]) for s in stamps) + 1
        until = newest if b >= plan.end_ns else min(newest, b) - plan.truth.margin_ns
        if done_ns is not None and until <= done_ns:
            continue
        derived = derive_truth(channels, plan=plan.truth)
        tracks.append(_rows(derived.track, done_ns, until))
        done_ns = until
        channels = {n: _since(c, until - plan.truth.margin_ns) for n, c in channels.items()}
    if plan.truth is None or not sum(len(t) for t in tracks):
        raise MappingError(
            expected="truth in the chosen slice",
            got="no samples that can be used",
            where=f"{log.path} {', '.join(s.label for s in plan.mapping.truth.values())}",
            remedy="pdhef inspect LOG shows what the log holds and what was dropped",
        )
    gap_s = plan.truth.max_gap_s[plan.truth.base]
    return TruthTrack(concatenate(tracks), gap_s, plan.derivation), losses, samples


def _rows(track: StateTrack, start_ns: int | None, end_ns: int) -> StateTrack:
    lo = 0 if start_ns is None else int(np.searchsorted(track.stamps_ns, start_ns))
    part = slice(lo, int(np.searchsorted(track.stamps_ns, end_ns)))
    columns = {n: getattr(track, n)[part] for n in _TRUTH_COLUMNS}
    return make_track(track.name, track.stamps_ns[part], **columns)


_TRUTH_COLUMNS = (
    "vx_m_s",
    "vy_m_s",
    "yaw_rate_rad_s",
    "sideslip_rad",
    "ay_m_s2",
    "x_m",
    "y_m",
    "yaw_rad",
)


def _since(channel: Channel, stamp_ns: int) -> Channel:
    first = int(np.searchsorted(channel.stamps_ns, stamp_ns))
    return replace(
        channel,
        stamps_ns=channel.stamps_ns[first:],
        arrival_ns=channel.arrival_ns[first:],
        values=channel.values[first:],
    )


def signals_at(signals: Signals | None, stamps_ns: IntArray) -> Signals:
    """Return the sensors at other stamps [N], interpolated between samples, never across gaps; all NaN without any."""
    n = stamps_ns.shape[0]

    def column(name: str) -> FloatArray:
        if signals is None:
            return np.full(n, np.nan)
        values: FloatArray = getattr(signals, name)
        known = np.isfinite(values)
        at = signals.stamps_ns[known]
        return Bracket(at, stamps_ns, gap_ns(at)).linear(values[known])

    names = ("steer_rad", "ax_m_s2", "ay_m_s2", "yaw_rate_rad_s", "speed_m_s", "friction")
    return Signals(
        stamps_ns=stamps_ns,
        ready_ns=stamps_ns,
        wheel_speed_m_s=np.full((n, len(WHEELS)), np.nan),
        available=frozenset() if signals is None else signals.available,
        **{name: column(name) for name in names},
    )
