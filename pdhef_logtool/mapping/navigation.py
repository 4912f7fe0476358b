"""Ground truth of an undocumented navigation system: vectors by their names, the heading convention by the path.

Names contain north, east and up, or ECEF. They rarely define whether a heading is clockwise from north or
counter-clockwise from east, in degrees or radians. As a car mostly moves in the direction of its heading, the
convention follows from a comparison with the path.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from pdhef_logtool.logs.drive_log import DriveLog, TopicInfo
from pdhef_logtool.logs.message_schema import FieldInfo
from pdhef_logtool.mapping.checking import stamp_path_of
from pdhef_logtool.mapping.evidence import FEWEST_CELLS, Pieces, Seen
from pdhef_logtool.mapping.naming import Meaning, meaning_of, unit_of, words_of
from pdhef_logtool.mapping.records import SignalSource
from pdhef_logtool.records.geometry import DEGREE_M
from pdhef_logtool.records.signals import FloatArray

#: Minimum speed for the course to be the direction of the car.
MOVING_M_S = 3.0
#: Median difference from the course: below NEAR_RAD for the right convention, above FAR_RAD for all others.
NEAR_RAD, FAR_RAD = math.radians(12.0), math.radians(25.0)
#: Positions by quantity.
_PLACES = {"lat_deg": "latitude", "lon_deg": "longitude"}
#: Largest plausible extent of a log.
WIDEST_DEG = 10.0
_SIDES = {
    "north": "n", "n": "n", "vn": "n", "veln": "n", "east": "e", "e": "e", "ve": "e", "vele": "e",
    "up": "u", "u": "u", "vu": "u", "velu": "u", "down": "d", "d": "d", "vd": "d", "veld": "d",
}  # fmt: skip
#: Unit of a heading, and its angle counter-clockwise from east: ``sign * unit * raw + offset``.
_CONVENTIONS = (
    ("degrees clockwise from north", -math.radians(1.0), math.pi / 2.0),
    ("radians clockwise from north", -1.0, math.pi / 2.0),
    ("degrees counter-clockwise from east", math.radians(1.0), 0.0),
    ("radians counter-clockwise from east", 1.0, 0.0),
)


#: Ground-truth quantities of one topic, and the note on their source.
NavigationTruth: TypeAlias = tuple[dict[str, SignalSource], str]


def navigation_truth(log: DriveLog, topics: Sequence[TopicInfo], *, whole: bool = False) -> NavigationTruth | None:
    """Return the ground truth of the topic with most quantities of position, velocity and heading, or None.

    Parameters
    ----------
    topics : of navigation systems and references with undocumented types.
    whole : whether only a velocity with a heading counts.
    """
    truths = [truth for t in topics if (truth := _of_topic(log, t)) is not None]
    truths = [t for t in truths if not whole or {"enu_velocity_m_s", "yaw_rad"} <= set(t[0])]
    return max(truths, key=lambda t: len(t[0]), default=None)


def named_gnss(log: DriveLog, topic: TopicInfo, speed: SignalSource | None = None) -> dict[str, SignalSource]:
    """Return position, velocity or speed and course over ground by the names of a topic's fields.

    ``speed`` is mapped already, with a unit that the drive shows. A velocity must agree with the path, if there is one.
    A heading that is the direction of the path is a course.
    """
    fields = log.fields(topic.name, quiet=True)
    stamp, meanings = stamp_path_of(fields), _meanings(topic, fields)
    meanings |= _with_known_unit(topic.name, meanings, speed)
    first = {m.quantity: path for path, m in reversed(meanings.items())}
    velocity = next(_horizontal(fields), {})
    if not {"latitude", "longitude"} <= set(first):
        return {s.name: s for s in (_velocity_over_ground(topic.name, stamp, velocity) if velocity else ())}
    angles = [p for q in ("course", "heading") for p, m in meanings.items() if m.quantity == q]
    pieces = Pieces(log)
    samples = pieces.read(
        {topic.name: [*dict.fromkeys([*velocity.values(), *angles, *(first[q] for q in _PLACES.values())])]}
    )
    seen = {path: values for (_, path), values in samples.items()}
    places = {n: SignalSource(n, topic.name, first[q], stamp) for n, q in _PLACES.items()}
    if not (_is_place(seen.get(first["latitude"]), 90.0) and _is_place(seen.get(first["longitude"]), 180.0)):
        return {}
    sources = [replace(places[n], name=f"gnss_{q}_deg") for n, q in _PLACES.items()]
    if (course := _course(places, samples, topic.name, pieces)) is None:
        return {source.name: source for source in sources}
    sides = {side: seen[velocity[side]].cells for side in "ne" if velocity.get(side, "") in seen}
    if len(sides) > 1 and _median_off(np.arctan2(sides["n"], sides["e"]) - course) < NEAR_RAD:
        sources += _velocity_over_ground(topic.name, stamp, velocity)
    else:
        sources += _speed_and_course(topic.name, stamp, meanings, {p: seen[p] for p in angles if p in seen}, course)
    return {source.name: source for source in sources}


def _with_known_unit(topic: str, meanings: Mapping[str, Meaning], speed: SignalSource | None) -> dict[str, Meaning]:
    """Return the meaning of the field that is mapped as the speed, with the unit of the mapping."""
    if speed is None or speed.topic != topic or not isinstance(speed.scale, float):
        return {}
    return {p: replace(meanings[p], scale=speed.scale) for p in speed.paths if p in meanings}


def _velocity_over_ground(topic: str, stamp: str, velocity: Mapping[str, str]) -> Iterator[SignalSource]:
    unit = unit_of(velocity["n"].rpartition(".")[2], "speed")[1] or 1.0
    for name, side in (("gnss_velocity_east_m_s", "e"), ("gnss_velocity_north_m_s", "n")):
        yield SignalSource(name, topic, velocity[side], stamp, unit)


def _speed_and_course(
    topic: str, stamp: str, meanings: Mapping[str, Meaning], angles: Mapping[str, Seen], course: FloatArray
) -> Iterator[SignalSource]:
    """Yield the first speed with a unit and the first of the angles that is the path's course, if both exist."""
    speed = next((p for p, m in meanings.items() if m.quantity == "speed" and m.scale is not None), None)
    for path, seen in angles.items() if speed is not None else ():
        # A course over ground is clockwise from north by definition; the path confirms this and determines the unit.
        unit = meanings[path].scale
        fitting = [c[1:] for c in _CONVENTIONS[:2] if unit is None or math.isclose(-c[1], unit)]
        fitting = [c for c in fitting if _off(seen, course, *c) < NEAR_RAD]
        if fitting and speed is not None:
            yield SignalSource("gnss_course_rad", topic, path, stamp, *fitting[0])
            yield SignalSource("gnss_speed_m_s", topic, speed, stamp, meanings[speed].scale or 1.0)
            return


def _meanings(topic: TopicInfo, fields: tuple[FieldInfo, ...]) -> dict[str, Meaning]:
    named = ((f.path, meaning_of(topic.name, topic.type_name, f.path, f.unit)) for f in fields if f.kind == "number")
    return {path: meaning for path, meaning in named if meaning is not None}


def _of_topic(log: DriveLog, topic: TopicInfo) -> NavigationTruth | None:
    fields = log.fields(topic.name, quiet=True)
    stamp = stamp_path_of(fields)
    truth = {s.name: s for s in (*_enu_velocities(topic, fields, stamp), *_ecef_vectors(topic, fields, stamp))}
    meanings = _meanings(topic, fields)
    first = {m.quantity: path for path, m in reversed(meanings.items())}
    places = {n: SignalSource(n, topic.name, first[q], stamp) for n, q in _PLACES.items() if q in first}
    headings = {p: m.scale for p, m in meanings.items() if m.quantity == "heading"}
    pieces = Pieces(log)
    paths = [p for s in (*truth.values(), *places.values()) for p in s.paths if "ecef" not in p.lower()]
    samples = pieces.read({topic.name: [*dict.fromkeys([*paths, *headings])]}) if paths or headings else {}
    seen = [samples.get((topic.name, source.paths[0])) for source in places.values()]
    if len(seen) == 2 and all(map(_is_place, seen, (90.0, 180.0))):
        truth |= places
    note = f"ground truth comes from {topic.name}, by the names of its fields"
    course = _course(truth, samples, topic.name, pieces)
    conventions = {p: _convention(samples.get((topic.name, p)), course, unit) for p, unit in headings.items()}
    for path, convention in conventions.items():
        if convention is not None:
            words, scale, offset = convention
            truth["yaw_rad"] = SignalSource("yaw_rad", topic.name, path, stamp, scale, offset)
            note += f"; {path} is in {words}, which agrees with the course over ground"
            break
    useful = {"enu_velocity_m_s", "ecef_velocity_m_s", "ecef_position_m", "lat_deg"} & set(truth)
    return (truth, note) if useful else None


def _enu_velocities(topic: TopicInfo, fields: tuple[FieldInfo, ...], stamp: str) -> Iterator[SignalSource]:
    """Yield the first velocity east, north, up (or down) by the field names of one struct."""
    for paths_of in _horizontal(fields):
        if vertical := next((s for s in "ud" if s in paths_of), ""):
            paths = (paths_of["e"], paths_of["n"], paths_of[vertical])
            factor = unit_of(paths[0].rpartition(".")[2], "speed")[1] or 1.0
            scale = (factor, factor, factor if vertical == "u" else -factor)
            yield SignalSource("enu_velocity_m_s", topic.name, paths, stamp, scale)
            return


def _horizontal(fields: tuple[FieldInfo, ...]) -> Iterator[dict[str, str]]:
    """Yield by struct the paths of a velocity with at least north and east, by direction."""
    structs: dict[str, dict[str, str]] = {}
    for info in fields:
        prefix, _, leaf = info.path.rpartition(".")
        if info.kind == "number" and "ecef" not in info.path.lower() and (side := side_of(prefix, leaf)):
            structs.setdefault(prefix, {}).setdefault(side, info.path)
    yield from (paths_of for paths_of in structs.values() if {"n", "e"} <= set(paths_of))


def side_of(struct: str, leaf: str) -> str:
    """Return the direction (n, e, u, d) of a velocity component by its name; empty for other fields."""
    words = words_of(leaf)
    short = "".join(words)
    side = next((_SIDES[w] for w in (*words, short) if w in _SIDES and len(w) > 1), "")
    side = side or (_SIDES[words[-1]] if len(words) > 1 and words[-1] in "neud" else "")
    if {"std", "stddev", "stdev", "var", "cov", "accuracy", "sigma", "acc"} & set(words):
        return ""
    frame = next((f for f in ("ned", "enu") if f in words and words[-1] in {*"xyz"}), "")
    side = {"x": frame[:1], "y": frame[1:2], "z": frame[2:]}[words[-1]] if frame else side
    is_speed = (
        {"velocity", "vel", "speed"} & {*words, *words_of(struct)}
        or re.fullmatch("(v|vel)[neud]", short)
        or words[:1] == ("v",)
    )
    return side if is_speed else ""


def _ecef_vectors(topic: TopicInfo, fields: tuple[FieldInfo, ...], stamp: str) -> Iterator[SignalSource]:
    """Yield the arrays of three in ECEF that are a position or a velocity by name, in the order of the fields."""
    paths = dict.fromkeys(f.path for f in fields)
    for base in dict.fromkeys(p.removesuffix("[0]") for p in paths if p.endswith("[0]") and "ecef" in p.lower()):
        words = set(words_of(base))
        name = "ecef_velocity_m_s" if words & {"velocity", "vel"} else "ecef_position_m"
        if f"{base}[2]" in paths and f"{base}[3]" not in paths and words & {"velocity", "vel", "position", "pos"}:
            yield SignalSource(name, topic.name, tuple(f"{base}[{i}]" for i in range(3)), stamp)


def _is_place(seen: Seen | None, most: float) -> bool:
    """Return whether values can be degrees of latitude or longitude of a moving car."""
    if seen is None or not seen.changes or not 0.01 < seen.largest <= most:
        return False
    return float(np.nanmax(seen.cells) - np.nanmin(seen.cells)) < WIDEST_DEG


def _course(
    truth: dict[str, SignalSource], read: dict[tuple[str, str], Seen], topic: str, pieces: Pieces
) -> FloatArray | None:
    """Return the direction of travel counter-clockwise from east where the car moves, rad [M]."""
    if "enu_velocity_m_s" in truth:
        columns = [read.get((topic, p)) for p in truth["enu_velocity_m_s"].paths[:2]]
        if any(c is None for c in columns):
            return None
        east, north = (c.cells for c in columns if c is not None)
    elif {"lat_deg", "lon_deg"} <= set(truth):
        latitude, longitude = (read[topic, truth[n].paths[0]].cells for n in ("lat_deg", "lon_deg"))
        narrowed = math.cos(math.radians(float(np.nanmean(latitude))))
        north, east = (pieces.rate_of(c) * DEGREE_M for c in (latitude, longitude))
        east = east * narrowed
    else:
        return None
    return np.where(np.hypot(north, east) > MOVING_M_S, np.arctan2(north, east), np.nan)


def _convention(seen: Seen | None, course: FloatArray | None, unit: float | None) -> tuple[str, float, float] | None:
    """Return the convention in which a heading matches the course; None unless exactly one matches.

    Parameters
    ----------
    unit : radians per unit of the name; None without one: values beyond one turn in radians are then degrees.
    """
    if seen is None or course is None:
        return None
    unit = unit or (math.radians(1.0) if seen.largest > 2.1 * math.pi else 1.0)
    conventions = [c for c in _CONVENTIONS if math.isclose(abs(c[1]), unit)]
    off = [_off(seen, course, scale, angle) for _, scale, angle in conventions]
    if len(off) < 2 or not (min(off) < NEAR_RAD and FAR_RAD < max(off) < math.inf):
        return None
    return conventions[int(np.argmin(off))]


def _median_off(angles: FloatArray) -> float:
    """Return the median magnitude of angles; infinite with too few."""
    away = np.abs(np.angle(np.exp(1j * angles)))
    away = away[np.isfinite(away)]
    return float(np.median(away)) if away.shape[0] >= FEWEST_CELLS else math.inf


def _off(seen: Seen, course: FloatArray, scale: float, angle: float) -> float:
    """Return the median difference of an angle ``scale * raw + angle`` from the course, rad; infinite if unknown."""
    return _median_off(scale * seen.cells + angle - course)
