"""What the name of a field says: the quantity, its axis or wheel, its unit, and who sent it.

Nothing here looks at values. Names are cut into words (``WheelSpd_FL``, ``steeringangle``, ``latAccelG``) before they
are looked up, so that the spelling of a recorder does not matter.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import lru_cache

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
        "kt": 1852 / 3600, "knots": 1852 / 3600, "cmps": 1e-2, "mmps": 1e-3,
    },
    "wheel rate": {"radps": 1.0, "rads": 1.0, "rpm": 2.0 * math.pi / 60.0, "degps": math.radians(1.0)},
    "position": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "km": 1e3},
}  # fmt: skip

#: Units as a person reads them.
UNIT_TEXTS = {
    "mps2": "m/s²", "ms2": "m/s²", "mss": "m/s²", "radps": "rad/s", "rads": "rad/s", "rps": "rad/s", "degps": "deg/s",
    "dps": "deg/s", "degs": "deg/s", "mps": "m/s", "ms": "m/s", "kmh": "km/h", "kph": "km/h", "kmph": "km/h",
    "cmps": "cm/s", "mmps": "mm/s",
}  # fmt: skip

#: Several words that are one unit, in the order in which they are looked for.
_UNIT_PHRASES = (
    ("m_s_2", "mps2"), ("m_s2", "mps2"), ("m_per_s2", "mps2"), ("m_sec2", "mps2"), ("m_per_sec_2", "mps2"),
    ("mps_2", "mps2"), ("ms_2", "mps2"), ("m_s_s", "mps2"),
    ("deg_per_sec", "degps"), ("deg_per_s", "degps"), ("degrees_per_second", "degps"), ("deg_sec", "degps"),
    ("deg_s", "degps"), ("rad_per_sec", "radps"), ("rad_per_s", "radps"), ("rad_sec", "radps"), ("rad_s", "radps"),
    ("radians_per_second", "radps"),
    ("km_per_h", "kmh"), ("km_h", "kmh"), ("k_m_h", "kmh"), ("m_per_sec", "mps"), ("m_per_s", "mps"), ("m_s", "mps"),
    ("meters_per_second", "mps"), ("metres_per_second", "mps"), ("m_sec", "mps"), ("milli_g", "mg"),
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
    found: list[str] = []
    for letter, latin in (("ä", "ae"), ("ö", "oe"), ("ü", "ue"), ("Ä", "Ae"), ("Ö", "Oe"), ("Ü", "Ue")):
        name = name.replace(letter, latin)
    for part in re.split(r"[^A-Za-z0-9]+", name):
        if part.lower() in _SYNONYMS:
            found += _SYNONYMS[part.lower()].split()
            continue
        if part.lower() in _LEXICON or part.lower() in _WHOLE:
            found.append(part.lower())
            continue
        for piece in _CAMEL.findall(part):
            found += _SYNONYMS[piece.lower()].split() if piece.lower() in _SYNONYMS else _unglued(piece.lower())
    return tuple(found)


#: Words of other languages and of data bases of CAN, as those that stand for them here.
_SYNONYMS = {
    "lenkradwinkel": "steering wheel angle", "lenkwinkel": "steering angle", "gierrate": "yaw rate",
    "giergeschwindigkeit": "yaw rate", "querbeschleunigung": "lateral acceleration",
    "querbeschl": "lateral acceleration", "laengsbeschl": "longitudinal acceleration",
    "laengsbeschleunigung": "longitudinal acceleration", "schwimmwinkel": "sideslip angle",
    "quergeschwindigkeit": "lateral velocity", "laengsgeschwindigkeit": "longitudinal velocity",
    "geschwindigkeit": "speed", "fahrzeuggeschwindigkeit": "vehicle speed", "raddrehzahl": "wheel speed",
    "radgeschwindigkeit": "wheel speed", "radgeschw": "wheel speed", "strg": "steering", "stwhl": "steering wheel",
    "strwhl": "steering wheel", "psidot": "yaw rate", "yawdot": "yaw rate", "sog": "ground speed",
}  # fmt: skip


#: Short names that capitals would cut in a wrong place.
_WHOLE = _set(
    """
    kmh kph mps ms2 mps2 fl fr rl rr lf rf lr vx vy vz ax ay az
    """
)


def _unglued(piece: str) -> list[str]:
    """Return the known words that a piece consists of, or the piece itself."""
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
    """What a name says a field is.

    Attributes
    ----------
    quantity : ``acceleration``, ``rate``, ``steering``, ``speed``, ``wheel speed``, ``sideslip``, ``heading``,
        ``course``, ``velocity``, ``position``, ``latitude`` or ``longitude``.
    part : axis (x, y, z), wheel (fl, fr, rl, rr), frame of a velocity (``lateral``), or kind of a steering angle
        (``wheel``, ``road``); empty where the name does not say.
    strength : 0 to 1, how much of the meaning stands in the field's own name rather than around it.
    unit : word of the unit, empty where none stands there. scale : factor to SI that it stands for, None without one.
    why : the words that say so.
    """

    quantity: str
    part: str
    strength: float
    unit: str
    scale: float | None
    why: str


#: Words that make a field no measurement of what stands beside them.
_NOT_VALUES = _set(
    """
    covariance cov std stddev sigma sdev accuracy acc_accuracy uncertainty uncert variance var bias biases
    offset status valid validity invalid flag flags count counter crc checksum temperature temp time timestamp
    sec secs nsec nanosec stamp seq quality torque current voltage limit limits max min error err gain pressure
    power confidence age index id state states mode fault faults enable enabled dop hdop vdop pdop undulation
    jerk threshold rms noise throttle brake pedal accelerator integral sum residual stiffness percent pct
    driver duration period rsrvd reserved mag magnetic magnetometer quaternion orientation calibration
    resolution size width height num number engine motor wind air fan pump gear shaft eng transmission cruise
    obstacle object lead relative ambient rack mast display max_speed tow ratio
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
#: Front and rear as German data bases write them; too short to say it of anything but wheels.
_GERMAN = {"vl": "fl", "vr": "fr", "hl": "rl", "hr": "rr"}
_AXES = {
    "x": "x", "y": "y", "z": "z", "ax": "x", "ay": "y", "az": "z", "wx": "x", "wy": "y", "wz": "z", "long": "x",
    "lng": "x", "longitudinal": "x", "forward": "x", "lat": "y", "lateral": "y", "vert": "z", "vertical": "z",
    "trans": "y", "transverse": "y", "transversal": "y", "down": "z",
}  # fmt: skip
_AXIS_LETTERS = frozenset("xyz")
_ROLLS = frozenset({"roll", "pitch"})


#: Field names that say no more than that they are the topic's number.
_BARE = _set(
    """
    data value val angle ang rad deg degrees radians position pos actual measured v x y z mps kmh kph mph ms
    rpm fl fr rl rr lf rf lr front rear left right rate speed g s mps2 ms2 delta velocity current average avg
    filtered output
    """
)


def _is_bare(own: tuple[str, ...]) -> bool:
    return all(w in _BARE or not w.isalpha() for w in own)


#: Words that leave a delta a steering angle; a delta of anything else is a difference.
_OF_DELTA = _set(
    """
    delta rad deg degrees radians f front roadwheel roadwheels road wheel wheels steer steering measured actual mean
    """
)
#: Devices whose numbers are named like a car's and are none.
_OTHER_DEVICES = _set(
    "joint joints arm camera lidar disparity image battery temperature esc gimbal turtle radar tracks"
)


def is_command(*names: str) -> bool:
    """Return whether a topic, type or field calls itself what somebody asks for, not what is measured."""
    return any(_COMMANDS & set(words_of(n)) for n in names)


#: Words of names that only count.
_COUNTING = _set(
    """
    data value values val ch chan channel channels signal signals sig var variable variables col column columns
    field fields entry item element num array vector row rows sample samples msg message topic reading readings
    """
)


def says_nothing(name: str) -> bool:
    """Return whether a name is no more than letters, numbers and words that only count; so is an empty one."""
    return all(len(w) == 1 or w.isdigit() or w in _COUNTING for w in words_of(name))


def unit_of(leaf: str, kind: str) -> tuple[str, float | None]:
    """Return the unit that a name ends with or holds, and its factor to SI; ``("", None)`` without one.

    Parameters
    ----------
    kind : of quantity, a key of ``UNITS``; words that are no unit of it count for nothing (``g`` of a speed).
    """
    words = [w for w in re.split(r"[^a-z0-9]+", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", leaf).lower()) if w]
    text = "_".join(words)
    for phrase, unit in _UNIT_PHRASES:
        if unit in UNITS[kind] and re.search(rf"(^|_){phrase}($|_)", text):
            return unit, UNITS[kind][unit]
    for word in [*reversed(words), *reversed(words_of(leaf))]:
        if word in UNITS[kind] and (len(words) > 1 or len(word) > 2):
            return word, UNITS[kind][word]
    return "", None


def meaning_of(topic: str, type_name: str, path: str, unit_text: str = "") -> Meaning | None:
    """Return what a field is by its name, its parents' and, where these say nothing of their own, its topic's.

    ``unit_text`` is the unit that the log gives (``km/h``, ``°/s``), empty where it gives none.
    """
    parts = path.split(".")
    leaf = parts[-1]
    own = words_of(re.sub(r"\[\d*\]", "", leaf))
    inner = [w for p in parts[:-1] for w in words_of(p)]
    outer = [*words_of(topic), *words_of(type_name.rpartition("/")[2].rpartition(".")[2])]
    if _OTHER_DEVICES & set(outer):
        return None
    if not own:
        return None
    index = re.search(r"\[(\d+)\]$", leaf)
    if _NOT_VALUES & set(own) or _NOT_VALUES & set(inner) - {"state", "status", "orientation"}:
        return None
    named = f"{leaf}_{unit_text.replace('°', 'deg').replace('²', '2')}" if unit_text else leaf
    for strength, words in ((1.0, own), (0.9, (*inner, *own)), (0.7, (*outer, *inner, *own))):
        if strength < 0.8 and not _is_bare(own):
            break  # A topic's name says what its only number is, not what each of many is.
        found = _quantity(tuple(words), own, None if index is None else int(index[1]), strength)
        if found is None:
            continue
        quantity, part, kind = found
        corner = _corner(tuple(inner), ())
        if quantity == "speed" and corner:  # of the wheel that the struct around it is
            quantity, part = "wheel speed", corner
        if quantity == "speed" and unit_of(named, "wheel rate")[0]:
            return None  # of something that turns
        unit, scale = unit_of(named, kind)
        if not unit and len(parts) > 1:
            unit, scale = unit_of(parts[-2], kind)
        if kind == "speed" and not unit and quantity == "wheel speed":
            unit, scale = unit_of(named, "wheel rate")
            quantity = "wheel rate" if unit else quantity
        where = {1.0: leaf, 0.9: path}.get(strength, f"{topic} {path}")
        return Meaning(quantity, part, strength, unit, scale, f"{where!r} names it")
    return None


def _quantity(
    words: tuple[str, ...], own: tuple[str, ...], index: int | None, strength: float
) -> tuple[str, str, str] | None:
    """Return quantity, part and kind of unit that words stand for."""
    have = set(words)
    axis = next((_AXES[w] for w in reversed(own) if w in _AXES), "") or next(
        (_AXES[w] for w in reversed(words) if w in _AXES), ""
    )
    if not axis and index is not None and index < 3:
        axis = "xyz"[index]
    corner = _corner(words, own)
    wheel = bool(have & {"wheel", "wheels", "whl", "tire", "tyre", "tires", "tyres", "corner"})
    rate = bool(have & {"rate", "gyro", "gyroscope", "omega", "gyr"}) or (
        bool(have & {"angular", "ang"}) and bool(have & {"velocity", "vel", "velocities"})
    )
    rate |= own[-2:] in (("psi", "dot"), ("yaw", "dot"), ("w", "z")) or (
        "angular" in have and bool(have & {"speed", "twist"})
    )
    accelerates = bool(have & {"accel", "acceleration", "accelerometer", "accelerations", "accels", "acc", "specific"})
    accelerates |= bool(set(own) & {"ax", "ay", "az"}) or bool({"a", "g"} & set(own) and {"lat", "long"} & set(own))
    steers = bool(have & {"steer", "steering", "swa", "handwheel", "roadwheel", "roadwheels"}) or (
        ("delta" in own and set(own) <= _OF_DELTA)
        or {"road", "wheel", "angle"} <= have
        or {"hand", "wheel", "angle"} <= have
        or (bool(corner) and {"wheel", "angle"} <= have)
    )
    if have & _ROLLS & set(own) and not accelerates:
        return None
    if steers:
        if (
            rate
            or accelerates
            or have & {"velocity", "speed", "vel"} & set(own)
            or have & {"column", "motor"} & set(own)
        ):
            return None
        return "steering", _steering_kind(have), "angle"
    if have & {"sideslip", "beta"} or ("slip" in have and "angle" in have) or {"side", "slip"} <= have:
        return None if rate else ("sideslip", "", "angle")
    if accelerates and not have & {"angular", "yaw", "pedal"}:
        return ("acceleration", axis, "acceleration") if axis else None
    if rate or (have & {"yaw"} and have & {"vel", "velocity", "speed"}) or have & {"yawrate", "wz"} & set(own):
        if corner and (wheel or "omega" in own):
            return "wheel rate", corner, "wheel rate"
        if have & {"yaw", "yawrate", "turn", "wz", "psi"} or axis == "z":
            return "rate", "z", "rate"
        return ("rate", axis, "rate") if axis else None
    speeds = bool(have & {"speed", "speeds", "velocity", "velocities", "vel", "spd", "kmh", "kph", "mph", "ux", "vx"})
    speeds |= {"twist", "linear"} <= have
    speeds |= own[:1] == ("v",) and len(own) > 1 and own[1] in _AXES
    if corner and (wheel or speeds):
        return ("wheel speed", corner, "speed") if speeds or strength < 1.0 else None
    return _motion(have, own, axis, speeds, index)


def _motion(
    have: set[str], own: tuple[str, ...], axis: str, speeds: bool, index: int | None
) -> tuple[str, str, str] | None:
    place = own[-1] if set(own[:-1]) <= {"gps", "gnss", "ins", "pos", "position", "abs"} else ""
    if place in ("lat", "lon", "lng", "long") and not speeds:
        return "latitude" if place == "lat" else "longitude", "", "position"
    if have & {"wheel", "wheels", "whl"} and (index is not None or have & {"left", "right"}):
        return None  # which wheel it is does not stand there
    if have & {"ecef", "enu", "ned", "east", "north", "up", "down"} and speeds:
        return None
    if have & {"lat", "lateral", "vy"} & set(own) and (speeds or "vy" in own):
        return "velocity", "y", "speed"
    if own == ("vl",):
        return "velocity", "y", "speed"
    if own == ("vf",):
        return "speed", "x", "speed"
    if set(own) & {"vx", "ux"} or (speeds and set(own) & {"long", "lng", "longitudinal", "forward"}):
        return "speed", "x", "speed"
    if speeds and have & {"heading", "course"} & set(own):
        return None
    if speeds and set(own) <= _AXIS_LETTERS and own and not have & {"twist", "linear", "body"}:
        return None  # north or forward: a vector of a velocity does not say
    if speeds:
        return {"y": ("velocity", "y", "speed"), "z": None}.get(axis, ("speed", axis, "speed"))
    if have & {"latitude"}:
        return "latitude", "", "position"
    if have & {"longitude"}:
        return "longitude", "", "position"
    if set(own) & {"course", "cog"} or {"track", "angle"} <= have:
        return "course", "", "angle"
    if set(own) & {"heading", "head", "azimuth"} or own == ("yaw",) or {"yaw", "angle"} <= set(own):
        return "heading", "", "angle"
    return None


def _corner(words: tuple[str, ...], own: tuple[str, ...]) -> str:
    for group in (own, words):
        for word in group:
            if word in _CORNERS:
                return _CORNERS[word]
            if word in _GERMAN and {"wheel", "whl"} & set(words):
                return _GERMAN[word]
        ends = {"front": "f", "rear": "r", "back": "r"}, {"left": "l", "right": "r"}
        if "axle" in group:
            ends[0].update({"1": "f", "2": "r"})
        found = ["".join({e[w] for w in group if w in e}) for e in ends]
        if all(len(f) == 1 for f in found):
            return "".join(found)
    return ""


def corner_of(words: tuple[str, ...]) -> str:
    """Return the wheel (fl, fr, rl, rr) that words name; empty without one."""
    return _corner(words, words)


def _steering_kind(have: set[str]) -> str:
    if have & {"road", "tire", "tyre", "tires", "tyres", "roadwheel", "roadwheels", "axle", "delta"}:
        return "road"
    if _corner(tuple(have), ()):
        return "road"
    if have & {"hand", "handwheel", "swa", "pinion"} or {"steering", "wheel"} <= have or {"steer", "wheel"} <= have:
        return "wheel"
    return ""
