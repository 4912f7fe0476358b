"""How well a car's estimators do on slices of drives, and whether a candidate does better, by paired blocks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import WholeDrive
from pdhef_logtool.estimators.table import Options, runnable
from pdhef_logtool.evaluation.bootstrap import Interval, block_bootstrap_difference
from pdhef_logtool.evaluation.comparison import Errors, end_to_end
from pdhef_logtool.evaluation.metrics import NORMAL_95, signal_error
from pdhef_logtool.evaluation.requirement_blocks import BLOCK_S
from pdhef_logtool.learning.drives import load_drive
from pdhef_logtool.learning.evidence.trust import MIN_BLOCKS
from pdhef_logtool.learning.noise.search import MIN_AVAILABILITY
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.mapping import Mapping as SignalMapping
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.runs.estimating import calibrator, estimate_drive

#: What a filter needs from the start of a slice before its error counts.
SETTLE_S = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Scored:
    """Sideslip errors by estimator, [N] at the same stamps for all of them, and why others did not run."""

    errors: Mapping[str, Errors]
    skipped: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class PairedTest:
    """Errors of a candidate against those before, at the stamps that both score.

    Attributes
    ----------
    was_deg, now_deg : sideslip RMSE in degrees. difference : of RMSE, the candidate's less the other, rad, by a
        bootstrap of blocks. better : by the RMSE; None: alike.
    """

    was_deg: float
    now_deg: float
    difference: Interval
    better: bool | None

    @property
    def confirmed(self) -> bool:
        """Whether the 95 % bounds of the difference are below 0."""
        return self.difference.blocks >= MIN_BLOCKS and self.difference.high < 0.0


def paired_test(old: Errors, new: Errors) -> PairedTest:
    """Compare errors at the same stamps [N]; much fewer of them (:data:`MIN_AVAILABILITY`) are worse."""
    both = np.isfinite(old.error) & np.isfinite(new.error)
    was, now = (float(np.degrees(np.sqrt(np.mean(e.error[both] ** 2)))) if both.any() else np.nan for e in (old, new))
    lacks = new.scored < MIN_AVAILABILITY * old.scored
    difference = block_bootstrap_difference(new.error, old.error, new.stamps_ns, block_s=BLOCK_S)
    if lacks:
        difference = Interval(difference.value, np.inf, np.inf, difference.blocks)
    return PairedTest(
        round(was, 6), round(now, 6), difference, None if was == now and not lacks else now < was and not lacks
    )


def score_slices(
    car: Car, names: Sequence[str], slices: Sequence[LogInput], mapping: SignalMapping | None, options: ReadOptions
) -> Scored:
    """Run estimators of a car over slices of drives with ground truth.

    Raises
    ------
    PdhefError
        A log cannot be read.
    """
    columns: dict[str, list[tuple[FloatArray, BoolArray]]] = {name: [] for name in names}
    stamps: list[IntArray] = []
    skipped: dict[str, str] = {}
    for log_slice in slices:
        _, drive = load_drive(log_slice, car, mapping, options)
        if drive is None or drive.truth is None:
            continue
        stamps.append(drive.signals.stamps_ns)
        tracks, reasons = _tracks(car, names, drive, options)
        skipped |= reasons
        for name in names:
            columns[name].append(_errors(tracks.get(name), drive, car.vehicle.low_speed_blend_m_s))
    stamps_ns = end_to_end(stamps)
    errors = {
        name: Errors(name, np.concatenate([e for e, _ in parts]), stamps_ns, np.concatenate([i for _, i in parts]))
        for name, parts in columns.items()
        if parts and name not in skipped
    }
    return Scored(errors, skipped)


def _tracks(
    car: Car, names: Sequence[str], drive: WholeDrive, options: ReadOptions
) -> tuple[dict[str, StateTrack], dict[str, str]]:
    estimators, skipped = runnable(names, car, drive.plan.alignment.available, Options(options.use_speed))
    estimated = estimate_drive(drive, estimators, drawn=False, intervals=calibrator(car, estimators))
    return estimated.tracks, {s.name: s.reason for s in skipped}


def _errors(track: StateTrack | None, drive: WholeDrive, slow_m_s: float) -> tuple[FloatArray, BoolArray]:
    """Return the sideslip errors [N] in rad, NaN where nothing is scored, and which lie inside their interval."""
    stamps, truth = drive.signals.stamps_ns, drive.truth
    assert truth is not None
    if track is None:
        return np.full(stamps.shape[0], np.nan), np.zeros(stamps.shape[0], dtype=np.bool_)
    error = signal_error(track, truth, "sideslip_rad", slow_m_s)
    error = np.where(stamps - stamps[0] < round(SETTLE_S * 1e9), np.nan, error)
    inside: BoolArray = np.abs(error) <= NORMAL_95 * track.sideslip_std_rad
    return error, inside
