"""``pdhef retrain``: fine-tune the network of a car, find its residual gain and intervals, and compare by a gate.

The result of each stage is in ``work/`` of the output and is used again for the same inputs. Each stage has drives of
its own (``assignment.py``). The candidate is written to ``accepted/`` or ``rejected/`` with the reasons.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.store import update_car
from pdhef_logtool.drive.cached import read_cached
from pdhef_logtool.drive.reading import Tell
from pdhef_logtool.estimators.table import FILTERS
from pdhef_logtool.learning.drives import (
    DriveRecord,
    LearnSettings,
    drives_document,
    exit_code,
    no_true_sideslip,
    open_car,
    open_mapping,
    record_head,
    record_of,
    set_manifest,
    tell_drive,
)
from pdhef_logtool.learning.evidence.calibrate import MIN_DRIVES
from pdhef_logtool.learning.network.dataset import MANIFEST
from pdhef_logtool.learning.network.extract_command import ExtractSettings, extract
from pdhef_logtool.learning.resume import Stages, read_own
from pdhef_logtool.learning.retrain.assignment import (
    GATE,
    INTERVALS,
    LEAST,
    SHARES,
    STOP,
    TRAIN,
    TRUST,
    Candidate,
    deal,
)
from pdhef_logtool.learning.score import paired_test, score_slices
from pdhef_logtool.learning.split import Split
from pdhef_logtool.learning.stages.gain import find_gain
from pdhef_logtool.learning.stages.intervals import fit_intervals
from pdhef_logtool.learning.stages.network import GENTLY
from pdhef_logtool.learning.stages.task import StageOutput, Task
from pdhef_logtool.logs.discovery import LogInput, Logs, find_logs, hash_log, identity_of
from pdhef_logtool.mapping import Mapping as SignalMapping
from pdhef_logtool.records.errors import EXIT_GATE, EstimatorError, OutputError, PdhefError
from pdhef_logtool.records.reporter import SILENT, Reporter
from pdhef_logtool.residual_model.bundle import NO_MODEL, open_model
from pdhef_logtool.residual_model.torch_extra import check_torch
from pdhef_logtool.results.opened_run import MAX_DOCUMENT_BYTES
from pdhef_logtool.results.run_report import json_bytes
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.storage.documents import digest, read_sealed, seal
from pdhef_logtool.storage.files import write_bytes, writing
from pdhef_logtool.storage.outputs import FolderTransaction, OutputFolder, check_no_input
from pdhef_logtool.workers.supervisor import supervise

FORMAT, FORMAT_VERSION = "pdhef-retrain", 1
#: In the output: stages, candidates that may take the car's place, and those that may not.
WORK, ACCEPTED, REJECTED = "work", "accepted", "rejected"
#: In the folder of a candidate, and in work/.
RECORD_FILE, CAR_FOLDER, ROLES_FILE, SEEN_FILE = "retrain.json", "car", "roles.json", "seen.json"
#: The estimator that follows the network, and those whose intervals are fitted.
HYBRID = "pd-hef"
CALIBRATED = (HYBRID, "pd-hef-smoothed", "physics")
#: Digits of a network's hash that name its folder.
_NAME = 12

Progress = Callable[[str, float], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class RetrainSettings:
    """Settings of a retraining, beside the logs.

    Attributes
    ----------
    config : car, mapping, slice, sensors, truth channel. seed : of the split assignment, training and bootstraps.
    init : network to start from, a bundle or ``none``; None = the car's, else a new one.
    epochs : of training; None = the recipe's. strict : reject unless the lower error is confirmed.
    """

    config: RunConfig
    seed: int = 0
    init: Path | None = None
    epochs: int | None = None
    strict: bool = False

    def __post_init__(self) -> None:
        """Check the seed; raises UsageError."""
        LearnSettings(config=self.config, seed=self.seed)


@dataclass(frozen=True, slots=True, eq=False)
class RetrainResult:
    """What came of it: the folder of the candidate, its record, and a record of every drive."""

    folder: Path
    records: tuple[DriveRecord, ...]
    document: dict[str, Any]

    @property
    def accepted(self) -> bool:
        """Whether the candidate may take the car's place."""
        return bool(self.document["accepted"])

    @property
    def exit_code(self) -> int:
        """4 if the candidate is rejected; else as every command that learns of drives."""
        return exit_code(self.records) if self.accepted else EXIT_GATE

    def to_dict(self) -> dict[str, Any]:
        """Return the result as one JSON-able document."""
        drives = drives_document(self.records)
        return {"folder": str(self.folder), "exit_code": self.exit_code, **self.document, **drives}


@dataclass(frozen=True, slots=True, eq=False)
class _Retraining:
    """One call: its settings, the car, the drives by split, and the hash of each log by its stem."""

    settings: RetrainSettings
    car: Car
    car_sha256: str | None
    drives: Mapping[str, tuple[LogInput, ...]]
    hashes: Mapping[str, str]
    work: Path
    stages: Stages
    jobs: int
    warn: Tell

    @property
    def start(self) -> Path:
        """The network to begin with, as a bundle is named."""
        car_network = self.car.residual_network is not None and self.car.network_folder
        return self.settings.init or car_network or Path(NO_MODEL)

    def config_for(self, car: Path | None, network: Path | None = None) -> RunConfig:
        return replace(self.settings.config, car=car, network=network, intervals=None, estimators=None)

    def basis(self, *rests_on: Any, role: str = "") -> list[Any]:
        """Return the inputs of a stage: the settings of all, the drives of a split, and others."""
        config = self.settings.config
        mapping = None if config.mapping is None else hash_log(config.mapping)
        head = record_head(FORMAT, FORMAT_VERSION, LearnSettings(config=config, seed=self.settings.seed), self.car)
        return [
            head,
            mapping,
            self.car_sha256,
            sorted(self.hashes[i.stem] for i in self.drives.get(role, ())),
            *rests_on,
        ]

    def do(self, number: int, name: str, basis: list[Any], work: Callable[[Path], dict[str, Any]]) -> dict[str, Any]:
        return self.stages.do(number, name, basis, number / 6.0, work)

    def step(self, number: int, text: str, share: float) -> None:
        self.stages.reporter.progress(text, (number + share) / 6.0)


def retrain(
    arguments: Logs,
    output: Path,
    settings: RetrainSettings,
    *,
    jobs: int = 1,
    reporter: Reporter = SILENT,
) -> RetrainResult:
    """Fine-tune the network of a car on logs with ground truth, and compare the car with it to the car as it is.

    Parameters
    ----------
    arguments : logs, folders, glob patterns. jobs : processes that read and extract; changes nothing that is written.
    reporter : its notes are the stages, each with its duration.

    Raises
    ------
    UsageError
        An option is wrong, or no car is named.
    EstimatorError
        There are too few drives with ground truth.
    PdhefError
        A stage fails.
    """
    check_torch()
    config = settings.config
    car = open_car(config, reporter.warn)
    inputs = find_logs(arguments, private_redirects=config.allow_private_redirects)
    read = [*(i.local for i in inputs), *config.files]
    check_no_input(read, [], [output / name for name in (WORK, ACCEPTED, REJECTED)])
    work = output / WORK
    with OutputFolder(output, (WORK, ACCEPTED, REJECTED)):
        with writing(work):
            work.mkdir(exist_ok=True)
        stages = Stages(work, lambda result: str(result["shown"]), reporter)
        hashes = {i.stem: identity_of(i) for i in inputs}
        car_sha256 = None if car.source is None else hash_log(car.source)
        basis = digest([record_head(FORMAT, FORMAT_VERSION, LearnSettings(config=config), car), car_sha256])
        records, signals = _look(inputs, hashes, car, config, work / SEEN_FILE, basis, jobs, reporter)
        records, drives = _roles(inputs, records, signals, car, settings, work)
        shown_texts = set[str]()

        def once(text: str) -> None:
            if text not in shown_texts:
                shown_texts.add(text)
                reporter.warn(text)

        for record in records:
            tell_drive(record, once)
        _check_counts(drives)
        this = _Retraining(settings, car, car_sha256, drives, hashes, work, stages, jobs, once)
        document = _stages(this)
        name = document["network_sha256"][:_NAME]
        judged = {p.name for group in (ACCEPTED, REJECTED) for p in (output / group).glob("*") if p.is_dir()} | {name}
        counts = {role: len(drives[role]) for role in SHARES}
        document = {**document, "drives_by_role": counts, "judged": len(judged)}
        folder = _publish(this, output, name, document)
    reporter.progress("done", 1.0)
    return RetrainResult(folder, tuple(records), document)


# ---- drives ----


@dataclass(frozen=True, slots=True)
class _Log:
    log_input: LogInput
    car: Car
    mapping: SignalMapping | None
    config: RunConfig


@dataclass(frozen=True, slots=True)
class _Seen:
    """Record of a log and hash of its signals; None where it cannot be used."""

    record: DriveRecord
    signals_sha256: str | None


def _read_log(log: _Log, tell: Progress) -> _Seen:
    """Read a log once: hash of its signals, and whether it has ground truth."""
    try:
        with read_cached(log.log_input, log.car, log.mapping, log.config.read_options) as drive:
            if left_out := no_true_sideslip(drive.plan):
                return _Seen(record_of(drive, left_out=left_out), None)
            first, last = math.inf, -math.inf
            for window in drive.windows(fill_friction=False):
                if len(stamps := window.signals.stamps_ns):
                    first, last = min(first, float(stamps[0])), max(last, float(stamps[-1]))
                tell(log.log_input.stem, window.share_done)
            span = tuple((t - drive.log.start_ns) * 1e-9 for t in (first, last))
            record = replace(record_of(drive), seconds=span[1] - span[0], span_s=(span[0], span[1]))
            return _Seen(record, drive.signals_sha256)
    except PdhefError as error:
        return _Seen(_unread(log.log_input, str(error)), None)


def _unread(log_input: LogInput, reason: str) -> DriveRecord:
    return DriveRecord(log_input.stem, log_input.path.name, left_out=reason)


def _look(  # positional: what reading takes, where it is remembered, and how it is done
    inputs: Sequence[LogInput],
    hashes: Mapping[str, str],
    car: Car,
    config: RunConfig,
    file: Path,
    basis: str,
    jobs: int,
    reporter: Reporter,
) -> tuple[list[DriveRecord], list[str | None]]:
    """Return a record of every log and the hash of its signals; what earlier calls have read is not read again."""
    mapping = open_mapping(config)
    basis = digest([basis, repr(mapping)])
    document = read_own(file, reporter.note)
    log_entries: dict[str, Any] = document["logs"] if document is not None and document["basis"] == basis else {}
    new = [_Log(i, car, mapping, config) for i in inputs if hashes[i.stem] not in log_entries]

    def tell(number: int, text: str, share: float) -> None:
        reporter.progress(f"reading {text}", (number + share) / len(new) / 6.0)

    records = dict[str, DriveRecord]()
    preload = ("pdhef_logtool.drive.reading", *FILTERS)
    for ended in supervise(_read_log, new, jobs=jobs, preload=preload, progress=tell, warn=reporter.note):
        log_input, seen = ended.item.log_input, ended.result
        if seen is None:
            reason = "it could not be read" if ended.failure is None else ended.failure.reason
            seen = _Seen(_unread(log_input, reason), None)
        sha256 = seen.record.sha256 or hashes[log_input.stem]  # of a reduced log: its source's
        records[log_input.stem] = replace(seen.record, sha256=sha256)
        log_entries[hashes[log_input.stem]] = {
            "sha256": sha256,
            "signals_sha256": seen.signals_sha256,
            "left_out": seen.record.left_out,
            "span_s": seen.record.span_s,
        }
    write_bytes(file, json_bytes(seal({"basis": basis, "logs": log_entries})))

    def record(log_input: LogInput) -> DriveRecord:
        entry = log_entries[hashes[log_input.stem]]
        span = None if entry["span_s"] is None else (float(entry["span_s"][0]), float(entry["span_s"][1]))
        again = DriveRecord(
            log_input.stem,
            log_input.path.name,
            entry["sha256"],
            seconds=0.0 if span is None else span[1] - span[0],
            span_s=span,
            left_out=entry["left_out"],
        )
        return records.get(log_input.stem, again)

    return [record(i) for i in inputs], [log_entries[hashes[i.stem]]["signals_sha256"] for i in inputs]


def _roles(
    inputs: Sequence[LogInput],
    records: Sequence[DriveRecord],
    signals: Sequence[str | None],
    car: Car,
    settings: RetrainSettings,
    work: Path,
) -> tuple[list[DriveRecord], dict[str, tuple[LogInput, ...]]]:
    """Return the records with their splits, and the drives by split; copies of a drive are left out."""
    manifests = cache(set_manifest)
    parts = (car.learnt_on, () if car.trust is None else car.trust.drives)
    taught = {d.sha256 for part in parts for d in part} | (
        set() if car.intervals is None else {d.sha256 for d in car.intervals.drives}
    )
    first: dict[str, str] = {}
    candidates = []
    for log_input, record, key in zip(inputs, records, signals, strict=True):
        if key is not None and first.setdefault(key, log_input.stem) == log_input.stem:
            split = str(manifests(log_input.folder).get(log_input.path.name, {}).get("split") or "")
            candidates.append(Candidate(key, split, record.sha256 in taught))
    before: dict[str, str] = {}
    if (file := work / ROLES_FILE).exists():
        remedy = "restore it; without it, splits are assigned again by content and seed"
        kept = read_sealed(file, "the split assignment", OutputError, remedy, MAX_DOCUMENT_BYTES)
        before = {key: role for key, role in kept["roles"].items() if role in SHARES}
    roles = deal(candidates, before, settings.seed)
    write_bytes(work / ROLES_FILE, json_bytes(seal({"roles": roles})))
    split_records = list[DriveRecord]()
    drives: dict[str, list[LogInput]] = {role: [] for role in SHARES}
    for log_input, record, key in zip(inputs, records, signals, strict=True):
        if key is None:
            split_records.append(record)
        elif first[key] != log_input.stem:
            split_records.append(replace(record, notes=(f"left out, its signals equal those of {first[key]}",)))
        else:
            split_records.append(replace(record, split=roles[key]))
            drives[roles[key]].append(log_input)
    return split_records, {role: tuple(logs) for role, logs in drives.items()}


def _check_counts(drives: Mapping[str, Sequence[LogInput]]) -> None:
    short = [
        f"{role} has {len(drives[role])}" for role in (TRAIN, STOP, TRUST, GATE) if len(drives[role]) < LEAST[role]
    ]
    if short:
        wanted = ", ".join(f"{LEAST[role]} for {role}" for role in (TRAIN, STOP, TRUST, GATE))
        raise EstimatorError(
            expected=f"drives with ground truth for every split of a retraining: at least {wanted}",
            got=", ".join(short),
            where="retrain",
            remedy="give more drives with ground truth; those of a set keep its splits",
        )


# ---- stages ----


def _stages(this: _Retraining) -> dict[str, Any]:
    """Do all stages; return the record of the candidate."""
    both = [sorted(this.hashes[i.stem] for i in this.drives[role]) for role in (TRAIN, STOP)]
    dataset = this.do(1, "extract", this.basis(both), lambda _: _extract(this))
    start = None if str(this.start) == NO_MODEL else open_model(this.start)
    init = None if start is None else start.sha256
    basis = this.basis(dataset["sha256"], init, this.settings.epochs)
    model = this.do(2, "train", basis, lambda folder: _train(this, folder, digest(basis)))
    network = this.stages.place(2, "train") / "model"
    basis = this.basis(model["sha256"], role=TRUST)
    trusted = this.do(3, "trust", basis, lambda folder: _trust(this, folder, network))
    basis = this.basis(digest(basis), role=INTERVALS)
    intervals = this.do(4, "intervals", basis, lambda folder: _intervals(this, folder))
    rests_on = [digest(basis), this.settings.strict]
    judged = this.do(5, "gate", this.basis(*rests_on, role=GATE), lambda _: _judge(this, trusted))
    return {
        **record_head(FORMAT, FORMAT_VERSION, LearnSettings(config=this.settings.config), this.car),
        "accepted": judged["accepted"],
        "reasons": judged["reasons"],
        "network_sha256": model["sha256"],
        "fine_tuned_from": init,
        **{k: dataset[k] for k in ("cells", "splits")},
        "dataset_sha256": dataset["sha256"],
        "training": model,
        "trust": trusted,
        "intervals": intervals,
        "gate": judged["gate"],
    }


def _extract(this: _Retraining) -> dict[str, Any]:
    """Extract the residuals of the drives that train and stop; what is there of others goes."""
    folder = this.work / "dataset"
    with writing(folder):
        (folder / MANIFEST).unlink(missing_ok=True)
    splits = {i.stem: role for role in (TRAIN, STOP) for i in this.drives[role]}
    inputs = sorted((i for role in (TRAIN, STOP) for i in this.drives[role]), key=lambda i: i.stem)
    settings = ExtractSettings(this.config_for(this.settings.config.car), seed=this.settings.seed)
    result = extract(
        inputs,
        folder,
        settings,
        jobs=this.jobs,
        resume=True,
        splits=splits,
        reporter=Reporter(lambda text, share: this.step(1, text, share), this.warn),
    )
    manifest = result.manifest
    rows = {split: manifest["splits"][split]["usable_rows"] for split in (TRAIN, STOP)}
    empty = len(manifest["cells"]["empty"][TRAIN])
    return {
        "shown": f"{rows[TRAIN]} rows to train on, {rows[STOP]} to stop by; {empty} cells of driving are empty",
        **{k: manifest[k] for k in ("sha256", "cells", "splits")},
    }


def _train(this: _Retraining, folder: Path, basis: str) -> dict[str, Any]:
    """Train; what an interrupted call has left goes on, if it was of the same basis."""
    from pdhef_logtool.learning.network.train_command import dataset_for, make_recipe, train_on
    from pdhef_logtool.residual_model.bundle import PHYSICS_MODEL

    training, mark = this.work / "training", "basis"
    with writing(training):
        if training.is_dir() and not ((training / mark).is_file() and (training / mark).read_text() == basis):
            shutil.rmtree(training)
    write_bytes(training / mark, basis.encode())
    init = None if str(this.start) == NO_MODEL else open_model(this.start)
    recipe = make_recipe(paper=False, seed=this.settings.seed, epochs=None, device="cpu")
    recipe = recipe if init is None else replace(recipe, **GENTLY)
    if this.settings.epochs is not None:
        recipe = replace(recipe, epochs=this.settings.epochs)
    if not (this.work / "dataset" / MANIFEST).is_file():
        _extract(this)  # somebody has tidied up
    data = dataset_for(this.work / "dataset", PHYSICS_MODEL)
    trained = train_on(data, training, recipe, init=init, progress=lambda text, share: this.step(2, text, share))
    with writing(training):
        (training / mark).unlink()
        shutil.move(training, folder / "model")
    loss = trained.bundle.provenance["validation_loss"]
    return {
        "shown": f"{len(trained.history)} epochs, validation {loss:.4f}",
        "sha256": trained.bundle.sha256,
        "provenance": trained.bundle.provenance,
    }


def _stage(
    this: _Retraining, number: int, role: str, folder: Path, config: RunConfig, run: Callable[[Task], StageOutput]
) -> StageOutput:
    """Run a stage of ``learn`` on the drives of a split and write its car to a folder."""
    car = Car.load(config.car, network=config.network)
    task = Task(
        car=car,
        settings=LearnSettings(config=config, seed=this.settings.seed, any_split=True),
        split=Split.undivided(this.drives[role]),
        mapping=open_mapping(config),
        estimators=config.estimators,
        reporter=Reporter(lambda text, share: this.step(number, text, share)),
    )
    output = run(task)
    update_car(car, folder / CAR_FOLDER, output.change)
    return output


def _trust(this: _Retraining, folder: Path, network: Path) -> dict[str, Any]:
    config = this.config_for(this.settings.config.car, network)
    figures = _stage(this, 3, TRUST, folder, config, find_gain).figures
    cap = figures["trust_cap"]
    shown = f"residual gain {cap:g}: {figures['reason']}"
    return {"shown": shown, "cap": cap, "evidence": figures["evidence"]}


def _intervals(this: _Retraining, folder: Path) -> dict[str, Any]:
    """Calibrate the intervals of the candidate, or leave it as it is where there are too few drives for that."""
    before, drives = this.stages.place(3, "trust") / CAR_FOLDER, this.drives[INTERVALS]
    if len(drives) < MIN_DRIVES:
        shutil.copytree(before, folder / CAR_FOLDER)
        return {"shown": f"not fitted: {len(drives)} drives, {MIN_DRIVES} are needed", "coverage": {}}
    config = replace(this.config_for(before), estimators=CALIBRATED)
    output = _stage(this, 4, INTERVALS, folder, config, fit_intervals)
    return {"shown": output.text, **output.figures}


def _car(folder: Path | None) -> Car:
    return Car.load(folder)


def _judge(this: _Retraining, trusted: Mapping[str, Any]) -> dict[str, Any]:
    """Compare car and candidate on the drives of the gate, as ``learn`` judges a stage."""
    candidate = this.stages.place(4, "intervals") / CAR_FOLDER
    settings, errors = this.settings, []
    for number, folder in enumerate((settings.config.car, candidate)):
        this.step(5, "scoring the drives of the gate", 0.5 * number)
        options = this.config_for(folder).read_options
        scored = score_slices(_car(folder), (HYBRID,), this.drives[GATE], open_mapping(settings.config), options)
        if HYBRID not in scored.errors:
            raise EstimatorError(expected=f"an estimate of {HYBRID}", got=scored.skipped[HYBRID], where="retrain")
        errors.append(scored.errors[HYBRID])
    test = paired_test(*errors)
    bounds = [math.degrees(x) for x in (test.difference.value, test.difference.low, test.difference.high)]
    interval = f"difference 95 %: {bounds[1]:.4f} to {bounds[2]:.4f}"
    shown = f"{HYBRID} {test.now_deg:.4f}° against {test.was_deg:.4f}° ({interval}, {test.difference.blocks} blocks)"
    reasons = [f"worse: {shown}"] if test.refuted else []
    if settings.strict and not test.confirmed and not test.refuted:
        reasons.append(f"not confirmed: {shown}")
    if not trusted["cap"]:
        reasons.append(f"{trusted['shown']} (on drives that it has not seen)")
    figures = {"text": shown, "before_deg": test.was_deg, "after_deg": test.now_deg, "blocks": test.difference.blocks}
    return {
        "shown": f"rejected: {'; '.join(reasons)}" if reasons else f"accepted: {shown}",
        "accepted": not reasons,
        "reasons": reasons,
        "gate": {**figures, "difference_deg": [x if math.isfinite(x) else None for x in bounds]},
    }


def _publish(this: _Retraining, output: Path, name: str, document: Mapping[str, Any]) -> Path:
    """Put the candidate where its verdict belongs, with its record; return its folder."""
    right, wrong = (ACCEPTED, REJECTED) if document["accepted"] else (REJECTED, ACCEPTED)
    folder, data = output / right / name, json_bytes(dict(document))
    with suppress(OSError):
        if (folder / RECORD_FILE).read_bytes() == data and (folder / CAR_FOLDER).is_dir():
            return folder
    with writing(folder), FolderTransaction(folder, keep=False) as transaction:
        shutil.copytree(this.stages.place(4, "intervals") / CAR_FOLDER, transaction.file(CAR_FOLDER))
        write_bytes(transaction.file(RECORD_FILE), data)
    with writing(folder):
        shutil.rmtree(output / wrong / name, ignore_errors=True)
    return folder
