"""``coverage95``: whether intervals contain ground truth as often as they claim."""

from __future__ import annotations

import numpy as np

from pdhef_logtool.evaluation.metrics.metric import Figure, Metric, OfSignal, Reference, SignalBlock
from pdhef_logtool.evaluation.track_errors import NORMAL_95
from pdhef_logtool.records.tracks import StateTrack


class _Coverage:
    def __init__(self, reference: Reference, _estimate: StateTrack, _signal: str) -> None:
        self._counts = {segment: np.zeros(2, dtype=np.int64) for segment in reference.masks}

    def add(self, block: SignalBlock) -> None:
        if block.std is None:
            return
        has_interval = block.scored & np.isfinite(block.std)
        covered = has_interval & (np.abs(block.error) <= NORMAL_95 * block.std)
        for segment, mask in block.inside.items():
            self._counts[segment] += np.count_nonzero(mask & has_interval), np.count_nonzero(mask & covered)

    def of(self, segment: str) -> dict[str, Figure]:
        has_interval, covered = self._counts[segment].tolist()
        return {"coverage95": (covered / has_interval, has_interval)} if has_interval else {}


METRICS = (
    Metric(
        "coverage95",
        "in 95 % CI",
        "share of stamps with abs e ≤ 1.96 σ; σ² is the estimate's variance plus that of ground truth if known",
        OfSignal(_Coverage),
        best=0.95,
        unit="1",
        digits=2,
        terminal=("sideslip_rad",),
        brief=("sideslip_rad",),
    ),
)
