"""Velocities over ground: whether their axes are the earth's or the body's, and the speed as their length."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, TypeAlias

import numpy as np

from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.mapping.candidates import Field, anchors_of
from pdhef_logtool.mapping.evidence import FEWEST_CELLS, Fit, Pieces, Seen, fit, ratio
from pdhef_logtool.mapping.fields import CLEAR, PLACES, SLOW_M_S, Fields, path_speed, path_velocity
from pdhef_logtool.mapping.records import SignalSource
from pdhef_logtool.records.signals import FloatArray

#: Tolerance of its ratio to the speed from positions.
NEAR_PATH = 0.08
#: Speed over ground over that along the path if the axes are the earth's; share of the time that a body moves ahead.
SAME_STEPS, AHEAD_SHARE = (0.7, 1.4), 0.6
#: Axes of the x and y of a velocity; empty if the drive does not show them, "not ahead" if they are not the body's.
Axes: TypeAlias = Literal["east, north", "north, east", "body", "not ahead", ""]
#: Note on every speed that is a length.
NEVER_NEGATIVE = "the length of a velocity over ground, which is never negative: in reverse it has the wrong sign"


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
        if all(f is not None and f.correlation > CLEAR and SAME_STEPS[0] < f.slope < SAME_STEPS[1] for f in fits):
            return order
    length = np.hypot(x, y)
    moving = length > SLOW_M_S
    with np.errstate(invalid="ignore", divide="ignore"):
        turning = np.where(moving, (x * pieces.rate_of(y) - y * pieces.rate_of(x)) / length**2, np.nan)
    relation = None if rate is None else fit(pieces.smooth(rate), turning)
    sense = _sense(relation)
    if sense > 0.0:
        return "east, north"
    enough = np.count_nonzero(moving) >= FEWEST_CELLS
    # A car may reverse; without a path, a direction that is often opposite shows axes of the earth.
    ahead = x if steps is None else np.abs(x)
    is_ahead = not enough or bool(np.mean((ahead > np.abs(y))[moving]) >= AHEAD_SHARE)
    if sense < 0.0 and steps is None:  # in a slide the direction in the body's axes turns against the car, too
        return "" if is_ahead else "north, east"
    if not is_ahead:
        return "not ahead"
    return "" if relation is None else "body"


def _sense(relation: Fit | None) -> float:
    """Return the sign with which a direction turns with the yaw rate, rad/s or deg/s; 0 if unclear.

    The direction over ground turns as fast as the car; a sideslip that follows the yaw rate turns less.
    """
    if relation is None or abs(relation.correlation) <= CLEAR:
        return 0.0
    is_equal = any(SAME_STEPS[0] < relation.slope * unit < SAME_STEPS[1] for unit in (1.0, math.radians(1.0)))
    return math.copysign(float(is_equal or relation.slope < 0.0), relation.slope)


def twist_axes(log: DriveLog, velocity: SignalSource, references: Sequence[SignalSource]) -> Axes:
    """Return the axes of a velocity's first two fields by positions and a yaw rate among ``references``.

    A velocity with another size than that along the path is in an unknown unit: its axes are unknown, too.
    """
    pieces, read, fields, anchors = _read(log, (velocity, *references))
    x, y = (read.get((velocity.topic, path)) for path in velocity.paths[:2])
    if x is None or y is None:
        return ""
    path = path_speed(fields)
    times = None if path is None else ratio(path, np.hypot(x.cells, y.cells), SLOW_M_S)
    if times is not None and abs(times - 1.0) > NEAR_PATH:
        return ""
    rate = next((f.si for f in anchors if f.meaning.quantity == "rate"), None)
    return axes_of(pieces, x.cells, y.cells, path_velocity(fields), rate)


def _read(
    log: DriveLog, sources: Sequence[SignalSource]
) -> tuple[Pieces, dict[tuple[str, str], Seen], Fields, list[Field]]:
    """Read sources in a few pieces of a log; return also its positions and all sources as fields."""
    pieces = Pieces(log)
    requests: dict[str, list[str]] = {}
    for source in sources:
        requests.setdefault(source.topic, []).extend(source.paths)
    read = pieces.read(requests)
    anchors = anchors_of(log, sources, read)
    return pieces, read, Fields(pieces, {}, [], [f for f in anchors if f.meaning.quantity in PLACES]), anchors
