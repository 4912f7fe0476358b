"""Position errors of an estimate that is dead-reckoned from the ground-truth pose.

``position_m``: distance between the ground-truth position and v_x, v_y, r dead-reckoned from the ground-truth pose at
the first common stamp. ``lateral_1s_m``: dead reckoning restarts from the ground-truth pose every second; the error is
the lateral distance, in the ground-truth axes, at the end of each second. Seconds with an invalid estimate, a missing
pose or a gap are excluded.
"""

import numpy as np

from pdhef_logtool.records.geometry import dead_reckon
from pdhef_logtool.records.signals import NS_PER_S, BoolArray, FloatArray
from pdhef_logtool.records.tracks import StateTrack

ANCHOR_S = 1.0
#: Number of points of a drift, and the share of the way by which paths are aligned.
_MOST_POINTS, _ALIGNED_SHARE = 500, 0.1
#: Longest step between stamps: within a second of dead reckoning, and that counts as driving.
MAX_STEP_S = 0.2


def position_error(estimate: StateTrack, truth: StateTrack) -> FloatArray:
    """Return the distance [N] in m between ground truth and dead reckoning; NaN before the start and without a pose."""
    pose = pose_known(truth)
    error = np.full(len(truth), np.nan)
    ready = pose & _motion_known(estimate)
    if ready.any():
        first = int(np.argmax(ready))
        start = (float(truth.x_m[first]), float(truth.y_m[first]), float(truth.yaw_rad[first]))
        x, y, _ = _dead_reckon(estimate, start, first)
        distance = np.hypot(x - truth.x_m[first:], y - truth.y_m[first:])
        error[first:] = np.where(pose[first:], distance, np.nan)
    return error


def lateral_errors(estimate: StateTrack, truth: StateTrack) -> FloatArray:
    """Return the lateral errors [K] in m at the ends of the valid seconds."""
    pose, motion, stamps = pose_known(truth), _motion_known(estimate), truth.stamps_ns
    if not (pose & motion).any():
        return np.empty(0)
    start_ns = int(stamps[np.argmax(pose & motion)])
    anchors = np.searchsorted(stamps, np.arange(start_ns, int(stamps[-1]) + 1, round(ANCHOR_S * NS_PER_S)))
    begin, end = anchors[:-1], anchors[1:]
    gaps = np.cumsum(np.diff(stamps, prepend=stamps[:1]) > round(MAX_STEP_S * NS_PER_S))
    lost = np.cumsum(~motion)
    whole = (lost[end] == (lost - ~motion)[begin]) & (gaps[end] == gaps[begin]) & pose[begin] & pose[end]
    whole &= end > begin
    begin, end = begin[whole], end[whole]
    # One dead reckoning is enough for all seconds: a new start pose only rotates and moves it.
    x, y, yaw = _dead_reckon(estimate, (0.0, 0.0, 0.0))
    turn = truth.yaw_rad[begin] - yaw[begin]
    cosine, sine = np.cos(turn), np.sin(turn)
    x_step, y_step = x[end] - x[begin], y[end] - y[begin]
    dx = cosine * x_step - sine * y_step - (truth.x_m[end] - truth.x_m[begin])
    dy = sine * x_step + cosine * y_step - (truth.y_m[end] - truth.y_m[begin])
    return np.asarray(-np.sin(truth.yaw_rad[end]) * dx + np.cos(truth.yaw_rad[end]) * dy, dtype=np.float64)


def path_drift(estimate: StateTrack, truth: StateTrack) -> dict[str, float] | None:
    """Return the drift of the path of an estimate [N], by its pose at :data:`_MOST_POINTS`; None without a path.

    ``end_m``: distance of its end from the end of the ground truth's path, which is ``length_m`` long; the paths are
    aligned by position and heading first (:func:`aligned_path`).
    """
    count = min(len(truth), _MOST_POINTS)
    rows = np.linspace(0, max(len(truth) - 1, 0), count).astype(np.int64)
    source, target = (np.stack([track.x_m[rows], track.y_m[rows]]) for track in (estimate, truth))
    finite = np.isfinite(source + target).all(axis=0)
    source, target = source[:, finite], target[:, finite]
    length = float(np.hypot(*np.diff(target, axis=1)).sum())
    if not length > 0.0:
        return None
    return {"end_m": float(np.hypot(*(aligned_path(source, target) - target)[:, -1])), "length_m": length}


def aligned_path(source: FloatArray, target: FloatArray) -> FloatArray:
    """Return points [2, K] after the rotation and translation that fit the beginning of ``target`` [2, K] best.

    The beginning is the first :data:`_ALIGNED_SHARE` of the way. A path that is dead-reckoned from an unknown heading
    is turned as a whole, which is no drift.
    """
    way = np.cumsum(np.hypot(*np.diff(target, axis=1)))
    first = max(int(np.searchsorted(way, _ALIGNED_SHARE * way[-1])) + 2, 2)
    centre, goal = (p[:, :first].mean(axis=1, keepdims=True) for p in (source, target))
    a, b = source - centre, (target - goal)[:, :first]
    angle = np.arctan2(np.sum(a[0, :first] * b[1] - a[1, :first] * b[0]), np.sum(a[:, :first] * b))
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.asarray(np.stack([cosine * a[0] - sine * a[1], sine * a[0] + cosine * a[1]]) + goal, dtype=np.float64)


def pose_known(track: StateTrack) -> BoolArray:
    """Return where a track has a pose [N]."""
    is_known: BoolArray = track.valid & np.isfinite(track.x_m) & np.isfinite(track.y_m) & np.isfinite(track.yaw_rad)
    return is_known


def _motion_known(track: StateTrack) -> BoolArray:
    is_known: BoolArray = track.valid & np.isfinite(track.vx_m_s) & np.isfinite(track.vy_m_s)
    return is_known & np.isfinite(track.yaw_rate_rad_s)


def _dead_reckon(
    track: StateTrack, start: tuple[float, float, float], first: int = 0
) -> tuple[FloatArray, FloatArray, FloatArray]:
    vx = np.where(track.valid, track.vx_m_s, np.nan)
    return dead_reckon(track.stamps_ns[first:], vx[first:], track.vy_m_s[first:], track.yaw_rate_rad_s[first:], start)
