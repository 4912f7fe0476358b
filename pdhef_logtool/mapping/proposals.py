"""Quantities of columns without names, by physics: a_x ≈ v̇, a_y ≈ v r, and steering against the path's curvature."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from pdhef_logtool.mapping.evidence import Pieces, Seen, fit
from pdhef_logtool.records.signals import FloatArray

#: Most columns that are compared, and units of a speed, an acceleration and a rate.
MOST_PROPOSED = 24
_SPEEDS = (("m/s", 1.0), ("km/h", 1 / 3.6))
_ACCELERATIONS = (("m/s²", 1.0), ("g", 9.80665))
_RATES = (("rad/s", 1.0), ("deg/s", math.radians(1.0)))
#: Least correlation of a relation; 1-sigma of the logarithm of its gain; how much surer the best proposal must be.
LEAST, SIGMA, MARGIN = 0.8, 0.15, 1.0
#: Range of the largest values, SI: speed, accelerations, yaw rate.
_SPANS = {"speed": (4.0, 90.0), "acceleration": (0.7, 16.0), "rate": (0.04, 2.5)}


class Proposal(NamedTuple):
    """A column (its place), its quantity and part, and its unit, empty if it is open."""

    column: int
    quantity: str
    part: str
    unit: str = ""


def propose(pieces: Pieces, columns: Sequence[Seen]) -> list[Proposal]:
    """Return speed, accelerations and yaw rate among columns, and those that may be a steering angle.

    Only one assignment may explain the drive: without speeding up, a yaw rate, a_y and a steering angle are alike.
    """
    cells = [pieces.smooth(c.cells) for c in columns[:MOST_PROPOSED]]
    ways = sorted(_ways(pieces, columns, cells), key=lambda w: -w[0])
    if not ways:
        return []
    (surest, best), *others = ways
    if any(score > surest - MARGIN and _places(way) != _places(best) for score, way in others):
        return []
    used = _places(best)
    speed, rate = (cells[p.column] * dict((*_SPEEDS, *_RATES))[p.unit] for p in (best[0], best[-1]))
    with np.errstate(invalid="ignore", divide="ignore"):
        curvature = np.where(speed > 1.0, rate / speed, np.nan)
    relations = ((i, fit(c, curvature)) for i, c in enumerate(cells) if i not in used)
    steering = {i: abs(r.correlation) for i, r in relations if r is not None and abs(r.correlation) > LEAST}
    return [*best, *(Proposal(i, "steering", "") for i in sorted(steering, key=lambda i: -steering[i])[:1])]


def _places(way: Sequence[Proposal]) -> tuple[int, ...]:
    return tuple(p.column for p in way)


def _ways(
    pieces: Pieces, columns: Sequence[Seen], cells: Sequence[FloatArray]
) -> Iterator[tuple[float, list[Proposal]]]:
    """Yield assignments of speed, a_x, a_y and yaw rate with their evidence."""
    sizes = [c.largest for c in columns]
    is_speed = [bool(np.nanmin(c) > -0.05 * s) for c, s in zip(cells, sizes, strict=True)]
    for v in (i for i, there in enumerate(is_speed) if there):
        speeding_up, turning = pieces.rate_of(columns[v].cells), [c * cells[v] for c in cells]
        others = [i for i in range(len(cells)) if i != v]
        along = [(i, r) for i in others if (r := fit(cells[i], speeding_up)) is not None and r.correlation > LEAST]
        across = [
            (y, r, relation)
            for y, r in itertools.permutations(others, 2)
            if (relation := fit(cells[y], turning[r])) is not None and abs(relation.correlation) > LEAST
        ]
        for (x, ahead), (y, r, left) in itertools.product(along, across):
            if x in (y, r):
                continue
            evidence = sum(math.atanh(min(abs(f.correlation), 0.999)) for f in (ahead, left))
            for (su, s), (au, a), (ru, w) in itertools.product(_SPEEDS, _ACCELERATIONS, _RATES):
                spans = zip((v, x, y, r), (s, a, a, w), ("speed", *["acceleration"] * 2, "rate"), strict=True)
                gains = ahead.slope * a / s, abs(left.slope) * a / (s * w)
                off = 0.5 * sum((math.log(g) / SIGMA) ** 2 for g in gains)
                if all(_SPANS[q][0] < sizes[i] * u < _SPANS[q][1] for i, u, q in spans):
                    yield (
                        evidence - off,
                        [
                            Proposal(v, "speed", "x", su),
                            Proposal(x, "acceleration", "x", au),
                            Proposal(y, "acceleration", "y", au),
                            Proposal(r, "rate", "z", ru),
                        ],
                    )
