"""Prior and residual of a car from drives with ground truth.

All driving with ground truth above the car's low-speed limit is used. First, the prior for the calibration of later
drives is fitted. Then the drives calibrate the car like later drives, without ground truth, and residual models of
increasing order are fitted to the sideslip error of ``physics`` (docs/learn.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from pdhef_logtool.car.model import ESTIMATED, GROUND_TRUTH, TaughtParameter
from pdhef_logtool.car.parts import PHYSICS
from pdhef_logtool.car.posterior import Posterior
from pdhef_logtool.drive.reading import Drive, WholeDrive
from pdhef_logtool.estimators.adaptive_physics import AdaptivePhysics
from pdhef_logtool.estimators.checked_inputs import without_bursts
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.parallel_physics import run_features
from pdhef_logtool.estimators.residual_response import residual_response
from pdhef_logtool.estimators.table import FEATURES, make_estimator
from pdhef_logtool.evaluation.metrics import signal_error
from pdhef_logtool.learning.drives import DriveRecord, record_of
from pdhef_logtool.learning.truth import teaching_reference, weight_of, with_truth
from pdhef_logtool.model.drive_model import DriveModel, for_later_drives, lacking, read_driving
from pdhef_logtool.model.driving import STEP_S, Driving
from pdhef_logtool.model.fit import fit_car
from pdhef_logtool.model.priors import TYRES
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.steps import release
from pdhef_logtool.records.tracks import REFERENCE, StateTrack
from pdhef_logtool.residual_model.features import SlowFeatures, slow_features
from pdhef_logtool.residual_model.ladder import NONE
from pdhef_logtool.residual_model.ladder_fit import LadderFit, TaughtDrive, fit_ladder
from pdhef_logtool.runs.config import RunConfig

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
