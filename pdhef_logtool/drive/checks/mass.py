"""``vehicle.mass``: whether the file's tyres carry its mass through the bends that were driven."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pdhef_logtool.car.vehicle import GRAVITY_M_S2
from pdhef_logtool.drive.checks.kind import CheckedDrive, CheckKind
from pdhef_logtool.records.checks import Check

#: Lateral acceleration driven over what the file's tyres carry at friction 1: summer tyres reach 1.15 of it.
MAX_GRIP_USE = 1.25


def _check(drive: CheckedDrive) -> Iterator[Check]:
    columns, speed, vehicle = drive.measured.columns, drive.speed, drive.vehicle
    rate, ay = columns.get("yaw_rate_rad_s"), columns.get("ay_m_s2")
    if not drive.has_file or speed is None or rate is None or ay is None:
        return
    # Roll makes a_y too large, and a car that begins to spin its yaw rate.
    lateral = np.minimum(np.abs(ay), np.abs(rate * speed))
    finite = lateral[np.isfinite(lateral)]
    friction = max(1.0, vehicle.assumed_friction)
    carried = [vehicle.magic_formula(front, friction)[2] / vehicle.axle_load_n(front) for front in (True, False)]
    most = GRAVITY_M_S2 * min(carried)
    seen = float(np.quantile(finite, 0.99)) if finite.size else 0.0
    evidence = f"{seen:.1f} m/s^2 were driven, the file's tyres carry its mass up to {most:.1f} m/s^2"
    yield MASS.judged(seen <= MAX_GRIP_USE * most, evidence)


MASS = CheckKind(
    "vehicle.mass",
    compares="the lateral acceleration that was driven with what the file's tyres carry of its mass",
    fails="it is above 1.25 of that at friction 1",
    remedy="mass_kg is too large, or friction and the tyres' peak are too small",
    function=_check,
)
CHECKS = (MASS,)
