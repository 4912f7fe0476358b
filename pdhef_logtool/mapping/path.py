"""How a car moved by its positions and headings: what needs no convention of signs and no unit of a sensor."""

from __future__ import annotations

import math

import numpy as np

from pdhef_logtool.mapping.evidence import CELL_NS
from pdhef_logtool.mapping.fields import Fields
from pdhef_logtool.records.signals import FloatArray

#: Half of the time over which a course is taken from positions, in cells.
_HALF = 5
#: Metres of a degree of latitude.
DEGREE_M = 111_200.0


def _path(fields: Fields) -> tuple[FloatArray, FloatArray] | None:
    """Return the steps north and east over a second, in m [M], of the first positions that move; None without any."""
    pairs = {"latitude": "longitude", "position": "position"}
    for north in (f for f in fields.positions if f.meaning.quantity in pairs and f.meaning.part in ("", "y")):
        wanted = (pairs[north.meaning.quantity], "x" if north.meaning.part else "")
        others = [f for f in fields.positions if (f.meaning.quantity, f.meaning.part) == wanted]
        same = [f for f in others if f.topic.name == north.topic.name]
        # Recorders of one number a topic have latitude and longitude apart.
        east = same[0] if same else others[0] if len(others) == 1 else None
        if east is None or not (north.seen.changes or east.seen.changes):
            continue
        up, right = _step(fields, north.si), _step(fields, east.si)
        if north.meaning.quantity == "latitude":
            up, right = up * DEGREE_M, right * DEGREE_M * math.cos(math.radians(float(np.nanmean(north.si))))
        if np.isfinite(up).any():
            return up, right
    return None


def path_turn(fields: Fields) -> FloatArray | None:
    """Return how fast the direction of the positions' path turns to the left, rad/s [M]; None without positions."""
    steps = _path(fields)
    if steps is None:
        return None
    moved = np.hypot(*steps)
    with np.errstate(invalid="ignore"):
        far = moved > 0.3 * float(np.nanquantile(moved, 0.9))
        return _turn_rate(fields, np.where(far, np.arctan2(*steps), np.nan))


def path_speed(fields: Fields) -> FloatArray | None:
    """Return the speed along the positions' path, m/s [M]; None without positions."""
    steps = _path(fields)
    return None if steps is None else np.hypot(*steps) / (2 * _HALF * CELL_NS * 1e-9)


def heading_turn(fields: Fields) -> FloatArray | None:
    """Return how fast a navigation system's heading turns to the left, rad/s but for its scale; None without one."""
    for item in fields.candidates:
        if item.meaning.quantity == "heading" and item.role == "navigation" and item.seen.changes:
            degrees = item.seen.largest > 7.0
            return -_turn_rate(fields, np.radians(item.seen.cells) if degrees else item.seen.cells)
    return None


def _step(fields: Fields, cells: FloatArray) -> FloatArray:
    rows = cells.reshape(len(fields.pieces.starts), -1)
    out = np.full_like(rows, np.nan)
    out[:, _HALF:-_HALF] = rows[:, 2 * _HALF :] - rows[:, : -2 * _HALF]
    return out.ravel()


def _turn_rate(fields: Fields, angle_rad: FloatArray) -> FloatArray:
    """Return the change of an angle a second [M], the short way round."""
    change = _step(fields, angle_rad)
    return np.asarray(np.angle(np.exp(1j * change)) / (2 * _HALF * CELL_NS * 1e-9))
