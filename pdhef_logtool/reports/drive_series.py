"""The series of one drive, read from its estimates.parquet block by block: memory grows by cells, not by stamps.

Of the selected estimate and of what it is held against, the sideslip is kept at every stamp, for the largest errors.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from pdhef_logtool.evaluation.metrics import NORMAL_95, signal_error
from pdhef_logtool.records.geometry import DEGREES, wrap_angle
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray
from pdhef_logtool.records.tracks import StateTrack, make_track
from pdhef_logtool.reports.encoding import Envelope, FirstKnown, Grid, Means
from pdhef_logtool.results.parquet_sink import list_estimators, read_blocks
from pdhef_logtool.results.sink import TRUTH

#: NIS is shown as its mean over so long.
_NIS_S = 1.0
#: What is drawn of every track, and beside it of the ground truth and of the selected estimate.
_COLUMNS = ("vx_m_s", "vy_m_s", "sideslip_rad", "network_trust", "r_scale", "nis", "valid", "reason")
_MORE_COLUMNS = ("yaw_rate_rad_s", "ay_m_s2", "x_m", "y_m", "sideslip_std_rad")
#: What errors and gaps of sideslip are given from.
_OF_SIDESLIP = ("vx_m_s", "vy_m_s", "sideslip_rad", "valid")


class Tracks:
    """The tracks of a file. Each quantity of ground truth counts wherever it is known, as in the figures."""

    def __init__(self, path: Path, low_speed_m_s: float) -> None:
        self._path, self.low_speed_m_s = path, low_speed_m_s
        self.names = list_estimators(path)

    def blocks(self, name: str, columns: tuple[str, ...] = _COLUMNS) -> Iterator[StateTrack]:
        """Yield a track block by block; nothing where the file has none of the name."""
        for block in read_blocks(self._path, name, columns):
            yield replace(block, valid=np.ones(len(block), dtype=np.bool_)) if name == TRUTH else block

    def stamps(self, name: str) -> IntArray:
        """Return the stamps of a track [N]."""
        parts = [b.stamps_ns for b in self.blocks(name, ())]
        return np.concatenate(parts) if parts else np.empty(0, dtype=np.int64)

    def sideslip(self, name: str) -> SideslipTrack:
        """Return what the sideslip of a whole track is judged by."""
        parts = [(b.stamps_ns, b.vx_m_s, b.vy_m_s, b.sideslip_rad, b.valid) for b in self.blocks(name, _OF_SIDESLIP)]
        return SideslipTrack(name, *(np.concatenate(column) for column in zip(*parts, strict=True)))

    def drawn(self, track: StateTrack) -> StateTrack:
        """Return it with its sideslip unknown where it is not valid, or too slow for a direction."""
        slow = track.without_sideslip_below(self.low_speed_m_s)
        beta, std = (np.where(track.valid, c, np.nan) for c in (slow.sideslip_rad, slow.sideslip_std_rad))
        return replace(slow, sideslip_rad=beta, sideslip_std_rad=std)


@dataclass(frozen=True, slots=True, eq=False)
class SideslipTrack:
    """The sideslip of a whole track, and what it is judged by; [N] each, which is all of a drive that is kept."""

    name: str
    stamps_ns: IntArray
    vx_m_s: FloatArray
    vy_m_s: FloatArray
    sideslip_rad: FloatArray
    valid: BoolArray

    def at(self, rows: IntArray) -> StateTrack:
        """Return rows [M] of it as a track."""
        columns = {c: getattr(self, c)[rows] for c in _OF_SIDESLIP}
        return make_track(self.name, self.stamps_ns[rows], **columns)


@dataclass(slots=True, eq=False)
class Points:
    """Points of one plane: instants in s from the log's start, x and y."""

    picked: FirstKnown
    parts: list[FloatArray] = field(default_factory=list)

    def add(self, stamps_ns: IntArray, x: FloatArray, y: FloatArray) -> None:
        """Take the next points [M], one a cell."""
        rows = self.picked.rows(stamps_ns, np.isfinite(x) & np.isfinite(y))
        self.parts.append(np.stack([stamps_ns[rows].astype(np.float64), x[rows], y[rows]]))

    def thinned(self, most: int) -> FloatArray:
        """Return at most so many points [3, K]."""
        joined = np.concatenate(self.parts, axis=1) if self.parts else np.empty((3, 0))
        return joined[:, :: max(1, -(-joined.shape[1] // most))]


class DriveSeries:
    """What is drawn of one track; angles in degrees. ``error``: absolute, against what the page compares with.

    Confidence interval, speed, a_y and the planes are empty but for the ground truth and the selected estimate.
    """

    def __init__(self, name: str, grid: Grid) -> None:
        self.name = name
        self.sideslip, self.band_low, self.band_high, self.error = (Envelope(grid) for _ in range(4))
        self.trust, self.r_scale, self.speed, self.ay = (Envelope(grid) for _ in range(4))
        self.nis = Means(grid, _NIS_S)
        self.path, self.ay_sideslip, self.phase = (Points(FirstKnown(grid)) for _ in range(3))
        self.invalid: list[BoolArray] = []
        self.reason: list[IntArray] = []


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """Reference of errors: ground truth as the figures have it (``scored``), or another estimate as drawn."""

    track: SideslipTrack
    scored: bool
    tracks: Tracks

    def rows(self, stamps_ns: IntArray) -> IntArray | None:
        """Return the rows of the reference at these stamps, None where it is not at the same ones."""
        track_stamps = self.track.stamps_ns
        rows = np.minimum(np.searchsorted(track_stamps, stamps_ns), max(len(track_stamps) - 1, 0))
        return rows if len(track_stamps) and np.array_equal(track_stamps[rows], stamps_ns) else None

    def error(self, track: StateTrack) -> FloatArray:
        """Return track − reference [M] in rad; NaN where it is not known."""
        rows = self.rows(track.stamps_ns)
        if rows is None:
            return np.full(len(track), np.nan)
        other = self.track.at(rows)
        if self.scored:
            return signal_error(track, other, "sideslip_rad", self.tracks.low_speed_m_s)
        ours, theirs = (self.tracks.drawn(t).sideslip_rad for t in (track, other))
        return np.asarray(wrap_angle(ours - theirs), dtype=np.float64)


def gather(
    name: str,
    tracks: Tracks,
    grid: Grid,
    reference: Reference | None,
    nis_dof: Mapping[str, float],
    *,
    whole: bool,
) -> DriveSeries:
    """Return the series of one track, read block by block.

    Parameters
    ----------
    reference : what its errors are given against; None: none are. nis_dof : mean degrees of freedom by estimator.
    whole : whether confidence interval, motion and planes are drawn of it too.
    """
    made = DriveSeries(name, grid)
    for track in tracks.blocks(name, (*_COLUMNS, *_MORE_COLUMNS) if whole else _COLUMNS):
        drawn, stamps = tracks.drawn(track), track.stamps_ns
        beta = drawn.sideslip_rad * DEGREES
        made.sideslip.add(stamps, beta)
        if reference is not None:
            made.error.add(stamps, np.abs(reference.error(track)) * DEGREES)
        made.trust.add(stamps, track.network_trust)
        made.r_scale.add(stamps, track.r_scale)
        made.nis.add(stamps, track.nis / nis_dof.get(name, np.nan))
        made.invalid.append(~track.valid)
        if len(track.reason) == len(track):
            made.reason.append(track.reason)
        if whole:
            _add_whole(made, track, drawn)
    return made


def _add_whole(made: DriveSeries, track: StateTrack, drawn: StateTrack) -> None:
    stamps, beta = track.stamps_ns, drawn.sideslip_rad * DEGREES
    half = NORMAL_95 * drawn.sideslip_std_rad * DEGREES
    made.band_low.add(stamps, beta - half)
    made.band_high.add(stamps, beta + half)
    made.speed.add(stamps, track.vx_m_s)
    made.ay.add(stamps, track.ay_m_s2)
    made.path.add(stamps, track.x_m, track.y_m)
    made.ay_sideslip.add(stamps, np.abs(track.ay_m_s2), beta)
    made.phase.add(stamps, beta, np.where(np.isfinite(beta), sideslip_rate(track), np.nan) * DEGREES)


def sideslip_rate(track: StateTrack) -> FloatArray:
    """Return a_y / v_x − yaw rate [N] in rad/s, which the rate of sideslip is where speed is nearly constant."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(track.ay_m_s2 / track.vx_m_s - track.yaw_rate_rad_s, dtype=np.float64)
