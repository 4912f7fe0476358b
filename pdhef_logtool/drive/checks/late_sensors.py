"""``SIGNAL.delay``: late sensors, from pairs of sensors that follow one motion, without ground truth."""

from __future__ import annotations

from collections.abc import Sequence

from pdhef_logtool.drive.checks.kind import CheckedDrive, CheckKind
from pdhef_logtool.drive.delays import LateSensor
from pdhef_logtool.records.checks import Check


def _checks(drive: CheckedDrive) -> list[Check]:
    by_truth = {c.name for c in drive.judged}
    return [check for check in delay_checks(drive.late) if check.name not in by_truth]


def delay_checks(late: Sequence[LateSensor]) -> list[Check]:
    """Return a failed check for each signal that is late."""
    return [
        DELAY.failed(sensor.evidence, name, delay=sensor.delay_s, more="" if sensor.exact else ", at least")
        for sensor in late
        for name in sensor.names
    ]


DELAY = CheckKind(
    "SIGNAL.delay",
    compares="the stamps of two sensors that follow one motion",
    fails="one of them is late",
    remedy="latency_s = {delay:.3f} more in the mapping{more}",
    function=_checks,
)
CHECKS = (DELAY,)
