"""``vehicle.wheel_radius``: whether the wheels roll as the file's radius has it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pdhef_logtool.drive.checks.kind import CheckedDrive, CheckKind
from pdhef_logtool.drive.columns import moving_at
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.signals import WHEELS

#: Effective radius over the file's: tyres wear by 3 %, sizes of one car differ by 5 %.
RADIUS_RANGE = (0.85, 1.18)


def _check(drive: CheckedDrive) -> Iterator[Check]:
    columns, speed, vehicle = drive.measured.columns, drive.speed, drive.vehicle
    if not drive.has_file or speed is None or "speed_m_s" not in columns:
        return
    moving = moving_at(speed)
    wheels = [columns[n] for w in WHEELS if (n := f"wheel_speed_{w}_rad_s") in columns]
    turning = [(w, moving & np.isfinite(w) & (w != 0.0)) for w in wheels]
    ratios = [float(np.median(speed[k] / w[k])) for w, k in turning if k.any()]
    if not ratios:
        return
    radius = float(np.median(ratios))
    low, high = (f * vehicle.wheel_radius_m for f in RADIUS_RANGE)
    evidence = f"the speed over the wheels' is {radius:.3f} m, the file's radius {vehicle.wheel_radius_m:g} m"
    yield RADIUS.judged(low <= radius <= high, evidence, radius=radius)


RADIUS = CheckKind(
    "vehicle.wheel_radius",
    compares="the speed over that of the wheels with the radius in the vehicle file",
    fails="it is below 0.85 or above 1.18 of it",
    remedy="set wheel_radius_m = {radius:.3f}",
    function=_check,
)
CHECKS = (RADIUS,)
