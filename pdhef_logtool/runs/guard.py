"""The default estimate is never much worse than the simple ones: what d2 says of it (METHOD §17)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pdhef_logtool.evaluation.metrics import MetricRow

#: What is guarded, and by what; ``kinematic`` is none of them, for it integrates what d2 holds against an estimate.
GUARDED = "pd-hef"
SIMPLE = ("zero", "open-loop", "open-loop-calibrated", "phy-ukf", "physics")
#: On simulated drives with right and wrong files every estimate beyond 1.05 times the least d2 had at least 1.7 times
#: its sideslip error (docs/self_calibration.md).
FACTOR = 1.2


@dataclass(frozen=True, slots=True)
class Distrust:
    """The guarded estimate contradicts the sensors more than the ``best`` of the simple ones; d2 of both in m/s."""

    best: str
    own_d2: float
    best_d2: float

    @property
    def text(self) -> str:
        """What is told."""
        return (
            f"{GUARDED} contradicts the sensors: its d2 is {self.own_d2:.3g} m/s, that of {self.best} "
            f"{self.best_d2:.3g}; the vehicle file may be wrong"
        )


def distrust(rows: Iterable[MetricRow]) -> Distrust | None:
    """Return what speaks against the guarded estimate; None where nothing does, or it ran alone."""
    d2 = {r.estimator: r.value for r in rows if (r.metric, r.segment) == ("d2", "all")}
    simple = {name: d2[name] for name in SIMPLE if name in d2}
    if GUARDED not in d2 or not simple:
        return None
    best = min(simple, key=lambda name: simple[name])
    return Distrust(best, d2[GUARDED], simple[best]) if d2[GUARDED] > FACTOR * simple[best] else None
