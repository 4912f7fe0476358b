"""One log from start to end, and several of them in turn: read, estimate, compare, write."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters, default_vehicle, load_vehicle, vehicle_sha256
from pdhef_logtool.drive.friction import FrictionSource, friction_source, friction_topic
from pdhef_logtool.drive.windows import DrivePlan, DriveReader, plan_drive, with_look_ahead
from pdhef_logtool.estimators.base import Estimator, look_ahead_of, notes_of, run_window
from pdhef_logtool.estimators.registry import NOT_CAUSAL, default_names, runnable
from pdhef_logtool.logs.discovery import LogInput, find_logs, hash_log
from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import Mapping, choose_mapping, load_mapping, merge_losses
from pdhef_logtool.records.errors import (
    EXIT_FAILURE,
    EXIT_GATE,
    EXIT_OK,
    EXIT_PARTIAL,
    EstimatorError,
    OutputError,
    PdhefError,
    UsageError,
)
from pdhef_logtool.records.geometry import dead_reckon
from pdhef_logtool.records.signals import SIGNAL_UNITS, TRUTH_UNITS, BoolArray, IntArray, Loss, Signals, join_signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.residual_model.bundle import SHIPPED, ModelBundle, open_model
from pdhef_logtool.run.config import RunConfig, time_slice
from pdhef_logtool.run.track_store import TrackStore
from pdhef_logtool.sinks.base import TRUTH, Event, Sink
from pdhef_logtool.sinks.report import (
    EstimatorFacts,
    FrictionFacts,
    LogFacts,
    LogOutcome,
    ReportFacts,
    SourceFacts,
    TopicFacts,
    TruthFacts,
    build_report,
    build_run,
    tool_versions,
    write_json,
)
from pdhef_logtool.watches.intervals import Calibration, TrackCalibrator, find_calibration

if TYPE_CHECKING:
    from pdhef_logtool.evaluation.metrics import MetricRow
    from pdhef_logtool.evaluation.reasons import ReasonFacts
    from pdhef_logtool.evaluation.thresholds import Threshold, Verdict
    from pdhef_logtool.watches.divergence import DivergenceWatch

#: ``update(text, share)`` with share in [0, 1].
Progress = Callable[[str, float], None]

#: Units of truth quantities that have no channel of their own name.
_DERIVED_UNITS = {"position_m": "m"}


@dataclass(frozen=True, slots=True, eq=False)
class LogResult:
    """What came out of one log; ``report`` is the document of report.json, None if the log failed.

    ``verdicts``: how its figures stand against the thresholds; None without thresholds.
    """

    outcome: LogOutcome
    output: Path | None
    report: dict[str, Any] | None
    rows: tuple[MetricRow, ...]
    verdicts: tuple[Verdict, ...] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RunResult:
    """What came out of a run; ``output`` is None when nothing was to be written."""

    output: Path | None
    results: tuple[LogResult, ...]

    @property
    def exit_code(self) -> int:
        """0 if all is well, 4 if a threshold failed, 3 if input was lost or some logs failed, 1 if all failed."""
        if all(r.report is None for r in self.results):
            return EXIT_FAILURE
        if any(v.failed for v in self.verdicts):
            return EXIT_GATE
        return EXIT_OK if all(r.outcome.outcome == "ok" for r in self.results) else EXIT_PARTIAL

    @property
    def verdicts(self) -> tuple[Verdict, ...]:
        """The verdicts of all logs in order."""
        return tuple(v for r in self.results for v in r.verdicts or ())

    def to_dict(self) -> dict[str, Any]:
        """Return the result as one JSON-able document."""
        return {
            "output": None if self.output is None else str(self.output),
            "exit_code": self.exit_code,
            "logs": [
                {
                    "log": r.outcome.log,
                    "outcome": r.outcome.outcome,
                    "output": None if r.output is None else str(r.output),
                    "report": r.report,
                    **({} if r.verdicts is None else {"verdicts": [v.to_dict() for v in r.verdicts]}),
                }
                for r in self.results
            ],
        }


def run_logs(
    arguments: Sequence[str],
    output: Path,
    config: RunConfig,
    *,
    junit: Path | None = None,
    progress: Progress = lambda _text, _share: None,
    warn: Callable[[str], None] = lambda _text: None,
) -> RunResult:
    """Run the configured estimators on logs and write everything of DESIGN §6 to ``output``.

    A log that fails is reported and never stops the others.

    Parameters
    ----------
    arguments : logs, folders, glob patterns. junit : where the verdicts of the thresholds are written as JUnit XML.
    progress, warn : called with lines for people.

    Raises
    ------
    UsageError, VehicleError, MappingError
        What holds for all logs is wrong: arguments, vehicle or mapping file.
    OutputError
        The output folder cannot be written.
    """
    inputs = find_logs(arguments)
    vehicle = default_vehicle() if config.vehicle is None else load_vehicle(config.vehicle)
    mapping = None if config.mapping is None else load_mapping(config.mapping)
    model = open_model(config.model)
    calibration = find_calibration(config.calibration, config.model)
    thresholds = read_thresholds(config, junit)
    if config.vehicle is None:
        warn(f"no --vehicle: the default {vehicle.name} is assumed, so the model-based estimates are of another car")
    make_folder(output)
    results: list[LogResult] = []
    for number, log_input in enumerate(inputs):

        def of_all(text: str, share: float, number: int = number) -> None:
            progress(text, (number + share) / len(inputs))

        try:
            result = run_log(
                log_input, output, config, vehicle, mapping, model, calibration, progress=of_all, warn=warn
            )
        except Exception as error:  # one bad log never stops the others, whatever is wrong with it
            if len(inputs) == 1:
                raise
            reason = str(error) if isinstance(error, PdhefError) else f"internal error, {type(error).__name__}: {error}"
            warn(reason)
            outcome = LogOutcome(log=log_input.stem, file=log_input.path.name, sha256=None, failed=reason)
            result = LogResult(outcome, None, None, ())
        results.append(judge(result, thresholds))
    write_run(output, config.to_dict(), results, model)
    write_verdicts(junit, results)
    return RunResult(output, tuple(results))


def read_thresholds(config: RunConfig, junit: Path | None) -> tuple[Threshold, ...] | None:
    """Return the configured thresholds, None without; raises UsageError when they are wrong or miss for ``junit``."""
    from pdhef_logtool.evaluation.thresholds import load_thresholds

    if config.thresholds is not None:
        return load_thresholds(config.thresholds)
    if junit is not None:
        raise UsageError(
            expected="thresholds to give verdicts on", got="none", where="--junit", remedy="--thresholds FILE"
        )
    return None


def judge(result: LogResult, thresholds: Sequence[Threshold] | None) -> LogResult:
    """Return the result with verdicts; a log that failed has no figures, so that its thresholds fail too."""
    from pdhef_logtool.evaluation.thresholds import check_thresholds

    if thresholds is None:
        return result
    verdicts = check_thresholds(thresholds, result.rows, log=result.outcome.log)
    return replace(result, verdicts=tuple(verdicts))


def write_verdicts(junit: Path | None, results: Sequence[LogResult]) -> None:
    """Write JUnit XML if a file is asked for; raises OutputError."""
    from pdhef_logtool.sinks.junit import write_junit

    if junit is not None:
        write_junit(junit, {r.outcome.log: r.verdicts or () for r in results})


def run_log(
    log_input: LogInput,
    output: Path,
    config: RunConfig,
    vehicle: VehicleParameters,
    mapping: Mapping | None,
    model: ModelBundle | None = None,
    calibration: Calibration | None = None,
    *,
    progress: Progress = lambda _text, _share: None,
    warn: Callable[[str], None] = lambda _text: None,
) -> LogResult:
    """Run one log and write its folder ``output/logs/<stem>``.

    Raises
    ------
    PdhefError
        Nothing of the log can be used; nothing is then left under a final name.
    """
    progress(log_input.stem, 0.0)
    log = open_log(log_input.path)
    try:
        return _run_open_log(log, log_input, output, config, vehicle, mapping, model, calibration, progress, warn)
    finally:
        log.close()


def _run_open_log(
    log: DriveLog,
    log_input: LogInput,
    output: Path,
    config: RunConfig,
    vehicle: VehicleParameters,
    mapping: Mapping | None,
    model: ModelBundle | None,
    calibration: Calibration | None,
    progress: Progress,
    warn: Callable[[str], None],
) -> LogResult:
    from pdhef_logtool.drive.plausibility import plausibility_warnings
    from pdhef_logtool.watches.divergence import DivergenceWatch

    warnings: list[str] = []

    def tell(text: str) -> None:
        warnings.append(text)
        warn(f"{log_input.stem}: {text}")

    mapping, missing = choose_mapping(log, mapping, tell, prefer_truth=config.prefer_truth)
    start_ns, end_ns = time_slice(config, log.start_ns, log.end_ns)
    plan = plan_drive(log, mapping, vehicle, start_ns, end_ns)
    for warning in plausibility_warnings(plan.survey_signals):
        tell(warning.message)
    for name, reason in plan.alignment.unused:
        tell(f"{name} is not used: {reason}")
    estimators, skipped = runnable(
        config.estimators or default_names(vehicle, model),
        vehicle,
        plan.alignment.available,
        use_speed=config.sensors == "full",
        model=model,
    )
    for skip in skipped:
        tell(f"{skip.name} is skipped: {skip.reason}")
    if not estimators:
        raise EstimatorError(
            expected="at least one estimator that can run",
            got="; ".join(f"{s.name}: {s.reason}" for s in skipped),
            where=str(log_input.path),
            remedy="map the missing signals (pdhef inspect LOG --write-mapping mapping.toml)",
        )
    friction = friction_source(
        config.friction,
        vehicle,
        plan.alignment.available,
        friction_topic(plan.mapping),
        use_speed=config.sensors == "full",
    )
    if friction.note:
        tell(friction.note)
    sha256 = hash_log(log_input.path)
    stands_for = {e.name: getattr(e, "calibrated_as", e.name) for e in estimators}
    intervals = TrackCalibrator(
        calibration, vehicle_sha256(vehicle), None if model is None else model.sha256, stands_for
    )
    folder = output / "logs" / log_input.stem
    reader = DriveReader(log, plan, config.window_s)
    sinks = _open_sinks(folder, log, log_input.stem, config, vehicle, plan, sha256)
    try:
        with TrackStore(folder) as store:
            context = _estimate(
                reader,
                estimators,
                friction,
                DivergenceWatch(vehicle),
                intervals,
                sinks,
                store,
                lambda share: progress(log_input.stem, 0.8 * share),
            )
            progress(log_input.stem, 0.8)
            rows, events, reasons = _evaluate(log_input.stem, store, estimators, context, plan, vehicle)
        if friction.bank is not None:
            events = sorted([*events, *friction_events(friction, context.stamps_ns)], key=in_time)
        losses = merge_losses([log.lost, reader.losses, *(sink.lost for sink in sinks)])
        ran = [
            EstimatorFacts(
                e.name, causal=e.causal, notes=(*notes_of(e), *intervals.notes(e.name)), reasons=reasons[e.name]
            )
            for e in estimators
        ]
        left_out = [EstimatorFacts(s.name, causal=s.name not in NOT_CAUSAL, skipped=s.reason) for s in skipped]
        report = build_report(
            report_facts(
                log, log_input, sha256, plan, missing, vehicle, [*ran, *left_out], rows, events, losses, warnings,
                reader.samples or {}, friction,
            )
        )  # fmt: skip
        from pdhef_logtool.sinks.parquet import write_metrics

        for sink in sinks:
            sink.finish(report, events)
        write_metrics(folder / "metrics.parquet", rows)
        write_json(folder / "report.json", report)
    except BaseException:
        for sink in sinks:
            sink.abort()
        with suppress(OSError):
            folder.rmdir()
        raise
    lost = tuple(f"{x.what} ({x.where})" for x in losses if x.severity == "lost")
    outcome = LogOutcome(log=log_input.stem, file=log_input.path.name, sha256=sha256, lost=lost)
    progress(log_input.stem, 1.0)
    return LogResult(outcome, folder, report, tuple(rows))


def _open_sinks(
    folder: Path,
    log: DriveLog,
    stem: str,
    config: RunConfig,
    vehicle: VehicleParameters,
    plan: DrivePlan,
    input_hash: str,
) -> list[Sink]:
    from pdhef_logtool.sinks.mcap import AnnotatedMcapSink
    from pdhef_logtool.sinks.parquet import EstimatesSink
    from pdhef_logtool.sinks.rerun import RerunSink

    sinks: list[Sink] = []
    try:
        sinks.append(EstimatesSink(folder / "estimates.parquet"))
        if config.annotate != "none":
            sinks.append(AnnotatedMcapSink(folder / "annotated.mcap", log if config.annotate == "full" else None))
        sinks.append(
            RerunSink(
                folder / "recording.rrd",
                log_name=stem,
                input_hash=input_hash,
                start_ns=plan.start_ns,
                min_speed_m_s=vehicle.low_speed_blend_m_s,
            )
        )
    except BaseException:
        for sink in sinks:
            sink.abort()
        raise
    return sinks


class DeadReckoning:
    """Dead-reckons one track from window to window, from the true pose at the start where there is one."""

    def __init__(self) -> None:
        self._last: tuple[int, float, float, float] | None = None
        self._pose: tuple[float, float, float] | None = None

    def add(self, track: StateTrack, start: tuple[float, float, float]) -> StateTrack:
        """Return the next window of the track with its pose; ``start`` is where the first window begins."""
        if len(track) == 0:
            return track
        stamps, vx, vy, rate = track.stamps_ns, track.vx_m_s, track.vy_m_s, track.yaw_rate_rad_s
        if not np.isfinite(vy).any():
            vy = np.where(np.isfinite(vx), 0.0, np.nan)  # no claim on v_y: drawn along the heading
        if self._last is not None:
            stamps = np.concatenate([[self._last[0]], stamps])
            vx, vy, rate = (np.concatenate([[v], c]) for v, c in zip(self._last[1:], (vx, vy, rate), strict=True))
        x, y, yaw = dead_reckon(stamps, vx, vy, rate, self._pose or start)
        self._last = (int(stamps[-1]), float(vx[-1]), float(vy[-1]), float(rate[-1]))
        self._pose = (float(x[-1]), float(y[-1]), float(yaw[-1]))
        skip = len(x) - len(track)
        return track.with_pose(x[skip:], y[skip:], yaw[skip:])


def first_pose(truth: StateTrack | None) -> tuple[float, float, float]:
    """Return the first known pose x, y, yaw of the truth; the origin without one."""
    if truth is not None:
        known = np.flatnonzero(np.isfinite(truth.x_m) & np.isfinite(truth.y_m) & np.isfinite(truth.yaw_rad))
        if known.size:
            i = int(known[0])
            return float(truth.x_m[i]), float(truth.y_m[i]), float(truth.yaw_rad[i])
    return 0.0, 0.0, 0.0


def _estimate(
    reader: DriveReader,
    estimators: Sequence[Estimator],
    friction: FrictionSource,
    watch: DivergenceWatch,
    intervals: TrackCalibrator,
    sinks: Sequence[Sink],
    store: TrackStore,
    progress: Callable[[float], None],
) -> Signals:
    """Run all estimators over the drive, feeding sinks and store; return the drive's signals for segments."""
    carries: dict[str, Any] = {}
    poses = {e.name: DeadReckoning() for e in estimators} | {TRUTH: DeadReckoning()}
    seen: list[Signals] = []
    start: tuple[float, float, float] | None = None
    look_ahead_s = max(map(look_ahead_of, estimators), default=0.0)
    for window, ahead in with_look_ahead(friction.fill_windows(reader.windows()), look_ahead_s):
        seen.append(window.signals)
        if start is None:
            start = first_pose(window.truth)
        for sink in sinks:
            sink.append_signals(window.signals)
        if window.truth is not None:
            store.append(window.truth)
            drawn = window.truth
            if not reader.plan.has_truth_pose:
                drawn = poses[TRUTH].add(drawn, start)
            for sink in sinks:
                sink.append(drawn)
        for estimator in estimators:
            carry = carries.get(estimator.name)
            track, carries[estimator.name] = run_window(estimator, window.signals, carry, ahead)
            track = intervals.add(watch.add(track, window.signals), window.signals)
            track = poses[estimator.name].add(track, start)
            store.append(track)
            for sink in sinks:
                sink.append(track)
        progress(window.share_done)
    if not seen:
        raise EstimatorError(
            expected="IMU samples in the chosen slice",
            got="none that can be used",
            where=str(reader.log.path),
            remedy="pdhef inspect LOG shows what the log holds and what was dropped",
        )
    return join_signals(seen)


def _evaluate(
    stem: str,
    store: TrackStore,
    estimators: Sequence[Estimator],
    signals: Signals,
    plan: DrivePlan,
    vehicle: VehicleParameters,
) -> tuple[list[MetricRow], list[Event], dict[str, tuple[ReasonFacts, ...] | None]]:
    """Score the stored tracks, one whole track in memory at a time besides the truth.

    Returns the figures, the events, and by estimator why it did not use its sensors as usual.
    """
    from pdhef_logtool.evaluation.consistency import disagreement_rows, sensor_rows, whiteness_rows
    from pdhef_logtool.evaluation.metrics import score_track, state_rows
    from pdhef_logtool.evaluation.reasons import summarise_reasons
    from pdhef_logtool.evaluation.segments import find_intervals, segment_masks

    truth = store.read(TRUTH)
    masks = segment_masks(signals, truth, vehicle)
    slow = vehicle.low_speed_blend_m_s
    rows: list[MetricRow] = []
    reasons: dict[str, tuple[ReasonFacts, ...] | None] = {}
    events = [Event(s.name, s.start_ns, s.end_ns, "") for s in find_intervals(signals.stamps_ns, without_whole(masks))]
    for estimator in estimators:
        track = store.read(estimator.name)
        assert track is not None
        if truth is not None:
            rows += score_track(track, truth, masks, log=stem, low_speed_m_s=slow, not_independent=plan.dependent)
        else:
            rows += state_rows(track, masks, log=stem)
        rows += whiteness_rows(track, masks, log=stem)
        reasons[estimator.name] = summarise_reasons(track)
        events += [
            Event(f"{estimator.name} diverged", s.start_ns, s.end_ns, "the estimator reports its own divergence")
            for s in find_intervals(track.stamps_ns, {"diverged": track.diverged})
        ]
    if truth is None:
        for a, b in combinations([e.name for e in estimators], 2):
            pair = [t for t in (store.read(a), store.read(b)) if t is not None]
            rows += disagreement_rows(pair, masks, log=stem, low_speed_m_s=slow)
    rows += sensor_rows(signals, masks, log=stem, low_speed_m_s=slow)
    return rows, sorted(events, key=in_time), reasons


def in_time(event: Event) -> tuple[int, int, str]:
    """Return what events are sorted by."""
    return event.start_ns, event.end_ns, event.name


def friction_events(friction: FrictionSource, stamps_ns: IntArray) -> list[Event]:
    """Return when an estimated friction was observable; ``stamps_ns`` are those of all windows."""
    from pdhef_logtool.evaluation.segments import find_intervals

    found = find_intervals(stamps_ns, {"friction observable": friction.observable})
    return [Event(s.name, s.start_ns, s.end_ns, "the estimate of friction can be relied on") for s in found]


def without_whole(masks: dict[str, BoolArray]) -> dict[str, BoolArray]:
    """Return the masks that are worth an event: not the whole drive, nor what is only not nonlinear."""
    return {name: mask for name, mask in masks.items() if name not in ("all", "linear")}


def report_facts(
    log: DriveLog,
    log_input: LogInput,
    sha256: str,
    plan: DrivePlan,
    missing: Sequence[str],
    vehicle: VehicleParameters,
    estimators: Sequence[EstimatorFacts],
    rows: Sequence[MetricRow],
    events: Sequence[Event],
    losses: Sequence[Loss],
    warnings: Sequence[str],
    samples: dict[str, int],
    friction: FrictionSource | None = None,
) -> ReportFacts:
    """Gather what report.json says of one log; ``samples`` are the messages that were used, by source."""
    mapping = plan.mapping
    mapped = set(mapping.topics)
    notes = []
    if plan.latency is not None:
        found = plan.latency
        measured = f"{found.latency_s * 1e3:.1f} ms ± {found.std_error_s * 1e3:.1f} ms" if found.reliable else "unknown"
        verdict = "applied" if plan.truth_latency_s else "not applied: it does not stand out of its own uncertainty"
        notes.append(f"latency {measured} ({found.reason}), {verdict}")
    notes += [f"{signal} is not independent: {reason}" for signal, reason in plan.dependent.items()]
    if "cg" in plan.derivation:
        notes.append(plan.derivation["cg"])
    if plan.truth is not None and not plan.has_truth_pose:
        notes.append("no true position: the drawn truth trajectory is its velocity dead-reckoned")
    return ReportFacts(
        log=LogFacts(
            name=log_input.stem,
            file=log_input.path.name,
            kind=log.kind,
            sha256=sha256,
            start_ns=plan.start_ns,
            end_ns=plan.end_ns,
            topics=[
                TopicFacts(t.name, t.type_name, t.encoding, t.messages, mapped=t.name in mapped) for t in log.topics
            ],
        ),
        signals=[SourceFacts(n, s.label, SIGNAL_UNITS[n], samples.get(s.label, 0)) for n, s in mapping.signals.items()],
        missing_signals=list(missing),
        vehicle_name=vehicle.name,
        vehicle_sha256=vehicle_sha256(vehicle),
        estimators=list(estimators),
        truth=TruthFacts(
            quantities=[
                _truth_quantity(name, how, mapping, samples) for name, how in plan.derivation.items() if name != "cg"
            ],
            latency_s=None if plan.latency is None else plan.truth_latency_s,
            not_independent=sorted(plan.dependent),
            notes=notes,
        ),
        friction=None if friction is None else friction_facts(friction),
        metrics=rows,
        segments=events,
        losses=losses,
        warnings=warnings,
        versions=tool_versions(),
    )


def friction_facts(friction: FrictionSource) -> FrictionFacts:
    """Return what the report says of a run's friction, after the run."""
    return FrictionFacts(
        source=friction.label,
        estimated=friction.bank is not None,
        observable_share=friction.observable_share,
        observable_std=friction.observable_std,
        summary=friction.summary,
    )


def _truth_quantity(name: str, how: str, mapping: Mapping, samples: dict[str, int]) -> SourceFacts:
    source = mapping.truth.get(name)
    if source is None:
        return SourceFacts(name, "derived", _DERIVED_UNITS.get(name) or TRUTH_UNITS[name], 0, derivation=how)
    derivation = "" if how == source.label else how
    return SourceFacts(name, source.label, TRUTH_UNITS[name], samples.get(source.label, 0), derivation=derivation)


def make_folder(output: Path) -> None:
    """Make an output folder; raises OutputError."""
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            expected="a folder to write to", got=error.strerror or str(error), where=str(output)
        ) from None


def write_run(
    output: Path, config: dict[str, Any], results: Sequence[LogResult], model: ModelBundle | None = None
) -> None:
    """Write metrics.parquet of all logs, then run.json with the configuration as JSON-able values."""
    from pdhef_logtool.sinks.parquet import write_metrics

    used = None if model is None else {"name": str(config["model"] or SHIPPED), "sha256": model.sha256}
    write_metrics(output / "metrics.parquet", [row for r in results for row in r.rows])
    write_json(output / "run.json", build_run(tool_versions(), config, used, [r.outcome for r in results]))
