"""Scores estimates that somebody else recorded in a log: their fields, their stamps, ground truth there, figures.

The scored stamps are the estimate's own. Ground truth is interpolated to them, its latency measured against the gyro if
the log has an IMU; the sensors, which only cut the drive into segments, are interpolated to them too.
"""

from collections.abc import Mapping, Sequence
from contextlib import closing, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.reading import Drive, Tell, WholeDrive, one_log, read_drive
from pdhef_logtool.drive.truth import SAME_SHARE, TruthTrack, dependent_signals, derive_truth, share_equal, truth_at
from pdhef_logtool.estimators.prediction import sideslip_std
from pdhef_logtool.evaluation.operating_space import operating_space
from pdhef_logtool.evaluation.requirement_blocks import requirement_blocks
from pdhef_logtool.evaluation.units import SCORED_SIGNALS
from pdhef_logtool.evaluation.validation_plan import ValidationPlan
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.logs.drive_log import Columns, DriveLog
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import Mapping as SignalMapping, check_mapping, mapping_of, read_signals, resolve_mapping
from pdhef_logtool.mapping.can_frames import with_can_signals
from pdhef_logtool.mapping.channels import LOSS_TEXTS, dropped, merge_losses, si_values
from pdhef_logtool.mapping.choosing import mapping_for_recorder
from pdhef_logtool.mapping.clocks import clock_key, fit_clocks, requests_of, stamps_on_log_clock
from pdhef_logtool.mapping.estimates import BASE_ORDER, STDS, EstimateSource, choose_estimates, sources_of
from pdhef_logtool.model.drive_model import DriveModel
from pdhef_logtool.model.intervals import drive_intervals
from pdhef_logtool.records.errors import MappingError
from pdhef_logtool.records.geometry import wrap_angle
from pdhef_logtool.records.interpolation import Bracket
from pdhef_logtool.records.reporter import SILENT, Reporter
from pdhef_logtool.records.signals import (
    ALIGNED_SIGNALS,
    ESTIMATE_UNITS,
    NS_PER_S,
    TRUTH_UNITS,
    WHEELS,
    BoolArray,
    Channel,
    FloatArray,
    IntArray,
    Loss,
    Signals,
)
from pdhef_logtool.records.tracks import REFERENCE, StateTrack, diagonal_covariance, make_track
from pdhef_logtool.residual_model.bundle import NO_MODEL
from pdhef_logtool.results.opened_run import LOGS, PAGE_FILE
from pdhef_logtool.results.run_report import estimator_entry
from pdhef_logtool.results.tables import drive_part
from pdhef_logtool.runs import drive_outputs, estimating
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.judging import judge, judge_drive, read_validation_plan, write_verdicts
from pdhef_logtool.runs.referencing import DriveReference, reference_of
from pdhef_logtool.runs.run_drive import outcome_of, report_drive
from pdhef_logtool.runs.run_result import LogResult, RunResult
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
    argument : the log. config : vehicle, mapping, slice, choice of ground truth and plan are used.
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
        with closing(open_log(log_input.path, reading.limits, reading.msgs, reading.tables)) as log:
            mapping = mapping_for_recorder(log, mapping)
    plan = read_validation_plan(config.plan, junit)
    drive_outputs.check_places([log_input], output, config, mapping, junit)
    with nullcontext() if output is None else OutputFolder(output, (LOGS,)) as outputs:
        drive, sources = _open(log_input, car, mapping, config, (estimates, truth, name), reporter)
        with drive:
            result = _score_drive(drive, sources, config, plan, outputs, reporter)
        verdicts = judge(plan, [result], config.strict)
        if output is not None:
            drive_outputs.write_run_tables(output, [result])
            drive_outputs.write_run(output, _config_document(config, drive, sources), [result], verdicts)
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
    run = estimating.PreparedDrive(drive, config, model, reference, [], [], drive_intervals(drive.car, []), {})
    reporter.progress(drive.name, 0.8)

    def at(stamps_ns: IntArray, tracks: Sequence[StateTrack]) -> estimating.Estimated:
        of_reference = [] if reference is None or reference.estimator is None else [reference.estimator.at(stamps_ns)]
        return estimating.Estimated(_drive_at(drive, truth, stamps_ns), {t.name: t for t in (*tracks, *of_reference)})

    tracks = [r.track for r in recorded]
    equal: dict[str, str] = {}
    scored = [_score(run, r, at(r.track.stamps_ns, [r.track]), equal) for r in recorded]
    drive.plan.dependent.update(equal | drive.plan.dependent)
    selected = tracks[0].name if len(tracks) == 1 else None
    stamps_ns = np.unique(np.concatenate([track.stamps_ns for track in tracks]))
    # Each has been scored at its own stamps; the drive is cut into segments at those of all.
    parts, together = estimating.evaluate(drive, at(stamps_ns, []), model), at(stamps_ns, tracks)
    rows = {(m.estimator, m.signal, m.segment, m.metric): m for s in scored for m in s.rows}
    events = estimating.in_order([*parts.events, *estimating.divergences(tracks)])
    whole = replace(parts, rows=[*rows.values()], events=events)
    blocks = []
    for track, s in zip(tracks, scored, strict=True):
        asked = [q for q in plan.requirements if q.estimator == track.name or (selected and q.estimator is None)]
        blocks += requirement_blocks(asked, selected, s.drive)
    space = operating_space(together.signals, together.truth, together.tracks.get(selected or ""), drive.car.vehicle)
    stated = judge_drive(plan, drive, None, whole.rows, blocks, space)
    stated["estimators"] = [estimator_entry(r.track.name, causal=True, notes=[_RECORDED, *r.notes]) for r in recorded]
    losses = merge_losses([drive.losses, lost])
    report = report_drive(run, together, whole, stated, losses, selected)
    folder, files = None, dict[str, str]()
    if outputs is not None:
        with outputs.begin(drive_outputs.log_place(drive.name), stale=(PAGE_FILE,)) as change:
            drive_outputs.write_drive_tables(change, report, whole.rows, together.drawn)
        folder = change.target
        files = drive_outputs.files_of(folder)
    reporter.progress(drive.name, 1.0)
    outcome = outcome_of(drive, losses, files=files)
    part = drive_part(outcome, report, whole.rows, stated["plan"])
    return LogResult(outcome, folder, report, tuple(whole.rows), part=part)


def _read(drive: Drive, sources: Sequence[EstimateSource]) -> "tuple[list[RecordedEstimate], list[Loss]]":
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
        raise _nothing_to_score_against(f"none, and no sideslip reference: {refused}", drive.path.name)
    return reference


def _drive_at(drive: Drive, truth: TruthTrack | None, stamps_ns: IntArray) -> WholeDrive:
    """Return the drive at stamps [N]: its sensors are interpolated between samples, never across gaps."""
    plan, recorded = drive.plan, drive.recorded()
    read = recorded.signals
    columns: dict[str, Any] = {n: _interpolated(read.stamps_ns, getattr(read, n), stamps_ns) for n in ALIGNED_SIGNALS}
    wheels = np.full((len(stamps_ns), len(WHEELS)), np.nan)
    signals = Signals(stamps_ns, stamps_ns, wheel_speed_m_s=wheels, available=read.available, **columns)
    latency_s, standstill_m_s = plan.truth_latency_s, plan.vehicle.standstill_m_s
    true = None if truth is None else truth_at(truth, stamps_ns, latency_s, standstill_m_s=standstill_m_s)
    return WholeDrive(drive.name, plan, drive.friction.fill(signals), true, drive.log.start_ns, recorded.changes)


def _score(
    run: estimating.PreparedDrive, recorded: "RecordedEstimate", estimated: estimating.Estimated, equal: dict[str, str]
) -> estimating.Evaluation:
    """Score an estimate at its own stamps; add to ``equal`` the ground truth that equals it."""
    drive, track, truth = run.drive, recorded.track, estimated.truth
    same = {
        signal: f"the ground truth's {signal} equals that of the estimate {track.name}"
        for signal in SCORED_SIGNALS
        if truth is not None and _same_column(getattr(track, signal), getattr(truth, signal))
    }
    equal |= same
    scored = estimating.evaluate(drive, estimated, run.model, {**same, **drive.plan.dependent})
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


#: Steps of more than this number of median periods are not interpolated.
GAP_PERIODS = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class RecordedEstimate:
    """A recorded estimate on its own stamps.

    ``channels`` are its quantities on their own stamps, NaN left out; ``claimed`` are the names of all that the
    estimate consists of.
    """

    track: StateTrack
    channels: Mapping[str, Channel]
    claimed: frozenset[str]
    notes: tuple[str, ...] = ()


def read_estimate(
    log: DriveLog, source: EstimateSource, start_ns: int, end_ns: int
) -> tuple[RecordedEstimate, list[Loss]]:
    """Read one recorded estimate with log time in [start, end) onto the stamps of its first quantity of BASE_ORDER.

    NaN stays: it counts against the availability of the estimator and is not a loss.

    Raises
    ------
    MappingError : The slice contains no message of it, or not one number.
    """
    log = with_can_signals(log, source.as_mapping())
    mapping = resolve_mapping(log, source.as_mapping())
    clocks = fit_clocks(log, mapping, start_ns, end_ns)
    requests = requests_of(log, mapping.signals.values())
    if source.covariance is not None:
        requests[source.covariance.topic].append(source.covariance.field)
    losses: list[Loss] = []
    columns = log.read(requests, start_ns, end_ns)
    there = {name for name, s in mapping.signals.items() if len(columns.get(s.read_topic) or ())}
    base = next((name for name in BASE_ORDER if name in there), "")
    channels: dict[str, Channel] = {}
    for name, s in mapping.signals.items():
        if name not in there:
            none = np.empty(0, dtype=np.int64)
            channels[name] = Channel(name, ESTIMATE_UNITS[name], s.label, none, none, np.empty(0))
            continue
        topic = columns[s.read_topic]
        stamps, usable = stamps_on_log_clock(log, topic, s, clocks[clock_key(s)])
        stamps = stamps - np.int64(round(s.latency_s * NS_PER_S))
        kept = _in_order(stamps, topic.log_time_ns, usable)
        values, low, high = si_values(topic, s)[kept], s.valid_min, s.valid_max
        use = np.isfinite(values) & (low is None or values >= low) & (high is None or values <= high)
        values = np.where(use, values, np.nan)
        channels[name] = Channel(name, ESTIMATE_UNITS[name], s.label, stamps[kept], topic.log_time_ns[kept], values)
        if name == base:
            if not usable.all():
                losses.append(dropped("bad-stamp", s.topic, topic.log_time_ns[~usable]))
            if repeated := int(np.count_nonzero(usable)) - len(kept):
                text = LOSS_TEXTS["duplicate-stamp"]
                losses.append(Loss("duplicate-stamp", text, s.topic, count=repeated, severity="note"))
            covariance = _planar_covariance(topic, source)[kept]
    if not any(np.isfinite(channel.values).any() for name, channel in channels.items() if name in BASE_ORDER):
        raise MappingError(
            expected="numbers in the recorded estimate",
            got="none in the chosen slice",
            where=f"{log.path} {', '.join(s.label for n, s in mapping.signals.items() if n in BASE_ORDER)}",
            remedy="check topic, field and slice",
        )
    track, notes = _track(source.name, channels[base].stamps_ns, channels, covariance)
    finite = {n: c.take(np.isfinite(c.values)) for n, c in channels.items() if n in BASE_ORDER}
    return RecordedEstimate(track, finite, frozenset(channels), notes), losses


def _in_order(stamps_ns: IntArray, arrival_ns: IntArray, usable: BoolArray) -> IntArray:
    """Return the places of usable samples in order of unique stamps; of equal stamps the first arrival."""
    places = np.flatnonzero(usable)
    order = places[np.lexsort((arrival_ns[places], stamps_ns[places]))]
    return order[np.diff(stamps_ns[order], prepend=stamps_ns[order[:1]] - 1) > 0]


def _planar_covariance(topic: Columns, source: EstimateSource) -> FloatArray:
    """Return [N, 3, 3] over v_x, v_y, yaw rate; NaN if unknown (no field, all zero, or −1 first, as in ROS)."""
    n, of = len(topic), source.covariance
    raw = np.empty(0) if of is None else np.asarray(topic.fields[of.field], dtype=np.float64)
    if of is None or raw.ndim != 2 or raw.shape[1] != of.size**2:
        return np.full((n, 3, 3), np.nan)
    places = np.array(of.planar)
    planar = raw.reshape(n, of.size, of.size)[:, places[:, None], places]
    unknown = (planar == 0.0).all(axis=(1, 2)) | (raw[:, 0] < 0.0)
    return np.where(unknown[:, None, None], np.nan, planar)


def _track(
    name: str, stamps_ns: IntArray, channels: Mapping[str, Channel], covariance: FloatArray | None
) -> tuple[StateTrack, tuple[str, ...]]:
    notes: list[str] = []
    columns: dict[str, FloatArray] = {}
    for quantity, channel in channels.items():
        same = np.array_equal(channel.stamps_ns, stamps_ns)
        if same:
            columns[quantity] = channel.values
        else:
            is_angle = quantity == "sideslip_rad"
            columns[quantity] = _interpolated(channel.stamps_ns, channel.values, stamps_ns, is_angle=is_angle)
        if not same and quantity in BASE_ORDER:
            notes.append(f"{quantity} has other stamps than the estimate and is interpolated to them")
    if "sideslip_rad" in columns:
        beta = columns["sideslip_rad"]
        columns["sideslip_rad"] = np.where(np.abs(beta) > np.pi, wrap_angle(beta), beta)
        if "vx_m_s" in columns and "vy_m_s" not in columns:
            columns["vy_m_s"] = columns["vx_m_s"] * np.tan(columns["sideslip_rad"])
            notes.append("v_y is v_x times tan of the sideslip")
    if covariance is None or not np.isfinite(covariance).any():
        covariance = diagonal_covariance([columns.get(s, np.full(stamps_ns.shape[0], np.nan)) for s in STDS])
    flags = {flag: columns[flag] >= 0.5 for flag in ("valid", "diverged") if flag in columns}
    if covariance.shape[0] and "sideslip_std_rad" not in columns and {"vx_m_s", "vy_m_s"} <= columns.keys():
        # Where only deviations are known the correlation of the two velocities counts as 0.
        completed = np.where(np.eye(3, dtype=np.bool_), covariance, np.nan_to_num(covariance, nan=0.0))
        columns["sideslip_std_rad"] = sideslip_std(columns["vx_m_s"], columns["vy_m_s"], completed)
    state = {n: c for n, c in columns.items() if n not in (*STDS, "valid", "diverged")}
    return make_track(name, stamps_ns, covariance=covariance, **state, **flags), tuple(notes)


def _interpolated(stamps_ns: IntArray, values: FloatArray, at_ns: IntArray, *, is_angle: bool = False) -> FloatArray:
    """Return values [N] at other stamps [M], between finite samples that are not too far apart."""
    is_finite = np.isfinite(values)
    stamps = stamps_ns[is_finite]
    gap_ns = round(GAP_PERIODS * float(np.median(np.diff(stamps)))) if len(stamps) > 1 else 0
    bracket = Bracket(stamps, at_ns, gap_ns)
    return bracket.angle(values[is_finite]) if is_angle else bracket.linear(values[is_finite])
