"""Errors e = estimate − ground truth (angles wrapped) where both are valid and finite.

Sideslip is scored only where the ground-truth speed exceeds the low-speed blend. a_y is the lateral specific force at
the CG in the road plane (:data:`~pdhef_logtool.evaluation.units.AY_NOTE`), for estimates and for ground truth; ground
truth without it is not scored. ``lag_s`` is the delay of an estimate after ground truth, ``rmse_aligned`` the error
without that shift and a constant.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.drive.correlation import find_shift, on_common_grid
from pdhef_logtool.evaluation.dead_reckoned import lateral_errors, pose_known, position_error
from pdhef_logtool.evaluation.metrics.metric import Columns, EvaluatedDrive, described, mean, rms
from pdhef_logtool.evaluation.track_errors import NORMAL_95, raw_error, scorable, total_std
from pdhef_logtool.evaluation.units import SCORED_SIGNALS
from pdhef_logtool.records.geometry import wrap_angle
from pdhef_logtool.records.signals import NS_PER_S, BoolArray, FloatArray, IntArray
from pdhef_logtool.records.tracks import StateTrack


def errors_of_drive(drive: EvaluatedDrive) -> Iterator[Columns]:
    """Yield the columns of each track and signal, and the errors of dead-reckoned positions."""
    truth = drive.truth
    if truth is None:
        return
    at_truth = {signal: scorable(truth, signal, drive.low_speed_m_s) for signal in SCORED_SIGNALS}
    since_start_ns = truth.stamps_ns - truth.stamps_ns[:1]
    has_pose = bool(pose_known(truth).any())
    for track in drive.tracks.values():
        for signal, has_truth in at_truth.items():
            values = errors_of(track, truth, signal, has_truth) | {"since_start_ns": since_start_ns}
            if signal == "sideslip_rad" and "straight" in drive.masks:
                values["straight"] = drive.masks["straight"]
            yield Columns(track.name, signal, values)
        if has_pose:
            lateral = lateral_errors(track, truth)
            yield Columns(track.name, "position_m", {"error": position_error(track, truth)}, whole=True)
            yield Columns(track.name, "lateral_1s_m", {"error": lateral, "signed": lateral}, whole=True)


def errors_of(track: StateTrack, truth: StateTrack, signal: str, has_truth: BoolArray) -> dict[str, NDArray[Any]]:
    """Return ``available`` (0 or 1 where ground truth is known) and the other columns at the scored stamps.

    ``std`` is the 1-sigma of the error; it is absent if the estimate provides none.
    """
    error = raw_error(track, truth, signal)
    scored = track.valid & has_truth & np.isfinite(error)
    error = np.where(scored, error, np.nan)
    values = {
        "available": np.where(has_truth, scored, np.nan),
        "error": error,
        "signed": error,
        "truth": getattr(truth, signal),
        "estimate": getattr(track, signal),
    }
    std = total_std(track, truth, signal)
    if std is not None:
        values["std"] = np.where(scored, std, np.nan)
    return values


def _p95(error: FloatArray) -> float:
    return float(np.percentile(np.abs(error), 95.0))


MAX_LAG_S = 0.3
MIN_LAG_CORRELATION = 0.5
#: More driving does not make the lag more certain than the sampling of the signals.
LAG_SPAN_NS = 600_000_000_000


def lag_s(stamps_ns: IntArray, estimate: FloatArray, truth: FloatArray) -> float:
    """Return the delay of the estimate [N] after the ground truth [N] in s; NaN without a clear peak."""
    finite = np.isfinite(estimate) & np.isfinite(truth)
    if np.count_nonzero(finite) < 2:
        return float("nan")
    stamps = stamps_ns[finite]
    shift = find_shift(on_common_grid(stamps, truth[finite], stamps, estimate[finite]), MAX_LAG_S)
    clear = shift.inside and shift.correlation >= MIN_LAG_CORRELATION
    return shift.shift_s if clear else float("nan")


def _lag_of_start(_: FloatArray, since_start_ns: IntArray, estimate: FloatArray, truth: FloatArray) -> float:
    end = int(np.searchsorted(since_start_ns, LAG_SPAN_NS))
    return lag_s(since_start_ns[:end], estimate[:end], truth[:end])


def _rms_aligned(
    _: FloatArray, since_start_ns: IntArray, estimate: FloatArray, truth: FloatArray, straight: BoolArray, lag: float
) -> float | None:
    """Return the RMS error [N] without the lag and without the ground truth's mean on straights.

    A lag that is not clear is 0. None without straights: an offset of ground truth is an error elsewhere.
    """
    then_ns = since_start_ns - np.nan_to_num(lag) * NS_PER_S
    covered = (then_ns >= since_start_ns[0]) & (then_ns <= since_start_ns[-1])
    if not straight.any() or not covered.any():
        return None
    shifted = np.interp(then_ns[covered], since_start_ns, truth - np.mean(truth[straight]))
    return rms(np.asarray(wrap_angle(estimate[covered] - shifted), dtype=np.float64))


METRICS = described(
    errors_of_drive,
    availability=(mean, "available"),
    rmse=(rms, "error"),
    mae=(lambda e: float(np.mean(np.abs(e))), "error"),
    bias=(mean, "signed"),
    p95_abs=(_p95, "error"),
    max_abs=(lambda e: float(np.max(np.abs(e))), "error"),
    rmse_relative=(lambda e, truth: rms(e) / rms(truth) if truth.any() else float("nan"), "error", "truth"),
    coverage95=(lambda std, e: float(np.mean(np.abs(e) <= NORMAL_95 * std)), "std", "error"),
    lag_s=(_lag_of_start, "error", "since_start_ns", "estimate", "truth"),
    rmse_aligned=(_rms_aligned, "error", "since_start_ns", "estimate", "truth", "straight", "lag_s"),
)
