"""Motion over ground: axes of a velocity, signals of GNSS receivers, and ground truth of navigation systems.

Names contain north, east and up, or ECEF. They rarely define whether a heading is clockwise from north or
counter-clockwise from east, in degrees or radians, or whether x and y are axes of the earth or of the body. As a car
mostly moves in the direction of its heading, this follows from a comparison with the path and the yaw rate.
A source that also has a heading (two antennas, INS) or sideslip is ground truth, and never an input of an estimator.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np

from pdhef_logtool.logs.drive_log import DriveLog, TopicInfo
from pdhef_logtool.mapping.candidates import HYPOTHESES, MOST, Field, anchors_of
from pdhef_logtool.mapping.checking import stamp_path_of
from pdhef_logtool.mapping.evidence import FEWEST_CELLS, Pieces, Seen, fit, ratio
from pdhef_logtool.mapping.fields import CLEAR, PLACES, SLOW_M_S, Fields, path_velocity
from pdhef_logtool.mapping.naming import Meaning, meaning_among, words_of
from pdhef_logtool.mapping.records import SignalSource
from pdhef_logtool.mapping.vendors import Vendors, load_vendors
from pdhef_logtool.records.signals import GNSS_POSITION, FloatArray

#: Minimum speed for the course to be the direction of the car.
MOVING_M_S = 3.0
#: Median difference from the course: below NEAR_RAD for the right convention, above FAR_RAD for all others.
NEAR_RAD, FAR_RAD = math.radians(12.0), math.radians(25.0)
#: Positions by quantity.
_PLACES = {"lat_deg": "latitude", "lon_deg": "longitude"}
#: Largest plausible extent of a log, and least latitude in rad: simulators begin at 0.
WIDEST_DEG, FROM_ORIGIN_RAD = 10.0, 0.1
#: Senses of a heading, and its angle counter-clockwise from east: ``sign * unit * raw + offset``.
_SENSES = (("clockwise from north", -1.0, math.pi / 2.0), ("counter-clockwise from east", 1.0, 0.0))
#: Tolerance of the ratio of a speed to that from positions; speed over ground over that along the path if the axes are
#: the earth's; share of the time that a body moves ahead.
NEAR_PATH, SAME_STEPS, AHEAD_SHARE = 0.08, (0.7, 1.4), 0.6
#: Least share of its y axis in a path: along the x axis, velocities over ground and of the body are equal.
ACROSS_SHARE = 0.1
#: Axes of the x and y of a velocity; empty if the drive does not show them, "not ahead" if they are not the body's.
Axes: TypeAlias = Literal["east, north", "north, east", "body", "not ahead", ""]
#: Note on every speed that is a length.
NEVER_NEGATIVE = "the length of a velocity over ground, which is never negative: in reverse it has the wrong sign"
_EAST, _NORTH = "gnss_velocity_east_m_s", "gnss_velocity_north_m_s"
#: Ground truth with one of these contains a heading, or motion that needs one.
HEADING = frozenset({"quat_wxyz", "yaw_rad", "vy_m_s", "sideslip_rad"})


#: Ground-truth quantities of one topic, and the note on their source.
NavigationTruth: TypeAlias = tuple[dict[str, SignalSource], str]


def length_of(velocity: SignalSource) -> SignalSource:
    """Return the speed from a ground-truth velocity: the length of its horizontal part, of all three axes in ECEF."""
    level = len(velocity.paths) if velocity.name == "ecef_velocity_m_s" else 2
    scale = velocity.scale[:level] if isinstance(velocity.scale, tuple) else (velocity.scale,) * level
    return replace(velocity, name="speed_m_s", field=velocity.paths[:level], scale=scale, offset=0.0, combine="norm")


def axes_of(
    pieces: Pieces, x: FloatArray, y: FloatArray, steps: tuple[FloatArray, FloatArray] | None, rate: FloatArray | None
) -> Axes:
    """Return the axes of a horizontal velocity [M]; x and y in any unit.

    Parameters
    ----------
    steps : of a path, north and east. rate : yaw rate in any unit. Over ground, the direction of the velocity turns
        with the car; in the body's axes it stays ahead.
    """
    orders: tuple[tuple[Axes, FloatArray, FloatArray], ...] = ()
    if steps is not None:
        north, east = steps
        orders = (("east, north", east, north), ("north, east", north, east))
    for order, *along in orders:
        fits = [fit(a, b) for a, b in zip(along, (x, y), strict=True)]
        is_across = np.nanmean(along[1] ** 2) > ACROSS_SHARE**2 * np.nanmean(along[0] ** 2 + along[1] ** 2)
        if is_across and all(
            f is not None and f.correlation > CLEAR and SAME_STEPS[0] < f.slope < SAME_STEPS[1] for f in fits
        ):
            return order
    length = np.hypot(x, y)
    moving = length > SLOW_M_S
    turning = pieces.turning(np.where(moving, x + 1j * y, np.nan))
    relation = None if rate is None else fit(pieces.smooth(rate), turning)
    # The direction over ground turns as fast as the car, in rad/s or deg/s; a sideslip that follows it turns less.
    slope = relation.slope if relation is not None and relation.correlation > CLEAR else 0.0
    if any(SAME_STEPS[0] < slope * unit < SAME_STEPS[1] for unit in (1.0, math.radians(1.0))):
        return "east, north"
    enough = np.count_nonzero(moving) >= FEWEST_CELLS
    is_ahead = not enough or bool(np.mean((x > np.abs(y))[moving]) >= AHEAD_SHARE)
    if not is_ahead:
        return "not ahead"
    return "" if relation is None else "body"


def twist_axes(log: DriveLog, velocity: SignalSource, references: Sequence[SignalSource]) -> Axes:
    """Return the axes of a velocity's first two fields by positions and a yaw rate among ``references``."""
    pieces, read, anchors = _read(log, (velocity, *references))
    x, y = (read.get((velocity.topic, path)) for path in velocity.paths[:2])
    if x is None or y is None:
        return ""
    rate = next((f.si for f in anchors if f.meaning.quantity == "rate"), None)
    return axes_of(pieces, x.cells, y.cells, path_velocity(_on_path(pieces, anchors)), rate)


def _read(log: DriveLog, sources: Sequence[SignalSource]) -> tuple[Pieces, dict[tuple[str, str], Seen], list[Field]]:
    """Read sources in a few pieces of a log; return them also as fields."""
    pieces = Pieces(log)
    read = pieces.read((source.topic, path) for source in sources for path in source.paths)
    return pieces, read, anchors_of(log, sources, read)


def _on_path(pieces: Pieces, anchors: Sequence[Field]) -> Fields:
    return Fields(pieces, {}, [], [f for f in anchors if f.meaning.quantity in PLACES])


# ------------------------------------------------------------------------------------------------ receivers


def has_heading(truth: Collection[str]) -> bool:
    """Return whether ground truth contains a heading, or motion that needs one."""
    return bool(HEADING & set(truth))


def gnss_signals(signals: Mapping[str, SignalSource], truth: Mapping[str, SignalSource]) -> dict[str, SignalSource]:
    """Return the GNSS signals that mapped ground truth contains: a velocity, or speed and course of one topic."""
    if has_heading(truth):
        return {}
    if (velocity := truth.get("enu_velocity_m_s")) is not None:
        return {name: component(velocity, name, i) for i, name in enumerate((_EAST, _NORTH))}
    course = truth.get("course_rad")
    speeds = [s for s in (signals.get("speed_m_s"), truth.get("vx_m_s")) if s is not None]
    if course is None or not any(s.topic == course.topic for s in speeds):
        return {}
    speed = next(s for s in speeds if s.topic == course.topic)
    return {
        name: replace(source, name=name) for name, source in (("gnss_speed_m_s", speed), ("gnss_course_rad", course))
    }


def component(vector: SignalSource, name: str, column: int) -> SignalSource:
    """Return one column of a vector as a separate signal."""
    scale, offset = (value[column] if isinstance(value, tuple) else value for value in (vector.scale, vector.offset))
    return replace(vector, name=name, field=vector.paths[column], scale=scale, offset=offset)


def receiver_signals(
    topic: str, stamp: str, paths: Collection[str], vendors: Vendors | None = None
) -> dict[str, SignalSource]:
    """Return the GNSS signals of a topic if it contains, at any depth, the fields of a receiver; empty otherwise.

    Names in camel case (``gSpeed``) are those in lower case (``g_speed``).
    """
    there = {re.sub(r"(?<=[a-z])(?=[A-Z])", "_", path).lower(): path for path in paths}
    for receiver in (vendors or load_vendors()).receivers:
        leaf = min(receiver.has)
        for base in sorted(p.removesuffix(leaf) for p in there if p == leaf or p.endswith(f".{leaf}")):
            if not all(f"{base}{name}" in there for name in receiver.has):
                continue
            if any(f"{base}{name}" in there for name in receiver.without):
                return {}
            sources = {
                f.name: SignalSource(f.name, topic, there[f"{base}{path}"], stamp, f.scale, f.offset)
                for path, f in receiver.fields.items()
                if f"{base}{path}" in there
            }
            struct = there.get(f"{base}latitude", "").removesuffix("latitude")
            if any(p.startswith(f"{struct}position_covariance[") for p in paths):  # 1 sigma: mean of east and north
                squared = tuple(f"{struct}position_covariance[{i}]" for i in (0, 4))
                accuracy = SignalSource("gnss_position_accuracy_m", topic, squared, stamp, (0.5, 0.5), combine="root")
                sources[accuracy.name] = accuracy
            return sources
    return {}


# ------------------------------------------------------------------------------------------------ by names


class _Instrument:
    """A topic with the fields of a navigation system or receiver by their names."""

    def __init__(self, log: DriveLog, topic: TopicInfo) -> None:
        self.log, self.topic, self.fields = log, topic.name, log.fields(topic.name, quiet=True)
        self.stamp = stamp_path_of(self.fields)
        numbers = (f for f in self.fields if f.kind == "number")
        there = {f.path for f in self.fields}
        named = ((f.path, meaning_among(topic.name, topic.type_name, f.path, f.unit, there)) for f in numbers)
        self.meanings = {path: meaning for path, meaning in named if meaning is not None}
        first = {m.quantity: path for path, m in reversed(self.meanings.items())}
        self.place_paths = {name: first[q] for name, q in _PLACES.items() if q in first}
        self.named_velocities = [*_horizontal(self.meanings)]
        angles = ((m, p) for q in ("course", "heading") for p, m in self.meanings.items() if m.quantity == q)
        self.angles = {path: meaning for meaning, path in angles}
        self.has_attitude = any({"roll", "pitch"} & set(words_of(f.path)) for f in self.fields)
        # Beside a speed alone, the heading of a receiver is that of its motion.
        is_receiver = not self.has_attitude and "speed" in first and "ins" not in words_of(topic.name)
        self.courses = {p for p in self.angles if is_receiver and p.rpartition(".")[2].lower() == "heading"}

    def source(self, name: str, path: str, scale: float = 1.0, offset: float = 0.0) -> SignalSource:
        """Return a field of the topic as a source."""
        return SignalSource(name, self.topic, path, self.stamp, scale, offset)

    @cached_property
    def places(self) -> dict[str, SignalSource]:
        """Latitude and longitude in degrees; as degrees, usual ones in radians would be in the Gulf of Guinea."""
        reach = [self.seen[p].largest for p in self.place_paths.values() if p in self.seen]
        is_small = len(reach) == len(_PLACES) and FROM_ORIGIN_RAD < reach[0] <= math.pi / 2.0 and reach[1] <= math.pi
        usual = math.degrees(1.0) if is_small else 1.0
        return {n: self.source(n, p, self.meanings[p].scale or usual) for n, p in self.place_paths.items()}

    @cached_property
    def seen(self) -> dict[str, Seen]:
        """Values of velocities, angles and positions in a few pieces of the log, by path."""
        paths = [*(p for v in self.named_velocities for p in v.values()), *self.angles]
        paths += [p for p, m in self.meanings.items() if m.quantity == "speed"]
        paths += self.place_paths.values()
        return {path: seen for (_, path), seen in self.pieces.read((self.topic, p) for p in paths).items()}

    @cached_property
    def velocities(self) -> list[dict[str, str]]:
        """Velocities over ground that a car can have in the unit of their names, or else in m/s, by direction."""
        reach = {p: self.seen[p].largest * (m.scale or 1.0) for p, m in self.meanings.items() if p in self.seen}
        return [v for v in self.named_velocities if not any(reach.get(p, 0.0) > MOST["speed"] for p in v.values())]

    @cached_property
    def pieces(self) -> Pieces:
        """The pieces of the log."""
        return Pieces(self.log)

    @property
    def has_place(self) -> bool:
        """Return whether there are degrees of latitude and longitude of a moving car."""
        limits = zip(_PLACES, (90.0, 180.0), strict=True)
        its = ((self.places.get(n), most) for n, most in limits)
        return all(s is not None and _is_place(self.seen.get(s.paths[0]), most, s.scale) for s, most in its)

    @property
    def course(self) -> FloatArray:
        """Direction of the path, counter-clockwise from east, rad [M]; NaN at low speed."""
        nothing = np.full(len(self.pieces.starts) * self.pieces.cells_a_piece, np.nan)
        return nothing if self.along is None else _direction(*self.along)

    @cached_property
    def along(self) -> tuple[FloatArray, FloatArray] | None:
        """Velocity north and east along the positions, m/s [M]; None without positions."""
        read = {(self.topic, path): seen for path, seen in self.seen.items()}
        return path_velocity(_on_path(self.pieces, anchors_of(self.log, [*self.places.values()], read)))

    def unit_on_path(self, speed: str) -> float | None:
        """Return the unit in which a speed is that along the positions; None if it is not, or without positions."""
        seen = self.seen.get(speed)
        times = ratio(np.hypot(*self.along), seen.cells, SLOW_M_S) if self.along and seen else None
        return next((u for _, u in HYPOTHESES["speed"] if times is not None and abs(times / u - 1.0) < NEAR_PATH), None)

    @property
    def over_ground(self) -> list[SignalSource]:
        """Velocity east and north over ground; empty without one."""
        if not self.velocities:
            return []
        paths = [self.velocities[0][side] for side in "en"]
        unit = self.meanings[paths[1]].scale or 1.0
        return [self.source(name, path, unit) for name, path in zip((_EAST, _NORTH), paths, strict=True)]


def navigation_truth(log: DriveLog, topics: Sequence[TopicInfo], *, whole: bool = False) -> NavigationTruth | None:
    """Return the ground truth of the topic with most quantities of position, velocity and heading, or None.

    Parameters
    ----------
    topics : of navigation systems and references with undocumented types.
    whole : whether only a velocity with a heading counts.
    """
    truths = [truth for t in topics if (truth := _truth_of(_Instrument(log, t))) is not None]
    truths = [t for t in truths if not whole or {"enu_velocity_m_s", "yaw_rad"} <= set(t[0])]
    return max(truths, key=lambda t: len(t[0]), default=None)


def named_gnss(log: DriveLog, topic: TopicInfo) -> dict[str, SignalSource]:
    """Return position, velocity or speed and course over ground by the names of a topic's fields.

    A velocity must agree with the path, if there is one. A heading that is the
    direction of the path is a course.
    """
    its = _Instrument(log, topic)
    if len(its.place_paths) < len(_PLACES):
        return {s.name: s for s in its.over_ground}
    if not its.has_place:
        return {}
    sources = [replace(its.places[n], name=name) for n, name in zip(_PLACES, GNSS_POSITION, strict=True)]
    sides = [its.seen.get(s.paths[0]) for s in its.over_ground]
    east, north = (None if s is None else s.cells for s in sides) if sides else (None, None)
    if east is not None and north is not None and _median_off(np.arctan2(north, east) - its.course) < NEAR_RAD:
        sources += its.over_ground
    else:
        sources += _speed_and_course(its)
    return {source.name: source for source in sources}


def _speed_and_course(its: _Instrument) -> Iterator[SignalSource]:
    """Yield the first speed with a unit and the first angle that is the path's course, if both exist."""
    speeds = ((p, m.scale or its.unit_on_path(p)) for p, m in its.meanings.items() if m.quantity == "speed")
    speed, unit = next(((path, unit) for path, unit in speeds if unit is not None), ("", 0.0))
    if not speed:
        return
    for path, meaning in its.angles.items():
        convention = _convention(its.seen.get(path), its.course, meaning.scale)
        if convention is not None and convention[1] < 0.0:  # a course over ground is clockwise from north by definition
            yield its.source("gnss_course_rad", path, *convention[1:])
            yield its.source("gnss_speed_m_s", speed, unit)
            return


def _truth_of(its: _Instrument) -> NavigationTruth | None:
    truth = {s.name: s for s in (*_enu_velocities(its), *_ecef_vectors(its))}
    course = None
    if its.has_place:
        truth |= its.places
        course = its.course
    if velocity := truth.get("enu_velocity_m_s"):
        east, north = (its.seen.get(path) for path in velocity.paths[:2])
        course = None if east is None or north is None else _direction(north.cells, east.cells)
    note = f"ground truth comes from {its.topic}, by the names of its fields"
    for path in (p for p, m in its.angles.items() if m.quantity == "heading" and p not in its.courses):
        convention = _convention(its.seen.get(path), course, its.angles[path].scale)
        if convention is not None:
            words, scale, offset = convention
            truth["yaw_rad"] = its.source("yaw_rad", path, scale, offset)
            note += f"; {path} is in {words}, which agrees with the course over ground"
            break
    useful = {"enu_velocity_m_s", "ecef_velocity_m_s", "ecef_position_m", "lat_deg"} & set(truth)
    return (truth, note) if useful else None


def _enu_velocities(its: _Instrument) -> Iterator[SignalSource]:
    """Yield the first velocity east, north, up (or down) by the field names of one struct.

    That of an INS, which has roll and pitch, may lack a vertical one, which is 0 then.
    """
    for paths_of in its.velocities:
        vertical = next((s for s in "ud" if s in paths_of), "")
        if vertical or its.has_attitude:
            paths = (paths_of["e"], paths_of["n"], paths_of[vertical or "n"])
            factor = its.meanings[paths[0]].scale or 1.0
            scale = (factor, factor, factor * {"u": 1.0, "d": -1.0, "": 0.0}[vertical])
            yield SignalSource("enu_velocity_m_s", its.topic, paths, its.stamp, scale)
            return


def _horizontal(meanings: Mapping[str, Meaning]) -> Iterator[dict[str, str]]:
    """Yield by struct the paths of a velocity over ground with at least north and east, by direction."""
    structs: dict[str, dict[str, str]] = {}
    for path, meaning in meanings.items():
        if meaning.quantity == "over ground":
            structs.setdefault(path.rpartition(".")[0], {}).setdefault(meaning.part, path)
    yield from (paths_of for paths_of in structs.values() if {"n", "e"} <= set(paths_of))


def _ecef_vectors(its: _Instrument) -> Iterator[SignalSource]:
    """Yield the arrays of three, or vectors, in ECEF that are a position or a velocity by name."""
    paths = dict.fromkeys(f.path for f in its.fields)
    for ends in (("[0]", "[1]", "[2]"), (".x", ".y", ".z")):
        for base in [p.removesuffix(ends[0]) for p in paths if p.endswith(ends[0]) and "ecef" in p.lower()]:
            words, vector = set(words_of(base)), tuple(f"{base}{end}" for end in ends)
            name = "ecef_velocity_m_s" if words & {"velocity", "vel"} else "ecef_position_m"
            is_vector = set(vector) <= paths.keys() and f"{base}[3]" not in paths
            if is_vector and words & {"velocity", "vel", "position", "pos"}:
                yield SignalSource(name, its.topic, vector, its.stamp)


def turns(pieces: Pieces, angle_rad: FloatArray, rate: FloatArray) -> float:
    """Return the sign with which an angle [M] turns as fast as a yaw rate, rad/s [M]; 0 if it does not."""
    relation = fit(pieces.smooth(rate), pieces.smooth(pieces.turning(np.exp(1j * angle_rad))))
    slope = 0.0 if relation is None or abs(relation.correlation) <= CLEAR else relation.slope
    return math.copysign(float(SAME_STEPS[0] < abs(slope) < SAME_STEPS[1]), slope)


def _is_place(seen: Seen | None, most: float, scale: float | tuple[float, ...]) -> bool:
    """Return whether values times ``scale`` can be degrees of latitude or longitude of a moving car."""
    if seen is None or not seen.changes or not isinstance(scale, float) or not 0.01 < seen.largest * scale <= most:
        return False
    return float(np.nanmax(seen.cells) - np.nanmin(seen.cells)) * scale < WIDEST_DEG


def _direction(north: FloatArray, east: FloatArray) -> FloatArray:
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
    off = [_off(seen, course, sign * unit, angle) for _, sign, angle in _SENSES]
    if not (min(off) < NEAR_RAD and FAR_RAD < max(off) < math.inf):
        return None
    sense, sign, angle = _SENSES[int(np.argmin(off))]
    words = "radians" if unit == 1.0 else f"{math.degrees(unit):.3g} degrees".removeprefix("1 ")
    return f"{words} {sense}", sign * unit, angle


def _median_off(angles: FloatArray) -> float:
    """Return the median magnitude of angles; infinite with too few."""
    away = np.abs(np.angle(np.exp(1j * angles)))
    away = away[np.isfinite(away)]
    return float(np.median(away)) if away.shape[0] >= FEWEST_CELLS else math.inf


def _off(seen: Seen, course: FloatArray, scale: float, angle: float) -> float:
    """Return the median difference of an angle ``scale * raw + angle`` from the course, rad; infinite if unknown."""
    return _median_off(scale * seen.cells + angle - course)
