"""One log from start to end, and several of them in turn: read, estimate, compare, write."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pdhef_logtool.car.vehicle import VehicleParameters, default_vehicle, load_vehicle, vehicle_sha256
from pdhef_logtool.drive.friction import FrictionSource
from pdhef_logtool.drive.reading import Drive, lost_texts, read_drive
from pdhef_logtool.estimators.base import Estimator, notes_of
from pdhef_logtool.estimators.registry import NOT_CAUSAL, Skipped, default_names, runnable
from pdhef_logtool.logs.discovery import LogInput, find_logs
from pdhef_logtool.mapping import Mapping, load_mapping, merge_losses
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
from pdhef_logtool.records.signals import SIGNAL_UNITS, TRUTH_UNITS, BoolArray, IntArray, Loss, Signals, join_signals
from pdhef_logtool.residual_model.bundle import SHIPPED, ModelBundle, open_model
from pdhef_logtool.run.config import RunConfig
from pdhef_logtool.run.estimating import estimate
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
    with read_drive(log_input, vehicle, mapping, config.read_options, tell=warn) as drive:
        ready, skipped = _choose_estimators(drive, config, vehicle, model)
        stands_for = {e.name: getattr(e, "calibrated_as", e.name) for e in ready}
        intervals = TrackCalibrator(
            calibration, vehicle_sha256(vehicle), None if model is None else model.sha256, stands_for
        )
        folder = output / "logs" / drive.name
        sinks = _open_sinks(folder, drive, config, vehicle)
        try:
            with TrackStore(folder) as store:
                signals = _estimate(drive, ready, intervals, sinks, store, progress)
                rows, events, reasons = _evaluate(store, ready, signals, drive, vehicle)
            if drive.friction.bank is not None:
                events = sorted([*events, *friction_events(drive.friction, signals.stamps_ns)], key=in_time)
            losses = merge_losses([drive.losses, *(sink.lost for sink in sinks)])
            ran = [
                EstimatorFacts(
                    e.name, causal=e.causal, notes=(*notes_of(e), *intervals.notes(e.name)), reasons=reasons[e.name]
                )
                for e in ready
            ]
            left_out = [EstimatorFacts(s.name, causal=s.name not in NOT_CAUSAL, skipped=s.reason) for s in skipped]
            facts = report_facts(drive, vehicle, [*ran, *left_out], rows, events, losses)
            report = build_report(replace(facts, friction=friction_facts(drive.friction)))
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
        outcome = outcome_of(drive, losses)
    progress(drive.name, 1.0)
    return LogResult(outcome, folder, report, tuple(rows))


def outcome_of(drive: Drive, losses: Sequence[Loss]) -> LogOutcome:
    """Return how a log that was read is recorded in run.json."""
    return LogOutcome(log=drive.name, file=drive.path.name, sha256=drive.sha256, lost=lost_texts(losses))


def _choose_estimators(
    drive: Drive, config: RunConfig, vehicle: VehicleParameters, model: ModelBundle | None
) -> tuple[list[Estimator], list[Skipped]]:
    """Return the estimators that can run and those that cannot; raises EstimatorError if none can."""
    estimators, skipped = runnable(
        config.estimators or default_names(vehicle, model),
        vehicle,
        drive.available,
        use_speed=drive.options.use_speed,
        model=model,
    )
    for skip in skipped:
        drive.tell(f"{skip.name} is skipped: {skip.reason}")
    if not estimators:
        raise EstimatorError(
            expected="at least one estimator that can run",
            got="; ".join(f"{s.name}: {s.reason}" for s in skipped),
            where=str(drive.path),
            remedy="map the missing signals (pdhef inspect LOG --write-mapping mapping.toml)",
        )
    return estimators, skipped


def _open_sinks(folder: Path, drive: Drive, config: RunConfig, vehicle: VehicleParameters) -> list[Sink]:
    from pdhef_logtool.sinks.mcap import AnnotatedMcapSink
    from pdhef_logtool.sinks.parquet import EstimatesSink
    from pdhef_logtool.sinks.rerun import RerunSink

    sinks: list[Sink] = []
    try:
        sinks.append(EstimatesSink(folder / "estimates.parquet"))
        if config.annotate != "none":
            sinks.append(AnnotatedMcapSink(folder / "annotated.mcap", drive.log if config.annotate == "full" else None))
        sinks.append(
            RerunSink(
                folder / "recording.rrd",
                log_name=drive.name,
                input_hash=drive.sha256,
                start_ns=drive.plan.start_ns,
                min_speed_m_s=vehicle.low_speed_blend_m_s,
            )
        )
    except BaseException:
        for sink in sinks:
            sink.abort()
        raise
    return sinks


def _estimate(
    drive: Drive,
    estimators: Sequence[Estimator],
    intervals: TrackCalibrator,
    sinks: Sequence[Sink],
    store: TrackStore,
    progress: Progress,
) -> Signals:
    """Run all estimators over the drive, feeding sinks and store; return the drive's signals for segments."""
    seen: list[Signals] = []
    for window in estimate(drive, estimators, intervals=intervals):
        seen.append(window.signals)
        for sink in sinks:
            sink.append_signals(window.signals)
        if window.truth is not None:
            store.append(window.truth)
            assert window.drawn_truth is not None
            for sink in sinks:
                sink.append(window.drawn_truth)
        for track in window.tracks:
            store.append(track)
            for sink in sinks:
                sink.append(track)
        progress(drive.name, 0.8 * window.share_done)
    progress(drive.name, 0.8)
    return join_signals(seen)


def _evaluate(
    store: TrackStore,
    estimators: Sequence[Estimator],
    signals: Signals,
    drive: Drive,
    vehicle: VehicleParameters,
) -> tuple[list[MetricRow], list[Event], dict[str, tuple[ReasonFacts, ...] | None]]:
    """Score the stored tracks, one whole track in memory at a time besides the truth.

    Returns the figures, the events, and by estimator why it did not use its sensors as usual.
    """
    from pdhef_logtool.evaluation.consistency import disagreement_rows, sensor_rows, whiteness_rows
    from pdhef_logtool.evaluation.metrics import score_track, state_rows
    from pdhef_logtool.evaluation.reasons import summarise_reasons
    from pdhef_logtool.evaluation.segments import find_intervals, segment_masks

    stem, truth = drive.name, store.read(TRUTH)
    masks = segment_masks(signals, truth, vehicle)
    slow = vehicle.low_speed_blend_m_s
    rows: list[MetricRow] = []
    reasons: dict[str, tuple[ReasonFacts, ...] | None] = {}
    events = [Event(s.name, s.start_ns, s.end_ns, "") for s in find_intervals(signals.stamps_ns, without_whole(masks))]
    for estimator in estimators:
        track = store.read(estimator.name)
        assert track is not None
        if truth is not None:
            rows += score_track(track, truth, masks, log=stem, low_speed_m_s=slow, not_independent=drive.plan.dependent)
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
    drive: Drive,
    vehicle: VehicleParameters,
    estimators: Sequence[EstimatorFacts],
    rows: Sequence[MetricRow],
    events: Sequence[Event],
    losses: Sequence[Loss],
    samples: dict[str, int] | None = None,
) -> ReportFacts:
    """Gather what report.json says of one log; ``samples`` by source, None: those that the drive has read."""
    plan, log = drive.plan, drive.log
    samples = drive.samples if samples is None else samples
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
            name=drive.name,
            file=drive.path.name,
            kind=log.kind,
            sha256=drive.sha256,
            start_ns=plan.start_ns,
            end_ns=plan.end_ns,
            topics=[
                TopicFacts(t.name, t.type_name, t.encoding, t.messages, mapped=t.name in mapped) for t in log.topics
            ],
        ),
        signals=[SourceFacts(n, s.label, SIGNAL_UNITS[n], samples.get(s.label, 0)) for n, s in mapping.signals.items()],
        missing_signals=list(drive.missing),
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
        metrics=rows,
        segments=events,
        losses=losses,
        warnings=drive.notes,
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
