"""One log from start to end: read, estimate, score, judge, write. Several logs: :mod:`~.fleet`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from pdhef_logtool.car.car import SHOWN_DIGITS, Car
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.estimators.algorithm import resolve
from pdhef_logtool.estimators.causality_check import CausalityCheck
from pdhef_logtool.estimators.plug_ins import package_of
from pdhef_logtool.evaluation.operating_space import operating_space
from pdhef_logtool.evaluation.validation_plan import SIDESLIP, ValidationPlan
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.mapping import Mapping as SignalMapping
from pdhef_logtool.mapping import merge_losses
from pdhef_logtool.records.errors import EstimatorError
from pdhef_logtool.records.reporter import SILENT, Reporter
from pdhef_logtool.records.signals import Loss
from pdhef_logtool.records.tracks import REFERENCE
from pdhef_logtool.results.selected_estimate import MainFacts
from pdhef_logtool.results.tables import drive_part
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.drive_outputs import STALE_FILES, DriveOutputs, files_of, log_place
from pdhef_logtool.runs.drive_report import car_entry, outcome_of, report_drive
from pdhef_logtool.runs.estimating import Estimated, estimate_drive
from pdhef_logtool.runs.judging import drive_blocks, judge_drive
from pdhef_logtool.runs.preparing import PreparedDrive, prepare
from pdhef_logtool.runs.reference_audit import audit_truth
from pdhef_logtool.runs.run_result import LogResult
from pdhef_logtool.runs.scoring import Evaluation, evaluate
from pdhef_logtool.runs.selection import choose_main, contradiction
from pdhef_logtool.storage.outputs import OutputFolder

_SILENT = "{} has no valid row although the car moves: {}"
_ALL_SILENT = "no estimator has a valid row although the car moves: {}"
_NEVER_MOVES = "the car is never faster than {:g} m/s: there is nothing to score"


def run_log(
    log_input: LogInput,
    outputs: OutputFolder,
    config: RunConfig,
    car: Car,
    mapping: SignalMapping | None,
    *,
    validation: ValidationPlan,
    is_first: bool = True,
    reporter: Reporter = SILENT,
) -> LogResult:
    """Run one log and replace its folder ``logs/<stem>`` of the outputs.

    Parameters
    ----------
    validation : plan of the verdicts in the report.
    is_first : whether it is the run's first log; its estimators get the full causality check.

    Raises
    ------
    PdhefError
        The log cannot be used; its files of an earlier run are kept.
    """
    reporter.progress(log_input.stem, 0.0)
    with read_drive(log_input, car, mapping, config.read_options, tell=reporter.warn) as drive:
        run = prepare(drive, config)
        with outputs.begin(log_place(drive.name), stale=STALE_FILES) as change:
            run, estimated = _estimate(run, CausalityCheck(is_first), reporter)
            scored = _score(run, estimated)
            named = run.config.estimators is not None
            main = choose_main(run.names, scored.rows, proven=drive.car.has_evidence, named=named)
            judged = _judge(run, estimated, scored, main, validation)
            files = DriveOutputs((change, outputs.path), run, estimated, main)
            with files.annotated() as annotated:
                if annotated is not None:
                    annotated.write(files.tracks)
                failed = [Loss("estimator-failed", f"{name} {text}", drive.name) for name, text in run.failed.items()]
                silent = [Loss("no-valid-row", _SILENT.format(*why), drive.name) for why in scored.silent.items()]
                losses = merge_losses([drive.losses, silent, failed])
                report = report_drive(run, estimated, scored, judged, losses, main.name, main)
                if annotated is not None:
                    annotated.finish(report, files.tracks, scored.events)
            files.write(report, scored.rows, scored.events)
        all_silent = len(scored.silent) == len(run.estimators)
        outcome = outcome_of(
            drive,
            losses,
            neutral=config.no_position,
            car=car_entry(drive.car),
            main=main.name,
            algorithms={e.name: resolve(e).identity for e in run.estimators},
            files=files_of(change.target),
            failed=_ALL_SILENT.format("; ".join(dict.fromkeys(scored.silent.values()))) if all_silent else None,
        )
        failed_checks = sum(c.verdict == "failed" and not c.waived for c in drive.checks)
    reporter.progress(drive.name, 1.0)
    part = drive_part(outcome, report, scored.rows, judged["plan"])
    return LogResult(outcome, change.target, report, tuple(scored.rows), failed_checks, part)


def _estimate(run: PreparedDrive, causality: CausalityCheck, reporter: Reporter) -> tuple[PreparedDrive, Estimated]:
    """Run all estimators over the drive; raises EstimatorError if none has a result."""
    drive, plug_ins = run.drive, ", ".join(filter(None, map(package_of, run.estimators)))
    label = f"{drive.name} (plug-ins: {plug_ins})" if plug_ins else drive.name
    causality.failed |= run.failed
    whole = drive.whole()
    estimated = estimate_drive(
        whole,
        run.model.apply(whole.signals),
        run.estimators,
        intervals=run.intervals,
        causality=causality,
        progress=lambda share: reporter.progress(label, 0.8 * share),
    )
    reporter.progress(drive.name, 0.8)
    texts = [f"{name} {text}" for name, text in causality.failed.items()]
    for text in texts:
        drive.tell(text)
    left = [e for e in run.estimators if e.name not in causality.failed]
    if not left:
        raise EstimatorError(
            expected="an estimator that runs as it declares", got="; ".join(texts), where=str(drive.path)
        )
    return replace(run, estimators=left, failed=causality.failed), estimated


def _score(run: PreparedDrive, estimated: Estimated) -> Evaluation:
    """Score the tracks; add contradictions as notes of the drive."""
    drive = run.drive
    scored = evaluate(drive, estimated, run.model)
    digests = {e.name: resolve(e).sha256[:SHOWN_DIGITS] for e in run.estimators}
    scored = replace(scored, rows=[replace(r, algorithm=digests.get(r.estimator, "")) for r in scored.rows])
    truth, reference = estimated.truth, estimated.read(REFERENCE)
    if truth is not None and reference is not None and run.reference is not None:
        contradictions = audit_truth(truth, reference, drive.car.vehicle.low_speed_blend_m_s)
        run.reference.document["ground_truth"] = list(contradictions)
        for text in contradictions:
            drive.tell(text)
    if against := contradiction(scored.rows):
        drive.notes.append(f"WARNING: {against.text}")  # the text of the selected estimate gives the consequence
    if not scored.moves:
        drive.tell(_NEVER_MOVES.format(run.car.vehicle.low_speed_blend_m_s))
    return scored


def _judge(
    run: PreparedDrive, estimated: Estimated, scored: Evaluation, main: MainFacts, plan: ValidationPlan
) -> dict[str, Any]:
    """Return the entries of the report on the requirements of a plan."""
    drive, vehicle, truth = run.drive, run.car.vehicle, estimated.truth
    blocks = drive_blocks([*plan.requirements, SIDESLIP], main.name, scored.drive)
    space = operating_space(estimated.signals, truth, estimated.read(main.name), vehicle)
    return judge_drive(plan, drive, main.name, scored.rows, blocks, space)
