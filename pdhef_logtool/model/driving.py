"""Data of a drive for the fit of its car: sensors on an even grid, in stretches of driving."""

from dataclasses import dataclass, field, replace

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.drive.sensor_changes import part_means
from pdhef_logtool.estimators.speed_slip import believable
from pdhef_logtool.model.equations import AY, FRICTION, SPEED, STEER, YAW_RATE
from pdhef_logtool.records.interpolation import Bracket
from pdhef_logtool.records.signals import NS_PER_S, BoolArray, FloatArray, IntArray, Signals

#: Step of the grid. The model is valid to 4 Hz; the integration is exact for tyre lags (12 ms at 40 m/s).
STEP_S = 0.02
#: Minimum length of a stretch; longest gap to interpolate, in general and for the speed, which varies slowly.
LEAST_STRETCH_S, BRIDGED_S, SPEED_BRIDGED_S = 2.0, 0.3, 0.6
#: Excluded start of each stretch, where the initial state is unknown.
SETTLE_S = 1.0
#: Longest driving of one log in a fit, and length of the pieces from which it is selected.
MOST_S, PIECE_S = 200.0, 10.0

_COLUMNS = 5
_PAUSE_CELLS = 100


@dataclass(frozen=True, slots=True, eq=False)
class Driving:
    """Driving of one log for a fit.

    Attributes
    ----------
    columns : float64 [5, N], steering, speed, yaw rate, a_y and friction on the grid.
    stamps_ns : int64 [N], end of each cell of the grid.
    stretches : int64 [k, 2], [first, last) of each stretch without a gap above the vehicle's low-speed limit.
    has_ay : whether a_y was measured; if not, the column contains v_x r, which is not compared with the model.
    slopes, weights : [N], v_y / v_x of the ground truth, NaN where unknown, for teaching; None otherwise.
    """

    columns: FloatArray
    stamps_ns: IntArray
    stretches: IntArray
    has_ay: bool = True
    slopes: FloatArray | None = None
    weights: FloatArray = field(default_factory=lambda: np.empty(0))

    @property
    def seconds(self) -> float:
        """Driving in all stretches."""
        return float(np.sum(np.diff(self.stretches, axis=1))) * STEP_S

    @property
    def settled(self) -> BoolArray:
        """Mask [N] of used samples: the stretches without their start."""
        inside = np.zeros(self.columns.shape[1], dtype=np.bool_)
        for first, last in self.stretches:
            inside[first + round(SETTLE_S / STEP_S) : last] = True
        return inside

    def informative(self) -> "Driving":
        """Return the same grid with at most :data:`MOST_S` of driving: the pieces in which a_y varies most."""
        if self.seconds <= MOST_S:
            return self
        size, ay = round(PIECE_S / STEP_S), self.columns[AY]
        pieces = [slice(k, min(k + size, last)) for first, last in self.stretches for k in range(first, last, size)]
        inside = np.zeros(ay.size, dtype=np.bool_)
        for piece in sorted(pieces, key=lambda p: -float(np.var(ay[p])))[: round(MOST_S / PIECE_S)]:
            inside[piece] = True
        return replace(self, stretches=_long_runs(inside))


def driving_of(signals: Signals, vehicle: VehicleParameters) -> Driving:
    """Thin the signals of a drive [N] to a grid of cell means."""
    if not len(signals):
        none = np.empty(0, dtype=np.int64)
        return Driving(np.empty((_COLUMNS, 0)), none, none.reshape(0, 2))
    signals, _ = believable(signals, vehicle.sensors, None)
    start_ns = int(signals.stamps_ns[0])
    cell = (signals.stamps_ns - start_ns) // round(STEP_S * NS_PER_S)
    cells, place = np.unique(cell, return_inverse=True)
    means = np.full((_COLUMNS, cells.size), np.nan)
    # In the order of the columns.
    sources = (signals.steer_rad, signals.speed_m_s, signals.yaw_rate_rad_s, signals.ay_m_s2, signals.friction)
    for row, values in enumerate(sources):
        means[row] = part_means(values, place, cells.size)
    ends_ns = start_ns + (cells + 1) * round(STEP_S * NS_PER_S)
    # A pause, however long, is a gap: it takes no more room than that.
    cells = np.concatenate([[0], np.cumsum(np.minimum(np.diff(cells), _PAUSE_CELLS))])
    columns = np.full((_COLUMNS, int(cells[-1]) + 1), np.nan)
    columns[:, cells] = means
    stamps_ns = np.zeros(columns.shape[1], dtype=np.int64)
    stamps_ns[cells] = ends_ns
    stamps_ns = np.maximum.accumulate(stamps_ns)
    columns[FRICTION] = np.where(np.isfinite(columns[FRICTION]), columns[FRICTION], vehicle.assumed_friction)
    for row, bridged_s in ((STEER, BRIDGED_S), (YAW_RATE, BRIDGED_S), (AY, BRIDGED_S), (SPEED, SPEED_BRIDGED_S)):
        columns[row] = _bridged(columns[row], round(bridged_s / STEP_S))
    if not (has_ay := bool(np.isfinite(columns[AY]).any())):
        columns[AY] = columns[SPEED] * columns[YAW_RATE]
    complete = np.isfinite(columns).all(axis=0)
    return Driving(columns, stamps_ns, _long_runs(complete & (columns[SPEED] > vehicle.low_speed_blend_m_s)), has_ay)


def _bridged(values: FloatArray, most: int) -> FloatArray:
    """Return values [N] with gaps of at most ``most`` steps interpolated; longer ones stay NaN."""
    finite = np.flatnonzero(np.isfinite(values))
    return Bracket(finite, np.arange(values.size), most).linear(values[finite])


def _long_runs(mask: BoolArray) -> IntArray:
    """Return [first, last) of each run of true values in a mask [N] that is long enough for a stretch."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    runs = edges.reshape(-1, 2).astype(np.int64)
    return runs[runs[:, 1] - runs[:, 0] >= round(LEAST_STRETCH_S / STEP_S)]
