"""``exposure_s``, ``exposure_m``: how long and how far a drive went in each segment, estimator ``sensors``."""

from __future__ import annotations

import numpy as np

from pdhef_logtool.evaluation.blocks import SegmentSums, median_step_ns, packed, row_blocks
from pdhef_logtool.evaluation.metrics.metric import EvaluatedDrive, Metric, MetricRow, OfDrive
from pdhef_logtool.evaluation.metrics.sensor_residuals import SENSORS
from pdhef_logtool.evaluation.segments import known_of, speed_and_ay


def _rows(drive: EvaluatedDrive) -> list[MetricRow]:
    masks, sums = packed(drive.masks, len(drive.signals)), SegmentSums()
    step_s = median_step_ns(drive.signals) * 1e-9
    taken = known_of(drive.truth)
    for a, b in row_blocks(len(drive.signals)):
        truth = None if drive.truth is None else drive.truth.rows(a, b)
        speed = np.nan_to_num(speed_and_ay(drive.signals.rows(a, b), truth, taken)[0])
        sums.add(masks.rows(a, b), np.abs(speed) * step_s)
    rows = []
    for segment, (n, (metres,)) in sums.totals().items():
        rows.append(MetricRow(drive.log, SENSORS, "state", segment, "exposure_s", n * step_s, "s", n))
        rows.append(MetricRow(drive.log, SENSORS, "state", segment, "exposure_m", float(metres), "m", n))
    return rows


_FUNCTION = OfDrive(_rows)
_WORDS = "of the drive in a segment; n = its stamps. Estimator `sensors`"
METRICS = (
    Metric("exposure_s", "time", f"time {_WORDS}", _FUNCTION, unit="s"),
    Metric("exposure_m", "way", f"way {_WORDS}", _FUNCTION, unit="m"),
)
