"""Speed of a car from its positions, independent of the units of its sensors."""

from __future__ import annotations

import math

import numpy as np

from pdhef_logtool.mapping.evidence import CELL_NS
from pdhef_logtool.mapping.fields import Fields
from pdhef_logtool.records.geometry import DEGREE_M
from pdhef_logtool.records.signals import FloatArray

#: Half of the window for a course from positions, in cells.
_HALF = 5
#: Quantities of positions.
PLACES = ("latitude", "longitude", "position")


def _path(fields: Fields) -> tuple[FloatArray, FloatArray] | None:
    """Return the steps north and east over a second, in m [M], of the first positions that change; None without any."""
    pairs = {"latitude": "longitude", "position": "position"}
    for north in (f for f in fields.positions if f.meaning.quantity in pairs and f.meaning.part in ("", "y")):
        wanted = (pairs[north.meaning.quantity], "x" if north.meaning.part else "")
        others = [f for f in fields.positions if (f.meaning.quantity, f.meaning.part) == wanted]
        same = [f for f in others if f.topic.name == north.topic.name]
        # Recorders with one number per topic store latitude and longitude in different topics.
        east = same[0] if same else others[0] if len(others) == 1 else None
        if east is None or not (north.seen.changes or east.seen.changes):
            continue
        up, right = _step(fields, north.si), _step(fields, east.si)
        if north.meaning.quantity == "latitude":
            up, right = up * DEGREE_M, right * DEGREE_M * math.cos(math.radians(float(np.nanmean(north.si))))
        if np.isfinite(up).any():
            return up, right
    return None


def path_velocity(fields: Fields) -> tuple[FloatArray, FloatArray] | None:
    """Return the velocity north and east along the path of positions, m/s [M]; None without positions."""
    steps = _path(fields)
    seconds = 2 * _HALF * CELL_NS * 1e-9
    return None if steps is None else (steps[0] / seconds, steps[1] / seconds)


def path_speed(fields: Fields) -> FloatArray | None:
    """Return the speed along the path of positions, m/s [M]; None without positions."""
    velocity = path_velocity(fields)
    return None if velocity is None else np.hypot(*velocity)


def _step(fields: Fields, cells: FloatArray) -> FloatArray:
    rows = cells.reshape(len(fields.pieces.starts), -1)
    out = np.full_like(rows, np.nan)
    out[:, _HALF:-_HALF] = rows[:, 2 * _HALF :] - rows[:, : -2 * _HALF]
    return out.ravel()
