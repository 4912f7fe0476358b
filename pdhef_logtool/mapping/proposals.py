"""Quantities of columns whose names give none, by physics: a_x ≈ v̇, a_y ≈ v r, and steering against curvature.

Columns with a named quantity take part in the relations; units, where a column has one, exclude quantities.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import NamedTuple, TypeAlias

import numpy as np

from pdhef_logtool.mapping.evidence import Fit, Pieces, Seen, fit
from pdhef_logtool.records.signals import FloatArray

#: Quantities and parts that a proposal consists of, and the range of the largest value of each in a drive, SI.
ROLES = (("speed", "x"), ("acceleration", "x"), ("acceleration", "y"), ("rate", "z"))
_LARGEST = {"speed": (4.0, 90.0), "acceleration": (0.7, 16.0), "rate": (0.04, 2.5)}
#: Most columns that are compared; least correlation of a relation; 1-sigma of the logarithm of its gain; how much surer
#: the best proposal must be.
MOST_PROPOSED, LEAST, SIGMA, MARGIN = 24, 0.8, 0.15, 1.0
#: Possible units and their factors to SI, by quantity.
Units: TypeAlias = Mapping[str, Sequence[tuple[str, float]]]
#: Column of each role, None without one.
_Places: TypeAlias = tuple[int | None, ...]


class Column(NamedTuple):
    """Values of a column, and its possible units with their factors by quantity; ``role``: by its name, else None."""

    seen: Seen
    units: Units
    role: tuple[str, str] | None = None


def propose(
    pieces: Pieces, columns: Sequence[Column], wanted: Sequence[tuple[str, str]]
) -> dict[int, tuple[str, str, str]]:
    """Return quantity, part and unit by the place of a column without a role, for the wanted ones of :data:`ROLES`.

    Only one assignment may explain the drive: without speeding up, a yaw rate, a_y and a steering angle are alike. The
    unit of a steering angle stays open (empty).
    """
    cells = [pieces.smooth(c.seen.cells) for c in columns]
    options = [_options(columns, role, wanted) for role in ROLES]
    ways = sorted(_ways(pieces, columns, cells, options), key=lambda way: -way[0])
    if not ways or any(score > ways[0][0] - MARGIN and places != ways[0][1] for score, places, _ in ways):
        return {}
    _, places, units = ways[0]
    chosen = {p: (*q, u) for p, q, u in zip(places, ROLES, units, strict=True) if p is not None}
    factor = {p: dict(columns[p].units[q])[u] for p, (q, _, u) in chosen.items()}
    proposed = {p: meaning for p, meaning in chosen.items() if columns[p].role is None}
    v, _, y, r = places
    if v is None or (r is None and y is None) or ("steering", "") not in wanted:
        return proposed
    speed = cells[v] * factor[v]
    with np.errstate(invalid="ignore", divide="ignore"):
        rate = cells[r] * factor[r] if r is not None else cells[y or 0] * factor[y or 0] / speed
        curvature = np.where(speed > 1.0, rate / speed, np.nan)
    free = [i for i, c in enumerate(columns) if i not in chosen and c.role is None and "steering" in c.units]
    # A roll angle follows the lateral acceleration better than the curvature.
    surest, steering = max(((_strength(cells[i], curvature), i) for i in free), default=(0.0, 0))
    surest = 0.0 if surest < _strength(cells[steering], rate * speed) else surest
    return proposed | ({steering: ("steering", "", "")} if surest > LEAST else {})


def _options(columns: Sequence[Column], role: tuple[str, str], wanted: Sequence[tuple[str, str]]) -> list[int | None]:
    """Return the columns that may have a role: the named ones, else those without a name if the role is wanted."""
    named: list[int | None] = [i for i, c in enumerate(columns) if c.role == role]
    free = [i for i, c in enumerate(columns) if c.role is None and role[0] in c.units] if role in wanted else []
    return named[:1] or [*free, None]


def _ways(
    pieces: Pieces, columns: Sequence[Column], cells: Sequence[FloatArray], options: Sequence[Sequence[int | None]]
) -> Iterator[tuple[float, _Places, tuple[str, ...]]]:
    """Yield evidence, columns and units of the assignments that the drive's motion supports."""
    of_v, of_x, of_y, of_r = options
    for v in (i for i in of_v if i is not None and np.fmin.reduce(cells[i]) > -0.05 * columns[i].seen.largest):
        ahead, left = dict[int | None, Fit](), dict[tuple[int | None, int | None], Fit]()
        change = pieces.rate_of(columns[v].seen.cells)
        for i in (i for i in of_x if i is not None):
            if (relation := fit(cells[i], change)) is not None and relation.correlation > LEAST:
                ahead[i] = relation
        for i, j in ((i, j) for i, j in product(of_y, of_r) if i is not None and j is not None and i != j):
            if (relation := fit(cells[i], cells[j] * cells[v])) is not None and abs(relation.correlation) > LEAST:
                left[i, j] = relation
        for x, y, r in product(of_x, of_y, of_r):
            used = [p for p in (v, x, y, r) if p is not None]
            free = {p for p in used if columns[p].role is None}
            related = {v, x} if x in ahead else set()
            related |= {v, y, r} if (y, r) in left else set()
            # An acceleration without a lateral one may be the derivative of the speed.
            if free <= related and len({*used}) == len(used) and not (x in free and y is None):
                relations = [(f, i) for i, f in enumerate((ahead.get(x), left.get((y, r)))) if f is not None]
                yield from _with_units(columns, (v, x, y, r), relations)


def _with_units(
    columns: Sequence[Column], places: _Places, relations: Sequence[tuple[Fit, int]]
) -> Iterator[tuple[float, _Places, tuple[str, ...]]]:
    """Yield an assignment with its possible units; relations are a_x ≈ v̇ (0) and a_y ≈ v r (1)."""
    of_roles = [*zip(places, ROLES, strict=True)]
    surety = sum(math.atanh(min(abs(f.correlation), 0.999)) for f, _ in relations)
    for units in product(*(columns[p].units[q] if p is not None else (("", 1.0),) for p, (q, _) in of_roles)):
        v, x, y, r = (factor for _, factor in units)
        off = sum((math.log(abs(f.slope) * (x / v, y / (r * v))[i]) / SIGMA) ** 2 for f, i in relations)
        new = [(columns[p], u, q) for (p, (q, _)), (_, u) in zip(of_roles, units, strict=True) if p is not None]
        sizes = ((c.seen.largest * u, _LARGEST[q]) for c, u, q in new if c.role is None)
        if all(low < size < high for size, (low, high) in sizes):
            yield surety - 0.5 * off, places, tuple(name for name, _ in units)


def _strength(y: FloatArray, x: FloatArray) -> float:
    """Return the magnitude of a correlation; 0 without enough cells."""
    relation = fit(y, x)
    return 0.0 if relation is None else abs(relation.correlation)
