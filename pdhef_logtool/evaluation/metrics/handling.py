"""Key figures of manoeuvres, of estimates and of ground truth alike, so that an estimator's effect on them is visible.

Each is of the first manoeuvre of its kind in a drive. Steps: ISO 7401:2011; understeer gradient: ISO 4138:2021; entry
speed of a lane change: ISO 3888-2:2011; sine with dwell: 49 CFR 571.126, S5.2.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from pdhef_logtool.evaluation.metrics.metric import Columns, EvaluatedDrive, Metric
from pdhef_logtool.records.signals import BoolArray, FloatArray

#: Driving after a manoeuvre that its figures need, the end of a step that is its steady state, s, and the share of its
#: peak below which steering is at zero.
_AFTER_S, _STEADY_S, _AT_ZERO = 2.0, 0.5, 0.05
#: Range of a_y in which the understeer gradient is constant, and least range that determines it; m/s².
_LINEAR_M_S2, _LEAST_RANGE_M_S2 = 4.0, 1.0


def responses(drive: EvaluatedDrive) -> Iterator[Columns]:
    """Yield the response of each track during the first step, lane change, sine with dwell and ramp or circle."""
    if drive.calibrated is None:
        return
    signals, vehicle, _ = drive.calibrated
    since_s: FloatArray = (signals.stamps_ns - signals.stamps_ns[:1]) * np.float64(1e-9)
    step, lane = (_first(drive, since_s, (name,)) for name in ("step-steer", "dlc-3888-2"))
    dwell = _first(drive, since_s, ("sine-with-dwell",), _AFTER_S)
    turn = _first(drive, since_s, ("ramp-steer", "steady-circle"))
    for track in (*drive.tracks.values(), *(() if drive.truth is None else (drive.truth,))):
        with np.errstate(divide="ignore", invalid="ignore"):
            beyond = signals.steer_rad - vehicle.wheelbase_m * track.yaw_rate_rad_s / track.vx_m_s
        common = {"since_s": since_s, "steer": signals.steer_rad, "beyond": beyond}
        places = {"yaw_rate_rad_s": {"step": step, "dwell": dwell}, "ay_m_s2": {"step": step, "turn": turn}}
        for signal, masks in (*places.items(), ("vx_m_s", {"lane": lane})):
            usable = np.isfinite(getattr(track, signal)) & (track.valid | (track is drive.truth))
            response = {n: np.where(mask & usable, getattr(track, signal), np.nan) for n, mask in masks.items()}
            yield Columns(track.name, signal, response | common)


def _first(drive: EvaluatedDrive, since_s: FloatArray, names: tuple[str, ...], after_s: float = 0.0) -> BoolArray:
    """Return the mask [N] of the first manoeuvre with one of these names and of the time after it."""
    none = np.zeros(len(since_s), dtype=np.bool_)
    rows = np.flatnonzero(np.logical_or.reduce([none, *(drive.masks[n] for n in names if n in drive.masks)]))
    if not len(rows):
        return none
    last = rows[np.append(np.flatnonzero(np.diff(rows) > 1), len(rows) - 1)[0]]
    return np.asarray((since_s >= since_s[rows[0]]) & (since_s <= since_s[last] + after_s), dtype=np.bool_)


def _step(response: FloatArray, since_s: FloatArray, steer: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Return steering and response [N] as shares of their steady change, and the steady response."""
    settled = since_s >= since_s[-1] - _STEADY_S
    changes = [c - c[0] for c in (steer, response)]
    steady = [float(np.mean(c[settled])) for c in changes]
    with np.errstate(divide="ignore", invalid="ignore"):
        return changes[0] / steady[0], changes[1] / steady[1], steady[1]


def _reached(since_s: FloatArray, share: FloatArray, level: float) -> float | None:
    """Return the first time at which a share [N] reaches a level, between stamps; None if it does not."""
    row = int(np.argmax(share >= level))
    if not share[row] >= level:
        return None
    pair = slice(max(row - 1, 0), row + 1)
    return float(np.interp(level, share[pair], since_s[pair]))


def _response_time(response: FloatArray, since_s: FloatArray, steer: FloatArray) -> float | None:
    steering, answer, _ = _step(response, since_s, steer)
    start, end = _reached(since_s, steering, 0.5), _reached(since_s, answer, 0.9)
    return None if start is None or end is None else end - start


def _overshoot(response: FloatArray, since_s: FloatArray, steer: FloatArray) -> float:
    return max(float(np.max(_step(response, since_s, steer)[1])) - 1.0, 0.0)


def _peak(response: FloatArray, since_s: FloatArray, steer: FloatArray) -> float:
    _, answer, steady = _step(response, since_s, steer)
    return float(np.max(answer)) * steady


def _ratio(rate: FloatArray, since_s: FloatArray, steer: FloatArray, *, after_s: float) -> float | None:
    """Return the yaw rate some time after the steering is complete, over its peak after the steering reverses."""
    first = int(np.argmax(np.abs(steer) > 0.5 * np.max(np.abs(steer))))
    back = -np.sign(steer[first]) * steer
    reversal = first + int(np.argmax(back[first:] > 0.0))
    second = reversal + int(np.argmax(back[reversal:]))
    complete = second + int(np.argmax(back[second:] < _AT_ZERO * back[second]))
    answer = -np.sign(steer[first]) * rate
    peak = float(np.max(answer[reversal : complete + 1]))
    at_s = since_s[complete] + after_s
    if complete == second or peak <= 0.0 or at_s > since_s[-1]:
        return None
    return float(np.interp(at_s, since_s, answer)) / peak


def _understeer(ay: FloatArray, beyond: FloatArray) -> float | None:
    linear = np.isfinite(beyond) & (np.abs(ay) <= _LINEAR_M_S2)
    if not linear.any() or np.ptp(ay[linear]) < _LEAST_RANGE_M_S2:
        return None
    return float(np.polyfit(ay[linear], beyond[linear], 1)[0])


_HANDLING = partial(Metric, columns=responses, whole=True)
_STEP = partial(_HANDLING, over=("step", "since_s", "steer"), brief=("yaw_rate_rad_s", "ay_m_s2"))
_DWELL = partial(_HANDLING, over=("dwell", "since_s", "steer"), unit="1", brief=("yaw_rate_rad_s",))
_RESPONSE = "of the first step steer: from half of the steady steering angle to 90 % of the steady response"
_RATIO = "of the first sine with dwell: yaw rate {} s after completion of steer over its peak after the reversal"
_SLOPE = "slope of the road-wheel angle less L r / v over a_y up to 4 m/s², of the first ramp or steady circle"
METRICS = (
    _STEP("step_response_time", "response time", _RESPONSE, formula=_response_time, unit="s"),
    _STEP("step_peak", "peak of step", "largest response to the first step steer", formula=_peak),
    _STEP("step_overshoot", "overshoot", "`step_peak` over the steady response, less 1", formula=_overshoot, unit="1"),
    _DWELL("dwell_ratio_1s", "ratio 1 s", _RATIO.format("1"), formula=partial(_ratio, after_s=1.0)),
    _DWELL("dwell_ratio_1_75s", "ratio 1.75 s", _RATIO.format("1.75"), formula=partial(_ratio, after_s=1.75)),
    _HANDLING(
        "understeer_gradient",
        "understeer gradient",
        _SLOPE,
        formula=_understeer,
        over=("turn", "beyond"),
        unit="rad/(m/s^2)",
        brief=("ay_m_s2",),
    ),
    _HANDLING(
        "entry_speed",
        "entry speed",
        "v_x at the start of the first severe lane change",
        formula=lambda speed: float(speed[0]),
        over=("lane",),
        brief=("vx_m_s",),
    ),
)
