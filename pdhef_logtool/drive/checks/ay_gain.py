"""``ay_m_s2.gain``: what the accelerometer reads of the lateral acceleration."""

from __future__ import annotations

from collections.abc import Iterator

from pdhef_logtool.drive.checks.fitting import SURE
from pdhef_logtool.drive.checks.kind import CheckedDrive, CheckKind
from pdhef_logtool.drive.checks.sensor_errors import AY_GAIN_RANGE, errors_of_ay
from pdhef_logtool.records.checks import Check


def _check(drive: CheckedDrive) -> Iterator[Check]:
    errors = errors_of_ay(drive)
    if errors is None:
        return
    gain, error = errors.ay_gain, errors.ay_gain_error
    low, high = AY_GAIN_RANGE
    evidence = f"a_y reads {gain:.2f} +- {error:.2f} of the truth's lateral acceleration, with roll and bank"
    if gain + SURE * error < low or gain - SURE * error > high:
        yield GAIN.failed(evidence, gain=gain)
    elif low <= gain - 2.0 * error and gain + 2.0 * error <= high:
        yield GAIN.passed(evidence)


GAIN = CheckKind(
    "ay_m_s2.gain",
    compares="a_y with the truth's lateral acceleration",
    fails="it reads less than 0.65 or more than 1.3 of it",
    remedy="divide its scale in the mapping by about {gain:.2f}",
    function=_check,
)
CHECKS = (GAIN,)
