"""Motion over ground: axes of a velocity, signals of GNSS receivers, and ground truth of navigation systems.

Names contain north, east and up, or ECEF. They rarely define whether a heading is clockwise from north or
counter-clockwise from east, in degrees or radians, or whether x and y are axes of the earth or of the body. As a car
mostly moves in the direction of its heading, this follows from a comparison with the path and the yaw rate.
A source that also has a heading (two antennas, INS) or sideslip is ground truth, and never an input of an estimator.
"""

import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np

from pdhef_logtool.logs.drive_log import DriveLog, TopicInfo
from pdhef_logtool.logs.message_schema import FieldInfo
from pdhef_logtool.mapping.candidates import MOST, Field
from pdhef_logtool.mapping.checking import stamp_path_of
from pdhef_logtool.mapping.evidence import EVIDENCE, FEWEST_CELLS, Fit, Pieces, fit
from pdhef_logtool.mapping.fields import SLOW_M_S, Fields, path_velocity
from pdhef_logtool.mapping.naming import words_of
from pdhef_logtool.mapping.records import SignalSource
from pdhef_logtool.mapping.vendors import Vendors, load_vendors
from pdhef_logtool.records.signals import GNSS_POSITION, FloatArray

_GROUND = EVIDENCE["ground"]
#: Quantities of a position.
_PLACES = ("latitude", "longitude")
#: Senses of a heading, and its angle counter-clockwise from east: ``sign * unit * raw + offset``.
_SENSES = (("clockwise from north", -1.0, math.pi / 2.0), ("counter-clockwise from east", 1.0, 0.0))
SAME_STEPS: tuple[float, float] = _GROUND["same_steps"]
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
    """Return the speed from a velocity: the length of its horizontal part, of all three axes in ECEF."""
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
        is_across = np.nanmean(along[1] ** 2) > _GROUND["across_share"] ** 2 * np.nanmean(along[0] ** 2 + along[1] ** 2)
        if is_across and all(f.is_clear and SAME_STEPS[0] < f.slope < SAME_STEPS[1] for f in fits):
            return order
    length = np.hypot(x, y)
    moving = length > SLOW_M_S
    turning = pieces.turning(np.where(moving, x + 1j * y, np.nan))
    relation = Fit() if rate is None else fit(pieces.smooth(rate), turning)
    # The direction over ground turns as fast as the car, in rad/s or deg/s; a sideslip that follows it turns less.
    as_fast = any(SAME_STEPS[0] < relation.slope * unit < SAME_STEPS[1] for unit in (1.0, math.radians(1.0)))
    if relation.is_clear and as_fast:
        return "east, north"
    enough = np.count_nonzero(moving) >= FEWEST_CELLS
    is_ahead = not enough or bool(np.mean((x > np.abs(y))[moving]) >= _GROUND["ahead_share"])
    if not is_ahead:
        return "not ahead"
    return "body" if relation.correlation else ""


# ------------------------------------------------------------------------------------------------ receivers


def has_heading(truth: Collection[str]) -> bool:
    """Return whether ground truth contains a heading, or motion that needs one."""
    return bool(HEADING & set(truth))


def gnss_signals(signals: Mapping[str, SignalSource], truth: Mapping[str, SignalSource]) -> dict[str, SignalSource]:
    """Return the GNSS signals that mapped ground truth contains: a velocity, or speed and course of one topic."""
    if has_heading(truth):
        return {}
    if (velocity := truth.get("enu_velocity_m_s")) is not None:
        return {name: _component(velocity, name, i) for i, name in enumerate((_EAST, _NORTH))}
    course = truth.get("course_rad")
    for speed in (signals.get("speed_m_s"), truth.get("vx_m_s")):
        if speed is not None and course is not None and speed.topic == course.topic:
            return {s.name: s for s in (replace(speed, name="gnss_speed_m_s"), replace(course, name="gnss_course_rad"))}
    return {}


def _component(vector: SignalSource, name: str, column: int) -> SignalSource:
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
            its = ((s, there.get(f"{base}{path}")) for path, s in receiver.fields.items())
            sources = {s.name: replace(s, topic=topic, field=path, stamp=stamp) for s, path in its if path}
            struct = there.get(f"{base}latitude", "").removesuffix("latitude")
            if any(p.startswith(f"{struct}position_covariance[") for p in paths):  # 1 sigma: mean of east and north
                squared = tuple(f"{struct}position_covariance[{i}]" for i in (0, 4))
                accuracy = SignalSource("gnss_position_accuracy_m", topic, squared, stamp, (0.5, 0.5), combine="root")
                sources[accuracy.name] = accuracy
            return sources
    return {}


# ------------------------------------------------------------------------------------------------ by names


class _Instrument:
    """The fields of a topic, by their names, that may be a navigation system or a receiver."""

    def __init__(self, fields: Fields, topic: str) -> None:
        self.pieces = fields.pieces
        self.fields = [f for f in fields.candidates if f.topic.name == topic and not f.fixed]
        places = [next(iter(self.of(quantity)), None) for quantity in _PLACES]
        self.places = [f for f in places if f is not None]
        structs: dict[str, dict[str, Field]] = {}
        for item in self.of("over ground"):
            structs.setdefault(item.path.rpartition(".")[0], {}).setdefault(item.meaning.part, item)
        sides = [v for v in structs.values() if {"n", "e"} <= set(v)]
        #: Velocities over ground that a car can have, by direction.
        self.velocities = [v for v in sides if all(f.seen.largest * f.scale <= MOST["speed"] for f in v.values())]

    def of(self, quantity: str) -> list[Field]:
        """Return the fields of a quantity."""
        return [f for f in self.fields if f.meaning.quantity == quantity]

    @property
    def has_place(self) -> bool:
        """Return whether there are degrees of latitude and longitude of a moving car."""
        return len(self.places) == len(_PLACES) and all(map(_is_place, self.places))

    @cached_property
    def course(self) -> FloatArray | None:
        """Direction of the path, counter-clockwise from east, rad [M], NaN at low speed; None without positions."""
        velocity = path_velocity(self.pieces, self.places) if self.has_place else None
        return None if velocity is None else _direction(*velocity)

    @property
    def over_ground(self) -> list[SignalSource]:
        """Velocity east and north over ground; empty without one."""
        sides = zip((_EAST, _NORTH), "en", strict=True) if self.velocities else ()
        return [_source(name, self.velocities[0][side]) for name, side in sides]


def _source(name: str, item: Field, scale: float | None = None, offset: float = 0.0) -> SignalSource:
    """Return a field as the source of a quantity."""
    return SignalSource(name, item.topic.name, item.path, item.stamp, item.scale if scale is None else scale, offset)


def navigation_truth(
    log: DriveLog, fields: Fields, topics: Sequence[TopicInfo], *, whole: bool = False
) -> NavigationTruth | None:
    """Return the ground truth of the topic with most quantities of position, velocity and heading, or None.

    Parameters
    ----------
    topics : of navigation systems and references with undocumented types.
    whole : whether only a velocity with a heading counts.
    """
    truths = [truth for t in topics if (truth := _truth_of(log, t.name, _Instrument(fields, t.name))) is not None]
    truths = [t for t in truths if not whole or {"enu_velocity_m_s", "yaw_rad"} <= set(t[0])]
    return max(truths, key=lambda t: len(t[0]), default=None)


def named_gnss(fields: Fields, topic: str) -> dict[str, SignalSource]:
    """Return position, velocity or speed and course over ground by the names of a topic's fields.

    A velocity must agree with the path, if there is one. A heading that is the
    direction of the path is a course.
    """
    its = _Instrument(fields, topic)
    if len(its.places) < len(_PLACES):
        return {s.name: s for s in its.over_ground}
    if its.course is None:
        return {}
    sources = [_source(name, item) for item, name in zip(its.places, GNSS_POSITION, strict=True)]
    velocity = its.velocities[0] if its.velocities else None
    if velocity and _degrees_off(np.arctan2(velocity["n"].si, velocity["e"].si) - its.course) < _GROUND["near_deg"]:
        sources += its.over_ground
    else:
        sources += _speed_and_course(its, its.course)
    return {source.name: source for source in sources}


def _speed_and_course(its: _Instrument, course: FloatArray) -> Iterator[SignalSource]:
    """Yield the first speed with a unit and the first angle that is the path's course, if both exist."""
    speed = next((f for f in its.of("speed") if f.unit_known), None)
    if speed is None:
        return
    for item in (*its.of("course"), *its.of("heading")):
        convention = _convention(item, course)
        if convention is not None and convention[1] < 0.0:  # a course over ground is clockwise from north by definition
            yield _source("gnss_course_rad", item, *convention[1:])
            yield _source("gnss_speed_m_s", speed)
            return


def _truth_of(log: DriveLog, topic: str, its: _Instrument) -> NavigationTruth | None:
    fields, course = log.fields(topic, quiet=True), its.course
    has_attitude = any({"roll", "pitch"} & set(words_of(f.path)) for f in fields)
    velocities = _enu_velocities(its, has_attitude=has_attitude)
    truth = {s.name: s for s in (*velocities, *_ecef_vectors(topic, fields))}
    if its.has_place:
        truth |= {name: _source(name, item) for name, item in zip(("lat_deg", "lon_deg"), its.places, strict=True)}
    if "enu_velocity_m_s" in truth:
        course = _direction(its.velocities[0]["n"].si, its.velocities[0]["e"].si)
    note = f"ground truth comes from {topic}, by the names of its fields"
    # Beside a speed alone, the heading of a receiver is that of its motion.
    is_receiver = not has_attitude and bool(its.of("speed")) and "ins" not in words_of(topic)
    for item in its.of("heading"):
        is_course = is_receiver and item.path.rpartition(".")[2].lower() == "heading"
        convention = None if is_course else _convention(item, course)
        if convention is not None:
            words, scale, offset = convention
            truth["yaw_rad"] = _source("yaw_rad", item, scale, offset)
            note += f"; {item.path} is in {words}, which agrees with the course over ground"
            break
    useful = {"enu_velocity_m_s", "ecef_velocity_m_s", "ecef_position_m", "lat_deg"} & set(truth)
    return (truth, note) if useful else None


def _enu_velocities(its: _Instrument, *, has_attitude: bool) -> Iterator[SignalSource]:
    """Yield the first velocity east, north, up (or down) by the field names of one struct.

    That of an INS, which has roll and pitch, may lack a vertical one, which is 0 then.
    """
    for sides in its.velocities:
        vertical = next((s for s in "ud" if s in sides), "")
        if vertical or has_attitude:
            axes = [sides[side] for side in ("e", "n", vertical or "n")]
            signs = (1.0, 1.0, {"u": 1.0, "d": -1.0, "": 0.0}[vertical])
            paths = tuple(f.path for f in axes)
            factors = tuple(f.scale * sign for f, sign in zip(axes, signs, strict=True))
            yield SignalSource("enu_velocity_m_s", axes[0].topic.name, paths, axes[0].stamp, factors)
            return


def _ecef_vectors(topic: str, fields: tuple[FieldInfo, ...]) -> Iterator[SignalSource]:
    """Yield the arrays of three, or vectors, in ECEF that are a position or a velocity by name."""
    paths = dict.fromkeys(f.path for f in fields)
    for ends in (("[0]", "[1]", "[2]"), (".x", ".y", ".z")):
        for base in [p.removesuffix(ends[0]) for p in paths if p.endswith(ends[0]) and "ecef" in p.lower()]:
            words, vector = set(words_of(base)), tuple(f"{base}{end}" for end in ends)
            name = "ecef_velocity_m_s" if words & {"velocity", "vel"} else "ecef_position_m"
            is_vector = set(vector) <= paths.keys() and f"{base}[3]" not in paths
            if is_vector and words & {"velocity", "vel", "position", "pos"}:
                yield SignalSource(name, topic, vector, stamp_path_of(fields))


def turns(pieces: Pieces, angle_rad: FloatArray, rate: FloatArray) -> float:
    """Return the sign with which an angle [M] turns as fast as a yaw rate, rad/s [M]; 0 if it does not."""
    relation = fit(pieces.smooth(rate), pieces.smooth(pieces.turning(np.exp(1j * angle_rad))))
    is_same = relation.is_clear and SAME_STEPS[0] < abs(relation.slope) < SAME_STEPS[1]
    return math.copysign(float(is_same), relation.slope)


def _is_place(item: Field) -> bool:
    """Return whether values can be degrees of latitude or longitude of a moving car."""
    is_angle = _GROUND["least_deg"] < item.seen.largest * item.scale <= MOST[item.meaning.quantity]
    return item.seen.changes and is_angle and float(np.nanmax(item.si) - np.nanmin(item.si)) < _GROUND["widest_deg"]


def _direction(north: FloatArray, east: FloatArray) -> FloatArray:
    return np.where(np.hypot(north, east) > _GROUND["moving_m_s"], np.arctan2(north, east), np.nan)


def _convention(item: Field, course: FloatArray | None) -> tuple[str, float, float] | None:
    """Return the convention in which a heading matches the course; None unless exactly one matches.

    Without a unit in the name, values beyond one turn in radians are degrees.
    """
    if course is None:
        return None
    unit = item.meaning.scale or (math.radians(1.0) if item.seen.largest > 2.1 * math.pi else 1.0)
    off = [_degrees_off(sign * unit * item.seen.cells + angle - course) for _, sign, angle in _SENSES]
    if not (min(off) < _GROUND["near_deg"] and _GROUND["far_deg"] < max(off) < math.inf):
        return None
    sense, sign, angle = _SENSES[int(np.argmin(off))]
    words = "radians" if unit == 1.0 else f"{math.degrees(unit):.3g} degrees".removeprefix("1 ")
    return f"{words} {sense}", sign * unit, angle


def _degrees_off(angles_rad: FloatArray) -> float:
    """Return the median magnitude of angles, degrees; infinite with too few."""
    away = np.abs(np.angle(np.exp(1j * angles_rad), deg=True))
    away = away[np.isfinite(away)]
    return float(np.median(away)) if away.shape[0] >= FEWEST_CELLS else math.inf
