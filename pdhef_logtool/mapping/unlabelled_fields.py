"""Identify unlabelled fields (``data[3]``, ``ch7``, ``k``) by physical relations.

Each choice of columns as speed, yaw rate and accelerations has a likelihood, by the residuals of a_y = v r and a_x = v̇,
one sample per second, and by the units that explain both slopes. Steering angles compete as r √v and as r alone: the
yaw rate that they cause grows less than in proportion to speed. The result is the choice that is far likelier than all
others. The slope of a_x = v̇ gives the units of speed and accelerations; the ratio of both slopes gives the unit of the
yaw rate. Left and right are not observable.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pdhef_logtool.logs.drive_log import DriveLog, TopicInfo
from pdhef_logtool.mapping.candidates import ANGLES, HYPOTHESES, MOST_FIELDS, Field, Role, stamp_of
from pdhef_logtool.mapping.evidence import CELL_NS, Fit, Pieces, fit, is_of_both_signs, ratio, spread
from pdhef_logtool.mapping.fields import Fields
from pdhef_logtool.mapping.naming import Meaning, is_command, is_unlabelled, meaning_of
from pdhef_logtool.mapping.path import path_speed
from pdhef_logtool.mapping.units import CERTAIN, Gain, Unit, posterior
from pdhef_logtool.records.signals import FloatArray

#: Maximum number of columns to examine, in total and per array.
MOST_UNLABELLED = 40
MOST_OF_ARRAY = 32
#: Minimum correlations of a_y with v r and of a_x with v̇, and of both in a choice that competes.
TURNS, SPEEDS_UP, COMPETES = 0.92, 0.75, 0.6
#: Powers of the speed in the relation of a_y with the yaw rate, and with a steering angle.
POWERS = (1.0, 0.5, 0.0)
#: Minimum lead of the log likelihood of a choice.
DECISIVE = 6.0
#: 1-sigma of the logarithm of a slope: accelerations include roll and grade.
SLOPE = 0.08
#: Smallest standard deviation of an acceleration; a yaw rate in rad/s is smaller.
LEAST_AY_M_S2 = 0.4
#: Smallest share of a variance, or probability, that measurements resolve.
RESOLVED = 1e-6
#: Minimum correlation between copies of a quantity.
COPY = 0.98
#: Strength of a name that is a letter; physics has priority over it.
BY_LETTER = 0.6
#: Minimum correlation of a steering angle with the path's curvature, and its lead over any other column.
STEERS, CLEARER = 0.9, 0.05


@dataclass(frozen=True, slots=True)
class _Choice:
    """Columns chosen as speed, yaw rate, a_y and a_x, their relations, and the units of the first three.

    ``share``: probability of the units. ``power``: of the speed in the relation of a_y. ``score``: log likelihood.
    """

    columns: tuple[Field, Field, Field, Field]
    turning: Fit
    speeding: Fit
    units: tuple[tuple[str, float], ...]
    share: float
    power: float
    score: float

    @property
    def is_plain(self) -> bool:
        """Return whether it is the motion of a car, with both relations close and certain units."""
        if self.power != 1.0 or self.share < CERTAIN:
            return False
        is_close = abs(self.turning.correlation) > TURNS and abs(self.speeding.correlation) > SPEEDS_UP
        return is_close and spread(self.columns[2].seen.cells) * self.units[2][1] > LEAST_AY_M_S2

    @property
    def evidence(self) -> str:
        """Description of the relations."""
        v, r, y, x = (f.path for f in self.columns)
        first = f"{y} follows {v} times {r} ({self.turning.correlation:.2f})"
        second = f"{x} the rate of change of {v} ({self.speeding.correlation:.2f})"
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
    order = sorted(_choices(fields, unlabelled), key=lambda c: -c.score)
    if (
        not order
        or not (best := order[0]).is_plain
        or any(c.score > best.score - DECISIVE and not _same(best, c) for c in order)
    ):
        return [], "", ""
    meant = _as_chosen(fields, unlabelled, best, best.evidence)
    return meant, meant[0].topic.name if meant else "", best.evidence


def _as_chosen(fields: Fields, unlabelled: Sequence[Field], choice: _Choice, why: str) -> list[Field]:
    """Return the columns of a choice with their quantities, and the steering column."""
    speed, rate = (f.seen.cells * unit[1] for f, unit in zip(choice.columns[:2], choice.units, strict=False))
    path = path_speed(fields)
    times = None if path is None else ratio(path, speed, 1.0)
    # A wheel speed in rad/s may look like a speed.
    is_speed = choice.units[0][0] == "m/s" if times is None else abs(times - 1.0) < 0.08
    results: list[Field] = []
    kinds = (("speed", "x"), ("rate", "z"), ("acceleration", "y"), ("acceleration", "x"))
    signs = (1.0, 1.0, *(math.copysign(1.0, relation.slope) for relation in (choice.turning, choice.speeding)))
    units = (*choice.units, choice.units[2])
    for item, kind, (unit, factor), sign in zip(choice.columns, kinds, units, signs, strict=True):
        is_sure = is_speed or item is not choice.columns[0]
        said = why if is_sure else f"{why}; a wheel that turns in rad/s may look the same"
        if _is_open(item):
            meaning = Meaning(*kind, 1.0, unit, factor, said)
            doubts = [] if is_sure else ["its name gives no quantity, and its values do not decide"]
            named = replace(item, meaning=meaning, factors=((unit, factor),), sign=sign, unit_known=is_sure, reasons=[])
            results.append(replace(named, doubts=doubts, is_weak=item.is_weak or not is_sure))
        elif is_sure and not (item.unit_known or item.fixed):
            item.use(unit)
            item.reasons.append(f"unit {unit}, as {said}")
    rest = [f for f in unlabelled if not any(f is c for c in choice.columns)]
    return results + _steering(fields, rest, speed, rate)


def _choices(fields: Fields, unlabelled: Sequence[Field]) -> Iterator[_Choice]:
    """Yield the choices of columns, each also with the relations of signals that are no yaw rate."""
    signed = [f for f in unlabelled if is_of_both_signs(f.seen.values)]
    others = (("speed", None, [f for f in unlabelled if _is_forward(f)]), ("rate", "z", signed),
              ("acceleration", "y", signed), ("acceleration", "x", unlabelled))  # fmt: skip
    speeds, rates, ays, axs = (_known(fields, name, part) or columns for name, part, columns in others)
    smooth = {id(f): fields.pieces.smooth(f.seen.cells) for f in (*ays, *axs)}
    for v in speeds:
        change = fields.pieces.rate_of(v.seen.cells)
        fits = [(x, f) for x in axs if x is not v and (f := _close(change, smooth[id(x)]))]
        seconds = float(np.count_nonzero(np.isfinite(change))) * CELL_NS * 1e-9
        for r, y, power in itertools.product(rates, ays, POWERS):
            turning = _close(smooth[id(y)], fields.pieces.smooth(np.maximum(v.seen.cells, 0.0) ** power * r.seen.cells))
            for x, speeding in fits if turning else ():
                columns = (v, r, y, x)
                if turning is None or len({*map(id, columns)}) < len(columns):
                    continue
                left = math.prod(max(1.0 - f.correlation**2, RESOLVED) for f in (turning, speeding))
                units, share = _explained(columns, turning, speeding) if power == 1.0 else ((), 1.0)
                if share > RESOLVED:
                    score = math.log(share) - 0.5 * seconds * math.log(left)
                    yield _Choice(columns, turning, speeding, units, share, power, score)


def _close(y: FloatArray, x: FloatArray) -> Fit | None:
    """Return the fit of a relation that may compete."""
    relation = fit(y, x)
    return relation if relation is not None and abs(relation.correlation) > COMPETES else None


def _explained(
    columns: tuple[Field, Field, Field, Field], turning: Fit, speeding: Fit
) -> tuple[tuple[tuple[str, float], ...], float]:
    """Return the likeliest units of speed, yaw rate and accelerations by both slopes, and their probability."""
    v, r, y, x = columns
    units = [HYPOTHESES[q] if _is_open(f) else f.units for f, q in ((v, "speed"), (r, "rate"), (y, "acceleration"))]
    # Regress in the direction in which grade and noise of a_x do not reduce the slope.
    gain = speeding.correlation**2 / speeding.slope * (1.0 if len(x.units) > 1 or _is_open(x) else x.factors[0][1])
    powers = (-1, 0, 1 if len(x.units) > 1 or _is_open(x) else 0)
    joint = posterior([[Unit(*u) for u in ways] for ways in units], [
        Gain((-1, -1, 1), turning.slope, SLOPE), Gain(powers, gain, SLOPE)])  # fmt: skip
    best = np.unravel_index(int(joint.argmax()), joint.shape)
    return tuple(ways[i] for ways, i in zip(units, best, strict=True)), float(joint.max())


def _is_open(item: Field) -> bool:
    """Return whether a column has no name."""
    return not item.meaning.quantity


def _known(fields: Fields, quantity: str, part: str | None) -> list[Field]:
    """Return the surest named field of a quantity, with a known unit first, as a list of at most one."""
    every = [f for f in fields.open(quantity, part) if f.meaning.strength > BY_LETTER or f.fixed]
    return sorted(every, key=lambda f: not (f.unit_known or f.fixed))[:1]


def _is_forward(item: Field) -> bool:
    """Return whether a column may be a speed: rarely negative, and never constant for long."""
    finite = item.seen.values[np.isfinite(item.seen.values)]
    if finite.shape[0] == 0:
        return False
    low, high = np.quantile(finite, [0.02, 0.98])
    return bool(high > 0.0 and low > -0.1 * high)


def _same(a: _Choice, b: _Choice) -> bool:
    """Return whether two choices use the same columns, or copies of them, in the same relation."""
    return a.power == b.power and all(
        item is other or _is_copy(item, other) for item, other in zip(a.columns, b.columns, strict=True)
    )


def _steering(fields: Fields, columns: Sequence[Field], speed: FloatArray, rate: FloatArray) -> list[Field]:
    """Return the column that follows the path's curvature far better than all others, as a steering angle."""
    curve = fields.curvature(speed, rate)
    if curve is None:
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
