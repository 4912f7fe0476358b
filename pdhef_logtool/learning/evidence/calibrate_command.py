"""``pdhef calibrate`` from drives with truth to the intervals of a car, filed by what ran."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.car.car import INTERVALS_FILE, Car
from pdhef_logtool.car.parts import Algorithm, IntervalEntry, Intervals
from pdhef_logtool.car.store import Change, update_car
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters
from pdhef_logtool.drive.reading import Tell, friction_of
from pdhef_logtool.estimators.algorithm import resolve
from pdhef_logtool.estimators.table import ALL_ESTIMATORS, Options, runnable
from pdhef_logtool.evaluation.metrics import signal_error
from pdhef_logtool.evaluation.segments import GRIP_SMOOTHING_HZ, smooth
from pdhef_logtool.learning.drives import (
    DriveRecord,
    LearnResult,
    LearnSettings,
    Refusal,
    check_file_output,
    choose_drives,
    load_drive,
    open_car,
    open_mapping,
    tell_drive,
)
from pdhef_logtool.learning.evidence.calibrate import (
    COVERED,
    FOLDS,
    MIN_DRIVES,
    Fitted,
    Samples,
    bin_numbers,
    fit_inflation,
    join_samples,
)
from pdhef_logtool.learning.network.extract_command import MAX_VARIATION
from pdhef_logtool.learning.noise.tune_command import HELD_OUT
from pdhef_logtool.learning.variation import Variation, vary
from pdhef_logtool.logs.discovery import LogInput, Logs
from pdhef_logtool.mapping import Mapping as SignalMapping
from pdhef_logtool.records.errors import EstimatorError, UsageError
from pdhef_logtool.records.files import write_bytes
from pdhef_logtool.records.outputs import local_path
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.runs.estimating import estimate_windows
from pdhef_logtool.sinks.report import json_bytes, tool_versions
from pdhef_logtool.watches.error_features import error_terms
from pdhef_logtool.watches.intervals import yaw_rate_terms

DEFAULT_SPREAD = 0.1
#: Neighbouring errors are alike: one sample in this time is kept.
SAMPLE_EVERY_S = 0.05
#: Runs of each drive with friction and vehicle made wrong.
WRONG_RUNS = 2
#: A drive with fewer kept samples does not count.
MIN_SAMPLES = 20
#: Share of the progress that running the estimators takes.
RUNNING = 0.9

#: Drives that this command refuses.
REFUSED = Refusal(
    HELD_OUT,
    "drives that no figure is reported on",
    "calibrate",
    "coverage on drives that the intervals were fitted to is no test: take --split validation, or say --any-split",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrateSettings(LearnSettings):
    """With the ``spread`` by which friction and vehicle are made wrong in further runs of every drive; 0 = none."""

    spread: float = DEFAULT_SPREAD


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class CalibrateResult(LearnResult):
    """What the command found and wrote; ``file`` holds the intervals."""

    file: Path
    intervals: Intervals

    def to_dict(self) -> dict[str, Any]:
        """Return the result as one JSON-able document."""
        intervals = self.intervals.model_dump(mode="json")
        return {**intervals, **super(CalibrateResult, self).to_dict(), "file": str(self.file)}


def calibrate(
    arguments: Logs,
    output: Path | str,
    settings: CalibrateSettings,
    *,
    progress: Callable[[str, float], None] = lambda _text, _share: None,
    warn: Tell = lambda _text: None,
) -> CalibrateResult:
    """Fit the intervals of every algorithm that gives one; write them to the car ``output``.

    Parameters
    ----------
    arguments : logs, folders, glob patterns. output : a car's folder, or a .json file for the intervals alone.

    Raises
    ------
    UsageError
        An option is wrong, or drives are held out by their set.
    PdhefError
        A file or log cannot be read: an absent drive would change the result unnoticed.
    EstimatorError
        There are too few drives with truth.
    """
    output = local_path(output)
    config = settings.config
    if not 0.0 <= settings.spread <= MAX_VARIATION:
        raise UsageError(expected=f"a spread of 0 to {MAX_VARIATION:g}", got=str(settings.spread), where="--vary")
    if output.suffix == ".toml":
        raise UsageError(
            expected="a car's folder, or a file name that ends in .json", got=output.name, where="--output",
            remedy="intervals have no place in a vehicle.toml",
        )  # fmt: skip
    alone = output.suffix == ".json"
    car = open_car(config, None if alone else output, warn)
    mapping = open_mapping(config)
    inputs, splits = choose_drives(arguments, settings, REFUSED)
    check_file_output(inputs, config, output)
    if car.network is not None and "train" in splits.values():
        warn("drives of split train: a network is better there than in service, and its intervals will be too narrow")
    samples: dict[str, list[Samples]] = {}
    ran: dict[str, tuple[str, Algorithm]] = {}
    records: list[DriveRecord] = []
    for number, log_input in enumerate(inputs):
        progress(log_input.stem, RUNNING * number / len(inputs))
        record, found = _run_drive(log_input, number, settings, car, mapping)
        records.append(replace(record, split=splits.get(log_input.stem)))
        tell_drive(record, warn)
        for name, algorithm, part in found:
            ran.setdefault(algorithm.identity, (name, algorithm))
            samples.setdefault(algorithm.identity, []).append(part)
    entries: list[IntervalEntry] = []
    for number, (identity, parts) in enumerate(samples.items()):
        name, algorithm = ran[identity]
        progress(f"fitting {name}", RUNNING + (1.0 - RUNNING) * number / len(samples))
        joined = join_samples(parts)
        count = int(np.unique(joined.drive[~joined.wrong]).size)
        if count < MIN_DRIVES:
            warn(f"{name} is not calibrated: it has {count} drives, at least {MIN_DRIVES} are needed")
            continue
        entries.append(_entry(name, algorithm, fit_inflation(joined)))
    if not entries:
        raise EstimatorError(
            expected=f"at least {MIN_DRIVES} drives with a true sideslip",
            got=str(sum(not r.left_out for r in records)),
            where="calibrate",
            remedy="give more drives; the same number of short drives of many kinds is worth more than a long one",
        )
    intervals = _intervals(settings, car, entries, records)
    data = json_bytes(intervals.model_dump(mode="json"))
    if alone:
        file = output
        write_bytes(file, data)
    else:
        change = Change("calibrate", INTERVALS_FILE, {INTERVALS_FILE: data}, {}, settings.to_dict(), intervals.drives)
        file = update_car(car, output, change)
    return CalibrateResult(car=output, records=tuple(records), file=file, intervals=intervals)


def made_wrong(vehicle: VehicleParameters, spread: float, key: str) -> Iterator[Variation]:
    """Yield the draws of a key that do not leave everything as it is; ``spread`` > 0."""
    draws = (vary(vehicle, spread, f"{key}:{number}") for number in itertools.count())
    return (told for told in draws if told.vehicle is not vehicle)


def _run_drive(
    log_input: LogInput,
    number: int,
    settings: CalibrateSettings,
    car: Car,
    mapping: SignalMapping | None,
) -> tuple[DriveRecord, list[tuple[str, Algorithm, Samples]]]:
    """Run the estimators on a drive, once as told and some times with a wrong vehicle; return errors and terms."""
    config, vehicle = settings.config, car.vehicle
    options = config.read_options
    record, drive = load_drive(log_input, car, mapping, options, fill_friction=False)
    if drive is None or drive.truth is None:
        return record, []
    signals = drive.signals
    runs = [(vehicle, 1.0, False)]
    if settings.spread > 0.0:
        told = itertools.islice(made_wrong(vehicle, settings.spread, f"{settings.seed}:{record.sha256}"), WRONG_RUNS)
        runs += [(one.vehicle, one.friction_factor, True) for one in told]
    found: list[tuple[str, Algorithm, Samples]] = []
    for assumed, factor, wrong in runs:
        seen = friction_of(drive.plan, assumed, options, factor).fill(drive.signals)
        if not found and "friction" not in drive.plan.alignment.available:
            signals = replace(signals, friction=seen.friction)  # the best that is known of the drive, for the bins
        presumed = car if assumed is vehicle else car.with_vehicle(assumed)
        available = drive.plan.alignment.available
        estimators, _ = runnable(
            config.estimators or (ALL_ESTIMATORS,), presumed, available, Options(options.use_speed)
        )
        for window in estimate_windows(replace(drive, signals=seen), estimators, watched=False, drawn=False):
            for estimator, track in zip(estimators, window.tracks, strict=True):
                part = drive_samples(track, seen, signals, drive.truth, vehicle, number, wrong=wrong)
                if len(part) >= MIN_SAMPLES:
                    found.append((track.name, resolve(estimator), part))
    if not found:
        return replace(record, left_out="no estimate with an interval where the truth is known"), []
    return replace(record, counts={**record.counts, "runs": len(runs)}), found


def drive_samples(
    track: StateTrack,
    told: Signals,
    signals: Signals,
    truth: StateTrack,
    vehicle: VehicleParameters,
    drive: int,
    *,
    wrong: bool,
) -> Samples:
    """Return the samples of one run of a drive, a stamp every :data:`SAMPLE_EVERY_S`; none without an interval.

    Parameters
    ----------
    told : what the estimator was told; the terms come from it. signals : with the friction of the drive, for the bins.
    vehicle : the right one; its roll gradient and lowest speed count.
    """
    slow = vehicle.low_speed_blend_m_s
    terms, _ = error_terms(track, told, vehicle.roll_gradient_rad_per_m_s2, None)
    error = {s: signal_error(track, truth, s, slow) for s in ("sideslip_rad", "vy_m_s", "yaw_rate_rad_s")}
    own, rate_std = track.sideslip_std_rad, track.yaw_rate_std_rad_s
    use = np.isfinite(own) & (own > 0.0) & np.isfinite(track.vy_std_m_s) & np.isfinite(rate_std)
    for values in error.values():
        use &= np.isfinite(values)
    ay = truth.ay_m_s2 if np.isfinite(truth.ay_m_s2).any() else signals.ay_m_s2
    friction = np.where(np.isfinite(signals.friction), signals.friction, vehicle.assumed_friction)
    bins = bin_numbers(np.abs(smooth(truth.stamps_ns, ay, GRIP_SMOOTHING_HZ)) / (friction * GRAVITY_M_S2))
    use &= bins >= 0
    slot = (truth.stamps_ns - truth.stamps_ns[0]) // round(SAMPLE_EVERY_S * 1e9) if len(truth) else truth.stamps_ns
    kept = np.flatnonzero(use)
    kept = kept[np.unique(slot[kept], return_index=True)[1]]
    count = kept.size
    return Samples(
        terms=terms[kept],
        yaw_rate_terms=yaw_rate_terms(terms, rate_std)[kept],
        vy_per_sideslip=track.vy_std_m_s[kept] / own[kept],
        sideslip_error=error["sideslip_rad"][kept],
        vy_error=error["vy_m_s"][kept],
        yaw_rate_error=error["yaw_rate_rad_s"][kept],
        own_std=own[kept],
        bin=bins[kept],
        drive=np.full(count, drive, dtype=np.int64),
        wrong=np.full(count, wrong, dtype=np.bool_),
    )


def _entry(name: str, algorithm: Algorithm, fitted: Fitted) -> IntervalEntry:
    return IntervalEntry(
        estimator=name,
        algorithm=algorithm,
        inflation=fitted.inflation,
        unseen_factor=fitted.unseen_factor,
        coverage=tuple(asdict(c) for c in fitted.coverage),
    )


def _intervals(
    settings: CalibrateSettings, car: Car, entries: Sequence[IntervalEntry], records: Sequence[DriveRecord]
) -> Intervals:
    """Return the part that is written; no date, so that the same command gives the same bytes."""
    return Intervals(
        car=car.vehicle.name,
        physics_sha256=car.physics_sha256,
        roll_gradient_rad_per_m_s2=car.vehicle.roll_gradient_rad_per_m_s2,
        spread=settings.spread,
        entries=tuple(entries),
        settings=settings.to_dict(),
        fit={
            "covered": COVERED,
            "folds": FOLDS,
            "wrong_runs": WRONG_RUNS,
            "sample_every_s": SAMPLE_EVERY_S,
        },
        drives=tuple(r.learnt_on for r in records if not r.left_out),
        versions=tool_versions(),
    )
