"""``yaw_rate_rad_s.delay``: how late the gyro is against the truth."""

from __future__ import annotations

from collections.abc import Iterator

from pdhef_logtool.drive.checks.kind import CheckedDrive, CheckKind
from pdhef_logtool.records.checks import Check

#: A sensor's filter and a bus take 10 to 20 ms; at 0.5 Hz, 30 ms are 5 degrees of phase.
SENSOR_DELAY_S = 0.03


def _check(drive: CheckedDrive) -> Iterator[Check]:
    latency = drive.latency
    if not drive.has_truth or latency is None or not latency.reliable or latency.identical:
        return
    delay = latency.gyro_delay_s
    evidence = f"{delay * 1e3:.1f} +- {latency.std_error_s * 1e3:.1f} ms late against the truth"
    yield DELAY.judged(delay <= SENSOR_DELAY_S, evidence, delay=delay)


DELAY = CheckKind(
    "yaw_rate_rad_s.delay",
    compares="the stamps of the gyro with those of the truth",
    fails="the gyro is 30 ms late",
    remedy="latency_s = {delay:.4f} more in the mapping, or pdhef learn --stages identify",
    function=_check,
)
CHECKS = (DELAY,)
