"""``pdhef extract``: read logs, compute residuals, split by drive, and write a residual dataset."""

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.car.car import VEHICLE_FILE, Car
from pdhef_logtool.car.model import ESTIMATED
from pdhef_logtool.car.parts import physics_sha256
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.drive.correlation import GAP_PERIODS as TRUTH_GAP_PERIODS
from pdhef_logtool.drive.plan import DrivePlan
from pdhef_logtool.drive.reading import Drive, Tell, friction_of, logs_of, no_samples, read_drive
from pdhef_logtool.drive.truth import derive_truth
from pdhef_logtool.estimators.parallel_physics import filter_of
from pdhef_logtool.estimators.reference.inputs import white_noise
from pdhef_logtool.estimators.table import FEATURES, FILTERS
from pdhef_logtool.estimators.vehicle_ukf import VehicleUkf
from pdhef_logtool.evaluation.smoothing import median_step_ns
from pdhef_logtool.evaluation.statistics import gathered
from pdhef_logtool.learning.drives import DriveRecord, drives_document, exit_code, record_of, set_manifest, tell_drive
from pdhef_logtool.learning.network import dataset, residuals
from pdhef_logtool.learning.truth import TruthAt, teaching_reference
from pdhef_logtool.logs.discovery import LogInput, Logs, as_taken, hash_log, identity_of, with_free_stem
from pdhef_logtool.mapping import Mapping as SignalMapping, mapping_of
from pdhef_logtool.mapping.recognition import PERFECT_PREFIX
from pdhef_logtool.model.drive_model import DriveModel, read_driving
from pdhef_logtool.model.fit import fit_car
from pdhef_logtool.records.errors import EstimatorError, OutputError, PdhefError, UsageError
from pdhef_logtool.records.reporter import SILENT, Reporter
from pdhef_logtool.records.signals import S_PER_NS, Loss
from pdhef_logtool.residual_model.bundle import MODELS, NO_MODEL, PHYSICS_MODEL
from pdhef_logtool.results.condition import parse_condition
from pdhef_logtool.results.run_report import tool_versions
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import FleetProgress
from pdhef_logtool.runs.working import log_identity
from pdhef_logtool.storage.documents import digest
from pdhef_logtool.storage.files import writing
from pdhef_logtool.storage.outputs import OutputFolder, check_no_input, local_path
from pdhef_logtool.workers.supervisor import supervise

#: Upper bounds of train and validation in [0, 1); the rest is test.
SPLIT_ENDS = (0.70, 0.85)
#: Entries of the noise of the ground truth's derivatives.
_NOISES = ("vy_dot_m_s2", "yaw_acceleration_rad_s2")

Progress = Callable[[str, float], None]


@dataclass(frozen=True, slots=True)
class ExtractSettings:
    """Settings that determine, together with the logs, the content of a dataset.

    Attributes
    ----------
    config : vehicle, mapping, slice, sensors, friction, truth channel; the other entries are not used.
    split : split of all drives; None = the split in a set's manifest, else 70/15/15 by a hash of the content.
    model : filter of the residuals, one of :data:`~.bundle.MODELS`.
    where : condition on :data:`~.dataset.COLUMNS` of a row for its use in training.
    """

    config: RunConfig
    split: str | None = None
    model: str = PHYSICS_MODEL
    where: str | None = None

    def name_of(self, log: str) -> str:
        """Return the name of a log's slice in the dataset."""
        start, end = self.config.start, self.config.end
        if start is None and end is None:
            return log
        # Times of day contain colons, which some file systems reject in file names.
        return f"{log}.{start or 0}-{'' if end is None else end}".replace(":", "")

    def to_dict(self) -> dict[str, Any]:
        """Return the settings as JSON-able values; files by name only."""
        config = self.config.to_dict()
        used = ("car", "mapping", "start", "end", "sensors", "prefer_truth")
        return {
            **{k: config[k] for k in used},
            **{k: config[k] for k in ("friction", "reference", "gnss") if config[k] != "auto"},
            **{k: getattr(self, k) for k in ("split", "model", "where")},
        }


@dataclass(frozen=True, slots=True)
class DriveResult:
    """Result of one log: its entry in the manifest, None if excluded. ``kept``: written by an earlier command."""

    record: DriveRecord
    entry: dict[str, Any] | None
    kept: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class ExtractResult:
    """Result of the command: the manifest, and one result per log."""

    output: Path
    manifest: dict[str, Any]
    results: tuple[DriveResult, ...]

    @property
    def records(self) -> tuple[DriveRecord, ...]:
        """Records of all logs."""
        return tuple(r.record for r in self.results)

    @property
    def exit_code(self) -> int:
        """0 for success, 3 if input was lost or some logs gave no drive, 1 if no log gave one."""
        return exit_code(self.records)

    def to_dict(self) -> dict[str, Any]:
        """Return the result as one JSON-able document."""
        return {
            "output": str(self.output),
            "exit_code": self.exit_code,
            "kept": [r.record.name for r in self.results if r.kept],
            **drives_document(self.records),
            "manifest": self.manifest,
        }


@dataclass(frozen=True, slots=True)
class _Job:
    """Input of a process for the extraction of one drive."""

    log_input: LogInput
    output: Path
    settings: ExtractSettings
    car: Car
    mapping: SignalMapping | None
    listed_split: str | None
    resume: bool

    @property
    def physics(self) -> tuple[str, VehicleParameters]:
        """Digest and parameters of the vehicle behind the residuals."""
        car = self.car
        vehicle = car.physics_vehicle if self.settings.model == PHYSICS_MODEL else car.vehicle
        return physics_sha256(vehicle), vehicle


def extract(
    arguments: Logs,
    output: Path | str,
    settings: ExtractSettings,
    *,
    jobs: int = 1,
    resume: bool = False,
    reporter: Reporter = SILENT,
) -> ExtractResult:
    """Write the residual dataset of logs with ground truth to a folder.

    A log that cannot be read or has no ground truth is reported and never stops the others.

    Parameters
    ----------
    arguments : logs, folders, glob patterns. jobs : number of processes; the output does not depend on it.
    resume : keep drives with unchanged log and settings.

    Raises
    ------
    UsageError, VehicleError, MappingError
        An error that concerns all logs.
    PdhefError
        The only log cannot be used.
    """
    output = local_path(output)
    _check(settings)
    before = _earlier(output, settings)
    inputs = [_with_own_name(i, before, reporter.warn) for i in logs_of(arguments, settings.config.read_options)]
    work = _plan_jobs(inputs, output, settings, resume, reporter.warn)
    names = {settings.name_of(i.stem) for i in inputs}
    read = [*(i.local for i in inputs), *settings.config.files, *(j.car.source for j in work)]
    check_no_input(read, [output / dataset.MANIFEST])
    kept = [d for d in before.get("drives", []) if d["name"] not in names]
    vehicles = {v["sha256"]: v for v in before.get("vehicles", [])}
    for job in work:
        sha, vehicle = job.physics
        vehicles[sha] = {"name": vehicle.name, "sha256": sha, "parameters": vehicle.model_dump(mode="json")}
    write = partial(_write, output, settings, kept, vehicles, reporter.warn)
    folders = {
        dataset.split_folder(s) for s in (*dataset.SPLITS, settings.split, *(job.listed_split for job in work)) if s
    }
    with OutputFolder(output, sorted(folders)):
        # Until the new manifest is written, the old one must not name files that may change.
        if kept:
            write([])
        else:
            with writing(output):
                (output / dataset.MANIFEST).unlink(missing_ok=True)
        results = _extract_all(work, jobs, reporter)
        manifest = write(results)
        with writing(output):
            dataset.remove_unnamed(output, manifest)
    empty = [s for s in dataset.SPLITS if not manifest["splits"][s]["drives"]]
    if empty and manifest["drives"] and settings.split is None:
        reporter.warn(f"no drive is in {' and '.join(empty)}: with few drives choose with --split")
    return ExtractResult(output, manifest, results)


def _write(
    output: Path,
    settings: ExtractSettings,
    kept: Sequence[dict[str, Any]],
    vehicles: Mapping[str, Any],
    warn: Tell,
    results: Sequence[DriveResult],
) -> dict[str, Any]:
    """Write the manifest of the results and of the ``kept`` entries of earlier calls; return it.

    Of drives with equal signals, it contains the first new one by name: they could be both in training and in test.
    """
    made = sorted(((r.entry, r.record) for r in results if r.entry is not None), key=lambda m: str(m[0]["name"]))
    first: dict[str, dict[str, Any]] = {}
    for entry in (*(entry for entry, _ in made), *kept):
        first.setdefault(entry["signals_sha256"], entry)
    copies = []
    for entry, record in made:
        other = first[entry["signals_sha256"]]["name"]
        if other != entry["name"]:
            warn(f"{record.name} is left out: it contains the same signals as {other}")
            copies.append({"log": record.name, "file": record.file, "of": other})
    entries = [*first.values()]
    _check_apart(entries)
    left_out = [r.record for r in results if r.record.left_out]
    failed = [{"log": r.name, "file": r.file, "reason": r.left_out} for r in left_out]
    return dataset.write_manifest(
        output, entries, failed, settings=settings.to_dict(), vehicles=vehicles, duplicates=copies
    )


def _check_apart(entries: Sequence[Mapping[str, Any]]) -> None:
    """Raise UsageError if overlapping slices of one log are in different splits: training data would be in the test."""
    for same in gathered(((e["log"], e["source"]["sha256"]), e) for e in entries).values():
        same.sort(key=lambda e: float(e["start_s"]))
        for earlier, other in pairwise(same):
            if earlier["split"] != other["split"] and other["start_s"] < earlier["end_s"]:
                raise UsageError(
                    expected="slices of a log that do not overlap across splits",
                    got=f"{earlier['name']} ({earlier['split']}) and {other['name']} ({other['split']})",
                    where="extract",
                    remedy="choose other slices with --start and --end, or another folder with -o",
                )


def _earlier(output: Path, settings: ExtractSettings) -> Mapping[str, Any]:
    """Return the manifest of the dataset to extend; empty for a new dataset.

    Raises
    ------
    UsageError
        The folder contains another manifest, or a dataset of another filter.
    """
    if not (output / dataset.MANIFEST).exists():
        return {}
    try:
        return dataset.read_dataset(output, settings.model).manifest
    except OutputError as error:
        expected = f"a new folder, or a residual dataset for {settings.model}"
        remedy = "choose another folder with -o"
        raise UsageError(expected=expected, got=error.got, where=output, remedy=remedy) from None


def _with_own_name(log: LogInput, before: Mapping[str, Any], warn: Tell) -> LogInput:
    """Return a log with another name if the dataset contains another log of its name."""
    contents = {as_taken(d["log"]): d["source"]["sha256"] for d in before.get("drives", ())}
    content = log_identity(log) if as_taken(log.stem) in contents else None
    if content is None or contents[as_taken(log.stem)] == content:
        return log
    names = (d["log"] for d in before["drives"] if d["source"] == {"file": log.path.name, "sha256": content})
    log = replace(log, stem=next(names, with_free_stem(log, contents).stem))
    warn(f"{log.path.name}: the dataset contains another log of this name; this one is {log.stem}")
    return log


def _check(settings: ExtractSettings) -> None:
    for option, value, allowed in (("--split", settings.split, dataset.SPLITS), ("--filter", settings.model, MODELS)):
        if value is not None and value not in allowed:
            raise UsageError(expected=f"one of {', '.join(allowed)}", got=repr(value), where=option)
    if settings.where is not None:
        parse_condition(settings.where, dataset.COLUMNS, of_tracks=False)


def _plan_jobs(
    inputs: Sequence[LogInput], output: Path, settings: ExtractSettings, resume: bool, warn: Tell
) -> list[_Job]:
    cars, manifests = cache(partial(Car.load, network=NO_MODEL)), cache(set_manifest)
    mapping, listed = mapping_of(settings.config.mapping), [_listed(i, manifests(i.folder)) for i in inputs]
    if settings.config.car is None and any(vehicle is None for _, vehicle in listed):
        warn(f"no --car: residuals refer to the default {cars(None).vehicle.name}")
    return [
        _Job(log_input, output, settings, cars(settings.config.car or vehicle), mapping, split, resume)
        for log_input, (split, vehicle) in zip(inputs, listed, strict=True)
    ]


def _extract_all(work: Sequence[_Job], jobs: int, reporter: Reporter) -> tuple[DriveResult, ...]:
    """Return the result of each job; a crashed process loses only its own drive, a full disk ends the command."""
    results: dict[int, DriveResult] = {}
    progress, preload = FleetProgress(reporter.progress, len(work)), (__name__, *FILTERS)
    ends = supervise(
        _extract_guarded, work, jobs=min(jobs, len(work)), preload=preload, progress=progress.update, warn=reporter.warn
    )
    with closing(ends):
        for ended in ends:
            result = ended.result or _failure(ended.item, ended.failure.reason if ended.failure else "")
            if isinstance(result, PdhefError):
                if len(work) == 1 or (isinstance(result, OutputError) and result.ends_run):
                    raise result
                result = _failure(ended.item, str(result))
            results[ended.number] = result
            tell_drive(result.record, reporter.warn)
            progress.end(ended.number)
    return tuple(results[number] for number in range(len(work)))


def _extract_guarded(job: _Job, progress: Progress) -> DriveResult | PdhefError:
    """Extract a drive, or return its error."""
    try:
        return _extract(job, progress)
    except PdhefError as error:
        return error
    except MemoryError:
        raise  # another process may have caused it: repeated alone
    except Exception as error:  # noqa: BLE001 (no error in one log may stop the others)
        return _failure(job, f"internal error, {type(error).__name__}: {error}")


def _failure(job: _Job, reason: str) -> DriveResult:
    return DriveResult(DriveRecord(job.log_input.stem, job.log_input.path.name, left_out=reason), None)


def _extract(job: _Job, progress: Progress) -> DriveResult:
    settings, source = job.settings, identity_of(job.log_input)
    split, split_from = choose_split(source, chosen=settings.split, listed=job.listed_split)
    fingerprint, (sha, vehicle) = _fingerprint(job, split), job.physics
    name = settings.name_of(job.log_input.stem)
    identity = {"name": name, "split": split, "car": vehicle.name, "vehicle_sha256": sha}
    target = dataset.drive_file(job.output, identity)
    if job.resume and (kept := _kept(job, target, source, split, fingerprint)) is not None:
        return kept
    with read_drive(job.log_input, job.car, job.mapping, settings.config.read_options) as drive:
        plan = drive.plan
        if plan.truth is not None:  # a bridged gap is accurate enough for scoring, but not for derivatives
            gaps = {n: gap * residuals.GAP_PERIODS / TRUTH_GAP_PERIODS for n, gap in plan.truth.max_gap_s.items()}
            drive.plan = plan = replace(plan, truth=replace(plan.truth, max_gap_s=gaps))
        reference, _ = teaching_reference(drive, settings.config)
        _check_plan(plan, job, estimated=reference is not None)
        truth = _truth_facts(plan, estimated=reference is not None)
        model, calibration = _in_service(drive, job)
        physics = filter_of(model.car.calibrated_car, settings.model, use_speed=drive.options.use_speed)
        drive.friction = friction_of(plan, physics.vehicle, drive.options, of_truth=True)
        rows = _residuals(drive, physics, truth, model, reference)
        if not len(rows):
            raise no_samples(job.log_input.path)
        if settings.where is not None:
            columns = dict(zip(dataset.COLUMNS, [*rows.features.T, *rows.truth_velocity.T], strict=True))
            condition = parse_condition(settings.where, dataset.COLUMNS, of_tracks=False)
            rows = replace(rows, chosen=condition.is_true(columns))
        progress(job.log_input.stem, 1.0)
        start_s, end_s = ((int(stamp) - drive.log.start_ns) * S_PER_NS for stamp in rows.stamps_ns[[0, -1]])
        entry: dict[str, Any] = {
            **identity,
            "log": job.log_input.stem,
            "source": {"file": job.log_input.path.name, "sha256": source},
            "signals_sha256": drive.recorded().signals_sha256,
            "split_from": split_from,
            "settings_sha256": fingerprint,
            "mapping_sha256": drive.mapping.sha256,
            "calibration": calibration,
            "period_s": plan.alignment.grid_period_s,
            "start_s": start_s,
            "end_s": end_s,
            "duration_s": float(rows.stamps_ns[-1] - rows.stamps_ns[0]) * S_PER_NS,
            "rows": len(rows),
            "usable_rows": int(np.count_nonzero(rows.training_weight)),
            "truth": truth,
            "friction_from": drive.friction.label,
            "losses": [asdict(x) for x in drive.losses],
        }
        dataset.write_drive(target, rows, entry, truth_source=truth["kind"])
        if not entry["usable_rows"]:
            drive.tell("not one usable target: no ground truth above the low-speed limit")
        record = replace(record_of(drive), split=split, seconds=entry["duration_s"])
    return DriveResult(record, entry)


def _in_service(drive: Drive, job: _Job) -> tuple[DriveModel, str]:
    """Return the model of a run on this drive, and its calibration: a taught car is calibrated on each drive."""
    car = job.car
    if car.model is None or job.settings.model != PHYSICS_MODEL:
        return DriveModel.of(drive), ""
    calibration = fit_car(read_driving(drive), car.vehicle, car.taught_prior)
    return DriveModel.of(drive, calibration), calibration.text


def _kept(job: _Job, target: Path, source: str, split: str, fingerprint: str) -> DriveResult | None:
    """Return the drive written by an earlier command; None if its log or settings have changed."""
    entry, name = dataset.read_entry(target) or {}, job.log_input.path.name
    stated = entry.get("settings_sha256"), entry.get("source")
    if stated != (fingerprint, {"file": name, "sha256": source}):
        return None
    losses = tuple(Loss(**x) for x in entry["losses"])
    record = DriveRecord(job.log_input.stem, name, source, split, entry["duration_s"], losses=losses)
    return DriveResult(record, entry, kept=True)


def _residuals(
    drive: Drive, physics: VehicleUkf, facts: Mapping[str, Any], model: DriveModel, reference: TruthAt | None
) -> residuals.ResidualRows:
    """Return the residuals of a drive; ``facts`` on its ground truth."""
    whole = drive.whole()
    truth = whole.truth if reference is None else reference(whole.signals.stamps_ns)
    assert truth is not None, "the plan of the drive derives it"
    period_s, noise = drive.plan.alignment.grid_period_s, facts["difference_noise"]["vy_dot_m_s2"] or 0.0
    return residuals.residual_rows(
        model.apply(whole.signals).calibrated if physics.equations == "forces" else whole.signals,
        truth,
        physics,
        period_s=period_s,
        half_window=round(facts["smoothing_half_s"] / period_s),
        truth_std_m_s=noise * period_s / math.sqrt(2.0),  # of v_y itself
    )


def choose_split(source_sha256: str, *, chosen: str | None = None, listed: str | None = None) -> tuple[str, str]:
    """Return a drive's split and its source: option, a set's manifest, or a hash of the content.

    The hash does not depend on other drives, names or order, so that copies of a drive are in the same split.
    """
    if chosen is not None:
        return chosen, "option"
    if listed is not None:
        return listed, "manifest"
    drawn = hashlib.sha256(f"0:{source_sha256}".encode()).digest()
    place = int.from_bytes(drawn[:8], "big") / 2.0**64
    return dataset.SPLITS[sum(place >= end for end in SPLIT_ENDS)], "hash"


def _listed(log: LogInput, manifest: Mapping[str, Mapping[str, Any]]) -> tuple[str | None, Path | None]:
    """Return split and vehicle file of a log from the manifest of its simulated set."""
    entry = manifest.get(log.path.name, {})
    split, vehicle = entry.get("split"), entry.get("vehicle_file", entry.get("vehicle"))
    car = log.folder / vehicle if log.folder is not None and isinstance(vehicle, str) else None
    exists = car is not None and (car.is_file() or (car / VEHICLE_FILE).is_file())
    return split if isinstance(split, str) and split else None, car if exists else None


def _check_plan(plan: DrivePlan, job: _Job, *, estimated: bool = False) -> None:
    needed = {"vx_m_s", "vy_m_s", "yaw_rate_rad_s"}
    if not estimated and (plan.truth is None or not needed <= plan.derivation.keys()):
        expected = "ground truth from which v_x, v_y and yaw rate follow"
        got = ", ".join(sorted(needed & plan.derivation.keys())) or "none"
        remedy = "map v_y, sideslip, or position and heading of an RTK, INS or motion-capture reference"
    elif missing := sorted(FEATURES - plan.alignment.available):
        expected, got = "the signals of the physics filter", f"no {', '.join(missing)}"
        remedy = "map the missing signals (pdhef inspect LOG --write-mapping mapping.toml)"
    else:
        return
    raise EstimatorError(expected=expected, got=got, where=job.log_input.path, remedy=remedy)


def _truth_facts(plan: DrivePlan, *, estimated: bool = False) -> dict[str, Any]:
    """Return the entry on the ground truth: by the survey, whether its one-step differences need smoothing."""
    topics = {s.topic for s in plan.mapping.truth.values()}
    perfect = bool(topics) and all(t.startswith(PERFECT_PREFIX) for t in topics)
    truth = derive_truth(plan.survey_truth, plan=plan.truth).track
    per_white = math.sqrt(2.0) / (median_step_ns(truth.stamps_ns) * S_PER_NS) ** 1.5  # of one-step differences
    noise = [per_white * white_noise(truth.stamps_ns, c, 0.0) for c in (truth.vy_m_s, truth.yaw_rate_rad_s)]
    within = all(n <= limit for n, limit in zip(noise, residuals.NEGLIGIBLE_NOISE, strict=True))  # False for NaN
    return {
        "kind": ESTIMATED if estimated else "perfect" if perfect else "recorded",
        "quantities": dict(plan.derivation),
        "latency_s": plan.truth_latency_s,
        "smoothing_half_s": 0.0 if within else residuals.SMOOTHING_HALF_S,
        "difference_noise": {n: x if math.isfinite(x) else None for n, x in zip(_NOISES, noise, strict=True)},
        "not_independent": dict(plan.dependent),
    }


def _fingerprint(job: _Job, split: str) -> str:
    """Return the hash of all inputs of a drive's file except the log."""
    mapping = job.settings.config.mapping
    document = {
        "format": dataset.FORMAT_VERSION,
        "settings": {k: v for k, v in job.settings.to_dict().items() if k not in ("split", "car", "mapping")},
        "split": split,
        "vehicle": [job.physics[0], {name: noise.model_dump(mode="json") for name, noise in job.car.noise.items()}],
        "model": None if job.car.model is None else digest(job.car.model.model_dump(mode="json")),
        **({} if job.log_input.span_s is None else {"span_s": job.log_input.span_s}),
        "mapping": None if mapping is None else hash_log(Path(mapping)),
        "versions": tool_versions(),
    }
    return digest(document)
