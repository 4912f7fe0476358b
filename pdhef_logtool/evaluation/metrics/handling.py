"""Key figures of manoeuvres, of estimates and of ground truth alike, so that an estimator's effect on them is visible.

Each is of the first manoeuvre of its kind in a drive.

Sources: ISO 7401:2011, clauses 10 (step input: response times, overshoot, TB) and 14 (continuous sine: gain, phase,
coherence); ISO 4138:2021 (understeer gradient); ISO 3888-2:2011 (entry speed of a lane change); ISO 7975:2019 (braking
in a turn, against the circle before it); 49 CFR 571.126, S5.2.1 to S5.2.3 (sine with dwell).
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple, TypeAlias

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.evaluation.manoeuvres import RULES
from pdhef_logtool.evaluation.metrics.metric import Columns, EvaluatedDrive, described
from pdhef_logtool.records.signals import S_PER_NS, BoolArray, FloatArray

#: Sine with dwell: driving after it, share of its peak below which steering is at zero, steering-wheel angle at its
#: beginning, and the time of the displacement after that.
_AFTER_S, _AT_ZERO, _BEGINNING_RAD, _DISPLACED_S = 2.0, 0.05, np.deg2rad(5.0), 1.07
#: Steady states: the end of a step, s; between these times before braking, s; range of a_y in which the understeer
#: gradient is constant, and least range that determines it, m/s².
_STEADY_S, _CIRCLE_S, _LINEAR_M_S2, _LEAST_RANGE_M_S2 = 0.5, (1.3, 0.3), 4.0, 1.0
#: Sweep: duration of a spectrum and its distance from the next, rate of the samples, and least share of the steering's
#: largest spectral density at an excited frequency.
_SPECTRUM_S, _NEXT_S, _RATE_HZ, _EXCITED = 4.0, 1.0, 50.0, 0.05

_Figures: TypeAlias = "dict[str, float]"


class _Steering(NamedTuple):
    """A manoeuvre [N]: the vehicle, time since the manoeuvre's start, and road-wheel angle."""

    vehicle: VehicleParameters
    time_s: FloatArray
    steer: FloatArray


def responses(drive: EvaluatedDrive) -> Iterator[Columns]:
    """Yield the figures of each track: a column for each, with one value at all stamps of its manoeuvre."""
    if drive.calibrated is None:
        return
    signals, vehicle, _ = drive.calibrated
    since_s: FloatArray = np.multiply(signals.stamps_ns - signals.stamps_ns[:1], S_PER_NS)
    kinds = [(_first(drive, since_s, names.split()), needed.split(), figures) for names, needed, figures in _KINDS]
    signals_of, steered = {m.name: m.brief for m in METRICS}, np.isfinite(signals.steer_rad)
    for track in (*drive.tracks.values(), *(() if drive.truth is None else (drive.truth,))):
        for inside, needed, figures in kinds:
            columns = [getattr(track, column) for column in needed]
            use = inside & np.isfinite(columns[0]) & (track.valid | (track is drive.truth))
            use &= steered | ~steered[inside].any()  # some figures need no steering
            if not use.any():
                continue
            of = _Steering(vehicle, since_s[use] - since_s[inside][0], signals.steer_rad[use])
            with np.errstate(divide="ignore", invalid="ignore"):
                values = figures(of, *(c[use] for c in columns))
            for name, value in values.items():
                signal = needed[0] if needed[0] in signals_of[name] else signals_of[name][0]
                yield Columns(track.name, signal, {name: np.full(len(of.steer), value)}, whole=True)


def _first(drive: EvaluatedDrive, since_s: FloatArray, names: list[str]) -> BoolArray:
    """Return the mask [N] of the first manoeuvre with one of these names, and of the time after a sine with dwell."""
    none = np.zeros(len(since_s), dtype=np.bool_)
    rows = np.flatnonzero(np.logical_or.reduce([none, *(drive.masks[n] for n in names if n in drive.masks)]))
    if not len(rows):
        return none
    last = rows[np.append(np.flatnonzero(np.diff(rows) > 1), len(rows) - 1)[0]]
    end_s = since_s[last] + _AFTER_S * ("sine-with-dwell" in names)
    return np.asarray((since_s >= since_s[rows[0]]) & (since_s <= end_s), dtype=np.bool_)


def _reached(time_s: FloatArray, share: FloatArray, level: float) -> float:
    """Return the first time at which a share [N] reaches a level, between stamps; NaN if it does not."""
    row = int(np.argmax(share >= level))
    pair = slice(max(row - 1, 0), row + 1)
    return float(np.interp(level, share[pair], time_s[pair])) if share[row] >= level else np.nan


def _step(of: _Steering, response: FloatArray, slip: FloatArray | None = None) -> _Figures:
    settled = of.time_s >= of.time_s[-1] - _STEADY_S
    changes = [c - c[0] for c in (of.steer, response)]
    steady = [float(np.mean(c[settled])) for c in changes]
    steering, answer = (c / s for c, s in zip(changes, steady, strict=True))
    start_s, peak = _reached(of.time_s, steering, 0.5), float(np.max(answer))
    peak_s = float(of.time_s[np.argmax(answer)]) - start_s
    return {
        "step_response_time": _reached(of.time_s, answer, 0.9) - start_s,
        "step_peak_time": peak_s,
        "step_peak": peak * steady[1],
        "step_overshoot": max(peak - 1.0, 0.0),
    } | ({} if slip is None else {"step_tb": peak_s * float(np.mean(slip[settled]) - slip[0])})


def _ratios(of: _Steering, rate: FloatArray) -> _Figures:
    """Return the yaw rate some time after the steering is complete, over its peak after the steering reverses."""
    first = int(np.argmax(np.abs(of.steer) > 0.5 * np.max(np.abs(of.steer))))
    side = np.sign(of.steer[first])
    back, answer = -side * of.steer, -side * rate
    reversal = first + int(np.argmax(back[first:] > 0.0))
    second = reversal + int(np.argmax(back[reversal:]))
    complete = second + int(np.argmax(back[second:] < _AT_ZERO * back[second]))
    peak = float(np.max(answer[reversal : complete + 1]))
    if complete == second or peak <= 0.0:
        return {}
    after = {"dwell_ratio_1s": 1.0, "dwell_ratio_1_75s": 1.75}
    return {n: np.interp(of.time_s[complete] + s, of.time_s, answer, right=np.nan) / peak for n, s in after.items()}


def _displacement(of: _Steering, vx: FloatArray, vy: FloatArray, rate: FloatArray) -> _Figures:
    """Return the double integral of the lateral acceleration v̇_y + v_x r from the beginning of steer."""
    row = int(np.argmax(np.abs(of.steer) * of.vehicle.steering_ratio >= _BEGINNING_RAD))
    time_s = of.time_s[row:]

    def integral(values: FloatArray) -> FloatArray:
        return np.append(0.0, np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(time_s)))

    sideways = integral(vy[row:] - vy[row] + integral(vx[row:] * rate[row:]))
    displaced = np.interp(time_s[0] + _DISPLACED_S, time_s, sideways, right=np.nan)
    return {"dwell_displacement": float(np.sign(of.steer[row]) * displaced)}


def _understeer(of: _Steering, ay: FloatArray, rate: FloatArray, vx: FloatArray) -> _Figures:
    beyond = of.steer - of.vehicle.wheelbase_m * rate / vx
    linear = np.isfinite(beyond) & (np.abs(ay) <= _LINEAR_M_S2)
    if not linear.any() or np.ptp(ay[linear]) < _LEAST_RANGE_M_S2:
        return {}
    return {"understeer_gradient": float(np.polyfit(ay[linear], beyond[linear], 1)[0])}


def _brake(of: _Steering, vx: FloatArray, rate: FloatArray, slip: FloatArray) -> _Figures:
    since_s = of.time_s - RULES.turn_s
    circle, braking = (since_s >= -_CIRCLE_S[0]) & (since_s <= -_CIRCLE_S[1]), since_s >= 0.0
    if not circle.any() or np.count_nonzero(braking) < 2:
        return {}
    curvature, change = rate / vx, (slip - np.mean(slip[circle]))[braking & np.isfinite(slip)]
    speed, end_s = vx[braking], since_s[braking][[0, -1]]
    return {
        "brake_yaw_ratio": np.interp(1.0, since_s, curvature, right=np.nan) / np.mean(curvature[circle]),
        "brake_deceleration": float((speed[0] - speed[-1]) / np.ptp(end_s)),
        "brake_sideslip": float(max(change, key=abs, default=np.nan)),
    }


def _sweep(of: _Steering, rate: FloatArray) -> _Figures:
    """Return figures of the frequency response: cross-spectrum of steering and yaw rate over the steering spectrum."""
    n, step = round(_SPECTRUM_S * _RATE_HZ), round(_NEXT_S * _RATE_HZ)
    at_s = np.arange(of.time_s[0], of.time_s[-1], 1.0 / _RATE_HZ)
    if len(at_s) < n or not np.isfinite(of.steer).all():
        return {}
    columns = (np.interp(at_s, of.time_s, c) for c in (of.steer, rate))
    pieces = (np.lib.stride_tricks.sliding_window_view(c, n)[::step] for c in columns)
    x, y = (np.fft.rfft((p - p.mean(axis=1, keepdims=True)) * np.hanning(n)) for p in pieces)
    xx, xy, yy = (np.mean(a.conj() * b, axis=0) for a, b in ((x, x), (x, y), (y, y)))
    excited = np.flatnonzero(np.abs(xx) >= _EXCITED * np.max(np.abs(xx)))
    use = slice(excited[0], excited[-1] + 1)
    hz, response = (np.arange(len(xx)) / _SPECTRUM_S)[use], (xy / xx)[use]
    gain = np.abs(response)
    return {
        "sweep_gain": float(gain[0]),
        "sweep_phase": np.interp(1.0, hz, np.unwrap(np.angle(response)), left=np.nan, right=np.nan),
        "sweep_bandwidth": _reached(hz, -gain / gain[0], -np.sqrt(0.5)),
        "sweep_coherence": float(np.mean((np.abs(xy) ** 2 / np.abs(xx * yy))[use])),
    }


#: Manoeuvres, columns of a track (the first one determines the stamps), and the function that returns the figures.
_KINDS: tuple[tuple[str, str, Callable[..., _Figures]], ...] = (
    ("step-steer", "yaw_rate_rad_s sideslip_rad", _step),
    ("step-steer", "ay_m_s2", _step),
    ("sine-with-dwell", "yaw_rate_rad_s", _ratios),
    ("sine-with-dwell", "vx_m_s vy_m_s yaw_rate_rad_s", _displacement),
    ("ramp-steer steady-circle", "ay_m_s2 yaw_rate_rad_s vx_m_s", _understeer),
    ("dlc-3888-2", "vx_m_s", lambda _, vx: {"entry_speed": float(vx[0])}),
    ("brake-in-turn", "vx_m_s yaw_rate_rad_s sideslip_rad", _brake),
    ("sine-sweep", "yaw_rate_rad_s", _sweep),
)

_NAMES = """
step_response_time step_peak_time step_tb step_peak step_overshoot dwell_ratio_1s dwell_ratio_1_75s dwell_displacement
understeer_gradient entry_speed sweep_gain sweep_phase sweep_bandwidth sweep_coherence brake_yaw_ratio
brake_deceleration brake_sideslip
"""
METRICS = described(responses, **dict.fromkeys(_NAMES.split(), lambda v: float(v[0])))
