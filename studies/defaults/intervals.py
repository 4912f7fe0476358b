"""95 % intervals of the estimators of the shipped car, by the algorithm that ran (``intervals.json``)."""

from __future__ import annotations

import itertools
from dataclasses import asdict, replace

import numpy as np

from pdhef_logtool.car.parts import Algorithm, IntervalEntry, Intervals
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters
from pdhef_logtool.drive.reading import friction_of
from pdhef_logtool.estimators.algorithm import resolve
from pdhef_logtool.estimators.drive_signals import DriveSignals
from pdhef_logtool.estimators.error_features import error_terms
from pdhef_logtool.estimators.intervals import yaw_rate_terms
from pdhef_logtool.estimators.table import ALL_ESTIMATORS, Options, runnable
from pdhef_logtool.evaluation.metrics import signal_error
from pdhef_logtool.evaluation.segments import GRIP_SMOOTHING_HZ
from pdhef_logtool.evaluation.smoothing import smooth
from pdhef_logtool.learning.drives import DriveRecord, DriveSet
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.results.run_report import tool_versions
from pdhef_logtool.runs.estimating import estimate_drive
from studies.defaults.drives import SEED, load_drive
from studies.defaults.interval_fit import (
    COVERED,
    FOLDS,
    MIN_DRIVES,
    Samples,
    bin_numbers,
    fit_inflation,
    join_samples,
)
from studies.defaults.variation import made_wrong

#: Neighbouring errors are correlated: one sample in this time is kept.
SAMPLE_EVERY_S = 0.05
#: Runs of each drive with wrong friction and vehicle.
WRONG_RUNS = 2
#: A drive with fewer kept samples does not count.
MIN_SAMPLES = 20

_Ran = list[tuple[str, Algorithm, Samples]]


def fit_intervals(task: DriveSet, spread: float) -> Intervals:
    """Return the intervals of every algorithm that has enough drives.

    ``spread`` : 1-sigma of the random errors of friction and vehicle in further runs of each drive.
    """
    numbers = itertools.count()
    records, ran = task.read(lambda log: _run_drive(log, next(numbers), task, spread))
    names: dict[str, tuple[str, Algorithm]] = {}
    samples: dict[str, list[Samples]] = {}
    for name, algorithm, part in itertools.chain.from_iterable(ran):
        names.setdefault(algorithm.identity, (name, algorithm))
        samples.setdefault(algorithm.identity, []).append(part)
    entries: list[IntervalEntry] = []
    for identity, parts in samples.items():
        name, algorithm = names[identity]
        joined = join_samples(parts)
        if np.unique(joined.drive[~joined.wrong]).size < MIN_DRIVES:
            print(f"{name} is not calibrated: at least {MIN_DRIVES} drives are needed", flush=True)
            continue
        fitted = fit_inflation(joined)
        entries.append(
            IntervalEntry(
                estimator=name,
                algorithm=algorithm,
                inflation=fitted.inflation,
                unseen_factor=fitted.unseen_factor,
                coverage=tuple(asdict(c) for c in fitted.coverage),
            )
        )
    if not entries:
        raise SystemExit(f"intervals: at least {MIN_DRIVES} drives with a true sideslip are needed, got {len(ran)}")
    vehicle = task.car.vehicle
    return Intervals(
        car=vehicle.name,
        physics_sha256=task.car.physics_sha256,
        roll_gradient_rad_per_m_s2=vehicle.roll_gradient_rad_per_m_s2,
        spread=spread,
        entries=tuple(entries),
        settings={"seed": SEED, "split": task.settings.split},
        fit={"covered": COVERED, "folds": FOLDS, "wrong_runs": WRONG_RUNS, "sample_every_s": SAMPLE_EVERY_S},
        drives=tuple(r.learnt_on for r in records if not r.left_out),
        versions=tool_versions(),
    )


def _run_drive(log: LogInput, number: int, task: DriveSet, spread: float) -> tuple[DriveRecord, _Ran | None]:
    """Run the estimators on a drive, once as given and some times with a wrong vehicle; return errors and terms."""
    car, vehicle, options = task.car, task.car.vehicle, task.settings.config.read_options
    record, drive = load_drive(log, task, fill_friction=False)
    if drive is None or drive.truth is None:
        return record, None
    signals = drive.signals
    runs = [(vehicle, 1.0, False)]
    if spread > 0.0:
        draws = itertools.islice(made_wrong(vehicle, spread, f"{SEED}:{record.sha256}"), WRONG_RUNS)
        runs += [(*draw, True) for draw in draws]
    ran: _Ran = []
    for assumed, factor, wrong in runs:
        source = friction_of(drive.plan, assumed, options, validated=car.has_evidence)
        seen = source.fill(drive.signals)
        if source.from_log:
            seen = replace(seen, friction=factor * seen.friction)
        if not ran and "friction" not in drive.plan.alignment.available:
            signals = replace(signals, friction=seen.friction)  # the best that is known of the drive, for the bins
        presumed = car if assumed is vehicle else car.with_vehicle(assumed)
        available = drive.plan.alignment.available
        estimators, _ = runnable((ALL_ESTIMATORS,), presumed, available, Options(options.use_speed))
        corrected = DriveSignals.of(seen, presumed)
        estimated = estimate_drive(replace(drive, signals=seen), corrected, estimators, watched=False, drawn=False)
        for estimator in estimators:
            track = estimated.tracks[estimator.name]
            part = drive_samples(track, seen, signals, drive.truth, vehicle, number, wrong=wrong)
            if len(part) >= MIN_SAMPLES:
                ran.append((track.name, resolve(estimator), part))
    if not ran:
        return replace(record, left_out="no estimate with an interval where the ground truth is known"), None
    return record, ran


def drive_samples(
    track: StateTrack,
    given: Signals,
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
    given : signals that the estimator had; the terms come from them.
    signals : with the friction of the drive, for the bins.
    vehicle : the right one; its roll gradient and lowest speed count.
    """
    slow = vehicle.low_speed_blend_m_s
    terms = error_terms(track, given, vehicle.roll_gradient_rad_per_m_s2)
    error = {s: signal_error(track, truth, s, slow) for s in ("sideslip_rad", "vy_m_s", "yaw_rate_rad_s")}
    sideslip_std, rate_std = track.sideslip_std_rad, track.yaw_rate_std_rad_s
    use = np.isfinite(sideslip_std) & (sideslip_std > 0.0) & np.isfinite(track.vy_std_m_s) & np.isfinite(rate_std)
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
        vy_per_sideslip=track.vy_std_m_s[kept] / sideslip_std[kept],
        sideslip_error=error["sideslip_rad"][kept],
        vy_error=error["vy_m_s"][kept],
        yaw_rate_error=error["yaw_rate_rad_s"][kept],
        own_std=sideslip_std[kept],
        bin=bins[kept],
        drive=np.full(count, drive, dtype=np.int64),
        wrong=np.full(count, wrong, dtype=np.bool_),
    )
