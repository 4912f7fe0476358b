"""Stage ``gain``: gain limit of a network on a car, with its reason (``network.toml``)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from pdhef_logtool.car.car import NETWORK_FILE, NETWORK_FOLDER, SHOWN_DIGITS, Car
from pdhef_logtool.car.parts import LearntOn, Trust
from pdhef_logtool.car.store import Change
from pdhef_logtool.car.toml_files import part_toml
from pdhef_logtool.drive.reading import Drive, WholeDrive
from pdhef_logtool.estimators.drive_signals import calibrated_signals
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.table import FEATURES, Options, spec_of
from pdhef_logtool.evaluation.metrics import signal_error
from pdhef_logtool.learning.drives import GAIN, DriveRecord, drives_document, load_drive, no_drive, record_head
from pdhef_logtool.learning.evidence.trust import (
    BLOCK_S,
    EXCITED_M_S2,
    LEVEL,
    MIN_BLOCKS,
    MIN_EXCITED_S,
    RESAMPLES,
    TOLERANCE,
    TRUSTS,
    UNCONFIRMED_CAP,
    BlockErrors,
    TrustDecision,
    block_errors,
    decide_cap,
    join_blocks,
)
from pdhef_logtool.learning.stages.task import StageOutput, Task
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.signals import BoolArray
from pdhef_logtool.residual_model.bundle import SHIPPED_FOLDERS
from pdhef_logtool.residual_model.service import NetworkService, RememberingNetwork
from pdhef_logtool.results.run_report import json_bytes

FORMAT = "pdhef-trust"
FORMAT_VERSION = 2
#: Minimum number of scored stamps of a drive.
MIN_SCORED_STAMPS = 100
#: Tolerance of the overlap of slices; adjacent slices may share a sample or two.
EDGE_S = 0.05


def find_gain(task: Task) -> StageOutput:
    """Run the filter at several residual gains on the drives; return the limit with its evidence.

    Raises
    ------
    UsageError
        The car has no network.
    EstimatorError
        No drive can be scored.
    """
    car = task.car
    if car.network is None or car.residual_network is None:
        got = "none" if car.network is None else f"one for {car.network.model}"
        raise UsageError(expected="a network", got=got, where="--network", remedy="give a folder of pdhef train")

    def lacking(drive: Drive) -> str:
        missing = sorted(FEATURES - drive.available)
        return f"pd-hef needs {', '.join(missing)}" if missing else ""

    def read(log: LogInput) -> tuple[DriveRecord, BlockErrors | None]:
        record, drive = load_drive(log, car, task.mapping, task.options, refuse=lacking, least_scored=MIN_SCORED_STAMPS)
        return record, None if drive is None else errors_by_trust(car, drive, use_speed=task.options.use_speed)

    records, scored = task.read(read)
    drives = tuple(r for r in records if not r.left_out)
    if not drives:
        raise no_drive("a true sideslip and the signals of pd-hef", GAIN)
    for text in seen_by_identification(car, drives):
        task.reporter.warn(text)
    together = join_blocks(scored)
    if together.lost:
        task.reporter.warn(f"{together.lost} stamps without an estimate at some gain above 0 are counted against it")
    decision = decide_cap(together, seed=task.settings.seed)
    shipped = car.network_name in SHIPPED_FOLDERS
    part = Trust(
        network=car.network_name if shipped else NETWORK_FOLDER,
        network_sha256=car.network.sha256,
        trust_cap=decision.cap,
        evidence=evidence(decision, len(drives), car.network.sha256),
        physics_sha256=car.tried_with[0],
        noise_sha256=car.tried_with[1],
        drives=tuple(d.learnt_on for d in drives),
    )
    figures = _figures(decision, part)
    head = "Written by pdhef learn, stage gain: network of this car, its residual gain limit, and the evidence."
    files = {
        NETWORK_FILE: part_toml(part, head).encode(),
        "network.record.json": json_bytes(_record(task, figures, records, scored)),
    }
    folders = {} if shipped or car.network_folder is None else {NETWORK_FOLDER: car.network_folder}
    change = Change(f"learn --stages {GAIN}", NETWORK_FILE, files, folders, task.settings.to_dict(), part.drives)
    return StageOutput(change, records, f"residual gain {decision.cap:g}: {part.evidence}", figures)


def errors_by_trust(car: Car, drive: WholeDrive, *, use_speed: bool) -> BlockErrors:
    """Return the sideslip errors of ``pd-hef`` on a drive with ground truth at every residual gain, in blocks.

    The true v_x times the gyro's yaw rate is the lateral acceleration that defines excited driving; it contains no
    bank, bias or vibration.
    """
    signals, truth = drive.signals, drive.truth
    assert car.network is not None and truth is not None
    network, slow = car.network.service(), car.vehicle.low_speed_blend_m_s
    if isinstance(network, NetworkService):
        network = RememberingNetwork(network.bundle)
    given, errors = calibrated_signals(signals, car), []
    for share in TRUSTS:
        estimator = spec_of("pd-hef").make(car, Options(use_speed, share, network))
        errors.append(signal_error(run_estimator(estimator, given), truth, "sideslip_rad", slow))
    excited: BoolArray = np.abs(truth.vx_m_s * signals.yaw_rate_rad_s) > EXCITED_M_S2
    return block_errors(np.stack(errors), truth.sideslip_rad, signals.stamps_ns, excited)


def seen_by_identification(car: Car, drives: Sequence[DriveRecord]) -> list[str]:
    """Return a warning for each drive that the car was identified on, as far as the spans overlap."""

    def overlap(a: LearntOn, b: LearntOn) -> bool:
        same = a.sha256 == b.sha256 if a.sha256 and b.sha256 else a.name == b.name
        return same and min(a.end_s, b.end_s) - max(a.start_s, b.start_s) > EDGE_S

    return [
        f"the car was identified on {seen.name}, {seen.start_s:.2f} to {seen.end_s:.2f} s: score another part "
        "(--start, --end)"
        for seen in car.learnt_on
        if any(overlap(seen, d.learnt_on) for d in drives)
    ]


def evidence(decision: TrustDecision, drives: int, network_sha256: str) -> str:
    """Return the sentence for the car file, with its figures."""
    d = decision
    rmse = dict(zip(TRUSTS, d.rmse_deg, strict=True))
    shown = ", ".join(f"{rmse[t]:.3f}° at gain {t:g}" for t in sorted({0.0, 0.5, 1.0, d.cap}))
    gain = d.against_zero[-1]
    bounds = "" if np.isnan(gain.low_deg2) else f" (95 %: {gain.low_deg2:.3g} to {gain.high_deg2:.3g})"
    return (
        f"{d.reason}: {drives} {'drive' if drives == 1 else 'drives'} with ground truth, {d.scored_s:.0f} s scored, "
        f"{d.excited_s:.0f} s of them above {EXCITED_M_S2:g} m/s²; sideslip RMSE {shown}; squared error at 1 less "
        f"that at 0 {gain.value_deg2:.3g}{bounds} deg² over {d.blocks} blocks; network {network_sha256[:SHOWN_DIGITS]}"
    )


def _figures(d: TrustDecision, part: Trust) -> dict[str, Any]:
    return {
        "trust_cap": d.cap,
        "reason": d.reason,
        "evidence": part.evidence,
        "network_sha256": part.network_sha256,
        "trusts": list(TRUSTS),
        "rmse_deg": list(d.rmse_deg),
        "against_trust_0": [_bound(b) for b in d.against_zero],
        "blocks": d.blocks,
        "scored_s": round(d.scored_s, 3),
        "excited_s": round(d.excited_s, 3),
    }


def _bound(bound: Any) -> dict[str, float | None]:
    return {name: None if np.isnan(value) else value for name, value in asdict(bound).items()}


def _record(
    task: Task, figures: dict[str, Any], records: Sequence[DriveRecord], scored: Sequence[BlockErrors]
) -> dict[str, Any]:
    """Return the document of ``network.record.json``, with the errors of each drive."""
    document = drives_document(records)
    for drive, blocks in zip(document["drives"], scored, strict=True):
        drive["rmse_deg"] = [float(np.degrees(np.sqrt(row.sum() / blocks.counts.sum()))) for row in blocks.squares]
    rule = {
        "block_s": BLOCK_S,
        "min_blocks": MIN_BLOCKS,
        "excited_m_s2": EXCITED_M_S2,
        "min_excited_s": MIN_EXCITED_S,
        "tolerance": TOLERANCE,
        "unconfirmed_cap": UNCONFIRMED_CAP,
        "level": LEVEL,
        "resamples": RESAMPLES,
    }
    return {**record_head(FORMAT, FORMAT_VERSION, task.settings, task.car), "rule": rule, **figures, **document}
