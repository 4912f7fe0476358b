"""``pdhef learn``: the model of a car (``model.toml``) from its drives, with or without ground truth.

The posterior of each drive informs later drives (:mod:`pdhef_logtool.model.priors`). Drives with ground truth also
give a residual, which is chosen on held-out driving (:mod:`~.learn`).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.model import ESTIMATED, GROUND_TRUTH, CarModel
from pdhef_logtool.car.names import MODEL_FILE
from pdhef_logtool.car.parts import PHYSICS
from pdhef_logtool.car.posterior import Posterior
from pdhef_logtool.car.store import check_output, update_car
from pdhef_logtool.drive.reading import Drive, WholeDrive, read_drive
from pdhef_logtool.estimators.adaptive_physics import AdaptivePhysics
from pdhef_logtool.estimators.checked_inputs import without_bursts
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.parallel_physics import run_features
from pdhef_logtool.estimators.residual_response import residual_response
from pdhef_logtool.estimators.table import FEATURES, make_estimator
from pdhef_logtool.evaluation.track_errors import signal_error
from pdhef_logtool.learning.drives import (
    DriveRecord,
    LearnSettings,
    chosen_logs,
    drives_document,
    exit_code,
    record_of,
    tell_drive,
)
from pdhef_logtool.learning.truth import teaching_reference, weight_of, with_truth
from pdhef_logtool.logs.discovery import LogInput, Logs
from pdhef_logtool.mapping import mapping_of
from pdhef_logtool.model.drive_model import DriveModel, for_later_drives, lacking, model_of, read_driving
from pdhef_logtool.model.driving import STEP_S, Driving
from pdhef_logtool.model.fit import fit_car
from pdhef_logtool.model.priors import TYRES
from pdhef_logtool.records.errors import EstimatorError, UsageError
from pdhef_logtool.records.reporter import SILENT, Reporter
from pdhef_logtool.records.signals import S_PER_NS
from pdhef_logtool.records.steps import release
from pdhef_logtool.records.tracks import REFERENCE, StateTrack
from pdhef_logtool.residual_model.bundle import NO_MODEL
from pdhef_logtool.residual_model.features import slow_features
from pdhef_logtool.residual_model.ladder import NONE
from pdhef_logtool.residual_model.ladder_fit import TaughtDrive, fit_ladder
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
        reporter.warn(f"no --car: mass, geometry and priors come from the default {source.vehicle.name}")
    check_output(source, output)
    splits = chosen_logs(arguments, settings)
    read = [*(i.local for i in splits), *(path for path in config.files if path != config.car)]
    check_no_input(read, [], [output])
    records, model, figures = _learnt(splits, Car(source.vehicle), config, reporter.progress)
    for record in records:
        tell_drive(record, reporter.warn)
    learnt_on = tuple(r.learnt_on for r in records if not r.left_out)
    text = model.model_copy(update={"drives": learnt_on}).toml(f"Written by pdhef learn.\n{model.evidence}")
    update_car(source, output, {MODEL_FILE: text.encode()})
    reporter.progress("done", 1.0)
    return LearnResult(output, records, model.evidence, figures)


def _learnt(
    splits: Mapping[LogInput, str], car: Car, config: RunConfig, progress: Callable[[str, float], None]
) -> tuple[tuple[DriveRecord, ...], CarModel, dict[str, Any]]:
    """Return the records of drives, their model, and figures."""
    mapping, opened, records = mapping_of(config.mapping), list[OpenedDrive](), tuple[DriveRecord, ...]()
    for log, split in splits.items():
        progress(f"reading {log.stem}", 0.3 * len(records) / len(splits))
        with read_drive(log, car, mapping, config.read_options) as drive:
            record, content = open_drive(drive, config)
        opened.append(content)
        records += (replace(record, split=split or None),)
    teachers = [d for d in opened if d.whole is not None]
    if not teachers and config.reference != "on":
        return _without_truth(records, opened, car)
    _check("" if teachers else "none", "at least one drive with a true sideslip and the signals of a calibration")
    slopes = [d.driving.slopes for d in teachers if d.driving is not None and d.driving.slopes is not None]
    seconds, slow = STEP_S * sum(np.isfinite(s).sum() for s in slopes), car.vehicle.low_speed_blend_m_s
    few = "" if seconds >= LEAST_S else f"{seconds:.1f} s"
    _check(few, f"at least {LEAST_S:g} s of driving with ground truth above {slow:g} m/s")
    return records, *learn_from(teachers, progress)


def _without_truth(
    records: Sequence[DriveRecord], drives: "Sequence[OpenedDrive]", car: Car
) -> tuple[tuple[DriveRecord, ...], CarModel, dict[str, Any]]:
    """Return the records of drives without ground truth, their model, and figures."""
    fits = [None if d.driving is None else fit_car(d.driving, car.vehicle) for d in drives]
    left_out = [r.left_out if fit is None else fit.refused for r, fit in zip(records, fits, strict=True)]
    records = tuple(replace(r, left_out=reason) for r, reason in zip(records, left_out, strict=True))
    used = [(fit, d.drive.plan.sensors) for fit, d in zip(fits, drives, strict=True) if fit and not fit.refused]
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
    """A drive: its reader, the driving for the calibration, and its signals in memory if it has the true sideslip.

    ``driving`` is None if a signal of the calibration is missing.
    """

    drive: Drive
    driving: Driving | None
    whole: WholeDrive | None = None

    @property
    def truth(self) -> StateTrack:
        """The true sideslip."""
        assert self.whole is not None and self.whole.truth is not None
        return self.whole.truth


def open_drive(drive: Drive, config: RunConfig) -> tuple[DriveRecord, OpenedDrive]:
    """Return the record of an open drive and its content; the record has the reason if it does not teach."""
    if missing := sorted({*lacking(drive), *(FEATURES - drive.available)}):
        truth_at, lacks = None, f"the log has no {', '.join(missing)}"
    else:
        truth_at, lacks = teaching_reference(drive, config)
    driving = None if lacking(drive) else read_driving(drive)
    if driving is not None and not lacks:
        whole = drive.whole()
        if truth_at is not None:
            whole = replace(whole, truth=truth_at(whole.signals.stamps_ns))
        assert whole.truth is not None
        taught = with_truth(driving, whole.truth)
        if np.isfinite(taught.slopes).any():  # type: ignore[arg-type]
            record = record_of(drive, whole=whole)
            record = record if truth_at is None else replace(record, truth=(ESTIMATED,))
            return record, OpenedDrive(drive, taught, whole)
        lacks = "no driving with a true sideslip above the low-speed limit"
    start_s, end_s = ((t - drive.log.start_ns) * S_PER_NS for t in (drive.plan.start_ns, drive.plan.end_ns))
    record = replace(record_of(drive, left_out=lacks), seconds=end_s - start_s, span_s=(start_s, end_s))
    return record, OpenedDrive(drive, driving)


def learn_from(
    drives: Sequence[OpenedDrive], progress: Callable[[str, float], None] = lambda _text, _share: None
) -> tuple[CarModel, dict[str, Any]]:
    """Return the model of a car, with prior and residual, and figures, from drives that were read with its file."""
    progress("fitting the prior", 0.3)
    car = drives[0].drive.car
    driven = [d.driving for d in drives if d.driving is not None]
    fits = (fit_car(driving, car.vehicle) for driving in driven)
    parameters = tuple(p for fit in fits if not fit.refused for p in for_later_drives(fit, TYRES))
    calibrations = [fit_car(replace(driving, slopes=None), car.vehicle, parameters) for driving in driven]
    progress("fitting the residual", 0.8)
    lacks = [lacking_of(d, c) for d, c in zip(drives, calibrations, strict=True)]
    seconds = {False: 0.0, True: 0.0}
    for driving, calibration in zip(driven, calibrations, strict=True):
        seconds[not calibration.refused] += driving.seconds
    calibrated = seconds[True] >= seconds[False]  # calibrated and uncalibrated physics differ
    ladder = fit_ladder(
        [lack for lack, c in zip(lacks, calibrations, strict=True) if calibrated is not bool(c.refused)]
    )
    truth = " and ".join(sorted({ESTIMATED if d.truth.name == REFERENCE else GROUND_TRUTH for d in drives}))
    tried = ", ".join(f"{t.rung} {t.rmse_deg:.3f}°" for t in ladder.trials)
    rung = "no residual" if ladder.rung == NONE else f"residual model {ladder.rung}"
    evidence = (
        f"{rung}, taught by {truth}, by held-out blocks of {ladder.seconds:.0f} s"
        f" (RMSE without constants: {tried or 'not tried'})"
    )
    stated = {"evidence": evidence, "calibrated": calibrated, "truth": truth}
    model = model_of(car, drives[0].drive.plan.sensors, parameters=parameters, residual=ladder.model, **stated)
    tested = {"rung": ladder.rung, "seconds": round(ladder.seconds, 1), "blocks": ladder.blocks}
    return model, stated | tested | {"rungs": [asdict(t) for t in ladder.trials]}


def lacking_of(drive: OpenedDrive, calibration: Posterior) -> TaughtDrive:
    """Return features, sideslip error of ``physics`` on the calibrated car, and response of a drive."""
    model = DriveModel.of(drive.drive, calibration)
    car = model.car
    physics, whole = make_estimator(PHYSICS, car), drive.whole
    assert isinstance(physics, AdaptivePhysics) and whole is not None
    signals = model.apply(whole.signals).calibrated
    arrived = release(signals.ready_ns, signals.stamps_ns)
    track = run_estimator(physics, signals)
    extra_r = np.nan_to_num(signals.extra_variance)
    table, dt_s, *_ = run_features(physics.physics, signals, None, seen=without_bursts(signals), extra_r=extra_r)
    features, _ = slow_features(table, dt_s, None)
    error = signal_error(track, drive.truth, "sideslip_rad", car.vehicle.low_speed_blend_m_s)
    settled = signals.stamps_ns - signals.stamps_ns[0] > SETTLE_NS
    error = np.where(arrived.arrived & settled, error, np.nan)
    response = residual_response(physics, signals, arrived.step)
    weight = weight_of(np.nan_to_num(drive.truth.sideslip_std_rad))
    return TaughtDrive(drive.drive.name, signals.stamps_ns, features, -error, response, weight)
