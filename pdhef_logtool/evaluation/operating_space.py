"""Where a drive went in speed and lateral acceleration: seconds and sideslip error by cell of a fixed grid.

Lateral acceleration and speed are those of the segments (:mod:`~pdhef_logtool.evaluation.segments`): of ground truth
where it has them, else of the sensors, the acceleration smoothed to 1 Hz. The grid is the same for all drives, so that
the cells of a fleet add up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.evaluation.blocks import blocks_with_halo, median_step_ns
from pdhef_logtool.evaluation.metrics import signal_error
from pdhef_logtool.evaluation.segments import MANOEUVRE_SMOOTHING_HZ, known_of, speed_and_ay
from pdhef_logtool.evaluation.smoothing import RUN_GAP_S, reach_rows, smooth
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack

#: Lower edges of the cells; what is beyond the last one lies in the last cell. 60 m/s are 216 km/h.
SPEED_EDGES_M_S = tuple(float(5 * i) for i in range(13))
AY_EDGES_M_S2 = tuple(float(i) for i in range(13))
#: A longer step between stamps counts as this long.
MAX_STEP_S = 0.2


@dataclass(frozen=True, slots=True)
class Cell:
    """A cell of the grid that the drive was in.

    ``speed`` and ``ay`` number its lower edges; ``scored`` stamps of it have the mean squared sideslip error of the
    selected estimate, NaN without one.
    """

    speed: int
    ay: int
    seconds: float
    scored: int
    sideslip_mse_rad2: float


@dataclass(frozen=True, slots=True)
class OperatingSpace:
    """The cells that a drive was in, in order, the grid, and the median friction of the drive."""

    cells: Sequence[Cell]
    friction_median: float
    speed_edges_m_s: Sequence[float] = SPEED_EDGES_M_S
    ay_edges_m_s2: Sequence[float] = AY_EDGES_M_S2


def operating_space(
    signals: Signals, truth: StateTrack | None, estimate: StateTrack | None, vehicle: VehicleParameters
) -> OperatingSpace:
    """Return where a drive went.

    Parameters
    ----------
    signals, truth, estimate : at the same stamps [N]; ground truth or estimate None: no error.
    """
    shape = len(SPEED_EDGES_M_S), len(AY_EDGES_M_S2)
    size = shape[0] * shape[1]
    totals = np.zeros((3, size))
    step_ns = median_step_ns(signals)
    taken = known_of(truth)
    for first, a, b, end in blocks_with_halo(signals, RUN_GAP_S, reach_rows(step_ns, MANOEUVRE_SMOOTHING_HZ)):
        part = signals.rows(first, end)
        of_truth = None if truth is None else truth.rows(first, end)
        speed, lateral = speed_and_ay(part, of_truth, taken)
        ay = np.abs(smooth(part.stamps_ns, lateral, MANOEUVRE_SMOOTHING_HZ, step_ns))
        steps = np.diff(part.stamps_ns, append=part.stamps_ns[-1:]) * 1e-9
        steps = np.minimum(np.where(steps > 0.0, steps, step_ns * 1e-9), MAX_STEP_S)
        core = slice(a - first, b - first)
        finite = (np.isfinite(speed) & np.isfinite(ay))[core]
        i = np.searchsorted(SPEED_EDGES_M_S, speed[core][finite], side="right") - 1
        j = np.searchsorted(AY_EDGES_M_S2, ay[core][finite], side="right") - 1
        cell = np.maximum(i, 0) * shape[1] + j
        totals[0] += np.bincount(cell, weights=steps[core][finite], minlength=size)
        if truth is not None and estimate is not None:
            slow = vehicle.low_speed_blend_m_s
            error = signal_error(estimate.rows(a, b), truth.rows(a, b), "sideslip_rad", slow)[finite]
            scored = np.isfinite(error)
            totals[1] += np.bincount(cell[scored], minlength=size)
            totals[2] += np.bincount(cell[scored], weights=error[scored] ** 2, minlength=size)
    seconds, counts, squares = totals
    with np.errstate(invalid="ignore"):
        errors = squares / counts
    cells = [
        Cell(*divmod(int(i), shape[1]), float(seconds[i]), int(counts[i]), float(errors[i]))
        for i in np.flatnonzero(seconds)
    ]
    friction = signals.friction[np.isfinite(signals.friction)]
    return OperatingSpace(cells, float(np.median(friction)) if friction.size else vehicle.assumed_friction)
