"""``SIGNAL.mounting``, ``corrected``: the axes of the IMU and what is read otherwise, judged by the survey of a log."""

from __future__ import annotations

from pdhef_logtool.drive.checks.kind import CheckKind

MOUNTING = CheckKind(
    "SIGNAL.mounting",
    compares="the axis that the mapping reads with the axis that the drive shows",
    fails="they are not the same",
    remedy="in the mapping: field = {field}, scale = {scale}",
)
CORRECTED = CheckKind(
    "SIGNAL.corrected",
    compares="unit, sign and axis that recognition reads, without a mapping file, with what the drive shows",
    fails="the drive contradicts them with certainty: the run reads what it shows",
    remedy="confirm it in a mapping file: field = {field}, scale = {scale}",
)
CHECKS = (MOUNTING, CORRECTED)
