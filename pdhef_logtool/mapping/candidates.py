"""Search all numeric fields of a log for signals and ground truth, first by names, then by values.

Recognised message types have priority (``recognition.py``); this module searches for the remaining signals. A candidate
is *taken* if the evidence for it, in log odds (``evidence.toml``), is positive and higher than that for others. If its
unit or sign is uncertain, an undecided check records this. Other candidates are listed in the mapping as comments.
"""

import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

import numpy as np

from pdhef_logtool.logs.drive_log import DriveLog, TopicInfo
from pdhef_logtool.logs.message_schema import FieldInfo
from pdhef_logtool.mapping import naming
from pdhef_logtool.mapping.channels import signed
from pdhef_logtool.mapping.checking import STAMP_PATHS, stamp_path_of
from pdhef_logtool.mapping.evidence import EVIDENCE, LOG_ODDS, MOST_COLUMNS, Pieces, Seen
from pdhef_logtool.mapping.joints import is_joints, joint_meanings
from pdhef_logtool.mapping.naming import VOCABULARY, Meaning, is_command, words_of
from pdhef_logtool.mapping.records import SignalSource
from pdhef_logtool.mapping.vendors import Vendors, VendorType, meaning_of_source
from pdhef_logtool.records.signals import FloatArray

#: Kind of data in a field, according to the names around it.
Role: TypeAlias = Literal["sensor", "navigation", "truth", "estimate", "command"]
#: A field with a meaning from its name, or from its documented type, which is the last entry.
Named: TypeAlias = tuple[TopicInfo, Role, FieldInfo, Meaning, VendorType | None]

#: Words for the axes of a car, for which only the sign is unknown.
_CAR_AXES = frozenset(VOCABULARY["words"]["car_axes"].split())
#: Words of a field in a table of several instruments that make it ground truth, or of a receiver.
_TRUTH_WORDS, _RECEIVERS = frozenset(VOCABULARY["topics"]["truth"].split()), {"gps", "gnss", "ins", "rtk"}
#: Affix that distinguishes the name of a sign from the name of its magnitude; YawToRight belongs to YawRate.
_SIGN = re.compile("|".join(VOCABULARY["patterns"]["sign"]), re.IGNORECASE)
_NAMES = EVIDENCE["names"]
#: Possible units of a field without one, with their factors, by quantity; the conventional one is first.
HYPOTHESES: dict[str, tuple[tuple[str, float], ...]] = {
    quantity: tuple(units.items()) for quantity, units in VOCABULARY["possible_units"].items()
}
#: Physical limits of a car in SI, by quantity. A larger value has another unit or is another quantity.
MOST: dict[str, float] = VOCABULARY["largest"]
#: Largest usual values of quantities, SI: units in which a field has larger ones are less likely.
USUAL: dict[str, float] = VOCABULARY["usual"]
#: Words of a doubt about a unit that is an assumption.
UNIT_NOT_GIVEN = "unit not given"
CONSTANT = "constant in the parts of the log that were read"
PROPOSED: float = _NAMES["proposed"]


@dataclass(frozen=True, slots=True)
class Candidate:
    """A field that may be a signal or ground truth quantity.

    Attributes
    ----------
    section : ``signals`` or ``truth``. source : the field, with its likeliest scale and offset.
    score : probability of the reading. reason : evidence for the quantity.
    doubt : uncertain properties; may be empty. taken : the mapping contains it.
    """

    section: Literal["signals", "truth"]
    source: SignalSource
    score: float
    reason: str
    doubt: str = ""
    taken: bool = False

    def __str__(self) -> str:
        """Return one line for a report or a comment."""
        doubt = f"; unsure: {self.doubt}" if self.doubt else ""
        scales = ", ".join(f"{s:.6g}" for s in np.atleast_1d(self.source.scale))
        return f"{self.source.label}, scale {scales}: score {self.score:.2f}, {self.reason}{doubt}"


@dataclass(slots=True)
class Field:
    """A field with a quantity by name or type, during the evaluation.

    Attributes
    ----------
    factors : possible units, the likeliest first. fixed : unit and sign are documented.
    section : ``signals`` or ``truth`` by its documentation.
    evidence : names of evidence for or against the quantity, in log odds (``evidence.toml``).
    unit_known : its unit is certain. sign : sign of the scale.
    sign_path : path of the field that contains its sign.
    is_weak : its values cannot identify the quantity, so that it is never taken.
    is_turned : its axis and sign are those of a usual mounting.
    has_gravity : its device shows gravity, so that its axes are the device's.
    """

    topic: TopicInfo
    path: str
    meaning: Meaning
    role: Role
    stamp: str
    seen: Seen
    factors: tuple[tuple[str, float], ...]
    fixed: bool = False
    section: str = ""
    unit_known: bool = False
    sign: float = 1.0
    reasons: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)
    evidence: list[str] = field(default_factory=list)
    offset: float = 0.0
    is_weak: bool = False
    is_turned: bool = False
    has_gravity: bool = False
    sign_path: str = ""

    @property
    def scale(self) -> float:
        """Factor from raw to SI, including the sign."""
        return self.sign * self.factors[0][1]

    @property
    def si(self) -> FloatArray:
        """Values on the grid in SI [M]."""
        return np.asarray(self.seen.cells * self.scale + self.offset)

    @property
    def units(self) -> tuple[tuple[str, float], ...]:
        """Units that are still possible."""
        return self.factors[:1] if self.unit_known or self.fixed else self.factors

    @property
    def is_named(self) -> bool:
        """Return whether its name gives the quantity."""
        return self.meaning.strength >= float(_NAMES["least"])

    @property
    def unit_doubt(self) -> list[str]:
        """Doubt about a unit that neither the name nor the drive determines."""
        if self.unit_known or self.fixed:
            return []
        unit, usual = self.factors[0][0], HYPOTHESES[self.meaning.quantity][0][0]
        if unit != usual:
            return [f"{UNIT_NOT_GIVEN}; taken as {unit}, because its values in {usual} are out of a car's range"]
        return [f"{UNIT_NOT_GIVEN} and not observable in this drive; taken as {unit}"]

    @property
    def is_axis(self) -> bool:
        """Return whether its name is an axis letter; the direction of the axis then depends on the mounting."""
        leaf_words = words_of(self.path.rpartition(".")[2])
        is_guess = self.is_turned or self.meaning.strength == PROPOSED
        return "yaw" not in leaf_words and not _CAR_AXES & set(leaf_words) and not is_guess

    @property
    def is_steady(self) -> bool:
        """Return whether it is a constant speed with a unit, as in a simulation."""
        is_speed = self.meaning.quantity == "speed" and self.unit_known and not self.fixed
        return is_speed and not self.seen.changes and abs(self.seen.largest * self.scale) > 1.0  # others are fillers

    @property
    def is_downward(self) -> bool:
        """Return whether the name defines it as positive about, or along, the downward axis."""
        return "down" in words_of(self.path.rpartition(".")[2]) and self.meaning.part == "z"

    @property
    def log_odds(self) -> float:
        """Log odds of the quantity, by the evidence of ``evidence.toml``."""
        if self.fixed or self.is_weak:
            return LOG_ODDS["documented" if self.fixed else "weak"]
        applies = {
            "unit": bool(self.meaning.unit),
            "often": self.seen.rate_hz >= _NAMES["often_hz"],
            "seldom": self.seen.rate_hz < _NAMES["seldom_hz"],
            "receiver": self.role == "navigation" and self.meaning.quantity == "speed",
            "constant": not self.seen.changes,
        }
        evidence = (*self.evidence, *(name for name, is_so in applies.items() if is_so))
        return LOG_ODDS["prior"] + LOG_ODDS["name"] * self.meaning.strength + sum(LOG_ODDS[name] for name in evidence)

    def use(self, unit: str) -> None:
        """Select a unit."""
        self.factors = tuple(sorted(self.factors, key=lambda f: f[0] != unit))
        self.unit_known = True

    def fix(self, source: SignalSource) -> None:
        """Use the unit, sign and offset of a documented or mapped source of one field."""
        scale, offset = source.scale, source.offset
        if isinstance(scale, float) and isinstance(offset, float):
            self.factors, self.sign, self.offset = ((self.meaning.unit, abs(scale)),), math.copysign(1.0, scale), offset
        self.fixed = self.unit_known = True

    def candidate(self, name: str, section: Literal["signals", "truth"], *, taken: bool) -> Candidate:
        """Return the field as a candidate source of a signal."""
        source = SignalSource(name, self.topic.name, self.path, self.stamp, self.scale, self.offset)
        if self.sign_path:
            source = replace(source, field=(self.path, self.sign_path), scale=(self.scale, 1.0), combine="signed")
        most = MOST.get(self.meaning.quantity)
        finite = self.seen.values[np.isfinite(self.seen.values)] * self.scale + self.offset
        if most is not None and finite.shape[0] and float(np.abs(finite).max()) > most:
            source = replace(source, valid_min=-most, valid_max=most)
        reason = "; ".join([self.meaning.why, *self.reasons])
        doubts = dict.fromkeys([*self.doubts, *([] if self.seen.changes else [CONSTANT])])
        probability = round(1.0 / (1.0 + math.exp(-self.log_odds)), 2)
        return Candidate(section, source, probability, reason, "; ".join(doubts), taken)


def named_fields(log: DriveLog, topics: Sequence[tuple[TopicInfo, Role]], vendors: Vendors) -> list[Named]:
    """Return the fields with a meaning from their name or documented type."""
    results: list[Named] = []
    for topic, role in topics:
        fields = log.fields(topic.name, quiet=True)
        if len(fields) > _NAMES["most_fields"]:
            continue
        if is_joints(topic):
            joints = () if role == "command" else joint_meanings(log, topic)
            results += [(topic, role, FieldInfo(path, "number"), meaning, None) for path, meaning in joints]
            continue
        documented = vendors.of(topic.type_name)
        there = {f.path for f in fields}
        no_values = _no_values(topic, fields)
        for info in (f for f in fields if f.path not in no_values):
            if not is_column(info) or is_command(info.path):
                continue
            if its := documented.entries(info.path):
                results += [
                    (topic, role, replace(info, path=p), meaning_of_source(s), documented) for p, s in its.items()
                ]
            elif not documented.fields or info.path.count(".") or documented.has:
                meaning = naming.meaning_among(topic.name, topic.type_name, info.path, info.unit, there)
                results += [] if meaning is None else [(topic, role, info, meaning, None)]
    return results


def is_column(info: FieldInfo) -> bool:
    """Return whether a field has one number, or one array of numbers, a message."""
    return info.kind == "number" and info.path.count("[]") <= info.path.endswith("[]")


def _signs_of(paths: Collection[str]) -> dict[str, str]:
    """Return the paths of signs by the paths of their magnitudes."""
    bases = ((_SIGN.sub("", path), path) for path in paths)
    return {m: path for base, path in bases for m in (base, f"{base}Rate") if base != path and m in paths}


def _no_values(topic: TopicInfo, fields: Sequence[FieldInfo]) -> set[str]:
    """Return the paths that are no values: signs, and magnitudes with a text or another bus signal as their sign."""
    signs, texts = _signs_of({f.path for f in fields}), {f.path for f in fields if f.kind == "string"}
    return {*signs.values(), *(m for m, sign in signs.items() if topic.encoding == "can" or sign in texts)}


def look(
    log: DriveLog, named: Sequence[Named], sources: Sequence[SignalSource]
) -> tuple[Pieces, list[Field], dict[str, Field]]:
    """Read the named fields and the mapped sources in a few pieces of the log.

    Fields without a number are excluded, as are fields that exceed a car's range in every unit.
    """
    named = sorted(named, key=lambda n: (n[4] is None, -n[3].strength))[: _NAMES["most_read"]]
    fields = [(topic.name, info.path.removesuffix("[]")) for topic, _, info, _, _ in named]
    of_topics = {t: _signs_of({f.path for f in log.fields(t, quiet=True)}) for t in dict.fromkeys(t for t, _ in fields)}
    signs = {(t, p): of_topics[t][p] for t, p in fields if p in of_topics[t]}
    fields += [(topic, sign) for (topic, _), sign in signs.items()]
    fields += [(s.topic, path) for s in sources if s.can_signal is None for path in s.paths]
    pieces = Pieces(log)
    samples = pieces.read(fields)
    for key, sign in signs.items():
        if key in samples:
            size, its = samples[key], samples[key[0], sign]
            values, cells = signed(size.values, its.values), signed(size.cells, its.cells)
            samples[key] = Seen.of(values, cells, size.rate_hz)
    weighable = [item for entry in named for item in _weighable(log, entry, samples) if item.factors]
    for item in weighable:
        item.sign_path = signs.get((item.topic.name, item.path), "")
    return pieces, weighable, anchors_of(log, sources, samples)


def _weighable(log: DriveLog, named: Named, samples: Mapping[tuple[str, str], Seen]) -> Iterator[Field]:
    """Yield a field, or each element of an array that has a meaning."""
    topic, role, info, meaning, documented = named
    fields = log.fields(topic.name, quiet=True)
    path = info.path.removesuffix("[]")
    for name in [path] if (topic.name, path) in samples else [f"{path}[{i}]" for i in range(MOST_COLUMNS)]:
        seen = samples.get((topic.name, name))
        its = meaning if name == path else naming.meaning_among(topic.name, topic.type_name, name, info.unit)
        if its is None and meaning.quantity == "speed":
            its = replace(meaning, strength=0.5)  # one of several elements: only its values can identify it
        if seen is None or its is None or not np.isfinite(seen.values).any():
            continue
        if role == "sensor" and (words := set(words_of(name))) & (_TRUTH_WORDS | _RECEIVERS):
            role = "truth" if words & _TRUTH_WORDS else "navigation"
        yield field_of(fields, topic, role, replace(info, path=name), its, seen, documented)


def field_of(
    fields: tuple[FieldInfo, ...],
    topic: TopicInfo,
    role: Role,
    info: FieldInfo,
    meaning: Meaning,
    seen: Seen,
    documented: VendorType | None = None,
) -> Field:
    """Return a field with its possible units and what its name, or its documented type, leaves open."""
    factors = _factors(meaning, seen)
    if meaning.quantity == "wheel speed" and not factors:  # too large for a speed: rotational
        meaning = replace(meaning, quantity="wheel rate")
        factors = _factors(meaning, seen)
    stated = meaning.unit
    if not factors and documented is None:
        meaning = replace(meaning, unit="", scale=None)
        factors = _factors(meaning, seen)
    item = Field(topic, info.path, meaning, role, stamp_of(fields, info.path), seen, factors)
    if stated != meaning.unit:
        item.doubts.append(f"its values are out of a car's range in {stated}, the unit in its name")
    if documented is not None:
        entry = documented.fields[info.path]
        item.section = "truth" if entry in documented.truth else "signals"
        item.fix(entry)
        item.reasons.append(f"documented: {documented.page}")
    elif meaning.scale is not None:
        item.unit_known = True
        item.reasons.append(f"unit {naming.UNIT_TEXTS.get(meaning.unit, meaning.unit)}")
    if not item.is_named:
        item.doubts.append("its values alone identify it")
    if _may_be_share(item, info):
        item.is_weak = _is_control(item, info, fields)
        item.doubts.append("it may be a share of the largest angle, which needs a scale")
    if item.is_downward and not item.fixed:
        item.sign = -1.0
        item.reasons.append("positive downward by its name")
    return item


def _may_be_share(item: Field, info: FieldInfo) -> bool:
    """Return whether a signed byte has no unit, or a steering signal in [-1, 1] not the name of an angle, either."""
    named = {"angle", "ang", "delta"} & set(words_of(item.path))
    is_angle = item.meaning.quantity != "steering" or item.meaning.part == "road" or bool(named)
    return not item.unit_known and (info.code == "i1" or not (is_angle or item.seen.largest > 1.0))


def _is_control(item: Field, info: FieldInfo, fields: tuple[FieldInfo, ...]) -> bool:
    """Return whether a field is a signed byte, or its struct contains pedals, which are controls, too."""
    struct, places = item.path.rpartition(".")[0], (f.path.rpartition(".") for f in fields)
    beside = {word for place, _, leaf in places if place == struct for word in words_of(leaf)}
    return info.code == "i1" or bool({"throttle", "brake", "gas"} & beside)


def anchors_of(
    log: DriveLog, sources: Sequence[SignalSource], read: Mapping[tuple[str, str], Seen]
) -> dict[str, Field]:
    """Return mapped sources of one field as fields with a fixed meaning, by name."""
    topics = {t.name: t for t in log.topics}
    anchors = {}
    for source in sources:
        seen = read.get((source.topic, source.paths[0]))
        if seen is not None and isinstance(source.scale, float):
            topic, meaning = topics[source.topic], meaning_of_source(source)
            anchors[source.name] = Field(topic, source.paths[0], meaning, "sensor", source.stamp, seen, ())
            anchors[source.name].fix(source)
    return anchors


def _factors(meaning: Meaning, seen: Seen) -> tuple[tuple[str, float], ...]:
    """Return the units that are possible by a field's range; a unit in its name excludes all others."""
    named = () if meaning.scale is None else ((meaning.unit, meaning.scale),)
    largest = float(np.nanquantile(np.abs(seen.values), _NAMES["valid"])) if named and seen.changes else seen.largest
    most = MOST.get(meaning.quantity, math.inf)
    # Beyond a car's range, the unit in the name is wrong.
    units = (u for u in named or HYPOTHESES.get(meaning.quantity, ()) if not largest * u[1] > most)
    return tuple(sorted(units, key=lambda u: largest * u[1] > USUAL.get(meaning.quantity, math.inf)))


def stamp_of(fields: tuple[FieldInfo, ...], path: str) -> str:
    """Return the stamp of a topic, or else of the innermost message around a field that has a stamp."""
    parts, times = path.split("."), {f.path for f in fields if f.kind == "time"}
    inner = (".".join([*parts[:depth], stamp]) for depth in range(len(parts) - 1, 0, -1) for stamp in STAMP_PATHS)
    outer = stamp_path_of(fields)
    return next((stamp for stamp in inner if outer == "log_time" and stamp in times), outer)


def triad_of(item: Field) -> str:
    """Return the key shared by the three axes of a vector: topic and struct, or the words without the axis."""
    struct, _, leaf = re.sub(r"\[\d+\]$|_?[0-4]$", "", item.path).rpartition(".")
    return f"{item.topic.name}.{struct or '_'.join(w.rstrip('xyz') for w in words_of(leaf))}"


def leaf_group(item: Field) -> tuple[str, str]:
    """Return topic and innermost-but-one struct, which accelerations and rates of one IMU share."""
    parts = item.path.split(".")
    return item.topic.name, ".".join(parts[: max(0, len(parts) - 2)])


def place_of(item: Field) -> str | tuple[str, str]:
    """Return where a device is: the topic without its last element, or :func:`leaf_group`."""
    return item.topic.name.rpartition("/")[0] or leaf_group(item)
