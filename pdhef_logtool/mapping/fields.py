"""Fields of a log during the evaluation of candidates: look-ups and relations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.mapping.candidates import Field
from pdhef_logtool.mapping.evidence import Fit, Pieces, fit, spread
from pdhef_logtool.records.signals import FloatArray

#: Smallest correlation that counts as a relation.
CLEAR = 0.75
#: Smallest standard deviation of an acceleration that excites a relation.
EXCITED_A_M_S2 = 0.25
#: Standard deviation of the curvature below which a path counts as straight; speed at standstill.
EXCITED_CURVATURE_1_M, SLOW_M_S = 0.0001, 1.0


@dataclass(slots=True)
class Fields:
    """Candidates, mapped sources (``anchors``, by signal) and positions, on one time grid."""

    pieces: Pieces
    anchors: dict[str, Field]
    candidates: list[Field]
    positions: list[Field]

    def all(self, quantity: str, part: str | None = None) -> list[Field]:
        """Return anchors and candidates of a quantity, the surest first."""
        every = [f for f in (*self.anchors.values(), *self.candidates) if f.meaning.quantity == quantity]
        every = [f for f in every if f.role not in ("command", "estimate", "truth") or f.anchor]
        return sorted((f for f in every if part is None or f.meaning.part == part), key=lambda f: -f.score)

    def open(self, quantity: str, part: str | None = None) -> list[Field]:
        """Return the fields of a quantity and part that are not constant."""
        return [f for f in self.all(quantity, part) if f.seen.changes]

    def best(self, quantity: str) -> Field | None:
        """Return the surest field of a quantity that is not constant."""
        return next(iter(self.open(quantity)), None)

    def turning(self, ay: FloatArray, rate: FloatArray, speed: FloatArray) -> Fit | None:
        """Fit a_y to v r; None if the car does not turn."""
        expected = rate * speed
        if not spread(expected) > EXCITED_A_M_S2:
            return None
        return fit(self.pieces.smooth(ay), self.pieces.smooth(expected))

    def curvature(
        self, speed: FloatArray | None, rate: FloatArray | None, ay: FloatArray | None = None
    ) -> FloatArray | None:
        """Return the path's curvature while moving, 1/m [M], by yaw rate or else a_y; None if the path is straight."""
        if speed is None or not np.isfinite(speed).any():
            return None
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            turning = ay / speed if rate is None and ay is not None else rate
            moving = speed > max(SLOW_M_S, 0.25 * float(np.nanquantile(speed, 0.95)))
            curve = None if turning is None else self.pieces.smooth(np.where(moving, turning / speed, np.nan))
        return curve if curve is not None and spread(curve) > EXCITED_CURVATURE_1_M else None


def agree(a: FloatArray, b: FloatArray) -> bool:
    """Return whether two fields on the grid [M] have the same values."""
    relation = fit(a, b)
    return relation is not None and relation.correlation > 0.97 and 0.9 < relation.slope < 1.1


def mean_of(columns: Sequence[FloatArray]) -> FloatArray:
    """Return the mean over the columns [M] that are finite in each cell."""
    stacked = np.stack(columns)
    finite = np.isfinite(stacked)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(finite, stacked, 0.0).sum(axis=0) / finite.sum(axis=0))
