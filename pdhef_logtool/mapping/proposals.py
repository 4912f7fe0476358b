"""Quantities of columns without a meaning by name, by physics: a_x ≈ v̇, a_y ≈ v r, and steering against curvature.

Fields with a quantity by name take part in the relations; the likelihood that decides their units decides these, too.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple, TypeAlias

import numpy as np

from pdhef_logtool.logs.drive_log import DriveLog, TopicInfo
from pdhef_logtool.logs.message_schema import FieldInfo
from pdhef_logtool.mapping import naming
from pdhef_logtool.mapping.can_frames import holds_frames
from pdhef_logtool.mapping.candidates import HYPOTHESES, PROPOSED, Field, Named, Role, field_of, is_column
from pdhef_logtool.mapping.evidence import EVIDENCE, Fit, Seen, fit
from pdhef_logtool.mapping.fields import BY_DRIVING, Fields, Gain, Unit, posterior
from pdhef_logtool.mapping.naming import Meaning, words_of

#: Quantity and part.
_Quantity: TypeAlias = tuple[str, str]
_SPEED, _AX, _AY, _RATE = ("speed", "x"), ("acceleration", "x"), ("acceleration", "y"), ("rate", "z")
#: Exponents of the quantities in the gains of a_x ≈ v̇ and a_y ≈ v r.
_FORWARD, _TURN = {_AX: 1, _SPEED: -1}, {_AY: 1, _RATE: -1, _SPEED: -1}
#: Range of the largest value of each quantity in a drive, SI.
_LIMITS = EVIDENCE["proposals"]
_LARGEST: dict[_Quantity, tuple[float, float]] = {q: _LIMITS["largest"][" ".join(q)] for q in (_SPEED, _AX, _AY, _RATE)}
_LEAST: float = _LIMITS["correlation"]
#: Words that leave the quantity of a field open: it may be any of them.
_OPEN_WORDS = naming.COUNTING | {"angle", "yaw"}


class _Column(NamedTuple):
    """A field of a sensor without a quantity by name."""

    topic: TopicInfo
    info: FieldInfo
    seen: Seen


class _Way(NamedTuple):
    """An assignment of fields and columns to quantities, with their units; ``score`` in log odds."""

    score: float
    items: Mapping[_Quantity, Field | _Column]
    units: Mapping[_Quantity, str]


def proposed_fields(
    log: DriveLog, topics: Sequence[tuple[TopicInfo, Role]], named: Sequence[Named], fields: Fields
) -> Iterator[Field]:
    """Yield the fields without a usable name that the drive's motion explains, for quantities that nothing gives.

    Only one assignment may explain the drive: without speeding up, a yaw rate, a_y and a steering angle are alike. The
    unit of a steering angle stays open.
    """
    measured = [f for f in (*fields.anchors.values(), *fields.candidates) if f.role != "command"]
    items = {quantity: item for quantity in _LARGEST if (item := _surest(measured, quantity)) is not None}
    steers = any(f.meaning.quantity == "steering" for f in measured)
    columns = [] if len(items) == len(_LARGEST) and steers else [*_open_columns(log, fields, topics, named)]
    if (best := _only([*_ways(fields, items, columns)])) is None:
        return
    for quantity, column in best.items.items():
        if isinstance(column, _Column):
            items[quantity] = _field(log, column, quantity, best.units[quantity])
            yield items[quantity]
    if not steers:
        free = [c for c in columns if c not in best.items.values() and not c.seen.is_off_centre]
        if (steering := _steering(fields, items, free)) is not None:
            yield _field(log, steering, ("steering", ""), "")


def _only(ways: Sequence[_Way]) -> _Way | None:
    """Return the surest assignment, or None if another one is nearly as sure."""
    best = max(ways, key=lambda way: way.score, default=None)
    others = (way.score for way in ways if best is not None and way.items != best.items)
    return None if best is None or max(others, default=-math.inf) > best.score - _LIMITS["margin"] else best


def _steering(fields: Fields, items: Mapping[_Quantity, Field], columns: Sequence[_Column]) -> _Column | None:
    """Return the column that follows the path's curvature best, or None."""
    v, ay, rate = (None if (item := items.get(q)) is None else item.si for q in (_SPEED, _AY, _RATE))
    curvature = fields.curvature(v, rate, ay)
    if v is None or curvature is None or not columns:
        return None
    follows = [abs(fit(fields.pieces.smooth(c.seen.cells), curvature).correlation) for c in columns]
    steering = columns[int(np.argmax(follows))]
    # A roll angle follows the lateral acceleration better than the curvature.
    rolls = abs(fit(steering.seen.cells, curvature * v**2).correlation)
    return steering if max(follows) > max(_LEAST, rolls) else None


def _surest(fields: Sequence[Field], quantity: _Quantity) -> Field | None:
    """Return the field of a quantity with the best name; a wheel speed replaces a missing speed."""
    its = [f for f in fields if f.meaning.quantity == quantity[0] and f.meaning.part in (quantity[1], "")]
    its = its or [f for f in fields if quantity == _SPEED and f.meaning.quantity == "wheel speed"]
    return max(its, key=lambda f: f.meaning.strength, default=None)


def _open_columns(
    log: DriveLog, fields: Fields, topics: Sequence[tuple[TopicInfo, Role]], named: Sequence[Named]
) -> Iterator[_Column]:
    """Yield the columns of the sensors' fields without a unit, and without a word that has a meaning."""
    # A "yaw" may be the yaw rate.
    by_name = {(topic.name, info.path) for topic, _, info, meant, _ in named if meant.quantity != "heading"}
    infos: dict[tuple[str, str], tuple[TopicInfo, FieldInfo]] = {}
    for topic in (t for t, role in topics if role == "sensor"):
        its = log.fields(topic.name, quiet=True)
        for info in () if holds_frames(topic.name, its) else filter(is_column, its):
            words = set(words_of(info.path)) - naming.STATES
            unknown = all(len(w) == 1 or w.isdigit() or w in _OPEN_WORDS or w not in naming.KNOWN for w in words)
            if unknown and not (info.unit or words & naming.NOT_VALUES or (topic.name, info.path) in by_name):
                infos[topic.name, info.path.removesuffix("[]")] = topic, info
    for (name, path), seen in fields.pieces.read([*infos][: _LIMITS["most"]]).items():
        topic, info = infos.get((name, path)) or infos[name, path.partition("[")[0]]
        if seen.changes:
            yield _Column(topic, replace(info, path=path), seen)


def _field(log: DriveLog, column: _Column, quantity: _Quantity, unit: str) -> Field:
    why = "named by the drive: a_x ≈ v̇, a_y ≈ v r and the path's curvature"
    meaning = Meaning(*quantity, PROPOSED, unit, dict(HYPOTHESES[quantity[0]]).get(unit), why)
    return field_of(
        log.fields(column.topic.name, quiet=True), column.topic, "sensor", column.info, meaning, column.seen
    )


def _ways(fields: Fields, named: Mapping[_Quantity, Field], columns: Sequence[_Column]) -> Iterator[_Way]:
    """Yield the assignments that the drive's motion supports."""
    pieces = fields.pieces
    every: list[Field | _Column] = [*named.values(), *columns]
    cells = {id(item): pieces.smooth(item.seen.cells) for item in every}
    of: dict[_Quantity, Sequence[Field | _Column]]
    of = {quantity: [named[quantity]] if quantity in named else columns for quantity in _LARGEST}
    for v in (v for v in of[_SPEED] if np.fmin.reduce(cells[id(v)]) > -_LIMITS["reverse"] * v.seen.largest):
        change = pieces.rate_of(v.seen.cells)
        ahead = [({_AX: x}, fit(cells[id(x)], change)) for x in of[_AX]]
        pairs = [(y, r) for y, r in product(of[_AY], of[_RATE]) if y is not r]
        left = [({_AY: y, _RATE: r}, fit(cells[id(y)], cells[id(r)] * cells[id(v)])) for y, r in pairs]
        forward = [(x, f) for x, f in ahead if f.correlation > _LEAST]
        turn = [(y_r, f) for y_r, f in left if abs(f.correlation) > _LEAST]
        for (x, along), (y_r, across) in product([*forward, ({}, Fit())], [*turn, ({}, Fit())]):
            if _is_possible({_SPEED: v, **x, **y_r}, named):
                yield from _with_units({_SPEED: v, **x, **y_r}, [(_FORWARD, along), (_TURN, across)])


def _is_possible(items: Mapping[_Quantity, Field | _Column], named: Mapping[_Quantity, Field]) -> bool:
    """Return whether each item has one quantity, and a relation or a name."""
    # An acceleration without a lateral one may be the derivative of the speed.
    is_derivative = _AX in items and _AX not in named and not {_AY} & (items.keys() | named.keys())
    is_related = len(items) > 1 or _SPEED in named
    return is_related and not is_derivative and len({*map(id, items.values())}) == len(items)


def _with_units(
    items: Mapping[_Quantity, Field | _Column], relations: Sequence[tuple[Mapping[_Quantity, int], Fit]]
) -> Iterator[_Way]:
    """Yield an assignment with its likeliest units, if any are possible."""
    units = []
    for quantity, item in items.items():
        low, high = _LARGEST[quantity]
        its = item.units if isinstance(item, Field) else HYPOTHESES[quantity[0]][:2]
        units.append([Unit(*u) for u in its if isinstance(item, Field) or low < item.seen.largest * u[1] < high])
    if not all(units):
        return
    seen = [(powers, f) for powers, f in relations if f.correlation]
    gains = [Gain(tuple(powers.get(q, 0) for q in items), f.slope, BY_DRIVING) for powers, f in seen]
    shares = posterior(units, gains)
    surety = sum(math.atanh(min(abs(f.correlation), _LIMITS["noiseless"])) for _, f in seen)
    best = np.unravel_index(int(shares.argmax()), shares.shape)
    names = {quantity: ways[i].name for quantity, ways, i in zip(items, units, best, strict=True)}
    if shares.max() > 0.0:
        yield _Way(surety + math.log(shares.max()), items, names)
