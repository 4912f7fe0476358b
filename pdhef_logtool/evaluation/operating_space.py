"""Operating space of a drive: duration and sideslip error by cell of a fixed grid of speed and lateral acceleration.

Lateral acceleration and speed are as for segments (:mod:`~pdhef_logtool.evaluation.segments`): from ground truth if it
contains them, otherwise from the sensors; the acceleration is smoothed to 1 Hz. The grid is the same for all drives, so
that cells of a fleet can be added.
"""

from typing import Any

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.evaluation.dead_reckoned import MAX_STEP_S
from pdhef_logtool.evaluation.segments import MANOEUVRE_SMOOTHING_HZ, driven_speed, taken
from pdhef_logtool.evaluation.smoothing import median_step_ns, smooth
from pdhef_logtool.evaluation.track_errors import signal_error
from pdhef_logtool.records.signals import S_PER_NS, Signals
from pdhef_logtool.records.tracks import StateTrack

#: Lower edges of the cells; the last cell has no upper edge. 60 m/s are 216 km/h.
SPEED_EDGES_M_S = tuple(float(5 * i) for i in range(13))
AY_EDGES_M_S2 = tuple(float(i) for i in range(13))

#: Entries of a cell with data.
_CELL = ("speed", "ay", "seconds", "scored", "sideslip_mse_rad2")


def operating_space(
    signals: Signals, truth: StateTrack | None, estimate: StateTrack | None, vehicle: VehicleParameters
) -> dict[str, Any]:
    """Return the operating space of a drive, as the entry of report.json.

    ``cells`` with data in order, each with the indices of its lower edges (``speed``, ``ay``), the duration, and the
    number of stamps in the mean squared sideslip error of the selected estimate, which is NaN without any; highest
    speed and abs a_y (None: unknown), median friction, the grid.

    Parameters
    ----------
    signals, truth, estimate : at the same stamps [N]; without ground truth or estimate, the error is NaN.
    """
    shape = len(SPEED_EDGES_M_S), len(AY_EDGES_M_S2)
    size = shape[0] * shape[1]
    stamps = signals.stamps_ns
    step_ns = median_step_ns(stamps)
    speed, lateral = driven_speed(signals, truth), taken(signals, truth, "ay_m_s2")
    ay = np.abs(smooth(stamps, lateral, MANOEUVRE_SMOOTHING_HZ, step_ns))
    steps = np.diff(stamps, append=stamps[-1:]) * S_PER_NS
    steps = np.minimum(np.where(steps > 0.0, steps, step_ns * S_PER_NS), MAX_STEP_S)
    finite = np.isfinite(speed) & np.isfinite(ay)
    i = np.searchsorted(SPEED_EDGES_M_S, speed[finite], side="right") - 1
    j = np.searchsorted(AY_EDGES_M_S2, ay[finite], side="right") - 1
    cell = np.maximum(i, 0) * shape[1] + j
    seconds = np.bincount(cell, weights=steps[finite], minlength=size)
    counts, squares = np.zeros(size, dtype=np.int64), np.zeros(size)
    if truth is not None and estimate is not None:
        error = signal_error(estimate, truth, "sideslip_rad", vehicle.low_speed_blend_m_s)[finite]
        scored = np.isfinite(error)
        counts = np.bincount(cell[scored], minlength=size)
        squares += np.bincount(cell[scored], weights=error[scored] ** 2, minlength=size)
    with np.errstate(invalid="ignore"):
        errors = squares / counts
    cells = [
        dict(zip(_CELL, (*divmod(int(i), shape[1]), *(c[i].item() for c in (seconds, counts, errors))), strict=True))
        for i in np.flatnonzero(seconds)
    ]
    friction = signals.friction[np.isfinite(signals.friction)]
    everywhere = np.where(np.isfinite(speed), speed, signals.speed_m_s)  # ground truth may end before the drive
    top_speed, top_ay = (float(np.nanmax(c)) if np.isfinite(c).any() else None for c in (everywhere, ay))
    usual = float(np.median(friction)) if friction.size else vehicle.assumed_friction
    edges = {"speed_edges_m_s": SPEED_EDGES_M_S, "ay_edges_m_s2": AY_EDGES_M_S2}
    return {"cells": cells, "speed_max_m_s": top_speed, "ay_max_m_s2": top_ay, "friction_median": usual, **edges}
