"""``availability``: how much of a drive an estimate covers."""

from __future__ import annotations

import numpy as np

from pdhef_logtool.evaluation.blocks import row_blocks
from pdhef_logtool.evaluation.metrics.metric import Figure, Metric, OfSignal, Reference, SignalBlock
from pdhef_logtool.evaluation.units import SCORED_SIGNALS
from pdhef_logtool.records.tracks import StateTrack


class _Availability:
    def __init__(self, reference: Reference, _estimate: StateTrack, signal: str) -> None:
        self._asked = reference.once(_count_scorable)[signal]
        self._scored = dict.fromkeys(self._asked, 0)

    def add(self, block: SignalBlock) -> None:
        for segment, mask in block.inside.items():
            self._scored[segment] += int(np.count_nonzero(mask & block.scored))

    def of(self, segment: str) -> dict[str, Figure]:
        asked = self._asked[segment]
        return {"availability": (self._scored[segment] / asked, asked)} if asked else {}


def _count_scorable(reference: Reference) -> dict[str, dict[str, int]]:
    """Return by signal how many stamps of each segment ground truth can score."""
    by_signal: dict[str, dict[str, int]] = {signal: dict.fromkeys(reference.masks, 0) for signal in SCORED_SIGNALS}
    for a, b in row_blocks(len(reference.truth)):
        for segment, mask in reference.masks.rows(a, b).items():
            for signal, counts in by_signal.items():
                counts[segment] += int(np.count_nonzero(mask & reference.scorable.rows(a, b)[signal]))
    return by_signal


METRICS = (
    Metric(
        "availability",
        "available",
        "share of the stamps with scorable ground truth at which the estimate is valid and finite; n = all of them",
        OfSignal(_Availability),
        best="higher",
        unit="1",
    ),
)
