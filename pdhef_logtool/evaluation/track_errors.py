"""Errors of an estimate against ground truth at the same stamps, and the stamps that are scored."""

import numpy as np

from pdhef_logtool.records.geometry import wrap_angle
from pdhef_logtool.records.signals import BoolArray, FloatArray
from pdhef_logtool.records.tracks import StateTrack

NORMAL_95 = 1.959963984540054
_STDS = {
    "vx_m_s": "vx_std_m_s",
    "vy_m_s": "vy_std_m_s",
    "yaw_rate_rad_s": "yaw_rate_std_rad_s",
    "sideslip_rad": "sideslip_std_rad",
}


def truth_speed(truth: StateTrack) -> FloatArray:
    """Return the ground-truth speed [N] in m/s: abs v_x without v_y, the measured speed without v_x."""
    speed = np.where(np.isfinite(truth.vy_m_s), np.hypot(truth.vx_m_s, truth.vy_m_s), np.abs(truth.vx_m_s))
    measured = truth.measured_speed_m_s
    return np.where(np.isfinite(speed), speed, np.abs(measured)) if len(measured) == len(speed) else speed


def signal_error(estimate: StateTrack, truth: StateTrack, signal: str, low_speed_m_s: float) -> FloatArray:
    """Return estimate − ground truth [N] of a signal; NaN at stamps that are not scored."""
    error = raw_error(estimate, truth, signal)
    scored = estimate.valid & scorable(truth, signal, low_speed_m_s)
    return np.where(scored & np.isfinite(error), error, np.nan)


def raw_error(estimate: StateTrack, truth: StateTrack, signal: str) -> FloatArray:
    """Return estimate − ground truth [N], angles wrapped, including stamps that are not scored."""
    error: FloatArray = getattr(estimate, signal) - getattr(truth, signal)
    return wrap_angle(error) if signal == "sideslip_rad" else error


def scorable(truth: StateTrack, signal: str, low_speed_m_s: float) -> BoolArray:
    """Return where ground truth can score a signal [N]; sideslip only above a speed."""
    is_scorable: BoolArray = truth.valid & np.isfinite(getattr(truth, signal))
    if signal == "sideslip_rad":
        is_scorable = is_scorable & (truth_speed(truth) > low_speed_m_s)
    return is_scorable


def total_std(estimate: StateTrack, truth: StateTrack, signal: str) -> FloatArray | None:
    """Return the 1-sigma of the error [N]; None if the estimate provides none."""
    name = _STDS.get(signal)
    if name is None or (name != "sideslip_std_rad" and not estimate.covariance.shape[0]):
        return None
    std: FloatArray = getattr(estimate, name)
    of_truth = getattr(truth, name)
    if not np.isfinite(of_truth).any():
        return std
    return np.asarray(np.hypot(std, np.nan_to_num(of_truth, nan=0.0)), dtype=np.float64)
