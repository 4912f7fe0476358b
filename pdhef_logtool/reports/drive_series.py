"""Series of one drive for its page, read from estimates.parquet track by track."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from pdhef_logtool.evaluation.metrics import NORMAL_95, signal_error
from pdhef_logtool.records.geometry import DEGREES, wrap_angle
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray
from pdhef_logtool.records.tracks import StateTrack, make_track
from pdhef_logtool.reports.encoding import Grid, envelope, first_known
from pdhef_logtool.results.parquet_sink import list_estimators, read_track
from pdhef_logtool.results.sink import TRUTH

#: Columns to draw of every track, and further columns of the ground truth and the selected estimate.
_COLUMNS = ("vx_m_s", "vy_m_s", "sideslip_rad", "valid", "reason")
_MORE_COLUMNS = ("yaw_rate_rad_s", "ay_m_s2", "x_m", "y_m", "sideslip_std_rad", "steer_rad")
#: Columns that determine errors and gaps of the sideslip.
OF_SIDESLIP = ("vx_m_s", "vy_m_s", "sideslip_rad", "valid")


class Tracks:
    """The tracks of a file. Ground truth is used wherever it is finite, as in the metrics."""

    def __init__(self, path: Path, low_speed_m_s: float) -> None:
        self._path, self.low_speed_m_s = path, low_speed_m_s
        self.names = list_estimators(path)

    def read(self, name: str, columns: tuple[str, ...] = OF_SIDESLIP) -> StateTrack:
        """Read some columns of a track; the others are NaN."""
        track = read_track(self._path, name, columns)
        return replace(track, valid=np.ones(len(track), dtype=np.bool_)) if name == TRUTH else track

    def drawn(self, track: StateTrack) -> StateTrack:
        """Return the track with sideslip NaN where it is invalid or the speed is below the low-speed limit."""
        slow = track.without_sideslip_below(self.low_speed_m_s)
        beta, std = (np.where(track.valid, c, np.nan) for c in (slow.sideslip_rad, slow.sideslip_std_rad))
        return replace(slow, sideslip_rad=beta, sideslip_std_rad=std)


@dataclass(frozen=True, slots=True, eq=False)
class DriveSeries:
    """Series of one track for the figures; angles in degrees.

    Envelopes [cells, 2] of sideslip, yaw rate, speed, a_y and steering; largest values [cells] of the absolute
    ``error``; the 95 % CI [cells]; points [3, K] in the planes: stamp, x and y. ``invalid``, ``reason`` at each stamp
    [N]. Confidence interval, motion and planes are None except for the ground truth and the selected estimate.
    """

    name: str
    sideslip: FloatArray
    error: FloatArray | None
    invalid: BoolArray
    reason: IntArray
    band: tuple[FloatArray, FloatArray] | None = None
    yaw_rate: FloatArray | None = None
    speed: FloatArray | None = None
    ay: FloatArray | None = None
    path: FloatArray | None = None
    ay_sideslip: FloatArray | None = None
    steer: FloatArray | None = None


def thinned(points: FloatArray | None, most: int) -> FloatArray:
    """Return points [3, K], thinned to at most ``most``."""
    return np.empty((3, 0)) if points is None else points[:, :: max(1, -(-points.shape[1] // most))]


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """Reference of errors: ground truth as in the metrics (``scored``), or another estimate as drawn."""

    track: StateTrack
    scored: bool
    tracks: Tracks

    def error(self, track: StateTrack) -> FloatArray:
        """Return track − reference [N] in rad; NaN if unknown or if the reference lacks the stamps of the track."""
        known_ns, stamps_ns = self.track.stamps_ns, track.stamps_ns
        rows = np.minimum(np.searchsorted(known_ns, stamps_ns), max(len(known_ns) - 1, 0))
        if not len(known_ns) or not np.array_equal(known_ns[rows], stamps_ns):
            return np.full(len(track), np.nan)
        columns = {c: getattr(self.track, c)[rows] for c in OF_SIDESLIP}
        other = make_track(self.track.name, stamps_ns, **columns)
        if self.scored:
            return signal_error(track, other, "sideslip_rad", self.tracks.low_speed_m_s)
        ours, theirs = (self.tracks.drawn(t).sideslip_rad for t in (track, other))
        return np.asarray(wrap_angle(ours - theirs), dtype=np.float64)


def gather(name: str, tracks: Tracks, grid: Grid, reference: Reference | None, *, whole: bool) -> DriveSeries:
    """Return the series of one track.

    Parameters
    ----------
    reference : reference of the errors; None for no errors.
    whole : also return confidence interval, motion and planes.
    """
    track = tracks.read(name, (*_COLUMNS, *_MORE_COLUMNS) if whole else _COLUMNS)
    drawn, stamps = tracks.drawn(track), track.stamps_ns
    beta = drawn.sideslip_rad * DEGREES
    in_cells = partial(envelope, grid, stamps)
    error = None if reference is None else in_cells(np.abs(reference.error(track)) * DEGREES).max(axis=1)
    made = DriveSeries(name, in_cells(beta), error, ~track.valid, track.reason)
    if not whole:
        return made
    half = NORMAL_95 * drawn.sideslip_std_rad * DEGREES

    def points(x: FloatArray, y: FloatArray) -> FloatArray:
        rows = first_known(grid, stamps, np.isfinite(x) & np.isfinite(y))
        return np.stack([stamps[rows].astype(np.float64), x[rows], y[rows]])

    return replace(
        made,
        band=(in_cells(beta - half).min(axis=1), in_cells(beta + half).max(axis=1)),
        yaw_rate=in_cells(track.yaw_rate_rad_s * DEGREES),
        speed=in_cells(track.vx_m_s),
        ay=in_cells(track.ay_m_s2),
        path=points(track.x_m, track.y_m),
        ay_sideslip=points(np.abs(track.ay_m_s2), beta),
        steer=in_cells(track.steer_rad * DEGREES) if len(track.steer_rad) else None,
    )
