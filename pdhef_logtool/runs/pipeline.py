"""One log from start to end: read, estimate, compare, write. Several of them: :mod:`~.fleet`."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pdhef_logtool.car.car import SHOWN_DIGITS, Car
from pdhef_logtool.car.parts import PHYSICS
from pdhef_logtool.drive.friction import FrictionSource
from pdhef_logtool.drive.plan import DrivePlan, setup_of
from pdhef_logtool.drive.reading import Drive, lost_texts, read_drive
from pdhef_logtool.drive.setup import setup_toml
from pdhef_logtool.estimators.algorithm import resolve
from pdhef_logtool.estimators.base import Estimator, notes_of
from pdhef_logtool.estimators.causality_check import CausalityCheck
from pdhef_logtool.estimators.intervals import TrackCalibrator
from pdhef_logtool.estimators.plug_ins import package_of
from pdhef_logtool.estimators.table import ALL_ESTIMATORS, Options, Skipped, all_specs, runnable
from pdhef_logtool.evaluation.dependence import day_and_route, factors_of
from pdhef_logtool.evaluation.requirement_bounds import LEAST_DRIVES
from pdhef_logtool.evaluation.validation_plan import default_plan
from pdhef_logtool.logs.discovery import RUN_FILE, LogInput
from pdhef_logtool.mapping import Mapping, merge_losses
from pdhef_logtool.records.errors import (
    EXIT_FAILURE,
    EXIT_GATE,
    EXIT_OK,
    EXIT_PARTIAL,
    EstimatorError,
    UsageError,
)
from pdhef_logtool.records.ledger import SampleCount
from pdhef_logtool.records.reporter import SILENT, Reporter
from pdhef_logtool.records.signals import SIGNAL_UNITS, TRUTH_UNITS, Loss, Signals
from pdhef_logtool.records.tracks import REFERENCE, StateTrack
from pdhef_logtool.results.no_position import topics_with_position, without_names, without_pose
from pdhef_logtool.results.opened_run import (
    ESTIMATES_FILE,
    LOGS,
    METRICS_FILE,
    PAGE_FILE,
    RECORDING_FILE,
    REPORT_FILE,
    SETUP_FILE,
    OpenedLog,
)
from pdhef_logtool.results.palette import REFERENCE_COLOUR
from pdhef_logtool.results.run_report import (
    CarFacts,
    EstimatorFacts,
    FrictionFacts,
    LogFacts,
    LogOutcome,
    ReportFacts,
    RequirementFacts,
    SourceFacts,
    TopicFacts,
    TruthFacts,
    brief_report,
    build_report,
    build_run,
    run_versions,
    tool_versions,
    write_json,
)
from pdhef_logtool.results.sink import TRUTH, Event, Shown
from pdhef_logtool.runs.config import Keep, RunConfig
from pdhef_logtool.runs.estimating import Estimated, calibrator, estimate_drive
from pdhef_logtool.runs.reference_audit import audit_truth
from pdhef_logtool.runs.referencing import DriveReference, reference_of
from pdhef_logtool.runs.scoring import Evaluation, evaluate, in_time
from pdhef_logtool.runs.selection import choose_main, choose_over_time, contradiction, default_names
from pdhef_logtool.runs.self_calibrating import calibrate_drive, checked, log_sensors, self_calibrated
from pdhef_logtool.storage.documents import digest, file_sha256, jsonable
from pdhef_logtool.storage.files import write_bytes
from pdhef_logtool.storage.outputs import FolderTransaction, OutputFolder, check_no_input

if TYPE_CHECKING:
    from pdhef_logtool.estimators.calibration.calibration import SelfCalibration
    from pdhef_logtool.evaluation.metrics import MetricRow
    from pdhef_logtool.evaluation.metrics.metric import SensorErrors
    from pdhef_logtool.evaluation.operating_space import OperatingSpace
    from pdhef_logtool.evaluation.requirement_blocks import RequirementBlocks
    from pdhef_logtool.evaluation.validation_plan import ValidationPlan
    from pdhef_logtool.results.mcap_sink import AnnotatedMcap
    from pdhef_logtool.results.plan_verdicts import PlanVerdicts
    from pdhef_logtool.results.selected_estimate import MainFacts
    from pdhef_logtool.storage.object_store import Mirror

#: Up to so many logs each is given of by itself, and everything is kept.
FEW_LOGS = 50
#: What a run writes into a log's folder.
LOG_FILES = (
    SETUP_FILE,
    "annotated.mcap",
    "foxglove.json",
    "plotjuggler.xml",
    ESTIMATES_FILE,
    METRICS_FILE,
    RECORDING_FILE,
    REPORT_FILE,
    PAGE_FILE,
)

#: What of an earlier run's goes where a drive's new files have it not.
STALE_FILES = (SETUP_FILE, PAGE_FILE, METRICS_FILE, ESTIMATES_FILE, RECORDING_FILE)

#: Blocks of a requirement in a brief report.
_BRIEF_BLOCKS = 12
_SILENT = "{} has no valid row although the car moves"
_NO_COPY = "annotated.mcap contains the tool's topics only: a log of kind {} has no messages to copy"
_ALL_SILENT = "no estimator has a valid row although the car moves"
_MAP_THEM = "map the missing signals (pdhef inspect LOG --write-mapping mapping.toml)"
_NEVER_MOVES = "the car is never faster than {:g} m/s: there is nothing to score"
#: Units of ground truth quantities that have no channel of their own name.
_DERIVED_UNITS = {"position_m": "m"}


@dataclass(frozen=True, slots=True, eq=False)
class LogResult:
    """What came out of one log; what is in no hand any more is read from the files that it was written to.

    Attributes
    ----------
    output : folder of the log, None where nothing was written.
    document, figures : report and rows that are at hand, None where they are in files; ``figures_file`` is theirs.
    failed_checks : of the drive, those that count.
    """

    outcome: LogOutcome
    output: Path | None
    document: dict[str, Any] | None = None
    figures: tuple[MetricRow, ...] | None = ()
    failed_checks: int = 0
    figures_file: Path | None = None

    @property
    def report(self) -> dict[str, Any] | None:
        """The document of report.json, None if the log failed; raises OutputError for a damaged one."""
        if self.document is not None or self.output is None:
            return self.document
        return OpenedLog(self.outcome.log, self.outcome.outcome, self.output, {"files": self.outcome.files}).report()

    @property
    def rows(self) -> tuple[MetricRow, ...]:
        """The figures; raises OutputError for a damaged file of them."""
        from pdhef_logtool.results.parquet_sink import read_metrics

        if self.figures is not None:
            return self.figures
        return () if self.figures_file is None else tuple(read_metrics(self.figures_file))

    @property
    def is_whole(self) -> bool:
        """Whether all of the log could be used and no check failed that counts."""
        return self.outcome.outcome == "ok" and not self.failed_checks


@dataclass(frozen=True, slots=True, eq=False)
class RunResult:
    """What came out of a run; ``output`` is None when nothing was to be written.

    ``requirements``: the verdicts of the validation plan on all logs.

    Where outputs are at a URL, ``stored`` states so, and ``output`` is a folder with what is given of them, which goes
    with this result.
    """

    output: Path | None
    results: tuple[LogResult, ...]
    stored: Mirror | None = None
    requirements: PlanVerdicts | None = None

    @property
    def place(self) -> Path | str | None:
        """Where people find the outputs."""
        return self.output if self.stored is None else self.stored.objects.shown

    @property
    def is_fleet(self) -> bool:
        """Whether there are too many logs to report each."""
        return len(self.results) > FEW_LOGS

    @property
    def exit_code(self) -> int:
        """0 if all is well, 4: a requirement failed, 3: input was lost, a check or some logs failed, 1: all failed."""
        if all(r.outcome.failed is not None for r in self.results):
            return EXIT_FAILURE
        if self.requirements is not None and self.requirements.closes_gate:
            return EXIT_GATE
        return EXIT_OK if all(r.is_whole for r in self.results) else EXIT_PARTIAL

    def _shown(self, folder: Path) -> str:
        return str(folder) if self.output is None else str(folder).replace(str(self.output), str(self.place), 1)

    def to_dict(self) -> dict[str, Any]:
        """Return the result as one JSON-able document; of many logs without their reports."""
        return {
            "output": None if self.place is None else str(self.place),
            "exit_code": self.exit_code,
            "plan": None if self.requirements is None else jsonable(self.requirements.to_dict()),
            "logs": [
                {
                    "log": r.outcome.log,
                    "outcome": r.outcome.outcome,
                    "output": None if r.output is None else self._shown(r.output),
                    "report": None if self.is_fleet else r.report,
                }
                for r in self.results
            ],
        }


def read_validation_plan(config: RunConfig, junit: Path | None) -> ValidationPlan:
    """Return the configured plan or the default one; raises UsageError when it is wrong or misses for ``junit``."""
    from pdhef_logtool.evaluation.validation_plan import load_plan
    from pdhef_logtool.results.plan_against import other_runs

    if config.plan is not None:
        plan = load_plan(config.plan)
        other_runs(plan, ())  # a missing one ends the command before the work
        return plan
    if junit is not None:
        raise UsageError(
            expected="a validation plan to give verdicts on", got="none", where="--junit", remedy="--plan FILE"
        )
    return default_plan()


def judge(
    plan: ValidationPlan, results: Sequence[LogResult], strict: bool, metrics: Path | None = None
) -> PlanVerdicts:
    """Return the verdicts of a plan on logs; a log that failed has no figures.

    ``metrics``: the figures of all logs, None where they are at hand.
    """
    from pdhef_logtool.results.plan_against import other_runs
    from pdhef_logtool.results.plan_verdicts import JudgedDrive, figures_of_file, figures_of_rows, plan_verdicts

    done = [r for r in results if r.outcome.failed is None or r.document is not None]
    drives = [
        JudgedDrive(o.log, o.main, partial(_report, r), factors_of(asdict(o), None)) for r in done if (o := r.outcome)
    ]
    if metrics is None:
        figures = figures_of_rows(row for r in done for row in r.rows)
    else:
        import polars as pl

        figures = figures_of_file(pl.scan_parquet(metrics), plan, [d.main for d in drives])
    logs = [OpenedLog(o.log, o.outcome, Path(), asdict(o)) for r in done if (o := r.outcome)]
    return plan_verdicts(plan, figures, drives, strict=strict, against=other_runs(plan, logs))


@lru_cache(maxsize=LEAST_DRIVES)
def _report(result: LogResult) -> dict[str, Any] | None:
    return result.report


def write_verdicts(junit: Path | None, verdicts: PlanVerdicts, results: Sequence[LogResult]) -> None:
    """Write JUnit XML if a file is asked for; raises OutputError."""
    from pdhef_logtool.results.junit import write_junit

    if junit is not None:
        checks = {r.outcome.log: (r.report or {}).get("checks", ()) for r in results}
        write_junit(junit, verdicts, checks)


def run_log(
    log_input: LogInput,
    outputs: OutputFolder,
    config: RunConfig,
    car: Car,
    mapping: Mapping | None,
    *,
    pool: SelfCalibration | None = None,
    validation: ValidationPlan | None = None,
    is_first: bool = True,
    reporter: Reporter = SILENT,
) -> LogResult:
    """Run one log and replace its folder ``logs/<stem>`` of the outputs.

    Parameters
    ----------
    pool : what all logs of the run together state of the car; None: the log states it, if it is asked.
    validation : plan that the report gives verdicts on; None: the default plan.
    is_first : whether it is the run's first log, whose estimators get the full causality check.

    Raises
    ------
    PdhefError
        Nothing of the log can be used; nothing is then left under a final name.
    """
    reporter.progress(log_input.stem, 0.0)
    with read_drive(log_input, car, mapping, config.read_options, tell=reporter.warn) as drive:
        calibration = checked(drive, pool if pool is not None else calibrate_drive(drive, config))
        car = self_calibrated(drive, calibration)
        ready, skipped, requested = _choose_estimators(drive, config, car)
        reference = reference_of(drive, calibration, config)
        if reference is not None and reference.estimator is not None:
            ready, requested = [*ready, reference.estimator], requested | {REFERENCE}
        job = _Job(
            drive, car, calibration, reference, ready, skipped, requested, validation or default_plan(), is_first
        )
        result = _run_estimators(job, outputs, config, reporter)
    reporter.progress(result.outcome.log, 1.0)
    return result


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    """A drive with the car, as its log calibrated it where it did, and the estimators that run on it.

    Those that are not ``requested`` are candidates for the selected estimate: only the selected one is in the outputs.
    """

    drive: Drive
    car: Car
    calibration: SelfCalibration | None
    reference: DriveReference | None
    ready: Sequence[Estimator]
    skipped: Sequence[Skipped]
    requested: frozenset[str]
    validation: ValidationPlan
    is_first: bool

    def sensors(self, calibration: SelfCalibration | None) -> SensorErrors:
        """Return the errors of the log's sensors that a calibration states."""
        return log_sensors(self.drive.car.vehicle, calibration, told_friction=self.drive.friction.bank is None)


def _run_estimators(job: _Job, outputs: OutputFolder, config: RunConfig, reporter: Reporter) -> LogResult:
    """Estimate, score and write one drive."""
    drive, car = job.drive, job.car
    intervals = calibrator(car, job.ready)
    with outputs.begin(log_place(drive.name), stale=STALE_FILES) as change, ExitStack() as opened:
        causality = CausalityCheck(job.is_first)
        causality.failed |= {s.name: s.reason for s in job.skipped if s.is_error}
        estimated = _estimate(drive, job.ready, intervals, reporter, causality)
        job = replace(job, ready=_without_failed(drive, job.ready, causality.failed))
        scored = _score(job, estimated)
        main = choose_main(job.ready, scored.rows, proven=drive.car.has_evidence, named=config.estimators is not None)
        if config.calibrate == "online" and job.calibration is not None and not drive.car.has_evidence:
            over_time = choose_over_time(job.ready, job.calibration, estimated.read, estimated.signals, job.sensors)
            main = replace(main, over_time=over_time, name=over_time[-1][1])
        left_out = frozenset(e.name for e in job.ready) - job.requested - {name for _, name in main.spans}
        job, scored, main = _without(left_out, job, scored, main)
        shown = _shown(main, [e.name for e in job.ready])
        tracks = _written_tracks(estimated, left_out, no_position=config.no_position)
        outputs_of_log = _Outputs(change, job, config, shown, main.spans, outputs.path, estimated.signals, tracks)
        annotated = outputs_of_log.annotated()
        lost = () if annotated is None else opened.enter_context(annotated).write(tracks)
        if intervals.warning:
            drive.tell(intervals.warning)
        if not scored.moves:
            drive.tell(_NEVER_MOVES.format(car.vehicle.low_speed_blend_m_s))
        losses = merge_losses([drive.losses, lost, *_losses(drive, scored, causality.failed)])
        facts = _facts(job, config, main, scored, estimated, (intervals, causality.failed), losses)
        report = build_report(facts)
        if config.no_position:
            report = without_names(report, drive.path, drive.name)
        if annotated is not None:
            annotated.finish(report, tracks, scored.events)
        outputs_of_log.write(report, scored.events)
        report = _write_files(change, drive, report, facts.metrics, config.kept)
    outcome = replace(
        outcome_of(drive, losses, neutral=config.no_position),
        car=_car_facts(drive.car),
        main=None if main is None else main.name,
        algorithms={e.name: resolve(e).identity for e in job.ready},
        files=files_of(change.target),
        failed=_ALL_SILENT if len(scored.silent) == len(job.ready) else None,
    )
    failed_checks = sum(c.verdict == "failed" and not c.waived for c in drive.checks)
    return LogResult(outcome, change.target, report, tuple(facts.metrics), failed_checks=failed_checks)


def _score(job: _Job, estimated: Estimated) -> Evaluation:
    """Score the tracks; add the events of an estimated friction and a contradiction as a note of the drive."""
    drive = job.drive
    sensors = job.sensors(job.calibration)
    scored = evaluate(drive, [e.name for e in job.ready], estimated.read, estimated.signals, sensors)
    if drive.friction.bank is not None:
        observable = friction_events(drive.friction, estimated.signals)
        scored = replace(scored, events=sorted([*scored.events, *observable], key=in_time))
    _audit(job, estimated)
    if against := contradiction(scored.rows):
        drive.notes.append(f"WARNING: {against.text}")  # the selected estimate's text gives the consequence
    return scored


def _audit(job: _Job, estimated: Estimated) -> None:
    """Compare the ground truth of sideslip with the reference, and note where they contradict each other."""
    truth, reference = estimated.truth, estimated.read(REFERENCE)
    if truth is None or reference is None or job.reference is None:
        return
    contradictions = audit_truth(truth, reference, job.drive.car.vehicle.low_speed_blend_m_s)
    job.reference.document["ground_truth"] = list(contradictions)
    for text in contradictions:
        job.drive.tell(text)


def _without(
    left_out: frozenset[str], job: _Job, scored: Evaluation, main: MainFacts
) -> tuple[_Job, Evaluation, MainFacts]:
    """Return estimators and figures without candidates that were neither requested nor selected."""
    ready = [e for e in job.ready if e.name not in left_out]
    rows = [r for r in scored.rows if left_out.isdisjoint(r.estimator.split("~"))]
    silent = tuple(name for name in scored.silent if name not in left_out)
    shown = [name for name in main.shown if name not in left_out]
    return (
        replace(job, ready=ready),
        replace(scored, rows=rows, silent=silent),
        replace(main, shown=shown, naive=None if main.naive in left_out else main.naive),
    )


def _losses(drive: Drive, scored: Evaluation, failed: dict[str, str]) -> Iterator[list[Loss]]:
    """Yield the estimators without a valid row and those that failed, as losses."""
    yield [Loss("no-valid-row", _SILENT.format(name), drive.name) for name in scored.silent]
    yield [Loss("estimator-failed", f"{name} {text}", drive.name) for name, text in failed.items()]


def _facts(
    job: _Job,
    config: RunConfig,
    main: MainFacts,
    scored: Evaluation,
    estimated: Estimated,
    ran: tuple[TrackCalibrator, dict[str, str]],
    losses: Sequence[Loss],
) -> ReportFacts:
    """Gather the content of report.json; ``ran``: intervals, and the estimators that failed with their reasons."""
    from pdhef_logtool.evaluation.operating_space import operating_space
    from pdhef_logtool.results.error_places import largest_errors
    from pdhef_logtool.runs.drive_details import drive_details

    drive, signals, (intervals, failed) = job.drive, estimated.signals, ran
    algorithms = {e.name: resolve(e) for e in job.ready}
    estimators = [
        EstimatorFacts(
            e.name,
            causal=e.causal and not drive.not_causal,
            notes=(*notes_of(e), *([drive.not_causal] if drive.not_causal else [])),
            intervals=intervals.notes(e.name),
            reasons=scored.reasons[e.name],
            algorithm={"sha256": a.sha256, **a.model_dump(mode="json")},
        )
        for e in job.ready
        for a in (algorithms[e.name],)
    ]
    estimators += [EstimatorFacts(name, causal=False, failed=text) for name, text in failed.items()]
    skipped = [s for s in job.skipped if not s.is_error]
    estimators += [EstimatorFacts(s.name, causal=s.spec.causal, skipped=s.reason) for s in skipped]
    digests = {name: a.sha256[:SHOWN_DIGITS] for name, a in algorithms.items()}
    rows = [replace(r, algorithm=digests.get(r.estimator, "")) for r in scored.rows]
    truth, selected, vehicle = estimated.truth, estimated.read(main.name), job.car.vehicle
    space = operating_space(signals, truth, selected, vehicle)
    details = drive_details(drive, job.ready, main.name, estimated.read, metadata=not config.no_position)
    others = [t for n in (REFERENCE, PHYSICS, *algorithms) if n != main.name and (t := estimated.read(n)) is not None]
    return replace(
        report_facts(drive, job.car, estimators, rows, scored.events, losses),
        friction=friction_facts(drive.friction),
        calibration=None if job.calibration is None else job.calibration.to_dict(),
        reference=None if job.reference is None else job.reference.document,
        main=main,
        space=space,
        largest_errors=[] if selected is None else largest_errors(selected, truth, others, vehicle.low_speed_blend_m_s),
        details=details,
        requirements=_requirements(job, main.name, scored, estimated, space, brief=config.kept == "metrics"),
    )


def _requirements(
    job: _Job, main: str, scored: Evaluation, estimated: Estimated, space: OperatingSpace, *, brief: bool
) -> RequirementFacts:
    """Return the blocks of the plan's requirements in this drive, and the verdicts on the drive alone."""
    from pdhef_logtool.evaluation.requirement_blocks import MOST_BLOCKS, ScoredDrive, requirement_blocks

    blocks: list[RequirementBlocks] = []
    slow, dependent = job.car.vehicle.low_speed_blend_m_s, frozenset(job.drive.plan.dependent)
    for name in (TRUTH, REFERENCE):  # the reference where ground truth scores nothing
        if (base := estimated.read(name)) is not None:
            tracks = ScoredDrive(estimated.read, base, scored.masks, slow, dependent, estimated=name == REFERENCE)
            left = [r for r in job.validation.requirements if all(b.of != r.measured for b in blocks)]
            blocks += requirement_blocks(left, main, tracks, _BRIEF_BLOCKS if brief else MOST_BLOCKS)
    return judged_alone(job.validation, job.drive, main, scored.rows, blocks, space)


def judged_alone(
    plan: ValidationPlan,
    drive: Drive,
    main: str | None,
    rows: Sequence[MetricRow],
    blocks: Sequence[RequirementBlocks],
    space: OperatingSpace,
) -> RequirementFacts:
    """Return the verdicts of a plan on one drive with its figures, blocks of time and operating space."""
    from pdhef_logtool.results.plan_verdicts import JudgedDrive, figures_of_rows, plan_verdicts

    report = {"requirement_blocks": jsonable(blocks), "operating_space": jsonable(space)}
    judged = JudgedDrive(drive.name, main, lambda: report, {"car": drive.car.vehicle.name})
    return RequirementFacts(plan_verdicts(plan, figures_of_rows(rows), [judged]), blocks)


def _write_files(
    change: FolderTransaction, drive: Drive, report: dict[str, Any], rows: Sequence[MetricRow], kept: Keep
) -> dict[str, Any]:
    """Write metrics.parquet, setup.toml and report.json; return the report as written."""
    from pdhef_logtool.results.parquet_sink import write_metrics

    brief = kept == "metrics"
    if brief:
        report = brief_report(report)
    else:
        write_metrics(change.file(METRICS_FILE), rows)
    head = f"Mounting, units, delays and clocks of {drive.name}, for pdhef run --setup."
    write_bytes(change.file(SETUP_FILE), setup_toml(setup_of(drive.plan), head).encode())
    write_json(change.file(REPORT_FILE), report, brief=brief)
    return report


def files_of(folder: Path) -> dict[str, str]:
    """Return the sha256 of the files in a log's folder that commands read back, by name."""
    paths = (folder / name for name in (REPORT_FILE, ESTIMATES_FILE))
    return {path.name: file_sha256(path) for path in paths if path.is_file()}


def _car_facts(car: Car) -> CarFacts:
    network = None if car.network is None else car.network.sha256
    sensors = car.vehicle.sensors.model_dump(exclude_defaults=True)
    return CarFacts(car.file_name, car.vehicle.name, car.physics_sha256, network, sensors)


def outcome_of(drive: Drive, losses: Sequence[Loss], *, neutral: bool = False) -> LogOutcome:
    """Return how a log that was read is recorded in run.json; ``neutral``: without names and metadata of its file."""
    day, route = day_and_route(drive.plan.start_ns, drive.log.metadata())
    texts: dict[str, Any] = {"file": drive.file, "lost": lost_texts(losses)}
    if neutral:
        texts, route = without_names(texts, drive.path, drive.name), route and digest(route)[:SHOWN_DIGITS]
    return LogOutcome(
        log=drive.name,
        sha256=drive.sha256,
        signals_sha256=drive.signals_sha256,
        truth_sha256=drive.truth_sha256,
        mapping_sha256=drive.mapping.sha256,
        **texts,
        day=day,
        route=route,
    )


def _choose_estimators(
    drive: Drive, config: RunConfig, car: Car
) -> tuple[list[Estimator], list[Skipped], frozenset[str]]:
    """Return the estimators that run, those that cannot, and the names of the requested ones that run.

    Candidates for the selected estimate run in any case. Raises EstimatorError if no requested estimator can.
    """
    names = config.estimators or default_names(car, drive.available)
    options, refused = Options(drive.options.use_speed, gnss=config.gnss == "auto"), drive.plan.refused
    estimators, skipped = runnable(names, car, drive.available, options, refused)
    requested = frozenset(e.name for e in estimators)
    more = [name for name in default_names(car, drive.available) if name not in requested]
    estimators += runnable(more, car, drive.available, options, refused)[0] if more else []
    if not requested:
        raise EstimatorError(
            expected="at least one estimator that can run",
            got="; ".join(f"{s.name}: {s.reason}" for s in skipped),
            where=str(drive.path),
            remedy=next((f"{reason} (or --waive it)" for reason in refused.values()), _MAP_THEM),
        )
    return estimators, skipped, requested


def _shown(main: MainFacts, ran: Sequence[str]) -> Shown:
    """Return what recordings open on: the selected estimate, and physics alone or else the naive estimate."""
    order = [PHYSICS, *([] if main.naive is None else [main.naive]), *main.shown]
    return Shown(main.name, next((name for name in order if name in ran and name != main.name), None))


def _causal_from_ns(drive: Drive, estimators: Sequence[Estimator]) -> dict[str, int]:
    """Return the first stamp from which the rows of each causal estimator depend on nothing later."""
    frozen_s = drive.causal_from_s
    after_s = drive.plan.decided_s if frozen_s is None else frozen_s
    first = drive.plan.start_ns + round(after_s * 1e9)
    return {e.name: first for e in estimators if e.causal and not drive.not_causal}


def _written_tracks(estimated: Estimated, left_out: frozenset[str], *, no_position: bool) -> list[StateTrack]:
    """Return the ground truth and the tracks in the outputs, without those of ``left_out`` estimators."""
    tracks = [track for name, track in estimated.tracks.items() if name not in left_out]
    if estimated.drawn_truth is not None:
        tracks.insert(0, estimated.drawn_truth)
    return [without_pose(track) for track in tracks] if no_position else tracks


@dataclass(frozen=True, slots=True, eq=False)
class _Outputs:
    """Output files with the tracks of a drive.

    ``selected`` : estimators, each from a stamp on. ``run_folder`` : of the run.
    """

    change: FolderTransaction
    job: _Job
    config: RunConfig
    shown: Shown
    selected: Sequence[tuple[int, str]]
    run_folder: Path
    signals: Signals
    tracks: Sequence[StateTrack]

    def annotated(self) -> AnnotatedMcap | None:
        """Return the annotated log if it is asked for; add remarks of the drive."""
        from pdhef_logtool.results.mcap_sink import AnnotatedMcap, thinned_step_ns

        config, drive = self.config, self.job.drive
        left_out = _left_out(drive, copied=self._is_copy) if config.no_position else None
        if config.annotation == "none":
            return None
        if self._is_copy and drive.log.messages is None:
            drive.remarks.append(_NO_COPY.format(drive.log.kind))
        is_named = bool(config.estimators) and config.estimators != (ALL_ESTIMATORS,)
        step_ns = thinned_step_ns(
            drive.log.size,
            rows=len(self.signals),
            others=len(self.job.ready) - 1,
            span_ns=drive.plan.end_ns - drive.plan.start_ns,
        )
        return AnnotatedMcap(
            self.change.file("annotated.mcap"),
            drive.log if self._is_copy else None,
            shown={self.shown.main, TRUTH},
            others_step_ns=None if is_named else step_ns,
            min_speed_m_s=self.job.car.vehicle.low_speed_blend_m_s,
            left_out=left_out,
        )

    def write(self, report: dict[str, Any], events: Sequence[Event]) -> None:
        """Write estimates.parquet, the layouts of the annotated log, and recording.rrd, if they are asked for."""
        from pdhef_logtool.mapping.recognition import FIX_TYPES
        from pdhef_logtool.results.layouts import write_layouts
        from pdhef_logtool.results.parquet_sink import write_estimates

        config, drive = self.config, self.job.drive
        colours = {REFERENCE: REFERENCE_COLOUR, **{s.name: s.colour for s in all_specs()}}
        if config.kept != "metrics":
            causal_from_ns = _causal_from_ns(drive, self.job.ready)
            path = self.change.file(ESTIMATES_FILE)
            write_estimates(path, self.tracks, selected=self.selected, causal_from_ns=causal_from_ns)
        if config.annotation != "none":
            fixes = [t.name for t in drive.log.topics if t.type_name.replace("/msg/", "/") in FIX_TYPES]
            write_layouts(
                self.change.file("foxglove.json"),
                self.change.file("plotjuggler.xml"),
                self.tracks,
                colours,
                shown={self.shown.main, TRUTH},
                fixes=fixes if self._is_copy and not config.no_position else (),
            )
        if config.kept == "full":
            self._write_recording(report, events, colours)

    @property
    def _is_copy(self) -> bool:
        return self.config.annotation == "full"

    def _write_recording(self, report: dict[str, Any], events: Sequence[Event], colours: dict[str, int]) -> None:
        from pdhef_logtool.results.rerun_sink import write_recording

        drive, application_id = self.job.drive, _application_id(self.run_folder, self.config)
        write_recording(
            self.change.file(RECORDING_FILE),
            self.signals,
            self.tracks,
            report,
            events,
            application_id=application_id,
            log_name=drive.name,
            input_hash=sha256(f"{application_id} {drive.sha256} {drive.name}".encode()).hexdigest(),
            start_ns=drive.plan.start_ns,
            end_ns=drive.plan.end_ns,
            shown=self.shown,
            min_speed_m_s=self.job.car.vehicle.low_speed_blend_m_s,
            colours=colours,
        )


def _left_out(drive: Drive, *, copied: bool) -> frozenset[str]:
    """Return the topics that ``--no-position`` keeps out of the copy, if there is one; note what is left out."""
    topics = topics_with_position(drive.log, drive.plan.mapping) if copied else frozenset()
    names = f"topics {', '.join(sorted(topics))}, " if topics else ""
    drive.remarks.append(f"--no-position leaves out {names}attachments, metadata and file names")
    return topics


def _application_id(output: Path, config: RunConfig) -> str:
    """Return what the recordings of a run have in common, by which a viewer shows them as one dataset."""
    identity = json.dumps([config.to_dict(), tool_versions()], sort_keys=True)
    return f"pdhef-{output.resolve().name}-{sha256(identity.encode()).hexdigest()[:SHOWN_DIGITS]}"


def _estimate(
    drive: Drive,
    estimators: Sequence[Estimator],
    intervals: TrackCalibrator,
    reporter: Reporter,
    causality: CausalityCheck,
) -> Estimated:
    """Run all estimators over the drive."""
    plug_ins = ", ".join(filter(None, map(package_of, estimators)))
    label = f"{drive.name} (plug-ins: {plug_ins})" if plug_ins else drive.name
    estimated = estimate_drive(
        drive.whole(),
        estimators,
        intervals=intervals,
        causality=causality,
        progress=lambda share: reporter.progress(label, 0.8 * share),
    )
    reporter.progress(drive.name, 0.8)
    return estimated


def _without_failed(drive: Drive, ready: Sequence[Estimator], failed: dict[str, str]) -> Sequence[Estimator]:
    """Return the estimators whose estimates count; raises EstimatorError if none is left."""
    texts = [f"{name} {text}" for name, text in failed.items()]
    for text in texts:
        drive.tell(text)
    left = [e for e in ready if e.name not in failed]
    if not left:
        raise EstimatorError(
            expected="an estimator that runs as it declares", got="; ".join(texts), where=str(drive.path)
        )
    return left


def friction_events(friction: FrictionSource, signals: Signals) -> list[Event]:
    """Return when an estimated friction was observable."""
    from pdhef_logtool.evaluation.segments import find_intervals

    intervals = find_intervals(signals, {"friction observable": friction.observable})
    return [Event(s.name, s.start_ns, s.end_ns, "the estimate of friction can be relied on") for s in intervals]


def report_facts(
    drive: Drive,
    car: Car,
    estimators: Sequence[EstimatorFacts],
    rows: Sequence[MetricRow],
    events: Sequence[Event],
    losses: Sequence[Loss],
    samples: dict[str, int] | None = None,
    ledger: Sequence[SampleCount] | None = None,
) -> ReportFacts:
    """Gather what report.json states of one log; ``samples`` by source, ``ledger``: None is what the drive has read."""
    plan, log = drive.plan, drive.log
    samples = drive.samples if samples is None else samples
    mapping = plan.mapping
    mapped = set(mapping.topics)
    return ReportFacts(
        log=LogFacts(
            name=drive.name,
            file=drive.file,
            kind=log.kind,
            sha256=drive.sha256,
            signals_sha256=drive.signals_sha256,
            truth_sha256=drive.truth_sha256,
            start_ns=plan.start_ns,
            end_ns=plan.end_ns,
            topics=[
                TopicFacts(t.name, t.type_name, t.encoding, t.messages, mapped=t.name in mapped) for t in log.topics
            ],
        ),
        signals=[SourceFacts(n, s.label, SIGNAL_UNITS[n], samples.get(s.label, 0)) for n, s in mapping.signals.items()],
        missing_signals=list(drive.missing),
        vehicle_name=car.vehicle.name,
        vehicle_sha256=car.physics_sha256,
        vehicle_file=car.file_name,
        vehicle_proven=car.has_evidence,
        vehicle_taught=None if car.taught is None else car.taught.truth,
        sensors=car.vehicle.sensors.model_dump(),
        assumed=drive.car.assumed,
        setup={"source": drive.setup_source, "decided_s": plan.decided_s, "causal_from_s": drive.causal_from_s},
        low_speed_m_s=car.vehicle.low_speed_blend_m_s,
        estimators=list(estimators),
        truth=TruthFacts(
            quantities=[
                _truth_quantity(name, how, mapping, samples) for name, how in plan.derivation.items() if name != "cg"
            ],
            latency_s=None if plan.latency is None else plan.truth_latency_s,
            not_independent=sorted(plan.dependent),
            notes=_truth_notes(plan),
        ),
        metrics=rows,
        segments=events,
        losses=losses,
        samples=drive.sample_ledger if ledger is None else ledger,
        warnings=drive.notes,
        remarks=drive.remarks,
        checks=drive.checks,
        versions=run_versions(),
    )


def _truth_notes(plan: DrivePlan) -> list[str]:
    """Return remarks on the ground truth: its latency, what it depends on, and its position."""
    notes = []
    if (latency := plan.latency) is not None:
        std = f" ± {latency.std_error_s * 1e3:.1f} ms"
        measured = f"{latency.latency_s * 1e3:.1f} ms{std}" if latency.reliable else "unknown"
        verdict = "applied" if plan.truth_latency_s else "not applied: it is within its uncertainty"
        if latency.gyro_delay_s:
            verdict = "so that the ground truth is not moved"
        notes.append(f"latency {measured} ({latency.reason}), {verdict}")
    notes += [f"{signal} is not independent: {reason}" for signal, reason in plan.dependent.items()]
    if "cg" in plan.derivation:
        notes.append(plan.derivation["cg"])
    if plan.truth is not None and not plan.has_truth_pose:
        notes.append("no true position: the drawn ground truth trajectory is its velocity dead-reckoned")
    return notes


def friction_facts(friction: FrictionSource) -> FrictionFacts:
    """Return what the report states of a run's friction, after the run."""
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


def log_place(stem: str) -> str:
    """Return the folder of a log within the outputs."""
    return f"{LOGS}/{stem}"


def check_places(
    inputs: Sequence[LogInput],
    output: Path | None,
    config: RunConfig,
    mapping: Mapping | None,
    junit: Path | None,
    cars: Sequence[Path | None] = (),
) -> None:
    """Refuse to write over what is read; raises UsageError."""
    can = () if mapping is None else mapping.dbc
    files = [] if output is None else [output / name for name in (METRICS_FILE, RUN_FILE, PAGE_FILE)]
    folders = [] if output is None else [output / log_place(i.stem) for i in inputs]
    files += [folder / name for folder in folders for name in LOG_FILES]
    check_no_input(
        [*(i.local for i in inputs), *config.files, *cars, *can], files if junit is None else [*files, junit], folders
    )


def write_run(
    output: Path, config: dict[str, Any], result: LogResult, verdicts: PlanVerdicts, car: Car | None = None
) -> None:
    """Write metrics.parquet and run.json of a run of one log, with the configuration as JSON-able values."""
    from pdhef_logtool.results.parquet_sink import write_metrics

    used = None if car is None else car.network
    network = None if used is None or car is None else {"name": Path(car.network_name).name, "sha256": used.sha256}
    write_metrics(output / METRICS_FILE, result.rows)
    files = {METRICS_FILE: file_sha256(output / METRICS_FILE)}
    write_json(
        output / RUN_FILE, build_run(run_versions(), config, network, [result.outcome], files=files, plan=verdicts)
    )
