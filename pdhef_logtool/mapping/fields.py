"""Fields of a log during the evaluation of candidates: look-ups, relations, the path, and units that no name gives.

Units have a posterior, given gravity, other speeds, a_x ≈ v̇ and a_y ≈ v r.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pdhef_logtool.mapping.candidates import Field, leaf_group, place_of, triad_of
from pdhef_logtool.mapping.evidence import EVIDENCE, Fit, Pieces, fit, ratio, spread
from pdhef_logtool.mapping.naming import VOCABULARY
from pdhef_logtool.records.geometry import DEGREE_M, GRAVITY_M_S2
from pdhef_logtool.records.signals import FloatArray

_RELATIONS, _UNITS, _GRAVITY, _GROUND = (EVIDENCE[name] for name in ("relations", "units", "gravity", "ground"))
SLOW_M_S: float = _RELATIONS["slow_m_s"]
SAME: float = _RELATIONS["same"]
BY_DRIVING: float = _RELATIONS["driving"]
#: Usual lengths that convert curvature to an angle: a wheelbase, times a steering ratio for the steering wheel.
USUAL_LENGTH_M: dict[str, float] = _RELATIONS["wheelbase_m"]
#: Quantities of positions.
PLACES = ("latitude", "longitude", "position")


@dataclass(slots=True)
class Fields:
    """Candidates, mapped sources (``anchors``, by signal) and positions, on one time grid."""

    pieces: Pieces
    anchors: dict[str, Field]
    candidates: list[Field]
    positions: list[Field]

    def all(self, quantity: str, part: str | None = None) -> list[Field]:
        """Return anchors and candidates of a quantity, the surest first."""
        every = [f for f in (*self.anchors.values(), *self.candidates) if f.meaning.quantity == quantity]
        every = [f for f in every if f.role not in ("command", "estimate", "truth")]
        return sorted((f for f in every if part is None or f.meaning.part == part), key=lambda f: -f.log_odds)

    def open(self, quantity: str, part: str | None = None) -> list[Field]:
        """Return the fields of a quantity and part that are not constant."""
        return [f for f in self.all(quantity, part) if f.seen.changes]

    def best(self, quantity: str) -> Field | None:
        """Return the surest field of a quantity that is not constant."""
        return next(iter(self.open(quantity)), None)

    def turning(self, ay: FloatArray, rate: FloatArray, speed: FloatArray) -> Fit:
        """Fit a_y to v r; no relation if the car does not turn."""
        expected = rate * speed
        turns = spread(expected) > _RELATIONS["excited_m_s2"]
        return fit(self.pieces.smooth(ay), self.pieces.smooth(expected)) if turns else Fit()

    def curvature(
        self, speed: FloatArray | None, rate: FloatArray | None, ay: FloatArray | None = None
    ) -> FloatArray | None:
        """Return the path's curvature while moving, 1/m [M], by yaw rate or else a_y; None if the path is straight."""
        if speed is None or not np.isfinite(speed).any():
            return None
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            turning = ay / speed if rate is None and ay is not None else rate
            moving = speed > max(SLOW_M_S, _RELATIONS["moving_share"] * float(np.nanquantile(speed, 0.95)))
            curve = None if turning is None else self.pieces.smooth(np.where(moving, turning / speed, np.nan))
        return curve if curve is not None and spread(curve) > _RELATIONS["excited_1_m"] else None


def agree(a: FloatArray, b: FloatArray) -> bool:
    """Return whether two fields on the grid [M] have the same values."""
    relation = fit(a, b)
    low, high = _RELATIONS["same_ratio"]
    return bool(relation.correlation > _RELATIONS["same_correlation"] and low < relation.slope < high)


def mean_of(columns: Sequence[FloatArray]) -> FloatArray:
    """Return the mean over the columns [M] that are finite in each cell."""
    stacked = np.stack(columns)
    finite = np.isfinite(stacked)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(finite, stacked, 0.0).sum(axis=0) / finite.sum(axis=0))


# ------------------------------------------------------------------------------------------------ path


def path_velocity(pieces: Pieces, positions: Sequence[Field]) -> tuple[FloatArray, FloatArray] | None:
    """Return the velocity north and east, m/s [M], along the first positions that change; None without any."""
    pairs = {"latitude": "longitude", "position": "position"}
    for north in (f for f in positions if f.meaning.quantity in pairs and f.meaning.part in ("", "y")):
        wanted = (pairs[north.meaning.quantity], "x" if north.meaning.part else "")
        others = [f for f in positions if (f.meaning.quantity, f.meaning.part) == wanted]
        same = [f for f in others if f.topic.name == north.topic.name]
        # Recorders with one number per topic store latitude and longitude in different topics.
        east = same[0] if same else others[0] if len(others) == 1 else None
        if east is None or not (north.seen.changes or east.seen.changes):
            continue
        # Over a time that is long against the resolution of positions.
        up, right = (pieces.rate_of(f.si, _GROUND["half_window"]) for f in (north, east))
        if north.meaning.quantity == "latitude":
            up, right = up * DEGREE_M, right * DEGREE_M * math.cos(math.radians(float(np.nanmean(north.si))))
        if np.isfinite(up).any():
            return up, right
    return None


# ------------------------------------------------------------------------------------------------ units


class Unit(NamedTuple):
    """A unit of a field. ``factor`` to SI, with the 1-sigma ``spread`` of its logarithm; ``energy``: -ln prior odds."""

    name: str
    factor: float
    quantity: str = ""
    spread: float = 0.0
    energy: float = 0.0


class Gain(NamedTuple):
    """A measured gain that is 1, but for a factor of 1-sigma ``sigma``, in the right units of some fields.

    ``powers``: exponents of the fields' factors in the gain. ``broken``: probability that the relation does not apply.
    """

    powers: tuple[int, ...]
    gain: float
    sigma: float
    broken: float = _RELATIONS["broken"]


def posterior(units: Sequence[Sequence[Unit]], gains: Sequence[Gain]) -> FloatArray:
    """Return the probabilities [K_1, K_2, ...] of the combinations of the K_i units of each field i.

    The logarithm of a gain is normal; if its relation does not apply, it is uniform over a range of four. The
    probabilities sum to less than 1: the rest is the probability that a relation does not apply.
    """
    grids = np.meshgrid(*(range(len(ways)) for ways in units), indexing="ij")
    factors, spreads, energies = (
        [np.array([getattr(u, name) for u in ways])[grid] for ways, grid in zip(units, grids, strict=True)]
        for name in ("factor", "spread", "energy")
    )
    applies = total = np.exp(-np.sum(energies, axis=0))
    for gain in gains:
        off, variance = math.log(abs(gain.gain)), gain.sigma**2
        for factor, width, power in zip(factors, spreads, gain.powers, strict=True):
            off, variance = off + power * np.log(factor), variance + (power * width) ** 2
        density = (1.0 - gain.broken) * np.exp(-(off**2) / (2.0 * variance)) / np.sqrt(2.0 * np.pi * variance)
        applies, total = applies * density, total * (density + _RELATIONS["broken_density"] * gain.broken)
    return np.asarray(applies / total.sum())


def settle(items: Sequence[Field], gains: Sequence[Gain], by: str, *evidence: str) -> None:
    """Select the units that are certain given these gains; they are ``evidence`` for fields with an uncertain name."""
    if not gains:
        return
    joint = posterior([[Unit(*u, energy=_UNITS["rare"].get(u[0], 0.0)) for u in f.units] for f in items], gains)
    for axis, item in enumerate(items):
        share = joint.sum(axis=tuple(i for i in range(joint.ndim) if i != axis))
        if share.max() < _UNITS["certain"] or item.fixed:
            continue
        if not item.unit_known:
            item.use(item.units[int(share.argmax())][0])
            item.reasons.append(f"unit {item.factors[0][0]} by {by}")
        item.evidence += evidence if item.log_odds < 0.0 else ()


def decide_units(fields: Fields) -> None:
    """Determine units that no name gives: by gravity first, then by relations between quantities."""
    _by_gravity(fields)
    _speeds(fields)
    _by_speeding_up(fields)
    _by_turning(fields)
    _by_track(fields)
    _by_siblings(fields)


def _by_gravity(fields: Fields) -> None:
    groups: dict[str, dict[str, Field]] = {}
    for item in fields.candidates:
        if item.meaning.quantity == "acceleration" and item.meaning.part != "ahead" and item.is_axis:
            groups.setdefault(triad_of(item), {})[item.meaning.part] = item
    for axes in groups.values():
        if set(axes) in ({"z"}, set("xyz")):
            means = {axis: float(np.nanmean(f.seen.values)) for axis, f in axes.items()}
            size = math.hypot(*means.values())
            for item in axes.values() if size > 0.0 else ():
                settle((item,), [Gain((1,), size / GRAVITY_M_S2, SAME)], f"gravity, of which {size:.4g} is the mean")
            up = max(means, key=lambda axis: abs(means[axis]))
            is_upright = abs(means[up]) > _GRAVITY["upright"] * size
            if (
                len(means) > 1
                and is_upright
                and abs(size * axes["z"].scale / GRAVITY_M_S2 - 1.0) < _GRAVITY["near_1_g"]
            ):
                _turn(fields, axes, f"{'-' if means[up] < 0.0 else '+'}{up}")
    # Beside an accelerometer, an acceleration without gravity is computed from it, or is of the earth's axes.
    sensing = {item.topic.name for item in fields.candidates if item.has_gravity}
    for item in (f for f in fields.candidates if f.topic.name in sensing and not f.has_gravity):
        item.evidence += ["no_gravity"] * (item.meaning.quantity == "acceleration" and item.is_axis)


def _turn(fields: Fields, axes: dict[str, Field], up: str) -> None:
    """Turn an inertial sensor's axes to the car's by the usual mounting for this axis upward; the drive checks it."""
    for item in axes.values():
        item.has_gravity = True
    usual, place = VOCABULARY["mountings"].get(up, {}), place_of(axes["x"])
    rates = [f for f in fields.candidates if f.meaning.quantity == "rate" and f.is_axis and place_of(f) == place]
    for item in (f for f in (*axes.values(), *rates) if f.meaning.part in usual and not (f.fixed or f.is_downward)):
        part, sign = usual[item.meaning.part]
        item.meaning, item.is_turned, item.sign = replace(item.meaning, part=part), True, sign
        item.doubts.append(f"gravity is along {up} of its device, read as that of {usual['text']}")


def _speeds(fields: Fields) -> None:
    """Determine the units of speeds by a known speed and by positions."""
    settled = [f for f in fields.all("speed") if f.unit_known or f.fixed]
    reference = max(settled, key=lambda f: f.log_odds, default=None)
    velocity = path_velocity(fields.pieces, fields.positions)
    along_path = [] if velocity is None else [np.hypot(*velocity)]
    for item in (f for f in fields.candidates if f.meaning.quantity == "speed"):
        others = along_path + ([] if reference is None or reference is item else [reference.si])
        times = [ratio(other, item.seen.cells, SLOW_M_S) for other in others]
        settle((item,), [Gain((1,), 1.0 / x, SAME) for x in times if x > 0.0], "other speeds")


def _by_speeding_up(fields: Fields) -> None:
    """Determine by a_x ≈ v̇ the units of speeds and of a_x, and whether an acceleration without an axis is a_x."""
    along = fields.open("acceleration", "x") + fields.open("acceleration", "ahead")
    for speed, ax in itertools.product(fields.open("speed"), along):
        relation = fit(fields.pieces.smooth(ax.seen.cells), fields.pieces.rate_of(speed.seen.cells))
        if relation.is_clear and relation.slope > 0.0:
            settle((ax, speed), [Gain((1, -1), relation.slope, BY_DRIVING)], "a_x ≈ v̇", "relation")
            if ax.meaning.part == "ahead":
                ax.meaning = replace(ax.meaning, part="x")
                ax.evidence.append("no_axis")
                ax.doubts.append("its name gives no axis; it follows the derivative of the speed")


def _by_turning(fields: Fields) -> None:
    """Determine the units of a_y, yaw rate and speed by a_y ≈ v r."""
    speed = fields.best("speed")
    if speed is None:
        return
    for rate, ay in itertools.product(fields.open("rate", "z")[:4], fields.open("acceleration", "y")[:4]):
        relation = fields.turning(*(f.seen.cells for f in (ay, rate, speed)))
        if relation.is_clear:
            settle((ay, rate, speed), [Gain((1, -1, -1), relation.slope, BY_DRIVING)], "a_y ≈ v r", "relation")


def _by_track(fields: Fields) -> None:
    """Determine the unit of the speed by the track with which wheel speeds of this unit differ in bends."""
    speed, rate = fields.best("speed"), fields.best("rate")
    wheels = [f.seen.cells for side in ("rl", "rr") for f in fields.open("wheel speed", side)[:1]]
    if speed is None or rate is None or len(wheels) < 2 or not agree(wheels[1], speed.seen.cells):
        return
    relation = fit(fields.pieces.smooth(wheels[1] - wheels[0]), fields.pieces.smooth(rate.seen.cells))
    if relation.is_clear:
        gain = Gain((1, -1), relation.slope / _RELATIONS["track_m"], _RELATIONS["track"])
        settle((speed, rate), [gain], "the track of its wheels")


def _by_siblings(fields: Fields) -> None:
    """Use the unit of other accelerations, or velocities, of the same message."""
    for kinds in ({"acceleration"}, {"speed", "velocity"}):
        certain = [f for f in fields.candidates if f.meaning.quantity in kinds and f.unit_known]
        settled = {leaf_group(f): f for f in certain} | {triad_of(f): f for f in certain}
        mine = [f for f in fields.candidates if f.meaning.quantity in kinds and f.is_named and not f.unit_known]
        for item in (f for f in mine if leaf_group(f) in settled):
            other = settled.get(triad_of(item), settled[leaf_group(item)])
            same = [u for u, s in item.factors if math.isclose(s, other.factors[0][1], rel_tol=1e-6)]
            if same:
                item.use(same[0])
                item.reasons.append(f"unit {same[0]} as of {other.path}")
