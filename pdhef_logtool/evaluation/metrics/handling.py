"""Key figures of manoeuvres, of estimates and of ground truth alike, so that an estimator's effect on them is visible.

Each is of the first manoeuvre of its kind in a drive.

Sources: ISO 7401:2011, clauses 10 (step input: response times, overshoot, TB) and 14 (continuous sine: gain, phase,
coherence); ISO 4138:2021 (understeer gradient); ISO 3888-2:2011 (entry speed of a lane change); ISO 7975:2019 (braking
in a turn, against the yaw rate on the circle before it); 49 CFR 571.126, S5.2.1 to S5.2.3 (sine with dwell).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TypeAlias

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.evaluation.manoeuvres import RULES
from pdhef_logtool.evaluation.metrics.metric import Columns, EvaluatedDrive, Metric
from pdhef_logtool.records.signals import BoolArray, FloatArray

#: Driving after a manoeuvre that its figures need, the end of a step that is its steady state, s, and the share of its
#: peak below which steering is at zero.
_AFTER_S, _STEADY_S, _AT_ZERO = 2.0, 0.5, 0.05
#: Range of a_y in which the understeer gradient is constant, and least range that determines it; m/s².
_LINEAR_M_S2, _LEAST_RANGE_M_S2 = 4.0, 1.0
#: Sine with dwell: steering-wheel angle at its beginning, and the time of the displacement after it.
_BEGINNING_RAD, _DISPLACED_S = np.deg2rad(5.0), 1.07
#: Time before braking over which the circle is measured, s.
_CIRCLE_S = (1.3, 0.3)
#: Sweep: duration and overlap of the spectra, rate of their samples, and least share of the steering's largest
#: spectral density at an excited frequency.
_SPECTRUM_S, _OVERLAP, _RATE_HZ, _EXCITED = 4.0, 0.75, 50.0, 0.05

_Figures: TypeAlias = "dict[str, float | None]"


def responses(drive: EvaluatedDrive) -> Iterator[Columns]:
    """Yield the figures of each track, one column a figure with the same value at all stamps of its manoeuvre."""
    if drive.calibrated is None:
        return
    signals, vehicle, _ = drive.calibrated
    since_s: FloatArray = (signals.stamps_ns - signals.stamps_ns[:1]) * np.float64(1e-9)
    places = {names: _first(drive, since_s, names) for names, *_ in _KINDS}
    for track in (*drive.tracks.values(), *(() if drive.truth is None else (drive.truth,))):
        for names, signal, needed, figures in _KINDS:
            columns = [getattr(track, column) for column in needed]
            known = np.isfinite(columns).all(axis=0) & (track.valid | (track is drive.truth))
            use = places[names] & known
            if use.any():
                time_s = since_s[use] - since_s[places[names]][0]
                with np.errstate(divide="ignore", invalid="ignore"):
                    values = figures(vehicle, time_s, signals.steer_rad[use], *(c[use] for c in columns))
                of_figure = {n: np.broadcast_to(v, len(time_s)) for n, v in values.items() if v is not None}
                yield Columns(track.name, signal, of_figure, whole=True)


def _first(drive: EvaluatedDrive, since_s: FloatArray, names: tuple[str, ...]) -> BoolArray:
    """Return the mask [N] of the first manoeuvre with one of these names, and of the time after a sine with dwell."""
    none = np.zeros(len(since_s), dtype=np.bool_)
    rows = np.flatnonzero(np.logical_or.reduce([none, *(drive.masks[n] for n in names if n in drive.masks)]))
    if not len(rows):
        return none
    last = rows[np.append(np.flatnonzero(np.diff(rows) > 1), len(rows) - 1)[0]]
    end_s = since_s[last] + (_AFTER_S if names == ("sine-with-dwell",) else 0.0)
    return np.asarray((since_s >= since_s[rows[0]]) & (since_s <= end_s), dtype=np.bool_)


def _reached(time_s: FloatArray, share: FloatArray, level: float) -> float:
    """Return the first time at which a share [N] reaches a level, between stamps; NaN if it does not."""
    row = int(np.argmax(share >= level))
    pair = slice(max(row - 1, 0), row + 1)
    return float(np.interp(level, share[pair], time_s[pair])) if share[row] >= level else np.nan


def _step(_: VehicleParameters, time_s: FloatArray, steer: FloatArray, response: FloatArray) -> _Figures:
    settled = time_s >= time_s[-1] - _STEADY_S
    changes = [c - c[0] for c in (steer, response)]
    steady = [float(np.mean(c[settled])) for c in changes]
    steering, answer = (c / s for c, s in zip(changes, steady, strict=True))
    start_s, peak = _reached(time_s, steering, 0.5), float(np.max(answer))
    return {
        "step_response_time": _reached(time_s, answer, 0.9) - start_s,
        "step_peak_time": float(time_s[np.argmax(answer)]) - start_s,
        "step_peak": peak * steady[1],
        "step_overshoot": max(peak - 1.0, 0.0),
    }


def _tb(
    vehicle: VehicleParameters, time_s: FloatArray, steer: FloatArray, rate: FloatArray, slip: FloatArray
) -> _Figures:
    steady = float(np.mean(slip[time_s >= time_s[-1] - _STEADY_S]) - slip[0])
    return {"step_tb": (_step(vehicle, time_s, steer, rate)["step_peak_time"] or np.nan) * steady}


def _dwell(_: VehicleParameters, time_s: FloatArray, steer: FloatArray, rate: FloatArray) -> _Figures:
    """Return the yaw rate some time after the steering is complete, over its peak after the steering reverses."""
    first = int(np.argmax(np.abs(steer) > 0.5 * np.max(np.abs(steer))))
    back = -np.sign(steer[first]) * steer
    reversal = first + int(np.argmax(back[first:] > 0.0))
    second = reversal + int(np.argmax(back[reversal:]))
    complete = second + int(np.argmax(back[second:] < _AT_ZERO * back[second]))
    answer = -np.sign(steer[first]) * rate
    peak = float(np.max(answer[reversal : complete + 1]))
    if complete == second or peak <= 0.0:
        return {}
    at_s = [time_s[complete] + after_s for after_s in (1.0, 1.75)]
    ratios = np.interp(at_s, time_s, answer, right=np.nan) / peak
    return dict(zip(("dwell_ratio_1s", "dwell_ratio_1_75s"), ratios.tolist(), strict=True))


def _displacement(
    vehicle: VehicleParameters, time_s: FloatArray, steer: FloatArray, vx: FloatArray, vy: FloatArray, rate: FloatArray
) -> _Figures:
    """Return the double integral of the lateral acceleration v̇_y + v_x r from the beginning of steer."""
    row = int(np.argmax(np.abs(steer) * vehicle.steering_ratio >= _BEGINNING_RAD))
    sideways = vy[row:] - vy[row] + _integral(time_s[row:], vx[row:] * rate[row:])
    at_s = time_s[row] + _DISPLACED_S
    displaced = np.interp(at_s, time_s[row:], _integral(time_s[row:], sideways), right=np.nan)
    return {"dwell_displacement": float(np.sign(steer[row]) * displaced)}


def _integral(time_s: FloatArray, values: FloatArray) -> FloatArray:
    areas = 0.5 * (values[1:] + values[:-1]) * np.diff(time_s)
    return np.concatenate([[0.0], np.cumsum(areas)])


def _understeer(
    vehicle: VehicleParameters, _: FloatArray, steer: FloatArray, ay: FloatArray, rate: FloatArray, vx: FloatArray
) -> _Figures:
    beyond = steer - vehicle.wheelbase_m * rate / vx
    linear = np.isfinite(beyond) & (np.abs(ay) <= _LINEAR_M_S2)
    if not linear.any() or np.ptp(ay[linear]) < _LEAST_RANGE_M_S2:
        return {}
    return {"understeer_gradient": float(np.polyfit(ay[linear], beyond[linear], 1)[0])}


def _entry(_: VehicleParameters, __: FloatArray, ___: FloatArray, vx: FloatArray) -> _Figures:
    return {"entry_speed": float(vx[0])}


def _braking(time_s: FloatArray, values: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Return the mean of a column [N] on the circle, and times since the onset and values while the car brakes."""
    since_s = time_s - RULES.turn_s
    circle = (since_s >= -_CIRCLE_S[0]) & (since_s <= -_CIRCLE_S[1])
    return float(values[circle].mean()) if circle.any() else np.nan, since_s[since_s >= 0.0], values[since_s >= 0.0]


def _brake_yaw(_: VehicleParameters, time_s: FloatArray, __: FloatArray, rate: FloatArray, vx: FloatArray) -> _Figures:
    circle, since_s, curvature = _braking(time_s, rate / vx)
    return {"brake_yaw_ratio": float(np.interp(1.0, since_s, curvature, right=np.nan)) / circle} if len(since_s) else {}


def _brake_speed(_: VehicleParameters, time_s: FloatArray, __: FloatArray, vx: FloatArray) -> _Figures:
    since_s, speed = _braking(time_s, vx)[1:]
    return {"brake_deceleration": float((speed[0] - speed[-1]) / np.ptp(since_s))} if len(since_s) > 1 else {}


def _brake_slip(_: VehicleParameters, time_s: FloatArray, __: FloatArray, slip: FloatArray) -> _Figures:
    circle, since_s, values = _braking(time_s, slip)
    return {"brake_sideslip": float(max(values - circle, key=abs))} if len(since_s) else {}


def _sweep(_: VehicleParameters, time_s: FloatArray, steer: FloatArray, rate: FloatArray) -> _Figures:
    """Return figures of the frequency response: cross-spectrum of steering and yaw rate over that of the steering."""
    n = round(_SPECTRUM_S * _RATE_HZ)
    at_s = np.arange(time_s[0], time_s[-1], 1.0 / _RATE_HZ)
    if len(at_s) < n:
        return {}
    pieces = (np.lib.stride_tricks.sliding_window_view(np.interp(at_s, time_s, c), n) for c in (steer, rate))
    every = (p[:: round(n * (1.0 - _OVERLAP))] for p in pieces)
    x, y = (np.fft.rfft((p - p.mean(axis=1, keepdims=True)) * np.hanning(n)) for p in every)
    xx, xy, yy = ((a.conj() * b).mean(axis=0) for a, b in ((x, x), (x, y), (y, y)))
    excited = np.flatnonzero(np.abs(xx) >= _EXCITED * np.max(np.abs(xx)))
    use = slice(excited[0], excited[-1] + 1)
    hz, response = (np.arange(len(xx)) / _SPECTRUM_S)[use], (xy / xx)[use]
    gain, phase = np.abs(response), np.unwrap(np.angle(response))
    coherence = (np.abs(xy) ** 2 / np.abs(xx * yy))[use]
    return {
        "sweep_gain": float(gain[0]),
        "sweep_phase": float(np.interp(1.0, hz, phase, left=np.nan, right=np.nan)),
        "sweep_bandwidth": _reached(hz, -gain / gain[0], -np.sqrt(0.5)),
        "sweep_coherence": float(coherence.mean()),
    }


_RATE, _AY, _VX, _VY, _SLIP = "yaw_rate_rad_s", "ay_m_s2", "vx_m_s", "vy_m_s", "sideslip_rad"
_STEER, _BRAKE, _SINE, _TURN = (
    ("step-steer",),
    ("brake-in-turn",),
    ("sine-with-dwell",),
    ("ramp-steer", "steady-circle"),
)
#: Manoeuvres, signal of their figures, columns of a track that the figures need, and the function that returns them.
_KINDS: tuple[tuple[tuple[str, ...], str, tuple[str, ...], Callable[..., _Figures]], ...] = (
    (_STEER, _RATE, (_RATE,), _step),
    (_STEER, _AY, (_AY,), _step),
    (_STEER, _SLIP, (_RATE, _SLIP), _tb),
    (_SINE, _RATE, (_RATE,), _dwell),
    (_SINE, "position_m", (_VX, _VY, _RATE), _displacement),
    (_TURN, _AY, (_AY, _RATE, _VX), _understeer),
    (("dlc-3888-2",), _VX, (_VX,), _entry),
    (_BRAKE, _RATE, (_RATE, _VX), _brake_yaw),
    (_BRAKE, _VX, (_VX,), _brake_speed),
    (_BRAKE, _SLIP, (_SLIP,), _brake_slip),
    (("sine-sweep",), _RATE, (_RATE,), _sweep),
)


def _figure(name: str, label: str, definition: str, *brief: str, unit: str | None = None) -> Metric:
    """Return a metric whose column has one value."""
    return Metric(
        name, label, definition, responses, lambda values: float(values[0]), whole=True, unit=unit, brief=brief
    )


_RESPONSE = "of the first step steer: from half of the steady steering angle to 90 % of the steady response"
_PEAK_TIME = "of the first step steer: from half of the steady steering angle to the peak of the response"
_RATIO = "of the first sine with dwell: yaw rate {} s after completion of steer over its peak after the reversal"
_DISPLACED = (
    "of the first sine with dwell: lateral displacement 1.07 s after the steering wheel reaches 5°, the double "
)
_DISPLACED += "integral of v̇_y + v_x r, positive to the side of the first steering"
_SLOPE = "slope of the road-wheel angle less L r / v over a_y up to 4 m/s², of the first ramp or steady circle"
_GAIN = (
    "of the first sine sweep: yaw rate over road-wheel angle at the lowest frequency with 5 % of the largest density"
)
_CURVATURE = "of the first braking in a turn: curvature r / v_x 1 s after the onset over that of the circle before"
METRICS = (
    _figure("step_response_time", "response time", _RESPONSE, _RATE, _AY, unit="s"),
    _figure("step_peak_time", "peak response time", _PEAK_TIME, _RATE, unit="s"),
    _figure("step_tb", "TB", "`step_peak_time` of the yaw rate times the steady sideslip", _SLIP, unit="rad*s"),
    _figure("step_peak", "peak of step", "largest response to the first step steer", _RATE, _AY),
    _figure("step_overshoot", "overshoot", "`step_peak` over the steady response, less 1", _RATE, _AY, unit="1"),
    _figure("dwell_ratio_1s", "ratio 1 s", _RATIO.format("1"), _RATE, unit="1"),
    _figure("dwell_ratio_1_75s", "ratio 1.75 s", _RATIO.format("1.75"), _RATE, unit="1"),
    _figure("dwell_displacement", "displacement 1.07 s", _DISPLACED, "position_m"),
    _figure("understeer_gradient", "understeer gradient", _SLOPE, _AY, unit="rad/(m/s^2)"),
    _figure("entry_speed", "entry speed", "v_x at the start of the first severe lane change", _VX),
    _figure("sweep_gain", "yaw gain", _GAIN, _RATE, unit="1/s"),
    _figure(
        "sweep_phase", "yaw phase at 1 Hz", "phase of the yaw rate to the steering; negative: late", _RATE, unit="rad"
    ),
    _figure("sweep_bandwidth", "bandwidth", "frequency at which the gain is 3 dB below `sweep_gain`", _RATE, unit="Hz"),
    _figure("sweep_coherence", "coherence", "of steering and yaw rate, mean of the swept frequencies", _RATE, unit="1"),
    _figure("brake_yaw_ratio", "curvature after 1 s", _CURVATURE, _RATE, unit="1"),
    _figure(
        "brake_deceleration", "deceleration", "mean of v_x, from the onset to the end of braking", _VX, unit="m/s^2"
    ),
    _figure("brake_sideslip", "sideslip by braking", "largest change from its mean on the circle before", _SLIP),
)
