"""Sideslip errors of estimates with ground truth, and their means over drives and cars."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pdhef_logtool.evaluation.metrics import NORMAL_95
from pdhef_logtool.evaluation.track_errors import scorable, truth_speed
from pdhef_logtool.records.geometry import wrap_angle
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.records.tracks import StateTrack
from studies.peers.drives import OFFSET, PEER_DRIVES, PeerDrive

SIDESLIP = "sideslip_rad"
#: The offset of ground truth is its median on straights: yaw rate in rad/s below, speed in m/s above.
STRAIGHT_YAW_RATE_RAD_S, STRAIGHT_SPEED_M_S = 0.02, 5.0
#: Peers that the limit for a single drive counts.
BEST_PEERS = 3


@dataclass(slots=True)
class DriveErrors:
    """Sideslip RMSE in degrees and share of missing estimates of a drive, by estimator, on ``scored`` stamps.

    ``coverage`` and ``half_width_deg`` (median) of the 95 % intervals are of valid estimates.
    """

    drive: PeerDrive
    scored: int
    offset_deg: float
    rmse_deg: dict[str, float] = field(default_factory=dict)
    missing: dict[str, float] = field(default_factory=dict)
    coverage: dict[str, float] = field(default_factory=dict)
    half_width_deg: dict[str, float] = field(default_factory=dict)

    def document(self) -> dict[str, Any]:
        """Return it for JSON."""
        return {
            "log": self.drive.log,
            "car": self.drive.car,
            "least_speed_m_s": self.drive.least_speed_m_s,
            "scored_stamps": self.scored,
            "offset_removed_deg": round(self.offset_deg, 4),
            "rmse_deg": {name: round(value, 4) for name, value in self.rmse_deg.items()},
            "missing": {name: round(value, 4) for name, value in self.missing.items()},
            "coverage95": {name: round(value, 4) for name, value in self.coverage.items()},
            "half_width_deg": {name: round(value, 4) for name, value in self.half_width_deg.items()},
        }

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> DriveErrors:
        """Return the errors of a document."""
        drive = next(drive for drive in PEER_DRIVES if drive.log == document["log"])
        offset_deg = document["offset_removed_deg"]
        intervals = document["coverage95"], document["half_width_deg"]
        return cls(drive, document["scored_stamps"], offset_deg, document["rmse_deg"], document["missing"], *intervals)


def score(
    drive: PeerDrive,
    estimates: Mapping[str, FloatArray],
    truth: StateTrack,
    stds: Mapping[str, FloatArray] | None = None,
) -> DriveErrors:
    """Score sideslip [N] in rad at the stamps of the ground truth, and intervals where there are any.

    A missing estimate (NaN) counts as 0 in errors and not at all in intervals.
    """
    scored = scorable(truth, SIDESLIP, drive.least_speed_m_s)
    offset = 0.0
    if drive.group == OFFSET:
        straight = np.abs(truth.yaw_rate_rad_s) < STRAIGHT_YAW_RATE_RAD_S
        offset = float(np.median(truth.sideslip_rad[scored & straight & (truth_speed(truth) > STRAIGHT_SPEED_M_S)]))
    errors = DriveErrors(drive, int(np.count_nonzero(scored)), float(np.degrees(offset)))
    for name, sideslip in estimates.items():
        difference = wrap_angle(np.nan_to_num(sideslip, nan=0.0) - truth.sideslip_rad + offset)[scored]
        if stds is not None and name in stds:
            valid = np.isfinite(sideslip[scored])
            half_width = NORMAL_95 * stds[name][scored][valid]
            errors.coverage[name] = float(np.mean(np.abs(difference[valid]) <= half_width))
            errors.half_width_deg[name] = float(np.degrees(np.median(half_width)))
        errors.rmse_deg[name] = float(np.degrees(np.sqrt(np.mean(difference**2))))
        errors.missing[name] = float(np.mean(~np.isfinite(sideslip[scored])))
    return errors


def geometric(values: Sequence[float]) -> float:
    """Return the geometric mean."""
    return float(np.exp(np.mean(np.log(values))))


def car_means(errors: Sequence[DriveErrors], name: str) -> dict[str, float]:
    """Return the RMSE of an estimator by car: geometric mean over drives; logs of the same drive share its weight."""
    cars: dict[str, dict[str, list[float]]] = {}
    for e in errors:
        cars.setdefault(e.drive.car, {}).setdefault(e.drive.drive, []).append(e.rmse_deg[name])
    return {car: geometric([geometric(logs) for logs in drives.values()]) for car, drives in cars.items()}


def spread(values: Sequence[float]) -> float:
    """Return the geometric standard deviation, a factor."""
    return float(np.exp(np.std(np.log(values), ddof=1))) if len(values) > 1 else 1.0


def best_of(errors: DriveErrors, names: Sequence[str]) -> str:
    """Return the estimator with the lowest error of a drive."""
    return min(names, key=lambda name: errors.rmse_deg[name])


def best_peers_median(errors: DriveErrors, peers: Sequence[str]) -> float:
    """Return the median error of the best peers of a drive."""
    return float(np.median(sorted(errors.rmse_deg[name] for name in peers)[:BEST_PEERS]))
