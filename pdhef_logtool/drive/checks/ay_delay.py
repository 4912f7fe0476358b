"""``ay_m_s2.delay``: how late the accelerometer is against the truth."""

from __future__ import annotations

from collections.abc import Iterator

from pdhef_logtool.drive.checks.fitting import SURE
from pdhef_logtool.drive.checks.kind import CheckedDrive, CheckKind
from pdhef_logtool.drive.checks.sensor_errors import ay_delay, errors_of_ay
from pdhef_logtool.drive.checks.yaw_rate_delay import SENSOR_DELAY_S
from pdhef_logtool.records.checks import Check


def _check(drive: CheckedDrive) -> Iterator[Check]:
    errors = errors_of_ay(drive)
    delay_and_error = None if errors is None else ay_delay(errors, drive.latency)
    if delay_and_error is None:
        return
    delay, error = delay_and_error
    evidence = f"a_y is {delay * 1e3:.1f} +- {error * 1e3:.1f} ms late against the truth"
    if delay > max(SENSOR_DELAY_S, SURE * error):
        yield DELAY.failed(evidence, delay=delay)
    elif abs(delay) + 2.0 * error < 2.0 * SENSOR_DELAY_S:
        yield DELAY.passed(evidence)


DELAY = CheckKind(
    "ay_m_s2.delay",
    compares="the stamps of a_y with those of the truth",
    fails="a_y is 30 ms late",
    remedy="latency_s = {delay:.4f} more in the mapping",
    function=_check,
)
CHECKS = (DELAY,)
