"""How far estimates are from the sideslip reference, where no ground truth states their error, and which is closer."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from pdhef_logtool.evaluation.blocks import SegmentSums, packed, row_blocks
from pdhef_logtool.evaluation.metrics.metric import EvaluatedDrive, Metric, MetricRow, OfDrive
from pdhef_logtool.records.geometry import wrap_angle
from pdhef_logtool.records.tracks import REFERENCE, StateTrack


def _rows(drive: EvaluatedDrive) -> list[MetricRow]:
    reference = drive.tracks.get(REFERENCE)
    if reference is None:
        return []
    others = [track for name, track in drive.tracks.items() if name != REFERENCE]
    rows = [row for track in others for row in against_reference(track, reference, drive)]
    return rows + [row for a, b in combinations(others, 2) for row in _ranked(a, b, reference, drive)]


def against_reference(track: StateTrack, reference: StateTrack, drive: EvaluatedDrive) -> list[MetricRow]:
    """Return the rows of one estimate [N] by segment."""
    masks = packed(drive.masks, len(track))
    sums = SegmentSums()
    for start, end in row_blocks(len(track)):
        a, b = track.rows(start, end), reference.rows(start, end)
        used = a.valid & b.valid & (a.vx_m_s > drive.low_speed_m_s) & (b.vx_m_s > drive.low_speed_m_s)
        difference = np.where(used, wrap_angle(a.sideslip_rad - b.sideslip_rad), np.nan)
        independent = np.where(used, b.independent, np.nan)
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


def _ranked(a: StateTrack, b: StateTrack, reference: StateTrack, drive: EvaluatedDrive) -> list[MetricRow]:
    """Return by how much the first of two estimates [N] is further off, by segment, where that may be claimed.

    Only stamps count at which the reference is independent and the two differ by more than its standard deviation.
    """
    masks = packed(drive.masks, len(a))
    sums = SegmentSums()
    for start, end in row_blocks(len(a)):
        first, second, c = (t.rows(start, end) for t in (a, b, reference))
        used = first.valid & second.valid & c.valid & (c.vx_m_s > drive.low_speed_m_s) & (c.independent > 0.0)
        used &= np.abs(wrap_angle(first.sideslip_rad - second.sideslip_rad)) > c.sideslip_std_rad
        errors = [wrap_angle(t.sideslip_rad - c.sideslip_rad) ** 2 for t in (first, second)]
        sums.add(masks.rows(start, end), *(np.where(used, e, np.nan) for e in (*errors, c.sideslip_std_rad**2)))
    rows = []
    for segment, (n, (of_a, of_b, variance)) in sums.totals().items():
        further = float(np.sqrt(of_a / n) - np.sqrt(of_b / n))
        if abs(further) > np.sqrt(variance / n):
            name = f"{a.name}~{b.name}"
            rows.append(MetricRow(drive.log, name, "sideslip_rad", segment, "reference_further", further, "rad", n))
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
        "share of these stamps at which GNSS has more than half of the reference's information; at the others axle law "
        "and kinematics of the same IMU prevail",
        _FUNCTION,
        unit="1",
    ),
    Metric(
        "reference_further",
        "further from reference",
        "by how much the first of two estimates `a~b` is further from the sideslip reference, as RMS, than the second, "
        "at the stamps where the reference is independent and the two differ by more than its 1-sigma. Only where this "
        "exceeds the RMS of that 1-sigma: other pairs are not ranked",
        _FUNCTION,
    ),
)
