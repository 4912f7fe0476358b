"""Signs: which of steering, yaw rate and a_y contradict one another, and the way the car really turned.

Three signals that agree may all be positive to the right. What cannot be is shown by what needs no convention: the path
that positions show, right minus left wheel, a navigation system's heading, which counts clockwise, and gravity,
which the accelerometer of an upright IMU has along +z.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.mapping.candidates import Field, leaf_group
from pdhef_logtool.mapping.evidence import fit
from pdhef_logtool.mapping.fields import CLEAR, Fields
from pdhef_logtool.mapping.naming import G_M_S2
from pdhef_logtool.mapping.path import heading_turn, path_turn
from pdhef_logtool.records.signals import FloatArray

#: Speeds below give no information of the path.
SLOW_M_S = 1.0
#: Correlations from here on give a sign.
TELLS = 0.6
#: What a person calls the signals.
WORDS = {"steer": "steering", "rate": "yaw rate", "ay": "a_y"}
WITNESSES = {
    "wheels": "the wheels' difference",
    "path": "the path of the positions",
    "heading": "the heading",
    "gravity": "gravity",
}


@dataclass(frozen=True, slots=True)
class Signs:
    """Result of the comparison of signs.

    Attributes
    ----------
    turned : signals (``steer``, ``rate``, ``ay``) whose sign is to be turned.
    absolute : the way the car turned is known.
    contradiction : which pairs contradict one another, empty if none. decided : ``turned`` is the one way to mend it.
    """

    turned: tuple[str, ...] = ()
    absolute: bool = False
    contradiction: str = ""
    decided: bool = True


def judge_signs(
    fields: Fields, trio: Mapping[str, Field | None], speed: Field | None, wheels: FloatArray | None
) -> Signs:
    """Compare the signs of steering, yaw rate and a_y with one another and with the turning of the car.

    Parameters
    ----------
    trio : by ``steer``, ``rate``, ``ay``. wheels : right minus left wheel speed on the grid [M].
    """
    present = {name: item for name, item in trio.items() if item is not None}
    turns = _turns(fields, present, speed)
    votes = _votes(fields, turns, present.get("rate"), wheels)
    absolute = any(source in WITNESSES for _, source in votes) or any(map(_has_documented_sign, present.values()))
    against = [f"{_word(a)} and {_word(b)}" for (a, b), vote in votes.items() if vote < 0.0]
    if not against:
        return Signs(absolute=absolute)
    free = [n for n in turns if may_turn(present[n])]
    # The axes of an IMU may point anywhere: its mounting is identified later, and the signs with it.
    imu = tuple(n for n in turns if present[n].is_axis and not present[n].fixed and n not in free)
    ways = _ways([*((n,) for n in free), *([imu] if imu else [])], votes)
    decided = len(ways) == 1 and set(ways[0]) <= set(free)
    decided = decided and (absolute or (len(votes) > 1 and len(free) == len(turns)))
    return Signs(ways[0] if decided else (), absolute, ", ".join(against), decided)


def _turns(fields: Fields, present: Mapping[str, Field], speed: Field | None) -> dict[str, FloatArray]:
    """Return steering, a_y and yaw rate, each as a yaw rate but for its scale."""
    turns: dict[str, FloatArray] = {}
    if speed is not None:
        v = np.where(speed.si > SLOW_M_S, speed.si, np.nan)
        turns |= {"steer": present["steer"].si * v} if "steer" in present else {}
        turns |= {"ay": present["ay"].si / v} if "ay" in present else {}
    turns |= {"rate": present["rate"].si} if "rate" in present else {}
    return {name: fields.pieces.smooth(values) for name, values in turns.items()}


def _votes(
    fields: Fields, turns: Mapping[str, FloatArray], rate: Field | None, wheels: FloatArray | None
) -> dict[tuple[str, str], float]:
    """Return 1 for each pair whose signs agree and -1 for each pair whose signs contradict one another."""
    votes = {pair: _sign(turns[pair[0]], turns[pair[1]], TELLS) for pair in itertools.combinations(turns, 2)}
    references = {"wheels": wheels, "path": path_turn(fields), "heading": heading_turn(fields)}
    for source, values in references.items():
        if values is not None:
            votes |= {(n, source): _sign(x, values, CLEAR if source == "wheels" else TELLS) for n, x in turns.items()}
    if rate is not None and rate.is_axis:
        votes["rate", "gravity"] = upright(fields, rate) * rate.sign
    return {pair: vote for pair, vote in votes.items() if vote}


def may_turn(item: Field) -> bool:
    """Return whether the sign of a field is free: neither documented nor a matter of its mounting."""
    if item.anchor or _has_documented_sign(item):
        return False
    return item.meaning.quantity == "steering" or not item.is_axis


def _has_documented_sign(item: Field) -> bool:
    """Return whether documentation or a name gives the sign; of a well-known type it depends on the mounting."""
    return not item.anchor and (item.fixed or item.is_downward)


def upright(fields: Fields, rate: Field) -> float:
    """Return 1 where gravity is along +z of the sensor that a rate about z comes from, -1 along -z, 0 if unknown."""
    for item in (*fields.candidates, *fields.anchors.values()):
        if (item.meaning.quantity, item.meaning.part) == ("acceleration", "z") and leaf_group(item) == leaf_group(rate):
            mean = float(np.nanmean(item.si))
            # Gravity alone is that large for so long, but in a sensor that takes it away.
            return math.copysign(1.0, mean) if abs(mean) > 0.9 * G_M_S2 else 0.0
    return 0.0


def _ways(units: Sequence[tuple[str, ...]], votes: Mapping[tuple[str, str], float]) -> list[tuple[str, ...]]:
    """Return the smallest sets of signals whose turning settles every vote; those of a unit turn together."""
    for size in range(1, len(units) + 1):
        chosen = [tuple(n for unit in units_of for n in unit) for units_of in itertools.combinations(units, size)]
        ways = [
            turned
            for turned in chosen
            if all(v * (-1.0) ** sum(n in turned for n in pair) > 0.0 for pair, v in votes.items())
        ]
        if ways:
            return ways
    return []


def _sign(y: FloatArray, x: FloatArray, clear: float) -> float:
    relation = fit(y, x)
    if relation is None or abs(relation.correlation) < clear:
        return 0.0
    return math.copysign(1.0, relation.correlation)


def _word(name: str) -> str:
    return (WORDS | WITNESSES)[name]
