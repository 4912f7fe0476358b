"""Determine units that no name gives: by gravity, by other speeds and by a_y ≈ v r."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from pdhef_logtool.mapping.candidates import LEAST_SCORE, Field, leaf_group, triad_of
from pdhef_logtool.mapping.evidence import fit, ratio
from pdhef_logtool.mapping.fields import CLEAR, Fields
from pdhef_logtool.mapping.naming import G_M_S2
from pdhef_logtool.mapping.path import path_speed
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.signals import FloatArray

#: Accepted range of the slope of a_y over v r.
SLOPES = (0.7, 1.4)
#: Radii of wheels, of model cars to lorries.
RADII_M = (0.02, 0.7)
#: Smaller raw speeds give no information on the unit.
SLOWEST = 1.0
#: Minimum share of gravity along +z of an upright sensor.
MOST_TILTED = 0.9
#: Words in names of filtered or derived copies of a sensor.
_SECOND_CHOICE = ("raw", "uncomp", "delta", "error", "offset", "relative")


def decide_units(fields: Fields) -> None:
    """Determine units that no name gives: by gravity first, then by relations between quantities."""
    _by_gravity(fields)
    _rank(fields)
    _speeds(fields)
    _by_speeding_up(fields)
    _by_turning(fields)
    _by_siblings(fields)


def _by_gravity(fields: Fields) -> None:
    groups: dict[str, dict[str, Field]] = {}
    for item in fields.candidates:
        if item.meaning.quantity == "acceleration" and item.is_axis:
            groups.setdefault(triad_of(item), {})[item.meaning.part] = item
        elif item.meaning.quantity == "acceleration" and item.meaning.part == "z":  # named vertical, without a triad
            _use_gravity(item, float(np.nanmean(item.seen.values)), [item])
    for axes in groups.values():
        if set(axes) != set("xyz"):
            continue
        means = np.array([np.nanmean(axes[a].seen.values) for a in "xyz"])
        size = float(np.linalg.norm(means))
        _say_mounting(fields, axes["z"], means / size if size > 0.0 else means)
        _use_gravity(axes["z"], size, [*axes.values()])


def _use_gravity(z: Field, size: float, axes: Sequence[Field]) -> None:
    """Select the unit of accelerations in which their mean of this size is gravity."""
    for item in axes:
        near = [u for u, s in item.factors if abs(abs(size) * s / G_M_S2 - 1.0) < 0.08]
        if near and not (item.unit_known or item.fixed):
            item.use(near[0])
            item.reasons.append(f"gravity: the mean of {triad_of(z)} is {size:.4g}, so it is in {near[0]}")


def _say_mounting(fields: Fields, z: Field, gravity: FloatArray) -> None:
    """Report an accelerometer with named axes and gravity not along +z: its axes differ from the car's."""
    if not z.fixed and z.role not in ("command", "estimate", "truth"):
        fields.checks += mounting_checks(gravity, triad_of(z))


def mounting_checks(gravity: FloatArray, where: str) -> list[Check]:
    """Return the check of a sensor with gravity [3], a unit vector, elsewhere than along its +z; empty for others."""
    along = int(np.argmax(np.abs(gravity)))
    if gravity[2] > MOST_TILTED or not np.abs(gravity[along]) > 0.0:
        return []
    sense = "-" if gravity[along] < 0.0 else "+"
    evidence = f"gravity is along {sense}{'xyz'[along]} of {where}, not along +z: its axes are not the car's"
    remedy = 'turn them in a mapping file, or --waive "imu.mounting"'
    return [Check("imu.mounting", "ay_m_s2", "undecided", evidence, remedy)]


def _rank(fields: Fields) -> None:
    """Prefer fields of messages with both accelerations and rates, and a sensor over its copies."""
    kinds: dict[tuple[str, str], set[str]] = {}
    for item in fields.candidates:
        kinds.setdefault(leaf_group(item), set()).add(item.meaning.quantity)
    for item in fields.candidates:
        if item.meaning.quantity in ("acceleration", "rate") and kinds[leaf_group(item)] >= {"acceleration", "rate"}:
            item.bonus += 0.1
        if any(w in item.path.lower() for w in _SECOND_CHOICE):
            item.bonus -= 0.15


def _speeds(fields: Fields) -> None:
    """Determine the units of speeds by a known speed, by positions, then by a_x."""
    settled = [f for f in fields.all("speed") if f.unit_known or f.fixed]
    reference = max(settled, key=lambda f: f.score, default=None)
    path = path_speed(fields)
    for item in fields.all("speed"):
        if reference is not None and item is not reference:
            times = ratio(reference.si, item.seen.cells, SLOWEST)
            fields.settle(item, times or 0.0, f"{reference.path} of {reference.topic.name}", 0.08)
        if path is not None:
            fields.settle(item, ratio(path, item.seen.cells, SLOWEST) or 0.0, "the positions' speed", 0.12)


def _by_speeding_up(fields: Fields) -> None:
    """Determine the units of speeds and of a_x by a_x ≈ v̇, if exactly one combination fits."""
    for speed, ax in itertools.product(fields.open("speed"), fields.open("acceleration", "x")):
        factors = [f.factors[:1] if f.unit_known or f.fixed else f.factors for f in (ax, speed)]
        # With two unknown units, x of a vector is ambiguous: it may be in the world frame.
        if len(factors[0]) > 1 < len(factors[1]) and speed.is_axis and speed.meaning.part == "x":
            continue
        relation = fit(fields.pieces.smooth(ax.seen.cells), fields.pieces.rate_of(speed.seen.cells))
        if relation is None or relation.correlation < CLEAR:
            continue
        near = [u for u in itertools.product(*factors) if abs(relation.slope * u[0][1] / u[1][1] - 1.0) < 0.25]
        for item, (unit, _) in zip((ax, speed), near[0], strict=True) if len(near) == 1 else ():
            if not (item.unit_known or item.fixed):
                item.use(unit)
                item.reasons.append(f"unit {unit} by a_x ≈ v̇")


def _by_turning(fields: Fields) -> None:
    """Determine the units of a_y, yaw rate and speed by a_y ≈ v r, if exactly one combination fits."""
    speed = fields.best("speed") or fields.wheel_mean()
    if speed is None:
        return
    for rate in fields.open("rate", "z")[:4]:
        for ay in fields.open("acceleration", "y")[:4]:
            trio = (ay, rate, speed)
            units = () if all(f.unit_known for f in trio) else _units_of_turning(fields, trio)
            for item, unit in zip(trio, units, strict=False):
                if not item.unit_known and not item.fixed:
                    item.use(unit)
                    item.reasons.append(f"unit {unit} by a_y ≈ v r")
                    item.bonus += 0.3 if item.score < LEAST_SCORE else 0.0


def _units_of_turning(fields: Fields, trio: tuple[Field, Field, Field]) -> tuple[str, ...]:
    """Return the units of a_y, yaw rate and speed with a slope near 1; empty unless they are unique."""
    fits = []
    for units in itertools.product(*(f.factors[:1] if f.unit_known or f.fixed else f.factors for f in trio)):
        relation = fields.turning(*(f.seen.cells * factor for f, (_, factor) in zip(trio, units, strict=True)))
        if relation is not None and abs(relation.correlation) > CLEAR and SLOPES[0] < abs(relation.slope) < SLOPES[1]:
            fits.append(units)
    # Combinations that differ only in the unit of a_y: the conventional unit is first.
    return tuple(unit for unit, _ in fits[0]) if fits and all(f[1:] == fits[0][1:] for f in fits) else ()


def _by_siblings(fields: Fields) -> None:
    """Use the unit of other accelerations, or velocities, of the same message."""
    for kinds in ({"acceleration"}, {"speed", "velocity"}):
        settled = {leaf_group(f): f for f in fields.candidates if f.meaning.quantity in kinds and f.unit_known}
        mine = (f for f in fields.candidates if f.meaning.quantity in kinds and f.meaning.strength > 0.6)
        for item in [f for f in mine if not f.unit_known and leaf_group(f) in settled]:
            other = settled[leaf_group(item)]
            same = [u for u, s in item.factors if math.isclose(s, other.factors[0][1], rel_tol=1e-6)]
            if same:
                item.use(same[0])
                item.reasons.append(f"unit {same[0]} as of {other.path}")
