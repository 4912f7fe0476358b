"""Names of fields: their quantity, axis or wheel, and unit.

Nothing here examines values. Names are cut into words (``WheelSpd_FL``, ``steeringangle``, ``latAccelG``) before they
are looked up, so that the spelling of a recorder does not matter.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

#: Gravity by which accelerations in g are written.
G_M_S2 = 9.80665

#: Factors to SI by kind of quantity and word of a unit.
UNITS: dict[str, dict[str, float]] = {
    "acceleration": {"mps2": 1.0, "ms2": 1.0, "mss": 1.0, "g": G_M_S2, "gs": G_M_S2, "mg": 1e-3 * G_M_S2},
    "rate": {
        "radps": 1.0, "rads": 1.0, "rps": 1.0, "degps": math.radians(1.0), "dps": math.radians(1.0),
        "degs": math.radians(1.0), "rad": 1.0, "deg": math.radians(1.0), "degrees": math.radians(1.0),
        "mdps": math.radians(1e-3), "mrad": 1e-3,
    },
    "angle": {
        "rad": 1.0, "radians": 1.0, "deg": math.radians(1.0), "degree": math.radians(1.0),
        "degrees": math.radians(1.0), "mrad": 1e-3, "cdeg": math.radians(1e-2), "mdeg": math.radians(1e-3),
    },
    "speed": {
        "mps": 1.0, "ms": 1.0, "kmh": 1 / 3.6, "kph": 1 / 3.6, "kmph": 1 / 3.6, "mph": 0.44704, "kn": 1852 / 3600,
        "kt": 1852 / 3600, "kts": 1852 / 3600, "knots": 1852 / 3600, "cmps": 1e-2, "mmps": 1e-3,
    },
    "wheel rate": {"radps": 1.0, "rads": 1.0, "rpm": 2.0 * math.pi / 60.0, "degps": math.radians(1.0)},
    "position": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "km": 1e3},
}  # fmt: skip

#: Units as they are written in reports.
UNIT_TEXTS = {
    "mps2": "m/s²", "ms2": "m/s²", "mss": "m/s²", "radps": "rad/s", "rads": "rad/s", "rps": "rad/s", "degps": "deg/s",
    "dps": "deg/s", "degs": "deg/s", "mps": "m/s", "ms": "m/s", "kmh": "km/h", "kph": "km/h", "kmph": "km/h",
    "cmps": "cm/s", "mmps": "mm/s",
}  # fmt: skip

#: Several words that are one unit, in the order in which they are looked for.
_UNIT_PHRASES = (
    ("m_s_2", "mps2"), ("m_s2", "mps2"), ("mps_2", "mps2"), ("ms_2", "mps2"), ("m_s_s", "mps2"),
    ("degrees_second", "degps"),
    ("deg_s", "degps"), ("radians_second", "radps"), ("rad_s", "radps"), ("km_h", "kmh"), ("k_m_h", "kmh"),
    ("m_s", "mps"),
    ("meters_second", "mps"), ("metres_second", "mps"), ("milli_g", "mg"),
)  # fmt: skip


def _set(words: str) -> frozenset[str]:
    return frozenset(words.split())


#: Words by which names that are written as one word are cut.
_LEXICON = _set(
    """
    steer steering wheel wheels whl angle ang yaw roll pitch rate acc accel acceleration accelerometer
    accelerations lat lateral long lng longitudinal vert vertical velocity velocities vel speed speeds spd
    front rear left right veh vehicle hand road tire tyre gyro gyroscope angular linear heading course head
    track slip side body forward ground position report status column power torque command cmd request target
    sensor sensors ext imu raw gps gnss turn rotation rot axle omega delta driver tires tyres pinion rack motor
    servo valid truth sideslip beta over deg rad kph kmh mph mps rpm mps2 radps degps data value
    """
)

_CAMEL = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")


@lru_cache(maxsize=8192)
def words_of(name: str) -> tuple[str, ...]:
    """Cut a name into lower-case words: at signs, at capitals, and where known words are written as one."""
    words: list[str] = []
    for letter, latin in (("ä", "ae"), ("ö", "oe"), ("ü", "ue"), ("Ä", "Ae"), ("Ö", "Oe"), ("Ü", "Ue")):
        name = name.replace(letter, latin)
    for part in re.split(r"[^A-Za-z0-9]+", _SIDES.sub(lambda m: f"_{m[1][0]}{m[2]}", name)):
        if part.lower() in _SYNONYMS:
            words += _SYNONYMS[part.lower()].split()
            continue
        if part.lower() in _LEXICON or part.lower() in _WHOLE:
            words.append(part.lower())
            continue
        for piece in _CAMEL.findall(part):
            words += _SYNONYMS[piece.lower()].split() if piece.lower() in _SYNONYMS else _unglued(piece.lower())
    return tuple(words)


#: Words of other languages and of CAN databases, and their English equivalents.
_SYNONYMS = {
    "lenkradwinkel": "steering wheel angle", "lenkwinkel": "steering angle", "gierrate": "yaw rate",
    "giergeschwindigkeit": "yaw rate", "querbeschleunigung": "lateral acceleration",
    "querbeschl": "lateral acceleration", "laengsbeschl": "longitudinal acceleration",
    "laengsbeschleunigung": "longitudinal acceleration", "schwimmwinkel": "sideslip angle",
    "quergeschwindigkeit": "lateral velocity", "laengsgeschwindigkeit": "longitudinal velocity",
    "geschwindigkeit": "speed", "fahrzeuggeschwindigkeit": "vehicle speed", "raddrehzahl": "wheel speed",
    "radgeschwindigkeit": "wheel speed", "radgeschw": "wheel speed", "strg": "steering", "stwhl": "steering wheel",
    "strwhl": "steering wheel", "winkel": "angle", "stwhlang": "steering wheel angle", "lgt": "longitudinal",
    "inline": "longitudinal", "psidot": "yaw rate", "yawdot": "yaw rate", "psip": "yaw rate", "sog": "ground speed",
    "sas": "steering wheel angle sensor", "lws": "steering wheel angle sensor",
    "avx": "angular velocity x", "avy": "angular velocity y", "avz": "angular velocity z",
}  # fmt: skip


#: Short names that capitals would cut in a wrong place.
_WHOLE = _set(
    """
    kmh kph mps ms2 mps2 fl fr rl rr lf rf lr vx vy vz ax ay az
    """
)
#: A wheel as ``FrL``, and behind letters that stand for its speed.
_SIDES = re.compile(r"(?<=[a-z_])(Fr|Re)([LR])(?![a-z])")
_CORNER_SPEED = re.compile(r"(?:ws|vw|w|v|n)(?=(?:fl|fr|rl|rr)$)")


def _unglued(piece: str) -> list[str]:
    """Return the known words that a piece consists of, or the piece itself."""
    if letters := _CORNER_SPEED.match(piece):
        return [letters[0], piece[letters.end() :]]
    if piece in _LEXICON or len(piece) < 5:
        return [piece]
    best: list[list[str] | None] = [[]] + [None] * len(piece)
    for end in range(1, len(piece) + 1):
        for start in range(max(0, end - 16), end):
            before = best[start]
            if before is not None and piece[start:end] in _LEXICON:
                best[end] = [*before, piece[start:end]]
                break
    return best[-1] or [piece]


@dataclass(frozen=True, slots=True)
class Meaning:
    """Quantity of a field by its name.

    Attributes
    ----------
    quantity : ``acceleration``, ``rate``, ``steering``, ``speed``, ``wheel speed``, ``sideslip``, ``heading``,
        ``course``, ``velocity``, ``position``, ``latitude`` or ``longitude``.
    part : axis (x, y, z), wheel (fl, fr, rl, rr), frame of a velocity (``lateral``), or kind of a steering angle
        (``wheel``, ``road``); empty where the name does not give it.
    strength : 0 to 1; 1 where the field's name alone gives the quantity, less where its parents or its topic do.
    unit : word of the unit, empty without one. scale : its factor to SI, None without one.
    why : the name, for reports.
    """

    quantity: str
    part: str
    strength: float
    unit: str
    scale: float | None
    why: str


#: Words that make a field no measurement of the quantity that its other words name.
_NOT_VALUES = _set(
    """
    covariance cov std stddev sigma sdev accuracy acc_accuracy uncertainty uncert variance var bias biases
    offset status valid validity invalid flag flags count counter crc checksum temperature temp time timestamp
    sec secs nsec nanosec stamp seq quality torque current voltage limit limits max min error err gain pressure
    power confidence age index id state states mode fault faults enable enabled dop hdop vdop pdop undulation
    jerk threshold rms noise throttle brake pedal accelerator integral sum residual stiffness percent pct
    driver duration period rsrvd reserved mag magnetic magnetometer quaternion orientation calibration
    resolution size width height num number engine motor wind air fan pump gear shaft eng transmission cruise
    obstacle object lead relative ambient rack mast display max_speed tow ratio suspension susp damper shock
    """
)
_COMMANDS = _set(
    """
    cmd command commands commanded setpoint target desired request requested req goal plan planner planned
    control ref demand autonomous
    """
)
_CORNERS = {
    "fl": "fl", "lf": "fl", "fr": "fr", "rf": "fr", "rl": "rl", "lr": "rl", "rr": "rr", "bl": "rl", "br": "rr",
    "frontleft": "fl", "frontright": "fr", "rearleft": "rl", "rearright": "rr",
    "lb": "rl", "rb": "rr",
}  # fmt: skip
#: Front and rear in German databases; too short to be unambiguous except beside a word for wheel.
_GERMAN = {"vl": "fl", "vr": "fr", "hl": "rl", "hr": "rr"}
_AXES = {
    "x": "x", "y": "y", "z": "z", "ax": "x", "ay": "y", "az": "z", "wx": "x", "wy": "y", "wz": "z", "gx": "x",
    "gy": "y", "gz": "z", "long": "x",
    "lng": "x", "longitudinal": "x", "forward": "x", "lat": "y", "lateral": "y", "vert": "z", "vertical": "z",
    "trans": "y", "transverse": "y", "transversal": "y", "down": "z",
}  # fmt: skip
#: Words of a leaf that identifies no quantity: the topic's name does.
_BARE = _set(
    """
    data value val angle ang rad deg degrees radians position pos actual measured v x y z mps kmh kph mph ms
    rpm fl fr rl rr lf rf lr front rear left right rate speed g s mps2 ms2 delta velocity current average avg
    filtered output
    """
)


#: Words that leave a v a speed.
_OF_V = _set("v x veh vehicle car ego signal sig can esp abs act actual ist ref value mps ms kmh kph m s km h")
#: Words that leave a delta a steering angle; a delta of anything else is a difference.
_OF_DELTA = _set(
    """
    delta rad deg degrees radians f front roadwheel roadwheels road wheel wheels steer steering measured actual mean
    sw hw h
    """
)
#: Devices whose quantities have the names of a car's.
_OTHER_DEVICES = _set("joint joints arm camera lidar disparity image battery temperature gimbal turtle radar tracks")


def is_command(*names: str) -> bool:
    """Return whether the name of a topic, type or field is that of a command, not of a measurement."""
    return any(_COMMANDS & set(words_of(n)) for n in names)


#: Words of names that only count.
_COUNTING = _set(
    """
    data value values val ch chan channel channels signal signals sig var variable variables col column columns
    field fields entry item element num array vector row rows sample samples msg message topic reading readings
    """
)


def is_unlabelled(name: str) -> bool:
    """Return whether a name consists of letters, numbers and counting words only; so does an empty name."""
    return all(len(w) == 1 or w.isdigit() or w in _COUNTING for w in words_of(name))


#: Spelled-out parts of units, as far as databases write them (``Unit_DegrePerSecon``), and their signs.
_SPELLED_UNITS = tuple(
    (re.compile(pattern), sign)
    for pattern, sign in (
        (r"^unit", ""), (r"°|^grad(?![a-z])", "deg"), ("²", "2"), (r"degree?s?(?=[^a-z]|$)", "deg"),
        (r"of_arc|_angle$", ""),
        (r"kilo_?met[a-z]+", "km"), (r"met(?:er|re)s?", "m"), (r"secon[a-z]*", "s"), (r"hours?", "h"),
        (r"squar[a-z]*", "2"), (r"[a-z_]*gravi[a-z]*", "g"), (r"radians?", "rad"),
        (r"revolutions?|umdr[a-z]*|rev", "r"),
        (r"minut[a-z]*", "min"), (r"^_*(?:[1ur]|)_?(?:/|per_)_?min$|^_*min\W*1$", "rpm"),
    )
)  # fmt: skip


def _plain_unit(text: str) -> str:
    """Return a unit of a file as names of fields have it: ``Unit_DegrePerSecon`` becomes ``deg_per_s``."""
    text = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", text.strip("[](){} ")).lower()
    for pattern, sign in _SPELLED_UNITS:
        text = pattern.sub(sign, text)
    return re.sub(r"_+", "_", text).strip("_")


def unit_of(leaf: str, kind: str) -> tuple[str, float | None]:
    """Return the unit that a name contains, and its factor to SI; ``("", None)`` without one.

    Parameters
    ----------
    kind : of quantity, a key of ``UNITS``; units of other kinds are ignored (``g`` of a speed).
    """
    words = [w for w in re.split(r"[^a-z0-9]+", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", leaf).lower()) if w]
    text = re.sub(r"(?<=_)sec(?=2|_|$)", "s", "_".join(words).replace("_per_", "_"))
    for phrase, unit in _UNIT_PHRASES:
        if unit in UNITS[kind] and re.search(rf"(^|_){phrase}($|_)", text):
            return unit, UNITS[kind][unit]
    for word in [*reversed(words), *reversed(words_of(leaf))]:
        if word in UNITS[kind] and (len(words) > 1 or len(word) > 2):
            return word, UNITS[kind][word]
    return "", None


def meaning_of(topic: str, type_name: str, path: str, unit_text: str = "") -> Meaning | None:
    """Return the quantity that a field's name gives, with its parents' or topic's words where the leaf has none.

    ``unit_text`` is the unit that the log gives (``km/h``, ``°/s``), empty where it gives none.
    """
    *parents, leaf = path.split(".")
    leaf_words = words_of(f"r_{unit_text.replace('°', 'deg')}" if leaf == "r" else re.sub(r"\[\d*\]", "", leaf))
    inner = tuple(w for p in parents for w in words_of(p))
    outer = (*words_of(topic), *words_of(type_name.rpartition("/")[2].rpartition(".")[2]))
    if not leaf_words or _OTHER_DEVICES & set(outer):
        return None
    if _NOT_VALUES & set(leaf_words) or _NOT_VALUES & set(inner) - {"state", "status", "orientation"}:
        return None
    index = re.search(r"\[(\d+)\]$", leaf)
    column = None if index is None else int(index[1])
    named = f"{leaf}_{_plain_unit(unit_text)}" if unit_text else leaf
    own = _strength_of_leaf(leaf_words, inner, named, has_unit=bool(unit_text))
    if own is None:
        return None
    scopes = [(own, leaf_words, leaf)] if own else []
    scopes.append((0.9, (*inner, *leaf_words), path))
    if all(w in _BARE or not w.isalpha() for w in leaf_words):  # else a topic's name does not describe each field
        scopes.append((0.7, (*outer, *inner, *leaf_words), f"{topic} {path}"))
    for strength, words, where in scopes:
        quantity = _quantity(words, leaf_words, column, strength, named)
        if quantity is not None:
            return _with_unit(quantity, strength, where, inner, (named, *parents[-1:]))
    return None


def _strength_of_leaf(
    leaf_words: tuple[str, ...], inner: tuple[str, ...], named: str, *, has_unit: bool
) -> float | None:
    """Return how much a leaf alone gives: less for a v without a unit, 0 for the yaw of a rate, None for a voltage."""
    if "v" in leaf_words and set(leaf_words) <= _OF_V and not unit_of(named, "speed")[0]:
        return None if has_unit else 0.6
    return 0.0 if leaf_words == ("yaw",) and {"rate", "velocity", "gyro", "gyroscope"} & set(inner) else 1.0


def _with_unit(
    quantity: _Quantity, strength: float, where: str, inner: tuple[str, ...], names: tuple[str, ...]
) -> Meaning | None:
    """Return the meaning with the unit that the leaf or its struct (``names``) gives; None for a rotational speed."""
    name, part, kind = quantity
    corner = _corner(inner, ())
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
#: A condition on tokens: of each pair any of the tokens is there, or, with False, none.
_Rule: TypeAlias = tuple[tuple[bool, frozenset[str]], ...]


def _rule(text: str) -> _Rule:
    return tuple((not term.startswith("!"), frozenset(term.removeprefix("!").split("|"))) for term in text.split())


def _matches(rule: _Rule, tokens: set[str]) -> bool:
    return all(tokens.isdisjoint(words) != wanted for wanted, words in rule)


# Tokens of the rules: words of the name; ``.word`` for those of its leaf, ``.a_b`` for its last two, ``=a_b`` for all;
# ``@x`` for its axis, ``@place_x`` for the last word where only words of positions precede it, and traits.
#: Traits, each given by any of its rules, in the order in which they use one another.
_TRAITS = tuple(
    (trait, _rule(text))
    for trait, texts in (
        ("@wheel", ("wheel|wheels|whl|tire|tyre|tires|tyres|corner",)),
        ("@rate", ("rate|gyro|gyroscope|omega|gyr", "angular|ang velocity|vel|velocities", ".psi_dot|.yaw_dot|.w_z",
                   "angular speed|twist")),
        ("@accelerates", ("accel|acceleration|accelerometer|accelerations|accels|acc|specific", ".ax|.ay|.az",
                          ".a|.g .lat|.long", ".gx|.gy|.gz @unit_acceleration", "=a_x|=a_y|=a_z",
                          ".a @x|@y|@z @unit_acceleration")),
        ("@steers", ("steer|steering|swa|handwheel|roadwheel|roadwheels", "@delta", "road|hand|front wheel angle",
                     "@corner wheel angle", ".str angle|ang|whl|wheel|wheels", ".lw angle")),
        ("@slips", ("sideslip|beta", "slip angle", "side slip")),
        ("@turns", ("@rate", "yaw vel|velocity|speed", ".yawrate|.wz", ".yr @unit_rate")),
        ("@speeds", ("speed|speeds|velocity|velocities|vel|spd|kmh|kph|mph|ux|vx", "twist linear", "@v_axis",
                     ".v @unit_speed", "@bare_v")),
        ("@road", ("road|tire|tyre|tires|tyres|roadwheel|roadwheels|axle|delta|@any_corner",)),
        ("@hand", ("hand|handwheel|swa|pinion", "steering|steer wheel", ".sw|.hw|.h|.lw")),
    )
    for text in texts
)  # fmt: skip
#: Quantities by the first rule that matches; None: no quantity. A part ``@axis`` or ``@corner`` is the name's.
_QUANTITIES: tuple[tuple[_Rule, _Quantity | None], ...] = tuple(
    (_rule(text), quantity)
    for text, quantity in (
        (".roll|.pitch !@accelerates", None),
        ("@steers @rate|@accelerates|.velocity|.speed|.vel|.column|.motor", None),
        ("@around @steers velocity|vel !.angle|.ang|.rad|.deg|.position|.pos|.delta", None),
        ("@steers .sw|.hw", ("steering", "wheel", "angle")),
        ("@steers @road !.h", ("steering", "road", "angle")),
        ("@steers @hand", ("steering", "wheel", "angle")),
        ("@steers", ("steering", "", "angle")),
        ("@slips @rate", None),
        ("@slips", ("sideslip", "", "angle")),
        ("@accelerates !angular|yaw|pedal @x|@y|@z", ("acceleration", "@axis", "acceleration")),
        ("@accelerates !angular|yaw|pedal", None),
        ("@turns @corner @wheel|.omega", ("wheel rate", "@corner", "wheel rate")),
        ("@turns yaw|yawrate|yr|turn|wz|psi|@z", ("rate", "z", "rate")),
        ("@turns @x|@y", ("rate", "@axis", "rate")),
        ("=r_radps|=r_rad_s|=r_rads|=r_degps|=r_deg_s|=r_dps", ("rate", "z", "rate")),
        ("@turns", None),
        ("@corner @wheel|@speeds @speeds|@around", ("wheel speed", "@corner", "speed")),
        ("@corner .ws|.vw @unit_speed|@unit_wheel_rate", ("wheel speed", "@corner", "speed")),
        ("@corner @wheel|@speeds", None),
        ("@place_lat !@speeds", ("latitude", "", "position")),
        ("@place_lon|@place_lng|@place_long !@speeds", ("longitude", "", "position")),
        ("wheel|wheels|whl @index|left|right", None),  # which wheel it is, is not given
        ("ecef|enu|ned|east|north|up|down @speeds", None),
        (".lat|.lateral|.vy|.uy @speeds|.vy|.uy", ("velocity", "y", "speed")),
        ("=vl", ("velocity", "y", "speed")),
        ("=vf|.vx|.ux", ("speed", "x", "speed")),
        ("@speeds .long|.lng|.longitudinal|.forward", ("speed", "x", "speed")),
        ("@speeds .heading|.course", None),
        ("@speeds @letters !twist|linear|body", None),  # north or forward: the frame of the vector is not given
        ("@speeds @y", ("velocity", "y", "speed")),
        ("@speeds @z", None),
        ("@speeds", ("speed", "@axis", "speed")),
        ("latitude", ("latitude", "", "position")),
        ("longitude", ("longitude", "", "position")),
        (".course|.cog", ("course", "", "angle")),
        ("track angle", ("course", "", "angle")),
        (".heading|.head|.azimuth|=yaw", ("heading", "", "angle")),
        (".yaw .angle", ("heading", "", "angle")),
    )
)
_PLACE_WORDS = frozenset({"gps", "gnss", "ins", "pos", "position", "abs"})


def _quantity(
    words: tuple[str, ...], leaf_words: tuple[str, ...], index: int | None, strength: float, named: str
) -> _Quantity | None:
    """Return the quantity of the first rule that the words match; ``named`` is the leaf with its unit."""
    axis = next((_AXES[w] for w in (*reversed(leaf_words), *reversed(words)) if w in _AXES), "")
    if not axis and index is not None and index < 3:
        axis = "xyz"[index]
    corner = _corner(words, leaf_words)
    leaf = set(leaf_words)
    tokens = {*words, *(f".{w}" for w in leaf), f".{'_'.join(leaf_words[-2:])}", f"={'_'.join(leaf_words)}", f"@{axis}"}
    flags = {
        "@corner": bool(corner),
        "@any_corner": bool(_corner(tuple(set(words)), ())),
        "@index": index is not None,
        "@around": strength < 1.0,
        "@delta": "delta" in leaf <= _OF_DELTA,
        "@letters": leaf <= set("xyz"),
        "@v_axis": leaf_words[0] == "v" and leaf_words[1:2] != () and leaf_words[1] in _AXES,
        "@bare_v": "v" in leaf <= _OF_V,
        **{f"@unit_{kind.replace(' ', '_')}": bool(unit_of(named, kind)[0]) for kind in UNITS},
        f"@place_{leaf_words[-1]}": set(leaf_words[:-1]) <= _PLACE_WORDS,
    }
    tokens |= {flag for flag, is_set in flags.items() if is_set}
    for trait, rule in _TRAITS:
        if _matches(rule, tokens):
            tokens.add(trait)
    quantity = next((q for rule, q in _QUANTITIES if _matches(rule, tokens)), None)
    if quantity is None:
        return None
    name, part, kind = quantity
    return name, {"@axis": axis, "@corner": corner}.get(part, part), kind


def _corner(words: tuple[str, ...], leaf_words: tuple[str, ...]) -> str:
    for group in (leaf_words, words):
        for word in group:
            if word in _CORNERS:
                return _CORNERS[word]
            if word in _GERMAN and {"wheel", "whl"} & set(words):
                return _GERMAN[word]
        ends = {"front": "f", "rear": "r", "back": "r"}, {"left": "l", "right": "r"}
        if "axle" in group:
            ends[0].update({"1": "f", "2": "r"})
        letters = ["".join({e[w] for w in group if w in e}) for e in ends]
        if all(len(end) == 1 for end in letters):
            return "".join(letters)
    return ""


def corner_of(words: tuple[str, ...]) -> str:
    """Return the wheel (fl, fr, rl, rr) that words name; empty without one."""
    return _corner(words, words)
