"""Prior and residual of a car from drives with ground truth.

All driving with ground truth above the car's low-speed limit is used. First, the prior for the calibration of later
drives is fitted. Then the drives calibrate the car like later drives, without ground truth, and residual models of
increasing order are fitted to the sideslip error of ``physics`` (docs/learn.md).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, TypeAlias

import numpy as np

from pdhef_logtool.car.model import ESTIMATED, GROUND_TRUTH, TaughtParameter
from pdhef_logtool.car.parts import PHYSICS
from pdhef_logtool.drive.reading import Drive, WholeDrive
from pdhef_logtool.estimators.adaptive_physics import AdaptivePhysics
from pdhef_logtool.estimators.calibration.calibration import SelfCalibration, self_calibrate
from pdhef_logtool.estimators.calibration.driving import STEP_S
from pdhef_logtool.estimators.calibration.joint import level_of, like_drives
from pdhef_logtool.estimators.latency_compensation import compensate
from pdhef_logtool.estimators.parallel_physics import run_features
from pdhef_logtool.estimators.residual_response import residual_response
from pdhef_logtool.estimators.table import FEATURES, make_estimator
from pdhef_logtool.evaluation.bootstrap import Interval, block_bootstrap_difference
from pdhef_logtool.evaluation.metrics import NORMAL_95, signal_error
from pdhef_logtool.evaluation.requirement_blocks import BLOCK_S
from pdhef_logtool.learning.drives import DriveRecord, record_of
from pdhef_logtool.learning.taught_prior import TaughtDriving, taught_driving, taught_parameters
from pdhef_logtool.learning.truth import teaching_reference, weight_of
from pdhef_logtool.model.drive_model import DriveModel, lacking, read_driving
from pdhef_logtool.records.signals import FloatArray, IntArray, Signals
from pdhef_logtool.records.steps import release
from pdhef_logtool.records.tracks import REFERENCE, StateTrack
from pdhef_logtool.residual_model.features import SlowFeatures, slow_features
from pdhef_logtool.residual_model.ladder import NONE
from pdhef_logtool.residual_model.ladder_fit import (
    LadderFit,
    TaughtDrive,
    fit_ladder,
)
from pdhef_logtool.runs.config import RunConfig

#: Minimum driving with ground truth.
LEAST_S = 20.0
#: Settling time of a filter, which is excluded from scoring.
SETTLE_NS = 3_000_000_000
#: Minimum length of each half of a drive that is split for a test, and block length of a test.
LEAST_HALF_S, TEST_BLOCK_S = 8.0, 5.0
#: Maximum number of drives for the leave-one-out test of the prior.
MOST_LEFT_OUT = 8


@dataclass(frozen=True, slots=True, eq=False)
class OpenedDrive:
    """A drive in memory: its reader, its signals with the true sideslip, and the driving for the calibration."""

    drive: Drive
    whole: WholeDrive
    taught: TaughtDriving

    @property
    def truth(self) -> StateTrack:
        """The true sideslip."""
        assert self.whole.truth is not None
        return self.whole.truth

    @property
    def seconds(self) -> float:
        """Duration of usable driving."""
        return float(np.count_nonzero(np.isfinite(self.taught.slopes))) * STEP_S


@dataclass(frozen=True, slots=True, eq=False)
class TestedPrior:
    """Prior from similar driving at a level of a_y, its test, and the probability that it reduces errors elsewhere."""

    level_m_s2: float
    test: Interval | None
    support: float
    parameters: tuple[TaughtParameter, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Teaching:
    """Result of teaching: priors, parameters, residual, whether the drives calibrated their car."""

    priors: tuple[TestedPrior, ...]
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

    @property
    def entries(self) -> dict[str, Any]:
        """Entries of the car's model."""
        return {
            "parameters": self.parameters,
            "residual": self.ladder.model,
            "calibrated": self.calibrated,
            "truth": self.truth,
            "evidence": self.evidence,
        }


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
    taught = taught_driving(read_driving(drive), whole.truth)
    if not np.isfinite(taught.slopes).any():
        return record_of(drive, left_out="no driving with a true sideslip above the low-speed limit"), None
    record = record_of(drive, whole=whole)
    return record if truth_at is None else replace(record, truth=(ESTIMATED,)), OpenedDrive(drive, whole, taught)


def learn_from(drives: Sequence[OpenedDrive], progress: Any = lambda _text, _share: None) -> Teaching:
    """Return prior and residual from drives of one car, read with its vehicle file."""
    progress("fitting the prior", 0.3)
    groups = like_drives([level_of([d.taught.driving]) for d in drives])
    priors = tuple(_prior_of([drives[k] for k in group], progress) for group in groups)
    parameters = tuple(p for prior in priors for p in prior.parameters)
    calibrations = [_calibration(d, parameters) for d in drives]
    progress("fitting the residual", 0.8)
    lacks = [lacking_of(d, c) for d, c in zip(drives, calibrations, strict=True)]
    seconds = {False: 0.0, True: 0.0}
    for drive, calibration in zip(drives, calibrations, strict=True):
        seconds[not calibration.refused] += drive.taught.driving.seconds
    calibrated = seconds[True] >= seconds[False]  # calibrated and uncalibrated physics differ
    fitted = [lack for lack, c in zip(lacks, calibrations, strict=True) if calibrated is not bool(c.refused)]
    ladder = fit_ladder(fitted)
    truth = " and ".join(sorted({ESTIMATED if d.truth.name == REFERENCE else GROUND_TRUTH for d in drives}))
    return Teaching(priors, parameters, ladder, calibrated, truth)


def _prior_of(drives: Sequence[OpenedDrive], progress: Any) -> TestedPrior:
    """Return the prior from similar drives with its test; without parameters if the test does not support it."""
    test, taught = _prior_test(drives, progress), [d.taught for d in drives]
    support, level = _support(test), float(f"{level_of([d.driving for d in taught]):.4g}")
    parameters = taught_parameters(taught, drives[0].drive.car.vehicle, support) if support > 0.0 else ()
    return TestedPrior(level, test, support, parameters)


def _calibration(drive: OpenedDrive, parameters: Sequence[TaughtParameter]) -> SelfCalibration:
    calibration = self_calibrate([drive.taught.driving], drive.drive.car.vehicle, taught=parameters)
    return replace(calibration, varied=())


def lacking_of(drive: OpenedDrive, calibration: SelfCalibration) -> TaughtDrive:
    """Return the features of a drive, the sideslip error of ``physics`` on its calibrated car, and its response."""
    model = DriveModel.of(drive.drive, calibration)
    car = model.car
    physics, signals = make_estimator(PHYSICS, car), model.apply(drive.whole.signals).calibrated
    assert isinstance(physics, AdaptivePhysics)
    steps, _ = physics.run(signals, None)
    track, _ = compensate(physics, signals, steps)
    features = features_of(physics, signals)
    arrived = release(signals.ready_ns, signals.stamps_ns)
    error = signal_error(track, drive.truth, "sideslip_rad", car.vehicle.low_speed_blend_m_s)
    settled = signals.stamps_ns - signals.stamps_ns[0] > SETTLE_NS
    error = np.where(arrived.arrived & settled, error, np.nan)
    response = residual_response(physics, signals, arrived.row)
    weight = weight_of(np.nan_to_num(drive.truth.sideslip_std_rad))
    return TaughtDrive(drive.drive.name, signals.stamps_ns, features, -error, response, weight)


def features_of(physics: AdaptivePhysics, signals: Signals) -> SlowFeatures:
    """Return the features of a drive's steps, as the filter in service computes them."""
    faults = physics.inputs(signals, None)[0].faults
    table, dt_s, *_ = run_features(physics.physics, faults.filtered, None, seen=faults.network, extra_r=faults.extra_r)
    return slow_features(table, dt_s, None)[0]


#: Training drives, and the scored part of another drive or of the same drive.
_Fold: TypeAlias = tuple[tuple[TaughtDriving, ...], OpenedDrive, slice]


def _folds(drives: Sequence[OpenedDrive]) -> list[_Fold]:
    """Return folds that leave out one drive each; a single drive is split into halves."""
    if len(drives) > 1:
        left_out = drives[:MOST_LEFT_OUT]
        return [(tuple(d.taught for d in drives if d is not drive), drive, slice(None)) for drive in left_out]
    folds: list[_Fold] = []
    (drive,) = drives
    driving, stamps = drive.taught.driving, drive.whole.signals.stamps_ns
    cells, known_cells = len(driving.stamps_ns), np.cumsum(np.isfinite(drive.taught.slopes))
    half_way = int(np.searchsorted(known_cells, known_cells[-1] // 2))
    middle = int(np.searchsorted(stamps, driving.stamps_ns[half_way]))
    for first, last, part in ((0, half_way, slice(middle, None)), (half_way, cells, slice(0, middle))):
        half = replace(drive.taught, driving=driving.between(first, last))
        if half.driving.seconds >= LEAST_HALF_S:
            folds.append(((half,), drive, part))
    return folds


def _prior_test(drives: Sequence[OpenedDrive], progress: Any) -> Interval | None:
    """Return the RMSE change by the prior of other drives, over blocks with their means removed, in rad.

    Return None if there is too little driving for a test.
    """
    errors: tuple[list[FloatArray], list[FloatArray]] = ([], [])
    stamps, folds = [], _folds(drives)
    vehicle = drives[0].drive.car.vehicle
    for number, (taught, drive, part) in enumerate(folds):
        progress(f"testing the prior on {drive.drive.name}", 0.35 + 0.4 * number / len(folds))
        prior = taught_parameters(taught, vehicle)
        stamps.append(drive.whole.signals.stamps_ns[part])
        for column, parameters in zip(errors, (prior, ()), strict=True):
            scored = lacking_of(drive, _calibration(drive, parameters))
            lack, root = scored.lacking_rad[part], np.sqrt(np.asarray(scored.weight)[part])
            column.append(root * (lack - np.nanmedian(lack)) if np.isfinite(lack).any() else lack)
    if not folds:
        return None
    with_prior, without = (np.concatenate(column) for column in errors)
    return block_bootstrap_difference(with_prior, without, _end_to_end(stamps), block_s=TEST_BLOCK_S)


def _end_to_end(stamps_ns: Sequence[IntArray]) -> IntArray:
    """Return the stamps of several slices, shifted one after the other so that no block contains two slices."""
    moved: list[IntArray] = []
    begin = 0
    for stamps in (s for s in stamps_ns if s.size):
        moved.append(stamps - stamps[0] + begin)
        begin = int(moved[-1][-1]) + round(BLOCK_S * 1e9)
    return np.concatenate(moved)


def _support(test: Interval | None) -> float:
    """Return the probability that the prior reduces the error on other driving, by its test; 0 without evidence."""
    if test is None or not test.high > test.value:
        return 0.0
    return 0.5 * math.erfc(test.value * NORMAL_95 / (test.high - test.value) / math.sqrt(2.0))


def figures_of(taught: Teaching) -> dict[str, Any]:
    """Return the figures as JSON-able values."""
    ladder, priors = taught.ladder, []
    for p in taught.priors:
        t = (p.test.value, p.test.low, p.test.high) if p.test else ()
        against = [None if math.isnan(x) else math.degrees(x) for x in t]
        priors.append({"ay_m_s2": p.level_m_s2, "support": round(p.support, 3), "against_untaught_deg": against})
    return {
        "evidence": taught.evidence,
        "rung": ladder.rung,
        "seconds": round(ladder.seconds, 1),
        "blocks": ladder.blocks,
        "rungs": [asdict(t) for t in ladder.trials],
        "calibrated": taught.calibrated,
        "truth": taught.truth,
        "priors": priors,
    }
