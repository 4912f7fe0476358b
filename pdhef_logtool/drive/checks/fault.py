"""``SIGNAL.fault``: a sensor that fails for most of the drive."""

from __future__ import annotations

from pdhef_logtool.drive.checks.kind import CheckKind
from pdhef_logtool.records.checks import Check

#: A sensor whose silent samples held so much of the drive's motion is itself a failed check.
FAULTY_SHARE = 0.5

FAULT = CheckKind(
    "SIGNAL.fault",
    compares="samples that are stuck or dead with what the car does meanwhile",
    fails="more than half of what the drive does falls into them; other signals are judged without those samples",
    remedy="look at the sensor, its cable and its power",
)
CHECKS = (FAULT,)


def fault_check(name: str, share: float) -> Check:
    """Return the check of a signal whose faulty samples take a share of the drive's motion."""
    evidence = f"{share:.0%} of what the car did fell into samples of it that are stuck or dead"
    return FAULT.failed(evidence, name) if share > FAULTY_SHARE else FAULT.passed(evidence, name)
