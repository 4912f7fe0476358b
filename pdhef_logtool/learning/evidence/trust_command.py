"""``pdhef trust`` from drives with truth to a car that says how far a network may be followed, and why."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.car.car import NETWORK_FILE, NETWORK_FOLDER, SHOWN_DIGITS, Car
from pdhef_logtool.car.parts import LearntOn, Trust
from pdhef_logtool.car.store import Change, update_car
from pdhef_logtool.car.toml_files import part_toml
from pdhef_logtool.drive.reading import Drive, Tell, WholeDrive
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.estimators.table import Options, spec_of
from pdhef_logtool.evaluation.metrics import signal_error
from pdhef_logtool.learning.drives import (
    DriveRecord,
    LearnResult,
    LearnSettings,
    Refusal,
    check_file_output,
    choose_drives,
    drives_document,
    load_drive,
    no_drive,
    open_car,
    open_mapping,
    record_head,
    tell_drive,
)
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
from pdhef_logtool.learning.noise.tune_drives import MIN_SCORED_STAMPS
from pdhef_logtool.logs.discovery import Logs
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.outputs import local_path
from pdhef_logtool.records.signals import BoolArray
from pdhef_logtool.residual_model.bundle import SHIPPED_FOLDERS
from pdhef_logtool.residual_model.service import RememberingNetwork
from pdhef_logtool.sinks.report import json_bytes

FORMAT = "pdhef-trust"
FORMAT_VERSION = 2
#: Splits of a set that a network is trained on and chosen by: it looks better there than in service.
SEEN = ("train", "validation")
#: Two slices that meet share a sample or two.
EDGE_S = 0.05

#: Drives that this command refuses.
REFUSED = Refusal(
    SEEN,
    "drives that no network was trained on",
    "trust",
    "take --split test, or say --any-split if this network has not seen them",
)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class TrustResult(LearnResult):
    """What the command decided and wrote; ``rmse_deg`` holds a row a drive that took part, a column a trust."""

    decision: TrustDecision
    trust: Trust
    rmse_deg: tuple[tuple[float, ...], ...]

    def drives_document(self) -> dict[str, Any]:
        """Return the drives with their errors at each trust, and those left out."""
        document = drives_document(self.records)
        for drive, rmse in zip(document["drives"], self.rmse_deg, strict=True):
            drive["rmse_deg"] = list(rmse)
        return document

    def to_dict(self) -> dict[str, Any]:
        """Return the result as one JSON-able document."""
        d = self.decision
        return {
            **super(TrustResult, self).to_dict(),
            "trust_cap": d.cap,
            "reason": d.reason,
            "evidence": self.trust.evidence,
            "network_sha256": self.trust.network_sha256,
            **_figures(d),
            **self.drives_document(),
        }


def trust(
    arguments: Logs,
    output: Path | str,
    settings: LearnSettings,
    *,
    progress: Callable[[str, float], None] = lambda _text, _share: None,
    warn: Tell = lambda _text: None,
) -> TrustResult:
    """Try a network on drives with truth; write cap, evidence and a record of all figures to the car ``output``.

    Parameters
    ----------
    arguments : logs, folders, glob patterns.

    Raises
    ------
    UsageError
        An option is wrong, or the network was trained on the drives.
    PdhefError
        A file or log cannot be read: an absent drive would change the result unnoticed.
    EstimatorError
        No drive can be scored.
    """
    output = local_path(output)
    config = settings.config
    car = open_car(config, output, warn)
    if car.residual_network is None:
        got = "none" if car.network is None else f"one for {car.network.model}"
        raise UsageError(expected="a network", got=got, where="--network", remedy="give a folder of pdhef train")
    assert car.network is not None
    inputs, splits = choose_drives(arguments, settings, REFUSED)
    check_file_output(inputs, config, output)
    mapping = open_mapping(config)

    def lacking(drive: Drive) -> str:
        missing = sorted(spec_of("pd-hef").needs - drive.available)
        return f"pd-hef needs {', '.join(missing)}" if missing else ""

    loaded: list[DriveRecord] = []
    scored: list[BlockErrors] = []
    for number, log_input in enumerate(inputs):
        progress(log_input.stem, number / len(inputs))
        record, drive = load_drive(
            log_input,
            car,
            mapping,
            config.read_options,
            split=splits.get(log_input.stem),
            refuse=lacking,
            least_scored=MIN_SCORED_STAMPS,
        )
        tell_drive(record, warn)
        loaded.append(record)
        if drive is not None:
            scored.append(errors_by_trust(car, drive, use_speed=config.read_options.use_speed))
    drives = tuple(f for f in loaded if not f.left_out)
    if not drives:
        raise no_drive("a true sideslip and the signals of pd-hef", "trust")
    for text in seen_by_identification(car, drives):
        warn(text)
    together = join_blocks(scored)
    if together.lost:
        warn(f"{together.lost} stamps without an estimate at some trust above 0 are charged to it")
    decision = decide_cap(together, seed=settings.seed)
    shipped = car.network_name in SHIPPED_FOLDERS
    found = Trust(
        network=car.network_name if shipped else NETWORK_FOLDER,
        network_sha256=car.network.sha256,
        trust_cap=decision.cap,
        evidence=evidence(decision, len(drives), car.network.sha256),
        physics_sha256=car.tried_with[0],
        noise_sha256=car.tried_with[1],
        drives=tuple(d.learnt_on for d in drives),
    )
    rmse_deg = tuple(_rmse_deg(b) for b in scored)
    result = TrustResult(car=output, records=tuple(loaded), decision=decision, trust=found, rmse_deg=rmse_deg)
    head = "Written by pdhef trust: which network this car has, how far it is trusted, and why."
    files = {
        NETWORK_FILE: part_toml(found, head).encode(),
        "network.record.json": json_bytes(_record(result, settings, car)),
    }
    folders = {} if shipped or car.network_folder is None else {NETWORK_FOLDER: car.network_folder}
    change = Change("trust", NETWORK_FILE, files, folders, settings.to_dict(), found.drives)
    update_car(car, output, change)
    progress("done", 1.0)
    return result


def errors_by_trust(car: Car, drive: WholeDrive, *, use_speed: bool) -> BlockErrors:
    """Return the sideslip errors of ``pd-hef`` on a drive with truth at every trust, in blocks.

    The truth's v_x times the gyro's yaw rate is the lateral acceleration that decides what counts as excited: no
    bank, bias or vibration is in it.
    """
    signals, truth = drive.signals, drive.truth
    assert car.network is not None and truth is not None
    network, slow = RememberingNetwork(car.network), car.vehicle.low_speed_blend_m_s
    errors = []
    for share in TRUSTS:
        estimator = spec_of("pd-hef").make(car, Options(use_speed, share, network))
        errors.append(signal_error(run_window(estimator, signals)[0], truth, "sideslip_rad", slow))
    excited: BoolArray = np.abs(truth.vx_m_s * signals.yaw_rate_rad_s) > EXCITED_M_S2
    return block_errors(np.stack(errors), truth.sideslip_rad, signals.stamps_ns, excited)


def seen_by_identification(car: Car, drives: Sequence[DriveRecord]) -> list[str]:
    """Return a warning for each drive that the car was identified on, as far as the spans overlap."""

    def overlap(one: LearntOn, other: LearntOn) -> bool:
        same = one.sha256 == other.sha256 if one.sha256 and other.sha256 else one.name == other.name
        return same and min(one.end_s, other.end_s) - max(one.start_s, other.start_s) > EDGE_S

    return [
        f"the car was identified on {seen.name}, {seen.start_s:.2f} to {seen.end_s:.2f} s: score another part "
        "(--start, --end)"
        for seen in car.learnt_on
        if any(overlap(seen, d.learnt_on) for d in drives)
    ]


def evidence(decision: TrustDecision, drives: int, network_sha256: str) -> str:
    """Return the sentence that the car keeps, with its figures."""
    d = decision
    rmse = dict(zip(TRUSTS, d.rmse_deg, strict=True))
    shown = ", ".join(f"{rmse[t]:.3f}° at trust {t:g}" for t in sorted({0.0, 0.5, 1.0, d.cap}))
    gain = d.against_zero[-1]
    bounds = "" if np.isnan(gain.low_deg2) else f" (95 %: {gain.low_deg2:.3g} to {gain.high_deg2:.3g})"
    return (
        f"{d.reason}: {drives} {'drive' if drives == 1 else 'drives'} with truth, {d.scored_s:.0f} s scored, "
        f"{d.excited_s:.0f} s of them above {EXCITED_M_S2:g} m/s²; sideslip RMSE {shown}; squared error at 1 less "
        f"that at 0 {gain.value_deg2:.3g}{bounds} deg² over {d.blocks} blocks; network {network_sha256[:SHOWN_DIGITS]}"
    )


def _rmse_deg(blocks: BlockErrors) -> tuple[float, ...]:
    return tuple(float(np.degrees(np.sqrt(row.sum() / blocks.counts.sum()))) for row in blocks.squares)


def _figures(d: TrustDecision) -> dict[str, Any]:
    return {
        "trusts": list(TRUSTS),
        "rmse_deg": list(d.rmse_deg),
        "against_trust_0": [_bound(b) for b in d.against_zero],
        "best_lower_trust": d.best_lower,
        "trust_1_against_best_lower": _bound(d.against_best),
        "blocks": d.blocks,
        "scored_s": round(d.scored_s, 3),
        "excited_s": round(d.excited_s, 3),
    }


def _bound(bound: Any) -> dict[str, float | None]:
    return {name: None if np.isnan(value) else value for name, value in asdict(bound).items()}


def _record(result: TrustResult, settings: LearnSettings, car: Car) -> dict[str, Any]:
    """Return the document of ``network.record.json``."""
    return {
        **record_head(FORMAT, FORMAT_VERSION, settings, car),
        "rule": {
            "block_s": BLOCK_S,
            "min_blocks": MIN_BLOCKS,
            "excited_m_s2": EXCITED_M_S2,
            "min_excited_s": MIN_EXCITED_S,
            "tolerance": TOLERANCE,
            "unconfirmed_cap": UNCONFIRMED_CAP,
            "level": LEVEL,
            "resamples": RESAMPLES,
        },
        "trust_cap": result.decision.cap,
        "reason": result.decision.reason,
        "evidence": result.trust.evidence,
        **_figures(result.decision),
        **result.drives_document(),
    }
