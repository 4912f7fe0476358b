"""``residual_active``: on how much of a drive a residual acts that has a region of validity."""

from __future__ import annotations

import numpy as np

from pdhef_logtool.evaluation.blocks import SegmentSums, packed, row_blocks
from pdhef_logtool.evaluation.metrics.metric import EvaluatedDrive, Metric, MetricRow, OfDrive
from pdhef_logtool.records.tracks import StateTrack


def _rows(drive: EvaluatedDrive) -> list[MetricRow]:
    rows = []
    for name, track in drive.tracks.items():
        if ":" in name or not _has_region(track):
            continue
        masks, sums = packed(drive.masks, len(track)), SegmentSums()
        for start, end in row_blocks(len(track)):
            part = track.rows(start, end)
            moving = part.valid & (part.vx_m_s > drive.low_speed_m_s)
            sums.add(masks.rows(start, end), np.where(moving, part.network_trust > 0.0, np.nan))
        for segment, (n, (active,)) in sums.totals().items():
            rows.append(MetricRow(drive.log, name, "sideslip_rad", segment, "residual_active", active / n, "1", n))
    return rows


def _has_region(track: StateTrack) -> bool:
    """Return whether the gain is no constant below 1: one gain for all of a drive belongs to a network."""
    gain = track.network_trust[np.isfinite(track.network_trust)]
    return bool(gain.size and gain.max() > 0.0 and (gain.min() < gain.max() or gain.max() == 1.0))


METRICS = (
    Metric(
        "residual_active",
        "residual active",
        "share of the stamps above the low-speed blend at which the residual acts, for a residual with a region of "
        "validity",
        OfDrive(_rows),
        best="higher",
        unit="1",
    ),
)
