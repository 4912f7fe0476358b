"""Quantities of columns without names, by physics: a_x ≈ v̇, a_y ≈ v r, and steering against the path's curvature."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import permutations, product

import numpy as np

from pdhef_logtool.mapping.evidence import Pieces, Seen, fit
from pdhef_logtool.mapping.naming import VOCABULARY
from pdhef_logtool.records.signals import FloatArray

#: Quantities and parts that a proposal consists of, and the range of the largest value of each in a drive, SI.
_QUANTITIES = (("speed", "x"), ("acceleration", "x"), ("acceleration", "y"), ("rate", "z"))
_LARGEST = {"speed": (4.0, 90.0), "acceleration": (0.7, 16.0), "rate": (0.04, 2.5)}
#: Most columns that are compared; least correlation of a relation; 1-sigma of the logarithm of its gain; how much surer
#: the best proposal must be.
MOST_PROPOSED, LEAST, SIGMA, MARGIN = 24, 0.8, 0.15, 1.0


def propose(pieces: Pieces, columns: Sequence[Seen]) -> dict[int, tuple[str, str, str]]:
    """Return quantity, part and unit by the place of a column: speed, accelerations, yaw rate and a steering angle.

    Only one assignment may explain the drive: without speeding up, a yaw rate, a_y and a steering angle are alike. The
    unit of a steering angle stays open (empty).
    """
    cells = [pieces.smooth(c.cells) for c in columns[:MOST_PROPOSED]]
    ways = sorted(_ways(pieces, columns, cells), reverse=True)
    if not ways or any(score > ways[0][0] - MARGIN and places != ways[0][1] for score, places, _ in ways):
        return {}
    _, places, units = ways[0]
    speed, rate = (cells[places[i]] * VOCABULARY["possible_units"][_QUANTITIES[i][0]][units[i]] for i in (0, -1))
    with np.errstate(invalid="ignore", divide="ignore"):
        curvature = np.where(speed > 1.0, rate / speed, np.nan)
    relations = ((i, fit(c, curvature)) for i, c in enumerate(cells) if i not in places)
    surest, steering = max(((abs(r.correlation), i) for i, r in relations if r is not None), default=(0.0, 0))
    proposed = {p: (*q, u) for p, q, u in zip(places, _QUANTITIES, units, strict=True)}
    return proposed | ({steering: ("steering", "", "")} if surest > LEAST else {})


def _ways(
    pieces: Pieces, columns: Sequence[Seen], cells: Sequence[FloatArray]
) -> Iterator[tuple[float, tuple[int, ...], tuple[str, ...]]]:
    """Yield evidence, columns and units of the assignments that the drive's motion supports."""
    units = [[*VOCABULARY["possible_units"][q].items()][:2] for q in _LARGEST]  # the others are rare
    for v in (i for i, c in enumerate(cells) if np.fmin.reduce(c) > -0.05 * columns[i].largest):
        others = [i for i in range(len(cells)) if i != v]
        along = ((x, fit(cells[x], pieces.rate_of(columns[v].cells))) for x in others)
        for x, ahead in [(x, f) for x, f in along if f is not None and f.correlation > LEAST]:
            for y, r in permutations([i for i in others if i != x], 2):
                left = fit(cells[y], cells[r] * cells[v])
                if left is None or abs(left.correlation) < LEAST:
                    continue
                evidence = sum(math.atanh(min(abs(f.correlation), 0.999)) for f in (ahead, left))
                for (su, s), (au, a), (ru, w) in product(*units):
                    off = sum((math.log(g) / SIGMA) ** 2 for g in (ahead.slope * a / s, abs(left.slope) * a / (s * w)))
                    sizes = (columns[i].largest * u for i, u in zip((v, x, y, r), (s, a, a, w), strict=True))
                    limits = (_LARGEST[quantity] for quantity, _ in _QUANTITIES)
                    if all(low < size < high for size, (low, high) in zip(sizes, limits, strict=True)):
                        yield evidence - 0.5 * off, (v, x, y, r), (su, au, au, ru)
