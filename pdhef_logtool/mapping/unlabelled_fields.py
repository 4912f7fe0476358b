"""Identify unlabelled fields (``data[3]``, ``ch7``, ``k``) by physical relations.

Speed, yaw rate and accelerations are identified if exactly one choice of columns satisfies a_y = v r and a_x = v̇ with
slopes that units explain. The slope of a_x = v̇ gives the units of speed and accelerations; the ratio of both slopes
gives the unit of the yaw rate, and also separates a yaw rate from a steering angle. Left and right are not observable.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pdhef_logtool.logs.drive_log import DriveLog, TopicInfo
from pdhef_logtool.mapping.candidates import ANGLES, HYPOTHESES, MOST_FIELDS, Field, Role, stamp_of
from pdhef_logtool.mapping.evidence import Fit, Pieces, fit, is_of_both_signs, ratio, spread
from pdhef_logtool.mapping.fields import EXCITED_A_M_S2, Fields
from pdhef_logtool.mapping.naming import G_M_S2, Meaning, is_command, is_unlabelled, meaning_of
from pdhef_logtool.mapping.path import path_speed
from pdhef_logtool.records.signals import FloatArray

#: Maximum number of columns to examine, in total and per array.
MOST_UNLABELLED = 40
MOST_OF_ARRAY = 32
#: Minimum correlations of a_y with v r and of a_x with v̇; for competing choices, the loose ones.
TURNS, SPEEDS_UP = 0.92, 0.75
LOOSE_TURNS, LOOSE_SPEEDS_UP = 0.8, 0.6
#: Minimum lead of the product of the correlations over any other choice.
CLEARER = 0.05
#: Largest residual of a_y over v r, relative to the residuals over r alone and over r √v. A steering angle gives a yaw
#: rate that increases with speed, but less than in proportion, as cars understeer.
BY_SPEED, BY_ROOT = 0.6, 0.85
#: Minimum lead of a_y over v r, as the sideslip of a car grows first; a yaw rate lags the steering.
AHEAD_S = 0.05
#: Tolerance factors of a slope: accelerations include roll and grade.
SLOPE, LOOSE_SLOPE = 1.25, 1.6
#: Smallest standard deviation of an acceleration; a yaw rate in rad/s is smaller.
LEAST_AY_M_S2 = 0.4
#: Minimum correlation between copies of a quantity.
COPY = 0.98
#: Minimum correlation of a column sent twice.
ITSELF = 0.999
#: Strength of a name that is a letter; physics has priority over it.
BY_LETTER = 0.6
#: Minimum correlation of a steering angle with the path's curvature.
STEERS = 0.9
_UNITS = HYPOTHESES | {"acceleration": (("m/s²", 1.0), ("g", G_M_S2))}


@dataclass(frozen=True, slots=True)
class _Choice:
    """Columns chosen as speed, yaw rate, a_y and a_x, their relations, and the units of the first three.

    ``is_strict``: both relations fit well enough, with plausible slopes and a large enough a_y, to be accepted unless
    another choice fits almost as well. ``ahead_s``: lead of a_y over v r.
    """

    v: Field
    r: Field
    y: Field
    x: Field
    turning: Fit
    speeding: Fit
    units: tuple[tuple[str, float], tuple[str, float], tuple[str, float]]
    is_strict: bool
    ahead_s: float

    @property
    def columns(self) -> tuple[Field, ...]:
        """The four columns."""
        return (self.v, self.r, self.y, self.x)

    @property
    def score(self) -> float:
        """Product of the correlations."""
        return abs(self.turning.correlation * self.speeding.correlation)

    @property
    def evidence(self) -> str:
        """Description of the relations."""
        first = f"{self.y.path} follows {self.v.path} times {self.r.path} ({self.turning.correlation:.2f})"
        second = f"{self.x.path} the rate of change of {self.v.path} ({self.speeding.correlation:.2f})"
        return f"{first} and {second}, and units explain both slopes"


def unlabelled_columns(log: DriveLog, topics: Sequence[tuple[TopicInfo, Role]], pieces: Pieces) -> list[Field]:
    """Return the sensor columns without informative names, with their values."""
    requests: dict[str, list[str]] = {}
    for topic, role in topics:
        fields = log.fields(topic.name, quiet=True)
        if role not in ("sensor", "device") or len(fields) > MOST_FIELDS or is_command(topic.name):
            continue
        numbers = [f.path for f in fields if f.kind == "number"]
        for path in numbers:
            alone = topic.name if len(numbers) == 1 and not path.endswith("[]") else ""
            if path.count("[]") > path.endswith("[]") or meaning_of(topic.name, topic.type_name, path) is not None:
                continue
            if is_unlabelled(path) and is_unlabelled(alone):
                requests.setdefault(topic.name, []).append(path.removesuffix("[]"))
    if not requests:
        return []
    read = pieces.read(requests, MOST_OF_ARRAY)
    by_name = {topic.name: (topic, role) for topic, role in topics}
    results: list[Field] = []
    for (name, path), seen in read.items():
        if seen.changes and len(results) < MOST_UNLABELLED:
            topic, role = by_name[name]
            stamp = stamp_of(log.fields(name, quiet=True), path)
            meaning = Meaning("", "", 0.5, "", None, f"{path!r} gives no quantity")
            results.append(Field(topic, path, meaning, role, stamp, seen, (("", 1.0),)))
    return results


def identified(fields: Fields, unlabelled: Sequence[Field]) -> tuple[list[Field], str, str]:
    """Return the identified columns, their topic and the evidence; empty unless one choice is clearly the best.

    Parameters
    ----------
    unlabelled : columns with an empty meaning; named fields keep their quantity.
    """
    order = sorted(_choices(fields, unlabelled), key=lambda c: (-c.score, -abs(c.turning.correlation)))
    best = next((c for c in order if c.is_strict), None)
    # A column that lags v r is not a_y if another one leads it.
    others = (c for c in order if best is not None and c.ahead_s > 0.0 and not _same(best, c))
    if best is None or any(c.score > best.score - CLEARER for c in others):
        return [], "", ""
    meant = _as_chosen(fields, unlabelled, best, best.evidence)
    return meant, meant[0].topic.name if meant else "", best.evidence


def _as_chosen(fields: Fields, unlabelled: Sequence[Field], choice: _Choice, why: str) -> list[Field]:
    """Return the columns of a choice with their quantities, and the steering column."""
    speed_unit, rate_unit, unit = choice.units
    speed_is_sure = _speed_is_sure(fields, choice.v, speed_unit)
    speed_why = why if speed_is_sure else f"{why}; a wheel that turns in rad/s may look the same"
    signs = [math.copysign(1.0, relation.slope) for relation in (choice.turning, choice.speeding)]
    meanings = [
        (choice.v, Meaning("speed", "x", 1.0, *speed_unit, speed_why), 1.0),
        (choice.r, Meaning("rate", "z", 1.0, *rate_unit, why), 1.0),
        (choice.y, Meaning("acceleration", "y", 1.0, *unit, why), signs[0]),
        (choice.x, Meaning("acceleration", "x", 1.0, *unit, why), signs[1]),
    ]
    results = [_named(f, m, sign, sure=f is not choice.v or speed_is_sure) for f, m, sign in meanings if _open(f)]
    for item, meaning, _ in meanings:
        if not _open(item) and _is_raw(item) and (item is not choice.v or speed_is_sure):
            item.use(meaning.unit)
            item.reasons.append(f"unit {meaning.unit}, as {why}")
    rest = [f for f in unlabelled if not any(f is c for c in choice.columns)]
    return results + _steering(fields, rest, _values(choice.v) * speed_unit[1], _values(choice.r) * rate_unit[1])


def _choices(fields: Fields, unlabelled: Sequence[Field]) -> Iterator[_Choice]:
    """Yield the choices that satisfy the relations with plausible slopes."""
    signed = [f for f in unlabelled if is_of_both_signs(f.seen.values)]
    forward = [f for f in unlabelled if _is_forward(f)]
    others = {"speed": forward, "rate": signed, "ay": signed, "ax": list(unlabelled)}
    speeds, rates, ays, axs = (_known(fields, n) or columns for n, columns in others.items())
    smooth = {id(f): fields.pieces.smooth(_values(f)) for f in {id(f): f for f in (*ays, *axs)}.values()}
    for v in speeds:
        change = fields.pieces.rate_of(_values(v))
        fits = [(x, fit(change, smooth[id(x)])) for x in axs if x is not v]
        # Regress in the direction in which grade and noise of a_x do not reduce the slope.
        ways = [
            (x, replace(relation, slope=relation.correlation**2 / relation.slope))
            for x, relation in fits
            if relation is not None and abs(relation.correlation) > LOOSE_SPEEDS_UP
        ]
        for r, y in itertools.product(rates, ays):
            if r is not y and v is not r and v is not y:
                yield from _choices_of(
                    fields, (v, r, y), smooth[id(y)], [w for w in ways if w[0] is not r and w[0] is not y]
                )


def _choices_of(
    fields: Fields, columns: tuple[Field, Field, Field], ay: FloatArray, ways: Sequence[tuple[Field, Fit]]
) -> Iterator[_Choice]:
    """Yield the choices with a given speed, yaw rate and a_y."""
    turning, by_speed, ahead_s = _turning(fields, *columns[:2], ay)
    for x, speeding in ways if turning is not None else ():
        explained = None if turning is None else _explained((*columns, x), turning, speeding)
        if turning is not None and explained is not None:
            units, off = explained
            fits = by_speed and abs(speeding.correlation) > SPEEDS_UP
            strict = fits and off < math.log(SLOPE) and spread(ay) * units[2][1] > LEAST_AY_M_S2
            yield _Choice(*columns, x, turning, speeding, units, strict, ahead_s)


def _turning(fields: Fields, v: Field, r: Field, ay: FloatArray) -> tuple[Fit | None, bool, float]:
    """Fit a_y to v r; return the fit, whether other powers of the speed fit worse, and the lead of a_y in s."""
    smooth, speed = fields.pieces.smooth, _values(v)
    with np.errstate(invalid="ignore"):
        relation, root, alone = (fit(ay, smooth(np.maximum(speed, 0.0) ** p * _values(r))) for p in (1.0, 0.5, 0.0))
    if relation is None or root is None or alone is None or abs(relation.correlation) < LOOSE_TURNS:
        return None, False, 0.0
    if abs(alone.correlation) > ITSELF:
        return None, False, 0.0
    left, of_root, of_alone = (1.0 - f.correlation**2 for f in (relation, root, alone))
    strict = abs(relation.correlation) > TURNS and left < BY_SPEED * of_alone and left < BY_ROOT * of_root
    ahead_s = fields.pieces.ahead_s(ay, smooth(speed * _values(r)))
    return relation, strict and ahead_s > AHEAD_S, ahead_s


def _explained(
    columns: tuple[Field, Field, Field, Field], turning: Fit, speeding: Fit
) -> tuple[tuple[tuple[str, float], tuple[str, float], tuple[str, float]], float] | None:
    """Return the units of speed, yaw rate and accelerations that explain the slopes, and the log error of the slopes.

    Return None if no units do.
    """
    v, r, y, x = columns
    ways = []
    for speed, rate, unit in itertools.product(_units(v, "speed"), _units(r, "rate"), _units(y, "acceleration")):
        slopes = abs(turning.slope) * unit[1] / rate[1], abs(speeding.slope) * (unit[1] if _is_raw(x) else 1.0)
        off = [abs(math.log(slope / speed[1])) for slope in slopes]
        if max(off) < math.log(LOOSE_SLOPE):
            ways.append((sum(off), (speed, rate, unit), max(off)))
    return min(ways)[1:] if ways else None


def _units(item: Field, quantity: str) -> tuple[tuple[str, float], ...]:
    if not _is_raw(item):
        return (("", 1.0),)
    return _UNITS[quantity] if _open(item) else tuple(u for u in _UNITS[quantity] if u in item.factors)


def _open(item: Field) -> bool:
    """Return whether a column has no name."""
    return not item.meaning.quantity


def _is_raw(item: Field) -> bool:
    """Return whether a column has no name, or a name without a unit."""
    return _open(item) or not (item.unit_known or item.fixed)


def _values(item: Field) -> FloatArray:
    return item.seen.cells if _is_raw(item) else item.si


def _known(fields: Fields, what: str) -> list[Field]:
    """Return the surest named field of a quantity, with a known unit first, as a list of at most one."""
    kind = {"speed": ("speed", None), "rate": ("rate", "z"), "ay": ("acceleration", "y"), "ax": ("acceleration", "x")}
    every = [f for f in fields.all(*kind[what]) if f.seen.changes and (f.meaning.strength > BY_LETTER or f.fixed)]
    return sorted(every, key=_is_raw)[:1]


def _is_forward(item: Field) -> bool:
    """Return whether a column may be a speed: rarely negative, and never constant for long."""
    finite = item.seen.values[np.isfinite(item.seen.values)]
    if finite.shape[0] == 0:
        return False
    low, high = np.quantile(finite, [0.02, 0.98])
    return bool(high > 0.0 and low > -0.1 * high)


def _same(a: _Choice, b: _Choice) -> bool:
    """Return whether two choices use the same columns or copies of them."""
    for item, other in zip(a.columns, b.columns, strict=True):
        relation = None if item is other else fit(_values(item), _values(other))
        if item is not other and (relation is None or abs(relation.correlation) < COPY):
            return False
    return True


def _speed_is_sure(fields: Fields, speed: Field, unit: tuple[str, float]) -> bool:
    """Return whether no wheel speed in rad/s can be mistaken for the speed."""
    path = path_speed(fields)
    times = None if path is None else ratio(path, _values(speed) * unit[1], 1.0)
    return unit[0] == "m/s" if times is None else abs(times - 1.0) < 0.08


def _named(item: Field, meaning: Meaning, sign: float, *, sure: bool) -> Field:
    """Return a column with its quantity, marked as weak if it is uncertain."""
    factors = ((meaning.unit, meaning.scale or 1.0),)
    named = replace(item, meaning=meaning, factors=factors, sign=sign, unit_known=sure, reasons=[], doubts=[])
    if not sure:
        named.is_weak = True
        named.doubts.append("its name gives no quantity, and its values do not decide")
    return named


def _steering(fields: Fields, columns: Sequence[Field], speed: FloatArray, rate: FloatArray) -> list[Field]:
    """Return the column that follows the path's curvature far better than all others, as a steering angle."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        slow = max(1.0, 0.25 * float(np.nanquantile(speed, 0.95)))
        curve = fields.pieces.smooth(np.where(speed > slow, rate / speed, np.nan))
    if not spread(curve * speed**2) > EXCITED_A_M_S2:
        return []
    relations = ((fit(fields.pieces.smooth(item.seen.cells), curve), item) for item in columns)
    fits = [(abs(relation.correlation), item) for relation, item in relations if relation is not None]
    ranked = sorted((f for f in fits if f[0] > STEERS), key=lambda f: -f[0])
    if not ranked:
        return []
    first, best = ranked[0]
    rivals = [o for c, o in ranked[1:] if c > first - CLEARER and not _is_copy(best, o)]
    why = f"it follows the path's curvature (correlation {first:.2f})"
    meaning = Meaning("steering", "", 1.0, "", None, why)
    doubts = [f"its name gives no quantity, and {f.path} follows the path's curvature equally well" for f in rivals[:1]]
    return [replace(best, meaning=meaning, factors=ANGLES, reasons=[], doubts=doubts, is_weak=bool(doubts))]


def _is_copy(a: Field, b: Field) -> bool:
    relation = fit(a.seen.cells, b.seen.cells)
    return relation is not None and abs(relation.correlation) > COPY


def needs_unlabelled(signals: Mapping[str, object], named: Sequence[Meaning]) -> bool:
    """Return whether the yaw rate, an acceleration or the steering is neither mapped nor named."""
    kinds = {(m.quantity, m.part) for m in named}
    missing = {
        "yaw_rate_rad_s": ("rate", "z"), "ax_m_s2": ("acceleration", "x"), "ay_m_s2": ("acceleration", "y"),
    }  # fmt: skip
    steers = any(n.startswith("steer") for n in signals) or any(quantity == "steering" for quantity, _ in kinds)
    return not steers or any(name not in signals and kind not in kinds for name, kind in missing.items())
