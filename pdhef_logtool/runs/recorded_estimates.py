"""Scores estimates that somebody else recorded in a log: their fields, their stamps, ground truth there, figures.

The scored stamps are the estimate's own. Ground truth is interpolated to them, its latency measured against the gyro if
the log has an IMU; the sensors, which only cut the drive into segments, are interpolated to them too.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.interpolation import Bracket
from pdhef_logtool.drive.reading import Drive, Tell, WholeDrive, one_log, read_drive
from pdhef_logtool.drive.truth import SAME_SHARE, TruthTrack, dependent_signals, derive_truth, share_equal, truth_at
from pdhef_logtool.evaluation.metrics import SCORED_SIGNALS
from pdhef_logtool.evaluation.operating_space import operating_space
from pdhef_logtool.evaluation.validation_plan import ValidationPlan
from pdhef_logtool.logs.container import Wanted
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import Mapping as SignalMapping
from pdhef_logtool.mapping import check_mapping, mapping_of, merge_losses, read_signals
from pdhef_logtool.mapping.choosing import mapping_for_recorder
from pdhef_logtool.mapping.estimates import EstimateSource, choose_estimates, sources_of
from pdhef_logtool.model.drive_model import DriveModel
from pdhef_logtool.model.intervals import drive_intervals
from pdhef_logtool.records.errors import MappingError
from pdhef_logtool.records.reporter import SILENT, Reporter
from pdhef_logtool.records.signals import ALIGNED_SIGNALS, TRUTH_UNITS, WHEELS, FloatArray, IntArray, Loss, Signals
from pdhef_logtool.records.tracks import REFERENCE, StateTrack
from pdhef_logtool.residual_model.bundle import NO_MODEL
from pdhef_logtool.results.opened_run import LOGS, PAGE_FILE
from pdhef_logtool.results.run_report import estimator_entry
from pdhef_logtool.results.tables import drive_part
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.drive_outputs import (
    check_places,
    files_of,
    log_place,
    write_drive_tables,
    write_run,
    write_run_tables,
)
from pdhef_logtool.runs.drive_report import outcome_of, report_drive
from pdhef_logtool.runs.estimate_channels import RecordedEstimate, gap_ns, read_estimate
from pdhef_logtool.runs.estimating import Estimated, with_poses
from pdhef_logtool.runs.judging import drive_blocks, judge, judge_drive, read_validation_plan, write_verdicts
from pdhef_logtool.runs.preparing import PreparedDrive
from pdhef_logtool.runs.referencing import DriveReference, reference_of
from pdhef_logtool.runs.run_result import LogResult, RunResult
from pdhef_logtool.runs.scoring import Evaluation, divergences, evaluate, in_order
from pdhef_logtool.storage.outputs import OutputFolder

_RECORDED = "read from the log: not recorded whether it is causal, or what it was computed from"


def score_log(
    argument: str,
    config: RunConfig,
    *,
    estimates: Sequence[str] = (),
    truth: Sequence[str] = (),
    name: str | None = None,
    output: Path | None = None,
    junit: Path | None = None,
    reporter: Reporter = SILENT,
) -> RunResult:
    """Score recorded estimates of one log against its ground truth; same figures, tables and report as a run.

    Parameters
    ----------
    argument : the log. config : of it count vehicle, mapping, slice, ground truth choice and plan.
    estimates : ``[SIGNAL=]TOPIC[.FIELD]``, together one estimator called ``name`` (default: its topic); without any,
        the mapping's ``[estimates.NAME.SIGNAL]`` tables, all or the one called ``name``.
    truth : likewise; without any, the mapping's or the recognised ground truth.
    output : folder for the files, None to write none. junit : as for :func:`pdhef_logtool.runs.fleet.run_logs`.

    Raises
    ------
    PdhefError : There is no estimate or no ground truth, or the log cannot be used.
    """
    log_input = one_log(argument, config.read_options)
    car = Car.load(config.car, network=NO_MODEL, sensors=config.sensor_profile)
    mapping = mapping_of(config.mapping)
    if mapping is not None and mapping.recorders:
        reading = config.read_options
        with closing(
            open_log(log_input.path, reading.limits, reading.msgs, Wanted(frozenset()), reading.tables)
        ) as log:
            mapping = mapping_for_recorder(log, mapping)
    plan = read_validation_plan(config.plan, junit)
    check_places([log_input], output, config, mapping, junit)
    with nullcontext() if output is None else OutputFolder(output, (LOGS,)) as outputs:
        drive, sources = _open(log_input, car, mapping, config, (estimates, truth, name), reporter)
        with drive:
            result = _score_drive(drive, sources, config, plan, outputs, reporter)
        verdicts = judge(plan, [result], config.strict)
        if output is not None:
            write_run_tables(output, [result])
            write_run(output, _config_document(config, drive, sources), [result], verdicts)
        write_verdicts(junit, verdicts, [result])
    return RunResult(output, (result,), requirements=verdicts)


def _config_document(config: RunConfig, drive: Drive, sources: Sequence[EstimateSource]) -> dict[str, Any]:
    document = config.to_dict()
    for key in ("estimators", "annotate", "keep", "sensors"):
        del document[key]
    document["estimates"] = {e.name: {name: source.label for name, source in e.signals.items()} for e in sources}
    document["truth"] = {name: source.label for name, source in drive.mapping.truth.items()}
    return document


def _open(
    log_input: LogInput,
    car: Car,
    given: SignalMapping | None,
    config: RunConfig,
    asked: tuple[Sequence[str], Sequence[str], str | None],
    reporter: Reporter,
) -> tuple[Drive, Sequence[EstimateSource]]:
    """Open the log; return it with the fields of its estimates. ``asked`` : estimates, ground truth and name."""
    estimates, truth, name = asked
    sources: list[EstimateSource] = []
    mapping = given
    if given is not None and not given.signals and not given.truth:
        mapping = None  # a file of estimates alone leaves the rest to recognition
    elif given is not None and truth:
        mapping = replace(given, truth={}, quality=None)

    def choose(log: DriveLog, chosen: SignalMapping, tell: Tell) -> SignalMapping:
        sources.extend(choose_estimates(log, estimates, given, name))
        for estimate in sources:
            check_mapping(estimate.as_mapping(), log)
        if truth:
            quality = chosen.quality if given is None else given.quality
            if quality is not None:
                tell(f"--truth replaces the mapped ground truth and its gate on {quality.describe()}")
            named = sources_of(log, truth, TRUTH_UNITS, "--truth")[0]
            chosen = replace(chosen, truth=named, quality=None, can=None if given is None else given.can)
        if not chosen.truth and config.reference == "off":
            raise _nothing_to_score_against("none mapped and none recognised", str(log.path))
        return chosen

    options = replace(config.read_options, friction=None)
    return (
        read_drive(log_input, car, mapping, options, tell=reporter.warn, adjust=choose, require_sensors=False),
        sources,
    )


def _score_drive(
    drive: Drive,
    sources: Sequence[EstimateSource],
    config: RunConfig,
    plan: ValidationPlan,
    outputs: OutputFolder | None,
    reporter: Reporter,
) -> LogResult:
    """Read, score and judge the recorded estimates; write the files of the log where there is a folder."""
    reporter.progress(drive.name, 0.1)
    recorded, lost = _read(drive, sources)
    truth = _read_truth(drive)
    reporter.progress(drive.name, 0.6)
    if not drive.available:
        drive.tell("no IMU in the mapping: segments come from the ground truth alone")
    model = DriveModel.of(drive)
    reference = _reference(drive, model, config)
    run = PreparedDrive(drive, config, model, reference, [], [], drive_intervals(drive.car, []), {})
    reporter.progress(drive.name, 0.8)

    def at(stamps_ns: IntArray, tracks: Sequence[StateTrack]) -> Estimated:
        of_reference = [] if reference is None or reference.estimator is None else [reference.estimator.at(stamps_ns)]
        return with_poses(_drive_at(drive, truth, stamps_ns), [*tracks, *of_reference])

    tracks = [r.track for r in recorded]
    equal: dict[str, str] = {}
    scored = [_score(run, r, at(r.track.stamps_ns, [r.track]), equal) for r in recorded]
    drive.plan.dependent.update(equal | drive.plan.dependent)
    selected = tracks[0].name if len(tracks) == 1 else None
    stamps_ns = np.unique(np.concatenate([track.stamps_ns for track in tracks]))
    whole, together = scored[0], at(stamps_ns, tracks)
    if selected is None:  # each has been scored at its own stamps; the drive is cut into segments at those of all
        parts = evaluate(drive, at(stamps_ns, []), model)
        rows = {(m.estimator, m.signal, m.segment, m.metric): m for s in scored for m in s.rows}
        whole = replace(parts, rows=[*rows.values()], events=in_order([*parts.events, *divergences(tracks)]))
    blocks = []
    for track, s in zip(tracks, scored, strict=True):
        asked = [q for q in plan.requirements if q.estimator == track.name or (selected and q.estimator is None)]
        blocks += drive_blocks(asked, selected, s.drive)
    space = operating_space(together.signals, together.truth, together.read(selected or ""), drive.car.vehicle)
    stated = judge_drive(plan, drive, None, whole.rows, blocks, space)
    stated["estimators"] = [estimator_entry(r.track.name, causal=True, notes=[_RECORDED, *r.notes]) for r in recorded]
    losses = merge_losses([drive.losses, lost])
    report = report_drive(run, together, whole, stated, losses, selected)
    folder, files = None, dict[str, str]()
    if outputs is not None:
        with outputs.begin(log_place(drive.name), stale=(PAGE_FILE,)) as change:
            write_drive_tables(change, report, whole.rows, together.drawn)
        folder = change.target
        files = files_of(folder)
    reporter.progress(drive.name, 1.0)
    outcome = outcome_of(drive, losses, files=files)
    part = drive_part(outcome, report, whole.rows, stated["plan"])
    return LogResult(outcome, folder, report, tuple(whole.rows), part=part)


def _read(drive: Drive, sources: Sequence[EstimateSource]) -> tuple[list[RecordedEstimate], list[Loss]]:
    """Read the estimates; mark ground truth that equals a channel of an estimate as dependent in the drive's plan."""
    plan, recorded, losses = drive.plan, [], list[Loss]()
    for source in sources:
        estimate, lost = read_estimate(drive.log, source, plan.start_ns, plan.end_ns)
        for note in estimate.notes:
            drive.tell(f"{source.name}: {note}")
        recorded.append(estimate)
        losses += lost
        same = dependent_signals(estimate.channels, plan.survey_truth, role=f"estimate {source.name}'s")
        plan.dependent.update({name: why for name, why in same.items() if name not in plan.dependent})
    return recorded, losses


def _read_truth(drive: Drive) -> TruthTrack | None:
    """Derive the ground truth on its own clock; raises MappingError where the slice contains none of a mapped one."""
    plan = drive.plan
    if not plan.mapping.truth:
        return None
    channels = read_signals(drive.log, replace(plan.mapping, signals={}), plan.clocks, plan.start_ns, plan.end_ns).truth
    truth = None if plan.truth is None else derive_truth(channels, plan=plan.truth)
    if truth is None or not len(truth.track):
        raise MappingError(
            expected="ground truth in the chosen slice",
            got="no samples that can be used",
            where=f"{drive.log.path} {', '.join(s.label for s in plan.mapping.truth.values())}",
            remedy="pdhef inspect LOG shows the contents of the log and the dropped samples",
        )
    return replace(truth, derivation=plan.derivation)


def _reference(drive: Drive, model: DriveModel, config: RunConfig) -> DriveReference | None:
    """Return the sideslip reference; raises MappingError without reference and ground truth."""
    reference = reference_of(drive, model, config)
    if reference is not None and reference.estimator is not None:
        drive.tell("estimated sideslip reference: differences from it are no errors (docs/estimators.md#reference)")
    elif reference is not None and not drive.mapping.truth:
        refused = str(reference.document["refused"])
        raise _nothing_to_score_against(f"none, and no sideslip reference: {refused}", drive.file)
    return reference


def _drive_at(drive: Drive, truth: TruthTrack | None, stamps_ns: IntArray) -> WholeDrive:
    """Return the drive at stamps [N]: its sensors are interpolated between samples, never across gaps."""
    plan, recorded = drive.plan, drive.recorded()

    def column(name: str) -> FloatArray:
        values: FloatArray = getattr(recorded.signals, name)
        is_finite = np.isfinite(values)
        stamps = recorded.signals.stamps_ns[is_finite]
        return Bracket(stamps, stamps_ns, gap_ns(stamps)).linear(values[is_finite])

    columns: dict[str, Any] = {name: column(name) for name in ALIGNED_SIGNALS}
    wheels = np.full((len(stamps_ns), len(WHEELS)), np.nan)
    signals = Signals(stamps_ns, stamps_ns, wheel_speed_m_s=wheels, available=recorded.signals.available, **columns)
    latency_s, standstill_m_s = plan.truth_latency_s, plan.vehicle.standstill_m_s
    true = None if truth is None else truth_at(truth, stamps_ns, latency_s, standstill_m_s=standstill_m_s)
    return WholeDrive(drive.name, plan, drive.friction.fill(signals), true, drive.log.start_ns, recorded.changes)


def _score(run: PreparedDrive, recorded: RecordedEstimate, estimated: Estimated, equal: dict[str, str]) -> Evaluation:
    """Score an estimate at its own stamps; add to ``equal`` the ground truth that equals it."""
    drive, track, truth = run.drive, recorded.track, estimated.truth
    same = {
        signal: f"the ground truth's {signal} equals that of the estimate {track.name}"
        for signal in SCORED_SIGNALS
        if truth is not None and _same_column(getattr(track, signal), getattr(truth, signal))
    }
    equal |= same
    scored = evaluate(drive, estimated, run.model, {**same, **drive.plan.dependent})
    if not any(m.estimator == track.name and m.metric in ("rmse", "reference_rms") for m in scored.rows):
        drive.tell(f"{track.name}: nowhere are estimate and ground truth known together, so there are no errors")
    # A quantity that the estimate does not contain has no availability, and so no row.
    silent = {n for n in SCORED_SIGNALS if n not in recorded.claimed and not np.isfinite(getattr(track, n)).any()}
    silent |= {"diverged"} - recorded.claimed
    rows = [m for m in scored.rows if m.estimator != track.name or silent.isdisjoint((m.signal, m.metric))]
    return replace(scored, rows=[m for m in rows if m.estimator != REFERENCE])


def _nothing_to_score_against(got: str, where: str) -> MappingError:
    return MappingError(
        expected="a ground truth to score against, or an IMU for a sideslip reference",
        got=got,
        where=where,
        remedy="name ground truth with --truth SIGNAL=TOPIC.FIELD or in a mapping file",
    )


def _same_column(estimate: FloatArray, truth: FloatArray) -> bool:
    usable = np.isfinite(estimate) & np.isfinite(truth)
    return int(np.count_nonzero(usable)) >= 10 and share_equal(estimate[usable], truth[usable]) >= SAME_SHARE
