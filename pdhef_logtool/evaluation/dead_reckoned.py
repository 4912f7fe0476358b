"""Errors of positions, which exist only with the ground-truth pose: an estimate dead-reckoned from it, block by block.

``position_m``: distance between the ground-truth position and v_x, v_y, r dead-reckoned from the ground-truth pose at
the first common stamp. ``lateral_1s_m``: dead reckoning is restarted from the ground-truth pose every second; the error
is the lateral one, in the ground-truth axes, at the end of each second. A second with an invalid estimate, a missing
pose or a gap does not count.
"""

from __future__ import annotations

import numpy as np

from pdhef_logtool.evaluation.blocks import row_blocks
from pdhef_logtool.records.geometry import DeadReckoner
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray
from pdhef_logtool.records.tracks import StateTrack

ANCHOR_S = 1.0
#: No second of dead reckoning may contain a longer step between stamps.
MAX_STEP_S = 0.2


def position_error(estimate: StateTrack, truth: StateTrack) -> FloatArray:
    """Return the distance [N] in m between ground truth and dead reckoning; NaN before the start and without a pose."""
    path = Path()
    return np.concatenate([path.add(estimate.rows(a, b), truth.rows(a, b)) for a, b in row_blocks(len(truth))])


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
