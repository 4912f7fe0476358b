"""What a filter reports of itself: normalized innovations and divergence; needs no ground truth."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pdhef_logtool.evaluation.blocks import SegmentMasks, SegmentSums, packed, row_blocks
from pdhef_logtool.evaluation.metrics.metric import Metric, MetricRow, OfTrack
from pdhef_logtool.records.signals import BoolArray
from pdhef_logtool.records.tracks import StateTrack


def _rows(estimate: StateTrack, _truth: StateTrack | None, masks: SegmentMasks, log: str) -> list[MetricRow]:
    return state_rows(estimate, masks, log=log)


def state_rows(track: StateTrack, masks: Mapping[str, BoolArray], *, log: str) -> list[MetricRow]:
    """Return ``nis``, ``nis_dof`` and ``diverged`` of a track; no NIS rows without innovations."""
    masks = packed(masks, len(track))
    innovation, diverged = SegmentSums(), SegmentSums()
    for a, b in row_blocks(len(track)):
        part, inside = track.rows(a, b), masks.rows(a, b)
        dof = part.nis_dof
        innovation.add(inside, np.where(dof > 0, part.nis, np.nan), dof)
        diverged.add(inside, part.diverged)
    figures = [
        (segment, metric, float(total[i]) / n, n)
        for sums, metrics in ((innovation, ("nis", "nis_dof")), (diverged, ("diverged",)))
        for segment, (n, total) in sums.totals().items()
        for i, metric in enumerate(metrics)
    ]
    place = list(masks).index
    return [
        MetricRow(log, track.name, "state", *figure[:3], "1", figure[3])
        for figure in sorted(figures, key=lambda f: place(f[0]))
    ]


_FUNCTION = OfTrack(_rows)
METRICS = (
    Metric("nis", "NIS", "mean normalized innovation squared. Signal `state`", _FUNCTION, unit="1", brief=("state",)),
    Metric(
        "nis_dof",
        "degrees of freedom",
        "mean of the degrees of freedom of NIS, which `nis` should equal. Signal `state`",
        _FUNCTION,
        unit="1",
        brief=("state",),
    ),
    Metric(
        "diverged",
        "diverged",
        "share of stamps at which the estimator itself reports divergence. Signal `state`",
        _FUNCTION,
        best="lower",
        unit="1",
    ),
)
