"""``pdhef learn``: load and split drives, run the stages, undo a stage that raises the error, score once, write.

A stage that runs alone uses all logs. Several stages, or the training of a network, share the logs: each has its part,
and a stage is kept only if it does not raise the error on the validation part. The folder ``learn/NUMBER-NAME/`` of the
car contains the result of each such stage: ``step.json`` with the hash of its inputs and its result, and its car if it
is kept. A rerun takes every stage whose inputs are as they were.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.car.car import NO_INTERVALS, VEHICLE_FILE, Car
from pdhef_logtool.car.parts import PHYSICS
from pdhef_logtool.car.store import Change, check_output, update_car, vehicle_file
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import Tell
from pdhef_logtool.estimators.table import spec_of
from pdhef_logtool.evaluation.bootstrap import Interval
from pdhef_logtool.evaluation.comparison import Compared, Errors, compare
from pdhef_logtool.learning.drives import (
    CALIBRATE,
    GAIN,
    INTERVALS,
    NETWORK,
    NOISE,
    TEACH,
    DriveRecord,
    LearnSettings,
    choose_drives,
    drives_document,
    exit_code,
    load_drive,
    no_drive,
    open_car,
    open_mapping,
    record_head,
)
from pdhef_logtool.learning.more_driving import what_more_would_pay
from pdhef_logtool.learning.page import draw_page, page_markdown
from pdhef_logtool.learning.resume import Stages, read_own
from pdhef_logtool.learning.score import paired_test, score_slices
from pdhef_logtool.learning.split import PARTS, TEST, TRAINED, TRAINING, VALIDATION, DriveTimes, Split, split_drives
from pdhef_logtool.learning.stages.calibrate import calibrate
from pdhef_logtool.learning.stages.gain import find_gain
from pdhef_logtool.learning.stages.intervals import fit_intervals
from pdhef_logtool.learning.stages.network import train_network
from pdhef_logtool.learning.stages.noise import tune
from pdhef_logtool.learning.stages.task import StageOutput, Task
from pdhef_logtool.learning.stages.teach import teach
from pdhef_logtool.logs.discovery import LogInput, Logs, hash_log
from pdhef_logtool.logs.remote_place import LogPlace
from pdhef_logtool.records.errors import EstimatorError, UsageError
from pdhef_logtool.records.reporter import SILENT, Reporter
from pdhef_logtool.records.signals import BoolArray, FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.residual_model.bundle import NO_MODEL
from pdhef_logtool.residual_model.torch_extra import check_torch
from pdhef_logtool.results.run_report import json_bytes
from pdhef_logtool.storage.documents import digest, seal
from pdhef_logtool.storage.files import write_bytes
from pdhef_logtool.storage.outputs import LOCK_FILE, OutputFolder, check_no_input, local_path

FORMAT, FORMAT_VERSION = "pdhef-learn", 2
#: In the car's folder: the stages' results, and the record, page and plot of the whole.
WORK, RECORD_FILE, PAGE_FILE, PLOT_FILE = "learn", "learn.record.json", "learn.md", "learn.png"
CAR, EVALUATIONS_FILE = "car", "evaluations.json"
#: Outcome of a stage.
KEPT, UNDONE, NOT_DONE = "kept", "undone", "not done"
RUN: dict[str, Callable[[Task], StageOutput]] = {
    TEACH: teach,
    CALIBRATE: calibrate,
    NOISE: tune,
    GAIN: find_gain,
    NETWORK: train_network,
    INTERVALS: fit_intervals,
}
#: Stages that are undone where they change nothing, or where the 95 % intervals then contain less than a share of the
#: errors and less than before: simpler is better, and a lower error is not worth a meaningless interval.
MUST_GAIN, LEAST_COVERED = (NOISE, NETWORK), 0.8
#: The noise of a calibrated car suits most cars: another one must be better with significance.
MUST_CONFIRM = (NOISE,)
#: Usable driving below which nothing is left to fit, to validate and to test.
LEAST_S = 50.0
#: Used where the true speed is above this multiple of the low-speed limit, and where the car does not spin or drift.
SPEED_FACTOR, MAX_SIDESLIP_RAD = 2.0, math.radians(8.0)
#: The filter that follows the network, the same smoothed, and the baseline that runs on every vehicle file.
HYBRID, SMOOTHED, BASELINE = "pd-hef", "pd-hef-smoothed", "phy-ukf"
#: Estimators of the stages noise and intervals where several stages share the drives.
ESTIMATORS = {NOISE: (PHYSICS,), INTERVALS: (PHYSICS, HYBRID, SMOOTHED)}
#: Lines of the tables: estimators with the vehicle file as it was given, and with the trained car.
BEFORE = ("zero", "kinematic", "open-loop", BASELINE, PHYSICS)
AFTER = (PHYSICS, HYBRID, SMOOTHED)
#: Estimators that do not depend on the car.
_OF_NO_CAR = ("zero", "kinematic")
YARDSTICK = f"{HYBRID}, trained"


@dataclass(frozen=True, slots=True)
class StageResult:
    """Outcome of one stage.

    Attributes
    ----------
    status : ``kept``; ``undone``, with the validation error higher, or no lower where it must be; or ``not done``.
    text : summary, or why not.
    before, after : [estimator that represents the car, its validation RMSE in degrees], None without a validation.
    figures : of the stage itself.
    """

    name: str
    status: str
    text: str
    before: list[Any] | None
    after: list[Any] | None
    figures: dict[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class LearnResult:
    """The car that was written, a record of every drive, the stages, and the document of a call with several stages."""

    car: Path
    records: tuple[DriveRecord, ...]
    stages: tuple[StageResult, ...]
    document: Mapping[str, Any]

    @property
    def exit_code(self) -> int:
        """0 if all drives took part whole, 3 if not."""
        return exit_code(self.records)

    @property
    def drives(self) -> tuple[DriveRecord, ...]:
        """Drives that took part."""
        return tuple(r for r in self.records if not r.left_out)

    @property
    def left_out(self) -> tuple[DriveRecord, ...]:
        """Drives that did not."""
        return tuple(r for r in self.records if r.left_out)

    @property
    def figures(self) -> dict[str, Any]:
        """The figures of the last stage."""
        return self.stages[-1].figures

    def to_dict(self) -> dict[str, Any]:
        """Return the result as one JSON-able document."""
        shared = {"car": str(self.car), "exit_code": self.exit_code, **drives_document(self.records)}
        return {**shared, "stages": [asdict(s) for s in self.stages], **self.document}


@dataclass(frozen=True, slots=True, eq=False)
class _Call:
    """One call with several stages: what they share, the logs' hashes, the work folder, and the hash of all inputs."""

    task: Task
    logs: Mapping[LogPlace, str]
    work: Path
    basis: str


def learn(
    arguments: Logs,
    output: Path | str,
    settings: LearnSettings,
    *,
    fresh: bool = False,
    reporter: Reporter = SILENT,
) -> LearnResult:
    """Run stages on drives and write the car to the folder ``output``.

    Parameters
    ----------
    arguments : logs, folders, glob patterns.
    fresh : forget the results of an earlier call with this output.
    reporter : its notes are the stages, each with its duration.

    Raises
    ------
    UsageError
        An option is wrong, or drives are held out by their set.
    PdhefError
        A file or log cannot be read: an absent drive would change the result unnoticed.
    EstimatorError
        There is too little driving with ground truth.
    """
    output, config, order = local_path(output), settings.config, settings.order
    if output.suffix in (".toml", ".json"):
        raise UsageError(
            expected="a car's folder", got=output.name, where="--output", remedy="a car has more than a file contains"
        )
    if NETWORK in order and str(config.network) != NO_MODEL:
        check_torch(f"; --network {NO_MODEL} trains none")
    car = _open(settings, reporter.warn)
    check_output(car, output)
    inputs, set_splits = choose_drives(arguments, settings)
    read = [*(i.local for i in inputs), *(path for path in config.files if path != config.car)]
    check_no_input(read, [], [output])
    task = Task(
        car=car,
        settings=settings,
        split=Split.undivided(inputs, settings.holdout),
        mapping=open_mapping(config),
        set_splits=set_splits,
        estimators=config.estimators,
        reporter=reporter,
    )
    if len(order) == 1 and order != (NETWORK,):
        result = _learn_alone(task, output)
    else:
        result = _learn_in_turn(task, inputs, output, fresh=fresh)
    reporter.progress("done", 1.0)
    return result


def _open(settings: LearnSettings, warn: Tell) -> Car:
    """Return the car to start from: the first stages start from the vehicle file and nothing else."""
    config = settings.config
    if {TEACH, CALIBRATE} & set(settings.order):
        car = Car.load(config.car, network=NO_MODEL, intervals=NO_INTERVALS)
        if config.car is None:
            warn(f"no --car: mass, geometry and priors are those of the default {car.datasheet.name}")
        return car
    return open_car(config, warn)


def _learn_alone(task: Task, output: Path) -> LearnResult:
    """Run one stage on all logs and write its part of the car."""
    (name,) = task.settings.order
    stage = RUN[name](task)
    update_car(task.car, output, stage.change)
    result = StageResult(name, KEPT, stage.text, None, None, stage.figures)
    return LearnResult(output, stage.records, (result,), {})


def _learn_in_turn(task: Task, inputs: Sequence[LogInput], output: Path, *, fresh: bool) -> LearnResult:
    """Split the driving, run the stages one after the other and score the test part."""
    settings, given = task.settings, task.car
    records, times = _read(inputs, task)
    split = Split(split_drives(times, settings.holdout, settings.order), tuple(times))
    if not split.parts[VALIDATION] or not (split.parts[TRAINING] or TRAINED.isdisjoint(settings.order)):
        raise EstimatorError(
            expected="driving to fit and to validate",
            got="too little of one",
            where="learn",
            remedy="give longer drives",
        )
    task = replace(task, split=split)
    if not (output / VEHICLE_FILE).is_file():
        write_bytes(output / VEHICLE_FILE, vehicle_file(given))
    work = output / WORK
    with OutputFolder(work, (".",)):
        start = _begin(work, given, settings, fresh=fresh)
        basis = digest(_basis(task, start, records))
        logs = {i.path: r.sha256 for i, r in zip(inputs, records, strict=True)}
        call = _Call(task, logs, work, basis)
        stages, car = _run_stages(call, start)
        kept = [s.name for s in stages if s.status == KEPT]
        ends = _cached(call, len(stages) + 1, "end", kept, lambda _: _end(call, start, car, stages))
    document = {
        **record_head(FORMAT, FORMAT_VERSION, settings, Car.load(start, network=NO_MODEL)),
        "split": {
            p: {"usable_s": round(split.seconds(p), 2), "slices": [s.stem for s in split.parts[p]]} for p in PARTS
        },
        "stages": [asdict(s) for s in stages],
        **ends,
        **drives_document(records),
    }
    used = tuple(r.learnt_on for r in records if not r.left_out)
    files = {
        RECORD_FILE: json_bytes(document),
        PAGE_FILE: page_markdown(document).encode(),
        PLOT_FILE: draw_page(document),
    }
    change = Change("learn", RECORD_FILE, files, {WORK: work}, settings.to_dict(), used)
    update_car(given, output, change, parts_from=car)
    return LearnResult(output, records, tuple(stages), document)


def _read(inputs: Sequence[LogInput], task: Task) -> tuple[tuple[DriveRecord, ...], list[DriveTimes]]:
    """Return a record of every drive, and when each can be used."""
    vehicle = task.car.datasheet

    def read(log: LogInput) -> tuple[DriveRecord, DriveTimes | None]:
        record, drive = load_drive(log, Car.of(vehicle), task.mapping, replace(task.options, friction=None))
        if drive is None or drive.truth is None:
            return record, None
        stamps = drive.signals.stamps_ns
        use = usable_stamps(drive.signals, drive.truth, vehicle)
        seconds: FloatArray = (stamps[use] - drive.log_start_ns).astype(np.float64) * 1e-9
        if seconds.size < 2:
            return replace(record, left_out="no driving with ground truth above twice the low-speed limit"), None
        return record, DriveTimes(log, seconds, float(np.median(np.diff(stamps))) * 1e-9)

    records, times = task.read(inputs, read, 0.05)
    if not times:
        raise no_drive("ground truth velocities", "learn")
    usable_s = sum(t.seconds for t in times)
    if usable_s < LEAST_S:
        raise EstimatorError(
            expected=f"at least {LEAST_S:g} s of driving with ground truth, above twice the low-speed limit",
            got=f"{usable_s:.1f} s",
            where="learn",
            remedy="give more drives",
        )
    return records, times


def usable_stamps(signals: Signals, truth: StateTrack, vehicle: VehicleParameters) -> BoolArray:
    """Return where ground truth and signals can be learned from, [N]."""
    is_complete = truth.valid & np.isfinite(truth.vx_m_s + truth.vy_m_s + truth.yaw_rate_rad_s)
    moving = truth.vx_m_s > SPEED_FACTOR * vehicle.low_speed_blend_m_s
    tame = np.abs(truth.sideslip_rad) < MAX_SIDESLIP_RAD
    use: BoolArray = is_complete & moving & tame & np.isfinite(signals.steer_rad)
    return use


def _begin(work: Path, given: Car, settings: LearnSettings, *, fresh: bool) -> Path:
    """Return the folder of the car that everything starts from."""
    start = work / "0-start"
    kept = set() if fresh else {f"{number}-{name}" for number, name in enumerate((*settings.order, "end"), start=1)}
    for folder in [p for p in work.iterdir() if p.is_dir() and p.name not in kept]:
        shutil.rmtree(folder)
    if given.source is not None and given.source.is_dir() and CALIBRATE not in settings.order:
        shutil.copytree(given.source, start, ignore=shutil.ignore_patterns(WORK, "learn.*", f"{LOCK_FILE}*"))
    write_bytes(start / VEHICLE_FILE, vehicle_file(given))
    return start


def _basis(task: Task, start: Path, records: Sequence[DriveRecord]) -> dict[str, Any]:
    """Return everything that decides the results, as JSON-able values."""
    config = task.settings.config
    network = _network_of(task.settings, Car.load(start)).network
    return {
        **record_head(FORMAT, FORMAT_VERSION, task.settings, task.car),
        "start": hash_log(start),
        "mapping": None if config.mapping is None else hash_log(config.mapping),
        "network": str(config.network) if network is None else network.sha256,
        "drives": [[r.name, r.sha256, r.left_out] for r in records],
        "split": {p: [[s.stem, *(s.span_s or ())] for s in task.split.parts[p]] for p in PARTS},
    }


# ---- the stages ----


def _run_stages(call: _Call, start: Path) -> tuple[list[StageResult], Path]:
    """Run all stages, each with the car that those before have left; return their outcomes and the last car."""
    car, results = start, list[StageResult]()
    for number, name in enumerate(call.task.settings.order, start=1):
        kept = [r.name for r in results if r.status == KEPT]
        outcome = _cached(call, number, name, kept, partial(_run_stage, call, number, name, car))
        results.append(StageResult(name, **outcome))
        if results[-1].status == KEPT:
            car = call.work / f"{number}-{name}" / CAR
    return results, car


def _cached(
    call: _Call, number: int, name: str, kept: Sequence[str], work: Callable[[Path], dict[str, Any]]
) -> dict[str, Any]:
    """Return the result of a stage; it depends on the inputs of the call and on the stages that are ``kept``."""
    stages = Stages(call.work, _shown, call.task.reporter)
    return stages.do(number, name, [call.basis, list(kept)], _share(call, number), work)


def _share(call: _Call, number: int) -> float:
    return 0.05 + 0.95 * (number - 1) / (len(call.task.settings.order) + 1)


def _shown(outcome: dict[str, Any]) -> str:
    """Return the outcome of a stage in a line."""
    if "status" not in outcome:
        return "the test part is scored" + (
            "" if outcome["evaluations"] == 1 else f", evaluation {outcome['evaluations']} of it"
        )
    if outcome["after"] is None:
        return f"{outcome['status']}: {outcome['text']}"
    (old, was), (new, now) = outcome["before"], outcome["after"]
    return f"{outcome['status']}; validation RMSE of {old} before {was:.3f}°, of {new} after {now:.3f}°"


def config_of(settings: LearnSettings, car: Path) -> LearnSettings:
    """Return the settings of a stage that runs with ``car``; slices bring their own start and end."""
    config = replace(settings.config, car=car, network=None, intervals=None, estimators=None, start=None, end=None)
    return replace(settings, config=config)


def _network_of(settings: LearnSettings, car: Car) -> Car:
    """Return the car with the network to start from: the requested one, else its own."""
    assert car.source is not None
    return car if settings.config.network is None else Car.load(car.source, network=settings.config.network)


def _stage_task(call: _Call, number: int, name: str, before: Path, folder: Path) -> Task:
    settings = config_of(call.task.settings, before)
    car = Car.load(before)
    if name in (GAIN, NETWORK):
        car = _network_of(call.task.settings, car)
        network = call.task.settings.config.network or (None if car.network_folder is None else car.network_folder)
        settings = replace(settings, config=replace(settings.config, network=network))
    first, span = _share(call, number), _share(call, 2) - _share(call, 1)
    return replace(
        call.task,
        car=car,
        settings=settings,
        estimators=call.task.estimators or ESTIMATORS.get(name),
        work=folder,
        reporter=Reporter(lambda text, share: call.task.reporter.progress(f"{name}: {text}", first + share * span)),
    )


def _run_stage(call: _Call, number: int, name: str, before: Path, folder: Path) -> dict[str, Any]:
    """Run one stage in a folder; return the values of its :class:`StageResult`. Its car is left only if it is kept."""
    try:
        task = _stage_task(call, number, name, before, folder)
        output = RUN[name](task)
    except EstimatorError as error:
        _tidy(folder, keep_car=False)
        return {"status": NOT_DONE, "text": str(error), "before": None, "after": None, "figures": {}}
    update_car(task.car, folder / CAR, output.change)
    task.reporter.progress("scoring the validation part", 1.0)
    old, new = (_validation_errors(call, car) for car in (before, folder / CAR))
    test = paired_test(old, new)
    unsure = name in MUST_GAIN and not _still_sure(old, new)
    doubtful = name in MUST_CONFIRM and not test.confirmed
    kept = not unsure and not doubtful and (test.better is True if name in MUST_GAIN else test.better is not False)
    _tidy(folder, keep_car=kept)
    text = output.text + ("; its 95 % intervals contain too few of the errors" if unsure else "")
    return {
        "status": KEPT if kept else UNDONE,
        "text": text + ("; the lower error is not significant" if doubtful else ""),
        "before": [old.name, test.was_deg],
        "after": [new.name, test.now_deg],
        "figures": output.figures,
    }


def _tidy(folder: Path, *, keep_car: bool) -> None:
    """Leave nothing of a stage's folder but its car, if that."""
    for path in folder.iterdir():
        if path.is_dir() and not (keep_car and path.name == CAR):
            shutil.rmtree(path)


def judged_by(car: Car) -> str:
    """Return the estimator that represents a car: the best that it has evidence for."""
    if car.network is not None and car.trust is not None and car.trust.has_evidence:
        return HYBRID
    return BASELINE if spec_of(PHYSICS).missing(car) else PHYSICS


def _validation_errors(call: _Call, car_folder: Path) -> Errors:
    """Return the errors on the validation part of the estimator that represents a car."""
    car, task = Car.load(car_folder), call.task
    name = judged_by(car)
    scored = score_slices(car, (name,), task.split.parts[VALIDATION], task.mapping, _slice_options(task))
    if name not in scored.errors or not scored.errors[name].scored:
        raise EstimatorError(
            expected=f"an estimate of {name} on the validation part",
            got=scored.skipped.get(name, "none"),
            where="learn",
            remedy="give more driving with ground truth",
        )
    return scored.errors[name]


def _still_sure(old: Errors, new: Errors) -> bool:
    """Return whether the new 95 % intervals contain most of the errors, or as many as the old ones."""
    was, now = (float(np.mean(e.inside[np.isfinite(e.error)])) if e.inside is not None else 0.0 for e in (old, new))
    return now >= min(was, LEAST_COVERED)


# ---- the end ----


def _end(call: _Call, start: Path, car: Path, stages: Sequence[StageResult]) -> dict[str, Any]:
    """Score the test part once, and return what more driving would be worth."""
    task = call.task
    task.reporter.progress("scoring the test part, once", _share(call, len(stages) + 1))
    spans = [[call.logs[s.path], *(s.span_s or ())] for s in task.split.parts[TEST]]
    count = count_evaluations(call.work / EVALUATIONS_FILE, spans, call.task.reporter.note)
    tables = {part: table_of(task, start, car, part) for part in (VALIDATION, TEST)}
    return {
        "car_name": Car.load(car).vehicle.name,
        "evaluations": count,
        **tables,
        "more": what_more_would_pay(task.split, task.settings.order),
    }


def _slice_options(task: Task) -> ReadOptions:
    return config_of(task.settings, Path()).config.read_options


def count_evaluations(file: Path, spans: list[list[Any]], say: Tell = lambda _text: None) -> int:
    """Record that spans [hash of the log, start, end] are scored now; return how often any was, this time included.

    The file remains through ``--fresh`` and other settings: repeated trials until the test error is low are fits to it.
    """
    earlier: list[list[list[Any]]] = (read_own(file, say) or {}).get("evaluations", [])
    write_bytes(file, json_bytes(seal({"evaluations": [*earlier, spans]})))

    def overlap(a: list[Any], b: list[Any]) -> bool:
        return bool(a[0] == b[0] and min(a[2], b[2]) > max(a[1], b[1]))

    return 1 + sum(any(overlap(a, b) for a in before for b in spans) for before in earlier)


def table_of(task: Task, start: Path, trained: Path, part: str) -> list[dict[str, Any]]:
    """Return one line per estimator on a part of the drives, with the car as it was given and as it was trained."""
    names_in_order, lines = list[str](), list[Errors]()
    skipped: dict[str, dict[str, Any]] = {}
    for label, folder, names in (("as given", start, BEFORE), ("trained", trained, AFTER)):
        scored = score_slices(Car.load(folder), names, task.split.parts[part], task.mapping, _slice_options(task))
        for name in names:
            shown = name if name in _OF_NO_CAR else f"{name}, {label}"
            names_in_order.append(shown)
            if name in scored.errors:
                lines.append(replace(scored.errors[name], name=shown))
            elif name in scored.skipped:
                skipped[shown] = {"name": shown, "skipped": scored.skipped[name]}
    table = skipped | {line.name: _line(line) for line in compare(lines, YARDSTICK)}
    return [table[name] for name in names_in_order if name in table]


def _line(compared: Compared) -> dict[str, Any]:
    return {
        "name": compared.name,
        "causal": spec_of(compared.name.partition(",")[0]).causal,
        "rmse_deg": _degrees(compared.rmse),
        "share": round(compared.share, 4),
        "covered": None if compared.covered is None else round(compared.covered, 4),
        "against_hybrid_deg": None if compared.difference is None else _degrees(compared.difference),
    }


def _degrees(interval: Interval) -> list[float | None]:
    """Return value, lower and upper bound in degrees; None where there are too few blocks for one."""
    values = (math.degrees(x) for x in (interval.value, interval.low, interval.high))
    return [round(x, 6) if math.isfinite(x) else None for x in values]
