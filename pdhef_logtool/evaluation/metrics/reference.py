"""``reference_rms``: how far an estimate is from the sideslip reference, where no ground truth states its error."""

from __future__ import annotations

import numpy as np

from pdhef_logtool.evaluation.blocks import SegmentSums, packed, row_blocks
from pdhef_logtool.evaluation.metrics.metric import EvaluatedDrive, Metric, MetricRow, OfDrive
from pdhef_logtool.records.geometry import wrap_angle
from pdhef_logtool.records.tracks import REFERENCE, StateTrack

#: Above this share of GNSS in its information the reference is independent of an estimator that uses the same IMU.
INDEPENDENT_SHARE = 0.5


def _rows(drive: EvaluatedDrive) -> list[MetricRow]:
    reference = drive.tracks.get(REFERENCE)
    if reference is None:
        return []
    others = [track for name, track in drive.tracks.items() if name != REFERENCE]
    return [row for track in others for row in _against(track, reference, drive)]


def _against(track: StateTrack, reference: StateTrack, drive: EvaluatedDrive) -> list[MetricRow]:
    """Return the rows of one estimate [N] by segment."""
    masks = packed(drive.masks, len(track))
    sums = SegmentSums()
    for start, end in row_blocks(len(track)):
        a, b = track.rows(start, end), reference.rows(start, end)
        used = a.valid & b.valid & (a.vx_m_s > drive.low_speed_m_s) & (b.vx_m_s > drive.low_speed_m_s)
        difference = np.where(used, wrap_angle(a.sideslip_rad - b.sideslip_rad), np.nan)
        independent = np.where(used, (b.share_gnss >= INDEPENDENT_SHARE).astype(np.float64), np.nan)
        sums.add(masks.rows(start, end), difference**2, b.sideslip_std_rad**2, independent)
    rows = []
    for segment, (n, (squares, variances, independents)) in sums.totals().items():
        for metric, value, unit in (
            ("reference_rms", float(np.sqrt(squares / n)), "rad"),
            ("reference_std", float(np.sqrt(variances / n)), "rad"),
            ("reference_independent", independents / n, "1"),
        ):
            rows.append(MetricRow(drive.log, track.name, "sideslip_rad", segment, metric, value, unit, n))
    return rows


_FUNCTION = OfDrive(_rows)
METRICS = (
    Metric(
        "reference_rms",
        "RMS from reference",
        "RMS of the difference of an estimate's sideslip from the sideslip reference, where the reference is valid and "
        "both are above the low-speed blend. The reference is estimated: no error, and never mixed with ground truth",
        _FUNCTION,
        best="lower",
    ),
    Metric(
        "reference_std",
        "reference ±",
        "RMS of the 1-sigma of the sideslip reference at these stamps: smaller differences state nothing",
        _FUNCTION,
    ),
    Metric(
        "reference_independent",
        "reference independent",
        "share of these stamps at which GNSS has at least half of the reference's information; at the others axle law "
        "and kinematics of the same IMU prevail",
        _FUNCTION,
        unit="1",
    ),
)
