"""Quantity, axis or wheel, and unit of a field by its name, without its values.

Names are split into words (``WheelSpd_FL``, ``steeringangle``, ``latAccelG``) before the look-up, so that all
spellings of recorders are accepted.
"""

import math
import re
import tomllib
from collections.abc import Collection
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import TypeAlias

from pdhef_logtool.logs.constants import LATIN, LETTERS

#: Size of the cache of meanings: the drives of a fleet have the same names.
CACHED_NAMES = 8192
#: Standard gravity, the unit g of accelerations.

#: Words, units and rules for names.
VOCABULARY = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
#: Factors to SI by kind of quantity and word of a unit.
UNITS: dict[str, dict[str, float]] = VOCABULARY["units"]
_UNIT_WORDS = frozenset(word for words in UNITS.values() for word in words)
#: Spelling of units in reports.
UNIT_TEXTS: dict[str, str] = VOCABULARY["unit_texts"]
#: Names of a struct, and the longer names that short ones have beside them.
_SHORT_NAMES = tuple((frozenset(beside.split()), names) for beside, names in VOCABULARY["short_names"].items())
_UNIT_PHRASES: tuple[tuple[str, str], ...] = tuple(VOCABULARY["unit_phrases"].items())
_SPELLED_UNITS = tuple((re.compile(pattern), sign) for pattern, sign in VOCABULARY["unit_parts"].items())
_SYNONYMS: dict[str, str] = VOCABULARY["synonyms"]
_WORDS = {name: frozenset(words.split()) for name, words in VOCABULARY["words"].items()}
COUNTING, NOT_VALUES = _WORDS["counting"], _WORDS["not_values"]
#: Words by which names that are written as one word are cut.
KNOWN = _WORDS["lexicon"] | _SYNONYMS.keys()
_WHOLE, _BARE = KNOWN | _WORDS["whole"], _WORDS["bare"] | _UNIT_WORDS
#: Words for a wheel, and the wheels that are abbreviated so beside them; without words, always.
_CORNERS = tuple((frozenset(words.split()), its) for words, its in VOCABULARY["corners"].items())
_AXES: dict[str, str] = {word: axis for axis, words in VOCABULARY["axes"].items() for word in words.split()}
_PATTERNS = {name: re.compile("|".join(either)) for name, either in VOCABULARY["patterns"].items()}
_CAMEL = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")


@lru_cache(maxsize=CACHED_NAMES)
def words_of(name: str) -> tuple[str, ...]:
    """Split a name into lower-case words: at punctuation, at capitals, and between known words written as one."""
    words: list[str] = []
    name = _PATTERNS["sides"].sub(lambda m: "_" + "".join(g[0] for g in m.groups() if g), name.translate(LATIN))
    name = _PATTERNS["corner_at_end"].sub(r"_\g<0>_", name)
    for part in re.split(r"[^A-Za-z0-9]+", name):
        for piece in [part] if part.lower() in _WHOLE else _CAMEL.findall(part):
            words += [english for word in _unglued(piece.lower()) for english in _SYNONYMS.get(word, word).split()]
    return tuple(words)


#: Last words of names of enumerations, and of what is measured.
STATES = frozenset({"state", "states", "status"})


def _unglued(piece: str) -> list[str]:
    """Split a piece into known words; return the piece itself if it contains other letters."""
    if piece not in KNOWN and (letters := _PATTERNS["glued"].match(piece)):
        return [letters[0], piece[letters.end() :]]
    if piece in KNOWN or len(piece) < 5:
        return [piece]
    best: list[list[str] | None] = [[]] + [None] * len(piece)
    for end in range(1, len(piece) + 1):
        for start in range(max(0, end - 16), end):
            before = best[start]
            if before is not None and piece[start:end] in KNOWN:
                best[end] = [*before, piece[start:end]]
                break
    return best[-1] or [piece]


def tags_of(name: str) -> frozenset[str]:
    """Return the words of a name without a meaning, such as the name of an instrument."""
    return frozenset(w for w in words_of(name) if len(w) > 1 and (w not in _WHOLE or w in _WORDS["instruments"]))


@dataclass(frozen=True, slots=True)
class Meaning:
    """Quantity of a field according to its name.

    Attributes
    ----------
    quantity : ``acceleration``, ``rate``, ``steering``, ``speed``, ``wheel speed``, ``sideslip``, ``heading``,
        ``course``, ``velocity``, ``position``, ``latitude`` or ``longitude``.
    part : axis (x, y, z), wheel (fl, fr, rl, rr), frame of a velocity (``lateral``), or kind of a steering angle
        (``wheel``, ``road``); empty if the name does not contain it.
    strength : 0 to 1; 1 if the field's name alone defines the quantity, less if its parents or its topic do.
    unit : word of the unit, empty without one. scale : its factor to SI, None without one.
    why : the name, for reports.
    """

    quantity: str
    part: str
    strength: float
    unit: str
    scale: float | None
    why: str


def is_command(*names: str) -> bool:
    """Return whether the name of a topic, type or field describes a command, not a measurement."""
    # The reference of a stability controller is the vehicle's speed; its other quantities are those of its sensors.
    measured = ({"v", "vehicle", "ref"}, {"stability", "control"})
    return any(_WORDS["commands"] & w and not any(m <= w for m in measured) for w in map(set, map(words_of, names)))


def plain_unit(text: str) -> str:
    """Normalize a unit of a file to the form used in field names: ``Unit_DegrePerSecon`` becomes ``deg_per_s``."""
    text = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", text.strip("[](){} ").translate(LETTERS)).lower()
    for pattern, sign in _SPELLED_UNITS:
        text = pattern.sub(sign, text)
    return re.sub(r"_+", "_", text).strip("_")


@lru_cache(maxsize=CACHED_NAMES)
def unit_of(leaf: str, kind: str) -> tuple[str, float | None]:
    """Return the unit that a name contains, and its factor to SI; ``("", None)`` without one.

    Parameters
    ----------
    kind : kind of quantity, a key of ``UNITS``; units of other kinds are ignored (``g`` for a speed).
    """
    words = [w for w in re.split(r"[^a-z0-9]+", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", leaf).lower()) if w]
    # Integers in thousandths (``acc_y_mps2_e3``), or of a stated size (``steer_0.01 deg``).
    power = 10.0 ** -sum(int(w[1:]) for w in words[1:] if re.fullmatch(r"e\d", w))
    power *= math.prod(float(Fraction(size)) for size in re.findall(r"_(0\.\d+|\de-\d+|1/[1-9]\d*) *[a-z]", leaf))
    text = re.sub(r"(?<=_)sec(?=2|_|$)", "s", "_".join(words).replace("_per_", "_"))
    for phrase, unit in _UNIT_PHRASES:
        if unit in UNITS[kind] and re.search(rf"(^|_){phrase}($|_)", text):
            return unit, UNITS[kind][unit] * power
    for word in [*reversed(words), *reversed(words_of(leaf))]:
        if word in UNITS[kind] and (len(words) > 1 or len(word) > 2):
            return word, UNITS[kind][word] * power
    return "", None


def meaning_among(topic: str, type_name: str, path: str, unit_text: str, there: Collection[str] = ()) -> Meaning | None:
    """Return :func:`meaning_of` a field beside others; an array of unknown length may be a vector of three axes."""
    path = _spelled_out(path, there)
    meanings = (meaning_of(topic, type_name, p, unit_text) for p in (path, path.replace("[]", "[2]")))
    return next((meaning for meaning in meanings if meaning is not None), None)


def _spelled_out(path: str, there: Collection[str]) -> str:
    """Return a path with a longer name if other names of its struct give its meaning: g_x beside a_x, or an array."""
    if (gyro := re.fullmatch(r"(.*(?:^|[._]))g([xyz])", path)) and f"{gyro[1]}a{gyro[2]}" in there:
        return f"{gyro[1]}gyro_{gyro[2]}"
    if (part := re.fullmatch(r"(.*)_(\d)", path)) and [f"{part[1]}_{i}" in there for i in range(4)] == [1, 1, 1, 0]:
        return f"{part[1]}[{part[2]}]"
    leaf = path.rpartition(".")[2]
    struct = path.removesuffix(leaf)
    beside = {p.removeprefix(struct).lower() for p in there if p.startswith(struct)}
    short = (names[leaf.lower()] for needed, names in _SHORT_NAMES if leaf.lower() in names and needed <= beside)
    return struct + next(short, leaf)


@lru_cache(maxsize=CACHED_NAMES)
def meaning_of(topic: str, type_name: str, path: str, unit_text: str = "") -> Meaning | None:
    """Return the quantity of a field by its name; words of its parents or topic complete an incomplete leaf.

    ``unit_text`` is the unit stored in the log (``km/h``, ``°/s``), empty without one.
    """
    *parents, leaf = path.split(".")
    leaf_words = words_of(re.sub(r"\[\d*\]", "", leaf))
    inner = tuple(w for p in parents for w in words_of(p))
    outer = (*words_of(topic), *words_of(type_name.rpartition("/")[2].rpartition(".")[2]))
    if not leaf_words or _WORDS["other_devices"] & set(outer):
        return None
    if NOT_VALUES & _described(leaf_words) or NOT_VALUES & set(inner) - {"state", "status", "orientation"}:
        return None
    column = int(index[1]) if (index := re.search(r"\[(\d+)\]$", leaf)) else None
    named = f"{leaf}_{plain_unit(unit_text)}" if unit_text else leaf
    of_leaf = _strength_of_leaf(leaf_words, inner, named, unit_text)
    if of_leaf is None:
        return None
    scopes = [(of_leaf, leaf_words, leaf)] if of_leaf else []
    scopes.append((0.9, (*inner, *leaf_words), path))
    for strength, words, where in scopes:
        if quantity := _quantity(words, leaf_words, column, strength, named):
            return _with_unit(quantity, strength, where, inner, (named, *parents[-1:]))
    # The topic's name describes its fields only if the leaf identifies no quantity, and if it names measurements.
    last = re.sub("(?i)g_?sensor", "accelerometer", topic.rpartition("/")[2])  # of any unit
    if NOT_VALUES & _described(words_of(last)) or not all(w in _BARE or not w.isalpha() for w in leaf_words):
        return None
    named_by = leaf_words if set(leaf_words) - COUNTING else tuple(w for w in words_of(last) if w not in COUNTING)
    quantity = _quantity((*outer, *inner, *leaf_words), named_by, column, 0.7, named)
    return quantity and _with_unit(quantity, 0.7, f"{topic} {path}", inner, (named, *parents[-1:], last))


def _described(leaf_words: tuple[str, ...]) -> set[str]:
    """Return the words of a leaf that describe its quantity."""
    # "current" before other words is an adjective; "state" beside them is the topic of an export, or what is measured.
    last = set(leaf_words[-1:]) - (STATES if leaf_words[1:] else set())
    return last | {w for w in leaf_words[:-1] if w not in {"current", *STATES}}


_TURNING = frozenset({"rate", "velocity", "velocities", "gyro", "gyroscope"})


def _strength_of_leaf(leaf_words: tuple[str, ...], inner: tuple[str, ...], named: str, unit_text: str) -> float | None:
    """Return the strength of a leaf alone: less for a v without a unit, None for one in volts, N m or %.

    The yaw of a rate and the v (values) of an inertial sensor are no quantities: 0.
    """
    if plain_unit(unit_text) in _WORDS["other_units"]:
        return None
    if leaf_words == ("v",) and (_TURNING | {"accel", "acceleration", "accelerometer"}) & set(inner):
        return 0.0
    if "v" in leaf_words and set(leaf_words) <= _WORDS["of_v"] and not unit_of(named, "speed")[0]:
        return None if unit_text else 0.8 if {"ego", "veh", "vehicle", "car"} & set(leaf_words) else 0.6
    return 0.0 if leaf_words == ("yaw",) and _TURNING & set(inner) else 1.0


def _with_unit(
    quantity: "_Quantity", strength: float, where: str, inner: tuple[str, ...], names: tuple[str, ...]
) -> Meaning | None:
    """Return the meaning with the unit from the leaf or its struct (``names``); None for a rotational speed."""
    name, part, kind = quantity
    corner = corner_of(inner)
    if name == "speed" and corner:
        name, part = "wheel speed", corner
    if name == "speed" and unit_of(names[0], "wheel rate")[0]:
        return None
    unit, scale = next((u for n in names if (u := unit_of(n, kind))[0]), ("", None))
    if not unit and name == "wheel speed":
        unit, scale = unit_of(names[0], "wheel rate")
        name = "wheel rate" if unit else name
    return Meaning(name, part, strength, unit, scale, f"named by {where!r}")


#: Quantity, part and kind of unit.
_Quantity: TypeAlias = tuple[str, str, str]
#: Conjunction of conditions on tokens: (True, tokens) needs any of the tokens, (False, tokens) excludes all.
_Rule: TypeAlias = tuple[tuple[bool, frozenset[str]], ...]


def _rule(text: str) -> _Rule:
    return tuple((not term.startswith("!"), frozenset(term.removeprefix("!").split("|"))) for term in text.split())


def _matches(rule: _Rule, tokens: set[str]) -> bool:
    return all(tokens.isdisjoint(words) != wanted for wanted, words in rule)


def vector_of(path: str) -> tuple[str, ...]:
    """Return the words of a field but its axis: components of one vector have the same."""
    return tuple("" if word in _AXES or re.fullmatch(r"\d+|v[xyz]", word) else word for word in words_of(path))


_TRAITS = tuple((trait, _rule(text)) for trait, texts in VOCABULARY["traits"].items() for text in texts)
#: Quantities by the first matching rule; empty: no quantity. A part ``@axis`` or ``@corner`` is read from the name.
_QUANTITIES: tuple[tuple[_Rule, tuple[str, ...]], ...] = tuple(
    (_rule(text), tuple(quantity)) for text, quantity in VOCABULARY["quantities"].items()
)
_PLACE_WORDS = frozenset(VOCABULARY["topics"]["navigation"].split()) | {"pos", "position", "abs"}
_PLACE_OR_UNIT = _PLACE_WORDS | _UNIT_WORDS


def _quantity(
    words: tuple[str, ...], leaf_words: tuple[str, ...], index: int | None, strength: float, named: str
) -> _Quantity | None:
    """Return the quantity of the first rule that matches the words; ``named`` is the leaf with its unit."""
    axis = next((_AXES[w] for w in (*reversed(leaf_words), *reversed(words)) if w in _AXES), "")
    if not axis and index is not None and index < 3:
        axis = "xyz"[index]
    corner = corner_of(words, leaf_words)
    leaf = set(leaf_words)
    tokens = {*words, *(f".{w}" for w in leaf), f".{'_'.join(leaf_words[-2:])}", f"={'_'.join(leaf_words)}", f"@{axis}"}
    flags = {
        "@corner": bool(corner),
        "@any_corner": bool(corner_of(tuple(set(words)))),
        "@index": index is not None,
        "@around": strength < 1.0,
        "@delta": "delta" in leaf <= _WORDS["of_delta"],
        "@letters": leaf <= set("xyz"),
        "@only_axis": {w for w in leaf if not w.isdigit()} - {"axis", axis} == set(),
        "@v_axis": any(first == "v" and second in _AXES for first, second in pairwise(leaf_words)),
        "@bare_v": "v" in leaf <= _WORDS["of_v"],
        **{f"@unit_{kind.replace(' ', '_')}": bool(unit_of(named, kind)[0]) for kind in UNITS},
        **{f"@place_{w}": leaf - {w} <= _PLACE_OR_UNIT for w in leaf - _PLACE_WORDS},
    }
    tokens |= {flag for flag, is_set in flags.items() if is_set}
    for trait, rule in _TRAITS:
        if _matches(rule, tokens):
            tokens.add(trait)
    quantity = next((q for rule, q in _QUANTITIES if _matches(rule, tokens)), ())
    if not quantity:
        return None
    name, part, kind = quantity
    return name, {"@axis": axis, "@corner": corner}.get(part, part), kind


def corner_of(words: tuple[str, ...], leaf_words: tuple[str, ...] = ()) -> str:
    """Return the wheel (fl, fr, rl, rr) in the words of a name, of the leaf first; empty without one."""
    for group in (leaf_words, words):
        for word in group:
            its = (ends[word] for beside, ends in _CORNERS if word in ends and (not beside or beside & set(words)))
            if corner := next(its, ""):
                return corner
        ends = {"front": "f", "rear": "r", "back": "r"}, {"left": "l", "right": "r"}
        if "axle" in group:
            ends[0].update({"1": "f", "2": "r"})
        letters = ["".join({e[w] for w in group if w in e}) for e in ends]
        if all(len(end) == 1 for end in letters):
            return "".join(letters)
    return ""
