"""``disagreement_rms``: how far two estimates are apart, where no ground truth states which of them is right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from pdhef_logtool.evaluation.blocks import SegmentSums, packed, row_blocks
from pdhef_logtool.evaluation.metrics.metric import EvaluatedDrive, Metric, MetricRow, OfDrive
from pdhef_logtool.records.geometry import wrap_angle
from pdhef_logtool.records.signals import BoolArray
from pdhef_logtool.records.tracks import REFERENCE, StateTrack


def _rows(drive: EvaluatedDrive) -> list[MetricRow]:
    if drive.truth is not None:
        return []
    tracks = [track for name, track in drive.tracks.items() if name != REFERENCE]
    return disagreement_rows(tracks, drive.masks, log=drive.log, low_speed_m_s=drive.low_speed_m_s)


def disagreement_rows(
    tracks: Sequence[StateTrack], masks: Mapping[str, BoolArray], *, log: str, low_speed_m_s: float
) -> list[MetricRow]:
    """Return the rms difference of sideslip of every pair of estimates [N] at the same stamps, by segment."""
    rows = []
    for pair in combinations(tracks, 2):
        masks = packed(masks, len(pair[0]))
        sums = SegmentSums()
        for start, end in row_blocks(len(pair[0])):
            a, b = (t.rows(start, end) for t in pair)
            moving = a.valid & b.valid & (a.vx_m_s > low_speed_m_s) & (b.vx_m_s > low_speed_m_s)
            difference = np.where(moving, wrap_angle(a.sideslip_rad - b.sideslip_rad), np.nan)
            sums.add(masks.rows(start, end), difference, difference**2)
        name = "~".join(t.name for t in pair)
        for segment, (n, (_, squares)) in sums.totals().items():
            rms = float(np.sqrt(squares / n))
            rows.append(MetricRow(log, name, "sideslip_rad", segment, "disagreement_rms", rms, "rad", n))
    return rows


METRICS = (
    Metric(
        "disagreement_rms",
        "RMS difference",
        "RMS of the difference of two estimates' sideslip, both above the low-speed blend; estimator `a~b`. Without "
        "ground truth only",
        OfDrive(_rows),
        best="lower",
    ),
)
