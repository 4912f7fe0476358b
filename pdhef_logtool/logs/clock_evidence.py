"""The unit of a clock without a stated one, by motion: the path of the positions against the integral of the speed."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from pdhef_logtool.logs.constants import CONSTANTS
from pdhef_logtool.records.geometry import DEGREE_M
from pdhef_logtool.records.signals import IntArray

_MOTION: Mapping[str, Any] = CONSTANTS["clocks"]["motion"]


def decades_too_short(columns: Mapping[str, Any], rows: IntArray, stamps: IntArray) -> int:
    """Return n if times have to be multiplied by 10**n so that speed and path agree; 0 without evidence.

    Units of speed, from m/s to km/h, shorten the ratio of the path to the integral by up to 0.56 decades.

    Parameters
    ----------
    columns : numbers [N] by name in lower case; positions in degrees, speed in any usual unit.
    rows, stamps : rows with a time [K], and their times [K] in ns.
    """
    latitude, longitude, speed = (
        next((c for n, c in columns.items() if re.fullmatch(_MOTION[name], n) and isinstance(c, np.ndarray)), None)
        for name in ("latitude", "longitude", "speed")
    )
    if latitude is None or longitude is None or speed is None:
        return 0
    used = np.isfinite(latitude[rows]) & np.isfinite(longitude[rows]) & (latitude[rows] != 0.0)
    rows, stamps = rows[used], stamps[used]
    # Long steps average the noise of the positions.
    corners = rows[:: max(1, len(rows) // _MOTION["steps"])]
    north, east = np.diff(latitude[corners]), np.diff(longitude[corners]) * np.cos(np.radians(latitude[corners[1:]]))
    path_m = DEGREE_M * float(np.hypot(north, east).sum())
    length = float(np.nansum(np.abs(speed[rows[1:]]) * np.diff(stamps) * 1e-9))
    is_moving = _MOTION["shortest_path_m"] < path_m < _MOTION["longest_path_m"] and length > 0.0
    return math.ceil(math.log10(path_m / length) - _MOTION["noise_decades"]) if is_moving else 0
