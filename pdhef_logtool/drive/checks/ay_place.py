"""``ay_m_s2.place``: where the accelerometer is."""

from __future__ import annotations

from collections.abc import Iterator

from pdhef_logtool.drive.checks.fitting import SURE
from pdhef_logtool.drive.checks.kind import CheckedDrive, CheckKind
from pdhef_logtool.drive.checks.sensor_errors import errors_of_ay
from pdhef_logtool.records.checks import Check

#: An accelerometer stands off the place in the file by more than a mounting in the cabin explains; m. Farther than the
#: second no car has one: something else goes with the yaw acceleration.
LEVER_M, MOST_LEVER_M = 0.5, 5.0


def _check(drive: CheckedDrive) -> Iterator[Check]:
    errors = errors_of_ay(drive)
    if errors is None:
        return
    place = drive.vehicle.imu_position_m[0]
    off, error = errors.lever_m - place, errors.lever_error_m
    evidence = f"the accelerometer is {errors.lever_m:.2f} +- {error:.2f} m ahead of the CG, the file says {place:g}"
    if abs(off) > max(MOST_LEVER_M, SURE * error):
        yield PLACE.undecided(evidence)
    elif abs(off) > LEVER_M and abs(off) > SURE * error:
        yield PLACE.failed(evidence, lever=errors.lever_m)
    elif abs(off) + 2.0 * error < 2.0 * LEVER_M:
        yield PLACE.passed(evidence)


PLACE = CheckKind(
    "ay_m_s2.place",
    compares="the accelerometer's place, by a_y against the truth, with the place in the vehicle file",
    fails="they are 0.5 m apart",
    remedy="imu_position_m = [{lever:.2f}, 0.0, 0.0] in the vehicle file, or pdhef learn --stages identify",
    lacks="no car has it there: the truth's lateral velocity or yaw rate may stand at another point or time",
    function=_check,
)
CHECKS = (PLACE,)
