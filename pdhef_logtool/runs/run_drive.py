"""One log from start to end: read, estimate, score, judge, write. Several logs: :mod:`~.fleet`."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any

from pdhef_logtool.car.car import SHOWN_DIGITS, Car
from pdhef_logtool.car.parts import PHYSICS, Algorithm
from pdhef_logtool.drive.reading import Drive, lost_texts, read_drive
from pdhef_logtool.estimators.base import notes_of
from pdhef_logtool.estimators.causality_check import CausalityCheck
from pdhef_logtool.estimators.plug_ins import package_of
from pdhef_logtool.estimators.presets import uses_calibration
from pdhef_logtool.evaluation.dead_reckoned import path_drift
from pdhef_logtool.evaluation.largest_errors import largest_errors
from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.evaluation.operating_space import operating_space
from pdhef_logtool.evaluation.reasons import Interval, sensor_fault, sensor_faults
from pdhef_logtool.evaluation.requirement_blocks import requirement_blocks
from pdhef_logtool.evaluation.statistics import day_and_route
from pdhef_logtool.evaluation.validation_plan import SIDESLIP, ValidationPlan
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.mapping import Mapping as SignalMapping, merge_losses
from pdhef_logtool.records.errors import EstimatorError
from pdhef_logtool.records.printable import printable
from pdhef_logtool.records.processes import release_memory
from pdhef_logtool.records.reporter import SILENT, Reporter
from pdhef_logtool.records.signals import S_PER_NS, Loss
from pdhef_logtool.records.tracks import REFERENCE, StateTrack
from pdhef_logtool.results.no_position import without_names
from pdhef_logtool.results.run_report import LogOutcome, build_report, estimator_entry, run_versions
from pdhef_logtool.results.selected_estimate import MainFacts
from pdhef_logtool.results.tables import drive_part
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.drive_outputs import STALE_FILES, DriveOutputs, files_of, log_place
from pdhef_logtool.runs.estimating import Estimated, Evaluation, PreparedDrive, estimate_drive, evaluate, prepare
from pdhef_logtool.runs.judging import judge_drive
from pdhef_logtool.runs.referencing import audit_truth
from pdhef_logtool.runs.run_result import LogResult
from pdhef_logtool.runs.selection import choose_main, contradiction
from pdhef_logtool.storage.documents import digest
from pdhef_logtool.storage.outputs import OutputFolder
from pdhef_logtool.storage.templates import lines, template

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
            blocks = requirement_blocks([*validation.requirements, SIDESLIP], main.name, scored.drive)
            space = operating_space(estimated.signals, estimated.truth, estimated.tracks[main.name], run.car.vehicle)
            judged = judge_drive(validation, drive, main.name, scored.rows, blocks, space)
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
            release_memory(len(estimated.signals))
            files.write(report, scored.rows, scored.events)
        all_silent = len(scored.silent) == len(run.estimators)
        outcome = outcome_of(
            drive,
            losses,
            neutral=config.no_position,
            car=car_entry(drive.car),
            main=main.name,
            algorithms={name: algorithm.identity for name, algorithm in estimated.algorithms.items()},
            files=files_of(change.target),
            failed_checks=sum(c.verdict == "failed" and not c.waived for c in drive.checks),
            failed=_ALL_SILENT.format("; ".join(dict.fromkeys(scored.silent.values()))) if all_silent else None,
        )
    reporter.progress(drive.name, 1.0)
    part = drive_part(outcome, report, scored.rows, judged["plan"])
    return LogResult(outcome, change.target, report, tuple(scored.rows), part)


def _estimate(run: PreparedDrive, causality: CausalityCheck, reporter: Reporter) -> tuple[PreparedDrive, Estimated]:
    """Run all estimators over the drive; raises EstimatorError if none has a result."""
    drive, plug_ins = run.drive, ", ".join(filter(None, map(package_of, run.estimators)))
    label = f"{drive.name} (plug-ins: {plug_ins})" if plug_ins else drive.name
    causality.failed |= run.failed
    whole = drive.whole()
    release_memory(len(whole.signals))
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
    release_memory(len(estimated.signals))
    truth, reference = estimated.truth, estimated.tracks.get(REFERENCE)
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


#: Entries of a log's metadata that a report keeps, and signs of each.
_MOST_METADATA, _MOST_SIGNS = 64, 200
_OF_CHECK = ("name", "verdict", "evidence", "remedy", "waived")


def report_drive(
    run: PreparedDrive,
    estimated: Estimated,
    scored: Evaluation,
    stated: dict[str, Any],
    losses: Sequence[Loss],
    selected: str | None,
    main: MainFacts | None = None,
) -> dict[str, Any]:
    """Return the document of report.json.

    Parameters
    ----------
    stated : further entries, of :func:`~.judging.judge_drive` or in place of others. selected : the estimate whose
        errors are located; None: of several recorded ones none. main : the same as a choice; None: it was recorded.
    """
    drive, config, truth, track = run.drive, run.config, estimated.truth, estimated.tracks.get(selected or "")
    preferred = dict.fromkeys((REFERENCE, PHYSICS, *run.names))
    others = [t for n in preferred if n != selected and (t := estimated.tracks.get(n)) is not None]
    slow = run.car.vehicle.low_speed_blend_m_s
    content = _drive_entries(drive, run.car, scored.rows, losses) | {
        "estimators": [*_estimator_entries(run, estimated.algorithms)],
        "metrics": scored.rows,
        "segments": scored.events,
        "friction": run.model.friction.to_dict(),
        "self_calibration": None if run.model.posterior is None else run.model.posterior.to_dict(),
        "reference": None if run.reference is None else run.reference.document,
        "largest_errors": [] if track is None else largest_errors(track, truth, others, slow),
        "faults": _faults(run, selected, estimated.tracks),
        "path_drift": None if truth is None or track is None else path_drift(estimated.posed(track), truth),
        "metadata": {} if config.no_position else _metadata(drive),
        **stated,
    }
    report = build_report(content, main)
    return without_names(report, drive.path, drive.name) if config.no_position else report


def _estimator_entries(run: PreparedDrive, algorithms: Mapping[str, Algorithm]) -> Iterator[dict[str, Any]]:
    """Yield the entries of the estimators that ran, failed or were skipped."""
    not_causal = run.drive.not_causal
    for e in run.estimators:
        algorithm, calibration = algorithms[e.name], run.car.self_calibrated if uses_calibration(e.name) else None
        yield estimator_entry(
            e.name,
            causal=e.causal and not not_causal,
            notes=(*notes_of(e), *filter(None, [calibration and calibration.note, not_causal])),
            intervals=run.intervals.notes(e.name),
            algorithm={"sha256": algorithm.sha256, **algorithm.model_dump(mode="json", exclude={"noise", "use_speed"})},
        )
    for name, reason in run.failed.items():
        yield estimator_entry(name, causal=False, outcome="failed", reason=reason)
    for s in run.skipped:
        if not s.is_error:
            yield estimator_entry(s.name, causal=s.spec.causal, outcome="skipped", reason=s.reason)


def _faults(run: PreparedDrive, selected: str | None, tracks: Mapping[str, StateTrack]) -> list[dict[str, Any]] | None:
    """Return the changes of the sensors, and the faults that the selected estimate detects, or else physics.

    None without changes where neither detects any.
    """
    detected = (sensor_faults(tracks[name]) for name in dict.fromkeys((selected or "", PHYSICS)) if name in tracks)
    faults = next((faults for faults in detected if faults is not None), None)
    of_drive = run.drive.recorded().changes
    changes = [sensor_fault(c.sensor, c.kind, [Interval(c.start_ns, c.end_ns)]) for c in of_drive]
    return [*changes, *(faults or ())] if changes or faults is not None else None


def _metadata(drive: Drive) -> dict[str, str]:
    """Return the log's metadata by key, and by ``record.key`` where records differ, as far as it is short."""
    texts = drive.log.metadata()
    texts = {k: v for k, v in texts.items() if k.partition(".")[2] not in texts or texts[k.partition(".")[2]] != v}
    short = {printable(k, _MOST_SIGNS): v for k, v in sorted(texts.items()) if len(v) <= _MOST_SIGNS}
    return {k: printable(v) for k, v in [*short.items()][:_MOST_METADATA]}


def _drive_entries(drive: Drive, car: Car, rows: Sequence[MetricRow], losses: Sequence[Loss]) -> dict[str, Any]:
    """Return the entries on log, car and ground truth; ``car`` : as calibrated on the drive."""
    plan, sources = drive.plan, drive.plan.mapping.truth
    derivation = {name: how for name, how in plan.derivation.items() if name != "cg"}
    return {
        "log": {
            "name": drive.name,
            "file": PurePath(drive.path.name).name,
            "kind": drive.log.kind,
            "sha256": drive.sha256,
            "start_ns": plan.start_ns,
            "end_ns": plan.end_ns,
            "duration_s": (plan.end_ns - plan.start_ns) * S_PER_NS,
        },
        "mapping": {"missing": drive.chosen.missing},
        "vehicle": {
            "name": car.vehicle.name,
            "sha256": car.physics_sha256,
            "file": car.file_name,
            "proven": car.has_evidence,
            "taught": (car.model and car.model.truth) or None,
            "assumed": {entry.entry: entry.value for entry in drive.car.assumed},
            "low_speed_blend_m_s": car.vehicle.low_speed_blend_m_s,
        },
        "truth": {
            "available": bool(derivation),
            "quantities": {n: sources[n].label if n in sources and not how else how for n, how in derivation.items()},
            "latency_s": None if plan.latency is None else plan.truth_latency_s,
            "not_independent": sorted({row.signal for row in rows if not row.independent}),
            "notes": lines(template(Path(__file__).with_name("templates") / "truth_notes.txt").render(p=plan)),
        },
        "model": {
            "source": "log" if drive.earlier is None else "file",
            "decided_s": plan.decided_s,
            "causal_from_s": drive.causal_from_s,
        },
        "losses": losses,
        "ledger": {"samples": drive.recorded().ledger},
        "warnings": drive.notes,
        "remarks": drive.remarks,
        "checks": [{k: getattr(c, k) for k in _OF_CHECK} for c in drive.checks],
        "versions": run_versions(),
    }


def car_entry(car: Car) -> dict[str, Any]:
    """Return the car of a log in run.json.

    It has its folder or file (None: none was given), vehicle, digests of physics and network, and the entries of its
    sensor profile that differ from the default.
    """
    return {
        "file": car.file_name,
        "name": car.vehicle.name,
        "sha256": car.physics_sha256,
        "network_sha256": None if car.network is None else car.network.sha256,
        "sensors": car.vehicle.sensors.model_dump(exclude_defaults=True),
    }


def outcome_of(drive: Drive, losses: Sequence[Loss], *, neutral: bool = False, **changes: Any) -> LogOutcome:
    """Return the record of a log in run.json; ``neutral``: without names and metadata of its file."""
    day, route = day_and_route(drive.plan.start_ns, drive.log.metadata())
    texts: dict[str, Any] = {"file": drive.path.name, "lost": lost_texts(losses)}
    if neutral:
        texts, route = without_names(texts, drive.path, drive.name), route and digest(route)[:SHOWN_DIGITS]
    texts |= {key: getattr(drive.recorded(), key) for key in ("signals_sha256", "truth_sha256")}
    return LogOutcome(
        drive.name, sha256=drive.sha256, mapping_sha256=drive.mapping.sha256, day=day, route=route, **texts, **changes
    )
