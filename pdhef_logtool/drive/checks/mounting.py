"""``SIGNAL.fault``, ``mounting``, ``corrected``: faulty sensors, axes of the IMU, and corrected signals."""

from __future__ import annotations

from pdhef_logtool.drive.checks.kind import CheckKind

#: The check of a sensor fails if more than this share of the drive's motion is during its silent samples.
FAULTY_SHARE = 0.5

FAULT = CheckKind(
    "SIGNAL.fault",
    compares="samples that are stuck or dead with the motion of the car at the same time",
    fails="more than half of the motion is during such samples; other signals are checked without them",
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
    compares="recognised unit, sign and axis (without a mapping file) with the drive",
    fails="the drive contradicts them with certainty; the run uses the corrected values",
    remedy="confirm it in a mapping file: {entries}",
)
CHECKS = (FAULT, MOUNTING, CORRECTED)
