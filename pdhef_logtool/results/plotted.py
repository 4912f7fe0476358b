"""Drawn values of a track: angles in degrees, limits of the 95 % interval, errors against the ground truth."""

from __future__ import annotations

import numpy as np

from pdhef_logtool.evaluation.track_errors import NORMAL_95, truth_speed
from pdhef_logtool.records.geometry import DEGREES, wrap_angle
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.records.tracks import StateTrack

#: Whose error is drawn; the other two errors show the same once more.
ERRORS = {"sideslip_deg": "sideslip_rad", "yaw_rate_deg_s": "yaw_rate_rad_s", "vy_m_s": "vy_m_s"}
#: Field of ``pdhef_msgs/msg/PlottedEstimate`` of each error.
_ERROR_FIELDS = ("sideslip_error_deg", "yaw_rate_error_deg_s", "vy_error_m_s")


def errors(track: StateTrack, truth: StateTrack | None, min_speed_m_s: float) -> dict[str, FloatArray]:
    """Return the errors [N] by the keys of :data:`ERRORS`, NaN where ground truth or estimate is not known.

    ``min_speed_m_s``: of the ground truth, below which there is no error of sideslip.
    """
    columns = {name: np.full(len(track), np.nan) for name in ERRORS}
    if truth is None:
        return columns
    _, of_track, of_truth = np.intersect1d(track.stamps_ns, truth.stamps_ns, assume_unique=True, return_indices=True)
    valid = track.valid[of_track] & truth.valid[of_truth]
    fast = truth_speed(truth)[of_truth] >= min_speed_m_s
    for name, column in ERRORS.items():
        error = np.asarray(getattr(track, column))[of_track] - getattr(truth, column)[of_truth]
        is_slip = column == "sideslip_rad"
        error = (wrap_angle(error) if is_slip else error) * (1.0 if name == "vy_m_s" else DEGREES)
        columns[name][of_track] = np.where(valid & fast if is_slip else valid, error, np.nan)
    return columns


def plotted_fields(track: StateTrack, truth: StateTrack | None, min_speed_m_s: float) -> dict[str, FloatArray]:
    """Return the fields [N] of ``pdhef_msgs/msg/PlottedEstimate`` but the header; no errors of ground truth."""
    fast = np.hypot(track.vx_m_s, track.vy_m_s) >= min_speed_m_s
    slip, rate = (
        np.where(is_drawn, DEGREES * getattr(track, column), np.nan)
        for column, is_drawn in (("sideslip_rad", track.valid & fast), ("yaw_rate_rad_s", track.valid))
    )
    slip_half, rate_half = (
        NORMAL_95 * DEGREES * np.asarray(getattr(track, std)) for std in ("sideslip_std_rad", "yaw_rate_std_rad_s")
    )
    fields = {
        "sideslip_deg": slip,
        "sideslip_low_deg": slip - slip_half,
        "sideslip_high_deg": slip + slip_half,
        "yaw_rate_deg_s": rate,
        "yaw_rate_low_deg_s": rate - rate_half,
        "yaw_rate_high_deg_s": rate + rate_half,
        **{c: np.where(track.valid, getattr(track, c), np.nan) for c in ("vx_m_s", "vy_m_s", "ay_m_s2")},
    }
    against = None if truth is None or truth.name == track.name else truth
    return fields | dict(zip(_ERROR_FIELDS, errors(track, against, min_speed_m_s).values(), strict=True))
