"""Errors of positions, which exist only with the ground-truth pose: an estimate dead-reckoned from it, block by block.

``position_m``: distance between the ground-truth position and v_x, v_y, r dead-reckoned from the ground-truth pose at
the first common stamp. ``lateral_1s_m``: dead reckoning is restarted from the ground-truth pose every second; the error
is the lateral one, in the ground-truth axes, at the end of each second. A second with an invalid estimate, a missing
pose or a gap does not count.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdhef_logtool.evaluation.blocks import row_blocks
from pdhef_logtool.records.geometry import DeadReckoner
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray
from pdhef_logtool.records.tracks import StateTrack

ANCHOR_S = 1.0
_MOST_POINTS = 500
#: No second of dead reckoning may contain a longer step between stamps.
MAX_STEP_S = 0.2


def position_error(estimate: StateTrack, truth: StateTrack) -> FloatArray:
    """Return the distance [N] in m between ground truth and dead reckoning; NaN before the start and without a pose."""
    path = Path()
    return np.concatenate([path.add(estimate.rows(a, b), truth.rows(a, b)) for a, b in row_blocks(len(truth))])


@dataclass(frozen=True, slots=True)
class PathDrift:
    """Distance of a dead-reckoned path from that of the ground truth in m.

    ``end_m`` at the end of ``length_m`` from a common start; ``largest_aligned_m`` after the rotation and translation
    (SE(2)) that bring the paths closest to one another.
    """

    end_m: float
    length_m: float
    largest_aligned_m: float


def path_drift(estimate: StateTrack, truth: StateTrack) -> PathDrift | None:
    """Return the drift of the path of an estimate [N], by its pose at :data:`_MOST_POINTS`; None without a path."""
    count = min(len(truth), _MOST_POINTS)
    rows = np.unique(np.linspace(0, max(len(truth) - 1, 0), count).astype(np.int64)).tolist()
    poses = [(t.x_m[0], t.y_m[0]) for track in (estimate, truth) for t in (track.rows(i, i + 1) for i in rows)]
    source, target = np.array(poses, dtype=np.float64).reshape(2, -1, 2).transpose(0, 2, 1)
    finite = np.isfinite(source + target).all(axis=0)
    source, target = source[:, finite], target[:, finite]
    length = float(np.hypot(*np.diff(target, axis=1)).sum())
    if not length > 0.0:
        return None
    end = float(np.hypot(*((source - source[:, :1]) - (target - target[:, :1]))[:, -1]))
    return PathDrift(end, length, float(np.hypot(*(aligned_path(source, target) - target)).max()))


def aligned_path(source: FloatArray, target: FloatArray) -> FloatArray:
    """Return points [2, K] after the rotation and translation that bring them closest to ``target`` [2, K]."""
    a, b = (p - p.mean(axis=1, keepdims=True) for p in (source, target))
    angle = np.arctan2(np.sum(a[0] * b[1] - a[1] * b[0]), np.sum(a * b))
    cosine, sine = np.cos(angle), np.sin(angle)
    rotated = np.stack([cosine * a[0] - sine * a[1], sine * a[0] + cosine * a[1]])
    return np.asarray(rotated + target.mean(axis=1, keepdims=True), dtype=np.float64)


class Path:
    """An estimate dead-reckoned from the ground-truth pose at the first common stamp, block by block."""

    def __init__(self) -> None:
        self._reckoner: DeadReckoner | None = None

    def add(self, estimate: StateTrack, truth: StateTrack) -> FloatArray:
        """Return the errors [M] of the next block as :func:`position_error` has them."""
        pose = pose_known(truth)
        error = np.full(len(truth), np.nan)
        first = 0
        if self._reckoner is None:
            ready = np.flatnonzero(pose & _motion_known(estimate)) if pose.any() else np.empty(0, dtype=np.int64)
            if not ready.size:
                return error
            first = int(ready[0])
            self._reckoner = DeadReckoner(
                (float(truth.x_m[first]), float(truth.y_m[first]), float(truth.yaw_rad[first]))
            )
        x, y, _ = _dead_reckon(estimate, self._reckoner, first)
        distance = np.hypot(x - truth.x_m[first:], y - truth.y_m[first:])
        error[first:] = np.where(pose[first:], distance, np.nan)
        return error


class Seconds:
    """An estimate and ground truth at the first stamp of each second from the first common stamp on, block by block."""

    def __init__(self) -> None:
        self._reckoner = DeadReckoner((0.0, 0.0, 0.0))
        self._anchors: list[FloatArray] = []
        self._mark: int | None = None
        self._rows = self._lost = self._gaps = 0
        self._last: IntArray = np.empty(0, dtype=np.int64)

    def add(self, estimate: StateTrack, truth: StateTrack) -> None:
        """Take the next block.

        Of it [11, K] is kept: place, whether the true pose is known, stamps before it and up to it without motion,
        gaps before it, dead reckoning x, y, yaw and true x, y, yaw.
        """
        pose, motion, stamps = pose_known(truth), _motion_known(estimate), truth.stamps_ns
        gap = np.diff(stamps, prepend=self._last if self._rows else stamps[:1]) > round(MAX_STEP_S * 1e9)
        if self._mark is None and (pose & motion).any():
            self._mark = int(stamps[np.argmax(pose & motion)])
        second = round(ANCHOR_S * 1e9)
        marks = (
            np.empty(0, dtype=np.int64) if self._mark is None else np.arange(self._mark, int(stamps[-1]) + 1, second)
        )
        anchors = np.searchsorted(stamps, marks)
        up_to = self._lost + np.cumsum(~motion)
        columns = (self._rows + np.arange(len(stamps)), pose, up_to - ~motion, up_to, self._gaps + np.cumsum(gap))
        poses = (*_dead_reckon(estimate, self._reckoner), truth.x_m, truth.y_m, truth.yaw_rad)
        self._anchors.append(np.stack([np.asarray(c[anchors], dtype=np.float64) for c in (*columns, *poses)]))
        self._mark = None if self._mark is None else self._mark + second * len(marks)
        self._lost += int(np.count_nonzero(~motion))
        self._gaps += int(np.count_nonzero(gap))
        self._rows, self._last = self._rows + len(stamps), stamps[-1:]

    def lateral_errors(self) -> FloatArray:
        """Return the lateral errors of all blocks."""
        anchors = np.concatenate([np.empty((11, 0)), *self._anchors], axis=1)
        begin, end = anchors[:, :-1], anchors[:, 1:]
        row, pose, lost, _, gaps = range(5)
        whole = (end[3] == begin[lost]) & (end[gaps] == begin[gaps]) & (begin[pose] * end[pose] > 0)
        whole &= end[row] > begin[row]
        x, y, yaw, true_x, true_y, true_yaw = begin[5:, whole]
        x_end, y_end, _, true_x_end, true_y_end, true_yaw_end = end[5:, whole]
        # One dead reckoning serves all seconds: a new start pose only turns and moves it.
        turn = true_yaw - yaw
        dx = np.cos(turn) * (x_end - x) - np.sin(turn) * (y_end - y) - (true_x_end - true_x)
        dy = np.sin(turn) * (x_end - x) + np.cos(turn) * (y_end - y) - (true_y_end - true_y)
        return np.asarray(-np.sin(true_yaw_end) * dx + np.cos(true_yaw_end) * dy, dtype=np.float64)


def pose_known(truth: StateTrack) -> BoolArray:
    """Return where ground truth has a pose [N]."""
    is_known: BoolArray = truth.valid & np.isfinite(truth.x_m) & np.isfinite(truth.y_m) & np.isfinite(truth.yaw_rad)
    return is_known


def _motion_known(track: StateTrack) -> BoolArray:
    is_known: BoolArray = track.valid & np.isfinite(track.vx_m_s) & np.isfinite(track.vy_m_s)
    return is_known & np.isfinite(track.yaw_rate_rad_s)


def _dead_reckon(
    track: StateTrack, reckoner: DeadReckoner, first: int = 0
) -> tuple[FloatArray, FloatArray, FloatArray]:
    vx = np.where(track.valid, track.vx_m_s, np.nan)
    return reckoner.add(track.stamps_ns[first:], vx[first:], track.vy_m_s[first:], track.yaw_rate_rad_s[first:])
