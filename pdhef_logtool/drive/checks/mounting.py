"""``SIGNAL.fault``, ``mounting``, ``corrected``: sensors that fail, the axes of the IMU, and what is read otherwise."""

from __future__ import annotations

from pdhef_logtool.drive.checks.kind import CheckKind

#: A sensor whose silent samples held so much of the drive's motion is itself a failed check.
FAULTY_SHARE = 0.5

FAULT = CheckKind(
    "SIGNAL.fault",
    compares="samples that are stuck or dead with what the car does meanwhile",
    fails="more than half of what the drive does falls into them; other signals are judged without those samples",
    remedy="look at the sensor, its cable and its power",
)
MOUNTING = CheckKind(
    "SIGNAL.mounting",
    compares="the axis that the mapping reads with the axis that the drive shows",
    fails="they are not the same",
    remedy="in the mapping: {entries}",
)
CORRECTED = CheckKind(
    "SIGNAL.corrected",
    compares="unit, sign and axis that recognition reads, without a mapping file, with what the drive shows",
    fails="the drive contradicts them with certainty: the run reads what it shows",
    remedy="confirm it in a mapping file: {entries}",
)
CHECKS = (FAULT, MOUNTING, CORRECTED)
