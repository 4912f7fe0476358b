"""How far estimates are from the sideslip reference, where no ground truth states their error, and which is closer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from pdhef_logtool.evaluation.blocks import SegmentMasks, SegmentSums, packed, row_blocks
from pdhef_logtool.evaluation.metrics.metric import EvaluatedDrive, Metric, MetricRow, OfDrive
from pdhef_logtool.evaluation.track_errors import NORMAL_95
from pdhef_logtool.records.geometry import wrap_angle
from pdhef_logtool.records.signals import BoolArray, FloatArray
from pdhef_logtool.records.tracks import REFERENCE, StateTrack

#: Time within which the error of the reference is taken to be the same, s.
BLOCK_S = 10.0


def _rows(drive: EvaluatedDrive) -> list[MetricRow]:
    others = dict(drive.tracks)
    reference = others.pop(REFERENCE, None)
    if reference is None:
        return []
    estimates = list(others.values())
    return reference_rows(estimates, reference, drive.masks, log=drive.log, low_speed_m_s=drive.low_speed_m_s)


def reference_rows(
    estimates: Sequence[StateTrack],
    reference: StateTrack,
    masks: Mapping[str, BoolArray],
    *,
    log: str,
    low_speed_m_s: float,
) -> list[MetricRow]:
    """Return the figures of estimates and of their pairs against the reference, all [N] at the same stamps."""
    place = _Place(log, low_speed_m_s, packed(masks, len(reference)))
    rows = [row for track in estimates for row in _against(track, reference, place)]
    return rows + [row for a, b in combinations(estimates, 2) for row in _ranked(a, b, reference, place)]


@dataclass(frozen=True, slots=True)
class _Place:
    log: str
    low_speed_m_s: float
    masks: SegmentMasks

    def row(self, estimator: str, segment: str, metric: str, value: float, n: int, unit: str = "rad") -> MetricRow:
        return MetricRow(self.log, estimator, "sideslip_rad", segment, metric, value, unit, n)


def _against(track: StateTrack, reference: StateTrack, place: _Place) -> Iterator[MetricRow]:
    sums = SegmentSums()
    for start, end in row_blocks(len(track)):
        a, b = track.rows(start, end), reference.rows(start, end)
        used = a.valid & b.valid & (b.vx_m_s > place.low_speed_m_s) & ~(a.vx_m_s <= place.low_speed_m_s)
        difference = np.where(used, wrap_angle(a.sideslip_rad - b.sideslip_rad), np.nan)
        independent = np.where(used, b.independent, np.nan)
        sums.add(place.masks.rows(start, end), difference**2, b.sideslip_std_rad**2, independent)
    for segment, (n, (squares, variances, independents)) in sums.totals().items():
        yield place.row(track.name, segment, "reference_rms", float(np.sqrt(squares / n)), n)
        yield place.row(track.name, segment, "reference_std", float(np.sqrt(variances / n)), n)
        yield place.row(track.name, segment, "reference_independent", float(independents / n), n, "1")


def _ranked(a: StateTrack, b: StateTrack, reference: StateTrack, place: _Place) -> Iterator[MetricRow]:
    """Yield by how much the first of two estimates [N] is further off, by segment, where that may be claimed.

    An error of the reference δ changes the difference of the squares Σ (β_a − β_c)² − (β_b − β_c)² by
    2 Σ (β_a − β_b) δ; δ is its standard deviation, of one sign within ``BLOCK_S`` and independent between.
    """
    sums, doubts = SegmentSums(), dict[str, FloatArray]()
    start_ns, block_ns = reference.stamps_ns[0], round(BLOCK_S * 1e9)
    blocks = int((reference.stamps_ns[-1] - start_ns) // block_ns) + 1
    for start, end in row_blocks(len(a)):
        first, second, c = (t.rows(start, end) for t in (a, b, reference))
        used = first.valid & second.valid & c.valid & (c.vx_m_s > place.low_speed_m_s)
        errors = [wrap_angle(t.sideslip_rad - c.sideslip_rad) ** 2 for t in (first, second)]
        doubt = 2.0 * np.abs(wrap_angle(first.sideslip_rad - second.sideslip_rad)) * c.sideslip_std_rad
        used &= np.isfinite(errors[0] + errors[1] + doubt)
        masks = place.masks.rows(start, end)
        sums.add(masks, *(np.where(used, e, np.nan) for e in errors))
        number = (c.stamps_ns - start_ns) // block_ns
        for segment, mask in masks.items():
            of_blocks = doubts.setdefault(segment, np.zeros(blocks))
            of_blocks += np.bincount(number[mask & used], doubt[mask & used], blocks)
    for segment, (n, (of_a, of_b)) in sums.totals().items():
        if abs(of_a - of_b) > NORMAL_95 * np.linalg.norm(doubts[segment]):
            further = float(np.sqrt(of_a / n) - np.sqrt(of_b / n))
            yield place.row(f"{a.name}~{b.name}", segment, "reference_further", further, n)


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
        "by how much the first of two estimates `a~b` is further from the sideslip reference, as RMS, than the second. "
        "Only where the difference of their mean squares exceeds 1.96 of its standard deviation, which follows from "
        "the reference's own, with one error in each 10 s: other pairs are not ranked",
        _FUNCTION,
    ),
)
