"""``truth.sideslip_rad``: whether ground-truth heading and velocity are consistent; sideslip is 0 on straights."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from pdhef_logtool.drive.checks.kind import CheckedDrive, CheckKind
from pdhef_logtool.drive.columns import fit, halves, median_known, moving_at
from pdhef_logtool.drive.relations import SAME_RANGE, gentle_at
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.signals import FloatArray

#: A larger sideslip on straights is an error of ground truth; tyres and crossfall cause less.
SIDESLIP_OFFSET_RAD = math.radians(0.15)
#: Bias of an accelerometer, 1-sigma, which shifts the sideslip due to lateral tyre forces.
AY_BIAS_M_S2 = 0.1
#: No car drives sideways: if sideslip exceeds this angle for this share of the moving time, heading and velocity are
#: inconsistent.
SIDEWAYS_RAD, SIDEWAYS_SHARE = math.radians(20.0), 0.75


def _checks(drive: CheckedDrive) -> list[Check]:
    columns = drive.measured.columns
    if not drive.has_truth or not all(f"truth.{n}" in columns for n in ("vx_m_s", "vy_m_s")):
        return []
    vx, vy = columns["truth.vx_m_s"], columns["truth.vy_m_s"]
    sideslip = _sideslip(columns)
    moving = moving_at(np.hypot(vx, vy))
    finite = moving & np.isfinite(sideslip)
    if not finite.any():
        return []
    typical = float(np.quantile(np.abs(sideslip[finite]), 1.0 - SIDEWAYS_SHARE))
    evidence = f"its size is above {math.degrees(typical):.1f} deg for {SIDEWAYS_SHARE:.0%} of the moving time"
    frame = FRAME.judged(typical <= SIDEWAYS_RAD, evidence)
    if frame.verdict == "failed" and _is_speed(drive, vy):
        remedy = "exchange the fields of v_x and v_y in the mapping"
        names = ("truth.vx_m_s", "truth.vy_m_s")
        return [Check(f"{n}.axis", n, "failed", f"{evidence}, and v_y is the speed", remedy) for n in names]
    offset = _offset_check(columns) if frame.verdict == "passed" else None
    return [frame] if offset is None else [frame, offset]


def _sideslip(columns: Mapping[str, FloatArray]) -> FloatArray:
    """Return the angle [N] of the ground-truth velocity from the direction of travel, which is backwards in reverse."""
    vx, vy = columns["truth.vx_m_s"], columns["truth.vy_m_s"]
    way = np.where((columns.get("speed_m_s", vx * 0.0) < 0.0) & (vx < 0.0), -1.0, 1.0)
    return np.asarray(np.arctan2(way * vy, way * vx))


def _is_speed(drive: CheckedDrive, column: FloatArray) -> bool:
    """Return whether a column equals the speed of the sensors."""
    if drive.speed is None or str(drive.measured.speed_name).startswith("truth."):
        return False
    with np.errstate(divide="ignore", invalid="ignore"):
        share = median_known(np.where(moving_at(drive.speed), np.abs(column / drive.speed), np.nan))
    return SAME_RANGE[0] < share < SAME_RANGE[1]


def sideslip_offset(columns: Mapping[str, FloatArray]) -> tuple[float, float] | None:
    """Return the ground-truth sideslip on straights with its standard error; None if too little is known."""
    rate, ay = (columns.get(n) for n in ("yaw_rate_rad_s", "ay_m_s2"))
    vx, vy = (columns.get(f"truth.{n}") for n in ("vx_m_s", "vy_m_s"))
    if rate is None or ay is None or vx is None or vy is None:
        return None
    moving = moving_at(np.hypot(vx, vy))
    with np.errstate(divide="ignore", invalid="ignore"):
        regressors = [np.ones_like(vx), rate / vx, ay]
    result = fit(_sideslip(columns), regressors, gentle_at(rate * vx, moving))
    if result is None:
        return None
    (offset, _, compliance), (error, *_), _ = result
    return float(offset), math.hypot(error, compliance * AY_BIAS_M_S2)


def _offset_check(columns: Mapping[str, FloatArray]) -> Check | None:
    """Return the check of the ground-truth sideslip on straights; None without IMU."""
    if "yaw_rate_rad_s" not in columns or "ay_m_s2" not in columns:
        return None
    result = sideslip_offset(columns)
    if result is None:
        return OFFSET.undecided("too little gentle driving")
    offset, error = result
    parts = [
        sideslip_offset({n: np.where(p, c, np.nan) for n, c in columns.items()})
        for p in halves(len(columns["ay_m_s2"]))
    ]
    shown = " and ".join(f"{math.degrees(p[0]):.2f}" for p in parts if p is not None)
    evidence = f"sideslip is {math.degrees(offset):.2f} +- {math.degrees(error):.2f} deg in straight driving"
    evidence += f" ({shown} in alternate parts of the drive)" if " and " in shown else ""
    return OFFSET.of_figure(offset, error, (-SIDESLIP_OFFSET_RAD, SIDESLIP_OFFSET_RAD), evidence)


FRAME = CheckKind(
    "truth.sideslip_rad.frame",
    compares="the heading of ground truth with its velocity",
    fails="its sideslip is above 20 degrees for 75 % of the moving time",
    remedy="heading and velocity are inconsistent: check frames, signs and units of ground truth",
    function=_checks,
)
OFFSET = CheckKind(
    "truth.sideslip_rad.offset",
    compares="ground-truth sideslip on straights with 0",
    fails="it is off by 0.15 degrees",
    remedy="the heading of ground truth is rotated against the car (tyres, crossfall or a bias of a_y cause less): "
    "correct it by pdhef inspect --write-mapping",
    lacks="needs straights and bends",
)
CHECKS = (FRAME, OFFSET)
