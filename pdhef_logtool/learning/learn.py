"""``pdhef learn``: the model of a car (``model.toml``) from its drives, with or without ground truth.

The posterior of each drive informs later drives (:mod:`pdhef_logtool.model.priors`). Drives with ground truth also
give a residual, which is chosen on held-out driving (:mod:`~.learn`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.model import ESTIMATED, GROUND_TRUTH, CarModel, TaughtParameter
from pdhef_logtool.car.names import MODEL_FILE
from pdhef_logtool.car.parts import PHYSICS
from pdhef_logtool.car.posterior import Posterior
from pdhef_logtool.car.store import check_output, update_car
from pdhef_logtool.drive.plan import Sensors
from pdhef_logtool.drive.reading import Drive, WholeDrive, read_drive
from pdhef_logtool.estimators.adaptive_physics import AdaptivePhysics
from pdhef_logtool.estimators.checked_inputs import without_bursts
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.parallel_physics import run_features
from pdhef_logtool.estimators.residual_response import residual_response
from pdhef_logtool.estimators.table import FEATURES, make_estimator
from pdhef_logtool.evaluation.metrics import signal_error
from pdhef_logtool.learning.drives import (
    DriveRecord,
    DriveSet,
    LearnSettings,
    drives_document,
    exit_code,
    record_of,
    tell_drive,
)
from pdhef_logtool.learning.truth import teaching_reference, weight_of, with_truth
from pdhef_logtool.logs.discovery import LogInput, Logs
from pdhef_logtool.model.drive_model import DriveModel, for_later_drives, lacking, model_of, read_driving
from pdhef_logtool.model.driving import STEP_S, Driving
from pdhef_logtool.model.fit import fit_car
from pdhef_logtool.model.priors import TYRES
from pdhef_logtool.records.errors import EstimatorError, UsageError
from pdhef_logtool.records.reporter import SILENT, Reporter
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.steps import release
from pdhef_logtool.records.tracks import REFERENCE, StateTrack
from pdhef_logtool.residual_model.bundle import NO_MODEL
from pdhef_logtool.residual_model.features import SlowFeatures, slow_features
from pdhef_logtool.residual_model.ladder import NONE
from pdhef_logtool.residual_model.ladder_fit import LadderFit, TaughtDrive, fit_ladder
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.storage.outputs import check_no_input, local_path


@dataclass(frozen=True, slots=True, eq=False)
class LearnResult:
    """The folder of the car, a record of every drive, a summary line, and figures as JSON-able values."""

    car: Path
    records: tuple[DriveRecord, ...]
    text: str
    figures: dict[str, Any]

    @property
    def exit_code(self) -> int:
        """0 if all drives were used completely, 3 otherwise."""
        return exit_code(self.records)

    @property
    def drives(self) -> tuple[DriveRecord, ...]:
        """Drives that were used."""
        return tuple(r for r in self.records if not r.left_out)

    def to_dict(self) -> dict[str, Any]:
        """Return the result as one JSON-able document."""
        shared = {"car": str(self.car), "exit_code": self.exit_code, **drives_document(self.records)}
        return {**shared, "text": self.text, "figures": self.figures}


def learn(arguments: Logs, output: Path | str, settings: LearnSettings, *, reporter: Reporter = SILENT) -> LearnResult:
    """Learn a car from drives and write it to the folder ``output``.

    Drives with ground truth teach; the others are used if there is no such drive.

    Parameters
    ----------
    arguments : logs, folders, glob patterns.

    Raises
    ------
    UsageError
        An option is wrong, or the set of a drive excludes it from learning.
    PdhefError
        A file or log cannot be read; without it the result would differ.
    EstimatorError
        There is too little driving.
    """
    output, config = local_path(output), settings.config
    if output.suffix in (".toml", ".json"):
        raise UsageError(
            expected="a car's folder", got=output.name, where="--output", remedy="a car has more than a file contains"
        )
    source = Car.load(config.car, network=NO_MODEL)
    if config.car is None:
        reporter.warn(f"no --car: mass, geometry and priors come from the default {source.datasheet.name}")
    check_output(source, output)
    drives = DriveSet.of(arguments, Car.of(source.datasheet), settings, reporter)
    read = [*(i.local for i in drives.logs), *(path for path in config.files if path != config.car)]
    check_no_input(read, [], [output])
    records, model, figures = _learnt(drives)
    for record in records:
        tell_drive(record, reporter.warn)
    learnt_on = tuple(r.learnt_on for r in records if not r.left_out)
    text = model.model_copy(update={"drives": learnt_on}).toml(f"Written by pdhef learn.\n{model.evidence}")
    update_car(source, output, {MODEL_FILE: text.encode()})
    reporter.progress("done", 1.0)
    return LearnResult(output, records, model.evidence, figures)


#: Driving and sensors of a drive, and its content for teaching, None without ground truth.
_Read: TypeAlias = "tuple[Driving | None, Sensors, OpenedDrive | None]"


def _learnt(drives: DriveSet) -> tuple[tuple[DriveRecord, ...], CarModel, dict[str, Any]]:
    """Return the records of drives, their model, and figures."""
    config, car, progress = drives.settings.config, drives.car, drives.reporter.progress

    def read(log: LogInput) -> tuple[DriveRecord, _Read]:
        with read_drive(log, car, drives.mapping, config.read_options) as drive:
            record, opened = open_drive(drive, config)
            if opened is not None:
                return record, (opened.driving, drive.plan.sensors, opened)
            start_s, end_s = ((t - drive.log.start_ns) * 1e-9 for t in (drive.plan.start_ns, drive.plan.end_ns))
            driving = None if lacking(drive) else read_driving(drive)
            record = replace(record, seconds=end_s - start_s, span_s=(start_s, end_s))
            return record, (driving, drive.plan.sensors, None)

    records, content = drives.read(read, 0.3)
    teachers = [opened for *_, opened in content if opened is not None]
    if not teachers and config.reference != "on":
        return _without_truth(records, content, car)
    _check("" if teachers else "none", "at least one drive with a true sideslip and the signals of a calibration")
    seconds, slow = math.fsum(d.seconds for d in teachers), car.vehicle.low_speed_blend_m_s
    few = "" if seconds >= LEAST_S else f"{seconds:.1f} s"
    _check(few, f"at least {LEAST_S:g} s of driving with ground truth above {slow:g} m/s")
    taught = learn_from(teachers, progress)
    sensors = teachers[0].drive.plan.sensors
    stated = {name: getattr(taught, name) for name in ("parameters", "calibrated", "truth", "evidence")}
    return records, model_of(car, sensors, residual=taught.ladder.model, **stated), figures_of(taught)


def _without_truth(
    records: Sequence[DriveRecord], content: Sequence[_Read], car: Car
) -> tuple[tuple[DriveRecord, ...], CarModel, dict[str, Any]]:
    """Return the records of drives without ground truth, their model, and figures."""
    fits = [None if driving is None else fit_car(driving, car.vehicle) for driving, *_ in content]
    left_out = [r.left_out if fit is None else fit.refused for r, fit in zip(records, fits, strict=True)]
    records = tuple(replace(r, left_out=reason) for r, reason in zip(records, left_out, strict=True))
    used = [(fit, of[1]) for fit, of in zip(fits, content, strict=True) if fit is not None and not fit.refused]
    _check(
        "" if used else next(iter(left_out), "no drive"),
        "driving that calibrates the car, such as lane changes and bends",
    )
    seconds = math.fsum(fit.seconds for fit, _ in used)
    evidence = f"calibrated without ground truth on {seconds:.0f} s of driving"
    parameters = tuple(p for fit, _ in used for p in for_later_drives(fit))
    model = model_of(car, used[0][1], parameters=parameters, evidence=evidence)
    return records, model, {"self_calibration": [fit.to_dict() for fit, _ in used]}


def _check(got: str, expected: str) -> None:
    """Raise EstimatorError if ``got`` states a lack of the drives."""
    if got:
        remedy = "give more drives of this car, or map v_y, sideslip, or position and heading as ground truth"
        raise EstimatorError(expected=expected, got=got, where="learn", remedy=remedy)


#: Minimum driving with ground truth.
LEAST_S = 20.0
#: Settling time of a filter, which is excluded from scoring.
SETTLE_NS = 3_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class OpenedDrive:
    """A drive in memory: its reader, its signals with the true sideslip, and the driving for the calibration."""

    drive: Drive
    whole: WholeDrive
    driving: Driving

    @property
    def truth(self) -> StateTrack:
        """The true sideslip."""
        assert self.whole.truth is not None
        return self.whole.truth

    @property
    def seconds(self) -> float:
        """Duration of usable driving."""
        assert self.driving.slopes is not None
        return float(np.count_nonzero(np.isfinite(self.driving.slopes))) * STEP_S


@dataclass(frozen=True, slots=True, eq=False)
class Teaching:
    """Result of teaching: parameters of each drive, residual, whether the drives calibrated their car."""

    parameters: tuple[TaughtParameter, ...]
    ladder: LadderFit
    calibrated: bool
    truth: str

    @property
    def evidence(self) -> str:
        """The evidence in one line."""
        tried = ", ".join(f"{t.rung} {t.rmse_deg:.3f}°" for t in self.ladder.trials)
        rung = "no residual" if self.ladder.rung == NONE else f"residual model {self.ladder.rung}"
        return (
            f"{rung}, taught by {self.truth}, by held-out blocks of {self.ladder.seconds:.0f} s"
            f" (RMSE without constants: {tried or 'not tried'})"
        )


def open_drive(drive: Drive, config: RunConfig) -> tuple[DriveRecord, OpenedDrive | None]:
    """Return the record of an open drive and its content for teaching, or None with the reason in the record."""
    missing = sorted({*lacking(drive), *(FEATURES - drive.available)})
    truth_at, lacks = (None, f"the log has no {', '.join(missing)}") if missing else teaching_reference(drive, config)
    if lacks:
        return record_of(drive, left_out=lacks), None
    whole = drive.whole()
    if truth_at is not None:
        whole = replace(whole, truth=truth_at(whole.signals.stamps_ns))
    assert whole.truth is not None
    driving = with_truth(read_driving(drive), whole.truth)
    if not np.isfinite(driving.slopes).any():  # type: ignore[arg-type]
        return record_of(drive, left_out="no driving with a true sideslip above the low-speed limit"), None
    record = record_of(drive, whole=whole)
    return record if truth_at is None else replace(record, truth=(ESTIMATED,)), OpenedDrive(drive, whole, driving)


def learn_from(drives: Sequence[OpenedDrive], progress: Any = lambda _text, _share: None) -> Teaching:
    """Return prior and residual from drives of one car, read with its vehicle file."""
    progress("fitting the prior", 0.3)
    vehicle = drives[0].drive.car.vehicle
    fits = (fit_car(d.driving, vehicle) for d in drives)
    parameters = tuple(p for fit in fits if not fit.refused for p in for_later_drives(fit, TYRES))
    calibrations = [fit_car(replace(d.driving, slopes=None), vehicle, parameters) for d in drives]
    progress("fitting the residual", 0.8)
    lacks = [lacking_of(d, c) for d, c in zip(drives, calibrations, strict=True)]
    seconds = {False: 0.0, True: 0.0}
    for drive, calibration in zip(drives, calibrations, strict=True):
        seconds[not calibration.refused] += drive.driving.seconds
    calibrated = seconds[True] >= seconds[False]  # calibrated and uncalibrated physics differ
    fitted = [lack for lack, c in zip(lacks, calibrations, strict=True) if calibrated is not bool(c.refused)]
    ladder = fit_ladder(fitted)
    truth = " and ".join(sorted({ESTIMATED if d.truth.name == REFERENCE else GROUND_TRUTH for d in drives}))
    return Teaching(parameters, ladder, calibrated, truth)


def lacking_of(drive: OpenedDrive, calibration: Posterior) -> TaughtDrive:
    """Return features, sideslip error of ``physics`` on the calibrated car, and response of a drive."""
    model = DriveModel.of(drive.drive, calibration)
    car = model.car
    physics, signals = make_estimator(PHYSICS, car), model.apply(drive.whole.signals).calibrated
    assert isinstance(physics, AdaptivePhysics)
    arrived = release(signals.ready_ns, signals.stamps_ns)
    track = run_estimator(physics, signals)
    features = features_of(physics, signals)
    error = signal_error(track, drive.truth, "sideslip_rad", car.vehicle.low_speed_blend_m_s)
    settled = signals.stamps_ns - signals.stamps_ns[0] > SETTLE_NS
    error = np.where(arrived.arrived & settled, error, np.nan)
    response = residual_response(physics, signals, arrived.step)
    weight = weight_of(np.nan_to_num(drive.truth.sideslip_std_rad))
    return TaughtDrive(drive.drive.name, signals.stamps_ns, features, -error, response, weight)


def features_of(physics: AdaptivePhysics, signals: Signals) -> SlowFeatures:
    """Return the features of a drive's steps, as the filter in service computes them."""
    extra_r = np.nan_to_num(signals.extra_variance)
    table, dt_s, *_ = run_features(physics.physics, signals, None, seen=without_bursts(signals), extra_r=extra_r)
    return slow_features(table, dt_s, None)[0]


def figures_of(taught: Teaching) -> dict[str, Any]:
    """Return the figures as JSON-able values."""
    ladder = taught.ladder
    return {
        "evidence": taught.evidence,
        "rung": ladder.rung,
        "seconds": round(ladder.seconds, 1),
        "blocks": ladder.blocks,
        "rungs": [asdict(t) for t in ladder.trials],
        "calibrated": taught.calibrated,
        "truth": taught.truth,
    }
