"""The unit of a clock without a stated one, by motion: the path of the positions against the integral of the speed."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from pdhef_logtool.records.signals import BoolArray, IntArray

_LATITUDE, _LONGITUDE = (
    re.compile(r"(?:.*_)?lat(?:itude)?(?:_deg)?"),
    re.compile(r"(?:.*_)?(?:lon|lng|longitude)(?:_deg)?"),
)
_SPEED = re.compile(r"(?:.*_)?(?:speed|velocity|geschwindigkeit|v)(?:_(?:mps|m_s|kmh|km_h|kph|mph|kn|knots))?")
_METRES_PER_DEGREE = 111_195.0
#: Steps of the path: longer ones average the noise of the positions.
_STEPS = 400
_SHORTEST_PATH_M = 100.0
#: Decades by which noise may lengthen the path. Units of speed (m/s to km/h) shorten its ratio by up to 0.56 decades.
_NOISE = 0.2


def decades_too_short(columns: Mapping[str, Any], stamps: IntArray, has_time: BoolArray) -> int:
    """Return n if times [N] in ns have to be multiplied by 10**n so that speed and path agree; 0 without evidence.

    Parameters
    ----------
    columns : numbers [N] by name in lower case; positions in degrees, speed in any usual unit.
    """
    names = {n: c for n, c in columns.items() if isinstance(c, np.ndarray) and c.dtype.kind in "iuf" and c.ndim == 1}
    latitude, longitude = (next((names[n] for n in names if p.fullmatch(n)), None) for p in (_LATITUDE, _LONGITUDE))
    if latitude is None or longitude is None:
        return 0
    rows = np.flatnonzero(has_time & np.isfinite(latitude) & np.isfinite(longitude) & (latitude != 0.0))
    if len(rows) < 2 or np.abs(latitude[rows]).max() > 90.0:
        return 0
    at = rows[:: max(1, len(rows) // _STEPS)]
    north, east = np.diff(latitude[at]), np.diff(longitude[at]) * np.cos(np.radians(latitude[at[1:]]))
    path_m = _METRES_PER_DEGREE * float(np.hypot(north, east).sum())
    if path_m < _SHORTEST_PATH_M:
        return 0
    steps_s = np.diff(stamps[rows]) * 1e-9
    ways = [float(np.nansum(np.abs(c[rows[1:]]) * steps_s)) for n, c in names.items() if _SPEED.fullmatch(n)]
    votes = Counter(math.ceil(math.log10(path_m / way) - _NOISE) for way in ways if way > 0.0)
    (decades, count), *_ = votes.most_common(1) or [(0, 1)]
    return decades if 2 * count > len(ways) else 0
