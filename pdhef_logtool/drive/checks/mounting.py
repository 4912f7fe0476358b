"""``SIGNAL.mounting``: whether each of the IMU's signals is read from the right axis; judged by the survey of a log."""

from __future__ import annotations

from pdhef_logtool.drive.checks.kind import CheckKind

MOUNTING = CheckKind(
    "SIGNAL.mounting",
    compares="the axis that the mapping reads with the axis that the drive shows",
    fails="they are not the same",
    remedy="in the mapping: field = {field}, scale = {scale}",
)
CHECKS = (MOUNTING,)
