"""Select candidates by physics: gravity, a_y ≈ v r, a_x ≈ v̇, steering against curvature, wheels against yaw rate.

Signals of recognised types are fixed anchors, to which candidates are compared. Reports give the evidence for a unit
or a sign; an open point becomes an undecided check with a remedy.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from pdhef_logtool.logs.drive_log import DriveLog, TopicInfo
from pdhef_logtool.mapping.candidates import (
    CONSTANT,
    HYPOTHESES,
    Candidate,
    Field,
    Role,
    look,
    named_fields,
    place_of,
    triad_of,
)
from pdhef_logtool.mapping.evidence import EVIDENCE, LOG_ODDS, Fit, Pieces, fit, ratio
from pdhef_logtool.mapping.fields import (
    BY_DRIVING,
    PLACES,
    SLOW_M_S,
    USUAL_LENGTH_M,
    Fields,
    Gain,
    Unit,
    agree,
    decide_units,
    mean_of,
    path_velocity,
    posterior,
)
from pdhef_logtool.mapping.naming import tags_of, words_of
from pdhef_logtool.mapping.navigation import axes_of, has_heading, turns
from pdhef_logtool.mapping.proposals import proposed_fields
from pdhef_logtool.mapping.records import SignalSource
from pdhef_logtool.mapping.vendors import Vendors, names_of
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.signals import WHEELS, FloatArray

#: Ground truth quantities of a single field.
_TRUTH = ("vx_m_s", "vy_m_s", "sideslip_rad", "yaw_rate_rad_s", "lat_deg", "lon_deg", "course_rad", "yaw_rad")
_SLIP = frozenset({"vy_m_s", "sideslip_rad"})
#: Words of a velocity x, y, z in the body's axes by convention.
_OF_BODY = frozenset({"twist", "linear", "body", "vessel"})
#: Signals of a single field, in the order of their selection.
_SENSORS = ("speed_m_s", "ax_m_s2", "ay_m_s2", "yaw_rate_rad_s")
_RELATIONS, _UNITS = EVIDENCE["relations"], EVIDENCE["units"]
#: Plausible lengths that convert curvature to an angle: wheelbases of model cars to lorries, times a steering ratio for
#: the steering wheel.
_STEERING_M: dict[str, tuple[float, float]] = _RELATIONS["wheelbases_m"]
#: Signals that may have an unknown sign.
_SIGNED = ("steer_rad", "steering_wheel_rad", "yaw_rate_rad_s", "ay_m_s2")
#: Units of wheel speeds, which are mostly named as speeds.
_RADIUS_M: float = _RELATIONS["radius_m"]
WHEEL_UNITS = (
    *(Unit(*u, "wheel speed") for u in HYPOTHESES["wheel speed"]),
    *(Unit(n, f * _RADIUS_M, "wheel rate", _RELATIONS["radius"]) for n, f in HYPOTHESES["wheel rate"]),
)


def weigh(
    log: DriveLog,
    topics: Sequence[tuple[TopicInfo, Role]],
    signals: Mapping[str, SignalSource],
    truth: Mapping[str, SignalSource],
    vendors: Vendors,
) -> "Weighing":
    """Select fields for the missing signals, and for missing ground truth.

    Parameters
    ----------
    topics : topics that may contain candidates, with their kinds of data.
    signals, truth : sources of recognised types; a topic named as ground truth replaces ground truth without heading.
    """
    if not topics or log.end_ns <= log.start_ns:
        return Weighing(Fields(Pieces(log), {}, [], []))
    named = named_fields(log, topics, vendors)
    true = [s for n, s in truth.items() if n in ("lat_deg", "lon_deg", "x_m", "y_m", "vx_m_s")]
    pieces, candidates, anchors = look(log, named, [*signals.values(), *true])
    places = [f for f in (*candidates, *anchors.values()) if f.meaning.quantity in PLACES]
    fields = Fields(pieces, {n: f for n, f in anchors.items() if n in signals}, candidates, places)
    fields.candidates += proposed_fields(log, topics, named, fields)
    decide_units(fields)
    weighing = Weighing(fields, anchors.get("vx_m_s"))
    weighing.drop_vectors_over_ground()
    weighing.drop_vertical_speeds()
    may_be_true = [f for f in fields.candidates if not truth or (f.role == "truth" and not has_heading(truth))]
    weighing.truth_from = truth_topic(may_be_true)
    its = [f for f in may_be_true if f.topic.name == weighing.truth_from and _truth_name(f) in _SLIP and f.seen.changes]
    weighing.slip = min(its, key=lambda f: (f.role != "truth", f.role != "navigation", -f.log_odds), default=None)
    weighing.choose_signals(set(signals))
    weighing.taken |= weighing.choose_truth()
    for name, item in weighing.taken.items():
        weighing.tell(name, item)
    return weighing


@dataclass(slots=True)
class Weighing:
    """Selection of fields from the candidates.

    Attributes
    ----------
    true_speed : of mapped ground truth. truth_from, slip : topic of other ground truth, and its lateral velocity.
    taken : selected fields by signal, and by ``truth.NAME``.
    rivals : fields of a signal with nearly the same score. checks : undecided points.
    """

    fields: Fields
    true_speed: Field | None = None
    truth_from: str = ""
    slip: Field | None = None
    taken: dict[str, Field] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    rivals: list[tuple[str, tuple[str, ...]]] = field(default_factory=list)
    checks: list[Check] = field(default_factory=list)

    # ---------------------------------------------------------------------------------------------- signals

    def choose_signals(self, have: set[str]) -> None:
        """Take the best candidate of each signal that is missing."""
        usable = self._usable()
        wheels = any(n.startswith("wheel_speed") for n in have)
        for name in _SENSORS:
            if name not in have and not (wheels and name == "speed_m_s"):
                fields = (f for f in usable if name in names_of(f.meaning.quantity, f.meaning.part))
                self._choose([(f.log_odds, name, f) for f in fields])
        self._turn_level()
        if not wheels:
            self._wheels(usable)
        if not have & {"steer_rad", "steering_wheel_rad"}:
            self._steering([f for f in usable if f.meaning.quantity == "steering"])
            self._steer_by_command()

    def _usable(self) -> list[Field]:
        """Return candidates for signals; sensors in the ground-truth topic rank below sensors of other messages."""
        usable = [f for f in self.fields.candidates if f.role in ("sensor", "navigation")]
        given = {f.meaning.quantity.replace("wheel rate", "speed").replace("wheel speed", "speed") for f in usable}
        lacking = {"acceleration", "rate", "speed", "steering"} - given
        usable += [f for f in self.fields.candidates if f.role == "estimate" and f.meaning.quantity in lacking]
        usable = [f for f in usable if (f.seen.changes or f.fixed or f.is_steady) and f.section != "truth"]
        # Sensors of the ground truth's instrument rank below others.
        kinships = [(f.meaning.quantity, f.meaning.part, self._kinship(f)) for f in usable]
        for item, (*meant, kinship) in zip(usable, kinships, strict=True):
            item.evidence += ["instrument"] * any(meant == other and kinship > less for *other, less in kinships)
        return usable

    def _kinship(self, item: Field) -> int:
        """Return how far the words of a field show the instrument that measures the lateral velocity."""
        if item.topic.name != self.truth_from:
            return -9
        tags, others = tags_of(item.path), tags_of(self.slip.path if self.slip else item.path)
        return len(tags & others) - len(tags - others)

    def drop_vectors_over_ground(self) -> None:
        """Take velocities x, y over ground as the signals of a receiver; they are no velocities of the body."""
        steps, rates = path_velocity(self.fields.pieces, self.fields.positions), self.fields.open("rate", "z")
        for x, y in list(self._vectors()):
            axes = axes_of(self.fields.pieces, x.si, y.si, steps, rates[0].si if rates else None)
            is_named = x.path.rpartition(".")[2] != "x" or bool(_OF_BODY & set(words_of(x.path)))
            if (axes == "body" or (is_named and not axes)) and not self._is_horizontal_speed(x, y):
                self._turn_down(y)
                continue
            self.fields.candidates = [f for f in self.fields.candidates if f not in (x, y)]
            note = f"{x.topic.name}.{x.path} is not used as a speed: its vector is not in the car's axes"
            # Axes by the yaw rate alone cannot show its sign: beside a speed, the vector is left out.
            is_sure = steps is not None or (is_named and not any(f is not x for f in self.fields.open("speed")))
            if axes in ("east, north", "north, east") and is_sure and x.role in ("sensor", "navigation"):
                for name, item in zip(axes.split(", "), (x, y), strict=True):
                    self.taken[f"gnss_velocity_{name}_m_s"] = item
                note += f"; x and y are {axes.replace(', ', ' and ')}"
            self.notes.append(note)

    def drop_vertical_speeds(self) -> None:
        """Leave out speeds that are small against the velocity over ground of their message."""
        for side in (*self.fields.open("over ground"), *self.taken.values()):
            least = EVIDENCE["ground"]["vertical"] * abs(side.seen.largest * side.scale)
            speeds = [f for f in self.fields.open("speed") if f.topic is side.topic and not f.fixed]
            for item in [f for f in speeds if abs(f.seen.largest * f.scale) < least]:
                self.fields.candidates.remove(item)

    def _is_horizontal_speed(self, x: Field, y: Field) -> bool:
        """Return whether another speed is the length of x and y, and not x."""
        speeds = [f.si for f in self.fields.open("speed") if f is not x]
        return any(agree(v, np.hypot(x.si, y.si)) and not agree(v, x.si) for v in speeds)

    def _turn_down(self, y: Field) -> None:
        """Turn the y of a body's velocity to the left if the accelerometer beside it has gravity along -z."""
        down = [f for f in self.fields.candidates if f.has_gravity and f.sign < 0.0 and f.path.rstrip("]")[-1] in "zZ2"]
        if any(f.meaning.part == "z" and place_of(f) == place_of(y) for f in down):
            y.sign = -1.0
            y.doubts.append("its device has axes forward, right, down, as gravity shows")

    def _vectors(self) -> Iterator[tuple[Field, Field]]:
        """Yield the x and y of velocities that change."""
        for y in self.fields.candidates:
            if y.meaning.quantity == "velocity" and y.is_axis and not y.fixed and y.seen.changes:
                beside = (f for f in self.fields.candidates if f.meaning.part == "x" and triad_of(f) == triad_of(y))
                yield from ((x, y) for x in [f for f in beside if f.meaning.quantity == "speed" and f.seen.changes][:1])

    def _choose(self, judged: Sequence[tuple[float, str, Field]]) -> None:
        """Select the field with the highest score for its signal (score, signal, field), and record its rivals."""

        # The car's own sensor before that of a receiver, which may be the ground truth; a speed before the x of a
        # velocity, which is ahead in some axes only.
        def rank(judgement: tuple[float, str, Field]) -> tuple[object, ...]:
            score, _, f = judgement
            is_other = (f.role == "navigation", f.meaning.part, f.seen.is_off_centre)
            return -score, *is_other, -f.topic.messages, f.topic.name, f.path

        good = sorted((j for j in judged if j[0] >= 0.0), key=rank)
        if not good:
            return
        score, name, best = good[0]
        near = [f for s, n, f in good[1:] if s > score - LOG_ODDS["rival"] and n == name and not agree(best.si, f.si)]
        self._select(name, best, near)

    def _select(self, name: str, best: Field, rivals: Sequence[Field]) -> None:
        """Select a field for a signal, and record its rivals."""
        self.taken[name] = best
        if rivals:
            self.rivals.append((name, tuple(f"{f.topic.name}.{f.path}" for f in (best, *rivals))))

    def _turn_level(self) -> None:
        """Turn the axes of a level device by a quarter of a turn if its names are letters, as speeding up shows."""
        ax, speed, pieces = self.taken.get("ax_m_s2"), self._speed(), self.fields.pieces
        triad = [f for f in self.fields.candidates if ax is not None and triad_of(f) == triad_of(ax)]
        across = [f for f in triad if f.meaning.quantity == "acceleration" and f.meaning.part == "y"]
        if ax is None or speed is None or ax.fixed or not ax.is_axis or len(across) != 1:
            return
        ay, change = across[0], pieces.rate_of(speed.si)
        along, ahead = (fit(pieces.smooth(f.si), change) for f in (ax, ay))
        if not ahead.is_clear or abs(along.correlation) >= EVIDENCE["gravity"]["follows"]:
            return
        for name, item, factor in (("ax_m_s2", ay, ahead.slope), ("ay_m_s2", ax, -ahead.slope)):
            item.sign, item.is_turned = item.sign * math.copysign(1.0, factor), True
            item.doubts.append("the axes of its device are turned, as its accelerations and the motion show")
            self.taken[name] = item

    def _wheels(self, usable: Sequence[Field]) -> None:
        wheels = _wheel_set(usable)
        if len(wheels) < 2:
            return
        kind = self._wheel_unit([*wheels.values()])
        for corner, item in wheels.items():
            self.taken[f"wheel_speed_{corner}_{'rad_s' if kind == 'wheel rate' else 'm_s'}"] = item

    def _wheel_unit(self, wheels: Sequence[Field]) -> str:
        """Select the unit of wheel speeds by the speed, without one by a_y ≈ v r; return their quantity."""
        first, speed = wheels[0], self._chosen("speed_m_s")
        if first.unit_known or first.fixed:
            return first.meaning.quantity
        mean = mean_of([f.seen.cells for f in wheels])
        times, sigma, by = self._per_turning(mean), BY_DRIVING, "a_y ≈ v r"
        if speed is not None:
            times, sigma, by = ratio(mean, speed.si, SLOW_M_S), _RELATIONS["assumed_radius"], "the speed"
        units = [u for u in WHEEL_UNITS if first.meaning.quantity in ("wheel speed", u.quantity)]
        best, *others = _likely(units, Gain((1,), times, sigma), _UNITS["wheel_doubt"]) if times else units[:1]
        reasons = [f"{times:.4g} of it is 1 m/s by {by}"] if times else []
        doubt = f"it could be {' or '.join(u.name for u in others)} as well" if others else ""
        if not times:
            doubt = f"the unit of the wheel speeds is not given, and no speed to compare with; taken as {best.name}"
        elif not (doubt or speed is None or speed.unit_known):
            doubt = "the unit of the speed that they are compared with is unsure"
        for item in wheels:
            item.factors = ((best.name, best.factor / (_RADIUS_M if best.spread else 1.0)),)
            item.unit_known = not doubt
            item.reasons += reasons
            item.doubts += [doubt] if doubt else []
        return best.quantity

    def _per_turning(self, speed: FloatArray) -> float:
        """Return how much of a speed [M] in another unit is 1 m/s by a_y ≈ v r; 0 if the drive does not show it."""
        rate, ay = self._chosen("yaw_rate_rad_s"), self._chosen("ay_m_s2")
        relation = Fit() if rate is None or ay is None else self.fields.turning(ay.si, rate.si, speed)
        return 1.0 / abs(relation.slope) if relation.is_clear else 0.0

    # --------------------------------------------------------------------------------------------- steering

    def _steering(self, candidates: Sequence[Field]) -> None:
        speed, *turning = (self._speed(), self._chosen("yaw_rate_rad_s"), self._chosen("ay_m_s2"))
        # Wheel speeds are in their likeliest unit, rotational ones of usual wheels.
        spun = [f for n, f in self.taken.items() if n.startswith("wheel_speed")]
        wheels = [f.si * (_RADIUS_M if f.meaning.quantity == "wheel rate" else 1.0) for f in spun]
        pace = speed.si if speed is not None else mean_of(wheels) if wheels else None
        curvature = self.fields.curvature(pace, *(None if f is None else f.si for f in turning))
        judged: list[tuple[float, str, Field]] = []
        for item in candidates:
            if item.is_weak:
                self.notes.append(f"{item.topic.name}.{item.path} is not used: {item.doubts[-1]}")
                continue
            relation = Fit() if curvature is None else fit(self.fields.pieces.smooth(item.seen.cells), curvature)
            name, follows = self._steering_kind(item, relation)
            judged.append((item.log_odds + LOG_ODDS["curvature"] * follows, name, item))
        self._choose(judged)

    def _steer_by_command(self) -> None:
        """Without a measured angle, take a documented command, or one whose ratio to the curvature is an angle's."""
        commands = [f for f in self.fields.candidates if f.role == "command" and f.meaning.quantity == "steering"]
        if measured := [n for n in self.taken if n.startswith("steer")]:
            self._select(measured[0], self.taken[measured[0]], [f for f in commands if f.fixed])
            return
        for item in commands:
            item.evidence.append("command")
        self._steering([f for f in commands if f.seen.changes or f.fixed])

    def _steering_kind(self, item: Field, relation: Fit) -> tuple[str, bool]:
        """Return the signal for a steering angle, and whether it follows the car's turning as a usual one."""
        kinds = {"road": ("steer_rad",), "wheel": ("steering_wheel_rad",)}.get(item.meaning.part, tuple(_STEERING_M))
        if not relation.is_clear:
            return _steering_by_range(item, kinds, relation), False
        metres = abs(relation.slope)
        ways = [Unit(u, f / USUAL_LENGTH_M[k], k, _RELATIONS["length"]) for k in kinds for u, f in item.units]
        gain = Gain((1,), metres, BY_DRIVING, _RELATIONS["steering_broken"])
        likely = _likely(ways, gain, _UNITS["steering_doubt"])
        name, unit = likely[0].quantity, likely[0].name
        usual = metres * likely[0].factor
        low, high = _STEERING_M[name]
        if not low <= (length := usual * USUAL_LENGTH_M[name]) <= high:
            item.doubts.append(f"its ratio to the path's curvature is {length:.3g} m, which no car has in this unit")
            return kinds[0], False
        item.use(unit)
        item.reasons.append(f"ratio to the path's curvature {length:.3g} m: {name} in {unit}")
        if abs(math.log(usual)) < _RELATIONS["usual"]:
            item.doubts = [d for d in item.doubts if "a share" not in d]
        if likely[1:] and not item.fixed:
            item.doubts.append(f"it could be {likely[1].quantity} in {likely[1].name} as well")
        return name, True

    @property
    def open_signs(self) -> tuple[tuple[str, ...], ...]:
        """Return the signals with an unknown sign (documentation, name, mounting); signals of one axis as a group."""
        open_fields = {n: f for n, f in self.taken.items() if n in _SIGNED and _has_open_sign(f)}
        of_truth = ("truth.vy_m_s", "truth.yaw_rate_rad_s")
        open_fields |= {n: f for n, f in self.taken.items() if n in of_truth and not f.fixed}
        lateral, across = open_fields.get("ay_m_s2"), open_fields.get("truth.vy_m_s")
        groups: list[tuple[str, ...]] = [(n,) for n in open_fields]
        if lateral is not None and across is not None and _share_axis(lateral, across):
            groups = [g for g in groups if g not in (("ay_m_s2",), ("truth.vy_m_s",))]
            groups.append(("ay_m_s2", "truth.vy_m_s"))
        return tuple(groups)

    def _speed(self) -> Field | None:
        """Return the best speed to compare other signals with, selected or not."""
        return self._chosen("speed_m_s") or self.fields.best("speed") or self.true_speed

    def _chosen(self, name: str) -> Field | None:
        """Return the field of a signal that is selected or mapped."""
        return self.taken.get(name) or self.fields.anchors.get(name)

    # ------------------------------------------------------------------------------------------------ ground truth

    def choose_truth(self) -> dict[str, Field]:
        """Return the ground truth of the topic chosen by :func:`truth_topic`, by ``truth.NAME``."""
        if not self.truth_from:
            return {}
        its = [f for f in self.fields.candidates if f.topic.name == self.truth_from and f.section != "signals"]
        documented, named = (_truth_of(fields, self._kinship) for fields in ([f for f in its if f.fixed], its))
        # Documented fields have priority unless only names provide a sideslip (modules of a receiver).
        true = named if not documented or _SLIP & set(named) - set(documented) else documented
        if not true:
            return {}
        if (heading := self._heading()) is not None:
            true["yaw_rad"] = heading
        first = its[0]
        if first.role == "sensor" and true.get("yaw_rate_rad_s") is self.taken.get("yaw_rate_rad_s"):
            true.pop("yaw_rate_rad_s", None)  # the only gyro of a combined table is a sensor
        # Fields of ground truth are no inputs, except the speed of a navigation system without another speed.
        mine = set(map(id, true.values()))
        for signal in [n for n, f in self.taken.items() if id(f) in mine and n != "speed_m_s"]:
            if first.role != "navigation":
                del self.taken[signal]
        if first.role == "sensor":
            evidence = f"{first.topic.name} contains a sideslip, measured or estimated: its name does not give which"
            remedy = 'name it under [truth] in a mapping file, or --waive "truth.source"'
            self.checks.append(Check("truth.source", "truth", "undecided", evidence, remedy))
        self.notes.append(f"ground truth comes from {first.topic.name}, by the names of its fields")
        return {f"truth.{name}": item for name, item in true.items()}

    def _heading(self) -> Field | None:
        """Return the heading that turns as fast as the car, or None.

        Values of a full turn count clockwise from north, as a compass does; others have the sense of the yaw rate, and
        count from east if it is to the left.
        """
        rate = self._chosen("yaw_rate_rad_s")
        headings = [f for f in self.fields.candidates if f.meaning.quantity == "heading" and not f.fixed]
        for item in sorted(headings, key=lambda f: f.topic.name != self.truth_from):
            sense = 0.0 if rate is None else turns(self.fields.pieces, item.si, rate.si)
            is_compass = bool(np.nanmin(item.seen.values) >= 0.0) and item.seen.largest * item.scale > math.pi
            if sense and rate is not None and (is_compass or not _has_open_sign(rate)):
                item.sign = -1.0 if is_compass and not rate.fixed else sense
                item.offset = 0.0 if item.sign > 0.0 else math.pi / 2.0
                return item
        return None

    # ------------------------------------------------------------------------------------------------- reporting

    def tell(self, name: str, item: Field) -> None:
        """Add an undecided check for the doubts about a field; note a speed from the navigation system."""
        if item.role == "command":
            lacks = "actuator lag and steering play are missing"
            self.notes.append(f"{name} comes from the command {item.topic.name}, not from a measured angle: {lacks}")
        if item.role == "estimate":
            self.notes.append(f"{name} comes from the estimate {item.topic.name}.{item.path}, as no sensor gives it")
        if name == "speed_m_s" and item.role == "navigation":
            self.notes.append(
                f"speed_m_s comes from the navigation system's {item.topic.name}.{item.path}: "
                "if it is the ground truth too, the estimator's input is the true speed"
            )
        item.doubts += [*item.unit_doubt, *([CONSTANT] if item.is_steady else [])]
        if item.doubts:
            evidence = f"{item.topic.name}.{item.path} is taken, but {'; '.join(item.doubts)}"
            remedy = f'look at it (pdhef inspect --fields), name it in a mapping file, or --waive "{name}.candidate"'
            self.checks.append(Check(f"{name}.candidate", name, "undecided", evidence, remedy))

    def sources(self, section: Literal["signals", "truth"]) -> dict[str, SignalSource]:
        """Return the selected sources of a section."""
        return {c.source.name: c.source for c in self._selected if c.section == section}

    @property
    def _selected(self) -> list[Candidate]:
        names = ((n.removeprefix("truth."), n.startswith("truth."), f) for n, f in self.taken.items())
        return [f.candidate(name, "truth" if is_true else "signals", taken=True) for name, is_true, f in names]

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """All fields that may be a signal or ground truth, the selected and the surest first."""
        candidates, is_true = self._selected, any(n.startswith("truth.") for n in self.taken)
        used = {(c.section, c.source.label) for c in candidates}
        for item in self.fields.candidates:
            for name in names_of(item.meaning.quantity, item.meaning.part)[:1]:
                record = item.candidate(name, "signals", taken=False)
                if (record.section, record.source.label) not in used and (item.role != "truth"):
                    candidates.append(record)
            name = _truth_name(item)
            if name and item.role in ("truth", "navigation") and not is_true:
                candidates.append(item.candidate(name, "truth", taken=False))
        return tuple(sorted(candidates, key=lambda c: (not c.taken, -c.score)))


def _has_open_sign(item: Field) -> bool:
    """Return whether the sign of a field is unknown from documentation, name and mounting."""
    return not (item.fixed or item.is_downward) and (item.meaning.quantity == "steering" or not item.is_axis)


def _share_axis(first: Field, second: Field) -> bool:
    """Return whether two undocumented fields of one topic name their axis with the same word."""
    axes = (set(words_of(f.path)) & {"lat", "lateral", "trans", "y", "right"} for f in (first, second))
    return first.topic.name == second.topic.name and bool(set.intersection(*axes)) and not (first.fixed or second.fixed)


def _truth_of(candidates: Sequence[Field], kinship: Callable[[Field], int]) -> dict[str, Field]:
    """Return the ground truth quantities of one topic; empty without sideslip, lateral velocity or a position.

    Fields of one instrument are preferred (``kinship``).
    """
    truth: dict[str, Field] = {}
    along = {"lng", "long", "longitudinal", "forward"}
    for item in sorted(candidates, key=lambda f: (-kinship(f), -f.log_odds, along.isdisjoint(words_of(f.path)))):
        name = _truth_name(item)
        if name and item.seen.changes:
            truth.setdefault(name, item)
    if not {*_SLIP, "lat_deg"} & set(truth):
        return {}
    if {"vx_m_s", "vy_m_s"} <= set(truth):
        truth.pop("sideslip_rad", None)
    return truth


def _wheel_set(usable: Sequence[Field]) -> dict[str, Field]:
    """Return the wheels of the struct with most of them, or the wheels of separate structs."""
    sets: dict[tuple[str, str, str], dict[str, Field]] = {}
    for item in usable:
        if item.meaning.quantity in ("wheel speed", "wheel rate") and item.meaning.part in WHEELS:
            key = (item.topic.name, item.path.rpartition(".")[0], item.meaning.quantity)
            sets.setdefault(key, {}).setdefault(item.meaning.part, item)
    apart = {corner: f for group in sets.values() if len(group) == 1 for corner, f in group.items()}
    complete = [g for g in sets.values() if len(g) >= 2]
    return max(complete, key=lambda g: (len(g), sum(f.log_odds for f in g.values())), default=apart)


def _steering_by_range(item: Field, kinds: tuple[str, ...], relation: Fit) -> str:
    """Return the signal for a steering angle by the range of values, if the curvature is not conclusive."""
    name = kinds[-1] if item.seen.largest * item.factors[0][1] > 0.9 else kinds[0]
    if len(kinds) == 2 and not item.fixed:
        item.doubts.append(f"its name gives neither steering wheel nor road wheels; taken as {name}")
    if relation.correlation and not item.fixed:
        item.doubts.append(f"its correlation with the path's curvature is only {relation.correlation:.2f}")
    return name


def truth_topic(weighable: Sequence[Field]) -> str:
    """Return the topic with sideslip or lateral velocity, reference topics first; empty without one."""
    topics: dict[str, list[Field]] = {}
    for item in weighable:
        if item.role in ("truth", "navigation", "sensor"):
            topics.setdefault(item.topic.name, []).append(item)
    best, of = (0.0, ""), EVIDENCE["truth"]
    for name, fields in topics.items():
        kinds = {f.meaning.quantity for f in fields if f.seen.changes}
        worth = of["velocity"] * ("velocity" in kinds and "speed" in kinds) + of["sideslip"] * ("sideslip" in kinds)
        worth += of["named"] * (fields[0].role == "truth") + of["position"] * ("latitude" in kinds) if worth else 0.0
        if worth == 0.0 and fields[0].fixed and {"latitude", "longitude"} <= kinds:
            worth = of["documented_position"]
        if worth > best[0] and (fields[0].role != "sensor" or worth >= of["sideslip"] or fields[0].fixed):
            best = (worth, name)
    return best[1]


def _likely(units: Sequence[Unit], gain: Gain, least: float) -> Sequence[Unit]:
    """Return the likely units of a field with this gain, the likeliest first; ``least``: share of the highest one."""
    shares = posterior([units], [gain])
    return [units[i] for i in np.argsort(-shares) if shares[i] >= least * shares.max()]


def _truth_name(item: Field) -> str:
    if item.meaning.quantity in ("course", "heading") and not item.fixed:
        return ""
    return next(iter(names_of(item.meaning.quantity, item.meaning.part, _TRUTH)), "")
