"""``pdhef learn`` from logs with truth to a car: split, teach step by step, undo what does not help, score once.

What a step leaves stands in ``learn/NUMBER-NAME/`` of the car's folder: ``step.json`` with what it rests on and what
came of it, and the car that it made where that stays. A rerun takes every step whose basis is as it was.
"""

from __future__ import annotations

import hashlib
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
from pdhef_logtool.drive.reading import Tell
from pdhef_logtool.estimators.table import spec_of
from pdhef_logtool.evaluation.bootstrap import Interval, block_bootstrap_difference
from pdhef_logtool.evaluation.comparison import BLOCK_S, Compared, Errors, compare
from pdhef_logtool.learning.car.axle_forces import usable_stamps
from pdhef_logtool.learning.car.fit_data import load_fit_drive, period_s
from pdhef_logtool.learning.drives import (
    DriveRecord,
    LearnResult,
    LearnSettings,
    choose_drives,
    drives_document,
    no_drive,
    open_mapping,
    record_head,
    tell_drive,
)
from pdhef_logtool.learning.evidence.trust import MIN_BLOCKS
from pdhef_logtool.learning.learn.page import draw_page, page_markdown
from pdhef_logtool.learning.learn.parts import CHECK, FIT, LAST, PARTS, DriveTimes, split_drives
from pdhef_logtool.learning.learn.score import score_slices
from pdhef_logtool.learning.learn.steps import (
    BASELINE,
    HYBRID,
    SMOOTHED,
    STEPS,
    Lesson,
    judged_by,
    learning_curve,
    what_more_would_pay,
)
from pdhef_logtool.learning.noise.tune_command import REFUSED
from pdhef_logtool.learning.stages import Stages, read_own
from pdhef_logtool.logs.discovery import LogInput, Logs
from pdhef_logtool.logs.remote_place import LogPlace
from pdhef_logtool.mapping import Mapping as SignalMapping
from pdhef_logtool.records.documents import digest, seal
from pdhef_logtool.records.errors import EstimatorError, UsageError
from pdhef_logtool.records.files import write_bytes
from pdhef_logtool.records.outputs import OutputFolder, check_no_input, local_path
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.residual_model.bundle import NO_MODEL
from pdhef_logtool.residual_model.torch_extra import check_torch
from pdhef_logtool.sinks.report import json_bytes

FORMAT, FORMAT_VERSION = "pdhef-learn", 1
#: In the car's folder: the steps' results, and what is told of them.
WORK, RECORD_FILE, PAGE_FILE, PLOT_FILE = "learn", "learn.record.json", "learn.md", "learn.png"
CAR, LOOKS_FILE = "car", "looks.json"
#: What may come of a step.
KEPT, UNDONE, NOT_DONE = "kept", "undone", "not done"
#: Steps that do not stay where they change nothing, or where the 95 % intervals then hold less than a share of the
#: errors and less than before: simpler is better, and a gain is not worth an interval that means nothing.
MUST_GAIN, LEAST_COVERED = ("noise", "training"), 0.8
#: Identification has found noise through the filter already: another has to be better beyond doubt.
MUST_CONFIRM = ("noise",)
#: Usable driving below which nothing is left to fit, to check and to score.
LEAST_S = 50.0
#: A candidate that gives an estimate at fewer of the stamps counts as worse.
LEAST_AVAILABILITY = 0.9
#: Lines of the tables: the estimator, and whether it has what was learnt or the vehicle file as it was given.
BEFORE = ("zero", "kinematic", "open-loop", BASELINE, PHYSICS)
AFTER = (PHYSICS, HYBRID, SMOOTHED)
#: Of these the car does not matter.
_OF_NO_CAR = ("zero", "kinematic")
YARDSTICK = f"{HYBRID}, learnt"


@dataclass(frozen=True, slots=True, kw_only=True)
class CourseSettings(LearnSettings):
    """With the share ``holdout`` that is scored once, at the end, and the ``trials`` of the search for noise."""

    holdout: float = 0.15
    trials: int = 64


@dataclass(frozen=True, slots=True)
class StepResult:
    """What came of one step.

    Attributes
    ----------
    status : ``kept``; ``undone``, with the held-out error worse, or no better where it must be; or ``not done``.
    text : what it found, or why not.
    before, after : [estimator that stands for the car, its RMSE on the check part in degrees], None if not done.
    figures : of the step itself.
    """

    name: str
    status: str
    text: str
    before: list[Any] | None
    after: list[Any] | None
    figures: dict[str, Any]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class CourseResult(LearnResult):
    """What the command found and wrote: its steps, the part that was scored once, and what more driving would pay."""

    steps: tuple[StepResult, ...]
    last: tuple[dict[str, Any], ...]
    more: tuple[str, ...]
    document: dict[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """Return the result as one JSON-able document."""
        own = super(CourseResult, self).to_dict()
        return {**own, **{k: v for k, v in self.document.items() if k not in own}}


@dataclass(frozen=True, slots=True, eq=False)
class _Course:
    """One call of the command: what it learns with, the logs' hashes, where, and whom it tells."""

    lesson: Lesson
    logs: Mapping[LogPlace, str]
    work: Path
    basis: str
    progress: Callable[[str, float], None]
    say: Tell


def learn(
    arguments: Logs,
    output: Path | str,
    settings: CourseSettings,
    *,
    fresh: bool = False,
    progress: Callable[[str, float], None] = lambda _text, _share: None,
    warn: Tell = lambda _text: None,
    say: Tell = lambda _text: None,
) -> CourseResult:
    """Teach a car everything that drives with truth can, and write it to the folder ``output``.

    Parameters
    ----------
    arguments : logs, folders, glob patterns. fresh : forget what an earlier call with this output has found.
    say : told of each step with the time it took.

    Raises
    ------
    UsageError
        An option is wrong, or drives are held out by their set.
    PdhefError
        A file or log cannot be read: an absent drive would change the result unnoticed.
    EstimatorError
        There is too little driving with truth.
    """
    output = local_path(output)
    config = settings.config
    _check(settings, output)
    given = Car.load(config.car, network=NO_MODEL, intervals=NO_INTERVALS)
    check_output(given, output)
    if config.car is None:
        warn(f"no --car: mass, geometry and priors are those of the default {given.own.name}")
    inputs, splits = choose_drives(arguments, settings, REFUSED)
    read = [*(i.local for i in inputs), *(path for path in config.files if path != config.car)]
    check_no_input(read, [], [output])
    mapping = open_mapping(config)
    records, times = _read(inputs, splits, given, mapping, settings, progress, warn)
    parts = split_drives(times, settings.holdout)
    if not parts[FIT] or not parts[CHECK]:
        raise EstimatorError(
            expected="driving to fit and to check", got="too little of one", where="learn", remedy="give longer drives"
        )
    lesson = Lesson(config, mapping, parts, tuple(times), settings.seed, settings.trials)
    if not (output / VEHICLE_FILE).is_file():
        write_bytes(output / VEHICLE_FILE, vehicle_file(given))
    work = output / WORK
    with OutputFolder(work, (".",)):
        start = _begin(work, given, fresh=fresh)
        basis = digest(_basis(settings, given, records, parts, lesson))
        logs = {i.path: r.sha256 for i, r in zip(inputs, records, strict=True)}
        course = _Course(lesson, logs, work, basis, progress, say)
        steps, car = _teach(course, start)
        figures = {s.name: s.figures for s in steps if s.status == KEPT}
        kept = [s.name for s in steps if s.status == KEPT]
        ends = _cached(course, len(STEPS) + 1, "end", kept, lambda _: _end(course, start, car, figures))
    document = {
        **record_head(FORMAT, FORMAT_VERSION, settings, Car.load(start, network=NO_MODEL)),
        "parts": {p: {"usable_s": round(lesson.seconds(p), 2), "slices": [s.stem for s in parts[p]]} for p in PARTS},
        "steps": [asdict(s) for s in steps],
        **ends,
        **drives_document(records),
    }
    taught = tuple(r.learnt_on for r in records if not r.left_out)
    files = {
        RECORD_FILE: json_bytes(document),
        PAGE_FILE: page_markdown(document).encode(),
        PLOT_FILE: draw_page(document),
    }
    change = Change("learn", RECORD_FILE, files, {WORK: work}, settings.to_dict(), taught)
    update_car(given, output, change, parts_from=car)
    progress("done", 1.0)
    return CourseResult(
        car=output,
        records=tuple(records),
        steps=tuple(steps),
        last=tuple(ends["last"]),
        more=tuple(ends["more"]),
        document=document,
    )


def _check(settings: CourseSettings, output: Path) -> None:
    if not 0.0 <= settings.holdout <= 0.5:
        raise UsageError(expected="a share from 0 to 0.5", got=f"{settings.holdout:g}", where="--holdout")
    if output.suffix == ".toml":
        raise UsageError(
            expected="a car's folder", got=output.name, where="--output", remedy="learn writes more than a file holds"
        )
    if str(settings.config.network) != NO_MODEL:
        check_torch(f"; --network {NO_MODEL} trains none")


def _read(
    inputs: Sequence[LogInput],
    splits: dict[str, str],
    car: Car,
    mapping: SignalMapping | None,
    settings: CourseSettings,
    progress: Callable[[str, float], None],
    warn: Tell,
) -> tuple[list[DriveRecord], list[DriveTimes]]:
    """Return a record of every drive, and when each can be learnt from."""
    records: list[DriveRecord] = []
    times: list[DriveTimes] = []
    for number, one in enumerate(inputs):
        progress(f"reading {one.stem}", 0.05 * number / len(inputs))
        record, drive = load_fit_drive(one, Car.of(car.own), mapping, settings.config.read_options)
        if drive is not None:
            use = usable_stamps(drive, car.own)
            at: FloatArray = (drive.signals.stamps_ns[use] - drive.log_start_ns).astype(np.float64) * 1e-9
            if at.size < 2:
                record = replace(record, left_out="no driving with truth above twice the low-speed limit")
            else:
                times.append(DriveTimes(one, at, period_s(drive)))
        record = replace(record, split=splits.get(one.stem))
        tell_drive(record, warn)
        records.append(record)
    if not times:
        raise no_drive("truth velocities", "learn")
    usable_s = sum(t.seconds for t in times)
    if usable_s < LEAST_S:
        raise EstimatorError(
            expected=f"at least {LEAST_S:g} s of driving with truth, above twice the low-speed limit",
            got=f"{usable_s:.1f} s",
            where="learn",
            remedy="give more drives",
        )
    return records, times


def _begin(work: Path, given: Car, *, fresh: bool) -> Path:
    """Return the folder of the car that everything starts from: the person's vehicle file and nothing else."""
    if fresh:
        for folder in [p for p in work.iterdir() if p.is_dir()]:
            shutil.rmtree(folder)
    start = work / "0-start"
    write_bytes(start / VEHICLE_FILE, vehicle_file(given))
    return start


def _basis(
    settings: CourseSettings,
    given: Car,
    records: Sequence[DriveRecord],
    parts: dict[str, tuple[LogInput, ...]],
    lesson: Lesson,
) -> dict[str, Any]:
    """Return everything that decides what comes out, as JSON-able values."""
    config = settings.config
    head = record_head(FORMAT, FORMAT_VERSION, settings, given)
    return {
        **head,
        "vehicle": hashlib.sha256(vehicle_file(given)).hexdigest(),
        "mapping": None if config.mapping is None else hashlib.sha256(config.mapping.read_bytes()).hexdigest(),
        "network": str(lesson.network) if (network := lesson.bundle()) is None else network.sha256,
        "drives": [[r.name, r.sha256, r.left_out] for r in records],
        "parts": {p: [[s.stem, *(s.span_s or ())] for s in parts[p]] for p in PARTS},
    }


# ---- the steps ----


def _teach(course: _Course, start: Path) -> tuple[list[StepResult], Path]:
    """Do all steps, each with the car that those before have left; return what came of them, and the last car."""
    car, results = start, list[StepResult]()
    for number, name in enumerate(STEPS, start=1):
        kept = [r.name for r in results if r.status == KEPT]
        found = _cached(course, number, name, kept, partial(_step, course, name, car))
        results.append(StepResult(name, **found))
        if results[-1].status == KEPT:
            car = course.work / f"{number}-{name}" / CAR
    return results, car


def _cached(
    course: _Course, number: int, name: str, kept: Sequence[str], work: Callable[[Path], dict[str, Any]]
) -> dict[str, Any]:
    """Return what a step came to; it rests on the course and on the steps before it that stay (``kept``)."""
    stages = Stages(course.work, _shown, course.say, course.progress)
    return stages.do(number, name, [course.basis, list(kept)], _share(number), work)


def _share(number: int) -> float:
    return 0.05 + 0.95 * (number - 1) / (len(STEPS) + 1)


def _shown(found: dict[str, Any]) -> str:
    """Return what came of a step in a line."""
    if "status" not in found:
        return "the last part is scored" + ("" if found["looks"] == 1 else f", for the {found['looks']}th time")
    if found["after"] is None:
        return f"{found['status']}: {found['text']}"
    (old, was), (new, now) = found["before"], found["after"]
    return f"{found['status']}; held out, {old} had {was:.3f}° before, {new} has {now:.3f}° now"


def _step(course: _Course, name: str, before: Path, folder: Path) -> dict[str, Any]:
    """Do one step in a folder; return what a :class:`StepResult` holds. Its car is left only if it stays."""
    lesson = course.lesson
    number = list(STEPS).index(name) + 1

    def progress(text: str, share: float) -> None:
        course.progress(f"{name}: {text}", _share(number) + share * (_share(2) - _share(1)))

    try:
        taught = STEPS[name](lesson, before, folder / CAR, progress)
    except EstimatorError as error:
        _tidy(folder, keep_car=False)
        if name == next(iter(STEPS)):
            raise  # without it there is nothing to give
        return {"status": NOT_DONE, "text": str(error), "before": None, "after": None, "figures": {}}
    progress("scoring what it is worth", 1.0)
    old, new = (_held_out(lesson, car) for car in (before, folder / CAR))
    (was, now), gains = _compare(old, new)
    unsure = name in MUST_GAIN and not _still_sure(old, new)
    doubtful = name in MUST_CONFIRM and not _confirmed(old, new)
    stays = not unsure and not doubtful and (gains is True if name in MUST_GAIN else gains is not False)
    _tidy(folder, keep_car=stays)
    return {
        "status": KEPT if stays else UNDONE,
        "text": taught.text
        + ("; its 95 % intervals hold too few of the errors" if unsure else "")
        + ("; a gain is not confirmed" if doubtful else ""),
        "before": [old.name, was],
        "after": [new.name, now],
        "figures": taught.figures,
    }


def _tidy(folder: Path, *, keep_car: bool) -> None:
    """Leave nothing of a step's folder but its car, if that."""
    for path in folder.iterdir():
        if path.is_dir() and not (keep_car and path.name == CAR):
            shutil.rmtree(path)


def _held_out(lesson: Lesson, car_folder: Path) -> Errors:
    """Return the errors on the check part of the estimator that stands for a car."""
    car = Car.load(car_folder)
    name = judged_by(car)
    scored = score_slices(car, (name,), lesson.parts[CHECK], lesson.mapping, lesson.config_for(car_folder).read_options)
    if name not in scored.errors or not scored.errors[name].scored:
        raise EstimatorError(
            expected=f"an estimate of {name} on the check part",
            got=scored.skipped.get(name, "none"),
            where="learn",
            remedy="give more driving with truth",
        )
    return scored.errors[name]


def _compare(old: Errors, new: Errors) -> tuple[tuple[float, float], bool | None]:
    """Return the RMSE of both in degrees where both are known, and whether the new one is better; None: it is alike."""
    both = np.isfinite(old.error) & np.isfinite(new.error)
    was, now = (float(np.degrees(np.sqrt(np.mean(e.error[both] ** 2)))) if both.any() else np.nan for e in (old, new))
    lacks = new.scored < LEAST_AVAILABILITY * old.scored
    return (round(was, 6), round(now, 6)), None if was == now and not lacks else now < was and not lacks


def _still_sure(old: Errors, new: Errors) -> bool:
    """Return whether the 95 % intervals of the new one hold most of its errors, or as many as those of the old one."""
    was, now = (float(np.mean(e.inside[np.isfinite(e.error)])) if e.inside is not None else 0.0 for e in (old, new))
    return now >= min(was, LEAST_COVERED)


def _confirmed(old: Errors, new: Errors) -> bool:
    """Return whether the 95 % bounds of a paired block bootstrap say that the new one is better."""
    found = block_bootstrap_difference(new.error, old.error, new.stamps_ns, block_s=BLOCK_S)
    return found.blocks >= MIN_BLOCKS and found.high < 0.0


# ---- the end ----


def _end(course: _Course, start: Path, car: Path, figures: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Score the last part once; say what more driving would pay."""
    lesson = course.lesson
    course.progress("scoring the last part, once", _share(len(STEPS) + 1))
    curve = learning_curve(lesson, car, course.progress)
    spans = [[course.logs[s.path], *(s.span_s or ())] for s in lesson.parts[LAST]]
    looks = _look(course.work / LOOKS_FILE, spans, course.say)
    tables = {part: table_of(lesson, start, car, part) for part in (CHECK, LAST)}
    return {
        "car_name": Car.load(car).vehicle.name,
        "looks": looks,
        **tables,
        "curve": curve,
        "more": what_more_would_pay(lesson, figures, curve),
    }


def _look(file: Path, spans: list[list[Any]], say: Tell = lambda _text: None) -> int:
    """Remember that spans [hash of the log, start, end] are scored now; return how often any was, this time included.

    The file outlives ``--fresh`` and other settings: who tries until the last part looks well has fitted to it.
    """
    earlier: list[list[list[Any]]] = (read_own(file, say) or {}).get("looks", [])
    write_bytes(file, json_bytes(seal({"looks": [*earlier, spans]})))

    def meets(one: list[Any], other: list[Any]) -> bool:
        return bool(one[0] == other[0] and min(one[2], other[2]) > max(one[1], other[1]))

    return 1 + sum(any(meets(a, b) for a in look for b in spans) for look in earlier)


def table_of(lesson: Lesson, start: Path, learnt: Path, part: str) -> list[dict[str, Any]]:
    """Return a line an estimator on a part of the drives, with the car as it was given and as it was learnt."""
    names_in_order, lines = list[str](), list[Errors]()
    skipped: dict[str, dict[str, Any]] = {}
    for label, folder, names in (("as given", start, BEFORE), ("learnt", learnt, AFTER)):
        car = Car.load(folder)
        scored = score_slices(car, names, lesson.parts[part], lesson.mapping, lesson.config_for(folder).read_options)
        for name in names:
            shown = name if name in _OF_NO_CAR else f"{name}, {label}"
            names_in_order.append(shown)
            if name in scored.errors:
                lines.append(replace(scored.errors[name], name=shown))
            elif name in scored.skipped:
                skipped[shown] = {"name": shown, "skipped": scored.skipped[name]}
    found = skipped | {one.name: _line(one) for one in compare(lines, YARDSTICK)}
    return [found[name] for name in names_in_order if name in found]


def _line(one: Compared) -> dict[str, Any]:
    causal = spec_of(one.name.partition(",")[0]).causal
    return {
        "name": one.name,
        "causal": causal,
        "rmse_deg": _degrees(one.rmse),
        "share": round(one.share, 4),
        "covered": None if one.covered is None else round(one.covered, 4),
        "against_hybrid_deg": None if one.difference is None else _degrees(one.difference),
    }


def _degrees(found: Interval) -> list[float | None]:
    """Return value, lower and upper bound in degrees; None where there are too few blocks for one."""
    values = (math.degrees(x) for x in (found.value, found.low, found.high))
    return [round(x, 6) if math.isfinite(x) else None for x in values]
