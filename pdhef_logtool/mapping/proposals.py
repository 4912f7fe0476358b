"""Quantities of columns without a meaning by name, by physics: a_x ≈ v̇, a_y ≈ v r, and steering against curvature.

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
#: Column of each quantity, None without one.
_Places: TypeAlias = tuple[int | None, ...]


class Column(NamedTuple):
    """Values of a column, and its possible units by quantity; ``role``: its quantity by name, or None."""

    seen: Seen
    units: Units
    role: tuple[str, str] | None = None


def propose(
    pieces: Pieces, columns: Sequence[Column], wanted: Sequence[tuple[str, str]]
) -> dict[int, tuple[str, str, str]]:
    """Return quantity, part and unit by the place of a column without a name, for the wanted ones of :data:`ROLES`.

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
    steering = _steering(columns, cells, places, factor) if ("steering", "") in wanted else None
    return proposed if steering is None else {**proposed, steering: ("steering", "", "")}


def _steering(
    columns: Sequence[Column], cells: Sequence[FloatArray], places: _Places, factor: Mapping[int, float]
) -> int | None:
    """Return the column without a name that follows the path's curvature best, or None."""
    v, _, y, r = places
    turning = y if r is None else r
    if v is None or turning is None:
        return None
    speed = cells[v] * factor[v]
    with np.errstate(invalid="ignore", divide="ignore"):
        rate = cells[turning] * factor[turning] / (speed if r is None else 1.0)
        curvature, lateral = np.where(speed > 1.0, rate / speed, np.nan), rate * speed
    free = {i for i, c in enumerate(columns) if c.role is None and "steering" in c.units and not c.seen.is_off_centre}
    surest, steering = max(((abs(fit(cells[i], curvature).correlation), i) for i in free - {*places}), default=(0.0, 0))
    # A roll angle follows the lateral acceleration better than the curvature.
    return steering if surest > max(LEAST, abs(fit(cells[steering], lateral).correlation)) else None


def _options(columns: Sequence[Column], role: tuple[str, str], wanted: Sequence[tuple[str, str]]) -> list[int | None]:
    """Return the columns that may be a quantity: the named ones, else those without a name if it is wanted."""
    named: list[int | None] = [i for i, c in enumerate(columns) if c.role == role]
    free = [i for i, c in enumerate(columns) if c.role is None and role[0] in c.units] if role in wanted else []
    return named[:1] or [*free, None]


def _ways(
    pieces: Pieces, columns: Sequence[Column], cells: Sequence[FloatArray], options: Sequence[Sequence[int | None]]
) -> Iterator[tuple[float, _Places, tuple[str, ...]]]:
    """Yield evidence, columns and units of the assignments that the drive's motion supports."""
    of_v, *others = options
    for v in (i for i in of_v if i is not None and np.fmin.reduce(cells[i]) > -0.05 * columns[i].seen.largest):
        ahead, left = _relations(pieces.rate_of(columns[v].seen.cells), cells, v, others)
        for x, y, r in product(*others):
            used = [p for p in (v, x, y, r) if p is not None]
            free = {p for p in used if columns[p].role is None}
            related = ({v, x} if x in ahead else set()) | ({v, y, r} if (y, r) in left else set())
            # An acceleration without a lateral one may be the derivative of the speed.
            if free <= related and len({*used}) == len(used) and not (x in free and y is None):
                relations = [(f, i) for i, f in enumerate((ahead.get(x), left.get((y, r)))) if f is not None]
                yield from _with_units(columns, (v, x, y, r), relations)


def _relations(
    change: FloatArray, cells: Sequence[FloatArray], v: int, others: Sequence[Sequence[int | None]]
) -> tuple[dict[int | None, Fit], dict[tuple[int | None, int | None], Fit]]:
    """Return the fits of a_x ≈ v̇ and of a_y ≈ v r for a speed ``v``, by columns."""
    of_x, of_y, of_r = ([i for i in its if i is not None] for its in others)
    ahead = {x: fit(cells[x], change) for x in of_x}
    left = {(y, r): fit(cells[y], cells[r] * cells[v]) for y, r in product(of_y, of_r) if y != r}
    return (
        {x: f for x, f in ahead.items() if f.correlation > LEAST},
        {pair: f for pair, f in left.items() if abs(f.correlation) > LEAST},
    )


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
