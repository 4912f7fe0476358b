"""``nis_autocorrelation``: whether innovations are white."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from pdhef_logtool.evaluation.blocks import SegmentMasks, SegmentSums, packed, row_blocks
from pdhef_logtool.evaluation.metrics.metric import EvaluatedDrive, Metric, MetricRow, OfDrive
from pdhef_logtool.records.signals import BoolArray, FloatArray
from pdhef_logtool.records.tracks import StateTrack


def _rows(drive: EvaluatedDrive) -> Iterator[MetricRow]:
    for track in drive.tracks.values():
        yield from whiteness_rows(track, drive.masks, log=drive.log)


def whiteness_rows(track: StateTrack, masks: Mapping[str, BoolArray], *, log: str) -> list[MetricRow]:
    """Return ``nis_autocorrelation`` of one estimator, a row a segment with at least ten pairs of stamps."""
    masks = packed(masks, len(track))
    first = SegmentSums()
    for inside, before, after in _pairs(track, masks):
        first.add(inside, before, after)
    means = {segment: sums / n for segment, (n, sums) in first.totals().items() if n >= 10}
    second = SegmentSums()
    for inside, before, after in _pairs(track, masks):
        for segment, mean in means.items():
            use = inside[segment] & np.isfinite(before)
            x, y = before[use] - mean[0], after[use] - mean[1]
            second.add_to(segment, x**2, y**2, x * y)
    rows = []
    for segment, (n, (of_before, of_after, of_both)) in second.totals().items():
        power = float(np.sqrt(of_before * of_after))
        value = float(of_both) / power if power > 0 else float("nan")
        rows.append(MetricRow(log, track.name, "state", segment, "nis_autocorrelation", value, "1", n))
    return rows


def _pairs(track: StateTrack, masks: SegmentMasks) -> Iterator[tuple[dict[str, BoolArray], FloatArray, FloatArray]]:
    """Yield, by block, ``NIS / dof`` [M] of stamps and of the following ones, NaN without it, and their masks."""
    for a, b in row_blocks(len(track)):
        start = max(a - 1, 0)
        part = track.rows(start, b)
        nis, dof = part.nis, part.nis_dof
        has_nis = np.isfinite(nis) & (dof > 0)
        ratio = np.where(has_nis, nis / np.where(has_nis, dof, 1.0), np.nan)
        both = has_nis[1:] & has_nis[:-1]
        inside = {segment: mask[1:] & mask[:-1] for segment, mask in masks.rows(start, b).items()}
        yield inside, np.where(both, ratio[:-1], np.nan), np.where(both, ratio[1:], np.nan)


METRICS = (
    Metric(
        "nis_autocorrelation",
        "whiteness",
        "autocorrelation of NIS per degree of freedom from one stamp to the next, signal `state`; 0 for white "
        "innovations, beyond ± 2/√n they are not white",
        OfDrive(_rows),
        best=0.0,
        unit="1",
    ),
)
