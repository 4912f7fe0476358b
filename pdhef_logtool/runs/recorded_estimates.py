"""Scores estimates that somebody else recorded in a log: their fields, their stamps, ground truth there, figures.

The scored stamps are the estimate's own. Ground truth is interpolated to them, its latency measured against the gyro if
the log has an IMU; the sensors, which only cut the drive into segments, are interpolated to them too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.interpolation import Bracket
from pdhef_logtool.drive.plan import DrivePlan
from pdhef_logtool.drive.reading import Drive, Tell, one_log, read_drive
from pdhef_logtool.drive.recorded import sample_ledger
from pdhef_logtool.drive.truth import (
    SAME_SHARE,
    TruthTrack,
    dependent_signals,
    derive_truth,
    share_equal,
    truth_at,
    valid_as_a_whole,
)
from pdhef_logtool.evaluation.largest_errors import largest_errors
from pdhef_logtool.evaluation.manoeuvres import find_manoeuvres
from pdhef_logtool.evaluation.metrics import SCORED_SIGNALS, EvaluatedDrive, evaluate_drive
from pdhef_logtool.evaluation.operating_space import operating_space
from pdhef_logtool.evaluation.segments import segment_masks
from pdhef_logtool.logs.container import Wanted
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import Mapping as SignalMapping
from pdhef_logtool.mapping import check_mapping, mapping_of, merge_losses, read_signals
from pdhef_logtool.mapping.choosing import mapping_for_recorder
from pdhef_logtool.mapping.estimates import EstimateSource, choose_estimates, sources_of
from pdhef_logtool.model.drive_model import DriveModel
from pdhef_logtool.records.errors import MappingError
from pdhef_logtool.records.ledger import SampleCount, damage
from pdhef_logtool.records.reporter import SILENT, Reporter
from pdhef_logtool.records.signals import (
    ALIGNED_SIGNALS,
    TRUTH_UNITS,
    WHEELS,
    Channel,
    FloatArray,
    IntArray,
    Loss,
    Signals,
)
from pdhef_logtool.records.tracks import REFERENCE, StateTrack
from pdhef_logtool.residual_model.bundle import NO_MODEL
from pdhef_logtool.results.opened_run import LOGS, PAGE_FILE
from pdhef_logtool.results.run_report import build_report, estimator_entry
from pdhef_logtool.results.sink import TRUTH
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
from pdhef_logtool.runs.drive_report import drive_entries, outcome_of
from pdhef_logtool.runs.estimate_channels import RecordedEstimate, gap_ns, read_estimate
from pdhef_logtool.runs.estimating import dead_reckoned, first_pose
from pdhef_logtool.runs.judging import drive_blocks, judge, judge_drive, read_validation_plan, write_verdicts
from pdhef_logtool.runs.referencing import reference_of
from pdhef_logtool.runs.run_result import LogResult, RunResult
from pdhef_logtool.runs.scoring import drive_events
from pdhef_logtool.storage.outputs import OutputFolder

if TYPE_CHECKING:
    from pdhef_logtool.estimators.reference.estimator import ReferenceEstimator
    from pdhef_logtool.evaluation.manoeuvres import Manoeuvre
    from pdhef_logtool.evaluation.metrics import MetricRow
    from pdhef_logtool.evaluation.requirement_blocks import RequirementBlocks
    from pdhef_logtool.evaluation.validation_plan import ValidationPlan

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
    log = _read(drive, sources, config, reporter)
    reporter.progress(drive.name, 0.8)
    rows, blocks = _score(log, plan)
    scored_ns = np.unique(np.concatenate([r.track.stamps_ns for r in log.recorded]))
    whole, seen = log.at(scored_ns)
    content = _entries(log, plan, rows, blocks, whole, seen)
    report = build_report(content)
    folder, files = None, dict[str, str]()
    if outputs is not None:
        tracks = [*(r.track for r in log.recorded), *whole.tracks.values()]
        if whole.truth is not None:
            standstill_m_s = drive.car.vehicle.standstill_m_s
            tracks.insert(0, valid_as_a_whole(whole.truth, drive.plan.derivation, standstill_m_s))
        with outputs.begin(log_place(drive.name), stale=(PAGE_FILE,)) as change:
            write_drive_tables(change, report, rows, _drawn(tracks, drive.plan))
        folder = change.target
        files = files_of(folder)
    reporter.progress(drive.name, 1.0)
    outcome = outcome_of(drive, log.losses, files=files)
    return LogResult(outcome, folder, report, tuple(rows), part=drive_part(outcome, report, rows, content["plan"]))


def _drawn(tracks: Sequence[StateTrack], plan: DrivePlan) -> list[StateTrack]:
    """Return the tracks with their poses; ground truth is the first if there is any."""
    start = first_pose(tracks[0] if tracks[0].name == TRUTH else None)
    return [track if track.name == TRUTH and plan.has_truth_pose else dead_reckoned(track, start) for track in tracks]


def _entries(
    log: _Recording,
    plan: ValidationPlan,
    rows: Sequence[MetricRow],
    blocks: Sequence[RequirementBlocks],
    whole: EvaluatedDrive,
    seen: Signals,
) -> dict[str, Any]:
    """Judge the drive; return the content of report.json. ``whole``, ``seen`` : at the stamps of all estimates."""
    drive, estimates = log.drive, [r.track for r in log.recorded]
    alone = estimates[0] if len(estimates) == 1 else None
    space = operating_space(seen, whole.truth, alone, drive.car.vehicle)
    others = [*whole.tracks.values()]
    places = [] if alone is None else largest_errors(alone, whole.truth, others, whole.low_speed_m_s)
    entries = drive_entries(drive, drive.car, log.losses, log.ledger)
    if log.truth is not None and drive.plan.latency is None:
        entries["truth"]["notes"].insert(0, "no gyro to measure the ground truth's latency with: taken as 0")
    entries |= judge_drive(plan, drive, None, rows, blocks, space)
    return entries | {
        "estimators": [estimator_entry(r.track.name, causal=True, notes=[_RECORDED, *r.notes]) for r in log.recorded],
        "metrics": rows,
        "segments": drive_events(seen, whole.masks, log.manoeuvres, estimates),
        "largest_errors": places,
    }


def _read(drive: Drive, sources: Sequence[EstimateSource], config: RunConfig, reporter: Reporter) -> _Recording:
    """Read estimates, ground truth and sensors; add to the plan which ground truth depends on an estimate."""
    plan, losses = drive.plan, list[Loss]()
    recorded, dependent = [], dict(plan.dependent)
    for source in sources:
        estimate, lost = read_estimate(drive.log, source, plan.start_ns, plan.end_ns)
        for note in estimate.notes:
            drive.tell(f"{source.name}: {note}")
        recorded.append(estimate)
        losses += lost
        same = dependent_signals(estimate.channels, plan.survey_truth, role=f"estimate {source.name}'s")
        dependent |= {name: why for name, why in same.items() if name not in dependent}
    truth: TruthTrack | None = None
    ledger: tuple[SampleCount, ...] = ()
    if drive.mapping.truth:
        part = read_signals(drive.log, replace(plan.mapping, signals={}), plan.clocks, plan.start_ns, plan.end_ns)
        truth = _truth_of(part.truth, drive)
        losses += part.losses
        ledger = sample_ledger(drive.log, plan, part.counts)
    reporter.progress(drive.name, 0.6)
    signals = _read_sensors(drive)
    drive.plan = replace(plan, dependent=dependent)
    manoeuvres = [] if signals is None else find_manoeuvres(signals, drive.car.vehicle)
    reference = _reference(drive, config, scored=truth is not None)
    every_loss = merge_losses([drive.losses, losses, damage(ledger)])
    every_sample = (*drive.sample_ledger, *ledger)
    return _Recording(drive, recorded, truth, reference, signals, manoeuvres, every_loss, every_sample)


def _reference(drive: Drive, config: RunConfig, *, scored: bool) -> ReferenceEstimator | None:
    """Return the sideslip reference of the sensors: without ground truth, or beside it where asked for."""
    if config.reference == "off" or (scored and config.reference == "auto"):
        return None
    reference = reference_of(drive, DriveModel.of(drive), config)
    if reference is None or reference.estimator is None:
        why = "the log has no IMU" if reference is None else str(reference.document["refused"])
        if not scored:
            raise _nothing_to_score_against(f"none, and no sideslip reference: {why}", drive.file)
        drive.tell(f"no sideslip reference: {why}")
        return None
    drive.tell("estimated sideslip reference: differences from it are no errors (docs/estimators.md#reference)")
    return reference.estimator


def _score(log: _Recording, plan: ValidationPlan) -> tuple[list[MetricRow], list[RequirementBlocks]]:
    """Score each estimate at its own stamps; add to the plan which derived ground truth equals an estimate."""
    rows: list[MetricRow] = []
    blocks: list[RequirementBlocks] = []
    drive, equal = log.drive, dict[str, str]()
    alone = len(log.recorded) == 1
    for r in log.recorded:
        track, name = r.track, r.track.name
        scored, _ = log.at(track.stamps_ns)
        same = {
            signal: f"the ground truth's {signal} equals that of the estimate {name}"
            for signal in SCORED_SIGNALS
            if scored.truth is not None and _same_column(getattr(track, signal), getattr(scored.truth, signal))
        }
        equal |= same
        scored = replace(scored, tracks={name: track, **scored.tracks}, dependent={**drive.plan.dependent, **same})
        asked = [q for q in plan.requirements if q.estimator in (name, None if alone else name)]
        blocks += drive_blocks(asked, name if alone else None, scored)
        figures = [row for row in evaluate_drive(scored) if row.estimator == name]
        if not any(row.metric in ("rmse", "reference_rms") for row in figures):
            drive.tell(f"{name}: nowhere are estimate and ground truth known together, so there are no errors")
        # A quantity that the estimate does not contain has no availability, and so no row.
        silent = {n for n in SCORED_SIGNALS if n not in r.claimed and not np.isfinite(getattr(track, n)).any()}
        silent |= {"diverged"} - r.claimed
        rows += [row for row in figures if silent.isdisjoint((row.signal, row.metric))]
    drive.plan = replace(drive.plan, dependent={**equal, **drive.plan.dependent})
    return rows, blocks


@dataclass(frozen=True, slots=True, eq=False)
class _Recording:
    """The content of a log: estimates, ground truth, reference and signals, each at its own stamps."""

    drive: Drive
    recorded: Sequence[RecordedEstimate]
    truth: TruthTrack | None
    reference: ReferenceEstimator | None
    signals: Signals | None
    manoeuvres: Sequence[Manoeuvre]
    losses: tuple[Loss, ...]
    ledger: tuple[SampleCount, ...]

    def at(self, stamps_ns: IntArray) -> tuple[EvaluatedDrive, Signals]:
        """Return ground truth, reference and segments at stamps [N], and the signals interpolated to them."""
        latency_s, vehicle, truth = self.drive.plan.truth_latency_s, self.drive.car.vehicle, None
        if self.truth is not None:
            truth = truth_at(self.truth, stamps_ns, latency_s, standstill_m_s=vehicle.standstill_m_s)
        tracks = {} if self.reference is None else {REFERENCE: self.reference.at(stamps_ns)}
        seen = signals_at(self.signals, stamps_ns)
        masks = segment_masks(seen, truth, vehicle, self.manoeuvres)
        return EvaluatedDrive(self.drive.name, tracks, truth, None, masks, vehicle.low_speed_blend_m_s), seen


def _nothing_to_score_against(got: str, where: str) -> MappingError:
    return MappingError(
        expected="a ground truth to score against, or an IMU for a sideslip reference",
        got=got,
        where=where,
        remedy="name ground truth with --truth SIGNAL=TOPIC.FIELD or in a mapping file",
    )


def _read_sensors(drive: Drive) -> Signals | None:
    """Return the signals of the mapped sensors, None without any; the drive then has their losses and samples."""
    if not drive.plan.alignment.channels:
        drive.tell("no IMU in the mapping: segments come from the ground truth alone")
        return None
    drive.plan = replace(drive.plan, truth=None, mapping=replace(drive.mapping, truth={}, quality=None))
    signals = drive.recorded().signals
    return drive.friction.fill(signals) if len(signals) else None


def _same_column(estimate: FloatArray, truth: FloatArray) -> bool:
    usable = np.isfinite(estimate) & np.isfinite(truth)
    return int(np.count_nonzero(usable)) >= 10 and share_equal(estimate[usable], truth[usable]) >= SAME_SHARE


def _truth_of(channels: Mapping[str, Channel], drive: Drive) -> TruthTrack:
    """Derive the ground truth on its own clock; raises MappingError where the slice contains none."""
    plan = drive.plan.truth
    track = None if plan is None else derive_truth(channels, plan=plan).track
    if plan is None or track is None or not len(track):
        raise MappingError(
            expected="ground truth in the chosen slice",
            got="no samples that can be used",
            where=f"{drive.log.path} {', '.join(s.label for s in drive.plan.mapping.truth.values())}",
            remedy="pdhef inspect LOG shows the contents of the log and the dropped samples",
        )
    return TruthTrack(track, plan.max_gap_s[plan.base], drive.plan.derivation)


def signals_at(signals: Signals | None, stamps_ns: IntArray) -> Signals:
    """Return the sensors at other stamps [N], interpolated between samples, never across gaps; all NaN without any."""
    n = stamps_ns.shape[0]

    def column(name: str) -> FloatArray:
        if signals is None:
            return np.full(n, np.nan)
        values: FloatArray = getattr(signals, name)
        is_finite = np.isfinite(values)
        stamps = signals.stamps_ns[is_finite]
        return Bracket(stamps, stamps_ns, gap_ns(stamps)).linear(values[is_finite])

    return Signals(
        stamps_ns=stamps_ns,
        ready_ns=stamps_ns,
        wheel_speed_m_s=np.full((n, len(WHEELS)), np.nan),
        available=frozenset() if signals is None else signals.available,
        **{name: column(name) for name in ALIGNED_SIGNALS},
    )
