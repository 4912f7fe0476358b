"""Scores of all estimators on a drive with ground truth."""

import time
from collections.abc import Mapping as Table
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import pdhef_logtool as pdhef
from pdhef_logtool.drive.options import AUTO
from pdhef_logtool.evaluation.track_errors import NORMAL_95, scorable, truth_speed
from pdhef_logtool.mapping import Mapping
from pdhef_logtool.model.drive_model import DriveModel
from pdhef_logtool.model.intervals import drive_intervals
from pdhef_logtool.records.geometry import wrap_angle
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.runs.estimating import estimate_drive

SIDESLIP = "sideslip_rad"
#: Factor of the part of an error outside a 95 % interval in its score: 2 / 0.05.
PENALTY = 40.0
#: The offset of ground truth is its median on straights: yaw rate in rad/s below, speed in m/s above.
STRAIGHT_YAW_RATE_RAD_S, STRAIGHT_SPEED_M_S = 0.02, 5.0


@dataclass(frozen=True, slots=True)
class Entry:
    """A log to score.

    Attributes
    ----------
    group : heading of its tables. drive : name of the drive that it recorded. car_name : has one vote.
    mapping : None: recognised. least_speed_m_s : sideslip is scored above it; None: the low-speed limit of the car.
    has_offset : whether the offset of the ground truth is subtracted.
    names : of estimators or their groups. labels : names in the tables, where they differ. model : as in a run.
    truth : of the drive as it is read with another car, whose file has the position of the ground truth.
    """

    log: Path
    group: str
    drive: str
    car_name: str
    car: pdhef.Car
    mapping: Mapping | None
    least_speed_m_s: float | None = None
    has_offset: bool = False
    names: tuple[str, ...] = ("all", "peers")
    labels: Table[str, str] = field(default_factory=dict)
    model: Path = AUTO
    truth: StateTrack | None = None


def scores(entry: Entry) -> tuple[list[dict[str, Any]], DriveModel, StateTrack | None]:
    """Return the scores of the estimators on a log, with its car calibrated as in a run, model and ground truth."""
    rows = []
    with pdhef.read_drive(entry.log, entry.car, entry.mapping, pdhef.ReadOptions(model=entry.model)) as drive:
        model, whole = DriveModel.fit(drive), drive.whole()
        corrected, truth = model.apply(whole.signals), entry.truth or whole.truth
        given = [e for name in entry.names for e in pdhef.choose(drive, [name], model.car)[0]]
        for name, estimator in {e.name: e for e in given}.items():
            begin = time.process_time()
            intervals = drive_intervals(model.car, [estimator])
            (track,) = estimate_drive(whole, corrected, [estimator], intervals=intervals).tracks.values()
            seconds = time.process_time() - begin
            if truth is None or track.name != name:
                continue
            length_s = float(np.ptp(track.stamps_ns) * 1e-9)
            about = {"group": entry.group, "log": entry.log.name, "drive": entry.drive, "car": entry.car_name}
            costs = {"length_s": length_s, "seconds_per_hour": 3600.0 * seconds / length_s}
            least = entry.least_speed_m_s or entry.car.vehicle.low_speed_blend_m_s
            figures = errors(track, truth, least, has_offset=entry.has_offset)
            rows.append(about | {"estimator": entry.labels.get(name, name)} | figures | costs)
    return [row for row in rows if row["scored_s"] > 0.0 and row["available"] > 0.0], model, truth


def errors(track: StateTrack, truth: StateTrack, least_speed_m_s: float, *, has_offset: bool = False) -> dict[str, Any]:
    """Return the figures of a track, angles in degrees; a missing estimate counts as 0, and not in intervals."""
    scored, offset = scorable(truth, SIDESLIP, least_speed_m_s), 0.0
    if has_offset:
        straight = scored & (np.abs(truth.yaw_rate_rad_s) < STRAIGHT_YAW_RATE_RAD_S)
        offset = float(np.median(truth.sideslip_rad[straight & (truth_speed(truth) > STRAIGHT_SPEED_M_S)]))
    there = (track.valid & np.isfinite(track.sideslip_rad))[scored]
    estimate = np.where(there, track.sideslip_rad[scored], 0.0)
    error = np.degrees(np.abs(wrap_angle(estimate - truth.sideslip_rad[scored] + offset)))
    half, with_interval = np.degrees(NORMAL_95 * track.sideslip_std_rad[scored][there]), error[there]

    def mean(values: np.ndarray) -> float:
        return float(np.mean(values)) if values.size else float("nan")

    has_interval = bool(np.isfinite(half).any())
    return {
        "offset_deg": float(np.degrees(offset)),
        "scored_s": float(np.ptp(track.stamps_ns) * 1e-9) * mean(scored),
        "rmse_deg": mean(error**2) ** 0.5,
        "available": mean(there),
        "coverage95": mean(with_interval <= half) if has_interval else float("nan"),
        "half_width_deg": float(np.nanmedian(half)) if has_interval else float("nan"),
        "winkler_deg": mean(2.0 * half + PENALTY * np.maximum(with_interval - half, 0.0)),
    }
