"""The content of report.json of a drive, and its entry in run.json."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import PurePath
from typing import Any

from pdhef_logtool.car.car import SHOWN_DIGITS, Car
from pdhef_logtool.car.parts import PHYSICS
from pdhef_logtool.drive.plan import DrivePlan
from pdhef_logtool.drive.reading import Drive, lost_texts
from pdhef_logtool.estimators.algorithm import resolve
from pdhef_logtool.estimators.base import notes_of
from pdhef_logtool.estimators.presets import calibration_of
from pdhef_logtool.evaluation.dead_reckoned import path_drift
from pdhef_logtool.evaluation.largest_errors import largest_errors
from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.evaluation.reasons import Interval, SensorFault, sensor_faults
from pdhef_logtool.evaluation.statistics import day_and_route
from pdhef_logtool.records.printable import printable
from pdhef_logtool.records.signals import Loss
from pdhef_logtool.records.tracks import REFERENCE, StateTrack
from pdhef_logtool.results.no_position import without_names
from pdhef_logtool.results.run_report import LogOutcome, build_report, estimator_entry, run_versions
from pdhef_logtool.results.selected_estimate import MainFacts
from pdhef_logtool.runs.estimating import Estimated
from pdhef_logtool.runs.preparing import PreparedDrive
from pdhef_logtool.runs.scoring import Evaluation
from pdhef_logtool.storage.documents import digest

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
    others = [t for n in preferred if n != selected and (t := estimated.read(n)) is not None]
    slow = run.car.vehicle.low_speed_blend_m_s
    content = _drive_entries(drive, run.car, scored.rows, losses) | {
        "estimators": [*_estimator_entries(run)],
        "metrics": scored.rows,
        "segments": scored.events,
        "friction": run.model.friction.to_dict(),
        "self_calibration": None if run.model.posterior is None else run.model.posterior.to_dict(),
        "reference": None if run.reference is None else run.reference.document,
        "largest_errors": [] if track is None else largest_errors(track, truth, others, slow),
        "faults": _faults(run, selected, estimated.read),
        "path_drift": None if truth is None or track is None else path_drift(track, truth),
        "metadata": {} if config.no_position else _metadata(drive),
        **stated,
    }
    report = build_report(content, main)
    return without_names(report, drive.path, drive.name) if config.no_position else report


def _estimator_entries(run: PreparedDrive) -> Iterator[dict[str, Any]]:
    """Yield the entries of the estimators that ran, failed or were skipped."""
    not_causal = run.drive.not_causal
    for e in run.estimators:
        algorithm, calibration = resolve(e), calibration_of(e.name, run.car)
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


def _faults(
    run: PreparedDrive, selected: str | None, read: Callable[[str], StateTrack | None]
) -> tuple[SensorFault, ...] | None:
    """Return the changes of the sensors, and the faults that the selected estimate detects, or else physics.

    None without changes where neither detects any.
    """
    tracks = [read(name) for name in dict.fromkeys((selected, PHYSICS)) if name in run.names]
    detected = (sensor_faults(track) for track in tracks if track is not None)
    faults = next((faults for faults in detected if faults is not None), None)
    changes = tuple(
        SensorFault(c.sensor, c.kind, 1, (c.end_ns - c.start_ns) * 1e-9, (Interval(c.start_ns, c.end_ns),))
        for c in run.drive.recorded().changes
    )
    return (*changes, *(faults or ())) if changes or faults is not None else None


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
            "file": PurePath(drive.file).name,
            "kind": drive.log.kind,
            "sha256": drive.sha256,
            "start_ns": plan.start_ns,
            "end_ns": plan.end_ns,
            "duration_s": (plan.end_ns - plan.start_ns) * 1e-9,
        },
        "mapping": {"missing": drive.missing},
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
            "notes": _truth_notes(plan),
        },
        "model": {
            "source": "log" if drive.earlier is None else "file",
            "decided_s": plan.decided_s,
            "causal_from_s": drive.causal_from_s,
        },
        "losses": losses,
        "ledger": {"samples": drive.sample_ledger},
        "warnings": drive.notes,
        "remarks": drive.remarks,
        "checks": [{k: getattr(c, k) for k in _OF_CHECK} for c in drive.checks],
        "versions": run_versions(),
    }


def _truth_notes(plan: DrivePlan) -> list[str]:
    """Return remarks on the ground truth: its latency, its dependence on signals, and its position."""
    notes = []
    if (latency := plan.latency) is not None:
        std = f" ± {latency.std_error_s * 1e3:.1f} ms"
        measured = f"{latency.latency_s * 1e3:.1f} ms{std}" if latency.reliable else "unknown"
        verdict = "applied" if plan.truth_latency_s else "not applied: it is within its uncertainty"
        if latency.gyro_delay_s:
            verdict = "so that the ground truth is not moved"
        notes.append(f"latency {measured} ({latency.reason}), {verdict}")
    elif plan.truth is not None:
        notes.append("no gyro, or no true yaw rate, to measure the latency with: taken as 0")
    notes += [f"{signal} is not independent: {reason}" for signal, reason in plan.dependent.items()]
    if "cg" in plan.derivation:
        notes.append(plan.derivation["cg"])
    if plan.truth is not None and not plan.has_truth_pose:
        notes.append("no true position: the drawn ground truth trajectory is its velocity dead-reckoned")
    return notes


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
    texts: dict[str, Any] = {"file": drive.file, "lost": lost_texts(losses)}
    if neutral:
        texts, route = without_names(texts, drive.path, drive.name), route and digest(route)[:SHOWN_DIGITS]
    return LogOutcome(
        log=drive.name,
        sha256=drive.sha256,
        signals_sha256=drive.signals_sha256,
        truth_sha256=drive.truth_sha256,
        mapping_sha256=drive.mapping.sha256,
        day=day,
        route=route,
        **texts,
        **changes,
    )
